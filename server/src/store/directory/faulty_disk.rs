//! A disk that fails on purpose, in an order that a seed decides.
//!
//! What it is asked to do it does to real files, and remembers what a loss of power could take
//! back: bytes of files, and names in folders, that were not synced. Syncing only makes it forget;
//! nothing waits for a real disk.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, File},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
};

use fastrand::Rng;

use super::disk::{Disk, LocalDisk, Written};

/// A disk that several may hold on to: the store, and the test that makes it fail.
#[derive(Debug, Clone)]
pub(crate) struct FaultyDisk(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    state: Mutex<State>,
    /// It does not hang any more.
    goes_on: Condvar,
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Faults {
    /// There is no room.
    pub(crate) is_full: bool,
    /// One call in so many fails, before or after it has done what it was asked; 0 for none.
    pub(crate) one_in: u32,
    /// After so many calls nothing is done any more: the process was killed.
    pub(crate) killed_after: Option<u32>,
}

#[derive(Debug)]
struct State {
    rng: Rng,
    faults: Faults,
    is_hanging: bool,
    /// Changes of names that are not synced, oldest first.
    changes: Vec<Change>,
    /// Files whose bytes are not synced.
    unsynced: BTreeSet<PathBuf>,
}

#[derive(Debug)]
struct Change {
    path: PathBuf,
    before: Before,
}

/// What stood under a name.
#[derive(Debug)]
enum Before {
    Nothing,
    File(Vec<u8>),
}

/// How a call goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Done,
    Failed,
    DoneAndFailed,
}

impl FaultyDisk {
    /// One on which nothing goes wrong yet.
    pub(crate) fn new(seed: u64) -> Self {
        let state = State {
            rng: Rng::with_seed(seed),
            faults: Faults::default(),
            is_hanging: false,
            changes: Vec::new(),
            unsynced: BTreeSet::new(),
        };
        Self(Arc::new(Inner { state: Mutex::new(state), goes_on: Condvar::new() }))
    }

    /// From now on this goes wrong, and nothing else.
    pub(crate) fn set(&self, faults: Faults) {
        self.state().faults = faults;
    }

    /// From now on calls wait, or those that wait go on.
    pub(crate) fn set_hanging(&self, is_hanging: bool) {
        self.state().is_hanging = is_hanging;
        self.0.goes_on.notify_all();
    }

    /// The process was killed.
    pub(crate) fn is_dead(&self) -> bool {
        self.state().faults.killed_after == Some(0)
    }

