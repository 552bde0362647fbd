//! Ellipsoids by their shape matrix.

use nalgebra::{DMatrix, DVector};

use super::ConvexSet;
use crate::matrices::{
    cholesky, product, solve_lower, symmetric_eigenvalues, times_vector, transposed_product,
};

/// The ellipsoid {x : x' S^-1 x <= 1} about the origin, S (n x n) symmetric positive definite.
#[derive(Debug, Clone, PartialEq)]
pub struct Ellipsoid {
    shape: DMatrix<f64>,
    /// Lower triangular root of the shape: the ellipsoid is its image of the unit ball.
    root: DMatrix<f64>,
}

/// Why a matrix is not a shape.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EllipsoidError {
    /// Not square, or of dimension 0.
    #[error("{0} x {1} is not square")]
    NotSquare(usize, usize),
    /// An entry is not finite.
    #[error("entry ({0}, {1}) is not finite")]
    NotFinite(usize, usize),
    /// Two mirrored entries differ by more than rounding.
    #[error("entries ({0}, {1}) and ({1}, {0}) differ")]
    NotSymmetric(usize, usize),
    /// Some direction has no extent, or less.
    #[error("not positive definite: pivot {pivot:e} in row {row}")]
    NotPositiveDefinite {
        /// Row of the Cholesky factorisation that failed.
        row: usize,
        /// What should have been positive.
        pivot: f64,
    },
}

/// Which outer ellipsoid stands for the Minkowski sum of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OuterSum {
    /// The one of least volume.
    MinVolume,
    /// The one of least trace of the shape matrix.
    MinTrace,
}

/// Mirrored entries may differ by this much of sqrt(S_ii S_jj): rounding of whoever made them.
const SYMMETRY: f64 = 1e-12;

impl Ellipsoid {
    /// The ellipsoid of a shape matrix.
    ///
    /// # Errors
    /// [`EllipsoidError`]; nothing is repaired.
    pub fn from_shape(shape: DMatrix<f64>) -> Result<Self, EllipsoidError> {
        let n = shape.nrows();
        if n == 0 || n != shape.ncols() {
            return Err(EllipsoidError::NotSquare(n, shape.ncols()));
        }
        for i in 0..n {
            for j in 0..n {
                if !shape[(i, j)].is_finite() {
                    return Err(EllipsoidError::NotFinite(i, j));
                }
            }
        }
        for i in 0..n {
            for j in 0..i {
                let size = (shape[(i, i)] * shape[(j, j)]).abs().sqrt();
                if (shape[(i, j)] - shape[(j, i)]).abs() > SYMMETRY * size {
                    return Err(EllipsoidError::NotSymmetric(i, j));
                }
            }
        }
        let root = cholesky(&shape)
            .map_err(|(row, pivot)| EllipsoidError::NotPositiveDefinite { row, pivot })?;
        Ok(Self { shape, root })
    }

    /// The ellipsoid with these semi-axes along the axes of the space.
    ///
    /// # Errors
    /// [`EllipsoidError`] if one is not positive.
    pub fn from_semi_axes(semi_axes: &[f64]) -> Result<Self, EllipsoidError> {
        if let Some(row) = semi_axes.iter().position(|&axis| !(axis > 0.0)) {
            return Err(EllipsoidError::NotPositiveDefinite { row, pivot: semi_axes[row] });
        }
        let squares = DVector::from_iterator(semi_axes.len(), semi_axes.iter().map(|a| a * a));
        Self::from_shape(DMatrix::from_diagonal(&squares))
    }

    /// S, n x n.
    #[must_use]
    pub fn shape(&self) -> &DMatrix<f64> {
        &self.shape
    }

    /// Lower triangular P with S = P P', n x n.
    #[must_use]
    pub fn root(&self) -> &DMatrix<f64> {
        &self.root
    }

    /// The image under an invertible linear map (n x n).
    ///
    /// # Errors
    /// [`EllipsoidError`] if the map squashes a direction to nothing.
    pub fn mapped(&self, map: &DMatrix<f64>) -> Result<Self, EllipsoidError> {
        Self::from_shape(mapped_shape(&self.shape, map))
    }

