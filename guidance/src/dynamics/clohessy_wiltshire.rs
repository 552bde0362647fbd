//! Relative motion near a circular orbit, discretised exactly.

use nalgebra::DMatrix;

/// A (6 x 6) and B (6 x 3) of the scaled Hill-Clohessy-Wiltshire equations over the orbital angle
/// `tau` = eta dt, input held constant. [Quartullo2025a, eqs. 1-2], in closed form.
///
/// State [x, y, z, x', y', z'] in RTN, scaled as [`super::HillScaling`] says.
#[must_use]
pub fn clohessy_wiltshire(tau: f64) -> (DMatrix<f64>, DMatrix<f64>) {
    let (s, c) = (libm::sin(tau), libm::cos(tau));
    let half = libm::sin(0.5 * tau);
    // 1 - cos and tau - sin without cancellation.
    let versine = 2.0 * half * half;
    let lag = angle_minus_sine(tau);
    #[rustfmt::skip]
    let a = DMatrix::from_row_slice(6, 6, &[
        1.0 + 3.0 * versine, 0.0, 0.0, s,              2.0 * versine,       0.0,
        -6.0 * lag,          1.0, 0.0, -2.0 * versine, tau - 4.0 * lag,     0.0,
        0.0,                 0.0, c,   0.0,            0.0,                 s,
        3.0 * s,             0.0, 0.0, c,              2.0 * s,             0.0,
        -6.0 * versine,      0.0, 0.0, -2.0 * s,       1.0 - 4.0 * versine, 0.0,
        0.0,                 0.0, -s,  0.0,            0.0,                 c,
    ]);
    // y from along-track thrust: 4 (1 - cos) - 3/2 tau^2 = tau^2 / 2 - 4 (tau^2 / 2 - versine).
    #[rustfmt::skip]
    let b = DMatrix::from_row_slice(6, 3, &[
        versine,        2.0 * lag,                         0.0,
        -2.0 * lag,     4.0 * versine - 1.5 * tau * tau,   0.0,
        0.0,            0.0,                               versine,
        s,              2.0 * versine,                     0.0,
        -2.0 * versine, tau - 4.0 * lag,                   0.0,
        0.0,            0.0,                               s,
    ]);
    (a, b)
}

/// tau - sin(tau), by its series where the difference would cancel.
fn angle_minus_sine(tau: f64) -> f64 {
    if tau.abs() > 0.5 {
        return tau - libm::sin(tau);
    }
    let square = tau * tau;
    let mut term = tau * square / 6.0;
    let mut sum = 0.0;
    let mut order = 3.0;
    while term != 0.0 && sum + term != sum {
        sum += term;
        term *= -square / ((order + 1.0) * (order + 2.0));
        order += 2.0;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A, B by the exponential series of the continuous matrices (2), augmented.
    fn by_series(tau: f64) -> DMatrix<f64> {
        let mut continuous = DMatrix::zeros(9, 9);
        for (i, j, value) in [(0, 3, 1.0), (1, 4, 1.0), (2, 5, 1.0), (3, 0, 3.0), (3, 4, 2.0)] {
            continuous[(i, j)] = value;
        }
        for (i, j, value) in [(4, 3, -2.0), (5, 2, -1.0), (3, 6, 1.0), (4, 7, 1.0), (5, 8, 1.0)] {
            continuous[(i, j)] = value;
        }
        let mut sum = DMatrix::identity(9, 9);
        let mut term = DMatrix::identity(9, 9);
        for i in 1..60 {
            term = &term * &continuous * (tau / f64::from(i));
            sum += &term;
        }
        sum
    }

    #[test]
    fn closed_form_agrees_with_the_exponential() {
        for tau in [1e-4, 0.006135923151542565, 0.3, 0.51, 2.0] {
            let (a, b) = clohessy_wiltshire(tau);
            let series = by_series(tau);
            let a_error = (&a - series.view((0, 0), (6, 6))).amax();
            let b_error = (&b - series.view((0, 6), (6, 3))).amax();
            assert!(a_error < 1e-13 && b_error < 1e-13, "{tau}: {a_error:e} {b_error:e}");
        }
    }

    #[test]
    fn two_half_steps_make_a_step() {
        let (a, b) = clohessy_wiltshire(0.2);
        let (a_half, b_half) = clohessy_wiltshire(0.1);
        assert!((&a_half * &a_half - &a).amax() < 1e-15);
        assert!((&a_half * &b_half + &b_half - &b).amax() < 1e-15);
    }
}
