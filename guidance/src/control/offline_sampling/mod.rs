//! Stochastic MPC whose chance constraints are sampled offline.
//!
//! # What it does
//! Drives a linear plant with uncertain matrices and bounded random disturbance to the origin of
//! its coordinates (the target), so that each state constraint holds with a chosen probability
//! and the input constraints always.
//!
//! # Symbols
//! x state, u = K x + v input, v correction, w disturbance, q parameters; T horizon; Q, R, P
//! weights; H_x, H_u, H_T constraints; epsilon violation, delta complement of the confidence;
//! D the sampled set over (x, v), D_R the first-step set.
//!
//! # Offline
//! K, the terminal set (the largest robust invariant one under K), P, the expected cost; then a
//! row of D for every sample and constraint, without redundant ones, part by part
//! ([`Controller::run_shard`]) and then all together; then, if asked for, a robust control
//! invariant set grown from the terminal set, and D_R: every successor lies in it.
//!
//! Two baselines share problem, artifact and step ([`Scheme`]): nothing is sampled for them, and
//! one shard makes the whole artifact.
//!
//! # Online
//! [`Controller::step`]: one dense quadratic program over the corrections (and with a tube over
//! the place of the state in it), u = K x + v_0.
//!
//! # Guarantee and its assumptions
//! If the plants lie in the hull of the vertices and w in its bounds: the input of the present
//! step is within its constraints, and each constraint on later states and inputs, as predicted,
//! holds with probability 1 - epsilon, with confidence 1 - delta for each sampled row, and all
//! together with the confidence that the artifact states ([`Artifact::confidence_statement`]).
//! With a first-step set, from a state with an answer every later step has one too. Where no
//! answer exists all the same, the last plan's tail is flown, clipped, and flagged: it carries no
//! guarantee. [`Scheme::TubeRobust`] keeps every constraint at every step, from any state with an
//! answer; [`Scheme::LinearQuadratic`] promises nothing.
//!
//! # Where we differ from the paper
//! - The constant in z = (x, v, 1) replaces the printed blocks of (7) and appendix A.
//! - State rows of stage 0 are left out unless asked for: they are data, and turn the chance
//!   constraint robust.
//! - C_T is not projected from n + T m dimensions: the first-step set is grown from inside.
//! - Exact removal of redundant rows, or scaled inner sets: removing nearly redundant rows alone
//!   would leave an outer set, with violations.
//! - The paper does not publish its baselines' data. Ours: the expected plant under the same
//!   constraints, and a tube around it into which the plant's uncertainty is lumped.
//!
//! # References
//! \[Mammarella2019\].

mod artifact;
mod conflict;
mod design;
mod encoding;
mod nominal;
mod problem;
mod sampled;
mod state;
mod step;
mod terminal;
mod tube;

pub use artifact::{Artifact, GroupSummary, RowOrigin, Summary, TubeSummary};
pub use problem::{
    Coordinates, CostWeights, GainChoice, Problem, Redundancy, SampleChoice, Scheme,
};
pub use sampled::Shard;
pub use state::State;
pub use step::{Branch, Command, Diagnostics, Measurement, Step, Verdict};

use super::{
    Controller, Method, PrepareError, StepError,
    shard::{self, Place},
};
use crate::{budget::Budget, reach::ReadError};
use sampled::ShardPart;

/// Version of the mathematics: raised when the same problem can give different bytes.
pub const VERSION: &str = "1";

/// Everything that can be said against a problem before anything is sampled: faults, a gain that
/// does not stabilise, a terminal set or tube that does not exist.
///
/// # Errors
/// As [`Controller::run_shard`].
pub fn check(problem: &Problem, budget: Budget<'_>) -> Result<(), PrepareError> {
    match problem.scheme {
        Scheme::OfflineSampling => sampled::check(problem, budget),
        Scheme::LinearQuadratic => nominal::prepare(problem, budget).map(drop),
        Scheme::TubeRobust => tube::prepare(problem, budget).map(drop),
    }
}

/// The method, as a [`Controller`].
#[derive(Debug, Clone, Copy)]
pub struct OfflineSampling;

impl Controller for OfflineSampling {
    type Problem = Problem;
    type Shard = Shard;
    type Artifact = Artifact;
    type State = State;
    type Measurement = Measurement;
    type Answer = Step;

    fn memory_bytes(problem: &Problem) -> usize {
        problem.memory_bytes()
    }

    /// One a part of a sampled group, and one for the expected cost; one for a baseline.
    fn shards(problem: &Problem) -> usize {
        match problem.scheme {
            Scheme::OfflineSampling => sampled::shards(problem),
            Scheme::LinearQuadratic | Scheme::TubeRobust => 1,
        }
    }

    fn run_shard(
        problem: &Problem,
        shard: usize,
        budget: Budget<'_>,
    ) -> Result<Shard, PrepareError> {
        let whole = |artifact| ShardPart::Whole(Box::new(artifact));
        let part = match problem.scheme {
            Scheme::OfflineSampling => sampled::run_shard(problem, shard, budget),
            Scheme::LinearQuadratic => nominal::prepare(problem, budget).map(whole),
            Scheme::TubeRobust => tube::prepare(problem, budget).map(whole),
        };
        part.map(|part| Shard { index: shard, part })
    }

    fn shard_to_bytes(problem: &Problem, shard: &Shard) -> Vec<u8> {
        place(problem).seal(shard.index, |writer| shard.write(writer))
    }

    fn shard_from_bytes(
        problem: &Problem,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Shard, ReadError> {
        let place = place(problem);
        place.open(bytes, budget, |index, reader| Shard::read(problem, index, reader, budget))
    }

    fn merge(
        problem: &Problem,
        shards: Vec<Shard>,
        budget: Budget<'_>,
    ) -> Result<Artifact, PrepareError> {
        shard::complete(shards.iter().map(|shard| shard.index), Self::shards(problem))?;
        sampled::merge(problem, shards, budget)
    }

    fn start(_artifact: &Artifact) -> State {
        State::START
    }

    fn step(
        artifact: &Artifact,
        state: &State,
        measurement: &Measurement,
        budget: Budget<'_>,
    ) -> Result<Step, StepError> {
        step::step(artifact, state, measurement, budget)
    }
}

fn place(problem: &Problem) -> Place {
    Place {
        method: Method::OfflineSampling,
        problem: problem.canonical_bytes(),
        shards: OfflineSampling::shards(problem),
    }
}
