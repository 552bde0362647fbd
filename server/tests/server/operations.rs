//! Long-running operations.

use std::time::{Duration, Instant};

use ::http::Method;
use bytes::Bytes;
use prost::Message as _;
use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::{
    google::longrunning::{
        CancelOperationRequest, DeleteOperationRequest, GetOperationRequest, ListOperationsRequest,
        Operation, WaitOperationRequest, operation, operations_client::OperationsClient,
    },
    v1,
};
use vbar_server::{AccessOptions, Config, NewToken, Node, StartError, StoreLocation};

use crate::{
    missions, offline_sampling,
    support::{Answer, Server, detail, server, server_with},
};

/// Starts a precompute.
pub(crate) async fn begin(server: &Server, problem: &Value) -> Operation {
    let request: v1::PrecomputeRequest = missions::message(json!({ "problem": problem }));
    server.grpc().await.precompute(request).await.unwrap().into_inner()
}

/// Starts a precompute and waits for its end.
pub(crate) async fn precompute(server: &Server, problem: &Value) -> Operation {
    let begun = begin(server, problem).await;
    if begun.done { begun } else { wait(server, &begun.name).await }
}

async fn wait(server: &Server, name: &str) -> Operation {
    let mut client = OperationsClient::new(server.channel().await);
    let request = WaitOperationRequest { name: name.to_owned(), timeout: None };
    let operation = client.wait_operation(request).await.unwrap().into_inner();
    assert!(operation.done, "{operation:?}");
    operation
}

pub(crate) fn artifact(operation: &Operation) -> v1::Artifact {
    let Some(operation::Result::Response(response)) = &operation.result else {
        panic!("{operation:?}");
    };
    assert_eq!(response.type_url, "type.googleapis.com/vbar.v1.PrecomputeResponse");
    let response = v1::PrecomputeResponse::decode(response.value.as_slice()).unwrap();
    match response.outcome {
        Some(v1::precompute_response::Outcome::Artifact(artifact)) => artifact,
        other => panic!("{other:?}"),
    }
}

fn metadata(operation: &Operation) -> v1::PrecomputeMetadata {
    let packed = operation.metadata.as_ref().expect("there is always metadata");
    v1::PrecomputeMetadata::decode(packed.value.as_slice()).unwrap()
}

/// Problems that differ in nothing that matters.
pub(crate) fn numbered(number: u32) -> Value {
    let mut problem = missions::double_integrator();
    problem["variableHorizon"]["fuelWeight"] = (f64::from(number) + 1.0).into();
    problem
}

/// So many samples that it takes minutes.
fn slow() -> Value {
    let mut problem = offline_sampling::poseidyn();
    problem["offlineSampling"]["horizon"] = 10.into();
    problem["offlineSampling"]["samples"]["size"] = 5000.into();
    problem
}

