//! The store on a disk that fails: sequences of calls that a seed decides, held against what must,
//! may and must not be there after each of them.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::PathBuf,
};

use fastrand::Rng;

use super::{
    faulty_disk::{Faults, FaultyDisk},
    *,
};
use crate::seeds::each_seed;

/// Calls in a sequence.
const CALLS: usize = 60;

/// Where something is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Key {
    Record(Shelf, RecordId),
    Entry(Ledger, RecordId),
}

/// What is found there.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Found {
    Nothing,
    Bytes(Bytes),
    Damaged,
}

/// What may be found there: one thing once a call was acknowledged, several after one that was not.
#[derive(Debug)]
struct Expected {
    may_be: BTreeSet<Found>,
    /// Everything that was ever to be kept there, and nothing.
    ever: BTreeSet<Found>,
    /// Of an entry, as its only writer knows it.
    seen: Revision,
}

struct Sequence {
    rng: Rng,
    folder: tempfile::TempDir,
    syncing: Syncing,
    disk: FaultyDisk,
    store: Option<DirectoryStore>,
    expected: BTreeMap<Key, Expected>,
}

fn keys() -> impl Iterator<Item = Key> {
    // Two of the ids share a folder.
    let ids =
        [[0x11; 32], [0x22; 32], [[0x11; 31].as_slice(), &[0x12]].concat().try_into().unwrap()];
    ids.into_iter().flat_map(|id| {
        [
            Key::Record(Shelf::Artifacts, id),
            Key::Record(Shelf::Plans, id),
            Key::Entry(Ledger::Jobs, id),
            Key::Entry(Ledger::Leases, id),
        ]
    })
}

impl Expected {
    fn nothing() -> Self {
        let nothing = BTreeSet::from([Found::Nothing]);
        Self { may_be: nothing.clone(), ever: nothing, seen: 0 }
    }

    fn is(&mut self, found: Found) {
        self.may_be = [found].into();
    }
}

impl Sequence {
    fn new(seed: u64) -> Self {
        let mut rng = Rng::with_seed(seed);
        let syncing = if rng.u8(..4) > 0 { Syncing::EveryWrite } else { Syncing::LeftToTheSystem };
        let disk = FaultyDisk::new(rng.u64(..));
        Self {
            rng,
            folder: tempfile::tempdir().unwrap(),
            syncing,
            disk,
            store: None,
            expected: keys().map(|key| (key, Expected::nothing())).collect(),
        }
    }

    fn run(mut self) {
        // Its very start may fail too.
        self.set_faults();
        self.open();
        for _ in 0..CALLS {
            self.set_faults();
            let key = *self.choice();
            self.change(key);
            self.disk_comes_back();
            match self.rng.u8(..12) {
                0 => self.rot(),
                1 => self.restart(),
                _ => {}
            }
            self.check_all();
        }
        self.check_it_goes_on();
    }

    fn store(&self) -> &DirectoryStore {
        self.store.as_ref().expect("it is open")
    }

    fn choice(&mut self) -> &Key {
        let nth = self.rng.usize(..self.expected.len());
        self.expected.keys().nth(nth).expect("it is one of them")
    }

    fn set_faults(&mut self) {
        let calm = Faults::default();
        let faults = match self.rng.u8(..8) {
            0 | 1 => calm,
            2 | 3 => Faults { is_full: true, ..calm },
            4 | 5 => Faults { one_in: self.rng.u32(1..8), ..calm },
            _ => Faults { killed_after: Some(self.rng.u32(1..14)), ..calm },
        };
        self.disk.set(faults);
    }

    /// Opens the store, as often as it takes; what goes wrong meanwhile goes wrong once.
    fn open(&mut self) {
        let root = self.folder.path().join("store");
        for _ in 0..2 {
            let disk = Arc::new(self.disk.clone());
            match DirectoryStore::open_on(disk, &root, self.syncing) {
                Ok(store) => {
                    self.store = Some(store);
                    return;
                }
                Err(_) => self.disk_comes_back(),
            }
        }
        panic!("it does not open on a disk that works");
    }

    /// Whatever was wrong with the disk is over. A process that was killed is started again.
    fn disk_comes_back(&mut self) {
        let was_killed = self.disk.is_dead();
        self.disk.set(Faults::default());
        if was_killed && self.store.is_some() {
            self.restart();
        }
    }

    fn restart(&mut self) {
        self.store = None;
        if self.rng.bool() {
            self.disk.lose_power();
            self.forget_what_power_took();
        }
        if self.rng.u8(..4) == 0 {
            self.set_faults();
        }
        self.open();
        self.disk.set(Faults::default());
        let left = fs::read_dir(self.folder.path().join("store/v1/incoming")).unwrap();
        // Removing them can fail only where the start fails too.
        assert_eq!(left.count(), 0, "files stay in incoming");
        let keys: Vec<_> = self.expected.keys().copied().collect();
        for key in keys {
            if let Key::Entry(ledger, id) = key {
                let revision = match self.store().read(ledger, &id) {
                    Ok(entry) => entry.map_or(0, |entry| entry.revision),
                    Err(_) => 0,
                };
                self.expect(key).seen = revision;
            }
        }
    }

