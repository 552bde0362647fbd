//! The jobs of a store that one process has for itself.
//!
//! They lie on a board in memory, where threads take shards of all jobs in turn, so that a long job
//! does not hold up a short one. The store is read once, at the start, and then only written.

mod board;
mod threads;

use std::{
    io,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::JoinHandle,
    time::{Duration, SystemTime},
};

use tokio::sync::watch;

use super::{
    Ending, JobLimits, Jobs, Order, View, Work, gauge, given_up, queue_full, record::JobRecord,
    requests::Requests, running, shutting_down, stays, unknown, wait_for_end,
};
use crate::{
    service::{Error, clock::Clock},
    store::{Ledger, Store, StoreError},
    telemetry::{Metrics, OutcomeLabels},
    wire::{ArtifactId, Failure, OperationFilter},
};
use board::{Board, Job};

/// The jobs of a node and the threads that do them.
#[derive(Debug)]
pub(in crate::service) struct Single<W: Work> {
    inner: Arc<Inner<W>>,
    threads: Vec<JoinHandle<()>>,
    /// Set when nobody should wait any longer.
    closing: watch::Sender<bool>,
}

#[derive(Debug)]
struct Inner<W: Work> {
    store: Arc<dyn Store>,
    clock: Arc<Clock>,
    limits: JobLimits,
    metrics: Arc<Metrics>,
    board: Mutex<Board<W>>,
    /// There may be a shard to compute.
    ready: Condvar,
    /// Held from the decision that a job changes until the store knows it. Never taken while the
    /// board is held: callers that only look must not wait for a disk.
    journal: Mutex<()>,
    requests: Requests,
}

impl<W: Work> Single<W> {
    /// Reads what the store remembers, queues what was not done, and starts the threads.
    /// `restore` makes the work of a recorded problem again.
    ///
    /// # Errors
    /// If the store cannot be read or the system gives no thread.
    pub(in crate::service) fn open(
        store: Arc<dyn Store>,
        clock: Arc<Clock>,
        limits: JobLimits,
        metrics: Arc<Metrics>,
        restore: impl Fn(ArtifactId, &[u8]) -> Result<W, Failure>,
    ) -> io::Result<Self> {
        let requests = Requests::default();
        let learned = requests.sweep(&*store, SystemTime::UNIX_EPOCH, clock.ahead());
        learned.map_err(io::Error::other)?;
        let inner = Arc::new(Inner {
            store,
            clock,
            limits,
            metrics,
            board: Mutex::default(),
            ready: Condvar::new(),
            journal: Mutex::default(),
            requests,
        });
        inner.recover(restore).map_err(io::Error::other)?;
        let threads = threads::start(&inner)?;
        Ok(Self { inner, threads, closing: watch::Sender::new(false) })
    }
}

impl<W: Work> Jobs<W> for Single<W> {
    fn submit(&self, order: Order<W>) -> Result<View, Error> {
        let Order { id, work, problem, request_id, is_made } = order;
        let inner = &*self.inner;
        let _journal = inner.journal();
        let is_repeated = match &request_id {
            None => false,
            Some(request_id) => {
                inner.requests.note(&*inner.store, request_id, id, inner.clock.ahead())?
            }
        };
        let replaced = {
            let board = inner.board();
            if board.is_closed() {
                return Err(shutting_down());
            }
            let there = board.job(&id);
            if let Some(job) = there.filter(|job| stays(job.ending(), is_made, is_repeated)) {
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
            record.end(shards, Ending::Made, inner.clock.ahead());
        }
        let revision = inner.store.write(Ledger::Jobs, &id.0, record.encode().into(), replaced)?;
        inner.count("accepted");
        let mut board = inner.board();
        board.place(id, Job::new(id, record, revision, work));
        inner.metrics.jobs_unfinished.set(gauge(board.unfinished()));
        inner.ready.notify_all();
        board.job(&id).map(Job::view).ok_or_else(|| unknown(id))
    }

    /// Every job of the store is on the board.
    fn find(&self, _: ArtifactId) -> Result<(), Error> {
        Ok(())
    }

    fn watch(&self, id: ArtifactId) -> Result<(View, watch::Receiver<()>), Error> {
        // Both under one lock: no change falls between them.
        let board = self.inner.board();
        board.job(&id).map(|job| (job.view(), job.changes())).ok_or_else(|| unknown(id))
    }

    fn list(&self, filter: &OperationFilter, after: Option<ArtifactId>, limit: usize) -> Vec<View> {
        let board = self.inner.board();
        let wanted = board.above(after).map(Job::view);
        wanted.filter(|view| filter.takes(view.progress.standing)).take(limit).collect()
    }

    fn cancel(&self, id: ArtifactId) -> Result<(), Error> {
        self.watch(id)?;
        self.inner.end(id, None, Ending::Cancelled).map_err(Error::from)
    }

    fn delete(&self, id: ArtifactId) -> Result<(), Error> {
        let _journal = self.inner.journal();
        let revision = {
            let board = self.inner.board();
            let job = board.job(&id).ok_or_else(|| unknown(id))?;
            if job.ending().is_none() {
                return Err(running(id));
            }
            job.revision()
        };
        self.inner.store.erase(Ledger::Jobs, &id.0, revision)?;
        self.inner.board().remove(&id);
        Ok(())
    }

    fn sweep(&self) {
        let inner = &*self.inner;
        inner.write_down_ends();
        let kept_for = inner.limits.kept_for;
        let oldest = inner.clock.behind().checked_sub(kept_for).unwrap_or(SystemTime::UNIX_EPOCH);
        let old = inner.board().ended_before(oldest);
        for id in old {
            if let Err(error) = self.delete(id) {
                tracing::warn!(%id, ?error, "forgetting a finished job");
            }
        }
        if let Err(fault) = inner.requests.sweep(&*inner.store, oldest, inner.clock.ahead()) {
            tracing::warn!(%fault, "forgetting request ids");
        }
    }

    fn stop(&self, grace: Duration) {
        self.closing.send_replace(true);
        self.inner.stop();
        wait_for_end(&self.threads, grace);
    }

    fn closing(&self) -> watch::Receiver<bool> {
        self.closing.subscribe()
    }
}

impl<W: Work> Drop for Single<W> {
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

