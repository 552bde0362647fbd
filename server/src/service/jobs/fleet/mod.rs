//! The jobs of a store that many machines reach.
//!
//! Every node takes orders for all jobs; any node with threads for it, and every worker, does their
//! parts. A job's record is changed by whoever has seen its latest revision, so that two never
//! decide differently; its parts travel through the store's queue as ids, their results lie on the
//! store's shelves. All of it can happen twice and nothing comes of that: a shard has the same
//! bytes whoever makes it, and what is there already is not made again.
//!
//! Killed, anybody leaves at worst a lease that runs out. A job of which nothing is heard for two
//! leases is queued afresh by whoever notices first, which also mends a job that was recorded by
//! somebody who died before queueing it.

mod errands;
mod mirror;
mod parts;

use std::{
    io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant, SystemTime},
};

use tokio::sync::watch;

use super::{
    Ending, JobLimits, Jobs, Order, View, Work, gauge, queue_full, record::JobRecord,
    requests::Requests, running, shutting_down, stays, unknown, wait_for_end,
};
use crate::{
    service::{Error, clock::Clock},
    store::{Change, Ledger, Put, Revision, Shared, Shelf, StoreError},
    telemetry::{Metrics, OutcomeLabels},
    wire::{ArtifactId, Failure, OperationFilter},
};
use errands::Hold;
use mirror::Mirror;
pub(super) use parts::Parts;
use parts::{Errand, Part, Ticket, Word};
#[cfg(feature = "fuzzing")]
pub(super) use parts::{errand_rewritten, word_rewritten};

/// Tasks of one job in the queue at once: a long job does not hold up a short one by more.
const WINDOW: usize = 32;

/// The jobs of all nodes, and the threads of this one that do parts of them.
#[derive(Debug)]
pub(in crate::service) struct Fleet<W: Work> {
    inner: Arc<Inner<W>>,
    threads: Vec<JoinHandle<()>>,
    /// Set when nobody should wait any longer.
    closing: watch::Sender<bool>,
}

/// Makes the work of a recorded problem again.
pub(in crate::service) type Restore<W> =
    Box<dyn Fn(ArtifactId, &[u8]) -> Result<W, Failure> + Send + Sync>;

struct Inner<W: Work> {
    store: Arc<dyn Shared>,
    clock: Arc<Clock>,
    limits: JobLimits,
    metrics: Arc<Metrics>,
    restore: Restore<W>,
    mirror: Mirror,
    requests: Requests,
    /// Work whose shards were done here last, so that its problem is not read for each.
    recent: Mutex<Vec<(Ticket, Arc<W>)>>,
    /// What the threads are at.
    holds: Mutex<Vec<Arc<Hold>>>,
    closed: AtomicBool,
    tidied: Mutex<Instant>,
}

impl<W: Work> std::fmt::Debug for Inner<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Inner").field("store", &self.store).finish_non_exhaustive()
    }
}

impl<W: Work> Fleet<W> {
    /// Learns what jobs there are, and starts the threads. Blocks on the store.
    ///
    /// # Errors
    /// If the store cannot be read or the system gives no thread.
    pub(in crate::service) fn open(
        store: Arc<dyn Shared>,
        clock: Arc<Clock>,
        limits: JobLimits,
        metrics: Arc<Metrics>,
        restore: Restore<W>,
    ) -> io::Result<Self> {
        const TOLD_WITHIN: Duration = Duration::from_secs(10);
        let inner = Arc::new(Inner {
            store,
            clock,
            limits,
            metrics,
            restore,
            mirror: Mirror::default(),
            requests: Requests::default(),
            recent: Mutex::default(),
            holds: Mutex::default(),
            closed: AtomicBool::new(false),
            tidied: Mutex::new(Instant::now()),
        });
        let now = inner.clock.ahead();
        let learned = inner.requests.sweep(&*inner.store, SystemTime::UNIX_EPOCH, now);
        learned.map_err(io::Error::other)?;
        inner.listen();
        let until = Instant::now() + TOLD_WITHIN;
        while !inner.mirror.is_complete() {
            if Instant::now() >= until {
                return Err(io::Error::other("the store does not tell what jobs there are"));
            }
            thread::sleep(Duration::from_millis(5));
        }
        let threads = errands::start(&inner)?;
        Ok(Self { inner, threads, closing: watch::Sender::new(false) })
    }
}

