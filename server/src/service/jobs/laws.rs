//! Jobs against a model of them: random orders, ends and accidents, whoever does the jobs.
//!
//! The model knows how each job stands and what may come next; after every command all that
//! callers see must be one of that. `PROPTEST_CASES` sets how many sequences are tried; a failure
//! prints the shortest that fails.

use std::{collections::BTreeMap, env, sync::Arc, thread};

use proptest::{prelude::*, test_runner::TestRunner};

use super::*;
use crate::{
    service::{
        clock::tests::Hands,
        jobs::fixture::{CANNOT, Counting, LIMITS, PANICS, Stage},
    },
    store::MemoryShared,
    telemetry::Metrics,
};

const LEASE: Duration = Duration::from_millis(150);
/// Jobs: what is made of one shard and of three, what cannot be made, and what is a bug.
const NAMES: [u8; 4] = [1, 3, CANNOT, PANICS];
const UNFINISHED_MAX: usize = 2;
const PATIENCE: Duration = Duration::from_secs(30);

#[derive(Debug, Clone, Copy)]
enum Who {
    Single,
    Fleet,
}

#[derive(Debug, Clone)]
enum Command {
    /// Orders a job, perhaps under a request id.
    Submit(u8, Option<u8>),
    Cancel(u8),
    Delete(u8),
    /// So many shards may be computed.
    LetGo(usize),
    /// What was made is gone.
    Expire(u8),
    Sweep,
    /// Long after everything ended.
    SweepLater,
    /// The node dies, and another takes its place.
    Kill,
    /// The node ends as it should, and another takes its place.
    Restart,
    /// Nothing in the store answers, or everything does again.
    Down(bool),
    /// Everything is let go until every job has ended.
    Finish,
}

fn commands() -> impl Strategy<Value = Vec<Command>> {
    let name = || proptest::sample::select(&NAMES[..]);
    let command = prop_oneof![
        6 => (name(), proptest::option::of(0..3_u8)).prop_map(|(n, r)| Command::Submit(n, r)),
        2 => name().prop_map(Command::Cancel),
        2 => name().prop_map(Command::Delete),
        3 => (1..4_usize).prop_map(Command::LetGo),
        1 => name().prop_map(Command::Expire),
        1 => Just(Command::Sweep),
        1 => Just(Command::SweepLater),
        2 => Just(Command::Kill),
        2 => Just(Command::Restart),
        2 => any::<bool>().prop_map(Command::Down),
        1 => Just(Command::Finish),
    ];
    proptest::collection::vec(command, 1..24)
}

/// A job as the model has it.
#[derive(Debug, Clone)]
struct Expected {
    created: SystemTime,
    /// How it ended, once that was seen.
    ending: Option<Ending>,
    /// Nodes that died under it.
    kills: u32,
    /// It may have ended while nothing could be written down.
    is_unwritten: bool,
}

struct World {
    who: Who,
    stage: Arc<Stage>,
    first: Arc<MemoryShared>,
    store: Arc<MemoryShared>,
    hands: Hands,
    jobs: Arc<dyn Jobs<Counting>>,
    is_down: bool,
    expected: BTreeMap<u8, Expected>,
    requests: BTreeMap<u8, u8>,
}

fn id(name: u8) -> ArtifactId {
    ArtifactId([name; 32])
}

/// Shards of a job.
fn shards(name: u8) -> u8 {
    if name == 3 { 3 } else { 1 }
}

fn open(
    who: Who,
    stage: &Arc<Stage>,
    store: &Arc<MemoryShared>,
    hands: &Hands,
    threads: usize,
) -> Arc<dyn Jobs<Counting>> {
    let stage = Arc::clone(stage);
    let restore = move |_, problem: &[u8]| {
        Ok(Counting { name: problem[0], shards: problem[1].into(), stage: Arc::clone(&stage) })
    };
    let limits = JobLimits { threads, unfinished_max: UNFINISHED_MAX, ..LIMITS };
    let metrics = Arc::new(Metrics::new());
    let (store, clock) = (Arc::clone(store), hands.clock());
    match who {
        Who::Single => Arc::new(Single::open(store, clock, limits, metrics, restore).unwrap()),
        Who::Fleet => {
            Arc::new(Fleet::open(store, clock, limits, metrics, Box::new(restore)).unwrap())
        }
    }
}

impl World {
    fn new(who: Who) -> Self {
        let first = Arc::new(MemoryShared::new(LEASE));
        let (stage, store) = (Arc::<Stage>::default(), Arc::new(first.another()));
        let hands = Hands::new();
        let jobs = open(who, &stage, &store, &hands, LIMITS.threads);
        let (expected, requests) = (BTreeMap::new(), BTreeMap::new());
        Self { who, stage, first, store, hands, jobs, is_down: false, expected, requests }
    }

    fn is_made(&self, name: u8) -> bool {
        self.stage.made.lock().unwrap().contains_key(&name)
    }

