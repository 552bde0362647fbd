//! After a call that found nothing, failed, ran out of time or was given up, the next answer is,
//! byte for byte, that of a node that has just started.

use std::{collections::BTreeMap, time::Duration};

use proptest::{
    prelude::*,
    test_runner::{Config as Runs, RngAlgorithm, TestRng, TestRunner},
};
use prost::Message as _;
use serde_json::{Value, json};
use tokio::runtime::Runtime;
use tonic::{Code, Request, Status};
use vbar_proto::v1::{
    self, compute_plan_response::Outcome as Planned, step_response::Verdict as Decided,
};

use crate::{
    missions::{self, at_rest, integrator, message},
    offline_sampling::poseidyn,
    support::{Client, Server, server, step_request},
};

/// A call whose answer must not depend on what was called before.
#[derive(Debug, Clone)]
enum Ask {
    Step(Box<v1::StepRequest>),
    Plan(Box<v1::ComputePlanRequest>),
}

/// A call, the same without an answer, and the same as no caller should send it.
#[derive(Debug)]
struct Probe {
    name: &'static str,
    ask: Ask,
    hopeless: Option<Ask>,
    wrong: Vec<Ask>,
}

/// What comes before the call that counts.
#[derive(Debug, Clone, Copy)]
enum Blow {
    /// There is nothing to find.
    Hopeless,
    /// Fields or a controller state that nobody can use; which of them.
    Wrong(usize),
    /// A deadline, microseconds.
    Deadline(u64),
    /// The caller hangs up, microseconds after it called.
    HangUp(u64),
}

impl Ask {
    fn step(problem: &Value, measurement: Value) -> Self {
        Self::Step(Box::new(step_request(("problem", problem.clone()), measurement)))
    }

    fn plan(problem: &Value, initial: Option<Value>) -> Self {
        let mut request = json!({ "problem": problem });
        if let Some(initial) = initial {
            request["initial"] = initial;
        }
        Self::Plan(Box::new(message(request)))
    }

    async fn send(&self, client: &Client, within: Option<Duration>) -> Result<Answer, Status> {
        fn with<T>(message: &T, within: Option<Duration>) -> Request<T>
        where
            T: Clone,
        {
            let mut request = Request::new(message.clone());
            within.into_iter().for_each(|deadline| request.set_timeout(deadline));
            request
        }
        let mut client = client.clone();
        Ok(match self {
            Self::Step(step) => {
                let answer = client.step(with(&**step, within)).await?.into_inner();
                Answer {
                    is_infeasible: matches!(answer.verdict, Some(Decided::Infeasible(_))),
                    text: format!("{answer:?}"),
                    bytes: answer.encode_to_vec(),
                }
            }
            Self::Plan(plan) => {
                let answer = client.compute_plan(with(&**plan, within)).await?.into_inner();
                Answer {
                    is_infeasible: matches!(answer.outcome, Some(Planned::Infeasible(_))),
                    text: format!("{answer:?}"),
                    bytes: answer.encode_to_vec(),
                }
            }
        })
    }

