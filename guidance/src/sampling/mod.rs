//! Chance, seeded and countable: streams, laws, and how many samples a claim needs.

mod law;
mod sample_size;
mod stream;

pub use law::{ScalarLaw, ScalarLawError};
pub use sample_size::{
    SampleSizeError, VIOLATION_MAX, failure_of_any, sample_size, sample_size_bound,
};
pub use stream::Stream;
