//! What machines that work together need of a store beside records and entries.

use std::time::{Duration, SystemTime};

use bytes::Bytes;

use super::{Entry, Ledger, RecordId, Store, StoreError};

/// A store that several machines reach at once.
///
/// Contract: a task that was queued is leased to somebody until somebody says it is done, to one at
/// a time while the lease is renewed, and possibly to several when it is not. Whoever follows a
/// ledger sees the latest state of every entry in the end; not every state in between.
pub(crate) trait Shared: Store {
    /// Queues a task. The same name twice within a minute is one task.
    fn queue(&self, task: Task) -> Result<(), StoreError>;

    /// Waits for a task for at most `patience`.
    fn lease(&self, patience: Duration) -> Result<Option<Leased>, StoreError>;

    /// How long a lease lasts that nobody renews.
    fn lease_term(&self) -> Duration;

    /// Forgets every task of a group that nobody has leased.
    fn withdraw(&self, group: &RecordId) -> Result<(), StoreError>;

    /// Removes what those left who died while they put a record, before `oldest`; how many.
    fn tidy(&self, oldest: SystemTime) -> Result<usize, StoreError>;

    /// Tells `follower` of a ledger for as long as the store is open: of all of it at once, then of
    /// each change, and of all of it again whenever changes could have been missed.
    fn follow(&self, ledger: Ledger, follower: Follower);

    /// Says something to every machine that listens just now; it may be lost.
    fn tell(&self, word: Bytes);

    /// Hears what is told, for as long as the store is open.
    fn hear(&self, hearer: Hearer);
}

/// Something to do. The queue knows nothing of what the bytes mean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Task {
    /// Tasks that are withdrawn together.
    pub(crate) group: RecordId,
    /// Tells it from others of its group.
    pub(crate) name: String,
    /// Ids only: what is large lies on a shelf.
    pub(crate) bytes: Bytes,
}

/// A task that was handed out.
#[derive(Debug)]
pub(crate) struct Leased {
    /// Of the task.
    pub(crate) bytes: Bytes,
    /// How often it was handed out, this time included.
    pub(crate) deliveries: u64,
    /// To be renewed while it is worked at.
    pub(crate) lease: Box<dyn Lease>,
}

/// The hold on a task. Dropped, it runs out and the task is handed out again.
pub(crate) trait Lease: std::fmt::Debug + Send + Sync {
    /// Puts its end off.
    fn renew(&self) -> Result<(), StoreError>;

    /// The task is done.
    fn done(&self) -> Result<(), StoreError>;

    /// Somebody else should do it, now.
    fn hand_back(&self) -> Result<(), StoreError>;
}

/// What became of a ledger.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Change {
    /// Every entry, but for those that somebody wrote or erased while all of it was told: of
    /// these it is told next.
    All(Vec<(RecordId, Entry)>),
    /// One was written.
    Written(RecordId, Entry),
    /// One was erased.
    Erased(RecordId),
}

/// Is told of changes; must not block.
pub(crate) type Follower = Box<dyn Fn(Change) + Send + Sync>;

/// Is told words; must not block.
pub(crate) type Hearer = Box<dyn Fn(Bytes) + Send + Sync>;

#[cfg(test)]
pub(crate) mod memory;
