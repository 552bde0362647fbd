//! The dual active set against Clarabel and against the conditions of optimality, on random
//! programs with every kind of trouble.

use std::sync::Arc;

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget, Interruption,
    budget::Question,
    program::{
        Clarabel, DenseRows, DualActiveSet, NotPositiveDefinite, QuadraticCost, QuadraticProgram,
        QuadraticSolution, Status, prove_infeasible, verify_quadratic,
    },
};

/// What is wrong with a random program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Trouble {
    None,
    /// Rows repeated at other scales.
    Duplicates,
    /// Many rows through one point, which is optimal for most gradients.
    Degenerate,
    /// Normals from a space of half the dimension, some of them rows of zeros.
    RankDeficient,
    /// Two opposite rows, or a combination of rows, that exclude each other.
    Infeasible,
    /// A cost with a condition number of some 1e8.
    Stretched,
}

const TROUBLES: [Trouble; 6] = [
    Trouble::None,
    Trouble::Duplicates,
    Trouble::Degenerate,
    Trouble::RankDeficient,
    Trouble::Infeasible,
    Trouble::Stretched,
];

struct Random {
    cost: QuadraticCost,
    gradient: Vec<f64>,
    rows: DenseRows,
    offsets: Vec<f64>,
}

impl Random {
    fn new(seed: u64, trouble: Trouble) -> Self {
        Self::sized(seed, trouble, 1 + (seed % 20) as usize, 1 + (seed * 7 % 150) as usize)
    }

    /// n variables, q rows, before what the trouble adds.
    fn sized(seed: u64, trouble: Trouble, n: usize, q: usize) -> Self {
        let mut chance = ChaCha8Rng::seed_from_u64(seed);
        let mut draw = move || chance.random_range(-1.0..1.0_f64);
        let factor = DMatrix::from_fn(n, n, |_, _| draw());
        let mut hessian = &factor * factor.transpose() + DMatrix::identity(n, n) * 0.1;
        if trouble == Trouble::Stretched {
            let stretch: Vec<f64> = (0..n).map(|_| libm::exp2(6.5 * draw())).collect();
            hessian = DMatrix::from_fn(n, n, |i, j| hessian[(i, j)] * stretch[i] * stretch[j]);
        }
        let gradient: Vec<f64> = (0..n).map(|_| 5.0 * draw()).collect();
        let inside: Vec<f64> = (0..n).map(|_| draw()).collect();
        let (mut rows, mut offsets) = (DenseRows::new(n), Vec::new());
        let rank = if trouble == Trouble::RankDeficient { n.div_ceil(2) } else { n };
        for i in 0..q {
            let flat = trouble == Trouble::RankDeficient && i % 11 == 5;
            let normal: Vec<f64> =
                (0..n).map(|k| if k < rank && !flat { draw() } else { 0.0 }).collect();
            let along: f64 = normal.iter().zip(&inside).map(|(a, x)| a * x).sum();
            let room =
                if trouble == Trouble::Degenerate && i % 3 != 0 { 0.0 } else { draw().abs() };
            rows.push(&normal);
            offsets.push(along + room);
            if trouble == Trouble::Duplicates {
                let scale = 1.0 + 3.0 * draw().abs();
                rows.push(&normal.iter().map(|a| a * scale).collect::<Vec<_>>());
                offsets.push((along + room) * scale);
            }
        }
        if trouble == Trouble::Infeasible {
            // Minus a positive combination of rows, cut off below what the combination allows.
            let chosen = 1 + (seed % 4) as usize;
            let (mut normal, mut offset) = (vec![0.0; n], 0.0);
            for row in 0..chosen.min(q) {
                let weight = 0.1 + draw().abs();
                offset += weight * offsets[row];
                for (sum, a) in normal.iter_mut().zip(rows.normal(row)) {
                    *sum -= weight * a;
                }
            }
            rows.push(&normal);
            offsets.push(-offset - 0.01);
        }
        Self { cost: QuadraticCost::new(hessian).unwrap(), gradient, rows, offsets }
    }

    fn program(&self) -> QuadraticProgram<'_> {
        QuadraticProgram {
            cost: &self.cost,
            gradient: &self.gradient,
            rows: &self.rows,
            offsets: &self.offsets,
        }
    }
}

fn solve(program: &QuadraticProgram<'_>, start: &[usize]) -> QuadraticSolution {
    DualActiveSet::default().solve(program, start, Budget::UNLIMITED).unwrap()
}

/// The conditions hold, and an interior-point method finds the same optimum to its tolerance.
fn check(label: &str, program: &QuadraticProgram<'_>, feasible: bool) {
    let solution = solve(program, &[]);
    let general = Clarabel.solve_quadratic(program, Budget::UNLIMITED).unwrap();
    if !feasible {
        assert_eq!(solution.status, Status::PrimalInfeasible, "{label}");
        let proof = prove_infeasible(program.rows, program.offsets, &solution.active);
        assert!(proof.margin > 0.0 && proof.radius > 1e6, "{label}: {proof:?}");
        assert_ne!(general.status, Status::Optimal, "{label}");
        return;
    }
    assert_eq!(solution.status, Status::Optimal, "{label}: {solution:?}");
    let residuals = verify_quadratic(program, &solution);
    assert!(residuals.violation <= 1e-9, "{label}: {residuals:?}");
    assert!(residuals.stationarity <= 1e-9, "{label}: {residuals:?}");
    assert!(residuals.least_multiplier >= 0.0, "{label}: {residuals:?}");
    assert!(residuals.gap <= 1e-8, "{label}: {residuals:?}");
    assert!(solution.active.len() <= program.cost.variables(), "{label}");
    // Clarabel's own gap is 1e-10; where it stops early it proves nothing, and the conditions
    // above are sufficient without it.
    if general.status == Status::Optimal {
        let gap = (solution.objective - general.objective).abs();
        assert!(gap <= 1e-6 * (1.0 + general.objective.abs()), "{label}: {gap:e}");
    }
    // The optimum is unique, so any start leads there.
    for start in [solution.active_rows(), (0..program.rows.len()).collect(), vec![usize::MAX]] {
        let again = solve(program, &start);
        assert_eq!(again.status, Status::Optimal, "{label}");
        let moved = again.point.iter().zip(&solution.point).map(|(a, b)| (a - b).abs());
        assert!(moved.fold(0.0, f64::max) <= 1e-6, "{label}: from {start:?}");
    }
}

