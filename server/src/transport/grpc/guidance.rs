//! `vbar.v1.GuidanceService`.

use std::{pin::Pin, time::Instant};

use futures_util::{Stream, stream};
use tonic::{Request, Response, Status, Streaming, async_trait, metadata::MetadataValue};
use vbar_proto::{
    google::{longrunning::Operation, rpc},
    v1::{self, guidance_service_server::GuidanceService, step_stream_response},
};

use super::{Draining, Grpc, request_id, status};
use crate::{
    access::Pass,
    service::{Call, Code, Error, Service, Session, SessionAnswer, Timed},
    telemetry::{OutcomeLabels, RequestId},
    transport::{SERVER_TIMING, pass, server_timing},
    wire::{self, Render as _, StreamCall},
};

#[async_trait]
impl GuidanceService for Grpc {
    type StepStreamStream =
        Pin<Box<dyn Stream<Item = Result<v1::StepStreamResponse, Status>> + Send>>;
    type DownloadArtifactStream =
        Pin<Box<dyn Stream<Item = Result<v1::DownloadArtifactResponse, Status>> + Send>>;

    async fn compute_plan(
        &self,
        request: Request<v1::ComputePlanRequest>,
    ) -> Result<Response<v1::ComputePlanResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.plan(ask, &call).await)
            .await
            .map(|timed| respond(timed.map(|answer| answer.render())))
    }

    async fn upload_plan(
        &self,
        request: Request<v1::UploadPlanRequest>,
    ) -> Result<Response<v1::UploadPlanResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.upload(ask, &call).await)
            .await
            .map(|timed| respond(timed.map(|answer| answer.render())))
    }

    async fn get_plan(
        &self,
        request: Request<v1::GetPlanRequest>,
    ) -> Result<Response<v1::GetPlanResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.kept_plan(ask, &call).await)
            .await
            .map(|answer| Response::new(answer.render()))
    }

    async fn list_plans(
        &self,
        request: Request<v1::ListPlansRequest>,
    ) -> Result<Response<v1::ListPlansResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| {
            service.kept_plans(ask, &call).await
        })
        .await
        .map(|answer| Response::new(answer.render()))
    }

    async fn export_plan(
        &self,
        request: Request<v1::ExportPlanRequest>,
    ) -> Result<Response<v1::ExportPlanResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.export(ask, &call).await)
            .await
            .map(|timed| respond(timed.map(|answer| answer.render())))
    }

    async fn precompute(
        &self,
        request: Request<v1::PrecomputeRequest>,
    ) -> Result<Response<Operation>, Status> {
        self.call(request, async |service: &Service, ask, call| {
            service.precompute(ask, &call).await
        })
        .await
        .map(|answer| Response::new(answer.render()))
    }

    async fn get_artifact(
        &self,
        request: Request<v1::GetArtifactRequest>,
    ) -> Result<Response<v1::GetArtifactResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.artifact(ask, &call).await)
            .await
            .map(|answer| Response::new(answer.render()))
    }

    async fn list_artifacts(
        &self,
        request: Request<v1::ListArtifactsRequest>,
    ) -> Result<Response<v1::ListArtifactsResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.artifacts(ask, &call).await)
            .await
            .map(|answer| Response::new(answer.render()))
    }

    async fn download_artifact(
        &self,
        request: Request<v1::DownloadArtifactRequest>,
    ) -> Result<Response<Self::DownloadArtifactStream>, Status> {
        // Large enough to be fast, small enough for every reader's limit.
        const PIECE: usize = 256 << 10;
        self.call(request, async |service: &Service, ask, call| service.download(ask, &call).await)
            .await
            .map(|answer| {
                let pieces = answer.pieces(PIECE).map(Ok);
                Response::new(Box::pin(stream::iter(pieces)) as Self::DownloadArtifactStream)
            })
    }

    async fn step(
        &self,
        request: Request<v1::StepRequest>,
    ) -> Result<Response<v1::StepResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| service.step(ask, &call).await)
            .await
            .map(|timed| respond(timed.map(|answer| answer.render())))
    }

    async fn step_stream(
        &self,
        request: Request<Streaming<v1::StepStreamRequest>>,
    ) -> Result<Response<Self::StepStreamStream>, Status> {
        let id = request_id(&request);
        let opening = self
            .head(&request)
            .and_then(|call| pass(request.extensions()).map(|pass| (call, pass.clone())));
        let (call, pass) = opening.map_err(|error| status::render(error, &id))?;
        // Without a wish of its own a stream may live on; each of its steps has a deadline.
        let ends = request.metadata().contains_key("grpc-timeout").then_some(call.deadline);
        let closed_loop = Loop {
            session: Session::new(self.service.clone()),
            messages: request.into_inner(),
            grpc: self.clone(),
            draining: self.draining.clone(),
            ends,
            pass,
            id,
            over: false,
        };
        let answers = stream::unfold(closed_loop, async |mut closed_loop| {
            closed_loop.next().await.map(|answer| (answer, closed_loop))
        });
        Ok(Response::new(Box::pin(answers)))
    }

    async fn safety_report(
        &self,
        request: Request<v1::SafetyReportRequest>,
    ) -> Result<Response<v1::SafetyReportResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| {
            service.safety_report(ask, &call).await
        })
        .await
        .map(|timed| respond(timed.map(|answer| answer.render())))
    }

    async fn get_server_info(
        &self,
        request: Request<v1::GetServerInfoRequest>,
    ) -> Result<Response<v1::GetServerInfoResponse>, Status> {
        self.call(request, async |service: &Service, ask: wire::InfoCall, _| Ok(service.info(ask)))
            .await
            .map(|answer| Response::new(answer.render()))
    }
}

