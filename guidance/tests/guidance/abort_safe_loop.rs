//! The abort-safe controller in closed loop, its answers at the edges, its bytes.

use nalgebra::{Matrix3, SMatrix, Vector3};
use vbar_guidance::{
    Budget,
    control::{
        ConstraintFamily, Controller, PrepareError, StepError,
        abort_safe::{
            AbortOrigin, AbortReason, AbortSafe, Artifact, Fallback, Measurement, Phase, Problem,
            Safety, SafetyQuestion, Separation, SetTiming, State, Step, Verdict, Watch, Weights,
            safety_report,
        },
    },
    dynamics::{PeriodicPlant, RelativeVector},
    frames::{InFrame, RelativeState},
    mission::{AvoidanceRegion, AvoidanceSet, ThrustMode, Thrusters},
    orbit::KeplerOrbit,
    reach::AbortVerdict,
    units::{Angle, Distance, Force, Mass, Seconds},
};

/// Weights of the paper in km and kN, in SI.
fn weights(stage: f64, input: f64, terminal: f64) -> Weights {
    Weights {
        stage: SMatrix::identity() * (stage * 1e-6),
        input: Matrix3::identity() * (input * 1e-6),
        terminal: SMatrix::identity() * (terminal * 1e-6),
    }
}

fn watch(region: AvoidanceRegion, speed_max_m_s: f64, horizon: usize) -> Watch {
    let avoid = AvoidanceSet::new(region, speed_max_m_s).unwrap();
    Watch { avoid, inflation: 1.0, horizon, fractions: 1, nearest: 1 }
}

fn singles() -> Vec<ThrustMode> {
    (0..8).map(|j| ThrustMode::of([j]).unwrap()).collect()
}

/// The full mission to the space station: approach ellipsoid, keep-out sphere, 20 m box, target.
/// Orbit, regions and weights are the paper's; thresholds it does not give. [AguilarMarsillach2022,
/// VI.A, VI.B, VI.D]
pub(crate) fn station(safety_steps: usize) -> Problem {
    let axis = Distance::from_metres(6_726_270.0);
    let passive = weights(1.0, 1.3e4, 1e2);
    let active = weights(1e3, 1.0, 1e3);
    let ellipsoid = AvoidanceRegion::SemiAxes(Vector3::new(1e3, 2e3, 1e3));
    let cube = AvoidanceRegion::HalfWidths(Vector3::repeat(20.0));
    let phase = |safety, weights, metres| Phase {
        safety,
        weights,
        advance_within: Distance::from_metres(metres),
    };
    Problem {
        epoch: None,
        orbit: KeplerOrbit::new(axis, 0.0, Angle::from_degrees(0.0), None).unwrap(),
        mass: Mass::from_kilograms(4000.0),
        sample_time: Seconds::from_seconds(30.0),
        steps_per_period: 1,
        thrusters: Thrusters::cube_corners(Force::from_newtons(20.0)).unwrap(),
        phases: vec![
            phase(Safety::Passive(watch(ellipsoid, 100.0, safety_steps)), passive, 200.0),
            phase(
                Safety::Passive(watch(AvoidanceRegion::Radius(100.0), 100.0, safety_steps)),
                passive,
                150.0,
            ),
            phase(Safety::Active { watch: watch(cube, 6.0, 46), modes: singles() }, active, 30.0),
            phase(Safety::None, active, 0.0),
        ],
        prediction_horizon: 30,
        clearance: 1e-4,
        timing: SetTiming::Timed,
        separation: Separation::Tangent,
        fallback: Fallback::Soften,
        arrival: Distance::from_metres(5.0),
        fastest_approach_m_s: 5.0,
        abort_programs_max: 2000,
        abort_clearance: 1e-3,
        steps_max: 2000,
    }
}

/// The eccentric orbit of the V-bar approach, first phase only. [AguilarMarsillach2022, VI.A2]
pub(crate) fn eccentric(horizon: usize) -> Problem {
    let axis = Distance::from_metres(7_419_320.0);
    let mut problem = station(horizon);
    problem.orbit = KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap();
    problem.steps_per_period = 212;
    problem.phases.truncate(1);
    problem
}

