//! Convex hulls of points in few dimensions, and vertices of polytopes by duality.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};

use super::Polytope;
use crate::budget::{Budget, Interruption};

/// A point closer than this to the hull, relative to the size of the points, does not extend it.
const BEYOND: f64 = 1e-10;

/// Why there is no hull.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum HullError {
    /// The points lie in a plane of lower dimension, or there are too few.
    #[error("the points span no volume")]
    Flat,
    /// More facets than allowed.
    #[error("more than {0} facets")]
    TooManyFacets(usize),
    /// Stopped from outside.
    #[error("stopped: {0:?}")]
    Interrupted(Interruption),
}

impl From<Interruption> for HullError {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// The hull of some of the points it was given: those that extended it.
#[derive(Debug, Clone, PartialEq)]
pub struct Hull {
    points: Vec<DVector<f64>>,
    centre: DVector<f64>,
    facets: Vec<Facet>,
    size: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct Facet {
    /// Indices of its n points, increasing.
    corners: Vec<usize>,
    /// Of unit length, outwards.
    normal: DVector<f64>,
    offset: f64,
}

impl Hull {
    /// The hull of `points`, one after the other (beneath and beyond): facets that see a new
    /// point are replaced by those that join it to the rim of what it sees.
    ///
    /// # Errors
    /// [`HullError`].
    pub fn new(
        points: &[DVector<f64>],
        facets_max: usize,
        budget: Budget<'_>,
    ) -> Result<Self, HullError> {
        let simplex = first_simplex(points).ok_or(HullError::Flat)?;
        let n = points[0].len();
        let corners: Vec<DVector<f64>> = simplex.iter().map(|&i| points[i].clone()).collect();
        let centre = corners.iter().sum::<DVector<f64>>() / (n + 1) as f64;
        let size = points.iter().map(|p| (p - &centre).amax()).fold(0.0, f64::max);
        let mut hull = Self { points: corners, centre, facets: Vec::new(), size };
        for left_out in 0..=n {
            let corners: Vec<usize> = (0..=n).filter(|&i| i != left_out).collect();
            hull.push_facet(corners);
        }
        for (i, point) in points.iter().enumerate() {
            budget.check()?;
            if !simplex.contains(&i) {
                hull.insert(point, facets_max)?;
            }
        }
        Ok(hull)
    }

    /// Extends the hull by a point, if it lies outside; true if it did.
    ///
    /// # Errors
    /// [`HullError::TooManyFacets`]; the hull is as it was.
    pub fn insert(&mut self, point: &DVector<f64>, facets_max: usize) -> Result<bool, HullError> {
        let limit = BEYOND * self.size;
        let sees = |facet: &Facet| facet.normal.dot(point) - facet.offset > limit;
        // A ridge of one seen facet is on the rim; one of two is inside what is seen.
        let mut ridges: BTreeMap<Vec<usize>, usize> = BTreeMap::new();
        let mut seen = 0;
        for facet in self.facets.iter().filter(|facet| sees(facet)) {
            seen += 1;
            for left_out in 0..facet.corners.len() {
                let mut ridge = facet.corners.clone();
                ridge.remove(left_out);
                *ridges.entry(ridge).or_default() += 1;
            }
        }
        if seen == 0 {
            return Ok(false);
        }
        let rim: Vec<Vec<usize>> =
            ridges.into_iter().filter(|(_, count)| *count == 1).map(|(ridge, _)| ridge).collect();
        if self.facets.len() - seen + rim.len() > facets_max {
            return Err(HullError::TooManyFacets(facets_max));
        }
        self.facets.retain(|facet| !sees(facet));
        self.points.push(point.clone());
        self.size = self.size.max((point - &self.centre).amax());
        let new = self.points.len() - 1;
        for mut ridge in rim {
            ridge.push(new);
            self.push_facet(ridge);
        }
        Ok(true)
    }

    /// The facets as half-spaces of unit normals.
    #[must_use]
    pub fn to_polytope(&self) -> Polytope {
        let n = self.centre.len();
        let normals = DMatrix::from_fn(self.facets.len(), n, |i, j| self.facets[i].normal[j]);
        let offsets = self.facets.iter().map(|facet| facet.offset);
        Polytope::new(normals, DVector::from_iterator(self.facets.len(), offsets))
    }