impl<W: Work> Jobs<W> for Fleet<W> {
    fn submit(&self, order: Order<W>) -> Result<View, Error> {
        let Order { id, work, problem, request_id, is_made } = order;
        let inner = &*self.inner;
        if inner.is_closed() {
            return Err(shutting_down());
        }
        let is_repeated = match &request_id {
            None => false,
            Some(request_id) => {
                inner.requests.note(&*inner.store, request_id, id, inner.clock.ahead())?
            }
        };
        loop {
            let there = inner.store.read(Ledger::Jobs, &id.0)?;
            let replaced = there.as_ref().map_or(0, |entry| entry.revision);
            if let Some(record) = there.and_then(|entry| JobRecord::decode(&entry.bytes).ok())
                && stays(record.ending(), is_made, is_repeated)
            {
                inner.count("joined");
                inner.mirror.see(id, record, replaced);
                return self.seen(id);
            }
            let unfinished = inner.mirror.unfinished();
            if !is_made && unfinished >= inner.limits.unfinished_max {
                return Err(queue_full(unfinished));
            }
            let (ticket, shards) = (Ticket::fresh(), work.shards());
            let mut record = JobRecord::in_parts(work.method(), shards, Parts::new(ticket, shards));
            if is_made {
                record.end(shards, Ending::Made, inner.clock.ahead());
            } else {
                inner.store.put_if_absent(Shelf::Problems, &ticket.problem(), problem.clone())?;
            }
            let bytes = record.encode().into();
            match inner.store.write(Ledger::Jobs, &id.0, bytes, replaced) {
                Ok(revision) => inner.mirror.see(id, record.clone(), revision),
                // Another node took the same order just now.
                Err(StoreError::Stale { .. }) => {
                    inner.clear(ticket, 0);
                    continue;
                }
                Err(fault) => return Err(fault.into()),
            }
            inner.count("accepted");
            if !is_made {
                inner.remember(ticket, Arc::new(work));
                inner.queue_first(id, ticket, &record)?;
            }
            return self.seen(id);
        }
    }

    fn find(&self, id: ArtifactId) -> Result<(), Error> {
        if let Some((record, revision)) = self.inner.recorded(id)? {
            self.inner.mirror.see(id, record, revision);
        }
        Ok(())
    }

    fn watch(&self, id: ArtifactId) -> Result<(View, watch::Receiver<()>), Error> {
        self.inner.mirror.watch(id).ok_or_else(|| unknown(id))
    }

    fn list(&self, filter: &OperationFilter, after: Option<ArtifactId>, limit: usize) -> Vec<View> {
        self.inner.mirror.above(after, limit, |view| filter.takes(view.progress.standing))
    }

    fn cancel(&self, id: ArtifactId) -> Result<(), Error> {
        let there = self.inner.recorded(id)?;
        let (record, _) = there.ok_or_else(|| unknown(id))?;
        if let Some(ticket) = record.parts().and_then(Parts::ticket) {
            self.inner.end(id, ticket, Ending::Cancelled)?;
        }
        Ok(())
    }

    fn delete(&self, id: ArtifactId) -> Result<(), Error> {
        let inner = &*self.inner;
        let (record, revision) = inner.recorded(id)?.ok_or_else(|| unknown(id))?;
        if record.ending().is_none() {
            return Err(running(id));
        }
        inner.store.erase(Ledger::Jobs, &id.0, revision)?;
        inner.mirror.forget(id);
        Ok(())
    }

    fn sweep(&self) {
        let inner = &*self.inner;
        let now = inner.clock.behind();
        let oldest = now.checked_sub(inner.limits.kept_for).unwrap_or(SystemTime::UNIX_EPOCH);
        for id in inner.mirror.ended_before(oldest) {
            match self.delete(id) {
                Ok(()) => {}
                // Another node was faster.
                Err(error) if error.code == super::Code::NotFound => inner.mirror.forget(id),
                Err(error) => tracing::warn!(%id, ?error, "forgetting a finished job"),
            }
        }
        let swept = inner
            .requests
            .sweep(&*inner.store, oldest, inner.clock.ahead())
            .and_then(|()| inner.mend())
            .and_then(|()| inner.tidy(now));
        if let Err(fault) = swept {
            tracing::warn!(%fault, "sweeping jobs");
        }
    }

    fn stop(&self, grace: Duration) {
        self.closing.send_replace(true);
        self.inner.close();
        wait_for_end(&self.threads, grace);
    }

    fn closing(&self) -> watch::Receiver<bool> {
        self.closing.subscribe()
    }
}

