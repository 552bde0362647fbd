//! Records and entries as files in one directory.
//!
//! ```text
//! <root>/format                 "vbar artifacts 1\n"
//! <root>/lock                   held by the process that uses the directory; its id is in it
//! <root>/v1/<xx>/<id>           one artifact; <id> in hexadecimal, <xx> its first two digits
//! <root>/v1/plans/<xx>/<id>     one plan
//! <root>/v1/jobs/<xx>/<id>      one precompute; <id> is that of the artifact it makes
//! <root>/v1/requests/<xx>/<id>  one request id; <id> is its sha256
//! <root>/v1/leases/<xx>/<id>    until when an artifact is kept
//! <root>/v1/incoming/…          files being written; `in-use` from the first one to a good end
//! ```
//!
//! A file is the sha256 of what follows (32 bytes), then what follows: a record's bytes; for an
//! entry its revision (8 bytes, little-endian) and its bytes. It is written in `incoming` and
//! synced; a record is linked to its name (which fails if the name exists), an entry renamed over
//! its predecessor; then the folder is synced. A crash leaves at worst a file in `incoming`, which
//! the next start removes. Nothing is acknowledged before its name is synced. What a call that failed
//! left without that is synced with the next write, and what a killed process left by the next start,
//! which finds something in `incoming`: either is read meanwhile, and built upon.
//!
//! With [`Syncing::EveryWrite`] nothing that was acknowledged is lost when the power fails, as far
//! as the disk keeps its own promises. Without it a killed process still loses nothing, because
//! the system has the bytes, but a power failure can take what was written in the last half
//! minute; what it tore is noticed by its digest.

mod disk;
#[cfg(test)]
mod faults;
#[cfg(test)]
mod faulty_disk;

use std::{
    collections::{BTreeSet, HashMap},
    fs::{self, File, TryLockError},
    io::{self, ErrorKind, Write as _},
    path::{Path, PathBuf},
    process,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::{Entry, Ledger, Put, RecordId, Revision, Shelf, Store, StoreError, hex, unhex};
use disk::{Disk, LocalDisk};
#[cfg(test)]
pub(crate) use faulty_disk::{Faults, FaultyDisk};

const FORMAT: &str = "vbar artifacts 1\n";
const DIGEST_LENGTH: usize = 32;
const REVISION_LENGTH: usize = size_of::<Revision>();
/// Name of a file in `incoming`.
const MARK: &str = "in-use";
/// A node that ends lets go of its directory within this time.
const LOCK_WAIT: Duration = Duration::from_secs(2);

/// When what is written reaches the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Syncing {
    /// Before a write is acknowledged.
    EveryWrite,
    /// When the system gets round to it.
    LeftToTheSystem,
}

/// A store in a directory, which no other process uses meanwhile.
#[derive(Debug)]
pub(crate) struct DirectoryStore {
    disk: Arc<dyn Disk>,
    records: PathBuf,
    incoming: PathBuf,
    syncing: Syncing,
    /// Makes the names in `incoming` different.
    written: AtomicU64,
    /// The last write failed.
    is_failing: AtomicBool,
    /// `in-use` stands in `incoming`.
    is_marked: AtomicBool,
    /// Folders with names that change, until they are synced.
    unsynced: Mutex<BTreeSet<PathBuf>>,
    /// Held while an entry is compared and replaced.
    entries: Mutex<Unsettled>,
    /// The lock is given back when this is closed, also by a process that is killed.
    _lock: File,
}

/// Entries that may have been changed although their writers were told otherwise, with the revision
/// that these saw last: it is as good as the one that is there.
type Unsettled = HashMap<(Ledger, RecordId), Revision>;

impl DirectoryStore {
    /// Opens the store at `root`, which is made if it does not exist.
    ///
    /// # Errors
    /// If the directory cannot be used, is used by another process, or has a layout of another
    /// version.
    pub(crate) fn open(root: &Path, syncing: Syncing) -> Result<Self, StoreError> {
        Self::open_on(Arc::new(LocalDisk), root, syncing)
    }

