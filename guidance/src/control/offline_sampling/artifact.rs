//! Everything that is known before flight.

use nalgebra::DMatrix;

use super::{Problem, encoding};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    program::{DenseRows, QuadraticCost},
    reach::{HalfSpaces, StageGroup},
};

/// The controller, ready to fly.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    problem: Problem,
    summary: Summary,
    /// S over (x, v, 1).
    cost: DMatrix<f64>,
    /// D and then D_R, over (x, v).
    rows: HalfSpaces,
    /// Group of each row of D; none for D_R.
    origins: Vec<Option<StageGroup>>,
    /// {x : every successor of a feasible step lies here}.
    first_step_set: HalfSpaces,
    /// 2 S_vv, factored.
    quadratic: QuadraticCost,
    state_rows: DenseRows,
    correction_rows: DenseRows,
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
    /// Samples drawn, all groups together.
    pub samples: usize,
    /// Rows they made.
    pub sampled_rows: usize,
    /// Rows of D left.
    pub kept_rows: usize,
    /// Rows kept because no certificate for their removal was accepted.
    pub doubtful_rows: usize,
    /// Largest certified excess of a removed row, relative; with `InnerScaled` the kept rows were
    /// moved inwards by it.
    pub outer_excess: f64,
    /// Rows of D_R that D does not imply.
    pub first_step_rows: usize,
    /// The first-step set stopped at its limit of facets.
    pub first_step_limited: bool,
    /// All sampled sets are right together with at least this confidence; 0 says nothing, `None`
    /// if the sample size was not taken from the bound.
    pub joint_confidence: Option<f64>,
}

impl Artifact {
    /// Puts the parts together; says what does not fit.
    pub(super) fn assemble(
        problem: Problem,
        summary: Summary,
        cost: DMatrix<f64>,
        rows: HalfSpaces,
        origins: Vec<Option<StageGroup>>,
        first_step_set: HalfSpaces,
    ) -> Result<Self, String> {
        let (n, m) = problem.dimensions();
        let width = problem.horizon.saturating_mul(m);
        if cost.shape() != (n + width + 1, n + width + 1)
            || rows.dimension() != n + width
            || origins.len() != rows.len()
            || first_step_set.dimension() != n
            || summary.gain.shape() != (m, n)
        {
            return Err("parts of different sizes".into());
        }
        let quadratic = QuadraticCost::new(cost.view((n, n), (width, width)) * 2.0)
            .map_err(|error| error.to_string())?;
        let (mut state_rows, mut correction_rows) = (DenseRows::new(n), DenseRows::new(width));
        for row in 0..rows.len() {
            let (x, v) = rows.normal(row).split_at(n);
            state_rows.push(x);
            correction_rows.push(v);
        }
        Ok(Self {
            problem,
            summary,
            cost,
            rows,
            origins,
            first_step_set,
            quadratic,
            state_rows,
            correction_rows,
        })
    }

    /// The mission it was made for.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    /// What came of the precompute.
    #[must_use]
    pub fn summary(&self) -> &Summary {
        &self.summary
    }

    /// S of the expected cost z'S z, z = (x, v_0 .. v_{T-1}, 1). [Mammarella2019, eq. 7]
    #[must_use]
    pub fn expected_cost(&self) -> &DMatrix<f64> {
        &self.cost
    }

    /// D and D_R over (x, v). [Mammarella2019, eqs. 13, 15]
    #[must_use]
    pub fn rows(&self) -> &HalfSpaces {
        &self.rows
    }

    /// Group of a row; `None` for the first-step rows.
    #[must_use]
    pub fn origin(&self, row: usize) -> Option<StageGroup> {
        self.origins[row]
    }

    /// The set that every successor lies in.
    #[must_use]
    pub fn first_step_set(&self) -> &HalfSpaces {
        &self.first_step_set
    }

    pub(super) fn quadratic(&self) -> &QuadraticCost {
        &self.quadratic
    }

    pub(super) fn correction_rows(&self) -> &DenseRows {
        &self.correction_rows
    }

    /// Gradient over v and offsets of the online program at x.
    pub(super) fn online(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (n, width) = (x.len(), self.correction_rows.columns());
        let gradient = (0..width)
            .map(|i| {
                let from_x: f64 = (0..n).map(|k| self.cost[(n + i, k)] * x[k]).sum();
                2.0 * (from_x + self.cost[(n + i, n + width)])
            })
            .collect();
        let mut moved = Vec::with_capacity(self.rows.len());
        self.state_rows.products(x, &mut moved);
        let offsets = self.rows.offsets().iter().zip(&moved).map(|(h, hx)| h - hx).collect();
        (gradient, offsets)
    }

    /// z'S z at (x, v).
    pub(super) fn expected_cost_at(&self, x: &[f64], v: &[f64]) -> f64 {
        let z: Vec<f64> = x.iter().chain(v).copied().chain([1.0]).collect();
        let row = |i: usize| -> f64 { (0..z.len()).map(|k| self.cost[(i, k)] * z[k]).sum() };
        (0..z.len()).map(|i| z[i] * row(i)).sum()
    }

    /// The artifact's own bytes: the same for the same problem on any machine.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        encoding::write_problem(&mut writer, &self.problem);
        encoding::write_summary(&mut writer, &self.summary);
        writer.matrix(&self.cost);
        encoding::write_half_spaces(&mut writer, &self.rows);
        for origin in &self.origins {
            encoding::write_origin(&mut writer, *origin);
        }
        encoding::write_half_spaces(&mut writer, &self.first_step_set);
        writer.finish()
    }

    /// Reads what [`Artifact::to_bytes`] wrote, and checks that its parts fit.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let problem = encoding::read_problem(&mut reader)?;
        let summary = encoding::read_summary(&mut reader)?;
        let cost = reader.matrix()?;
        let rows = encoding::read_half_spaces(&mut reader)?;
        let origins = (0..rows.len()).map(|_| encoding::read_origin(&mut reader));
        let origins = origins.collect::<Result<_, _>>()?;
        let first_step_set = encoding::read_half_spaces(&mut reader)?;
        reader.end()?;
        if let Some(fault) = problem.faults().first() {
            return Err(reader.fault(format!("{}: {}", fault.field, fault.got)));
        }
        Self::assemble(problem, summary, cost, rows, origins, first_step_set)
            .map_err(|text| reader.fault(text))
    }
}
