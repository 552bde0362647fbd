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

/// Pseudo-inverse and rank, by singular values above 1e-12 of the largest.
pub(crate) fn pseudo_inverse(a: &DMatrix<f64>) -> (DMatrix<f64>, usize) {
    let scale = a.amax();
    let none = || (DMatrix::zeros(a.ncols(), a.nrows()), 0);
    if a.ncols() == 0 || scale == 0.0 {
        return none();
    }
    let svd = (a / scale).svd(true, true);
    let cut_off = 1e-12 * svd.singular_values.amax();
    let rank = svd.rank(cut_off);
    svd.pseudo_inverse(cut_off).map_or_else(|_| none(), |inverse| (inverse / scale, rank))
}
