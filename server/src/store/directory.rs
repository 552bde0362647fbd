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
//! <root>/v1/incoming/…          files being written
//! ```
//!
//! A file is the sha256 of what follows (32 bytes), then what follows: a record's bytes; for an
//! entry its revision (8 bytes, little-endian) and its bytes. It is written in `incoming` and
//! synced; a record is linked to its name (which fails if the name exists), an entry renamed over
//! its predecessor; then the folder is synced. A crash leaves at worst a file in `incoming`, which
//! the next start removes.
//!
//! With [`Syncing::EveryWrite`] nothing that was acknowledged is lost when the power fails, as far
//! as the disk keeps its own promises. Without it a killed process still loses nothing, because
//! the system has the bytes, but a power failure can take what was written in the last half
//! minute; what it tore is noticed by its digest.

use std::{
    fs::{self, File, TryLockError},
    io::{self, Write as _},
    path::{Path, PathBuf},
    process,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::{Entry, Ledger, Put, RecordId, Revision, Shelf, Store, StoreError, hex};

const FORMAT: &str = "vbar artifacts 1\n";
const DIGEST_LENGTH: usize = 32;
const REVISION_LENGTH: usize = size_of::<Revision>();
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
    records: PathBuf,
    incoming: PathBuf,
    syncing: Syncing,
    /// Makes the names in `incoming` different.
    written: AtomicU64,
    /// Held while an entry is compared and replaced.
    entries: Mutex<()>,
    /// The lock is given back when this is closed, also by a process that is killed.
    _lock: File,
}

impl DirectoryStore {
    /// Opens the store at `root`, which is made if it does not exist.
    ///
    /// # Errors
    /// If the directory cannot be used, is used by another process, or has a layout of another
    /// version.
    pub(crate) fn open(root: &Path, syncing: Syncing) -> Result<Self, StoreError> {
        let records = root.join("v1");
        let incoming = records.join("incoming");
        fs::create_dir_all(root).map_err(io_error("creating", root))?;
        let lock = locked(root)?;
        check_format(&root.join("format"))?;
        let store = Self {
            records,
            incoming,
            syncing,
            written: AtomicU64::new(0),
            entries: Mutex::new(()),
            _lock: lock,
        };
        let ledgers = [Ledger::Jobs, Ledger::Requests, Ledger::Leases];
        let folders = ledgers.map(|ledger| store.ledger(ledger)).into_iter();
        for folder in folders.chain([store.shelf(Shelf::Plans), store.incoming.clone()]) {
            fs::create_dir_all(&folder).map_err(io_error("creating", &folder))?;
        }
        // They are what a crash left: nobody else writes here.
        for name in sorted_names(&store.incoming)? {
            let path = store.incoming.join(name);
            fs::remove_file(&path).map_err(io_error("removing", &path))?;
        }
        Ok(store)
    }

    /// The folder of a shelf. Artifacts stood here alone once, which is why they have no folder of
    /// their own; names of other shelves are longer than two letters.
    fn shelf(&self, shelf: Shelf) -> PathBuf {
        match shelf {
            Shelf::Artifacts => self.records.clone(),
            Shelf::Plans => self.records.join("plans"),
        }
    }

    fn ledger(&self, ledger: Ledger) -> PathBuf {
        self.records.join(match ledger {
            Ledger::Jobs => "jobs",
            Ledger::Requests => "requests",
            Ledger::Leases => "leases",
        })
    }

    /// Writes a file nobody else knows yet, to be given its name by `publish`, in `root`.
    fn create(
        &self,
        root: &Path,
        id: &RecordId,
        parts: &[&[u8]],
        publish: impl FnOnce(&Path, &Path) -> io::Result<()>,
    ) -> Result<io::Result<()>, StoreError> {
        let path = path(root, id);
        let folder = path.parent().expect("a record lies in a folder");
        fs::create_dir_all(folder).map_err(io_error("creating", folder))?;
        let incoming = self.write_incoming(parts)?;
        let published = publish(&incoming, &path);
        match fs::remove_file(&incoming) {
            // It was renamed.
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {}
            removed => removed.map_err(io_error("removing", &incoming))?,
        }
        if published.is_ok() {
            self.sync_folder(folder)?;
            self.sync_folder(root)?;
        }
        Ok(published)
    }

