//! What is asked, and what a node answers that nobody else asks.

use prost::Message as _;
use serde_json::json;
use vbar_client::{
    Client, Code, Options,
    v1::{
        self, ComputePlanRequest, Measurement, SafetyReportRequest, StepRequest, StepResponse,
        precompute_response::Outcome, step_request::Controller, step_response::Verdict,
    },
};

use crate::missions::{self, message};

/// Steps of each method that are asked again and again.
const STEPS: usize = 6;

/// A question whose answer is known.
#[derive(Debug, Clone)]
pub(crate) struct Question<Q> {
    pub(crate) name: &'static str,
    pub(crate) request: Q,
    /// Its bytes.
    pub(crate) answer: Vec<u8>,
}

/// A closed loop whose answers are known.
#[derive(Debug, Clone)]
pub(crate) struct Flight {
    pub(crate) artifact_id: String,
    pub(crate) steps: Vec<(Measurement, Vec<u8>)>,
}

/// Everything that is asked.
#[derive(Debug, Clone)]
pub(crate) struct Questions {
    pub(crate) steps: Vec<Question<StepRequest>>,
    pub(crate) flights: Vec<Flight>,
    pub(crate) plans: Vec<Question<ComputePlanRequest>>,
    pub(crate) reports: Vec<Question<SafetyReportRequest>>,
    pub(crate) problems: Vec<v1::Problem>,
    /// Each with a fault, and the path that must be named.
    pub(super) faulty: Vec<(StepRequest, &'static str)>,
}

/// A client that shows every refusal.
pub(super) async fn client(url: &str) -> Client {
    let options = Options {
        attempts_max: 1,
        deadline: std::time::Duration::from_secs(20),
        ..Options::default()
    };
    Client::connect(url, options).await.unwrap()
}

impl Questions {
    /// Asks a node that has nothing else to do.
    pub(crate) async fn answered_by(url: &str) -> Self {
        let client = client(url).await;
        let at_rest = |state: [f64; 2]| json!({ "linear": { "components": state } });
        let methods = [
            ("variable_horizon", missions::envisat(), missions::envisat_start()),
            ("disturbance_feedback", missions::prisma(), missions::prisma_measurement(0)),
            ("abort_safe", missions::station(), missions::at_rest(5000.0)),
            ("offline_sampling", missions::integrator(), at_rest([2.0, 0.1])),
        ];
        let (mut steps, mut flights, mut problems) = (Vec::new(), Vec::new(), Vec::new());
        for (name, problem, start) in methods {
            let problem: v1::Problem = message(problem);
            let made = client.precompute(problem.clone()).await.unwrap();
            let Some(Outcome::Artifact(artifact)) = made.outcome else { panic!("{made:?}") };
            let asked = fly(&client, &artifact.artifact_id, message(start)).await;
            flights.push(Flight {
                artifact_id: artifact.artifact_id,
                steps: asked
                    .iter()
                    .map(|(request, answer)| {
                        (request.measurement.clone().unwrap(), answer.encode_to_vec())
                    })
                    .collect(),
            });
            steps.extend(asked.into_iter().map(|(request, answer)| Question {
                name,
                request,
                answer: answer.encode_to_vec(),
            }));
            problems.push(problem);
        }
        let plans = plans(&client).await;
        let reports = reports(&client, &flights[2].artifact_id).await;
        let faulty = faulty(&steps);
        for (request, path) in &faulty {
            let error = client.step(request.clone()).await.unwrap_err();
            assert_eq!(error.code, Code::InvalidArgument, "{error}");
            assert!(error.violations.iter().any(|v| v.field == *path), "{error}");
        }
        Self { steps, flights, plans, reports, problems, faulty }
    }