    /// An ellipsoid that contains the Minkowski sum with `other`: shape (1 + b) S1 + (1 + 1/b) S2
    /// with the b of least volume or trace. [Ros2002; Deaconu2014, eq. 8]
    ///
    /// # Errors
    /// [`EllipsoidError`] if dimensions differ, or rounding destroys a shape.
    pub fn outer_minkowski_sum(
        &self,
        other: &Self,
        kind: OuterSum,
    ) -> Result<Self, EllipsoidError> {
        if self.shape.shape() != other.shape.shape() {
            return Err(EllipsoidError::NotSquare(self.shape.nrows(), other.shape.nrows()));
        }
        let b = match kind {
            OuterSum::MinTrace => (other.shape.trace() / self.shape.trace()).sqrt(),
            OuterSum::MinVolume => self.least_volume_weight(other),
        };
        Self::from_shape(&self.shape * (1.0 + b) + &other.shape * (1.0 + 1.0 / b))
    }

    /// The root b > 0 of n b / (1 + b) = sum_i l_i / (b + l_i), l_i the eigenvalues of S1^-1 S2:
    /// where the derivative of log det vanishes. The left side rises and the right side falls, so
    /// there is one root, between the least and the greatest sqrt(l_i).
    fn least_volume_weight(&self, other: &Self) -> f64 {
        let inside = solve_lower(&self.root, &other.root);
        let eigenvalues = symmetric_eigenvalues(&transposed_product(&inside, &inside));
        let n: f64 = eigenvalues.iter().map(|_| 1.0).sum();
        let excess = |b: f64| -> f64 {
            n * b / (1.0 + b) - eigenvalues.iter().map(|l| l / (b + l)).sum::<f64>()
        };
        let roots = || eigenvalues.iter().map(|l| l.max(f64::MIN_POSITIVE).sqrt());
        let mut low = 0.5 * roots().fold(f64::INFINITY, f64::min);
        let mut high = 2.0 * roots().fold(0.0, f64::max);
        // Halving in the logarithm: 200 rounds exhaust the digits of any bracket.
        for _ in 0..200 {
            let middle = (low * high).sqrt();
            if !(middle > low && middle < high) {
                break;
            }
            if excess(middle) > 0.0 {
                high = middle;
            } else {
                low = middle;
            }
        }
        (low * high).sqrt()
    }

    /// Least t >= 0 with `point` in t times the set.
    #[must_use]
    pub fn gauge(&self, point: &DVector<f64>) -> f64 {
        let column = DMatrix::from_column_slice(point.len(), 1, point.as_slice());
        let inside = solve_lower(&self.root, &column);
        inside.iter().map(|x| x * x).sum::<f64>().sqrt()
    }

    /// Semi-axes of the projection on these components, longest first.
    #[must_use]
    pub fn projection_semi_axes(&self, components: &[usize]) -> Vec<f64> {
        let n = components.len();
        let block = DMatrix::from_fn(n, n, |i, j| self.shape[(components[i], components[j])]);
        let mut axes: Vec<f64> =
            symmetric_eigenvalues(&block).into_iter().map(|l| l.max(0.0).sqrt()).collect();
        axes.reverse();
        axes
    }
}

/// M S M'.
fn mapped_shape(shape: &DMatrix<f64>, map: &DMatrix<f64>) -> DMatrix<f64> {
    let image = product(&product(map, shape), &map.transpose());
    // Exactly symmetric: the two halves are sums in different orders.
    DMatrix::from_fn(image.nrows(), image.ncols(), |i, j| 0.5 * (image[(i, j)] + image[(j, i)]))
}

impl ConvexSet for Ellipsoid {
    fn dimension(&self) -> usize {
        self.shape.nrows()
    }

    /// sqrt(d' S d).
    fn support_function(&self, direction: &DVector<f64>) -> f64 {
        let along = times_vector(&self.root.transpose(), direction);
        along.iter().map(|x| x * x).sum::<f64>().sqrt()
    }
}
