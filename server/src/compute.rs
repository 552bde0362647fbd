//! Compute threads: a fixed number of computations at once, each with a budget.
//!
//! A call gets a thread now, or after a short and bounded wait, or is told to come back later;
//! there is no hidden queue. The wait exists because a step takes a tenth of a millisecond: to
//! refuse the third of three calls that arrive together would cost its caller far more.
//!
//! Own threads, not the runtime's: a computation in place on a runtime worker could not notice
//! that its caller has gone, and would hold up every connection that the worker serves.

use std::{
    any::Any,
    collections::VecDeque,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use vbar_guidance::{Budget, Interruption};

use crate::telemetry::{MethodLabels, Metrics};

/// Fixed number of threads.
#[derive(Debug)]
pub(crate) struct Compute {
    permits: Arc<Semaphore>,
    queue: Arc<Queue>,
    wait_max: Duration,
    waiting_max: usize,
    waiting: AtomicUsize,
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
    /// Every thread is busy, and was so for as long as a call may wait.
    Busy {
        /// When to ask again.
        retry_after: Duration,
    },
    /// The deadline passed.
    Deadline,
    /// Our bug.
    Panicked(String),
}

type Job = Box<dyn FnOnce() + Send>;

/// Jobs handed over; never longer than the number of idle threads, because of the permits.
#[derive(Default)]
struct Queue {
    state: Mutex<QueueState>,
    ready: Condvar,
}

#[derive(Default)]
struct QueueState {
    jobs: VecDeque<Job>,
    closed: bool,
}

impl std::fmt::Debug for Queue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Queue").finish_non_exhaustive()
    }
}

/// Tells a computation that nobody waits for it any more, when the call is dropped.
struct CancelOnDrop(Arc<AtomicBool>);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Compute {
    /// Starts `threads` threads.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub(crate) fn start(
        threads: usize,
        wait_max: Duration,
        waiting_max: usize,
        metrics: Arc<Metrics>,
    ) -> std::io::Result<Self> {
        let queue = Arc::<Queue>::default();
        for number in 0..threads {
            let queue = Arc::clone(&queue);
            thread::Builder::new().name(format!("compute-{number}")).spawn(move || queue.work())?;
        }
        Ok(Self {
            permits: Arc::new(Semaphore::new(threads)),
            queue,
            wait_max,
            waiting_max,
            waiting: AtomicUsize::new(0),
            metrics,
        })
    }

    /// Runs `work` on a compute thread until `deadline`.
    ///
    /// Its budget ends a little earlier, so that an answer that was found in time also leaves in
    /// time. If the returned future is dropped, the budget says [`Interruption::Cancelled`].
    ///
    /// # Errors
    /// [`ComputeError`].
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        method: &'static str,
        deadline: Instant,
        work: impl FnOnce(Budget<'_>) -> T + Send + 'static,
    ) -> Result<Timed<T>, ComputeError> {
        let permit = self.permit(deadline).await?;
        let cancelled = Arc::new(AtomicBool::new(false));
        let _guard = CancelOnDrop(Arc::clone(&cancelled));
        let (sender, receiver) = oneshot::channel();
        let metrics = Arc::clone(&self.metrics);
        self.queue.push(Box::new(move || {
            let timed = timed(method, deadline, &cancelled, &metrics, work);
            drop(permit);
            // The receiver is gone if the caller is.
            let _ = sender.send(timed);
        }));
        match tokio::time::timeout_at(deadline.into(), receiver).await {
            Ok(Ok(outcome)) => outcome.map_err(|panic| {
                self.metrics.compute_panics.inc();
                ComputeError::Panicked(panic_text(&*panic))
            }),
            Ok(Err(_)) => Err(ComputeError::Panicked("the compute thread is gone".to_owned())),
            Err(_) => Err(ComputeError::Deadline),
        }
    }

    async fn permit(&self, deadline: Instant) -> Result<OwnedSemaphorePermit, ComputeError> {
        if let Ok(permit) = Arc::clone(&self.permits).try_acquire_owned() {
            return Ok(permit);
        }
        let refuse = || {
            self.metrics.compute_refused.inc();
            Err(ComputeError::Busy { retry_after: self.wait_max.max(Duration::from_millis(10)) })
        };
        let _waiting = Waiting::enter(self);
        if self.waiting.load(Ordering::Relaxed) > self.waiting_max {
            return refuse();
        }
        let start = Instant::now();
        let until = deadline.min(start + self.wait_max);
        let permit = Arc::clone(&self.permits).acquire_owned();
        match tokio::time::timeout_at(until.into(), permit).await {
            Ok(Ok(permit)) => {
                self.metrics.compute_wait_seconds.observe(start.elapsed().as_secs_f64());
                Ok(permit)
            }
            _ if Instant::now() >= deadline => Err(ComputeError::Deadline),
            _ => refuse(),
        }
    }
}

impl Drop for Compute {
    fn drop(&mut self) {
        self.queue.state().closed = true;
        self.queue.ready.notify_all();
    }
}

/// Counts a waiting call, also if it is dropped while it waits.
struct Waiting<'a>(&'a Compute);

