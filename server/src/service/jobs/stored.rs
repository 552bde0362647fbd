//! What a store holds of jobs, read and written again: what fuzz targets throw bytes at. `None` if
//! the bytes are refused.

use bytes::Bytes;

use super::{
    View,
    fleet::{errand_rewritten, word_rewritten},
    record::JobRecord,
    requests,
};
use crate::wire::{ArtifactId, Render as _};

/// A job, shown as a caller sees it.
pub(crate) fn job(bytes: &[u8]) -> Option<Bytes> {
    let record = JobRecord::decode(&Bytes::copy_from_slice(bytes)).ok()?;
    let metadata = View::new(ArtifactId([0; 32]), &record, None).progress.render();
    assert!((0.0..=1.0).contains(&metadata.fraction_done), "{metadata:?}");
    Some(record.encode().into())
}

/// A caller's own name for a job.
pub(crate) fn request(bytes: &[u8]) -> Option<Bytes> {
    requests::decode(bytes).map(|(job, at)| requests::encode(job, at))
}

/// A task in the queue.
pub(crate) fn errand(bytes: &[u8]) -> Option<Bytes> {
    errand_rewritten(bytes)
}

/// What machines tell one another.
pub(crate) fn word(bytes: &[u8]) -> Option<Bytes> {
    word_rewritten(bytes)
}
