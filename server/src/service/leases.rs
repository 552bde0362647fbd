//! Until when artifacts are kept, and how many bytes of them.
//!
//! The server cannot know who still holds an artifact's id. So every artifact has a lease, every
//! step that uses it puts the end of the lease off, and what nobody used for the whole term goes.
//! Steps only note it in memory; the sweep writes it down. A node that is killed in between loses
//! a minute of a lease, not the lease.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use bytes::Bytes;

use super::{Code, Error};
use crate::{
    store::{Ledger, RecordId, Revision, Shelf, Store, StoreError},
    wire::ArtifactId,
};

/// Leases of every artifact in the store.
#[derive(Debug)]
pub(super) struct Leases {
    store: Arc<dyn Store>,
    term: Duration,
    bytes_max: u64,
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
        term: Duration,
        bytes_max: u64,
    ) -> Result<Self, StoreError> {
        let leases = Self { store, term, bytes_max, known: Mutex::default() };
        let mut after: Option<RecordId> = None;
        loop {
            const PAGE: usize = 1000;
            let ids = leases.store.list(Shelf::Artifacts, after.as_ref(), PAGE)?;
            for id in &ids {
                leases.take_up(ArtifactId(*id))?;
            }
            after = ids.last().copied();
            if ids.len() < PAGE {
                break;
            }
        }
        leases.erase_orphans()?;
        Ok(leases)
    }

    fn take_up(&self, id: ArtifactId) -> Result<(), StoreError> {
        let written = match self.store.read(Ledger::Leases, &id.0) {
            Ok(entry) => entry.and_then(|entry| decode(&entry.bytes, entry.revision)),
            Err(StoreError::Damaged { .. }) => None,
            Err(fault) => return Err(fault),
        };
        let lease = match written {
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

    /// Entries of artifacts that are gone: a sweep was cut short.
    fn erase_orphans(&self) -> Result<(), StoreError> {
        for id in self.store.entries(Ledger::Leases)? {
            if self.expires(ArtifactId(id)).is_none()
                && let Ok(Some(entry)) = self.store.read(Ledger::Leases, &id)
            {
                self.store.erase(Ledger::Leases, &id, entry.revision)?;
            }
        }
        Ok(())
    }

    fn fresh(&self, size: usize, revision: Revision) -> Lease {
        let size = u64::try_from(size).unwrap_or(u64::MAX);
        Lease { expires: self.term_from_now(), size, revision, is_dirty: true }
    }

    /// Whole seconds: nobody needs more, and the same answer twice has the same bytes.
    fn term_from_now(&self) -> SystemTime {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
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
        let Some(lease) = self.known().by_id.get(&id).copied() else { return Ok(()) };
        let revision = self.store.write(Ledger::Leases, &id.0, encode(&lease), lease.revision)?;
        if let Some(known) = self.known().by_id.get_mut(&id) {
            known.revision = revision;
            // Unless it was put off once more meanwhile.
            known.is_dirty = known.expires != lease.expires;
        }
        Ok(())
    }

    /// Writes down what was put off, and removes what expired before `now`: its ids. Blocks on the
    /// store. Called by one thread at a time.
    pub(super) fn sweep(&self, now: SystemTime) -> Vec<ArtifactId> {
        let (dirty, expired) = self.known().part(now);
        for id in dirty {
            if let Err(fault) = self.write_down(id) {
                tracing::warn!(%id, %fault, "a lease could not be written down");
            }
        }
        let mut removed = Vec::new();
        for (id, lease) in expired {
            // The artifact first: a lease without one is found and erased at the next start.
            let gone = self
                .store
                .remove(Shelf::Artifacts, &id.0)
                .and_then(|()| self.store.erase(Ledger::Leases, &id.0, lease.revision));
            match gone {
                Ok(()) => removed.push(id),
                Err(fault) => {
                    tracing::warn!(%id, %fault, "an expired artifact stays");
                    self.known().insert(id, lease);
                }
            }
        }
        removed
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
    use crate::store::MemoryStore;

    const TERM: Duration = Duration::from_secs(240);

    fn id(n: u8) -> ArtifactId {
        ArtifactId([n; 32])
    }

    fn opened(store: &Arc<dyn Store>) -> Leases {
        Leases::open(Arc::clone(store), TERM, 100).unwrap()
    }

    fn put(store: &Arc<dyn Store>, n: u8, size: usize) {
        store.put_if_absent(Shelf::Artifacts, &id(n).0, vec![n; size].into()).unwrap();
    }

    #[test]
    fn lease_is_remembered_and_an_artifact_without_one_is_given_one() {
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(10_000));
        let leases = opened(&store);
        put(&store, 1, 60);
        leases.grant(id(1), 60).unwrap();
        // A crash before its lease was granted.
        put(&store, 2, 30);
        let again = opened(&store);
        assert_eq!(again.expires(id(1)), leases.expires(id(1)));
        assert!(again.expires(id(2)).is_some());
        assert!(again.admit(10).is_ok());
        let refused = again.admit(11).unwrap_err();
        assert_eq!((refused.code, refused.reason), (Code::ResourceExhausted, "ARTIFACTS_FULL"));
    }

    #[test]
    fn lease_expired_takes_its_artifact_with_it_unless_it_is_used() {
        let store: Arc<dyn Store> = Arc::new(MemoryStore::new(10_000));
        let leases = opened(&store);
        for n in [1, 2] {
            put(&store, n, 10);
            leases.grant(id(n), 10).unwrap();
        }
        let end = leases.expires(id(1)).unwrap();
        assert_eq!(leases.sweep(end), []);
        // As if a stride had passed since it was granted.
        let earlier = end - leases.stride() - Duration::from_secs(1);
        leases.known().by_id.get_mut(&id(2)).unwrap().expires = earlier;
        leases.extend(id(2));
        assert!(leases.expires(id(2)).unwrap() >= end);
        leases.known().by_id.get_mut(&id(1)).unwrap().expires = earlier;
        assert_eq!(leases.sweep(end - Duration::from_secs(1)), [id(1)]);
        assert_eq!(store.list(Shelf::Artifacts, None, 9).unwrap(), [id(2).0]);
        assert_eq!(store.entries(Ledger::Leases).unwrap(), [id(2).0]);
        assert_eq!(leases.expires(id(1)), None);
        // What was put off is written down.
        assert_eq!(opened(&store).expires(id(2)), leases.expires(id(2)));
    }
}
