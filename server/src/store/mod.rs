//! Where artifacts and plans are kept: bytes under ids, created once, never changed; and what is
//! to be remembered about work, whose entries do change.
//!
//! One contract, two back-ends, one conformance suite that both pass. The store knows nothing of
//! what the bytes mean.

#[cfg(test)]
mod conformance;
mod directory;
mod memory;

use std::{fmt::Debug, io};

use bytes::Bytes;

pub(crate) use directory::{DirectoryStore, Syncing};
pub(crate) use memory::MemoryStore;

/// Names one record.
pub(crate) type RecordId = [u8; 32];

/// Kinds of records, kept apart: the same id may stand on two shelves and mean two things.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Shelf {
    /// What precomputes made, under the id of the problem.
    Artifacts,
    /// Plans to fly, under the digest of their content.
    Plans,
}

/// Kinds of entries, kept apart like the shelves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Ledger {
    /// Precomputes, under the id of the problem.
    Jobs,
    /// Which problem came with which request id.
    Requests,
    /// Until when artifacts are kept.
    Leases,
}

/// How often an entry was written; 0 says that there is none.
pub(crate) type Revision = u64;

/// An entry of a ledger.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Entry {
    /// What was written last.
    pub(crate) bytes: Bytes,
    /// To be given back by whoever wants to change it.
    pub(crate) revision: Revision,
}

/// Keeps records and entries.
///
/// Contract: a record is created whole or not at all; once `put_if_absent` has answered, `get`
/// gives exactly those bytes or an error that says why not; nothing ever replaces them. An entry
/// is written whole or not at all, and only by whoever has seen its latest revision.
/// Calls may block on a disk: call them where that is allowed.
pub(crate) trait Store: Debug + Send + Sync {
    /// Creates the record unless it exists; answers what is there already.
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError>;

    /// The record, verified against its digest; `None` if there is none.
    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError>;

    /// Up to `limit` ids above `after`, in ascending order.
    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError>;

    /// Removes the record, if there is one.
    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError>;

    /// The entry, verified against its digest; `None` if there is none.
    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError>;

    /// Writes the entry whose latest revision is `seen` (0 for a new one); answers the new one.
    ///
    /// # Errors
    /// [`StoreError::Stale`] if somebody else wrote or erased it meanwhile.
    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError>;

    /// Erases the entry whose latest revision is `seen`; nothing to do if there is none.
    ///
    /// # Errors
    /// As [`Store::write`].
    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError>;

    /// Ids of every entry, in ascending order.
    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError>;
}

/// What came of [`Store::put_if_absent`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Put {
    /// The record is new.
    Created,
    /// It was there; these are its bytes.
    Existing(Bytes),
}

/// Why the store could not do what was asked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum StoreError {
    /// What is stored is not what was put.
    #[error("record {id} is damaged: {what}")]
    Damaged { id: String, what: &'static str },
    /// There is no room.
    #[error("the store is full: {0}")]
    Full(String),
    /// Another was faster.
    #[error("entry {id} was changed meanwhile: revision {seen} was seen, {found} is there")]
    Stale { id: String, seen: Revision, found: Revision },
    /// Another process has it.
    #[error("{0}")]
    InUse(String),
    /// The world.
    #[error("{doing}: {source}")]
    Io { doing: String, source: io::Error },
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        write!(text, "{byte:02x}").expect("a String takes everything");
        text
    })
}