    fn write_incoming(&self, parts: &[&[u8]]) -> Result<PathBuf, StoreError> {
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        let incoming = self.incoming.join(format!("{}-{number}", process::id()));
        let mut digest = Sha256::new();
        parts.iter().for_each(|part| digest.update(part));
        let write = || {
            let mut file = File::create(&incoming)?;
            file.write_all(&digest.finalize())?;
            parts.iter().try_for_each(|part| file.write_all(part))?;
            match self.syncing {
                Syncing::EveryWrite => file.sync_all(),
                Syncing::LeftToTheSystem => Ok(()),
            }
        };
        write().map_err(io_error("writing", &incoming))?;
        Ok(incoming)
    }

    fn sync_folder(&self, folder: &Path) -> Result<(), StoreError> {
        if self.syncing == Syncing::LeftToTheSystem {
            return Ok(());
        }
        File::open(folder).and_then(|folder| folder.sync_all()).map_err(io_error("syncing", folder))
    }

    /// What follows the digest in a file, if that is right.
    fn verified(&self, root: &Path, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        let path = path(root, id);
        let file = match fs::read(&path) {
            Ok(file) => Bytes::from(file),
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(fault) => return Err(io_error("reading", &path)(fault)),
        };
        if file.len() < DIGEST_LENGTH {
            return Err(damaged(id, "its file is truncated"));
        }
        let bytes = file.slice(DIGEST_LENGTH..);
        if Sha256::digest(&bytes)[..] != file[..DIGEST_LENGTH] {
            return Err(damaged(id, "its bytes do not have the digest written before them"));
        }
        Ok(Some(bytes))
    }

    fn remove_file(&self, root: &Path, id: &RecordId) -> Result<(), StoreError> {
        let path = path(root, id);
        match fs::remove_file(&path) {
            Ok(()) => self.sync_folder(path.parent().expect("a record lies in a folder")),
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(fault) => Err(io_error("removing", &path)(fault)),
        }
    }

    /// The entry, if `seen` is its latest revision.
    fn seen(
        &self,
        ledger: Ledger,
        id: &RecordId,
        seen: Revision,
    ) -> Result<Option<Entry>, StoreError> {
        let entry = self.read(ledger, id)?;
        match entry.as_ref().map_or(0, |entry| entry.revision) {
            found if found == seen => Ok(entry),
            found => Err(StoreError::Stale { id: hex(id), seen, found }),
        }
    }
}

impl Store for DirectoryStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        if let Some(existing) = self.get(shelf, id)? {
            return Ok(Put::Existing(existing));
        }
        let root = self.shelf(shelf);
        match self.create(&root, id, &[&bytes], |from, to| fs::hard_link(from, to))? {
            Ok(()) => Ok(Put::Created),
            Err(fault) if fault.kind() == io::ErrorKind::AlreadyExists => {
                let existing = self.get(shelf, id)?;
                let gone = || damaged(id, "it was removed while it was being read");
                Ok(Put::Existing(existing.ok_or_else(gone)?))
            }
            Err(fault) => Err(io_error("linking", &path(&root, id))(fault)),
        }
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
        ids(&self.shelf(shelf), after, limit)
    }

    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError> {
        self.remove_file(&self.shelf(shelf), id)
    }

    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError> {
        let Some(file) = self.verified(&self.ledger(ledger), id)? else { return Ok(None) };
        let Some(revision) = file.first_chunk::<REVISION_LENGTH>() else {
            return Err(damaged(id, "its file is truncated"));
        };
        let revision = Revision::from_le_bytes(*revision);
        Ok(Some(Entry { bytes: file.slice(REVISION_LENGTH..), revision }))
    }

    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError> {
        let _entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        self.seen(ledger, id, seen)?;
        let root = self.ledger(ledger);
        let revision = seen + 1;
        let parts = [&revision.to_le_bytes()[..], &bytes];
        self.create(&root, id, &parts, |from, to| fs::rename(from, to))?
            .map_err(io_error("renaming", &path(&root, id)))?;
        Ok(revision)
    }

    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError> {
        let _entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        if self.read(ledger, id)?.is_some() {
            self.seen(ledger, id, seen)?;
            self.remove_file(&self.ledger(ledger), id)?;
        }
        Ok(())
    }

    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError> {
        ids(&self.ledger(ledger), None, usize::MAX)
    }
}

