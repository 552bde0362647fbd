//! A node that is killed over and over loses nothing that it acknowledged.

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use vbar_client::{
    Client, Options,
    v1::{
        ComputePlanRequest, Measurement, Problem, Provenance, StepRequest, problem::Method,
        step_request::Controller,
    },
};
use vbar_simulator::{Mission, MissionFile};

use super::{Process, measured_at, mission};

/// Kills unless `VBAR_CRASHES` says otherwise.
const CRASHES: u32 = 5;

/// What the node acknowledged.
#[derive(Debug, Default)]
struct Acknowledged {
    operations: BTreeSet<String>,
    plans: BTreeSet<String>,
    /// Artifacts that were fetched, with the digest of their bytes.
    artifacts: BTreeMap<String, String>,
    steps: u64,
}

impl Acknowledged {
    fn count(&self) -> u64 {
        self.operations.len() as u64 + self.plans.len() as u64 + self.steps
    }

    fn stepped(&mut self, by: Provenance) {
        self.steps += 1;
        self.artifacts.insert(by.artifact_id, by.content_sha256);
    }

    fn take_in(&mut self, later: Self) {
        self.operations.extend(later.operations);
        self.plans.extend(later.plans);
        for (id, digest) in later.artifacts {
            let known = self.artifacts.insert(id, digest.clone());
            assert!(known.is_none_or(|known| known == digest), "an artifact changed");
        }
        self.steps += later.steps;
    }
}

type Shared = Arc<Mutex<Acknowledged>>;

fn number(name: &str, default: u32) -> u32 {
    env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// A mission like the file's, of another name.
fn varied(problem: &Problem, variant: u64) -> Problem {
    let mut problem = problem.clone();
    let weight = 1.0 + variant as f64 / 1024.0;
    match problem.method.as_mut() {
        Some(Method::VariableHorizon(method)) => method.fuel_weight = Some(weight),
        Some(Method::DisturbanceFeedback(method)) => method.fuel_weight = Some(weight),
        other => panic!("{other:?}"),
    }
    problem
}

struct Missions {
    closed_loop: Problem,
    plan: Problem,
    start: Measurement,
}

impl Missions {
    fn load() -> Self {
        let closed_loop = Mission::load(mission("double_integrator.json").as_ref()).unwrap();
        let MissionFile::DisturbanceFeedback(plan) =
            MissionFile::load(mission("prisma.json").as_ref()).unwrap()
        else {
            panic!("prisma is flown by a plan")
        };
        Self {
            closed_loop: closed_loop.problem,
            plan: plan.problem,
            start: measured_at(vec![20.0, 0.0]),
        }
    }
}

async fn client(node: &Process) -> Client {
    let options = Options { attempts_max: 1, ..Options::default() };
    Client::connect(&node.url, options).await.unwrap()
}

/// Asks for precomputes, plans and steps until the node is gone, and notes what it acknowledged.
async fn load(client: Client, missions: Arc<Missions>, seen: Shared, seed: u64) {
    for count in 0.. {
        let variant = seed * 1000 + count;
        let problem = varied(&missions.closed_loop, variant);
        let Ok(operation) = client.start_precompute(problem.clone()).await else { return };
        seen.lock().unwrap().operations.insert(operation.name.clone());
        let step = StepRequest {
            controller: Some(Controller::Problem(problem)),
            measurement: Some(missions.start.clone()),
            ..StepRequest::default()
        };
        let Ok(answer) = client.step(step).await else { return };
        assert!(answer.certificate.is_some_and(|certificate| certificate.passed));
        // Before it decided the step it kept the controller.
        seen.lock().unwrap().stepped(answer.provenance.unwrap());
        if count % 4 == 0 {
            let problem = Some(varied(&missions.plan, variant));
            let request = ComputePlanRequest { problem, ..ComputePlanRequest::default() };
            let Ok(answer) = client.plan(request).await else { return };
            seen.lock().unwrap().plans.insert(answer.plan_id);
        }
    }
}

/// Everything that was acknowledged is there and whole.
async fn check(client: &Client, seen: &Acknowledged) {
    for name in &seen.operations {
        client.operation(name).await.unwrap_or_else(|error| panic!("{name}: {error}"));
    }
    for plan in &seen.plans {
        let kept = client.get_plan(plan).await.unwrap_or_else(|error| panic!("{plan}: {error}"));
        assert!(kept.document.is_some());
    }
    for (id, digest) in &seen.artifacts {
        let found = client.artifact(id).await.unwrap_or_else(|error| panic!("{id}: {error}"));
        assert_eq!(found.provenance.unwrap().content_sha256, *digest);
        // The client checks the digest of what it fetched.
        client.download_artifact(id).await.unwrap_or_else(|error| panic!("{id}: {error}"));
    }
}

/// The next of a sequence that looks like chance (splitmix64).
fn chance(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[allow(clippy::print_stdout, reason = "what survived is the result")]
async fn node_killed_at_any_moment_loses_nothing_it_acknowledged() {
    let crashes = number("VBAR_CRASHES", CRASHES);
    let mut random = u64::from(number("VBAR_SEED", 1));
    println!("VBAR_CRASHES={crashes} VBAR_SEED={random}");
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("vbar.toml");
    let settings = "precompute_wait_s = 0.0\njob_threads = 1\njobs_unfinished_max = 100000\n\
                    job_attempts_max = 1000000\n";
    std::fs::write(&config, settings).unwrap();
    let data = folder.path().join("data");
    let arguments = ["--data-dir", data.to_str().unwrap(), "--config", config.to_str().unwrap()];
    let missions = Arc::new(Missions::load());
    let mut all = Acknowledged::default();
    let mut latest = Acknowledged::default();
    for crash in 0..crashes {
        let mut node = Process::start(&arguments);
        let client = client(&node).await;
        check(&client, &latest).await;
        all.take_in(latest);
        let seen = Shared::default();
        let load = load(client, Arc::clone(&missions), Arc::clone(&seen), crash.into());
        let load = tokio::spawn(load);
        // At least an operation, a step and a plan, on however slow a machine.
        let enough = 3 + chance(&mut random) % 30;
        while seen.lock().unwrap().count() < enough && !load.is_finished() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        tokio::time::sleep(Duration::from_millis(chance(&mut random) % 50)).await;
        node.child.kill().unwrap();
        node.child.wait().unwrap();
        load.await.unwrap();
        latest = std::mem::take(&mut *seen.lock().unwrap());
    }
    all.take_in(latest);
    let node = Process::start(&arguments);
    let client = client(&node).await;
    finish(&client, &mut all).await;
    check(&client, &all).await;
    let Acknowledged { operations, plans, artifacts, steps } = all;
    println!(
        "killed {crashes} times; kept {} operations, {} plans, {} artifacts; {steps} steps",
        operations.len(),
        plans.len(),
        artifacts.len()
    );
    let least = crashes as usize;
    assert!(operations.len() >= least && plans.len() >= least && steps >= u64::from(crashes));
}

/// Waits for every operation, and notes what each made.
async fn finish(client: &Client, seen: &mut Acknowledged) {
    let patience = Instant::now() + Duration::from_secs(120);
    for name in &seen.operations {
        while !client.operation(name).await.unwrap().done {
            assert!(Instant::now() < patience, "{name} does not end");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let id = name.strip_prefix("operations/").unwrap();
        let made = client.artifact(id).await.unwrap();
        seen.artifacts.insert(id.to_owned(), made.provenance.unwrap().content_sha256);
    }
}
