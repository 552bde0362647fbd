//! Records in memory: nothing to install, nothing kept after the process ends.

use std::{
    collections::BTreeMap,
    ops::Bound,
    sync::{Mutex, MutexGuard, PoisonError},
};

use bytes::Bytes;

use super::{Entry, Ledger, Put, RecordId, Revision, Shelf, Store, StoreError, hex};

/// A bounded store in memory. When full it refuses new records rather than forgetting old ones:
/// an id that was handed out stays good for as long as its record is to be kept.
#[derive(Debug)]
pub(crate) struct MemoryStore {
    bytes_max: usize,
    records: Mutex<Records>,
}

#[derive(Debug, Default)]
struct Records {
    bytes: usize,
    by_id: BTreeMap<(Shelf, RecordId), Bytes>,
    entries: BTreeMap<(Ledger, RecordId), Entry>,
}

impl MemoryStore {
    /// An empty store for at most `bytes_max` bytes of records and entries.
    pub(crate) fn new(bytes_max: usize) -> Self {
        Self { bytes_max, records: Mutex::default() }
    }

    /// No code that holds the lock can leave the records half changed.
    fn records(&self) -> MutexGuard<'_, Records> {
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Records {
    /// Makes room for `added` bytes in place of `removed` ones.
    fn account(&mut self, added: usize, removed: usize, most: usize) -> Result<(), StoreError> {
        let total = self.bytes - removed + added;
        if total > most && added > removed {
            return Err(StoreError::Full(format!(
                "{total} bytes with this record, {most} allowed"
            )));
        }
        self.bytes = total;
        Ok(())
    }

    /// Bytes of the entry, if `seen` is its latest revision.
    fn seen(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<usize, StoreError> {
        let entry = self.entries.get(&(ledger, *id));
        let found = entry.map_or(0, |entry| entry.revision);
        if found != seen {
            return Err(StoreError::Stale { id: hex(id), seen, found });
        }
        Ok(entry.map_or(0, |entry| entry.bytes.len()))
    }
}

impl Store for MemoryStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        let mut records = self.records();
        if let Some(existing) = records.by_id.get(&(shelf, *id)) {
            return Ok(Put::Existing(existing.clone()));
        }
        records.account(bytes.len(), 0, self.bytes_max)?;
        records.by_id.insert((shelf, *id), bytes);
        Ok(Put::Created)
    }

    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        Ok(self.records().by_id.get(&(shelf, *id)).cloned())
    }

    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        let from = match after {
            None => Bound::Included((shelf, [0; 32])),
            Some(id) => Bound::Excluded((shelf, *id)),
        };
        let to = Bound::Included((shelf, [0xff; 32]));
        let records = self.records();
        Ok(records.by_id.range((from, to)).take(limit).map(|((_, id), _)| *id).collect())
    }

    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError> {
        let mut records = self.records();
        if let Some(removed) = records.by_id.remove(&(shelf, *id)) {
            records.bytes -= removed.len();
        }
        Ok(())
    }

    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError> {
        Ok(self.records().entries.get(&(ledger, *id)).cloned())
    }

    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError> {
        let mut records = self.records();
        let before = records.seen(ledger, id, seen)?;
        records.account(bytes.len(), before, self.bytes_max)?;
        let revision = seen + 1;
        records.entries.insert((ledger, *id), Entry { bytes, revision });
        Ok(revision)
    }

    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError> {
        let mut records = self.records();
        if records.entries.contains_key(&(ledger, *id)) {
            records.bytes -= records.seen(ledger, id, seen)?;
            records.entries.remove(&(ledger, *id));
        }
        Ok(())
    }

    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError> {
        let (from, to) = ((ledger, [0; 32]), (ledger, [0xff; 32]));
        Ok(self.records().entries.range(from..=to).map(|((_, id), _)| *id).collect())
    }

    fn reach(&self) -> Result<(), StoreError> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_store_full_refuses_and_keeps_what_it_has() {
        let store = MemoryStore::new(10);
        let put =
            |n: u8, size| store.put_if_absent(Shelf::Artifacts, &[n; 32], vec![n; size].into());
        assert_eq!(put(1, 8).unwrap(), Put::Created);
        assert!(matches!(put(2, 3), Err(StoreError::Full(_))));
        assert_eq!(put(3, 2).unwrap(), Put::Created);
        assert!(matches!(put(1, 8).unwrap(), Put::Existing(_)));
        let write = |size: usize, seen| {
            store.write(Ledger::Jobs, &[9; 32], Bytes::from(vec![0; size]), seen)
        };
        assert!(matches!(write(1, 0), Err(StoreError::Full(_))));
        // What is removed makes room.
        store.remove(Shelf::Artifacts, &[3; 32]).unwrap();
        let first = write(2, 0).unwrap();
        let second = write(1, first).unwrap();
        assert!(matches!(write(3, second), Err(StoreError::Full(_))));
    }
}