impl<'a> Waiting<'a> {
    fn enter(compute: &'a Compute) -> Self {
        compute.waiting.fetch_add(1, Ordering::Relaxed);
        compute.metrics.compute_waiting.inc();
        Self(compute)
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, Ordering::Relaxed);
        self.0.metrics.compute_waiting.dec();
    }
}

fn timed<T>(
    method: &'static str,
    deadline: Instant,
    cancelled: &AtomicBool,
    metrics: &Metrics,
    work: impl FnOnce(Budget<'_>) -> T,
) -> Result<Timed<T>, Box<dyn Any + Send>> {
    metrics.computations.inc();
    let start = Instant::now();
    // Rendering and sending take a fraction of a millisecond.
    let reserve = (deadline.saturating_duration_since(start) / 10).min(Duration::from_millis(2));
    let stop_at = deadline - reserve;
    let ask = || {
        if cancelled.load(Ordering::Relaxed) {
            Some(Interruption::Cancelled)
        } else if Instant::now() >= stop_at {
            Some(Interruption::Deadline)
        } else {
            None
        }
    };
    // Nothing survives a panic but the message: `work` owns or only reads what it uses.
    let outcome = catch_unwind(AssertUnwindSafe(|| work(Budget::new(&ask))));
    let compute = start.elapsed();
    metrics.computations.dec();
    metrics.compute_seconds.get_or_create(&MethodLabels { method }).observe(compute.as_secs_f64());
    outcome.map(|value| Timed { value, compute })
}

/// What a panic said.
pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panic".to_owned())
}

impl Queue {
    fn state(&self) -> MutexGuard<'_, QueueState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, job: Job) {
        self.state().jobs.push_back(job);
        self.ready.notify_one();
    }

    /// Body of a compute thread.
    fn work(&self) {
        let mut state = self.state();
        loop {
            if let Some(job) = state.jobs.pop_front() {
                drop(state);
                job();
                state = self.state();
            } else if state.closed {
                return;
            } else {
                state = self.ready.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    fn compute(threads: usize, wait_max: Duration) -> Arc<Compute> {
        let metrics = Arc::new(Metrics::new());
        Arc::new(Compute::start(threads, wait_max, 100, metrics).unwrap())
    }

    fn soon() -> Instant {
        Instant::now() + Duration::from_secs(30)
    }

    /// Occupies a thread until the returned sender is dropped.
    fn occupy(compute: &Arc<Compute>) -> (mpsc::Sender<()>, tokio::task::JoinHandle<()>) {
        let (release, released) = mpsc::channel::<()>();
        let (started, has_started) = mpsc::channel();
        let compute = Arc::clone(compute);
        let task = tokio::spawn(async move {
            let work = move |_: Budget<'_>| {
                started.send(()).unwrap();
                let _ = released.recv();
            };
            compute.run("test", soon(), work).await.unwrap();
        });
        tokio::task::block_in_place(|| has_started.recv().unwrap());
        (release, task)
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_busy_is_refused_with_a_time_to_come_back() {
        let compute = compute(1, Duration::ZERO);
        let (release, task) = occupy(&compute);
        let refused = compute.run("test", soon(), |_| ()).await.unwrap_err();
        assert!(matches!(refused, ComputeError::Busy { retry_after } if !retry_after.is_zero()));
        assert_eq!(compute.metrics.compute_refused.get(), 1);
        drop(release);
        task.await.unwrap();
        assert_eq!(compute.run("test", soon(), |_| 7).await.unwrap().value, 7);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_busy_for_a_moment_is_waited_for() {
        let compute = compute(1, Duration::from_secs(20));
        let (release, task) = occupy(&compute);
        let waiting = tokio::spawn({
            let compute = Arc::clone(&compute);
            async move { compute.run("test", soon(), |_| 8).await.unwrap().value }
        });
        while compute.metrics.compute_waiting.get() == 0 {
            tokio::task::yield_now().await;
        }
        drop(release);
        task.await.unwrap();
        assert_eq!(waiting.await.unwrap(), 8);
        assert_eq!(compute.metrics.compute_waiting.get(), 0);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_panic_is_caught_and_the_thread_lives_on() {
        let compute = compute(1, Duration::from_secs(20));
        let panicked = compute.run("test", soon(), |_| -> () { panic!("a bug") }).await;
        assert_eq!(panicked.unwrap_err(), ComputeError::Panicked("a bug".to_owned()));
        assert_eq!(compute.run("test", soon(), |_| 9).await.unwrap().value, 9);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_budget_ends_before_the_deadline() {
        let compute = compute(1, Duration::ZERO);
        let deadline = Instant::now() + Duration::from_millis(50);
        let work = |budget: Budget<'_>| loop {
            if let Err(interruption) = budget.check() {
                return interruption;
            }
        };
        let answer = compute.run("test", deadline, work).await.unwrap();
        assert_eq!(answer.value, Interruption::Deadline);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn compute_that_ignores_its_budget_does_not_hold_the_caller() {
        let compute = compute(1, Duration::ZERO);
        let (release, released) = mpsc::channel::<()>();
        let deadline = Instant::now() + Duration::from_millis(20);
        let late = compute.run("test", deadline, move |_| released.recv()).await;
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
                compute.run("test", soon(), work).await
            }
        });
        has_started.await.unwrap();
        task.abort();
        assert_eq!(tells.await.unwrap(), Interruption::Cancelled);
    }
}
