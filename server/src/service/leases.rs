//! Until when artifacts are kept, and how many bytes of them.
//!
//! The server cannot know who still holds an artifact's id. So every artifact has a lease, every
//! step that uses it puts the end of the lease off, and what nobody used for the whole term goes.
//! Steps only note it in memory; the sweep writes it down. A node that is killed in between loses
//! a minute of a lease, not the lease.
//!
//! Where several nodes share a store, each knows what it read of the others' leases at its last
//! sweep. Whoever writes a lease down puts its end off and never back; what has expired goes a few
//! minutes later, so that whoever used it last has written that down.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use bytes::Bytes;

use super::{Code, Error, clock::Clock};
use crate::{
    store::{Ledger, RecordId, Revision, Shelf, Store, StoreError},
    wire::ArtifactId,
};

/// Leases of every artifact in the store.
#[derive(Debug)]
pub(super) struct Leases {
    store: Arc<dyn Store>,
    clock: Arc<Clock>,
    term: Duration,
    bytes_max: u64,
    /// Other nodes change the leases too.
    is_shared: bool,
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    bytes: u64,
    by_id: BTreeMap<ArtifactId, Lease>,
}

#[derive(Debug, Clone, Copy)]
struct Lease {
    expires: SystemTime,
    /// Of the artifact.
    size: u64,
    revision: Revision,
    /// Put off since it was written down.
    is_dirty: bool,
}

impl Leases {
    /// Reads the leases of the store; artifacts without one, which a crash or an older node left,
    /// are given one.
    ///
    /// # Errors
    /// If the store cannot be read.
    pub(super) fn open(
        store: Arc<dyn Store>,
        clock: Arc<Clock>,
        term: Duration,
        bytes_max: u64,
        is_shared: bool,
    ) -> Result<Self, StoreError> {
        let leases = Self { store, clock, term, bytes_max, is_shared, known: Mutex::default() };
        leases.learn_all()?;
        Ok(leases)
    }

    /// Learns what is in the store and not known, and forgets what is not there any more; the ids
    /// of the latter.
    fn learn_all(&self) -> Result<Vec<ArtifactId>, StoreError> {
        let mut there: HashSet<RecordId> = HashSet::new();
        let mut after: Option<RecordId> = None;
        loop {
            const PAGE: usize = 1000;
            let ids = self.store.list(Shelf::Artifacts, after.as_ref(), PAGE)?;
            for id in &ids {
                self.learn(ArtifactId(*id))?;
            }
            there.extend(&ids);
            after = ids.last().copied();
            if ids.len() < PAGE {
                break;
            }
        }
        // Entries of artifacts that are gone: a sweep was cut short. What was made since the list
        // is there.
        for id in self.store.entries(Ledger::Leases)? {
            if !there.contains(&id)
                && !self.store.contains(Shelf::Artifacts, &id)?
                && let Some(entry) = self.read(ArtifactId(id))?
            {
                self.store.erase(Ledger::Leases, &id, entry.revision)?;
            }
        }
        let known: Vec<_> = self.known().by_id.keys().copied().collect();
        let mut gone = Vec::new();
        for id in known {
            if !there.contains(&id.0) && !self.store.contains(Shelf::Artifacts, &id.0)? {
                self.known().remove(id);
                gone.push(id);
            }
        }
        Ok(gone)
    }

    /// The entry of an artifact's lease, if it can be used.
    fn read(&self, id: ArtifactId) -> Result<Option<Lease>, StoreError> {
        match self.store.read(Ledger::Leases, &id.0) {
            Ok(entry) => Ok(entry.and_then(|entry| decode(&entry.bytes, entry.revision))),
            Err(fault @ StoreError::Damaged { .. }) => {
                tracing::error!(%fault, "a lease is granted anew");
                match self.store.erase(Ledger::Leases, &id.0, 0) {
                    Ok(()) | Err(StoreError::Stale { .. }) => Ok(None),
                    Err(fault) => Err(fault),
                }
            }
            Err(fault) => Err(fault),
        }
    }

