//! A client and a node, with a wire between them that fails on purpose.
//!
//! Every call is answered, and rightly, as if nothing had been wrong; what is asked twice is done
//! once. How to repeat a case that fails is said where it does.

mod wire;

use std::{future::Future, net::SocketAddr, time::Duration};

use fastrand::Rng;
use prost::Message as _;
use tokio::{runtime::Runtime, task::JoinSet, time::sleep};
use vbar_client::{
    Client, Error, Options,
    v1::{
        ListPlansRequest, StepRequest, UploadPlanRequest, precompute_response::Outcome,
        step_request, step_stream_request::Controller, upload_plan_request::Content,
    },
};
use vbar_proto::google::longrunning::ListOperationsRequest;
use vbar_server::{Config, Node};

use crate::{
    nodes::{Mortal, envisat, fly},
    seeds::each_seed,
    soak::questions::Questions,
};
use wire::{Fault, Side, Wire};

fn address(node: &Mortal) -> SocketAddr {
    node.url.strip_prefix("http://").unwrap().parse().unwrap()
}

/// A wire to a node, with more faults than a flight goes without meeting and fewer than a client
/// makes attempts.
async fn faulty(node: &Mortal, rng: &mut Rng) -> Wire {
    let faults = (0..6).map(|_| Fault::drawn(rng)).collect();
    Wire::start(address(node), faults).await
}

/// Those of a client that tries for longer than anything goes wrong.
fn patient() -> Options {
    Options {
        attempts_max: 40,
        deadline: Duration::from_secs(120),
        silence_max: Duration::from_secs(1),
        ..Options::default()
    }
}

async fn client(wire: &Wire) -> Client {
    Client::connect(&wire.url, patient()).await.unwrap()
}

#[test]
fn faults_network_change_no_flight() {
    let runtime = Runtime::new().unwrap();
    let node = Mortal::start(Config::default());
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let controller = Controller::Problem(mission.problem);
    let flown = async |url: &str, options: Options| {
        let client = Client::connect(url, options).await?;
        let flight = client.closed_loop(controller.clone()).await?;
        fly(flight, start.clone(), usize::MAX).await.map(|(_, answers, _)| answers)
    };
    let undisturbed = runtime.block_on(flown(&node.url, Options::default())).unwrap();
    assert!(undisturbed.len() > 5);
    each_seed("-p vbar-system-tests --test system faults_network_change_no_flight", 5, |seed| {
        runtime.block_on(async {
            let wire = faulty(&node, &mut Rng::with_seed(seed)).await;
            let answers = flown(&wire.url, patient()).await;
            let answers = answers.unwrap_or_else(|error| panic!("{error}: {:?}", wire.faults));
            assert_eq!(answers, undisturbed, "{:?}", wire.faults);
        });
    });
}

#[test]
fn faults_network_half_open_or_lost_answer_is_asked_for_again_on_another_connection() {
    let runtime = Runtime::new().unwrap();
    let node = Mortal::start(Config::default());
    let mission = envisat();
    let request = StepRequest {
        controller: Some(step_request::Controller::Problem(mission.problem.clone())),
        measurement: Some(mission.fixed_start().unwrap()),
        ..StepRequest::default()
    };
    runtime.block_on(async {
        let direct = Client::connect(&node.url, Options::default()).await.unwrap();
        let answer = direct.step(request.clone()).await.unwrap();
        // After the greetings; in the midst of the question; in the midst of the answer.
        for (after, from) in [(100, Side::Node), (200, Side::Client), (400, Side::Node)] {
            for fault in [Fault::Silence { after, from }, Fault::Reset { after, from }] {
                let wire = Wire::start(address(&node), vec![fault]).await;
                let client = client(&wire).await;
                assert_eq!(client.step(request.clone()).await.unwrap(), answer, "{fault:?}");
                assert_eq!(client.retries(), 1, "{fault:?} was not met");
            }
        }
    });
}

/// What a closed loop of any method is answered.
#[test]
fn faults_network_change_no_answer_of_any_method() {
    let runtime = Runtime::new().unwrap();
    let node = Mortal::start(Config::default());
    let known = runtime.block_on(Questions::answered_by(&node.url));
    each_seed("-p vbar-system-tests --test system faults_network_change_no_answer", 5, |seed| {
        runtime.block_on(async {
            let wire = faulty(&node, &mut Rng::with_seed(seed)).await;
            let client = client(&wire).await;
            for flight in &known.flights {
                let controller = Controller::ArtifactId(flight.artifact_id.clone());
                let mut flown = client.closed_loop(controller).await.unwrap();
                for (measurement, answer) in &flight.steps {
                    let answered = flown.step(measurement.clone()).await;
                    let answered =
                        answered.unwrap_or_else(|fault| panic!("{fault}: {:?}", wire.faults));
                    assert!(answered.encode_to_vec() == *answer, "{:?}", wire.faults);
                }
            }
        });
    });
}

