//! Whether sampled chance constraints keep their promise, where it is hardest to keep.

use nalgebra::DVector;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        offline_sampling::{Artifact, Branch, OfflineSampling, Problem, Verdict},
    },
    program::{DualActiveSet, QuadraticCost, QuadraticProgram, Status},
    sampling::{Stream, sample_size},
};

use crate::double_integrator::{prepare, problem, step};

/// Trajectories from every extreme point.
const TRAJECTORIES: u32 = 10_000;
/// Of the statement about every measured probability.
const CONFIDENCE: f64 = 0.999;

/// With the sample sizes of the bound, for every group's own variables.
fn sampled_by_the_bound() -> Problem {
    let mut problem = problem();
    problem.samples.size = None;
    problem.samples.rows_max = 1_000_000;
    problem.first_step = None;
    problem
}

/// The probability p at which `count` or fewer of `trials` happen with probability 1 - confidence:
/// the true one is not above it, with that confidence. Clopper and Pearson, Biometrika 26, 1934.
fn clopper_pearson_upper(count: u32, trials: u32, confidence: f64) -> f64 {
    let tail = |p: f64| -> f64 {
        let (mut log_binomial, mut sum) = (0.0, 0.0);
        for i in 0..=count {
            if i > 0 {
                log_binomial += libm::log(f64::from(trials - i + 1) / f64::from(i));
            }
            let (hits, misses) = (f64::from(i), f64::from(trials - i));
            sum += libm::exp(log_binomial + hits * libm::log(p) + misses * libm::log1p(-p));
        }
        sum
    };
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if tail(middle) > 1.0 - confidence {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

#[test]
fn chance_bound_of_clopper_and_pearson_has_known_values() {
    // No hit in n trials: 1 - (1 - confidence)^(1/n).
    let expected = 1.0 - libm::pow(0.001, 1e-4);
    assert!((clopper_pearson_upper(0, 10_000, 0.999) - expected).abs() < 1e-12);
    // From tables: 10 hits in 100 trials, one-sided 97.5 %.
    assert!((clopper_pearson_upper(10, 100, 0.975) - 0.1762).abs() < 1e-4);
}

#[test]
fn chance_sample_sizes_are_the_published_ones() {
    let size = |d| sample_size(d, 0.05, 1e-3).unwrap();
    let states: usize = (0..10).map(|l| size(4 + 2 * l)).sum();
    let inputs: usize = (1..10).map(|l| size(4 + 2 * l)).sum();
    println!("sample sizes: {} for d = 10, {} in all", size(10), states + inputs + size(24));
    assert_eq!((size(10), states + inputs + size(24)), (32_370, 899_806));
}

/// Points (x, v) of the sampled set that lie as far out as any along random directions.
fn extreme_points(artifact: &Artifact, count: usize) -> Vec<Vec<f64>> {
    let rows = artifact.rows();
    let n = rows.dimension();
    let cost = QuadraticCost::new(nalgebra::DMatrix::identity(n, n) * 1e-6).unwrap();
    let mut chance = ChaCha8Rng::seed_from_u64(12);
    let mut solver = DualActiveSet::default();
    let mut farthest = || {
        let gradient: Vec<f64> = (0..n).map(|_| chance.random_range(-1.0..1.0)).collect();
        let program = QuadraticProgram {
            cost: &cost,
            gradient: &gradient,
            rows: rows.rows(),
            offsets: rows.offsets(),
        };
        let solution = solver.solve(&program, &[], Budget::UNLIMITED).unwrap();
        assert_eq!(solution.status, Status::Optimal);
        solution.point
    };
    (0..count).map(|_| farthest()).collect()
}

/// How often each state row is violated at each stage 1 .. T - 1 under u = K x + v_l.
fn violations(artifact: &Artifact, point: &[f64], stream: u64) -> Vec<u32> {
    let problem = artifact.problem();
    let (n, m) = problem.dimensions();
    let rows = problem.state_set.offsets().len();
    let mut counts = vec![0; (problem.horizon - 1) * rows];
    for trajectory in 0..TRAJECTORIES {
        // A seed that no sample of the precompute had.
        let mut stream = Stream::new(problem.seed + 1, stream, u64::from(trajectory));
        let mut x = DVector::from_column_slice(&point[..n]);
        for stage in 1..problem.horizon {
            let v = DVector::from_column_slice(&point[n + (stage - 1) * m..][..m]);
            let plant = problem.plant.draw(&mut stream);
            let laws = problem.disturbance.iter();
            let w = DVector::from_iterator(laws.len(), laws.map(|law| law.draw(&mut stream)));
            let input = &artifact.summary().gain * &x + v;
            x = &plant.a * &x + &plant.b * input + &plant.b_w * w;
            for (row, margin) in problem.state_set.margins(&x).iter().enumerate() {
                counts[(stage - 1) * rows + row] += u32::from(*margin < 0.0);
            }
        }
    }
    counts
}

#[test]
fn chance_constraints_hold_at_extreme_points_of_the_feasible_set() {
    let problem = sampled_by_the_bound();
    let artifact = prepare(&problem).unwrap();
    assert!(artifact.summary().joint_confidence.is_some_and(|joint| joint > 0.9));
    let points = extreme_points(&artifact, 12);
    let (mut worst, mut met) = (0, 0);
    for (index, point) in points.iter().enumerate() {
        let counts = violations(&artifact, point, index as u64);
        let largest = counts.into_iter().max().unwrap();
        worst = worst.max(largest);
        met += u32::from(largest > 0);
    }
    let bound = clopper_pearson_upper(worst, TRAJECTORIES, CONFIDENCE);
    println!(
        "chance constraints: at {} extreme points at most {worst} of {TRAJECTORIES} trajectories \
         violate a row at a stage; probability below {bound:.5} with confidence {CONFIDENCE}",
        points.len()
    );
    assert!(bound < problem.samples.violation, "{bound}");
    // Points at which nothing could be violated would prove nothing.
    assert!(met > 0, "no extreme point was on the edge of a chance constraint");
}

#[test]
fn chance_constraints_stay_feasible_over_ten_thousand_steps() {
    let problem = problem();
    let artifact = prepare(&problem).unwrap();
    let set = artifact.first_step_set().unwrap();
    let corners = problem.plant.corners().unwrap();
    let mut chance = ChaCha8Rng::seed_from_u64(13);
    let (mut steps, mut bound_active) = (0, 0);
    while steps < 10_000 {
        let mut x =
            DVector::from_vec(vec![chance.random_range(-4.0..4.0), chance.random_range(-1.5..1.5)]);
        if set.violation(x.as_slice()) > -1e-6 {
            continue;
        }
        let mut state = OfflineSampling::start(&artifact);
        // Short flights: near the target nothing is hard.
        for k in 0..8 {
            let step = step(&artifact, &state, &x);
            assert_eq!(step.diagnostics.branch, Branch::Optimum, "step {k} at {x}");
            let Verdict::Command(command) = &step.verdict else { panic!("step {k}") };
            bound_active += u32::from(command.input.amax() > 1.0 - 1e-6);
            let plant = &corners[chance.random_range(0..corners.len())];
            let w = problem.disturbance.iter().map(|law| {
                let (low, high) = law.range();
                if chance.random_bool(0.5) { low } else { high }
            });
            let w = DVector::from_iterator(2, w.collect::<Vec<_>>());
            x = &plant.a * &x + &plant.b * &command.input + w;
            state = step.next;
            steps += 1;
        }
    }
    println!("recursive feasibility: {steps} steps, {bound_active} of them at the input's bound");
    assert!(bound_active > 500, "{bound_active}");
}
