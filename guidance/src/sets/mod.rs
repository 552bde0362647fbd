//! Convex sets that speak by their support function.

mod hull;
mod polytope;
mod zonotope;

pub use hull::{Hull, HullError, vertices};
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
