//! Rendezvous that can be aborted at every step, on elliptic orbits.
//!
//! # What it does
//! Drives a chaser towards a target in phases. In each phase it keeps the predicted states out of
//! the states from which, if thrusters failed there, a region around the target would be entered:
//! first the approach ellipsoid and the keep-out sphere under total failure, then a terminal
//! region under failure of some thrusters, then nothing.
//!
//! # Symbols
//! x relative state, u force, k step, k_p steps of a period, N_p prediction horizon, N safety
//! horizon, S avoided set, U_i forces of mode i, RS backward reachable set, gamma inflation, rho
//! clearance, l sets that each predicted state is kept out of.
//!
//! # Offline
//! [`Artifact`]: the plant sampled along the orbit, and for every start along it the backward
//! reachable sets of each phase; ellipsoids as 13 numbers each, polytopes with shared normals.
//!
//! # Online
//! [`AbortSafe::step`](Controller::step): for each predicted state of the last step the l nearest
//! sets of its own time index, one half-space off each, and a quadratic program (23). The answer
//! says of the next state, for every failure, whether an abort exists, and gives one. An abort
//! that has begun goes on: what is left of its sequence is flown once more from each measured
//! state, and replaced when it no longer keeps out.
//!
//! # Guarantee and its assumptions
//! A state outside the passive sets of its time index drifts clear of S at the instants of the
//! safety horizon, as the linear plant has it; what happens between instants and without
//! linearisation is reported beside it. For failures of some thrusters nothing follows from being
//! outside the sets: there the verdict on each mode is what counts, found by exact search, and an
//! abort is found only if it keeps out between instants too. Only the l nearest sets are cut off,
//! so the next state is judged against all of them. A mission that starts inside a set of its own
//! time index is refused.
//!
//! # Where we differ from the paper
//! - Proposition III.1 fails for active modes: a set is "there is an instant such that for all
//!   thrusts", the lack of an abort "for all thrusts there is an instant". Both are reported.
//! - Sets are timed: only those that start at a state's own time index threaten it. The union
//!   (12) makes the paper's own start infeasible; it is an option.
//! - (5) has lost the dots on two velocities; (31) and (32d) need Q^(1/2) a; (33) needs v_m^2;
//!   the tangent of remark 5 has no factor 2.
//! - One half-space for each set, unless the programs (28) and (32) are asked for: a common one
//!   rarely exists for several sets, and where it does not, each gets its own again. Where (28)
//!   has no bound, because the origin is outside the set, the Euclidean projection is used.
//! - Sets are ranked by gauge, not by a distance that adds metres to metres per second.
//! - gamma inflates S before it is propagated, not the propagated offsets.
//! - Phases advance by the distance of the position to the region, and never go back.
//!
//! # References
//! \[AguilarMarsillach2022\].

mod answer;
mod artifact;
mod cuts;
mod encoding;
mod faults;
mod leave;
mod problem;
mod regulator;
mod safety;
mod state;
mod step;
mod summary;
mod unsafe_state;

pub use answer::{
    AbortCommand, AbortOrigin, AbortReason, Arrival, Command, Diagnostics, Measurement,
    ModeVerdict, StateVerdict, Step, Trajectory, UnsafeState, Verdict,
};
pub use artifact::{Artifact, Shard};
pub use faults::{
    FRACTIONS_MAX, INSTANTS_MAX, NEAREST_MAX, NUMBERS_MAX, PREDICTION_MAX, STEPS_MAX,
};
pub use problem::{Fallback, Phase, Problem, Safety, Separation, SetTiming, Watch, Weights};
pub use safety::{SafetyQuestion, safety_report};
pub use state::State;
pub use summary::{PhaseSummary, Summary};

use super::{
    Controller, Method, PrepareError, StepError,
    shard::{self, Place},
};
use crate::{budget::Budget, reach::ReadError};

/// Version of the mathematics: raised when the same problem can give different bytes.
pub const VERSION: &str = "1";

/// The method, as a [`Controller`].
#[derive(Debug, Clone, Copy)]
pub struct AbortSafe;

impl Controller for AbortSafe {
    type Problem = Problem;
    type Shard = Shard;
    type Artifact = Artifact;
    type State = State;
    type Measurement = Measurement;
    type Answer = Step;

    fn memory_bytes(problem: &Problem) -> usize {
        artifact::memory_bytes(problem)
    }

    fn shards(problem: &Problem) -> usize {
        artifact::shard_count(problem)
    }

    fn run_shard(
        problem: &Problem,
        shard: usize,
        budget: Budget<'_>,
    ) -> Result<Shard, PrepareError> {
        artifact::run_shard(problem, shard, budget)
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
        artifact::merge(problem, shards, budget)
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
        method: Method::AbortSafe,
        problem: problem.canonical_bytes(),
        shards: AbortSafe::shards(problem),
    }
}
