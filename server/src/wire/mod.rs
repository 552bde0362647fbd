//! The door: messages become values of the mathematics, once, with every fault named by field;
//! answers become messages. The only room that knows both `vbar_proto` and `vbar_guidance`.
//!
//! Nothing is repaired here. A value is taken as it is or refused; where a message leaves a choice
//! to the server, the `.proto` file says which one is made.

mod abort_safe;
mod artifacts;
mod build;
mod calls;
mod controller_state;
mod disturbance_feedback;
mod export;
#[cfg(all(test, target_os = "linux"))]
mod interruption;
#[cfg(test)]
mod memory;
mod methods;
mod offline_sampling;
mod operations;
mod orbits;
mod paging;
mod types;
mod variable_horizon;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use build::{BUILD, Build};

pub(crate) use abort_safe::{ReportAnswer, ReportCall, ReportFault};
pub(crate) use artifacts::{
    ArtifactAnswer, ArtifactCall, ArtifactsAnswer, ArtifactsCall, DownloadAnswer, DownloadCall,
    StoredArtifact,
};
pub(crate) use calls::{
    Controller, DecidedStep, ExportCall, InfoAnswer, InfoCall, KeptPlanAnswer, KeptPlanCall,
    PlanAnswer, PlanCall, PlanResult, PlansAnswer, PlansCall, StepAnswer, StepCall, StreamCall,
    UploadAnswer, UploadCall,
};
pub(crate) use controller_state::{ControllerState, StateFault};
pub(crate) use disturbance_feedback::Claimed;
pub(crate) use export::{Document, Missing, OcmBurn, OcmFault, Order, Unwritten, read_ocm_burns};
pub(crate) use methods::{
    Artifact, Candidate, InTime, PlanVerdict, Planning, Problem, Shard, SolverWork, State, Step,
    Unread, Unverified, VerdictKind,
};
use methods::{Wired, same_for_every_method};
pub(crate) use operations::{
    ERROR_DOMAIN, Failure, NamedBy, NoArtifact, OperationAnswer, OperationFilter, OperationName,
    OperationOutcome, OperationsAnswer, OperationsCall, PrecomputeCall, Progress, Standing,
    WaitCall, problem_again,
};
pub(crate) use types::{ArtifactId, ElapsedAndState, Provenance};
pub(crate) use vbar_guidance::control::disturbance_feedback::INSTANTS_MAX as PLAN_INSTANTS_MAX;

/// Limits on what a request may ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Longest horizon.
    pub horizon_max: usize,
    /// Most generators of a disturbance set.
    pub generators_max: usize,
    /// Most state components of a general linear plant.
    pub states_max: usize,
    /// Most inputs of a general linear plant.
    pub inputs_max: usize,
    /// Longest mission, steps.
    pub steps_max: usize,
    /// Most rows of a polytope.
    pub polytope_rows_max: usize,
    /// Most instants of a plan with disturbance feedback.
    pub plan_instants_max: usize,
    /// Most states of a safety report.
    pub report_states_max: usize,
    /// Most rows that samples may make.
    pub sampled_rows_max: usize,
    /// Most vertices of an uncertain plant.
    pub plant_vertices_max: usize,
    /// Most memory that a problem may take, as estimated from its dimensions.
    pub problem_bytes_max: usize,
}

impl Default for Limits {
    /// Well above the published missions (horizon 122, 6 states, 12 generators, 20 instants), well
    /// below what would occupy a compute thread for minutes.
    fn default() -> Self {
        Self {
            horizon_max: 500,
            generators_max: 48,
            states_max: 12,
            inputs_max: 6,
            steps_max: 10_000,
            polytope_rows_max: 64,
            plan_instants_max: PLAN_INSTANTS_MAX,
            report_states_max: 2000,
            sampled_rows_max: 2_000_000,
            plant_vertices_max: 64,
            problem_bytes_max: 1 << 30,
        }
    }
}

/// A value that can be read from a message.
pub(crate) trait Parse: Sized {
    /// The message.
    type Message;

    /// Reads `message`, which stands at `path`; `None` after at least one violation was recorded.
    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self>;
}

/// A value that can be written as a message.
pub(crate) trait Render {
    /// The message.
    type Message;

    /// Writes it.
    fn render(&self) -> Self::Message;
}

/// Reads a whole request.
///
/// # Errors
/// Every violation found.
pub(crate) fn parse<T: Parse>(message: &T::Message, limits: &Limits) -> Result<T, Violations> {
    let mut door = Door { limits: *limits, violations: Vec::new() };
    match T::parse(message, Path::ROOT, &mut door) {
        Some(value) if door.violations.is_empty() => Ok(value),
        _ => Err(Violations(door.violations)),
    }
}

