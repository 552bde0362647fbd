//! Errors by owner: the caller, the moment, or us.

use std::time::Duration;

use vbar_guidance::{
    Interruption,
    control::{Failure, PrepareError, StepError},
};

use crate::{
    access::Refusal,
    compute::ComputeError,
    store::StoreError,
    wire::{self, Missing, ReportFault, StateFault, Unverified, Unwritten, Violation, Violations},
};

/// There is no room in the store.
pub(super) const STORE_FULL: &str = "STORE_FULL";

/// The codes of `google.rpc.Code` that this service answers with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Code {
    Cancelled,
    InvalidArgument,
    DeadlineExceeded,
    NotFound,
    AlreadyExists,
    PermissionDenied,
    ResourceExhausted,
    FailedPrecondition,
    OutOfRange,
    Unimplemented,
    Internal,
    Unavailable,
    DataLoss,
    Unauthenticated,
}

impl Code {
    /// Its number.
    pub(crate) fn number(self) -> i32 {
        match self {
            Self::Cancelled => 1,
            Self::InvalidArgument => 3,
            Self::DeadlineExceeded => 4,
            Self::NotFound => 5,
            Self::AlreadyExists => 6,
            Self::PermissionDenied => 7,
            Self::ResourceExhausted => 8,
            Self::FailedPrecondition => 9,
            Self::OutOfRange => 11,
            Self::Unimplemented => 12,
            Self::Internal => 13,
            Self::Unavailable => 14,
            Self::DataLoss => 15,
            Self::Unauthenticated => 16,
        }
    }
}

/// Why a call was not answered.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Error {
    /// Its code.
    pub(crate) code: Code,
    /// The machine's name for the reason, `UPPER_SNAKE`.
    pub(crate) reason: &'static str,
    /// For people.
    pub(crate) message: String,
    /// Faulty fields, all of them.
    pub(crate) violations: Vec<Violation>,
    /// When to ask again.
    pub(crate) retry_after: Option<Duration>,
}

impl Error {
    /// An error without details.
    pub(crate) fn new(code: Code, reason: &'static str, message: impl Into<String>) -> Self {
        let message = message.into();
        Self { code, reason, message, violations: Vec::new(), retry_after: None }
    }

    /// One faulty field.
    pub(crate) fn field(path: &str, expected: &str, got: &str) -> Self {
        Violations(vec![Violation {
            path: path.to_owned(),
            expected: expected.to_owned(),
            got: got.to_owned(),
        }])
        .into()
    }

    /// Our bug, or the machine's; details go to the log, the caller gets the request id.
    pub(crate) fn internal(reason: &'static str, detail: &str) -> Self {
        tracing::error!(reason, detail, "internal error");
        Self::new(Code::Internal, reason, "internal error; the request id finds it in the log")
    }

    /// A document needs what the mission does not have.
    pub(crate) fn missing(Missing(fields): Missing) -> Self {
        let message = format!("the mission lacks what this format needs: {}", fields.join(", "));
        let violation = |path: &str| Violation {
            path: path.to_owned(),
            expected: "a value (this format needs it)".to_owned(),
            got: "nothing".to_owned(),
        };
        Self {
            violations: fields.into_iter().map(violation).collect(),
            ..Self::new(Code::FailedPrecondition, "MISSION_LACKS_FIELDS", message)
        }
    }

    /// The mathematics found the problem at fault, or failed. `prefix` is where the method's
    /// message stands in the request.
    pub(crate) fn prepare(prefix: &str, fault: PrepareError) -> Self {
        match fault {
            PrepareError::Faults(faults) => Violations::under(prefix, faults).into(),
            PrepareError::Failure(failure) => failure.into(),
            PrepareError::Infeasible(why) => Self::internal("INFEASIBILITY_LOST", &why.reason),
        }
    }

    /// The same for a step; `prefix` is where the measurement stands.
    pub(crate) fn step(prefix: &str, fault: StepError) -> Self {
        match fault {
            StepError::Measurement(faults) => Violations::under(prefix, faults).into(),
            StepError::State(what) => StateFault::Payload(what).into(),
            StepError::PlanExhausted { missed, commands_left } => {
                let message = format!(
                    "{missed} steps were missed, but the last answer planned only {commands_left} \
                     commands beyond its own: what was flown since is not known. Start a new \
                     mission from this measurement"
                );
                Self::new(Code::FailedPrecondition, "PLAN_EXHAUSTED", message)
            }
            StepError::Failure(failure) => failure.into(),
        }
    }
}

impl From<Violations> for Error {
    fn from(Violations(violations): Violations) -> Self {
        let message = match violations.as_slice() {
            [one] => format!("{}: {one}", place(&one.path)),
            [first, ..] => format!(
                "{} faults in the request; the first: {}: {first}",
                violations.len(),
                place(&first.path)
            ),
            [] => "the request is at fault".to_owned(),
        };
        Self { violations, ..Self::new(Code::InvalidArgument, "INVALID_REQUEST", message) }
    }
}

impl From<Error> for wire::Failure {
    fn from(error: Error) -> Self {
        Self {
            code: error.code.number(),
            reason: error.reason.to_owned(),
            message: error.message,
            violations: error.violations,
        }
    }
}

