//! Jobs: work that outlives its call, in shards on threads of its own, written down before it is
//! acknowledged.
//!
//! A job has the id of what it makes, so the same problem is the same job. Every change of a job
//! that its callers could have been told of is in the store first; a node that is killed goes on,
//! when it starts again, with what was not done. Threads take shards of all jobs in turn, so that
//! a long job does not hold up a short one.

mod board;
mod record;
mod requests;
mod threads;

use std::{
    fmt::Debug,
    io,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant, SystemTime},
};

use bytes::Bytes;
use tokio::sync::watch;
use vbar_guidance::Budget;

use super::{Code, Error};
use crate::{
    store::{Ledger, Store},
    telemetry::{Metrics, OutcomeLabels},
    wire::{ArtifactId, Failure, NoArtifact, OperationFilter, Progress},
};
use board::{Board, Job};
use record::JobRecord;
use requests::Requests;

/// What a job does.
pub(super) trait Work: Debug + Send + Sync + 'static {
    /// Part of its product.
    type Shard: Send;

    /// Name of the method.
    fn method(&self) -> &'static str;

    /// Whether what it makes is there already.
    fn is_made(&self) -> bool;

    /// Number of shards, at least 1.
    fn shards(&self) -> usize;

    /// Computes one shard.
    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<Self::Shard, Stopped>;

    /// Puts the shards, in their order, together and keeps what comes of them.
    fn finish(&self, shards: Vec<Self::Shard>, budget: Budget<'_>) -> Result<(), Stopped>;
}

/// Why a job did not make what it should.
#[derive(Debug)]
pub(super) enum Stopped {
    /// It cannot be made.
    Infeasible(NoArtifact),
    /// It was not made.
    Failed(Failure),
}

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Ending {
    /// What it made stands on its shelf.
    Made,
    /// It cannot be made.
    Infeasible(NoArtifact),
    /// It was not made.
    Failed(Failure),
    /// Somebody asked for it.
    Cancelled,
}