    /// The answer, when there is a thread for it: one that was given up may hold it a little.
    async fn answer(&self, client: &Client) -> Result<Answer, TestCaseError> {
        const PATIENCE: u32 = 2000;
        for _ in 0..PATIENCE {
            match self.send(client, None).await {
                Err(status) if status.code() == Code::ResourceExhausted => {
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
                answer => return answer.map_err(|status| TestCaseError::fail(status.to_string())),
            }
        }
        Err(TestCaseError::fail("every thread is held for ever"))
    }
}

#[derive(Debug, PartialEq)]
struct Answer {
    is_infeasible: bool,
    bytes: Vec<u8>,
    /// For whoever has to find out why it is another.
    text: String,
}

/// Where two answers begin to differ.
fn differences(answer: &Answer, fresh: &Answer) -> String {
    const SHOWN: usize = 120;
    let (a, b) = (answer.text.as_bytes(), fresh.text.as_bytes());
    let place = a.iter().zip(b).take_while(|(a, b)| a == b).count();
    let from = place.saturating_sub(SHOWN);
    let shown = |text: &[u8]| {
        String::from_utf8_lossy(&text[from..text.len().min(place + SHOWN)]).into_owned()
    };
    format!("answers {}, of a fresh node {}", shown(a), shown(b))
}

/// Steps of a mission: the first, and the second from the state that the first left.
async fn steps(
    [first, second]: [&'static str; 2],
    problem: &Value,
    near: Value,
    next: impl Fn(&v1::StepResponse) -> Value,
    far: Option<Value>,
) -> [Probe; 2] {
    let step = |measurement: &Value| Ask::step(problem, measurement.clone());
    let answer = step(&near).answer(&server().await.grpc().await).await.unwrap();
    let answer = v1::StepResponse::decode(&*answer.bytes).expect("an answer of ours");
    let (state, next) = (answer.controller_state.clone(), next(&answer));
    let with_state = |state: &bytes::Bytes, measurement: &Value| {
        let mut ask = step(measurement);
        let Ask::Step(request) = &mut ask else { unreachable!("it is a step") };
        request.controller_state = state.clone();
        ask
    };
    let mut torn = state.to_vec();
    torn.truncate(state.len() / 2);
    let wrong = || {
        let nothing = json!({ "linear": { "components": [] } });
        vec![step(&nothing), with_state(&torn.clone().into(), &near), with_state(&state, &nothing)]
    };
    let far = |state: &bytes::Bytes| far.as_ref().map(|far| with_state(state, far));
    [
        Probe {
            name: first,
            ask: step(&near),
            hopeless: far(&bytes::Bytes::new()),
            wrong: wrong(),
        },
        Probe { name: second, ask: with_state(&state, &next), hopeless: None, wrong: wrong() },
    ]
}

/// Length of EnviSat's step.
const STEP_S: f64 = 5.863_519_064_155_094;

/// Calls of every method, with different solvers behind them.
async fn probes() -> Vec<Probe> {
    let linear = |components: &[f64]| json!({ "linear": { "components": components } });
    let envisat = missions::envisat();
    let mut far_away = missions::envisat_start();
    far_away["relative"]["positionM"] = json!([50_000.0, 0.0, 0.0]);
    let mut unstable = envisat.clone();
    unstable["variableHorizon"]["gain"]["poles"]["values"][0] = 1.5.into();
    // 300 m from the approach ellipsoid at 12 m/s towards it.
    let mut doomed = at_rest(2300.0);
    doomed["relative"]["velocityMS"] = json!([0.0, -12.0, 0.0]);
    let (prisma, too_little) = (missions::prisma(), missions::prisma_6000_s(0.01));

    let mut probes = Vec::new();
    probes.extend(
        steps(
            ["envisat, first step", "envisat, second step"],
            &envisat,
            missions::envisat_start(),
            |first| missions::predicted(first, STEP_S),
            Some(far_away.clone()),
        )
        .await,
    );
    probes.extend(
        steps(
            ["double integrator, first step", "double integrator, second step"],
            &missions::double_integrator(),
            linear(&[20.0, 0.0]),
            |_| linear(&[20.0, 0.1]),
            Some(linear(&[200.0, 0.0])),
        )
        .await,
    );
    probes.extend(
        steps(
            ["prisma, first burn", "prisma, second burn"],
            &prisma,
            missions::prisma_measurement(0),
            |_| missions::prisma_measurement(1),
            None,
        )
        .await,
    );
    probes.extend(
        steps(
            ["station, first step", "station, second step"],
            &missions::station(),
            at_rest(5000.0),
            |_| at_rest(4990.0),
            Some(doomed),
        )
        .await,
    );
    probes.extend(
        steps(
            ["integrator of uncertain strength, first step", "the same, second step"],
            &integrator(),
            linear(&[2.0, 0.0]),
            |_| linear(&[1.9, -0.1]),
            Some(linear(&[3.9, 1.4])),
        )
        .await,
    );
    probes.extend(
        steps(
            ["poseidyn, first step", "poseidyn, second step"],
            &poseidyn(),
            linear(&[0.5, 0.5, 0.0, 0.0]),
            |_| linear(&[0.49, 0.5, 0.0, 0.0]),
            Some(linear(&[-3.0, 3.0, 0.0, 0.0])),
        )
        .await,
    );
    let plan = |problem: &Value, initial: Option<Value>| Ask::plan(problem, initial);
    probes.push(Probe {
        name: "envisat, plan",
        ask: plan(&envisat, Some(missions::envisat_start())),
        hopeless: Some(plan(&envisat, Some(far_away))),
        wrong: vec![plan(&unstable, Some(missions::envisat_start())), plan(&envisat, None)],
    });
    for (name, problem) in [
        ("prisma, plan", prisma.clone()),
        ("prisma in 6000 s, plan", missions::prisma_6000_s(0.279)),
    ] {
        probes.push(Probe {
            name,
            ask: plan(&problem, None),
            hopeless: Some(plan(&too_little, None)),
            wrong: vec![plan(&problem, Some(missions::prisma_measurement(0)))],
        });
    }
    probes
}

fn blows(probes: usize) -> impl Strategy<Value = Vec<(usize, Blow)>> {
    // Evenly over orders of magnitude, from before the call arrives to after its answer.
    let micros = || (0.0..5.0_f64).prop_map(|exponent| 10_f64.powf(exponent) as u64);
    let blow = prop_oneof![
        Just(Blow::Hopeless),
        (0..3_usize).prop_map(Blow::Wrong),
        micros().prop_map(Blow::Deadline),
        micros().prop_map(Blow::HangUp),
    ];
    prop::collection::vec((0..probes, blow), 1..14)
}

/// What came of the blows: none may be always absent.
type Tally = BTreeMap<&'static str, usize>;

async fn strike(
    client: &Client,
    probe: &Probe,
    blow: Blow,
    tally: &mut Tally,
) -> Result<(), TestCaseError> {
    let (ask, within) = match blow {
        Blow::Hopeless => (probe.hopeless.as_ref().unwrap_or(&probe.ask), None),
        Blow::Wrong(which) => (&probe.wrong[which % probe.wrong.len()], None),
        Blow::Deadline(micros) => (&probe.ask, Some(Duration::from_micros(micros))),
        Blow::HangUp(micros) => {
            let call =
                tokio::time::timeout(Duration::from_micros(micros), probe.ask.send(client, None));
            let outcome = if call.await.is_err() { "given up" } else { "not given up in time" };
            *tally.entry(outcome).or_default() += 1;
            return Ok(());
        }
    };
    let outcome = match (blow, ask.send(client, within).await) {
        (Blow::Wrong(_), Err(status)) => {
            let expected = [Code::InvalidArgument, Code::FailedPrecondition];
            prop_assert!(expected.contains(&status.code()), "{}: {status}", probe.name);
            "refused"
        }
        (Blow::Wrong(_), Ok(_)) => {
            return Err(TestCaseError::fail(format!("{}: {ask:?} was answered", probe.name)));
        }
        (Blow::Hopeless, Ok(answer)) if probe.hopeless.is_some() => {
            prop_assert!(answer.is_infeasible, "{}: there was an answer", probe.name);
            "infeasible"
        }
        (_, Ok(_)) => "answered",
        (Blow::Deadline(_), Err(status))
            if matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled) =>
        {
            "out of time"
        }
        (_, Err(status)) if status.code() == Code::ResourceExhausted => "busy",
        (_, Err(status)) => return Err(TestCaseError::fail(format!("{}: {status}", probe.name))),
    };
    *tally.entry(outcome).or_default() += 1;
    Ok(())
}

async fn check(
    probes: &[Probe],
    fresh: &[Answer],
    blows: &[(usize, Blow)],
    tally: &mut Tally,
) -> Result<(), TestCaseError> {
    let server: Server = server().await;
    let client = server.grpc().await;
    for &(index, blow) in blows {
        let probe = &probes[index];
        strike(&client, probe, blow, tally).await?;
        let answer = probe.ask.answer(&client).await?;
        prop_assert!(
            answer == fresh[index],
            "{} {}",
            probe.name,
            differences(&answer, &fresh[index])
        );
    }
    // What was not struck since has not heard of it either.
    for (probe, fresh) in probes.iter().zip(fresh) {
        let answer = probe.ask.answer(&client).await?;
        prop_assert!(answer == *fresh, "{} {}", probe.name, differences(&answer, fresh));
    }
    Ok(())
}

#[test]
fn answers_after_any_blow_are_those_of_a_fresh_node() {
    const CASES: u32 = 16;
    let runtime = Runtime::new().unwrap();
    let (probes, fresh) = runtime.block_on(async {
        let probes = probes().await;
        let mut fresh = Vec::new();
        for probe in &probes {
            // Each of a node of its own, which did nothing before.
            fresh.push(probe.ask.answer(&server().await.grpc().await).await.unwrap());
        }
        (probes, fresh)
    });
    let runs = Runs { cases: CASES, failure_persistence: None, ..Runs::default() };
    let mut runner =
        TestRunner::new_with_rng(runs, TestRng::deterministic_rng(RngAlgorithm::ChaCha));
    let tally = std::cell::RefCell::new(Tally::new());
    let outcome = runner.run(&blows(probes.len()), |blows| {
        runtime.block_on(check(&probes, &fresh, &blows, &mut tally.borrow_mut()))
    });
    if let Err(error) = outcome {
        panic!("{error}");
    }
    let tally = tally.into_inner();
    for kind in ["infeasible", "refused", "out of time", "given up"] {
        assert!(tally.get(kind).is_some_and(|&count| count > 5), "{kind}: {tally:?}");
    }
}
