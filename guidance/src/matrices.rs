//! Dense arithmetic in a fixed order, so that artifacts have the same bytes on every machine.

use nalgebra::{DMatrix, DVector};

/// A B, summed over the inner index in order.
pub(crate) fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(a.nrows(), b.ncols(), |i, j| {
        (0..a.ncols()).map(|k| a[(i, k)] * b[(k, j)]).sum()
    })
}

/// A x, summed over the inner index in order.
pub(crate) fn times_vector(a: &DMatrix<f64>, x: &DVector<f64>) -> DVector<f64> {
    DVector::from_fn(a.nrows(), |i, _| (0..a.ncols()).map(|k| a[(i, k)] * x[k]).sum())
}

/// Least-norm least-squares solution of A x = b, by singular values.
pub(crate) fn least_squares(a: &DMatrix<f64>, b: &DVector<f64>) -> DVector<f64> {
    let scale = a.amax();
    if scale == 0.0 {
        return DVector::zeros(a.ncols());
    }
    // Columns and rows of a state can differ by many orders of magnitude: relative cut-off.
    let svd = (a / scale).svd(true, true);
    svd.solve(&(b / scale), 1e-12).unwrap_or_else(|_| DVector::zeros(a.ncols()))
}
