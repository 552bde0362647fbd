//! Scaling of the Hill-Clohessy-Wiltshire plant.

use nalgebra::{DVector, Vector3};

use crate::frames::{InFrame, RelativeState};

/// Scaled state [p eta^2 / a_max, v eta / a_max], scaled input a / a_max, scaled time eta t.
/// [Quartullo2025a, sec. II.A]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HillScaling {
    /// Metres in one unit of position: a_max / eta^2.
    pub position_unit_m: f64,
    /// Metres per second in one unit of velocity: a_max / eta.
    pub velocity_unit_m_s: f64,
    /// Metres per second squared in one unit of input: a_max.
    pub acceleration_unit_m_s2: f64,
}

impl HillScaling {
    /// From the mean motion eta and the largest acceleration a_max.
    #[must_use]
    pub fn new(mean_motion_rad_s: f64, acceleration_max_m_s2: f64) -> Self {
        Self {
            position_unit_m: acceleration_max_m_s2 / (mean_motion_rad_s * mean_motion_rad_s),
            velocity_unit_m_s: acceleration_max_m_s2 / mean_motion_rad_s,
            acceleration_unit_m_s2: acceleration_max_m_s2,
        }
    }

    /// The scaled state, 6 values.
    #[must_use]
    pub fn scaled(&self, state: &RelativeState) -> DVector<f64> {
        let position = state.position_m.components / self.position_unit_m;
        let velocity = state.velocity_m_s.components / self.velocity_unit_m_s;
        DVector::from_iterator(6, position.iter().chain(velocity.iter()).copied())
    }

    /// The physical state of 6 scaled values.
    #[must_use]
    pub fn physical(&self, scaled: &[f64]) -> RelativeState {
        let vector = |i: usize| Vector3::new(scaled[i], scaled[i + 1], scaled[i + 2]);
        RelativeState {
            position_m: InFrame::new(vector(0) * self.position_unit_m),
            velocity_m_s: InFrame::new(vector(3) * self.velocity_unit_m_s),
        }
    }
}
