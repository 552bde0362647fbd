//! Dense convex quadratic programs with few variables and very many rows.
//!
//! ```text
//! minimise   z'Hz / 2 + g'z      subject to   a_i z <= b_i,  i = 0 .. rows-1
//! ```
//!
//! H is positive definite and known long before g and b are, so it is factored once
//! ([`QuadraticCost`]). The rows are flat and padded, so that looking at all of them is one
//! straight run through memory ([`DenseRows`]).

mod clarabel;
mod dual_active_set;
mod factors;
mod verify;

pub use dual_active_set::DualActiveSet;
pub(crate) use factors::{ActiveSet, Entry};
pub use verify::{InfeasibilityProof, QuadraticResiduals, prove_infeasible, verify_quadratic};

use nalgebra::DMatrix;

use super::Status;
use crate::budget::{Budget, Interruption};

/// Rows between two looks at the budget where each takes one product.
const BUDGET_PERIOD: usize = 4096;

/// Rows are padded to a multiple of this, so that sums run in four lanes without a remainder.
const LANES: usize = 4;

/// In rows up to this length, looking for zeros costs more than multiplying them.
const SHORT: usize = 32;

/// Rows a_i of a program, flat and row by row.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct DenseRows {
    columns: usize,
    stride: usize,
    normals: Vec<f64>,
    /// 1 / |a_i|, or 1 for a row of zeros.
    scales: Vec<f64>,
    /// Where the entries other than 0 begin and end, in whole lanes: rows over many stages are
    /// mostly zeros.
    supports: Vec<(u32, u32)>,
}

/// H (n x n) with its factor.
#[derive(Debug, Clone, PartialEq)]
pub struct QuadraticCost {
    hessian: DMatrix<f64>,
    /// L^-T with H = L L', column by column.
    inverse_factor: Vec<f64>,
}

/// H is not positive definite, or not symmetric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the quadratic cost is not symmetric positive definite")]
pub struct NotPositiveDefinite;

/// What is asked.
#[derive(Debug, Clone, Copy)]
pub struct QuadraticProgram<'a> {
    /// H, n x n.
    pub cost: &'a QuadraticCost,
    /// g, n values.
    pub gradient: &'a [f64],
    /// a_i.
    pub rows: &'a DenseRows,
    /// b_i.
    pub offsets: &'a [f64],
}

/// A row with its multiplier.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActiveRow {
    /// Which.
    pub row: usize,
    /// >= 0: Hz + g + sum value a_row = 0, or a share of a Farkas ray.
    pub multiplier: f64,
}

/// What came of it. Trust it after [`verify_quadratic`] or [`prove_infeasible`] only.
#[derive(Debug, Clone, PartialEq)]
pub struct QuadraticSolution {
    /// How it ended.
    pub status: Status,
    /// z, n values.
    pub point: Vec<f64>,
    /// z'Hz / 2 + g'z.
    pub objective: f64,
    /// The rows that hold with equality; those of the ray if infeasible. A later solve of a
    /// similar program can start from them.
    pub active: Vec<ActiveRow>,
    /// Rows that entered or left.
    pub iterations: usize,
    /// Times that all rows were looked at.
    pub scans: usize,
}

impl QuadraticSolution {
    /// The active rows, where a later solve can start.
    #[must_use]
    pub fn active_rows(&self) -> Vec<usize> {
        self.active.iter().map(|active| active.row).collect()
    }
}

impl DenseRows {
    /// No rows yet, `columns` variables.
    #[must_use]
    pub fn new(columns: usize) -> Self {
        let stride = columns.div_ceil(LANES) * LANES;
        Self { columns, stride, normals: Vec::new(), scales: Vec::new(), supports: Vec::new() }
    }

    /// From `columns` values a row, one row after the other.
    ///
    /// # Panics
    /// If the last row is not complete.
    #[must_use]
    pub fn from_flat(columns: usize, normals: &[f64]) -> Self {
        assert_eq!(normals.len() % columns.max(1), 0, "values of whole rows");
        let mut rows = Self::new(columns);
        normals.chunks_exact(columns.max(1)).for_each(|normal| rows.push(normal));
        rows
    }

    /// From a matrix, rows x columns.
    #[must_use]
    pub fn from_matrix(matrix: &DMatrix<f64>) -> Self {
        let mut rows = Self::new(matrix.ncols());
        for row in matrix.row_iter() {
            let normal: Vec<f64> = row.iter().copied().collect();
            rows.push(&normal);
        }
        rows
    }

    /// Appends a row.
    ///
    /// # Panics
    /// If its length is not the number of columns.
    pub fn push(&mut self, normal: &[f64]) {
        assert_eq!(normal.len(), self.columns, "columns of a row");
        self.normals.extend_from_slice(normal);
        self.normals.resize(self.normals.len() + self.stride - self.columns, 0.0);
        let norm = normal.iter().map(|a| a * a).sum::<f64>().sqrt();
        self.scales.push(if norm > 0.0 { 1.0 / norm } else { 1.0 });
        let first = normal.iter().position(|&a| a != 0.0).unwrap_or(0) / LANES * LANES;
        let last = normal.iter().rposition(|&a| a != 0.0).map_or(0, |last| last + 1);
        self.supports.push((first as u32, (last.div_ceil(LANES) * LANES) as u32));
    }

