//! Relative motion near a circular orbit whose mean motion is not known exactly, for a chaser
//! whose mass is not either.

use nalgebra::DMatrix;

use super::{Discretisation, MatrixPolynomial, Monomial, UncertainPlant};
use crate::sampling::ScalarLaw;

/// The Hill-Clohessy-Wiltshire equations in RTN: state position and velocity in m and m/s, input
/// force in N, held for `sample_time_s`. [Quartullo2025a, eqs. 1-2], unscaled.
///
/// Parameters: q_1 the mean motion, uniform between two bounds in rad/s; q_2 the inverse of the
/// mass, uniform between those of two bounds in kg. A(q) is a polynomial of degree 2 in q_1.
/// B_w = I in discrete time.
#[must_use]
pub fn uncertain_hill(
    mean_motion_rad_s: (f64, f64),
    mass_kg: (f64, f64),
    sample_time_s: f64,
) -> UncertainPlant {
    let entry = |columns: usize, entries: &[(usize, usize, f64)]| {
        let mut matrix = DMatrix::zeros(6, columns);
        entries.iter().for_each(|&(i, j, value)| matrix[(i, j)] = value);
        matrix
    };
    let velocities = entry(6, &[(0, 3, 1.0), (1, 4, 1.0), (2, 5, 1.0)]);
    let coriolis = entry(6, &[(3, 4, 2.0), (4, 3, -2.0)]);
    let tide = entry(6, &[(3, 0, 3.0), (5, 2, -1.0)]);
    let mut a = MatrixPolynomial::constant(velocities).with_linear(0, coriolis);
    a.terms.push(Monomial { powers: vec![2], matrix: tide });
    let pushed = entry(3, &[(3, 0, 1.0), (4, 1, 1.0), (5, 2, 1.0)]);
    UncertainPlant {
        a,
        b: MatrixPolynomial::constant(DMatrix::zeros(6, 3)).with_linear(1, pushed),
        b_w: MatrixPolynomial::constant(DMatrix::identity(6, 6)),
        parameters: vec![
            ScalarLaw::Uniform { low: mean_motion_rad_s.0, high: mean_motion_rad_s.1 },
            ScalarLaw::Uniform { low: 1.0 / mass_kg.1, high: 1.0 / mass_kg.0 },
        ],
        discretisation: Discretisation::ZeroOrderHold { sample_time_s },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dynamics::clohessy_wiltshire;

    #[test]
    fn uncertain_hill_agrees_with_the_closed_form() {
        // Scaled by 1/n: time tau = n t, positions as they are, velocities over n, and a unit
        // acceleration over n^2.
        let (rate, mass, time) = (1.1e-3, 500.0, 20.0);
        let plant = uncertain_hill((rate, rate), (mass, mass), time);
        assert_eq!(plant.check(), Ok(()));
        let step = plant.at_mean();
        let (a, b) = clohessy_wiltshire(rate * time);
        let unit = |i: usize| if i < 3 { 1.0 } else { rate };
        for i in 0..6 {
            for j in 0..6 {
                let scaled = step.a[(i, j)] * unit(j) / unit(i);
                assert!((scaled - a[(i, j)]).abs() < 1e-13, "A({i}, {j}): {scaled}");
            }
            for j in 0..3 {
                let scaled = step.b[(i, j)] * mass * rate * rate / unit(i);
                assert!((scaled - b[(i, j)]).abs() < 1e-13, "B({i}, {j}): {scaled}");
            }
        }
    }

    #[test]
    fn uncertain_hill_has_a_corner_for_each_pair_of_bounds() {
        let plant = uncertain_hill((1.0e-3, 1.1e-3), (450.0, 500.0), 20.0);
        assert_eq!(plant.corners().map(|corners| corners.len()), Some(4));
        let ranges: Vec<(f64, f64)> = plant.parameters.iter().map(ScalarLaw::range).collect();
        assert_eq!(ranges, [(1.0e-3, 1.1e-3), (1.0 / 500.0, 1.0 / 450.0)]);
    }
}
