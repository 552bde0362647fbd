//! Jobs whose shards wait until they are let go.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicUsize, Ordering},
    thread,
};

use super::*;
use crate::{store::MemoryStore, wire::Standing};

/// Where the work of a test looks what it should do, and notes what it did.
#[derive(Debug, Default)]
struct Stage {
    /// Shards that may still be computed.
    let_go: AtomicUsize,
    begun: Mutex<Vec<(u8, usize)>>,
    made: Mutex<BTreeMap<u8, Vec<usize>>>,
}

impl Stage {
    fn let_go(&self, shards: usize) {
        self.let_go.fetch_add(shards, Ordering::SeqCst);
    }

    fn begun(&self) -> Vec<(u8, usize)> {
        self.begun.lock().unwrap().clone()
    }

    fn take_one(&self) -> bool {
        let take = |left: usize| left.checked_sub(1);
        self.let_go.fetch_update(Ordering::SeqCst, Ordering::SeqCst, take).is_ok()
    }
}

/// Collects the numbers of its shards.
#[derive(Debug)]
struct Counting {
    name: u8,
    shards: usize,
    stage: Arc<Stage>,
}

const PANICS: u8 = 200;
const CANNOT: u8 = 201;

impl Work for Counting {
    type Shard = usize;

    fn method(&self) -> &'static str {
        "counting"
    }

    fn is_made(&self) -> bool {
        self.stage.made.lock().unwrap().contains_key(&self.name)
    }

    fn shards(&self) -> usize {
        self.shards
    }

    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<usize, Stopped> {
        budget.tell(1, 2);
        self.stage.begun.lock().unwrap().push((self.name, shard));
        assert_ne!(self.name, PANICS, "a bug");
        while !self.stage.take_one() {
            budget.check().map_err(|interruption| {
                let failure = vbar_guidance::control::Failure::from(interruption);
                Stopped::Failed(Error::from(failure).into())
            })?;
            thread::yield_now();
        }
        Ok(shard)
    }

    fn finish(&self, shards: Vec<usize>, _: Budget<'_>) -> Result<(), Stopped> {
        if self.name == CANNOT {
            return Err(Stopped::Infeasible(NoArtifact::from_bytes(b"").unwrap()));
        }
        self.stage.made.lock().unwrap().insert(self.name, shards);
        Ok(())
    }
}

const LIMITS: JobLimits = JobLimits {
    threads: 2,
    unfinished_max: 4,
    time_max: Duration::from_secs(60),
    attempts_max: 3,
    kept_for: Duration::from_secs(3600),
};

fn opened(store: &Arc<dyn Store>, stage: &Arc<Stage>, limits: JobLimits) -> Jobs<Counting> {
    let metrics = Arc::new(Metrics::new());
    Jobs::open(Arc::clone(store), limits, metrics, |_, problem| {
        Ok(Counting { name: problem[0], shards: problem[1].into(), stage: Arc::clone(stage) })
    })
    .unwrap()
}

struct Fixture {
    store: Arc<dyn Store>,
    stage: Arc<Stage>,
    jobs: Jobs<Counting>,
}

fn fixture(limits: JobLimits) -> Fixture {
    let store: Arc<dyn Store> = Arc::new(MemoryStore::new(1 << 20));
    let stage = Arc::<Stage>::default();
    let jobs = opened(&store, &stage, limits);
    Fixture { store, stage, jobs }
}

fn id(name: u8) -> ArtifactId {
    ArtifactId([name; 32])
}

