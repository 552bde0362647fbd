//! What could be done from a state if thrusters failed there.

use nalgebra::{SMatrix, Vector3};

use super::{
    Artifact, ModeVerdict, Phase, Problem, StateVerdict,
    artifact::{PhaseSets, PreparedPhase},
    step::phase_at,
};
use crate::{
    budget::{Budget, Interruption},
    dynamics::RelativeVector,
    matrices::product_fixed,
    mission::ThrustMode,
    reach::{
        Abort, AbortQuestion, AbortVerdict, Flight, Outside, PassiveQuestion, PolytopeQuestion,
        PolytopeUnion, find_abort, passive_safety_along,
    },
    sets::{CentredEllipsoid, Polytope},
};

/// Asks about the states of a trajectory, one sample apart.
#[derive(Debug, Clone, Copy)]
pub struct SafetyQuestion<'a> {
    /// The phase whose region counts, the last one if there are fewer; `None`: at each state the
    /// one that its position calls for, without going back.
    pub phase: Option<usize>,
    /// Time index of the first state.
    pub first: usize,
    /// Metres, metres per second, RTN.
    pub states: &'a [RelativeVector],
    /// Working thrusters after each failure that is asked about; `None`: those of the phase.
    pub modes: Option<&'a [ThrustMode]>,
}

/// One verdict a state.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub fn safety_report(
    artifact: &Artifact,
    question: &SafetyQuestion<'_>,
    budget: Budget<'_>,
) -> Result<Vec<StateVerdict>, Interruption> {
    let problem = artifact.problem();
    let mut reached = 0;
    let verdict = |(i, x): (usize, &RelativeVector)| {
        budget.check()?;
        reached = question.phase.unwrap_or_else(|| phase_at(problem, reached, true, x).0);
        reached = reached.min(problem.phases.len() - 1);
        let (phase, prepared) = artifact.phase(reached);
        let judge = Judge { problem, phase, prepared };
        let modes = question.modes.unwrap_or(phase.safety.modes());
        judge.verdict(reached, question.first + i, x, modes, budget)
    };
    question.states.iter().enumerate().map(verdict).collect()
}

/// Answers for one phase.
#[derive(Clone, Copy)]
pub(super) struct Judge<'a> {
    pub(super) problem: &'a Problem,
    pub(super) phase: &'a Phase,
    pub(super) prepared: &'a PreparedPhase,
}

