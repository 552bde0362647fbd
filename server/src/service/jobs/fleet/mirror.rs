//! What this node knows of every job: the store tells it of each change.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::Bound,
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, SystemTime},
};

use tokio::sync::watch;

use super::parts::{Part, Ticket, Word};
use crate::{
    service::jobs::{JobRecord, View},
    store::{Change, Entry, RecordId, Revision},
    wire::ArtifactId,
};

/// Every job, as it was when the store last told of it.
#[derive(Debug, Default)]
pub(super) struct Mirror {
    jobs: Mutex<Jobs>,
}

#[derive(Debug, Default)]
struct Jobs {
    by_id: BTreeMap<ArtifactId, Seen>,
    is_complete: bool,
    /// Jobs that were not among all when the store told of all again: gone, or just rewritten.
    missing: BTreeSet<ArtifactId>,
}

#[derive(Debug)]
struct Seen {
    record: JobRecord,
    revision: Revision,
    /// How far each shard, and last the merge, was said to be; millionths.
    told: Vec<u32>,
    /// When something was heard of it.
    heard: Instant,
    changes: watch::Sender<()>,
}

const WHOLE: u32 = 1_000_000;

impl Seen {
    fn new(record: JobRecord, revision: Revision) -> Self {
        let told = vec![0; record.shards_total() + 1];
        let changes = watch::Sender::new(());
        Self { record, revision, told, heard: Instant::now(), changes }
    }

    fn ticket(&self) -> Option<Ticket> {
        self.record.parts()?.ticket()
    }

    fn is_done(&self, shard: usize) -> bool {
        self.record.parts().is_some_and(|parts| parts.is_done(shard))
    }

    /// Of everything; the merge counts as one more shard.
    fn fraction(&self) -> f64 {
        let part = |(shard, told): (usize, &u32)| if self.is_done(shard) { WHOLE } else { *told };
        let sum: u64 = self.told.iter().enumerate().map(part).map(u64::from).sum();
        sum as f64 / (self.told.len() as f64 * f64::from(WHOLE))
    }

    fn view(&self, id: ArtifactId) -> View {
        View::new(id, &self.record, self.record.ending().is_none().then(|| self.fraction()))
    }
}

impl Jobs {
    fn see(&mut self, id: ArtifactId, record: JobRecord, revision: Revision) {
        self.missing.remove(&id);
        match self.by_id.get_mut(&id) {
            Some(seen) if seen.revision >= revision => {}
            Some(seen) => {
                let ticket = record.parts().and_then(|parts| parts.ticket());
                if ticket != seen.ticket() {
                    seen.told = vec![0; record.shards_total() + 1];
                }
                (seen.record, seen.revision, seen.heard) = (record, revision, Instant::now());
                seen.changes.send_replace(());
            }
            None => drop(self.by_id.insert(id, Seen::new(record, revision))),
        }
    }

    fn forget(&mut self, id: ArtifactId) {
        self.by_id.remove(&id);
        self.missing.remove(&id);
    }

    fn see_entry(&mut self, id: RecordId, entry: &Entry) {
        let id = ArtifactId(id);
        match JobRecord::decode(&entry.bytes) {
            Ok(record) => self.see(id, record, entry.revision),
            // A node of another version may have written it.
            Err(fault) => tracing::error!(%id, fault, "a job's entry cannot be used"),
        }
    }
}

impl Mirror {
    /// No code that holds the lock can leave the jobs half changed.
    fn jobs(&self) -> MutexGuard<'_, Jobs> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes in what the store tells.
    pub(super) fn apply(&self, change: Change) {
        let mut jobs = self.jobs();
        match change {
            Change::All(entries) => {
                jobs.missing = jobs.by_id.keys().copied().collect();
                entries.iter().for_each(|(id, entry)| jobs.see_entry(*id, entry));
                jobs.is_complete = true;
            }
            Change::Written(id, entry) => jobs.see_entry(id, &entry),
            Change::Erased(id) => jobs.forget(ArtifactId(id)),
        }
    }

    /// Whether the store has told of everything once.
    pub(super) fn is_complete(&self) -> bool {
        self.jobs().is_complete
    }

    /// Takes in what this node wrote or read itself.
    pub(super) fn see(&self, id: ArtifactId, record: JobRecord, revision: Revision) {
        self.jobs().see(id, record, revision);
    }

    /// The job is not there any more.
    pub(super) fn forget(&self, id: ArtifactId) {
        self.jobs().forget(id);
    }

    /// Jobs of which only the store can say whether they are still there.
    pub(super) fn missing(&self) -> Vec<ArtifactId> {
        self.jobs().missing.iter().copied().collect()
    }

    /// Takes in how far somebody is.
    pub(super) fn hear(&self, word: Word) {
        let mut jobs = self.jobs();
        let Some(seen) = jobs.by_id.get_mut(&word.errand.job) else { return };
        if seen.ticket() != Some(word.errand.ticket) {
            return;
        }
        let place = match word.errand.part {
            Part::Shard(shard) => shard,
            Part::Merge => seen.told.len() - 1,
        };
        if let Some(told) = seen.told.get_mut(place) {
            *told = (*told).max(word.millionths.min(WHOLE));
        }
        seen.heard = Instant::now();
    }

    /// A job as it stands, and what tells when that changes.
    pub(super) fn watch(&self, id: ArtifactId) -> Option<(View, watch::Receiver<()>)> {
        self.jobs().by_id.get(&id).map(|seen| (seen.view(id), seen.changes.subscribe()))
    }

    /// Views of jobs above `after` that `filter` takes.
    pub(super) fn above(
        &self,
        after: Option<ArtifactId>,
        limit: usize,
        takes: impl Fn(&View) -> bool,
    ) -> Vec<View> {
        let from = after.map_or(Bound::Unbounded, Bound::Excluded);
        let jobs = self.jobs();
        let views = jobs.by_id.range((from, Bound::Unbounded)).map(|(id, seen)| seen.view(*id));
        views.filter(takes).take(limit).collect()
    }

    /// Jobs that are not done.
    pub(super) fn unfinished(&self) -> usize {
        self.jobs().by_id.values().filter(|seen| seen.record.ending().is_none()).count()
    }

    /// Whether an order of a job still goes on.
    pub(super) fn goes_on(&self, id: ArtifactId, ticket: Ticket) -> bool {
        let jobs = self.jobs();
        let seen = jobs.by_id.get(&id);
        seen.is_some_and(|seen| seen.ticket() == Some(ticket) && seen.record.ending().is_none())
    }

    /// Tickets of jobs that are not done.
    pub(super) fn tickets(&self) -> Vec<Ticket> {
        let jobs = self.jobs();
        let unfinished = jobs.by_id.values().filter(|seen| seen.record.ending().is_none());
        unfinished.filter_map(Seen::ticket).collect()
    }

    /// Jobs that are not done and of which nothing was heard for so long.
    pub(super) fn silent_for(&self, time: Duration) -> Vec<ArtifactId> {
        let jobs = self.jobs();
        let silent = jobs
            .by_id
            .iter()
            .filter(|(_, seen)| seen.record.ending().is_none() && seen.heard.elapsed() > time);
        silent.map(|(id, _)| *id).collect()
    }

    /// Ids of jobs that ended before `oldest`.
    pub(super) fn ended_before(&self, oldest: SystemTime) -> Vec<ArtifactId> {
        let jobs = self.jobs();
        let old = jobs
            .by_id
            .iter()
            .filter(|(_, seen)| seen.record.ended().is_some_and(|ended| ended < oldest));
        old.map(|(id, _)| *id).collect()
    }
}
