//! A thousand random states for each set of failures: what is reported FOUND is flown once more by
//! a truth of the tests' own, without linearisation, and looked at between the samples.

use nalgebra::{Matrix3, SMatrix, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use vbar_guidance::{
    Budget,
    control::abort_safe::{
        Artifact, Fallback, ModeVerdict, Phase, Problem, Safety, SafetyQuestion, Separation,
        SetTiming, Watch, Weights, safety_report,
    },
    dynamics::RelativeVector,
    mission::{AvoidanceRegion, AvoidanceSet, ThrustMode, Thrusters},
    orbit::KeplerOrbit,
    reach::{Abort, AbortVerdict},
    units::{Angle, Distance, Force, Mass, Seconds},
};

use crate::two_body_truth::Truth;

const STATES: usize = 1000;
const STEP_S: f64 = 30.0;
const HORIZON: usize = 20;
const MASS_KG: f64 = 4000.0;
/// What the linear plant leaves out over ten minutes from 200 m: (200 m)^2 / 7400 km, and half a
/// radian of orbit.
const LINEAR_ERROR_M: f64 = 0.05;

/// The paper's active case: e = 0.1, f_0 = 140 deg, 4 t, 20 N. [AguilarMarsillach2022, VI.B]
fn problem(safety: Safety) -> Problem {
    let axis = Distance::from_metres(7_419_320.0);
    let weights = Weights {
        stage: SMatrix::identity(),
        input: Matrix3::identity(),
        terminal: SMatrix::identity(),
    };
    Problem {
        epoch: None,
        orbit: KeplerOrbit::new(axis, 0.1, Angle::from_degrees(140.0), None).unwrap(),
        mass: Mass::from_kilograms(MASS_KG),
        sample_time: Seconds::from_seconds(STEP_S),
        steps_per_period: 212,
        thrusters: Thrusters::cube_corners(Force::from_newtons(20.0)).unwrap(),
        phases: vec![Phase { safety, weights, advance_within: Distance::from_metres(0.0) }],
        prediction_horizon: 10,
        clearance: 1e-4,
        timing: SetTiming::Timed,
        separation: Separation::Tangent,
        fallback: Fallback::Soften,
        arrival: Distance::from_metres(1.0),
        fastest_approach_m_s: 5.0,
        abort_programs_max: 300,
        abort_clearance: LINEAR_ERROR_M,
        steps_max: 1000,
    }
}

fn watch(region: AvoidanceRegion, speed_max_m_s: f64, fractions: usize) -> Watch {
    let avoid = AvoidanceSet::new(region, speed_max_m_s).unwrap();
    Watch { avoid, inflation: 1.0, horizon: HORIZON, fractions, nearest: 1 }
}

fn modes(sets: impl IntoIterator<Item = Vec<usize>>) -> Vec<ThrustMode> {
    sets.into_iter().map(|set| ThrustMode::of(set).unwrap()).collect()
}

/// Towards the target, to be there after 30 to 300 s.
fn approaching(rng: &mut ChaCha8Rng, reach_m: f64, aim_m: f64) -> RelativeVector {
    let arrival_s: f64 = rng.random_range(30.0..300.0);
    let from: [f64; 3] = std::array::from_fn(|_| rng.random_range(-reach_m..reach_m));
    let aim: [f64; 3] = std::array::from_fn(|_| rng.random_range(-aim_m..aim_m));
    RelativeVector::from_fn(|i, _| match i {
        0..3 => from[i],
        _ => (aim[i - 3] - from[i - 3]) / arrival_s,
    })
}

/// Looks at an abort's true flight every 2.5 s.
fn flies(k: usize, x: &RelativeVector, abort: &Abort, clear: impl Fn(&RelativeVector) -> bool) {
    let orbit = json!({ "a_km": 7419.32, "e": 0.1, "f0_deg": 140.0 });
    let (mut x, parts) = (*x, 12);
    for step in 0..abort.horizon {
        let force = abort.forces_n.get(step).copied().unwrap_or_else(Vector3::zeros);
        for part in 0..parts {
            assert!(clear(&x), "k {k}, step {step}, part {part}: {x}");
            let interval_s = STEP_S / f64::from(parts);
            let elapsed = (k + step) as f64 * STEP_S + f64::from(part) * interval_s;
            x = Truth::new(&orbit, elapsed).after(&x, &(force / MASS_KG), interval_s);
        }
    }
    assert!(clear(&x), "at the end: {x}");
}

#[derive(Default)]
struct Counts {
    found: usize,
    none: usize,
    undecided: usize,
    inside: usize,
}

impl Counts {
    /// Counts a verdict; the abort if there is one.
    fn add<'v>(&mut self, verdict: &'v ModeVerdict) -> Option<&'v Abort> {
        let inside = verdict.inside_reachable_set();
        self.inside += usize::from(inside);
        match &verdict.abort {
            AbortVerdict::Found(abort) => {
                assert!(!inside, "inside a reachable set, and yet an abort: {verdict:?}");
                self.found += 1;
                Some(abort)
            }
            AbortVerdict::NoneProved { .. } => {
                self.none += 1;
                None
            }
            AbortVerdict::Undecided { .. } => {
                self.undecided += 1;
                None
            }
        }
    }

    fn print(&self, what: &str) {
        let Self { found, none, undecided, inside } = self;
        println!(
            "{what}: of {STATES} states {found} with an abort, {none} without (proved), \
             {undecided} undecided; {inside} inside a reachable set"
        );
        assert!(*found > STATES / 10 && *inside > 0, "a vain test");
        assert!(*inside <= *none + *undecided);
    }
}

