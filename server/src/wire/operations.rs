//! Precomputes as long-running operations: what is asked of them, and how they stand.

use std::time::{Duration, SystemTime};

use bytes::Bytes;
use prost::Message as _;
use serde::{Deserialize, Serialize};
use vbar_guidance::control::Infeasibility;
use vbar_proto::{
    google::{longrunning, rpc},
    v1,
};

use super::{
    ArtifactAnswer, ArtifactId, Door, Limits, Parse, Path, Problem, Render, Violation, count,
    paging::{page_size, page_token},
    parse,
};

/// Domain of the reasons in `google.rpc.ErrorInfo`.
pub(crate) const ERROR_DOMAIN: &str = "vbar";

/// `Precompute`.
#[derive(Debug)]
pub(crate) struct PrecomputeCall {
    pub(crate) problem: Problem,
    /// The problem as it came, to be read again by whoever goes on with it.
    pub(crate) message: Bytes,
    /// A UUID in lower case, if there is one.
    pub(crate) request_id: Option<String>,
    pub(crate) validate_only: bool,
}

impl Parse for PrecomputeCall {
    type Message = v1::PrecomputeRequest;

    fn parse(message: &v1::PrecomputeRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let problem = door.message(&message.problem, path.field("problem"));
        let request_id = match message.request_id.as_str() {
            "" => Some(None),
            given if is_uuid(given) => Some(Some(given.to_ascii_lowercase())),
            given => {
                let shown: String = given.chars().take(80).collect();
                door.refuse(path.field("request_id"), "a UUID or nothing", format!("{shown:?}"))
            }
        };
        let asked = message.problem.as_ref().map(v1::Problem::encode_to_vec).unwrap_or_default();
        Some(Self {
            problem: problem?,
            message: asked.into(),
            request_id: request_id?,
            validate_only: message.validate_only,
        })
    }
}

fn is_uuid(text: &str) -> bool {
    text.len() == 36
        && text.bytes().enumerate().all(|(i, c)| match i {
            8 | 13 | 18 | 23 => c == b'-',
            _ => c.is_ascii_hexdigit(),
        })
}

/// Reads again the problem of a [`PrecomputeCall::message`]; limits can have changed since.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn problem_again(message: &[u8], limits: &Limits) -> Result<Problem, Failure> {
    let invalid = |message: String, violations| Failure {
        code: rpc_code::INVALID_ARGUMENT,
        reason: "INVALID_REQUEST".to_owned(),
        message,
        violations,
    };
    let message = v1::Problem::decode(message)
        .map_err(|fault| invalid(format!("the recorded problem: {fault}"), Vec::new()))?;
    parse(&message, limits).map_err(|violations| {
        invalid("the recorded problem is refused now".to_owned(), violations.0)
    })
}

mod rpc_code {
    pub(super) const CANCELLED: i32 = 1;
    pub(super) const INVALID_ARGUMENT: i32 = 3;
    pub(super) const UNAVAILABLE: i32 = 14;
}

/// Why an operation ended without a response.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Failure {
    /// A `google.rpc.Code`.
    pub(crate) code: i32,
    /// For programs, `UPPER_SNAKE`.
    pub(crate) reason: String,
    /// For people.
    pub(crate) message: String,
    /// Faulty fields of the problem.
    pub(crate) violations: Vec<Violation>,
}

impl Failure {
    /// Somebody asked for it.
    pub(crate) fn cancelled() -> Self {
        Self {
            code: rpc_code::CANCELLED,
            reason: "CANCELLED".to_owned(),
            message: "the operation was cancelled".to_owned(),
            violations: Vec::new(),
        }
    }

    /// Whether the problem itself is at fault.
    pub(crate) fn is_invalid_problem(&self) -> bool {
        self.code == rpc_code::INVALID_ARGUMENT
    }

    /// Whether it comes of something that does not answer now and may later.
    pub(crate) fn is_unavailable(&self) -> bool {
        self.code == rpc_code::UNAVAILABLE
    }
}

impl Render for Failure {
    type Message = rpc::Status;

    fn render(&self) -> rpc::Status {
        let info = rpc::ErrorInfo {
            reason: self.reason.clone(),
            domain: ERROR_DOMAIN.to_owned(),
            ..rpc::ErrorInfo::default()
        };
        let mut details = vec![any(&info)];
        if !self.violations.is_empty() {
            let field_violations =
                self.violations.iter().map(|violation| rpc::bad_request::FieldViolation {
                    field: violation.path.clone(),
                    description: violation.to_string(),
                    reason: "INVALID_VALUE".to_owned(),
                });
            details.push(any(&rpc::BadRequest { field_violations: field_violations.collect() }));
        }
        rpc::Status { code: self.code, message: self.message.clone(), details }
    }
}

