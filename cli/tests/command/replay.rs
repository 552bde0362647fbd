//! What a node recorded is asked again.

use std::{
    fs,
    io::{Read as _, Write as _},
    net::TcpStream,
    path::Path,
    process::Output,
};

use prost::Message as _;
use serde_json::{Value, json};
use vbar_client::{
    Client, ClosedLoop, Code,
    v1::{
        ComputePlanRequest, GetPlanRequest, Measurement, Problem, StepRequest, UploadPlanRequest,
        compute_plan_response::Outcome, precompute_response, step_request, step_response::Verdict,
        step_stream_request::Controller, upload_plan_request,
    },
};
use vbar_server::recording::{Entry, Exchange, Recording, entry::What};

use super::{Process, missions, output, text};

fn problem(json: Value) -> Problem {
    missions::message(json)
}

fn measured(json: Value) -> Measurement {
    missions::message(json)
}

fn linear(components: [f64; 2]) -> Measurement {
    measured(json!({ "linear": { "components": components } }))
}

async fn client(node: &Process) -> Client {
    Client::connect(&node.url, vbar_client::Options::default()).await.unwrap()
}

/// Sends a request over HTTP/1.1 and gives its status.
fn http(node: &Process, head: &str, body: &str) -> u16 {
    let mut stream = TcpStream::connect(node.url.trim_start_matches("http://")).unwrap();
    let length = body.len();
    write!(
        stream,
        "{head} HTTP/1.1\r\nhost: x\r\nconnection: close\r\ncontent-type: application/json\r\n\
         authorization: Bearer vbar_secret\r\ncontent-length: {length}\r\n\r\n{body}"
    )
    .unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8_lossy(&answer);
    answer.split(' ').nth(1).unwrap().parse().unwrap()
}

/// Flies two steps of a closed loop, with a bad message between them.
async fn fly(mut flight: ClosedLoop, first: Measurement, second: Measurement) {
    let decided = flight.step(first).await.unwrap();
    assert!(decided.verdict.is_some());
    let refused = flight.step(Measurement::default()).await.unwrap_err();
    assert_eq!(refused.code, Code::InvalidArgument);
    // Decided or refused, it is an answer.
    let _ = flight.step(second).await;
}

/// Every method in a closed loop and by itself; plans; precomputes; what is refused; over gRPC and
/// HTTP. How many exchanges that is.
async fn everything(node: &Process) -> u64 {
    let client = client(node).await;
    let start = missions::envisat_start();
    let mut count = 0;
    for (mission, first, second) in [
        (missions::double_integrator(), linear([20.0, 0.0]), linear([20.0, -1.5])),
        (missions::envisat(), measured(start.clone()), measured(start.clone())),
        (missions::integrator(), linear([2.0, 0.0]), linear([1.9, -0.1])),
        (
            missions::station(),
            measured(missions::at_rest(5000.0)),
            measured(missions::at_rest(4990.0)),
        ),
        (
            missions::prisma(),
            measured(missions::prisma_measurement(0)),
            measured(missions::prisma_measurement(1)),
        ),
    ] {
        let mission = problem(mission);
        let made = client.precompute(mission.clone()).await.unwrap();
        let Some(precompute_response::Outcome::Artifact(artifact)) = made.outcome else {
            panic!("no artifact")
        };
        let controller = Controller::ArtifactId(artifact.artifact_id.clone());
        fly(client.closed_loop(controller).await.unwrap(), first.clone(), second.clone()).await;
        let controller = Controller::Problem(mission);
        fly(client.closed_loop(controller).await.unwrap(), first.clone(), second).await;
        let controller = Some(step_request::Controller::ArtifactId(artifact.artifact_id.clone()));
        let step = StepRequest { controller, measurement: Some(first), ..StepRequest::default() };
        client.step(step).await.unwrap();
        client.artifact(&artifact.artifact_id).await.unwrap();
        assert_eq!(http(node, &format!("GET /v1/artifacts/{}", artifact.artifact_id), ""), 200);
        count += 1 + 3 + 3 + 1 + 1 + 1;
    }
    count + plans(node, &client).await + refusals(node, &client).await
}

