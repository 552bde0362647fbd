//! Regions that a chaser must not be carried into.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use crate::{
    matrices::symmetric_eigenvalues,
    program::{PolytopeView, nearest_point_of_polytope},
    sets::{CentredEllipsoid, Polytope},
};

/// A region of positions around the target's centre of mass, RTN.
#[derive(Debug, Clone, PartialEq)]
pub enum AvoidanceRegion {
    /// Half-lengths of an ellipsoid along RTN, metres: the approach ellipsoid.
    SemiAxes(Vector3<f64>),
    /// Radius of a ball, metres: the keep-out sphere.
    Radius(f64),
    /// {p : p' P^-1 p <= 1} with P (3 x 3) in square metres, symmetric positive definite.
    ShapeMatrix(Matrix3<f64>),
    /// Half widths of a box along RTN, metres.
    HalfWidths(Vector3<f64>),
    /// {p : normals p <= offsets}: normals q x 3, offsets q metres for unit normals; bounded.
    Faces {
        /// q x 3.
        normals: DMatrix<f64>,
        /// q.
        offsets: DVector<f64>,
    },
}

/// A region with the speeds up to which being in it counts.
///
/// Reachable sets must be bounded, so the region of positions is lifted to states with a bound on
/// the speed (along each axis for boxes and faces, in norm for ellipsoids). A bound that a real
/// approach exceeds would hide collisions: see [`AvoidanceSet::hides_approaches_above`].
/// [AguilarMarsillach2022, sec. V.C, eq. 33]
#[derive(Debug, Clone, PartialEq)]
pub struct AvoidanceSet {
    region: AvoidanceRegion,
    speed_max_m_s: f64,
}

/// The bound on the speed if none is asked for, m/s; the paper's v_m of its passive cases.
pub const SPEED_MAX_DEFAULT_M_S: f64 = 100.0;

impl AvoidanceSet {
    /// `None` if a length, a shape or the speed is not positive and finite.
    #[must_use]
    pub fn new(region: AvoidanceRegion, speed_max_m_s: f64) -> Option<Self> {
        let positive = |x: f64| x > 0.0 && x.is_finite();
        let sound = match &region {
            AvoidanceRegion::SemiAxes(lengths) | AvoidanceRegion::HalfWidths(lengths) => {
                lengths.iter().all(|&x| positive(x))
            }
            AvoidanceRegion::Radius(radius) => positive(*radius),
            AvoidanceRegion::ShapeMatrix(shape) => {
                (shape - shape.transpose()).amax() <= 1e-9 * shape.amax()
                    && shape.cholesky().is_some()
            }
            AvoidanceRegion::Faces { normals, offsets } => {
                normals.shape() == (offsets.len(), 3)
                    && normals.iter().chain(offsets.iter()).all(|x| x.is_finite())
                    && offsets.iter().all(|&x| x > 0.0)
            }
        };
        (sound && positive(speed_max_m_s)).then_some(Self { region, speed_max_m_s })
    }

    /// The region of positions.
    #[must_use]
    pub fn region(&self) -> &AvoidanceRegion {
        &self.region
    }

    /// v_m, m/s.
    #[must_use]
    pub fn speed_max_m_s(&self) -> f64 {
        self.speed_max_m_s
    }

    /// The set of states as an ellipsoid; `None` for boxes and faces. The speeds' block of the
    /// shape matrix is v_m^2 I: (33) prints v_m.
    #[must_use]
    pub fn ellipsoid(&self) -> Option<CentredEllipsoid> {
        let mut precision = DMatrix::zeros(6, 6);
        let positions = self.position_precision()?;
        precision.view_mut((0, 0), (3, 3)).copy_from(&positions);
        for i in 3..6 {
            precision[(i, i)] = 1.0 / (self.speed_max_m_s * self.speed_max_m_s);
        }
        CentredEllipsoid::from_precision(precision)
    }

    /// P^-1 of the positions alone (3 x 3, per square metre); `None` for boxes and faces.
    #[must_use]
    pub fn position_precision(&self) -> Option<Matrix3<f64>> {
        let diagonal = |a: &Vector3<f64>| Matrix3::from_diagonal(&a.map(|x| 1.0 / (x * x)));
        match &self.region {
            AvoidanceRegion::SemiAxes(axes) => Some(diagonal(axes)),
            AvoidanceRegion::Radius(radius) => Some(diagonal(&Vector3::repeat(*radius))),
            AvoidanceRegion::ShapeMatrix(shape) => shape.try_inverse(),
            AvoidanceRegion::HalfWidths(_) | AvoidanceRegion::Faces { .. } => None,
        }
    }

