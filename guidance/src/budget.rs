//! Limits and interruption: how pure code learns that it should stop, and says how far it is.

use std::sync::Arc;

/// Why a computation was stopped from outside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interruption {
    /// The time allowed is over; an unproved but certified answer is still welcome.
    Deadline,
    /// Nobody waits for the answer any more.
    Cancelled,
}

/// How far a long computation is, in units of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Units done; never falls within one phase.
    pub done: usize,
    /// Units of this phase, at least `done`.
    pub total: usize,
}

/// The question whether to go on. Shared, because a solver of somebody else's keeps it while it
/// runs.
pub type Question = Arc<dyn Fn() -> Option<Interruption> + Send + Sync>;

/// Asked between units of work, about every ten microseconds, whether to go on.
///
/// The question is a closure, because this crate has no clock: the server answers from its
/// deadline and its cancellation flag, a test from a counter.
#[derive(Clone, Copy)]
pub struct Budget<'a> {
    ask: Option<&'a Question>,
    tell: Option<&'a (dyn Fn(Progress) + Sync)>,
    hears_deadline: bool,
}

impl<'a> Budget<'a> {
    /// Never interrupts. Iteration limits still hold.
    pub const UNLIMITED: Budget<'static> = Budget { ask: None, tell: None, hears_deadline: true };

    /// A budget that asks `ask`, which must be cheap.
    #[must_use]
    pub fn new(ask: &'a Question) -> Self {
        Self { ask: Some(ask), tell: None, hears_deadline: true }
    }

    /// What it asks, if it asks anything.
    #[must_use]
    pub fn question(&self) -> Option<&'a Question> {
        self.ask
    }

    /// The same, and long computations tell `tell` how far they are, at most as often as they ask.
    #[must_use]
    pub fn telling(self, tell: &'a (dyn Fn(Progress) + Sync)) -> Self {
        Self { tell: Some(tell), ..self }
    }

    /// The same for what makes an answer of the work done when the deadline comes: only who has
    /// gone stops that.
    #[must_use]
    pub fn beyond_deadline(self) -> Self {
        Self { hears_deadline: false, ..self }
    }

    /// The same for a part of the work whose progress means nothing to the caller.
    #[must_use]
    pub fn untold(self) -> Self {
        Self { tell: None, ..self }
    }

    /// Fails when the computation should stop.
    ///
    /// # Errors
    /// The [`Interruption`] that was asked for.
    pub fn check(&self) -> Result<(), Interruption> {
        match self.ask.and_then(|ask| ask()) {
            Some(Interruption::Deadline) if !self.hears_deadline => Ok(()),
            Some(interruption) => Err(interruption),
            None => Ok(()),
        }
    }

    /// Says how far the work is. Nothing that is computed may depend on it.
    pub fn tell(&self, done: usize, total: usize) {
        if let Some(tell) = self.tell {
            tell(Progress { done, total });
        }
    }
}

impl std::fmt::Debug for Budget<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(if self.ask.is_some() { "Budget(limited)" } else { "Budget(unlimited)" })
    }
}
