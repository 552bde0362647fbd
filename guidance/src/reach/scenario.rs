//! A scenario program made small: sampled rows, group by group, without those that do not matter.
//!
//! The groups are independent: [`Scenario::survivors`] of one needs nothing of the others but a
//! small context that every group can make for itself. So groups are shards, and
//! [`Scenario::merged`] of their survivors, in group order, is the same on any machine.

use nalgebra::DMatrix;

use super::{
    EXACT, HalfSpaces, NoInterior, Reduction, StageConstraints, StageFamily, StageGroup,
    irredundant,
};
use crate::{
    budget::{Budget, Interruption},
    dynamics::{PlantMatrices, Prediction, UncertainPlant},
    sampling::{ScalarLaw, Stream},
};

/// Samples of every group that make the context.
const CONTEXT_SAMPLES: usize = 24;
/// Samples between two looks at the budget.
const BUDGET_PERIOD: usize = 256;

/// What is sampled.
#[derive(Debug, Clone, Copy)]
pub struct Scenario<'a> {
    /// The plant and the laws of its parameters.
    pub plant: &'a UncertainPlant,
    /// Law of each component of w, drawn anew at every step.
    pub disturbance: &'a [ScalarLaw],
    /// K, m x n, of u = K x + v.
    pub gain: &'a DMatrix<f64>,
    /// T.
    pub horizon: usize,
    /// What must hold.
    pub constraints: &'a StageConstraints,
    /// The groups, in their order.
    pub groups: &'a [StageGroup],
    /// Samples of each group.
    pub sizes: &'a [usize],
    /// All chance follows from this.
    pub seed: u64,
}

/// Rows that remember their group.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SampledRows {
    /// Over (x, v_0 .. v_{T-1}).
    pub rows: HalfSpaces,
    /// Index of the group of every row.
    pub groups: Vec<usize>,
}

impl SampledRows {
    fn select(&self, kept: &[usize]) -> Self {
        Self {
            rows: self.rows.select(kept),
            groups: kept.iter().map(|&row| self.groups[row]).collect(),
        }
    }

    fn extend(&mut self, rows: &HalfSpaces, groups: impl IntoIterator<Item = usize>) {
        self.rows.extend(rows);
        self.groups.extend(groups);
        debug_assert_eq!(self.rows.len(), self.groups.len());
    }
}

impl Scenario<'_> {
    /// The prediction of sample `sample`, over `steps` steps; `stream` is the index of a group, or
    /// any other number for samples apart from those of the groups.
    #[must_use]
    pub fn prediction(&self, stream: u64, sample: usize, steps: usize) -> Prediction {
        let mut stream = Stream::new(self.seed, stream, sample as u64);
        let mut matrices: Vec<PlantMatrices> = Vec::with_capacity(steps);
        let mut disturbances = Vec::with_capacity(steps);
        for _ in 0..steps {
            matrices.push(self.plant.draw(&mut stream));
            disturbances.push(self.disturbance.iter().map(|law| law.draw(&mut stream)).collect());
        }
        Prediction::new(&matrices, &disturbances, self.gain, self.horizon)
    }

    /// Rows of group `group` for these samples, over (x, v_0 .. v_{T-1}).
    ///
    /// The input of stage 0 is K x + v_0 whatever the sample: one is enough.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn rows(
        &self,
        group: usize,
        samples: std::ops::Range<usize>,
        budget: Budget<'_>,
    ) -> Result<HalfSpaces, Interruption> {
        let stage_group = self.groups[group];
        let certain = stage_group == StageGroup { family: StageFamily::Input, stage: 0 };
        let (m, n) = self.gain.shape();
        let mut rows = HalfSpaces::new(n + self.horizon * m);
        for sample in samples.take(if certain { 1 } else { usize::MAX }) {
            if sample % BUDGET_PERIOD == 0 {
                budget.check()?;
            }
            let prediction = self.prediction(group as u64, sample, stage_group.steps());
            self.constraints.push_rows(stage_group, &prediction, &mut rows);
        }
        // All samples of one constraint, then of the next: neighbours are nearly parallel, and a
        // row that lies behind another is found at once.
        let faces = self.constraints.of(stage_group.family).len();
        let order: Vec<usize> =
            (0..faces).flat_map(|face| (face..rows.len()).step_by(faces)).collect();
        Ok(rows.select(&order))
    }

    /// Rows of all groups, had none been removed.
    #[must_use]
    pub fn row_count(&self) -> usize {
        (0..self.groups.len()).map(|group| self.group_row_count(group)).sum()
    }

    /// Rows of a group, had none been removed.
    #[must_use]
    pub fn group_row_count(&self, group: usize) -> usize {
        let StageGroup { family, stage } = self.groups[group];
        let certain = family == StageFamily::Input && stage == 0;
        self.constraints.of(family).len() * if certain { 1 } else { self.sizes[group] }
    }

    /// The needed rows among the first few samples of every group. They stay in every reduction,
    /// so that a group sees what the others do to the set.
    ///
    /// # Errors
    /// [`NoInterior`]: the sampled set is empty or flat already.
    pub fn context(&self, budget: Budget<'_>) -> Result<SampledRows, NoInterior> {
        let (m, n) = self.gain.shape();
        let none = HalfSpaces::new(n + self.horizon * m);
        let mut all = SampledRows { rows: none.clone(), groups: Vec::new() };
        for group in 0..self.groups.len() {
            let rows = self.rows(group, 0..CONTEXT_SAMPLES.min(self.sizes[group]), budget)?;
            all.extend(&rows, std::iter::repeat_n(group, rows.len()));
        }
        let kept = irredundant(&all.rows, &none, EXACT, budget)?.kept;
        Ok(all.select(&kept))
    }

    /// The rows of a group that are needed beside the context.
    ///
    /// # Errors
    /// [`NoInterior`].
    pub fn survivors(
        &self,
        group: usize,
        context: &SampledRows,
        budget: Budget<'_>,
    ) -> Result<SampledRows, NoInterior> {
        let first = CONTEXT_SAMPLES.min(self.sizes[group]);
        let rows = self.rows(group, first..self.sizes[group], budget)?;
        let kept = irredundant(&rows, &context.rows, EXACT, budget)?.kept;
        Ok(SampledRows { rows: rows.select(&kept), groups: vec![group; kept.len()] })
    }

    /// All survivors, in group order, and the context, reduced together; `tolerance` as in
    /// [`irredundant`].
    ///
    /// # Errors
    /// [`NoInterior`].
    pub fn merged(
        context: &SampledRows,
        survivors: &[SampledRows],
        tolerance: f64,
        budget: Budget<'_>,
    ) -> Result<(SampledRows, Reduction), NoInterior> {
        let mut all = context.clone();
        for part in survivors {
            all.extend(&part.rows, part.groups.iter().copied());
        }
        let none = HalfSpaces::new(all.rows.dimension());
        let reduction = irredundant(&all.rows, &none, tolerance, budget)?;
        let mut kept = all.select(&reduction.kept);
        if tolerance > EXACT {
            kept.rows = reduction.inner(&all.rows);
        }
        Ok((kept, reduction))
    }
}
