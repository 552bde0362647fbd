//! Several machines in one process, some of which die.

use super::*;
use crate::{
    service::{
        clock::Clock,
        jobs::fixture::{Counting, LIMITS, Stage},
    },
    store::{MemoryShared, Store as _},
    wire::Standing,
};

const LEASE: Duration = Duration::from_millis(200);

fn id(name: u8) -> ArtifactId {
    ArtifactId([name; 32])
}

/// All machines' store, and the stage of their work.
struct Machines {
    store: Arc<MemoryShared>,
    stage: Arc<Stage>,
}

struct Machine {
    fleet: Fleet<Counting>,
    store: Arc<MemoryShared>,
}

impl std::ops::Deref for Machine {
    type Target = Fleet<Counting>;

    fn deref(&self) -> &Fleet<Counting> {
        &self.fleet
    }
}

impl Machine {
    /// It dies: its leases run out, nothing is handed back.
    fn kill(self) {
        self.store.set_down(true);
        self.fleet.stop(Duration::from_secs(30));
    }
}

impl Machines {
    fn new() -> Self {
        Self { store: Arc::new(MemoryShared::new(LEASE)), stage: Arc::default() }
    }

    /// One more, with so many threads for parts.
    fn open(&self, threads: usize) -> Machine {
        let stage = Arc::clone(&self.stage);
        let restore = move |_, problem: &[u8]| {
            Ok(Counting { name: problem[0], shards: problem[1].into(), stage: Arc::clone(&stage) })
        };
        let limits = JobLimits { threads, ..LIMITS };
        let store = Arc::new(self.store.another());
        let shared = Arc::clone(&store) as _;
        let (clock, metrics) = (Arc::new(Clock::of_system()), Arc::new(Metrics::new()));
        let fleet = Fleet::open(shared, clock, limits, metrics, Box::new(restore));
        Machine { fleet: fleet.unwrap(), store }
    }

    fn order(&self, node: &Fleet<Counting>, name: u8, shards: u8) -> View {
        let work = Counting { name, shards: shards.into(), stage: Arc::clone(&self.stage) };
        let problem = vec![name, shards].into();
        let is_made = work.is_made().unwrap();
        node.submit(Order { id: id(name), work, problem, request_id: None, is_made }).unwrap()
    }
}

fn until(what: &str, there: impl Fn() -> bool) {
    let patience = Instant::now() + Duration::from_secs(30);
    while !there() {
        assert!(Instant::now() < patience, "not {what}");
        thread::sleep(Duration::from_millis(1));
    }
}

fn standing(node: &Fleet<Counting>, name: u8) -> Standing {
    node.watch(id(name)).unwrap().0.progress.standing
}

fn made(node: &Fleet<Counting>, name: u8) -> bool {
    standing(node, name) == Standing::Succeeded
}

#[test]
fn fleet_machines_share_a_job_and_all_see_it() {
    let machines = Machines::new();
    let (node, workers) = (machines.open(0), [machines.open(1), machines.open(1)]);
    machines.order(&node, 1, 100);
    until("two shards begun", || machines.stage.begun().len() >= 2);
    assert!(machines.store.waiting() <= WINDOW, "{}", machines.store.waiting());
    machines.stage.let_go(100);
    until("made", || made(&node, 1));
    assert!(workers.iter().all(|worker| made(worker, 1)));
    assert_eq!(machines.stage.made.lock().unwrap()[&1], (0..100).collect::<Vec<_>>());
    assert_eq!(machines.stage.begun().len(), 100, "each shard once");
    // Nothing is left of it but its record.
    until("cleared", || {
        let left = |shelf| machines.store.list(shelf, None, 999).unwrap().len();
        left(Shelf::Problems) + left(Shelf::Shards) + machines.store.waiting() == 0
    });
}

#[test]
fn fleet_short_job_does_not_wait_for_a_long_one() {
    let machines = Machines::new();
    let node = machines.open(0);
    machines.order(&node, 1, 200);
    machines.order(&node, 2, 1);
    machines.stage.let_go(usize::from(u8::MAX));
    let _worker = machines.open(1);
    until("both made", || made(&node, 1) && made(&node, 2));
    let short = machines.stage.begun().iter().position(|&(name, _)| name == 2).unwrap();
    assert!(short <= WINDOW, "{short}");
}

#[test]
fn fleet_part_of_a_dead_machine_is_done_by_another() {
    let machines = Machines::new();
    let (node, dying) = (machines.open(0), machines.open(1));
    machines.order(&node, 1, 3);
    until("begun", || machines.stage.begun().len() == 1);
    dying.kill();
    let _worker = machines.open(1);
    machines.stage.let_go(100);
    until("made", || made(&node, 1));
    assert_eq!(machines.stage.made.lock().unwrap()[&1], [0, 1, 2]);
}

#[test]
fn fleet_part_that_kills_its_machine_each_time_is_given_up_and_says_so() {
    let machines = Machines::new();
    let node = machines.open(0);
    machines.order(&node, 1, 1);
    for time in 1..=LIMITS.attempts_max as usize {
        let dying = machines.open(1);
        until("begun", || machines.stage.begun().len() == time);
        dying.kill();
    }
    let _worker = machines.open(1);
    until("failed", || standing(&node, 1) == Standing::Failed);
    let Some(Ending::Failed(failure)) = node.watch(id(1)).unwrap().0.ending else { panic!() };
    assert_eq!(failure.reason, "GIVEN_UP");
    assert_eq!(machines.stage.begun().len(), LIMITS.attempts_max as usize);
}

