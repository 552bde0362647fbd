//! Where a disturbed plant can be: tubes and what they take from constraints.

mod tube;

pub use tube::{Decrease, Tube, TubeError};
