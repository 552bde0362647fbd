//! Half-spaces that keep a predicted state out of a backward reachable set.

use nalgebra::DVector;

use super::{EllipsoidUnion, NearEllipsoid, ReachablePolytope};
use crate::{
    dynamics::RelativeVector,
    program::{
        PolytopeView, SeparationOutcome, nearest_point_of_polytope, separate_from_ellipsoids,
        separate_from_polytopes,
    },
    sets::Polytope,
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

/// The best half-space around several ellipsoids at once; `None` if none that holds them all leaves
/// `x` out. [AguilarMarsillach2022, eq. 32]
#[must_use]
pub fn cut_off_ellipsoids(
    union: &EllipsoidUnion,
    sets: &[NearEllipsoid],
    x: &RelativeVector,
) -> Option<Cut> {
    let precisions: Vec<_> =
        sets.iter().map(|set| union.precision(set.start, set.instant)).collect();
    let references: Vec<_> = precisions.iter().collect();
    common(separate_from_ellipsoids(&references, &DVector::from_column_slice(x.as_slice())), x)
}

/// The best half-space around several polytopes at once; `None` if none that holds them all and the
/// origin leaves `x` out. [AguilarMarsillach2022, eq. 28]
#[must_use]
pub fn cut_off_polytopes<'a>(
    sets: impl Iterator<Item = &'a ReachablePolytope<'a>>,
    x: &RelativeVector,
) -> Option<Cut> {
    let polytopes: Vec<Polytope> = sets.map(ReachablePolytope::polytope).collect();
    let sides: Vec<PolytopeView<'_>> = polytopes
        .iter()
        .map(|set| PolytopeView { normals: set.normals(), offsets: set.offsets() })
        .collect();
    common(separate_from_polytopes(&sides, &DVector::from_column_slice(x.as_slice())), x)
}

/// What the solver found, if it leaves x out; how far is computed once more.
fn common(outcome: SeparationOutcome, x: &RelativeVector) -> Option<Cut> {
    let SeparationOutcome::Found(found) = outcome else { return None };
    let normal = RelativeVector::from_column_slice(found.normal.as_slice());
    let clearance = normal.dot(x) - 1.0;
    (clearance >= 0.0).then_some(Cut { normal, offset: 1.0, clearance })
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
    let sides = PolytopeView { normals: polytope.normals(), offsets: polytope.offsets() };
    let nearest = nearest_point_of_polytope(sides, &DVector::from_column_slice(x.as_slice()))?;
    let nearest = RelativeVector::from_column_slice(nearest.as_slice());
    let distance = (x - nearest).norm();
    let normal = (x - nearest) / distance;
    let offset = normal.dot(&nearest);
    Some(Cut { normal, offset, clearance: distance })
}
