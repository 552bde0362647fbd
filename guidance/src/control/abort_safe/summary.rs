//! What an artifact holds, to be shown.

use super::{
    Artifact, Phase, Safety,
    artifact::{PhaseSets, PreparedPhase},
};
use crate::{
    mission::{ThrustMode, dominating_modes},
    units::Seconds,
};

/// Samples that miss a revolution by less than this part of a step are not worth a warning.
const FOLD_ERROR_SMALL: f64 = 1e-3;

/// What an artifact holds, to be shown.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Length of a step.
    pub step: Seconds,
    /// kp steps minus one revolution.
    pub fold_error: Seconds,
    /// One a phase.
    pub phases: Vec<PhaseSummary>,
}

/// One phase of a [`Summary`].
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseSummary {
    /// Backward reachable sets that are not empty, over all starts, of the dominating modes.
    pub sets: usize,
    /// Those that all modes that were asked for would have, if they were counted.
    pub sets_of_all_modes: Option<usize>,
    /// Bytes of their numbers.
    pub size_bytes: usize,
    /// Modes whose sets hold those of all modes that were asked for.
    pub dominating_modes: Vec<ThrustMode>,
    /// The bound on speeds, m/s, if a plausible approach is faster: such an approach would pass
    /// through the region unseen.
    pub hides_approaches_above_m_s: Option<f64>,
    /// Metres that the fastest plausible approach flies between two instants, if that is more than
    /// the region's narrowest width: such an approach would pass through it between them.
    pub crosses_unseen_m: Option<f64>,
    /// The region is an ellipsoid, but active modes need a polytope: the box around it is used.
    pub outer_box: bool,
}

impl Artifact {
    /// What it holds.
    #[must_use]
    pub fn summary(&self) -> Summary {
        let phases = self.problem().phases.iter().zip(&self.phases);
        Summary {
            step: self.problem().sample_time,
            fold_error: self
                .phases
                .first()
                .map_or(Seconds::from_seconds(0.0), |phase| phase.plant.fold_error()),
            phases: phases.map(|(asked, prepared)| self.phase_summary(asked, prepared)).collect(),
        }
    }

    fn phase_summary(&self, asked: &Phase, prepared: &PreparedPhase) -> PhaseSummary {
        let (sets, sets_of_all_modes, size_bytes) = match &prepared.sets {
            PhaseSets::None => (0, Some(0), 0),
            PhaseSets::Ellipsoids { union, .. } => {
                (union.len(), Some(union.len()), union.size_bytes())
            }
            PhaseSets::Polytopes { union, sets_of_all_modes, .. } => {
                (union.len(), *sets_of_all_modes, union.size_bytes())
            }
        };
        let fastest = self.problem().fastest_approach_m_s;
        let watch = asked.safety.watch();
        let interval_s =
            prepared.plant.sample_time().seconds() / prepared.plant.fraction_count() as f64;
        PhaseSummary {
            sets,
            sets_of_all_modes,
            size_bytes,
            dominating_modes: dominating_modes(asked.safety.modes()),
            hides_approaches_above_m_s: watch
                .and_then(|watch| watch.avoid.hides_approaches_above(fastest)),
            crosses_unseen_m: watch
                .filter(|watch| fastest * interval_s > watch.avoid.narrowest_width_m())
                .map(|_| fastest * interval_s),
            outer_box: matches!(&asked.safety, Safety::Active { watch, .. }
                if !watch.avoid.is_polytope()),
        }
    }
}

impl Summary {
    /// What the caller should know before flying, one sentence each.
    #[must_use]
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        let miss = self.fold_error.seconds();
        if miss.abs() > self.step.seconds() * FOLD_ERROR_SMALL {
            warnings.push(format!(
                "the samples of a revolution miss it by {miss} s: the sets drift from the orbit by \
                 as much with every revolution"
            ));
        }
        for (i, phase) in self.phases.iter().enumerate() {
            let mut say = |what: String| warnings.push(format!("phases[{i}]: {what}"));
            if let Some(bound) = phase.hides_approaches_above_m_s {
                say(format!(
                    "approaches faster than {bound} m/s pass through the region unseen, and faster \
                     ones are plausible: raise its bound on speeds"
                ));
            }
            if let Some(way) = phase.crosses_unseen_m {
                say(format!(
                    "a plausible approach flies {way} m between two instants, more than the region \
                     is wide: cut steps into more fractions"
                ));
            }
            if phase.outer_box {
                say("active modes need a polytope: the box around the ellipsoid is used".into());
            }
        }
        warnings
    }
}
