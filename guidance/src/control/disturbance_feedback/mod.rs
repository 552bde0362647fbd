//! Fixed-time rendezvous plans with disturbance feedback.

mod answer;
mod encoding;
mod plan;
mod problem;
mod state;

pub use answer::{
    Arrival, BurnCommand, Diagnostics, Measurement, RealisedDisturbance, Step, Verdict,
};
pub use plan::{
    ArrivalSet, BurnBounds, Gain, Origin, Outcome, Plan, PlanCertificate, PlannedState,
};
pub use problem::{
    ArrivalMetric, EFFORT_WEIGHT_DEFAULT, FUEL_WEIGHT_DEFAULT, INSTANTS_MAX, Instants, Problem,
};
pub use state::State;

use super::{Controller, Failure, PrepareError, StepError};
use crate::budget::Budget;

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

    /// One: a plan takes milliseconds.
    fn shards(_problem: &Problem) -> usize {
        1
    }

    fn run_shard(
        problem: &Problem,
        _shard: usize,
        budget: Budget<'_>,
    ) -> Result<Plan, PrepareError> {
        plan(problem, budget)
    }

    fn merge(problem: &Problem, shards: Vec<Plan>) -> Result<Plan, PrepareError> {
        match shards.into_iter().next() {
            Some(plan) => Ok(plan),
            None => plan(problem, Budget::UNLIMITED),
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
        let _ = (artifact, state, measurement);
        Err(Failure::Numerical("not on this branch yet".into()).into())
    }
}

/// Computes a plan.
///
/// # Errors
/// [`PrepareError::Faults`] by field, among them instants from which no impulse reaches the target
/// state (half a revolution apart); [`PrepareError::Infeasible`] with the least `delta_v_max_m_s`
/// if the limit is too low; [`PrepareError::Failure`] when interrupted or defeated by numbers.
pub fn plan(problem: &Problem, budget: Budget<'_>) -> Result<Plan, PrepareError> {
    budget.check()?;
    let faults = problem.faults();
    if !faults.is_empty() {
        return Err(PrepareError::Faults(faults));
    }
    Err(Failure::Numerical("not on this branch yet".into()).into())
}

/// Least `delta_v_max_m_s` for which a plan exists (gains of zero cost no margin, so this is a
/// matter of the nominal burns); `None` if no limit would do.
///
/// # Errors
/// The problem's faults.
pub fn least_delta_v_max_m_s(problem: &Problem) -> Result<Option<f64>, Vec<super::Fault>> {
    let faults = problem.faults();
    if faults.is_empty() { Ok(None) } else { Err(faults) }
}