    /// The same on any disk.
    pub(crate) fn open_on(
        disk: Arc<dyn Disk>,
        root: &Path,
        syncing: Syncing,
    ) -> Result<Self, StoreError> {
        let records = root.join("v1");
        create_folders(&*disk, root).map_err(io_error("creating", root))?;
        let lock = locked(&*disk, root)?;
        check_format(&*disk, &root.join("format"))?;
        let store = Self {
            disk,
            incoming: records.join("incoming"),
            records,
            syncing,
            written: AtomicU64::new(0),
            is_failing: AtomicBool::new(false),
            is_marked: AtomicBool::new(false),
            unsynced: Mutex::default(),
            entries: Mutex::default(),
            _lock: lock,
        };
        let shelves = Shelf::ALL.map(|shelf| store.shelf(shelf)).into_iter();
        let ledgers = Ledger::ALL.map(|ledger| store.ledger(ledger));
        let roots: Vec<_> = shelves.chain(ledgers).collect();
        for folder in roots.iter().chain([&store.incoming]) {
            create_folders(&*store.disk, folder).map_err(io_error("creating", folder))?;
        }
        store.sync_folder(&store.records)?;
        store.sync_folder(root)?;
        store.sync_outside(root)?;
        // What a killed process left: nobody else writes here.
        let left = store.sorted_names(&store.incoming)?;
        if !left.is_empty() {
            roots.iter().try_for_each(|root| store.sync_all_names(root))?;
        }
        for name in left {
            let path = store.incoming.join(name);
            store.disk.remove(&path).map_err(io_error("removing", &path))?;
        }
        Ok(store)
    }

    /// The folder of a shelf. Artifacts stood here alone once, which is why they have no folder of
    /// their own; names of other shelves are longer than two letters.
    fn shelf(&self, shelf: Shelf) -> PathBuf {
        match shelf {
            Shelf::Artifacts => self.records.clone(),
            other => self.records.join(other.name()),
        }
    }

    fn ledger(&self, ledger: Ledger) -> PathBuf {
        self.records.join(ledger.name())
    }

    /// Writes a file nobody else knows yet, to be given its name by `publish`, in `root`.
    fn create(
        &self,
        root: &Path,
        id: &RecordId,
        parts: &[&[u8]],
        publish: impl FnOnce(&dyn Disk, &Path, &Path) -> io::Result<()>,
    ) -> Result<io::Result<()>, StoreError> {
        let path = path(root, id);
        let folder = folder(&path);
        self.changes(&[folder, root]);
        let create = || {
            self.mark()?;
            create_folders(&*self.disk, folder).map_err(io_error("creating", folder))?;
            let incoming = self.write_incoming(parts)?;
            let published = publish(&*self.disk, &incoming, &path);
            self.remove_incoming(&incoming);
            if published.is_ok() {
                self.sync_names(root, id)?;
            }
            Ok(published)
        };
        let created = create();
        let is_failing = match &created {
            Ok(Err(fault)) => fault.kind() != ErrorKind::AlreadyExists,
            created => created.is_err(),
        };
        self.is_failing.store(is_failing, Ordering::Relaxed);
        created
    }

    fn write_incoming(&self, parts: &[&[u8]]) -> Result<PathBuf, StoreError> {
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        let incoming = self.incoming.join(format!("{}-{number}", process::id()));
        let mut digest = Sha256::new();
        parts.iter().for_each(|part| digest.update(part));
        let write = || {
            let mut file = self.disk.create(&incoming)?;
            file.write_all(&digest.finalize())?;
            parts.iter().try_for_each(|part| file.write_all(part))?;
            match self.syncing {
                Syncing::EveryWrite => file.sync(),
                Syncing::LeftToTheSystem => Ok(()),
            }
        };
        match write() {
            Ok(()) => Ok(incoming),
            Err(fault) => {
                // What there is of it takes room that others need.
                self.remove_incoming(&incoming);
                Err(io_error("writing", &incoming)(fault))
            }
        }
    }

    /// The next start removes what stays.
    fn remove_incoming(&self, incoming: &Path) {
        match self.disk.remove(incoming) {
            // It was renamed, or never made.
            Err(fault) if fault.kind() == ErrorKind::NotFound => {}
            Err(fault) => tracing::warn!(%fault, path = %incoming.display(), "a file stays"),
            Ok(()) => {}
        }
    }

