//! Records in memory: nothing to install, nothing kept after the process ends.

use std::{
    collections::BTreeMap,
    ops::Bound,
    sync::{Mutex, MutexGuard, PoisonError},
};

use bytes::Bytes;

use super::{Put, RecordId, RecordStore, Shelf, StoreError};

/// A bounded store in memory. When full it refuses new records rather than forgetting old ones:
/// an id that was handed out stays good for the life of the process.
#[derive(Debug)]
pub(crate) struct MemoryStore {
    bytes_max: usize,
    records: Mutex<Records>,
}

#[derive(Debug, Default)]
struct Records {
    bytes: usize,
    by_id: BTreeMap<(Shelf, RecordId), Bytes>,
}

impl MemoryStore {
    /// An empty store for at most `bytes_max` bytes of records.
    pub(crate) fn new(bytes_max: usize) -> Self {
        Self { bytes_max, records: Mutex::default() }
    }

    /// No code that holds the lock can leave the records half changed.
    fn records(&self) -> MutexGuard<'_, Records> {
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RecordStore for MemoryStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        let mut records = self.records();
        if let Some(existing) = records.by_id.get(&(shelf, *id)) {
            return Ok(Put::Existing(existing.clone()));
        }
        let total = records.bytes + bytes.len();
        if total > self.bytes_max {
            return Err(StoreError::Full(format!(
                "{total} bytes with this record, {} allowed",
                self.bytes_max
            )));
        }
        records.bytes = total;
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
    }
}