/// Why no artifact can be made, as it is answered.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NoArtifact(v1::Infeasible);

impl NoArtifact {
    /// `why` in the units of `problem`.
    pub(crate) fn new(problem: &Problem, why: &Infeasibility) -> Self {
        Self(problem.render_infeasible(why))
    }

    /// To be kept.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        self.0.encode_to_vec()
    }

    /// Reads what [`NoArtifact::to_bytes`] wrote.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Option<Self> {
        v1::Infeasible::decode(bytes).ok().map(Self)
    }
}

/// Where an operation stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Standing {
    Queued,
    Running,
    Succeeded,
    Failed,
    Cancelled,
}

impl Standing {
    const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// Whether it can still change.
    pub(crate) fn is_done(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }

    /// In a filter.
    fn name(self) -> &'static str {
        match self {
            Self::Queued => "QUEUED",
            Self::Running => "RUNNING",
            Self::Succeeded => "SUCCEEDED",
            Self::Failed => "FAILED",
            Self::Cancelled => "CANCELLED",
        }
    }

    fn render(self) -> v1::PrecomputeState {
        match self {
            Self::Queued => v1::PrecomputeState::Queued,
            Self::Running => v1::PrecomputeState::Running,
            Self::Succeeded => v1::PrecomputeState::Succeeded,
            Self::Failed => v1::PrecomputeState::Failed,
            Self::Cancelled => v1::PrecomputeState::Cancelled,
        }
    }
}

/// How far an operation has come.
#[derive(Debug, Clone)]
pub(crate) struct Progress {
    pub(crate) id: ArtifactId,
    /// Name of the method.
    pub(crate) method: String,
    pub(crate) standing: Standing,
    pub(crate) shards_done: usize,
    /// At least 1.
    pub(crate) shards_total: usize,
    /// Of everything, parts of shards included, while it is not done.
    pub(crate) fraction: Option<f64>,
    pub(crate) attempts: u32,
    pub(crate) created: SystemTime,
    pub(crate) started: Option<SystemTime>,
    pub(crate) ended: Option<SystemTime>,
    /// When this was seen.
    pub(crate) seen: SystemTime,
}

impl Progress {
    fn phase(&self) -> &'static str {
        match self.standing {
            Standing::Queued => "queued",
            Standing::Running if self.shards_done < self.shards_total => "computing",
            Standing::Running => "merging",
            Standing::Succeeded | Standing::Failed | Standing::Cancelled => "done",
        }
    }

    fn fraction_done(&self) -> f64 {
        match (self.standing, self.fraction) {
            (Standing::Succeeded, _) => 1.0,
            (_, Some(fraction)) => fraction,
            // The merge counts as one more shard.
            (_, None) => {
                f64::from(count(self.shards_done)) / f64::from(count(self.shards_total) + 1)
            }
        }
    }

    /// How long it has run; at least the clock's tick.
    fn run_time_s(&self) -> f64 {
        let until = self.ended.unwrap_or(self.seen);
        let running = self.started.and_then(|started| until.duration_since(started).ok());
        running.unwrap_or_default().max(Duration::from_millis(1)).as_secs_f64()
    }

    /// Shards a second since it runs.
    fn rate(&self) -> f64 {
        f64::from(count(self.shards_done)) / self.run_time_s()
    }

    fn remaining_s(&self) -> Option<f64> {
        let done = self.fraction_done();
        let is_known = self.standing == Standing::Running && done > 0.0;
        is_known.then(|| self.run_time_s() * (1.0 - done) / done)
    }
}

impl Render for Progress {
    type Message = v1::PrecomputeMetadata;

    fn render(&self) -> v1::PrecomputeMetadata {
        v1::PrecomputeMetadata {
            artifact_id: self.id.to_string(),
            fraction_done: self.fraction_done(),
            phase: self.phase().to_owned(),
            state: self.standing.render().into(),
            method: self.method.clone(),
            shards_done: count(self.shards_done),
            shards_total: count(self.shards_total),
            shards_per_s: self.rate(),
            remaining_s: self.remaining_s(),
            create_time: Some(self.created.into()),
            start_time: self.started.map(Into::into),
            end_time: self.ended.map(Into::into),
            attempts: i32::try_from(self.attempts).unwrap_or(i32::MAX),
        }
    }
}

/// An operation.
#[derive(Debug)]
pub(crate) enum OperationAnswer {
    /// The problem was only checked: nothing was started that could be asked for.
    Validated { id: ArtifactId },
    /// A precompute; without an outcome it is under way.
    Precompute { progress: Box<Progress>, outcome: Option<OperationOutcome> },
}