    /// Syncs the names that lead to what stands under `id`.
    fn sync_names(&self, root: &Path, id: &RecordId) -> Result<(), StoreError> {
        self.sync_folder(folder(&path(root, id)))?;
        self.sync_folder(root)
    }

    /// Syncs every name in the folder of a shelf or ledger.
    fn sync_all_names(&self, root: &Path) -> Result<(), StoreError> {
        if self.syncing == Syncing::LeftToTheSystem {
            return Ok(());
        }
        for name in self.sorted_names(root)?.iter().filter(|name| name.len() == 2) {
            self.sync_folder(&root.join(name))?;
        }
        self.sync_folder(root)
    }

    /// Syncs the name of the root, which may stand where this process may not look.
    fn sync_outside(&self, root: &Path) -> Result<(), StoreError> {
        let outside = root.parent().filter(|parent| !parent.as_os_str().is_empty());
        let outside = outside.unwrap_or(Path::new("."));
        match self.syncing {
            Syncing::LeftToTheSystem => Ok(()),
            Syncing::EveryWrite => match self.disk.sync_folder(outside) {
                Err(fault) if fault.kind() == ErrorKind::PermissionDenied => Ok(()),
                synced => synced.map_err(io_error("syncing", outside)),
            },
        }
    }

    /// Syncs the names in a folder, and those in others that changed and could not be synced.
    fn sync_folder(&self, folder: &Path) -> Result<(), StoreError> {
        if self.syncing == Syncing::LeftToTheSystem {
            return Ok(());
        }
        let mut unsynced = self.unsynced();
        unsynced.insert(folder.to_owned());
        while let Some(next) = unsynced.first() {
            match self.disk.sync_folder(next) {
                Ok(()) => {}
                // Nothing was ever kept there.
                Err(fault) if fault.kind() == ErrorKind::NotFound => {}
                Err(fault) => return Err(io_error("syncing", next)(fault)),
            }
            unsynced.pop_first();
        }
        Ok(())
    }

    /// Names in these folders are about to change, whatever their callers are told.
    fn changes(&self, folders: &[&Path]) {
        if self.syncing == Syncing::EveryWrite {
            self.unsynced().extend(folders.iter().map(|folder| folder.to_path_buf()));
        }
    }

    /// Says to the next start that something may be there whose name is not synced.
    fn mark(&self) -> Result<(), StoreError> {
        if self.syncing == Syncing::EveryWrite && !self.is_marked.load(Ordering::Relaxed) {
            let mark = self.incoming.join(MARK);
            self.disk.create(&mark).map_err(io_error("creating", &mark))?;
            self.is_marked.store(true, Ordering::Relaxed);
        }
        Ok(())
    }

    fn unsynced(&self) -> MutexGuard<'_, BTreeSet<PathBuf>> {
        self.unsynced.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What follows the digest in a file, if that is right.
    fn verified(&self, root: &Path, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        let path = path(root, id);
        let file = match self.disk.read(&path) {
            Ok(file) => Bytes::from(file),
            Err(fault) if fault.kind() == ErrorKind::NotFound => return Ok(None),
            Err(fault) => return Err(io_error("reading", &path)(fault)),
        };
        content(file).map(Some).map_err(|what| damaged(id, what))
    }

    fn remove_file(&self, root: &Path, id: &RecordId) -> Result<(), StoreError> {
        let path = path(root, id);
        self.changes(&[folder(&path)]);
        match self.disk.remove(&path) {
            Ok(()) => {}
            // A call that failed may have removed it, so what is not there is synced too.
            Err(fault) if fault.kind() == ErrorKind::NotFound => {}
            Err(fault) => return Err(io_error("removing", &path)(fault)),
        }
        self.sync_folder(folder(&path))
    }

