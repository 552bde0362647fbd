//! A scenario program made small: sampled rows, part by part, without those that do not matter.
//!
//! The parts are independent: [`Scenario::survivors`] of one needs nothing of the others but a
//! small context that every part can make for itself. So parts are shards, and
//! [`Scenario::merged`] of their survivors, in order, is the same on any machine.

use nalgebra::DMatrix;

use super::{
    EXACT, ExtremeCheck, HalfSpaces, InteriorPoint, NoInterior, ReadError, Reduction,
    StageConstraints, StageFamily, StageGroup, check_extremes, irredundant, irredundant_about,
};
use crate::{
    budget::{Budget, Interruption},
    bytes::{Reader, Writer},
    dynamics::{PlantMatrices, Prediction, UncertainPlant},
    sampling::{ScalarLaw, Stream},
};

/// Samples of every group that the context is chosen from.
const CONTEXT_SAMPLES: usize = 12;
/// Rows that cut off less than this are not chosen: any choice would do, and a small one is fast.
const CONTEXT_TOLERANCE: f64 = 0.05;
/// Share of the terminal set's inner point in the point that rows are measured about: whatever is
/// sampled leaves room there, because the terminal set is invariant without corrections.
const TERMINAL_SHARE: f64 = 0.2;
/// Extreme points at which the removed rows of a part, or of all parts, are looked at.
const CHECKED_POINTS: usize = 48;

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

/// Some constraints of a group: every `stride`-th face, from `first`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupPart {
    /// Index of the group.
    pub group: usize,
    /// The first face.
    pub first: usize,
    /// From a face to the next.
    pub stride: usize,
}

impl GroupPart {
    /// All faces of a group.
    #[must_use]
    pub fn whole(group: usize) -> Self {
        Self { group, first: 0, stride: 1 }
    }
}

/// What stays in every reduction.
#[derive(Debug, Clone, PartialEq)]
pub struct Context {
    /// Some rows of the first few samples of every group.
    pub rows: SampledRows,
    /// The point that rows are measured about.
    pub centre: InteriorPoint,
}

/// What is left of a part, or of all.
#[derive(Debug, Clone, PartialEq)]
pub struct Survivors {
    /// The rows, as they were sampled.
    pub rows: SampledRows,
    /// Every removed row holds within 1 + this wherever these rows and the context hold, measured
    /// about the context's centre.
    pub outer_excess: f64,
    /// Rows kept because no certificate for their removal was accepted.
    pub doubtful: usize,
    /// Removed rows at extreme points of what is left.
    pub check: ExtremeCheck,
}

impl Survivors {
    fn new(
        reduction: &Reduction,
        candidates: &HalfSpaces,
        context: &HalfSpaces,
        groups: impl Fn(usize) -> usize,
        budget: Budget<'_>,
    ) -> Result<Self, NoInterior> {
        let rows = candidates.select_within(&reduction.kept, budget)?;
        let left = rows.with(context, budget)?;
        let centre = &reduction.interior;
        let check = check_extremes(&left, candidates, centre, CHECKED_POINTS, budget)?;
        Ok(Self {
            rows: SampledRows { rows, groups: reduction.kept.iter().map(|&i| groups(i)).collect() },
            outer_excess: reduction.outer_excess,
            doubtful: reduction.doubtful,
            check,
        })
    }

    /// Appends what is left of one part, whose rows are all of one group.
    pub(crate) fn write(&self, writer: &mut Writer) {
        self.rows.rows.write(writer);
        writer.number(self.outer_excess);
        writer.count(self.doubtful);
        writer.count(self.check.points);
        // A row that a point violates without end.
        let excess = Some(self.check.excess).filter(|excess| excess.is_finite());
        writer.option(excess, Writer::number);
    }

    /// Reads what [`Self::write`] wrote of a part of `group`, for rows of so many coordinates.
    pub(crate) fn read(
        reader: &mut Reader<'_>,
        group: usize,
        dimension: usize,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let rows = HalfSpaces::read(reader, budget)?;
        if rows.dimension() != dimension {
            return Err(reader.fault("rows of another problem").into());
        }
        Ok(Self {
            rows: SampledRows { groups: vec![group; rows.len()], rows },
            outer_excess: reader.number()?,
            doubtful: reader.count()?,
            check: ExtremeCheck {
                points: reader.count()?,
                excess: reader.option(Reader::number)?.unwrap_or(f64::INFINITY),
            },
        })
    }

