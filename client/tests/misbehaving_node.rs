//! The client against a node that misbehaves on purpose.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use prost::{Message, Name};
use tokio::net::TcpListener;
use tokio_stream::{Stream, StreamExt, wrappers::TcpListenerStream};
use tonic::{Code, Request, Response, Status, Streaming, transport::Server};
use tonic_types::{ErrorDetails, StatusExt};
use vbar_client::{Client, Options};
use vbar_proto::{
    google::{
        longrunning::{
            CancelOperationRequest, DeleteOperationRequest, GetOperationRequest,
            ListOperationsRequest, ListOperationsResponse, Operation, WaitOperationRequest,
            operation,
            operations_server::{Operations, OperationsServer},
        },
        rpc,
    },
    v1::{
        Artifact, ComputePlanRequest, ComputePlanResponse, DownloadArtifactRequest,
        DownloadArtifactResponse, ExportPlanRequest, ExportPlanResponse, GetArtifactRequest,
        GetArtifactResponse, GetPlanRequest, GetPlanResponse, GetServerInfoRequest,
        GetServerInfoResponse, ListArtifactsRequest, ListArtifactsResponse, ListPlansRequest,
        ListPlansResponse, Measurement, PrecomputeMetadata, PrecomputeRequest, PrecomputeResponse,
        Problem, SafetyReportRequest, SafetyReportResponse, SafetySummary, StepRequest,
        StepResponse, StepStreamRequest, StepStreamResponse, UploadPlanRequest, UploadPlanResponse,
        guidance_service_server::{GuidanceService, GuidanceServiceServer},
        precompute_response::Outcome,
        step_stream_request::Controller,
        step_stream_response,
    },
};

/// The bytes of every artifact of this node, and their digest.
const CONTENT: &[u8] = b"thought long";
const CONTENT_SHA256: &str = "3c3bcb06cb45c69ef69f0865b796e76326f98d276d9c6df308a5cfc2aadd5af8";

/// What the node does with one message.
#[derive(Debug)]
enum Behaviour {
    Answer,
    Refuse(Status),
    Sleep(Duration),
    /// Streams only: ends the stream without an answer.
    HangUp,
}

/// A node that follows a script, then answers; and remembers what it saw.
#[derive(Debug, Clone, Default)]
struct Scripted {
    script: Arc<Mutex<VecDeque<Behaviour>>>,
    /// `grpc-timeout` of each call.
    timeouts: Arc<Mutex<Vec<Option<String>>>>,
    streamed: Arc<Mutex<Vec<StepStreamRequest>>>,
    /// Looks at an operation that are answered "not done".
    looks_left: Arc<Mutex<u32>>,
    /// Waits that are refused for want of room.
    busy: Arc<Mutex<u32>>,
    cannot_wait: bool,
}

impl Scripted {
    fn new(script: impl IntoIterator<Item = Behaviour>) -> Self {
        Self { script: Arc::new(Mutex::new(script.into_iter().collect())), ..Self::default() }
    }

    fn calls(&self) -> usize {
        self.timeouts.lock().unwrap().len()
    }

    async fn follow<T>(&self, request: &Request<T>) -> Result<(), Status> {
        let timeout = request.metadata().get("grpc-timeout");
        let timeout = timeout.map(|v| v.to_str().unwrap().to_owned());
        self.timeouts.lock().unwrap().push(timeout);
        let behaviour = self.script.lock().unwrap().pop_front();
        match behaviour.unwrap_or(Behaviour::Answer) {
            Behaviour::Answer | Behaviour::HangUp => Ok(()),
            Behaviour::Refuse(status) => Err(status),
            Behaviour::Sleep(time) => {
                tokio::time::sleep(time).await;
                Ok(())
            }
        }
    }