    fn journal(&self) -> MutexGuard<'_, ()> {
        self.journal.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn count(&self, outcome: &'static str) {
        self.metrics.jobs.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// Puts what the store remembers on the board.
    fn recover(
        &self,
        restore: impl Fn(ArtifactId, &[u8]) -> Result<W, Failure>,
    ) -> Result<(), StoreError> {
        let mut found = Vec::new();
        for id in self.store.entries(Ledger::Jobs)? {
            let entry = match self.store.read(Ledger::Jobs, &id) {
                Ok(Some(entry)) => entry,
                Ok(None) => continue,
                // Left there it would keep everybody from asking for the same again.
                Err(fault @ StoreError::Damaged { .. }) => {
                    tracing::error!(%fault, "a job is forgotten");
                    self.store.erase(Ledger::Jobs, &id, 0)?;
                    continue;
                }
                Err(fault) => return Err(fault),
            };
            let id = ArtifactId(id);
            match JobRecord::decode(&entry.bytes) {
                Ok(record) => found.push((id, record, entry.revision)),
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
                Ok(work) if work.is_made()? => Ending::Made,
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
            record.end(record.shards_done(), ending, self.clock.ahead());
            let written = self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision);
            // A full disk must not keep a node from starting; the next start finds the same.
            let job = match written {
                Ok(revision) => Job::finished(id, record, revision),
                Err(fault) => {
                    tracing::error!(%id, %fault, "the end of a job could not be written down");
                    Job::finished(id, record, revision).unwritten()
                }
            };
            self.board().place(id, job);
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
    ) -> Result<(), StoreError> {
        let _journal = self.journal();
        let Some((mut record, revision)) = self.board().unfinished_record(&id, run) else {
            return Ok(());
        };
        let outcome = ending.outcome();
        record.end(record.shards_done(), ending, self.clock.ahead());
        let written = self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision);
        let known = match (written, run) {
            (Ok(revision), _) => Some(revision),
            (Err(fault), None) => return Err(fault),
            // What was computed stays computed; it is written down when the store answers again.
            (Err(fault), Some(_)) => {
                tracing::error!(%id, %fault, "the end of a job could not be written down");
                None
            }
        };
        let mut board = self.board();
        board.settle(&id, record, known);
        self.metrics.jobs_unfinished.set(gauge(board.unfinished()));
        drop(board);
        self.count(outcome);
        Ok(())
    }

    /// Writes down the ends that the store did not take when they came.
    fn write_down_ends(&self) {
        let _journal = self.journal();
        let unwritten = self.board().unwritten();
        for (id, record, revision) in unwritten {
            match self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision) {
                Ok(revision) => self.board().written(&id, revision),
                Err(fault) => tracing::error!(%id, %fault, "a job's end is still not written down"),
            }
        }
    }

    fn stop(&self) {
        self.write_down_ends();
        let _journal = self.journal();
        let running = {
            let mut board = self.board();
            board.close();
            board.hand_back()
        };
        self.ready.notify_all();
        for (id, record, revision) in running {
            match self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision) {
                Ok(revision) => self.board().written(&id, revision),
                Err(fault) => tracing::error!(%id, %fault, "a job could not be handed back"),
            }
        }
    }
}
