//! The expected cost of a horizon as one matrix, and the terminal weight that makes it a bound.

use nalgebra::{DMatrix, DVector};

use super::{Prediction, spectral_radius};
use crate::{
    budget::{Budget, Interruption},
    bytes::{DecodeError, Reader, Writer},
    matrices::product,
};

/// Weights of J = sum_l x_l'Q x_l + u_l'R u_l + x_T'P x_T.
#[derive(Debug, Clone, PartialEq)]
pub struct StageWeights {
    /// Q, n x n.
    pub state: DMatrix<f64>,
    /// R, m x m.
    pub input: DMatrix<f64>,
    /// P, n x n.
    pub terminal: DMatrix<f64>,
}

/// The mean of z'S z over samples, z = (x_0, v_0 .. v_{T-1}, 1). [Mammarella2019, eqs. 7, 26]
#[derive(Debug, Clone, PartialEq)]
pub struct ExpectedCost {
    sum: DMatrix<f64>,
    samples: usize,
}

impl ExpectedCost {
    /// No samples yet; z has `width` = n + T m + 1 components.
    #[must_use]
    pub fn new(width: usize) -> Self {
        Self { sum: DMatrix::zeros(width, width), samples: 0 }
    }

    /// Adds a sample whose prediction covers the whole horizon.
    pub fn add(&mut self, prediction: &Prediction, weights: &StageWeights) {
        let stages = prediction.inputs.len();
        for l in 0..stages {
            add_weighted(&mut self.sum, &prediction.states[l], &weights.state);
            add_weighted(&mut self.sum, &prediction.inputs[l], &weights.input);
        }
        add_weighted(&mut self.sum, &prediction.states[stages], &weights.terminal);
        self.samples += 1;
    }

    /// Puts two parts together; the order of parts decides the last bits.
    #[must_use]
    pub fn merged(mut self, other: &Self) -> Self {
        self.sum += &other.sum;
        self.samples += other.samples;
        self
    }

    /// Samples so far.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.samples
    }

    /// Appends the sum.
    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.matrix(&self.sum);
        writer.count(self.samples);
    }

    /// Reads what [`Self::write`] wrote, for z of so many components and so many samples.
    pub(crate) fn read(
        reader: &mut Reader<'_>,
        width: usize,
        samples: usize,
    ) -> Result<Self, DecodeError> {
        let cost = Self { sum: reader.matrix()?, samples: reader.count()? };
        let fits = cost.sum.shape() == (width, width) && cost.samples == samples;
        if fits { Ok(cost) } else { Err(reader.fault("an expected cost of another problem")) }
    }

    /// The mean S, symmetric.
    #[must_use]
    pub fn mean(&self) -> DMatrix<f64> {
        let sum = (&self.sum + self.sum.transpose()) * 0.5;
        sum / self.samples.max(1) as f64
    }
}

/// sum += M'W M.
fn add_weighted(sum: &mut DMatrix<f64>, m: &DMatrix<f64>, weight: &DMatrix<f64>) {
    let weighted = product(weight, m);
    let (rows, width) = m.shape();
    for j in 0..width {
        for i in 0..width {
            let entry: f64 = (0..rows).map(|k| m[(k, i)] * weighted[(k, j)]).sum();
            sum[(i, j)] += entry;
        }
    }
}

/// No terminal weight exists.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum TerminalCostError {
    /// E[x'x] grows under the gain: the spectral radius of the mean of A_K (x) A_K.
    #[error("the loop is not stable in the mean square: growth {0} a step")]
    Unstable(f64),
    /// The equation has no solution to working precision.
    #[error("the equation for the terminal weight is singular")]
    Singular,
    /// Stopped from outside.
    #[error("stopped: {0:?}")]
    Interrupted(Interruption),
}

impl From<Interruption> for TerminalCostError {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// P with P = Q + K'R K + mean of A_K'P A_K over the samples of A_K = A + B K: equality in
/// [Mammarella2019, eq. 3], as one linear system in the entries of P.
///
/// # Errors
/// [`TerminalCostError`].
pub fn terminal_cost(
    state_weight: &DMatrix<f64>,
    input_weight: &DMatrix<f64>,
    gain: &DMatrix<f64>,
    closed_loops: &[DMatrix<f64>],
    budget: Budget<'_>,
) -> Result<DMatrix<f64>, TerminalCostError> {
    let n = state_weight.nrows();
    // vec(A'PA) = (A (x) A)' vec(P); its mean decides about mean-square stability.
    let mut mean = DMatrix::zeros(n * n, n * n);
    for closed in closed_loops {
        budget.check()?;
        mean += closed.kronecker(closed).transpose();
    }
    mean /= closed_loops.len().max(1) as f64;
    budget.check()?;
    let growth = spectral_radius(&mean);
    budget.check()?;
    if !(growth < 1.0) {
        return Err(TerminalCostError::Unstable(growth));
    }
    let stage = state_weight + product(&gain.transpose(), &product(input_weight, gain));
    let right = DVector::from_column_slice(stage.as_slice());
    let system = DMatrix::identity(n * n, n * n) - mean;
    let solution = system.lu().solve(&right).ok_or(TerminalCostError::Singular)?;
    let p = DMatrix::from_column_slice(n, n, solution.as_slice());
    Ok((&p + p.transpose()) * 0.5)
}
