//! One call, one method.

use std::time::Duration;

use tokio::time::Instant;
use tonic::{
    Code, Request, Response, Status,
    service::interceptor::InterceptedService,
    transport::{Channel, Endpoint},
};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use vbar_proto::{
    google::longrunning::operations_client::OperationsClient,
    v1::{
        ComputePlanRequest, ComputePlanResponse, ExportPlanRequest, ExportPlanResponse,
        GetPlanRequest, GetPlanResponse, GetServerInfoRequest, GetServerInfoResponse,
        ListPlansRequest, ListPlansResponse, SafetyReportRequest, SafetyReportResponse,
        StepRequest, StepResponse, UploadPlanRequest, UploadPlanResponse,
        guidance_service_client::GuidanceServiceClient, step_stream_request::Controller,
    },
};

use crate::{
    ClosedLoop, Credentials, Error,
    credentials::{self, Bearer},
    retry::{Attempts, Retries},
};

/// A connection on which every call says who asks.
pub(crate) type Transport = InterceptedService<Channel, Bearer>;

/// How calls are made.
#[derive(Debug, Clone)]
pub struct Options {
    /// Longest time for one call, every attempt and pause included. The node is told and stops
    /// computing when it has passed.
    pub deadline: Duration,
    /// The same for [`Client::precompute`], waiting included: it thinks long once.
    pub precompute_deadline: Duration,
    /// Longest time to reach the node once.
    pub connect_timeout: Duration,
    /// Longest time without a sign of life from the node while a call waits; then its connection is
    /// given up, and the call is tried on another. Without it a connection that is gone and does not
    /// say so would take the deadline of every call on it.
    pub silence_max: Duration,
    /// Most attempts of one call, the first included; 0 counts as 1.
    pub attempts_max: u32,
    /// Largest message sent or accepted.
    pub message_bytes_max: usize,
    /// Whom to believe, and how to say who asks.
    pub credentials: Credentials,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            deadline: Duration::from_secs(30),
            precompute_deadline: Duration::from_secs(3600),
            connect_timeout: Duration::from_secs(5),
            silence_max: Duration::from_secs(10),
            attempts_max: 5,
            message_bytes_max: 16 << 20,
            credentials: Credentials::default(),
        }
    }
}

/// A connection to one node; cheap to clone, and all clones share the connection.
#[derive(Debug, Clone)]
pub struct Client {
    pub(crate) guidance: GuidanceServiceClient<Transport>,
    pub(crate) operations: OperationsClient<Transport>,
    health: HealthClient<Transport>,
    pub(crate) transport: Transport,
    pub(crate) options: Options,
    pub(crate) retries: Retries,
}

impl Client {
    /// Connects to the node at `url`, such as `http://127.0.0.1:7440` or `https://node:7440`.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a URL that is not `http://host:port` or `https://host:port`, or
    /// credentials that do not fit it; `UNAVAILABLE` when nothing answers there after all
    /// attempts.
    pub async fn connect(url: &str, options: Options) -> Result<Self, Error> {
        let endpoint = endpoint(url, &options)?;
        let bearer = Bearer::new(&options.credentials)?;
        let retries = Retries::default();
        let deadline = Instant::now() + options.deadline;
        let mut attempts = Attempts::new(options.attempts_max, deadline, &retries);
        let channel = loop {
            let reached = async {
                endpoint.connect().await.map_err(|fault| {
                    let mut error = Error::from(Status::from_error(fault.into()));
                    error.message = format!("cannot reach {url}: {}", error.message);
                    error
                })
            };
            match attempts.bounded(reached).await {
                Ok(channel) => break channel,
                Err(error) => attempts.pause_after(error).await?,
            }
        };
        let channel = InterceptedService::new(channel, bearer);
        let size = options.message_bytes_max;
        Ok(Self {
            guidance: GuidanceServiceClient::new(channel.clone())
                .max_decoding_message_size(size)
                .max_encoding_message_size(size),
            health: HealthClient::new(channel.clone()),
            transport: channel.clone(),
            operations: OperationsClient::new(channel)
                .max_decoding_message_size(size)
                .max_encoding_message_size(size),
            options,
            retries,
        })
    }

    /// The same connection with another deadline for each call.
    #[must_use]
    pub fn with_deadline(&self, deadline: Duration) -> Self {
        let mut client = self.clone();
        client.options.deadline = deadline;
        client
    }

    /// How often this client and its clones tried again what the world had interrupted.
    #[must_use]
    pub fn retries(&self) -> u64 {
        self.retries.count()
    }