    /// The set of states as a polytope. Exact for boxes and faces; for ellipsoids the box around
    /// them, which is outer.
    #[must_use]
    pub fn outer_polytope(&self) -> Polytope {
        let (normals, offsets) = match &self.region {
            AvoidanceRegion::Faces { normals, offsets } => (normals.clone(), offsets.clone()),
            AvoidanceRegion::HalfWidths(widths) | AvoidanceRegion::SemiAxes(widths) => {
                box_of(widths)
            }
            AvoidanceRegion::Radius(radius) => box_of(&Vector3::repeat(*radius)),
            AvoidanceRegion::ShapeMatrix(shape) => {
                box_of(&Vector3::new(shape[(0, 0)], shape[(1, 1)], shape[(2, 2)]).map(f64::sqrt))
            }
        };
        let speeds = box_of(&Vector3::repeat(self.speed_max_m_s));
        lifted(&normals, &offsets, &speeds.0, &speeds.1)
    }

    /// Is the state set exactly the polytope of [`Self::outer_polytope`]?
    #[must_use]
    pub fn is_polytope(&self) -> bool {
        matches!(self.region, AvoidanceRegion::HalfWidths(_) | AvoidanceRegion::Faces { .. })
    }

    /// The set scaled about the target for robustness: an ellipsoid to radius sqrt(gamma), a
    /// polytope's offsets by gamma. [AguilarMarsillach2022, sec. V.D]
    ///
    /// The set itself is scaled, before sets are propagated backward. Scaling the propagated
    /// offsets, as the paper writes, would shrink a set whose offsets have become negative.
    #[must_use]
    pub fn inflated(&self, gamma: f64) -> Option<Self> {
        let root = gamma.sqrt();
        let (region, speed) = match &self.region {
            AvoidanceRegion::SemiAxes(axes) => (AvoidanceRegion::SemiAxes(axes * root), root),
            AvoidanceRegion::Radius(radius) => (AvoidanceRegion::Radius(radius * root), root),
            AvoidanceRegion::ShapeMatrix(shape) => {
                (AvoidanceRegion::ShapeMatrix(shape * gamma), root)
            }
            AvoidanceRegion::HalfWidths(widths) => {
                (AvoidanceRegion::HalfWidths(widths * gamma), gamma)
            }
            AvoidanceRegion::Faces { normals, offsets } => {
                let (normals, offsets) = (normals.clone(), offsets * gamma);
                (AvoidanceRegion::Faces { normals, offsets }, gamma)
            }
        };
        Self::new(region, self.speed_max_m_s * speed)
    }

    /// Distance from a position to the region, metres; 0 inside.
    #[must_use]
    pub fn distance_m(&self, position: &Vector3<f64>) -> f64 {
        let point = DVector::from_column_slice(position.as_slice());
        let away = |nearest: DVector<f64>| (nearest - &point).norm();
        if let Some(precision) = self.position_precision() {
            let precision = DMatrix::from_fn(3, 3, |i, j| precision[(i, j)]);
            return CentredEllipsoid::from_precision(precision)
                .map_or(f64::INFINITY, |region| away(region.nearest_point(&point)));
        }
        let lifted = self.outer_polytope();
        let of_positions = |&r: &usize| (0..3).any(|c| lifted.normals()[(r, c)] != 0.0);
        let rows: Vec<usize> = (0..lifted.offsets().len()).filter(of_positions).collect();
        let normals = lifted.normals().select_rows(&rows).columns(0, 3).into_owned();
        let offsets = lifted.offsets().select_rows(&rows);
        let sides = PolytopeView { normals: &normals, offsets: &offsets };
        nearest_point_of_polytope(sides, &point).map_or(f64::INFINITY, away)
    }

    /// Twice the distance from the target to the nearest point of the region's border, metres: no
    /// slab through the target that the region holds is wider.
    #[must_use]
    pub fn narrowest_width_m(&self) -> f64 {
        2.0 * match &self.region {
            AvoidanceRegion::SemiAxes(lengths) | AvoidanceRegion::HalfWidths(lengths) => {
                lengths.min()
            }
            AvoidanceRegion::Radius(radius) => *radius,
            AvoidanceRegion::ShapeMatrix(shape) => {
                let squares = symmetric_eigenvalues(&DMatrix::from_fn(3, 3, |i, j| shape[(i, j)]));
                squares[0].sqrt()
            }
            AvoidanceRegion::Faces { normals, offsets } => normals
                .row_iter()
                .zip(offsets.iter())
                .map(|(normal, offset)| offset / normal.norm())
                .fold(f64::INFINITY, f64::min),
        }
    }

    /// The speed above which an approach passes through the region unseen, if `plausible_m_s`, the
    /// fastest approach of the mission, is above it.
    #[must_use]
    pub fn hides_approaches_above(&self, plausible_m_s: f64) -> Option<f64> {
        (plausible_m_s > self.speed_max_m_s).then_some(self.speed_max_m_s)
    }
}

