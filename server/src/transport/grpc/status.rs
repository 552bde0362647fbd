//! Errors as gRPC statuses with `google.rpc` details.

use std::{collections::HashMap, time::Duration};

use ::http::Response;
use axum::body::Body;
use prost::Message as _;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt as _};
use vbar_proto::google::rpc;

use crate::{
    service::Error,
    telemetry::RequestId,
    wire::{ERROR_DOMAIN, Violation},
};

/// The status for `error` in the request `id`.
pub(super) fn render(error: Error, id: &RequestId) -> Status {
    let code = Code::from(error.code.number());
    let mut details = ErrorDetails::new();
    details.set_error_info(error.reason, ERROR_DOMAIN, metadata(id));
    details.set_request_info(&*id.0, "");
    if !error.violations.is_empty() {
        let violation = |violation: &Violation| FieldViolation {
            field: violation.path.clone(),
            description: violation.to_string(),
            reason: "INVALID_VALUE".to_owned(),
            localized_message: None,
        };
        details.set_bad_request(error.violations.iter().map(violation).collect::<Vec<_>>());
    }
    if let Some(delay) = error.retry_after {
        details.set_retry_info(Some(delay));
    }
    Status::with_error_details(code, error.message, details)
}

/// The answer to a request that is not let in.
pub(in crate::transport) fn refused(error: Error, id: &RequestId) -> Response<Body> {
    render(error, id).into_http()
}

/// The status of a request whose message did not arrive within `longest`; [`complete`] adds to it
/// what every error says.
pub(in crate::transport) fn too_slow(longest: Duration) -> Status {
    Status::deadline_exceeded(format!("the request's message did not arrive within {longest:?}"))
}

/// What every error says besides its reason: the trace in which it happened.
fn metadata(id: &RequestId) -> HashMap<String, String> {
    HashMap::from([("trace_id".to_owned(), id.trace_id().as_str().to_owned())])
}

/// A status that the gRPC library made itself (a message it could not read, a method it does not
/// know), with the details that our own have.
pub(in crate::transport) fn complete(status: Status, id: &RequestId) -> Status {
    if status.code() == Code::Ok || !status.details().is_empty() {
        return status;
    }
    let reason = match status.code() {
        Code::InvalidArgument => "MALFORMED_MESSAGE",
        Code::OutOfRange => "REQUEST_TOO_LARGE",
        Code::DeadlineExceeded => "REQUEST_TOO_SLOW",
        Code::Unimplemented => "METHOD_UNKNOWN",
        _ => "TRANSPORT",
    };
    let mut details = ErrorDetails::new();
    details.set_error_info(reason, ERROR_DOMAIN, metadata(id));
    details.set_request_info(&*id.0, "");
    Status::with_error_details(status.code(), status.message(), details)
}

/// The same as a message within a stream.
pub(super) fn message(status: &Status) -> rpc::Status {
    // `with_error_details` put a whole `google.rpc.Status` into the details.
    rpc::Status::decode(status.details()).unwrap_or_else(|_| rpc::Status {
        code: status.code().into(),
        message: status.message().to_owned(),
        details: Vec::new(),
    })
}
