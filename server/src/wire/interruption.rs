//! How soon each method notices that it should stop: what stands between two questions to its
//! budget, in the published missions.
//!
//! `VBAR_STRETCHES=all` has the long ones too, which takes minutes, and says between which places
//! the longest stretch of each lies.

use std::{
    backtrace::Backtrace,
    fmt,
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};

use serde_json::{Value, json};
use vbar_guidance::{
    Budget, Interruption,
    budget::Question,
    control::{Failure, PrepareError, StepError},
};
use vbar_proto::v1;

use crate::missions;

use super::{
    Artifact, Candidate, ElapsedAndState, Limits, Order, Problem, Step, Unread, Unverified,
    Unwritten, parse,
};

/// The times between two questions, the way in and the way out included: of this thread on a
/// processor, so that what else the machine does is not in them.
struct Stretches(Vec<Duration>);

fn cpu_time() -> Duration {
    clock_gettime(ClockId::ThreadCPUTime).try_into().unwrap()
}

impl Stretches {
    /// Of `work`, which is never told to stop.
    fn of<T>(work: impl FnOnce(Budget<'_>) -> T) -> (T, Self) {
        let stretches = Arc::new(Mutex::new((cpu_time(), Vec::new())));
        let noted = Arc::clone(&stretches);
        let note = move || {
            let mut noted = noted.lock().unwrap();
            let (last, stretches) = &mut *noted;
            let now = cpu_time();
            stretches.push(now - *last);
            *last = now;
        };
        let ask: Question = Arc::new(move || {
            note();
            None
        });
        let value = work(Budget::new(&ask));
        let _ = ask();
        let stretches = std::mem::take(&mut stretches.lock().unwrap().1);
        (value, Self(stretches))
    }

    /// How often it was asked.
    fn asked(&self) -> usize {
        self.0.len() - 1
    }

    /// The question that the longest stretch ends with, from 0, and how long it is.
    fn longest(&self) -> (usize, Duration) {
        let stretches = self.0.iter().copied().enumerate();
        stretches.max_by_key(|(_, stretch)| *stretch).unwrap_or_default()
    }

    fn quantile_ms(&self, quantile: f64) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_unstable();
        let place = ((sorted.len() - 1) as f64 * quantile).round() as usize;
        sorted[place].as_secs_f64() * 1e3
    }
}

impl fmt::Display for Stretches {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p99, most] = [0.5, 0.99, 1.0].map(|quantile| self.quantile_ms(quantile));
        let total = self.0.iter().sum::<Duration>().as_secs_f64() * 1e3;
        let asked = self.asked();
        write!(f, "{asked:>8} {p50:>9.3} {p99:>9.3} {most:>9.3} {total:>10.1}")
    }
}

