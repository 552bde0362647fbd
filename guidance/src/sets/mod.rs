//! Convex sets that speak by their support function.

mod centred_ellipsoid;
mod ellipsoid;
mod hull;
mod polytope;
mod zonotope;
mod zonotope_facets;

pub use centred_ellipsoid::{CentredEllipsoid, Tangent};
pub use ellipsoid::{Ellipsoid, EllipsoidError, OuterSum};
pub use hull::{Hull, HullError, vertices};
pub use polytope::Polytope;
pub use zonotope::{Zonotope, ZonotopeGauge, ZonotopeMeasure};
pub use zonotope_facets::ZonotopeFacets;

use nalgebra::DVector;

/// A closed convex set.
pub trait ConvexSet {
    /// Dimension of the space.
    fn dimension(&self) -> usize;

    /// rho(d) = sup d'x over the set; infinite if unbounded that way, -infinite if empty.
    fn support_function(&self, direction: &DVector<f64>) -> f64;
}
