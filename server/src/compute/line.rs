//! Who waits for a compute thread, who is next, and who is told at once to come back later.
//!
//! Callers take turns, so one that asks a hundred times at once holds up the others by one
//! computation, not by a hundred. A newcomer is refused when the wait it can expect, reckoned from
//! what is under way and from whom it would have to let go first, is longer than a call may wait.
//! That bound is generous until a burst has filled it, and from then on, until nobody had to be
//! refused for a while, as narrow as keeps the threads busy: a line that stands makes everybody late
//! and nobody sooner (the distinction is CoDel's; Nichols and Jacobson, "Controlling Queue Delay",
//! ACM Queue 10(5), 2012). What was reckoned can turn out wrong, because threads share processors
//! with others: then whoever waited too long is refused when its turn comes, and the thread goes on
//! with somebody fresher.
//!
//! No clock and no thread here: whoever calls says what time it is.

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use super::Kind;

/// After a refusal there is more to do than can be done until nobody was refused for so long.
const OVERLOAD_LASTS: Duration = Duration::from_millis(100);
/// So many for each thread may wait ahead of a newcomer while there is more to do than can be done.
/// One would keep the thread busy if the next always came in time; but calls come in handfuls, as
/// connections are read.
const AHEAD_IN_OVERLOAD: usize = 4;
/// What a computation is taken for until the first of its kind has ended.
const COST_UNKNOWN: Duration = Duration::from_millis(1);
/// Nobody is asked to come back sooner, or later, than this.
const RETRY_AFTER: (Duration, Duration) = (Duration::from_millis(10), Duration::from_secs(60));

/// When to come back after what was waited for took `wait`.
fn retry_after(wait: Duration) -> Duration {
    wait.clamp(RETRY_AFTER.0, RETRY_AFTER.1)
}

/// What a line may be.
#[derive(Debug, Clone, Copy)]
pub(super) struct LineLimits {
    /// Computations at once.
    pub(super) threads: usize,
    /// Longest wait in a burst.
    pub(super) wait_max: Duration,
    /// Longest wait while there is more to do than can be done.
    pub(super) overload_wait_max: Duration,
    /// Most that wait.
    pub(super) waiting_max: usize,
}

/// Who asks for what.
#[derive(Debug, Clone)]
pub(super) struct Ask {
    /// Whose turn it takes.
    pub(super) caller: Arc<str>,
    /// What it resembles: computations of a kind cost about the same.
    pub(super) kind: Kind,
    /// When its answer is no longer of use.
    pub(super) deadline: Instant,
}

/// Names a computation from the moment it joins until it has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Ticket(u64);

/// Why a computation is not taken on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Refused {
    /// Which rule.
    pub(super) reason: RefusalReason,
    /// When what it would have waited for is done.
    pub(super) retry_after: Duration,
}

/// The rules by which computations are refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RefusalReason {
    /// The expected wait is too long.
    Backlog,
    /// Too many wait, and most of them are not this caller's rivals but its own.
    Full,
    /// It waited too long for its turn.
    Late,
}

impl RefusalReason {
    /// In the count of refusals.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Backlog => "backlog",
            Self::Full => "full",
            Self::Late => "late",
        }
    }
}

/// A place in the line.
#[derive(Debug)]
pub(super) struct Joined<J> {
    /// Whose.
    pub(super) ticket: Ticket,
    /// When to give up waiting for one's turn.
    pub(super) turn_by: Instant,
    /// Who had to leave for it.
    pub(super) displaced: Option<(J, Refused)>,
}

/// What a thread should do now.
#[derive(Debug)]
pub(super) enum Next<J> {
    /// Compute this, which waited so long, and say [`Line::ended`].
    Run(Ticket, Duration, J),
    /// Tell this one that it waited too long, and ask again.
    Refuse(J, Refused),
    /// Nothing.
    Rest,
}

/// Those who wait for one group of threads, and what these are at.
#[derive(Debug)]
pub(super) struct Line<J> {
    limits: LineLimits,
    /// Callers with somebody waiting; the first is next.
    turns: VecDeque<Turn<J>>,
    waiting: usize,
    running: Vec<Running>,
    costs: HashMap<Kind, Duration>,
    overload: Option<Overload>,
    tickets: u64,
}

