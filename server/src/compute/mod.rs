//! Compute threads: a fixed number of computations at once, each with a budget.
//!
//! A call gets a thread now, or after a short and bounded wait, or is told at once when to come
//! back; there is no hidden queue. The wait exists because a step takes a tenth of a millisecond:
//! to refuse the third of three calls that arrive together would cost its caller far more. Who
//! waits, and in which order, is for the [`line`].
//!
//! Each [`Lane`] has threads of its own. A step never waits for a plan: it has its own line, and
//! the threads of plans yield the processors to it (on Linux they run at a lower priority, about a
//! sixth of a step's share, so that plans go on too). Threads that wait for a disk hold up neither.
//!
//! Own threads, not the runtime's: a computation in place on a runtime worker could not notice
//! that its caller has gone, and would hold up every connection that the worker serves.

mod line;

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use tokio::sync::oneshot;
use vbar_guidance::{Budget, Interruption, Method, budget::Question};

use crate::telemetry::{LaneLabels, MethodLabels, Metrics, RefusalLabels};
use line::{Ask, Line, LineLimits, Next, Refused, Ticket};

/// What a compute thread is asked to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Task {
    Step,
    SafetyReport,
    Plan,
    Verify,
    Validate,
    Precompute,
    Export,
    Load,
    List,
    Download,
    Submit,
    Forget,
    Cancel,
    Delete,
}

impl Task {
    /// In metrics.
    fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::SafetyReport => "safety_report",
            Self::Plan => "plan",
            Self::Verify => "verify",
            Self::Validate => "validate",
            Self::Precompute => "precompute",
            Self::Export => "export",
            Self::Load => "load",
            Self::List => "list",
            Self::Download => "download",
            Self::Submit => "submit",
            Self::Forget => "forget",
            Self::Cancel => "cancel",
            Self::Delete => "delete",
        }
    }

    fn lane(self) -> Lane {
        match self {
            Self::Step => Lane::Steps,
            Self::SafetyReport | Self::Plan | Self::Verify | Self::Validate | Self::Precompute => {
                Lane::Plans
            }
            Self::Export
            | Self::Load
            | Self::List
            | Self::Download
            | Self::Submit
            | Self::Forget
            | Self::Cancel
            | Self::Delete => Lane::Records,
        }
    }

    /// A task of a method.
    pub(crate) fn of(self, method: Method) -> Kind {
        Kind { task: self, method: Some(method) }
    }
}

/// Computations of a kind cost about the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Kind {
    task: Task,
    method: Option<Method>,
}

impl From<Task> for Kind {
    fn from(task: Task) -> Self {
        Self { task, method: None }
    }
}

/// Computations that share threads and a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Lane {
    /// A spacecraft waits for them.
    Steps,
    /// They think for as long as they may.
    Plans,
    /// They read and write what is kept.
    Records,
}

impl Lane {
    const ALL: [Self; 3] = [Self::Steps, Self::Plans, Self::Records];

    fn name(self) -> &'static str {
        match self {
            Self::Steps => "steps",
            Self::Plans => "plans",
            Self::Records => "records",
        }
    }

    /// Threads of this lane when there may be `threads` computations at once: plans leave a
    /// processor to the rest if there is more than one.
    fn threads(self, threads: usize) -> usize {
        match self {
            Self::Plans => threads.saturating_sub(1).max(1),
            Self::Steps | Self::Records => threads,
        }
    }
}

/// Bounds of the compute threads.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ComputeLimits {
    /// Computations at once in a lane.
    pub(crate) threads: usize,
    /// Longest wait of a step in a burst.
    pub(crate) wait_max: Duration,
    /// The same while there is more to do than can be done.
    pub(crate) overload_wait_max: Duration,
    /// Longest wait of what no spacecraft waits for.
    pub(crate) patient_wait_max: Duration,
    /// Most calls waiting in a lane.
    pub(crate) waiting_max: usize,
}

