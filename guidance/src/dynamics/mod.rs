//! Dynamics of relative motion, and feedback gains for them.

mod clohessy_wiltshire;
mod elliptic;
mod gain;
mod scaling;
mod two_body;
mod yamanaka_ankersen;

pub use clohessy_wiltshire::clohessy_wiltshire;
pub use elliptic::{
    ForceMatrix, HeldStep, PeriodicPlant, RelativeVector, TransitionMatrix, elliptic_step,
};
pub use gain::{GainError, linear_quadratic_regulator, place_poles, spectral_radius};
pub use scaling::HillScaling;
pub use two_body::TwoBodyDrift;
pub use yamanaka_ankersen::{TschaunerHempel, yamanaka_ankersen};
