//! The four-faced docking cone, checked against true positions.
//!
//! [Quartullo2025a, eqs. 6-7]: with port `p`, its unit vector `r = p / |p|`, `c = tan(alpha) /
//! sqrt(2)` and `t_2, t_3` the second and third row of the rotation that takes `r` to the radial
//! axis, a position `x` is inside when `|t_i x| <= c (r x - |p|)` for both. As half-spaces:
//! `(+-t_i - c r) x <= -c |p|`, rows of length `sqrt(1 + c^2)`, left as they are.

use nalgebra::{Matrix3, Vector3};

use super::rotation::rotation;

/// Shape of a cone; its place comes from the port.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DockingCone {
    /// Half angle of the circular cone, rad.
    pub half_angle_rad: f64,
    /// Roll of the faces about the axis, right-handed about the port's direction, rad.
    pub face_roll_rad: f64,
}

impl DockingCone {
    /// Least of the four right sides minus left sides, m; negative outside.
    pub(crate) fn margin_m(&self, port_m: &Vector3<f64>, position_m: &Vector3<f64>) -> f64 {
        let slope = self.slope();
        let depth = port_m.normalize().dot(position_m) - port_m.norm();
        let (second, third) = self.face_axes(port_m);
        let sideways = second.dot(position_m).abs().max(third.dot(position_m).abs());
        slope * depth - sideways
    }

    /// The four edges of the cone as unit vectors from the port.
    pub(crate) fn edges(&self, port_m: &Vector3<f64>) -> [Vector3<f64>; 4] {
        let axis = port_m.normalize();
        let (second, third) = self.face_axes(port_m);
        [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
            .map(|(a, b)| (axis + (second * a + third * b) * self.slope()).normalize())
    }

    fn slope(&self) -> f64 {
        self.half_angle_rad.tan() / std::f64::consts::SQRT_2
    }

    /// Unit vectors across the two pairs of faces.
    fn face_axes(&self, port_m: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let axis = port_m.normalize();
        let to_radial = rotation_to_radial(&axis);
        let second = to_radial.row(1).transpose();
        let third = to_radial.row(2).transpose();
        if self.face_roll_rad == 0.0 {
            return (second, third);
        }
        let roll = rotation(&axis, self.face_roll_rad);
        (roll * second, roll * third)
    }
}

/// T(k): takes `axis` to the radial axis about their common normal [Quartullo2025a, eq. 7].
/// Where that normal vanishes the paper leaves T open: identity at +x, a half turn about z at -x.
fn rotation_to_radial(axis: &Vector3<f64>) -> Matrix3<f64> {
    let normal = axis.cross(&Vector3::x());
    if normal.norm() < 1e-12 {
        let sign = axis[0].signum();
        return Matrix3::from_diagonal(&Vector3::new(sign, sign, 1.0));
    }
    rotation(&normal, normal.norm().atan2(axis[0]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{spinning_cases, vector, vector3};

    #[test]
    fn cone_axis_is_inside_and_faces_have_zero_margin() {
        let cone = DockingCone { half_angle_rad: 0.5, face_roll_rad: 0.2 };
        for port in [Vector3::x() * 1.5, -Vector3::x() * 1.5, Vector3::new(0.3, -1.0, 0.8)] {
            assert!(cone.margin_m(&port, &(port * 10.0)) > 0.0);
            assert!(cone.margin_m(&port, &(port * 0.5)) < 0.0);
            for edge in cone.edges(&port) {
                assert!(cone.margin_m(&port, &(port + edge * 30.0)).abs() < 1e-13);
                // The polyhedral cone touches the circular one along its edges.
                let angle = edge.dot(&port.normalize()).acos();
                assert!((angle - 0.5).abs() < 1e-12, "{angle}");
            }
        }
    }

    /// Foreign numbers: rows and offsets of every spacecraft case, through the margin they give.
    #[test]
    fn cone_margin_agrees_with_reference_cases() {
        let mut checked = 0;
        for case in spinning_cases() {
            let physical = &case["physical"];
            let three = |key: &str| vector3(&physical[key]);
            let dt = physical["dt_s"].as_f64().unwrap();
            let cone = DockingCone {
                half_angle_rad: physical["alpha_deg"].as_f64().unwrap().to_radians(),
                face_roll_rad: 0.0,
            };
            let spin = three("omega_rad_s");
            let unit = physical["pos_unit_m"].as_f64().unwrap();
            let first = case["k"].as_u64().unwrap_or(0) as f64;
            for (ahead, faces) in case["expected"]["cone"].as_object().expect("cone") {
                let angle = spin.norm() * dt * (first + ahead.parse::<f64>().expect("a step"));
                let port = rotation(&spin, angle) * three("p_dock0_m");
                for probe in [three("p0_m"), port * 7.0 + Vector3::new(3.0, -8.0, 5.0)] {
                    let theirs = (0..4)
                        .map(|face| {
                            let row = vector(&faces["H"][face]);
                            let left = (0..3).map(|i| row[i] * probe[i] / unit).sum::<f64>();
                            faces["b"][face].as_f64().unwrap() - left
                        })
                        .fold(f64::INFINITY, f64::min);
                    let ours = cone.margin_m(&port, &probe) / unit;
                    assert!((ours - theirs).abs() < 1e-15, "{} {ours} {theirs}", case["id"]);
                    checked += 1;
                }
            }
        }
        assert!(checked > 200, "only {checked} margins");
    }
}