    fn operation(&self) -> Operation {
        let mut left = self.looks_left.lock().unwrap();
        let done = *left == 0;
        *left = left.saturating_sub(1);
        let artifact = Artifact { artifact_id: "a1".into(), ..Artifact::default() };
        let made = PrecomputeResponse { outcome: Some(Outcome::Artifact(artifact)) };
        let packed = prost_types::Any {
            type_url: PrecomputeResponse::type_url(),
            value: made.encode_to_vec(),
        };
        let metadata = PrecomputeMetadata {
            shards_done: 10 - i32::try_from(*left).unwrap_or(10).min(10),
            ..PrecomputeMetadata::default()
        };
        let metadata = prost_types::Any {
            type_url: PrecomputeMetadata::type_url(),
            value: metadata.encode_to_vec(),
        };
        Operation {
            name: "operations/1".into(),
            metadata: Some(metadata),
            done,
            result: done.then_some(operation::Result::Response(packed)),
        }
    }
}

#[tonic::async_trait]
impl GuidanceService for Scripted {
    type StepStreamStream = Pin<Box<dyn Stream<Item = Result<StepStreamResponse, Status>> + Send>>;
    type DownloadArtifactStream =
        Pin<Box<dyn Stream<Item = Result<DownloadArtifactResponse, Status>> + Send>>;

    async fn compute_plan(
        &self,
        request: Request<ComputePlanRequest>,
    ) -> Result<Response<ComputePlanResponse>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(ComputePlanResponse::default()))
    }

    async fn upload_plan(
        &self,
        request: Request<UploadPlanRequest>,
    ) -> Result<Response<UploadPlanResponse>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(UploadPlanResponse { plan_id: "kept".into(), certificate: None }))
    }

    async fn get_plan(
        &self,
        request: Request<GetPlanRequest>,
    ) -> Result<Response<GetPlanResponse>, Status> {
        self.follow(&request).await?;
        let plan_id = request.into_inner().plan_id;
        Ok(Response::new(GetPlanResponse { plan_id, ..GetPlanResponse::default() }))
    }

    async fn list_plans(
        &self,
        request: Request<ListPlansRequest>,
    ) -> Result<Response<ListPlansResponse>, Status> {
        self.follow(&request).await?;
        let next_page_token = request.into_inner().page_token;
        Ok(Response::new(ListPlansResponse { plans: Vec::new(), next_page_token }))
    }

    async fn export_plan(
        &self,
        request: Request<ExportPlanRequest>,
    ) -> Result<Response<ExportPlanResponse>, Status> {
        self.follow(&request).await?;
        let file_name = request.into_inner().plan_id;
        Ok(Response::new(ExportPlanResponse { file_name, ..ExportPlanResponse::default() }))
    }

    async fn precompute(
        &self,
        request: Request<PrecomputeRequest>,
    ) -> Result<Response<Operation>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(self.operation()))
    }

    async fn get_artifact(
        &self,
        request: Request<GetArtifactRequest>,
    ) -> Result<Response<GetArtifactResponse>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(GetArtifactResponse::default()))
    }

    async fn list_artifacts(
        &self,
        request: Request<ListArtifactsRequest>,
    ) -> Result<Response<ListArtifactsResponse>, Status> {
        self.follow(&request).await?;
        let next_page_token = request.into_inner().page_token;
        Ok(Response::new(ListArtifactsResponse { artifacts: Vec::new(), next_page_token }))
    }

    /// Three bytes an attempt, then it breaks off; a digest of the artifact's own choice.
    async fn download_artifact(
        &self,
        request: Request<DownloadArtifactRequest>,
    ) -> Result<Response<Self::DownloadArtifactStream>, Status> {
        self.follow(&request).await?;
        let DownloadArtifactRequest { artifact_id, offset, .. } = request.into_inner();
        let begin = usize::try_from(offset).unwrap();
        let end = CONTENT.len().min(begin + 3);
        let piece = DownloadArtifactResponse {
            content: CONTENT[begin..end].into(),
            offset,
            size_bytes: CONTENT.len().try_into().unwrap(),
            content_sha256: artifact_id,
        };
        let mut pieces = vec![Ok(piece)];
        if end < CONTENT.len() {
            pieces.push(Err(Status::unavailable("broken off")));
        }
        Ok(Response::new(Box::pin(tokio_stream::iter(pieces))))
    }

    async fn step(&self, request: Request<StepRequest>) -> Result<Response<StepResponse>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(StepResponse { step_index: 7, ..StepResponse::default() }))
    }

    async fn safety_report(
        &self,
        request: Request<SafetyReportRequest>,
    ) -> Result<Response<SafetyReportResponse>, Status> {
        self.follow(&request).await?;
        let verdicts = request.into_inner().first_step_index;
        let summary = Some(SafetySummary { verdicts, ..SafetySummary::default() });
        Ok(Response::new(SafetyReportResponse { summary, ..SafetyReportResponse::default() }))
    }

    /// Each answer's controller state is the number of messages this node has seen.
    async fn step_stream(
        &self,
        request: Request<Streaming<StepStreamRequest>>,
    ) -> Result<Response<Self::StepStreamStream>, Status> {
        let node = self.clone();
        let mut messages = request.into_inner();
        let (answers, receiver) = tokio::sync::mpsc::channel(1);
        tokio::spawn(async move {
            while let Some(Ok(message)) = messages.next().await {
                let seen = {
                    let mut streamed = node.streamed.lock().unwrap();
                    streamed.push(message);
                    u8::try_from(streamed.len()).unwrap()
                };
                let behaviour = node.script.lock().unwrap().pop_front();
                let result = match behaviour.unwrap_or(Behaviour::Answer) {
                    Behaviour::HangUp => return,
                    Behaviour::Refuse(status) => {
                        step_stream_response::Result::Status(rpc::Status {
                            code: status.code().into(),
                            message: status.message().into(),
                            details: vec![],
                        })
                    }
                    Behaviour::Sleep(time) => {
                        tokio::time::sleep(time).await;
                        late_answer()
                    }
                    Behaviour::Answer => step_stream_response::Result::Response(StepResponse {
                        controller_state: vec![seen].into(),
                        ..StepResponse::default()
                    }),
                };
                let answer = StepStreamResponse { result: Some(result) };
                if answers.send(Ok(answer)).await.is_err() {
                    return;
                }
            }
        });
        let stream = tokio_stream::wrappers::ReceiverStream::new(receiver);
        Ok(Response::new(Box::pin(stream)))
    }

    async fn get_server_info(
        &self,
        request: Request<GetServerInfoRequest>,
    ) -> Result<Response<GetServerInfoResponse>, Status> {
        self.follow(&request).await?;
        Ok(Response::new(GetServerInfoResponse::default()))
    }
}

