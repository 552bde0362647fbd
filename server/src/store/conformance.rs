//! What every back-end promises, as tests that take any of them.

use std::{
    env,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use super::*;

fn id(n: u8) -> RecordId {
    let mut id = [0xa5; 32];
    id[0] = n;
    id
}

/// A back-end keeps the contract on every shelf and in every ledger.
fn check(store: &dyn Store) {
    // What stands on one shelf is not on another.
    for shelf in Shelf::ALL {
        check_shelf(store, shelf);
    }
    let put = |shelf, text: &'static [u8]| store.put_if_absent(shelf, &id(200), text.into());
    assert_eq!(put(Shelf::Artifacts, b"artifact").unwrap(), Put::Created);
    assert_eq!(put(Shelf::Plans, b"plan").unwrap(), Put::Created);
    let get = |shelf| store.get(shelf, &id(200)).unwrap();
    assert_eq!(get(Shelf::Artifacts).as_deref(), Some(b"artifact".as_slice()));
    assert_eq!(get(Shelf::Plans).as_deref(), Some(b"plan".as_slice()));
    store.remove(Shelf::Plans, &id(200)).unwrap();
    assert_eq!(get(Shelf::Plans), None);
    assert_eq!(get(Shelf::Artifacts).as_deref(), Some(b"artifact".as_slice()));
    for ledger in Ledger::ALL {
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
    assert!(store.contains(shelf, &id(9)).unwrap() && !store.contains(shelf, &id(3)).unwrap());
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

/// Two machines, each with its own hold on one store.
fn check_shared(one: &dyn Shared, other: &dyn Shared) {
    check(one);
    one.reach().unwrap();
    check_tasks(one, other);
    check_followers(one, other);
    check_words(one, other);
}

fn task(group: u8, name: &str) -> Task {
    Task { group: id(group), name: name.to_owned(), bytes: Bytes::from(name.to_owned()) }
}

const AT_ONCE: Duration = Duration::from_millis(200);

fn check_tasks(one: &dyn Shared, other: &dyn Shared) {
    let lease = |store: &dyn Shared| store.lease(Duration::from_secs(20)).unwrap().unwrap();
    assert!(one.lease(AT_ONCE).unwrap().is_none());
    for name in ["first", "second", "first"] {
        one.queue(task(1, name)).unwrap();
    }
    let (first, second) = (lease(other), lease(one));
    assert_eq!((&*first.bytes, first.deliveries), (b"first".as_slice(), 1));
    assert_eq!((&*second.bytes, second.deliveries), (b"second".as_slice(), 1));
    assert!(one.lease(AT_ONCE).unwrap().is_none(), "the same task twice is one");
    // Handed back it comes again at once; done it does not.
    first.lease.hand_back().unwrap();
    let again = lease(one);
    assert_eq!((&*again.bytes, again.deliveries), (b"first".as_slice(), 2));
    again.lease.done().unwrap();
    // Renewed it stays with whoever has it; not renewed it goes to another.
    let until = Instant::now() + 2 * one.lease_term();
    while Instant::now() < until {
        second.lease.renew().unwrap();
        assert!(other.lease(one.lease_term() / 8).unwrap().is_none());
    }
    drop(second);
    let again = lease(other);
    assert_eq!((&*again.bytes, again.deliveries), (b"second".as_slice(), 2));
    again.lease.done().unwrap();
    // Withdrawn with its group, and only with its own.
    for (group, name) in [(2, "a"), (3, "b"), (2, "c")] {
        one.queue(task(group, name)).unwrap();
    }
    other.withdraw(&id(2)).unwrap();
    let left = lease(one);
    assert_eq!(&*left.bytes, b"b");
    left.lease.done().unwrap();
    assert!(other.lease(AT_ONCE).unwrap().is_none());
}

/// Waits until `there` says so.
fn eventually(there: impl Fn() -> bool) {
    let patience = Instant::now() + Duration::from_secs(20);
    while !there() {
        assert!(Instant::now() < patience, "it did not come about");
        thread::sleep(Duration::from_millis(2));
    }
}

fn check_followers(one: &dyn Shared, other: &dyn Shared) {
    type Seen = std::collections::BTreeMap<RecordId, Entry>;
    let ledger = Ledger::Requests;
    for left in one.entries(ledger).unwrap() {
        let revision = one.read(ledger, &left).unwrap().unwrap().revision;
        one.erase(ledger, &left, revision).unwrap();
    }
    let follow = |store: &dyn Shared| {
        let seen: Arc<Mutex<Option<Seen>>> = Arc::default();
        let told = Arc::clone(&seen);
        store.follow(
            ledger,
            Box::new(move |change| {
                let mut seen = told.lock().unwrap();
                match (change, &mut *seen) {
                    (Change::All(all), _) => *seen = Some(all.into_iter().collect()),
                    (Change::Written(id, entry), Some(seen)) => drop(seen.insert(id, entry)),
                    (Change::Erased(id), Some(seen)) => drop(seen.remove(&id)),
                    (change, None) => panic!("{change:?} before everything was told"),
                }
            }),
        );
        seen
    };
    let write = |n: u8, text: &'static str, seen| {
        let revision = one.write(ledger, &id(n), text.into(), seen).unwrap();
        (id(n), Entry { bytes: text.into(), revision })
    };
    let early = follow(other);
    eventually(|| early.lock().unwrap().as_ref().is_some_and(Seen::is_empty));
    let (first, second) = (write(1, "first", 0), write(2, "second", 0));
    let both = Seen::from([first.clone(), second.clone()]);
    eventually(|| early.lock().unwrap().as_ref() == Some(&both));
    let late = follow(other);
    eventually(|| late.lock().unwrap().as_ref() == Some(&both));
    let changed = write(1, "changed", first.1.revision);
    one.erase(ledger, &id(2), second.1.revision).unwrap();
    let now = Seen::from([changed]);
    for seen in [early, late] {
        eventually(|| seen.lock().unwrap().as_ref() == Some(&now));
    }
}

fn check_words(one: &dyn Shared, other: &dyn Shared) {
    let heard = Arc::new(AtomicU32::new(0));
    let count = Arc::clone(&heard);
    other.hear(Box::new(move |word| {
        assert_eq!(&*word, b"a word");
        count.fetch_add(1, Ordering::Relaxed);
    }));
    // Whoever does not listen yet misses it.
    eventually(|| {
        one.tell(b"a word".as_slice().into());
        heard.load(Ordering::Relaxed) > 0
    });
}

#[test]
fn memory_shared_conforms() {
    let store = MemoryShared::new(Duration::from_millis(400));
    check_shared(&store, &store.another());
}

/// Where `VBAR_TEST_NATS` names servers, as in `.ci/run`; skipped elsewhere.
#[test]
fn nats_store_conforms() {
    let Ok(servers) = env::var("VBAR_TEST_NATS") else {
        eprintln!("!!! skipped: VBAR_TEST_NATS names no NATS servers");
        return;
    };
    let nonce = std::process::id();
    let servers: Vec<_> = servers.split(',').map(str::to_owned).collect();
    let location = NatsLocation {
        name: format!("conformance{nonce}"),
        replicas: if servers.len() > 1 { 3 } else { 1 },
        lease_term: Duration::from_secs(2),
        patience: Duration::from_secs(10),
        tasks_max: 1000,
        ..NatsLocation::at(servers.clone())
    };
    let connect = || NatsStore::connect(location.clone()).unwrap();
    let (one, other) = (connect(), connect());
    check_shared(&one, &other);
    // Larger than a message may be, and nothing is left of whoever came second.
    let large = Bytes::from((0..5_000_000_u32).map(|n| (n % 251) as u8).collect::<Vec<_>>());
    assert_eq!(one.put_if_absent(Shelf::Artifacts, &id(77), large.clone()).unwrap(), Put::Created);
    assert_eq!(other.get(Shelf::Artifacts, &id(77)).unwrap().as_deref(), Some(&*large));
    let later = std::time::SystemTime::now() + Duration::from_secs(10);
    assert_eq!(one.tidy(later).unwrap(), 0);
    eprintln!("NATS at {} servers conforms", servers.len());
}