    /// Learns the lease of an artifact that is in the store. Blocks on the store.
    pub(super) fn learn(&self, id: ArtifactId) -> Result<(), StoreError> {
        if self.expires(id).is_some() {
            return Ok(());
        }
        let lease = match self.read(id)? {
            Some(lease) => lease,
            None => {
                let record = match self.store.get(Shelf::Artifacts, &id.0) {
                    Ok(record) => record,
                    // Whoever asks for it is told; its lease says only when it goes.
                    Err(StoreError::Damaged { .. }) => None,
                    Err(fault) => return Err(fault),
                };
                let size = record.map_or(0, |record| record.len());
                self.fresh(size, 0)
            }
        };
        self.known().insert(id, lease);
        Ok(())
    }

    /// Whether an artifact is in the store. Blocks on the store where others use it too.
    pub(super) fn is_kept(&self, id: ArtifactId) -> Result<bool, StoreError> {
        if !self.is_shared {
            return Ok(self.expires(id).is_some());
        }
        if self.store.contains(Shelf::Artifacts, &id.0)? {
            self.learn(id)?;
            return Ok(true);
        }
        self.known().remove(id);
        Ok(false)
    }

    fn fresh(&self, size: usize, revision: Revision) -> Lease {
        let size = u64::try_from(size).unwrap_or(u64::MAX);
        Lease { expires: self.term_from_now(), size, revision, is_dirty: true }
    }

    /// Whole seconds: nobody needs more, and the same answer twice has the same bytes.
    fn term_from_now(&self) -> SystemTime {
        let now = self.clock.ahead().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let end = (now + self.term).as_secs_f64().ceil();
        SystemTime::UNIX_EPOCH + Duration::from_secs_f64(end)
    }

