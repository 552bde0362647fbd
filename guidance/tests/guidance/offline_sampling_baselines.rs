//! The controllers that offline sampling is compared with, and that it must differ from.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    control::{
        Claim, ConstraintFamily, Controller, PrepareError,
        offline_sampling::{Artifact, Branch, OfflineSampling, Problem, Scheme, State, Verdict},
    },
    dynamics::MatrixPolynomial,
    program::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status},
    reach::HalfSpaces,
    sampling::ScalarLaw,
    sets::Polytope,
};

use crate::double_integrator::{DISTURBANCE, prepare, problem, step};

fn with(scheme: Scheme) -> Problem {
    Problem { scheme, ..problem() }
}

/// Does any decision satisfy the rows at x? By a program of its own.
fn feasible(artifact: &Artifact, x: &[f64]) -> bool {
    let rows = artifact.rows();
    let width = rows.dimension() - x.len();
    let (mut lines, mut offsets) = (DenseRows::new(width), Vec::new());
    for row in 0..rows.len() {
        let (state, decision) = rows.normal(row).split_at(x.len());
        let at: f64 = state.iter().zip(x).map(|(a, x)| a * x).sum();
        lines.push(decision);
        offsets.push(rows.offset(row) - at);
    }
    let program = QuadraticProgram {
        cost: &QuadraticCost::identity(width),
        gradient: &vec![0.0; width],
        rows: &lines,
        offsets: &offsets,
    };
    let budget = vbar_guidance::Budget::UNLIMITED;
    DualActiveSet::default().solve(&program, &[], budget).unwrap().status == Status::Optimal
}

fn random_state(chance: &mut ChaCha8Rng) -> DVector<f64> {
    DVector::from_vec(vec![chance.random_range(-4.0..4.0), chance.random_range(-1.5..1.5)])
}

#[test]
fn tube_robust_keeps_every_constraint_against_the_worst() {
    let problem = with(Scheme::TubeRobust);
    let artifact = prepare(&problem).unwrap();
    let mut chance = ChaCha8Rng::seed_from_u64(6);
    let corners = problem.plant.corners().unwrap();
    let (mut flown, mut nearest) = (0, f64::INFINITY);
    while flown < 40 {
        let mut x = random_state(&mut chance);
        if !feasible(&artifact, x.as_slice()) {
            continue;
        }
        flown += 1;
        let mut state = OfflineSampling::start(&artifact);
        for k in 0..30 {
            let step = step(&artifact, &state, &x);
            assert_eq!(step.diagnostics.branch, Branch::Optimum, "step {k} at {x}");
            assert!(step.certificate.as_ref().unwrap().passed);
            let Verdict::Command(command) = &step.verdict else { panic!("step {k}") };
            assert!(command.input.amax() <= 1.0 + 1e-7, "step {k}: {}", command.input);
            let z = command.nominal.as_ref().unwrap();
            let half = &artifact.summary().tube.as_ref().unwrap().state_half_widths;
            assert!((&x - z).iter().zip(half.iter()).all(|(e, h)| e.abs() <= h + 1e-7));
            // Whatever is worst: corners of the plant and of the disturbance.
            let plant = &corners[chance.random_range(0..corners.len())];
            let sign = |up: bool| if up { DISTURBANCE } else { -DISTURBANCE };
            let w = DVector::from_fn(2, |_, _| sign(chance.random_bool(0.5)));
            x = &plant.a * &x + &plant.b * &command.input + w;
            let margin = problem.state_set.margins(&x).min();
            assert!(margin >= -1e-7, "step {k}: {x}");
            nearest = nearest.min(margin);
            state = State::from_bytes(&step.next.to_bytes()).unwrap();
        }
        assert!(x.norm() < 0.4, "not at the target after 30 steps: {x}");
    }
    assert!(nearest < 0.1, "no constraint was ever near: {nearest}");
}

#[test]
fn tube_robust_is_more_cautious_than_sampling_and_nominal_less() {
    let [sampled, nominal, tube] =
        [Scheme::OfflineSampling, Scheme::LinearQuadratic, Scheme::TubeRobust]
            .map(|scheme| prepare(&Problem { first_step: None, ..with(scheme) }).unwrap());
    let mut chance = ChaCha8Rng::seed_from_u64(7);
    let mut counts = [0; 3];
    for _ in 0..2000 {
        let x = random_state(&mut chance);
        for (count, artifact) in counts.iter_mut().zip([&tube, &sampled, &nominal]) {
            *count += usize::from(feasible(artifact, x.as_slice()));
        }
    }
    assert!(counts[0] > 100 && counts[0] < counts[1] && counts[1] < counts[2], "{counts:?}");
    for artifact in [&nominal, &tube] {
        assert_eq!(artifact.summary().samples(), 0);
        let statement = artifact.confidence_statement();
        assert!(statement.starts_with("nothing is sampled"), "{statement}");
        assert_eq!(&Artifact::from_bytes(&artifact.to_bytes()).unwrap(), artifact);
    }
    assert!(sampled.confidence_statement().ends_with("no confidence is proved"));
}

