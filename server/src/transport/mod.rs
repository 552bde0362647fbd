//! Transports: bytes to messages and back. No decisions.
//!
//! Both speak on one port; this front gives every request its id and deadline, logs and counts it.

mod audited;
mod framing;
mod grpc;
mod http;
mod patience;

#[cfg(feature = "fuzzing")]
pub(crate) use http::{decode_json, encode_json};

use std::{
    collections::BTreeMap,
    sync::{Arc, LazyLock, Mutex},
    time::{Duration, Instant},
};

use ::http::{Extensions, HeaderMap, HeaderValue, Method, Request, Response, header};
use axum::{Router, body::Body};
use hyper::body::Body as _;
use tower::ServiceExt as _;
use tracing::{Instrument as _, field::Empty};
use vbar_proto::DESCRIPTORS;

use crate::{
    access::{Caller, Gate, Pass, Peer, Right, right},
    recording::{Exchange, Recorder},
    service::{Error, Service},
    telemetry::{CallLabels, MethodLabels, REQUEST_ID, RequestId},
};

use audited::{Answered, Asked, Messages, Record, Tape};
use patience::Patient;

pub(crate) use grpc::Draining;

const GRPC_STATUS: &str = "grpc-status";
const GRPC_DETAILS: &str = "grpc-status-details-bin";
/// Where the time a compute thread took travels: never in the message, because the same request
/// must give the same bytes.
const SERVER_TIMING: &str = "server-timing";

/// What a process does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// Answers calls.
    Node,
    /// Does parts of jobs; tells only how it is.
    Worker,
}

/// What transports need to know of the configuration.
#[derive(Debug, Clone)]
pub(crate) struct TransportOptions {
    /// Largest request.
    pub(crate) request_bytes_max: usize,
    /// How long the body of a request may take to arrive.
    pub(crate) receive_time_max: Duration,
    /// Set when the node is about to stop.
    pub(crate) draining: Draining,
    /// What is served.
    pub(crate) role: Role,
}

/// Everything that is served on the port.
#[derive(Debug, Clone)]
pub(crate) struct Front {
    router: Router,
    service: Arc<Service>,
    gate: Arc<Gate>,
    recorder: Option<Arc<Recorder>>,
    receive_time_max: Duration,
}

impl Front {
    /// gRPC and HTTP in front of `service`, behind `gate`; what passes is recorded by `recorder`.
    pub(crate) async fn new(
        service: Arc<Service>,
        gate: Arc<Gate>,
        recorder: Option<Arc<Recorder>>,
        options: TransportOptions,
    ) -> Self {
        let grpc = grpc::router(&service, &options).await;
        let http = http::router(&service, &options);
        // The gRPC router comes with a fallback of its own, which knows only gRPC.
        let router = grpc.reset_fallback().merge(http).fallback(unknown);
        let receive_time_max = options.receive_time_max;
        Self { router: router.with_state(()), service, gate, recorder, receive_time_max }
    }