#[test]
fn quadratic_agrees_with_clarabel_on_random_programs() {
    let mut optimal_by_clarabel = 0;
    for seed in 0..420 {
        let trouble = TROUBLES[seed as usize % TROUBLES.len()];
        let random = Random::new(seed, trouble);
        let program = random.program();
        check(&format!("seed {seed} {trouble:?}"), &program, trouble != Trouble::Infeasible);
        let general = Clarabel.solve_quadratic(&program, Budget::UNLIMITED).unwrap();
        optimal_by_clarabel += usize::from(general.status == Status::Optimal);
    }
    // 350 of the 420 are feasible; the comparison must not be empty.
    assert!(optimal_by_clarabel > 300, "{optimal_by_clarabel}");
}

#[test]
fn quadratic_with_ninety_variables_agrees_with_clarabel() {
    // The size of a planner over thirty steps of three inputs.
    for seed in 0..4 {
        let random = Random::sized(seed, Trouble::Degenerate, 90, 300);
        check(&format!("seed {seed}"), &random.program(), true);
    }
}

#[test]
fn quadratic_without_rows_is_the_unconstrained_optimum() {
    let cost = QuadraticCost::new(DMatrix::from_row_slice(2, 2, &[2.0, 0.0, 0.0, 4.0])).unwrap();
    let rows = DenseRows::new(2);
    let program =
        QuadraticProgram { cost: &cost, gradient: &[-2.0, -4.0], rows: &rows, offsets: &[] };
    let solution = solve(&program, &[]);
    assert_eq!(solution.status, Status::Optimal);
    assert!(solution.point.iter().all(|x| (x - 1.0).abs() < 1e-15), "{solution:?}");
    assert_eq!((solution.iterations, solution.scans), (0, 1));
}

#[test]
fn quadratic_projection_onto_a_corner_is_exact() {
    // Nearest point of {x <= 1, y <= 1, x + y <= 2} to (3, 2): the corner, where three rows meet.
    let cost = QuadraticCost::identity(2);
    let rows = DenseRows::from_flat(2, &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    let program = QuadraticProgram {
        cost: &cost,
        gradient: &[-3.0, -2.0],
        rows: &rows,
        offsets: &[1.0, 1.0, 2.0],
    };
    let solution = solve(&program, &[]);
    assert_eq!(solution.status, Status::Optimal);
    assert!(solution.point.iter().all(|x| (x - 1.0).abs() < 1e-15), "{solution:?}");
}

#[test]
fn quadratic_row_of_zeros_that_cannot_hold_is_the_proof() {
    let cost = QuadraticCost::identity(2);
    let rows = DenseRows::from_flat(2, &[1.0, 0.0, 0.0, 0.0]);
    let program =
        QuadraticProgram { cost: &cost, gradient: &[0.0, 0.0], rows: &rows, offsets: &[1.0, -0.5] };
    let solution = solve(&program, &[]);
    assert_eq!(solution.status, Status::PrimalInfeasible);
    assert_eq!(solution.active_rows(), [1]);
    let proof = prove_infeasible(&rows, program.offsets, &solution.active);
    assert_eq!((proof.margin, proof.radius), (0.5, f64::INFINITY));
}

#[test]
fn quadratic_verification_refuses_what_is_not_optimal() {
    let random = Random::new(7, Trouble::None);
    let program = random.program();
    let solution = solve(&program, &[]);
    assert!(!solution.active.is_empty(), "the seed was chosen to have active rows");
    let mut moved = solution.clone();
    moved.point[0] += 1e-3;
    assert!(verify_quadratic(&program, &moved).stationarity > 1e-6);
    let mut wrong_sign = solution.clone();
    wrong_sign.active[0].multiplier = -1.0;
    assert_eq!(verify_quadratic(&program, &wrong_sign).least_multiplier, -1.0);
    // A ray that does not cancel proves nothing far out.
    let proof = prove_infeasible(program.rows, program.offsets, &solution.active);
    assert!(proof.radius < 1e6, "{proof:?}");
}

#[test]
fn quadratic_interruption_is_passed_on() {
    let random = Random::new(8, Trouble::None);
    let ask: Question = Arc::new(|| Some(Interruption::Cancelled));
    let result = DualActiveSet::default().solve(&random.program(), &[], Budget::new(&ask));
    assert_eq!(result, Err(Interruption::Cancelled));
}

#[test]
fn quadratic_cost_that_is_not_convex_is_refused() {
    for entries in [[1.0, 0.0, 0.0, -1.0], [1.0, 0.5, 0.0, 1.0], [1.0, 1.0, 1.0, 1.0]] {
        let hessian = DMatrix::from_row_slice(2, 2, &entries);
        assert_eq!(QuadraticCost::new(hessian), Err(NotPositiveDefinite), "{entries:?}");
    }
}
