//! The board: every job that is remembered, and whose turn it is.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::{Duration, Instant, SystemTime},
};

use tokio::sync::watch;

use super::{Ending, JobRecord, View, Work};
use crate::{store::Revision, wire::ArtifactId};

/// Names one run of a job; set when it is to stop.
pub(super) type RunKey = Arc<AtomicBool>;

/// Every job that is remembered.
#[derive(Debug)]
pub(super) struct Board<W: Work> {
    jobs: BTreeMap<ArtifactId, Job<W>>,
    /// Jobs with shards that nobody took; whose turn it is comes first.
    turns: VecDeque<ArtifactId>,
    unfinished: usize,
    closed: bool,
}

/// One job.
#[derive(Debug)]
pub(super) struct Job<W: Work> {
    id: ArtifactId,
    record: JobRecord,
    /// Of its entry in the store.
    revision: Revision,
    /// It ended, and the store does not know: it did not answer then.
    is_unwritten: bool,
    /// Until it is done.
    run: Option<Run<W>>,
    changes: watch::Sender<()>,
}

#[derive(Debug)]
struct Run<W: Work> {
    work: Arc<W>,
    key: RunKey,
    deadline: Option<Instant>,
    /// Shards taken so far; they are taken in order.
    taken: usize,
    shards: Shards<W>,
    told: Arc<Told>,
}

/// How far each shard, and last the merge, says it is; millionths.
#[derive(Debug)]
pub(super) struct Told(Vec<AtomicU32>);

impl Told {
    const WHOLE: u32 = 1_000_000;

    fn new(shards: usize) -> Self {
        Self((0..=shards).map(|_| AtomicU32::new(0)).collect())
    }

    pub(super) fn shard(&self, shard: usize, progress: vbar_guidance::Progress) {
        if let Some(part) = self.0.get(shard) {
            let (done, total) = (progress.done as u64, progress.total.max(1) as u64);
            let whole = u64::from(Self::WHOLE);
            let millionths = (done.saturating_mul(whole) / total).min(whole);
            // Of several phases the furthest counts: nobody likes a bar that goes back.
            part.fetch_max(u32::try_from(millionths).unwrap_or(Self::WHOLE), Ordering::Relaxed);
        }
    }

    pub(super) fn merge(&self, progress: vbar_guidance::Progress) {
        self.shard(self.0.len() - 1, progress);
    }

    /// Of everything; the merge counts as one more shard.
    fn fraction(&self) -> f64 {
        let parts = self.0.iter().map(|part| u64::from(part.load(Ordering::Relaxed)));
        parts.sum::<u64>() as f64 / (self.0.len() as f64 * f64::from(Self::WHOLE))
    }
}

/// Shards that are done, each in its place.
struct Shards<W: Work> {
    places: Vec<Option<W::Shard>>,
    done: usize,
}

impl<W: Work> std::fmt::Debug for Shards<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} of {} shards", self.done, self.places.len())
    }
}

/// One shard to compute.
#[derive(Debug)]
pub(super) struct Turn<W: Work> {
    pub(super) id: ArtifactId,
    pub(super) work: Arc<W>,
    pub(super) run: RunKey,
    pub(super) shard: usize,
    pub(super) told: Arc<Told>,
    pub(super) deadline: Instant,
    /// Nobody took a shard of this run before.
    pub(super) is_first: bool,
}

impl<W: Work> Job<W> {
    /// A job to do, or one that is done if its record says so.
    pub(super) fn new(id: ArtifactId, record: JobRecord, revision: Revision, work: W) -> Self {
        let run = record.ending().is_none().then(|| {
            let shards = work.shards().max(1);
            Run {
                work: Arc::new(work),
                key: RunKey::default(),
                deadline: None,
                taken: 0,
                shards: Shards { places: (0..shards).map(|_| None).collect(), done: 0 },
                told: Arc::new(Told::new(shards)),
            }
        });
        Self { id, record, revision, is_unwritten: false, run, changes: watch::Sender::new(()) }
    }

    /// A job that is done, as the store has it.
    pub(super) fn finished(id: ArtifactId, record: JobRecord, revision: Revision) -> Self {
        let changes = watch::Sender::new(());
        Self { id, record, revision, is_unwritten: false, run: None, changes }
    }

    /// The same job, whose end the store does not know.
    pub(super) fn unwritten(self) -> Self {
        Self { is_unwritten: true, ..self }
    }

    pub(super) fn revision(&self) -> Revision {
        self.revision
    }

    pub(super) fn ending(&self) -> Option<&Ending> {
        self.record.ending()
    }

    pub(super) fn changes(&self) -> watch::Receiver<()> {
        self.changes.subscribe()
    }

    /// As it stands.
    pub(super) fn view(&self) -> View {
        View::new(self.id, &self.record, self.run.as_ref().map(|run| run.told.fraction()))
    }
}

impl<W: Work> Default for Board<W> {
    fn default() -> Self {
        Self { jobs: BTreeMap::new(), turns: VecDeque::new(), unfinished: 0, closed: false }
    }
}

impl<W: Work> Board<W> {
    pub(super) fn job(&self, id: &ArtifactId) -> Option<&Job<W>> {
        self.jobs.get(id)
    }

    /// Jobs that are not done.
    pub(super) fn unfinished(&self) -> usize {
        self.unfinished
    }

    pub(super) fn is_closed(&self) -> bool {
        self.closed
    }