    /// With every write synced, what was acknowledged stays; else any earlier state can be back, and
    /// what was torn is seen.
    fn forget_what_power_took(&mut self) {
        for expected in self.expected.values_mut() {
            let is_damaged = expected.may_be.contains(&Found::Damaged);
            if self.syncing == Syncing::LeftToTheSystem || is_damaged {
                expected.may_be.extend(expected.ever.iter().cloned());
                expected.may_be.insert(Found::Damaged);
            }
        }
    }

    fn expect(&mut self, key: Key) -> &mut Expected {
        self.expected.get_mut(&key).expect("every key is there")
    }

    /// Puts, writes, removes or erases something, and notes what may be there now.
    fn change(&mut self, key: Key) {
        let wanted = match self.rng.u8(..4) {
            0 => Found::Nothing,
            _ => Found::Bytes((0..self.rng.usize(..200)).map(|_| self.rng.u8(..)).collect()),
        };
        self.expect(key).ever.insert(wanted.clone());
        let done = self.ask(key, &wanted);
        let expected = self.expect(key);
        match done {
            Ok(found) => expected.is(found),
            // Nothing was to be found out about it.
            Err(StoreError::Damaged { .. }) => {
                assert!(
                    expected.may_be.contains(&Found::Damaged),
                    "{key:?}: {:?}",
                    expected.may_be
                );
            }
            Err(StoreError::Full(_) | StoreError::Io { .. }) => {
                // Nothing replaces a record.
                let is_there = matches!(key, Key::Record(..))
                    && wanted != Found::Nothing
                    && !expected.may_be.contains(&Found::Nothing);
                if !is_there {
                    expected.may_be.insert(wanted);
                }
            }
            Err(fault) => panic!("{key:?} is refused to its only writer: {fault}"),
        }
    }

    /// What is there when the call was acknowledged.
    fn ask(&mut self, key: Key, wanted: &Found) -> Result<Found, StoreError> {
        let seen = self.expect(key).seen;
        let store = self.store();
        match (key, wanted) {
            (Key::Record(shelf, id), Found::Bytes(bytes)) => {
                let there = match store.put_if_absent(shelf, &id, bytes.clone())? {
                    Put::Created => Found::Bytes(bytes.clone()),
                    Put::Existing(bytes) => Found::Bytes(bytes),
                };
                let expected = self.expect(key);
                let may = expected.may_be.contains(&there) || there == *wanted;
                assert!(may, "{key:?}: {there:?} was there, not one of {:?}", expected.may_be);
                Ok(there)
            }
            (Key::Entry(ledger, id), Found::Bytes(bytes)) => {
                let revision = store.write(ledger, &id, bytes.clone(), seen)?;
                assert!(revision > seen, "{revision} after {seen}");
                self.expect(key).seen = revision;
                Ok(wanted.clone())
            }
            (Key::Record(shelf, id), _) => {
                store.remove(shelf, &id)?;
                Ok(Found::Nothing)
            }
            (Key::Entry(ledger, id), _) => {
                store.erase(ledger, &id, seen)?;
                self.expect(key).seen = 0;
                Ok(Found::Nothing)
            }
        }
    }

    fn find(&self, key: Key) -> Found {
        let found = match key {
            Key::Record(shelf, id) => self.store().get(shelf, &id),
            Key::Entry(ledger, id) => {
                self.store().read(ledger, &id).map(|entry| entry.map(|entry| entry.bytes))
            }
        };
        match found {
            Ok(None) => Found::Nothing,
            Ok(Some(bytes)) => Found::Bytes(bytes),
            Err(StoreError::Damaged { .. }) => Found::Damaged,
            Err(fault) => panic!("{key:?} cannot be read from a disk that works: {fault}"),
        }
    }

    fn file(&self, key: Key) -> PathBuf {
        match key {
            Key::Record(shelf, id) => path(&self.store().shelf(shelf), &id),
            Key::Entry(ledger, id) => path(&self.store().ledger(ledger), &id),
        }
    }

