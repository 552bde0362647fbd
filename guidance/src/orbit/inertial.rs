//! Two craft in inertial axes, and one relative to the other.

use nalgebra::{Matrix3, Vector3};

use crate::frames::{InFrame, Inertial, InertialAxes, RelativeState, Rotation, Rtn};

/// Position and velocity in inertial axes centred on the Earth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertialState {
    /// Which axes.
    pub axes: InertialAxes,
    /// Metres.
    pub position_m: InFrame<Inertial>,
    /// Metres per second.
    pub velocity_m_s: InFrame<Inertial>,
}

/// State of the chaser as seen in the target's rotating frame; `None` if the axes of the two
/// differ or the target's position and velocity span no plane.
///
/// Exact: no linearisation. The frame turns at |r x v| / |r|² about the orbit normal.
#[must_use]
pub fn relative_state(
    target: &InertialState,
    chaser: &InertialState,
) -> Option<RelativeState<Rtn>> {
    if target.axes != chaser.axes {
        return None;
    }
    let (rtn_from_inertial, rate) = rotating_frame(target)?;
    let offset = chaser.position_m.components - target.position_m.components;
    let speed = chaser.velocity_m_s.components - target.velocity_m_s.components;
    let position = rtn_from_inertial * InFrame::<Inertial>::new(offset);
    let velocity = rtn_from_inertial * InFrame::<Inertial>::new(speed);
    let turning = rate.cross(&position.components);
    Some(RelativeState {
        position_m: position,
        velocity_m_s: InFrame::new(velocity.components - turning),
    })
}

/// Inertial state of a chaser from the target's and the relative one; `None` if the target's
/// position and velocity span no plane. The inverse of [`relative_state`].
#[must_use]
pub fn chaser_state(
    target: &InertialState,
    relative: &RelativeState<Rtn>,
) -> Option<InertialState> {
    let (rtn_from_inertial, rate) = rotating_frame(target)?;
    let inertial_from_rtn = rtn_from_inertial.inverse();
    let position = relative.position_m;
    let velocity = relative.velocity_m_s.components + rate.cross(&position.components);
    let offset = inertial_from_rtn * position;
    let speed = inertial_from_rtn * InFrame::<Rtn>::new(velocity);
    Some(InertialState {
        axes: target.axes,
        position_m: InFrame::new(target.position_m.components + offset.components),
        velocity_m_s: InFrame::new(target.velocity_m_s.components + speed.components),
    })
}

/// RTN from inertial axes, and the rate of RTN in its own components, radians per second.
fn rotating_frame(target: &InertialState) -> Option<(Rotation<Rtn, Inertial>, Vector3<f64>)> {
    let (r, v) = (target.position_m.components, target.velocity_m_s.components);
    let momentum = r.cross(&v);
    if !(momentum.norm() > 1e-12 * r.norm() * v.norm()) {
        return None;
    }
    let (radial, normal) = (r.normalize(), momentum.normalize());
    let along = normal.cross(&radial);
    let rows = [radial.transpose(), along.transpose(), normal.transpose()];
    let rate = Vector3::new(0.0, 0.0, momentum.norm() / r.norm_squared());
    Some((Rotation::from_matrix(Matrix3::from_rows(&rows)), rate))
}
