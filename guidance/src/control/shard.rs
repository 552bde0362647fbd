//! What stands around a shard's own bytes, so that they can travel between machines.
//!
//! A shard is merged with others by a machine that did not compute it: bytes that were changed on
//! the way, that belong to another problem or that another version of the mathematics wrote must
//! not become part of an artifact.

use super::{Failure, Method, ReadError};
use crate::{
    budget::Budget,
    bytes::{Reader, Writer},
};

/// First bytes of a shard of any method, with the version of the layout.
const MAGIC: &[u8; 8] = b"vbarSH\x00\x01";

/// Where a shard belongs.
pub(super) struct Place {
    pub(super) method: Method,
    /// Canonical bytes.
    pub(super) problem: Vec<u8>,
    /// Number of shards that the problem has.
    pub(super) shards: usize,
}

impl Place {
    /// Bytes of shard `index`, whose own are written by `body`.
    pub(super) fn seal(&self, index: usize, body: impl FnOnce(&mut Writer)) -> Vec<u8> {
        let mut writer = Writer::exact();
        writer.bytes(MAGIC);
        writer.bytes(self.method.name().as_bytes());
        writer.bytes(self.method.version().as_bytes());
        writer.bytes(&self.problem);
        writer.count(index);
        body(&mut writer);
        writer.seal()
    }

    /// Reads what [`Self::seal`] wrote; `body` gets the index and reads to the end.
    pub(super) fn open<T>(
        &self,
        bytes: &[u8],
        budget: Budget<'_>,
        body: impl FnOnce(usize, &mut Reader<'_>) -> Result<T, ReadError>,
    ) -> Result<T, ReadError> {
        let mut reader = Reader::unsealed(bytes, || budget.check().map_err(ReadError::from))?;
        for (expected, what) in [
            (MAGIC.as_slice(), "not a shard of this layout"),
            (self.method.name().as_bytes(), "a shard of another method"),
            (self.method.version().as_bytes(), "a shard of another version of the method"),
            (&self.problem, "a shard of another problem"),
        ] {
            if reader.bytes()? != expected {
                return Err(reader.fault(what).into());
            }
        }
        let index = reader.count()?;
        if index >= self.shards {
            return Err(reader.fault(format!("shard {index} of {}", self.shards)).into());
        }
        let shard = body(index, &mut reader)?;
        reader.end()?;
        Ok(shard)
    }
}

/// Refuses indices that are not those of all shards, in order, each once.
pub(super) fn complete(
    indices: impl IntoIterator<Item = usize>,
    shards: usize,
) -> Result<(), Failure> {
    if indices.into_iter().eq(0..shards) {
        return Ok(());
    }
    Err(Failure::Numerical("shards are missing or out of order".into()))
}
