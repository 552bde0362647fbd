//! Half-spaces that keep a predicted state out of a backward reachable set.

use nalgebra::DVector;

use super::{EllipsoidUnion, ReachablePolytope};
use crate::{
    dynamics::RelativeVector,
    program::{HalfSpaces, nearest_point_of_polytope},
};

/// normal x >= offset keeps x out of a set: {y : normal y <= offset} holds the set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cut {
    /// h.
    pub normal: RelativeVector,
    /// 1 where the origin is inside the set, so that the normal is a gauge; else in metres along
    /// a unit normal.
    pub offset: f64,
    /// normal x - offset at the point the cut was made for.
    pub clearance: f64,
}

/// The tangent of an ellipsoid at the radial projection of `x`; `None` at the origin.
/// [AguilarMarsillach2022, remark 5, without its factor 2]
#[must_use]
pub fn cut_off_ellipsoid(
    union: &EllipsoidUnion,
    start: usize,
    instant: usize,
    x: &RelativeVector,
) -> Option<Cut> {
    let (normal, clearance) = union.tangent(start, instant, x)?;
    Some(Cut { normal, offset: 1.0, clearance })
}

/// The best half-space around one polytope, in closed form.
///
/// With the origin inside, problem (28) for one set is max_i H_i x / l_i - 1, at that row. With the
/// origin on the border or outside (28) has no bound; then the cut is orthogonal to the way from
/// the Euclidean projection of x, or the least violated row if x is inside. `None` if the
/// projection fails.
#[must_use]
pub fn cut_off_polytope(set: &ReachablePolytope<'_>, x: &RelativeVector) -> Option<Cut> {
    let row = |i: usize| RelativeVector::from_fn(|j, _| set.normals[i * 6 + j]);
    if set.offsets.iter().all(|&l| l > 0.0) {
        let gauge = |i: usize| row(i).dot(x) / set.offsets[i];
        let best = (0..set.offsets.len()).max_by(|&i, &j| gauge(i).total_cmp(&gauge(j)))?;
        let normal = row(best) / set.offsets[best];
        return Some(Cut { normal, offset: 1.0, clearance: gauge(best) - 1.0 });
    }
    if set.contains(x) {
        let depth = |i: usize| (row(i).dot(x) - set.offsets[i]) / row(i).norm();
        let best = (0..set.offsets.len()).max_by(|&i, &j| depth(i).total_cmp(&depth(j)))?;
        let length = row(best).norm();
        let offset = set.offsets[best] / length;
        return Some(Cut { normal: row(best) / length, offset, clearance: depth(best) });
    }
    let polytope = set.polytope();
    let sides = HalfSpaces { normals: polytope.normals(), offsets: polytope.offsets() };
    let nearest = nearest_point_of_polytope(sides, &DVector::from_column_slice(x.as_slice()))?;
    let nearest = RelativeVector::from_column_slice(nearest.as_slice());
    let distance = (x - nearest).norm();
    let normal = (x - nearest) / distance;
    let offset = normal.dot(&nearest);
    Some(Cut { normal, offset, clearance: distance })
}
