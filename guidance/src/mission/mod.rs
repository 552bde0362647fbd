//! Words of a rendezvous mission: target, docking port, cone, thrusters, avoidance, uncertainty.

mod avoidance;
mod docking_cone;
mod planar_cone;
mod target;
mod thrusters;
mod uncertainty;

pub use avoidance::{AvoidanceRegion, AvoidanceSet, SPEED_MAX_DEFAULT_M_S};
pub use docking_cone::{CONE_FACES, ConeFaces, DockingCone};
pub use planar_cone::PlanarCone;
pub use target::{BodyMotion, RateReference, TargetMotion, TargetSample};
pub use thrusters::{THRUSTERS_MAX, ThrustMode, Thruster, Thrusters, dominating_modes};
pub use uncertainty::{
    ActuationAndNavigation, CovarianceFault, DisturbanceSet, NavigationCovariance,
};