fn at(x: &RelativeVector) -> Measurement {
    Measurement {
        state: RelativeState {
            position_m: InFrame::new(x.fixed_rows::<3>(0).into_owned()),
            velocity_m_s: InFrame::new(x.fixed_rows::<3>(3).into_owned()),
        },
        elapsed: None,
        working: None,
    }
}

fn start() -> RelativeVector {
    RelativeVector::from_column_slice(&[0.0, 5e3, 0.0, 0.0, 0.0, 0.0])
}

fn step(artifact: &Artifact, state: &State, measurement: &Measurement) -> Step {
    AbortSafe::step(artifact, state, measurement, Budget::UNLIMITED).unwrap()
}

fn first_step(problem: &Problem, x: &RelativeVector) -> Step {
    let artifact = Artifact::prepare(problem).unwrap();
    step(&artifact, &AbortSafe::start(&artifact), &at(x))
}

#[test]
fn station_is_reached_through_every_phase_and_no_failure_on_the_way_is_fatal() {
    let problem = station(549);
    let artifact = Artifact::prepare(&problem).unwrap();
    let plant = PeriodicPlant::new(&problem.orbit, problem.mass, problem.sample_time, 1, 1);
    let mut state = AbortSafe::start(&artifact);
    let mut x = start();
    let mut phases = vec![0];
    let (mut softened, mut asked, mut open) = (0, 0, 0);
    for k in 0..200 {
        let answer = step(&artifact, &state, &at(&x));
        if answer.phase != phases[phases.len() - 1] {
            phases.push(answer.phase);
        }
        match &answer.verdict {
            Verdict::Command(command) => {
                assert!(answer.certificate.as_ref().unwrap().passed, "{answer:?}");
                // Even where a half-space had to give way, no failure is proved to be fatal. Samples
                // 30 s apart are coarse for a 40 m box: a sequence that is outside at all of them
                // can cut a corner between two, and a verdict stays open.
                for mode in answer.safety.iter().flat_map(|safety| &safety.modes) {
                    asked += 1;
                    match &mode.abort {
                        AbortVerdict::Found(abort) => assert!(abort.margin > 0.0, "step {k}"),
                        AbortVerdict::NoneProved { .. } => panic!("step {k}: {mode:?}"),
                        AbortVerdict::Undecided { .. } => open += 1,
                    }
                }
                softened += usize::from(command.softened);
                x = plant.advance(k, &x, &command.force_n);
            }
            Verdict::Arrived(arrival) => {
                assert_eq!(arrival.completion_steps, k);
                println!(
                    "station reached after {k} steps, {softened} of them softened; {open} of \
                     {asked} verdicts on failures open"
                );
                assert!(open * 4 < asked, "{open} of {asked} verdicts open");
                assert_eq!((phases.as_slice(), softened <= 2), ([0, 1, 2, 3].as_slice(), true));
                return;
            }
            other => panic!("step {k}: {other:?}"),
        }
        // What travels is what was meant.
        state = State::from_bytes(&answer.next.to_bytes()).unwrap();
        assert_eq!(state, answer.next);
    }
    panic!("not there after 200 steps, phases {phases:?}");
}

