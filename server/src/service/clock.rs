//! The time of day for what is kept, on a machine whose clock may jump.
//!
//! What is kept for thirty days must not go because somebody set the clock. So there are two: the
//! system's, and one that goes on evenly from where that was. Whatever ends does so by the one that
//! is behind; until when something is kept is counted from the one that is ahead. So nothing goes
//! early, and at most later by the jump. A jump that has lasted for a day is believed.

use std::{
    fmt,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant, SystemTime},
};

/// Clocks drift, and are put right, by less than this from one look to the next.
const SLACK: Duration = Duration::from_secs(60);
const BELIEVED_AFTER: Duration = Duration::from_secs(24 * 3600);

/// Both clocks.
pub(super) struct Clock {
    look: Box<dyn Fn() -> Moment + Send + Sync>,
    pace: Mutex<Pace>,
}

/// What the machine's clocks show at once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    /// The time of day; it may jump.
    pub(super) system: SystemTime,
    /// It only goes on.
    pub(super) steady: Instant,
}

#[derive(Debug)]
struct Pace {
    /// When both were last together.
    together: Moment,
    /// Since when they are not.
    apart_since: Option<Instant>,
}

impl Clock {
    /// Of this machine.
    pub(super) fn of_system() -> Self {
        Self::looking(|| Moment { system: SystemTime::now(), steady: Instant::now() })
    }

    /// Of whatever `look` shows.
    pub(super) fn looking(look: impl Fn() -> Moment + Send + Sync + 'static) -> Self {
        let pace = Pace { together: look(), apart_since: None };
        Self { look: Box::new(look), pace: Mutex::new(pace) }
    }

    /// By which to say that the time of something has passed.
    pub(super) fn behind(&self) -> SystemTime {
        self.both().0
    }

    /// By which to say until when something is kept.
    pub(super) fn ahead(&self) -> SystemTime {
        self.both().1
    }

    /// The one that is behind and the one that is ahead.
    fn both(&self) -> (SystemTime, SystemTime) {
        let now = (self.look)();
        let mut pace = self.pace.lock().unwrap_or_else(PoisonError::into_inner);
        let since = now.steady.saturating_duration_since(pace.together.steady);
        let even = pace.together.system.checked_add(since).unwrap_or(now.system);
        let apart = now.system.duration_since(even).unwrap_or_else(|back| back.duration());
        if apart <= SLACK {
            *pace = Pace { together: now, apart_since: None };
            return (now.system, now.system);
        }
        let apart_since = *pace.apart_since.get_or_insert_with(|| {
            tracing::warn!(?apart, is_back = now.system < even, "the system's clock jumped");
            now.steady
        });
        if now.steady.saturating_duration_since(apart_since) >= BELIEVED_AFTER {
            tracing::warn!(?apart, "the system's clock is believed");
            *pace = Pace { together: now, apart_since: None };
            return (now.system, now.system);
        }
        (now.system.min(even), now.system.max(even))
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.pace.fmt(f)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use super::*;

    pub(in crate::service) const HOUR: Duration = Duration::from_secs(3600);

    /// A machine's clocks, in a test's hands.
    #[derive(Debug, Clone)]
    pub(in crate::service) struct Hands(Arc<Mutex<Moment>>);

    impl Hands {
        pub(in crate::service) fn new() -> Self {
            let now = Moment { system: SystemTime::now(), steady: Instant::now() };
            Self(Arc::new(Mutex::new(now)))
        }

        pub(in crate::service) fn clock(&self) -> Arc<Clock> {
            let hands = self.clone();
            Arc::new(Clock::looking(move || hands.now()))
        }

        pub(in crate::service) fn now(&self) -> Moment {
            *self.0.lock().unwrap()
        }

        /// Time goes by.
        pub(in crate::service) fn pass(&self, time: Duration) {
            let mut now = self.0.lock().unwrap();
            now.system += time;
            now.steady += time;
        }

        /// The system's clock is set to another time.
        pub(in crate::service) fn set(&self, system: SystemTime) {
            self.0.lock().unwrap().system = system;
        }
    }

    #[test]
    fn clock_goes_with_the_system_while_that_does_not_jump() {
        let hands = Hands::new();
        let clock = hands.clock();
        for drift_s in [0, 50, 7, 59] {
            hands.pass(HOUR);
            hands.set(hands.now().system - Duration::from_secs(drift_s));
            assert_eq!(clock.both(), (hands.now().system, hands.now().system));
        }
    }

    #[test]
    fn clock_that_jumps_there_and_back_ends_nothing_early() {
        let hands = Hands::new();
        let clock = hands.clock();
        for is_back in [false, true] {
            let right = hands.now().system;
            let jumped = if is_back { right - 5 * HOUR } else { right + 5 * HOUR };
            hands.set(jumped);
            let (behind, ahead) = (right.min(jumped), right.max(jumped));
            assert_eq!(clock.both(), (behind, ahead));
            hands.pass(HOUR);
            assert_eq!(clock.both(), (behind + HOUR, ahead + HOUR));
            hands.set(right + HOUR);
            assert_eq!(clock.both(), (right + HOUR, right + HOUR));
        }
    }

    #[test]
    fn clock_that_stays_where_it_jumped_is_believed_after_a_day() {
        let hands = Hands::new();
        let clock = hands.clock();
        for jumped in [SystemTime::UNIX_EPOCH, hands.now().system + 20_000 * HOUR] {
            hands.set(jumped);
            assert_ne!(clock.behind(), clock.ahead());
            hands.pass(23 * HOUR);
            assert_ne!(clock.behind(), clock.ahead());
            hands.pass(HOUR);
            assert_eq!(clock.both(), (jumped + 24 * HOUR, jumped + 24 * HOUR));
        }
    }
}