/// Fixed number of threads.
#[derive(Debug)]
pub(crate) struct Compute {
    lanes: [Arc<LaneState>; 3],
    metrics: Arc<Metrics>,
}

/// A value and the time a compute thread spent on it.
#[derive(Debug)]
pub(crate) struct Timed<T> {
    /// The value.
    pub(crate) value: T,
    /// Time on the compute thread.
    pub(crate) compute: Duration,
}

impl<T> Timed<T> {
    /// The same time for what `change` makes of the value.
    pub(crate) fn map<U>(self, change: impl FnOnce(T) -> U) -> Timed<U> {
        Timed { value: change(self.value), compute: self.compute }
    }
}

/// Why a computation gave no value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ComputeError {
    /// There is more to do than can be done in the time a call may wait.
    Busy {
        /// When to ask again: about when what is waiting now is done.
        retry_after: Duration,
    },
    /// The deadline passed.
    Deadline,
    /// Our bug.
    Panicked(String),
}

/// Who asks, and until when the answer is of use.
#[derive(Debug, Clone)]
pub(crate) struct Terms {
    /// Callers take turns.
    pub(crate) caller: Arc<str>,
    /// When an answer is no longer of use.
    pub(crate) deadline: Instant,
}

/// What a thread tells a job when its turn has come, or will not.
enum Summons {
    Compute,
    Refuse(Refused),
}

/// Hands the outcome over, once the thread is counted as free again: a caller that asks again at
/// once must not find it busy with what it was just given.
type Deliver = Box<dyn FnOnce() + Send>;
type Job = Box<dyn FnOnce(Summons) -> Deliver + Send>;

/// The line of a lane, and what wakes its threads.
#[derive(Debug)]
struct LaneState {
    lane: Lane,
    guarded: Mutex<Guarded>,
    ready: Condvar,
    metrics: Arc<Metrics>,
}

struct Guarded {
    line: Line<Job>,
    closed: bool,
}

impl std::fmt::Debug for Guarded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Guarded").field("closed", &self.closed).finish_non_exhaustive()
    }
}

/// Tells a computation that nobody waits for it any more, when the call is dropped; one that still
/// waits for its turn leaves the line.
struct CancelOnDrop<'a> {
    cancelled: Arc<AtomicBool>,
    lane: &'a LaneState,
    ticket: Ticket,
}

impl Drop for CancelOnDrop<'_> {
    fn drop(&mut self) {
        self.cancelled.store(true, Ordering::Relaxed);
        self.lane.leave(self.ticket);
    }
}

