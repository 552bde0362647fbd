//! LVLH as CCSDS defines it: x along-track, y against the orbit normal, z towards the Earth.
//!
//! The axes of [Deaconu2014]. The frame is RTN with its axes renamed, so it turns as RTN does and
//! a velocity seen in the one is a velocity seen in the other.

use nalgebra::{Vector3, Vector6};

/// Components in RTN (radial, along-track, normal) of a vector given in LVLH.
pub(crate) fn rtn_from_lvlh(v: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(-v[2], v[0], -v[1])
}

/// Components in LVLH of a vector given in RTN.
pub(crate) fn lvlh_from_rtn(v: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(v[1], -v[2], -v[0])
}

/// The same for position and velocity together.
pub(crate) fn state_rtn_from_lvlh(state: &Vector6<f64>) -> Vector6<f64> {
    halves(state, rtn_from_lvlh)
}

/// The same for position and velocity together.
pub(crate) fn state_lvlh_from_rtn(state: &Vector6<f64>) -> Vector6<f64> {
    halves(state, lvlh_from_rtn)
}

fn halves(state: &Vector6<f64>, turn: fn(&Vector3<f64>) -> Vector3<f64>) -> Vector6<f64> {
    let position = turn(&state.fixed_rows::<3>(0).into());
    let velocity = turn(&state.fixed_rows::<3>(3).into());
    Vector6::from_fn(|row, _| if row < 3 { position[row] } else { velocity[row - 3] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lvlh_axes_point_where_ccsds_says() {
        let (radial, along_track, normal) = (Vector3::x(), Vector3::y(), Vector3::z());
        assert_eq!(lvlh_from_rtn(&along_track), Vector3::x());
        assert_eq!(lvlh_from_rtn(&-normal), Vector3::y());
        assert_eq!(lvlh_from_rtn(&-radial), Vector3::z());
        // Right-handed: x cross y is z.
        let rtn = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| rtn_from_lvlh(&axis));
        assert_eq!(rtn[0].cross(&rtn[1]), rtn[2]);
    }

    #[test]
    fn lvlh_states_survive_the_round_trip() {
        let state = Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0);
        assert_eq!(state_lvlh_from_rtn(&state_rtn_from_lvlh(&state)), state);
        assert_eq!(state_rtn_from_lvlh(&state), Vector6::new(-3.0, 1.0, -2.0, -6.0, 4.0, -5.0));
    }
}
