//! What every back-end promises, as tests that take any of them.

use std::thread;

use super::*;

fn id(n: u8) -> RecordId {
    let mut id = [0xa5; 32];
    id[0] = n;
    id
}

/// A back-end keeps the contract on every shelf and in every ledger.
fn check(store: &dyn Store) {
    check_shelf(store, Shelf::Artifacts);
    // What stands on one shelf is not on the other.
    check_shelf(store, Shelf::Plans);
    let put = |shelf, text: &'static [u8]| store.put_if_absent(shelf, &id(200), text.into());
    assert_eq!(put(Shelf::Artifacts, b"artifact").unwrap(), Put::Created);
    assert_eq!(put(Shelf::Plans, b"plan").unwrap(), Put::Created);
    let get = |shelf| store.get(shelf, &id(200)).unwrap();
    assert_eq!(get(Shelf::Artifacts).as_deref(), Some(b"artifact".as_slice()));
    assert_eq!(get(Shelf::Plans).as_deref(), Some(b"plan".as_slice()));
    store.remove(Shelf::Plans, &id(200)).unwrap();
    assert_eq!(get(Shelf::Plans), None);
    assert_eq!(get(Shelf::Artifacts).as_deref(), Some(b"artifact".as_slice()));
    for ledger in [Ledger::Jobs, Ledger::Requests, Ledger::Leases] {
        check_ledger(store, ledger);
    }
    check_ledger_writers(store);
}

fn check_shelf(store: &dyn Store, shelf: Shelf) {
    assert_eq!(store.get(shelf, &id(1)).unwrap(), None);
    assert_eq!(store.list(shelf, None, 10).unwrap(), Vec::<RecordId>::new());

    let put = |n: u8, text: &'static [u8]| store.put_if_absent(shelf, &id(n), text.into()).unwrap();
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

    let list =
        |after: Option<u8>, limit: usize| store.list(shelf, after.map(id).as_ref(), limit).unwrap();
    assert_eq!(list(None, 10), [id(1), id(2), id(9)]);
    assert_eq!(list(None, 2), [id(1), id(2)]);
    assert_eq!(list(Some(2), 10), [id(9)]);
    assert_eq!(list(Some(5), 10), [id(9)]);
    assert_eq!(list(Some(9), 10), Vec::<RecordId>::new());

    // Removed, not there, and free for other bytes; to remove nothing is no fault.
    store.remove(shelf, &id(9)).unwrap();
    store.remove(shelf, &id(9)).unwrap();
    assert_eq!(list(None, 10), [id(1), id(2)]);
    assert_eq!(put(9, b"again"), Put::Created);

    // Many writers, one winner, everybody sees the winner's bytes.
    let seen: Vec<_> = thread::scope(|scope| {
        let write = |writer: u8| {
            let bytes = Bytes::from(vec![writer; 1000]);
            store.put_if_absent(shelf, &id(100), bytes).unwrap()
        };
        let writers: Vec<_> = (0..8).map(|writer| scope.spawn(move || write(writer))).collect();
        writers.into_iter().map(|writer| writer.join().unwrap()).collect()
    });
    let winner = get(100).unwrap();
    assert_eq!(seen.iter().filter(|put| **put == Put::Created).count(), 1);
    for put in seen {
        assert!(put == Put::Created || put == Put::Existing(winner.clone()));
    }
}

fn check_ledger(store: &dyn Store, ledger: Ledger) {
    let write = |n: u8, text: &'static [u8], seen| store.write(ledger, &id(n), text.into(), seen);
    let stale = |outcome: Result<(), StoreError>| {
        assert!(matches!(outcome, Err(StoreError::Stale { .. })), "{outcome:?}");
    };
    assert_eq!(store.read(ledger, &id(7)).unwrap(), None);
    assert_eq!(store.entries(ledger).unwrap(), Vec::<RecordId>::new());
    stale(write(7, b"changed before it was there", 1).map(|_| ()));
    let first = write(7, b"first", 0).unwrap();
    stale(write(7, b"there already", 0).map(|_| ()));
    let second = write(7, b"second", first).unwrap();
    assert!(second > first);
    stale(write(7, b"late", first).map(|_| ()));
    let there = Entry { bytes: b"second".as_slice().into(), revision: second };
    assert_eq!(store.read(ledger, &id(7)).unwrap(), Some(there));
    write(3, b"", 0).unwrap();
    assert_eq!(store.entries(ledger).unwrap(), [id(3), id(7)]);
    stale(store.erase(ledger, &id(7), first));
    store.erase(ledger, &id(7), second).unwrap();
    store.erase(ledger, &id(7), second).unwrap();
    assert_eq!(store.read(ledger, &id(7)).unwrap(), None);
    assert_eq!(store.entries(ledger).unwrap(), [id(3)]);
}

/// Writers that read, raise and write again, as often as they must, lose no change.
fn check_ledger_writers(store: &dyn Store) {
    const WRITERS: u8 = 4;
    const CHANGES: u8 = 5;
    let raise = || {
        let seen = store.read(Ledger::Jobs, &id(50)).unwrap();
        let (count, revision) = seen.map_or((0, 0), |entry| (entry.bytes[0], entry.revision));
        store.write(Ledger::Jobs, &id(50), Bytes::from(vec![count + 1]), revision)
    };
    thread::scope(|scope| {
        for _ in 0..WRITERS {
            scope.spawn(|| {
                for _ in 0..CHANGES {
                    while raise().is_err() {}
                }
            });
        }
    });
    let entry = store.read(Ledger::Jobs, &id(50)).unwrap().unwrap();
    assert_eq!(*entry.bytes, [WRITERS * CHANGES]);
}

#[test]
fn memory_store_conforms() {
    check(&MemoryStore::new(1 << 20));
}

#[test]
fn directory_store_conforms() {
    for syncing in [Syncing::EveryWrite, Syncing::LeftToTheSystem] {
        let folder = tempfile::tempdir().unwrap();
        check(&DirectoryStore::open(folder.path(), syncing).unwrap());
    }
}
