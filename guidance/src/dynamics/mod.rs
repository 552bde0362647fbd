//! Dynamics of relative motion.

mod scaling;

pub use scaling::HillScaling;
