//! The half-spaces that predicted states are kept in.

use nalgebra::Vector3;

use super::{Separation, SetTiming, State, artifact::PhaseSets, step::Here};
use crate::{
    control::{Failure, StepError},
    dynamics::RelativeVector,
    program::StateCut,
    reach::{
        Cut, EllipsoidUnion, NearEllipsoid, ReachablePolytope, cut_off_ellipsoid,
        cut_off_ellipsoids, cut_off_polytope, cut_off_polytopes,
    },
};

/// Half-spaces with the least clearance of the points they were made for.
pub(super) struct Cuts {
    pub(super) cuts: Vec<StateCut>,
    pub(super) least_clearance: f64,
}

impl Here<'_> {
    /// The points that half-spaces are made for: the last prediction, one step on, its end
    /// drifting; the state itself everywhere when there is none. [AguilarMarsillach2022, alg. 1]
    pub(super) fn points(&self, state: &State) -> Vec<RelativeVector> {
        let n = self.problem.prediction_horizon;
        if state.prediction.len() != n + 1 {
            return vec![self.x; n + 1];
        }
        let mut points = state.prediction[1..].to_vec();
        points[0] = self.x;
        let end = state.prediction[n];
        points.push(self.prepared.plant.advance(self.k + n - 1, &end, &Vector3::zeros()));
        points
    }

    pub(super) fn cuts(&self, points: &[RelativeVector]) -> Result<Cuts, StepError> {
        let mut cuts = Cuts { cuts: Vec::new(), least_clearance: f64::INFINITY };
        let Some(watch) = self.phase.safety.watch() else { return Ok(cuts) };
        for (stage, point) in points.iter().enumerate().skip(1) {
            self.budget.check()?;
            for cut in self.cuts_at(self.k + stage, point, watch.nearest) {
                let Cut { normal, offset, clearance } = cut
                    .ok_or_else(|| Failure::Numerical(format!("no half-space at stage {stage}")))?;
                cuts.least_clearance = cuts.least_clearance.min(clearance);
                let offset = offset + self.problem.clearance;
                cuts.cuts.push(StateCut { stage, normal, offset });
            }
        }
        Ok(cuts)
    }

    /// Half-spaces off the `count` nearest sets that threaten a state at time index k.
    fn cuts_at(&self, k: usize, x: &RelativeVector, count: usize) -> Vec<Option<Cut>> {
        let timed = self.problem.timing == SetTiming::Timed;
        match &self.prepared.sets {
            PhaseSets::None => Vec::new(),
            PhaseSets::Ellipsoids { union, .. } => {
                let near = if timed {
                    union.nearest(k, x, count)
                } else {
                    union.nearest_untimed(x, count)
                };
                self.off_ellipsoids(union, &near, x)
            }
            PhaseSets::Polytopes { union, .. } => {
                let near = if timed {
                    union.nearest(k, x, count)
                } else {
                    union.nearest_untimed(x, count)
                };
                self.off_polytopes(&near, x)
            }
        }
    }

    fn off_ellipsoids(
        &self,
        union: &EllipsoidUnion,
        near: &[NearEllipsoid],
        x: &RelativeVector,
    ) -> Vec<Option<Cut>> {
        if self.problem.separation == Separation::SecondOrderCone
            && let Some(common) = cut_off_ellipsoids(union, near, x)
        {
            return vec![Some(common)];
        }
        // The origin is the centre of all: no half-space leaves it out, any will do.
        let away = if x.norm() > 0.0 { *x } else { RelativeVector::repeat(1.0) };
        let cut = |set: &NearEllipsoid| cut_off_ellipsoid(union, set.start, set.instant, &away);
        near.iter().map(cut).collect()
    }

    fn off_polytopes(
        &self,
        near: &[(f64, ReachablePolytope<'_>)],
        x: &RelativeVector,
    ) -> Vec<Option<Cut>> {
        if self.problem.separation == Separation::LinearProgram
            && let Some(common) = cut_off_polytopes(near.iter().map(|(_, set)| set), x)
        {
            return vec![Some(common)];
        }
        near.iter().map(|(_, set)| cut_off_polytope(set, x)).collect()
    }
}
