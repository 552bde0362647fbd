//! Fixed-time rendezvous plans with disturbance feedback.
//!
//! # What it does
//! Brings a chaser to a target state in a fixed time by impulses at fixed instants, on an orbit of
//! any eccentricity below 1, against bounded navigation errors. The plan holds nominal burns and
//! gains: each burn is corrected for the errors seen so far, so that the arrival set is as small as
//! it can be at the price of fuel that was asked for. Flying it needs no optimisation.
//!
//! # Symbols
//! Axes are `LVLH_CCSDS`: x along-track, y against the orbit normal, z nadir. x_k scaled state
//! [Deaconu2014, eq. 1] just before burn u_k (m/s); A_k transition matrix, B_k = A_k c_k \[0; I\];
//! d_k navigation error, in an ellipsoid; w_k = A_k d_k - d_{k+1} disturbance, in the ellipsoid
//! with shape W_k = P_k P_k'; L_ki gain of burn k for w_i; G_i what carries w_i to the end; M_i =
//! G_i + sum_k B_Nk L_ki its effect there, B_Nk what carries burn k there; H metric; s_i =
//! |H M_i P_i|_F. Everything counts from 0: burn k at instant k, w_i between instants i and i + 1.
//!
//! # Offline
//! [`plan`]: minimise (sum s_i)² + fuel_weight |dv|_1 under saturation with corrections (20).
//! - *Fast path*: gains in closed form (least squares through the burns still to come) and one
//!   linear program for the burns. No gains leave less than the part of H G_i P_i outside the range
//!   of the burns still to come, and no burns cost less than without corrections: where this bound
//!   is met, the plan is optimal and is returned at once.
//! - *Otherwise* a program over second-order cones in which only the scarce thrust is rationed,
//!   until nothing is overdrawn (module `conic`), and the linear program again.
//!
//! Whatever was found goes through the certificate: everything a plan claims is recomputed from
//! burns and gains alone ([`Plan::from_burns_and_gains`], which is also how plans from elsewhere
//! come in), with the bound above.
//!
//! # Online
//! [`DisturbanceFeedback::step`](Controller::step): w_k from successive measurements by (6)-(7),
//! u_k = dv_k + sum_i L_ki w_i, clipped at saturation and said so. At the last instant the answer
//! is an arrival with its level in the arrival set.
//!
//! The measurement at instant 0 corrects nothing: no disturbance has acted. It does not replace the
//! plan's own first state either, because the plan corrects deviations from its own nominal
//! trajectory: w_0 is counted from the planned state. So w_0 is inside its set as long as the
//! *true* state at instant 0 lies within one navigation error of the planned one, wherever the new
//! measurement lies, and a start elsewhere shows up as a large w_0 and is corrected like any other.
//! `deviation_gauge` says at once how far the measurement is from the plan.
//!
//! # Guarantee and its assumptions
//! If every w_k lies in its set (navigation errors within theirs are enough): no burn exceeds its
//! limit, the measured state at the end lies in the arrival set around the target state, and the
//! true state at every instant lies in the outer ellipsoid around the nominal one. The motion is
//! linearised and the impulses exact: what reality adds counts as w and is measured in flight;
//! leaving the set is reported and voids the guarantee.
//!
//! # Where we differ from the paper
//! - An impulse u enters the scaled state as c_k u with c_k = sqrt(p³/mu) / rho_k; with the printed
//!   B = \[0; I\] the paper's own missions are infeasible.
//! - (24) is no semidefinite program: by Schur complement Q_f >= sum_i M_i W_i M_i' / tau_i with
//!   sum tau_i <= 1, so that the least trace is (sum s_i)² and cones of second order suffice. The
//!   certificate still computes the least eigenvalue of (23).
//! - The metric: the paper takes the trace of the scaled 6 x 6 shape ([`ArrivalMetric::Scaled6`]),
//!   which velocity dominates on a high orbit; in position alone Simbol-X's axes are twelve times
//!   smaller. The arrival set of the whole state is then given beside the position set.
//! - Table 3 comes out within 0.5 % (6000 s needs 0.27887 m/s, the printed 0.26 m/s is infeasible),
//!   and both open-loop rows as printed. Table 4's row with feedback does not: 29.41, 38.37, 46.85,
//!   55.07 m against 22.61, 26.51, 29.02, 31.34 m. Ours are proved optimal by the bound, and meet
//!   those of an independent implementation to 1e-4.
//! - The outer ellipsoid of (8) is the one of least volume, by default; the paper leaves it open.
//! - Gains are not unique. Where thrust is ample, those of least squares are taken; `effort_weight`
//!   prices corrections by scarce thrust and is no part of the objective.
//! - An optimum that saturation limits is optimal by the conic solver's word alone: the bound,
//!   which ignores corrections, stays below it, and the certificate claims
//!   [`Claim::Feasible`](super::Claim) with the gap.
//!
//! # References
//! \[Deaconu2014\], \[YamanakaAnkersen2002\], \[Ros2002\].

