//! Variable-horizon tube MPC with adaptive terminal constraints, and its baselines.
//!
//! # What it does
//! Drives a linear plant to a moving reference in finite time, against bounded disturbances,
//! under state and input constraints, choosing how many steps that takes.
//!
//! # Symbols
//! x state, u input, w in W disturbance, r reference, k step; z, v nominal state and input; N
//! horizon; K tube gain, A_K = A + B K; S(j) = W + ... + A_K^(j-1) W error tube; J = N + gamma_z
//! sum |z - r|_1 + gamma_v sum |v|_1; z^r terminal point; q the step at which the terminal point
//! was last adapted.
//!
//! # Offline
//! [`Artifact::prepare`]: K, the tube, what it takes from the inputs, lambda_bar, and tables of
//! reference and cone.
//!
//! # Online
//! [`VariableHorizon::step`](Controller::step): solve P_k, a linear program a horizon, with the
//! terminal point. If its cost has not fallen by lambda_bar, solve the problem with the grown
//! terminal set, which is feasible by construction. Apply the first input; after the step with
//! N = 1 the mission is complete.
//!
//! A measurement that comes m whole steps late is answered for the step whose time it has. The
//! commands of the steps in between are taken to be those that the last answer planned, v(1), v(2),
//! ..., flown as they are: what a chaser that holds the prediction can do without us. If more
//! steps are missed than the plan has commands, nobody knows what was flown, and the step is
//! refused.
//!
//! Every command leaves with a certificate; [`verify_step`] makes it again from the answer alone,
//! without a solver.
//!
//! # Guarantee and its assumptions
//! If P_0 is feasible, w stays in W and lambda_bar > 0: every later step has an answer, no
//! constraint is violated, the cost falls by lambda_bar a step, and x ends in {z^r_q} + S(N_q)
//! after at most J_0 / lambda_bar steps. Every step reports the disturbance that acted and
//! whether it left W. The guarantee holds for a local search too: it needs decrease, not optima.
//! It says nothing between samples.
//!
//! Over m missed steps the deviation from the plan grows with A instead of A_K. If it still lies in
//! S(m + 1), it is one that the feasibility proof covers as it stands: P_k has an answer whose
//! cost has fallen by (m + 1) lambda_bar, for the candidate v + K A_K^j e costs at most that by
//! the same triangle inequality as for one step. If not, nothing is promised for this step: the
//! answer says so (`outside_guaranteed_tube`), no decrease is asked of it, and the guarantee
//! starts anew with it (not for tube feedback, which makes no new plan).
//!
//! # Where we differ from the papers
//! - Line 11 of Algorithm 1 gets a tolerance of 1e-9 (1 + |J|): equality is normal for W = {0}
//!   or gamma_v = 0.
//! - The constraint at j = 0 is data, not a decision: it is checked once, at the mission's start.
//! - In \[Quartullo2025a, eq. 15\] "A_i^k" must read A_K^i; in \[Quartullo2025b, eq. 23\] the
//!   kinematics are p' = omega x p.
//! - The two papers' fallbacks differ; both are offered ([`TerminalFallback`]).
//! - lambda_bar <= 0 is answered too; the artifact says that completion is not guaranteed.
//! - The first guess of the horizon is a minimum-time estimate: the paper refers to another one.
//!
//! # References
//! \[Quartullo2025a\], \[Quartullo2025b\].

mod answer;
mod artifact;
mod certify;
mod encoding;
mod inspect;
mod present;
mod problem;
mod relaxation;
mod search;
mod stages;
mod state;
mod step;
mod verification;

pub use answer::{
    Arrival, Branch, Command, Diagnostics, Evidence, MeasuredState, Measurement,
    PhysicalTrajectory, Plan, PlanOutcome, RealisedDisturbance, Step, Trajectory, Trial,
    TrialOutcome, Tube, Verdict,
};
pub use artifact::{Artifact, Summary};
pub use inspect::{HorizonAnswer, StateRows};
pub use problem::{
    GainChoice, HillPlant, HorizonSearch, LinearPlant, Plant, Problem, Scheme, TerminalFallback,
    TerminalPoint, Weights,
};
pub use state::State;
pub use verification::verify_step;

use super::{Controller, Method, PrepareError, StepError, shard::Place};
use crate::{budget::Budget, reach::ReadError};

/// Version of the mathematics: raised when the same problem can give different bytes.
pub const VERSION: &str = "3";

/// The method, as a [`Controller`].
#[derive(Debug, Clone, Copy)]
pub struct VariableHorizon;

impl Controller for VariableHorizon {
    type Problem = Problem;
    type Shard = Artifact;
    type Artifact = Artifact;
    type State = State;
    type Measurement = Measurement;
    type Answer = Step;

    /// The inverse of the simplex's kernel, should every input of the longest horizon have its row;
    /// the tube, should its sums be as long as they may; reference and cone at every step.
    fn memory_bytes(problem: &Problem) -> usize {
        artifact::memory_bytes(problem)
    }

    /// One: preparing takes less than a millisecond.
    fn shards(_problem: &Problem) -> usize {
        1
    }

    fn run_shard(
        problem: &Problem,
        _shard: usize,
        budget: Budget<'_>,
    ) -> Result<Artifact, PrepareError> {
        budget.check()?;
        Artifact::prepare_within(problem, budget)
    }

    fn shard_to_bytes(problem: &Problem, shard: &Artifact) -> Vec<u8> {
        place(problem).seal(0, |writer| shard.write_found(writer))
    }

    fn shard_from_bytes(
        problem: &Problem,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Artifact, ReadError> {
        let place = place(problem);
        place.open(bytes, budget, |_, reader| Artifact::read_found(problem.clone(), reader, budget))
    }

    fn merge(
        problem: &Problem,
        shards: Vec<Artifact>,
        budget: Budget<'_>,
    ) -> Result<Artifact, PrepareError> {
        match shards.into_iter().next() {
            Some(artifact) => Ok(artifact),
            None => Artifact::prepare_within(problem, budget),
        }
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
    Place { method: Method::VariableHorizon, problem: problem.canonical_bytes(), shards: 1 }
}

/// The plan from the mission's start: with tube feedback for
/// [`TubeOptimalControl`](Scheme::TubeOptimalControl), else open-loop.
///
/// # Errors
/// [`StepError`].
pub fn plan(
    artifact: &Artifact,
    initial: &Measurement,
    budget: Budget<'_>,
) -> Result<PlanOutcome, StepError> {
    step::plan(artifact, initial, budget)
}