/// One thread for jobs, and no wait for their end.
fn impatient() -> Config {
    Config { job_threads: 1, precompute_wait: Duration::ZERO, ..Config::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_of_a_precompute_can_be_asked_for_everywhere() {
    let server = server().await;
    let made = precompute(&server, &missions::double_integrator()).await;
    assert!(made.done);
    let artifact = artifact(&made);
    assert_eq!(made.name, format!("operations/{}", artifact.artifact_id));
    let progress = metadata(&made);
    assert_eq!(progress.state(), v1::PrecomputeState::Succeeded);
    assert_eq!((progress.phase.as_str(), progress.fraction_done), ("done", 1.0));
    assert_eq!((progress.shards_done, progress.attempts), (progress.shards_total, 1));
    let time = |time: Option<prost_types::Timestamp>| time.map(|t| (t.seconds, t.nanos)).unwrap();
    assert!(time(progress.create_time) <= time(progress.start_time));
    assert!(time(progress.start_time) <= time(progress.end_time));
    assert!(time(artifact.expire_time) > time(progress.end_time));
    // The same problem is the same operation.
    assert_eq!(precompute(&server, &missions::double_integrator()).await, made);
    let mut client = OperationsClient::new(server.channel().await);
    let name = made.name.clone();
    let got = client.get_operation(GetOperationRequest { name: name.clone() }).await.unwrap();
    assert_eq!(got.into_inner(), made);
    assert_eq!(wait(&server, &name).await, made);
    let list = client.list_operations(ListOperationsRequest::default()).await.unwrap();
    assert_eq!(list.into_inner().operations, std::slice::from_ref(&made));
    // It is done: nothing is left to stop.
    client.cancel_operation(CancelOperationRequest { name: name.clone() }).await.unwrap();
    assert_eq!(wait(&server, &name).await, made);
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_deleted_is_gone_and_its_artifact_stays() {
    let server = server().await;
    let made = precompute(&server, &missions::double_integrator()).await;
    let mut client = OperationsClient::new(server.channel().await);
    let name = made.name.clone();
    client.delete_operation(DeleteOperationRequest { name: name.clone() }).await.unwrap();
    let got = client.get_operation(GetOperationRequest { name: name.clone() }).await;
    assert_eq!(got.unwrap_err().code(), Code::NotFound);
    let again = client.delete_operation(DeleteOperationRequest { name }).await;
    assert_eq!(again.unwrap_err().code(), Code::NotFound);
    let request = v1::GetArtifactRequest { artifact_id: artifact(&made).artifact_id };
    assert!(server.grpc().await.get_artifact(request).await.is_ok());
    // Nothing is computed again.
    assert_eq!(artifact(&begin(&server, &missions::double_integrator()).await), artifact(&made));
    assert_eq!(computed(&server).await, 1.0);
}

/// Artifacts computed by this node.
async fn computed(server: &Server) -> f64 {
    server.metric("vbar_artifact_lookups_total{outcome=\"computed\"}").await
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_over_http_is_the_same() {
    let server = server().await;
    let request = json!({ "problem": missions::double_integrator() });
    let post = async |path: String| server.http(Method::POST, &path, &[], Bytes::new()).await;
    let begun = server.post("/v1/precompute", &request).await;
    assert_eq!(begun.status, 200, "{}", begun.text());
    let begun = begun.json();
    let name = begun["name"].as_str().unwrap();
    let made = post(format!("/v1/{name}:wait")).await.json();
    assert_eq!(made["done"], true);
    assert_eq!(server.get(&format!("/v1/{name}")).await.json(), made);
    assert_eq!(post(format!("/v1/{name}:cancel")).await.json(), json!({}));
    let wait = json!({ "timeout": "1.5s" });
    assert_eq!(server.post(&format!("/v1/{name}:wait"), &wait).await.json(), made);
    let backwards = json!({ "timeout": "-1.5s" });
    assert_eq!(server.post(&format!("/v1/{name}:wait"), &backwards).await.status, 400);
    let list = server.get("/v1/operations").await.json();
    assert_eq!(list["operations"], json!([made]));
    let id = name.strip_prefix("operations/").unwrap();
    let artifact = server.get(&format!("/v1/artifacts/{id}")).await.json();
    assert_eq!(artifact["artifact"], made["response"]["artifact"]);
    assert_eq!(artifact["artifact"]["provenance"]["artifactId"], id);
    let path = format!("/v1/{name}");
    let delete = async || server.http(Method::DELETE, &path, &[], Bytes::new()).await;
    assert_eq!(delete().await.json(), json!({}));
    assert_eq!(delete().await.status, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn operations_are_paged_and_filtered() {
    let server = server().await;
    let mut ids = Vec::new();
    for number in 0..3 {
        ids.push(artifact(&precompute(&server, &numbered(number)).await).artifact_id);
    }
    ids.sort();
    let mut seen = Vec::new();
    let mut token = String::new();
    loop {
        let path = format!("/v1/operations?pageSize=1&pageToken={token}&filter=state%3DSUCCEEDED");
        let page = server.get(&path).await.json();
        let operations = page["operations"].as_array().unwrap();
        assert!(operations.len() <= 1);
        seen.extend(operations.iter().map(|o| o["metadata"]["artifactId"].clone()));
        token = page["nextPageToken"].as_str().unwrap().to_owned();
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(seen, ids);
    let failed = server.get("/v1/operations?filter=done%3Dtrue+AND+state%3DFAILED").await.json();
    assert_eq!(failed["operations"], json!([]));
    let refused = server.get("/v1/operations?filter=colour%3Dred").await;
    assert_eq!(refused.status, 400);
    assert!(refused.text().contains("state=QUEUED"), "{}", refused.text());
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_slow_is_answered_at_once_watched_and_cancelled() {
    let server = server_with(impatient()).await;
    let asked = Instant::now();
    let begun = begin(&server, &slow()).await;
    assert!(!begun.done, "after {:?}: {begun:?}", asked.elapsed());
    let queued = begin(&server, &missions::double_integrator()).await;
    assert_eq!(metadata(&queued).state(), v1::PrecomputeState::Queued);
    let mut client = OperationsClient::new(server.channel().await);
    // A wait ends at its own time.
    let timeout = Some(prost_types::Duration { seconds: 0, nanos: 200_000_000 });
    let request = WaitOperationRequest { name: begun.name.clone(), timeout };
    let waited = client.wait_operation(request).await.unwrap().into_inner();
    assert!(!waited.done);
    let progress = metadata(&waited);
    assert_eq!(progress.state(), v1::PrecomputeState::Running);
    assert_eq!((progress.phase.as_str(), progress.attempts), ("computing", 1));
    assert!(progress.start_time.is_some() && progress.end_time.is_none());
    let list = ListOperationsRequest { filter: "state=RUNNING".into(), ..Default::default() };
    let list = client.list_operations(list).await.unwrap().into_inner();
    assert_eq!(list.operations.len(), 1);
    // What runs is not forgotten.
    let delete = DeleteOperationRequest { name: begun.name.clone() };
    let refused = client.delete_operation(delete).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    // Steps have threads of their own.
    assert_eq!(server.get("/v1/info").await.status, 200);

    let watch = async { server.get(&format!("/v1/{}:watch", begun.name)).await };
    let cancel = async {
        tokio::time::sleep(Duration::from_millis(300)).await;
        let request = CancelOperationRequest { name: begun.name.clone() };
        let mut client = client.clone();
        client.cancel_operation(request).await.unwrap();
    };
    let (watched, ()) = tokio::join!(watch, cancel);
    check_events(&watched);
    let cancelled = wait(&server, &begun.name).await;
    let Some(operation::Result::Error(error)) = &cancelled.result else { panic!("{cancelled:?}") };
    assert_eq!(error.code, Code::Cancelled as i32);
    assert!(error.details.iter().any(|detail| detail.type_url.ends_with("google.rpc.ErrorInfo")));
    assert_eq!(server.metric("vbar_jobs_total{outcome=\"cancelled\"}").await, 1.0);
    // The thread is free again for the one that waited.
    assert!(wait(&server, &queued.name).await.done);
}

/// Progress first, the end last, each a whole operation.
fn check_events(answer: &Answer) {
    assert_eq!(answer.headers["content-type"], "text/event-stream");
    let events: Vec<(&str, Value)> = answer
        .text()
        .split("\n\n")
        .filter(|event| event.starts_with("event:"))
        .map(|event| {
            let (name, data) = event.split_once('\n').unwrap();
            let data = data.strip_prefix("data:").unwrap().trim_start();
            (name.trim_start_matches("event:").trim(), serde_json::from_str(data).unwrap())
        })
        .collect();
    let (first, last) = (events.first().unwrap(), events.last().unwrap());
    assert_eq!((first.0, &first.1["done"]), ("progress", &json!(false)));
    assert_eq!((last.0, &last.1["done"]), ("done", &json!(true)));
    assert_eq!(last.1["error"]["code"], 1);
    let reason = detail(&last.1["error"], "ErrorInfo").unwrap()["reason"].clone();
    assert_eq!(reason, "CANCELLED");
}

#[tokio::test(flavor = "multi_thread")]
async fn precomputes_of_one_problem_at_once_are_computed_once() {
    let server = server().await;
    let problem = missions::envisat();
    let calls = (0..8).map(|_| precompute(&server, &problem));
    let made = futures_util::future::join_all(calls).await;
    assert!(made.iter().all(|operation| artifact(operation) == artifact(&made[0])));
    assert_eq!(computed(&server).await, 1.0);
    assert_eq!(server.metric("vbar_jobs_total{outcome=\"accepted\"}").await, 1.0);
    assert_eq!(server.metric("vbar_jobs_total{outcome=\"joined\"}").await, 7.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn precompute_request_id_names_one_problem() {
    let server = server().await;
    let ask = async |number| {
        let request_id = "7F1C2B0A-9A40-4a53-8d5e-0d6a3b0c1d2e";
        let request = json!({ "problem": numbered(number), "requestId": request_id });
        server.post("/v1/precompute", &request).await
    };
    let first = ask(1).await.json();
    assert_eq!(ask(1).await.json()["name"], first["name"]);
    let refused = ask(2).await;
    assert_eq!(refused.status, 409, "{}", refused.text());
    assert_eq!(detail(&refused.json(), "ErrorInfo").unwrap()["reason"], "REQUEST_ID_REUSED");
}

#[tokio::test(flavor = "multi_thread")]
async fn precompute_validate_only_keeps_nothing() {
    let server = server().await;
    let request = json!({ "problem": missions::double_integrator(), "validateOnly": true });
    let checked = server.post("/v1/precompute", &request).await;
    assert_eq!(checked.status, 200);
    let id = checked.json()["metadata"]["artifactId"].as_str().unwrap().to_owned();
    assert_eq!(checked.json()["done"], false);
    assert_eq!(server.get(&format!("/v1/artifacts/{id}")).await.status, 404);
    assert_eq!(server.get("/v1/operations").await.json()["operations"], json!([]));
    let request = json!({ "problem": missions::double_integrator(), "requestId": "not a uuid" });
    assert_eq!(server.post("/v1/precompute", &request).await.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn operations_have_limits() {
    let config = Config { jobs_unfinished_max: 1, watchers_max: 0, ..impatient() };
    assert!(matches!(Node::start(config.clone()).await, Err(StartError::Config(_))));
    let server = server_with(Config { watchers_max: 1, ..config }).await;
    let begun = begin(&server, &slow()).await;
    let request = json!({ "problem": missions::double_integrator() });
    let refused = server.post("/v1/precompute", &request).await;
    assert_eq!(refused.status, 429, "{}", refused.text());
    assert_eq!(detail(&refused.json(), "ErrorInfo").unwrap()["reason"], "QUEUE_FULL");
    assert!(refused.headers["retry-after"].parse::<u32>().unwrap() >= 1);
    // The same problem joins what is there.
    assert_eq!(begin(&server, &slow()).await.name, begun.name);
    let path = format!("/v1/{}:watch", begun.name);
    let (first, second) = tokio::join!(server.get(&path), async {
        tokio::time::sleep(Duration::from_millis(300)).await;
        let second = server.get(&path).await;
        let cancel = format!("/v1/{}:cancel", begun.name);
        server.http(Method::POST, &cancel, &[], Bytes::new()).await;
        second
    });
    check_events(&first);
    assert_eq!(second.status, 429, "{}", second.text());
    let unknown = format!("/v1/operations/{}:watch", "ab".repeat(32));
    assert_eq!(server.get(&unknown).await.status, 404);
    assert_eq!(server.http(Method::POST, &path, &[], Bytes::new()).await.status, 405);
}

#[tokio::test(flavor = "multi_thread")]
async fn events_end_when_the_token_of_their_caller_is_taken_away() {
    let draw = || NewToken::draw("watch", &["precompute".to_owned()], None).ok().unwrap();
    let (token, other) = (draw(), draw());
    let folder = tempfile::tempdir().unwrap();
    let tokens_file = folder.path().join("tokens.toml");
    std::fs::write(&tokens_file, &token.entry).unwrap();
    let access = AccessOptions {
        tokens_file: Some(tokens_file.clone()),
        credentials_poll: Duration::from_millis(20),
        ..AccessOptions::default()
    };
    let server = server_with(Config { access, ..impatient() }).await;
    let ask = async |method: Method, path: &str, token: &NewToken, body: String| {
        let bearer = format!("Bearer {}", token.secret);
        let headers = [("authorization", &*bearer), ("content-type", "application/json")];
        server.http(method, path, &headers, body.into()).await
    };
    let problem = json!({ "problem": slow() }).to_string();
    let begun = ask(Method::POST, "/v1/precompute", &token, problem).await;
    let name = begun.json()["name"].as_str().unwrap().to_owned();
    let path = format!("/v1/{name}:watch");
    let watch = ask(Method::GET, &path, &token, String::new());
    let (watched, ()) = tokio::join!(watch, async {
        tokio::time::sleep(Duration::from_millis(300)).await;
        std::fs::write(&tokens_file, &other.entry).unwrap();
    });
    let (_, last) = watched.text().trim_end().rsplit_once("event:").unwrap();
    assert!(last.trim_start().starts_with("error"), "{last}");
    assert!(last.contains("CREDENTIAL_UNKNOWN"), "{last}");
    let cancel = format!("/v1/{name}:cancel");
    assert_eq!(ask(Method::POST, &cancel, &token, String::new()).await.status, 401);
    assert_eq!(ask(Method::POST, &cancel, &other, String::new()).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn operations_survive_their_node() {
    const PROBLEMS: u32 = 12;
    let folder = tempfile::tempdir().unwrap();
    let store = StoreLocation::Directory(folder.path().to_owned());
    // A solver that is at a large step looks up late on a busy machine.
    let config = Config { store, shutdown_grace: Duration::from_secs(60), ..impatient() };
    let first = server_with(config.clone()).await;
    let slow = begin(&first, &slow()).await;
    let mut names = Vec::new();
    for number in 0..PROBLEMS {
        names.push(begin(&first, &numbered(number)).await.name);
    }
    // One directory, one node.
    let Err(StartError::Store(fault)) = Node::start(config.clone()).await else {
        panic!("two nodes on one directory")
    };
    assert!(fault.contains("another process"), "{fault}");
    first.node.shutdown().await;
    let second = server_with(config).await;
    let resumed = second.metric("vbar_jobs_total{outcome=\"resumed\"}").await;
    assert!(resumed >= 1.0, "{resumed} operations were under way");
    let cancel = format!("/v1/{}:cancel", slow.name);
    assert_eq!(second.http(Method::POST, &cancel, &[], Bytes::new()).await.status, 200);
    for name in names {
        let made = wait(&second, &name).await;
        assert_eq!(format!("operations/{}", artifact(&made).artifact_id), name);
    }
}