impl Compute {
    /// Starts the threads of every lane.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub(crate) fn start(limits: ComputeLimits, metrics: Arc<Metrics>) -> std::io::Result<Self> {
        let start = |lane: Lane| -> std::io::Result<_> {
            let threads = lane.threads(limits.threads);
            let state = Arc::new(LaneState::new(lane, threads, &limits, Arc::clone(&metrics)));
            for number in 0..threads {
                let state = Arc::clone(&state);
                let name = format!("{}-{number}", lane.name());
                thread::Builder::new().name(name).spawn(move || state.work())?;
            }
            Ok(state)
        };
        let [steps, plans, records] = Lane::ALL;
        let lanes = [start(steps)?, start(plans)?, start(records)?];
        Ok(Self { lanes, metrics })
    }

    /// Runs `work` on a compute thread until the deadline of `terms`.
    ///
    /// Its budget ends a little earlier, so that an answer that was found in time also leaves in
    /// time. If the returned future is dropped, the budget says [`Interruption::Cancelled`].
    ///
    /// # Errors
    /// [`ComputeError`].
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        kind: impl Into<Kind>,
        terms: &Terms,
        work: impl FnOnce(Budget<'_>) -> T + Send + 'static,
    ) -> Result<Timed<T>, ComputeError> {
        let (kind, deadline) = (kind.into(), terms.deadline);
        let lane = &*self.lanes[kind.task.lane() as usize];
        let cancelled = Arc::new(AtomicBool::new(false));
        let (sender, mut receiver) = oneshot::channel();
        let job: Job = {
            let (metrics, cancelled) = (Arc::clone(&self.metrics), Arc::clone(&cancelled));
            Box::new(move |summons| {
                let outcome = match summons {
                    Summons::Compute => Ok(timed(kind, deadline, &cancelled, &metrics, work)),
                    Summons::Refuse(refused) => Err(refused),
                };
                // The receiver is gone if the caller is.
                Box::new(move || drop(sender.send(outcome)))
            })
        };
        let asked = Instant::now();
        let ask = Ask { caller: Arc::clone(&terms.caller), kind, deadline };
        let (ticket, turn_by) = lane.join(asked, ask, job)?;
        let _guard = CancelOnDrop { cancelled, lane, ticket };
        let outcome = match tokio::time::timeout_at(turn_by.into(), &mut receiver).await {
            Ok(outcome) => outcome,
            Err(_) if lane.leave(ticket) => {
                if turn_by == deadline {
                    return Err(ComputeError::Deadline);
                }
                let refused = lane.guarded().line.late(Instant::now(), asked, &terms.caller);
                return Err(lane.refused(refused));
            }
            // Its turn has come meanwhile.
            Err(_) => match tokio::time::timeout_at(deadline.into(), receiver).await {
                Ok(outcome) => outcome,
                Err(_) => return Err(ComputeError::Deadline),
            },
        };
        match outcome {
            Ok(Ok(timed)) => timed.map_err(|panic| {
                self.metrics.compute_panics.inc();
                ComputeError::Panicked(panic_text(&*panic))
            }),
            Ok(Err(_)) if Instant::now() >= deadline => Err(ComputeError::Deadline),
            Ok(Err(refused)) => Err(lane.refused(refused)),
            Err(_) => Err(ComputeError::Panicked("the compute thread is gone".to_owned())),
        }
    }
}

impl Drop for Compute {
    fn drop(&mut self) {
        for lane in &self.lanes {
            lane.guarded().closed = true;
            lane.ready.notify_all();
        }
    }
}

impl LaneState {
    fn new(lane: Lane, threads: usize, limits: &ComputeLimits, metrics: Arc<Metrics>) -> Self {
        let (wait_max, overload_wait_max) = match lane {
            Lane::Steps => (limits.wait_max, limits.overload_wait_max),
            Lane::Plans | Lane::Records => (limits.patient_wait_max, limits.patient_wait_max),
        };
        let waiting_max = limits.waiting_max;
        let line = Line::new(LineLimits { threads, wait_max, overload_wait_max, waiting_max });
        let guarded = Mutex::new(Guarded { line, closed: false });
        Self { lane, guarded, ready: Condvar::new(), metrics }
    }

    fn guarded(&self) -> MutexGuard<'_, Guarded> {
        self.guarded.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn labels(&self) -> LaneLabels {
        LaneLabels { lane: self.lane.name() }
    }

    /// Says how many wait; called with the line held, so that the last word is the true one.
    fn show(&self, guarded: &Guarded) {
        let waiting = i64::try_from(guarded.line.waiting()).unwrap_or(i64::MAX);
        self.metrics.compute_waiting.get_or_create(&self.labels()).set(waiting);
    }

    /// Puts a job in the line; until when to wait for its turn.
    fn join(&self, now: Instant, ask: Ask, job: Job) -> Result<(Ticket, Instant), ComputeError> {
        let joined = {
            let mut guarded = self.guarded();
            let joined = guarded.line.join(now, ask, job);
            self.show(&guarded);
            joined
        };
        let joined = joined.map_err(|refused| self.refused(refused))?;
        self.ready.notify_one();
        if let Some((job, refused)) = joined.displaced {
            job(Summons::Refuse(refused))();
        }
        Ok((joined.ticket, joined.turn_by))
    }

    /// Takes a job out of the line, if it is still there.
    fn leave(&self, ticket: Ticket) -> bool {
        let mut guarded = self.guarded();
        let left = guarded.line.leave(ticket);
        self.show(&guarded);
        left
    }