    /// Jobs with ids above `after`, in order.
    pub(super) fn above(&self, after: Option<ArtifactId>) -> impl Iterator<Item = &Job<W>> {
        let from = after.map_or(Bound::Unbounded, Bound::Excluded);
        self.jobs.range((from, Bound::Unbounded)).map(|(_, job)| job)
    }

    /// Ids of jobs that ended before `oldest`.
    pub(super) fn ended_before(&self, oldest: SystemTime) -> Vec<ArtifactId> {
        let old = |job: &&Job<W>| job.record.ended().is_some_and(|ended| ended < oldest);
        self.jobs.values().filter(old).map(|job| job.id).collect()
    }

    /// Puts a job on the board, in place of a finished one of the same id.
    pub(super) fn place(&mut self, id: ArtifactId, job: Job<W>) {
        if job.run.is_some() {
            self.turns.push_back(id);
            self.unfinished += 1;
        }
        self.jobs.insert(id, job);
    }

    /// Takes a finished job off the board.
    pub(super) fn remove(&mut self, id: &ArtifactId) {
        self.jobs.remove(id);
    }

    /// The next shard to compute. Its job goes to the end of the line, so that every job moves.
    pub(super) fn take(&mut self, time_max: Duration) -> Option<Turn<W>> {
        loop {
            let id = self.turns.pop_front()?;
            let Some(job) = self.jobs.get_mut(&id) else { continue };
            let Some(run) = &mut job.run else { continue };
            let is_first = run.taken == 0;
            if is_first {
                job.record.begin();
                job.changes.send_replace(());
            }
            let shard = run.taken;
            run.taken += 1;
            let turn = Turn {
                id,
                work: Arc::clone(&run.work),
                run: Arc::clone(&run.key),
                shard,
                told: Arc::clone(&run.told),
                deadline: *run.deadline.get_or_insert_with(|| Instant::now() + time_max),
                is_first,
            };
            if run.taken < run.shards.places.len() {
                self.turns.push_back(id);
            }
            return Some(turn);
        }
    }

    /// Takes in a shard; all of them, in their order, once they are complete.
    pub(super) fn deliver(&mut self, turn: &Turn<W>, shard: W::Shard) -> Option<Vec<W::Shard>> {
        let job = self.jobs.get_mut(&turn.id)?;
        let run = job.run.as_mut().filter(|run| Arc::ptr_eq(&run.key, &turn.run))?;
        let place = run.shards.places.get_mut(turn.shard)?;
        if place.replace(shard).is_none() {
            run.shards.done += 1;
            run.told.shard(turn.shard, vbar_guidance::Progress { done: 1, total: 1 });
        }
        job.record.set_shards_done(run.shards.done);
        job.changes.send_replace(());
        if run.shards.done < run.shards.places.len() {
            return None;
        }
        std::mem::take(&mut run.shards.places).into_iter().collect()
    }

    /// Record and revision of a job that is not done, if `run` (when given) is its present run.
    pub(super) fn unfinished_record(
        &self,
        id: &ArtifactId,
        run: Option<&RunKey>,
    ) -> Option<(JobRecord, Revision)> {
        let job = self.jobs.get(id)?;
        let present = job.run.as_ref()?;
        let same = run.is_none_or(|run| Arc::ptr_eq(run, &present.key));
        same.then(|| (job.record.clone(), job.revision))
    }

    /// Records of jobs that are done without the store's knowledge, with its revision of each.
    pub(super) fn unwritten(&self) -> Vec<(ArtifactId, JobRecord, Revision)> {
        let unwritten = self.jobs.values().filter(|job| job.is_unwritten);
        unwritten.map(|job| (job.id, job.record.clone(), job.revision)).collect()
    }

    /// Notes that the store knows all of a job.
    pub(super) fn written(&mut self, id: &ArtifactId, revision: Revision) {
        if let Some(job) = self.jobs.get_mut(id) {
            (job.revision, job.is_unwritten) = (revision, false);
        }
    }

    /// A job is done: its threads are told to stop, whoever waits is told to look. Without a
    /// revision the store does not know of it.
    pub(super) fn settle(&mut self, id: &ArtifactId, record: JobRecord, known: Option<Revision>) {
        let Some(job) = self.jobs.get_mut(id) else { return };
        job.record = record;
        job.is_unwritten = known.is_none();
        job.revision = known.unwrap_or(job.revision);
        if let Some(run) = job.run.take() {
            run.key.store(true, Ordering::Relaxed);
            self.unfinished -= 1;
        }
        job.changes.send_replace(());
        self.turns.retain(|waiting| waiting != id);
    }

    /// No turn is given any more, and those who have one are told to stop.
    pub(super) fn close(&mut self) {
        self.closed = true;
        for run in self.jobs.values().filter_map(|job| job.run.as_ref()) {
            run.key.store(true, Ordering::Relaxed);
        }
    }

    /// Records, as they should be written, of jobs that somebody was at. The board forgets their
    /// runs: nobody delivers to them any more.
    pub(super) fn hand_back(&mut self) -> Vec<(ArtifactId, JobRecord, Revision)> {
        let mut handed_back = Vec::new();
        for job in self.jobs.values_mut() {
            let Some(run) = &mut job.run else { continue };
            run.key = RunKey::new(AtomicBool::new(true));
            if job.record.started().is_some() {
                job.record.hand_back();
                job.record.uncount_attempt();
                handed_back.push((job.id, job.record.clone(), job.revision));
            }
            job.changes.send_replace(());
        }
        handed_back
    }
}
