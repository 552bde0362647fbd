//! The threads that do parts of jobs, and the one that keeps hold of what they are at.

use std::{
    io,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use vbar_guidance::{Budget, Interruption, Progress, budget::Question};

use super::{Errand, Inner, JobRecord, Part, Parts, WINDOW, Word, differs};
use crate::{
    compute::yield_to_steps,
    service::{
        Code, Error,
        jobs::{Ending, Stopped, Work, caught, given_up},
    },
    store::{Lease, Leased, Shelf, StoreError},
    wire::{Failure, Unread},
};

/// A part that a thread is at.
#[derive(Debug)]
pub(super) struct Hold {
    pub(super) errand: Errand,
    lease: Box<dyn Lease>,
    stop: Arc<AtomicBool>,
    millionths: AtomicU32,
    /// When the lease was renewed last.
    renewed: Mutex<Instant>,
}

impl Hold {
    /// Nobody needs the part any more, or somebody else is to do it.
    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn tell(&self, progress: Progress) {
        const WHOLE: u64 = 1_000_000;
        let (done, total) = (progress.done as u64, progress.total.max(1) as u64);
        let millionths = (done.saturating_mul(WHOLE) / total).min(WHOLE);
        self.millionths.fetch_max(u32::try_from(millionths).unwrap_or(0), Ordering::Relaxed);
    }
}

/// What becomes of a task.
enum Attended {
    /// Nobody needs it any more.
    Done,
    /// Somebody else should do it.
    HandBack,
}

/// What came of a part.
enum Came {
    /// It is done.
    Done,
    /// It ends the whole job.
    End(Ending),
    /// The job has ended, or this node ends, or another has the lease.
    Nothing,
}

/// Starts the threads; they end when the fleet is closed.
pub(super) fn start<W: Work>(inner: &Arc<Inner<W>>) -> io::Result<Vec<JoinHandle<()>>> {
    let mut threads = Vec::new();
    for number in 0..inner.limits.threads {
        let inner = Arc::clone(inner);
        let name = format!("job-{number}");
        threads.push(thread::Builder::new().name(name).spawn(move || inner.work())?);
    }
    if !threads.is_empty() {
        let inner = Arc::clone(inner);
        let name = "job-leases".to_owned();
        threads.push(thread::Builder::new().name(name).spawn(move || inner.keep_hold())?);
    }
    Ok(threads)
}

impl<W: Work> Inner<W> {
    /// Body of a thread that does parts.
    fn work(&self) {
        const PATIENCE: Duration = Duration::from_secs(1);
        const REST: Duration = Duration::from_millis(500);
        yield_to_steps();
        while !self.is_closed() {
            match self.store.lease(PATIENCE) {
                Ok(None) => {}
                Ok(Some(leased)) => self.attend(leased),
                Err(fault) => {
                    tracing::debug!(%fault, "waiting for a task");
                    thread::sleep(REST);
                }
            }
        }
    }

    /// Body of the thread that renews leases and tells how far the others are.
    fn keep_hold(&self) {
        const LOOK_EVERY: Duration = Duration::from_millis(100);
        const TELL_EVERY: u32 = 10;
        let term = self.store.lease_term();
        for round in 1_u32.. {
            if self.is_closed() && self.holds().is_empty() {
                return;
            }
            let holds = self.holds().clone();
            for hold in holds {
                let renewed = *hold.renewed.lock().unwrap_or_else(PoisonError::into_inner);
                if renewed.elapsed() > term / 3 {
                    match hold.lease.renew() {
                        Ok(()) => {
                            *hold.renewed.lock().unwrap_or_else(PoisonError::into_inner) =
                                Instant::now();
                        }
                        Err(fault) if renewed.elapsed() > term => {
                            tracing::warn!(errand = ?hold.errand, %fault, "a lease is lost");
                            hold.stop();
                        }
                        Err(fault) => tracing::debug!(%fault, "renewing a lease"),
                    }
                }
                if round % TELL_EVERY == 0 {
                    let millionths = hold.millionths.load(Ordering::Relaxed);
                    self.store.tell(Word { errand: hold.errand, millionths }.encode());
                }
            }
            thread::sleep(LOOK_EVERY);
        }
    }

    fn attend(&self, leased: Leased) {
        let Leased { bytes, deliveries, lease } = leased;
        let Some(errand) = Errand::decode(&bytes) else {
            tracing::error!("a task that cannot be read is dropped");
            let _ = lease.done();
            return;
        };
        let hold = Arc::new(Hold {
            errand,
            lease,
            stop: Arc::new(AtomicBool::new(self.is_closed())),
            millionths: AtomicU32::new(0),
            renewed: Mutex::new(Instant::now()),
        });
        self.holds().push(Arc::clone(&hold));
        let attended = self.run(&hold, deliveries);
        self.holds().retain(|other| !Arc::ptr_eq(other, &hold));
        let told = match attended {
            Ok(Attended::Done) => hold.lease.done(),
            Ok(Attended::HandBack) => hold.lease.hand_back(),
            // The lease runs out and the task comes again, here or elsewhere.
            Err(fault) => {
                tracing::warn!(?errand, %fault, "a part of a job is put off");
                Ok(())
            }
        };
        if let Err(fault) = told {
            tracing::debug!(?errand, %fault, "a task will come again");
        }
    }

    fn run(&self, hold: &Hold, deliveries: u64) -> Result<Attended, StoreError> {
        let Errand { job, ticket, part } = hold.errand;
        let Some((record, revision)) = self.recorded(job)? else { return Ok(Attended::Done) };
        let is_same = record.parts().and_then(Parts::ticket) == Some(ticket);
        self.mirror.see(job, record.clone(), revision);
        if !is_same || record.ending().is_some() {
            return Ok(Attended::Done);
        }
        let end = |ending| self.end(job, ticket, ending).map(|()| Attended::Done);
        let begun = self.begin(hold, &record, deliveries)?;
        if begun > self.limits.attempts_max {
            let failure = given_up(self.limits.attempts_max);
            tracing::error!(%job, ?part, message = failure.message, "a job is given up");
            return end(Ending::Failed(failure));
        }
        let work = match self.restored(hold)? {
            Ok(work) => work,
            Err(failure) => return end(Ending::Failed(failure)),
        };
        // Whoever was at it before may have died between the product and the note of it.
        if deliveries > 1 && work.is_made()? {
            return end(Ending::Made);
        }
        let came = match part {
            Part::Shard(shard) => self.run_shard(hold, &record, &*work, shard)?,
            Part::Merge => self.run_merge(hold, &record, &*work)?,
        };
        match came {
            Came::Done => Ok(Attended::Done),
            Came::End(ending) => end(ending),
            Came::Nothing if self.is_closed() => {
                self.amend(job, ticket, |record| {
                    (deliveries > 1).then(|| record.parts_mut().map(|parts| parts.give_back(part)))
                })?;
                Ok(Attended::HandBack)
            }
            Came::Nothing => Ok(Attended::Done),
        }
    }

    /// Writes down that the job has begun, and how often this part was begun before it could end;
    /// the latter, with this time.
    fn begin(&self, hold: &Hold, record: &JobRecord, deliveries: u64) -> Result<u32, StoreError> {
        let Errand { job, ticket, part } = hold.errand;
        if deliveries <= 1 && record.started().is_some() {
            return Ok(1);
        }
        let begun = self.amend(job, ticket, |record| {
            if record.started().is_none() {
                record.begin();
            }
            let mut begun = 1;
            if deliveries > 1 {
                begun += record.parts_mut()?.begin_again(part);
                record.set_attempts(begun);
            }
            Some(begun)
        })?;
        Ok(begun.map_or(1, |(begun, _)| begun))
    }

    /// The work of an errand.
    fn restored(&self, hold: &Hold) -> Result<Result<Arc<W>, Failure>, StoreError> {
        let Errand { job, ticket, .. } = hold.errand;
        if let Some(work) = self.remembered(ticket) {
            return Ok(Ok(work));
        }
        let Some(problem) = self.store.get(Shelf::Problems, &ticket.problem())? else {
            let message = "its problem is gone from the store";
            return Ok(Err(Error::new(Code::DataLoss, "PROBLEM_LOST", message).into()));
        };
        Ok((self.restore)(job, &problem).map(|work| {
            let work = Arc::new(work);
            self.remember(ticket, Arc::clone(&work));
            work
        }))
    }

    /// Runs what may take long; `None` if it was stopped.
    fn long<T>(
        &self,
        hold: &Hold,
        record: &JobRecord,
        work: impl FnOnce(Budget<'_>) -> Result<T, Stopped>,
    ) -> Option<Result<T, Stopped>> {
        // How long it has run is read once, so that a clock that jumps meanwhile does not end it.
        let ran =
            record.started().and_then(|started| self.clock.behind().duration_since(started).ok());
        let left = self.limits.time_max.saturating_sub(ran.unwrap_or_default());
        let (begun, stop) = (Instant::now(), Arc::clone(&hold.stop));
        let ask: Question = Arc::new(move || {
            if stop.load(Ordering::Relaxed) {
                Some(Interruption::Cancelled)
            } else if begun.elapsed() >= left {
                Some(Interruption::Deadline)
            } else {
                None
            }
        });
        let tell = |progress: Progress| hold.tell(progress);
        let done = caught(|| work(Budget::new(&ask).telling(&tell)));
        (!hold.is_stopped() || done.is_ok()).then_some(done)
    }

    fn run_shard(
        &self,
        hold: &Hold,
        record: &JobRecord,
        work: &W,
        shard: usize,
    ) -> Result<Came, StoreError> {
        let Errand { job, ticket, .. } = hold.errand;
        let total = record.shards_total();
        if shard >= total {
            tracing::error!(%job, shard, total, "a task for a shard that does not exist");
            return Ok(Came::Done);
        }
        let place = ticket.shard(shard);
        if !self.store.contains(Shelf::Shards, &place)? {
            let start = Instant::now();
            let made = self.long(hold, record, |budget| {
                let made = work.run_shard(shard, budget)?;
                Ok(work.shard_to_bytes(&made))
            });
            self.metrics.job_shard_seconds.observe(start.elapsed().as_secs_f64());
            let bytes = match made {
                None => return Ok(Came::Nothing),
                Some(Err(stopped)) => return Ok(Came::End(stopped.into())),
                Some(Ok(bytes)) => bytes,
            };
            let put = self.store.put_if_absent(Shelf::Shards, &place, bytes.clone().into())?;
            if differs(&put, &bytes) {
                self.metrics.artifact_conflicts.inc();
                let error = Error::internal("SHARD_CONFLICT", &format!("{shard} of job {job}"));
                return Ok(Came::End(Ending::Failed(error.into())));
            }
        }
        let noted = self.amend(job, ticket, |record| {
            let parts = record.parts_mut()?;
            parts.set_done(shard, true);
            let done = parts.count_done();
            record.set_shards_done(done);
            Some(done == total)
        })?;
        let next = match noted {
            None => None,
            Some((true, record)) => Some((Part::Merge, record)),
            Some((false, record)) => {
                (shard + WINDOW < total).then_some((Part::Shard(shard + WINDOW), record))
            }
        };
        if let Some((part, record)) = next {
            let round = record.parts().map_or(0, Parts::round);
            self.store.queue(Errand { job, ticket, part }.task(round))?;
        }
        Ok(Came::Done)
    }

    fn run_merge(&self, hold: &Hold, record: &JobRecord, work: &W) -> Result<Came, StoreError> {
        let mut shards = Vec::with_capacity(record.shards_total());
        for shard in 0..record.shards_total() {
            let bytes = match self.store.get(Shelf::Shards, &hold.errand.ticket.shard(shard)) {
                Ok(Some(bytes)) => Ok(bytes),
                Ok(None) => Err("it is gone".to_owned()),
                Err(fault @ StoreError::Damaged { .. }) => Err(fault.to_string()),
                Err(fault) => return Err(fault),
            };
            // How the job ends if it is read no further is what its budget says.
            let read = |budget: Budget<'_>| match &bytes {
                Ok(bytes) => match work.shard_from_bytes(bytes, budget) {
                    Ok(shard) => Ok(Ok(shard)),
                    Err(Unread::Damaged(what)) => Ok(Err(what)),
                    Err(Unread::Interrupted(why)) => Err(Stopped::Failed(interrupted(why))),
                },
                Err(what) => Ok(Err(what.clone())),
            };
            match self.long(hold, record, read) {
                None => return Ok(Came::Nothing),
                Some(Err(stopped)) => return Ok(Came::End(stopped.into())),
                Some(Ok(Ok(read))) => shards.push(read),
                Some(Ok(Err(what))) => return self.make_again(hold, shard, &what),
            }
        }
        Ok(match self.long(hold, record, |budget| work.finish(shards, budget)) {
            None => Came::Nothing,
            Some(Ok(())) => Came::End(Ending::Made),
            // What was merged could not be stored: it is merged again when the store answers.
            Some(Err(Stopped::Failed(failure))) if failure.is_unavailable() => {
                return Err(StoreError::Unreachable(failure.message));
            }
            Some(Err(stopped)) => Came::End(stopped.into()),
        })
    }

    /// A shard cannot be used: it is made again, and the merge comes after it.
    fn make_again(&self, hold: &Hold, shard: usize, what: &str) -> Result<Came, StoreError> {
        let Errand { job, ticket, .. } = hold.errand;
        tracing::error!(%job, shard, what, "a shard cannot be used");
        self.store.remove(Shelf::Shards, &ticket.shard(shard))?;
        let undone = self.amend(job, ticket, |record| {
            let parts = record.parts_mut()?;
            parts.set_done(shard, false);
            let done = parts.count_done();
            let round = parts.next_round();
            record.set_shards_done(done);
            Some(round)
        })?;
        if let Some((round, _)) = undone {
            let part = Part::Shard(shard);
            self.store.queue(Errand { job, ticket, part }.task(round))?;
        }
        Ok(Came::Done)
    }
}

fn interrupted(why: Interruption) -> Failure {
    Error::from(vbar_guidance::control::Failure::from(why)).into()
}
