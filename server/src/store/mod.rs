//! Where artifacts and plans are kept: bytes under ids, created once, never changed; and what is
//! to be remembered about work, whose entries do change.
//!
//! One contract, three back-ends, one conformance suite that all pass. The store knows nothing of
//! what the bytes mean. A back-end that several machines reach at once is [`Shared`] too: it hands
//! out tasks and tells each machine what the others wrote.

mod cluster;
#[cfg(test)]
mod conformance;
mod directory;
mod memory;
mod nats;

use std::{fmt::Debug, io};

use bytes::Bytes;

#[cfg(test)]
pub(crate) use cluster::memory::MemoryShared;
pub(crate) use cluster::{Change, Follower, Hearer, Lease, Leased, Shared, Task};
pub(crate) use directory::{DirectoryStore, Syncing};
#[cfg(test)]
pub(crate) use directory::{Faults, FaultyDisk};
pub(crate) use memory::MemoryStore;
pub use nats::NatsLocation;
pub(crate) use nats::{NatsStore, without_user};

/// Names one record.
pub(crate) type RecordId = [u8; 32];

/// Kinds of records, kept apart: the same id may stand on two shelves and mean two things.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Shelf {
    /// What precomputes made, under the id of the problem.
    Artifacts,
    /// Plans to fly, under the digest of their content.
    Plans,
    /// Problems of jobs that several machines do, while they do them.
    Problems,
    /// Parts of what such jobs make, until they are put together.
    Shards,
}

impl Shelf {
    /// Every one.
    pub(crate) const ALL: [Self; 4] = [Self::Artifacts, Self::Plans, Self::Problems, Self::Shards];

    /// In paths and names of buckets.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Artifacts => "artifacts",
            Self::Plans => "plans",
            Self::Problems => "problems",
            Self::Shards => "shards",
        }
    }
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

impl Ledger {
    /// Every one.
    pub(crate) const ALL: [Self; 3] = [Self::Jobs, Self::Requests, Self::Leases];

    /// In paths and names of buckets.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Jobs => "jobs",
            Self::Requests => "requests",
            Self::Leases => "leases",
        }
    }
}

/// Grows whenever an entry is written; 0 says that there is none.
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
/// is written whole or not at all, and only by whoever has seen its latest revision. A call that
/// failed may have done what it was asked; whoever asks for it again is not refused for that.
/// Calls may block on a disk: call them where that is allowed.
pub(crate) trait Store: Debug + Send + Sync {
    /// Creates the record unless it exists; answers what is there already.
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError>;

    /// The record, verified against its digest; `None` if there is none.
    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError>;

    /// Whether the record is there.
    fn contains(&self, shelf: Shelf, id: &RecordId) -> Result<bool, StoreError> {
        self.get(shelf, id).map(|record| record.is_some())
    }

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

    /// Erases the entry whose latest revision is `seen`; nothing to do if there is none. One that a
    /// directory finds damaged goes whatever was seen: nobody can have seen it.
    ///
    /// # Errors
    /// As [`Store::write`].
    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError>;

    /// Ids of every entry, in ascending order.
    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError>;

    /// Whether it answers and takes something now, as far as it can tell.
    fn reach(&self) -> Result<(), StoreError>;
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
    /// It cannot be reached, or did not answer in time: whether anything was done is not known.
    #[error("the store does not answer: {0}")]
    Unreachable(String),
    /// The world.
    #[error("{doing}: {source}")]
    Io { doing: String, source: io::Error },
}

/// What a file of a directory holds, if it is an entry, with the digest of all of it put right.
#[cfg(feature = "fuzzing")]
pub(crate) fn entry_in_file(body: &[u8]) -> Option<Entry> {
    use sha2::Digest as _;
    let file = [&sha2::Sha256::digest(body)[..], body].concat();
    let content = directory::content(file.into()).expect("its digest is right");
    directory::entry(&content).ok()
}

/// The key of a record on NATS, read and written again; `None` if it cannot be read.
#[cfg(feature = "fuzzing")]
pub(crate) fn commit_rewritten(bytes: &[u8]) -> Option<Bytes> {
    nats::commit_rewritten(bytes)
}

/// The id in hexadecimal, read and written again.
#[cfg(feature = "fuzzing")]
pub(crate) fn id_rewritten(text: &str) -> Option<String> {
    unhex(text).map(|id| hex(&id))
}

/// The id that [`hex`] wrote.
fn unhex(text: &str) -> Option<RecordId> {
    let mut id = RecordId::default();
    if text.len() != 2 * id.len() || !text.is_ascii() {
        return None;
    }
    for (byte, digits) in id.iter_mut().zip(text.as_bytes().chunks(2)) {
        let digits = std::str::from_utf8(digits).ok()?;
        *byte = u8::from_str_radix(digits, 16).ok()?;
    }
    Some(id)
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(bytes.len() * 2), |mut text, byte| {
        write!(text, "{byte:02x}").expect("a String takes everything");
        text
    })
}
