//! The offline-sampling controller as a whole, on a double integrator of uncertain strength.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget,
    control::{
        Claim, ConstraintFamily, Controller, PrepareError, StepError,
        offline_sampling::{
            Artifact, Branch, GainChoice, Measurement, OfflineSampling, Redundancy, RowOrigin,
            State, Verdict,
        },
    },
    dynamics::Discretisation,
    reach::StageFamily,
    sampling::ScalarLaw,
    sets::Polytope,
    units::Seconds,
};

use crate::double_integrator::{DISTURBANCE, feasible, prepare, problem, step};

#[test]
fn offline_sampling_keeps_every_promise_in_closed_loop() {
    let problem = problem();
    let artifact = prepare(&problem).unwrap();
    assert_eq!(artifact.summary().doubtful_rows, 0);
    assert_eq!(artifact.summary().joint_confidence, None);
    let mut chance = ChaCha8Rng::seed_from_u64(5);
    let corners = problem.plant.corners().unwrap();
    let mut flown = 0;
    while flown < 20 {
        let x =
            DVector::from_vec(vec![chance.random_range(-4.0..4.0), chance.random_range(-1.5..1.5)]);
        if artifact.first_step_set().unwrap().violation(x.as_slice()) > -1e-6 {
            continue;
        }
        flown += 1;
        let (mut x, mut state) = (x, OfflineSampling::start(&artifact));
        for k in 0..30 {
            let step = step(&artifact, &state, &x);
            assert_eq!(step.diagnostics.branch, Branch::Optimum, "step {k} at {x}");
            assert!(!step.diagnostics.general_solver, "step {k} at {x}");
            let certificate = step.certificate.as_ref().unwrap();
            assert!(certificate.passed && certificate.claim == Claim::Global);
            let Verdict::Command(command) = &step.verdict else { panic!("step {k}") };
            // The input set is kept within what a certificate passes.
            assert!(command.input.amax() <= 1.0 + 1e-7, "step {k}: {}", command.input);
            let plant = &corners[chance.random_range(0..corners.len())];
            let w = DVector::from_fn(2, |_, _| chance.random_range(-DISTURBANCE..DISTURBANCE));
            x = &plant.a * &x + &plant.b * &command.input + w;
            // What was proved: the successor lies in the first-step set.
            assert!(artifact.first_step_set().unwrap().violation(x.as_slice()) <= 1e-7, "step {k}");
            state = State::from_bytes(&step.next.to_bytes()).unwrap();
            assert_eq!(state, step.next);
        }
        assert!(x.norm() < 0.3, "not at the target after 30 steps: {x}");
    }
}

#[test]
fn offline_sampling_artifact_comes_back_from_its_bytes() {
    let artifact = prepare(&problem()).unwrap();
    let bytes = artifact.to_bytes();
    let again = Artifact::from_bytes(&bytes).unwrap();
    assert_eq!(again, artifact);
    assert_eq!(prepare(&problem()).unwrap().to_bytes(), bytes, "not the same bytes twice");
    for length in [0, 1, bytes.len() / 2, bytes.len() - 1] {
        assert!(Artifact::from_bytes(&bytes[..length]).is_err(), "{length} bytes");
    }
    let mut other = problem();
    other.seed += 1;
    assert_ne!(other.canonical_bytes(), problem().canonical_bytes());
    assert_ne!(prepare(&other).unwrap().to_bytes(), bytes);
}

#[test]
fn offline_sampling_without_an_answer_names_rows_or_flies_the_tail() {
    let artifact = prepare(&problem()).unwrap();
    let far = DVector::from_vec(vec![3.9, 1.4]);
    let first = step(&artifact, &OfflineSampling::start(&artifact), &far);
    let Verdict::Infeasible(reason) = &first.verdict else { panic!("{first:?}") };
    assert!(!reason.rows.is_empty());
    let sum: f64 = reason.rows.iter().map(|row| row.weight).sum();
    assert!((sum - 1.0).abs() < 1e-9, "{sum}");
    assert!(first.certificate.is_none());
    // After a good step there is a plan: its tail is flown, flagged, and inside the input set.
    let good =
        step(&artifact, &OfflineSampling::start(&artifact), &DVector::from_vec(vec![2.0, 0.0]));
    let tail = step(&artifact, &good.next, &far);
    assert_eq!(tail.diagnostics.branch, Branch::PreviousPlanTail);
    let Verdict::Command(command) = &tail.verdict else { panic!("{tail:?}") };
    assert!(command.clipped && command.input.amax() <= 1.0 + 1e-9, "{command:?}");
    let certificate = tail.certificate.unwrap();
    assert!(!certificate.passed && certificate.claim == Claim::PreviousPlanTail);
}