/// What came of an operation.
#[derive(Debug)]
pub(crate) enum OperationOutcome {
    /// The artifact exists.
    Made(ArtifactAnswer),
    /// It cannot exist.
    Infeasible(NoArtifact),
    /// It was not made.
    Failed(Failure),
}

impl Render for OperationAnswer {
    type Message = longrunning::Operation;

    fn render(&self) -> longrunning::Operation {
        use v1::precompute_response::Outcome;
        let (progress, outcome) = match self {
            Self::Validated { id } => {
                let metadata = v1::PrecomputeMetadata {
                    artifact_id: id.to_string(),
                    phase: "validated".to_owned(),
                    ..v1::PrecomputeMetadata::default()
                };
                let metadata = Some(any(&metadata));
                return longrunning::Operation { metadata, ..longrunning::Operation::default() };
            }
            Self::Precompute { progress, outcome } => (progress, outcome),
        };
        let response = |outcome| {
            let response = v1::PrecomputeResponse { outcome: Some(outcome) };
            longrunning::operation::Result::Response(any(&response))
        };
        let result = outcome.as_ref().map(|outcome| match outcome {
            OperationOutcome::Made(made) => response(Outcome::Artifact(made.summary())),
            OperationOutcome::Infeasible(why) => response(Outcome::Infeasible(why.0.clone())),
            OperationOutcome::Failed(failure) => {
                longrunning::operation::Result::Error(failure.render())
            }
        });
        longrunning::Operation {
            name: format!("operations/{}", progress.id),
            metadata: Some(any(&progress.render())),
            done: result.is_some(),
            result,
        }
    }
}

fn any<M: prost::Name>(message: &M) -> prost_types::Any {
    prost_types::Any { type_url: M::type_url(), value: message.encode_to_vec() }
}

/// Names an operation: of `GetOperation`, `CancelOperation`, `DeleteOperation`.
#[derive(Debug)]
pub(crate) struct OperationName {
    pub(crate) id: ArtifactId,
}

impl OperationName {
    fn read(name: &str, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let id = name.strip_prefix("operations/").and_then(ArtifactId::from_hex);
        id.map(|id| Self { id }).or_else(|| {
            let shown: String = name.chars().take(100).collect();
            let expected = "`operations/` and 64 lower-case hexadecimal digits";
            door.refuse(path, expected, format!("{shown:?}"))
        })
    }
}

macro_rules! named_operation {
    ($($message:ident),*) => {$(
        impl From<&longrunning::$message> for NamedBy {
            fn from(message: &longrunning::$message) -> Self {
                Self(message.name.clone())
            }
        }
    )*};
}

/// A request that names an operation and nothing else that matters.
#[derive(Debug)]
pub(crate) struct NamedBy(String);

impl NamedBy {
    /// By the id in a path.
    pub(crate) fn operation(id: &str) -> Self {
        Self(format!("operations/{id}"))
    }
}

named_operation!(GetOperationRequest, CancelOperationRequest, DeleteOperationRequest);

impl Parse for OperationName {
    type Message = NamedBy;

    fn parse(message: &NamedBy, path: Path<'_>, door: &mut Door) -> Option<Self> {
        Self::read(&message.0, path.field("name"), door)
    }
}

/// `WaitOperation`.
#[derive(Debug)]
pub(crate) struct WaitCall {
    pub(crate) operation: OperationName,
    /// Without one, until the call's own deadline.
    pub(crate) timeout: Option<Duration>,
}

impl Parse for WaitCall {
    type Message = longrunning::WaitOperationRequest;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let operation = OperationName::read(&message.name, path.field("name"), door);
        let timeout = match message.timeout {
            None => Some(None),
            Some(timeout) => match Duration::try_from(timeout) {
                Ok(timeout) => Some(Some(timeout)),
                Err(_) => {
                    let got = format!("{} s, {} ns", timeout.seconds, timeout.nanos);
                    door.refuse(path.field("timeout"), "a duration, at least 0", got)
                }
            },
        };
        Some(Self { operation: operation?, timeout: timeout? })
    }
}

/// `ListOperations`.
#[derive(Debug)]
pub(crate) struct OperationsCall {
    pub(crate) filter: OperationFilter,
    pub(crate) page_size: usize,
    pub(crate) after: Option<ArtifactId>,
}

/// Which operations are wanted: those that fit every term.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct OperationFilter(Vec<FilterTerm>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FilterTerm {
    Done(bool),
    Standing(Standing),
}

impl OperationFilter {
    /// Whether an operation that stands so is wanted.
    pub(crate) fn takes(&self, standing: Standing) -> bool {
        self.0.iter().all(|term| match term {
            FilterTerm::Done(done) => standing.is_done() == *done,
            FilterTerm::Standing(wanted) => standing == *wanted,
        })
    }

