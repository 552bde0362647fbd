//! A measured state that is unsafe already: which set holds it, and where it would not be.

use std::collections::BTreeMap;

use super::{UnsafeState, artifact::PhaseSets, safety::Judge};
use crate::{
    budget::{Budget, Interruption},
    dynamics::RelativeVector,
    mission::ThrustMode,
    program::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status},
    reach::{Cut, cut_off_ellipsoid, cut_off_polytope},
};

/// Rounds of cutting off the sets that still hold the state. Ten were always enough where a state
/// was found at all.
const ROUNDS_MAX: usize = 40;
/// How far beyond a half-space the state found lies, in its own units: more than the solver's
/// rounding, less than anyone cares for.
const BEYOND: f64 = 1e-6;

/// A set that holds a state.
struct Holding {
    working: ThrustMode,
    instant: usize,
    gauge: f64,
    cut: Option<Cut>,
}

impl Judge<'_> {
    /// What is wrong with the state x at time index k; `None` outside every set of that index.
    pub(super) fn unsafe_state(
        &self,
        k: usize,
        x: &RelativeVector,
        budget: Budget<'_>,
    ) -> Result<Option<UnsafeState>, Interruption> {
        let holding = self.holding(k, x);
        let deepest = holding.iter().min_by(|a, b| a.gauge.total_cmp(&b.gauge));
        let Some(deepest) = deepest else { return Ok(None) };
        let earliest = holding.iter().map(|set| set.instant).min().unwrap_or(deepest.instant);
        let plant = &self.prepared.plant;
        let spacing_s = plant.sample_time().seconds() / plant.fraction_count() as f64;
        Ok(Some(UnsafeState {
            working: deepest.working,
            doomed_after_s: earliest as f64 * spacing_s,
            instant: deepest.instant,
            gauge: deepest.gauge,
            outside: self.nearest_outside(k, x, holding, budget)?,
        }))
    }

    /// The sets of time index k that hold x, each with a half-space that leaves it.
    fn holding(&self, k: usize, x: &RelativeVector) -> Vec<Holding> {
        // Through the common centre there is no tangent: any way out will do.
        let away = if x.norm() > 0.0 { *x } else { RelativeVector::repeat(1.0) };
        match &self.prepared.sets {
            PhaseSets::None => Vec::new(),
            PhaseSets::Ellipsoids { union, .. } => {
                let mut gauges = Vec::new();
                union.gauges_squared(k, x, &mut gauges);
                let held = gauges.iter().enumerate().filter(|(_, gauge)| **gauge <= 1.0);
                held.map(|(instant, gauge)| Holding {
                    working: ThrustMode::NONE,
                    instant,
                    gauge: gauge.sqrt(),
                    cut: cut_off_ellipsoid(union, k, instant, &away),
                })
                .collect()
            }
            PhaseSets::Polytopes { union, modes, .. } => union
                .sets(k)
                .filter(|set| set.contains(x))
                .map(|set| Holding {
                    working: modes[set.mode],
                    instant: set.instant,
                    gauge: set.nearness(x),
                    cut: cut_off_polytope(&set, x),
                })
                .collect(),
        }
    }

    /// A state near x that no set of time index k holds: half-spaces off the sets that do, the
    /// nearest point beyond them, and again from there. Near is metres, and metres per second
    /// over the mean motion, in which drift turns speed into distance. `None` if the half-spaces
    /// contradict each other before a state is found.
    fn nearest_outside(
        &self,
        k: usize,
        x: &RelativeVector,
        mut holding: Vec<Holding>,
        budget: Budget<'_>,
    ) -> Result<Option<RelativeVector>, Interruption> {
        let rate = self.problem.orbit.mean_motion_rad_s();
        let unit = |i: usize| if i < 3 { 1.0 } else { rate };
        let mut cuts: BTreeMap<(usize, ThrustMode), Cut> = BTreeMap::new();
        let cost = QuadraticCost::identity(6);
        for _ in 0..ROUNDS_MAX {
            budget.check()?;
            for set in &holding {
                let Some(cut) = set.cut else { return Ok(None) };
                cuts.insert((set.instant, set.working), cut);
            }
            let mut rows = DenseRows::new(6);
            let mut offsets = Vec::with_capacity(cuts.len());
            for cut in cuts.values() {
                let row: [f64; 6] = std::array::from_fn(|i| -cut.normal[i] * unit(i));
                rows.push(&row);
                offsets.push(cut.normal.dot(x) - cut.offset - BEYOND);
            }
            let program = QuadraticProgram {
                cost: &cost,
                gradient: &[0.0; 6],
                rows: &rows,
                offsets: &offsets,
            };
            let solution = DualActiveSet::default().solve(&program, &[], budget)?;
            if solution.status != Status::Optimal {
                return Ok(None);
            }
            let y = RelativeVector::from_fn(|i, _| x[i] + solution.point[i] * unit(i));
            holding = self.holding(k, &y);
            if holding.is_empty() {
                return Ok(Some(y));
            }
        }
        Ok(None)
    }
}
