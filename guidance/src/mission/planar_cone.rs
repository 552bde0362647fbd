//! An approach cone in a plane.

use nalgebra::{DMatrix, DVector, Vector2};

use crate::{
    sets::Polytope,
    units::{Angle, Distance},
};

/// The points within an angle of an axis, seen from a tip; with a range, a triangle.
/// [Mammarella2019, sec. III.B] gives the triangle by its corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanarCone {
    /// The tip, in m.
    pub apex_m: Vector2<f64>,
    /// Direction from the tip into the cone, from the first axis towards the second.
    pub axis: Angle,
    /// Between axis and faces, in (0, pi/2).
    pub half_angle: Angle,
    /// Largest distance from the tip along the axis.
    pub range_max: Option<Distance>,
}

impl PlanarCone {
    /// Rows of unit length over a state of `states` >= 2 components, of which the first two are
    /// the position in m: the face on the left of the axis, the one on the right, the range.
    #[must_use]
    pub fn half_spaces(&self, states: usize) -> Polytope {
        let normal = |angle: f64| Vector2::new(-libm::sin(angle), libm::cos(angle));
        let (axis, half) = (self.axis.radians(), self.half_angle.radians());
        let mut rows = vec![(normal(axis + half), 0.0), (-normal(axis - half), 0.0)];
        if let Some(range) = self.range_max {
            rows.push((Vector2::new(libm::cos(axis), libm::sin(axis)), range.metres()));
        }
        let mut normals = DMatrix::zeros(rows.len(), states);
        let mut offsets = DVector::zeros(rows.len());
        for (i, (row, distance)) in rows.iter().enumerate() {
            normals[(i, 0)] = row.x;
            normals[(i, 1)] = row.y;
            offsets[i] = row.dot(&self.apex_m) + distance;
        }
        Polytope::new(normals, offsets)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planar_cone_is_the_triangle_of_the_paper() {
        // [Mammarella2019, sec. III.B]: corners (0, 0), (4, 2.25), (2.25, 4); here with the tip at
        // (-0.3, -0.3), and two more components that are free.
        let cone = PlanarCone {
            apex_m: Vector2::new(-0.3, -0.3),
            axis: Angle::from_degrees(45.0),
            half_angle: Angle::from_radians(libm::atan2(4.0, 2.25) - std::f64::consts::FRAC_PI_4),
            range_max: Some(Distance::from_metres(6.25 / std::f64::consts::SQRT_2)),
        };
        let set = cone.half_spaces(4);
        let margins = |x: f64, y: f64| set.margins(&DVector::from_vec(vec![x, y, 9.0, -9.0]));
        // Each corner lies on two faces and inside the third.
        for (corner, inside) in [((0.0, 0.0), 2), ((4.0, 2.25), 0), ((2.25, 4.0), 1)] {
            let margins = margins(corner.0 - 0.3, corner.1 - 0.3);
            for (face, margin) in margins.iter().enumerate() {
                let right = if face == inside { *margin > 1.0 } else { margin.abs() < 1e-12 };
                assert!(right, "corner {corner:?}, face {face}: {margin}");
            }
        }
        assert!(margins(1.0, 1.0).min() > 0.0);
        assert!(margins(1.0, 3.0)[0] < 0.0 && margins(3.0, 1.0)[1] < 0.0);
        // Rows of unit length: margins are metres.
        assert!((margins(-0.3 + 1.0, -0.3 + 1.0)[2] - (6.25 - 2.0) / 2f64.sqrt()).abs() < 1e-12);
    }
}