fn respond<T>(timed: Timed<T>) -> Response<T> {
    let mut response = Response::new(timed.value);
    if let Ok(value) = MetadataValue::try_from(server_timing(timed.compute).as_bytes()) {
        response.metadata_mut().insert(SERVER_TIMING, value);
    }
    response
}

/// One `StepStream` as it is served.
struct Loop {
    session: Session,
    messages: Streaming<v1::StepStreamRequest>,
    grpc: Grpc,
    draining: Draining,
    ends: Option<Instant>,
    pass: Pass,
    id: RequestId,
    over: bool,
}

impl Loop {
    /// The next answer; `None` at the end.
    async fn next(&mut self) -> Option<Result<v1::StepStreamResponse, Status>> {
        if self.over {
            return None;
        }
        let message = tokio::select! {
            message = self.messages.message() => message,
            _ = self.draining.wait_for(|draining| *draining) => {
                self.over = true;
                let message = "the server is shutting down; open the loop elsewhere with the last \
                               controller_state";
                let error = Error::new(Code::Unavailable, "SHUTTING_DOWN", message);
                return Some(Err(status::render(error, &self.id)));
            }
        };
        let outcome = match message {
            Ok(None) => return None,
            // The message could not be read; the stream behind it can be in any state.
            Err(fault) => {
                self.over = true;
                return Some(Err(status::complete(fault, &self.id)));
            }
            Ok(Some(message)) => match self.pass.message() {
                Ok(()) => self.answer(&message).await,
                Err(refusal) if refusal.is_for_now() => Err(refusal.into()),
                // Its token has expired, or was taken from it.
                Err(refusal) => {
                    self.over = true;
                    return Some(Err(status::render(refusal.into(), &self.id)));
                }
            },
        };
        let (result, outcome) = match outcome {
            Ok(SessionAnswer::Step(timed)) => {
                (step_stream_response::Result::Response(timed.value.render()), "answered")
            }
            Ok(SessionAnswer::Opened) => {
                let opened = rpc::Status { message: "open".to_owned(), ..rpc::Status::default() };
                (step_stream_response::Result::Status(opened), "opened")
            }
            Err(error) => {
                let status = status::render(error, &self.id);
                (step_stream_response::Result::Status(status::message(&status)), "refused")
            }
        };
        let metrics = self.grpc.service.metrics();
        metrics.stream_messages.get_or_create(&OutcomeLabels { outcome }).inc();
        Some(Ok(v1::StepStreamResponse { result: Some(result) }))
    }

    async fn answer(&mut self, message: &v1::StepStreamRequest) -> Result<SessionAnswer, Error> {
        let service = &self.grpc.service;
        let message = wire::parse::<StreamCall>(message, &service.limits())?;
        let limit = service.deadline(None);
        let deadline = self.ends.map_or(limit, |ends| ends.min(limit));
        let call = Call { caller: self.pass.caller().clone(), deadline };
        self.session.answer(message, &call).await
    }
}