#[test]
fn first_commands_on_an_eccentric_orbit_are_safe_and_certified() {
    let problem = eccentric(636);
    let artifact = Artifact::prepare(&problem).unwrap();
    let plant = PeriodicPlant::new(&problem.orbit, problem.mass, problem.sample_time, 212, 1);
    let (mut state, mut x) = (AbortSafe::start(&artifact), start());
    let mut flown = vec![x];
    for k in 0..30 {
        let answer = step(&artifact, &state, &at(&x));
        let Verdict::Command(command) = answer.verdict else { panic!("{answer:?}") };
        assert!(!command.softened && !answer.diagnostics.by_general_solver);
        let safety = answer.safety.unwrap();
        assert!(safety.abort_always_exists() && safety.drift.unwrap().linear.safe_at_instants());
        x = plant.advance(k, &x, &command.force_n);
        flown.push(x);
        state = answer.next;
    }
    let question = SafetyQuestion { phase: None, first: 0, states: &flown, modes: None };
    let report = safety_report(&artifact, &question, Budget::UNLIMITED).unwrap();
    assert_eq!(report.len(), 31);
    for verdict in &report {
        let mode = &verdict.modes[0];
        assert_eq!(mode.working, ThrustMode::NONE);
        // In free drift being outside every set and having an abort are the same.
        assert_eq!(mode.inside_reachable_set(), !matches!(mode.abort, AbortVerdict::Found(_)));
        assert!(!mode.inside_reachable_set(), "{verdict:?}");
    }
}

#[test]
fn untimed_sets_hold_the_papers_own_start() {
    let timed = eccentric(636);
    let untimed = Problem { timing: SetTiming::Untimed, ..timed.clone() };
    let safe = first_step(&timed, &start());
    let Verdict::Command(command) = safe.verdict else { panic!("{safe:?}") };
    assert!(!command.softened && safe.safety.unwrap().abort_always_exists());
    // The independent implementation: the least gauge of all sets at the start is the root of
    // 0.0005073721077, far inside.
    let clearance = first_step(&untimed, &start()).diagnostics.least_clearance;
    assert!((clearance - (0.0005073721077_f64.sqrt() - 1.0)).abs() < 1e-6, "{clearance}");
}

#[test]
fn shards_in_any_number_of_hands_give_the_same_bytes() {
    let problem = eccentric(40);
    let count = AbortSafe::shards(&problem);
    assert_eq!(count, 14);
    let mut shards: Vec<_> = (0..count)
        .rev()
        .map(|i| AbortSafe::run_shard(&problem, i, Budget::UNLIMITED).unwrap())
        .collect();
    shards.reverse();
    let merged = AbortSafe::merge(&problem, shards.clone(), Budget::UNLIMITED).unwrap();
    let bytes = Artifact::prepare(&problem).unwrap().to_bytes();
    assert_eq!(merged.to_bytes(), bytes);
    assert_eq!(Artifact::from_bytes(&bytes).unwrap(), merged);
    assert!(bytes.starts_with(&problem.canonical_bytes()));
    for length in [0, 1, 100, bytes.len() - 1] {
        assert!(Artifact::from_bytes(&bytes[..length]).is_err(), "{length} bytes");
    }
    shards.pop();
    let error = AbortSafe::merge(&problem, shards, Budget::UNLIMITED).unwrap_err();
    assert!(matches!(error, PrepareError::Failure(_)), "{error:?}");
}

#[test]
fn station_artifact_survives_its_bytes() {
    let artifact = Artifact::prepare(&station(60)).unwrap();
    assert_eq!(Artifact::from_bytes(&artifact.to_bytes()).unwrap(), artifact);
    let summary = artifact.summary();
    let sets: Vec<usize> = summary.phases.iter().map(|phase| phase.sets).collect();
    assert_eq!((sets[0], sets[1], sets[3]), (61, 61, 0));
    assert_eq!(summary.phases[2].dominating_modes, singles());
    assert_eq!(summary.fold_error.seconds(), 0.0);
    assert_eq!(summary.phases[2].hides_approaches_above_m_s, None);
    // All eight single thrusters were asked for, so their sets are all there are.
    assert_eq!(summary.phases[2].sets_of_all_modes, Some(sets[2]));
    // 5 m/s for 30 s is more than the box is wide.
    assert_eq!(summary.phases[2].crosses_unseen_m, Some(150.0));
    assert_eq!(summary.warnings().len(), 1, "{:?}", summary.warnings());
    let faster = Problem { fastest_approach_m_s: 10.0, ..station(60) };
    let summary = Artifact::prepare(&faster).unwrap().summary();
    assert_eq!(summary.phases[2].hides_approaches_above_m_s, Some(6.0));
    let warned = summary.warnings().iter().any(|warning| warning.contains("than 6 m/s"));
    assert!(warned, "{:?}", summary.warnings());
}