fn late_answer() -> step_stream_response::Result {
    step_stream_response::Result::Response(StepResponse {
        controller_state: vec![99].into(),
        ..StepResponse::default()
    })
}

#[tonic::async_trait]
impl Operations for Scripted {
    async fn list_operations(
        &self,
        _: Request<ListOperationsRequest>,
    ) -> Result<Response<ListOperationsResponse>, Status> {
        Err(Status::unimplemented("not asked by the client"))
    }

    async fn get_operation(
        &self,
        _: Request<GetOperationRequest>,
    ) -> Result<Response<Operation>, Status> {
        Ok(Response::new(self.operation()))
    }

    async fn delete_operation(
        &self,
        _: Request<DeleteOperationRequest>,
    ) -> Result<Response<()>, Status> {
        Err(Status::unimplemented("not asked by the client"))
    }

    async fn cancel_operation(
        &self,
        _: Request<CancelOperationRequest>,
    ) -> Result<Response<()>, Status> {
        Err(Status::unimplemented("not asked by the client"))
    }

    async fn wait_operation(
        &self,
        request: Request<WaitOperationRequest>,
    ) -> Result<Response<Operation>, Status> {
        if self.cannot_wait {
            return Err(Status::unimplemented("this node cannot wait"));
        }
        assert!(request.into_inner().timeout.is_some(), "a wait without a bound");
        let mut busy = self.busy.lock().unwrap();
        if *busy > 0 {
            *busy -= 1;
            let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(1)));
            return Err(Status::with_error_details(Code::ResourceExhausted, "busy", details));
        }
        Ok(Response::new(self.operation()))
    }
}