    fn run(&mut self, command: &Command) {
        match *command {
            Command::Submit(name, request) => self.submit(name, request),
            Command::Cancel(name) => self.cancel(name),
            Command::Delete(name) => self.delete(name),
            Command::LetGo(shards) => self.stage.let_go(shards),
            Command::Expire(name) => drop(self.stage.made.lock().unwrap().remove(&name)),
            Command::Sweep => self.sweep(),
            Command::SweepLater => self.sweep_later(),
            Command::Kill => self.kill(),
            Command::Restart => self.restart(),
            Command::Down(is_down) => self.set_down(is_down),
            Command::Finish => self.finish(),
        }
        self.look();
    }

    /// Everything that callers can see is what the model allows; the model learns what ended.
    fn look(&mut self) {
        for name in NAMES {
            let seen = self.jobs.view(id(name));
            let Some(expected) = self.expected.get_mut(&name) else {
                let error = seen.expect_err("a job that nobody ordered");
                assert_eq!(error.code, Code::NotFound, "{name}");
                continue;
            };
            let view = seen.unwrap_or_else(|error| panic!("job {name} is forgotten: {error:?}"));
            let Progress { shards_done, shards_total, created, .. } = view.progress;
            assert_eq!(created, expected.created, "job {name} became another");
            assert!(shards_done <= shards_total, "{shards_done} of {shards_total} of {name}");
            match (&expected.ending, view.ending) {
                (Some(before), now) => {
                    assert_eq!(Some(before), now.as_ref(), "job {name} ended otherwise");
                }
                (None, Some(ending)) => {
                    check_ending(name, &ending, expected);
                    if ending == Ending::Made {
                        assert_eq!(shards_done, shards_total, "made of {name}");
                    }
                    expected.ending = Some(ending);
                    expected.is_unwritten |= self.is_down;
                }
                (None, None) => {}
            }
        }
    }

    fn submit(&mut self, name: u8, request: Option<u8>) {
        self.look();
        // Jobs are told apart by when they were created, to the millisecond.
        thread::sleep(Duration::from_millis(2));
        let before = self.expected.get(&name).cloned();
        let unfinished = self.expected.values().filter(|job| job.ending.is_none()).count();
        let is_made = self.is_made(name);
        let work = Counting { name, shards: shards(name).into(), stage: Arc::clone(&self.stage) };
        let answer = self.jobs.submit(Order {
            id: id(name),
            work,
            problem: vec![name, shards(name)].into(),
            request_id: request.map(|request| format!("request {request}")),
            is_made,
        });
        let known = request.and_then(|request| self.requests.get(&request).copied());
        let view = match answer {
            Ok(view) => view,
            Err(error) => {
                match error.reason {
                    "STORE_UNAVAILABLE" => assert!(self.is_down, "{error:?}"),
                    "REQUEST_ID_REUSED" => assert!(known.is_some_and(|known| known != name)),
                    "QUEUE_FULL" => {
                        assert!(unfinished >= UNFINISHED_MAX && !is_made, "{unfinished}");
                        // The id was noted before it was known that there is no room.
                        request.map(|request| self.requests.entry(request).or_insert(name));
                    }
                    _ => panic!("job {name}: {error:?}"),
                }
                return;
            }
        };
        assert!(known.is_none_or(|known| known == name), "request {request:?} names two jobs");
        if let Some(request) = request {
            self.requests.insert(request, name);
        }
        let created = view.progress.created;
        match before {
            Some(before) if before.created == created => {
                let ending = before.ending.as_ref();
                assert!(stays(ending, is_made, known.is_some()), "{name} is not made: {ending:?}");
            }
            Some(Expected { ending: Some(ending), .. }) => {
                let must_stay = stays(Some(&ending), is_made, known.is_some());
                assert!(!must_stay, "job {name}, which ended as {ending:?}, was made anew");
            }
            // It may have ended just before the order came.
            Some(Expected { ending: None, .. }) | None => {}
        }
        if self.expected.get(&name).is_none_or(|job| job.created != created) {
            let new = Expected { created, ending: None, kills: 0, is_unwritten: false };
            self.expected.insert(name, new);
        }
        if is_made {
            let ending = view.ending;
            assert!(
                matches!(ending, Some(Ending::Made | Ending::Infeasible(_)) | None)
                    || known.is_some(),
                "{ending:?} for job {name}, whose product is there"
            );
        }
    }

    fn cancel(&mut self, name: u8) {
        self.look();
        let before = self.expected.get(&name).map(|job| job.ending.clone());
        match (self.jobs.cancel(id(name)), before) {
            (Ok(()), Some(Some(_))) => {}
            (Ok(()), Some(None)) => {
                let view = self.jobs.view(id(name)).unwrap();
                assert!(view.ending.is_some(), "job {name} goes on after it was cancelled");
            }
            (Err(error), None) if error.code == Code::NotFound => {}
            (Err(error), _) => assert!(self.is_down, "job {name}: {error:?}"),
            (Ok(()), None) => panic!("job {name}, which is not there, was cancelled"),
        }
    }

