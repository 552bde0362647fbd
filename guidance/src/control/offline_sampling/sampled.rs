//! The offline part of the method itself, in shards: sampled rows, expected cost, first-step set.

use super::{
    Artifact, GroupSummary, Problem, Redundancy, RowOrigin, Scheme, Summary,
    artifact::Parts,
    design::{Design, assembled, no_set},
};
use crate::{
    budget::Budget,
    bytes::{Reader, Writer},
    control::{Failure, Fault, PrepareError},
    dynamics::ExpectedCost,
    reach::{
        EXACT, GroupPart, Growth, GrowthError, GrowthLimits, HalfSpaces, ReadError, SampledRows,
        Scenario, StageFamily, StageGroup, Survivors, grow_control_invariant, irredundant,
        step_back,
    },
    sampling::failure_of_any,
};

/// Stream of the samples of the expected cost, apart from those of the groups.
const COST_STREAM: u64 = u64::MAX;

/// Part of an artifact.
#[derive(Debug, Clone, PartialEq)]
pub struct Shard {
    /// Its place among all.
    pub(super) index: usize,
    pub(super) part: ShardPart,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum ShardPart {
    /// The rows of one part of a group that are needed beside the context.
    Rows(Survivors),
    /// The expected cost.
    Cost(ExpectedCost),
    /// Everything: the baselines take milliseconds.
    Whole(Box<Artifact>),
}

impl Shard {
    /// The rows that are left of its part of a group, if it has one.
    #[must_use]
    pub fn survivors(&self) -> Option<&Survivors> {
        match &self.part {
            ShardPart::Rows(rows) => Some(rows),
            ShardPart::Cost(_) | ShardPart::Whole(_) => None,
        }
    }

    pub(super) fn write(&self, writer: &mut Writer) {
        match &self.part {
            ShardPart::Rows(rows) => rows.write(writer),
            ShardPart::Cost(cost) => cost.write(writer),
            ShardPart::Whole(artifact) => artifact.write_found(writer),
        }
    }

    pub(super) fn read(
        problem: &Problem,
        index: usize,
        reader: &mut Reader<'_>,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let (n, m) = problem.dimensions();
        let width = n + problem.horizon * m;
        let part = match (problem.scheme, parts(problem).get(index)) {
            (Scheme::LinearQuadratic | Scheme::TubeRobust, _) => {
                let whole = Artifact::read_found(problem.clone(), reader, budget)?;
                ShardPart::Whole(Box::new(whole))
            }
            (Scheme::OfflineSampling, Some(part)) => {
                ShardPart::Rows(Survivors::read(reader, part.group, width, budget)?)
            }
            (Scheme::OfflineSampling, None) => {
                let samples = problem.weights.samples;
                ShardPart::Cost(ExpectedCost::read(reader, width + 1, samples)?)
            }
        };
        Ok(Self { index, part })
    }
}

/// A design with what is sampled.
struct Sampling<'a> {
    problem: &'a Problem,
    design: Design,
    sizes: Vec<usize>,
}

impl<'a> Sampling<'a> {
    fn new(problem: &'a Problem, budget: Budget<'_>) -> Result<Self, PrepareError> {
        let design = Design::new(problem, budget)?;
        let this = Self { problem, design, sizes: problem.sizes() };
        let rows = this.scenario().row_count();
        if rows > problem.samples.rows_max {
            let expected = format!("at most {} rows", problem.samples.rows_max);
            let fault = Fault::new("samples.rows_max", expected, format!("{rows} rows"));
            return Err(PrepareError::Faults(vec![fault]));
        }
        Ok(this)
    }

    fn scenario(&self) -> Scenario<'_> {
        Scenario {
            plant: &self.problem.plant,
            disturbance: &self.problem.disturbance,
            gain: &self.design.gain,
            horizon: self.problem.horizon,
            constraints: &self.design.constraints,
            groups: &self.design.groups,
            sizes: &self.sizes,
            seed: self.problem.seed,
        }
    }

    fn cost(&self, budget: Budget<'_>) -> Result<ExpectedCost, PrepareError> {
        let (n, m) = self.problem.dimensions();
        let scenario = self.scenario();
        let mut cost = ExpectedCost::new(n + self.problem.horizon * m + 1);
        for sample in 0..self.problem.weights.samples {
            budget.check()?;
            let prediction = scenario.prediction(COST_STREAM, sample, self.problem.horizon);
            cost.add(&prediction, &self.design.weights);
        }
        Ok(cost)
    }
}

/// Share of epsilon that is spent where rows are sampled, and are most.
const PART_SHARE: f64 = 0.8;
/// What rounding may add to a removed row at an extreme point, relative.
const CHECK_TOLERANCE: f64 = 1e-7;

/// A terminal set has more faces than the others, and its rows have all variables: it is cut up,
/// so that no shard is much longer than the rest.
pub(super) const TERMINAL_PARTS: usize = 6;

/// What each shard but the last reduces: the long ones first.
fn parts(problem: &Problem) -> Vec<GroupPart> {
    let groups = problem.groups();
    let parts = |(group, stage_group): (usize, &StageGroup)| {
        let stride = if stage_group.family == StageFamily::Terminal { TERMINAL_PARTS } else { 1 };
        (0..stride).map(move |first| GroupPart { group, first, stride })
    };
    groups.iter().enumerate().rev().flat_map(parts).collect()
}

/// Tolerances of a part's reduction and of the last one.
fn tolerances(redundancy: Redundancy) -> (f64, f64) {
    match redundancy {
        Redundancy::Exact => (EXACT, EXACT),
        Redundancy::InnerScaled { epsilon } => {
            let part = PART_SHARE * epsilon;
            (part, (1.0 + epsilon) / (1.0 + part) - 1.0)
        }
    }
}