async fn serve(node: &Scripted) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let server = Server::builder()
        .add_service(GuidanceServiceServer::new(node.clone()))
        .add_service(OperationsServer::new(node.clone()));
    tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
    format!("http://{address}")
}

async fn connected(node: &Scripted) -> Client {
    Client::connect(&serve(node).await, Options::default()).await.unwrap()
}

fn unavailable() -> Behaviour {
    Behaviour::Refuse(Status::unavailable("draining"))
}

fn by_problem() -> Controller {
    Controller::Problem(Problem::default())
}

#[tokio::test]
async fn step_unavailable_twice_is_answered_at_the_third_attempt() {
    let node = Scripted::new([unavailable(), unavailable()]);
    let client = connected(&node).await;
    let answer = client.step(StepRequest::default()).await.unwrap();
    assert_eq!(answer.step_index, 7);
    assert_eq!(node.calls(), 3);
}

/// Each call on plans survives one interruption and brings its own answer.
#[tokio::test]
async fn plan_calls_are_repeated_and_answered() {
    let node = Scripted::new([unavailable()]);
    let client = connected(&node).await;
    let kept = client.upload_plan(UploadPlanRequest::default()).await.unwrap();
    assert_eq!((kept.plan_id.as_str(), node.calls()), ("kept", 2));

    let node = Scripted::new([unavailable()]);
    let client = connected(&node).await;
    assert_eq!(client.get_plan("p1").await.unwrap().plan_id, "p1");
    assert_eq!(node.calls(), 2);

    let node = Scripted::new([unavailable()]);
    let client = connected(&node).await;
    let page = ListPlansRequest { page_token: "next".into(), ..ListPlansRequest::default() };
    assert_eq!(client.list_plans(page).await.unwrap().next_page_token, "next");
    assert_eq!(node.calls(), 2);

    let node = Scripted::new([unavailable()]);
    let client = connected(&node).await;
    let request = ExportPlanRequest { plan_id: "p2".into(), ..ExportPlanRequest::default() };
    assert_eq!(client.export_plan(request).await.unwrap().file_name, "p2");
    assert_eq!(node.calls(), 2);
}

#[tokio::test]
async fn safety_report_is_repeated_and_answered() {
    let node = Scripted::new([unavailable()]);
    let client = connected(&node).await;
    let request = SafetyReportRequest { first_step_index: 7, ..SafetyReportRequest::default() };
    let answer = client.safety_report(request).await.unwrap();
    assert_eq!((answer.summary.unwrap().verdicts, node.calls()), (7, 2));
}

#[tokio::test]
async fn step_unavailable_for_ever_ends_after_the_allowed_attempts() {
    let node = Scripted::new((0..50).map(|_| unavailable()));
    let url = serve(&node).await;
    let options = Options { attempts_max: 3, ..Options::default() };
    let client = Client::connect(&url, options).await.unwrap();
    let error = client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!((error.code, error.message.as_str()), (Code::Unavailable, "draining"));
    assert_eq!(node.calls(), 3);
}

#[tokio::test]
async fn retries_are_counted_over_all_clones() {
    let refused = Behaviour::Refuse(Status::invalid_argument("no"));
    let node = Scripted::new([unavailable(), unavailable(), Behaviour::Answer, refused]);
    let client = connected(&node).await;
    let clone = client.with_deadline(Duration::from_secs(20));
    clone.step(StepRequest::default()).await.unwrap();
    assert_eq!((client.retries(), clone.retries()), (2, 2));
    client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(client.retries(), 2, "what is refused is not tried again");
}