/// First and last refusal with no long rest between any two.
#[derive(Debug, Clone, Copy)]
struct Overload {
    since: Instant,
    last: Instant,
}

#[derive(Debug)]
struct Turn<J> {
    caller: Arc<str>,
    jobs: VecDeque<Waiting<J>>,
}

#[derive(Debug)]
struct Waiting<J> {
    ticket: Ticket,
    kind: Kind,
    deadline: Instant,
    turn_by: Instant,
    since: Instant,
    job: J,
}

#[derive(Debug)]
struct Running {
    ticket: Ticket,
    kind: Kind,
    deadline: Instant,
    since: Instant,
}

impl<J> Line<J> {
    /// An empty line.
    pub(super) fn new(limits: LineLimits) -> Self {
        Self {
            limits,
            turns: VecDeque::new(),
            waiting: 0,
            running: Vec::with_capacity(limits.threads),
            costs: HashMap::new(),
            overload: None,
            tickets: 0,
        }
    }

    /// How many wait.
    pub(super) fn waiting(&self) -> usize {
        self.waiting
    }

    /// Joins the line.
    ///
    /// # Errors
    /// [`Refused`], at once, if it would have to wait too long or too many wait already.
    pub(super) fn join(&mut self, now: Instant, ask: Ask, job: J) -> Result<Joined<J>, Refused> {
        let Ask { caller, kind, deadline } = ask;
        let wait = self.expected_wait(now, &caller);
        let retry_after = retry_after(wait);
        if self.is_too_long(now, wait, &caller) {
            return Err(self.refuse(now, RefusalReason::Backlog, retry_after));
        }
        // That its own deadline is too near says nothing about the others.
        if wait > deadline.saturating_duration_since(now) {
            return Err(Refused { reason: RefusalReason::Backlog, retry_after });
        }
        let idle = self.limits.threads - self.running.len();
        let mut displaced = None;
        if self.waiting >= self.limits.waiting_max.saturating_add(idle) {
            let refused = self.refuse(now, RefusalReason::Full, retry_after);
            displaced = Some((self.displace(&caller).ok_or(refused)?, refused));
        }
        self.tickets += 1;
        let ticket = Ticket(self.tickets);
        // A thread that is free already only has to wake up.
        let is_next = wait.is_zero();
        let turn_by = if is_next { deadline } else { deadline.min(now + self.limits.wait_max) };
        let waiting = Waiting { ticket, kind, deadline, turn_by, since: now, job };
        match self.turns.iter_mut().find(|turn| turn.caller == caller) {
            Some(turn) => turn.jobs.push_back(waiting),
            None => self.turns.push_back(Turn { caller, jobs: VecDeque::from([waiting]) }),
        }
        self.waiting += 1;
        Ok(Joined { ticket, turn_by, displaced })
    }

    /// What a free thread should do.
    pub(super) fn next(&mut self, now: Instant) -> Next<J> {
        let Some(mut turn) = self.turns.pop_front() else { return Next::Rest };
        let Some(first) = turn.jobs.pop_front() else { return Next::Rest };
        self.waiting -= 1;
        if !turn.jobs.is_empty() {
            self.turns.push_back(turn);
        }
        let Waiting { ticket, kind, deadline, turn_by, since, job } = first;
        let waited = now.saturating_duration_since(since);
        // In an overload that lasts whoever waited too long makes way for somebody fresher, if there
        // is one. A burst is over by then.
        let makes_way =
            self.waiting > 0 && self.overload_lasts(now) && waited > self.overload_wait();
        if now >= turn_by || makes_way {
            return Next::Refuse(job, self.refuse(now, RefusalReason::Late, retry_after(waited)));
        }
        self.running.push(Running { ticket, kind, deadline, since: now });
        Next::Run(ticket, waited, job)
    }

