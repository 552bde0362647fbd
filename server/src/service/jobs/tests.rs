//! What callers see of jobs is the same whoever does them.

use std::{sync::Arc, thread};

use super::*;
use crate::{
    service::{
        clock::{Clock, tests::Hands},
        jobs::fixture::{CANNOT, Counting, LIMITS, PANICS, Stage},
    },
    store::{Ledger, MemoryShared, MemoryStore, Store},
    telemetry::Metrics,
    wire::Standing,
};

/// What does the jobs.
#[derive(Debug, Clone)]
enum By {
    Single(Arc<MemoryStore>),
    Fleet(Arc<MemoryShared>),
}

impl By {
    fn single() -> Self {
        Self::Single(Arc::new(MemoryStore::new(1 << 20)))
    }

    fn fleet() -> Self {
        Self::Fleet(Arc::new(MemoryShared::new(Duration::from_millis(400))))
    }

    fn store(&self) -> Arc<dyn Store> {
        match self {
            Self::Single(store) => Arc::clone(store) as _,
            Self::Fleet(store) => Arc::clone(store) as _,
        }
    }

    /// A node on the store.
    fn open(
        &self,
        stage: &Arc<Stage>,
        clock: Arc<Clock>,
        limits: JobLimits,
    ) -> Arc<dyn Jobs<Counting>> {
        let metrics = Arc::new(Metrics::new());
        let stage = Arc::clone(stage);
        let restore = move |_, problem: &[u8]| {
            Ok(Counting { name: problem[0], shards: problem[1].into(), stage: Arc::clone(&stage) })
        };
        match self {
            Self::Single(store) => {
                let store = Arc::clone(store) as _;
                Arc::new(Single::open(store, clock, limits, metrics, restore).unwrap())
            }
            Self::Fleet(store) => {
                let store = Arc::clone(store) as _;
                Arc::new(Fleet::open(store, clock, limits, metrics, Box::new(restore)).unwrap())
            }
        }
    }
}

struct Fixture {
    by: By,
    stage: Arc<Stage>,
    hands: Hands,
    jobs: Arc<dyn Jobs<Counting>>,
}

fn fixture(by: &By, limits: JobLimits) -> Fixture {
    let stage = Arc::<Stage>::default();
    let hands = Hands::new();
    let jobs = by.open(&stage, hands.clock(), limits);
    Fixture { by: by.clone(), stage, hands, jobs }
}

/// Makes a test for each of those who do jobs of every function named.
macro_rules! whoever_does_them {
    ($($name:ident),* $(,)?) => {
        mod single {
            $(#[tokio::test]
            async fn $name() {
                super::$name(&super::By::single()).await;
            })*
        }
        mod fleet {
            $(#[tokio::test]
            async fn $name() {
                super::$name(&super::By::fleet()).await;
            })*
        }
    };
}

fn id(name: u8) -> ArtifactId {
    ArtifactId([name; 32])
}

impl Fixture {
    fn order(&self, name: u8, shards: u8, request_id: Option<&str>) -> Result<View, Error> {
        let work = Counting { name, shards: shards.into(), stage: Arc::clone(&self.stage) };
        self.jobs.submit(Order {
            id: id(name),
            is_made: work.is_made()?,
            work,
            problem: vec![name, shards].into(),
            request_id: request_id.map(str::to_owned),
        })
    }

    async fn ended(&self, name: u8) -> View {
        let view = self.jobs.wait(id(name), Instant::now() + Duration::from_secs(30)).await;
        let view = view.unwrap();
        assert!(view.ending.is_some(), "{view:?}");
        view
    }

    /// Waits until so many shards were begun.
    fn until_begun(&self, shards: usize) {
        let patience = Instant::now() + Duration::from_secs(30);
        while self.stage.begun().len() < shards {
            assert!(Instant::now() < patience, "begun: {:?}", self.stage.begun());
            thread::sleep(Duration::from_millis(1));
        }
    }

    fn standing(&self, name: u8) -> Standing {
        self.jobs.view(id(name)).unwrap().progress.standing
    }

    /// Waits until a job is as far as that.
    fn until(&self, name: u8, there: impl Fn(&View) -> bool) {
        let patience = Instant::now() + Duration::from_secs(30);
        loop {
            let view = self.jobs.view(id(name)).unwrap();
            if there(&view) {
                return;
            }
            assert!(Instant::now() < patience, "{view:?}");
            thread::sleep(Duration::from_millis(1));
        }
    }

