//! The truth: how the world moves when a command is applied.
//!
//! Written from the papers and from orbital mechanics alone; nothing here is shared with the
//! guidance that is being judged, so that one wrong sign cannot hide in both.

pub(crate) mod cone;
pub(crate) mod hermite;
pub(crate) mod hill;
pub(crate) mod linear;
pub(crate) mod lvlh;
pub(crate) mod planar;
pub(crate) mod relative_truth;
pub(crate) mod rotation;
pub(crate) mod runge_kutta;
pub(crate) mod sun_moon;
pub(crate) mod target_track;
pub(crate) mod thrusters;
pub(crate) mod two_body;

/// Earth's gravitational parameter, m^3/s^2 (WGS 84).
pub(crate) const EARTH_MU_M3_S2: f64 = 3.986_004_418e14;

/// Earth's equatorial radius, m (WGS 84).
pub(crate) const EARTH_RADIUS_M: f64 = 6_378_137.0;

/// Earth's second zonal harmonic (EGM96).
pub(crate) const EARTH_J2: f64 = 1.082_626_68e-3;