#[test]
fn tube_robust_set_is_invariant_and_around_the_least_one() {
    let problem = with(Scheme::TubeRobust);
    let artifact = prepare(&problem).unwrap();
    let summary = artifact.summary();
    let tube = summary.tube.as_ref().unwrap();
    // The weakest input, 10 % of at most 1, on B = [0.5, 1], and the disturbance.
    let expected = [0.05 + DISTURBANCE, 0.1 + DISTURBANCE];
    for (got, expected) in tube.disturbance_half_widths.iter().zip(expected) {
        assert!((got - expected).abs() < 1e-12, "{got} {expected}");
    }
    // Errors under the worst disturbance the set is made for stay in it.
    let mean = problem.plant.at_mean();
    let closed = &mean.a + &mean.b * &summary.gain;
    let rows = artifact.rows();
    let mut set = HalfSpaces::new(2);
    for row in 0..rows.len() {
        let (before, place) = rows.normal(row).split_at(rows.dimension() - 2);
        if before.iter().all(|&a| a == 0.0) {
            set.push(place, rows.offset(row));
        }
    }
    assert!(set.len() >= 4, "{} rows of the tube are left", set.len());
    let mut chance = ChaCha8Rng::seed_from_u64(8);
    let (mut e, mut widest) = (DVector::zeros(2), DVector::<f64>::zeros(2));
    let limit = |i: usize, chance: &mut ChaCha8Rng| {
        let half = tube.disturbance_half_widths[i];
        if chance.random_bool(0.5) { half } else { -half }
    };
    for _ in 0..20_000 {
        let d = DVector::from_fn(2, |i, _| limit(i, &mut chance));
        e = &closed * e + d;
        assert!(set.violation(e.as_slice()) <= 1e-9, "{e}");
        widest = widest.zip_map(&e.abs(), f64::max);
    }
    // Not much wider than chance finds: a tube that is far too wide would pass the above too.
    for (seen, half) in widest.iter().zip(tube.state_half_widths.iter()) {
        assert!(*seen > 0.8 * half, "{seen} of {half}");
    }
}

#[test]
fn linear_quadratic_flies_the_expected_plant_and_knows_no_other() {
    let problem = with(Scheme::LinearQuadratic);
    let artifact = prepare(&problem).unwrap();
    let mean = problem.plant.at_mean();
    let mut x = DVector::from_vec(vec![3.5, 0.0]);
    let mut state = OfflineSampling::start(&artifact);
    let mut cost = f64::INFINITY;
    for k in 0..25 {
        let step = step(&artifact, &state, &x);
        let Verdict::Command(command) = &step.verdict else { panic!("step {k}") };
        assert_eq!(step.certificate.as_ref().unwrap().claim, Claim::Global);
        // The expected plant is the plant: the cost falls by the stage's cost at least.
        let stage = x.norm_squared() + 0.5 * command.input.norm_squared();
        let now = step.diagnostics.expected_cost.unwrap();
        assert!(now <= cost + 1e-9, "step {k}: {now} after {cost}");
        cost = now - stage;
        x = &mean.a * &x + &mean.b * &command.input;
        assert!((&x - &command.expected_states[1]).amax() < 1e-12, "step {k}");
        state = step.next;
    }
    assert!(x.norm() < 1e-4, "{x}");
}

#[test]
fn tube_robust_says_what_it_cannot_do() {
    // Nothing bounds the position, so nothing bounds what an uncertain A does.
    let mut open = with(Scheme::TubeRobust);
    let shaken = DMatrix::from_row_slice(2, 2, &[0.0, 0.0, 0.01, 0.0]);
    open.plant.a = MatrixPolynomial::constant(open.plant.a.constant).with_linear(0, shaken);
    let normals = open.state_set.normals().select_rows(&[0, 1, 3]);
    let offsets = open.state_set.offsets().select_rows(&[0, 1, 3]);
    open.state_set = Polytope::new(normals, offsets);
    let Err(PrepareError::Faults(faults)) = prepare(&open) else { panic!("accepted") };
    assert_eq!(faults[0].field, "state_set");

    // A disturbance that leaves the nominal trajectory nothing.
    let mut rough = with(Scheme::TubeRobust);
    rough.disturbance = vec![ScalarLaw::Uniform { low: -0.4, high: 0.4 }; 2];
    let Err(PrepareError::Infeasible(why)) = prepare(&rough) else { panic!("accepted") };
    assert!(why.reason.contains("the tube around the target"), "{}", why.reason);
    assert!(why.relaxations.iter().any(|r| r.family == ConstraintFamily::Input), "{why:?}");
    // Without disturbance there is no tube to speak of.
    let mut calm = with(Scheme::TubeRobust);
    calm.disturbance = vec![ScalarLaw::Constant(0.0); 2];
    calm.plant.parameters = vec![ScalarLaw::Constant(0.0)];
    let Err(PrepareError::Faults(faults)) = prepare(&calm) else { panic!("accepted") };
    assert_eq!(faults[0].field, "disturbance");
}
