//! What can go wrong, in the words of the node that said so.

use std::{error::Error as _, time::Duration};

use prost::Message;
use tonic::{Code, Status, TimeoutExpired};
use tonic_types::StatusExt;
use vbar_proto::google::rpc;

/// Header and error detail by which a node names the call in its own records.
const REQUEST_ID: &str = "x-request-id";

/// A call that was not answered.
///
/// Infeasible missions are not among them: those are answers.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{code:?}: {message}{}", listed(violations))]
pub struct Error {
    /// Who is at fault, as gRPC says it.
    pub code: Code,
    /// For people.
    pub message: String,
    /// Every field of the request that was refused.
    pub violations: Vec<FieldViolation>,
    /// How long the node asked to be left alone.
    pub retry_after: Option<Duration>,
    /// Name of the call in the node's records, to quote in a bug report.
    pub trace_id: Option<String>,
}

/// One refused field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldViolation {
    /// Path of the field within the request.
    pub field: String,
    /// What was expected and what was got.
    pub description: String,
}

impl Error {
    /// An error found on this side of the wire.
    pub(crate) fn local(code: Code, message: impl Into<String>) -> Self {
        Self {
            code,
            message: message.into(),
            violations: Vec::new(),
            retry_after: None,
            trace_id: None,
        }
    }

    /// The node answered something the contract does not allow.
    pub(crate) fn broken_contract(what: &str) -> Self {
        Self::local(Code::Internal, format!("the node's answer breaks the contract: {what}"))
    }

    /// The same call may be answered if it is sent again.
    #[must_use]
    pub fn is_retryable(&self) -> bool {
        self.code == Code::Unavailable
    }
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        let details = status.get_error_details();
        let violations = details.bad_request().map_or_else(Vec::new, |bad| {
            let violations = bad.field_violations.iter();
            violations
                .map(|v| FieldViolation {
                    field: v.field.clone(),
                    description: v.description.clone(),
                })
                .collect()
        });
        let trace_id = match details.request_info() {
            Some(info) => Some(info.request_id.clone()),
            None => status.metadata().get(REQUEST_ID).and_then(|v| v.to_str().ok()).map(Into::into),
        };
        Self {
            code: code_of(&status),
            message: message_of(&status),
            violations,
            retry_after: details.retry_info().and_then(|info| info.retry_delay),
            trace_id,
        }
    }
}

/// The same model travels inside streams and operations.
impl From<rpc::Status> for Error {
    fn from(status: rpc::Status) -> Self {
        let details = status.encode_to_vec();
        let code = Code::from_i32(status.code);
        Status::with_details(code, status.message, details.into()).into()
    }
}

/// A status that came over the wire has no source; one with a source was made on this side, from
/// a connection that broke (`tonic` says `Unknown`, or `Internal` after a farewell frame) or from
/// a timeout (`Cancelled`).
fn code_of(status: &Status) -> Code {
    match (status.code(), status.source()) {
        (Code::Unknown | Code::Internal, Some(_)) => Code::Unavailable,
        (Code::Cancelled, Some(source)) if caused_by_timeout(source) => Code::DeadlineExceeded,
        // Who cancels a call does not wait for its answer: the node let go of it, and ends.
        (Code::Cancelled, Some(_)) => Code::Unavailable,
        (code, _) => code,
    }
}

/// The message with what lies beneath it: "transport error" alone helps nobody.
fn message_of(status: &Status) -> String {
    let mut message = status.message().to_owned();
    let mut cause = status.source();
    while let Some(inner) = cause {
        let text = inner.to_string();
        if !message.contains(&text) {
            message.push_str(": ");
            message.push_str(&text);
        }
        cause = inner.source();
    }
    message
}

fn caused_by_timeout(error: &(dyn std::error::Error + 'static)) -> bool {
    let mut cause = Some(error);
    while let Some(inner) = cause {
        if inner.is::<TimeoutExpired>() {
            return true;
        }
        cause = inner.source();
    }
    false
}

fn listed(violations: &[FieldViolation]) -> String {
    let mut text = String::new();
    for violation in violations {
        text.push_str("\n  ");
        text.push_str(&violation.field);
        text.push_str(": ");
        text.push_str(&violation.description);
    }
    text
}