    /// Takes back what was not synced: of each folder the latest changes of names, none, some or
    /// all of them; of each file its end.
    pub(crate) fn lose_power(&self) {
        let state = &mut *self.state();
        let mut of_folder = BTreeMap::<PathBuf, usize>::new();
        for change in &state.changes {
            *of_folder.entry(folder(&change.path)).or_default() += 1;
        }
        for lost in of_folder.values_mut() {
            *lost = state.rng.usize(..=*lost);
        }
        for Change { path, before } in std::mem::take(&mut state.changes).into_iter().rev() {
            let lost = of_folder.get_mut(&folder(&path)).expect("each folder was counted");
            if *lost == 0 {
                continue;
            }
            *lost -= 1;
            // What fails is gone already, or its folder will be.
            let _ = match before {
                Before::Nothing if path.is_dir() => fs::remove_dir_all(path),
                Before::Nothing => fs::remove_file(path),
                Before::File(bytes) => fs::write(path, bytes),
            };
        }
        for path in std::mem::take(&mut state.unsynced) {
            let Ok(bytes) = fs::read(&path) else { continue };
            let kept = state.rng.usize(..=bytes.len());
            // Its other names keep the same bytes, so it is cut and not replaced.
            File::options().write(true).open(&path).unwrap().set_len(kept as u64).unwrap();
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The state, when it is somebody's turn.
    fn turn(&self) -> MutexGuard<'_, State> {
        let state = self.state();
        self.0
            .goes_on
            .wait_while(state, |state| state.is_hanging)
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Does `call`, or fails, or both. `takes_room` says that it needs some.
    fn call<T>(
        &self,
        takes_room: bool,
        call: impl FnOnce(&mut State) -> io::Result<T>,
    ) -> io::Result<T> {
        let mut state = self.turn();
        if takes_room && state.faults.is_full {
            return Err(ErrorKind::StorageFull.into());
        }
        match state.fate() {
            Fate::Done => call(&mut state),
            Fate::Failed => Err(fault()),
            Fate::DoneAndFailed => call(&mut state).and(Err(fault())),
        }
    }
}

fn fault() -> io::Error {
    io::Error::other("a fault on purpose")
}

fn folder(path: &Path) -> PathBuf {
    path.parent().expect("it lies in a folder").to_owned()
}

impl State {
    fn fate(&mut self) -> Fate {
        if let Some(left) = &mut self.faults.killed_after {
            if *left == 0 {
                return Fate::Failed;
            }
            *left -= 1;
            if *left == 0 {
                return self.either();
            }
        }
        match self.faults.one_in {
            0 => Fate::Done,
            one_in if self.rng.u32(..one_in) == 0 => self.either(),
            _ => Fate::Done,
        }
    }

    fn either(&mut self) -> Fate {
        if self.rng.bool() { Fate::Failed } else { Fate::DoneAndFailed }
    }

    /// The name is about to change.
    fn note(&mut self, path: &Path) {
        let before = fs::read(path).map_or(Before::Nothing, Before::File);
        self.changes.push(Change { path: path.to_owned(), before });
    }

    fn is_unsynced(&mut self, path: &Path, is_unsynced: bool) {
        if is_unsynced {
            self.unsynced.insert(path.to_owned());
        } else {
            self.unsynced.remove(path);
        }
    }
}

impl Disk for FaultyDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn Written>> {
        self.call(true, |state| {
            state.note(path);
            state.is_unsynced(path, true);
            let file = File::create(path)?;
            let (disk, path) = (self.clone(), path.to_owned());
            Ok(Box::new(FaultyFile { disk, file, path }) as Box<dyn Written>)
        })
    }

    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        self.call(false, |_| LocalDisk.read(path))
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.call(true, |state| {
            if !to.exists() {
                state.note(to);
            }
            LocalDisk.link(from, to)?;
            let is_unsynced = state.unsynced.contains(from);
            state.is_unsynced(to, is_unsynced);
            Ok(())
        })
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.call(false, |state| {
            state.note(to);
            state.note(from);
            LocalDisk.rename(from, to)?;
            let is_unsynced = state.unsynced.remove(from);
            state.is_unsynced(to, is_unsynced);
            Ok(())
        })
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.call(false, |state| {
            if path.exists() {
                state.note(path);
            }
            LocalDisk.remove(path)?;
            state.unsynced.remove(path);
            Ok(())
        })
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        // One that is there takes no room.
        self.call(!path.exists(), |state| {
            LocalDisk.create_folder(path)?;
            state.changes.push(Change { path: path.to_owned(), before: Before::Nothing });
            Ok(())
        })
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<String>> {
        self.call(false, |_| LocalDisk.names(folder))
    }

    fn sync_folder(&self, folder: &Path) -> io::Result<()> {
        self.call(false, |state| {
            fs::read_dir(folder)?;
            state.changes.retain(|change| change.path.parent() != Some(folder));
            Ok(())
        })
    }
}

/// A file on it.
#[derive(Debug)]
struct FaultyFile {
    disk: FaultyDisk,
    file: File,
    path: PathBuf,
}

impl Write for FaultyFile {
    /// Writes all of it, or a part: because it is allowed to, or because it fails in the midst.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.turn();
        let is_full = state.faults.is_full;
        let is_short = state.rng.u8(..4) == 0 && bytes.len() > 1;
        let fate = if state.is_dead() { return Err(fault()) } else { state.fate() };
        let length = match fate {
            Fate::Done if is_full => state.rng.usize(..bytes.len().max(1)),
            Fate::Done if is_short => state.rng.usize(1..bytes.len()),
            Fate::Done => bytes.len(),
            Fate::Failed | Fate::DoneAndFailed => state.rng.usize(..=bytes.len()),
        };
        drop(state);
        self.file.write_all(&bytes[..length])?;
        match fate {
            Fate::Done if is_full => Err(ErrorKind::StorageFull.into()),
            Fate::Done => Ok(length),
            Fate::Failed | Fate::DoneAndFailed => Err(fault()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl State {
    fn is_dead(&self) -> bool {
        self.faults.killed_after == Some(0)
    }
}

impl Written for FaultyFile {
    fn sync(&mut self) -> io::Result<()> {
        let Self { disk, path, .. } = self;
        disk.call(false, |state| {
            state.unsynced.remove(path);
            Ok(())
        })
    }
}