    fn unsettled(&self) -> MutexGuard<'_, Unsettled> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Up to `limit` ids above `after` in a folder, in ascending order.
    fn ids(
        &self,
        root: &Path,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        let from = after.map(|id| hex(id)).unwrap_or_default();
        let mut ids = Vec::new();
        for folder in self.sorted_names(root)? {
            if folder.len() != 2 || from.get(..2).is_some_and(|first| folder.as_str() < first) {
                continue;
            }
            for name in self.sorted_names(&root.join(&folder))? {
                if ids.len() == limit {
                    return Ok(ids);
                }
                if name > from
                    && let Some(id) = unhex(&name)
                {
                    ids.push(id);
                }
            }
        }
        Ok(ids)
    }

    fn sorted_names(&self, folder: &Path) -> Result<Vec<String>, StoreError> {
        let mut names = self.disk.names(folder).map_err(io_error("listing", folder))?;
        names.sort_unstable();
        Ok(names)
    }
}

impl Drop for DirectoryStore {
    fn drop(&mut self) {
        if self.is_marked.load(Ordering::Relaxed) && self.unsynced().is_empty() {
            self.remove_incoming(&self.incoming.join(MARK));
        }
    }
}

/// The revision that is `there`, if a writer who saw `seen` may change it.
fn settled(
    unsettled: &Unsettled,
    key: (Ledger, RecordId),
    there: Option<&Entry>,
    seen: Revision,
) -> Result<Revision, StoreError> {
    let found = there.map_or(0, |entry| entry.revision);
    if found == seen || unsettled.get(&key) == Some(&seen) {
        return Ok(found);
    }
    Err(StoreError::Stale { id: hex(&key.1), seen, found })
}

impl Store for DirectoryStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        let root = self.shelf(shelf);
        let existing = match self.get(shelf, id)? {
            Some(existing) => existing,
            None => {
                match self.create(&root, id, &[&bytes], |disk, from, to| disk.link(from, to))? {
                    Ok(()) => return Ok(Put::Created),
                    Err(fault) if fault.kind() == ErrorKind::AlreadyExists => {
                        let gone = || damaged(id, "it was removed while it was being read");
                        self.get(shelf, id)?.ok_or_else(gone)?
                    }
                    Err(fault) => return Err(io_error("linking", &path(&root, id))(fault)),
                }
            }
        };
        // Whoever put it may not have come to this.
        self.sync_names(&root, id)?;
        Ok(Put::Existing(existing))
    }

    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        self.verified(&self.shelf(shelf), id)
    }

    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        self.ids(&self.shelf(shelf), after, limit)
    }

    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError> {
        self.remove_file(&self.shelf(shelf), id)
    }

    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError> {
        let Some(file) = self.verified(&self.ledger(ledger), id)? else { return Ok(None) };
        entry(&file).map(Some).map_err(|what| damaged(id, what))
    }

    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError> {
        let mut unsettled = self.unsettled();
        let (root, key) = (self.ledger(ledger), (ledger, *id));
        let found = settled(&unsettled, key, self.read(ledger, id)?.as_ref(), seen)?;
        let revision = found.max(seen) + 1;
        let parts = [&revision.to_le_bytes()[..], &bytes];
        unsettled.insert(key, seen);
        self.create(&root, id, &parts, |disk, from, to| disk.rename(from, to))?
            .map_err(io_error("renaming", &path(&root, id)))?;
        unsettled.remove(&key);
        Ok(revision)
    }

    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError> {
        let mut unsettled = self.unsettled();
        let key = (ledger, *id);
        match self.read(ledger, id) {
            // Nobody can have seen it.
            Ok(None) | Err(StoreError::Damaged { .. }) => {}
            Ok(Some(there)) => drop(settled(&unsettled, key, Some(&there), seen)?),
            Err(fault) => return Err(fault),
        }
        unsettled.insert(key, seen);
        self.remove_file(&self.ledger(ledger), id)?;
        unsettled.remove(&key);
        Ok(())
    }

    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError> {
        self.ids(&self.ledger(ledger), None, usize::MAX)
    }

    /// After a write that failed, another one is tried.
    fn reach(&self) -> Result<(), StoreError> {
        /// A disk that has this much has room again.
        const PROBE: [u8; 4096] = [0; 4096];
        if self.is_failing.load(Ordering::Relaxed) {
            self.remove_incoming(&self.write_incoming(&[&PROBE])?);
            self.is_failing.store(false, Ordering::Relaxed);
        }
        Ok(())
    }
}

