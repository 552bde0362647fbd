//! The baseline that believes the expected plant: linear-quadratic MPC.

use nalgebra::DMatrix;

use super::{
    Artifact, GroupSummary, Problem, RowOrigin,
    artifact::Parts,
    design::{Design, assembled, no_set},
};
use crate::{
    budget::Budget,
    control::PrepareError,
    dynamics::{ExpectedCost, Prediction, StageWeights},
    reach::{EXACT, HalfSpaces, StageConstraints, StageGroup, irredundant},
    sampling::ScalarLaw,
};

/// The artifact of [`super::Scheme::LinearQuadratic`]: one prediction, that of the expected plant.
pub(super) fn prepare(problem: &Problem, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
    let design = Design::new(problem, budget)?;
    let drift = problem.disturbance.iter().map(ScalarLaw::mean).collect();
    let nominal = Nominal::new(problem, &design.gain, drift);
    let cost = nominal.cost(&design.weights);
    let (rows, groups) = nominal.rows(&design.constraints, &design.groups);
    let none = HalfSpaces::new(rows.dimension());
    let reduction = irredundant(&rows, &none, EXACT, budget).map_err(|reason| no_set(&reason))?;
    let kept: Vec<StageGroup> = reduction.kept.iter().map(|&row| groups[row]).collect();
    let mut summary = design.summary(summaries(&design.groups, &groups, &kept));
    summary.doubtful_rows = reduction.doubtful;
    summary.outer_excess = reduction.outer_excess;
    let parts = Parts {
        problem: problem.clone(),
        summary,
        cost,
        rows: rows.select(&reduction.kept),
        origins: kept.into_iter().map(RowOrigin::Stage).collect(),
        terminal_set: design.constraints.terminal,
        first_step_set: None,
    };
    assembled(parts, budget)
}

/// What is predicted where nothing is sampled.
pub(super) struct Nominal {
    prediction: Prediction,
}

impl Nominal {
    /// The expected plant, pushed at every step by the disturbance `w`.
    pub(super) fn new(problem: &Problem, gain: &DMatrix<f64>, w: Vec<f64>) -> Self {
        let steps = vec![problem.plant.at_mean(); problem.horizon];
        let pushes = vec![w; problem.horizon];
        Self { prediction: Prediction::new(&steps, &pushes, gain, problem.horizon) }
    }

    /// S over (z_0, v, 1).
    pub(super) fn cost(&self, weights: &StageWeights) -> DMatrix<f64> {
        let width = self.prediction.states[0].ncols();
        let mut cost = ExpectedCost::new(width);
        cost.add(&self.prediction, weights);
        cost.mean()
    }

    /// Every group's rows over (z_0, v), and the group of each.
    pub(super) fn rows(
        &self,
        constraints: &StageConstraints,
        groups: &[StageGroup],
    ) -> (HalfSpaces, Vec<StageGroup>) {
        let mut rows = HalfSpaces::new(self.prediction.states[0].ncols() - 1);
        let mut origins = Vec::new();
        for &group in groups {
            let faces: Vec<usize> = (0..constraints.of(group.family).len()).collect();
            constraints.push_rows(group, &faces, &self.prediction, &mut rows);
            origins.resize(rows.len(), group);
        }
        (rows, origins)
    }
}

/// What became of every group, where each has one prediction.
pub(super) fn summaries(
    groups: &[StageGroup],
    all: &[StageGroup],
    kept: &[StageGroup],
) -> Vec<GroupSummary> {
    let count = |list: &[StageGroup], group| list.iter().filter(|&&other| other == group).count();
    let summary = |&group: &StageGroup| GroupSummary {
        group,
        samples: 0,
        rows: count(all, group),
        kept: count(kept, group),
    };
    groups.iter().map(summary).collect()
}