/// Takes the directory for this process. One that is just being left is waited for.
fn locked(root: &Path) -> Result<File, StoreError> {
    let path = root.join("lock");
    let open = File::options().create(true).truncate(false).write(true).read(true).open(&path);
    let mut lock = open.map_err(io_error("opening", &path))?;
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
    // For people; the lock itself is the system's.
    lock.set_len(0)
        .and_then(|()| lock.write_all(format!("{}\n", process::id()).as_bytes()))
        .map_err(io_error("writing", &path))?;
    Ok(lock)
}

fn check_format(path: &Path) -> Result<(), StoreError> {
    match fs::read_to_string(path) {
        Ok(found) if found == FORMAT => Ok(()),
        // A crash at the very first start can leave it empty.
        Ok(found) if !found.is_empty() => {
            let shown = found.lines().next().unwrap_or_default().to_owned();
            let what = format!("this server reads {:?}, not {shown:?}", FORMAT.trim_end());
            Err(io_error("opening", path)(io::Error::other(what)))
        }
        Err(fault) if fault.kind() != io::ErrorKind::NotFound => {
            Err(io_error("reading", path)(fault))
        }
        _ => fs::write(path, FORMAT).map_err(io_error("writing", path)),
    }
}

fn path(root: &Path, id: &RecordId) -> PathBuf {
    root.join(hex(&id[..1])).join(hex(id))
}

fn damaged(id: &RecordId, what: &'static str) -> StoreError {
    StoreError::Damaged { id: hex(id), what }
}

/// Up to `limit` ids above `after` in a folder, in ascending order.
fn ids(root: &Path, after: Option<&RecordId>, limit: usize) -> Result<Vec<RecordId>, StoreError> {
    let from = after.map(|id| hex(id)).unwrap_or_default();
    let mut ids = Vec::new();
    for folder in sorted_names(root)? {
        if folder.len() != 2 || from.get(..2).is_some_and(|first| folder.as_str() < first) {
            continue;
        }
        for name in sorted_names(&root.join(&folder))? {
            if ids.len() == limit {
                return Ok(ids);
            }
            if name > from
                && let Some(id) = record_id(&name)
            {
                ids.push(id);
            }
        }
    }
    Ok(ids)
}

fn record_id(name: &str) -> Option<RecordId> {
    let mut id = [0; 32];
    if name.len() != 64 || !name.is_ascii() {
        return None;
    }
    for (i, byte) in id.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&name[2 * i..2 * i + 2], 16).ok()?;
    }
    Some(id)
}

fn sorted_names(folder: &Path) -> Result<Vec<String>, StoreError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io_error("listing", folder))? {
        let entry = entry.map_err(io_error("listing", folder))?;
        // A name that is not text is not ours.
        names.extend(entry.file_name().into_string());
    }
    names.sort_unstable();
    Ok(names)
}

fn io_error(doing: &str, path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    let doing = format!("{doing} {}", path.display());
    move |source| StoreError::Io { doing, source }
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
