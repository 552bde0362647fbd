//! Artifacts in memory, decoded and ready, the least recently used ones forgotten first.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use vbar_guidance::control::Infeasibility;

use crate::{
    store::Shelf,
    wire::{ArtifactId, Problem, StoredArtifact},
};

/// What is remembered, by the shelf it stands on in the store.
pub(super) type Key = (Shelf, ArtifactId);

/// What a precompute came to.
#[derive(Debug, Clone)]
pub(crate) enum Outcome {
    /// An artifact, which is also in the store.
    Made(StoredArtifact),
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
    by_id: HashMap<Key, Entry>,
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
    pub(super) fn get(&self, id: &Key) -> Option<Outcome> {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.now += 1;
        let now = entries.now;
        let entry = entries.by_id.get_mut(id)?;
        entry.used = now;
        Some(entry.outcome.clone())
    }

    /// Forgets what is remembered of `id`.
    pub(super) fn forget(&self, id: &Key) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(forgotten) = entries.by_id.remove(id) {
            entries.bytes -= forgotten.outcome.bytes();
        }
    }

    /// Remembers `outcome`; forgets what was not used for longest if there is no room. The newest
    /// stays even if it alone is too large: somebody is about to use it.
    pub(super) fn insert(&self, id: Key, outcome: Outcome) {
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

#[cfg(test)]
mod tests {
    use vbar_proto::v1;

    use super::*;
    use crate::wire::{Limits, PrecomputeCall, parse};

    /// Any outcome; what is remembered does not matter to the memory.
    fn outcome(reason: &str) -> Outcome {
        let matrix = |rows, columns, values: &[f64]| {
            Some(v1::Matrix { rows, columns, values: values.to_vec() })
        };
        let linear = v1::LinearPlant {
            a: matrix(1, 1, &[1.0]),
            b: matrix(1, 1, &[1.0]),
            input_lower: vec![-1.0],
            input_upper: vec![1.0],
            disturbance: Some(v1::DisturbanceSet {
                form: Some(v1::disturbance_set::Form::None(v1::NoDisturbance {})),
            }),
            ..v1::LinearPlant::default()
        };
        let problem = v1::VariableHorizonProblem {
            plant: Some(v1::variable_horizon_problem::Plant::Linear(linear)),
            scheme: v1::VariableHorizonScheme::Nominal.into(),
            gain: Some(v1::Gain {
                form: Some(v1::gain::Form::Poles(v1::Poles { values: vec![0.5] })),
            }),
            fuel_weight: Some(1.0),
            search: v1::HorizonSearch::Local.into(),
            horizon_max: 1,
            ..v1::VariableHorizonProblem::default()
        };
        let method = Some(v1::problem::Method::VariableHorizon(problem));
        let request = v1::PrecomputeRequest {
            problem: Some(v1::Problem { method }),
            ..v1::PrecomputeRequest::default()
        };
        let call: PrecomputeCall = parse(&request, &Limits::default()).expect("a good request");
        let why = Infeasibility {
            reason: reason.to_owned(),
            horizon: 1,
            rows: Vec::new(),
            relaxations: Vec::new(),
            all_horizons_proved: true,
        };
        Outcome::Infeasible(call.problem, Arc::new(why))
    }

    fn key(n: u8) -> Key {
        (Shelf::Artifacts, ArtifactId([n; 32]))
    }

    fn reason(cache: &Cache, n: u8) -> Option<String> {
        match cache.get(&key(n))? {
            Outcome::Infeasible(_, why) => Some(why.reason.clone()),
            Outcome::Made(_) => None,
        }
    }

    #[test]
    fn cache_forgets_what_was_not_used_for_longest() {
        let cache = Cache::new(3 * outcome("").bytes());
        for n in [1, 2, 3] {
            cache.insert(key(n), outcome(&n.to_string()));
        }
        assert_eq!(reason(&cache, 1).as_deref(), Some("1"));
        cache.insert(key(4), outcome("4"));
        assert_eq!(reason(&cache, 2), None);
        for n in [1, 3, 4] {
            assert_eq!(reason(&cache, n), Some(n.to_string()));
        }
        // Replaced, not counted twice.
        cache.insert(key(4), outcome("again"));
        assert_eq!(reason(&cache, 4).as_deref(), Some("again"));
        assert_eq!(reason(&cache, 1).as_deref(), Some("1"));
    }

    #[test]
    fn cache_forgets_when_told_and_has_room_again() {
        let cache = Cache::new(2 * outcome("").bytes());
        for n in [1, 2] {
            cache.insert(key(n), outcome(&n.to_string()));
        }
        cache.forget(&key(1));
        cache.forget(&key(1));
        assert_eq!(reason(&cache, 1), None);
        cache.insert(key(3), outcome("3"));
        assert_eq!(reason(&cache, 2).as_deref(), Some("2"));
    }

    #[test]
    fn cache_keeps_the_newest_even_if_it_is_too_large() {
        let cache = Cache::new(1);
        cache.insert(key(1), outcome("1"));
        assert!(reason(&cache, 1).is_some());
        cache.insert(key(2), outcome("2"));
        assert!(reason(&cache, 1).is_none() && reason(&cache, 2).is_some());
    }
}
