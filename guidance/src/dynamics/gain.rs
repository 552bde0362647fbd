//! Feedback gains for discrete-time linear plants, u = K x.

use nalgebra::{DMatrix, DVector};

use crate::matrices::product;

/// Why no gain was found.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GainError {
    /// Fewer or more poles than states.
    #[error("{expected} poles expected, {got} given")]
    PoleCount {
        /// n.
        expected: usize,
        /// Poles given.
        got: usize,
    },
    /// A pole is repeated more often than inputs can place it.
    #[error("a pole is repeated {got} times, at most {most} can be placed")]
    Multiplicity {
        /// Rank of B.
        most: usize,
        /// Repetitions.
        got: usize,
    },
    /// The plant cannot be controlled to these poles, or only through a singular eigenbasis.
    #[error("the plant is not controllable, or these poles leave no independent eigenvectors")]
    Singular,
    /// The Riccati iteration did not converge.
    #[error("the Riccati equation has no stabilising solution for these weights")]
    Riccati,
}

/// K (m x n) such that A + B K has the given real poles, each at most rank(B) times.
///
/// Eigenvectors are chosen in the subspaces {x : (A - pole) x + B f = 0} as orthogonal to each
/// other as these allow (the rank-one method of Kautsky, Nichols and Van Dooren, 1985). Where the
/// multiplicities fill the subspaces, as for {0.6 x 3, 0.5 x 3} with three inputs, K is unique.
///
/// # Errors
/// [`GainError`].
pub fn place_poles(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    poles: &[f64],
) -> Result<DMatrix<f64>, GainError> {
    let n = a.nrows();
    if poles.len() != n {
        return Err(GainError::PoleCount { expected: n, got: poles.len() });
    }
    // Columns of B can be tiny: place for B / size, K / size.
    let size = b.amax();
    if size == 0.0 {
        return Err(GainError::Singular);
    }
    let b = b / size;
    let rank = b.clone().svd(false, false).rank(1e-12);
    let mut sorted = poles.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut subspaces = Vec::with_capacity(n);
    for group in sorted.chunk_by(|x, y| x == y) {
        if group.len() > rank {
            return Err(GainError::Multiplicity { most: rank, got: group.len() });
        }
        let basis = pole_subspace(a, &b, group[0]);
        if basis.ncols() < group.len() {
            return Err(GainError::Singular);
        }
        for i in 0..group.len() {
            subspaces.push((basis.clone(), i));
        }
    }
    let (states, inputs) = choose_eigenvectors(&subspaces, n);
    let inverse = states.clone().try_inverse().ok_or(GainError::Singular)?;
    if inverse.amax() * states.amax() > 1e10 {
        return Err(GainError::Singular);
    }
    Ok(product(&inputs, &inverse) / size)
}

/// Orthonormal basis, (n + m) x d, of {(x, f) : (A - pole) x + B f = 0}.
fn pole_subspace(a: &DMatrix<f64>, b: &DMatrix<f64>, pole: f64) -> DMatrix<f64> {
    let (n, m) = (a.nrows(), b.ncols());
    // Square, so that the decomposition returns the null space too.
    let mut square = DMatrix::zeros(n + m, n + m);
    square.view_mut((0, 0), (n, n)).copy_from(a);
    for i in 0..n {
        square[(i, i)] -= pole;
    }
    square.view_mut((0, n), (n, m)).copy_from(b);
    let svd = square.svd(false, true);
    let largest = svd.singular_values.amax();
    let right = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, n + m));
    let null: Vec<DVector<f64>> = (0..right.nrows())
        .filter(|&i| svd.singular_values[i] <= 1e-12 * largest)
        .map(|i| right.row(i).transpose())
        .collect();
    if null.is_empty() { DMatrix::zeros(n + m, 0) } else { DMatrix::from_columns(&null) }
}

/// One vector from each subspace; returns their state parts (n x n) and input parts (m x n).
fn choose_eigenvectors(
    subspaces: &[(DMatrix<f64>, usize)],
    n: usize,
) -> (DMatrix<f64>, DMatrix<f64>) {
    const SWEEPS: usize = 30;
    let mut chosen: Vec<DVector<f64>> =
        subspaces.iter().map(|(basis, i)| basis.column(*i).into_owned()).collect();
    for _ in 0..SWEEPS {
        for j in 0..chosen.len() {
            let others: Vec<DVector<f64>> = (chosen.iter().enumerate())
                .filter(|&(i, _)| i != j)
                .map(|(_, v)| v.rows(0, n).into_owned())
                .collect();
            let basis = &subspaces[j].0;
            let states = basis.rows(0, n);
            let normal = normal_to(&others, n);
            let coefficients = states.transpose() * normal;
            if coefficients.norm() > 1e-9 {
                let vector = basis * coefficients;
                let length = vector.rows(0, n).norm();
                chosen[j] = vector / length;
            }
        }
    }
    let vectors = DMatrix::from_columns(&chosen);
    let rows = vectors.nrows();
    (vectors.rows(0, n).into_owned(), vectors.rows(n, rows - n).into_owned())
}

/// A unit vector orthogonal to n - 1 vectors.
fn normal_to(vectors: &[DVector<f64>], n: usize) -> DVector<f64> {
    let mut square = DMatrix::zeros(n, n);
    for (i, vector) in vectors.iter().enumerate() {
        square.row_mut(i).copy_from(&vector.transpose());
    }
    let svd = square.svd(false, true);
    let smallest = svd.singular_values.imin();
    svd.v_t.map_or_else(|| DVector::zeros(n), |right| right.row(smallest).transpose())
}

