//! Everything that is known before flight.

use nalgebra::{DMatrix, DVector};

use super::{Problem, Scheme, encoding};
use crate::{
    budget::{Budget, Interruption},
    bytes::{DecodeError, Reader, Writer},
    dynamics::PlantMatrices,
    matrices::times_vector,
    program::{DenseRows, QuadraticCost},
    reach::{HalfSpaces, ReadError, StageGroup},
    sampling::ScalarLaw,
};

/// Rows between two looks at the budget.
const BUDGET_PERIOD: usize = 1024;

/// The controller, ready to fly.
///
/// Its program is over the present state x and the decisions d: the corrections v_0 .. v_{T-1},
/// and with [`Scheme::TubeRobust`] also e = x - z_0, where in the tube the state is.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    parts: Parts,
    /// The plant at expected parameters.
    mean: PlantMatrices,
    /// B_w E[w] at expected parameters.
    drift: DVector<f64>,
    /// 2 S_dd, factored.
    quadratic: QuadraticCost,
    state_rows: DenseRows,
    decision_rows: DenseRows,
}

/// What an artifact is put together from.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Parts {
    pub(super) problem: Problem,
    pub(super) summary: Summary,
    /// S over (x, d, 1).
    pub(super) cost: DMatrix<f64>,
    /// Over (x, d).
    pub(super) rows: HalfSpaces,
    /// One a row.
    pub(super) origins: Vec<RowOrigin>,
    pub(super) terminal_set: HalfSpaces,
    /// {x : every successor of a feasible step lies here}.
    pub(super) first_step_set: Option<HalfSpaces>,
}

/// Where a row of the program comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowOrigin {
    /// A constraint at a stage of the horizon.
    Stage(StageGroup),
    /// Every successor must lie in the first-step set.
    FirstStep,
    /// The state must lie in the tube.
    Tube,
}

/// What came of a precompute.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// K, m x n.
    pub gain: DMatrix<f64>,
    /// P, n x n.
    pub terminal_weight: DMatrix<f64>,
    /// Rows of the terminal set.
    pub terminal_rows: usize,
    /// Steps back until the terminal set stood.
    pub terminal_iterations: usize,
    /// What became of every group.
    pub groups: Vec<GroupSummary>,
    /// Rows kept because no certificate for their removal was accepted.
    pub doubtful_rows: usize,
    /// Largest certified excess of a removed row, relative; with `InnerScaled` the kept rows were
    /// moved inwards by it.
    pub outer_excess: f64,
    /// Extreme points of kept rows, before they were moved, at which the removed ones were looked
    /// at: those of each part of a group, and those of all parts together.
    pub checked_points: usize,
    /// Largest violation of a removed row at any of them, relative; it must not be larger than
    /// `outer_excess`, which comes from certificates.
    pub checked_excess: f64,
    /// Rows of the first-step set's program that the others do not imply.
    pub first_step_rows: usize,
    /// The first-step set stopped at its limit of facets.
    pub first_step_limited: bool,
    /// All sampled sets are right together with at least this confidence; 0 says nothing, `None`
    /// if the sample size was not taken from the bound or nothing was sampled.
    pub joint_confidence: Option<f64>,
    /// With [`Scheme::TubeRobust`].
    pub tube: Option<TubeSummary>,
}

/// What became of the rows of a group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupSummary {
    /// Which.
    pub group: StageGroup,
    /// Samples drawn; 0 where nothing is sampled.
    pub samples: usize,
    /// Rows before any was removed.
    pub rows: usize,
    /// Rows left.
    pub kept: usize,
}

/// The tube of [`Scheme::TubeRobust`].
#[derive(Debug, Clone, PartialEq)]
pub struct TubeSummary {
    /// Rows of the invariant set.
    pub rows: usize,
    /// Half widths of the box around it, n.
    pub state_half_widths: DVector<f64>,
    /// Half widths of the box around K times it, m.
    pub input_half_widths: DVector<f64>,
    /// Half widths of the box around all that acts on a step: disturbance, and the plant's
    /// difference from the expected one anywhere in the state and input sets; n.
    pub disturbance_half_widths: DVector<f64>,
}

