//! What could be done from a state if thrusters failed there.

use nalgebra::DVector;

use super::{
    Artifact, ModeVerdict, Phase, Problem, Safety, StateVerdict,
    artifact::{PhaseSets, PreparedPhase},
};
use crate::{
    budget::{Budget, Interruption},
    dynamics::RelativeVector,
    mission::ThrustMode,
    reach::{
        Abort, AbortQuestion, AbortVerdict, Flight, PassiveQuestion, PolytopeQuestion,
        PolytopeUnion, find_abort, passive_safety,
    },
    sets::{CentredEllipsoid, Polytope},
};

/// Verdicts on the states of a trajectory that starts at time index `first`, one sample apart, in
/// a phase (the last one if there are fewer).
///
/// # Errors
/// The [`Interruption`] of the budget.
pub fn safety_report(
    artifact: &Artifact,
    phase: usize,
    first: usize,
    states: &[RelativeVector],
    budget: Budget<'_>,
) -> Result<Vec<StateVerdict>, Interruption> {
    let (phase, prepared) = artifact.phase(phase);
    let judge = |(i, x): (usize, &RelativeVector)| {
        judge_state(artifact.problem(), phase, prepared, first + i, x, budget)
    };
    states.iter().enumerate().map(judge).collect()
}

/// The verdict on the state x at time index k.
pub(super) fn judge_state(
    problem: &Problem,
    phase: &Phase,
    prepared: &PreparedPhase,
    k: usize,
    x: &RelativeVector,
    budget: Budget<'_>,
) -> Result<StateVerdict, Interruption> {
    let horizon = phase.safety.watch().map_or(0, |watch| watch.horizon);
    let mut verdict = StateVerdict { index: k, state: *x, modes: Vec::new(), drift: None };
    match &prepared.sets {
        PhaseSets::None => {}
        PhaseSets::Ellipsoids { avoid, .. } => {
            let question =
                PassiveQuestion { plant: &prepared.plant, orbit: &problem.orbit, avoid, horizon };
            verdict.drift = passive_safety(&question, k, x).ok();
            verdict.modes.push(drift_verdict(problem, prepared, avoid, horizon, k, x));
        }
        PhaseSets::Polytopes { avoid, modes, .. } => {
            let search = ActiveSearch { problem, prepared, avoid, horizon, k, x };
            verdict.modes = search.verdicts(phase.safety.modes(), modes, budget)?;
        }
    }
    Ok(verdict)
}

/// Free drift against an ellipsoid: here membership and the lack of an abort are the same.
fn drift_verdict(
    problem: &Problem,
    prepared: &PreparedPhase,
    avoid: &CentredEllipsoid,
    horizon: usize,
    k: usize,
    x: &RelativeVector,
) -> ModeVerdict {
    let flight = Flight::drifting(&prepared.plant, k, x, horizon);
    let gauge = |x: &RelativeVector| avoid.gauge_squared(&DVector::from_column_slice(x.as_slice()));
    let least = flight.states().iter().map(gauge).fold(f64::INFINITY, f64::min);
    let inside = least <= 1.0;
    let abort = if inside {
        AbortVerdict::NoneProved { programs: 0 }
    } else {
        AbortVerdict::Found(idle(problem, horizon, flight, least.sqrt() - 1.0))
    };
    ModeVerdict { working: ThrustMode::NONE, inside_reachable_set: inside, abort }
}

/// An abort that does nothing.
fn idle(problem: &Problem, horizon: usize, flight: Flight, margin: f64) -> Abort {
    let closest = flight.closest_to_target();
    Abort {
        closest,
        throttles: vec![vec![0.0; problem.thrusters.list().len()]; horizon],
        forces_n: vec![nalgebra::Vector3::zeros(); horizon],
        flight,
        margin,
        programs: 0,
    }
}