    /// A computation has ended, well or not; what it cost is what the next of its kind will.
    pub(super) fn ended(&mut self, now: Instant, ticket: Ticket) {
        let Some(place) = self.running.iter().position(|running| running.ticket == ticket) else {
            return;
        };
        let Running { kind, since, .. } = self.running.swap_remove(place);
        let took = now.saturating_duration_since(since);
        self.costs.entry(kind).and_modify(|cost| *cost = (*cost * 7 + took) / 8).or_insert(took);
    }

    /// Leaves the line; `false` if its turn has come already.
    pub(super) fn leave(&mut self, ticket: Ticket) -> bool {
        let waits = |turn: &Turn<J>| turn.jobs.iter().position(|waiting| waiting.ticket == ticket);
        let found = self.turns.iter().enumerate().find_map(|(i, turn)| Some((i, waits(turn)?)));
        let Some((i, place)) = found else { return false };
        self.turns[i].jobs.remove(place);
        if self.turns[i].jobs.is_empty() {
            self.turns.remove(i);
        }
        self.waiting -= 1;
        true
    }

    /// The refusal of one that joined at `since` and left because its turn did not come: it can
    /// expect to wait as long again, or for what is ahead of its caller now.
    pub(super) fn late(&mut self, now: Instant, since: Instant, caller: &Arc<str>) -> Refused {
        let waited = now.saturating_duration_since(since);
        let wait = self.expected_wait(now, caller).max(waited);
        self.refuse(now, RefusalReason::Late, retry_after(wait))
    }

    /// How long a newcomer from `caller` would wait if everything took what its kind usually
    /// takes.
    pub(super) fn expected_wait(&self, now: Instant, caller: &Arc<str>) -> Duration {
        let idle = self.limits.threads - self.running.len();
        if self.waiting < idle {
            return Duration::ZERO;
        }
        let busy = self.running.iter().map(|running| Reverse(self.time_left(now, running)));
        let mut free_in: BinaryHeap<_> = busy.collect();
        free_in.extend((0..idle).map(|_| Reverse(Duration::ZERO)));
        for cost in self.costs_ahead_of(caller) {
            let Some(mut earliest) = free_in.peek_mut() else { break };
            earliest.0 += cost;
        }
        free_in.peek().map_or(Duration::MAX, |Reverse(earliest)| *earliest)
    }

    /// What those cost who would have their turn before a newcomer from `caller`: of everybody
    /// else as many as it has waiting itself, and one more of those whose turn comes sooner.
    fn costs_ahead_of(&self, caller: &Arc<str>) -> impl Iterator<Item = Duration> {
        let own = self.turns.iter().position(|turn| turn.caller == *caller);
        let own_waiting = own.map_or(0, |place| self.turns[place].jobs.len());
        let place = own.unwrap_or(self.turns.len());
        self.turns.iter().enumerate().flat_map(move |(i, turn)| {
            let rounds = own_waiting + usize::from(i < place);
            turn.jobs.iter().take(rounds).map(|waiting| self.cost(waiting.kind))
        })
    }

    /// What has lasted longer than usual is taken to last as long again, up to its deadline.
    fn time_left(&self, now: Instant, running: &Running) -> Duration {
        let elapsed = now.saturating_duration_since(running.since);
        let left = self.cost(running.kind).checked_sub(elapsed).unwrap_or(elapsed);
        left.min(running.deadline.saturating_duration_since(now)).max(Duration::from_nanos(1))
    }

    fn cost(&self, kind: Kind) -> Duration {
        self.costs.get(&kind).copied().unwrap_or(COST_UNKNOWN)
    }

    fn is_too_long(&self, now: Instant, wait: Duration, caller: &Arc<str>) -> bool {
        if !self.is_overloaded(now) {
            return wait > self.limits.wait_max;
        }
        let ahead_max = AHEAD_IN_OVERLOAD * self.limits.threads;
        wait > self.overload_wait()
            || self.costs_ahead_of(caller).take(ahead_max).count() == ahead_max
    }

    /// Longest wait while there is more to do than can be done.
    fn overload_wait(&self) -> Duration {
        self.limits.overload_wait_max.min(self.limits.wait_max)
    }

    fn is_overloaded(&self, now: Instant) -> bool {
        self.overload.is_some_and(|it| now.saturating_duration_since(it.last) < OVERLOAD_LASTS)
    }

