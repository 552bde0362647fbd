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

/// The solution X of X L = B for a lower triangular L.
pub(crate) fn solve_lower_right(right: &DMatrix<f64>, lower: &DMatrix<f64>) -> DMatrix<f64> {
    let n = lower.nrows();
    let mut x = right.clone();
    for row in 0..x.nrows() {
        for j in (0..n).rev() {
            let known: f64 = (j + 1..n).map(|k| x[(row, k)] * lower[(k, j)]).sum();
            x[(row, j)] = (x[(row, j)] - known) / lower[(j, j)];
        }
    }
    x
}

/// A = U R with U orthogonal (m x m) and the rows of R (m x n) orthogonal to each other: the
/// singular value decomposition by one-sided rotations (Hestenes), for few rows and any number of
/// columns. The lengths of R's rows are the singular values, in no order. Weak directions stay
/// accurate beside strong ones, which a decomposition through a bidiagonal form does not promise.
fn orthogonal_rows(a: &DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
    let (m, n) = a.shape();
    let (mut u, mut rows) = (DMatrix::identity(m, m), a.clone());
    let dot = |rows: &DMatrix<f64>, p: usize, q: usize| -> f64 {
        (0..n).map(|k| rows[(p, k)] * rows[(q, k)]).sum()
    };
    // As with Jacobi's rotations, a dozen sweeps have always been enough.
    for _ in 0..60 {
        let mut rotated = false;
        for p in 0..m {
            for q in p + 1..m {
                let (pp, qq, pq) = (dot(&rows, p, p), dot(&rows, q, q), dot(&rows, p, q));
                if pq.abs() <= 4.0 * f64::EPSILON * (pp * qq).sqrt() {
                    continue;
                }
                rotated = true;
                let theta = (qq - pp) / (2.0 * pq);
                let t = theta.signum() / (theta.abs() + libm::hypot(theta, 1.0));
                let c = 1.0 / libm::hypot(t, 1.0);
                let s = t * c;
                for k in 0..n {
                    let (a, b) = (rows[(p, k)], rows[(q, k)]);
                    rows[(p, k)] = c * a - s * b;
                    rows[(q, k)] = s * a + c * b;
                }
                for k in 0..m {
                    let (a, b) = (u[(k, p)], u[(k, q)]);
                    u[(k, p)] = c * a - s * b;
                    u[(k, q)] = s * a + c * b;
                }
            }
        }
        if !rotated {
            break;
        }
    }
    (u, rows)
}

/// Which rows of R count: singular values above `cut_off` of the largest.
fn counted_rows(rows: &DMatrix<f64>, cut_off: f64) -> Vec<(usize, f64)> {
    let lengths: Vec<f64> =
        rows.row_iter().map(|row| row.iter().map(|x| x * x).sum::<f64>().sqrt()).collect();
    let largest = lengths.iter().fold(0.0, |a: f64, &b| a.max(b));
    let kept = lengths.into_iter().enumerate().filter(|&(_, l)| l > cut_off * largest);
    kept.collect()
}

/// Orthonormal columns that span the range of A (few rows): left singular vectors whose singular
/// values exceed `cut_off` of the largest.
pub(crate) fn range(a: &DMatrix<f64>, cut_off: f64) -> DMatrix<f64> {
    let (u, rows) = orthogonal_rows(a);
    let kept: Vec<usize> = counted_rows(&rows, cut_off).into_iter().map(|(row, _)| row).collect();
    u.select_columns(&kept)
}

/// The X of least size for which A X is nearest to B, A with few rows: pseudo-inverse times B, by
/// singular values above 1e-12 of the largest.
pub(crate) fn least_answer(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let (u, rows) = orthogonal_rows(a);
    let mut answer = DMatrix::zeros(a.ncols(), b.ncols());
    for (row, length) in counted_rows(&rows, 1e-12) {
        for column in 0..b.ncols() {
            let along: f64 = (0..a.nrows()).map(|k| u[(k, row)] * b[(k, column)]).sum();
            let size = along / (length * length);
            for k in 0..a.ncols() {
                answer[(k, column)] += rows[(row, k)] * size;
            }
        }
    }
    answer
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
