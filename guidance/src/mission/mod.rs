//! Words of a rendezvous mission: target, docking port, cone, uncertainty.

mod docking_cone;
mod target;
mod uncertainty;

pub use docking_cone::{CONE_FACES, ConeFaces, DockingCone};
pub use target::{BodyMotion, RateReference, TargetMotion, TargetSample};
pub use uncertainty::{
    ActuationAndNavigation, CovarianceFault, DisturbanceSet, NavigationCovariance,
};
