//! After a computation that panicked, the next answer of the same thread, from the same artifact,
//! is byte for byte that of a thread and an artifact that never saw one.

use std::{
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use prost::Message as _;
use serde_json::{Value, json};
use vbar_guidance::{Budget, budget::Question};

use super::{record, shelves::provenance};
use crate::{
    compute::{Compute, ComputeError, ComputeLimits, Task, Terms},
    missions,
    telemetry::Metrics,
    wire::{
        Artifact, DecidedStep, ElapsedAndState, Limits, Problem, Render as _, StepAnswer, parse,
    },
};

/// Places at which a computation is made to panic, spread over those where it could.
const PLACES: usize = 12;

/// A thread, as a node has several.
fn thread() -> Compute {
    let wait = Duration::from_secs(30);
    let limits = ComputeLimits {
        threads: 1,
        wait_max: wait,
        overload_wait_max: wait,
        patient_wait_max: wait,
        waiting_max: 1,
    };
    Compute::start(limits, Arc::new(Metrics::new())).unwrap()
}

async fn run<T: Send + 'static>(
    compute: &Compute,
    work: impl FnOnce(Budget<'_>) -> T + Send + 'static,
) -> Result<T, ComputeError> {
    let deadline = Instant::now() + Duration::from_secs(120);
    let terms = Terms { caller: "test".into(), deadline };
    compute.run(Task::Load, &terms, work).await.map(|timed| timed.value)
}

/// The `place`-th question to the budget panics, in the midst of whatever asks it; returns how
/// often it was asked.
fn struck<T>(place: usize, work: impl FnOnce(Budget<'_>) -> T) -> (T, usize) {
    let asked = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&asked);
    let ask: Question = Arc::new(move || {
        assert!(counted.fetch_add(1, Ordering::Relaxed) != place, "on purpose");
        None
    });
    (work(Budget::new(&ask)), asked.load(Ordering::Relaxed))
}

fn places(asked: usize) -> impl Iterator<Item = usize> {
    (0..asked).step_by(asked.div_ceil(PLACES).max(1))
}

fn answer(artifact: &Artifact, measurement: &ElapsedAndState, budget: Budget<'_>) -> Vec<u8> {
    let step = artifact.step(&artifact.start(), measurement, budget).unwrap();
    let id = record::artifact_id(artifact.method(), &artifact.canonical_problem());
    let decided = DecidedStep {
        provenance: Arc::new(provenance(artifact.method(), id, String::new())),
        controller_state: step.next().to_bytes().into(),
        step,
        omit_prediction: false,
    };
    StepAnswer::Decided(decided).render().encode_to_vec()
}

/// Returns how many computations panicked.
async fn check(name: &str, problem: Value, measurement: Value) -> usize {
    let read = |json| parse::<Problem>(&missions::message(json), &Limits::default());
    let problem = read(problem).unwrap();
    let measurement = missions::message(measurement);
    let measurement: ElapsedAndState = parse(&measurement, &Limits::default()).unwrap();
    let prepare = |problem: Problem, place| {
        move |_: Budget<'_>| struck(place, |budget| problem.prepare(budget).unwrap())
    };
    let step = |artifact: Artifact, measurement: ElapsedAndState, place| {
        move |_: Budget<'_>| struck(place, |budget| answer(&artifact, &measurement, budget))
    };

    let fresh = thread();
    let (made, asked) = run(&fresh, prepare(problem.clone(), usize::MAX)).await.unwrap();
    let (expected, asked_in_step) =
        run(&fresh, step(made.clone(), measurement.clone(), usize::MAX)).await.unwrap();

    let compute = thread();
    let mut panics = 0;
    for place in places(asked) {
        let end = run(&compute, prepare(problem.clone(), place)).await.unwrap_err();
        assert_eq!(end, ComputeError::Panicked("on purpose".into()), "{name}");
        panics += 1;
    }
    let (again, _) = run(&compute, prepare(problem, usize::MAX)).await.unwrap();
    assert!(again.to_bytes() == made.to_bytes(), "{name}: another artifact");
    for place in places(asked_in_step) {
        let struck = step(again.clone(), measurement.clone(), place);
        let end = run(&compute, struck).await.unwrap_err();
        assert_eq!(end, ComputeError::Panicked("on purpose".into()), "{name}");
        panics += 1;
        let calm = step(again.clone(), measurement.clone(), usize::MAX);
        let (answer, _) = run(&compute, calm).await.unwrap();
        assert!(answer == expected, "{name}: another answer after a panic at question {place}");
    }
    panics
}

#[tokio::test]
async fn answers_after_a_panic_are_those_of_a_fresh_thread() {
    let linear = |components: &[f64]| json!({ "linear": { "components": components } });
    for (name, problem, measurement) in [
        ("envisat", missions::envisat(), missions::envisat_start()),
        ("double integrator", missions::double_integrator(), linear(&[20.0, 0.0])),
        ("prisma", missions::prisma(), missions::prisma_measurement(0)),
        ("prisma in 6000 s", missions::prisma_6000_s(0.279), missions::prisma_measurement(0)),
        ("station", missions::station(), missions::at_rest(5000.0)),
        ("integrator of uncertain strength", missions::integrator(), linear(&[2.0, 0.0])),
    ] {
        let panics = check(name, problem, measurement).await;
        assert!(panics > 1, "{name}: {panics}");
    }
}
