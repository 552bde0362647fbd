//! The offline-sampling controller as a whole, on a double integrator of uncertain strength.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget,
    control::{
        Claim, Controller, PrepareError, StepError,
        offline_sampling::{
            Artifact, Branch, Coordinates, CostWeights, GainChoice, Measurement, OfflineSampling,
            Problem, Redundancy, RowOrigin, SampleChoice, Scheme, State, Step, Verdict,
        },
    },
    dynamics::{Discretisation, MatrixPolynomial, UncertainPlant},
    reach::{GrowthLimits, InvariantLimits},
    sampling::ScalarLaw,
    sets::Polytope,
    units::Seconds,
};

const DISTURBANCE: f64 = 0.02;

fn symmetric(sizes: &[f64]) -> Polytope {
    let n = sizes.len();
    let normals = DMatrix::from_fn(2 * n, n, |i, j| match i % n == j {
        true if i < n => 1.0,
        true => -1.0,
        false => 0.0,
    });
    Polytope::new(normals, DVector::from_fn(2 * n, |i, _| sizes[i % n]))
}

fn problem() -> Problem {
    let column = DMatrix::from_row_slice(2, 1, &[0.5, 1.0]);
    let plant = UncertainPlant {
        a: MatrixPolynomial::constant(DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0])),
        b: MatrixPolynomial::constant(column.clone()).with_linear(0, column),
        b_w: MatrixPolynomial::constant(DMatrix::identity(2, 2)),
        parameters: vec![ScalarLaw::Uniform { low: -0.1, high: 0.1 }],
        discretisation: Discretisation::None,
    };
    let identity = DMatrix::identity(2, 2);
    let half = DMatrix::from_element(1, 1, 0.5);
    Problem {
        scheme: Scheme::OfflineSampling,
        plant,
        coordinates: Coordinates::General,
        vertices: None,
        disturbance: vec![ScalarLaw::Uniform { low: -DISTURBANCE, high: DISTURBANCE }; 2],
        horizon: 5,
        gain: GainChoice::Lqr { state: identity.clone(), input: half.clone() },
        weights: CostWeights { state: identity, input: half, samples: 200 },
        state_set: symmetric(&[4.0, 1.5]),
        input_set: symmetric(&[1.0]),
        samples: SampleChoice {
            violation: 0.05,
            confidence_complement: 1e-3,
            variables: None,
            size: Some(400),
            state_at_start: false,
            rows_max: 50_000,
        },
        redundancy: Redundancy::Exact,
        terminal_limits: InvariantLimits { iterations_max: 100, rows_max: 500 },
        first_step: Some(GrowthLimits { rounds: 20, directions: 40, facets_max: 300 }),
        seed: 11,
    }
}

fn prepare(problem: &Problem) -> Result<Artifact, PrepareError> {
    let run = |shard| OfflineSampling::run_shard(problem, shard, Budget::UNLIMITED);
    // In reverse, because the order of computing must not matter, only that of merging.
    let count = OfflineSampling::shards(problem);
    let mut shards = (0..count).rev().map(run).collect::<Result<Vec<_>, _>>()?;
    shards.reverse();
    OfflineSampling::merge(problem, shards, Budget::UNLIMITED)
}

fn step(artifact: &Artifact, state: &State, x: &DVector<f64>) -> Step {
    let measurement = Measurement { state: x.clone(), elapsed: None };
    OfflineSampling::step(artifact, state, &measurement, Budget::UNLIMITED).unwrap()
}

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

#[test]
fn offline_sampling_refuses_what_does_not_fit() {
    let mut wrong = problem();
    wrong.weights.input = DMatrix::identity(2, 2);
    wrong.samples.violation = 0.2;
    let Err(PrepareError::Faults(faults)) = prepare(&wrong) else { panic!("accepted") };
    let fields: Vec<&str> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert_eq!(fields, ["weights.input", "samples.violation"]);

    let mut rough = problem();
    rough.disturbance = vec![ScalarLaw::Uniform { low: -3.0, high: 3.0 }; 2];
    assert!(matches!(prepare(&rough), Err(PrepareError::Infeasible(_))));

    let artifact = prepare(&problem()).unwrap();
    let short = Measurement { state: DVector::zeros(1), elapsed: None };
    let start = OfflineSampling::start(&artifact);
    let refused = OfflineSampling::step(&artifact, &start, &short, Budget::UNLIMITED);
    assert!(matches!(refused, Err(StepError::Measurement(_))), "{refused:?}");
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