    /// Another node on the same store, after this one.
    fn reopened(self) -> Self {
        let Self { by, stage, hands, jobs } = self;
        drop(jobs);
        let jobs = by.open(&stage, hands.clock(), LIMITS);
        Self { by, stage, hands, jobs }
    }
}

whoever_does_them!(
    job_runs_its_shards_and_merges_them_in_order,
    job_is_joined_by_the_same_order_and_computed_once,
    job_whose_product_is_there_is_done_at_once,
    job_made_is_found_if_its_node_ended_before_that_was_written,
    job_infeasible_stays_so,
    job_cancelled_stops_at_once_and_can_be_started_afresh,
    job_panic_is_one_failed_job,
    job_that_takes_too_long_fails,
    job_request_id_names_one_job,
    jobs_too_many_are_refused_with_a_time_to_come_back,
    jobs_are_listed_by_id_and_by_standing,
    job_is_forgotten_when_it_is_deleted_or_old_but_not_while_it_runs,
    clock_jump_forgets_no_job_and_no_request_before_its_time,
    wait_ends_at_its_time_and_when_the_node_ends,
);

async fn job_runs_its_shards_and_merges_them_in_order(by: &By) {
    let f = fixture(by, LIMITS);
    let view = f.order(1, 5, None).unwrap();
    assert_eq!((view.progress.shards_total, view.ending), (5, None));
    f.until_begun(2);
    assert_eq!(f.standing(1), Standing::Running);
    // Two half shards of five and a merge.
    f.until(1, |view| (view.progress.fraction.unwrap() - 1.0 / 6.0).abs() < 1e-6);
    f.stage.let_go(5);
    let view = f.ended(1).await;
    assert_eq!((view.ending, view.progress.shards_done), (Some(Ending::Made), 5));
    assert_eq!(f.stage.made.lock().unwrap()[&1], [0, 1, 2, 3, 4]);
}

async fn job_is_joined_by_the_same_order_and_computed_once(by: &By) {
    let f = fixture(by, LIMITS);
    let first = f.order(1, 1, None).unwrap();
    assert_eq!(f.order(1, 1, None).unwrap().progress.created, first.progress.created);
    f.stage.let_go(9);
    f.ended(1).await;
    assert_eq!(f.order(1, 1, None).unwrap().ending, Some(Ending::Made));
    assert_eq!(f.stage.begun(), [(1, 0)]);
}

async fn job_whose_product_is_there_is_done_at_once(by: &By) {
    let f = fixture(by, LIMITS);
    f.stage.made.lock().unwrap().insert(1, vec![0]);
    assert_eq!(f.order(1, 1, None).unwrap().ending, Some(Ending::Made));
    // Once it is gone it is made again.
    f.stage.made.lock().unwrap().clear();
    f.stage.let_go(1);
    f.order(1, 1, None).unwrap();
    assert_eq!(f.ended(1).await.ending, Some(Ending::Made));
    assert_eq!(f.stage.begun(), [(1, 0)]);
}

async fn job_made_is_found_if_its_node_ended_before_that_was_written(by: &By) {
    let f = fixture(by, LIMITS);
    f.order(2, 1, None).unwrap();
    f.until_begun(1);
    f.stage.made.lock().unwrap().insert(2, vec![0]);
    let f = f.reopened();
    f.until(2, |view| view.progress.standing == Standing::Succeeded);
    assert_eq!(f.stage.begun(), [(2, 0)]);
}

async fn job_infeasible_stays_so(by: &By) {
    let f = fixture(by, LIMITS);
    f.stage.let_go(9);
    f.order(CANNOT, 1, None).unwrap();
    let view = f.ended(CANNOT).await;
    assert!(matches!(view.ending, Some(Ending::Infeasible(_))), "{view:?}");
    assert_eq!(view.progress.standing, Standing::Succeeded);
    let f = f.reopened();
    assert_eq!(f.order(CANNOT, 1, None).unwrap().ending, view.ending);
    assert_eq!(f.stage.begun().len(), 1);
}

async fn job_cancelled_stops_at_once_and_can_be_started_afresh(by: &By) {
    let f = fixture(by, LIMITS);
    f.order(1, 3, None).unwrap();
    f.until_begun(2);
    f.jobs.cancel(id(1)).unwrap();
    assert_eq!(f.standing(1), Standing::Cancelled);
    // Its threads are free for another.
    f.order(2, 2, None).unwrap();
    f.until_begun(4);
    f.stage.let_go(2);
    assert_eq!(f.ended(2).await.ending, Some(Ending::Made));
    assert_eq!(f.standing(1), Standing::Cancelled);
    f.stage.let_go(3);
    f.order(1, 3, None).unwrap();
    assert_eq!(f.ended(1).await.ending, Some(Ending::Made));
    // A finished one stays as it is.
    f.jobs.cancel(id(1)).unwrap();
    assert_eq!(f.standing(1), Standing::Succeeded);
}

