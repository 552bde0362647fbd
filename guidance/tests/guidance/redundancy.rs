//! Redundant rows against their definition, by an interior-point method on every row.

use std::sync::Arc;

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget, Interruption,
    budget::Question,
    program::{Clarabel, DenseRows, QuadraticCost, QuadraticProgram, Status},
    reach::{EXACT, HalfSpaces, NoInterior, Reduction, irredundant},
};

fn reduce(candidates: &HalfSpaces, tolerance: f64) -> Reduction {
    let context = HalfSpaces::new(candidates.dimension());
    irredundant(candidates, &context, tolerance, Budget::UNLIMITED).unwrap()
}

/// A box, and bundles of nearly parallel rows around the origin, as samples of a constraint are.
fn bundles(seed: u64, n: usize, count: usize) -> HalfSpaces {
    let mut chance = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = move || chance.random_range(-1.0..1.0_f64);
    let mut rows = HalfSpaces::new(n);
    for i in 0..2 * n {
        let mut normal = vec![0.0; n];
        normal[i / 2] = if i % 2 == 0 { 1.0 } else { -1.0 };
        rows.push(&normal, 4.0);
    }
    let mut bundle: Vec<f64> = (0..n).map(|_| draw()).collect();
    for row in 2 * n..count {
        if row % 15 == 0 {
            bundle = (0..n).map(|_| draw()).collect();
        }
        let normal: Vec<f64> = bundle.iter().map(|a| a + 0.1 * draw()).collect();
        rows.push(&normal, 1.0 + 0.1 * draw());
    }
    rows
}

/// Largest a_row x - b_row over the rows `others`, with a_row x <= b_row + 1 to bound it: a linear
/// program by Clarabel with a cost that is as good as linear.
fn margin(all: &HalfSpaces, row: usize, others: &[usize]) -> f64 {
    let n = all.dimension();
    let mut rows = DenseRows::new(n);
    let mut offsets = Vec::new();
    for &other in others.iter().filter(|&&other| other != row) {
        rows.push(all.normal(other));
        offsets.push(all.offset(other));
    }
    rows.push(all.normal(row));
    offsets.push(all.offset(row) + 1.0);
    let gradient: Vec<f64> = all.normal(row).iter().map(|a| -a).collect();
    let cost = QuadraticCost::new(DMatrix::identity(n, n) * 1e-9).unwrap();
    let program =
        QuadraticProgram { cost: &cost, gradient: &gradient, rows: &rows, offsets: &offsets };
    let solution = Clarabel.solve_quadratic(&program, Budget::UNLIMITED).unwrap();
    assert_eq!(solution.status, Status::Optimal);
    let at: f64 = all.normal(row).iter().zip(&solution.point).map(|(a, x)| a * x).sum();
    at - all.offset(row)
}

#[test]
fn redundancy_agrees_with_its_definition() {
    for (seed, n, count) in [(1, 2, 60), (2, 3, 90), (3, 5, 150), (4, 8, 120)] {
        let all = bundles(seed, n, count);
        let reduction = reduce(&all, EXACT);
        assert_eq!(reduction.doubtful, 0);
        let every: Vec<usize> = (0..count).collect();
        for row in 0..count {
            // The linear cost is off by 1e-9 |x|^2 and the solver by 1e-10.
            let margin = margin(&all, row, &every);
            assert!(margin.abs() > 1e-6, "seed {seed}: row {row} is on the edge by chance");
            assert_eq!(
                reduction.kept.contains(&row),
                margin > 0.0,
                "seed {seed} row {row}: margin {margin:e}"
            );
        }
        assert!(reduction.kept.len() < count, "seed {seed}: nothing to remove");
    }
}