    fn overload_lasts(&self, now: Instant) -> bool {
        self.is_overloaded(now) && self.overload.is_some_and(|it| now - it.since >= OVERLOAD_LASTS)
    }

    fn refuse(&mut self, now: Instant, reason: RefusalReason, retry_after: Duration) -> Refused {
        let since = self.overload.filter(|_| self.is_overloaded(now)).map_or(now, |it| it.since);
        self.overload = Some(Overload { since, last: now });
        Refused { reason, retry_after }
    }

    /// Takes the youngest job of whoever has most waiting, if that is more than `caller` would
    /// have.
    fn displace(&mut self, caller: &Arc<str>) -> Option<J> {
        let own = self.turns.iter().find(|turn| turn.caller == *caller);
        let fair = own.map_or(0, |turn| turn.jobs.len()) + 1;
        let longest = self.turns.iter_mut().max_by_key(|turn| turn.jobs.len())?;
        if longest.jobs.len() <= fair {
            return None;
        }
        let youngest = longest.jobs.pop_back()?;
        self.waiting -= 1;
        Some(youngest.job)
    }
}

#[cfg(test)]
mod tests {
    use super::{super::Task, *};

    const MS: Duration = Duration::from_millis(1);
    const STEP: Kind = Kind { task: Task::Step, method: None };

    /// A line on a clock that only the test moves.
    struct Clocked {
        line: Line<&'static str>,
        now: Instant,
    }

    impl Clocked {
        fn new(limits: LineLimits) -> Self {
            Self { line: Line::new(limits), now: Instant::now() }
        }

        fn join(
            &mut self,
            caller: &str,
            job: &'static str,
        ) -> Result<Joined<&'static str>, Refused> {
            let deadline = self.now + 1000 * MS;
            self.line.join(self.now, Ask { caller: caller.into(), kind: STEP, deadline }, job)
        }

        fn run(&mut self) -> (Ticket, &'static str) {
            match self.line.next(self.now) {
                Next::Run(ticket, _, job) => (ticket, job),
                other => panic!("{other:?}"),
            }
        }

        fn after(&mut self, time: Duration) {
            self.now += time;
        }

        /// One computation that takes `cost`, so that its kind is known to cost that.
        fn learn(&mut self, cost: Duration) {
            self.join("teacher", "lesson").unwrap();
            let (ticket, _) = self.run();
            self.after(cost);
            self.line.ended(self.now, ticket);
        }