#[test]
fn fleet_part_handed_back_is_not_counted_as_an_attempt() {
    let machines = Machines::new();
    let node = machines.open(0);
    machines.order(&node, 1, 1);
    for time in 1..=2 * LIMITS.attempts_max as usize {
        let worker = machines.open(1);
        until("begun", || machines.stage.begun().len() == time);
        worker.stop(Duration::from_secs(30));
    }
    machines.stage.let_go(1);
    let _worker = machines.open(1);
    until("made", || made(&node, 1));
}

#[test]
fn fleet_job_whose_tasks_were_lost_is_queued_afresh() {
    let machines = Machines::new();
    let (node, other) = (machines.open(0), machines.open(0));
    machines.order(&node, 1, 3);
    machines.stage.let_go(100);
    machines.store.lose_tasks();
    let _worker = machines.open(1);
    let patience = Instant::now() + Duration::from_secs(30);
    while !made(&node, 1) {
        assert!(Instant::now() < patience);
        node.sweep();
        other.sweep();
        thread::sleep(LEASE / 4);
    }
    assert_eq!(machines.stage.begun().len(), 3);
}

#[test]
fn fleet_shard_that_is_damaged_or_gone_is_made_again() {
    let machines = Machines::new();
    let (node, worker) = (machines.open(0), machines.open(1));
    machines.order(&node, 1, 3);
    until("begun", || machines.stage.begun().len() == 1);
    machines.stage.let_go(2);
    until("two done", || machines.stage.begun().len() == 3);
    let shards = machines.store.list(Shelf::Shards, None, 9).unwrap();
    assert_eq!(shards.len(), 2);
    machines.store.remove(Shelf::Shards, &shards[0]).unwrap();
    machines.store.remove(Shelf::Shards, &shards[1]).unwrap();
    let bad = bytes::Bytes::from_static(b"not a shard");
    machines.store.put_if_absent(Shelf::Shards, &shards[1], bad).unwrap();
    machines.stage.let_go(100);
    until("made", || made(&node, 1));
    assert_eq!(machines.stage.made.lock().unwrap()[&1], [0, 1, 2]);
    drop(worker);
}

#[test]
fn fleet_store_that_is_gone_for_a_while_loses_nothing() {
    let machines = Machines::new();
    let (node, worker) = (machines.open(0), machines.open(1));
    machines.order(&node, 1, 3);
    until("begun", || machines.stage.begun().len() == 1);
    [&node, &worker].iter().for_each(|machine| machine.store.set_down(true));
    let work = Counting { name: 2, shards: 1, stage: Arc::clone(&machines.stage) };
    let problem = vec![2, 1].into();
    let order = Order { id: id(2), work, problem, request_id: None, is_made: false };
    assert_eq!(node.submit(order).unwrap_err().reason, "STORE_UNAVAILABLE");
    machines.stage.let_go(100);
    thread::sleep(LEASE);
    [&node, &worker].iter().for_each(|machine| machine.store.set_down(false));
    until("made", || made(&node, 1));
    machines.order(&node, 2, 1);
    until("made", || made(&node, 2));
}

#[test]
fn fleet_left_over_of_the_dead_is_removed_when_it_is_old() {
    let machines = Machines::new();
    let node = machines.open(0);
    machines.order(&node, 1, 1);
    let (old, needed) = (Ticket::fresh(), node.inner.mirror.tickets()[0]);
    for (shelf, id) in [(Shelf::Problems, old.problem()), (Shelf::Shards, old.shard(3))] {
        machines.store.put_if_absent(shelf, &id, "left".into()).unwrap();
    }
    let now = SystemTime::now();
    node.inner.remove_left(now - Duration::from_secs(60)).unwrap();
    assert_eq!(machines.store.list(Shelf::Shards, None, 9).unwrap(), [old.shard(3)]);
    node.inner.remove_left(now + Duration::from_secs(60)).unwrap();
    assert!(machines.store.list(Shelf::Shards, None, 9).unwrap().is_empty());
    assert_eq!(machines.store.list(Shelf::Problems, None, 9).unwrap(), [needed.problem()]);
}

#[test]
fn fleet_job_missing_when_all_is_told_again_is_asked_for_before_it_is_forgotten() {
    let machines = Machines::new();
    let node = machines.open(0);
    for name in [1, 2] {
        machines.order(&node, name, 1);
    }
    // A machine that was cut off hears of all again, of which these are none.
    machines.store.erase_untold(Ledger::Jobs, &id(2).0);
    node.inner.mirror.apply(Change::All(Vec::new()));
    assert!(node.watch(id(1)).is_ok() && node.watch(id(2)).is_ok());
    node.sweep();
    assert!(node.watch(id(1)).is_ok(), "it is in the store");
    assert!(node.watch(id(2)).is_err(), "it is not");
    assert!(node.inner.mirror.missing().is_empty());
}