/// One fault of a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Violation {
    /// Where: field names as in the `.proto` files, joined by dots, with indices in brackets.
    pub(crate) path: String,
    /// What would have been right.
    pub(crate) expected: String,
    /// What was found.
    pub(crate) got: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "expected {}, got {}", self.expected, self.got)
    }
}

/// Every fault of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Violations(pub(crate) Vec<Violation>);

impl Violations {
    /// Faults that only the mathematics saw, under the path of the method's message.
    pub(crate) fn under(prefix: &str, faults: Vec<vbar_guidance::control::Fault>) -> Self {
        let place = |field: &str| match (prefix, field) {
            (prefix, "") => prefix.to_owned(),
            ("", field) => field.to_owned(),
            (prefix, field) => format!("{prefix}.{field}"),
        };
        Self(
            faults
                .into_iter()
                .map(|fault| Violation {
                    path: place(&fault.field),
                    expected: fault.expected,
                    got: fault.got,
                })
                .collect(),
        )
    }
}

/// What a parser needs: the limits, and the place where faults are written down.
#[derive(Debug)]
pub(crate) struct Door {
    limits: Limits,
    violations: Vec<Violation>,
}

impl Door {
    /// Records a fault; returns `None` so that a parser can end with it.
    fn refuse<T>(
        &mut self,
        path: Path<'_>,
        expected: impl Into<String>,
        got: impl fmt::Display,
    ) -> Option<T> {
        // A request of 4 MB can be wrong in 500,000 places; nobody reads more than these.
        const VIOLATIONS_MAX: usize = 100;
        if self.violations.len() < VIOLATIONS_MAX {
            self.violations.push(Violation {
                path: path.to_string(),
                expected: expected.into(),
                got: got.to_string(),
            });
        }
        None
    }

    /// A field that must be present.
    fn required<'m, T>(&mut self, field: &'m Option<T>, path: Path<'_>) -> Option<&'m T> {
        match field {
            Some(value) => Some(value),
            None => self.refuse(path, "a value (the field is required)", "nothing"),
        }
    }

    /// Parses a required message.
    fn message<T: Parse>(&mut self, field: &Option<T::Message>, path: Path<'_>) -> Option<T> {
        let message = self.required(field, path)?;
        T::parse(message, path, self)
    }

    /// Parses a message that may be absent: `Some(None)` if it is, `None` if it is wrong.
    #[allow(clippy::option_option, reason = "absent and wrong are different things here")]
    fn optional<T: Parse>(
        &mut self,
        field: &Option<T::Message>,
        path: Path<'_>,
    ) -> Option<Option<T>> {
        match field {
            None => Some(None),
            Some(message) => T::parse(message, path, self).map(Some),
        }
    }
}

/// Where a value stands in a request; text is made of it only when it is at fault.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Path<'a> {
    parent: Option<&'a Path<'a>>,
    segment: Segment,
}

#[derive(Debug, Clone, Copy)]
enum Segment {
    Root,
    Field(&'static str),
    Index(usize),
}

impl Path<'_> {
    /// The request itself.
    const ROOT: Self = Self { parent: None, segment: Segment::Root };

    /// A field of the message at this path.
    fn field(&self, name: &'static str) -> Path<'_> {
        Path { parent: Some(self), segment: Segment::Field(name) }
    }

    /// An element of the list at this path.
    fn index(&self, index: usize) -> Path<'_> {
        Path { parent: Some(self), segment: Segment::Index(index) }
    }
}

impl fmt::Display for Path<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(parent) = self.parent else { return Ok(()) };
        parent.fmt(f)?;
        match self.segment {
            Segment::Root => Ok(()),
            Segment::Field(name) if parent.parent.is_none() => f.write_str(name),
            Segment::Field(name) => write!(f, ".{name}"),
            Segment::Index(index) => write!(f, "[{index}]"),
        }
    }
}

/// Counts on the wire are `int32`; ours never come near its end, and say so if they do.
fn count(value: usize) -> i32 {
    i32::try_from(value).unwrap_or(i32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn path_reads_like_the_message() {
        let problem = Path::ROOT.field("problem");
        let method = problem.field("variable_horizon");
        let gain = method.field("gain");
        let poles = gain.field("poles");
        let values = poles.field("values");
        let poles = values.index(3).to_string();
        assert_eq!(poles, "problem.variable_horizon.gain.poles.values[3]");
        assert_eq!(Path::ROOT.to_string(), "");
    }

    #[test]
    fn violations_are_bounded() {
        let mut door = Door { limits: Limits::default(), violations: Vec::new() };
        for i in 0..1000 {
            let _: Option<()> = door.refuse(Path::ROOT.index(i), "less", "more");
        }
        assert_eq!(door.violations.len(), 100);
    }
}