        fn expected_wait(&self, caller: &str) -> Duration {
            self.line.expected_wait(self.now, &caller.into())
        }
    }

    fn limits(threads: usize) -> LineLimits {
        LineLimits { threads, wait_max: 50 * MS, overload_wait_max: 5 * MS, waiting_max: 100 }
    }

    #[test]
    fn line_callers_take_turns() {
        let mut line = Clocked::new(limits(1));
        for (caller, job) in
            [("a", "a1"), ("a", "a2"), ("a", "a3"), ("b", "b1"), ("c", "c1"), ("b", "b2")]
        {
            line.join(caller, job).unwrap();
        }
        let mut order = Vec::new();
        while let Next::Run(ticket, _, job) = line.line.next(line.now) {
            order.push(job);
            line.line.ended(line.now, ticket);
        }
        assert_eq!(order, ["a1", "b1", "c1", "a2", "b2", "a3"]);
        assert_eq!(line.line.waiting(), 0);
    }

    #[test]
    fn line_expected_wait_is_what_is_under_way_and_ahead() {
        let mut line = Clocked::new(limits(2));
        line.learn(8 * MS);
        assert_eq!(line.expected_wait("a"), Duration::ZERO);
        for job in ["a1", "a2"] {
            line.join("a", job).unwrap();
            line.run();
        }
        line.after(2 * MS);
        // Both threads are free in 6 ms; one job more takes one of them for 8 ms.
        assert_eq!(line.expected_wait("a"), 6 * MS);
        line.join("a", "a3").unwrap();
        assert_eq!(line.expected_wait("a"), 6 * MS);
        line.join("a", "a4").unwrap();
        assert_eq!(line.expected_wait("a"), 14 * MS);
        // Somebody else has one turn of `a` to wait for, not two.
        assert_eq!(line.expected_wait("b"), 6 * MS);
    }

    #[test]
    fn line_expected_wait_for_what_lasts_longer_than_usual_is_as_long_again() {
        let mut line = Clocked::new(limits(1));
        line.learn(2 * MS);
        line.join("a", "a1").unwrap();
        line.run();
        line.after(40 * MS);
        assert_eq!(line.expected_wait("b"), 40 * MS);
        line.after(940 * MS);
        // It ends at its deadline, 20 ms from here.
        assert_eq!(line.expected_wait("b"), 20 * MS);
    }

    #[test]
    fn line_refuses_at_once_whoever_would_wait_too_long_and_says_when_to_return() {
        let mut line = Clocked::new(limits(1));
        line.learn(20 * MS);
        line.join("a", "a1").unwrap();
        line.run();
        line.join("a", "a2").unwrap();
        line.join("a", "a3").unwrap();
        // Fair: whoever asks for the first time waits for one of them.
        assert_eq!(line.expected_wait("b"), 40 * MS);
        let refused = line.join("a", "a4").unwrap_err();
        let expected = Refused { reason: RefusalReason::Backlog, retry_after: 60 * MS };
        assert_eq!(refused, expected);
    }

    #[test]
    fn line_refuses_whoever_would_wait_beyond_its_deadline() {
        let mut line = Clocked::new(limits(1));
        line.learn(20 * MS);
        line.join("a", "a1").unwrap();
        line.run();
        let deadline = line.now + 10 * MS;
        let ask = Ask { caller: "b".into(), kind: STEP, deadline };
        let refused = line.line.join(line.now, ask, "b1").unwrap_err();
        assert_eq!(refused, Refused { reason: RefusalReason::Backlog, retry_after: 20 * MS });
    }

    #[test]
    fn line_takes_a_burst_but_no_standing_wait() {
        let mut line = Clocked::new(limits(1));
        line.learn(4 * MS);
        let (mut waits, mut refused, mut running) = (Vec::new(), 0, None);
        for _ in 0..100 {
            // Two join for each that is served: twice what the thread can do.
            for _ in 0..2 {
                refused += usize::from(line.join("a", "job").is_err());
            }
            if let Some(ticket) = running.take() {
                line.line.ended(line.now, ticket);
            }
            loop {
                match line.line.next(line.now) {
                    Next::Run(ticket, waited, _) => {
                        waits.push(waited);
                        running = Some(ticket);
                        break;
                    }
                    Next::Refuse(..) => refused += 1,
                    Next::Rest => break,
                }
            }
            line.after(4 * MS);
        }
        assert_eq!(waits.len(), 100, "the thread was never idle");
        assert!((85..=100).contains(&refused), "{refused} of 200 refused");
        let longest = |waits: &[Duration]| waits.iter().max().copied().unwrap();
        assert!(longest(&waits[..40]) > 40 * MS && longest(&waits[..40]) <= 50 * MS);
        assert!(longest(&waits[40..]) <= 5 * MS, "{:?}", longest(&waits[40..]));
        // When nobody was refused for a while, a burst is welcome again.
        assert!(line.line.is_overloaded(line.now));
        line.after(OVERLOAD_LASTS);
        assert!(!line.line.is_overloaded(line.now));
    }

    #[test]
    fn line_stays_short_in_overload_however_short_computations_are() {
        let mut line = Clocked::new(limits(1));
        line.learn(MS);
        line.join("a", "a0").unwrap();
        let (mut running, _) = line.run();
        while line.join("a", "more").is_ok() {}
        assert_eq!(line.expected_wait("a"), 51 * MS);
        while line.line.waiting() > AHEAD_IN_OVERLOAD {
            assert!(line.join("a", "too many").is_err());
            line.after(MS);
            line.line.ended(line.now, running);
            running = line.run().0;
        }
        assert!(line.join("a", "too many").is_err());
        // Who has nobody waiting has one of `a` ahead, and so on.
        line.join("b", "b1").unwrap();
        line.join("b", "b2").unwrap();
        assert!(line.join("b", "b3").is_err());
    }

    #[test]
    fn line_refuses_who_waited_longer_than_anybody_may() {
        let mut line = Clocked::new(limits(1));
        line.join("a", "a1").unwrap();
        line.join("a", "a2").unwrap();
        let (ticket, _) = line.run();
        line.after(60 * MS);
        line.line.ended(line.now, ticket);
        let Next::Refuse(job, refused) = line.line.next(line.now) else { panic!("not refused") };
        let expected = Refused { reason: RefusalReason::Late, retry_after: 60 * MS };
        assert_eq!((job, refused), ("a2", expected));
    }

    #[test]
    fn line_in_a_lasting_overload_prefers_who_came_later_to_who_waited_too_long() {
        let mut line = Clocked::new(limits(1));
        line.learn(MS);
        while line.join("a", "burst").is_ok() {}
        for _ in 0..3 {
            line.after(50 * MS);
            assert!(line.join("a", "too many").is_err());
        }
        while let Next::Refuse(..) = line.line.next(line.now) {}
        line.join("a", "a1").unwrap();
        line.after(6 * MS);
        line.join("a", "a2").unwrap();
        let Next::Refuse(job, refused) = line.line.next(line.now) else { panic!("not refused") };
        let expected = Refused { reason: RefusalReason::Late, retry_after: RETRY_AFTER.0 };
        assert_eq!((job, refused), ("a1", expected));
        let (ticket, job) = line.run();
        assert_eq!(job, "a2");
        line.line.ended(line.now, ticket);
        // Nobody came after this one: it is computed, however long it waited.
        line.join("a", "a3").unwrap();
        line.after(6 * MS);
        assert_eq!(line.run().1, "a3");
    }

    #[test]
    fn line_refuses_who_comes_to_its_turn_after_its_deadline() {
        let mut line = Clocked::new(limits(1));
        let deadline = line.now + 10 * MS;
        let ask = Ask { caller: "a".into(), kind: STEP, deadline };
        line.line.join(line.now, ask, "a1").unwrap();
        line.after(10 * MS);
        assert!(matches!(line.line.next(line.now), Next::Refuse("a1", _)));
        assert!(matches!(line.line.next(line.now), Next::Rest));
    }

    #[test]
    fn line_full_displaces_the_youngest_of_the_greediest() {
        let mut line = Clocked::new(LineLimits { waiting_max: 3, ..limits(1) });
        line.learn(MS);
        line.join("a", "a0").unwrap();
        line.run();
        for job in ["a1", "a2", "a3"] {
            line.join("a", job).unwrap();
        }
        assert_eq!(line.join("a", "a4").unwrap_err().reason, RefusalReason::Full);
        let joined = line.join("b", "b1").unwrap();
        let (job, refused) = joined.displaced.unwrap();
        assert_eq!((job, refused.reason), ("a3", RefusalReason::Full));
        // Two of `a`, one of `b`: a second of `b` would be no fairer.
        assert!(line.join("b", "b2").is_err());
        assert_eq!(line.line.waiting(), 3);
    }

    #[test]
    fn line_who_leaves_is_not_served() {
        let mut line = Clocked::new(limits(1));
        let first = line.join("a", "a1").unwrap().ticket;
        let second = line.join("a", "a2").unwrap().ticket;
        assert!(line.line.leave(first));
        assert!(!line.line.leave(first));
        assert_eq!(line.run(), (second, "a2"));
        assert!(!line.line.leave(second));
    }

    #[test]
    fn line_learns_what_a_kind_costs() {
        let mut line = Clocked::new(limits(1));
        assert_eq!(line.line.cost(STEP), COST_UNKNOWN);
        line.learn(8 * MS);
        assert_eq!(line.line.cost(STEP), 8 * MS);
        line.learn(16 * MS);
        assert_eq!(line.line.cost(STEP), 9 * MS);
        let other = Kind { task: Task::Plan, method: None };
        assert_eq!(line.line.cost(other), COST_UNKNOWN);
    }
}