    fn read(text: &str) -> Option<Self> {
        if text.trim().is_empty() {
            return Some(Self::default());
        }
        let term = |term: &str| {
            let (name, value) = term.split_once('=')?;
            match (name.trim(), value.trim()) {
                ("done", "true") => Some(FilterTerm::Done(true)),
                ("done", "false") => Some(FilterTerm::Done(false)),
                ("state", value) => Standing::ALL
                    .into_iter()
                    .find(|standing| standing.name() == value)
                    .map(FilterTerm::Standing),
                _ => None,
            }
        };
        text.split(" AND ").map(term).collect::<Option<_>>().map(Self)
    }
}

/// Operations on one page unless asked for fewer.
const PAGE_SIZE: usize = 100;

impl Parse for OperationsCall {
    type Message = longrunning::ListOperationsRequest;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let shown = |text: &str| format!("{:?}", text.chars().take(100).collect::<String>());
        let collection = match message.name.as_str() {
            "" | "operations" => Some(()),
            other => door.refuse(path.field("name"), "`operations`", shown(other)),
        };
        let filter = OperationFilter::read(&message.filter).or_else(|| {
            let expected = "`done=true`, `done=false`, `state=QUEUED|RUNNING|SUCCEEDED|FAILED|\
                            CANCELLED`, or several joined by ` AND `";
            door.refuse(path.field("filter"), expected, shown(&message.filter))
        });
        let after = page_token(&message.page_token, path, door);
        let page_size = page_size(message.page_size, PAGE_SIZE, path, door);
        collection?;
        Some(Self { filter: filter?, page_size: page_size?, after: after? })
    }
}

/// Answer of `ListOperations`.
#[derive(Debug)]
pub(crate) struct OperationsAnswer {
    pub(crate) operations: Vec<OperationAnswer>,
    pub(crate) next: Option<ArtifactId>,
}

impl Render for OperationsAnswer {
    type Message = longrunning::ListOperationsResponse;

    fn render(&self) -> Self::Message {
        longrunning::ListOperationsResponse {
            operations: self.operations.iter().map(Render::render).collect(),
            next_page_token: self.next.map(|id| id.to_string()).unwrap_or_default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filter_takes_what_fits_every_term() {
        let taken = |text: &str| {
            let filter = OperationFilter::read(text).expect(text);
            Standing::ALL.into_iter().filter(|s| filter.takes(*s)).map(Standing::name).collect()
        };
        let check = |text: &str, expected: &[&str]| {
            let taken: Vec<&str> = taken(text);
            assert_eq!(taken, expected, "{text:?}");
        };
        check("", &["QUEUED", "RUNNING", "SUCCEEDED", "FAILED", "CANCELLED"]);
        check("done=true", &["SUCCEEDED", "FAILED", "CANCELLED"]);
        check("done = false", &["QUEUED", "RUNNING"]);
        check("state=RUNNING", &["RUNNING"]);
        check("done=true AND state=FAILED", &["FAILED"]);
        check("done=false AND state=FAILED", &[]);
        for bad in ["done", "done=yes", "state=", "state=running", "x=1", "done=true AND", "AND"] {
            assert_eq!(OperationFilter::read(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn progress_says_rate_and_what_remains() {
        let at = |seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        let running = Progress {
            id: ArtifactId([1; 32]),
            method: "variable_horizon".to_owned(),
            standing: Standing::Running,
            shards_done: 4,
            shards_total: 15,
            fraction: Some(0.25),
            attempts: 1,
            created: at(90),
            started: Some(at(100)),
            ended: None,
            seen: at(108),
        };
        let rendered = running.render();
        assert_eq!((rendered.fraction_done, rendered.shards_per_s), (0.25, 0.5));
        assert_eq!((rendered.remaining_s, rendered.phase.as_str()), (Some(24.0), "computing"));
        let merging = Progress { shards_done: 15, ..running.clone() }.render();
        assert_eq!(merging.phase, "merging");
        let fresh = Progress { shards_done: 0, fraction: Some(0.0), ..running.clone() }.render();
        assert_eq!((fresh.remaining_s, fresh.shards_per_s), (None, 0.0));
        let cancelled = Progress {
            standing: Standing::Cancelled,
            fraction: None,
            ended: Some(at(108)),
            seen: at(999),
            ..running.clone()
        };
        let rendered = cancelled.render();
        assert_eq!((rendered.shards_per_s, rendered.fraction_done), (0.5, 0.25));
        assert_eq!((rendered.remaining_s, rendered.phase.as_str()), (None, "done"));
        let made = Progress { standing: Standing::Succeeded, ..cancelled }.render();
        assert_eq!(made.fraction_done, 1.0);
    }
}