/// Where answers end, rounding decides whether there is one: a flight goes on all the same.
#[test]
fn offline_sampling_always_has_a_command_after_the_first_step() {
    let artifact = prepare(&problem()).unwrap();
    let inside = DVector::from_vec(vec![2.0, 0.0]);
    let good = step(&artifact, &OfflineSampling::start(&artifact), &inside);
    let mut chance = ChaCha8Rng::seed_from_u64(11);
    let (mut optima, mut tails) = (0, 0);
    for _ in 0..40 {
        let direction = DVector::from_fn(2, |_, _| chance.random_range(-1.0..1.0));
        let (mut near, mut far) = (0.0, 50.0);
        // Down to two neighbouring numbers.
        for _ in 0..60 {
            let middle = 0.5 * (near + far);
            let step = step(&artifact, &good.next, &(&inside + &direction * middle));
            assert!(matches!(step.verdict, Verdict::Command(_)), "{middle} along {direction}");
            if step.diagnostics.branch == Branch::Optimum {
                assert!(step.certificate.unwrap().passed);
                (near, optima) = (middle, optima + 1);
            } else {
                (far, tails) = (middle, tails + 1);
            }
        }
        assert!(near > 0.0 && far - near < 1e-12, "{near} to {far} along {direction}");
    }
    assert!(optima > 400 && tails > 400, "{optima} optima, {tails} tails");
}

#[test]
fn offline_sampling_names_the_least_relaxation() {
    let artifact = prepare(&problem()).unwrap();
    let start = OfflineSampling::start(&artifact);
    // Outwards until there is no answer: a little beyond, moving one family can be enough.
    let mut states = (50..100).map(|share| DVector::from_vec(vec![0.04 * f64::from(share), 0.5]));
    let (x, why) = states
        .find_map(|x| match step(&artifact, &start, &x).verdict {
            Verdict::Command(_) => None,
            Verdict::Infeasible(why) => Some((x, why)),
        })
        .unwrap();
    assert!(!why.relaxations.is_empty(), "{why:?}");
    // Rows of a family moved as far as was said leave an answer, a little less leaves none.
    for relaxation in &why.relaxations {
        for (share, enough) in [(1.001, true), (0.99, false)] {
            let shift = |origin| {
                let moved = family(origin) == relaxation.family;
                if moved { share * relaxation.amount } else { 0.0 }
            };
            assert_eq!(feasible(&artifact, x.as_slice(), shift), enough, "{relaxation:?}");
        }
    }
}

fn family(origin: RowOrigin) -> ConstraintFamily {
    match origin {
        RowOrigin::FirstStep => ConstraintFamily::FirstStep,
        RowOrigin::Tube => ConstraintFamily::Tube,
        RowOrigin::Stage(group) => match group.family {
            StageFamily::State => ConstraintFamily::State,
            StageFamily::Input => ConstraintFamily::Input,
            StageFamily::Terminal => ConstraintFamily::Terminal,
        },
    }
}

#[test]
fn offline_sampling_refuses_what_does_not_fit() {
    let mut wrong = problem();
    wrong.weights.input = DMatrix::identity(2, 2);
    wrong.samples.violation = 0.2;
    wrong.samples.confidence_complement = 0.0;
    let Err(PrepareError::Faults(faults)) = prepare(&wrong) else { panic!("accepted") };
    let fields: Vec<&str> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert_eq!(fields, ["weights.input", "samples.violation", "samples.confidence_complement"]);

    let mut many = problem();
    many.samples.rows_max = 10_000;
    let Err(PrepareError::Faults(faults)) = prepare(&many) else { panic!("accepted") };
    assert_eq!(faults[0].field, "samples.rows_max");
    assert!(faults[0].got.ends_with(" rows") && faults[0].expected == "at most 10000 rows");

    // Stable where the input has an effect, not where it may have none.
    let mut weak = problem();
    weak.plant.parameters = vec![ScalarLaw::Uniform { low: -1.0, high: 0.1 }];
    weak.gain = GainChoice::Explicit(DMatrix::from_row_slice(1, 2, &[-0.4, -1.1]));
    let Err(PrepareError::Faults(faults)) = prepare(&weak) else { panic!("accepted") };
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(faults[0].field == "gain" && faults[0].got.contains("vertex 0 of 2"), "{faults:?}");

    let artifact = prepare(&problem()).unwrap();
    let short = Measurement { state: DVector::zeros(1), elapsed: None };
    let start = OfflineSampling::start(&artifact);
    let refused = OfflineSampling::step(&artifact, &start, &short, Budget::UNLIMITED);
    assert!(matches!(refused, Err(StepError::Measurement(_))), "{refused:?}");
}