impl Judge<'_> {
    /// The verdict on the state x at time index k, one a mode of `asked`.
    pub(super) fn verdict(
        &self,
        phase: usize,
        k: usize,
        x: &RelativeVector,
        asked: &[ThrustMode],
        budget: Budget<'_>,
    ) -> Result<StateVerdict, Interruption> {
        let mut verdict =
            StateVerdict { index: k, phase, state: *x, modes: Vec::new(), drift: None };
        let Some(watch) = self.phase.safety.watch() else { return Ok(verdict) };
        let horizon = watch.horizon;
        match &self.prepared.sets {
            PhaseSets::None => {}
            PhaseSets::Ellipsoids { avoid, around, .. } => {
                let drift = self.drift(avoid, k, x, horizon);
                verdict.drift = drift.verdict;
                let search = self.search(around, k, x, horizon);
                for &working in asked {
                    if working == ThrustMode::NONE {
                        verdict.modes.push(drift.mode.clone());
                        continue;
                    }
                    let doomed_after_s = search.doomed_after_s(&[working], budget)?[0];
                    let drifts = matches!(drift.mode.abort, AbortVerdict::Found(_));
                    let abort = if drifts {
                        drift.mode.abort.clone()
                    } else {
                        search.find(working, budget)?
                    };
                    verdict.modes.push(ModeVerdict { working, doomed_after_s, abort });
                }
            }
            PhaseSets::Polytopes { avoid, modes, union, .. } => {
                let search = self.search(avoid, k, x, horizon);
                verdict.modes = search.verdicts(asked, modes, union, budget)?;
            }
        }
        Ok(verdict)
    }

    /// The abort that a craft takes with the thrusters that work, over `horizon` steps: drift if
    /// that keeps out of an ellipsoid, else a search around the polytope, or the box around the
    /// ellipsoid. Where nothing is avoided, drift.
    pub(super) fn abort(
        &self,
        k: usize,
        x: &RelativeVector,
        working: ThrustMode,
        horizon: usize,
        budget: Budget<'_>,
    ) -> Result<AbortVerdict, Interruption> {
        match &self.prepared.sets {
            PhaseSets::None => {
                let flight = Flight::drifting(&self.prepared.plant, k, x, horizon);
                let far = f64::INFINITY;
                Ok(AbortVerdict::Found(self.abort_of(Vec::new(), horizon, flight, [far, far])))
            }
            PhaseSets::Polytopes { avoid, .. } => {
                self.search(avoid, k, x, horizon).find(working, budget)
            }
            PhaseSets::Ellipsoids { avoid, around, .. } => {
                let drift = self.drift(avoid, k, x, horizon);
                if matches!(drift.mode.abort, AbortVerdict::Found(_)) {
                    return Ok(drift.mode.abort);
                }
                self.search(around, k, x, horizon).find(working, budget)
            }
        }
    }

    /// A sequence flown once more from the state x, then drift; `None` if that does not keep out
    /// over `horizon` steps.
    pub(super) fn flown(
        &self,
        k: usize,
        x: &RelativeVector,
        throttles: &[Vec<f64>],
        horizon: usize,
    ) -> Option<Abort> {
        let full = self.problem.thrusters.full_forces_n();
        let force = |step: &Vec<f64>| -> Vector3<f64> {
            full.iter().zip(step).map(|(force, &throttle)| force * throttle).sum()
        };
        let mut forces: Vec<Vector3<f64>> = throttles.iter().take(horizon).map(force).collect();
        let thrusting = forces.len();
        forces.resize(horizon, Vector3::zeros());
        let flight = Flight::under(&self.prepared.plant, k, x, &forces);
        let margins = match &self.prepared.sets {
            PhaseSets::None => [f64::INFINITY; 2],
            PhaseSets::Ellipsoids { avoid, .. } => margins_of_drift(avoid, &flight),
            PhaseSets::Polytopes { avoid, .. } => {
                let outside = Outside::new(avoid, &self.clearances(avoid));
                [outside.at_instants(&flight), outside.throughout(&flight)]
            }
        };
        let throughout = matches!(self.prepared.sets, PhaseSets::Polytopes { .. });
        let clear = margins[0] > 0.0 && (margins[1] > 0.0 || !throughout);
        clear.then(|| {
            let kept = throttles[..thrusting].to_vec();
            Abort {
                forces_n: forces[..thrusting].to_vec(),
                ..self.abort_of(kept, horizon, flight, margins)
            }
        })
    }

    /// Free drift against an ellipsoid: here membership and the lack of an abort are the same.
    fn drift(
        &self,
        avoid: &CentredEllipsoid,
        k: usize,
        x: &RelativeVector,
        horizon: usize,
    ) -> Drift {
        let plant = &self.prepared.plant;
        let question = PassiveQuestion { plant, orbit: &self.problem.orbit, avoid, horizon };
        let flight = Flight::drifting(plant, k, x, horizon);
        let verdict = passive_safety_along(&question, k, &flight).ok();
        let precision = precision_of(avoid);
        let inside = |x: &RelativeVector| x.dot(&product_fixed(&precision, x)) <= 1.0;
        let doomed = flight.states().iter().position(inside);
        let doomed_after_s = doomed.map(|instant| instant as f64 * flight.spacing_s());
        let abort = if doomed.is_some() {
            AbortVerdict::NoneProved { programs: 0 }
        } else {
            let margins = margins_of_drift(avoid, &flight);
            AbortVerdict::Found(self.abort_of(Vec::new(), horizon, flight, margins))
        };
        Drift { verdict, mode: ModeVerdict { working: ThrustMode::NONE, doomed_after_s, abort } }
    }

    /// An abort with these throttles; the forces are the caller's.
    fn abort_of(
        &self,
        throttles: Vec<Vec<f64>>,
        horizon: usize,
        flight: Flight,
        [margin, margin_throughout]: [f64; 2],
    ) -> Abort {
        let closest = flight.closest_to_target();
        let forces_n = Vec::new();
        Abort {
            throttles,
            forces_n,
            horizon,
            flight,
            margin,
            margin_throughout,
            closest,
            programs: 0,
        }
    }

    fn clearances(&self, avoid: &Polytope) -> Vec<f64> {
        vec![self.problem.abort_clearance; avoid.offsets().len()]
    }

    fn search<'a>(
        &'a self,
        avoid: &'a Polytope,
        k: usize,
        x: &'a RelativeVector,
        horizon: usize,
    ) -> ActiveSearch<'a> {
        ActiveSearch { judge: self, avoid, horizon, k, x }
    }
}

/// What free drift does.
struct Drift {
    verdict: Option<crate::reach::PassiveVerdict>,
    mode: ModeVerdict,
}

fn precision_of(avoid: &CentredEllipsoid) -> SMatrix<f64, 6, 6> {
    SMatrix::from_fn(|i, j| avoid.precision()[(i, j)])
}

