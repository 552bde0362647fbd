//! The target's orbit: Kepler's motion, and how inertial and relative states belong together.

mod inertial;
mod kepler;

pub use inertial::{InertialState, chaser_state, relative_state};
pub use kepler::{KeplerOrbit, OrbitError, Orientation};

/// Gravitational parameter of the Earth, m³/s².
pub const EARTH_MU_M3_S2: f64 = 3.986_004_418e14;

/// Equatorial radius of the Earth, metres.
pub const EARTH_RADIUS_M: f64 = 6_378_137.0;
