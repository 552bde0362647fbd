//! Regions about a target, in its rotating RTN axes.

use nalgebra::Vector3;

/// A region that must not be entered, its centre at the target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Region {
    /// An ellipsoid along the axes; with equal semi-axes a sphere.
    Ellipsoid {
        /// Radial, along-track, normal.
        semi_axes_m: Vector3<f64>,
    },
    /// A box along the axes.
    Box {
        /// Radial, along-track, normal.
        half_widths_m: Vector3<f64>,
    },
}

impl Region {
    /// By how much the region must grow to reach `position_m`: below 1 inside, 1 on the border.
    pub(crate) fn gauge(&self, position_m: &Vector3<f64>) -> f64 {
        match self {
            Self::Ellipsoid { semi_axes_m } => position_m.component_div(semi_axes_m).norm(),
            Self::Box { half_widths_m } => position_m.component_div(half_widths_m).amax(),
        }
    }
}