#[test]
fn aborts_found_by_active_search_stay_out_between_samples_too() {
    let cube = AvoidanceRegion::HalfWidths(Vector3::repeat(20.0));
    let singles = modes((0..8).map(|j| vec![j]));
    let safety = Safety::Active { watch: watch(cube, 6.0, 3), modes: singles.clone() };
    let artifact = Artifact::prepare(&problem(safety)).unwrap();
    let sets = [
        ("only tau_8", modes([vec![7]])),
        ("one thruster is left", singles),
        ("two are left", modes((0..8).flat_map(|j| (0..j).map(move |i| vec![i, j])))),
        ("one has failed", modes((0..8).map(|j| (0..8).filter(|&i| i != j).collect()))),
    ];
    let mut rng = ChaCha8Rng::seed_from_u64(20_221_122);
    let outside = |x: &RelativeVector| (0..6).any(|i| x[i].abs() > if i < 3 { 20.0 } else { 6.0 });
    for (what, set) in sets {
        let mut counts = Counts::default();
        for _ in 0..STATES {
            let first = rng.random_range(0..212);
            let mode = [set[rng.random_range(0..set.len())]];
            let states = [approaching(&mut rng, 150.0, 30.0)];
            let question =
                SafetyQuestion { phase: Some(0), first, states: &states, modes: Some(&mode) };
            let report = safety_report(&artifact, &question, Budget::UNLIMITED).unwrap();
            if let Some(abort) = counts.add(&report[0].modes[0]) {
                assert!(abort.margin_throughout > 0.0 && abort.horizon == HORIZON);
                flies(first, &states[0], abort, outside);
            }
        }
        counts.print(what);
    }
}

#[test]
fn free_drift_that_is_safe_stays_out_between_samples_too() {
    let sphere = watch(AvoidanceRegion::Radius(100.0), 100.0, 6);
    let artifact = Artifact::prepare(&problem(Safety::Passive(sphere))).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(20_221_123);
    let mut counts = Counts::default();
    let mut crossings = 0;
    for _ in 0..STATES {
        let first = rng.random_range(0..212);
        let states = [approaching(&mut rng, 300.0, 200.0)];
        let question = SafetyQuestion { phase: Some(0), first, states: &states, modes: None };
        let report = safety_report(&artifact, &question, Budget::UNLIMITED).unwrap();
        let drift = report[0].drift.unwrap();
        // Both models tell the same story, but for states that graze.
        let grazes = (drift.linear.closest_gauge.least - 1.0).abs() < 0.02;
        assert!(grazes || drift.linear.safe_throughout() == drift.two_body.safe_throughout());
        if let Some(abort) = counts.add(&report[0].modes[0]) {
            // Cutting the sphere between two instants 5 s apart is said in the answer.
            if abort.margin_throughout < 0.0 {
                crossings += 1;
                continue;
            }
            let radius = 100.0 - 10.0 * LINEAR_ERROR_M;
            flies(first, &states[0], abort, |x| x.fixed_rows::<3>(0).norm() > radius);
        }
    }
    counts.print("total failure");
    assert_eq!(counts.undecided, 0, "drift leaves nothing open");
    assert!(crossings < STATES / 50, "{crossings} crossings between instants");
}