    /// Answers one request of `peer`.
    pub(crate) async fn answer(&self, mut request: Request<Body>, peer: &Peer) -> Response<Body> {
        let start = Instant::now();
        let id = RequestId::from_caller(request.headers());
        let is_grpc = is_grpc(request.headers());
        let transport = if is_grpc { "grpc" } else { "http" };
        let method = known_method(request.method(), request.uri().path());
        let span = span(&request, &id, transport, method);
        let admitted = self.gate.admit(peer, request.headers(), method);
        // Nobody behind this needs it, and what nobody has cannot be logged.
        request.headers_mut().remove(header::AUTHORIZATION);
        request.extensions_mut().insert(id.clone());
        let caller = match &admitted {
            Ok(pass) => pass.caller(),
            Err((caller, _)) => caller,
        };
        let mut record = self.record(&request, peer, caller, method, admitted.is_ok());
        let (mut response, pass) = match admitted {
            Ok(pass) => {
                request.extensions_mut().insert(pass.clone());
                if is_grpc {
                    let (within, is_stream) = (self.receive_time_max, takes_many(method));
                    let patient =
                        |body| Body::new(Patient::new(body, within, is_stream, grpc::too_slow));
                    request = request.map(patient);
                }
                if let Some(record) = &record {
                    let messages = Arc::clone(&record.asked);
                    request = request.map(|body| Body::new(Asked::new(body, messages)));
                }
                (self.routed(request, method).instrument(span.clone()).await, Some(pass))
            }
            Err((_, refusal)) if is_grpc => (grpc::refused(refusal.into(), &id), None),
            Err((_, refusal)) => (http::refused(refusal.into(), &id), None),
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
            if transport == "grpc" {
                span.record("rpc.grpc.status_code", code_number(&response));
            } else {
                span.record("http.response.status_code", status);
            }
            tracing::info!(code, status, elapsed_us = elapsed.as_micros(), "answered");
        });
        let metrics = self.service.metrics();
        metrics.requests.get_or_create(&CallLabels { method, transport, code }).inc();
        let labels = MethodLabels { method };
        metrics.request_seconds.get_or_create(&labels).observe(elapsed.as_secs_f64());
        if let Some(record) = &mut record {
            if is_grpc {
                record.end(response.headers());
            } else {
                record.end_http(code, code_number(&response).unwrap_or_default());
            }
            if response.body().is_end_stream() {
                record.is_all();
            }
        }
        response.map(|body| Body::new(Answered::new(body, record, pass)))
    }

    async fn routed(&self, request: Request<Body>, method: &'static str) -> Response<Body> {
        // What has no name of its own has no right of its own: no route may take it after all.
        if method == UNKNOWN {
            return unknown(request).await;
        }
        match self.router.clone().oneshot(request).await {
            Ok(response) => response,
            Err(never) => match never {},
        }
    }

    /// What will be written down about a request; `None` for probes, or if nobody would read it.
    fn record(
        &self,
        request: &Request<Body>,
        peer: &Peer,
        caller: &Caller,
        call: &'static str,
        is_admitted: bool,
    ) -> Option<Record> {
        let right = right(call);
        let is_audited = self.gate.audit().is_kept();
        // What the gate refuses is for the audit log only: it is no function of the request.
        let tape = if is_admitted { self.tape(request, call) } else { None };
        if right == Right::Open || !is_audited && tape.is_none() {
            return None;
        }
        let is_grpc = is_grpc(request.headers());
        let messages = || Messages::new(is_grpc, tape.is_some());
        Some(Record {
            gate: Arc::clone(&self.gate),
            peer: peer.clone(),
            caller: caller.clone(),
            role: match right {
                Right::Role(role) => role.name(),
                Right::Known | Right::Open => "",
            },
            call,
            transport: if is_grpc { "grpc" } else { "http" },
            resource: resource(request.uri().path()).to_owned(),
            id: request.extensions().get().cloned().unwrap_or_else(RequestId::fresh),
            start: Instant::now(),
            asked: Arc::new(Mutex::new(messages())),
            answered: messages(),
            code: "CANCELLED",
            is_audited,
            tape,
        })
    }

    /// Where a call of the guidance service goes if there is a black box.
    fn tape(&self, request: &Request<Body>, call: &'static str) -> Option<Tape> {
        let recorder = self.recorder.as_ref()?;
        if !is_guidance(call) {
            return None;
        }
        let is_grpc = is_grpc(request.headers());
        let path = request.uri().path_and_query().map_or("", |path| path.as_str());
        let id = request.extensions().get::<RequestId>();
        let exchange = Exchange {
            call: call.to_owned(),
            http_method: if is_grpc { String::new() } else { request.method().to_string() },
            path: path.to_owned(),
            request_id: id.map(|id| id.0.to_string()).unwrap_or_default(),
            closed_loop: takes_many(call).then(|| recorder.next_loop()),
            ..Exchange::default()
        };
        Some(Tape::new(Arc::clone(recorder), exchange))
    }
}

