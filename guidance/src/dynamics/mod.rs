//! Dynamics of relative motion, and feedback gains for them.

mod clohessy_wiltshire;
mod gain;
mod scaling;
mod yamanaka_ankersen;

pub use clohessy_wiltshire::clohessy_wiltshire;
pub use gain::{GainError, linear_quadratic_regulator, place_poles, spectral_radius};
pub use scaling::HillScaling;
pub use yamanaka_ankersen::{TschaunerHempel, yamanaka_ankersen};