    fn refused(&self, Refused { reason, retry_after }: Refused) -> ComputeError {
        let labels = RefusalLabels { lane: self.lane.name(), reason: reason.name() };
        self.metrics.compute_refused.get_or_create(&labels).inc();
        ComputeError::Busy { retry_after }
    }

    /// Body of a compute thread.
    fn work(&self) {
        match self.lane {
            Lane::Steps => lower_priority(STEPS_YIELD),
            Lane::Plans => yield_to_steps(),
            Lane::Records => {}
        }
        let mut guarded = self.guarded();
        loop {
            match guarded.line.next(Instant::now()) {
                Next::Run(ticket, waited, job) => {
                    self.show(&guarded);
                    drop(guarded);
                    let labels = self.labels();
                    let wait = self.metrics.compute_wait_seconds.get_or_create(&labels).clone();
                    wait.observe(waited.as_secs_f64());
                    let computations = self.metrics.computations.get_or_create(&labels).clone();
                    computations.inc();
                    let deliver = job(Summons::Compute);
                    computations.dec();
                    guarded = self.guarded();
                    guarded.line.ended(Instant::now(), ticket);
                    drop(guarded);
                    deliver();
                    guarded = self.guarded();
                }
                Next::Refuse(job, refused) => {
                    self.show(&guarded);
                    drop(guarded);
                    job(Summons::Refuse(refused))();
                    guarded = self.guarded();
                }
                Next::Rest if guarded.closed => return,
                Next::Rest => {
                    guarded = self.ready.wait(guarded).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
    }
}

/// Steps yield to the threads that serve connections: whoever waits shall wait in a line, which has
/// an end, and a refusal shall leave at once. With a much larger share for steps, calls waited for
/// a tenth of a second in their sockets at twice what the node can do.
const STEPS_YIELD: i32 = 7;
/// Plans and jobs yield to steps: each step of the scale is about a quarter of the share.
const PLANS_YIELD: i32 = 15;

/// Lets this thread, and no other, run when no step wants the processor.
pub(crate) fn yield_to_steps() {
    lower_priority(PLANS_YIELD);
}

/// Only Linux has priorities of single threads behind this call; elsewhere threads are equals.
fn lower_priority(by: i32) {
    #[cfg(target_os = "linux")]
    if let Err(fault) = rustix::process::nice(by) {
        tracing::warn!(%fault, "all threads run with the same priority");
    }
    #[cfg(not(target_os = "linux"))]
    let _ = by;
}

fn timed<T>(
    kind: Kind,
    deadline: Instant,
    cancelled: &Arc<AtomicBool>,
    metrics: &Metrics,
    work: impl FnOnce(Budget<'_>) -> T,
) -> Result<Timed<T>, Box<dyn Any + Send>> {
    let start = Instant::now();
    // Rendering and sending take a fraction of a millisecond.
    let reserve = (deadline.saturating_duration_since(start) / 10).min(Duration::from_millis(2));
    let stop_at = deadline - reserve;
    let ask = until(stop_at, Arc::clone(cancelled));
    // Nothing survives a panic but the message: `work` owns or only reads what it uses.
    let outcome = catch_unwind(AssertUnwindSafe(|| work(Budget::new(&ask))));
    let compute = start.elapsed();
    let labels = MethodLabels { method: kind.task.name() };
    metrics.compute_seconds.get_or_create(&labels).observe(compute.as_secs_f64());
    outcome.map(|value| Timed { value, compute })
}

/// Whether to go on: not once `stopped` is set, nor after `stop_at`.
pub(crate) fn until(stop_at: Instant, stopped: Arc<AtomicBool>) -> Question {
    Arc::new(move || {
        if stopped.load(Ordering::Relaxed) {
            Some(Interruption::Cancelled)
        } else if Instant::now() >= stop_at {
            Some(Interruption::Deadline)
        } else {
            None
        }
    })
}

/// What a panic said.
pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panic".to_owned())
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    fn compute(threads: usize, wait_max: Duration) -> Arc<Compute> {
        let metrics = Arc::new(Metrics::new());
        let limits = ComputeLimits {
            threads,
            wait_max,
            overload_wait_max: wait_max,
            patient_wait_max: wait_max,
            waiting_max: 100,
        };
        Arc::new(Compute::start(limits, metrics).unwrap())
    }

    fn waiting_until(deadline: Instant) -> Terms {
        Terms { caller: "test".into(), deadline }
    }

    fn soon() -> Terms {
        waiting_until(Instant::now() + Duration::from_secs(30))
    }

    fn waiting(compute: &Compute) -> i64 {
        let lanes = Lane::ALL.map(|lane| LaneLabels { lane: lane.name() });
        let waiting = |labels| compute.metrics.compute_waiting.get_or_create(&labels).get();
        lanes.into_iter().map(waiting).sum()
    }

    fn refused(compute: &Compute, lane: Lane, reason: &'static str) -> u64 {
        let labels = RefusalLabels { lane: lane.name(), reason };
        compute.metrics.compute_refused.get_or_create(&labels).get()
    }

    /// Occupies a thread until the returned sender is dropped.
    fn occupy(
        compute: &Arc<Compute>,
        task: Task,
    ) -> (mpsc::Sender<()>, tokio::task::JoinHandle<()>) {
        let (release, released) = mpsc::channel::<()>();
        let (started, has_started) = mpsc::channel();
        let compute = Arc::clone(compute);
        let running = tokio::spawn(async move {
            let work = move |_: Budget<'_>| {
                started.send(()).unwrap();
                let _ = released.recv();
            };
            compute.run(task, &soon(), work).await.unwrap();
        });
        tokio::task::block_in_place(|| has_started.recv().unwrap());
        (release, running)
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_busy_is_refused_with_a_time_to_come_back() {
        let compute = compute(1, Duration::ZERO);
        let (release, task) = occupy(&compute, Task::Step);
        let refused = compute.run(Task::Step, &soon(), |_| ()).await.unwrap_err();
        assert!(matches!(refused, ComputeError::Busy { retry_after } if !retry_after.is_zero()));
        assert_eq!(self::refused(&compute, Lane::Steps, "backlog"), 1);
        drop(release);
        task.await.unwrap();
        assert_eq!(compute.run(Task::Step, &soon(), |_| 7).await.unwrap().value, 7);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_busy_for_a_moment_is_waited_for() {
        let compute = compute(1, Duration::from_secs(20));
        let (release, task) = occupy(&compute, Task::Step);
        let waiting = tokio::spawn({
            let compute = Arc::clone(&compute);
            async move { compute.run(Task::Step, &soon(), |_| 8).await.unwrap().value }
        });
        while self::waiting(&compute) == 0 {
            tokio::task::yield_now().await;
        }
        drop(release);
        task.await.unwrap();
        assert_eq!(waiting.await.unwrap(), 8);
        assert_eq!(self::waiting(&compute), 0);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_panic_is_caught_and_the_thread_lives_on() {
        let compute = compute(1, Duration::from_secs(20));
        let panicked = compute.run(Task::Step, &soon(), |_| -> () { panic!("a bug") }).await;
        assert_eq!(panicked.unwrap_err(), ComputeError::Panicked("a bug".to_owned()));
        assert_eq!(compute.run(Task::Step, &soon(), |_| 9).await.unwrap().value, 9);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_budget_ends_before_the_deadline() {
        let compute = compute(1, Duration::ZERO);
        let deadline = Instant::now() + Duration::from_millis(50);
        let (told, tells) = oneshot::channel();
        let work = move |budget: Budget<'_>| loop {
            if let Err(interruption) = budget.check() {
                told.send((interruption, Instant::now())).unwrap();
                return;
            }
        };
        // On a busy machine its answer can still be too late.
        let _ = compute.run(Task::Step, &waiting_until(deadline), work).await;
        let (interruption, when) = tells.await.unwrap();
        assert_eq!(interruption, Interruption::Deadline);
        assert!(when >= deadline - Duration::from_millis(2));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_that_ignores_its_budget_does_not_hold_the_caller() {
        let compute = compute(1, Duration::ZERO);
        let (release, released) = mpsc::channel::<()>();
        let deadline = Instant::now() + Duration::from_millis(20);
        let late =
            compute.run(Task::Step, &waiting_until(deadline), move |_| released.recv()).await;
        assert_eq!(late.unwrap_err(), ComputeError::Deadline);
        drop(release);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_call_dropped_is_cancelled() {
        let compute = compute(1, Duration::from_secs(20));
        let (told, tells) = oneshot::channel();
        let (started, has_started) = oneshot::channel();
        let task = tokio::spawn({
            let compute = Arc::clone(&compute);
            async move {
                let work = move |budget: Budget<'_>| {
                    started.send(()).unwrap();
                    let interruption = loop {
                        if let Err(interruption) = budget.check() {
                            break interruption;
                        }
                    };
                    told.send(interruption).unwrap();
                };
                compute.run(Task::Step, &soon(), work).await
            }
        });
        has_started.await.unwrap();
        task.abort();
        assert_eq!(tells.await.unwrap(), Interruption::Cancelled);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_step_does_not_wait_for_plans() {
        let compute = compute(2, Duration::ZERO);
        let (release, plan) = occupy(&compute, Task::Plan);
        // One thread is for plans; the next plan is told to come back, steps and records are not.
        let busy = compute.run(Task::Validate, &soon(), |_| ()).await.unwrap_err();
        assert!(matches!(busy, ComputeError::Busy { .. }));
        assert_eq!(refused(&compute, Lane::Plans, "backlog"), 1);
        assert_eq!(compute.run(Task::Step, &soon(), |_| 1).await.unwrap().value, 1);
        assert_eq!(compute.run(Task::Load, &soon(), |_| 2).await.unwrap().value, 2);
        drop(release);
        plan.await.unwrap();
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_call_dropped_while_it_waits_is_never_computed() {
        let compute = compute(1, Duration::from_secs(20));
        let (release, running) = occupy(&compute, Task::Step);
        let computed = Arc::new(AtomicBool::new(false));
        let waiting = tokio::spawn({
            let (compute, computed) = (Arc::clone(&compute), Arc::clone(&computed));
            let work = move |_: Budget<'_>| computed.store(true, Ordering::Relaxed);
            async move { compute.run(Task::Step, &soon(), work).await }
        });
        while self::waiting(&compute) == 0 {
            tokio::task::yield_now().await;
        }
        waiting.abort();
        waiting.await.unwrap_err();
        assert_eq!(self::waiting(&compute), 0);
        drop(release);
        running.await.unwrap();
        compute.run(Task::Step, &soon(), |_| ()).await.unwrap();
        assert!(!computed.load(Ordering::Relaxed));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_call_that_waited_too_long_is_told_when_to_come_back() {
        let compute = compute(1, Duration::from_millis(30));
        let (release, running) = occupy(&compute, Task::Step);
        // Nothing is known of what is under way but that it has lasted a moment: it is waited for.
        let late = compute.run(Task::Step, &soon(), |_| ()).await.unwrap_err();
        let ComputeError::Busy { retry_after } = late else { panic!("{late:?}") };
        assert!(retry_after >= Duration::from_millis(10));
        let reasons = ["late", "backlog"].map(|reason| refused(&compute, Lane::Steps, reason));
        assert_eq!(reasons.iter().sum::<u64>(), 1);
        drop(release);
        running.await.unwrap();
    }

    #[test]
    fn lanes_leave_a_processor_to_steps_if_there_is_more_than_one() {
        let threads = |n| Lane::ALL.map(|lane| lane.threads(n));
        assert_eq!(threads(1), [1, 1, 1]);
        assert_eq!(threads(4), [4, 3, 4]);
    }
}