#[tokio::test]
async fn step_other_codes_are_never_repeated() {
    for code in [
        Code::InvalidArgument,
        Code::FailedPrecondition,
        Code::ResourceExhausted,
        Code::DeadlineExceeded,
        Code::Internal,
        Code::Unknown,
        Code::Aborted,
        Code::Cancelled,
    ] {
        let node = Scripted::new([Behaviour::Refuse(Status::new(code, "no"))]);
        let client = connected(&node).await;
        let error = client.step(StepRequest::default()).await.unwrap_err();
        assert_eq!(error.code, code);
        assert_eq!(node.calls(), 1, "{code:?}");
    }
}

#[tokio::test]
async fn error_keeps_violations_retry_delay_and_trace_id() {
    let mut details = ErrorDetails::new();
    details
        .add_bad_request_violation("problem.variable_horizon.horizon_max", "expected 1 to 200")
        .add_bad_request_violation("measurement", "required")
        .set_retry_info(Some(Duration::from_secs(4)))
        .set_request_info("req-42", "");
    let status = Status::with_error_details(Code::InvalidArgument, "2 faults", details);
    let node = Scripted::new([Behaviour::Refuse(status)]);
    let error = connected(&node).await.step(StepRequest::default()).await.unwrap_err();
    let fields: Vec<_> = error.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["problem.variable_horizon.horizon_max", "measurement"]);
    assert_eq!(error.violations[0].description, "expected 1 to 200");
    assert_eq!(error.retry_after, Some(Duration::from_secs(4)));
    assert_eq!(error.trace_id.as_deref(), Some("req-42"));
    assert!(error.to_string().contains("\n  measurement: required"), "{error}");
}

#[tokio::test]
async fn error_takes_the_trace_id_from_the_header_too() {
    let mut status = Status::internal("our bug");
    status.metadata_mut().insert("x-request-id", "abc".parse().unwrap());
    let node = Scripted::new([Behaviour::Refuse(status)]);
    let error = connected(&node).await.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(error.trace_id.as_deref(), Some("abc"));
}

#[tokio::test]
async fn deadline_passes_on_a_slow_node_and_is_sent_to_it() {
    let node = Scripted::new([Behaviour::Sleep(Duration::from_secs(20))]);
    let client = connected(&node).await.with_deadline(Duration::from_millis(150));
    let started = Instant::now();
    let error = client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(error.code, Code::DeadlineExceeded);
    assert!(started.elapsed() < Duration::from_secs(5), "{:?}", started.elapsed());
    let timeouts = node.timeouts.lock().unwrap().clone();
    let sent = timeouts[0].as_deref().expect("a grpc-timeout header");
    let micros: u64 = sent.strip_suffix('u').expect("microseconds").parse().unwrap();
    assert!((1..=150_000).contains(&micros), "{sent}");
    assert_eq!(timeouts.len(), 1, "a deadline that has passed is not a reason to try again");
}

#[tokio::test]
async fn retry_info_is_waited_for() {
    let asked = Duration::from_millis(400);
    let status = Status::with_error_details(
        Code::Unavailable,
        "busy",
        ErrorDetails::with_retry_info(Some(asked)),
    );
    let node = Scripted::new([Behaviour::Refuse(status)]);
    let client = connected(&node).await;
    let started = Instant::now();
    client.step(StepRequest::default()).await.unwrap();
    assert!(started.elapsed() >= asked, "{:?}", started.elapsed());
    assert_eq!(node.calls(), 2);
}

#[tokio::test]
async fn retry_info_beyond_the_deadline_ends_the_call_at_once() {
    let status = Status::with_error_details(
        Code::Unavailable,
        "busy",
        ErrorDetails::with_retry_info(Some(Duration::from_secs(60))),
    );
    let node = Scripted::new([Behaviour::Refuse(status)]);
    let client = connected(&node).await;
    let started = Instant::now();
    let error = client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable);
    assert_eq!(error.retry_after, Some(Duration::from_secs(60)));
    assert!(started.elapsed() < Duration::from_secs(5));
    assert_eq!(node.calls(), 1);
}