    /// A bit flips, or a file loses its end.
    fn rot(&mut self) {
        let key = *self.choice();
        let file = self.file(key);
        let Ok(mut bytes) = fs::read(&file) else { return };
        if self.rng.bool() {
            bytes.truncate(self.rng.usize(..bytes.len()));
        } else {
            let bit = self.rng.usize(..bytes.len() * 8);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        fs::write(file, bytes).unwrap();
        self.expect(key).is(Found::Damaged);
    }

    fn check_all(&self) {
        let (mut records, mut entries) = (BTreeMap::new(), BTreeMap::new());
        for (key, expected) in &self.expected {
            let found = self.find(*key);
            assert!(
                expected.may_be.contains(&found),
                "{key:?}: {found:?} is there, not one of {:?}",
                expected.may_be
            );
            if found != Found::Nothing {
                match key {
                    Key::Record(shelf, id) => records.entry(*shelf).or_insert(vec![]).push(*id),
                    Key::Entry(ledger, id) => entries.entry(*ledger).or_insert(vec![]).push(*id),
                }
            }
        }
        let sorted = |ids: Option<&Vec<RecordId>>| {
            let mut ids = ids.cloned().unwrap_or_default();
            ids.sort_unstable();
            ids
        };
        for shelf in Shelf::ALL {
            let listed = self.store().list(shelf, None, usize::MAX).unwrap();
            assert_eq!(listed, sorted(records.get(&shelf)), "{shelf:?}");
        }
        for ledger in Ledger::ALL {
            let listed = self.store().entries(ledger).unwrap();
            assert_eq!(listed, sorted(entries.get(&ledger)), "{ledger:?}");
        }
    }

    /// On a disk that works every key takes what it is given, once what is damaged is removed.
    fn check_it_goes_on(&mut self) {
        self.store().reach().unwrap();
        let keys: Vec<_> = self.expected.keys().copied().collect();
        for key in keys {
            for wanted in [Found::Nothing, Found::Bytes(Bytes::from_static(b"again"))] {
                let found = self.ask(key, &wanted).unwrap();
                assert_eq!(found, wanted);
                self.expect(key).is(found);
            }
        }
        self.check_all();
        self.restart();
        if self.syncing == Syncing::EveryWrite {
            self.check_all();
        }
    }
}

#[test]
fn disk_faults_lose_nothing_that_was_acknowledged_and_change_nothing_else() {
    each_seed("-p vbar-server --lib disk_faults_lose", 100, |seed| Sequence::new(seed).run());
}

/// Half an artifact on a full disk would keep others from the room it takes.
#[test]
fn directory_store_full_keeps_no_part_of_what_it_refuses_and_says_when_it_has_room() {
    let folder = tempfile::tempdir().unwrap();
    let disk = FaultyDisk::new(1);
    let store = DirectoryStore::open_on(Arc::new(disk.clone()), folder.path(), Syncing::EveryWrite)
        .unwrap();
    let put = |n: u8| store.put_if_absent(Shelf::Plans, &[n; 32], vec![n; 10_000].into());
    put(1).unwrap();
    disk.set(Faults { is_full: true, ..Faults::default() });
    // It tells what it noticed.
    store.reach().unwrap();
    for n in 2..9 {
        assert!(matches!(put(n), Err(StoreError::Full(_))));
    }
    assert!(matches!(store.reach(), Err(StoreError::Full(_))));
    assert_eq!(store.sorted_names(&store.incoming).unwrap(), [MARK]);
    assert_eq!(put(1).unwrap(), Put::Existing(vec![1; 10_000].into()));
    // A node that is started now still finds what it has.
    drop(store);
    let store = DirectoryStore::open_on(Arc::new(disk.clone()), folder.path(), Syncing::EveryWrite)
        .unwrap();
    assert_eq!(store.list(Shelf::Plans, None, 9).unwrap(), [[1; 32]]);
    assert!(matches!(
        store.put_if_absent(Shelf::Plans, &[2; 32], "two".into()),
        Err(StoreError::Full(_))
    ));
    disk.set(Faults::default());
    store.reach().unwrap();
    assert_eq!(store.put_if_absent(Shelf::Plans, &[2; 32], "two".into()).unwrap(), Put::Created);
}

/// What is found after a fault has been built upon by then: it must not go with the power.
fn check_found_stays(
    fault: impl Fn(u32) -> Faults,
    then: impl Fn(DirectoryStore) -> DirectoryStore,
) {
    const ID: RecordId = [7; 32];
    let mut found = 0;
    for seed in 1..40 {
        let folder = tempfile::tempdir().unwrap();
        let disk = FaultyDisk::new(seed.into());
        let open = |disk: &FaultyDisk| {
            let disk = Arc::new(disk.clone());
            DirectoryStore::open_on(disk, folder.path(), Syncing::EveryWrite).unwrap()
        };
        let store = open(&disk);
        disk.set(fault(seed));
        let put = store.put_if_absent(Shelf::Plans, &ID, "left".into());
        disk.set(Faults::default());
        let store = then(store);
        let is_there = store.get(Shelf::Plans, &ID).unwrap().is_some();
        drop(store);
        disk.lose_power();
        if is_there {
            found += u32::from(put.is_err());
            assert!(open(&disk).contains(Shelf::Plans, &ID).unwrap(), "seed {seed}");
        }
    }
    assert!(found > 0, "no call failed after it had been done");
}

#[test]
fn directory_store_keeps_what_a_killed_process_left_once_it_was_found() {
    check_found_stays(
        |calls| Faults { killed_after: Some(calls), ..Faults::default() },
        |store| {
            let (root, disk) = (store.records.parent().unwrap().to_owned(), store.disk.clone());
            drop(store);
            DirectoryStore::open_on(disk, &root, Syncing::EveryWrite).unwrap()
        },
    );
}

#[test]
fn directory_store_keeps_what_a_failed_call_left_once_another_was_acknowledged() {
    check_found_stays(
        |_| Faults { one_in: 3, ..Faults::default() },
        |store| {
            store.write(Ledger::Jobs, &[8; 32], "built upon it".into(), 0).unwrap();
            store
        },
    );
}