    /// Variables.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.scales.len()
    }

    /// No rows at all?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.scales.is_empty()
    }

    /// a_i.
    #[must_use]
    pub fn normal(&self, row: usize) -> &[f64] {
        &self.normals[row * self.stride..][..self.columns]
    }

    /// 1 / |a_i|; 1 for a row of zeros.
    #[must_use]
    pub fn scale(&self, row: usize) -> f64 {
        self.scales[row]
    }

    /// `point` with the zeros that rows are padded with.
    pub(crate) fn pad(&self, point: &[f64], padded: &mut Vec<f64>) {
        padded.clear();
        padded.extend_from_slice(point);
        padded.resize(self.stride, 0.0);
    }

    /// a_i z for a padded z.
    #[inline]
    pub(crate) fn product(&self, row: usize, padded: &[f64]) -> f64 {
        let normal = &self.normals[row * self.stride..][..self.stride];
        if self.stride <= SHORT {
            return lanes_dot(normal, padded);
        }
        let (first, end) = self.supports[row];
        let support = first as usize..end as usize;
        lanes_dot(&normal[support.clone()], &padded[support])
    }

    /// Largest (z - scale a_i) y over a box of these middles and half widths; all three padded.
    #[inline]
    pub(crate) fn reach_of_rest(
        &self,
        row: usize,
        scale: f64,
        padded: &[f64],
        (middle, half): (&[f64], &[f64]),
    ) -> f64 {
        let normal = &self.normals[row * self.stride..][..self.stride];
        let (normal, padded) = (normal.chunks_exact(LANES), padded.chunks_exact(LANES));
        let sides = middle.chunks_exact(LANES).zip(half.chunks_exact(LANES));
        let mut lanes = [0.0; LANES];
        for ((a, z), (middle, half)) in normal.zip(padded).zip(sides) {
            for k in 0..LANES {
                let rest = z[k] - scale * a[k];
                lanes[k] += rest * middle[k] + rest.abs() * half[k];
            }
        }
        (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
    }

    /// a_i z for every row, into `products`.
    pub fn products(&self, point: &[f64], products: &mut Vec<f64>) {
        let mut padded = Vec::with_capacity(self.stride);
        self.pad(point, &mut padded);
        products.clear();
        if self.stride == 0 {
            products.resize(self.len(), 0.0);
            return;
        }
        products.extend(self.normals.chunks_exact(self.stride).map(|a| lanes_dot(a, &padded)));
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn products_within(
        &self,
        point: &[f64],
        products: &mut Vec<f64>,
        budget: Budget<'_>,
    ) -> Result<(), Interruption> {
        let mut padded = Vec::with_capacity(self.stride);
        self.pad(point, &mut padded);
        products.clear();
        if self.stride == 0 {
            products.resize(self.len(), 0.0);
            return Ok(());
        }
        for rows in self.normals.chunks(BUDGET_PERIOD * self.stride) {
            budget.check()?;
            products.extend(rows.chunks_exact(self.stride).map(|a| lanes_dot(a, &padded)));
        }
        Ok(())
    }
}

impl QuadraticCost {
    /// Factors H.
    ///
    /// # Errors
    /// [`NotPositiveDefinite`].
    pub fn new(hessian: DMatrix<f64>) -> Result<Self, NotPositiveDefinite> {
        let n = hessian.nrows();
        let size = hessian.amax();
        if hessian.ncols() != n || !((&hessian - hessian.transpose()).amax() <= 1e-9 * size) {
            return Err(NotPositiveDefinite);
        }
        let factor = hessian.clone().cholesky().ok_or(NotPositiveDefinite)?.unpack();
        // Rows of L are columns of its transpose, and contiguous there.
        let transposed = factor.transpose();
        let mut inverse_factor = vec![0.0; n * n];
        // Column k of L^-T: L' x = e_k, from the last component up, each one taken out of those
        // above it as soon as it is known.
        for k in 0..n {
            let column = &mut inverse_factor[k * n..][..=k];
            column[k] = 1.0;
            for i in (0..=k).rev() {
                let row = &transposed.as_slice()[i * n..][..=i];
                let value = column[i] / row[i];
                column[i] = value;
                column[..i].iter_mut().zip(row).for_each(|(x, l)| *x -= value * l);
            }
        }
        if !inverse_factor.iter().all(|x| x.is_finite()) {
            return Err(NotPositiveDefinite);
        }
        Ok(Self { hessian, inverse_factor })
    }

    /// |z|^2 / 2 over n variables.
    #[must_use]
    pub fn identity(n: usize) -> Self {
        let hessian = DMatrix::identity(n, n);
        Self { inverse_factor: hessian.as_slice().to_vec(), hessian }
    }

    /// n.
    #[must_use]
    pub fn variables(&self) -> usize {
        self.hessian.nrows()
    }

    /// H, n x n.
    #[must_use]
    pub fn hessian(&self) -> &DMatrix<f64> {
        &self.hessian
    }

    /// Column k of L^-T.
    pub(crate) fn factor_column(&self, k: usize) -> &[f64] {
        let n = self.variables();
        &self.inverse_factor[k * n..][..n]
    }
}

/// Sum of products in four lanes: the same order on every machine, and wide where it can be.
#[inline]
fn lanes_dot(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for k in 0..LANES {
            lanes[k] += a[k] * b[k];
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}