impl<W: Work> Fleet<W> {
    fn seen(&self, id: ArtifactId) -> Result<View, Error> {
        self.watch(id).map(|(view, _)| view)
    }
}

impl<W: Work> Drop for Fleet<W> {
    fn drop(&mut self) {
        self.inner.close();
    }
}

impl<W: Work> Inner<W> {
    /// Is told by the store from now on.
    fn listen(self: &Arc<Self>) {
        let told = Arc::downgrade(self);
        self.store.follow(Ledger::Jobs, Box::new(move |change| Self::told(&told, change)));
        let hears = Arc::downgrade(self);
        self.store.hear(Box::new(move |word| {
            if let (Some(inner), Some(word)) = (hears.upgrade(), Word::decode(&word)) {
                inner.mirror.hear(word);
            }
        }));
    }

    fn told(inner: &Weak<Self>, change: Change) {
        let Some(inner) = inner.upgrade() else { return };
        inner.mirror.apply(change);
        inner.metrics.jobs_unfinished.set(gauge(inner.mirror.unfinished()));
        for hold in inner.holds().iter() {
            if !inner.mirror.goes_on(hold.errand.job, hold.errand.ticket) {
                hold.stop();
            }
        }
    }

    fn holds(&self) -> MutexGuard<'_, Vec<Arc<Hold>>> {
        self.holds.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Relaxed)
    }

    /// No part is begun any more, and those under way are stopped.
    fn close(&self) {
        self.closed.store(true, Ordering::Relaxed);
        self.holds().iter().for_each(|hold| hold.stop());
    }

    fn count(&self, outcome: &'static str) {
        self.metrics.jobs.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// Keeps work for the next shard.
    fn remember(&self, ticket: Ticket, work: Arc<W>) {
        const REMEMBERED: usize = 4;
        let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        recent.retain(|(other, _)| *other != ticket);
        recent.push((ticket, work));
        let too_many = recent.len().saturating_sub(REMEMBERED);
        recent.drain(..too_many);
    }

    fn remembered(&self, ticket: Ticket) -> Option<Arc<W>> {
        let recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        recent.iter().find(|(other, _)| *other == ticket).map(|(_, work)| Arc::clone(work))
    }

    /// A job's record in the store.
    fn recorded(&self, id: ArtifactId) -> Result<Option<(JobRecord, Revision)>, StoreError> {
        let Some(entry) = self.store.read(Ledger::Jobs, &id.0)? else { return Ok(None) };
        match JobRecord::decode(&entry.bytes) {
            Ok(record) => Ok(Some((record, entry.revision))),
            Err(fault) => {
                tracing::error!(%id, fault, "a job's entry cannot be used");
                Ok(None)
            }
        }
    }

    /// Changes the record of an order that is not done, however many others do so too; `None` if
    /// there is nothing to change any more, or `change` says so.
    fn amend<T>(
        &self,
        id: ArtifactId,
        ticket: Ticket,
        mut change: impl FnMut(&mut JobRecord) -> Option<T>,
    ) -> Result<Option<(T, JobRecord)>, StoreError> {
        loop {
            let Some((mut record, revision)) = self.recorded(id)? else { return Ok(None) };
            let is_same = record.parts().and_then(Parts::ticket) == Some(ticket);
            let changed =
                if is_same && record.ending().is_none() { change(&mut record) } else { None };
            let Some(changed) = changed else {
                self.mirror.see(id, record, revision);
                return Ok(None);
            };
            match self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision) {
                Ok(revision) => {
                    self.mirror.see(id, record.clone(), revision);
                    return Ok(Some((changed, record)));
                }
                Err(StoreError::Stale { .. }) => {}
                Err(fault) => return Err(fault),
            }
        }
    }

    /// Ends an order, unless it is done already, and clears away what lay there for it.
    fn end(&self, id: ArtifactId, ticket: Ticket, ending: Ending) -> Result<(), StoreError> {
        let outcome = ending.outcome();
        let ended = self.amend(id, ticket, |record| {
            record.end(record.shards_done(), ending.clone(), self.clock.ahead());
            Some(())
        })?;
        if let Some((_, record)) = ended {
            self.count(outcome);
            self.clear(ticket, record.shards_total());
        }
        Ok(())
    }

    /// Removes what lies in queue and shelves for an order. What cannot be removed now is found by
    /// [`Inner::tidy`].
    fn clear(&self, ticket: Ticket, shards: usize) {
        let clear = || -> Result<(), StoreError> {
            self.store.withdraw(&ticket.problem())?;
            for shard in 0..shards {
                self.store.remove(Shelf::Shards, &ticket.shard(shard))?;
            }
            self.store.remove(Shelf::Problems, &ticket.problem())
        };
        if let Err(fault) = clear() {
            tracing::warn!(%fault, "what lies there for a finished job stays for a while");
        }
    }

    /// Queues the first parts of a new order.
    fn queue_first(&self, id: ArtifactId, ticket: Ticket, record: &JobRecord) -> Result<(), Error> {
        match self.queue_missing(id, ticket, record) {
            Ok(()) => Ok(()),
            Err(StoreError::Full(why)) => {
                tracing::warn!(why, "the queue is full");
                if let Some((_, revision)) = self.recorded(id)? {
                    self.store.erase(Ledger::Jobs, &id.0, revision)?;
                    self.mirror.forget(id);
                }
                self.clear(ticket, 0);
                Err(queue_full(self.mirror.unfinished()))
            }
            // It is recorded, so it will be queued.
            Err(fault) => {
                tracing::warn!(%id, %fault, "a job is queued later");
                Ok(())
            }
        }
    }

    /// Queues what is to be done next: shards that are not done, or the merge.
    fn queue_missing(
        &self,
        job: ArtifactId,
        ticket: Ticket,
        record: &JobRecord,
    ) -> Result<(), StoreError> {
        let Some(parts) = record.parts() else { return Ok(()) };
        let missing = (0..record.shards_total()).filter(|&shard| !parts.is_done(shard));
        let mut next: Vec<_> = missing.take(WINDOW).map(Part::Shard).collect();
        if next.is_empty() {
            next.push(Part::Merge);
        }
        next.into_iter()
            .try_for_each(|part| self.store.queue(Errand { job, ticket, part }.task(parts.round())))
    }

    /// Queues afresh what may have been lost, and forgets what is gone.
    fn mend(&self) -> Result<(), StoreError> {
        for id in self.mirror.missing() {
            match self.recorded(id)? {
                Some((record, revision)) => self.mirror.see(id, record, revision),
                None => self.mirror.forget(id),
            }
        }
        for id in self.mirror.silent_for(2 * self.store.lease_term()) {
            let Some((record, _)) = self.recorded(id)? else {
                self.mirror.forget(id);
                continue;
            };
            let Some(ticket) = record.parts().and_then(Parts::ticket) else { continue };
            // Whoever writes the next round first queues it. All others see that and are silent.
            let before = record.parts().map_or(0, Parts::round);
            let claimed = self.amend(id, ticket, |record| {
                let parts = record.parts_mut()?;
                (parts.round() == before).then(|| parts.next_round())
            })?;
            if let Some((round, record)) = claimed {
                tracing::info!(%id, round, "a job of which nothing was heard is queued afresh");
                self.store.withdraw(&ticket.problem())?;
                self.queue_missing(id, ticket, &record)?;
            }
        }
        Ok(())
    }

    /// Now and then removes what those left on the shelves who were killed.
    fn tidy(&self, now: SystemTime) -> Result<(), StoreError> {
        const EVERY: Duration = Duration::from_secs(600);
        const LEFT_FOR: Duration = Duration::from_secs(1800);
        {
            let mut tidied = self.tidied.lock().unwrap_or_else(PoisonError::into_inner);
            if tidied.elapsed() < EVERY {
                return Ok(());
            }
            *tidied = Instant::now();
        }
        let oldest = now.checked_sub(LEFT_FOR).unwrap_or(SystemTime::UNIX_EPOCH);
        self.remove_left(oldest)?;
        self.store.tidy(oldest).map(|removed| {
            if removed > 0 {
                tracing::info!(removed, "removed bytes that no record names");
            }
        })
    }

    /// Removes problems and shards from before `oldest` that no job goes on with.
    fn remove_left(&self, oldest: SystemTime) -> Result<(), StoreError> {
        let needed = self.mirror.tickets();
        for shelf in [Shelf::Problems, Shelf::Shards] {
            for id in self.store.list(shelf, None, usize::MAX)? {
                let ticket = Ticket::of(&id);
                if ticket.drawn() < oldest && !needed.contains(&ticket) {
                    self.store.remove(shelf, &id)?;
                }
            }
        }
        Ok(())
    }
}

/// Whether the store holds other bytes than those just made.
fn differs(put: &Put, bytes: &[u8]) -> bool {
    matches!(put, Put::Existing(existing) if existing != bytes)
}

#[cfg(test)]
mod tests;