async fn job_panic_is_one_failed_job(by: &By) {
    let f = fixture(by, JobLimits { threads: 1, ..LIMITS });
    f.order(PANICS, 1, None).unwrap();
    let Some(Ending::Failed(failure)) = f.ended(PANICS).await.ending else { panic!("it ended") };
    assert_eq!(failure.reason, "PANIC");
    f.stage.let_go(1);
    f.order(1, 1, None).unwrap();
    assert_eq!(f.ended(1).await.ending, Some(Ending::Made));
}

async fn job_that_takes_too_long_fails(by: &By) {
    let f = fixture(by, JobLimits { time_max: Duration::from_millis(20), ..LIMITS });
    f.order(1, 1, None).unwrap();
    let Some(Ending::Failed(failure)) = f.ended(1).await.ending else { panic!("it ended") };
    assert_eq!(failure.reason, "DEADLINE_EXCEEDED");
}

async fn job_request_id_names_one_job(by: &By) {
    const REQUEST: Option<&str> = Some("0b5d5d0e-5d2c-4c3a-9d7e-1f6f5a3c9b01");
    let f = fixture(by, LIMITS);
    f.order(1, 1, REQUEST).unwrap();
    let refused = f.order(2, 1, REQUEST).unwrap_err();
    assert_eq!((refused.code, refused.reason), (Code::AlreadyExists, "REQUEST_ID_REUSED"));
    f.jobs.cancel(id(1)).unwrap();
    // A repeated request gets the answer it had, another one a new attempt.
    let f = f.reopened();
    assert_eq!(f.order(1, 1, REQUEST).unwrap().ending, Some(Ending::Cancelled));
    assert_eq!(f.order(1, 1, None).unwrap().ending, None);
}

#[tokio::test]
async fn job_long_does_not_hold_up_a_short_one() {
    let by = &By::single();
    let f = fixture(by, JobLimits { threads: 1, ..LIMITS });
    f.order(1, 4, None).unwrap();
    f.until_begun(1);
    f.order(2, 1, None).unwrap();
    f.stage.let_go(5);
    f.ended(1).await;
    assert_eq!(f.stage.begun(), [(1, 0), (1, 1), (2, 0), (1, 2), (1, 3)]);
}

async fn jobs_too_many_are_refused_with_a_time_to_come_back(by: &By) {
    let f = fixture(by, LIMITS);
    for name in 1..=4 {
        f.order(name, 1, None).unwrap();
    }
    let refused = f.order(5, 1, None).unwrap_err();
    assert_eq!((refused.code, refused.reason), (Code::ResourceExhausted, "QUEUE_FULL"));
    assert!(refused.retry_after.is_some());
    // One that is there already takes no place.
    f.order(4, 1, None).unwrap();
    f.jobs.cancel(id(4)).unwrap();
    f.order(5, 1, None).unwrap();
}

#[tokio::test]
async fn job_survives_its_node() {
    let by = &By::single();
    let f = fixture(by, LIMITS);
    f.order(1, 3, None).unwrap();
    f.until_begun(2);
    // Killed: nothing was handed back.
    let f = f.reopened();
    f.until_begun(4);
    assert_eq!(f.jobs.view(id(1)).unwrap().progress.attempts, 2);
    // Told to end: the attempt does not count.
    f.jobs.stop(Duration::from_secs(30));
    assert_eq!(f.order(9, 1, None).unwrap_err().reason, "SHUTTING_DOWN");
    let f = f.reopened();
    f.stage.let_go(99);
    let view = f.ended(1).await;
    assert_eq!((view.ending, view.progress.attempts), (Some(Ending::Made), 2));
    assert_eq!(f.stage.made.lock().unwrap()[&1], [0, 1, 2]);
    let f = f.reopened();
    assert_eq!(f.standing(1), Standing::Succeeded);
}