fn place(path: &str) -> &str {
    if path.is_empty() { "the request" } else { path }
}

impl From<ReportFault> for Error {
    fn from(fault: ReportFault) -> Self {
        match fault {
            ReportFault::Violations(violations) => violations.into(),
            ReportFault::Interrupted(interruption) => Failure::from(interruption).into(),
            ReportFault::TooLarge(what) => {
                Self::new(Code::ResourceExhausted, "REPORT_TOO_LARGE", what)
            }
        }
    }
}

impl From<Unwritten> for Error {
    fn from(unwritten: Unwritten) -> Self {
        match unwritten {
            Unwritten::Lacks(missing) => Self::missing(missing),
            Unwritten::Interrupted(interruption) => Failure::from(interruption).into(),
        }
    }
}

impl From<Unverified> for Error {
    fn from(unverified: Unverified) -> Self {
        match unverified {
            Unverified::Claims(violations) => violations.into(),
            Unverified::Interrupted(interruption) => Failure::from(interruption).into(),
        }
    }
}

impl From<StateFault> for Error {
    fn from(fault: StateFault) -> Self {
        let message = format!("controller_state does not fit: {fault}");
        Self::new(Code::FailedPrecondition, "CONTROLLER_STATE_MISMATCH", message)
    }
}

impl From<Failure> for Error {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Interrupted(Interruption::Deadline) => ComputeError::Deadline.into(),
            Failure::Interrupted(Interruption::Cancelled) => {
                Self::new(Code::Cancelled, "CANCELLED", "the call was cancelled")
            }
            Failure::Numerical(what) => Self::internal("NUMERICAL_FAILURE", &what),
        }
    }
}

impl From<Refusal> for Error {
    fn from(refusal: Refusal) -> Self {
        let unauthenticated = |reason, message| Self::new(Code::Unauthenticated, reason, message);
        let exhausted = |reason, message, retry_after| Self {
            retry_after: Some(retry_after),
            ..Self::new(Code::ResourceExhausted, reason, message)
        };
        match refusal {
            Refusal::Missing => unauthenticated(
                "CREDENTIAL_MISSING",
                "say who asks: the header authorization: Bearer TOKEN, or a certificate",
            ),
            Refusal::Unreadable => unauthenticated(
                "CREDENTIAL_UNREADABLE",
                "the header authorization is not Bearer and one token",
            ),
            Refusal::Unknown => {
                unauthenticated("CREDENTIAL_UNKNOWN", "this token or certificate is not known here")
            }
            Refusal::Expired => {
                unauthenticated("CREDENTIAL_EXPIRED", "this token or certificate has expired")
            }
            Refusal::Role { caller, call, needs } => {
                let needs = needs.name();
                let message =
                    format!("{call} needs the role {needs}, which {caller} does not have");
                Self::new(Code::PermissionDenied, "ROLE_MISSING", message)
            }
            Refusal::Rate { retry_after } => exhausted(
                "CALLER_RATE",
                "too many requests of this caller; ask again after the time given",
                retry_after,
            ),
            Refusal::Calls { retry_after } => exhausted(
                "CALLER_CALLS",
                "too many calls of this caller are under way; ask again after the time given",
                retry_after,
            ),
        }
    }
}

impl From<ComputeError> for Error {
    fn from(fault: ComputeError) -> Self {
        match fault {
            ComputeError::Busy { retry_after } => Self {
                retry_after: Some(retry_after),
                ..Self::new(
                    Code::ResourceExhausted,
                    "COMPUTE_BUSY",
                    "every compute thread is busy; ask again after the time given",
                )
            },
            ComputeError::Deadline => Self::new(
                Code::DeadlineExceeded,
                "DEADLINE_EXCEEDED",
                "no certified answer was found before the deadline; a problem that takes longer is \
                 for Precompute, whose artifact steps can name",
            ),
            ComputeError::Panicked(what) => Self::internal("PANIC", &what),
        }
    }
}

impl From<StoreError> for Error {
    fn from(fault: StoreError) -> Self {
        match fault {
            StoreError::Damaged { .. } => {
                tracing::error!(%fault, "damaged record");
                Self::new(Code::DataLoss, "ARTIFACT_DAMAGED", fault.to_string())
            }
            StoreError::Full(_) => {
                /// Somebody must make room, or something must expire.
                const RETRY_AFTER: Duration = Duration::from_secs(30);
                tracing::error!(%fault, "store");
                Self {
                    retry_after: Some(RETRY_AFTER),
                    ..Self::new(Code::ResourceExhausted, STORE_FULL, fault.to_string())
                }
            }
            StoreError::Stale { .. }
            | StoreError::InUse(_)
            | StoreError::Io { .. }
            | StoreError::Unreachable(_) => {
                const RETRY_AFTER: Duration = Duration::from_secs(2);
                tracing::error!(%fault, "store");
                let message = "the artifact store does not answer; steps with artifacts that this \
                               node remembers still do";
                Self {
                    retry_after: Some(RETRY_AFTER),
                    ..Self::new(Code::Unavailable, "STORE_UNAVAILABLE", message)
                }
            }
        }
    }
}