/// Least gauge less 1: of the states at the instants, of the positions throughout.
fn margins_of_drift(avoid: &CentredEllipsoid, flight: &Flight) -> [f64; 2] {
    let precision = precision_of(avoid);
    let squared = |x: &RelativeVector| x.dot(&product_fixed(&precision, x));
    let least = flight.states().iter().map(squared).fold(f64::INFINITY, f64::min);
    let weight = precision.fixed_view::<3, 3>(0, 0).into_owned();
    let closest = flight.closest(&weight).map_or(f64::INFINITY, |closest| closest.least);
    [least.sqrt() - 1.0, closest.sqrt() - 1.0]
}

/// The questions that one state and one polytope lead to.
struct ActiveSearch<'a> {
    judge: &'a Judge<'a>,
    avoid: &'a Polytope,
    horizon: usize,
    k: usize,
    x: &'a RelativeVector,
}

impl ActiveSearch<'_> {
    /// One verdict a mode of `asked`. What a few thrusters can do, more can do too, so the
    /// dominating modes are searched first and their aborts are shared; and a state outside the
    /// sets of a few thrusters is outside those of more.
    fn verdicts(
        &self,
        asked: &[ThrustMode],
        dominating: &[ThrustMode],
        union: &PolytopeUnion,
        budget: Budget<'_>,
    ) -> Result<Vec<ModeVerdict>, Interruption> {
        let doomed = self.earliest(union, dominating.len());
        let mut found: Vec<Option<AbortVerdict>> = vec![None; dominating.len()];
        let mut verdicts = Vec::with_capacity(asked.len());
        for &working in asked {
            let fewer: Vec<usize> =
                (0..dominating.len()).filter(|&i| dominating[i].is_within(working)).collect();
            for &i in &fewer {
                if found[i].is_none() {
                    found[i] = Some(self.find(dominating[i], budget)?);
                }
            }
            let itself = fewer.iter().copied().find(|&i| dominating[i] == working);
            let shared = || {
                fewer.iter().copied().find(|&i| matches!(found[i], Some(AbortVerdict::Found(_))))
            };
            let doomed_after_s = match itself {
                Some(i) => doomed[i],
                None if fewer.iter().any(|&i| doomed[i].is_none()) => None,
                None => self.doomed_after_s(&[working], budget)?[0],
            };
            let abort = match itself.or_else(shared).and_then(|i| found[i].clone()) {
                Some(abort) => abort,
                None => self.find(working, budget)?,
            };
            verdicts.push(ModeVerdict { working, doomed_after_s, abort });
        }
        Ok(verdicts)
    }

    /// Seconds until the earliest set of its own time index that holds the state, for each mode.
    fn doomed_after_s(
        &self,
        modes: &[ThrustMode],
        budget: Budget<'_>,
    ) -> Result<Vec<Option<f64>>, Interruption> {
        let plant = &self.judge.prepared.plant;
        let forces = self.judge.problem.thrusters.full_forces_n();
        let bits: Vec<u32> = modes.iter().map(|mode| mode.bits()).collect();
        let question = PolytopeQuestion {
            plant,
            avoid: self.avoid,
            full_forces_n: &forces,
            modes: &bits,
            horizon: self.horizon,
        };
        let start = self.k % plant.steps_per_period();
        let union = PolytopeUnion::new(&question, start..start + 1, budget)?;
        Ok(self.earliest(&union, modes.len()))
    }

    /// The same for the modes of a union.
    fn earliest(&self, union: &PolytopeUnion, modes: usize) -> Vec<Option<f64>> {
        let plant = &self.judge.prepared.plant;
        let spacing_s = plant.sample_time().seconds() / plant.fraction_count() as f64;
        let mut doomed = vec![None; modes];
        for set in union.sets(self.k) {
            if doomed[set.mode].is_none() && set.contains(self.x) {
                doomed[set.mode] = Some(set.instant as f64 * spacing_s);
            }
        }
        doomed
    }

    fn find(&self, mode: ThrustMode, budget: Budget<'_>) -> Result<AbortVerdict, Interruption> {
        let forces = self.judge.problem.thrusters.full_forces_n();
        let question = AbortQuestion {
            plant: &self.judge.prepared.plant,
            avoid: self.avoid,
            clearances: &self.judge.clearances(self.avoid),
            full_forces_n: &forces,
            working: mode.bits(),
            start: self.k,
            horizon: self.horizon,
            programs_max: self.judge.problem.abort_programs_max,
            throughout: true,
        };
        find_abort(&question, self.x, budget)
    }
}