/// The id in a path. Only what looks like one: a path is the caller's, and may hold anything.
fn resource(path: &str) -> &str {
    const DIGITS: usize = 64;
    let last = path.rsplit('/').next().unwrap_or_default();
    let id = last.split(':').next().unwrap_or_default();
    let is_id = id.len() == DIGITS && id.bytes().all(|c| matches!(c, b'0'..=b'9' | b'a'..=b'f'));
    if is_id { id } else { "" }
}

/// The span of a request, with the attributes that OpenTelemetry's conventions give to RPCs and
/// HTTP servers. Everything in it is of our own making or was found harmless.
fn span(
    request: &Request<Body>,
    id: &RequestId,
    transport: &'static str,
    method: &'static str,
) -> tracing::Span {
    let trace_id = id.trace_id().as_str();
    let span = tracing::info_span!(
        "request",
        %id,
        trace_id,
        transport,
        method,
        otel.kind = "server",
        otel.name = method,
        rpc.system = Empty,
        rpc.service = Empty,
        rpc.method = Empty,
        rpc.grpc.status_code = Empty,
        http.request.method = Empty,
        http.response.status_code = Empty,
    );
    if transport == "grpc" {
        span.record("rpc.system", "grpc");
        // A service that is not known could be anything.
        if let Some((path, _)) = RPCS.get_key_value(request.uri().path())
            && let Some((service, rpc)) = path[1..].rsplit_once('/')
        {
            span.record("rpc.service", service).record("rpc.method", rpc);
        }
    } else {
        // Nor is what a caller calls his method for our logs.
        let method =
            if is_standard(request.method()) { request.method().as_str() } else { "_OTHER" };
        span.record("http.request.method", method);
    }
    span
}

fn is_standard(method: &Method) -> bool {
    const STANDARD: [Method; 9] = [
        Method::GET,
        Method::POST,
        Method::DELETE,
        Method::HEAD,
        Method::OPTIONS,
        Method::PUT,
        Method::PATCH,
        Method::CONNECT,
        Method::TRACE,
    ];
    STANDARD.contains(method)
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

/// What has no other name.
const UNKNOWN: &str = "unknown";

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

/// Whether a call is one of the guidance service: a function of its request and of what is stored.
/// Operations tell how far something is, which is true once.
fn is_guidance(call: &str) -> bool {
    RPCS.iter().any(|(path, rpc)| rpc == call && path.starts_with("/vbar."))
}

/// Whether a call is one to which a caller sends messages for as long as it likes. The only one of
/// the libraries' is reflection.
fn takes_many(call: &str) -> bool {
    static STREAMS: LazyLock<Vec<String>> = LazyLock::new(|| {
        let services = DESCRIPTORS.services();
        let methods = services.flat_map(|service| service.methods().collect::<Vec<_>>());
        methods.filter(|rpc| rpc.is_client_streaming()).map(|rpc| rpc.name().to_owned()).collect()
    });
    call == "Reflection" || STREAMS.iter().any(|stream| stream == call)
}

/// A label must come from a fixed list, or strangers could fill the memory with labels: an RPC of
/// the contract, whatever it came over, or what else the port serves.
fn known_method(method: &Method, path: &str) -> &'static str {
    if let Some(rpc) = RPCS.get(path) {
        return rpc;
    }
    // Nothing that is served needs an escape, and with one a path is no longer what it seems.
    if path.contains('%') {
        return UNKNOWN;
    }
    match http::served(method, path) {
        Some(name) => name,
        None if path.starts_with("/grpc.health.") => "Health",
        None if path.starts_with("/grpc.reflection.") => "Reflection",
        None => UNKNOWN,
    }
}

/// Names of `google.rpc.Code`, by number.
const CODES: [&str; 17] = [
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

/// Name of the `google.rpc.Code` in an answer's head: of an error, or OK.
fn code_name(response: &Response<Body>) -> &'static str {
    code_number(response).map_or("UNKNOWN", |number| named(usize::try_from(number).ok()))
}

/// The same as a number; `None` if the head has something else.
fn code_number(response: &Response<Body>) -> Option<i32> {
    match response.extensions().get::<AnsweredWith>() {
        Some(AnsweredWith(number)) => Some(*number),
        None => match response.headers().get(GRPC_STATUS) {
            Some(value) => value.to_str().ok()?.parse().ok(),
            None => Some(0),
        },
    }
}

