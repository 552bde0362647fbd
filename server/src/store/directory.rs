//! Records as files in one directory.
//!
//! ```text
//! <root>/format              "vbar artifacts 1\n"
//! <root>/v1/<xx>/<id>        one artifact; <id> in hexadecimal, <xx> its first two digits
//! <root>/v1/plans/<xx>/<id>  one plan
//! <root>/v1/incoming/…       records being written
//! ```
//!
//! A record's file is the sha256 of its bytes (32 bytes), then the bytes. It is written in
//! `incoming`, synced, linked to its name (which fails if the name exists: this is what makes a
//! put happen once, also between processes that share the directory), and the folder is synced.
//! A crash leaves at worst a file in `incoming`, which a later start removes.

use std::{
    fs::{self, File},
    io::{self, Write as _},
    path::{Path, PathBuf},
    process,
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::{Put, RecordId, RecordStore, Shelf, StoreError, hex};

const FORMAT: &str = "vbar artifacts 1\n";
const PLANS: &str = "plans";
const DIGEST_LENGTH: usize = 32;
/// No write of one record takes nearly this long.
const LEFTOVER_AGE: Duration = Duration::from_secs(600);

/// A store in a directory.
#[derive(Debug)]
pub(crate) struct DirectoryStore {
    records: PathBuf,
    incoming: PathBuf,
    /// Makes the names in `incoming` different within this process.
    written: AtomicU64,
}

impl DirectoryStore {
    /// Opens the store at `root`, which is made if it does not exist.
    ///
    /// # Errors
    /// If the directory cannot be used, or has a layout of another version.
    pub(crate) fn open(root: &Path) -> Result<Self, StoreError> {
        let records = root.join("v1");
        let incoming = records.join("incoming");
        for folder in [&incoming, &records.join(PLANS)] {
            fs::create_dir_all(folder).map_err(io_error("creating", folder))?;
        }
        let format = root.join("format");
        match fs::read_to_string(&format) {
            Ok(found) if found == FORMAT => {}
            Ok(found) => {
                let shown = found.lines().next().unwrap_or_default().to_owned();
                let what = format!("this server reads {:?}, not {shown:?}", FORMAT.trim_end());
                return Err(io_error("opening", &format)(io::Error::other(what)));
            }
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => {
                fs::write(&format, FORMAT).map_err(io_error("writing", &format))?;
            }
            Err(fault) => return Err(io_error("reading", &format)(fault)),
        }
        remove_leftovers(&incoming)?;
        Ok(Self { records, incoming, written: AtomicU64::new(0) })
    }

    /// The folder of a shelf. Artifacts stood here alone once, which is why they have no folder of
    /// their own; names of other shelves are longer than two letters.
    fn shelf(&self, shelf: Shelf) -> PathBuf {
        match shelf {
            Shelf::Artifacts => self.records.clone(),
            Shelf::Plans => self.records.join(PLANS),
        }
    }

    fn path(&self, shelf: Shelf, id: &RecordId) -> PathBuf {
        self.shelf(shelf).join(hex(&id[..1])).join(hex(id))
    }

    /// Writes and syncs a file nobody else knows yet.
    fn write_incoming(&self, bytes: &[u8]) -> Result<PathBuf, StoreError> {
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        let path = self.incoming.join(format!("{}-{number}", process::id()));
        let write = || {
            let mut file = File::create(&path)?;
            file.write_all(&Sha256::digest(bytes))?;
            file.write_all(bytes)?;
            file.sync_all()
        };
        write().map_err(io_error("writing", &path))?;
        Ok(path)
    }
}

impl RecordStore for DirectoryStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        if let Some(existing) = self.get(shelf, id)? {
            return Ok(Put::Existing(existing));
        }
        let path = self.path(shelf, id);
        let folder = path.parent().expect("a record lies in a folder");
        fs::create_dir_all(folder).map_err(io_error("creating", folder))?;
        let incoming = self.write_incoming(&bytes)?;
        let linked = fs::hard_link(&incoming, &path);
        let removed = fs::remove_file(&incoming).map_err(io_error("removing", &incoming));
        match linked {
            Ok(()) => {
                removed?;
                let sync = |folder: &Path| File::open(folder).and_then(|folder| folder.sync_all());
                sync(folder).map_err(io_error("syncing", folder))?;
                let shelf = self.shelf(shelf);
                sync(&shelf).map_err(io_error("syncing", &shelf))?;
                Ok(Put::Created)
            }
            Err(fault) if fault.kind() == io::ErrorKind::AlreadyExists => {
                let existing = self.get(shelf, id)?.ok_or_else(|| StoreError::Damaged {
                    id: hex(id),
                    what: "it was removed while it was being read",
                })?;
                Ok(Put::Existing(existing))
            }
            Err(fault) => Err(io_error("linking", &path)(fault)),
        }
    }

    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        let path = self.path(shelf, id);
        let file = match fs::read(&path) {
            Ok(file) => Bytes::from(file),
            Err(fault) if fault.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(fault) => return Err(io_error("reading", &path)(fault)),
        };
        let damaged = |what| StoreError::Damaged { id: hex(id), what };
        if file.len() < DIGEST_LENGTH {
            return Err(damaged("its file is truncated"));
        }
        let bytes = file.slice(DIGEST_LENGTH..);
        if Sha256::digest(&bytes)[..] != file[..DIGEST_LENGTH] {
            return Err(damaged("its bytes do not have the digest written before them"));
        }
        Ok(Some(bytes))
    }

    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        let root = self.shelf(shelf);
        let from = after.map(|id| hex(id)).unwrap_or_default();
        let mut ids = Vec::new();
        for folder in sorted_names(&root)? {
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

/// Removes files that a crash left half written; fresh ones may belong to another live process
/// that shares the directory.
fn remove_leftovers(incoming: &Path) -> Result<(), StoreError> {
    for name in sorted_names(incoming)? {
        let path = incoming.join(name);
        let age = || -> io::Result<Duration> {
            Ok(fs::metadata(&path)?.modified()?.elapsed().unwrap_or_default())
        };
        if age().map_err(io_error("reading", &path))? > LEFTOVER_AGE {
            fs::remove_file(&path).map_err(io_error("removing", &path))?;
        }
    }
    Ok(())
}

fn io_error(doing: &str, path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    let doing = format!("{doing} {}", path.display());
    move |source| StoreError::Io { doing, source }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    const ID: RecordId = [0x3c; 32];
    const SHELF: Shelf = Shelf::Plans;

    fn store_with_a_record() -> (tempfile::TempDir, DirectoryStore, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let store = DirectoryStore::open(folder.path()).unwrap();
        let bytes = Bytes::from_static(b"what was thought long ago");
        store.put_if_absent(SHELF, &ID, bytes).unwrap();
        let path = store.path(SHELF, &ID);
        (folder, store, path)
    }

    fn damage(store: &DirectoryStore) -> String {
        match store.get(SHELF, &ID) {
            Err(StoreError::Damaged { id, what }) => {
                assert_eq!(id, hex(&ID));
                what.to_owned()
            }
            other => panic!("expected a damaged record, got {other:?}"),
        }
    }

    #[test]
    fn directory_store_survives_a_restart() {
        let (folder, store, _) = store_with_a_record();
        drop(store);
        let store = DirectoryStore::open(folder.path()).unwrap();
        assert_eq!(
            store.get(SHELF, &ID).unwrap().as_deref(),
            Some(&b"what was thought long ago"[..])
        );
        assert_eq!(store.list(SHELF, None, 9).unwrap(), [ID]);
    }

    #[test]
    fn directory_store_refuses_every_truncation() {
        let (_folder, store, path) = store_with_a_record();
        let good = fs::read(&path).unwrap();
        for length in 0..good.len() {
            fs::write(&path, &good[..length]).unwrap();
            damage(&store);
        }
        fs::write(&path, &good).unwrap();
        assert!(store.get(SHELF, &ID).unwrap().is_some());
    }

    #[test]
    fn directory_store_refuses_every_flipped_bit() {
        let (_folder, store, path) = store_with_a_record();
        let good = fs::read(&path).unwrap();
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            fs::write(&path, &bad).unwrap();
            assert!(damage(&store).contains("digest"));
        }
    }

    #[test]
    fn directory_store_refuses_another_layout() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("format"), "vbar artifacts 2\n").unwrap();
        let fault = DirectoryStore::open(folder.path()).unwrap_err().to_string();
        assert!(fault.contains("vbar artifacts 2"), "{fault}");
    }

    #[test]
    fn directory_store_removes_what_a_crash_left() {
        let (folder, store, _) = store_with_a_record();
        let leftover = store.incoming.join("77-0");
        fs::write(&leftover, b"half a rec").unwrap();
        let fresh = store.incoming.join("78-0");
        fs::write(&fresh, b"being written").unwrap();
        let long_ago = SystemTime::now() - LEFTOVER_AGE * 2;
        File::options().write(true).open(&leftover).unwrap().set_modified(long_ago).unwrap();
        drop(store);
        DirectoryStore::open(folder.path()).unwrap();
        assert!(!leftover.exists());
        assert!(fresh.exists());
    }
}
