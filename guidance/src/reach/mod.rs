//! Where a disturbed plant can be: tubes and what they take from constraints, sets that a control
//! law keeps, and the few rows of many that say so.

mod dominance;
mod elimination;
mod growth;
mod half_spaces;
mod invariant;
mod redundancy;
mod sampled_constraints;
mod scenario;
mod tube;

pub use elimination::{EliminationError, project_out_last};
pub use growth::{Growth, GrowthError, GrowthLimits, grow_control_invariant};
pub use half_spaces::{HalfSpaces, InteriorPoint, NoInterior};
pub use invariant::{
    Invariant, InvariantLimits, PlantVertex, max_robust_control_invariant,
    max_robust_positive_invariant, step_back,
};
pub use redundancy::{EXACT, Reduction, irredundant};
pub use sampled_constraints::{StageConstraints, StageFamily, StageGroup};
pub use scenario::{SampledRows, Scenario};
pub use tube::{Decrease, Tube, TubeError};
