//! Pictures of a report.
use crate::{Mission, Report};
use std::path::{Path, PathBuf};
/// Why a picture could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// io
    #[error("{0}")]
    Io(#[from] std::io::Error),
}
/// Draws.
pub fn draw(_m: &Mission, _r: &Report, _out: &Path) -> Result<Vec<PathBuf>, PictureError> {
    Ok(vec![])
}
