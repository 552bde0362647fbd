//! Transports: bytes to messages and back. No decisions.
//!
//! Both speak on one port; this front gives every request its id and deadline, logs and counts it.

mod grpc;
mod http;

use std::{
    collections::BTreeMap,
    sync::{Arc, LazyLock},
    time::{Duration, Instant},
};

use ::http::{HeaderMap, HeaderValue, Method, Request, Response, header};
use axum::{Router, body::Body};
use tower::ServiceExt as _;
use tracing::Instrument as _;
use vbar_proto::DESCRIPTORS;

use crate::{
    service::{Error, Service},
    telemetry::{CallLabels, MethodLabels, RequestId},
};

pub(crate) use grpc::Draining;

const GRPC_STATUS: &str = "grpc-status";
const GRPC_DETAILS: &str = "grpc-status-details-bin";
const REQUEST_ID: &str = "x-request-id";
/// Where the time a compute thread took travels: never in the message, because the same request
/// must give the same bytes.
const SERVER_TIMING: &str = "server-timing";

/// What transports need to know of the configuration.
#[derive(Debug, Clone)]
pub(crate) struct TransportOptions {
    /// Largest request.
    pub(crate) request_bytes_max: usize,
    /// How long the body of a request may take to arrive.
    pub(crate) receive_time_max: Duration,
    /// Set when the node is about to stop.
    pub(crate) draining: Draining,
}

/// Everything that is served on the port.
#[derive(Debug, Clone)]
pub(crate) struct Front {
    router: Router,
    service: Arc<Service>,
}

impl Front {
    /// gRPC and HTTP in front of `service`.
    pub(crate) async fn new(service: Arc<Service>, options: TransportOptions) -> Self {
        let grpc = grpc::router(&service, &options).await;
        let http = http::router(&service, &options);
        // The gRPC router comes with a fallback of its own, which knows only gRPC.
        let router = grpc.reset_fallback().merge(http).fallback(unknown);
        Self { router: router.with_state(()), service }
    }

    /// Answers one request.
    pub(crate) async fn answer(&self, mut request: Request<Body>) -> Response<Body> {
        let start = Instant::now();
        let id = RequestId::from_caller(request.headers().get(REQUEST_ID));
        let transport = if is_grpc(request.headers()) { "grpc" } else { "http" };
        let method = known_method(request.method(), request.uri().path());
        request.extensions_mut().insert(id.clone());
        let span = tracing::info_span!("request", %id, transport, method);
        let answered = self.router.clone().oneshot(request).instrument(span.clone()).await;
        let mut response = match answered {
            Ok(response) => response,
            Err(never) => match never {},
        };
        if response.headers().contains_key(GRPC_STATUS)
            && !response.headers().contains_key(GRPC_DETAILS)
            && let Some(status) = tonic::Status::from_header_map(response.headers())
        {
            response = grpc::complete(status, &id).into_http();
        }
        let code = code_name(&response);
        let elapsed = start.elapsed();
        if let Ok(value) = HeaderValue::from_str(&id.0) {
            response.headers_mut().insert(REQUEST_ID, value);
        }
        span.in_scope(|| {
            let status = response.status().as_u16();
            tracing::info!(code, status, elapsed_us = elapsed.as_micros(), "answered");
        });
        let metrics = self.service.metrics();
        metrics.requests.get_or_create(&CallLabels { method, transport, code }).inc();
        let labels = MethodLabels { method };
        metrics.request_seconds.get_or_create(&labels).observe(elapsed.as_secs_f64());
        response
    }
}

/// Neither transport knows the path.
async fn unknown(request: Request<Body>) -> Response<Body> {
    if is_grpc(request.headers()) {
        let path = request.uri().path();
        return tonic::Status::unimplemented(format!("{path} is not a method of this server"))
            .into_http();
    }
    http::unknown_path(&request)
}

fn is_grpc(headers: &HeaderMap) -> bool {
    headers
        .get(header::CONTENT_TYPE)
        .is_some_and(|value| value.as_bytes().starts_with(b"application/grpc"))
}