async fn plans(node: &Process, client: &Client) -> u64 {
    let request = ComputePlanRequest {
        problem: Some(problem(missions::prisma())),
        ..ComputePlanRequest::default()
    };
    let planned = client.plan(request).await.unwrap();
    assert!(matches!(planned.outcome, Some(Outcome::Plan(_))));
    let document = client.get_plan(&planned.plan_id).await.unwrap().document;
    let content = document.map(upload_plan_request::Content::Document);
    client.upload_plan(UploadPlanRequest { content, validate_only: false }).await.unwrap();
    let path = format!("GET /v1/plans/{}:export?format=CSV", planned.plan_id);
    assert_eq!(http(node, &path, ""), 200);
    let body = json!({ "problem": missions::prisma(), "validateOnly": true }).to_string();
    assert_eq!(http(node, "POST /v1/plans:compute", &body), 200);
    assert_eq!(http(node, "POST /v1/precompute", &body), 200);
    6
}

async fn refusals(node: &Process, client: &Client) -> u64 {
    let refused = client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(refused.code, Code::InvalidArgument);
    assert_eq!(client.get_plan(&"0".repeat(64)).await.unwrap_err().code, Code::NotFound);
    assert_eq!(http(node, "POST /v1/step", "{\"artifactId\": "), 400);
    assert_eq!(http(node, "GET /v1/info", ""), 200);
    4
}

fn entries(log: &Path) -> Vec<Entry> {
    Recording::open(log).unwrap().map(Result::unwrap).collect()
}

fn exchanges(log: &Path) -> Vec<Exchange> {
    let exchange = |entry: Entry| match entry.what {
        Some(What::Exchange(exchange)) => Some(exchange),
        _ => None,
    };
    entries(log).into_iter().filter_map(exchange).collect()
}

/// Ends a node as an operator does, so that everything is written.
fn stop(mut node: Process) {
    node.signal("-TERM");
    assert_eq!(node.child.wait().unwrap().code(), Some(0));
}

fn replay(arguments: &[&str]) -> Output {
    output(&[&["replay"][..], arguments].concat())
}

/// Writes a recording by hand, as its documentation says it.
fn write(log: &Path, entries: &[Entry]) {
    let mut file = b"VBARBOX\x01".to_vec();
    for entry in entries {
        let content = entry.encode_to_vec();
        let length = u32::try_from(content.len()).unwrap().to_le_bytes();
        file.extend([&length[..], &crc32fast::hash(&length).to_le_bytes()].concat());
        file.extend([&crc32fast::hash(&content).to_le_bytes()[..], &content].concat());
    }
    fs::write(log, file).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn replay_of_everything_finds_no_difference_and_one_change_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("box");
    let log_name = log.to_str().unwrap();
    let node = Process::start(&["--record", log_name]);
    let asked = everything(&node).await;
    stop(node);
    let recorded = exchanges(&log);
    // A precompute may be asked about more than once, and is recorded once.
    assert_eq!(recorded.len() as u64, asked, "{:?}", calls(&recorded));
    assert!(!text_of(&log).contains("vbar_secret"), "a header was recorded");

    // Of our own, and with another number of threads.
    let again = replay(&[log_name]);
    let said = text(&again.stdout);
    assert_eq!(again.status.code(), Some(0), "{said}{}", text(&again.stderr));
    let compared = asked - 1;
    assert!(said.contains(&format!("{compared} answers are the same, 0 differ, 1 were")), "{said}");
    let other = Process::start(&["--compute-threads", "1"]);
    let elsewhere = replay(&[log_name, "--server", &other.url]);
    assert_eq!(text(&elsewhere.stdout), said, "{}", text(&elsewhere.stderr));

    // One digit of one command of a closed loop.
    let mut entries = entries(&log);
    let changed = entries.iter_mut().find_map(|entry| match &mut entry.what {
        Some(What::Exchange(exchange)) if exchange.closed_loop.is_some() => Some(exchange),
        _ => None,
    });
    let changed = changed.expect("there were closed loops");
    tamper(changed);
    let id = changed.request_id.clone();
    write(&log, &entries);
    let again = replay(&[log_name]);
    let said = text(&again.stdout);
    assert_eq!(again.status.code(), Some(1), "{said}");
    assert!(said.contains(", 1 differ,"), "{said}");
    assert!(said.contains(&id) && said.contains("inputNd[0]: recorded"), "{said}");
}

fn calls(exchanges: &[Exchange]) -> Vec<&str> {
    exchanges.iter().map(|exchange| exchange.call.as_str()).collect()
}

fn text_of(log: &Path) -> String {
    String::from_utf8_lossy(&fs::read(log).unwrap()).into_owned()
}

