//! Sets that error, drift or control can reach, from which they can be reached, or in which a control
//! law keeps them, and the few rows of many that say so.

mod abort;
mod clearance;
mod dominance;
mod elimination;
mod ellipsoids;
mod extremes;
mod flight;
mod growth;
mod half_spaces;
mod invariant;
mod passive;
mod polytopes;
mod reading;
mod redundancy;
mod sampled_constraints;
mod scenario;
mod separation;
mod tube;

pub use abort::{Abort, AbortQuestion, AbortVerdict, find_abort};
pub use clearance::Outside;
pub use elimination::{EliminationError, project_out_last};
pub use ellipsoids::{EllipsoidUnion, NearEllipsoid};
pub use extremes::{ExtremeCheck, check_extremes};
pub use flight::{Closest, Flight};
pub use growth::{Growth, GrowthError, GrowthLimits, grow_control_invariant};
pub use half_spaces::{HalfSpaces, InteriorPoint, NoInterior};
pub use invariant::{
    Invariant, InvariantLimits, PlantVertex, max_robust_control_invariant,
    max_robust_positive_invariant, step_back,
};
pub(crate) use passive::passive_safety_along;
pub use passive::{DriftVerdict, PassiveQuestion, PassiveVerdict, passive_safety};
pub use polytopes::{PolytopeQuestion, PolytopeUnion, ReachablePolytope};
pub use reading::ReadError;
pub use redundancy::{EXACT, Reduction, irredundant, irredundant_about};
pub use sampled_constraints::{StageConstraints, StageFamily, StageGroup};
pub use scenario::{Context, GroupPart, SampledRows, Scenario, Survivors};
pub use separation::{
    Cut, cut_off_ellipsoid, cut_off_ellipsoids, cut_off_polytope, cut_off_polytopes,
};
pub use tube::{Decrease, Tube, TubeError};
