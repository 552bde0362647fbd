//! Limits and interruption: how pure code learns that it should stop.

/// Why a computation was stopped from outside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interruption {
    /// The time allowed is over; an unproved but certified answer is still welcome.
    Deadline,
    /// Nobody waits for the answer any more.
    Cancelled,
}

/// Asked between units of work, about every ten microseconds, whether to go on.
///
/// The question is a closure, because this crate has no clock: the server answers from its
/// deadline and its cancellation flag, a test from a counter.
#[derive(Clone, Copy)]
pub struct Budget<'a> {
    ask: Option<&'a (dyn Fn() -> Option<Interruption> + Sync)>,
}

impl<'a> Budget<'a> {
    /// Never interrupts. Iteration limits still hold.
    pub const UNLIMITED: Budget<'static> = Budget { ask: None };

    /// A budget that asks `ask`, which must be cheap.
    #[must_use]
    pub fn new(ask: &'a (dyn Fn() -> Option<Interruption> + Sync)) -> Self {
        Self { ask: Some(ask) }
    }

    /// Fails when the computation should stop.
    ///
    /// # Errors
    /// The [`Interruption`] that was asked for.
    pub fn check(&self) -> Result<(), Interruption> {
        match self.ask.and_then(|ask| ask()) {
            None => Ok(()),
            Some(interruption) => Err(interruption),
        }
    }
}

impl std::fmt::Debug for Budget<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(if self.ask.is_some() { "Budget(limited)" } else { "Budget(unlimited)" })
    }
}
