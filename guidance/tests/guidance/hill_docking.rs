//! Docking in three dimensions on a circular orbit: the method is not tied to the plane.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    control::{
        Controller,
        offline_sampling::{
            Branch, CostWeights, GainChoice, OfflineSampling, Problem, Redundancy, SampleChoice,
            Scheme, Verdict,
        },
    },
    dynamics::{Discretisation, MatrixPolynomial, Monomial, UncertainPlant},
    reach::InvariantLimits,
    sampling::ScalarLaw,
    sets::Polytope,
};

use crate::double_integrator::{prepare, step};

/// Position and velocity in RTN, force in N; q_1 is the mean motion in rad/s, q_2 one over the
/// mass in kg.
fn plant() -> UncertainPlant {
    let entry = |rows: usize, columns: usize, entries: &[(usize, usize, f64)]| {
        let mut matrix = DMatrix::zeros(rows, columns);
        entries.iter().for_each(|&(i, j, value)| matrix[(i, j)] = value);
        matrix
    };
    let mut a = MatrixPolynomial::constant(entry(6, 6, &[(0, 3, 1.0), (1, 4, 1.0), (2, 5, 1.0)]))
        .with_linear(0, entry(6, 6, &[(3, 4, 2.0), (4, 3, -2.0)]));
    let squared = entry(6, 6, &[(3, 0, 3.0), (5, 2, -1.0)]);
    a.terms.push(Monomial { powers: vec![2], matrix: squared });
    let push = entry(6, 3, &[(3, 0, 1.0), (4, 1, 1.0), (5, 2, 1.0)]);
    UncertainPlant {
        a,
        b: MatrixPolynomial::constant(DMatrix::zeros(6, 3)).with_linear(1, push),
        b_w: MatrixPolynomial::constant(DMatrix::identity(6, 6)),
        parameters: vec![
            ScalarLaw::Uniform { low: 0.00108, high: 0.00112 },
            ScalarLaw::Uniform { low: 1.0 / 102.0, high: 1.0 / 98.0 },
        ],
        discretisation: Discretisation::ZeroOrderHold { sample_time_s: 10.0 },
    }
}

/// From along the track, in a pyramid of 20 degrees whose apex is 2 m behind the target, to 60 m;
/// 0.5 m/s on every axis.
fn state_set() -> Polytope {
    let (s, c) = (libm::sin(0.349_065_850_398_866), libm::cos(0.349_065_850_398_866));
    let mut rows: Vec<([f64; 6], f64)> = Vec::new();
    for (axis, sign) in [(0, 1.0), (0, -1.0), (2, 1.0), (2, -1.0)] {
        let mut normal = [0.0; 6];
        (normal[axis], normal[1]) = (sign * c, -s);
        rows.push((normal, 2.0 * s));
    }
    rows.push(([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], 60.0));
    for (axis, sign) in (3..6).flat_map(|axis| [(axis, 1.0), (axis, -1.0)]) {
        let mut normal = [0.0; 6];
        normal[axis] = sign;
        rows.push((normal, 0.5));
    }
    let normals: Vec<f64> = rows.iter().flat_map(|row| row.0).collect();
    let offsets = DVector::from_iterator(rows.len(), rows.iter().map(|row| row.1));
    Polytope::new(DMatrix::from_row_slice(rows.len(), 6, &normals), offsets)
}

fn problem() -> Problem {
    let normals = DMatrix::from_fn(6, 3, |i, j| match i / 2 == j {
        true if i % 2 == 0 => 1.0,
        true => -1.0,
        false => 0.0,
    });
    let state =
        DMatrix::from_diagonal(&DVector::from_vec(vec![1.0, 1.0, 1.0, 100.0, 100.0, 100.0]));
    let input = DMatrix::identity(3, 3) * 100.0;
    let even = |bound: f64| ScalarLaw::Uniform { low: -bound, high: bound };
    Problem {
        scheme: Scheme::OfflineSampling,
        plant: plant(),
        vertices: None,
        disturbance: [vec![even(0.01); 3], vec![even(0.002); 3]].concat(),
        horizon: 6,
        gain: GainChoice::Lqr { state: state.clone(), input: input.clone() },
        weights: CostWeights { state, input, samples: 300 },
        state_set: state_set(),
        input_set: Polytope::new(normals, DVector::from_element(6, 1.0)),
        samples: SampleChoice {
            violation: 0.05,
            confidence_complement: 1e-3,
            variables: None,
            size: Some(150),
            state_at_start: false,
            rows_max: 100_000,
        },
        redundancy: Redundancy::InnerScaled { epsilon: 0.01 },
        terminal_limits: InvariantLimits { iterations_max: 100, rows_max: 2000 },
        first_step: None,
        seed: 3,
    }
}

#[test]
fn hill_docking_flies_from_twenty_metres_to_the_target() {
    let problem = problem();
    let artifact = prepare(&problem).unwrap();
    let summary = artifact.summary();
    println!(
        "hill docking: {} of {} rows kept, terminal set {} rows",
        summary.kept_rows(),
        summary.rows(),
        summary.terminal_rows
    );
    assert_eq!(summary.doubtful_rows, 0);
    assert!(summary.checked_points > 100 && summary.checked_excess <= summary.outer_excess + 1e-7);
    let mut chance = ChaCha8Rng::seed_from_u64(4);
    for start in [[0.0, 20.0, 0.0], [5.0, 18.0, -4.0], [-3.0, 15.0, 4.0]] {
        let mut x = DVector::zeros(6);
        (0..3).for_each(|i| x[i] = start[i]);
        let mut state = OfflineSampling::start(&artifact);
        for k in 0..40 {
            let step = step(&artifact, &state, &x);
            assert_eq!(step.diagnostics.branch, Branch::Optimum, "step {k} at {x}");
            let Verdict::Command(command) = &step.verdict else { panic!("step {k}") };
            assert!(command.input.amax() <= 1.0 + 1e-7);
            let q: Vec<f64> = problem
                .plant
                .parameters
                .iter()
                .map(ScalarLaw::range)
                .map(|r| chance.random_range(r.0..=r.1))
                .collect();
            let plant = problem.plant.at(&q);
            let w = DVector::from_fn(6, |i, _| {
                let (low, high) = problem.disturbance[i].range();
                chance.random_range(low..=high)
            });
            x = &plant.a * &x + &plant.b * &command.input + w;
            assert!(problem.state_set.margins(&x).min() > -0.02, "step {k}: {x}");
            state = step.next;
        }
        assert!(x.rows(0, 3).norm() < 0.6, "not at the target: {x}");
    }
}