impl Fixture {
    fn order(&self, name: u8, shards: u8, request_id: Option<&str>) -> Result<View, Error> {
        self.jobs.submit(Order {
            id: id(name),
            work: Counting { name, shards: shards.into(), stage: Arc::clone(&self.stage) },
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

    /// Another node on the same store, after this one.
    fn reopened(self) -> Self {
        let Self { store, stage, jobs } = self;
        drop(jobs);
        let jobs = opened(&store, &stage, LIMITS);
        Self { store, stage, jobs }
    }
}

#[tokio::test]
async fn job_runs_its_shards_and_merges_them_in_order() {
    let f = fixture(LIMITS);
    let view = f.order(1, 5, None).unwrap();
    assert_eq!((view.progress.shards_total, view.ending), (5, None));
    f.until_begun(2);
    let running = f.jobs.view(id(1)).unwrap().progress;
    assert_eq!(running.standing, Standing::Running);
    // Two half shards of five and a merge.
    assert!((running.fraction.unwrap() - 1.0 / 6.0).abs() < 1e-6, "{running:?}");
    f.stage.let_go(5);
    let view = f.ended(1).await;
    assert_eq!((view.ending, view.progress.shards_done), (Some(Ending::Made), 5));
    assert_eq!(f.stage.made.lock().unwrap()[&1], [0, 1, 2, 3, 4]);
}

#[tokio::test]
async fn job_is_joined_by_the_same_order_and_computed_once() {
    let f = fixture(LIMITS);
    let first = f.order(1, 1, None).unwrap();
    assert_eq!(f.order(1, 1, None).unwrap().progress.created, first.progress.created);
    f.stage.let_go(9);
    f.ended(1).await;
    assert_eq!(f.order(1, 1, None).unwrap().ending, Some(Ending::Made));
    assert_eq!(f.stage.begun(), [(1, 0)]);
}

#[tokio::test]
async fn job_whose_product_is_there_is_done_at_once() {
    let f = fixture(LIMITS);
    f.stage.made.lock().unwrap().insert(1, vec![0]);
    assert_eq!(f.order(1, 1, None).unwrap().ending, Some(Ending::Made));
    // Also if its node ended before it could write that down.
    f.order(2, 1, None).unwrap();
    f.until_begun(1);
    f.stage.made.lock().unwrap().insert(2, vec![0]);
    let f = f.reopened();
    assert_eq!(f.standing(2), Standing::Succeeded);
    assert_eq!(f.stage.begun(), [(2, 0)]);
}

#[tokio::test]
async fn job_infeasible_stays_so() {
    let f = fixture(LIMITS);
    f.stage.let_go(9);
    f.order(CANNOT, 1, None).unwrap();
    let view = f.ended(CANNOT).await;
    assert!(matches!(view.ending, Some(Ending::Infeasible(_))), "{view:?}");
    assert_eq!(view.progress.standing, Standing::Succeeded);
    let f = f.reopened();
    assert_eq!(f.order(CANNOT, 1, None).unwrap().ending, view.ending);
    assert_eq!(f.stage.begun().len(), 1);
}

#[tokio::test]
async fn job_cancelled_stops_at_once_and_can_be_started_afresh() {
    let f = fixture(LIMITS);
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

#[tokio::test]
async fn job_panic_is_one_failed_job() {
    let f = fixture(JobLimits { threads: 1, ..LIMITS });
    f.order(PANICS, 1, None).unwrap();
    let Some(Ending::Failed(failure)) = f.ended(PANICS).await.ending else { panic!("it ended") };
    assert_eq!(failure.reason, "PANIC");
    f.stage.let_go(1);
    f.order(1, 1, None).unwrap();
    assert_eq!(f.ended(1).await.ending, Some(Ending::Made));
}

#[tokio::test]
async fn job_that_takes_too_long_fails() {
    let f = fixture(JobLimits { time_max: Duration::from_millis(20), ..LIMITS });
    f.order(1, 1, None).unwrap();
    let Some(Ending::Failed(failure)) = f.ended(1).await.ending else { panic!("it ended") };
    assert_eq!(failure.reason, "DEADLINE_EXCEEDED");
}

#[tokio::test]
async fn job_request_id_names_one_job() {
    const REQUEST: Option<&str> = Some("0b5d5d0e-5d2c-4c3a-9d7e-1f6f5a3c9b01");
    let f = fixture(LIMITS);
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
    let f = fixture(JobLimits { threads: 1, ..LIMITS });
    f.order(1, 4, None).unwrap();
    f.until_begun(1);
    f.order(2, 1, None).unwrap();
    f.stage.let_go(5);
    f.ended(1).await;
    assert_eq!(f.stage.begun(), [(1, 0), (1, 1), (2, 0), (1, 2), (1, 3)]);
}

#[tokio::test]
async fn jobs_too_many_are_refused_with_a_time_to_come_back() {
    let f = fixture(LIMITS);
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
    let f = fixture(LIMITS);
    f.order(1, 3, None).unwrap();
    f.until_begun(2);
    // Killed: nothing was handed back.
    let f = f.reopened();
    f.until_begun(4);
    assert_eq!(f.jobs.view(id(1)).unwrap().progress.attempts, 2);
    // Told to end: the attempt does not count.
    f.jobs.stop();
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
    let mut f = fixture(LIMITS);
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

#[tokio::test]
async fn jobs_are_listed_by_id_and_by_standing() {
    let f = fixture(JobLimits { threads: 1, ..LIMITS });
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

#[tokio::test]
async fn job_is_forgotten_when_it_is_deleted_or_old_but_not_while_it_runs() {
    let f = fixture(LIMITS);
    f.order(1, 1, None).unwrap();
    f.until_begun(1);
    assert_eq!(f.jobs.delete(id(1)).unwrap_err().reason, "OPERATION_RUNNING");
    let later = SystemTime::now() + 2 * LIMITS.kept_for;
    f.jobs.sweep(later);
    f.stage.let_go(2);
    f.ended(1).await;
    f.order(2, 1, None).unwrap();
    f.ended(2).await;
    f.jobs.delete(id(1)).unwrap();
    assert_eq!(f.jobs.view(id(1)).unwrap_err().code, Code::NotFound);
    f.jobs.sweep(SystemTime::now());
    assert_eq!(f.standing(2), Standing::Succeeded);
    f.jobs.sweep(later);
    assert_eq!(f.jobs.view(id(2)).unwrap_err().code, Code::NotFound);
    assert_eq!(f.store.entries(Ledger::Jobs).unwrap(), Vec::<[u8; 32]>::new());
}

#[tokio::test]
async fn wait_ends_at_its_time_and_when_the_node_ends() {
    let f = fixture(LIMITS);
    f.order(1, 1, None).unwrap();
    let soon = Instant::now() + Duration::from_millis(20);
    assert_eq!(f.jobs.wait(id(1), soon).await.unwrap().ending, None);
    let late = Instant::now() + Duration::from_secs(600);
    let (waited, ()) = tokio::join!(f.jobs.wait(id(1), late), async {
        tokio::time::sleep(Duration::from_millis(10)).await;
        f.jobs.stop();
    });
    assert_eq!(waited.unwrap().ending, None);
}
