//! Jobs: work that outlives its call, in shards on threads of its own, written down before it is
//! acknowledged.
//!
//! A job has the id of what it makes, so the same problem is the same job. Every change of a job
//! that its callers could have been told of is in the store first, but for an end that comes while
//! the store of a single process does not answer: that is written down by the next sweep that can,
//! and found or computed again if the process is killed before. And whoever is killed in the midst
//! of a job, others go on. [`Single`] does the jobs of a store that one process has for itself,
//! [`Fleet`] those of a store that many reach; to callers both are [`Jobs`].

#[cfg(test)]
mod fixture;
mod fleet;
#[cfg(test)]
mod laws;
mod record;
mod requests;
mod single;
#[cfg(feature = "fuzzing")]
pub(crate) mod stored;

use std::{
    fmt::Debug,
    panic::{AssertUnwindSafe, catch_unwind},
    thread::{self, JoinHandle},
    time::{Duration, Instant, SystemTime},
};

use bytes::Bytes;
use tokio::sync::watch;
use vbar_guidance::Budget;

use super::{Code, Error};
use crate::{
    compute::{ComputeError, panic_text},
    store::StoreError,
    wire::{ArtifactId, Failure, NoArtifact, OperationFilter, Progress, Unread},
};
pub(super) use fleet::Fleet;
use record::JobRecord;
pub(super) use single::Single;

/// What a job does.
pub(super) trait Work: Debug + Send + Sync + 'static {
    /// Part of its product.
    type Shard: Send;

    /// Name of the method.
    fn method(&self) -> &'static str;

    /// Whether what it makes is there already. May block on the store.
    fn is_made(&self) -> Result<bool, StoreError>;

    /// Number of shards, at least 1.
    fn shards(&self) -> usize;

    /// Computes one shard.
    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<Self::Shard, Stopped>;

    /// Its bytes, for another machine.
    fn shard_to_bytes(&self, shard: &Self::Shard) -> Vec<u8>;

    /// Reads what [`Work::shard_to_bytes`] wrote; whatever else it is given it refuses.
    fn shard_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Self::Shard, Unread>;

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
    /// What the work is made of again, by another process.
    pub(super) problem: Bytes,
    /// The caller's own name for it.
    pub(super) request_id: Option<String>,
    /// Whether it is there already, as [`Work::is_made`] said: the store is asked once.
    pub(super) is_made: bool,
}

/// A job as it stands.
#[derive(Debug, Clone)]
pub(super) struct View {
    /// How far it has come.
    pub(super) progress: Progress,
    /// How it ended, if it did.
    pub(super) ending: Option<Ending>,
}

impl View {
    fn new(id: ArtifactId, record: &JobRecord, fraction: Option<f64>) -> Self {
        let progress = Progress {
            id,
            method: record.method().to_owned(),
            standing: record.standing(),
            shards_done: record.shards_done(),
            shards_total: record.shards_total(),
            fraction,
            attempts: record.attempts(),
            created: record.created(),
            started: record.started(),
            ended: record.ended(),
            seen: SystemTime::now(),
        };
        Self { progress, ending: record.ending().cloned() }
    }
}

/// The jobs that a node takes orders for.
pub(super) trait Jobs<W: Work>: Debug + Send + Sync {
    /// Takes an order: joins the job that does it already, answers with the one that did it, or
    /// writes down a new one. A job that failed or was cancelled is started afresh, unless the
    /// order repeats the request that it came with. Blocks on the store.
    ///
    /// # Errors
    /// `ALREADY_EXISTS` for a request id that came with another problem, `RESOURCE_EXHAUSTED` if
    /// too many jobs are not done, `UNAVAILABLE` while the node ends or the store does not answer.
    fn submit(&self, order: Order<W>) -> Result<View, Error>;

    /// Looks in the store for a job that this node does not know of yet. Blocks on the store.
    ///
    /// # Errors
    /// `UNAVAILABLE` if the store does not answer.
    fn find(&self, id: ArtifactId) -> Result<(), Error>;

    /// A job as it stands, and what tells when that changes.
    ///
    /// # Errors
    /// `NOT_FOUND`.
    fn watch(&self, id: ArtifactId) -> Result<(View, watch::Receiver<()>), Error>;

    /// Up to `limit` jobs above `after` that `filter` takes, ordered by id.
    fn list(&self, filter: &OperationFilter, after: Option<ArtifactId>, limit: usize) -> Vec<View>;

    /// Ends a job that is not done; one that is stays as it is. Blocks on the store.
    ///
    /// # Errors
    /// `NOT_FOUND`; `UNAVAILABLE` if the store does not answer: the job then goes on.
    fn cancel(&self, id: ArtifactId) -> Result<(), Error>;

    /// Forgets a job that is done. Blocks on the store.
    ///
    /// # Errors
    /// `NOT_FOUND`; `FAILED_PRECONDITION` if it is not done.
    fn delete(&self, id: ArtifactId) -> Result<(), Error>;

    /// Forgets jobs and request ids that were kept long enough, and mends what those left who were
    /// killed. Blocks on the store.
    fn sweep(&self);

    /// Stops the threads, hands back what they were at so that others take it up, and lets nobody
    /// wait any longer. Blocks on the store, and until the threads have let go of it but no longer
    /// than `grace`.
    fn stop(&self, grace: Duration);

    /// Says when nobody should wait any longer.
    fn closing(&self) -> watch::Receiver<bool>;
}

impl<W: Work> dyn Jobs<W> {
    /// A job as it stands.
    ///
    /// # Errors
    /// `NOT_FOUND`.
    pub(super) fn view(&self, id: ArtifactId) -> Result<View, Error> {
        self.watch(id).map(|(view, _)| view)
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
        let _ = self.closing().wait_for(|closing| *closing).await;
    }
}

/// Whether an order is answered with the job that is there already: `ending` is how that one
/// ended, if it did.
fn stays(ending: Option<&Ending>, is_made: bool, is_repeated: bool) -> bool {
    match ending {
        None | Some(Ending::Infeasible(_)) => true,
        // What it made can have expired since.
        Some(Ending::Made) => is_made,
        Some(Ending::Failed(_) | Ending::Cancelled) => is_repeated,
    }
}

/// Gives threads that were told to end the time to do so.
fn wait_for_end(threads: &[JoinHandle<()>], grace: Duration) {
    const LOOK_EVERY: Duration = Duration::from_millis(5);
    let until = Instant::now() + grace;
    while threads.iter().any(|thread| !thread.is_finished()) && Instant::now() < until {
        thread::sleep(LOOK_EVERY);
    }
}

/// A panic is one failed job: it is repeated exactly whenever the job is.
fn caught<T>(work: impl FnOnce() -> Result<T, Stopped>) -> Result<T, Stopped> {
    // Nothing survives a panic but the message: shards are only read, and a job that ends so
    // delivers nothing.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let error = Error::from(ComputeError::Panicked(panic_text(&*panic)));
        Err(Stopped::Failed(error.into()))
    })
}

fn gauge(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

fn unknown(id: ArtifactId) -> Error {
    let message = format!("operation operations/{id} is not known");
    Error::new(Code::NotFound, "OPERATION_UNKNOWN", message)
}

fn running(id: ArtifactId) -> Error {
    let message = format!("operation operations/{id} is under way; cancel it first");
    Error::new(Code::FailedPrecondition, "OPERATION_RUNNING", message)
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
