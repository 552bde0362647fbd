//! Artifacts in memory, decoded and ready, the least recently used ones forgotten first.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use vbar_guidance::control::Infeasibility;

use crate::wire::{ArtifactAnswer, ArtifactId, Problem};

/// What a precompute came to.
#[derive(Debug, Clone)]
pub(crate) enum Outcome {
    /// An artifact, which is also in the store.
    Made(ArtifactAnswer),
    /// There is none. Remembered here only: it is cheap to find out again.
    Infeasible(Problem, Arc<Infeasibility>),
}

impl Outcome {
    /// What it is taken to occupy; a decoded artifact is about as large as its bytes.
    fn bytes(&self) -> usize {
        const OVERHEAD: usize = 4096;
        match self {
            Self::Made(made) => made.size_bytes + OVERHEAD,
            Self::Infeasible(..) => OVERHEAD,
        }
    }
}

/// A bounded memory of outcomes.
#[derive(Debug)]
pub(super) struct Cache {
    bytes_max: usize,
    entries: Mutex<Entries>,
}

#[derive(Debug, Default)]
struct Entries {
    bytes: usize,
    /// Raised at each use.
    now: u64,
    by_id: HashMap<ArtifactId, Entry>,
}

#[derive(Debug)]
struct Entry {
    outcome: Outcome,
    used: u64,
}

impl Cache {
    /// For outcomes of at most `bytes_max` bytes together.
    pub(super) fn new(bytes_max: usize) -> Self {
        Self { bytes_max, entries: Mutex::default() }
    }

    /// What is remembered of `id`.
    pub(super) fn get(&self, id: &ArtifactId) -> Option<Outcome> {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.now += 1;
        let now = entries.now;
        let entry = entries.by_id.get_mut(id)?;
        entry.used = now;
        Some(entry.outcome.clone())
    }

    /// Remembers `outcome`; forgets what was not used for longest if there is no room. The newest
    /// stays even if it alone is too large: somebody is about to use it.
    pub(super) fn insert(&self, id: ArtifactId, outcome: Outcome) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        let entries = &mut *entries;
        entries.now += 1;
        entries.bytes += outcome.bytes();
        let entry = Entry { outcome, used: entries.now };
        if let Some(replaced) = entries.by_id.insert(id, entry) {
            entries.bytes -= replaced.outcome.bytes();
        }
        while entries.bytes > self.bytes_max && entries.by_id.len() > 1 {
            let oldest = entries.by_id.iter().min_by_key(|(_, entry)| entry.used);
            let Some(oldest) = oldest.map(|(id, _)| *id) else { return };
            if let Some(forgotten) = entries.by_id.remove(&oldest) {
                entries.bytes -= forgotten.outcome.bytes();
            }
        }
    }
}