    fn delete(&mut self, name: u8) {
        self.look();
        let before = self.expected.get(&name).map(|job| job.ending.is_some());
        match (self.jobs.delete(id(name)), before) {
            (Ok(()), Some(_)) => drop(self.expected.remove(&name)),
            (Err(error), None) if error.code == Code::NotFound => {}
            (Err(error), Some(false)) if error.reason == "OPERATION_RUNNING" => {}
            (Err(error), _) => assert!(self.is_down, "job {name}: {error:?}"),
            (Ok(()), None) => panic!("job {name}, which is not there, was deleted"),
        }
    }

    fn sweep(&mut self) {
        self.jobs.sweep();
        if !self.is_down {
            self.expected.values_mut().for_each(|job| job.is_unwritten = false);
        }
    }

    /// Forgets what ended and every request id: by a node that does no parts, because they would all
    /// be late by its clock.
    fn sweep_later(&mut self) {
        self.look();
        if self.is_down {
            return self.jobs.sweep();
        }
        self.kill_for_one_with(0);
        self.look();
        self.hands.pass(2 * LIMITS.kept_for);
        self.jobs.sweep();
        self.requests.clear();
        let jobs = &self.jobs;
        self.expected.retain(|name, job| {
            let is_there = jobs.view(id(*name)).is_ok();
            assert!(!is_there || job.ending.is_none(), "job {name} is too old");
            is_there
        });
        self.kill();
    }

    fn set_down(&mut self, is_down: bool) {
        self.look();
        if self.is_down && !is_down {
            // It may end just before the store answers again.
            let unfinished = self.expected.values_mut().filter(|job| job.ending.is_none());
            unfinished.for_each(|job| job.is_unwritten = true);
        }
        self.is_down = is_down;
        self.store.set_down(is_down);
    }

    fn kill(&mut self) {
        self.kill_for_one_with(LIMITS.threads);
    }

    fn kill_for_one_with(&mut self, threads: usize) {
        self.look();
        self.store.set_down(true);
        self.jobs.stop(PATIENCE);
        for job in self.expected.values_mut() {
            // What a dead node said alone, nobody knows.
            if job.is_unwritten && matches!(self.who, Who::Single) {
                job.ending = None;
            }
            if job.ending.is_none() {
                job.kills += 1;
            }
        }
        self.reopen(threads);
    }

    fn restart(&mut self) {
        if self.is_down {
            // A node that cannot write anything down ends as if it had died.
            return self.kill();
        }
        self.look();
        // What ended while nothing could be written down is written down now.
        self.jobs.stop(PATIENCE);
        self.look_at_what_ended_on_the_way();
        self.reopen(LIMITS.threads);
    }

    fn look_at_what_ended_on_the_way(&mut self) {
        for (name, job) in &mut self.expected {
            if let (None, Ok(view)) = (&job.ending, self.jobs.view(id(*name)))
                && let Some(ending) = view.ending
            {
                check_ending(*name, &ending, job);
                job.ending = Some(ending);
            }
        }
    }

    fn reopen(&mut self, threads: usize) {
        self.store = Arc::new(self.first.another());
        self.hands = Hands::new();
        self.jobs = open(self.who, &self.stage, &self.store, &self.hands, threads);
        self.is_down = false;
        for job in self.expected.values_mut() {
            job.is_unwritten = false;
        }
    }

    /// Every job ends at last: none is forgotten.
    fn finish(&mut self) {
        self.set_down(false);
        let until = Instant::now() + PATIENCE;
        loop {
            self.stage.let_go(8);
            self.jobs.sweep();
            self.look();
            if self.expected.values().all(|job| job.ending.is_some()) {
                return;
            }
            assert!(Instant::now() < until, "jobs that never end: {:?}", self.expected);
            thread::sleep(Duration::from_millis(5));
        }
    }
}

/// The ways in which a job of this name can end.
fn check_ending(name: u8, ending: &Ending, job: &Expected) {
    let failed_as = |reason: &str| match ending {
        Ending::Failed(failure) => failure.reason == reason,
        _ => false,
    };
    let may_be = match name {
        CANNOT => matches!(ending, Ending::Infeasible(_)),
        PANICS => failed_as("PANIC"),
        _ => *ending == Ending::Made,
    };
    let is_given_up = failed_as("GIVEN_UP") && job.kills >= LIMITS.attempts_max;
    assert!(
        may_be || *ending == Ending::Cancelled || is_given_up,
        "job {name} ended as {ending:?}: {job:?}"
    );
}

fn check(who: Who, cases: u32) {
    let cases = env::var("PROPTEST_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(cases);
    let config = ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(cases) };
    let run = |commands: Vec<Command>| {
        let mut world = World::new(who);
        for command in &commands {
            world.run(command);
        }
        world.run(&Command::Finish);
        world.jobs.stop(PATIENCE);
        Ok(())
    };
    TestRunner::new(config).run(&commands(), run).unwrap_or_else(|failure| panic!("{failure}"));
}

#[test]
fn jobs_of_one_process_stand_as_the_model_says() {
    check(Who::Single, 32);
}

#[test]
fn jobs_of_many_machines_stand_as_the_model_says() {
    check(Who::Fleet, 12);
}