/// 300 m from the approach ellipsoid at 12 m/s towards it.
fn too_fast() -> RelativeVector {
    RelativeVector::from_column_slice(&[0.0, 2300.0, 0.0, 0.0, -12.0, 0.0])
}

#[test]
fn craft_that_cannot_keep_out_softens_aloud_or_leaves() {
    let second_step = |problem: &Problem| {
        let artifact = Artifact::prepare(problem).unwrap();
        let first = step(&artifact, &AbortSafe::start(&artifact), &at(&start()));
        step(&artifact, &first.next, &at(&too_fast()))
    };
    let soft = second_step(&eccentric(200));
    let Verdict::Command(command) = &soft.verdict else { panic!("{soft:?}") };
    assert!(command.softened && soft.diagnostics.violation > 0.0, "{:?}", soft.diagnostics);
    assert!(!soft.safety.as_ref().unwrap().abort_always_exists() && soft.unsafe_state.is_some());
    // Why, and what would have to give way: half-spaces by less than the softened step's largest
    // violation, or thrust by more than there is.
    let why = soft.diagnostics.infeasibility.unwrap();
    let families: Vec<_> = why.relaxations.iter().map(|r| r.family).collect();
    assert_eq!(families, [ConstraintFamily::State, ConstraintFamily::Input]);
    let amount = why.relaxations[0].amount;
    assert!(amount > 0.0 && amount <= soft.diagnostics.violation * (1.0 + 1e-6), "{why:?}");
    assert!(why.relaxations[1].amount > 0.0 && !why.rows.is_empty());
    let answer = second_step(&Problem { fallback: Fallback::Abort, ..eccentric(200) });
    match &answer.verdict {
        Verdict::Abort(command) => assert_eq!(command.reason, AbortReason::NoTrajectory),
        Verdict::Infeasible(why) => assert!(!why.rows.is_empty(), "{why:?}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn start_inside_the_unsafe_set_is_refused_with_a_state_outside() {
    let refused = first_step(&eccentric(200), &too_fast());
    let Verdict::Infeasible(why) = &refused.verdict else { panic!("{refused:?}") };
    assert!(
        why.reason.starts_with("the start is inside the unsafe set: without thrust"),
        "{why:?}"
    );
    assert_eq!(why.rows[0].family, ConstraintFamily::InitialState);
    let found = refused.unsafe_state.unwrap();
    assert!((why.relaxations[0].amount - (1.0 - found.gauge)).abs() < 1e-15 && found.gauge < 1.0);
    // 300 m at 12 m/s.
    assert_eq!(found.doomed_after_s, 30.0, "{found:?}");
    let outside = found.outside.unwrap();
    println!("start inside: {:?} outside is {:?}", too_fast().as_slice(), outside.as_slice());
    let again = first_step(&eccentric(200), &outside);
    assert!(again.unsafe_state.is_none());
    assert!(!matches!(&again.verdict, Verdict::Infeasible(why) if why.reason.contains("start")));
    // Nearer than braking to rest, in metres and metres per second over the mean motion.
    let rate = eccentric(200).orbit.mean_motion_rad_s();
    let way = outside - too_fast();
    let length = (way.fixed_rows::<3>(0).norm_squared()
        + way.fixed_rows::<3>(3).norm_squared() / (rate * rate))
        .sqrt();
    assert!(length < 12.0 / rate, "{length} m");
}

#[test]
fn start_without_a_way_to_steer_out_is_refused_in_an_active_phase() {
    let mut problem = station(46);
    problem.phases.drain(..2);
    let x = RelativeVector::from_column_slice(&[0.0, 50.0, 0.0, 0.0, -1.0, 0.0]);
    let refused = first_step(&problem, &x);
    let Verdict::Infeasible(why) = &refused.verdict else { panic!("{refused:?}") };
    assert!(why.reason.contains("alone do the chaser is in the region"), "{why:?}");
    assert!(
        first_step(&problem, &refused.unsafe_state.unwrap().outside.unwrap())
            .unsafe_state
            .is_none()
    );
}

#[test]
fn abort_goes_on_from_step_to_step_and_mends_itself() {
    let mut problem = station(46);
    problem.phases.drain(..2);
    let artifact = Artifact::prepare(&problem).unwrap();
    let plant = PeriodicPlant::new(&problem.orbit, problem.mass, problem.sample_time, 1, 1);
    let mut x = RelativeVector::from_column_slice(&[5.0, 160.0, 0.0, 0.0, -0.6, 0.0]);
    let mut state = step(&artifact, &AbortSafe::start(&artifact), &at(&x)).next;
    let failed = |x: &RelativeVector, k: usize| Measurement {
        // Said once; later measurements need not repeat it.
        working: if k == 1 { ThrustMode::of([7]) } else { None },
        ..at(x)
    };
    let mut origins = Vec::new();
    for k in 1..60 {
        let answer = step(&artifact, &state, &failed(&x, k));
        let Verdict::Abort(command) = &answer.verdict else { panic!("{k}: {answer:?}") };
        assert_eq!((command.began, command.working), (1, ThrustMode::of([7]).unwrap()));
        let reason = if k == 1 { AbortReason::Failure } else { AbortReason::UnderWay };
        assert_eq!((command.reason, command.abort.horizon), (reason, 46));
        assert!(command.abort.margin_throughout > 0.0);
        origins.push(command.origin);
        let force = command.abort.forces_n.first().copied().unwrap_or_default();
        x = plant.advance(k, &x, &force);
        if k == 10 {
            // Pushed 1 m/s off its way: what was found may not do any longer.
            x[4] -= 1.0;
        }
        assert!(x.fixed_rows::<3>(0).amax() > 20.0, "{k}: {x}");
        state = State::from_bytes(&answer.next.to_bytes()).unwrap();
        assert_eq!(state, answer.next);
        assert!(state.is_aborting());
    }
    assert_eq!(origins[0], AbortOrigin::Searched);
    assert!(origins.contains(&AbortOrigin::Kept), "{origins:?}");
}

#[test]
fn common_half_spaces_are_taken_where_they_exist() {
    let mut problem = eccentric(200);
    if let Safety::Passive(watch) = &mut problem.phases[0].safety {
        watch.nearest = 3;
    }
    let x = RelativeVector::from_column_slice(&[200.0, 5000.0, 100.0, 0.0, -1.0, 0.0]);
    let tangents = first_step(&problem, &x);
    problem.separation = Separation::SecondOrderCone;
    let common = first_step(&problem, &x);
    assert_eq!(tangents.diagnostics.cuts, 90);
    assert!((30..90).contains(&common.diagnostics.cuts), "{}", common.diagnostics.cuts);
    for answer in [&tangents, &common] {
        assert!(answer.certificate.as_ref().unwrap().passed);
        assert!(answer.safety.as_ref().unwrap().abort_always_exists());
    }
    // For one set a phase the programs are their closed form.
    let mut single = station(46);
    single.phases.drain(..2);
    single.separation = Separation::LinearProgram;
    let x = RelativeVector::from_column_slice(&[5.0, 160.0, 0.0, 0.0, -0.3, 0.0]);
    let program = first_step(&single, &x);
    let closed = first_step(&Problem { separation: Separation::Tangent, ..single }, &x);
    let force = |answer: &Step| match &answer.verdict {
        Verdict::Command(command) => command.force_n,
        other => panic!("{other:?}"),
    };
    assert!((force(&program) - force(&closed)).norm() < 1e-3, "{program:?}");
    let wrong = Problem { separation: Separation::LinearProgram, ..problem };
    let PrepareError::Faults(faults) = Artifact::prepare(&wrong).unwrap_err() else { panic!() };
    assert_eq!(faults[0].field, "separation");
}

#[test]
fn failed_thrusters_in_a_passive_phase_mean_drift() {
    let artifact = Artifact::prepare(&eccentric(212)).unwrap();
    let measurement = Measurement { working: ThrustMode::of([1, 2]), ..at(&start()) };
    let answer = step(&artifact, &AbortSafe::start(&artifact), &measurement);
    let Verdict::Abort(command) = &answer.verdict else { panic!("{answer:?}") };
    assert_eq!(command.reason, AbortReason::Failure);
    // An abort that does nothing, verified over the whole horizon.
    assert_eq!((command.abort.throttles.len(), command.abort.horizon), (0, 212));
    assert_eq!(command.origin, AbortOrigin::Searched);
    assert!(command.abort.margin > 0.0 && command.abort.flight.states().len() == 213);
}

#[test]
fn phases_advance_by_distance_and_arrival_is_said() {
    let problem = station(60);
    let artifact = Artifact::prepare(&problem).unwrap();
    let of = |y: f64| {
        let x = RelativeVector::from_column_slice(&[0.0, y, 0.0, 0.0, 0.0, 0.0]);
        step(&artifact, &AbortSafe::start(&artifact), &at(&x))
    };
    assert_eq!([2500.0, 2100.0, 240.0, 45.0].map(|y| of(y).phase), [0, 1, 2, 3]);
    let Verdict::Arrived(arrival) = of(4.0).verdict else { panic!("not arrived") };
    assert_eq!((arrival.completion_steps, arrival.distance_m), (0, 4.0));
    // A phase that has begun stays, however far the craft goes.
    let begun = of(240.0).next;
    let far = step(&artifact, &begun, &at(&start()));
    assert_eq!((far.phase, far.index), (2, 1));
}

#[test]
fn wrong_measurements_and_states_are_named() {
    let artifact = Artifact::prepare(&station(20)).unwrap();
    let state = AbortSafe::start(&artifact);
    let mut measurement = at(&start());
    measurement.state.velocity_m_s.components.x = f64::NAN;
    measurement.elapsed = Some(Seconds::from_seconds(31.0));
    measurement.working = ThrustMode::of([9]);
    let error = AbortSafe::step(&artifact, &state, &measurement, Budget::UNLIMITED).unwrap_err();
    let StepError::Measurement(faults) = error else { panic!("{error:?}") };
    let fields: Vec<&str> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert_eq!(fields, ["relative", "elapsed_s", "working_thrusters"]);
    let later = step(&artifact, &state, &at(&start())).next;
    let shorter = Problem { prediction_horizon: 10, ..station(20) };
    let other = Artifact::prepare(&shorter).unwrap();
    let error = AbortSafe::step(&other, &later, &at(&start()), Budget::UNLIMITED).unwrap_err();
    assert!(matches!(error, StepError::State(_)), "{error:?}");
    assert!(State::from_bytes(&later.to_bytes()[1..]).is_err());
}

#[test]
fn every_fault_of_a_problem_is_reported() {
    let mut problem = station(20);
    problem.mass = Mass::from_kilograms(0.0);
    problem.prediction_horizon = 0;
    problem.steps_per_period = 7;
    problem.clearance = f64::NAN;
    problem.phases[1].weights.input = -Matrix3::identity();
    let mut long = station(2000).phases[0].safety.watch().unwrap().clone();
    long.fractions = 31;
    problem.phases[0].safety = Safety::Passive(long);
    problem.phases[2].safety = Safety::Active {
        watch: station(20).phases[0].safety.watch().unwrap().clone(),
        modes: vec![],
    };
    let error = Artifact::prepare(&problem).unwrap_err();
    let PrepareError::Faults(faults) = error else { panic!("{error:?}") };
    let fields: Vec<&str> = faults.iter().map(|fault| fault.field.as_str()).collect();
    let expected = [
        "mass_kg",
        "sample_time_s",
        "prediction_horizon",
        "clearance",
        "phases[0].passive.watch.fractions",
        "phases[1].weights.input",
        "phases[2].active.modes",
    ];
    assert_eq!(fields, expected);
}
