//! Convex sets that speak by their support function.

mod ellipsoid;
mod polytope;
mod zonotope;

pub use ellipsoid::{Ellipsoid, EllipsoidError, OuterSum};
pub use polytope::Polytope;
pub use zonotope::{Zonotope, ZonotopeGauge, ZonotopeMeasure};

use nalgebra::DVector;

/// A closed convex set.
pub trait ConvexSet {
    /// Dimension of the space.
    fn dimension(&self) -> usize;

    /// rho(d) = sup d'x over the set; infinite if unbounded that way, -infinite if empty.
    fn support_function(&self, direction: &DVector<f64>) -> f64;
}
