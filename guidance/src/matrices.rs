//! Dense arithmetic in a fixed order, so that artifacts have the same bytes on every machine.

use nalgebra::{DMatrix, DVector, SMatrix};

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

/// A' B, summed over the inner index in order.
pub(crate) fn transposed_product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(a.ncols(), b.ncols(), |i, j| {
        (0..a.nrows()).map(|k| a[(k, i)] * b[(k, j)]).sum()
    })
}

/// Square root of the sum of squares, in order.
pub(crate) fn frobenius(a: &DMatrix<f64>) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Lower triangular root of a symmetric matrix, of which the lower half is read; else the row and
/// pivot that are not positive.
pub(crate) fn cholesky(a: &DMatrix<f64>) -> Result<DMatrix<f64>, (usize, f64)> {
    let n = a.nrows();
    let mut root = DMatrix::<f64>::zeros(n, n);
    for i in 0..n {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| root[(i, k)] * root[(j, k)]).sum();
            let rest = a[(i, j)] - known;
            if i > j {
                root[(i, j)] = rest / root[(j, j)];
            } else if rest > 0.0 && rest.is_finite() {
                root[(i, i)] = rest.sqrt();
            } else {
                return Err((i, rest));
            }
        }
    }
    Ok(root)
}

/// The solution X of L X = B for a lower triangular L.
pub(crate) fn solve_lower(lower: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    let mut x = right.clone();
    for column in 0..x.ncols() {
        for i in 0..lower.nrows() {
            let known: f64 = (0..i).map(|k| lower[(i, k)] * x[(k, column)]).sum();
            x[(i, column)] = (x[(i, column)] - known) / lower[(i, i)];
        }
    }
    x
}

/// Eigenvalues of a small symmetric matrix, least first: Jacobi's rotations in cyclic order, which
/// keep small eigenvalues accurate beside large ones.
pub(crate) fn symmetric_eigenvalues(a: &DMatrix<f64>) -> Vec<f64> {
    let n = a.nrows();
    let mut m = a.clone();
    // Convergence is quadratic; a dozen sweeps have always been enough.
    for _ in 0..60 {
        let mut rotated = false;
        for p in 0..n {
            for q in p + 1..n {
                rotated |= rotate(&mut m, p, q);
            }
        }
        if !rotated {
            break;
        }
    }
    let mut eigenvalues: Vec<f64> = (0..n).map(|i| m[(i, i)]).collect();
    eigenvalues.sort_by(f64::total_cmp);
    eigenvalues
}

/// Zeroes entry (p, q) unless it is nothing beside its diagonal entries; says whether it did.
fn rotate(m: &mut DMatrix<f64>, p: usize, q: usize) -> bool {
    let off = m[(p, q)];
    let size = (m[(p, p)] * m[(q, q)]).abs().sqrt();
    if off == 0.0 || off.abs() <= 1e-17 * size {
        return false;
    }
    let theta = (m[(q, q)] - m[(p, p)]) / (2.0 * off);
    let t = theta.signum() / (theta.abs() + libm::hypot(theta, 1.0));
    let c = 1.0 / libm::hypot(t, 1.0);
    let s = t * c;
    for k in 0..m.nrows() {
        let (a, b) = (m[(k, p)], m[(k, q)]);
        m[(k, p)] = c * a - s * b;
        m[(k, q)] = s * a + c * b;
    }
    for k in 0..m.nrows() {
        let (a, b) = (m[(p, k)], m[(q, k)]);
        m[(p, k)] = c * a - s * b;
        m[(q, k)] = s * a + c * b;
    }
    m[(p, q)] = 0.0;
    m[(q, p)] = 0.0;
    true
}

/// A B for matrices whose shapes are known, summed over the inner index in order.
pub(crate) fn product_fixed<const R: usize, const I: usize, const C: usize>(
    a: &SMatrix<f64, R, I>,
    b: &SMatrix<f64, I, C>,
) -> SMatrix<f64, R, C> {
    SMatrix::from_fn(|i, j| (0..I).map(|k| a[(i, k)] * b[(k, j)]).sum())
}

/// A' B for matrices whose shapes are known, summed over the inner index in order.
pub(crate) fn transposed_fixed_product<const R: usize, const I: usize, const C: usize>(
    a: &SMatrix<f64, I, R>,
    b: &SMatrix<f64, I, C>,
) -> SMatrix<f64, R, C> {
    SMatrix::from_fn(|i, j| (0..I).map(|k| a[(k, i)] * b[(k, j)]).sum())
}
