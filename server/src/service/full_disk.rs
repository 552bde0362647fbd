//! A node whose disk is full, fails, hangs or dies: what it acknowledged stays, what needs no disk it
//! answers, the rest it refuses aloud, and when the disk works again so does everything.

use std::{collections::BTreeMap, net::Ipv4Addr, path::Path};

use fastrand::Rng;
use prost::Message as _;
use serde_json::{Value, json};
use tokio::runtime::Runtime;

use super::*;
use crate::{
    access::Roles,
    compute::ComputeLimits,
    missions,
    seeds::each_seed,
    store::{DirectoryStore, Faults, FaultyDisk, Syncing},
    wire::{OperationAnswer, OperationOutcome, Parse, PrecomputeCall, Render as _, parse},
};

const FULL: Faults = Faults { is_full: true, one_in: 0, killed_after: None };
const WORKS: Faults = Faults { is_full: false, one_in: 0, killed_after: None };

/// A node on `disk`, without its port.
struct Served(Arc<Service>);

impl Served {
    fn open(disk: &FaultyDisk, root: &Path) -> io::Result<Self> {
        let config = Config {
            compute_threads: 2,
            precompute_wait: Duration::from_secs(60),
            computation_time_max: Duration::from_secs(120),
            ..Config::default()
        };
        let metrics = Arc::new(Metrics::new());
        let limits = ComputeLimits {
            threads: config.compute_threads,
            wait_max: Duration::from_secs(60),
            overload_wait_max: Duration::from_secs(60),
            patient_wait_max: Duration::from_secs(60),
            waiting_max: 64,
        };
        let compute = Compute::start(limits, Arc::clone(&metrics))?;
        let disk = Arc::new(disk.clone());
        let store = DirectoryStore::open_on(disk, root, Syncing::EveryWrite);
        let store = OpenStore::Own(Arc::new(store.map_err(io::Error::other)?));
        let info = InfoAnswer {
            limits: config.limits,
            request_bytes_max: config.request_bytes_max,
            compute_threads: config.compute_threads,
            computation_time_max: config.computation_time_max,
        };
        Ok(Self(Arc::new(Service::open(compute, store, &config, metrics, info)?)))
    }

    fn call() -> Call {
        let caller = Caller::at(Ipv4Addr::LOCALHOST.into(), Roles::ALL);
        Call { caller, deadline: Instant::now() + Duration::from_secs(120) }
    }

    fn asked<T: Parse>(message: Value) -> T
    where
        T::Message: prost::Message + prost::Name + Default,
    {
        parse(&missions::message(message), &Limits::default()).unwrap()
    }

    /// The artifact's id, once it is made.
    async fn precompute(&self, problem: &Value) -> Result<ArtifactId, Error> {
        let ask: PrecomputeCall = Self::asked(json!({ "problem": problem }));
        match self.0.precompute(ask, &Self::call()).await? {
            OperationAnswer::Precompute { outcome: Some(OperationOutcome::Made(made)), .. } => {
                Ok(made.stored.id)
            }
            OperationAnswer::Precompute {
                outcome: Some(OperationOutcome::Failed(failure)),
                ..
            } => Err(Error::new(Code::Internal, "FAILED", failure.reason)),
            other => panic!("{other:?}"),
        }
    }

    /// The bytes of the answer.
    async fn step(&self, controller: Value) -> Result<Vec<u8>, Error> {
        let mut message = controller;
        message["measurement"] = json!({ "linear": { "components": [20.0, 0.0] } });
        let answer = self.0.step(Self::asked(message), &Self::call()).await?;
        Ok(answer.value.render().encode_to_vec())
    }

    async fn step_by_id(&self, id: ArtifactId) -> Result<Vec<u8>, Error> {
        self.step(json!({ "artifactId": id.to_string() })).await
    }

    async fn plan(&self, problem: &Value) -> Result<Option<ArtifactId>, Error> {
        let ask = Self::asked(json!({ "problem": problem }));
        self.0.plan(ask, &Self::call()).await.map(|answer| answer.value.plan_id)
    }

    /// Ends as a node does.
    fn end(self) {
        self.0.stop(Duration::from_secs(30));
    }
}

/// The `n`-th of problems that are all different and fast.
fn problem(n: u32) -> Value {
    let mut problem = missions::double_integrator();
    problem["variableHorizon"]["fuelWeight"] = json!(1.0 + 0.01 * f64::from(n));
    problem
}

fn assert_full<T: std::fmt::Debug>(outcome: Result<T, Error>) {
    let error = outcome.unwrap_err();
    assert_eq!((error.code, error.reason), (Code::ResourceExhausted, "STORE_FULL"), "{error:?}");
    assert!(error.retry_after.is_some());
}

