//! Exact discretisation of linear plants whose input is held between samples.

use nalgebra::DMatrix;

use crate::matrices::product;

/// Terms of the exponential's series at norm 1/2: 0.5^18 / 18! is below 1e-21.
const SERIES_TERMS: u32 = 18;

/// exp(A t) (n x n) and its integral over [0, t] times B (n x m), for x' = A x + B u with u held.
///
/// By the exponential of [[A, B], [0, 0]] t: scaled to norm 1/2, series, squared back.
#[must_use]
pub fn zero_order_hold(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    time: f64,
) -> (DMatrix<f64>, DMatrix<f64>) {
    let (n, m) = (a.nrows(), b.ncols());
    let mut generator = DMatrix::zeros(n + m, n + m);
    generator.view_mut((0, 0), (n, n)).copy_from(a);
    generator.view_mut((0, n), (n, m)).copy_from(b);
    generator *= time;
    let norm: f64 =
        generator.row_iter().map(|row| row.iter().map(|x| x.abs()).sum()).fold(0.0, f64::max);
    let mut halvings = 0;
    let mut scale = 1.0;
    while norm * scale > 0.5 && halvings < 1000 {
        scale *= 0.5;
        halvings += 1;
    }
    generator *= scale;
    // Horner's scheme: 1 + G (1 + G/2 (1 + G/3 (...))).
    let identity = DMatrix::identity(n + m, n + m);
    let mut sum = identity.clone();
    for term in (1..=SERIES_TERMS).rev() {
        sum = &identity + product(&generator, &sum) / f64::from(term);
    }
    for _ in 0..halvings {
        sum = product(&sum, &sum);
    }
    (sum.view((0, 0), (n, n)).into_owned(), sum.view((0, n), (n, m)).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oscillator_and_integrator_have_their_closed_forms() {
        let a = DMatrix::from_row_slice(2, 2, &[0.0, 1.0, -1.0, 0.0]);
        let b = DMatrix::from_row_slice(2, 1, &[0.0, 1.0]);
        for t in [1e-3, 1.0, 20.0] {
            let (ad, bd) = zero_order_hold(&a, &b, t);
            let (s, c) = (libm::sin(t), libm::cos(t));
            let exact = DMatrix::from_row_slice(2, 2, &[c, s, -s, c]);
            assert!((ad - exact).amax() < 1e-13, "{t}");
            assert!((bd - DMatrix::from_row_slice(2, 1, &[1.0 - c, s])).amax() < 1e-13, "{t}");
        }
        let still = DMatrix::zeros(2, 2);
        let (ad, bd) = zero_order_hold(&still, &b, 5.0);
        assert_eq!(ad, DMatrix::identity(2, 2));
        assert_eq!(bd, b * 5.0);
    }
}
