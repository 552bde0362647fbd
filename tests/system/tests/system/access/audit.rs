//! Who asked for what.

use prost::Message as _;
use serde_json::Value;
use vbar_client::{
    Credentials,
    v1::{StepRequest, step_request, step_stream_request::Controller},
};
use vbar_server::AccessOptions;

use super::{
    authority::{Files, sha256, text, token_entry},
    callers::Server,
};
use crate::nodes::envisat;

/// Runs `calls` against a node with an audit file, and gives its lines.
async fn lines(calls: impl AsyncFnOnce(&Server)) -> Vec<Value> {
    let files = Files::new();
    let names = token_entry("loop-1", "vbar_loop", &["step"], "");
    let audit_file = files.path("audit.jsonl");
    let access = AccessOptions {
        tokens_file: Some(files.write("tokens.toml", names)),
        audit_file: Some(audit_file.clone()),
        ..AccessOptions::default()
    };
    let server = Server::start(access).await;
    calls(&server).await;
    server.node.shutdown().await;
    text(&audit_file).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn audit_says_who_asked_for_what_and_what_was_answered() {
    let mission = envisat();
    let request = StepRequest {
        controller: Some(step_request::Controller::Problem(mission.problem.clone())),
        measurement: Some(mission.fixed_start().unwrap()),
        ..StepRequest::default()
    };
    let body = "{\"artifactId\": \"00\"}";
    let (mut answer, mut refusal) = (None, None);
    let lines = lines(async |server| {
        let client = server.client_with("vbar_loop").await;
        answer = Some(client.step(request.clone()).await.unwrap());
        let bearer = [
            ("authorization", "Bearer vbar_loop"),
            ("x-request-id", "mine"),
            ("traceparent", "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"),
        ];
        refusal = Some(server.http("POST", "/v1/step", &bearer, body).await);
        let id = "ab".repeat(32);
        server.get(&format!("/v1/plans/{id}"), &bearer).await;
        server.get("/v1/info", &[("authorization", "Bearer vbar_wrong")]).await;
        server.get("/healthz", &bearer).await;
        assert!(client.is_serving().await.unwrap());
    })
    .await;
    assert_eq!(lines.len(), 4, "probes are not written down: {lines:?}");
    let of = |line: &Value, names: &[&str]| -> Vec<String> {
        names.iter().map(|name| line[name].to_string().trim_matches('"').to_owned()).collect()
    };
    let who = ["caller", "peer", "role", "call", "transport", "code"];
    assert_eq!(of(&lines[0], &who), ["loop-1", "127.0.0.1", "step", "Step", "grpc", "OK"]);
    let digests = ["request_sha256", "answer_sha256", "messages_in", "messages_out"];
    let asked = sha256(&request.encode_to_vec());
    let answered = sha256(&answer.unwrap().encode_to_vec());
    assert_eq!(of(&lines[0], &digests), [&asked, &answered, "1", "1"]);

    let refused = ["loop-1", "127.0.0.1", "step", "Step", "http", "INVALID_ARGUMENT"];
    assert_eq!(of(&lines[1], &who), refused);
    let answered = sha256(refusal.unwrap().body.as_bytes());
    assert_eq!(of(&lines[1], &digests), [&sha256(body.as_bytes()), &answered, "1", "1"]);
    assert_eq!(lines[1]["request_id"], "mine");
    assert_eq!(lines[1]["trace_id"], "4bf92f3577b34da6a3ce929d0e0e4736");

    let denied = ["loop-1", "127.0.0.1", "plan", "GetPlan", "http", "PERMISSION_DENIED"];
    assert_eq!(of(&lines[2], &who), denied);
    assert_eq!(lines[2]["resource"], "ab".repeat(32));
    let unknown = ["127.0.0.1", "127.0.0.1", "", "GetServerInfo", "http", "UNAUTHENTICATED"];
    assert_eq!(of(&lines[3], &who), unknown);
}

#[tokio::test(flavor = "multi_thread")]
async fn audit_has_one_line_for_a_closed_loop_with_all_its_messages() {
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let lines = lines(async |server| {
        let token = Some("vbar_loop".to_owned());
        let credentials = Credentials { token, ..Credentials::default() };
        let client = server.client(credentials).await.unwrap();
        let controller = Controller::Problem(mission.problem);
        let mut flight = client.closed_loop(controller).await.unwrap();
        for _ in 0..3 {
            // Decided or refused, it is a message.
            let _ = flight.step(start.clone()).await;
        }
    })
    .await;
    let [line] = &lines[..] else { panic!("{lines:?}") };
    assert_eq!(line["call"], "StepStream");
    assert_eq!((&line["messages_in"], &line["messages_out"]), (&3.into(), &3.into()));
    assert_ne!(line["request_sha256"], line["answer_sha256"]);
}
