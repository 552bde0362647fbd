//! The world in which a flight takes place, and the judge of where drifts and aborts lead.

use nalgebra::{Vector3, Vector6};

use crate::{
    campaign::SimulationError,
    clearance::{Clearance, Region},
    mission::{
        AbortCase, AbortMission, MissionError,
        abort::{AbortTruth, DriftLaw},
        abort_model::{AbortModel, PhaseKind},
    },
    plant::relative_truth::{Course, Law, RelativeTruth},
};

/// How one course passes a region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Least gauge of the position among the instants that are looked at: below 1 inside.
    pub least_gauge: f64,
    /// The same between the instants too.
    pub least_gauge_throughout: f64,
    /// Least distance from the target, between the instants too.
    pub least_distance_m: f64,
    /// When the course is first inside, after its start.
    pub entry_s: Option<f64>,
}

/// Of a flown state, one a phase of the problem: inside some set of states that are unsafe there,
/// as the service says. Empty unless the mission asks for it.
pub type UnsafeSets = Vec<bool>;

impl Drift {
    fn of(course: &Course, region: &Region) -> Self {
        let found = Clearance::of(course, region);
        Self {
            least_gauge: found.least_gauge_sampled,
            least_gauge_throughout: found.least_gauge,
            least_distance_m: found.least_distance_m,
            entry_s: found.entry_s,
        }
    }
}

/// What moves a flight.
#[derive(Debug)]
pub(crate) struct World {
    truth: RelativeTruth,
    mass_kg: f64,
    step_s: f64,
}

impl World {
    pub(crate) fn new(mission: &AbortMission, case: &AbortCase) -> Result<Self, SimulationError> {
        let truth = relative_truth(mission, case, case.truth)?;
        let model = &case.model;
        Ok(Self { truth, mass_kg: model.mass_kg, step_s: model.sample_time_s })
    }

    /// The state one step after `state`, which holds at step `k`, under a force held along RTN.
    pub(crate) fn advance(
        &self,
        k: u32,
        state: &Vector6<f64>,
        force_n: &Vector3<f64>,
    ) -> Vector6<f64> {
        let time_s = f64::from(k) * self.step_s;
        self.truth.advance(time_s, state, self.step_s, &(force_n / self.mass_kg))
    }
}

/// Judges courses by the mission's own regions, whatever a variant makes of its problem.
#[derive(Debug)]
pub(crate) struct Judge {
    truths: Vec<RelativeTruth>,
    /// The linear one that starts are judged by.
    linear: RelativeTruth,
    own: AbortModel,
    law: DriftLaw,
    mass_kg: f64,
    step_s: f64,
    drift_s: f64,
}

impl Judge {
    pub(crate) fn new(mission: &AbortMission, case: &AbortCase) -> Result<Self, SimulationError> {
        let law = mission.simulation.drift.clone();
        let truths: Result<_, _> =
            law.truths.iter().map(|truth| relative_truth(mission, case, *truth)).collect();
        Ok(Self {
            truths: truths?,
            linear: relative_truth(mission, case, AbortTruth::Linear)?,
            own: mission.model()?,
            drift_s: law.periods * case.model.period_s(),
            law,
            mass_kg: case.model.mass_kg,
            step_s: case.model.sample_time_s,
        })
    }

    /// What becomes of a state in a phase if all thrusters fail, one verdict a truth of the
    /// mission; none in phases that do not promise to survive that.
    pub(crate) fn drifts(&self, k: u32, state: &Vector6<f64>, phase: usize) -> Vec<Drift> {
        match self.own.phases.get(phase) {
            Some(phase) if phase.kind == PhaseKind::Passive => {
                self.after(k, state, phase.region.as_ref(), &[])
            }
            _ => Vec::new(),
        }
    }

    /// What becomes of a state under `forces_n`, one a step, and drift after them.
    pub(crate) fn after(
        &self,
        k: u32,
        state: &Vector6<f64>,
        region: Option<&Region>,
        forces_n: &[Vector3<f64>],
    ) -> Vec<Drift> {
        let Some(region) = region else { return Vec::new() };
        let time_s = f64::from(k) * self.step_s;
        let course = |truth: &RelativeTruth| match forces_n {
            [] => truth.drift(time_s, state, self.drift_s, self.law.sample_s),
            forces => {
                let (accelerations, spacing_s) = self.held(forces);
                truth.fly(time_s, state, &accelerations, spacing_s)
            }
        };
        self.truths.iter().map(|truth| Drift::of(&course(truth), region)).collect()
    }

    /// Accelerations at the mission's sampling: as many equal parts of a step as reach it.
    fn held(&self, forces_n: &[Vector3<f64>]) -> (Vec<Vector3<f64>>, f64) {
        let parts = (self.step_s / self.law.sample_s - 1e-9).ceil().max(1.0);
        let a_step = |force: &Vector3<f64>| vec![force / self.mass_kg; parts as usize];
        (forces_n.iter().flat_map(a_step).collect(), self.step_s / parts)
    }

    /// Least squared gauge of a state's free drift over the first phase's safety horizon, as the
    /// linear truth has it; `None` if that phase has no region.
    pub(crate) fn gauge_squared_of_start(&self, state: &Vector6<f64>) -> Option<f64> {
        let phase = self.own.phases.first()?;
        let duration_s = f64::from(phase.horizon_steps) * self.step_s;
        let course = self.linear.drift(0.0, state, duration_s, self.step_s);
        Some(Drift::of(&course, phase.region.as_ref()?).least_gauge.powi(2))
    }

    /// The region that judges flights in a phase.
    pub(crate) fn region(&self, phase: usize) -> Option<&Region> {
        self.own.phases.get(phase)?.region.as_ref()
    }

    /// Gauge of a state's position in the region of a phase.
    pub(crate) fn gauge(&self, phase: usize, state: &Vector6<f64>) -> Option<f64> {
        Some(self.region(phase)?.gauge(&state.fixed_rows::<3>(0).into()))
    }

    /// Steps that a flight goes on after a failure.
    pub(crate) fn steps_after_failure(&self) -> u32 {
        (self.drift_s / self.step_s).round().max(1.0) as u32
    }
}

/// The truth for as long as a flight of this case can last, drift after it included.
pub(crate) fn relative_truth(
    mission: &AbortMission,
    case: &AbortCase,
    truth: AbortTruth,
) -> Result<RelativeTruth, SimulationError> {
    let model = &case.model;
    let law = match truth {
        AbortTruth::Linear => Law::Linear,
        AbortTruth::Nonlinear { j2, sun_moon } => {
            Law::Newton { j2, sun_moon_from: model.epoch.filter(|_| sun_moon) }
        }
    };
    let drift = &mission.simulation.drift;
    let steps = f64::from(case.steps_max()) * model.sample_time_s;
    // One sample more than a drift from the last step, whose last instant may lie beyond it.
    let horizon = model.phases.iter().map(|phase| phase.horizon_steps).max().unwrap_or(0);
    let after = (drift.periods * model.period_s()).max(f64::from(horizon) * model.sample_time_s);
    let duration_s = steps + after + drift.sample_s + model.sample_time_s;
    RelativeTruth::new(&model.elements, law, duration_s).ok_or_else(|| {
        let fault = "the epoch lies outside the years for which Sun and Moon are known";
        MissionError::Invalid(vec![fault.into()]).into()
    })
}