/// Makes a folder and those it lies in.
fn create_folders(disk: &dyn Disk, folder: &Path) -> io::Result<()> {
    match disk.create_folder(folder) {
        Err(fault) if fault.kind() == ErrorKind::AlreadyExists => Ok(()),
        Err(fault) if fault.kind() == ErrorKind::NotFound => {
            create_folders(disk, folder.parent().ok_or(fault)?)?;
            disk.create_folder(folder)
        }
        created => created,
    }
}

/// What follows the digest in a file, or why that is not what was written.
pub(super) fn content(file: Bytes) -> Result<Bytes, &'static str> {
    let Some(digest) = file.first_chunk::<DIGEST_LENGTH>() else {
        return Err("its file is truncated");
    };
    let bytes = file.slice(DIGEST_LENGTH..);
    if Sha256::digest(&bytes)[..] != *digest {
        return Err("its bytes do not have the digest written before them");
    }
    Ok(bytes)
}

/// The entry in the content of a file.
pub(super) fn entry(content: &Bytes) -> Result<Entry, &'static str> {
    let revision = content.first_chunk::<REVISION_LENGTH>().ok_or("its file is truncated")?;
    let revision = Revision::from_le_bytes(*revision);
    Ok(Entry { bytes: content.slice(REVISION_LENGTH..), revision })
}

/// Takes the directory for this process. One that is just being left is waited for.
fn locked(disk: &dyn Disk, root: &Path) -> Result<File, StoreError> {
    let path = root.join("lock");
    let open = File::options().create(true).truncate(false).write(true).read(true).open(&path);
    let lock = open.map_err(io_error("opening", &path))?;
    let until = Instant::now() + LOCK_WAIT;
    loop {
        match lock.try_lock() {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if Instant::now() < until => {
                thread::sleep(Duration::from_millis(20));
            }
            Err(TryLockError::WouldBlock) => {
                let holder = fs::read_to_string(&path).unwrap_or_default();
                return Err(StoreError::InUse(format!(
                    "{} is used by another process (id {}): one node, one directory",
                    root.display(),
                    holder.trim_end()
                )));
            }
            Err(TryLockError::Error(fault)) => return Err(io_error("locking", &path)(fault)),
        }
    }
    // For people; the lock itself is the system's, and a full disk keeps nobody from it.
    let id = format!("{}\n", process::id());
    if let Err(fault) = disk.create(&path).and_then(|mut file| file.write_all(id.as_bytes())) {
        tracing::warn!(%fault, path = %path.display(), "writing who holds the lock");
    }
    Ok(lock)
}

fn check_format(disk: &dyn Disk, path: &Path) -> Result<(), StoreError> {
    let found = match disk.read(path) {
        Ok(found) => found,
        Err(fault) if fault.kind() == ErrorKind::NotFound => Vec::new(),
        Err(fault) => return Err(io_error("reading", path)(fault)),
    };
    if found == FORMAT.as_bytes() {
        return Ok(());
    }
    // A crash at the very first start can leave a part of it.
    if !FORMAT.as_bytes().starts_with(&found) {
        let shown = String::from_utf8_lossy(&found);
        let shown = shown.lines().next().unwrap_or_default();
        let what = format!("this server reads {:?}, not {shown:?}", FORMAT.trim_end());
        return Err(io_error("opening", path)(io::Error::other(what)));
    }
    let write = || {
        let mut file = disk.create(path)?;
        file.write_all(FORMAT.as_bytes())?;
        file.sync()
    };
    write().map_err(io_error("writing", path))
}

fn path(root: &Path, id: &RecordId) -> PathBuf {
    root.join(hex(&id[..1])).join(hex(id))
}

fn folder(path: &Path) -> &Path {
    path.parent().expect("a record lies in a folder")
}

fn damaged(id: &RecordId, what: &'static str) -> StoreError {
    StoreError::Damaged { id: hex(id), what }
}

