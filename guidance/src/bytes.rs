//! Canonical bytes: our own fixed little-endian encoding.

/// Why bytes could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("at byte {offset}: {what}")]
pub struct DecodeError {
    /// Where.
    pub offset: usize,
    /// What was wrong.
    pub what: String,
}
