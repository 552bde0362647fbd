//! The black box: what was asked and what was answered, so that it can be asked again.
//!
//! A node that is told to writes down each call of the guidance service, and of a closed loop each
//! message, as it went over the wire. Headers are never written, and a request that holds
//! anything like a token is not either. One thread writes; calls hand over what they have and go
//! on, and what it cannot take is counted and said.

mod format;
mod writer;

use std::path::PathBuf;

#[cfg(feature = "fuzzing")]
pub(crate) use format::file_of;
pub use format::{Entry, Exchange, Lost, Recording, RecordingFault, Session, digest, entry};
pub(crate) use writer::Recorder;

/// What a node is told about its black box.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingOptions {
    /// The file; without one nothing is recorded. What was written before the latest change of
    /// files stands beside it in a file of the same name with `.1` behind it.
    pub file: Option<PathBuf>,
    /// Most bytes of both files together.
    pub bytes_max: u64,
    /// Keep the bytes of answers; without them only their digests.
    pub answers: bool,
}

impl Default for RecordingOptions {
    fn default() -> Self {
        Self { file: None, bytes_max: 256 << 20, answers: true }
    }
}

impl RecordingOptions {
    /// Fewest bytes that are of any use: one exchange of the largest kind fits.
    pub(crate) const BYTES_MIN: u64 = 1 << 20;
    /// Most that anybody would read again.
    pub(crate) const BYTES_MAX: u64 = 1 << 44;
}
