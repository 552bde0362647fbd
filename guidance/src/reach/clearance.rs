//! How far outside a polytope a flight stays, at its instants and between them.

use nalgebra::Vector3;

use super::flight::{Flight, Segment};
use crate::{dynamics::RelativeVector, sets::Polytope};

/// Outside a polytope of states, beyond at least one face by its clearance.
#[derive(Debug, Clone)]
pub struct Outside {
    faces: Vec<Face>,
}

/// normal x >= limit is outside.
#[derive(Debug, Clone, Copy)]
struct Face {
    normal: RelativeVector,
    limit: f64,
    /// |offset| of the polytope, so that excesses have no unit; 1 for an offset of 0.
    scale: f64,
}

impl Outside {
    /// Of {x : H x <= l}, with clearances in the units of l, one a row.
    ///
    /// # Panics
    /// If there is not one clearance a row.
    #[must_use]
    pub fn new(avoid: &Polytope, clearances: &[f64]) -> Self {
        assert_eq!(avoid.offsets().len(), clearances.len(), "one clearance a row");
        let face = |r: usize| {
            let offset = avoid.offsets()[r];
            Face {
                normal: RelativeVector::from_fn(|c, _| avoid.normals()[(r, c)]),
                limit: offset + clearances[r],
                scale: if offset != 0.0 { offset.abs() } else { 1.0 },
            }
        };
        Self { faces: (0..clearances.len()).map(face).collect() }
    }

    /// Scale of each face.
    pub(super) fn scales(&self) -> impl Iterator<Item = f64> {
        self.faces.iter().map(|face| face.scale)
    }

    /// Right side of each face, its clearance included.
    pub(super) fn limit(&self, face: usize) -> f64 {
        self.faces[face].limit
    }

    /// Largest excess beyond a face, in parts of its scale: at least 0 outside.
    #[must_use]
    pub fn excess(&self, x: &RelativeVector) -> f64 {
        self.faces
            .iter()
            .map(|face| (face.normal.dot(x) - face.limit) / face.scale)
            .fold(f64::NEG_INFINITY, f64::max)
    }

    /// Least excess at the instants of a flight; infinite without states.
    #[must_use]
    pub fn at_instants(&self, flight: &Flight) -> f64 {
        flight.states().iter().map(|x| self.excess(x)).fold(f64::INFINITY, f64::min)
    }

    /// Least excess between the instants too, positions and speeds along the cubic through both
    /// ends of a segment.
    #[must_use]
    pub fn throughout(&self, flight: &Flight) -> f64 {
        let states = flight.states();
        (1..states.len()).fold(self.at_instants(flight), |least, i| {
            least.min(self.between(&states[i - 1], &states[i], flight.spacing_s(), least))
        })
    }

    /// Least excess between two states, or any bound on it that is at least `enough`.
    pub(super) fn between(
        &self,
        from: &RelativeVector,
        to: &RelativeVector,
        spacing_s: f64,
        enough: f64,
    ) -> f64 {
        let segment = Segment::between(from, to, spacing_s);
        let bound = self.bound(&segment);
        if bound >= enough {
            return bound;
        }
        let excess = |share: f64| {
            let (p, v) = (segment.position(share), segment.velocity(share));
            self.excess(&RelativeVector::new(p.x, p.y, p.z, v.x, v.y, v.z))
        };
        segment.least(excess).0
    }

    /// A segment stays in the hull of its control points, so beyond one face it stays at least as
    /// far as the nearest of them.
    fn bound(&self, segment: &Segment) -> f64 {
        let speeds = segment.velocity_control();
        let least = |normal: Vector3<f64>, points: &[Vector3<f64>]| {
            points.iter().map(|p| normal.dot(p)).fold(f64::INFINITY, f64::min)
        };
        let face = |face: &Face| {
            let (p, v) = (face.normal.fixed_rows::<3>(0), face.normal.fixed_rows::<3>(3));
            let product = least(p.into_owned(), &segment.control) + least(v.into_owned(), &speeds);
            (product - face.limit) / face.scale
        };
        self.faces.iter().map(face).fold(f64::NEG_INFINITY, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    #[test]
    fn corner_is_seen_to_be_cut_between_instants_only() {
        let normals = DMatrix::from_row_slice(
            2,
            6,
            &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        );
        let corner = Polytope::new(normals, DVector::from_element(2, 20.0));
        let outside = Outside::new(&corner, &[0.0; 2]);
        // From beyond one face to beyond the other one in 30 s, through the corner.
        let state = |x: f64, y: f64| RelativeVector::new(x, y, 0.0, -0.5, 0.5, 0.0);
        let flight = Flight::from_states(30.0, vec![state(25.0, 5.0), state(10.0, 20.0)]);
        assert!(outside.at_instants(&flight) >= 0.0);
        // On the straight line x + y = 30 the corner is missed by 5 m along each axis.
        let least = outside.throughout(&flight);
        assert!((least * 20.0 + 5.0).abs() < 1e-6, "{least}");
        let clear = Flight::from_states(30.0, vec![state(40.0, 5.0), state(25.0, 20.0)]);
        assert!((outside.throughout(&clear) * 20.0 - 5.0).abs() < 1e-9);
    }
}