impl Summary {
    /// Samples drawn, all groups together.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.groups.iter().map(|group| group.samples).sum()
    }

    /// Rows before any was removed, without those of the first-step set.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.groups.iter().map(|group| group.rows).sum()
    }

    /// Rows left, without those of the first-step set.
    #[must_use]
    pub fn kept_rows(&self) -> usize {
        self.groups.iter().map(|group| group.kept).sum()
    }
}

/// The rows' parts over x and over the decisions.
fn split_rows(parts: &Parts, budget: Budget<'_>) -> Result<(DenseRows, DenseRows), Interruption> {
    let rows = &parts.rows;
    let n = parts.problem.dimensions().0.min(rows.dimension());
    let (mut over_x, mut over_d) = (DenseRows::new(n), DenseRows::new(rows.dimension() - n));
    for row in 0..rows.len() {
        if row % BUDGET_PERIOD == 0 {
            budget.check()?;
        }
        let (x, d) = rows.normal(row).split_at(n);
        over_x.push(x);
        over_d.push(d);
    }
    Ok((over_x, over_d))
}

impl Artifact {
    /// Puts the parts together; says what does not fit.
    pub(super) fn assemble(
        parts: Parts,
        budget: Budget<'_>,
    ) -> Result<Result<Self, String>, Interruption> {
        let (state_rows, decision_rows) = split_rows(&parts, budget)?;
        Ok(Self::fitting(parts, state_rows, decision_rows))
    }

    fn fitting(
        parts: Parts,
        state_rows: DenseRows,
        decision_rows: DenseRows,
    ) -> Result<Self, String> {
        let Parts { problem, summary, cost, rows, origins, terminal_set, first_step_set } = &parts;
        let (n, m) = problem.dimensions();
        let decisions = problem.decisions();
        let width = n.saturating_add(decisions);
        if cost.shape() != (width + 1, width + 1)
            || rows.dimension() != width
            || origins.len() != rows.len()
            || terminal_set.dimension() != n
            || first_step_set.as_ref().is_some_and(|set| set.dimension() != n)
            || summary.gain.shape() != (m, n)
            || summary.tube.is_some() != (problem.scheme == Scheme::TubeRobust)
        {
            return Err("parts of different sizes".into());
        }
        let quadratic = QuadraticCost::new(cost.view((n, n), (decisions, decisions)) * 2.0)
            .map_err(|error| error.to_string())?;
        let mean = problem.plant.at_mean();
        let expected = problem.disturbance.iter().map(ScalarLaw::mean);
        let drift = DVector::from_iterator(problem.disturbance.len(), expected);
        let drift = times_vector(&mean.b_w, &drift);
        Ok(Self { mean, drift, quadratic, state_rows, decision_rows, parts })
    }

