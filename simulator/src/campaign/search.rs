//! LOCAL against ENUMERATION: both are asked at every step on the same true state.
//!
//! A controller state belongs to one problem, so each search has a loop of its own. Both see the
//! states that the LOCAL commands lead to. As long as cost, horizon and branch agree, both loops
//! carry the same history, because nothing else of it enters the next problem.

use std::time::Duration;

use vbar_client::Client;
use vbar_proto::v1::HorizonSearch;

use super::{
    Plan, SimulationError,
    flight::{Candidate, Decision, STARTS_MAX, Session, Starts, stream_of_chance},
    vehicle::Vehicle,
    with_search,
};
use crate::mission::law::RunDisturbance;

/// Largest relative difference of two equal costs; both come from linear programs solved to 1e-9.
const COST_TOLERANCE: f64 = 1e-6;

/// How often the two searches were asked and disagreed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SearchComparison {
    /// Runs compared.
    pub runs: u32,
    /// Steps at which both were asked.
    pub steps: u32,
    /// Steps with another verdict or branch.
    pub different_branch: u32,
    /// Steps with another horizon.
    pub different_horizon: u32,
    /// Steps with another cost.
    pub different_cost: u32,
    /// Time spent waiting for LOCAL.
    pub local: Duration,
    /// Time spent waiting for ENUMERATION.
    pub enumeration: Duration,
}

impl SearchComparison {
    /// The two never disagreed.
    #[must_use]
    pub fn equal(&self) -> bool {
        self.different_branch + self.different_horizon + self.different_cost == 0
    }
}

impl std::iter::Sum for SearchComparison {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        parts.fold(Self::default(), |sum, part| Self {
            runs: sum.runs + part.runs,
            steps: sum.steps + part.steps,
            different_branch: sum.different_branch + part.different_branch,
            different_horizon: sum.different_horizon + part.different_horizon,
            different_cost: sum.different_cost + part.different_cost,
            local: sum.local + part.local,
            enumeration: sum.enumeration + part.enumeration,
        })
    }
}

/// Compares the two searches along run number `run`.
pub(crate) async fn compare(
    client: &Client,
    plan: &Plan,
    run: u32,
) -> Result<SearchComparison, SimulationError> {
    let under = |search| Plan {
        mission: crate::mission::Mission {
            problem: with_search(&plan.mission.problem, search),
            ..plan.mission.clone()
        },
        ..plan.clone()
    };
    let (local, enumeration) = (under(HorizonSearch::Local), under(HorizonSearch::Enumeration));
    // Both draw from the same stream, so the starts are equal.
    let mut starts = [Starts::of(plan, run), Starts::of(plan, run)];
    for _ in 0..STARTS_MAX {
        let first = starts[0].draw(client, &local).await?;
        let second = starts[1].draw(client, &enumeration).await?;
        let (Candidate::Start(ours, start), Candidate::Start(theirs, _)) = (first, second) else {
            continue;
        };
        let mut pair = Pair {
            vehicle: Vehicle::new(&ours.model, &plan.mission.simulation.truth, &start),
            local: Session::open(client, run, &ours, false).await?,
            enumeration: Session::open(client, run, &theirs, false).await?,
            counts: SearchComparison { runs: 1, ..SearchComparison::default() },
        };
        let mut chance = stream_of_chance(plan.seed, run, 1);
        let law = &plan.mission.simulation.disturbance;
        let disturbance: RunDisturbance = law.begin(&ours.model, &mut chance);
        let mut flown = 0;
        while let Some(command) = pair.ask().await? {
            pair.vehicle.advance(&ours.model, &command, &disturbance, &mut chance);
            flown += 1;
            if flown > ours.model.steps_max {
                break;
            }
        }
        if flown > 0 || !plan.start_is_random() {
            return Ok(pair.counts);
        }
    }
    let reason = "one of the two searches refused every start".to_owned();
    Err(SimulationError::NoStart { run, tries: STARTS_MAX, reason })
}

struct Pair {
    vehicle: Vehicle,
    local: Session,
    enumeration: Session,
    counts: SearchComparison,
}

impl Pair {
    /// Asks both, counts a difference, and returns LOCAL's command; `None` at the end.
    async fn ask(&mut self) -> Result<Option<nalgebra::DVector<f64>>, SimulationError> {
        let state = self.vehicle.state();
        let asked = std::time::Instant::now();
        let (local, _) = self.local.decide(&state).await?;
        let between = std::time::Instant::now();
        let (enumeration, _) = self.enumeration.decide(&state).await?;
        self.counts.local += between - asked;
        self.counts.enumeration += between.elapsed();
        self.counts.steps += 1;
        match (local, enumeration) {
            (Decision::Command(command, ours), Decision::Command(_, theirs)) => {
                let difference = (ours.cost - theirs.cost).abs();
                self.counts.different_branch += u32::from(ours.branch != theirs.branch);
                self.counts.different_horizon += u32::from(ours.horizon != theirs.horizon);
                self.counts.different_cost +=
                    u32::from(difference > COST_TOLERANCE * (1.0 + ours.cost.abs()));
                Ok(Some(command))
            }
            (Decision::Arrived, Decision::Arrived)
            | (Decision::Infeasible(_), Decision::Infeasible(_)) => Ok(None),
            _ => {
                self.counts.different_branch += 1;
                Ok(None)
            }
        }
    }
}