impl Ending {
    /// In the count of jobs.
    fn outcome(&self) -> &'static str {
        match self {
            Self::Made => "succeeded",
            Self::Infeasible(_) => "infeasible",
            Self::Failed(_) => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

impl From<Stopped> for Ending {
    fn from(stopped: Stopped) -> Self {
        match stopped {
            Stopped::Infeasible(why) => Self::Infeasible(why),
            Stopped::Failed(failure) => Self::Failed(failure),
        }
    }
}

/// Bounds of a node's jobs.
#[derive(Debug, Clone, Copy)]
pub(super) struct JobLimits {
    /// Shards at once.
    pub(super) threads: usize,
    /// Jobs that are not done; more are refused.
    pub(super) unfinished_max: usize,
    /// Longest run of one job.
    pub(super) time_max: Duration,
    /// How often a job is begun before it is given up.
    pub(super) attempts_max: u32,
    /// How long a finished job is remembered.
    pub(super) kept_for: Duration,
}

/// What is asked for.
#[derive(Debug)]
pub(super) struct Order<W> {
    /// Names what is to be made.
    pub(super) id: ArtifactId,
    /// What to do.
    pub(super) work: W,
    /// What [`Jobs::open`] makes the work of again.
    pub(super) problem: Bytes,
    /// The caller's own name for it.
    pub(super) request_id: Option<String>,
}

/// A job as it stands.
#[derive(Debug, Clone)]
pub(super) struct View {
    /// How far it has come.
    pub(super) progress: Progress,
    /// How it ended, if it did.
    pub(super) ending: Option<Ending>,
}

/// The jobs of a node and the threads that do them.
#[derive(Debug)]
pub(super) struct Jobs<W: Work> {
    inner: Arc<Inner<W>>,
    /// Set when nobody should wait any longer.
    closing: watch::Sender<bool>,
}

#[derive(Debug)]
struct Inner<W: Work> {
    store: Arc<dyn Store>,
    limits: JobLimits,
    metrics: Arc<Metrics>,
    board: Mutex<Board<W>>,
    /// There may be a shard to compute.
    ready: Condvar,
    /// Held from the decision that a job changes until the store knows it. Never taken while the
    /// board is held: callers that only look must not wait for a disk.
    journal: Mutex<Requests>,
}

impl<W: Work> Jobs<W> {
    /// Reads what the store remembers, queues what was not done, and starts the threads.
    /// `restore` makes the work of a recorded problem again.
    ///
    /// # Errors
    /// If the store cannot be read or the system gives no thread.
    pub(super) fn open(
        store: Arc<dyn Store>,
        limits: JobLimits,
        metrics: Arc<Metrics>,
        restore: impl Fn(ArtifactId, &[u8]) -> Result<W, Failure>,
    ) -> io::Result<Self> {
        let requests = Requests::open(&*store).map_err(io::Error::other)?;
        let inner = Arc::new(Inner {
            store,
            limits,
            metrics,
            board: Mutex::default(),
            ready: Condvar::new(),
            journal: Mutex::new(requests),
        });
        inner.recover(restore).map_err(io::Error::other)?;
        threads::start(&inner)?;
        Ok(Self { inner, closing: watch::Sender::new(false) })
    }

    /// Takes an order: joins the job that does it already, answers with the one that did it, or
    /// writes down a new one. A job that failed or was cancelled is started afresh, unless the
    /// order repeats the request that it came with. Blocks on the store.
    ///
    /// # Errors
    /// `ALREADY_EXISTS` for a request id that came with another problem, `RESOURCE_EXHAUSTED` if
    /// too many jobs are not done, `UNAVAILABLE` while the node ends or the store does not answer.
    pub(super) fn submit(&self, order: Order<W>) -> Result<View, Error> {
        let Order { id, work, problem, request_id } = order;
        let is_made = work.is_made();
        let inner = &*self.inner;
        let mut requests = inner.journal();
        let is_repeated = match &request_id {
            None => false,
            Some(request_id) => requests.note(&*inner.store, request_id, id)?,
        };
        let replaced = {
            let board = inner.board();
            if board.is_closed() {
                return Err(shutting_down());
            }
            let there = board.job(&id);
            let stays = |job: &Job<W>| match job.ending() {
                None | Some(Ending::Made | Ending::Infeasible(_)) => true,
                Some(Ending::Failed(_) | Ending::Cancelled) => is_repeated,
            };
            if let Some(job) = there.filter(|job| stays(job)) {
                inner.count("joined");
                return Ok(job.view());
            }
            if !is_made && board.unfinished() >= inner.limits.unfinished_max {
                return Err(queue_full(board.unfinished()));
            }
            there.map_or(0, Job::revision)
        };
        let shards = work.shards();
        let mut record = JobRecord::new(work.method(), shards, problem);
        if is_made {
            record.end(shards, Ending::Made);
        }
        let revision = inner.store.write(Ledger::Jobs, &id.0, record.encode().into(), replaced)?;
        inner.count("accepted");
        let mut board = inner.board();
        board.place(id, Job::new(id, record, revision, work));
        inner.metrics.jobs_unfinished.set(gauge(board.unfinished()));
        inner.ready.notify_all();
        board.job(&id).map(Job::view).ok_or_else(|| unknown(id))
    }

    /// A job as it stands.
    ///
    /// # Errors
    /// `NOT_FOUND`.
    pub(super) fn view(&self, id: ArtifactId) -> Result<View, Error> {
        self.inner.board().job(&id).map(Job::view).ok_or_else(|| unknown(id))
    }

    /// A job as it stands, and what tells when that changes.
    ///
    /// # Errors
    /// `NOT_FOUND`.
    pub(super) fn watch(&self, id: ArtifactId) -> Result<(View, watch::Receiver<()>), Error> {
        // Both under one lock: no change falls between them.
        let board = self.inner.board();
        board.job(&id).map(|job| (job.view(), job.changes())).ok_or_else(|| unknown(id))
    }

    /// A job once it is done, or as it stands at `until` or when the node ends.
    ///
    /// # Errors
    /// `NOT_FOUND`, also if it is deleted meanwhile.
    pub(super) async fn wait(&self, id: ArtifactId, until: Instant) -> Result<View, Error> {
        loop {
            let (view, mut changes) = self.watch(id)?;
            if view.ending.is_some() {
                return Ok(view);
            }
            tokio::select! {
                _ = changes.changed() => {}
                () = tokio::time::sleep_until(until.into()) => return self.view(id),
                () = self.closed() => return self.view(id),
            }
        }
    }

    /// Comes when the node ends.
    pub(super) async fn closed(&self) {
        // It fails only once the sender is gone, and then the node has ended too.
        let _ = self.closing.subscribe().wait_for(|closing| *closing).await;
    }

    /// Up to `limit` jobs above `after` that `filter` takes, ordered by id.
    pub(super) fn list(
        &self,
        filter: &OperationFilter,
        after: Option<ArtifactId>,
        limit: usize,
    ) -> Vec<View> {
        let board = self.inner.board();
        let wanted = board.above(after).map(Job::view);
        wanted.filter(|view| filter.takes(view.progress.standing)).take(limit).collect()
    }

    /// Ends a job that is not done; one that is stays as it is. Blocks on the store.
    ///
    /// # Errors
    /// `NOT_FOUND`; `UNAVAILABLE` if the store does not answer: the job then goes on.
    pub(super) fn cancel(&self, id: ArtifactId) -> Result<(), Error> {
        self.view(id)?;
        self.inner.end(id, None, Ending::Cancelled).map_err(Error::from)
    }

    /// Forgets a job that is done. Blocks on the store.
    ///
    /// # Errors
    /// `NOT_FOUND`; `FAILED_PRECONDITION` if it is not done.
    pub(super) fn delete(&self, id: ArtifactId) -> Result<(), Error> {
        let _journal = self.inner.journal();
        let revision = {
            let board = self.inner.board();
            let job = board.job(&id).ok_or_else(|| unknown(id))?;
            if job.ending().is_none() {
                let message = format!("operation operations/{id} is under way; cancel it first");
                return Err(Error::new(Code::FailedPrecondition, "OPERATION_RUNNING", message));
            }
            job.revision()
        };
        self.inner.store.erase(Ledger::Jobs, &id.0, revision)?;
        self.inner.board().remove(&id);
        Ok(())
    }

    /// Forgets jobs and request ids that were kept long enough. Blocks on the store.
    pub(super) fn sweep(&self, now: SystemTime) {
        let oldest = now.checked_sub(self.inner.limits.kept_for).unwrap_or(SystemTime::UNIX_EPOCH);
        let old = self.inner.board().ended_before(oldest);
        for id in old {
            if let Err(error) = self.delete(id) {
                tracing::warn!(%id, ?error, "forgetting a finished job");
            }
        }
        self.inner.journal().sweep(&*self.inner.store, oldest);
    }

    /// Stops the threads, hands back what they were at so that the next start takes it up, and
    /// lets nobody wait any longer. Blocks on the store.
    pub(super) fn stop(&self) {
        self.closing.send_replace(true);
        self.inner.stop();
    }
}

impl<W: Work> Drop for Jobs<W> {
    fn drop(&mut self) {
        self.inner.board().close();
        self.inner.ready.notify_all();
    }
}

impl<W: Work> Inner<W> {
    /// No code that holds the lock can leave the board half changed.
    fn board(&self) -> MutexGuard<'_, Board<W>> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn journal(&self) -> MutexGuard<'_, Requests> {
        self.journal.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn count(&self, outcome: &'static str) {
        self.metrics.jobs.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// Puts what the store remembers on the board.
    fn recover(
        &self,
        restore: impl Fn(ArtifactId, &[u8]) -> Result<W, Failure>,
    ) -> Result<(), crate::store::StoreError> {
        let mut found = Vec::new();
        for id in self.store.entries(Ledger::Jobs)? {
            let read = self.store.read(Ledger::Jobs, &id).map_err(|fault| fault.to_string());
            let id = ArtifactId(id);
            let decoded = read.and_then(|entry| {
                let entry = entry.ok_or("it was erased meanwhile")?;
                Ok((JobRecord::decode(&entry.bytes)?, entry.revision))
            });
            match decoded {
                Ok((record, revision)) => found.push((id, record, revision)),
                // One unreadable entry must not keep a node from its other work.
                Err(fault) => tracing::error!(%id, fault, "a job's entry cannot be used"),
            }
        }
        found.sort_by_key(|(id, record, _)| (record.created(), *id));
        for (id, mut record, revision) in found {
            if record.ending().is_some() {
                self.board().place(id, Job::finished(id, record, revision));
                continue;
            }
            let outcome = if record.attempts() < self.limits.attempts_max {
                restore(id, record.problem())
            } else {
                Err(given_up(record.attempts()))
            };
            let ending = match outcome {
                // The node ended between the product and the note of it.
                Ok(work) if work.is_made() => Ending::Made,
                Ok(work) => {
                    record.hand_back();
                    self.count("resumed");
                    self.board().place(id, Job::new(id, record, revision, work));
                    continue;
                }
                Err(failure) => {
                    tracing::error!(%id, message = failure.message, "a job is not taken up again");
                    Ending::Failed(failure)
                }
            };
            self.count(ending.outcome());
            record.end(record.shards_done(), ending);
            let bytes = record.encode().into();
            let revision = self.store.write(Ledger::Jobs, &id.0, bytes, revision)?;
            self.board().place(id, Job::finished(id, record, revision));
        }
        self.metrics.jobs_unfinished.set(gauge(self.board().unfinished()));
        Ok(())
    }

    /// Ends a job, unless it is done already. A thread names the run it belongs to: the job may
    /// have been cancelled and started afresh since.
    fn end(
        &self,
        id: ArtifactId,
        run: Option<&board::RunKey>,
        ending: Ending,
    ) -> Result<(), crate::store::StoreError> {
        let _journal = self.journal();
        let Some((mut record, revision)) = self.board().unfinished_record(&id, run) else {
            return Ok(());
        };
        let outcome = ending.outcome();
        record.end(record.shards_done(), ending);
        let written = self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision);
        let revision = match (written, run) {
            (Ok(revision), _) => revision,
            (Err(fault), None) => return Err(fault),
            // What was computed stays computed; after a restart it is found, or computed again.
            (Err(fault), Some(_)) => {
                tracing::error!(%id, %fault, "the end of a job could not be written down");
                revision
            }
        };
        let mut board = self.board();
        board.settle(&id, record, revision);
        self.metrics.jobs_unfinished.set(gauge(board.unfinished()));
        drop(board);
        self.count(outcome);
        Ok(())
    }

    fn stop(&self) {
        let _journal = self.journal();
        let running = {
            let mut board = self.board();
            board.close();
            board.hand_back()
        };
        self.ready.notify_all();
        for (id, record, revision) in running {
            match self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision) {
                Ok(revision) => self.board().set_revision(&id, revision),
                Err(fault) => tracing::error!(%id, %fault, "a job could not be handed back"),
            }
        }
    }
}

fn gauge(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

fn unknown(id: ArtifactId) -> Error {
    let message = format!("operation operations/{id} is not known");
    Error::new(Code::NotFound, "OPERATION_UNKNOWN", message)
}

fn shutting_down() -> Error {
    Error::new(Code::Unavailable, "SHUTTING_DOWN", "the server is shutting down")
}

fn queue_full(unfinished: usize) -> Error {
    const RETRY_AFTER: Duration = Duration::from_secs(5);
    let message = format!("{unfinished} operations are not done, and no more may be");
    Error {
        retry_after: Some(RETRY_AFTER),
        ..Error::new(Code::ResourceExhausted, "QUEUE_FULL", message)
    }
}

/// Whatever ends the process each time must not end it for ever.
fn given_up(attempts: u32) -> Failure {
    let message = format!("the server ended {attempts} times while it was at this operation");
    Error::new(Code::Internal, "GIVEN_UP", message).into()
}

#[cfg(test)]
mod tests;
