//! The arrival set as an answer gives it: `{d : d' shape^-1 d <= 1}` of position and velocity, and
//! the position set, which may be tighter than its projection; LVLH, m and m/s.

use nalgebra::{DMatrix, Matrix2, Matrix3, Matrix6, Vector2, Vector3, Vector6};
use vbar_proto::v1;

use crate::mission::model::matrix;

/// Corners of an ellipse that is drawn.
const CORNERS: usize = 180;

/// Position and velocity errors around the target state.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Ellipsoid {
    /// Lower triangular root of the shape.
    root: Matrix6<f64>,
    /// The same of the position set.
    position_root: Matrix3<f64>,
    /// The same of the position set's projection on the orbital plane (x, z).
    plane_root: Matrix2<f64>,
}

impl Ellipsoid {
    /// Reads the set; the fault says what is wrong with it.
    pub(crate) fn new(place: &str, given: Option<&v1::ArrivalSet>) -> Result<Self, String> {
        let shape = square(place, given.and_then(|set| set.shape.as_ref()), 6)?;
        let shape = Matrix6::from_fn(|row, column| shape[(row, column)]);
        let position = given.and_then(|set| set.position_shape.as_ref());
        let position = square(&format!("{place}.position_shape"), position, 3)?;
        let position = Matrix3::from_fn(|row, column| position[(row, column)]);
        // A projection's shape is the block of the shape that belongs to the kept components.
        let plane = Matrix2::from_fn(|row, column| position[(2 * row, 2 * column)]);
        match (shape.cholesky(), position.cholesky(), plane.cholesky()) {
            (Some(root), Some(position), Some(plane)) => {
                Ok(Self { root: root.l(), position_root: position.l(), plane_root: plane.l() })
            }
            _ => Err(format!("{place}: the shape is not positive definite")),
        }
    }

    /// Least t with a position error in t times the position set: at most 1 inside.
    pub(crate) fn position_level(&self, error: &Vector6<f64>) -> f64 {
        let position: Vector3<f64> = error.fixed_rows::<3>(0).into();
        let unit = self.position_root.solve_lower_triangular(&position);
        unit.map_or(f64::INFINITY, |unit| unit.norm())
    }

    /// The same of position and velocity together.
    pub(crate) fn state_level(&self, error: &Vector6<f64>) -> f64 {
        let unit = self.root.solve_lower_triangular(error);
        unit.map_or(f64::INFINITY, |unit| unit.norm())
    }

    /// Semi-axes of the position set's projection on the orbital plane, longer first.
    pub(crate) fn in_plane_semi_axes_m(&self) -> [f64; 2] {
        let shape = self.plane_root * self.plane_root.transpose();
        let (middle, half) =
            (0.5 * (shape.m11 + shape.m22), (0.5 * (shape.m11 - shape.m22)).hypot(shape.m12));
        // The shorter axis from the determinant: the difference would lose its digits.
        let longer = middle + half;
        let root_of_determinant = self.plane_root.m11 * self.plane_root.m22;
        [longer.sqrt(), root_of_determinant / longer.sqrt()]
    }

    /// Its outline in the orbital plane (x, z) around the origin.
    pub(crate) fn outline(&self) -> Vec<(f64, f64)> {
        let corner = |index: usize| {
            let angle = std::f64::consts::TAU * index as f64 / CORNERS as f64;
            let point = self.plane_root * Vector2::new(angle.cos(), angle.sin());
            (point[0], point[1])
        };
        (0..CORNERS).map(corner).collect()
    }
}

fn square(place: &str, given: Option<&v1::Matrix>, size: usize) -> Result<DMatrix<f64>, String> {
    let mut faults = Vec::new();
    let matrix = matrix(place, given, &mut faults);
    if matrix.shape() != (size, size) {
        faults.push(format!("{place}: {size} x {size}"));
        return Err(faults.join("; "));
    }
    Ok(matrix)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Axes 5 and 1 m in the orbital plane, turned by 30 degrees; 2 m across.
    fn ellipsoid() -> Ellipsoid {
        let (s, c) = 30_f64.to_radians().sin_cos();
        let mut shape = Matrix6::identity() * 1e-4;
        shape[(0, 0)] = 25.0 * c * c + s * s;
        shape[(2, 2)] = 25.0 * s * s + c * c;
        shape[(0, 2)] = 24.0 * s * c;
        shape[(2, 0)] = 24.0 * s * c;
        shape[(1, 1)] = 4.0;
        let position = shape.fixed_view::<3, 3>(0, 0).into_owned();
        let message = |size, values: &[f64]| {
            Some(v1::Matrix { rows: size, columns: size, values: values.to_vec() })
        };
        let set = v1::ArrivalSet {
            // Both are symmetric: rows and columns may be taken for each other.
            shape: message(6, shape.as_slice()),
            position_shape: message(3, position.as_slice()),
            ..Default::default()
        };
        Ellipsoid::new("here", Some(&set)).expect("one")
    }

    #[test]
    fn ellipsoid_levels_are_1_on_the_surface() {
        let set = ellipsoid();
        let (s, c) = 30_f64.to_radians().sin_cos();
        for tip in [
            Vector6::new(5.0 * c, 0.0, 5.0 * s, 0.0, 0.0, 0.0),
            Vector6::new(-s, 0.0, c, 0.0, 0.0, 0.0),
            Vector6::new(0.0, 2.0, 0.0, 0.0, 0.0, 0.0),
        ] {
            assert!((set.position_level(&tip) - 1.0).abs() < 1e-12);
            assert!((set.state_level(&(tip * 0.5)) - 0.5).abs() < 1e-12);
        }
        // Velocity counts for the state alone.
        let fast = Vector6::new(0.0, 0.0, 0.0, 0.02, 0.0, 0.0);
        assert!((set.state_level(&fast) - 2.0).abs() < 1e-12);
        assert_eq!(set.position_level(&fast), 0.0);
    }

    #[test]
    fn ellipsoid_axes_and_outline_agree() {
        let set = ellipsoid();
        let [longer, shorter] = set.in_plane_semi_axes_m();
        assert!((longer - 5.0).abs() < 1e-12 && (shorter - 1.0).abs() < 1e-12);
        let radii: Vec<f64> = set.outline().iter().map(|(x, z)| x.hypot(*z)).collect();
        let farthest = radii.iter().copied().fold(0.0, f64::max);
        // 180 corners miss the tips by at most a degree: 5 (1 - cos 1 deg).
        assert!((farthest - 5.0).abs() < 1e-3, "{farthest}");
        assert!(radii.iter().all(|radius| *radius > 1.0 - 1e-12));
    }

    #[test]
    fn ellipsoid_that_is_none_is_refused() {
        let square = |size: i32| {
            let values = vec![1.0; (size * size) as usize];
            Some(v1::Matrix { rows: size, columns: size, values })
        };
        let set =
            v1::ArrivalSet { shape: square(6), position_shape: square(3), ..Default::default() };
        assert!(Ellipsoid::new("here", Some(&set)).is_err_and(|fault| fault.contains("definite")));
        let set = v1::ArrivalSet { shape: square(6), ..Default::default() };
        let refused = Ellipsoid::new("here", Some(&set));
        assert!(refused.is_err_and(|fault| fault.contains("here.position_shape")));
        assert!(Ellipsoid::new("here", None).is_err_and(|fault| fault.contains("here")));
    }
}