#[tokio::test]
async fn connect_refuses_what_is_not_a_node_url() {
    for url in [
        "",
        "localhost",
        "127.0.0.1:7440",
        "https://127.0.0.1:7440",
        "http://127.0.0.1",
        "http://127.0.0.1:7440/v1",
        "http://127.0.0.1:7440?x",
        "http://a b:1",
    ] {
        let error = Client::connect(url, Options::default()).await.unwrap_err();
        assert_eq!(error.code, Code::InvalidArgument, "{url}");
    }
}

#[tokio::test]
async fn connect_to_nobody_is_unavailable_and_names_the_address() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    let options = Options { attempts_max: 2, ..Options::default() };
    let error = Client::connect(&url, options).await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable);
    assert!(error.message.contains(&url) && error.message.contains("refused"), "{error}");
}

#[tokio::test]
async fn call_on_a_connection_that_is_cut_is_unavailable() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    // Takes every connection, reads a little, and cuts it.
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            tokio::time::sleep(Duration::from_millis(50)).await;
            drop(stream);
        }
    });
    let options = Options { attempts_max: 2, ..Options::default() };
    let client = Client::connect(&url, options).await.unwrap();
    let error = client.server_info().await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable, "{error}");
}

#[tokio::test]
async fn answer_larger_than_allowed_is_refused() {
    let node = Scripted::default();
    let url = serve(&node).await;
    let options = Options { message_bytes_max: 1, ..Options::default() };
    let client = Client::connect(&url, options).await.unwrap();
    let error = client.step(StepRequest::default()).await.unwrap_err();
    assert_eq!(error.code, Code::OutOfRange);
}

#[tokio::test]
async fn health_is_what_the_node_says() {
    let (reporter, service) = tonic_health::server::health_reporter();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let server = Server::builder().add_service(service);
    tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
    let client = Client::connect(&url, Options::default()).await.unwrap();
    assert!(client.is_serving().await.unwrap());
    reporter.set_service_status("", tonic_health::ServingStatus::NotServing).await;
    assert!(!client.is_serving().await.unwrap());
}

#[tokio::test]
async fn artifact_missing_from_the_answer_breaks_the_contract() {
    let error = connected(&Scripted::default()).await.artifact("a1").await.unwrap_err();
    assert_eq!(error.code, Code::Internal);
    assert!(error.message.contains("contract"), "{error}");
}

#[tokio::test]
async fn precompute_waits_until_done() {
    for cannot_wait in [false, true] {
        let node = Scripted { cannot_wait, ..Scripted::default() };
        *node.looks_left.lock().unwrap() = 3;
        let client = connected(&node).await;
        let made = client.precompute(Problem::default()).await.unwrap();
        let Some(Outcome::Artifact(artifact)) = made.outcome else { panic!("no artifact") };
        assert_eq!(artifact.artifact_id, "a1");
        assert_eq!(*node.looks_left.lock().unwrap(), 0);
    }
}

#[tokio::test]
async fn precompute_goes_on_waiting_for_a_node_that_is_busy() {
    let node = Scripted {
        looks_left: Arc::new(Mutex::new(2)),
        busy: Arc::new(Mutex::new(3)),
        ..Scripted::default()
    };
    let client = connected(&node).await;
    let made = client.precompute(Problem::default()).await.unwrap();
    assert!(matches!(made.outcome, Some(Outcome::Artifact(_))));
    assert_eq!(client.retries(), 3);
}

#[tokio::test]
async fn precompute_reports_how_far_it_is() {
    let node = Scripted::default();
    *node.looks_left.lock().unwrap() = 3;
    let client = connected(&node).await;
    let mut reported = Vec::new();
    let report = |metadata: &PrecomputeMetadata| reported.push(metadata.shards_done);
    client.precompute_reporting(Problem::default(), report).await.unwrap();
    assert_eq!(reported, [8, 9, 10, 10]);
}

#[tokio::test]
async fn download_goes_on_where_it_broke_off_and_is_checked() {
    let node = Scripted::default();
    let client = connected(&node).await;
    assert_eq!(client.download_artifact(CONTENT_SHA256).await.unwrap(), CONTENT);
    assert_eq!(node.calls(), CONTENT.len().div_ceil(3));
    let error = client.download_artifact("another digest").await.unwrap_err();
    assert_eq!(error.code, Code::Internal, "{error}");
}

