//! When to try again, and when to give up.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::time::Instant;
use tonic::Code;

use crate::Error;

/// The first pause; each later one doubles.
const PAUSE_FIRST: Duration = Duration::from_millis(50);
/// No pause of our own is longer. A node may ask for more.
const PAUSE_MAX: Duration = Duration::from_secs(2);

/// How often the clones of a client tried again, all together.
#[derive(Debug, Clone, Default)]
pub(crate) struct Retries(Arc<AtomicU64>);

impl Retries {
    pub(crate) fn count(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }

    pub(crate) fn add_one(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// The attempts of one call.
#[derive(Debug)]
pub(crate) struct Attempts {
    made: u32,
    max: u32,
    deadline: Instant,
    retries: Retries,
}

impl Attempts {
    /// Until `deadline` and at most `max`; every repetition is added to `retries`.
    pub(crate) fn new(max: u32, deadline: Instant, retries: &Retries) -> Self {
        Self { made: 0, max, deadline, retries: retries.clone() }
    }

    /// Time left for the attempt that is about to start.
    pub(crate) fn time_left(&self) -> Result<Duration, Error> {
        time_left(self.deadline)
    }

    /// Runs one attempt, cut at the deadline.
    pub(crate) async fn bounded<T>(
        &self,
        attempt: impl Future<Output = Result<T, Error>>,
    ) -> Result<T, Error> {
        match tokio::time::timeout_at(self.deadline, attempt).await {
            Ok(outcome) => outcome,
            Err(_elapsed) => Err(deadline_exceeded()),
        }
    }

    /// Waits before the next attempt, or gives `error` back if there must be none: the fault is
    /// not a passing one, the attempts are used up, or the pause would outlast the deadline.
    pub(crate) async fn pause_after(&mut self, error: Error) -> Result<(), Error> {
        self.made += 1;
        if !error.is_retryable() || self.made >= self.max {
            return Err(error);
        }
        let pause = pause(self.made, error.retry_after, fastrand::f64());
        let resume = Instant::now() + pause;
        if resume >= self.deadline {
            return Err(error);
        }
        tracing::debug!(attempt = self.made, ?pause, %error, "trying again");
        tokio::time::sleep_until(resume).await;
        self.retries.add_one();
        Ok(())
    }
}

/// Time left until `deadline`, or the error of a call that has none.
pub(crate) fn time_left(deadline: Instant) -> Result<Duration, Error> {
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(deadline_exceeded()) } else { Ok(left) }
}

fn deadline_exceeded() -> Error {
    Error::local(Code::DeadlineExceeded, "no answer before the call's deadline")
}

/// Pause after attempt number `made`, with `chance` in [0, 1).
///
/// Half of it is chance, so that clients which lost the same node do not return together. What
/// the node asked for is a lower bound, and the chance comes on top.
fn pause(made: u32, asked: Option<Duration>, chance: f64) -> Duration {
    let doublings = made.saturating_sub(1).min(16);
    let full = PAUSE_FIRST.saturating_mul(1 << doublings).min(PAUSE_MAX);
    let own = full.mul_f64(0.5 + 0.5 * chance);
    match asked {
        Some(asked) => asked.saturating_add(full.mul_f64(0.5 * chance)),
        None => own,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pause_doubles_up_to_its_limit() {
        let longest = |made| pause(made, None, 1.0);
        assert_eq!(longest(1), Duration::from_millis(50));
        assert_eq!(longest(2), Duration::from_millis(100));
        assert_eq!(longest(6), Duration::from_millis(1600));
        assert_eq!(longest(7), PAUSE_MAX);
        assert_eq!(longest(u32::MAX), PAUSE_MAX);
        assert_eq!(pause(1, None, 0.0), Duration::from_millis(25));
    }

    #[test]
    fn pause_is_never_shorter_than_the_node_asked_for() {
        let asked = Duration::from_secs(3);
        assert_eq!(pause(1, Some(asked), 0.0), asked);
        assert!(pause(1, Some(asked), 0.9) > asked);
        assert_eq!(pause(1, Some(Duration::MAX), 0.9), Duration::MAX);
    }
}