/// Changes the command in a recorded answer of a closed loop.
fn tamper(exchange: &mut Exchange) {
    use vbar_client::v1::{StepStreamResponse, step_stream_response::Result};
    let mut answer = StepStreamResponse::decode(&*exchange.answers[0]).unwrap();
    let Some(Result::Response(response)) = &mut answer.result else { panic!("{answer:?}") };
    let Some(Verdict::Command(command)) = &mut response.verdict else { panic!("{response:?}") };
    command.input_nd[0] += 1e-9;
    exchange.answers[0] = answer.encode_to_vec();
    exchange.answer_sha256 =
        vbar_server::recording::digest(exchange.answers.iter().map(Vec::as_slice));
}

#[tokio::test(flavor = "multi_thread")]
async fn recording_of_a_node_that_is_killed_is_whole_up_to_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("box");
    let log_name = log.to_str().unwrap();
    let store = folder.path().join("store");
    let arguments = ["--record", log_name, "--data-dir", store.to_str().unwrap()];
    let node = Process::start(&arguments);
    let mission = problem(missions::double_integrator());
    let made = client(&node).await.precompute(mission).await.unwrap();
    let Some(precompute_response::Outcome::Artifact(artifact)) = made.outcome else {
        panic!("no artifact")
    };
    node.signal("-KILL");
    drop(node);
    fs::remove_file(&log).unwrap();
    // What it made is known only from the directory: the recording begins later.
    let node = Process::start(&arguments);
    let controller = Controller::ArtifactId(artifact.artifact_id.clone());
    let mut flight = client(&node).await.closed_loop(controller).await.unwrap();
    for _ in 0..3 {
        flight.step(linear([20.0, 0.0])).await.unwrap();
    }
    while exchanges(&log).len() < 3 {
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    node.signal("-KILL");
    drop(node);
    // The writer was in the midst of another record.
    let whole = fs::read(&log).unwrap();
    fs::write(&log, [&whole[..], &whole[8..40]].concat()).unwrap();
    let again = replay(&[log_name, "--data-dir", store.to_str().unwrap()]);
    let said = text(&again.stdout);
    assert_eq!(again.status.code(), Some(0), "{said}{}", text(&again.stderr));
    assert!(said.contains("3 answers are the same"), "{said}");
    assert!(text(&again.stderr).contains("the last 32 bytes"), "{}", text(&again.stderr));
    // Without the directory nobody knows the artifact, and the rest of the loop cannot be asked.
    let lost = replay(&[log_name]);
    let said = text(&lost.stdout);
    assert_eq!(lost.status.code(), Some(1), "{said}");
    assert!(said.contains("--data-dir") || said.contains("recorded"), "{said}");
    // Damage that no killed writer leaves is refused with its place.
    let mut damaged = whole;
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    fs::write(&log, damaged).unwrap();
    let refused = replay(&[log_name]);
    assert_eq!(refused.status.code(), Some(65));
    assert!(text(&refused.stderr).contains("at byte"), "{}", text(&refused.stderr));
}

#[tokio::test(flavor = "multi_thread")]
async fn recording_of_digests_alone_still_tells_what_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("box");
    let log_name = log.to_str().unwrap();
    let config = folder.path().join("node.toml");
    fs::write(&config, format!("record_file = {log_name:?}\nrecord_answers = false\n")).unwrap();
    let node = Process::start(&["--config", config.to_str().unwrap()]);
    let client = client(&node).await;
    let request = StepRequest {
        controller: Some(step_request::Controller::Problem(problem(missions::integrator()))),
        measurement: Some(linear([2.0, 0.0])),
        ..StepRequest::default()
    };
    client.step(request).await.unwrap();
    assert!(client.get_plan(&GetPlanRequest::default().plan_id).await.is_err());
    stop(node);
    assert!(exchanges(&log).iter().all(|exchange| exchange.answers.is_empty()));
    let again = replay(&[log_name]);
    assert!(text(&again.stdout).contains("2 answers are the same"), "{}", text(&again.stdout));
    let mut entries = entries(&log);
    let Some(What::Exchange(step)) = &mut entries[1].what else { panic!("{entries:?}") };
    step.answer_sha256[0] ^= 1;
    write(&log, &entries);
    assert_eq!(replay(&[log_name]).status.code(), Some(1));
}

#[test]
fn replay_of_what_is_no_recording_exits_65() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("box");
    fs::write(&log, "something else").unwrap();
    let refused = replay(&[log.to_str().unwrap()]);
    assert_eq!(refused.status.code(), Some(65));
    assert!(text(&refused.stderr).contains("not a recording"), "{}", text(&refused.stderr));
}