#[test]
fn redundancy_in_shards_keeps_the_same_set() {
    let all = bundles(5, 4, 300);
    let whole = reduce(&all, EXACT);
    // Every tenth row is the context of three shards; survivors and context are reduced again.
    let context: Vec<usize> = (0..300).filter(|row| row % 10 == 0).collect();
    let mut survivors = context.clone();
    for shard in 0..3 {
        let mine: Vec<usize> = (0..300).filter(|row| row % 10 != 0 && row / 100 == shard).collect();
        let kept = irredundant(&all.select(&mine), &all.select(&context), EXACT, Budget::UNLIMITED)
            .unwrap()
            .kept;
        survivors.extend(kept.iter().map(|&row| mine[row]));
    }
    let merged = reduce(&all.select(&survivors), EXACT);
    let mut kept: Vec<usize> = merged.kept.iter().map(|&row| survivors[row]).collect();
    kept.sort_unstable();
    assert_eq!(kept, whole.kept);
}

#[test]
fn redundancy_with_epsilon_is_inner_once_scaled() {
    let all = bundles(6, 4, 400);
    let exact = reduce(&all, EXACT);
    let coarse = reduce(&all, 0.1);
    assert!(coarse.kept.len() < exact.kept.len());
    assert!(coarse.outer_excess > 0.0 && coarse.outer_excess <= 0.1, "{coarse:?}");
    let inner = coarse.inner(&all);
    let mut worst = f64::NEG_INFINITY;
    for row in (0..all.len()).filter(|row| !coarse.kept.contains(row)) {
        let mut rows = inner.clone();
        rows.push(all.normal(row), all.offset(row));
        let others: Vec<usize> = (0..inner.len()).collect();
        worst = worst.max(margin(&rows, inner.len(), &others));
    }
    // No removed row is violated anywhere in the inner set; without scaling some would be.
    assert!(worst <= 1e-7, "{worst:e}");
    let unscaled = coarse.kept.clone();
    let violated = (0..all.len())
        .filter(|row| !unscaled.contains(row))
        .any(|row| margin(&all, row, &unscaled) > 1e-3);
    assert!(violated, "the case does not show why scaling is needed");
}

#[test]
fn redundancy_of_copies_keeps_one() {
    let mut rows = HalfSpaces::new(2);
    for (normal, offset) in [
        ([1.0, 0.0], 1.0),
        ([0.0, 1.0], 1.0),
        ([-1.0, 0.0], 1.0),
        ([0.0, -1.0], 1.0),
        ([3.0, 0.0], 3.0),
        ([1.0, 0.0], 1.0),
        // Through a corner, and a row of zeros.
        ([1.0, 1.0], 2.0),
        ([0.0, 0.0], 0.5),
    ] {
        rows.push(&normal, offset);
    }
    let kept = reduce(&rows, EXACT).kept;
    assert_eq!(kept.len(), 4, "{kept:?}");
    assert!([1, 2, 3].iter().all(|row| kept.contains(row)), "{kept:?}");
}

#[test]
fn redundancy_of_an_empty_set_is_a_proof() {
    let mut rows = HalfSpaces::new(2);
    rows.push(&[1.0, 0.0], -1.0);
    rows.push(&[-1.0, 0.0], -1.0);
    let none = HalfSpaces::new(2);
    match irredundant(&rows, &none, EXACT, Budget::UNLIMITED) {
        Err(NoInterior::Empty { ray, margin }) => {
            assert_eq!(ray.len(), 2);
            assert!((margin - 1.0).abs() < 1e-12, "{margin}");
        }
        other => panic!("{other:?}"),
    }
    // A segment has points, but none with room.
    rows = HalfSpaces::new(2);
    rows.push(&[1.0, 0.0], 1.0);
    rows.push(&[-1.0, 0.0], -1.0);
    let flat = irredundant(&rows, &none, EXACT, Budget::UNLIMITED);
    assert!(matches!(flat, Err(NoInterior::Flat { .. })), "{flat:?}");
}

#[test]
fn redundancy_interrupted_says_so() {
    let ask: Question = Arc::new(|| Some(Interruption::Deadline));
    let rows = bundles(7, 3, 50);
    let result = irredundant(&rows, &HalfSpaces::new(3), EXACT, Budget::new(&ask));
    assert_eq!(result, Err(NoInterior::Interrupted(Interruption::Deadline)));
}