    /// Two nodes gave the same answers.
    pub(super) fn must_equal(&self, other: &Self) {
        fn same<Q: PartialEq + std::fmt::Debug>(ours: &[Question<Q>], theirs: &[Question<Q>]) {
            assert_eq!(ours.len(), theirs.len());
            for (i, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
                assert_eq!(ours.request, theirs.request, "{} {i} was asked otherwise", ours.name);
                assert!(ours.answer == theirs.answer, "{} {i} has two answers", ours.name);
            }
        }
        same(&self.steps, &other.steps);
        same(&self.plans, &other.plans);
        same(&self.reports, &other.reports);
    }
}

/// Some steps of an undisturbed flight. Each answer must bring its proof, if it is a command.
async fn fly(client: &Client, id: &str, start: Measurement) -> Vec<(StepRequest, StepResponse)> {
    let mut asked = Vec::new();
    let mut request = StepRequest {
        controller: Some(Controller::ArtifactId(id.to_owned())),
        measurement: Some(start),
        ..StepRequest::default()
    };
    while asked.len() < STEPS {
        let answer = client.step(request.clone()).await.unwrap();
        let next = match &answer.verdict {
            Some(Verdict::Command(command)) => {
                let proof = answer.certificate.as_ref();
                assert!(proof.is_some_and(|proof| proof.passed), "{answer:?}");
                next_measurement(&request, &answer, command)
            }
            Some(Verdict::Arrived(_)) => None,
            _ => panic!("{answer:?}"),
        };
        let state = answer.controller_state.clone();
        asked.push((request.clone(), answer));
        request = StepRequest { controller_state: state, measurement: next, ..request };
        if request.measurement.is_none() {
            break;
        }
    }
    asked
}

/// What is measured next if nothing disturbs: as predicted, where there is a prediction; the
/// same again for a plan, which measures what it pleases.
fn next_measurement(
    request: &StepRequest,
    answer: &StepResponse,
    command: &v1::Command,
) -> Option<Measurement> {
    let prediction = answer.prediction.as_ref()?;
    let row = |matrix: &v1::Matrix| {
        let width = usize::try_from(matrix.columns).unwrap();
        matrix.values[width..2 * width].to_vec()
    };
    let (Some(positions), Some(velocities)) = (&prediction.positions_m, &prediction.velocities_m_s)
    else {
        let components = row(prediction.states_nd.as_ref()?);
        return Some(message(json!({ "linear": { "components": components } })));
    };
    let elapsed_s = request.measurement.as_ref()?.elapsed_s;
    Some(message(json!({
        "relative": {
            "frame": v1::Frame::try_from(command.frame).ok()?.as_str_name(),
            "positionM": row(positions),
            "velocityMS": row(velocities),
        },
        "elapsedS": elapsed_s.and_then(|elapsed_s| Some(elapsed_s + command.duration_s?)),
    })))
}

async fn plans(client: &Client) -> Vec<Question<ComputePlanRequest>> {
    let mut plans = Vec::new();
    for problem in [missions::prisma(), missions::prisma_6000_s(0.26), missions::envisat()] {
        let mut request = json!({ "problem": problem });
        if request["problem"]["variableHorizon"].is_object() {
            request["initial"] = missions::envisat_start();
        }
        let request: ComputePlanRequest = message(request);
        let answer = client.plan(request.clone()).await.unwrap();
        plans.push(Question { name: "plan", request, answer: answer.encode_to_vec() });
    }
    plans
}

async fn reports(client: &Client, station: &str) -> Vec<Question<SafetyReportRequest>> {
    let mut reports = Vec::new();
    for along_track_m in [400.0, 1200.0, 3000.0] {
        let state = &missions::at_rest(along_track_m)["relative"];
        let request: SafetyReportRequest =
            message(json!({ "artifactId": station, "states": { "states": [state] } }));
        let answer = client.safety_report(request.clone()).await.unwrap();
        reports.push(Question { name: "report", request, answer: answer.encode_to_vec() });
    }
    reports
}

fn faulty(steps: &[Question<StepRequest>]) -> Vec<(StepRequest, &'static str)> {
    let good = &steps[0].request;
    let mut not_a_number = good.clone();
    if let Some(v1::measurement::State::Relative(state)) =
        not_a_number.measurement.as_mut().and_then(|measurement| measurement.state.as_mut())
    {
        state.position_m[0] = f64::NAN;
    }
    let no_controller = StepRequest { controller: None, ..good.clone() };
    let no_measurement = StepRequest { measurement: None, ..good.clone() };
    vec![
        (not_a_number, "measurement.relative.position_m[0]"),
        (no_controller, "controller"),
        (no_measurement, "measurement"),
    ]
}
