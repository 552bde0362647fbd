//! Sets of disturbances as a mission states them.

use nalgebra::{DMatrix, Vector3};

use crate::{dynamics::HillScaling, sets::Zonotope, units::Angle};

/// Disturbances w of one step of the scaled Hill plant, centred at 0.
#[derive(Debug, Clone, PartialEq)]
pub enum DisturbanceSet {
    /// W = {0}.
    None,
    /// |w_i| <= half width, scaled units, 6 values.
    Box(Vec<f64>),
    /// A box in SI units.
    BoxSi {
        /// Half widths along RTN, metres.
        position_m: Vector3<f64>,
        /// Half widths along RTN, metres per second.
        velocity_m_s: Vector3<f64>,
    },
    /// Generators in scaled units, 6 x p.
    Generators(DMatrix<f64>),
    /// W = 2 angle B U, which contains B M(angle) u for every admissible u: the cross product of
    /// a misalignment within +-angle per axis with |u|_inf <= 1 is at most 2 angle per axis.
    /// [Quartullo2025a, sec. V.B]
    Misalignment(Angle),
}

impl DisturbanceSet {
    /// The zonotope in scaled units, for the scaled input matrix `b` (6 x 3).
    #[must_use]
    pub fn zonotope(&self, scaling: &HillScaling, b: &DMatrix<f64>) -> Zonotope {
        let generators = match self {
            Self::None => DMatrix::zeros(6, 0),
            Self::Box(half_widths) => diagonal(half_widths),
            Self::BoxSi { position_m, velocity_m_s } => {
                let position = position_m.iter().map(|p| p / scaling.position_unit_m);
                let velocity = velocity_m_s.iter().map(|v| v / scaling.velocity_unit_m_s);
                diagonal(&position.chain(velocity).collect::<Vec<_>>())
            }
            Self::Generators(generators) => generators.clone(),
            Self::Misalignment(angle) => b * (2.0 * angle.radians()),
        };
        Zonotope::centred(generators)
    }
}

/// Generators of a box; half widths of 0 need none.
fn diagonal(half_widths: &[f64]) -> DMatrix<f64> {
    let used: Vec<usize> = (0..half_widths.len()).filter(|&i| half_widths[i] != 0.0).collect();
    let mut generators = DMatrix::zeros(half_widths.len(), used.len());
    for (column, &row) in used.iter().enumerate() {
        generators[(row, column)] = half_widths[row];
    }
    generators
}