/// Asks again when the node says that it has no room, as it may when so much is asked at once.
async fn patiently<T, F: Future<Output = Result<T, Error>>>(ask: impl Fn() -> F) -> T {
    loop {
        match ask().await {
            Ok(answer) => return answer,
            Err(Error { retry_after: Some(after), .. }) => sleep(after).await,
            Err(error) => panic!("{error}"),
        }
    }
}

/// One thing that is asked, and what must come of it.
#[derive(Debug, Clone)]
enum Ask {
    Precompute(usize),
    Upload,
    Step(usize),
    Report(usize),
}

impl Ask {
    async fn check(self, client: Client, known: &Questions, plan: &(String, UploadPlanRequest)) {
        match self {
            Self::Precompute(n) => {
                let problem = &known.problems[n];
                let made = patiently(|| client.precompute(problem.clone())).await;
                let Some(Outcome::Artifact(made)) = made.outcome else { panic!("{made:?}") };
                assert_eq!(made.artifact_id, known.flights[n].artifact_id);
            }
            Self::Upload => {
                let (id, upload) = plan;
                let kept = patiently(|| client.upload_plan(upload.clone())).await;
                assert_eq!(kept.plan_id, *id);
            }
            Self::Step(n) => {
                let question = &known.steps[n];
                let answer = patiently(|| client.step(question.request.clone())).await;
                assert!(answer.encode_to_vec() == question.answer, "{}", question.name);
            }
            Self::Report(n) => {
                let question = &known.reports[n];
                let answer = patiently(|| client.safety_report(question.request.clone())).await;
                assert!(answer.encode_to_vec() == question.answer, "{}", question.name);
            }
        }
    }
}

/// Everything once to three times, in an order of its own, at once over several connections.
async fn all_at_once(
    asks: Vec<Ask>,
    wire: &Wire,
    known: &'static Questions,
    plan: &'static (String, UploadPlanRequest),
    rng: &mut Rng,
) {
    let mut asks: Vec<Ask> = asks.into_iter().flat_map(|ask| vec![ask; rng.usize(1..=3)]).collect();
    rng.shuffle(&mut asks);
    let clients = [client(wire).await, client(wire).await, client(wire).await];
    let mut tasks = JoinSet::new();
    for ask in asks {
        let client = clients[rng.usize(..clients.len())].clone();
        tasks.spawn(ask.check(client, known, plan));
    }
    while let Some(checked) = tasks.join_next().await {
        checked.unwrap_or_else(|fault| panic!("{fault}: {:?}", wire.faults));
    }
}

#[test]
fn faults_network_calls_asked_twice_and_out_of_turn_are_done_once() {
    let runtime = Runtime::new().unwrap();
    let (known, plan) = runtime.block_on(async {
        let node = Node::start(Config::default()).await.unwrap();
        let url = format!("http://{}", node.local_address());
        let known = Questions::answered_by(&url).await;
        let client = Client::connect(&url, Options::default()).await.unwrap();
        let kept = client.plan(known.plans[0].request.clone()).await.unwrap().plan_id;
        let document = client.get_plan(&kept).await.unwrap().document.unwrap();
        let content = Some(Content::Document(document));
        node.shutdown().await;
        (known, (kept, UploadPlanRequest { content, validate_only: false }))
    });
    // Tasks outlive no case, but they cannot know that.
    let (known, plan): (&'static Questions, &'static _) =
        (Box::leak(Box::new(known)), Box::leak(Box::new(plan)));
    each_seed("-p vbar-system-tests --test system faults_network_calls", 3, |seed| {
        let node = Mortal::start(Config::default());
        runtime.block_on(async {
            let mut rng = Rng::with_seed(seed);
            let wire = faulty(&node, &mut rng).await;
            let mut asks: Vec<_> = (0..known.problems.len()).map(Ask::Precompute).collect();
            asks.push(Ask::Upload);
            all_at_once(asks, &wire, known, plan, &mut rng).await;
            let steps = (0..known.steps.len()).map(Ask::Step);
            let asks = steps.chain((0..known.reports.len()).map(Ask::Report)).collect();
            all_at_once(asks, &wire, known, plan, &mut rng).await;

            let client = client(&wire).await;
            let plans = client.list_plans(ListPlansRequest::default()).await.unwrap().plans;
            assert_eq!(plans.len(), 1, "a plan that was uploaded twice is one plan");
            let jobs = client.operations(ListOperationsRequest::default()).await.unwrap();
            assert_eq!(jobs.operations.len(), known.problems.len(), "the same problem is one job");
        });
    });
}