    /// Leases are put off in strides, so that most steps change nothing.
    fn stride(&self) -> Duration {
        (self.term / 24).min(Duration::from_secs(3600))
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether another artifact of `size` bytes may be kept.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED`.
    pub(super) fn admit(&self, size: usize) -> Result<(), Error> {
        const RETRY_AFTER: Duration = Duration::from_secs(60);
        let kept = self.known().bytes;
        let total = kept.saturating_add(u64::try_from(size).unwrap_or(u64::MAX));
        if total <= self.bytes_max {
            return Ok(());
        }
        let message = format!(
            "{total} bytes of artifacts with this one, {} are allowed; unused ones expire",
            self.bytes_max
        );
        Err(Error {
            retry_after: Some(RETRY_AFTER),
            ..Error::new(Code::ResourceExhausted, "ARTIFACTS_FULL", message)
        })
    }

    /// A lease for an artifact of `size` bytes that was just stored. Blocks on the store.
    pub(super) fn grant(&self, id: ArtifactId, size: usize) -> Result<(), StoreError> {
        if self.expires(id).is_some() {
            self.extend(id);
            return Ok(());
        }
        self.known().insert(id, self.fresh(size, 0));
        self.write_down(id)
    }

    /// The artifact is used. Nothing is written here.
    pub(super) fn extend(&self, id: ArtifactId) {
        let end = self.term_from_now();
        let stride = self.stride();
        if let Some(lease) = self.known().by_id.get_mut(&id)
            && lease.expires + stride <= end
        {
            lease.expires = end;
            lease.is_dirty = true;
        }
    }

    /// Until when an artifact is kept; `None` if there is none.
    pub(super) fn expires(&self, id: ArtifactId) -> Option<SystemTime> {
        self.known().by_id.get(&id).map(|lease| lease.expires)
    }

    fn write_down(&self, id: ArtifactId) -> Result<(), StoreError> {
        loop {
            let Some(lease) = self.known().by_id.get(&id).copied() else { return Ok(()) };
            match self.store.write(Ledger::Leases, &id.0, encode(&lease), lease.revision) {
                Ok(revision) => {
                    if let Some(known) = self.known().by_id.get_mut(&id) {
                        known.revision = revision;
                        // Unless it was put off once more meanwhile.
                        known.is_dirty = known.expires != lease.expires;
                    }
                    return Ok(());
                }
                // Another node wrote or erased it.
                Err(StoreError::Stale { .. }) if self.is_shared => {
                    let there = self.read(id)?;
                    let mut known = self.known();
                    let Some(own) = known.by_id.get_mut(&id) else { return Ok(()) };
                    own.revision = there.map_or(0, |there| there.revision);
                    let theirs = there.map(|there| there.expires);
                    if theirs >= Some(own.expires) {
                        own.expires = theirs.unwrap_or(own.expires);
                        own.is_dirty = false;
                        return Ok(());
                    }
                }
                Err(fault) => return Err(fault),
            }
        }
    }

    /// Writes down what was put off, and removes what has expired; ids of what is not
    /// there any more. Blocks on the store. Called by one thread at a time.
    pub(super) fn sweep(&self) -> Vec<ArtifactId> {
        /// Longer than from one sweep to the next.
        const WRITTEN_DOWN_WITHIN: Duration = Duration::from_secs(180);
        let mut removed = Vec::new();
        let mut late = self.clock.behind();
        if self.is_shared {
            late = late.checked_sub(WRITTEN_DOWN_WITHIN).unwrap_or(SystemTime::UNIX_EPOCH);
            match self.learn_all() {
                Ok(gone) => removed = gone,
                Err(fault) => tracing::warn!(%fault, "the leases of other nodes are not known"),
            }
        }
        let (dirty, expired) = self.known().part(late);
        for id in dirty {
            if let Err(fault) = self.write_down(id) {
                tracing::warn!(%id, %fault, "a lease could not be written down");
            }
        }
        for (id, lease) in expired {
            match self.remove(id, lease, late) {
                Ok(true) => removed.push(id),
                Ok(false) => {}
                Err(fault) => {
                    tracing::warn!(%id, %fault, "an expired artifact stays");
                    self.known().insert(id, lease);
                }
            }
        }
        removed
    }

    /// Removes an artifact that expired before `late`; whether that was so for all nodes.
    fn remove(&self, id: ArtifactId, lease: Lease, late: SystemTime) -> Result<bool, StoreError> {
        if !self.is_shared {
            // The artifact first: a lease without one is found and erased at the next start.
            self.store.remove(Shelf::Artifacts, &id.0)?;
            self.store.erase(Ledger::Leases, &id.0, lease.revision)?;
            return Ok(true);
        }
        if let Some(there) = self.read(id)? {
            if there.expires >= late {
                self.known().insert(id, there);
                return Ok(false);
            }
            // The lease first: whoever puts it off now finds that it is gone.
            match self.store.erase(Ledger::Leases, &id.0, there.revision) {
                Ok(()) => {}
                Err(StoreError::Stale { .. }) => {
                    self.learn(id)?;
                    return Ok(false);
                }
                Err(fault) => return Err(fault),
            }
        }
        self.store.remove(Shelf::Artifacts, &id.0)?;
        Ok(true)
    }
}

impl Known {
    /// Leases to write down, and those that expired before `now`: these are taken out at once, so
    /// that no step puts off the end of what is about to go.
    fn part(&mut self, now: SystemTime) -> (Vec<ArtifactId>, Vec<(ArtifactId, Lease)>) {
        let (mut dirty, mut expired) = (Vec::new(), Vec::new());
        for (id, lease) in &self.by_id {
            if lease.expires < now {
                expired.push((*id, *lease));
            } else if lease.is_dirty {
                dirty.push(*id);
            }
        }
        expired.iter().for_each(|(id, _)| self.remove(*id));
        (dirty, expired)
    }

    fn insert(&mut self, id: ArtifactId, lease: Lease) {
        self.remove(id);
        self.bytes += lease.size;
        self.by_id.insert(id, lease);
    }

    fn remove(&mut self, id: ArtifactId) {
        if let Some(removed) = self.by_id.remove(&id) {
            self.bytes -= removed.size;
        }
    }
}

/// End in seconds since 1970, then the artifact's size; 8 bytes each, little-endian.
fn encode(lease: &Lease) -> Bytes {
    let end = lease.expires.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs();
    [end.to_le_bytes(), lease.size.to_le_bytes()].concat().into()
}

/// A lease, read and written again; `None` if it cannot be read.
#[cfg(feature = "fuzzing")]
pub(crate) fn rewritten(bytes: &[u8]) -> Option<Bytes> {
    decode(bytes, 1).map(|lease| encode(&lease))
}

fn decode(bytes: &[u8], revision: Revision) -> Option<Lease> {
    let (end, size) = bytes.split_first_chunk::<8>()?;
    let end = Duration::from_secs(u64::from_le_bytes(*end));
    let size = u64::from_le_bytes(size.try_into().ok()?);
    let expires = SystemTime::UNIX_EPOCH.checked_add(end)?;
    Some(Lease { expires, size, revision, is_dirty: false })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        service::clock::tests::{HOUR, Hands},
        store::{DirectoryStore, MemoryStore, Syncing},
    };

    const TERM: Duration = Duration::from_secs(240);

    fn id(n: u8) -> ArtifactId {
        ArtifactId([n; 32])
    }

    fn opened(store: &Arc<dyn Store>, hands: &Hands) -> Leases {
        Leases::open(Arc::clone(store), hands.clock(), TERM, 100, false).unwrap()
    }

    fn put(store: &Arc<dyn Store>, n: u8, size: usize) {
        store.put_if_absent(Shelf::Artifacts, &id(n).0, vec![n; size].into()).unwrap();
    }

    #[test]
    fn lease_is_remembered_and_an_artifact_without_one_is_given_one() {
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(10_000));
        let hands = Hands::new();
        let leases = opened(&store, &hands);
        put(&store, 1, 60);
        leases.grant(id(1), 60).unwrap();
        // A crash before its lease was granted.
        put(&store, 2, 30);
        let again = opened(&store, &hands);
        assert_eq!(again.expires(id(1)), leases.expires(id(1)));
        assert!(again.expires(id(2)).is_some());
        assert!(again.admit(10).is_ok());
        let refused = again.admit(11).unwrap_err();
        assert_eq!((refused.code, refused.reason), (Code::ResourceExhausted, "ARTIFACTS_FULL"));
    }

    #[test]
    fn lease_expired_takes_its_artifact_with_it_unless_it_is_used() {
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(10_000));
        let hands = Hands::new();
        let leases = opened(&store, &hands);
        for n in [1, 2] {
            put(&store, n, 10);
            leases.grant(id(n), 10).unwrap();
        }
        let end = leases.expires(id(1)).unwrap();
        hands.pass(TERM / 2);
        assert_eq!(leases.sweep(), []);
        leases.extend(id(2));
        assert!(leases.expires(id(2)).unwrap() >= end + TERM / 2 - Duration::from_secs(1));
        hands.pass(TERM / 2 + Duration::from_secs(2));
        assert_eq!(leases.sweep(), [id(1)]);
        assert_eq!(store.list(Shelf::Artifacts, None, 9).unwrap(), [id(2).0]);
        assert_eq!(store.entries(Ledger::Leases).unwrap(), [id(2).0]);
        assert_eq!(leases.expires(id(1)), None);
        // What was put off is written down.
        assert_eq!(opened(&store, &hands).expires(id(2)), leases.expires(id(2)));
    }

    #[test]
    fn clock_jump_takes_no_artifact_before_its_term() {
        for jump in [-5000, -5, 5, 5000] {
            let store: Arc<dyn Store> = Arc::new(MemoryStore::new(10_000));
            let hands = Hands::new();
            let leases = opened(&store, &hands);
            put(&store, 1, 10);
            leases.grant(id(1), 10).unwrap();
            // Hours there, then something is made, then back.
            let right = hands.now().system;
            let hours = HOUR * i32::unsigned_abs(jump);
            hands.set(if jump < 0 { right - hours } else { right + hours });
            assert_eq!(leases.sweep(), [], "{jump} h");
            put(&store, 2, 10);
            leases.grant(id(2), 10).unwrap();
            leases.extend(id(1));
            hands.set(right);
            hands.pass(TERM - Duration::from_secs(1));
            assert_eq!(leases.sweep(), [], "{jump} h");
            // Later at most by the jump.
            hands.pass(hours + Duration::from_secs(3));
            assert_eq!(leases.sweep(), [id(1), id(2)], "{jump} h");
        }
    }

    #[test]
    fn lease_damaged_on_its_disk_is_granted_anew() {
        let folder = tempfile::tempdir().unwrap();
        let store = DirectoryStore::open(folder.path(), Syncing::LeftToTheSystem).unwrap();
        let store: Arc<dyn Store> = Arc::new(store);
        let hands = Hands::new();
        put(&store, 1, 10);
        assert_eq!(opened(&store, &hands).sweep(), []);
        let file = folder.path().join("v1/leases/01").join("01".repeat(32));
        std::fs::write(&file, b"rotten").unwrap();
        let leases = opened(&store, &hands);
        assert!(leases.expires(id(1)).is_some());
        assert_eq!(leases.sweep(), []);
        assert_eq!(opened(&store, &hands).expires(id(1)), leases.expires(id(1)));
        hands.pass(TERM + Duration::from_secs(2));
        assert_eq!(leases.sweep(), [id(1)]);
        assert!(!file.exists());
    }
}
