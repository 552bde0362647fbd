//! Dynamics of relative motion, certain and uncertain, feedback gains and costs for them.

mod clohessy_wiltshire;
mod elliptic;
mod expected_cost;
mod gain;
mod poseidyn;
mod scaling;
mod transfer;
mod two_body;
mod uncertain_hill;
mod uncertain_plant;
mod yamanaka_ankersen;
mod zero_order_hold;

pub use clohessy_wiltshire::clohessy_wiltshire;
pub use elliptic::{
    ForceMatrix, HeldStep, PeriodicPlant, RelativeVector, TransitionMatrix, elliptic_step,
    integration_steps,
};
pub use expected_cost::{ExpectedCost, StageWeights, TerminalCostError, terminal_cost};
pub use gain::{GainError, linear_quadratic_regulator, place_poles, spectral_radius};
pub use poseidyn::{PoseidynVariant, poseidyn};
pub use scaling::HillScaling;
pub use transfer::{Prediction, Transfer};
pub use two_body::TwoBodyDrift;
pub use uncertain_hill::uncertain_hill;
pub use uncertain_plant::{
    Discretisation, MatrixPolynomial, Monomial, PlantMatrices, UncertainPlant, UncertainPlantError,
};
pub use yamanaka_ankersen::{TschaunerHempel, yamanaka_ankersen};
pub use zero_order_hold::zero_order_hold;