    /// The mission it was made for.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.parts.problem
    }

    /// What came of the precompute.
    #[must_use]
    pub fn summary(&self) -> &Summary {
        &self.parts.summary
    }

    /// S of the expected cost z'S z, z = (x, d, 1). [Mammarella2019, eq. 7]
    #[must_use]
    pub fn expected_cost(&self) -> &DMatrix<f64> {
        &self.parts.cost
    }

    /// The rows of the program, over (x, d). [Mammarella2019, eqs. 13, 15]
    #[must_use]
    pub fn rows(&self) -> &HalfSpaces {
        &self.parts.rows
    }

    /// Where a row comes from.
    #[must_use]
    pub fn origin(&self, row: usize) -> RowOrigin {
        self.parts.origins[row]
    }

    /// The terminal set, over x; with [`Scheme::TubeRobust`] that of the nominal trajectory.
    #[must_use]
    pub fn terminal_set(&self) -> &HalfSpaces {
        &self.parts.terminal_set
    }

    /// The set that every successor lies in.
    #[must_use]
    pub fn first_step_set(&self) -> Option<&HalfSpaces> {
        self.parts.first_step_set.as_ref()
    }

    /// What is known about all sampled sets being right together, in a sentence.
    #[must_use]
    pub fn confidence_statement(&self) -> String {
        let Summary { groups, joint_confidence, .. } = self.summary();
        let Problem { scheme, samples, .. } = self.problem();
        let (epsilon, delta) = (samples.violation, samples.confidence_complement);
        match (scheme, joint_confidence) {
            (Scheme::LinearQuadratic, _) => {
                "nothing is sampled: constraints hold for the expected plant only".into()
            }
            (Scheme::TubeRobust, _) => {
                "nothing is sampled: constraints hold for every plant in the hull of the vertices \
                 and every disturbance in its bounds"
                    .into()
            }
            (Scheme::OfflineSampling, None) => {
                "the numbers of samples are not those of the bound for every group's own \
                 variables: no confidence is proved"
                    .into()
            }
            (Scheme::OfflineSampling, Some(joint)) => format!(
                "each row of a group is right (violated with probability {epsilon} at most) with \
                 confidence {}; all {} rows of {} groups together with confidence {joint}",
                1.0 - delta,
                self.problem().claims(self.terminal_set().len()),
                groups.len()
            ),
        }
    }

    pub(super) fn quadratic(&self) -> &QuadraticCost {
        &self.quadratic
    }

    pub(super) fn decision_rows(&self) -> &DenseRows {
        &self.decision_rows
    }

    /// x after one step of the expected plant from x under u.
    pub(super) fn expected_step(&self, x: &DVector<f64>, u: &DVector<f64>) -> DVector<f64> {
        times_vector(&self.mean.a, x) + times_vector(&self.mean.b, u) + &self.drift
    }

    /// Gradient over d and offsets of the online program at x.
    pub(super) fn online(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (n, decisions) = (x.len(), self.decision_rows.columns());
        let cost = &self.parts.cost;
        let gradient = (0..decisions)
            .map(|i| {
                let from_x: f64 = (0..n).map(|k| cost[(n + i, k)] * x[k]).sum();
                2.0 * (from_x + cost[(n + i, n + decisions)])
            })
            .collect();
        let mut moved = Vec::with_capacity(self.parts.rows.len());
        self.state_rows.products(x, &mut moved);
        let offsets = self.parts.rows.offsets().iter().zip(&moved).map(|(h, hx)| h - hx).collect();
        (gradient, offsets)
    }

    /// z'S z at (x, d).
    pub(super) fn expected_cost_at(&self, x: &[f64], d: &[f64]) -> f64 {
        let z: Vec<f64> = x.iter().chain(d).copied().chain([1.0]).collect();
        let row = |i: usize| -> f64 { (0..z.len()).map(|k| self.parts.cost[(i, k)] * z[k]).sum() };
        (0..z.len()).map(|i| z[i] * row(i)).sum()
    }

    /// The artifact's own bytes: the same for the same problem on any machine.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        encoding::write_problem(&mut writer, &self.parts.problem);
        self.write_found(&mut writer);
        writer.finish()
    }

    /// Appends what was found for the problem.
    pub(super) fn write_found(&self, writer: &mut Writer) {
        encoding::write_found(writer, &self.parts);
    }

    /// Reads what [`Artifact::write_found`] wrote, and checks that its parts fit.
    pub(super) fn read_found(
        problem: Problem,
        reader: &mut Reader<'_>,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let parts = encoding::read_found(problem, reader, budget)?;
        Self::assemble(parts, budget)?.map_err(|text| reader.fault(text).into())
    }

    /// Reads what [`Artifact::to_bytes`] wrote, and checks that its parts fit.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        Self::from_bytes_within(bytes, Budget::UNLIMITED).map_err(ReadError::uninterrupted)
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`ReadError`].
    pub fn from_bytes_within(bytes: &[u8], budget: Budget<'_>) -> Result<Self, ReadError> {
        let mut reader = Reader::new(bytes);
        let problem = encoding::read_problem(&mut reader)?;
        if let Some(fault) = problem.faults().first() {
            return Err(reader.fault(format!("{}: {}", fault.field, fault.got)).into());
        }
        let artifact = Self::read_found(problem, &mut reader, budget)?;
        reader.end()?;
        Ok(artifact)
    }
}
