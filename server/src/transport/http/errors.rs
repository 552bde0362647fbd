//! Errors as `google.rpc.Status` JSON with the right HTTP code.

use std::time::Duration;

use axum::{
    body::Body,
    extract::Request,
    response::{IntoResponse as _, Response},
};
use http::{HeaderValue, StatusCode, header};
use serde_json::{Value, json};

use super::JSON;
use crate::{
    service::{Code, Error},
    telemetry::RequestId,
    transport::AnsweredWith,
    wire::ERROR_DOMAIN,
};

/// An error and how HTTP says it.
#[derive(Debug)]
pub(super) struct HttpError {
    status: StatusCode,
    error: Error,
    allow: Option<&'static str>,
}

impl From<Error> for HttpError {
    fn from(error: Error) -> Self {
        let status = match error.code {
            Code::InvalidArgument | Code::FailedPrecondition | Code::OutOfRange => {
                StatusCode::BAD_REQUEST
            }
            Code::NotFound => StatusCode::NOT_FOUND,
            Code::AlreadyExists => StatusCode::CONFLICT,
            Code::PermissionDenied => StatusCode::FORBIDDEN,
            Code::Unauthenticated => StatusCode::UNAUTHORIZED,
            Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
            // Nobody is left to read it; the number is the customary one.
            Code::Cancelled => StatusCode::from_u16(499).unwrap_or(StatusCode::BAD_REQUEST),
            Code::DeadlineExceeded => StatusCode::GATEWAY_TIMEOUT,
            Code::Unimplemented => StatusCode::NOT_IMPLEMENTED,
            Code::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
            Code::Internal | Code::DataLoss => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self { status, error, allow: None }
    }
}

impl HttpError {
    fn with(status: StatusCode, code: Code, reason: &'static str, message: String) -> Self {
        Self { status, error: Error::new(code, reason, message), allow: None }
    }

    /// The same, as a request with a `Range` header is told.
    pub(super) fn of_a_range(error: Error) -> Self {
        match error.code {
            Code::OutOfRange => {
                Self { status: StatusCode::RANGE_NOT_SATISFIABLE, error, allow: None }
            }
            _ => error.into(),
        }
    }

    pub(super) fn too_large(largest: usize) -> Self {
        let message = format!("the request is larger than the {largest} bytes allowed");
        Self::with(StatusCode::PAYLOAD_TOO_LARGE, Code::OutOfRange, "REQUEST_TOO_LARGE", message)
    }

    pub(super) fn too_slow(longest: Duration) -> Self {
        let message = format!("the request's body did not arrive within {longest:?}");
        Self::with(StatusCode::REQUEST_TIMEOUT, Code::DeadlineExceeded, "REQUEST_TOO_SLOW", message)
    }

    pub(super) fn unsupported(header: &str, expected: &str, got: &str) -> Self {
        let error = Error::field(header, expected, if got.is_empty() { "nothing" } else { got });
        Self { status: StatusCode::UNSUPPORTED_MEDIA_TYPE, error, allow: None }
    }

    pub(super) fn method_not_allowed(allow: &'static str) -> Self {
        let message = format!("the path exists, but not for this method; it allows {allow}");
        let error = Error::new(Code::Unimplemented, "METHOD_NOT_ALLOWED", message);
        Self { status: StatusCode::METHOD_NOT_ALLOWED, error, allow: Some(allow) }
    }

    /// The text of the response.
    pub(super) fn body(&self, id: &RequestId) -> String {
        body(&self.error, id).to_string()
    }

    /// The response, for the request `id`.
    pub(super) fn render(self, id: &RequestId) -> Response {
        let body = self.body(id);
        let mut response = (self.status, [(header::CONTENT_TYPE, JSON)], body).into_response();
        response.extensions_mut().insert(AnsweredWith(self.error.code.number()));
        let headers = response.headers_mut();
        if self.status == StatusCode::UNAUTHORIZED {
            let scheme = HeaderValue::from_static("Bearer realm=\"vbar\"");
            headers.insert(header::WWW_AUTHENTICATE, scheme);
        }
        if let Some(allow) = self.allow {
            headers.insert(header::ALLOW, HeaderValue::from_static(allow));
        }
        if let Some(delay) = self.error.retry_after {
            // The header knows whole seconds only; the body is exact.
            let seconds = delay.as_secs_f64().ceil().max(1.0);
            if let Ok(value) = HeaderValue::from_str(&format!("{seconds}")) {
                headers.insert(header::RETRY_AFTER, value);
            }
        }
        response
    }
}

/// `google.rpc.Status` in JSON, with the same details as over gRPC.
fn body(error: &Error, id: &RequestId) -> Value {
    const TYPES: &str = "type.googleapis.com/google.rpc";
    let mut details = vec![
        json!({
            "@type": format!("{TYPES}.ErrorInfo"),
            "reason": error.reason,
            "domain": ERROR_DOMAIN,
            "metadata": { "trace_id": id.trace_id().as_str() },
        }),
        json!({ "@type": format!("{TYPES}.RequestInfo"), "requestId": &*id.0 }),
    ];
    if !error.violations.is_empty() {
        let violations: Vec<_> = error
            .violations
            .iter()
            .map(|violation| {
                json!({
                    "field": violation.path,
                    "description": violation.to_string(),
                    "reason": "INVALID_VALUE",
                })
            })
            .collect();
        details.push(json!({
            "@type": format!("{TYPES}.BadRequest"),
            "fieldViolations": violations,
        }));
    }
    if let Some(delay) = error.retry_after {
        let delay = format!("{:.3}s", delay.as_secs_f64());
        details.push(json!({ "@type": format!("{TYPES}.RetryInfo"), "retryDelay": delay }));
    }
    json!({ "code": error.code.number(), "message": error.message, "details": details })
}

/// The path exists for other methods; the router adds which.
pub(super) async fn method_not_allowed(request: Request<Body>) -> Response {
    let message = format!("the path exists, but not for {}", request.method());
    HttpError::with(
        StatusCode::METHOD_NOT_ALLOWED,
        Code::Unimplemented,
        "METHOD_NOT_ALLOWED",
        message,
    )
    .render(&request_id(&request))
}

/// The request is not let in.
pub(in crate::transport) fn refused(error: Error, id: &RequestId) -> Response {
    HttpError::from(error).render(id)
}

/// The path does not exist.
pub(in crate::transport) fn unknown_path(request: &Request<Body>) -> Response {
    let path: String = request.uri().path().chars().take(200).collect();
    let message = format!("{path:?} is not a path of this server; /openapi.json lists them");
    HttpError::with(StatusCode::NOT_FOUND, Code::NotFound, "PATH_UNKNOWN", message)
        .render(&request_id(request))
}

fn request_id(request: &Request<Body>) -> RequestId {
    request.extensions().get().cloned().unwrap_or_else(RequestId::fresh)
}