/// One a part, and one for the expected cost.
pub(super) fn shards(problem: &Problem) -> usize {
    parts(problem).len() + 1
}

/// Faults, stability, terminal set and number of rows.
pub(super) fn check(problem: &Problem, budget: Budget<'_>) -> Result<(), PrepareError> {
    Sampling::new(problem, budget).map(drop)
}

pub(super) fn run_shard(
    problem: &Problem,
    shard: usize,
    budget: Budget<'_>,
) -> Result<ShardPart, PrepareError> {
    let sampling = Sampling::new(problem, budget.untold())?;
    let scenario = sampling.scenario();
    let Some(&part) = parts(problem).get(shard) else {
        return sampling.cost(budget).map(ShardPart::Cost);
    };
    let context = scenario.context(budget.untold()).map_err(|reason| no_set(&reason))?;
    let (tolerance, _) = tolerances(problem.redundancy);
    let rows = scenario.survivors(part, &context, tolerance, budget);
    rows.map(ShardPart::Rows).map_err(|reason| no_set(&reason))
}

pub(super) fn merge(
    problem: &Problem,
    shards: Vec<Shard>,
    budget: Budget<'_>,
) -> Result<Artifact, PrepareError> {
    let mut survivors = Vec::new();
    let mut cost = None;
    for shard in shards {
        match shard.part {
            ShardPart::Rows(rows) => survivors.push(rows),
            ShardPart::Cost(part) => cost = Some(part.mean()),
            ShardPart::Whole(artifact) => return Ok(*artifact),
        }
    }
    let Some(cost) = cost else {
        return Err(Failure::Numerical("no shard has the expected cost".into()).into());
    };
    let sampling = Sampling::new(problem, budget.untold())?;
    let scenario = sampling.scenario();
    let context = scenario.context(budget.untold()).map_err(|reason| no_set(&reason))?;
    let (_, tolerance) = tolerances(problem.redundancy);
    let merged = Scenario::merged(&context, &survivors, tolerance, budget)
        .map_err(|reason| no_set(&reason))?;
    if merged.check.excess > merged.outer_excess + CHECK_TOLERANCE {
        let text = format!("a removed row is violated by {:.3e}", merged.check.excess);
        return Err(Failure::Numerical(text).into());
    }
    let mut summary = sampling.design.summary(groups(&scenario, &merged.rows));
    summary.doubtful_rows = merged.doubtful;
    summary.outer_excess = merged.outer_excess;
    summary.checked_points = merged.check.points;
    summary.checked_excess = merged.check.excess;
    if problem.sampled_by_the_bound() {
        let claims = problem.claims(summary.terminal_rows);
        let delta = problem.samples.confidence_complement;
        summary.joint_confidence = Some(1.0 - failure_of_any(claims, delta));
    }
    let origin = |&group: &usize| RowOrigin::Stage(sampling.design.groups[group]);
    let mut parts = Parts {
        problem: problem.clone(),
        origins: merged.rows.groups.iter().map(origin).collect(),
        rows: match problem.redundancy {
            Redundancy::Exact => merged.rows.rows,
            Redundancy::InnerScaled { .. } => merged.inner(&context.centre),
        },
        summary,
        cost,
        terminal_set: sampling.design.constraints.terminal.clone(),
        first_step_set: None,
    };
    if let Some(limits) = problem.first_step {
        add_first_step(&mut parts, &sampling.design, limits, budget)?;
    }
    assembled(parts, budget)
}

/// What became of every group.
fn groups(scenario: &Scenario<'_>, sampled: &SampledRows) -> Vec<GroupSummary> {
    let summary = |index: usize| GroupSummary {
        group: scenario.groups[index],
        samples: scenario.sizes[index],
        rows: scenario.group_row_count(index),
        kept: sampled.groups.iter().filter(|&&group| group == index).count(),
    };
    (0..scenario.groups.len()).map(summary).collect()
}

/// D_R: every successor lies in a set grown from the terminal one; without rows that the sampled
/// ones make redundant. [Mammarella2019, eq. 15]
fn add_first_step(
    parts: &mut Parts,
    design: &Design,
    limits: GrowthLimits,
    budget: Budget<'_>,
) -> Result<(), PrepareError> {
    let vertices = design.plant_vertices(true);
    let grown = grow_control_invariant(&parts.terminal_set, &parts.rows, &vertices, limits, budget);
    let Growth { set, limited, .. } = grown.map_err(|error| match error {
        GrowthError::Seed(reason) => no_set(&reason),
        GrowthError::Interrupted(why) => why.into(),
        other => Failure::Numerical(format!("the first-step set: {other:?}")).into(),
    })?;
    let width = parts.rows.dimension();
    let mut rows = HalfSpaces::new(width);
    let mut normal = vec![0.0; width];
    let successors = step_back(&set, &vertices, budget)?;
    for row in 0..successors.len() {
        let known = successors.normal(row);
        normal[..known.len()].copy_from_slice(known);
        rows.push(&normal, successors.offset(row));
    }
    let needed = irredundant(&rows, &parts.rows, EXACT, budget.untold());
    let kept = needed.map_err(|reason| no_set(&reason))?.kept;
    parts.rows.extend(&rows.select(&kept));
    parts.origins.extend(std::iter::repeat_n(RowOrigin::FirstStep, kept.len()));
    let Summary { first_step_rows, first_step_limited, .. } = &mut parts.summary;
    (*first_step_rows, *first_step_limited) = (kept.len(), limited);
    parts.first_step_set = Some(set);
    Ok(())
}