/// Rows [I; -I] of a box, the way the paper orders them within positions or speeds.
fn box_of(half_widths: &Vector3<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let normals = DMatrix::from_fn(6, 3, |i, j| match (i % 3 == j, i < 3) {
        (false, _) => 0.0,
        (true, true) => 1.0,
        (true, false) => -1.0,
    });
    (normals, DVector::from_fn(6, |i, _| half_widths[i % 3]))
}

/// Position and speed rows as rows on the state. Two boxes are interleaved to H = [I_6; -I_6],
/// so that row i + 6 is always opposite to row i.
fn lifted(
    position_normals: &DMatrix<f64>,
    position_offsets: &DVector<f64>,
    speed_normals: &DMatrix<f64>,
    speed_offsets: &DVector<f64>,
) -> Polytope {
    let (q, s) = (position_offsets.len(), speed_offsets.len());
    let boxes = q == 6 && position_normals == speed_normals;
    let order: Vec<(bool, usize)> = if boxes {
        (0..12).map(|i| (i % 6 < 3, i % 3 + if i < 6 { 0 } else { 3 })).collect()
    } else {
        (0..q).map(|i| (true, i)).chain((0..s).map(|i| (false, i))).collect()
    };
    let mut normals = DMatrix::zeros(q + s, 6);
    let mut offsets = DVector::zeros(q + s);
    for (row, &(position, i)) in order.iter().enumerate() {
        let (from, first) = if position { (position_normals, 0) } else { (speed_normals, 3) };
        (0..3).for_each(|j| normals[(row, first + j)] = from[(i, j)]);
        offsets[row] = if position { position_offsets[i] } else { speed_offsets[i] };
    }
    Polytope::new(normals, offsets)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_has_opposite_rows_six_apart() {
        let widths = Vector3::new(20.0, 30.0, 40.0);
        let set = AvoidanceSet::new(AvoidanceRegion::HalfWidths(widths), 6.0).unwrap();
        let polytope = set.outer_polytope();
        for i in 0..6 {
            let (row, opposite) = (polytope.normals().row(i), polytope.normals().row(i + 6));
            assert_eq!(row, -opposite);
            assert_eq!(row[i], 1.0);
            assert_eq!(polytope.offsets()[i], polytope.offsets()[i + 6]);
        }
        assert_eq!(polytope.offsets().as_slice()[..6], [20.0, 30.0, 40.0, 6.0, 6.0, 6.0]);
    }

    #[test]
    fn semi_axes_and_radius_mean_what_they_say() {
        let ball = AvoidanceSet::new(AvoidanceRegion::Radius(100.0), 50.0).unwrap();
        let axes = AvoidanceRegion::SemiAxes(Vector3::repeat(100.0));
        assert_eq!(ball.ellipsoid(), AvoidanceSet::new(axes, 50.0).unwrap().ellipsoid());
        let edge = DVector::from_vec(vec![0.0, 100.0, 0.0, 0.0, 0.0, 0.0]);
        assert!((ball.ellipsoid().unwrap().gauge_squared(&edge) - 1.0).abs() < 1e-14);
        let fast = DVector::from_vec(vec![0.0, 0.0, 0.0, 0.0, 0.0, 50.0]);
        assert!((ball.ellipsoid().unwrap().gauge_squared(&fast) - 1.0).abs() < 1e-14);
    }

    #[test]
    fn inflation_scales_ellipsoids_by_the_root_and_polytopes_by_gamma() {
        let ball = AvoidanceSet::new(AvoidanceRegion::Radius(100.0), 50.0).unwrap();
        let point = DVector::from_vec(vec![100.0, 0.0, 0.0, 0.0, 10.0, 0.0]);
        let q = |set: &AvoidanceSet| set.ellipsoid().unwrap().gauge_squared(&point);
        assert!((q(&ball.inflated(1.5).unwrap()) * 1.5 - q(&ball)).abs() < 1e-14);
        let cube = AvoidanceRegion::HalfWidths(Vector3::repeat(20.0));
        let cube = AvoidanceSet::new(cube, 6.0).unwrap();
        let grown = cube.inflated(1.5).unwrap().outer_polytope();
        assert_eq!(grown.offsets(), &(cube.outer_polytope().offsets() * 1.5));
    }

    #[test]
    fn slow_bounds_are_noticed_and_nonsense_refused() {
        let set = AvoidanceSet::new(AvoidanceRegion::Radius(20.0), 6.0).unwrap();
        assert_eq!(set.hides_approaches_above(20.0), Some(6.0));
        assert_eq!(set.hides_approaches_above(5.0), None);
        assert_eq!(AvoidanceSet::new(AvoidanceRegion::Radius(-1.0), 6.0), None);
        assert_eq!(AvoidanceSet::new(AvoidanceRegion::Radius(1.0), f64::NAN), None);
        let flat = AvoidanceRegion::ShapeMatrix(Matrix3::zeros());
        assert_eq!(AvoidanceSet::new(flat, 6.0), None);
    }
}