#[tokio::test]
async fn job_that_ends_its_node_each_time_is_given_up() {
    let by = &By::single();
    let mut f = fixture(by, LIMITS);
    f.order(1, 1, None).unwrap();
    for attempt in 1..=3 {
        f.until_begun(attempt);
        f = f.reopened();
    }
    let Some(Ending::Failed(failure)) = f.jobs.view(id(1)).unwrap().ending else {
        panic!("{:?}", f.jobs.view(id(1)))
    };
    assert_eq!(failure.reason, "GIVEN_UP");
    assert!(failure.message.contains("3 times"), "{}", failure.message);
}

async fn jobs_are_listed_by_id_and_by_standing(by: &By) {
    let f = fixture(by, JobLimits { threads: 1, ..LIMITS });
    for name in [3, 1, 2] {
        f.order(name, 1, None).unwrap();
        f.until_begun(1);
    }
    f.jobs.cancel(id(2)).unwrap();
    let every = OperationFilter::default();
    let names =
        |views: Vec<View>| -> Vec<u8> { views.iter().map(|v| v.progress.id.0[0]).collect() };
    assert_eq!(names(f.jobs.list(&every, None, 9)), [1, 2, 3]);
    assert_eq!(names(f.jobs.list(&every, None, 2)), [1, 2]);
    assert_eq!(names(f.jobs.list(&every, Some(id(1)), 9)), [2, 3]);
    let standings = [1, 2, 3].map(|name| f.standing(name));
    assert_eq!(standings, [Standing::Queued, Standing::Cancelled, Standing::Running]);
}

async fn job_is_forgotten_when_it_is_deleted_or_old_but_not_while_it_runs(by: &By) {
    let f = fixture(by, LIMITS);
    f.order(1, 1, None).unwrap();
    f.until_begun(1);
    assert_eq!(f.jobs.delete(id(1)).unwrap_err().reason, "OPERATION_RUNNING");
    f.hands.pass(2 * LIMITS.kept_for);
    f.jobs.sweep();
    f.stage.let_go(2);
    f.ended(1).await;
    f.order(2, 1, None).unwrap();
    f.ended(2).await;
    f.jobs.delete(id(1)).unwrap();
    assert_eq!(f.jobs.view(id(1)).unwrap_err().code, Code::NotFound);
    f.jobs.sweep();
    assert_eq!(f.standing(2), Standing::Succeeded);
    f.hands.pass(2 * LIMITS.kept_for);
    f.jobs.sweep();
    assert_eq!(f.jobs.view(id(2)).unwrap_err().code, Code::NotFound);
    assert_eq!(f.by.store().entries(Ledger::Jobs).unwrap(), Vec::<[u8; 32]>::new());
}

async fn clock_jump_forgets_no_job_and_no_request_before_its_time(by: &By) {
    const REQUEST: Option<&str> = Some("1f1c2a52-3f39-4a6e-8c53-b6a4b2f7d902");
    let f = fixture(by, LIMITS);
    f.stage.let_go(9);
    for (name, request_id, is_back) in [(1, REQUEST, false), (2, None, true)] {
        // Days there, something ends, and back.
        let right = f.hands.now().system;
        let days = 48 * LIMITS.kept_for;
        f.hands.set(if is_back { right - days } else { right + days });
        f.order(name, 1, request_id).unwrap();
        f.ended(name).await;
        f.jobs.sweep();
        f.hands.set(right);
        f.hands.pass(LIMITS.kept_for / 3);
        f.jobs.sweep();
        assert_eq!(f.standing(name), Standing::Succeeded);
    }
    assert_eq!(f.standing(1), Standing::Succeeded);
    let refused = f.order(2, 1, REQUEST).unwrap_err();
    assert_eq!(refused.reason, "REQUEST_ID_REUSED");
    f.hands.pass(50 * LIMITS.kept_for);
    f.jobs.sweep();
    assert_eq!(f.jobs.view(id(1)).unwrap_err().code, Code::NotFound);
    assert_eq!(f.by.store().entries(Ledger::Requests).unwrap(), Vec::<[u8; 32]>::new());
}

async fn wait_ends_at_its_time_and_when_the_node_ends(by: &By) {
    let f = fixture(by, LIMITS);
    f.order(1, 1, None).unwrap();
    let soon = Instant::now() + Duration::from_millis(20);
    assert_eq!(f.jobs.wait(id(1), soon).await.unwrap().ending, None);
    let late = Instant::now() + Duration::from_secs(600);
    let (waited, ()) = tokio::join!(f.jobs.wait(id(1), late), async {
        tokio::time::sleep(Duration::from_millis(10)).await;
        f.jobs.stop(Duration::from_secs(30));
    });
    assert_eq!(waited.unwrap().ending, None);
}
