//! The docking cone and its four faces.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use crate::units::Angle;

/// Number of faces of the polyhedral cone.
pub const CONE_FACES: usize = 4;

/// A four-faced cone inside the circular cone of the given half angle, with its apex at the
/// docking port and its axis along the port's direction from the target's centre of mass.
/// [Quartullo2025a, eq. 6]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DockingCone {
    /// Half angle alpha of the circular cone, in (0, pi/2).
    pub half_angle: Angle,
    /// Roll of the faces about the axis, from the paper's orientation (7), right-handed about the
    /// port's direction. The paper leaves it open, but it changes the optimum, so it belongs to
    /// the problem.
    pub face_roll: Angle,
}

/// The cone at one instant as half-spaces normals * p <= offsets on the position p.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConeFaces {
    /// Four normals in RTN, not of unit length (the paper's scaling).
    pub normals: [Vector3<f64>; CONE_FACES],
    /// Right sides, in the unit of `port`.
    pub offsets: [f64; CONE_FACES],
}

impl DockingCone {
    /// The faces for a docking port at `port` (RTN from the target's centre of mass, any unit).
    ///
    /// With r = port / |port|, c = tan(alpha) / sqrt(2) and t_2, t_3 the second and third rows of
    /// T, the rotation that takes r to +x: normals +-t_i - c r, right side -c |port|, in the order
    /// +t_2, -t_2, +t_3, -t_3. Inside (6) the term T (p - (p.r) r) has no first component and
    /// T r = x, so (6) is exactly these four rows.
    ///
    /// T as printed in (7) has no axis at r = +-x; there it is the identity at +x and
    /// diag(-1, -1, 1) at -x, the limits along the rotation about z.
    #[must_use]
    pub fn faces(&self, port: Vector3<f64>) -> ConeFaces {
        let length = port.norm();
        let axis = port / length;
        let slope = libm::tan(self.half_angle.radians()) / std::f64::consts::SQRT_2;
        let to_axis = rotation_to_x(axis);
        let (t2, t3) = (to_axis.row(1).transpose(), to_axis.row(2).transpose());
        let roll = self.face_roll.radians();
        let (s, c) = (libm::sin(roll), libm::cos(roll));
        // Without a roll the rows are taken as they are, free of rounding.
        let (u, v) = if roll == 0.0 { (t2, t3) } else { (t2 * c + t3 * s, t3 * c - t2 * s) };
        ConeFaces {
            normals: [u, -u, v, -v].map(|side| side - axis * slope),
            offsets: [-slope * length; CONE_FACES],
        }
    }
}

impl ConeFaces {
    /// The point with normals * p <= offsets nearest to `point`; exact, by trying the sets of
    /// faces that can be active. `None` if there is none.
    ///
    /// This is z^r of [Quartullo2025a, eq. 21] in the position part; the velocity part is the
    /// reference's own, because the faces do not touch it.
    #[must_use]
    pub fn nearest_point(&self, point: Vector3<f64>) -> Option<Vector3<f64>> {
        // Relative to the size of the offsets' rounding.
        let scale = self.offsets.iter().fold(point.norm(), |a, b| a.max(b.abs()));
        let tolerance = 1e-12 * scale;
        let inside = |p: &Vector3<f64>| {
            (0..CONE_FACES).all(|i| self.normals[i].dot(p) <= self.offsets[i] + tolerance)
        };
        if inside(&point) {
            return Some(point);
        }
        let mut nearest: Option<(f64, Vector3<f64>)> = None;
        // Bit i set: face i active. More than three active faces meet three of them already.
        for active in 1u8..(1 << CONE_FACES) - 1 {
            let Some(candidate) = self.onto_faces(active, point) else { continue };
            let distance = (candidate - point).norm();
            if inside(&candidate) && nearest.is_none_or(|(least, _)| distance < least) {
                nearest = Some((distance, candidate));
            }
        }
        nearest.map(|(_, candidate)| candidate)
    }

    /// Projection onto the intersection of the planes of the faces in `active`.
    fn onto_faces(&self, active: u8, point: Vector3<f64>) -> Option<Vector3<f64>> {
        let mut faces = (0..CONE_FACES).filter(|i| active >> i & 1 == 1);
        let (first, second, third) = (faces.next()?, faces.next(), faces.next());
        let miss = |i: usize| self.normals[i].dot(&point) - self.offsets[i];
        let h = &self.normals;
        match (second, third) {
            (None, _) => Some(point - h[first] * (miss(first) / h[first].norm_squared())),
            (Some(second), None) => {
                let pair = [first, second];
                let gram = Matrix2::from_fn(|i, j| h[pair[i]].dot(&h[pair[j]]));
                let weights = gram.try_inverse()? * Vector2::new(miss(first), miss(second));
                Some(point - h[first] * weights.x - h[second] * weights.y)
            }
            (Some(second), Some(third)) => {
                let rows = [h[first], h[second], h[third]].map(|face| face.transpose());
                let offsets = [first, second, third].map(|i| self.offsets[i]);
                Matrix3::from_rows(&rows).try_inverse().map(|m| m * Vector3::from(offsets))
            }
        }
    }
}

