//! The floating spacecraft of [Mammarella2019, sec. III]: a planar chaser on air bearings.

use nalgebra::DMatrix;

use super::{Discretisation, MatrixPolynomial, UncertainPlant};
use crate::sampling::ScalarLaw;

/// Which matrix A(q) is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseidynVariant {
    /// Equation (24) as printed: 2 q_2 multiplies the position y in the third row. Only this one
    /// gives the paper's 4 to 5 Ns.
    Printed,
    /// With 2 q_2 on the velocity of y, as the Clohessy-Wiltshire equations (21) say.
    ClohessyWiltshire,
}

/// State [x, y, x', y'] in m and m/s, input [F_x, F_y] in N, sampled every `sample_time_s`, for a
/// chaser of `mass_kg`. [Mammarella2019, eqs. 23-24]
///
/// Parameters: q_1 in [5e-5, 5e-4], q_2 in [0.001, 0.0014], q_3 in [1e-6, 1.44e-6], q_4 in
/// [-0.0091, 1e-4], all uniform; q_1 to q_3 stand for linearisation errors, q_4 for the mass.
/// B_w = I in discrete time.
#[must_use]
pub fn poseidyn(variant: PoseidynVariant, mass_kg: f64, sample_time_s: f64) -> UncertainPlant {
    let entry = |rows: usize, columns: usize, entries: &[(usize, usize, f64)]| {
        let mut matrix = DMatrix::zeros(rows, columns);
        entries.iter().for_each(|&(i, j, value)| matrix[(i, j)] = value);
        matrix
    };
    let coupled = match variant {
        PoseidynVariant::Printed => 1,
        PoseidynVariant::ClohessyWiltshire => 3,
    };
    let a = MatrixPolynomial::constant(entry(4, 4, &[(0, 2, 1.0), (1, 3, 1.0)]))
        .with_linear(0, entry(4, 4, &[(0, 0, 1.0), (1, 1, 1.0)]))
        .with_linear(1, entry(4, 4, &[(2, coupled, 2.0), (3, 2, -2.0)]))
        .with_linear(2, entry(4, 4, &[(3, 1, 3.0)]));
    let pushed = [(2, 0, 1.0), (3, 1, 1.0)];
    let b = MatrixPolynomial::constant(entry(4, 2, &pushed) / mass_kg)
        .with_linear(3, entry(4, 2, &pushed));
    let uniform = |low, high| ScalarLaw::Uniform { low, high };
    UncertainPlant {
        a,
        b,
        b_w: MatrixPolynomial::constant(DMatrix::identity(4, 4)),
        parameters: vec![
            uniform(5e-5, 5e-4),
            uniform(0.001, 0.0014),
            uniform(1e-6, 1.44e-6),
            uniform(-0.0091, 1e-4),
        ],
        discretisation: Discretisation::ZeroOrderHold { sample_time_s },
    }
}
