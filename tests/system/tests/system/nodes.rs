//! Real nodes, real connections.

use std::{path::Path, process::Command, thread};

use prost::Message as _;
use tokio::runtime::Runtime;
use vbar_client::{
    Client, Code, Error, Options,
    v1::{Measurement, StepResponse, step_response::Verdict, step_stream_request::Controller},
};
use vbar_server::{Config, Node};
use vbar_simulator::Mission;

fn root() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub(crate) fn envisat() -> Mission {
    Mission::load(&root().join("simulator/missions/envisat.json")).unwrap()
}

/// A node on a runtime of its own, so that it can die without a word.
pub(crate) struct Mortal {
    runtime: Option<Runtime>,
    pub(crate) url: String,
}

impl Mortal {
    pub(crate) fn start(config: Config) -> Self {
        // A runtime must not be entered from within another one.
        let started = thread::spawn(move || {
            let runtime = Runtime::new().unwrap();
            let node = runtime.block_on(Node::start(config)).unwrap();
            let url = format!("http://{}", node.local_address());
            // Kept alive by its runtime, until that ends.
            runtime.spawn(async move {
                std::future::pending::<()>().await;
                drop(node);
            });
            Self { runtime: Some(runtime), url }
        });
        started.join().unwrap()
    }

    fn die(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Drop for Mortal {
    fn drop(&mut self) {
        self.die();
    }
}

async fn client(node: &Mortal) -> Client {
    let options = Options { attempts_max: 2, ..Options::default() };
    Client::connect(&node.url, options).await.unwrap()
}

/// What the chaser would measure next if nothing disturbed it, bent a little so that the closed
/// loop has something to do.
fn next_measurement(answer: &StepResponse) -> Option<Measurement> {
    let Some(Verdict::Command(command)) = &answer.verdict else { return None };
    let prediction = answer.prediction.as_ref().unwrap();
    let row =
        |matrix: &Option<vbar_client::v1::Matrix>| matrix.as_ref().unwrap().values[3..6].to_vec();
    let mut velocity_m_s = row(&prediction.velocities_m_s);
    // Far inside the assumed set: 1 degree of misalignment at full thrust gives 10 mm/s here.
    velocity_m_s[answer.step_index as usize % 3] += 1e-3;
    let state = vbar_client::v1::RelativeState {
        frame: vbar_client::v1::Frame::Rtn.into(),
        position_m: row(&prediction.positions_m),
        velocity_m_s,
    };
    Some(Measurement {
        state: Some(vbar_client::v1::measurement::State::Relative(state)),
        elapsed_s: Some(command.elapsed_s + command.duration_s.unwrap()),
        ..Measurement::default()
    })
}

/// Flies from `start`, calling `before_step` with the step's number.
pub(crate) async fn fly(
    mut flight: vbar_client::ClosedLoop,
    start: Measurement,
    steps: usize,
) -> Result<(vbar_client::ClosedLoop, Vec<StepResponse>, Option<Measurement>), Error> {
    let mut answers = Vec::new();
    let mut measured = Some(start);
    while let Some(measurement) = measured.take().filter(|_| answers.len() < steps) {
        let answer = flight.step(measurement).await?;
        measured = next_measurement(&answer);
        answers.push(answer);
    }
    Ok((flight, answers, measured))
}

#[tokio::test]
async fn loop_goes_on_with_another_node_as_if_nothing_had_happened() {
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let controller = Controller::Problem(mission.problem);
    let (mut first, second) = (Mortal::start(Config::default()), Mortal::start(Config::default()));
    let undisturbed = client(&second).await.closed_loop(controller.clone()).await.unwrap();
    let (_, whole, _) = fly(undisturbed, start.clone(), usize::MAX).await.unwrap();
    assert!(
        matches!(whole.last().unwrap().verdict, Some(Verdict::Arrived(_))),
        "{:?}",
        whole.last()
    );

    let flight = client(&first).await.closed_loop(controller.clone()).await.unwrap();
    let (mut flight, mut answers, _) = fly(flight, start, 6).await.unwrap();
    let measured = next_measurement(&answers[5]).unwrap();
    first.die();
    let error = flight.step(measured.clone()).await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable, "{error}");

    let state = flight.controller_state().clone();
    let flight = client(&second).await.closed_loop(controller).await.unwrap().from_state(state);
    let (_, rest, _) = fly(flight, measured, usize::MAX).await.unwrap();
    answers.extend(rest);
    assert_eq!(answers, whole);
}

#[tokio::test]
async fn nodes_answer_the_same_request_with_the_same_bytes() {
    let mission = envisat();
    let request = vbar_client::v1::StepRequest {
        controller: Some(vbar_client::v1::step_request::Controller::Problem(
            mission.problem.clone(),
        )),
        measurement: Some(mission.fixed_start().unwrap()),
        ..Default::default()
    };
    let mut seen = Vec::new();
    for compute_threads in [1, 2] {
        let node = Mortal::start(Config { compute_threads, ..Config::default() });
        let client = client(&node).await;
        // Twice: the second is answered from the cache of artifacts.
        for _ in 0..2 {
            seen.push(client.step(request.clone()).await.unwrap().encode_to_vec());
        }
    }
    assert!(seen.iter().all(|bytes| *bytes == seen[0]), "answers differ");
}

#[tokio::test]
async fn precompute_names_what_a_step_can_use_and_a_restarted_node_still_knows() {
    let mission = envisat();
    let folder = tempfile::tempdir().unwrap();
    let store = vbar_server::StoreLocation::Directory(folder.path().to_owned());
    let config = Config { store, ..Config::default() };
    let node = Mortal::start(config.clone());
    let made = client(&node).await.precompute(mission.problem.clone()).await.unwrap();
    let Some(vbar_client::v1::precompute_response::Outcome::Artifact(artifact)) = made.outcome
    else {
        panic!("no artifact")
    };
    drop(node);
    let node = Mortal::start(config);
    let client = client(&node).await;
    assert_eq!(client.artifact(&artifact.artifact_id).await.unwrap(), artifact);
    let controller =
        vbar_client::v1::step_request::Controller::ArtifactId(artifact.artifact_id.clone());
    let request = vbar_client::v1::StepRequest {
        controller: Some(controller),
        measurement: Some(mission.fixed_start().unwrap()),
        ..Default::default()
    };
    let answer = client.step(request).await.unwrap();
    assert_eq!(answer.provenance.unwrap().artifact_id, artifact.artifact_id);
    let error = client.artifact("0000").await.unwrap_err();
    assert!(matches!(error.code, Code::NotFound | Code::InvalidArgument), "{error}");
}

/// Builds the client's examples; nothing to do if the whole workspace is being tested.
pub(crate) fn build_examples() -> std::path::PathBuf {
    let built = Command::new(env!("CARGO"))
        .args(["build", "--quiet", "--workspace", "--examples"])
        .current_dir(root())
        .status()
        .unwrap();
    assert!(built.success());
    let test_binary = std::env::current_exe().unwrap();
    test_binary.parent().unwrap().parent().unwrap().join("examples")
}

#[test]
fn examples_of_the_client_run_against_a_node() {
    let folder = build_examples();
    let node = Mortal::start(Config::default());
    for (example, expected) in [
        ("plan", "commands:"),
        ("step", "certificate passed: true"),
        ("stream", "arrived"),
        ("precompute", "decided from the artifact"),
    ] {
        let ended = Command::new(folder.join(example)).arg(&node.url).output().unwrap();
        let said = String::from_utf8_lossy(&ended.stdout);
        assert!(ended.status.success(), "{example}: {}", String::from_utf8_lossy(&ended.stderr));
        assert!(said.contains(expected), "{example} said {said}");
    }
}