#[tokio::test]
async fn precompute_that_never_ends_ends_at_its_deadline() {
    let node = Scripted { cannot_wait: true, ..Scripted::default() };
    *node.looks_left.lock().unwrap() = u32::MAX;
    let url = serve(&node).await;
    let options = Options { precompute_deadline: Duration::from_millis(300), ..Options::default() };
    let client = Client::connect(&url, options).await.unwrap();
    let error = client.precompute(Problem::default()).await.unwrap_err();
    assert_eq!(error.code, Code::DeadlineExceeded);
}

#[tokio::test]
async fn closed_loop_sends_the_controller_once() {
    let node = Scripted::default();
    let mut flight = connected(&node).await.closed_loop(by_problem()).await.unwrap();
    for step in 1..=3 {
        let answer = flight.step(Measurement::default()).await.unwrap();
        assert_eq!(answer.controller_state.as_ref(), [step]);
    }
    assert_eq!(flight.controller_state().as_ref(), [3]);
    let seen = node.streamed.lock().unwrap();
    let with_controller: Vec<_> = seen.iter().map(|m| m.controller.is_some()).collect();
    assert_eq!(with_controller, [true, false, false]);
}

#[tokio::test]
async fn closed_loop_goes_on_after_a_status() {
    let refusal = Status::invalid_argument("elapsed_s is not the step's time");
    let node = Scripted::new([Behaviour::Answer, Behaviour::Refuse(refusal)]);
    let mut flight = connected(&node).await.closed_loop(by_problem()).await.unwrap();
    flight.step(Measurement::default()).await.unwrap();
    let error = flight.step(Measurement::default()).await.unwrap_err();
    assert_eq!(error.code, Code::InvalidArgument);
    flight.step(Measurement::default()).await.unwrap();
    let seen = node.streamed.lock().unwrap();
    assert!(seen[2].controller.is_none(), "the stream was opened a second time");
}

#[tokio::test]
async fn closed_loop_refused_first_message_sends_the_controller_again() {
    let node = Scripted::new([Behaviour::Refuse(Status::invalid_argument("no"))]);
    let mut flight = connected(&node).await.closed_loop(by_problem()).await.unwrap();
    flight.step(Measurement::default()).await.unwrap_err();
    flight.step(Measurement::default()).await.unwrap();
    assert!(node.streamed.lock().unwrap()[1].controller.is_some());
}

#[tokio::test]
async fn closed_loop_reopens_a_broken_stream_from_its_last_state() {
    let node = Scripted::new([Behaviour::Answer, Behaviour::HangUp]);
    let mut flight = connected(&node).await.closed_loop(by_problem()).await.unwrap();
    flight.step(Measurement::default()).await.unwrap();
    flight.step(Measurement::default()).await.unwrap();
    let seen = node.streamed.lock().unwrap();
    assert_eq!(seen.len(), 3);
    assert!(seen[2].controller.is_some());
    assert_eq!(seen[2].controller_state.as_deref(), Some([1].as_slice()));
}

#[tokio::test]
async fn closed_loop_never_takes_a_late_answer_for_the_next() {
    let late = Behaviour::Sleep(Duration::from_millis(600));
    let node = Scripted::new([Behaviour::Answer, late]);
    let client = connected(&node).await.with_deadline(Duration::from_millis(200));
    let mut flight = client.closed_loop(by_problem()).await.unwrap();
    flight.step(Measurement::default()).await.unwrap();
    let error = flight.step(Measurement::default()).await.unwrap_err();
    assert_eq!(error.code, Code::DeadlineExceeded);
    tokio::time::sleep(Duration::from_millis(700)).await;
    let answer = flight.step(Measurement::default()).await.unwrap();
    assert_eq!(answer.controller_state.as_ref(), [3], "99 would be the late answer");
}