    /// The rows, moved towards `centre` by 1 / (1 + the excess): an inner set, whose every point
    /// satisfies the removed rows too.
    #[must_use]
    pub fn inner(&self, centre: &InteriorPoint) -> HalfSpaces {
        self.rows.rows.towards(&centre.point, 1.0 / (1.0 + self.outer_excess))
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

    /// Rows of a part for these samples, over (x, v_0 .. v_{T-1}).
    ///
    /// The input of stage 0 is K x + v_0 whatever the sample: one is enough.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn rows(
        &self,
        part: GroupPart,
        samples: std::ops::Range<usize>,
        budget: Budget<'_>,
    ) -> Result<HalfSpaces, Interruption> {
        let stage_group = self.groups[part.group];
        let certain = stage_group == StageGroup { family: StageFamily::Input, stage: 0 };
        let faces = self.constraints.of(stage_group.family).len();
        let chosen: Vec<usize> = (part.first..faces).step_by(part.stride.max(1)).collect();
        let (m, n) = self.gain.shape();
        let mut rows = HalfSpaces::new(n + self.horizon * m);
        for sample in samples.take(if certain { 1 } else { usize::MAX }) {
            budget.check()?;
            let prediction = self.prediction(part.group as u64, sample, stage_group.steps());
            self.constraints.push_rows(stage_group, &chosen, &prediction, &mut rows);
        }
        // All samples of one constraint, then of the next: neighbours are nearly parallel, and a
        // row that lies behind another is found at once.
        let count = chosen.len().max(1);
        let order: Vec<usize> =
            (0..count).flat_map(|face| (face..rows.len()).step_by(count)).collect();
        rows.select_within(&order, budget)
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

    /// The rows that matter most among the first few samples of every group. They stay in every
    /// part's reduction, so that it sees what the others do to the set.
    ///
    /// # Errors
    /// [`NoInterior`]: the sampled set is empty or flat already.
    pub fn context(&self, budget: Budget<'_>) -> Result<Context, NoInterior> {
        let (m, n) = self.gain.shape();
        let none = HalfSpaces::new(n + self.horizon * m);
        let mut all = SampledRows { rows: none.clone(), groups: Vec::new() };
        for group in 0..self.groups.len() {
            let first = 0..CONTEXT_SAMPLES.min(self.sizes[group]);
            let rows = self.rows(GroupPart::whole(group), first, budget)?;
            all.extend(&rows, std::iter::repeat_n(group, rows.len()));
        }
        let reduction = irredundant(&all.rows, &none, CONTEXT_TOLERANCE, budget)?;
        let inside = self.constraints.terminal.interior_point(budget)?;
        let inside = inside.point.into_iter().chain(std::iter::repeat(0.0));
        let point: Vec<f64> = (reduction.interior.point.iter().zip(inside))
            .map(|(ball, terminal)| ball + TERMINAL_SHARE * (terminal - ball))
            .collect();
        let rows = all.select(&reduction.kept);
        let room = rows.rows.room(&point, budget)?;
        Ok(Context { rows, centre: InteriorPoint { point, room } })
    }

    /// The rows of a part that are needed beside the context; `tolerance` as in [`irredundant`].
    ///
    /// # Errors
    /// [`NoInterior`].
    pub fn survivors(
        &self,
        part: GroupPart,
        context: &Context,
        tolerance: f64,
        budget: Budget<'_>,
    ) -> Result<Survivors, NoInterior> {
        let rows = self.rows(part, 0..self.sizes[part.group], budget)?;
        let rows = nearest_first(&rows, self.sizes[part.group], &context.centre, budget)?;
        let beside = &context.rows.rows;
        let reduction = irredundant_about(&context.centre, &rows, beside, tolerance, budget)?;
        Survivors::new(&reduction, &rows, beside, |_| part.group, budget)
    }

    /// All survivors, in order, and the context, reduced together by `tolerance`: the excess of the
    /// result holds for every row that was sampled.
    ///
    /// # Errors
    /// [`NoInterior`].
    pub fn merged(
        context: &Context,
        parts: &[Survivors],
        tolerance: f64,
        budget: Budget<'_>,
    ) -> Result<Survivors, NoInterior> {
        let mut all = context.rows.select(&[]);
        for part in parts {
            budget.check()?;
            all.extend(&part.rows.rows, part.rows.groups.iter().copied());
        }
        let groups = |index| all.groups[index];
        let (centre, beside) = (&context.centre, &context.rows.rows);
        let reduction = irredundant_about(centre, &all.rows, beside, tolerance, budget)?;
        let mut merged = Survivors::new(&reduction, &all.rows, beside, groups, budget)?;
        // What the context was needed for is over: rows of it that are not needed go.
        let left = &merged.rows.rows;
        let reduction = irredundant_about(centre, beside, left, EXACT, budget.untold())?;
        let kept = context.rows.select(&reduction.kept);
        merged.rows.extend(&kept.rows, kept.groups);
        merged.doubtful += reduction.doubtful;
        merged.outer_excess = (1.0 + merged.outer_excess) * (1.0 + reduction.outer_excess) - 1.0;
        let before = parts.iter().map(|part| part.outer_excess).fold(0.0, f64::max);
        Ok(Survivors {
            // What is left of the parts holds within one factor, what they removed within both.
            outer_excess: (1.0 + before) * (1.0 + merged.outer_excess) - 1.0,
            doubtful: parts.iter().map(|part| part.doubtful).sum::<usize>() + merged.doubtful,
            check: parts.iter().fold(merged.check, |check, part| check.and(part.check)),
            ..merged
        })
    }
}

/// Bundles of `size` rows each, those nearest to the point first: later ones lie behind them.
fn nearest_first(
    rows: &HalfSpaces,
    size: usize,
    about: &InteriorPoint,
    budget: Budget<'_>,
) -> Result<HalfSpaces, Interruption> {
    let mut products = Vec::with_capacity(rows.len());
    rows.rows().products_within(&about.point, &mut products, budget)?;
    let distance = |row: usize| (rows.offset(row) - products[row]) * rows.rows().scale(row);
    let mut order: Vec<usize> = (0..rows.len()).collect();
    for bundle in order.chunks_mut(size.max(1)) {
        budget.check()?;
        bundle.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
    }
    rows.select_within(&order, budget)
}