/// Name of every RPC of the contract, by its gRPC path.
static RPCS: LazyLock<BTreeMap<String, String>> = LazyLock::new(|| {
    let methods = DESCRIPTORS.services().flat_map(|service| service.methods().collect::<Vec<_>>());
    methods
        .map(|rpc| {
            let path = format!("/{}/{}", rpc.parent_service().full_name(), rpc.name());
            (path, rpc.name().to_owned())
        })
        .collect()
});

/// A label must come from a fixed list, or strangers could fill the memory with labels: an RPC of
/// the contract, whatever it came over, or what else the port serves.
fn known_method(method: &Method, path: &str) -> &'static str {
    if let Some(rpc) = RPCS.get(path) {
        return rpc;
    }
    match http::served(method, path) {
        Some(name) => name,
        None if path.starts_with("/grpc.health.") => "Health",
        None if path.starts_with("/grpc.reflection.") => "Reflection",
        None => "unknown",
    }
}

/// Name of the `google.rpc.Code` in an answer's head: of an error, or OK.
fn code_name(response: &Response<Body>) -> &'static str {
    const NAMES: [&str; 17] = [
        "OK",
        "CANCELLED",
        "UNKNOWN",
        "INVALID_ARGUMENT",
        "DEADLINE_EXCEEDED",
        "NOT_FOUND",
        "ALREADY_EXISTS",
        "PERMISSION_DENIED",
        "RESOURCE_EXHAUSTED",
        "FAILED_PRECONDITION",
        "ABORTED",
        "OUT_OF_RANGE",
        "UNIMPLEMENTED",
        "INTERNAL",
        "UNAVAILABLE",
        "DATA_LOSS",
        "UNAUTHENTICATED",
    ];
    let number = match response.extensions().get::<AnsweredWith>() {
        Some(AnsweredWith(number)) => usize::try_from(*number).ok(),
        None => match response.headers().get(GRPC_STATUS) {
            Some(value) => value.to_str().ok().and_then(|text| text.parse().ok()),
            None => Some(0),
        },
    };
    number.and_then(|number| NAMES.get(number)).copied().unwrap_or("UNKNOWN")
}

/// The code of an HTTP answer, for the count.
#[derive(Debug, Clone, Copy)]
struct AnsweredWith(i32);

/// `Server-Timing`: milliseconds on a compute thread.
fn server_timing(compute: Duration) -> HeaderValue {
    let text = format!("compute;dur={:.3}", compute.as_secs_f64() * 1e3);
    HeaderValue::from_str(&text).unwrap_or(HeaderValue::from_static("compute"))
}

/// Reads a caller's deadline.
fn deadline_fault(header: &str, expected: &str, got: &HeaderValue) -> Error {
    Error::field(header, expected, &format!("{got:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_method_is_the_rpc_over_both_transports() {
        for (path, rpc) in &*RPCS {
            assert_eq!(known_method(&Method::POST, path), rpc);
        }
        assert!(RPCS.contains_key("/vbar.v1.GuidanceService/StepStream"));
        assert!(RPCS.contains_key("/google.longrunning.Operations/WaitOperation"));
        for (method, path, label) in [
            (Method::POST, "/v1/step", "Step"),
            (Method::GET, "/v1/step", "Step"),
            (Method::GET, "/v1/artifacts/00ff", "GetArtifact"),
            (Method::GET, "/v1/artifacts", "ListArtifacts"),
            (Method::GET, "/v1/artifacts/00ff:download", "DownloadArtifact"),
            (Method::GET, "/v1/operations", "ListOperations"),
            (Method::GET, "/v1/operations/00ff", "GetOperation"),
            (Method::HEAD, "/v1/operations/00ff", "GetOperation"),
            (Method::DELETE, "/v1/operations/00ff", "DeleteOperation"),
            (Method::POST, "/v1/operations/00ff:wait", "WaitOperation"),
            (Method::POST, "/v1/operations/00ff:cancel", "CancelOperation"),
            (Method::GET, "/v1/operations/00ff:watch", "GetOperation"),
            (Method::GET, "/healthz", "probe"),
            (Method::POST, "/grpc.health.v1.Health/Check", "Health"),
            (Method::GET, "/v1/artifacts/00ff/more", "unknown"),
            (Method::GET, "/v1/stepping", "unknown"),
            (Method::GET, "/", "unknown"),
        ] {
            assert_eq!(known_method(&method, path), label, "{method} {path}");
        }
    }
}