#[test]
fn offline_sampling_without_a_terminal_set_says_how_far_the_target_must_move() {
    // The target lies on the constraint -x <= 0, where no disturbance can be borne.
    let mut blunt = problem();
    let mut offsets = blunt.state_set.offsets().clone();
    offsets[2] = 0.0;
    blunt.state_set = Polytope::new(blunt.state_set.normals().clone(), offsets.clone());
    let Err(PrepareError::Infeasible(why)) = prepare(&blunt) else { panic!("accepted") };
    assert!(why.reason.contains("row 2 of state_set"), "{}", why.reason);
    let [relaxation] = why.relaxations[..] else { panic!("{why:?}") };
    assert_eq!(relaxation.family, ConstraintFamily::State);
    // A little more than what was said leaves room, nine tenths of it do not.
    for (share, enough) in [(1.1, true), (0.9, false)] {
        offsets[2] = share * relaxation.amount;
        let mut moved = blunt.clone();
        moved.state_set = Polytope::new(moved.state_set.normals().clone(), offsets.clone());
        moved.first_step = None;
        assert_eq!(prepare(&moved).is_ok(), enough, "{share} of {}", relaxation.amount);
    }
    // Against a disturbance that no input can bear there is no such offset to name but for all.
    let mut rough = problem();
    rough.disturbance = vec![ScalarLaw::Uniform { low: -3.0, high: 3.0 }; 2];
    assert!(matches!(prepare(&rough), Err(PrepareError::Infeasible(_))));
}

#[test]
fn offline_sampling_catches_up_on_missed_steps() {
    let mut timed = problem();
    // The same plant by Euler's rule of one second.
    let unit = DMatrix::identity(2, 2);
    timed.plant.a.constant -= unit;
    timed.plant.discretisation = Discretisation::Euler { sample_time_s: 1.0 };
    let artifact = prepare(&timed).unwrap();
    let at = |state: &State, x: &DVector<f64>, elapsed: f64| {
        let elapsed = Some(Seconds::from_seconds(elapsed));
        let measurement = Measurement { state: x.clone(), elapsed };
        OfflineSampling::step(&artifact, state, &measurement, Budget::UNLIMITED)
    };
    let start = OfflineSampling::start(&artifact);
    let first = at(&start, &DVector::from_vec(vec![2.0, 0.0]), 0.0).unwrap();
    let Verdict::Command(command) = &first.verdict else { panic!("{first:?}") };
    assert_eq!(command.expected_states.len(), 6);
    assert_eq!(command.expected_inputs[0], command.input);
    // As expected, two steps late: the rest of the plan is still the best there is, or close.
    let late = at(&first.next, &command.expected_states[3], 3.0).unwrap();
    assert_eq!((late.index, late.diagnostics.missed_steps), (3, 2));
    assert_eq!(late.next.step_index(), 4);
    // From where nothing is feasible the tail two steps on is flown: u_3 as planned there.
    let far = DVector::from_vec(vec![3.9, 1.4]);
    let tail = at(&first.next, &far, 3.0).unwrap();
    assert_eq!(tail.diagnostics.branch, Branch::PreviousPlanTail);
    let Verdict::Command(flown) = &tail.verdict else { panic!("{tail:?}") };
    assert_eq!(flown.corrections[1..2], command.corrections[4..5]);
    assert_eq!(flown.corrections[2..], [0.0; 3]);

    for (elapsed, state) in [(1.5, &first.next), (0.0, &first.next)] {
        let refused = at(state, &far, elapsed);
        let Err(StepError::Measurement(faults)) = refused else { panic!("{refused:?}") };
        assert_eq!(faults[0].field, "elapsed_s");
    }
    let exhausted = at(&first.next, &far, 6.0);
    assert_eq!(exhausted, Err(StepError::PlanExhausted { missed: 5, commands_left: 4 }));
}

#[test]
fn offline_sampling_scaled_inwards_is_inside_the_exact_set() {
    let exact = prepare(&problem()).unwrap();
    let mut coarse = problem();
    coarse.redundancy = Redundancy::InnerScaled { epsilon: 0.02 };
    let coarse = prepare(&coarse).unwrap();
    assert!(coarse.summary().kept_rows() < exact.summary().kept_rows());
    assert!(coarse.summary().outer_excess > 0.0);
    // A point of the coarse set satisfies every row of the exact one.
    let mut chance = ChaCha8Rng::seed_from_u64(9);
    let sampled: Vec<usize> =
        (0..exact.rows().len()).filter(|&row| exact.origin(row) != RowOrigin::FirstStep).collect();
    let only_sampled = exact.rows().select(&sampled);
    let mut inside = 0;
    for _ in 0..20_000 {
        let point: Vec<f64> = (0..7)
            .map(|i| chance.random_range(-1.0..1.0) * if i == 0 { 4.0 } else { 1.0 })
            .collect();
        if coarse.rows().violation(&point) <= 0.0 {
            inside += 1;
            assert!(only_sampled.violation(&point) <= 1e-9, "{point:?}");
        }
    }
    assert!(inside > 50, "only {inside} points tested");
}