/// R(r x e_x, arccos(r_x)) of (7), by Rodrigues' formula without the angle.
fn rotation_to_x(axis: Vector3<f64>) -> Matrix3<f64> {
    let cross = axis.cross(&Vector3::x());
    let sine = cross.norm();
    if sine < 1e-12 {
        let sign = if axis.x > 0.0 { 1.0 } else { -1.0 };
        return Matrix3::from_diagonal(&Vector3::new(sign, sign, 1.0));
    }
    let k = cross / sine;
    let skew = Matrix3::new(0.0, -k.z, k.y, k.z, 0.0, -k.x, -k.y, k.x, 0.0);
    Matrix3::identity() + skew * sine + skew * skew * (1.0 - axis.x)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cone(roll_degrees: f64) -> DockingCone {
        DockingCone {
            half_angle: Angle::from_degrees(25.0),
            face_roll: Angle::from_degrees(roll_degrees),
        }
    }

    #[test]
    fn faces_lie_inside_the_circular_cone() {
        // [Quartullo2025a]: the polyhedral set is a subset of the circular cone (5). Its edges are
        // its widest directions and touch the circle.
        let port = Vector3::new(0.7, -1.1, 0.4);
        let axis = port.normalize();
        for roll in [0.0, 17.0, 45.0] {
            let faces = cone(roll).faces(port);
            for (i, j) in [(0, 2), (0, 3), (1, 2), (1, 3)] {
                let mut edge = faces.normals[i].cross(&faces.normals[j]);
                edge *= edge.dot(&axis).signum();
                let angle = libm::acos(edge.normalize().dot(&axis));
                assert!((angle - Angle::from_degrees(25.0).radians()).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn roll_is_right_handed_about_the_port() {
        // The first normal's part across the axis turns with the roll.
        let port = Vector3::new(0.7, -1.1, 0.4);
        let axis = port.normalize();
        let across = |roll| {
            let normal = cone(roll).faces(port).normals[0];
            (normal - axis * axis.dot(&normal)).normalize()
        };
        let turned = axis.cross(&across(0.0));
        assert!((across(90.0) - turned).norm() < 1e-14);
        let quarter = (across(0.0) + turned) / std::f64::consts::SQRT_2;
        assert!((across(45.0) - quarter).norm() < 1e-14);
    }

    #[test]
    fn apex_touches_every_face() {
        let port = Vector3::new(-1.5, 0.2, 0.1);
        let faces = cone(30.0).faces(port);
        for i in 0..CONE_FACES {
            assert!((faces.normals[i].dot(&port) - faces.offsets[i]).abs() < 1e-14);
            assert!(faces.normals[i].dot(&(port * 2.0)) < faces.offsets[i]);
        }
    }

    #[test]
    fn rotation_is_continuous_in_the_orbital_plane_at_minus_x() {
        // The Monte Carlo mission starts with the port at -x, where (7) has no axis.
        let at = cone(0.0).faces(Vector3::new(-1.5, 0.0, 0.0));
        let near = cone(0.0).faces(Vector3::new(-1.5, 1e-9, 0.0));
        for i in 0..CONE_FACES {
            assert!((at.normals[i] - near.normals[i]).norm() < 1e-8);
        }
    }

    #[test]
    fn nearest_point_satisfies_the_optimality_conditions() {
        let faces = {
            let mut faces = cone(12.0).faces(Vector3::new(-1.2, 0.7, 0.4));
            // Tightened unevenly, so that the apex is no longer common to all faces.
            for (i, offset) in faces.offsets.iter_mut().enumerate() {
                *offset -= 0.1 + 0.05 * f64::from(u8::try_from(i).unwrap());
            }
            faces
        };
        for (x, y, z) in [(0.0, 0.0, 0.0), (1.0, -2.0, 0.3), (-5.0, 0.0, 0.0), (-1.5, 0.9, 3.0)] {
            let point = Vector3::new(x, y, z);
            let nearest = faces.nearest_point(point).unwrap();
            // Feasible, and every feasible point lies on the far side of the normal plane.
            for i in 0..CONE_FACES {
                assert!(faces.normals[i].dot(&nearest) <= faces.offsets[i] + 1e-12);
            }
            for inside in [Vector3::new(-12.0, 7.0, 4.0), Vector3::new(-14.0, 7.0, 5.0)] {
                assert!(faces.nearest_point(inside) == Some(inside));
                assert!((point - nearest).dot(&(inside - nearest)) <= 1e-10);
            }
        }
    }
}
