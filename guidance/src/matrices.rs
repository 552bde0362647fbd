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
    let rows = Rows::of(a);
    let kept = rows.counted(RANK_CUT_OFF);
    let identity = DMatrix::identity(a.nrows(), a.nrows());
    (rows.least_answer(&kept, &identity), kept.len())
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

/// Singular values below this share of the largest count as zero.
const RANK_CUT_OFF: f64 = 1e-12;

/// A = U R with U orthogonal (m x m) and the rows of R (m x n) orthogonal to each other: the
/// singular value decomposition by one-sided rotations (Hestenes), for few rows and any number of
/// columns. The lengths of R's rows are the singular values, in no order. Weak directions stay
/// accurate beside strong ones, which a decomposition through a bidiagonal form does not promise.
struct Rows {
    u: DMatrix<f64>,
    rows: DMatrix<f64>,
}

impl Rows {
    fn of(a: &DMatrix<f64>) -> Self {
        let m = a.nrows();
        let mut this = Self { u: DMatrix::identity(m, m), rows: a.clone() };
        // As with Jacobi's rotations, a dozen sweeps have always been enough.
        for _ in 0..60 {
            let mut rotated = false;
            for p in 0..m {
                for q in p + 1..m {
                    rotated |= this.rotate(p, q);
                }
            }
            if !rotated {
                break;
            }
        }
        this
    }

    /// Makes rows p and q orthogonal unless they are; says whether it did.
    fn rotate(&mut self, p: usize, q: usize) -> bool {
        let (rows, u) = (&mut self.rows, &mut self.u);
        let dot = |rows: &DMatrix<f64>, p: usize, q: usize| -> f64 {
            (0..rows.ncols()).map(|k| rows[(p, k)] * rows[(q, k)]).sum()
        };
        let (pp, qq, pq) = (dot(rows, p, p), dot(rows, q, q), dot(rows, p, q));
        if pq.abs() <= 4.0 * f64::EPSILON * (pp * qq).sqrt() {
            return false;
        }
        let theta = (qq - pp) / (2.0 * pq);
        let t = theta.signum() / (theta.abs() + libm::hypot(theta, 1.0));
        let c = 1.0 / libm::hypot(t, 1.0);
        let s = t * c;
        for k in 0..rows.ncols() {
            let (a, b) = (rows[(p, k)], rows[(q, k)]);
            rows[(p, k)] = c * a - s * b;
            rows[(q, k)] = s * a + c * b;
        }
        for k in 0..u.nrows() {
            let (a, b) = (u[(k, p)], u[(k, q)]);
            u[(k, p)] = c * a - s * b;
            u[(k, q)] = s * a + c * b;
        }
        true
    }

    /// Which rows of R count, with their lengths: singular values above `cut_off` of the largest.
    fn counted(&self, cut_off: f64) -> Vec<(usize, f64)> {
        let length = |row: usize| self.rows.row(row).iter().map(|x| x * x).sum::<f64>().sqrt();
        let lengths: Vec<f64> = (0..self.rows.nrows()).map(length).collect();
        let largest = lengths.iter().fold(0.0, |a: f64, &b| a.max(b));
        let kept = lengths.into_iter().enumerate().filter(|&(_, l)| l > cut_off * largest);
        kept.collect()
    }

    /// The X of least size for which A X is nearest to B, by the rows that count.
    fn least_answer(&self, kept: &[(usize, f64)], b: &DMatrix<f64>) -> DMatrix<f64> {
        let mut answer = DMatrix::zeros(self.rows.ncols(), b.ncols());
        for &(row, length) in kept {
            for column in 0..b.ncols() {
                let along: f64 = (0..b.nrows()).map(|k| self.u[(k, row)] * b[(k, column)]).sum();
                let size = along / length / length;
                for k in 0..answer.nrows() {
                    answer[(k, column)] += self.rows[(row, k)] * size;
                }
            }
        }
        answer
    }
}

/// Orthonormal columns that span the range of A (few rows): left singular vectors whose singular
/// values exceed `cut_off` of the largest.
pub(crate) fn range(a: &DMatrix<f64>, cut_off: f64) -> DMatrix<f64> {
    let rows = Rows::of(a);
    let kept: Vec<usize> = rows.counted(cut_off).into_iter().map(|(row, _)| row).collect();
    rows.u.select_columns(&kept)
}

/// The X of least size for which A X is nearest to B, A with few rows.
pub(crate) fn least_answer(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    let rows = Rows::of(a);
    rows.least_answer(&rows.counted(RANK_CUT_OFF), b)
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