/// K (m x n) of the infinite-horizon regulator that minimises sum x'Qx + u'Ru, by the
/// structure-preserving doubling algorithm (Chu, Fan, Lin and Wang, 2004).
///
/// # Errors
/// [`GainError::Riccati`] if the iteration does not converge.
pub fn linear_quadratic_regulator(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
) -> Result<DMatrix<f64>, GainError> {
    const DOUBLINGS: usize = 60;
    let n = a.nrows();
    let r_inverse = r.clone().try_inverse().ok_or(GainError::Riccati)?;
    let mut transition = a.clone();
    let mut control = product(&product(b, &r_inverse), &b.transpose());
    let mut cost = q.clone();
    for _ in 0..DOUBLINGS {
        let inner = DMatrix::identity(n, n) + product(&control, &cost);
        let inverse = inner.try_inverse().ok_or(GainError::Riccati)?;
        let moved = product(&transition, &inverse);
        let added =
            product(&product(&transition.transpose(), &cost), &product(&inverse, &transition));
        control += product(&product(&moved, &control), &transition.transpose());
        transition = product(&moved, &transition);
        cost += &added;
        if !cost.iter().all(|x| x.is_finite()) {
            return Err(GainError::Riccati);
        }
        if added.amax() <= 1e-15 * cost.amax() {
            let weight = r + product(&product(&b.transpose(), &cost), b);
            let inverse = weight.try_inverse().ok_or(GainError::Riccati)?;
            let gain = product(&inverse, &product(&product(&b.transpose(), &cost), a));
            return Ok(-gain);
        }
    }
    Err(GainError::Riccati)
}

/// Largest modulus of an eigenvalue, by squaring: |A^(2^k)|^(1/2^k), rescaled at each squaring.
///
/// Unlike a Schur iteration this cannot fail on repeated eigenvalues, which pole placement makes
/// on purpose. After 60 squarings the norm's own factor has vanished below rounding.
#[must_use]
pub fn spectral_radius(matrix: &DMatrix<f64>) -> f64 {
    let mut power = matrix.clone();
    let mut logarithm = 0.0;
    let mut weight = 1.0;
    for _ in 0..60 {
        let size = power.amax();
        if size == 0.0 {
            return 0.0;
        }
        logarithm += weight * libm::log(size);
        power /= size;
        power = product(&power, &power);
        weight *= 0.5;
    }
    libm::exp(logarithm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dynamics::clohessy_wiltshire;

    #[test]
    fn poles_are_where_they_were_asked_for() {
        let (a, b) = clohessy_wiltshire(0.0123);
        for poles in [[0.6, 0.6, 0.6, 0.5, 0.5, 0.5], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]] {
            let k = place_poles(&a, &b, &poles).unwrap();
            let closed = &a + &b * &k;
            // The characteristic polynomial vanishes at each pole.
            for pole in poles {
                let shifted = &closed - DMatrix::identity(6, 6) * pole;
                let smallest = shifted.svd(false, false).singular_values.min();
                assert!(smallest < 1e-9, "{pole}: {smallest:e}");
            }
        }
    }

    #[test]
    fn too_many_equal_poles_are_refused() {
        let (a, b) = clohessy_wiltshire(0.0123);
        let error = place_poles(&a, &b, &[0.5, 0.5, 0.5, 0.5, 0.6, 0.6]).unwrap_err();
        assert_eq!(error, GainError::Multiplicity { most: 3, got: 4 });
    }

    #[test]
    fn uncontrollable_plant_is_refused() {
        let a = DMatrix::from_row_slice(2, 2, &[1.0, 0.0, 0.0, 2.0]);
        let b = DMatrix::from_row_slice(2, 1, &[1.0, 0.0]);
        assert!(place_poles(&a, &b, &[0.1, 0.2]).is_err());
    }

    #[test]
    fn regulator_satisfies_its_riccati_equation() {
        // For a scalar plant x+ = a x + u with q = r = 1: p = 1 + a^2 p / (1 + p).
        let one = DMatrix::from_element(1, 1, 1.0);
        let a = DMatrix::from_element(1, 1, 2.0);
        let k = linear_quadratic_regulator(&a, &one, &one, &one).unwrap();
        let p = 2.0 + 5.0_f64.sqrt();
        assert!((k[(0, 0)] + 2.0 * p / (1.0 + p)).abs() < 1e-13);
    }

    #[test]
    fn spectral_radius_of_known_matrices() {
        let rotation = DMatrix::from_row_slice(2, 2, &[0.6, -0.3, 0.3, 0.6]);
        assert!((spectral_radius(&rotation) - 0.45_f64.sqrt()).abs() < 1e-12);
        let defective = DMatrix::from_row_slice(2, 2, &[0.9, 5.0, 0.0, 0.9]);
        assert!((spectral_radius(&defective) - 0.9).abs() < 1e-12);
        let nilpotent = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, 0.0, 0.0]);
        assert_eq!(spectral_radius(&nilpotent), 0.0);
        let unstable = DMatrix::from_row_slice(2, 2, &[1.0, 0.0, 0.0, 1.5]);
        assert!((spectral_radius(&unstable) - 1.5).abs() < 1e-12);
    }
}
