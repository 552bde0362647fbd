//! Why the command ends with another code than 0.

use std::fmt;

use vbar_client::{Code, Error};

/// A comparison found a difference.
const DIFFERENT: u8 = 1;
/// Wrong command line or configuration.
pub(crate) const USAGE: u8 = 64;
/// A file that makes no sense, or a request that a node refused.
const DATA: u8 = 65;
/// A node that does not answer.
const UNAVAILABLE: u8 = 69;
/// A fault of ours.
const SOFTWARE: u8 = 70;
/// A file that cannot be written.
const CANNOT_WRITE: u8 = 73;

/// Ctrl-C, as shells say it: 128 and the number of the signal.
const INTERRUPTED: u8 = 130;

/// What to say, and the exit code.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: u8,
    message: String,
}

impl Failure {
    pub(crate) fn different(message: impl Into<String>) -> Self {
        Self { code: DIFFERENT, message: message.into() }
    }

    pub(crate) fn usage(message: impl Into<String>) -> Self {
        Self { code: USAGE, message: message.into() }
    }

    pub(crate) fn data(message: impl Into<String>) -> Self {
        Self { code: DATA, message: message.into() }
    }

    pub(crate) fn unavailable(message: impl Into<String>) -> Self {
        Self { code: UNAVAILABLE, message: message.into() }
    }

    pub(crate) fn ours(message: impl Into<String>) -> Self {
        Self { code: SOFTWARE, message: message.into() }
    }

    pub(crate) fn cannot_write(message: impl Into<String>) -> Self {
        Self { code: CANNOT_WRITE, message: message.into() }
    }

    pub(crate) fn interrupted(message: impl Into<String>) -> Self {
        Self { code: INTERRUPTED, message: message.into() }
    }

    /// The same, about a file.
    pub(crate) fn in_file(self, path: &str) -> Self {
        Self { message: format!("{path}: {}", self.message), ..self }
    }

    /// The same, in run number `run` of a campaign.
    pub(crate) fn in_run(self, run: u32) -> Self {
        Self { message: format!("run {run}: {}", self.message), ..self }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let code = match error.code {
            Code::Unavailable | Code::DeadlineExceeded | Code::ResourceExhausted => UNAVAILABLE,
            Code::Internal | Code::Unknown => SOFTWARE,
            _ => DATA,
        };
        let trace = error.trace_id.as_deref().map(|id| format!("\n  request id: {id}"));
        Self { code, message: format!("{error}{}", trace.unwrap_or_default()) }
    }
}