/// Name of the code in `grpc-status`.
fn code_of(status: &HeaderValue) -> &'static str {
    named(status.to_str().ok().and_then(|text| text.parse().ok()))
}

fn named(number: Option<usize>) -> &'static str {
    number.and_then(|number| CODES.get(number)).copied().unwrap_or("UNKNOWN")
}

/// The code of an HTTP answer, for the count.
#[derive(Debug, Clone, Copy)]
struct AnsweredWith(i32);

/// `Server-Timing`: milliseconds on a compute thread.
fn server_timing(compute: Duration) -> HeaderValue {
    let text = format!("compute;dur={:.3}", compute.as_secs_f64() * 1e3);
    HeaderValue::from_str(&text).unwrap_or(HeaderValue::from_static("compute"))
}

/// What let the request in: the front has asked before.
fn pass(extensions: &Extensions) -> Result<&Pass, Error> {
    let unknown = || Error::internal("PASS_MISSING", "a request that did not pass the front");
    extensions.get().ok_or_else(unknown)
}

/// Reads everything that is read by hand of the head of a request.
#[cfg(feature = "fuzzing")]
pub(crate) fn read_head(request: Request<()>) {
    let (parts, ()) = request.into_parts();
    let id = RequestId::from_caller(&parts.headers);
    assert!(HeaderValue::from_str(&id.0).is_ok(), "{id} cannot be echoed");
    assert_eq!(id.trace_id().as_str().len(), 32, "{id}");
    let path = parts.uri.path();
    let is_probe = ["/healthz", "/readyz", "/grpc.health."].iter().any(|p| path.starts_with(p));
    assert!(right(known_method(&parts.method, path)) != Right::Open || is_probe, "{path} is open");
    assert!(matches!(resource(path).len(), 0 | 64), "{path} has no id");
    let text = |name: &str| parts.headers.get(name).and_then(|value| value.to_str().ok());
    text("grpc-timeout").map(grpc::timeout);
    http::read_head(&parts);
}

/// Counts and digests framed messages that arrive in pieces of `length` bytes.
#[cfg(feature = "fuzzing")]
pub(crate) fn read_frames(body: &[u8], length: usize) -> (u64, String) {
    audited::read(body, length)
}

/// What is wrong with a caller's deadline.
fn deadline_fault(header: &str, expected: &str, got: &HeaderValue) -> Error {
    Error::field(header, expected, &format!("{got:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access;

    #[test]
    fn rights_cover_every_rpc_and_everything_else_that_is_served_and_nothing_more() {
        let mut served: Vec<&str> = RPCS.values().map(String::as_str).collect();
        let count = served.len();
        served.sort_unstable();
        served.dedup();
        assert_eq!(served.len(), count, "two RPCs of one name would have one right");
        served.extend(["Health", "Reflection", "metrics", "openapi", "probe", UNKNOWN]);
        served.sort_unstable();
        let mut named: Vec<_> = access::named().collect();
        named.sort_unstable();
        assert_eq!(named, served);
    }

    #[test]
    fn resource_is_an_id_and_nothing_else() {
        let id = "0123456789abcdef".repeat(4);
        assert_eq!(resource(&format!("/v1/plans/{id}")), id);
        assert_eq!(resource(&format!("/v1/operations/{id}:cancel")), id);
        for path in ["/v1/step", "/", "", &format!("/v1/plans/vbar_{id}"), "/v1/plans/00ff"] {
            assert_eq!(resource(path), "", "{path}");
        }
    }

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
            (Method::GET, "/metrics", "metrics"),
            (Method::GET, "/openapi.json", "openapi"),
            (Method::DELETE, "/v1/operations/00ff", "DeleteOperation"),
            (Method::DELETE, "/v1/operations/00ff%3Awatch", "unknown"),
            (Method::GET, "/v1/%6fperations", "unknown"),
            (Method::GET, "/", "unknown"),
        ] {
            assert_eq!(known_method(&method, path), label, "{method} {path}");
        }
    }
}