    /// Facets.
    #[must_use]
    pub fn facet_count(&self) -> usize {
        self.facets.len()
    }

    /// The points that are corners of facets.
    #[must_use]
    pub fn corners(&self) -> Vec<DVector<f64>> {
        let mut used = vec![false; self.points.len()];
        self.facets.iter().flat_map(|facet| &facet.corners).for_each(|&i| used[i] = true);
        let corners = self.points.iter().zip(used).filter(|(_, used)| *used);
        corners.map(|(point, _)| point.clone()).collect()
    }

    /// Largest distance beyond a facet; negative inside.
    #[must_use]
    pub fn violation(&self, point: &DVector<f64>) -> f64 {
        let beyond = self.facets.iter().map(|facet| facet.normal.dot(point) - facet.offset);
        beyond.fold(f64::NEG_INFINITY, f64::max)
    }

    fn push_facet(&mut self, corners: Vec<usize>) {
        let n = self.centre.len();
        let base = &self.points[corners[0]];
        let edges = DMatrix::from_fn(n - 1, n, |i, j| self.points[corners[i + 1]][j] - base[j]);
        let mut normal = orthogonal_to(edges);
        let mut offset = normal.dot(base);
        if normal.dot(&self.centre) > offset {
            normal = -normal;
            offset = -offset;
        }
        self.facets.push(Facet { corners, normal, offset });
    }
}

/// The vertices of a bounded polytope around `interior`: the facets of the hull of its polar
/// points a_i / (b_i - a_i z).
///
/// # Errors
/// [`HullError::Flat`] if the polytope is unbounded, or the interior point is not inside.
pub fn vertices(
    polytope: &Polytope,
    interior: &DVector<f64>,
    facets_max: usize,
    budget: Budget<'_>,
) -> Result<Vec<DVector<f64>>, HullError> {
    let rooms = polytope.margins(interior);
    if !rooms.iter().all(|&room| room > 0.0) {
        return Err(HullError::Flat);
    }
    let polar: Vec<DVector<f64>> = (polytope.normals().row_iter().zip(rooms.iter()))
        .map(|(normal, room)| normal.transpose() / *room)
        .collect();
    let hull = Hull::new(&polar, facets_max, budget)?;
    // Unbounded exactly if the polar points do not surround the origin.
    if !hull.facets.iter().all(|facet| facet.offset > BEYOND * hull.size) {
        return Err(HullError::Flat);
    }
    Ok(hull.facets.iter().map(|facet| interior + &facet.normal / facet.offset).collect())
}

/// n + 1 points that span much volume: each the farthest from the plane of those before.
fn first_simplex(points: &[DVector<f64>]) -> Option<Vec<usize>> {
    let n = points.first()?.len();
    let farthest = |measure: &dyn Fn(&DVector<f64>) -> f64| {
        (0..points.len()).max_by(|&a, &b| measure(&points[a]).total_cmp(&measure(&points[b])))
    };
    // The farthest from the mean is a corner, not just a point of a face.
    let mean = points.iter().sum::<DVector<f64>>() / points.len() as f64;
    let first = farthest(&|p| (p - &mean).norm())?;
    let mut chosen = vec![first];
    let mut directions: Vec<DVector<f64>> = Vec::new();
    let size = points.iter().map(|p| (p - &points[first]).norm()).fold(0.0, f64::max);
    for _ in 0..n {
        let rest = |p: &DVector<f64>| {
            let mut rest = p - &points[first];
            // Twice is enough for orthogonality to working precision.
            for _ in 0..2 {
                directions.iter().for_each(|d| rest -= d * d.dot(&rest));
            }
            rest
        };
        let next = farthest(&|p| rest(p).norm())?;
        let direction = rest(&points[next]);
        let length = direction.norm();
        if !(length > 1e-9 * size) {
            return None;
        }
        directions.push(direction / length);
        chosen.push(next);
    }
    Some(chosen)
}

/// A unit vector orthogonal to the n - 1 rows, by elimination with complete pivoting.
fn orthogonal_to(mut rows: DMatrix<f64>) -> DVector<f64> {
    let n = rows.ncols();
    let mut order: Vec<usize> = (0..n).collect();
    for k in 0..n - 1 {
        let mut pivot = (k, k);
        for i in k..n - 1 {
            for j in k..n {
                if rows[(i, j)].abs() > rows[pivot].abs() {
                    pivot = (i, j);
                }
            }
        }
        rows.swap_rows(k, pivot.0);
        rows.swap_columns(k, pivot.1);
        order.swap(k, pivot.1);
        let head = rows[(k, k)];
        if head == 0.0 {
            break;
        }
        for i in k + 1..n - 1 {
            let factor = rows[(i, k)] / head;
            for j in k..n {
                rows[(i, j)] -= factor * rows[(k, j)];
            }
        }
    }
    let mut solution = vec![0.0; n];
    solution[n - 1] = 1.0;
    for k in (0..n - 1).rev() {
        let known: f64 = (k + 1..n).map(|j| rows[(k, j)] * solution[j]).sum();
        solution[k] = if rows[(k, k)] == 0.0 { 0.0 } else { -known / rows[(k, k)] };
    }
    let mut normal = DVector::zeros(n);
    order.iter().zip(&solution).for_each(|(&place, &value)| normal[place] = value);
    let length = normal.norm();
    normal / length
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The 2^n corners of the unit cube, its centre, and a point on a face.
    fn cube(n: usize) -> Vec<DVector<f64>> {
        let mut points: Vec<DVector<f64>> = (0..1_usize << n)
            .map(|signs| DVector::from_fn(n, |i, _| if signs >> i & 1 == 1 { 1.0 } else { -1.0 }))
            .collect();
        points.push(DVector::zeros(n));
        points.push(DVector::from_fn(n, |i, _| if i == 0 { 1.0 } else { 0.0 }));
        points
    }

    #[test]
    fn hull_of_a_cube_is_the_cube() {
        for n in 2..=5 {
            let hull = Hull::new(&cube(n), 10_000, Budget::UNLIMITED).unwrap();
            assert_eq!(hull.corners().len(), 1 << n);
            // Every facet of the triangulated surface lies in a face of the cube.
            for facet in &hull.facets {
                assert!((facet.normal.amax() - 1.0).abs() < 1e-12, "{n}: {}", facet.normal);
                assert!((facet.offset - 1.0).abs() < 1e-12);
            }
            assert!(hull.violation(&DVector::from_element(n, 0.999)) < 0.0);
            assert!((hull.violation(&DVector::from_element(n, 1.5)) - 0.5).abs() < 1e-12);
        }
    }

    #[test]
    fn vertices_of_a_cube_are_its_corners() {
        for n in 2..=4 {
            let polytope = Hull::new(&cube(n), 10_000, Budget::UNLIMITED).unwrap().to_polytope();
            let interior = DVector::from_element(n, 0.1);
            let found = vertices(&polytope, &interior, 10_000, Budget::UNLIMITED).unwrap();
            for corner in &cube(n)[..1 << n] {
                assert!(found.iter().any(|v| (v - corner).amax() < 1e-9), "{n}: {corner}");
            }
            for vertex in &found {
                assert!((vertex.abs() - DVector::from_element(n, 1.0)).amax() < 1e-9);
            }
        }
    }

    #[test]
    fn flat_points_and_unbounded_polytopes_are_refused() {
        let flat = [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]].map(|p| DVector::from_column_slice(&p));
        assert_eq!(Hull::new(&flat, 100, Budget::UNLIMITED), Err(HullError::Flat));
        let strip = Polytope::new(
            DMatrix::from_row_slice(3, 2, &[1.0, 0.0, -1.0, 0.0, 0.0, 1.0]),
            DVector::from_element(3, 1.0),
        );
        assert_eq!(
            vertices(&strip, &DVector::zeros(2), 100, Budget::UNLIMITED),
            Err(HullError::Flat)
        );
    }
}
