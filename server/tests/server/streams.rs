//! Closed loops on one stream.

use serde_json::json;
use tokio::sync::mpsc;
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::{Code, Streaming};
use vbar_proto::{
    google::rpc,
    v1::{self, step_response::Verdict, step_stream_request, step_stream_response::Result},
};

use crate::{
    missions,
    support::{Server, server, step_request},
};

struct Loop {
    ask: mpsc::Sender<v1::StepStreamRequest>,
    answers: Streaming<v1::StepStreamResponse>,
}

impl Loop {
    async fn open(server: &Server) -> Self {
        let (ask, asked) = mpsc::channel(16);
        let mut client = server.grpc().await;
        let answers = client.step_stream(ReceiverStream::new(asked)).await.unwrap().into_inner();
        Self { ask, answers }
    }

    async fn send(&self, message: v1::StepStreamRequest) {
        self.ask.send(message).await.unwrap();
    }

    async fn step(&mut self) -> v1::StepResponse {
        match self.answers.next().await.unwrap().unwrap().result.unwrap() {
            Result::Response(response) => response,
            Result::Status(status) => panic!("{status:?}"),
        }
    }

    async fn refusal(&mut self) -> rpc::Status {
        match self.answers.next().await.unwrap().unwrap().result.unwrap() {
            Result::Status(status) => status,
            Result::Response(response) => panic!("{response:?}"),
        }
    }
}

fn measured(components: [f64; 2]) -> v1::StepStreamRequest {
    let state = v1::LinearState { components: components.to_vec() };
    let state = Some(v1::measurement::State::Linear(state));
    let measurement = Some(v1::Measurement { state, ..v1::Measurement::default() });
    v1::StepStreamRequest { measurement, ..v1::StepStreamRequest::default() }
}

fn first(components: [f64; 2]) -> v1::StepStreamRequest {
    let problem = missions::message(missions::double_integrator());
    let controller = Some(step_stream_request::Controller::Problem(problem));
    v1::StepStreamRequest { controller, ..measured(components) }
}

/// What `Step` says to the same questions.
async fn stepwise(server: &Server, states: &[[f64; 2]]) -> Vec<v1::StepResponse> {
    let mut answers: Vec<v1::StepResponse> = Vec::new();
    for &components in states {
        let measurement = json!({ "linear": { "components": components } });
        let problem = ("problem", missions::double_integrator());
        let mut request = step_request(problem, measurement);
        if let Some(last) = answers.last() {
            request.controller_state = last.controller_state.clone();
        }
        answers.push(server.grpc().await.step(request).await.unwrap().into_inner());
    }
    answers
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_answers_like_step_and_survives_bad_messages() {
    let server = server().await;
    let expected = stepwise(&server, &[[20.0, 0.0], [20.0, -1.5]]).await;
    assert!(matches!(expected[1].verdict, Some(Verdict::Command(_))), "{expected:?}");
    let mut closed_loop = Loop::open(&server).await;
    closed_loop.send(first([20.0, 0.0])).await;
    assert_eq!(closed_loop.step().await, expected[0]);
    // All of these at once: answers come in order, the loop goes on where it was.
    closed_loop.send(measured([f64::NAN, 0.0])).await;
    closed_loop.send(v1::StepStreamRequest::default()).await;
    closed_loop.send(first([1.0, 0.0])).await;
    let state = Some(bytes::Bytes::from_static(b"not a state"));
    closed_loop
        .send(v1::StepStreamRequest { controller_state: state, ..measured([1.0, 0.0]) })
        .await;
    closed_loop.send(measured([20.0, -1.5])).await;
    let invalid = Code::InvalidArgument as i32;
    let refusals = [
        (invalid, "measurement.linear.components[0]"),
        (invalid, "measurement"),
        (invalid, "controller"),
        (Code::FailedPrecondition as i32, "controller_state"),
    ];
    for (code, named) in refusals {
        let status = closed_loop.refusal().await;
        assert_eq!(status.code, code, "{status:?}");
        assert!(status.message.contains(named), "{status:?}");
        assert!(!status.details.is_empty());
    }
    assert_eq!(closed_loop.step().await, expected[1]);
    drop(closed_loop.ask);
    assert!(closed_loop.answers.next().await.is_none());
    let refused = r#"vbar_stream_messages_total{outcome="refused"}"#;
    assert_eq!(server.metric(refused).await, 4.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_needs_a_controller_first() {
    let server = server().await;
    let mut closed_loop = Loop::open(&server).await;
    closed_loop.send(measured([1.0, 0.0])).await;
    assert_eq!(closed_loop.refusal().await.code, Code::InvalidArgument as i32);
    let unknown = Some(step_stream_request::Controller::ArtifactId("ef".repeat(32)));
    closed_loop.send(v1::StepStreamRequest { controller: unknown, ..measured([1.0, 0.0]) }).await;
    assert_eq!(closed_loop.refusal().await.code, Code::NotFound as i32);
    // A message that only opens the loop is answered by a status of OK.
    let opening = v1::StepStreamRequest { measurement: None, ..first([0.0, 0.0]) };
    closed_loop.send(opening).await;
    assert_eq!(closed_loop.refusal().await.code, Code::Ok as i32);
    closed_loop.send(measured([20.0, 0.0])).await;
    assert_eq!(closed_loop.step().await, stepwise(&server, &[[20.0, 0.0]]).await[0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_can_be_taken_up_with_a_state() {
    let server = server().await;
    let expected = stepwise(&server, &[[20.0, 0.0], [20.0, -1.5]]).await;
    let mut closed_loop = Loop::open(&server).await;
    let state = Some(expected[0].controller_state.clone());
    closed_loop
        .send(v1::StepStreamRequest { controller_state: state, ..first([20.0, -1.5]) })
        .await;
    assert_eq!(closed_loop.step().await, expected[1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_is_told_when_the_server_shuts_down() {
    let Server { node, address } = server().await;
    let channel = tonic::transport::Channel::from_shared(format!("http://{address}")).unwrap();
    let channel = channel.connect().await.unwrap();
    let mut client = v1::guidance_service_client::GuidanceServiceClient::new(channel);
    let (ask, asked) = mpsc::channel(1);
    let mut answers = client.step_stream(ReceiverStream::new(asked)).await.unwrap().into_inner();
    ask.send(first([20.0, 0.0])).await.unwrap();
    assert!(answers.next().await.unwrap().is_ok());
    let stopping = tokio::spawn(node.shutdown());
    let told = answers.next().await.unwrap().unwrap_err();
    assert_eq!(told.code(), Code::Unavailable, "{told}");
    drop((ask, answers, client));
    tokio::time::timeout(std::time::Duration::from_secs(5), stopping).await.unwrap().unwrap();
}