/// The abort that a craft in this phase takes with the thrusters that work: drift if that keeps
/// out of an ellipsoid, else a search around the polytope, or the box around the ellipsoid.
/// `None` in phases that avoid nothing.
pub(super) fn abort_now(
    problem: &Problem,
    phase: &Phase,
    prepared: &PreparedPhase,
    k: usize,
    x: &RelativeVector,
    working: ThrustMode,
    budget: Budget<'_>,
) -> Result<Option<AbortVerdict>, Interruption> {
    let Some(watch) = phase.safety.watch() else { return Ok(None) };
    let horizon = watch.horizon;
    let boxed;
    let avoid = match &prepared.sets {
        PhaseSets::None => return Ok(None),
        PhaseSets::Polytopes { avoid, .. } => avoid,
        PhaseSets::Ellipsoids { avoid, .. } => {
            let drift = drift_verdict(problem, prepared, avoid, horizon, k, x);
            if !drift.inside_reachable_set {
                return Ok(Some(drift.abort));
            }
            let Some(grown) = watch.avoid.inflated(watch.inflation) else { return Ok(None) };
            boxed = grown.outer_polytope();
            &boxed
        }
    };
    let search = ActiveSearch { problem, prepared, avoid, horizon, k, x };
    search.find(working, budget).map(Some)
}

/// The questions that one state and one polytope lead to.
struct ActiveSearch<'a> {
    problem: &'a Problem,
    prepared: &'a PreparedPhase,
    avoid: &'a Polytope,
    horizon: usize,
    k: usize,
    x: &'a RelativeVector,
}

impl ActiveSearch<'_> {
    /// One verdict a mode of `asked`. What a few thrusters can do, more can do too, so the
    /// dominating modes are searched first and their aborts are shared.
    fn verdicts(
        &self,
        asked: &[ThrustMode],
        dominating: &[ThrustMode],
        budget: Budget<'_>,
    ) -> Result<Vec<ModeVerdict>, Interruption> {
        let inside_few = self.members(dominating);
        let found = dominating
            .iter()
            .map(|&mode| self.find(mode, budget))
            .collect::<Result<Vec<_>, _>>()?;
        let mut verdicts = Vec::with_capacity(asked.len());
        for &mode in asked {
            let fewer = || (0..dominating.len()).filter(|&i| dominating[i].is_within(mode));
            let itself = dominating.iter().position(|&other| other == mode);
            let shared = fewer().find(|&i| matches!(found[i], AbortVerdict::Found(_)));
            let inside_reachable_set = match itself {
                Some(i) => inside_few[i],
                None => fewer().all(|i| inside_few[i]) && self.members(&[mode])[0],
            };
            let abort = match itself.or(shared) {
                Some(i) => found[i].clone(),
                None => self.find(mode, budget)?,
            };
            verdicts.push(ModeVerdict { working: mode, inside_reachable_set, abort });
        }
        Ok(verdicts)
    }

    /// Is the state in a backward reachable set of its own time index, for each mode?
    fn members(&self, modes: &[ThrustMode]) -> Vec<bool> {
        let forces = self.problem.thrusters.full_forces_n();
        let bits: Vec<u32> = modes.iter().map(|mode| mode.bits()).collect();
        let question = PolytopeQuestion {
            plant: &self.prepared.plant,
            avoid: self.avoid,
            full_forces_n: &forces,
            modes: &bits,
            horizon: self.horizon,
        };
        let start = self.k % self.prepared.plant.steps_per_period();
        let mut inside = vec![false; modes.len()];
        for set in PolytopeUnion::new(&question, start..start + 1).sets(start) {
            inside[set.mode] |= set.contains(self.x);
        }
        inside
    }

    fn find(&self, mode: ThrustMode, budget: Budget<'_>) -> Result<AbortVerdict, Interruption> {
        let forces = self.problem.thrusters.full_forces_n();
        let clearances = vec![self.problem.abort_clearance; self.avoid.offsets().len()];
        let question = AbortQuestion {
            plant: &self.prepared.plant,
            avoid: self.avoid,
            clearances: &clearances,
            full_forces_n: &forces,
            working: mode.bits(),
            start: self.k,
            horizon: self.horizon,
            programs_max: self.problem.abort_programs_max,
        };
        find_abort(&question, self.x, budget)
    }
}

/// Does the phase promise anything?
pub(super) fn is_watched(safety: &Safety) -> bool {
    safety.watch().is_some()
}