#[tokio::test]
async fn full_disk_refuses_what_is_to_be_kept_and_answers_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let disk = FaultyDisk::new(1);
    let node = Served::open(&disk, folder.path()).unwrap();
    let id = node.precompute(&problem(1)).await.unwrap();
    let answer = node.step_by_id(id).await.unwrap();
    assert_eq!(node.0.store_fault().await, None);

    disk.set(FULL);
    assert_full(node.precompute(&problem(2)).await);
    assert_full(node.plan(&missions::prisma()).await);
    assert!(node.0.store_fault().await.is_some());
    assert_eq!(node.precompute(&problem(1)).await.unwrap(), id);
    assert_eq!(node.step_by_id(id).await.unwrap(), answer);
    // What comes with its problem is answered too, twice alike.
    let unkept = node.step(json!({ "problem": problem(2) })).await.unwrap();
    assert_eq!(node.step(json!({ "problem": problem(2) })).await.unwrap(), unkept);
    node.0.sweep();
    // So does a node that is started now.
    node.end();
    let node = Served::open(&disk, folder.path()).unwrap();
    assert_eq!(node.step_by_id(id).await.unwrap(), answer);
    assert_full(node.precompute(&problem(2)).await);

    disk.set(WORKS);
    assert_eq!(node.0.store_fault().await, None);
    let second = node.precompute(&problem(2)).await.unwrap();
    assert_eq!(node.step_by_id(second).await.unwrap(), unkept);
    let plan = node.plan(&missions::prisma()).await.unwrap();
    assert!(plan.is_some());
}

#[tokio::test]
async fn hanging_disk_holds_up_no_step_that_needs_none() {
    let folder = tempfile::tempdir().unwrap();
    let disk = FaultyDisk::new(1);
    let node = Served::open(&disk, folder.path()).unwrap();
    let id = node.precompute(&problem(1)).await.unwrap();
    let answer = node.step_by_id(id).await.unwrap();
    disk.set_hanging(true);
    // More than there are threads for any kind of call.
    let hanging: Vec<_> = (2..10)
        .map(|n| {
            let node = Served(Arc::clone(&node.0));
            tokio::spawn(async move { node.precompute(&problem(n)).await })
        })
        .collect();
    for _ in 0..20 {
        assert_eq!(node.step_by_id(id).await.unwrap(), answer);
    }
    assert!(hanging.iter().all(|call| !call.is_finished()));
    disk.set_hanging(false);
    for call in hanging {
        call.await.unwrap().unwrap();
    }
}

/// A node's life on a disk that fails.
struct Life {
    rng: Rng,
    folder: tempfile::TempDir,
    disk: FaultyDisk,
    node: Option<Served>,
    /// Answers of artifacts that were acknowledged.
    made: BTreeMap<u32, (ArtifactId, Vec<u8>)>,
}

impl Life {
    async fn run(seed: u64) {
        let mut rng = Rng::with_seed(seed);
        let disk = FaultyDisk::new(rng.u64(..));
        let folder = tempfile::tempdir().unwrap();
        let mut life = Self { rng, folder, disk, node: None, made: BTreeMap::new() };
        life.open();
        for _ in 0..8 {
            life.disk.set(match life.rng.u8(..4) {
                0 => FULL,
                1 => Faults { killed_after: Some(life.rng.u32(1..60)), ..WORKS },
                _ => Faults { one_in: life.rng.u32(2..30), ..WORKS },
            });
            life.act().await;
            life.disk_comes_back();
            life.check().await;
        }
        for n in 0..4 {
            let id = life.node().precompute(&problem(n)).await.unwrap();
            assert!(life.node().step_by_id(id).await.is_ok());
        }
        life.check().await;
    }

    fn node(&self) -> &Served {
        self.node.as_ref().expect("it runs")
    }

    fn open(&mut self) {
        self.node = Some(Served::open(&self.disk, &self.folder.path().join("store")).unwrap());
    }

    async fn act(&mut self) {
        let n = self.rng.u32(..4);
        match self.rng.u8(..6) {
            0 => self.node().0.sweep(),
            1 => {
                // An answer is right, whatever the disk does, or there is none.
                let answer = self.node().step(json!({ "problem": problem(n) })).await;
                if let (Ok(answer), Some((_, known))) = (answer, self.made.get(&n)) {
                    assert_eq!(answer, *known);
                }
            }
            _ => {
                if let Ok(id) = self.node().precompute(&problem(n)).await {
                    let answer = self.node().step_by_id(id).await.unwrap();
                    let (_, known) = self.made.entry(n).or_insert((id, answer.clone()));
                    assert_eq!(answer, *known);
                }
            }
        }
    }

    fn disk_comes_back(&mut self) {
        let was_killed = self.disk.is_dead();
        if was_killed || self.rng.u8(..3) == 0 {
            self.node.take().expect("it runs").end();
            if was_killed && self.rng.bool() {
                self.disk.lose_power();
            }
            self.disk.set(WORKS);
            self.open();
        }
        self.disk.set(WORKS);
    }

    /// Nothing that was acknowledged is lost.
    async fn check(&self) {
        for (n, (id, answer)) in &self.made {
            let found = self.node().step_by_id(*id).await;
            assert_eq!(found.as_ref(), Ok(answer), "artifact {n}");
            assert_eq!(self.node().precompute(&problem(*n)).await.as_ref(), Ok(id));
        }
        assert_eq!(self.node().0.store_fault().await, None);
    }
}

#[test]
fn disk_faults_take_from_a_node_nothing_that_it_acknowledged() {
    let runtime = Runtime::new().unwrap();
    each_seed("-p vbar-server --lib disk_faults_take", 12, |seed| {
        runtime.block_on(Life::run(seed))
    });
}