fn io_error(doing: &str, path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    let doing = format!("{doing} {}", path.display());
    move |source| match source.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            tracing::error!(doing, %source, "no room");
            StoreError::Full(source.to_string())
        }
        _ => StoreError::Io { doing, source },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: RecordId = [0x3c; 32];
    const SHELF: Shelf = Shelf::Plans;
    const LEDGER: Ledger = Ledger::Jobs;
    const TEXT: &[u8] = b"what was thought long ago";

    fn opened(folder: &tempfile::TempDir) -> DirectoryStore {
        DirectoryStore::open(folder.path(), Syncing::EveryWrite).unwrap()
    }

    /// A store with a record, an entry of the same bytes, and where both lie.
    fn filled() -> (tempfile::TempDir, DirectoryStore, [PathBuf; 2]) {
        let folder = tempfile::tempdir().unwrap();
        let store = opened(&folder);
        store.put_if_absent(SHELF, &ID, TEXT.into()).unwrap();
        store.write(LEDGER, &ID, TEXT.into(), 0).unwrap();
        let paths = [path(&store.shelf(SHELF), &ID), path(&store.ledger(LEDGER), &ID)];
        (folder, store, paths)
    }

    /// What both answer to a read when their files are `spoilt`.
    fn check_spoilt(spoilt: impl Fn(&[u8]) -> Vec<Vec<u8>>) {
        let (_folder, store, [record, entry]) = filled();
        for (path, is_record) in [(record, true), (entry, false)] {
            let good = fs::read(&path).unwrap();
            for bad in spoilt(&good) {
                fs::write(&path, &bad).unwrap();
                let outcome = if is_record {
                    store.get(SHELF, &ID).map(|_| ())
                } else {
                    store.read(LEDGER, &ID).map(|_| ())
                };
                assert!(
                    matches!(&outcome, Err(StoreError::Damaged { id, .. }) if *id == hex(&ID)),
                    "{outcome:?} of {bad:?}"
                );
            }
            fs::write(&path, &good).unwrap();
        }
        assert_eq!(store.get(SHELF, &ID).unwrap().as_deref(), Some(TEXT));
        assert_eq!(store.read(LEDGER, &ID).unwrap().unwrap().bytes, TEXT);
    }

    #[test]
    fn directory_store_survives_a_restart() {
        let (folder, store, _) = filled();
        drop(store);
        let store = opened(&folder);
        assert_eq!(store.get(SHELF, &ID).unwrap().as_deref(), Some(TEXT));
        assert_eq!(store.list(SHELF, None, 9).unwrap(), [ID]);
        assert_eq!(store.entries(LEDGER).unwrap(), [ID]);
        store.write(LEDGER, &ID, Bytes::new(), 1).unwrap();
    }

    #[test]
    fn directory_store_refuses_every_truncation() {
        check_spoilt(|good| (0..good.len()).map(|length| good[..length].to_vec()).collect());
    }

    #[test]
    fn directory_store_refuses_every_flipped_bit() {
        check_spoilt(|good| {
            let flipped = |bit: usize| {
                let mut bad = good.to_vec();
                bad[bit / 8] ^= 1 << (bit % 8);
                bad
            };
            (0..good.len() * 8).map(flipped).collect()
        });
    }

    #[test]
    fn directory_store_refuses_another_layout() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("format"), "vbar artifacts 2\n").unwrap();
        let fault = DirectoryStore::open(folder.path(), Syncing::EveryWrite).unwrap_err();
        assert!(fault.to_string().contains("vbar artifacts 2"), "{fault}");
    }

    #[test]
    fn directory_store_has_one_user_at_a_time() {
        let (folder, store, _) = filled();
        let fault = DirectoryStore::open(folder.path(), Syncing::EveryWrite).unwrap_err();
        assert!(matches!(fault, StoreError::InUse(_)), "{fault}");
        assert!(fault.to_string().contains(&process::id().to_string()), "{fault}");
        drop(store);
        assert_eq!(opened(&folder).list(SHELF, None, 9).unwrap(), [ID]);
    }

    #[test]
    fn directory_store_removes_what_a_crash_left() {
        let (folder, store, _) = filled();
        let leftover = store.incoming.join("77-0");
        fs::write(&leftover, b"half a rec").unwrap();
        drop(store);
        opened(&folder);
        assert!(!leftover.exists());
    }
}
