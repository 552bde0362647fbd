//! The methods: one folder each, one trait, one list.

pub mod abort_safe;
mod canonical;
pub mod disturbance_feedback;
pub mod offline_sampling;
mod shard;
pub mod variable_horizon;
mod verdict;

pub use verdict::{
    Certificate, Claim, ConstraintFamily, ConstraintMargin, Infeasibility, ProofRow, Relaxation,
};

use crate::{
    budget::{Budget, Interruption},
    bytes::Reader,
    reach::ReadError,
};

/// The one list of methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// Variable-horizon tube MPC and its baselines.
    VariableHorizon,
    /// Fixed-time rendezvous plans with disturbance feedback.
    DisturbanceFeedback,
    /// Rendezvous that can be aborted at every step.
    AbortSafe,
    /// Stochastic MPC sampled offline, and its baselines.
    OfflineSampling,
}

impl Method {
    /// Every method.
    pub const ALL: [Self; 4] =
        [Self::VariableHorizon, Self::DisturbanceFeedback, Self::AbortSafe, Self::OfflineSampling];

    /// Name on the wire and in identifiers.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::VariableHorizon => "variable_horizon",
            Self::DisturbanceFeedback => "disturbance_feedback",
            Self::AbortSafe => "abort_safe",
            Self::OfflineSampling => "offline_sampling",
        }
    }

    /// Version of the mathematics: raised when the same problem can give different bytes.
    #[must_use]
    pub const fn version(self) -> &'static str {
        match self {
            Self::VariableHorizon => variable_horizon::VERSION,
            Self::DisturbanceFeedback => disturbance_feedback::VERSION,
            Self::AbortSafe => abort_safe::VERSION,
            Self::OfflineSampling => offline_sampling::VERSION,
        }
    }
}

/// Folders of methods whose mathematics stands here and that no node serves yet: contract, wire and
/// missions are to come. A served method leaves this list for [`Method`]; `tidy` knows both.
pub const NOT_YET_SERVED: [&str; 0] = [];

/// A method: think long once (`prepare` in shards, then `merge`), then decide fast many times.
///
/// The pure core knows no threads: whoever runs the shards, on one thread, many or many machines,
/// merges them in shard order and gets the same artifact.
pub trait Controller {
    /// The mission.
    type Problem;
    /// Part of an artifact that can be computed on its own.
    type Shard;
    /// Everything that can be known before flight.
    type Artifact;
    /// What one step hands to the next.
    type State;
    /// What was measured.
    type Measurement;
    /// The decision and its proof.
    type Answer;

    /// About the most bytes that a precompute and what it makes take, from dimensions alone, so
    /// that nothing has to be spent to know it.
    fn memory_bytes(problem: &Self::Problem) -> usize;

    /// Number of independent shards of a precompute, at least 1.
    fn shards(problem: &Self::Problem) -> usize;

    /// Computes one shard.
    ///
    /// # Errors
    /// [`PrepareError`]: faults of the problem, or a [`Failure`].
    fn run_shard(
        problem: &Self::Problem,
        shard: usize,
        budget: Budget<'_>,
    ) -> Result<Self::Shard, PrepareError>;

    /// Bytes of a shard, for whoever merges it elsewhere.
    fn shard_to_bytes(problem: &Self::Problem, shard: &Self::Shard) -> Vec<u8>;

    /// Reads what [`Controller::shard_to_bytes`] wrote, bit by bit.
    ///
    /// # Errors
    /// [`DecodeError`](crate::bytes::DecodeError) for anything else: bytes that were changed, a
    /// shard of another problem, of another method or of another version of it; the interruption of
    /// the budget.
    fn shard_from_bytes(
        problem: &Self::Problem,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Self::Shard, ReadError>;

    /// Puts shards, in their order, together; this can be long work too.
    ///
    /// # Errors
    /// As [`Controller::run_shard`]; [`Failure::Numerical`] if they are not all, each once.
    fn merge(
        problem: &Self::Problem,
        shards: Vec<Self::Shard>,
        budget: Budget<'_>,
    ) -> Result<Self::Artifact, PrepareError>;

    /// The state before the first step.
    fn start(artifact: &Self::Artifact) -> Self::State;

    /// Decides the next command: a pure function of its arguments.
    ///
    /// # Errors
    /// [`StepError`]: a measurement or state that does not fit, or a [`Failure`].
    fn step(
        artifact: &Self::Artifact,
        state: &Self::State,
        measurement: &Self::Measurement,
        budget: Budget<'_>,
    ) -> Result<Self::Answer, StepError>;
}

/// We could not answer; not the caller's fault.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Failure {
    /// Stopped from outside before any certified answer was found.
    #[error("stopped before an answer was found: {0:?}")]
    Interrupted(Interruption),
    /// Every solver reported trouble, or an answer did not pass its own verification.
    #[error("numerical failure: {0}")]
    Numerical(String),
}

impl From<Interruption> for Failure {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// Something in a problem that only the mathematics can see to be wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// Field of the problem, as the wire names it within the method's message, such as
    /// `gain.explicit` or `hill.disturbance`.
    pub field: String,
    /// What would be right.
    pub expected: String,
    /// What was found.
    pub got: String,
}

impl Fault {
    /// A fault of `field`.
    pub fn new(
        field: impl Into<String>,
        expected: impl Into<String>,
        got: impl Into<String>,
    ) -> Self {
        Self { field: field.into(), expected: expected.into(), got: got.into() }
    }
}

/// Why no artifact was made.
#[derive(Debug, Clone, PartialEq)]
pub enum PrepareError {
    /// The problem is at fault; all that was found.
    Faults(Vec<Fault>),
    /// No controller of this kind exists for the problem.
    Infeasible(Infeasibility),
    /// We are.
    Failure(Failure),
}

/// Why no step was decided.
#[derive(Debug, Clone, PartialEq)]
pub enum StepError {
    /// The measurement does not fit the artifact; fields are relative to the measurement.
    Measurement(Vec<Fault>),
    /// The controller state does not fit the artifact.
    State(String),
    /// More steps went by without a measurement than the last answer planned commands for: what
    /// was flown since is not known.
    PlanExhausted {
        /// Steps without a measurement.
        missed: usize,
        /// Commands that the last answer planned beyond its own.
        commands_left: usize,
    },
    /// We are at fault.
    Failure(Failure),
}

/// What was read is prepared again: that fails for what the bytes say, or because time is over.
fn unread(error: PrepareError, reader: &Reader<'_>) -> ReadError {
    match error {
        PrepareError::Failure(Failure::Interrupted(why)) => why.into(),
        PrepareError::Failure(Failure::Numerical(what)) => reader.fault(what).into(),
        PrepareError::Infeasible(why) => reader.fault(why.reason).into(),
        PrepareError::Faults(faults) => {
            let said = |f: &Fault| format!("{}: {}, got {}", f.field, f.expected, f.got);
            let first = faults.first().map(said);
            reader.fault(first.unwrap_or_default()).into()
        }
    }
}

impl From<Failure> for StepError {
    fn from(failure: Failure) -> Self {
        Self::Failure(failure)
    }
}

impl From<Interruption> for StepError {
    fn from(interruption: Interruption) -> Self {
        Self::Failure(interruption.into())
    }
}

impl From<Failure> for PrepareError {
    fn from(failure: Failure) -> Self {
        Self::Failure(failure)
    }
}

impl From<Interruption> for PrepareError {
    fn from(interruption: Interruption) -> Self {
        Self::Failure(interruption.into())
    }
}