    /// Computes a plan to fly without further optimisation, or says why there is none.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn plan(&self, request: ComputePlanRequest) -> Result<ComputePlanResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.compute_plan(request).await }
        })
        .await
    }

    /// Keeps a plan made elsewhere, if what it claims holds.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` with every claim that does not hold; [`Error`], as every call.
    pub async fn upload_plan(
        &self,
        request: UploadPlanRequest,
    ) -> Result<UploadPlanResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.upload_plan(request).await }
        })
        .await
    }

    /// A kept plan with its mission.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; [`Error`], as every call.
    pub async fn get_plan(&self, plan_id: &str) -> Result<GetPlanResponse, Error> {
        let request = GetPlanRequest { plan_id: plan_id.to_owned() };
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.get_plan(request).await }
        })
        .await
    }

    /// A page of kept plans.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn list_plans(&self, request: ListPlansRequest) -> Result<ListPlansResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.list_plans(request).await }
        })
        .await
    }

    /// A kept plan as a document.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; `FAILED_PRECONDITION` if its mission lacks what
    /// the format needs; [`Error`], as every call.
    pub async fn export_plan(
        &self,
        request: ExportPlanRequest,
    ) -> Result<ExportPlanResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.export_plan(request).await }
        })
        .await
    }

    /// Decides the next command. The answer's `controller_state` goes into the next request.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn step(&self, request: StepRequest) -> Result<StepResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.step(request).await }
        })
        .await
    }

    /// What could be done along a trajectory if thrusters failed.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have the artifact or plan; `RESOURCE_EXHAUSTED` for a
    /// report too large for one answer; [`Error`], as every call.
    pub async fn safety_report(
        &self,
        request: SafetyReportRequest,
    ) -> Result<SafetyReportResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.safety_report(request).await }
        })
        .await
    }

    /// A closed loop from its first step: the controller is sent once, then measurements only.
    ///
    /// The stream is opened by the first measurement, so a refused controller shows there.
    ///
    /// # Errors
    /// None today: whatever can fail does so in [`ClosedLoop::step`].
    pub async fn closed_loop(&self, controller: Controller) -> Result<ClosedLoop, Error> {
        Ok(ClosedLoop::new(self.clone(), controller))
    }

    /// Build, methods and limits of the node.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn server_info(&self) -> Result<GetServerInfoResponse, Error> {
        self.call(self.options.deadline, GetServerInfoRequest {}, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.get_server_info(request).await }
        })
        .await
    }

    /// The node says that it will answer; false while it starts or drains.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn is_serving(&self) -> Result<bool, Error> {
        let response = self
            .call(self.options.deadline, HealthCheckRequest::default(), |request| {
                let mut health = self.health.clone();
                async move { health.check(request).await }
            })
            .await?;
        Ok(response.status() == ServingStatus::Serving)
    }

    /// One call: deadline, attempts, pauses.
    pub(crate) async fn call<Q: Clone, A, F>(
        &self,
        within: Duration,
        request: Q,
        send: impl Fn(Request<Q>) -> F,
    ) -> Result<A, Error>
    where
        F: Future<Output = Result<Response<A>, Status>>,
    {
        let deadline = Instant::now() + within;
        let mut attempts = Attempts::new(self.options.attempts_max, deadline, &self.retries);
        loop {
            let mut message = Request::new(request.clone());
            message.set_timeout(attempts.time_left()?);
            let answer = async { send(message).await.map_err(Error::from) };
            match attempts.bounded(answer).await {
                Ok(response) => return Ok(response.into_inner()),
                Err(error) => attempts.pause_after(error).await?,
            }
        }
    }
}

fn endpoint(url: &str, options: &Options) -> Result<Endpoint, Error> {
    let refused = |why: String| {
        Error::local(
            Code::InvalidArgument,
            format!("{why}; a node's URL is http://host:port or https://host:port"),
        )
    };
    let uri: http::Uri =
        url.parse().map_err(|fault| refused(format!("{url:?} is not a URL: {fault}")))?;
    match uri.scheme_str() {
        Some("http" | "https") => {}
        Some(other) => return Err(refused(format!("{other}:// is not spoken by this client"))),
        None => return Err(refused(format!("{url:?} has no scheme"))),
    }
    if uri.port_u16().is_none() || uri.path() != "/" || uri.query().is_some() {
        return Err(refused(format!("{url:?} has no port, or something after it")));
    }
    let tls = credentials::tls(&uri, options)?;
    // A step is one small message and one small answer: waiting to fill a packet only delays.
    // Half of the silence passes before the node is asked, half before it must have answered.
    let endpoint = Endpoint::from(uri)
        .tcp_nodelay(true)
        .connect_timeout(options.connect_timeout)
        .http2_keep_alive_interval(options.silence_max / 2)
        .keep_alive_timeout(options.silence_max / 2);
    match tls {
        None => Ok(endpoint),
        Some(tls) => endpoint.tls_config(tls).map_err(|_| {
            Error::local(Code::InvalidArgument, "the certificates or the key are not in PEM")
        }),
    }
}
