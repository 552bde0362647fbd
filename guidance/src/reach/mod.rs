//! Sets of states that error or drift can reach, or from which they can be reached.

mod abort;
mod ellipsoids;
mod flight;
mod passive;
mod polytopes;
mod separation;
mod tube;

pub use abort::{Abort, AbortQuestion, AbortVerdict, find_abort};
pub use ellipsoids::{EllipsoidUnion, NearEllipsoid};
pub use flight::{Closest, Flight};
pub use passive::{PassiveQuestion, PassiveVerdict, passive_safety};
pub use polytopes::{PolytopeQuestion, PolytopeUnion, ReachablePolytope};
pub use separation::{Cut, cut_off_ellipsoid, cut_off_polytope};
pub use tube::{Decrease, Tube, TubeError};
