//! Where artifacts and plans are kept: bytes under ids, created once, never changed.
//!
//! One contract, two back-ends, one conformance suite (below) that both pass. The store knows
//! nothing of what the bytes mean.

mod directory;
mod memory;

use std::{fmt::Debug, io};

use bytes::Bytes;

pub(crate) use directory::DirectoryStore;
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

/// Keeps records.
///
/// Contract: a record is created whole or not at all; once `put_if_absent` has answered, `get`
/// gives exactly those bytes or an error that says why not; nothing ever replaces them.
/// Calls may block on a disk: call them where that is allowed.
pub(crate) trait RecordStore: Debug + Send + Sync {
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
}

/// What came of [`RecordStore::put_if_absent`].
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

#[cfg(test)]
mod tests {
    use super::*;

    fn id(n: u8) -> RecordId {
        let mut id = [0xa5; 32];
        id[0] = n;
        id
    }

    /// Every back-end keeps the contract, on every shelf.
    fn check_conformance(store: &dyn RecordStore) {
        check_shelf(store, Shelf::Artifacts);
        // What stands on one shelf is not on the other.
        check_shelf(store, Shelf::Plans);
        let put = |shelf, text: &'static [u8]| store.put_if_absent(shelf, &id(200), text.into());
        assert_eq!(put(Shelf::Artifacts, b"artifact").unwrap(), Put::Created);
        assert_eq!(put(Shelf::Plans, b"plan").unwrap(), Put::Created);
        let get = |shelf| store.get(shelf, &id(200)).unwrap();
        assert_eq!(get(Shelf::Artifacts).as_deref(), Some(b"artifact".as_slice()));
        assert_eq!(get(Shelf::Plans).as_deref(), Some(b"plan".as_slice()));
    }

    fn check_shelf(store: &dyn RecordStore, shelf: Shelf) {
        assert_eq!(store.get(shelf, &id(1)).unwrap(), None);
        assert_eq!(store.list(shelf, None, 10).unwrap(), Vec::<RecordId>::new());

        let put =
            |n: u8, text: &'static [u8]| store.put_if_absent(shelf, &id(n), text.into()).unwrap();
        assert_eq!(put(2, b"two"), Put::Created);
        assert_eq!(put(9, b""), Put::Created);
        assert_eq!(put(1, b"one"), Put::Created);
        // The first bytes stay, whatever comes later.
        assert_eq!(put(2, b"two"), Put::Existing(b"two".as_slice().into()));
        assert_eq!(put(2, b"other"), Put::Existing(b"two".as_slice().into()));

        let get = |n: u8| store.get(shelf, &id(n)).unwrap();
        assert_eq!(get(1).as_deref(), Some(b"one".as_slice()));
        assert_eq!(get(2).as_deref(), Some(b"two".as_slice()));
        assert_eq!(get(9).as_deref(), Some(b"".as_slice()));
        assert_eq!(get(3), None);

        let list = |after: Option<u8>, limit: usize| {
            store.list(shelf, after.map(id).as_ref(), limit).unwrap()
        };
        assert_eq!(list(None, 10), [id(1), id(2), id(9)]);
        assert_eq!(list(None, 2), [id(1), id(2)]);
        assert_eq!(list(Some(2), 10), [id(9)]);
        assert_eq!(list(Some(5), 10), [id(9)]);
        assert_eq!(list(Some(9), 10), Vec::<RecordId>::new());

        // Many writers, one winner, everybody sees the winner's bytes.
        let seen: Vec<_> = std::thread::scope(|scope| {
            let writers: Vec<_> = (0..8u8)
                .map(|writer| {
                    scope.spawn(move || {
                        let bytes = Bytes::from(vec![writer; 1000]);
                        store.put_if_absent(shelf, &id(100), bytes).unwrap()
                    })
                })
                .collect();
            writers.into_iter().map(|writer| writer.join().unwrap()).collect()
        });
        let winner = get(100).unwrap();
        assert_eq!(seen.iter().filter(|put| **put == Put::Created).count(), 1);
        for put in seen {
            assert!(put == Put::Created || put == Put::Existing(winner.clone()));
        }
    }

    #[test]
    fn memory_store_conforms() {
        check_conformance(&MemoryStore::new(1 << 20));
    }

    #[test]
    fn directory_store_conforms() {
        let folder = tempfile::tempdir().unwrap();
        check_conformance(&DirectoryStore::open(folder.path()).unwrap());
    }
}