mod answer;
mod coast;
mod conic;
mod design;
mod encoding;
mod flight;
mod model;
mod outcome;
mod plan;
mod problem;
mod state;

pub use answer::{
    Arrival, BurnCommand, Diagnostics, Measurement, RealisedDisturbance, Step, Verdict,
};
pub use coast::{Coast, CoastState};
pub use design::{Designed, design};
pub use model::{LinearModel, LowerBound};
pub use outcome::{ArrivalSet, BurnBounds, Outcome, PlanCertificate, PlannedState};
pub use plan::{Gain, Origin, Plan};
pub use problem::{
    ArrivalMetric, EFFORT_WEIGHT_DEFAULT, FUEL_WEIGHT_DEFAULT, INSTANTS_MAX, Instants, Problem,
};
pub use state::State;

use super::{Controller, Method, PrepareError, StepError, shard::Place};
use crate::{
    budget::{Budget, Interruption},
    reach::ReadError,
};

/// Version of the mathematics: raised when the same problem can give different bytes.
pub const VERSION: &str = "1";

/// The method, as a [`Controller`]: the artifact is the plan.
#[derive(Debug, Clone, Copy)]
pub struct DisturbanceFeedback;

impl Controller for DisturbanceFeedback {
    type Problem = Problem;
    type Shard = Plan;
    type Artifact = Plan;
    type State = State;
    type Measurement = Measurement;
    type Answer = Step;

    /// The conic program's gains of every burn for the noise of every earlier one, with what its
    /// factorisation fills in.
    fn memory_bytes(problem: &Problem) -> usize {
        const FILLED: usize = 64;
        let gains =
            problem.instants.count().saturating_mul(problem.instants.count()).saturating_mul(18);
        gains.saturating_mul(FILLED).saturating_mul(size_of::<f64>())
    }

    /// One: a plan takes milliseconds.
    fn shards(_problem: &Problem) -> usize {
        1
    }

    fn run_shard(
        problem: &Problem,
        _shard: usize,
        budget: Budget<'_>,
    ) -> Result<Plan, PrepareError> {
        let designed = design(problem, budget)?;
        // Whenever it is made, the artifact of a problem is the same.
        if designed.is_cut_short {
            return Err(Interruption::Deadline.into());
        }
        Ok(designed.plan)
    }

    fn shard_to_bytes(problem: &Problem, shard: &Plan) -> Vec<u8> {
        place(problem).seal(0, |writer| shard.write_found(writer))
    }

    fn shard_from_bytes(
        problem: &Problem,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Plan, ReadError> {
        let place = place(problem);
        place.open(bytes, budget, |_, reader| Plan::read_found(problem.clone(), reader, budget))
    }

    fn merge(
        problem: &Problem,
        shards: Vec<Plan>,
        budget: Budget<'_>,
    ) -> Result<Plan, PrepareError> {
        match shards.into_iter().next() {
            Some(plan) => Ok(plan),
            None => Self::run_shard(problem, 0, budget),
        }
    }

    fn start(_artifact: &Plan) -> State {
        State::START
    }

    fn step(
        artifact: &Plan,
        state: &State,
        measurement: &Measurement,
        budget: Budget<'_>,
    ) -> Result<Step, StepError> {
        budget.check()?;
        flight::step(artifact, state, measurement)
    }
}

fn place(problem: &Problem) -> Place {
    Place { method: Method::DisturbanceFeedback, problem: problem.canonical_bytes(), shards: 1 }
}

/// Computes a plan: when the deadline comes, the best that was found, if it passes its certificate.
///
/// # Errors
/// [`PrepareError::Faults`] by field, among them instants from which no impulse reaches the target
/// state (half a revolution apart); [`PrepareError::Infeasible`] with the least `delta_v_max_m_s`
/// if the limit is too low; [`PrepareError::Failure`] when interrupted or defeated by numbers.
pub fn plan(problem: &Problem, budget: Budget<'_>) -> Result<Plan, PrepareError> {
    design(problem, budget).map(|designed| designed.plan)
}

/// Least `delta_v_max_m_s` for which a plan exists (gains of zero cost no margin, so this is a
/// matter of the nominal burns); `None` if no limit would do.
///
/// # Errors
/// The problem's faults, and a disturbance set that rounding has destroyed.
pub fn least_delta_v_max_m_s(problem: &Problem) -> Result<Option<f64>, PrepareError> {
    Ok(LinearModel::of(problem)?.least_limit().map(|(limit, _)| limit))
}