/// Where in the mathematics question number `at` is asked, and the one before it.
fn places_before<T>(at: usize, work: impl FnOnce(Budget<'_>) -> T) -> [String; 2] {
    let noted = Arc::new(Mutex::new((0, [String::new(), String::new()])));
    let seen = Arc::clone(&noted);
    let ask: Question = Arc::new(move || {
        let mut seen = seen.lock().unwrap();
        if seen.0 + 1 == at {
            seen.1[0] = place();
        } else if seen.0 == at {
            seen.1[1] = place();
        }
        seen.0 += 1;
        None
    });
    let _ = work(Budget::new(&ask));
    std::mem::take(&mut noted.lock().unwrap().1)
}

/// Lines of guidance's own files on the stack, the innermost first.
fn place() -> String {
    let stack = Backtrace::force_capture().to_string();
    let ours = stack.lines().filter_map(|line| line.split_once("guidance/src/")).map(|(_, at)| at);
    let places: Vec<&str> = ours.filter(|at| !at.starts_with("budget.rs")).take(5).collect();
    places.join(" < ")
}

/// A small mission of each method and a measurement in it.
fn cases() -> [(&'static str, Value, Value); 4] {
    [
        ("variable_horizon", missions::envisat(), missions::envisat_start()),
        ("disturbance_feedback", missions::prisma(), missions::prisma_measurement(0)),
        ("abort_safe", missions::station(), missions::at_rest(5000.0)),
        (
            "offline_sampling",
            missions::integrator(),
            json!({ "linear": { "components": [2.0, 0.1] } }),
        ),
    ]
}

fn problem(json: Value) -> Problem {
    let message: v1::Problem = missions::message(json);
    parse(&message, &Limits::default()).unwrap()
}

/// A mission as it is published.
fn published(name: &str) -> Problem {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../simulator/missions");
    let text = std::fs::read_to_string(folder.join(name).with_extension("json")).unwrap();
    let mut mission: Value = serde_json::from_str(&text).unwrap();
    problem(mission["problem"].take())
}

fn measured(json: Value) -> ElapsedAndState {
    let message: v1::Measurement = missions::message(json);
    parse(&message, &Limits::default()).unwrap()
}

fn step(artifact: &Artifact, measured: &ElapsedAndState, budget: Budget<'_>) -> Option<StepError> {
    artifact.step(&artifact.start(), measured, budget).err()
}

fn all_missions() -> bool {
    std::env::var("VBAR_STRETCHES").is_ok_and(|what| what == "all")
}

#[allow(clippy::print_stdout, reason = "the figures are what it is for")]
fn show<T>(name: &str, what: &str, work: impl Fn(Budget<'_>) -> T) -> T {
    const WORTH_A_PLACE: Duration = Duration::from_millis(2);
    let (value, stretches) = Stretches::of(&work);
    println!("{name:<22}{what:<16}{stretches}");
    let (at, longest) = stretches.longest();
    if all_missions() && longest >= WORTH_A_PLACE {
        let [from, to] = places_before(at, &work);
        println!("    longest from {from}\n              to {to}");
    }
    value
}

#[test]
#[allow(clippy::print_stdout, reason = "the figures are what it is for")]
fn interruption_is_noticed_as_often_as_this() {
    println!(
        "{:<38}{:>8} {:>9} {:>9} {:>9} {:>10}",
        "", "asked", "p50 ms", "p99 ms", "max ms", "all ms"
    );
    for (name, mission, measurement) in cases() {
        let problem = problem(mission);
        let artifact = show_precompute(name, &problem);
        show(name, "check", |budget| problem.check(budget)).unwrap();
        let measured = measured(measurement);
        let fault = show(name, "step", |budget| step(&artifact, &measured, budget));
        assert!(fault.is_none(), "{fault:?}");
    }
    if all_missions() {
        for name in MISSIONS {
            show_precompute(name, &published(name));
        }
    }
}

/// Every mission in `simulator/missions` but those of [`cases`].
const MISSIONS: [&str; 11] = [
    "active_abort",
    "double_integrator",
    "gto",
    "hcw_docking",
    "iss",
    "leo_tumbler",
    "perturbed_55",
    "poseidyn",
    "simbol_x",
    "tumbling_satellite",
    "vbar_elliptic",
];

/// Figures of every part of a precompute, there and back through bytes.
fn show_precompute(name: &str, problem: &Problem) -> Artifact {
    let shards = problem.shards();
    let mut made = Vec::new();
    for shard in 0..shards {
        let what = format!("shard {} of {shards}", shard + 1);
        let shard = show(name, &what, |budget| problem.run_shard(shard, budget)).unwrap();
        made.push(problem.shard_to_bytes(&shard));
    }
    let read = |budget: Budget<'_>| -> Vec<_> {
        let read = |bytes: &Vec<u8>| problem.shard_from_bytes_within(bytes, budget);
        made.iter().map(|bytes| read(bytes).unwrap()).collect()
    };
    show(name, "shards read", read);
    let merge = |budget| problem.merge(read(Budget::UNLIMITED), budget);
    let artifact = merge(Budget::UNLIMITED).unwrap();
    let parts = Mutex::new(vec![read(Budget::UNLIMITED), read(Budget::UNLIMITED)]);
    show(name, "merge", |budget| {
        let shards = parts.lock().unwrap().pop().expect("read for both times");
        problem.merge(shards, budget).map(drop)
    })
    .unwrap();
    let (method, bytes) = (artifact.method(), artifact.to_bytes());
    show(name, "artifact read", |budget| {
        Artifact::from_bytes_within(method, &bytes, budget).map(drop)
    })
    .unwrap();
    artifact
}

/// Says `why` to stop at question number `at`, counted from 0, and ever after; what came of it, and
/// how many questions followed.
fn stopped_at<T>(at: usize, why: Interruption, work: impl FnOnce(Budget<'_>) -> T) -> (T, usize) {
    let asked = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&asked);
    let ask: Question =
        Arc::new(move || (count.fetch_add(1, Ordering::Relaxed) >= at).then_some(why));
    let value = work(Budget::new(&ask));
    (value, asked.load(Ordering::Relaxed).saturating_sub(at + 1))
}

/// Moments spread over `asked` questions: the first, the last and some between.
fn moments(asked: usize) -> Vec<usize> {
    const MOMENTS: usize = 12;
    let last = asked.saturating_sub(1);
    let mut moments: Vec<_> = (0..MOMENTS).map(|i| last * i / (MOMENTS - 1)).collect();
    moments.dedup();
    moments
}

#[test]
fn interruption_ends_a_computation_at_the_question_that_is_answered_so() {
    const WHY: Interruption = Interruption::Cancelled;
    const CANCELLED: Failure = Failure::Interrupted(WHY);
    for (name, mission, measurement) in cases() {
        let (problem, measured) = (problem(mission), measured(measurement));
        let (artifact, stretches) = Stretches::of(|budget| problem.prepare(budget));
        for at in moments(stretches.asked()) {
            let (outcome, more) = stopped_at(at, WHY, |budget| problem.prepare(budget));
            let Err(PrepareError::Failure(failure)) = outcome else {
                panic!("{name}: precompute went on after question {at}: {outcome:?}");
            };
            assert_eq!(failure, CANCELLED, "{name}: precompute stopped at {at}");
            assert_eq!(more, 0, "{name}: precompute asked again after {at}");
        }
        let artifact = artifact.unwrap();
        let (_, stretches) = Stretches::of(|budget| step(&artifact, &measured, budget));
        // A step that never asks is over sooner than it could be stopped.
        for at in (stretches.asked() > 0).then(|| moments(stretches.asked())).into_iter().flatten()
        {
            let (fault, more) = stopped_at(at, WHY, |budget| step(&artifact, &measured, budget));
            let Some(StepError::Failure(failure)) = fault else {
                panic!("{name}: a step went on after question {at}: {fault:?}");
            };
            assert_eq!(failure, CANCELLED, "{name}: a step stopped at {at}");
            assert_eq!(more, 0, "{name}: a step asked again after {at}");
        }
    }
}

/// The measurement of the next step, if it is as predicted.
fn next_measured(name: &str, decided: &Step) -> ElapsedAndState {
    let answer = decided.render(false);
    let prediction = answer.prediction.as_ref().unwrap();
    if name == "disturbance_feedback" {
        return measured(missions::prisma_measurement(1));
    }
    let Some(v1::step_response::Verdict::Command(command)) = &answer.verdict else {
        panic!("{name}: {:?}", answer.verdict);
    };
    if prediction.positions_m.is_some() {
        let elapsed_s = command.elapsed_s + command.duration_s.unwrap();
        return measured(missions::predicted(&answer, elapsed_s));
    }
    let states = prediction.states_nd.as_ref().unwrap();
    let n = usize::try_from(states.columns).unwrap();
    measured(json!({ "linear": { "components": states.values[n..2 * n] } }))
}

#[test]
fn interruption_by_a_deadline_gives_a_labelled_answer_or_none() {
    const LATE: Failure = Failure::Interrupted(Interruption::Deadline);
    for (name, mission, measurement) in cases() {
        let artifact = problem(mission).prepare(Budget::UNLIMITED).unwrap();
        let first = artifact.step(&artifact.start(), &measured(measurement), Budget::UNLIMITED);
        let first = first.unwrap();
        let (state, measured) = (first.next(), next_measured(name, &first));
        let (best, stretches) =
            Stretches::of(|budget| artifact.step(&state, &measured, budget).unwrap());
        let mut answered = 0;
        let asked = stretches.asked();
        let all = if asked == 0 { Vec::new() } else { moments(asked) };
        for &at in &all {
            let (outcome, _) = stopped_at(at, Interruption::Deadline, |budget| {
                artifact.step(&state, &measured, budget)
            });
            match outcome {
                Ok(step) => {
                    answered += 1;
                    assert!(step.may_leave(), "{name} at {at}: {step:?}");
                    let claim = |step: &Step| step.certificate().unwrap().claim;
                    let is_best = step.render(true).verdict == best.render(true).verdict;
                    let says_so = claim(&step) != claim(&best);
                    assert!(is_best || says_so, "{name} at {at}: {step:?} passes for optimal");
                }
                Err(StepError::Failure(failure)) => assert_eq!(failure, LATE, "{name} at {at}"),
                Err(other) => panic!("{name} at {at}: {other:?}"),
            }
        }
        // These two hand on a plan, so there always is an answer.
        if matches!(name, "variable_horizon" | "offline_sampling") {
            assert!(!all.is_empty() && answered == all.len(), "{name}: {answered} of {all:?}");
        }
    }
}

/// Missions whose parts take less than a second each.
const QUICK: [&str; 9] = [
    "active_abort",
    "double_integrator",
    "envisat",
    "gto",
    "leo_tumbler",
    "perturbed_55",
    "prisma",
    "simbol_x",
    "tumbling_satellite",
];

/// Questions drawn from `asked`, the same for the same seed.
fn drawn(seed: u64, asked: usize) -> impl Iterator<Item = usize> {
    const DRAWN: usize = 5;
    let mut state = seed;
    std::iter::repeat_with(move || {
        // Knuth's generator modulo 2^64; its upper half is random enough to choose by.
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(state >> 33).expect("31 bits") % asked
    })
    .take(DRAWN)
}

/// `VBAR_SEED` draws other questions.
#[test]
fn interruption_at_any_question_of_a_mission_leaves_nothing() {
    const WHY: Interruption = Interruption::Cancelled;
    let seed = std::env::var("VBAR_SEED").map_or(1, |seed| seed.parse().unwrap());
    let long = if all_missions() { &MISSIONS[..] } else { &[] };
    for name in QUICK.iter().chain(long.iter().filter(|name| !QUICK.contains(name))) {
        let problem = published(name);
        let last = problem.shards() - 1;
        for shard in if last > 0 { vec![0, last] } else { vec![0] } {
            let (_, stretches) = Stretches::of(|budget| problem.run_shard(shard, budget).map(drop));
            assert!(stretches.asked() > 0, "{name}: shard {shard} never asks");
            for at in drawn(seed, stretches.asked()) {
                let (end, more) = stopped_at(at, WHY, |budget| problem.run_shard(shard, budget));
                let what = format!("{name}: shard {shard} at question {at}, seed {seed}");
                match end {
                    Err(PrepareError::Failure(Failure::Interrupted(why))) => {
                        assert_eq!((why, more), (WHY, 0), "{what}");
                    }
                    Err(other) => panic!("{what}: {other:?}"),
                    Ok(_) => panic!("{what} went on"),
                }
            }
        }
    }
}

/// What is read, checked and written asks too, and keeps nothing when it is told to stop.
#[test]
fn interruption_ends_reading_checking_and_writing_too() {
    const WHY: Interruption = Interruption::Cancelled;
    let every = |what: &str, work: &dyn Fn(Budget<'_>) -> Option<Interruption>| {
        let (end, stretches) = Stretches::of(work);
        assert_eq!(end, None, "{what}");
        assert!(stretches.asked() > 0, "{what} never asks whether to go on");
        for at in moments(stretches.asked()) {
            let (end, more) = stopped_at(at, WHY, work);
            assert_eq!((end, more), (Some(WHY), 0), "{what} at {at} of {}", stretches.asked());
        }
    };
    fn unread<T>(read: Result<T, Unread>) -> Option<Interruption> {
        match read {
            Ok(_) => None,
            Err(Unread::Interrupted(why)) => Some(why),
            Err(Unread::Damaged(what)) => panic!("{what}"),
        }
    }
    for (name, mission, _) in cases() {
        let problem = problem(mission);
        let artifact = problem.prepare(Budget::UNLIMITED).unwrap();
        let (method, bytes) = (artifact.method(), artifact.to_bytes());
        every(&format!("{name}: artifact"), &|budget| {
            unread(Artifact::from_bytes_within(method, &bytes, budget))
        });
        let shard = problem.run_shard(0, Budget::UNLIMITED).unwrap();
        let shard = problem.shard_to_bytes(&shard);
        every(&format!("{name}: shard"), &|budget| {
            unread(problem.shard_from_bytes_within(&shard, budget))
        });
        if !artifact.is_plan() {
            continue;
        }
        let binary = bytes::Bytes::from(bytes);
        every("upload", &|budget| match Candidate::Binary(binary.clone()).verify_within(budget) {
            Ok(_) => None,
            Err(Unverified::Interrupted(why)) => Some(why),
            Err(other) => panic!("{other:?}"),
        });
        for format in [1, 2, 3, 4] {
            let request = v1::ExportPlanRequest { format, ..v1::ExportPlanRequest::default() };
            let order: Order = parse(&request, &Limits::default()).unwrap();
            every(&format!("export {format}"), &|budget| match artifact
                .export_within("plan", &order, budget)
                .expect("it is a plan")
            {
                Ok(_) => None,
                Err(Unwritten::Interrupted(why)) => Some(why),
                Err(other) => panic!("{other:?}"),
            });
        }
    }
}
