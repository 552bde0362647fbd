//! The online program of offline sampling in its published size: 10,000 rows, 20 variables.
//!
//! `cargo bench -p vbar-guidance --bench quadratic`. Both back-ends in one run, because only the
//! ratio survives a shared machine.

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget,
    program::{
        Clarabel, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, QuadraticSolution,
        Status,
    },
};

fn main() {
    divan::main();
}

const COLUMNS: usize = 20;
const ROWS: usize = 10_000;

struct Program {
    cost: QuadraticCost,
    gradient: Vec<f64>,
    rows: DenseRows,
    offsets: Vec<f64>,
}

impl Program {
    /// Random half-spaces around the origin, in bundles of nearly parallel ones as samples of one
    /// constraint are. `pull` moves the optimum without rows away from the origin: 0.3 leaves it
    /// inside, 5 pulls it against a corner.
    fn new(pull: f64) -> Self {
        let mut chance = ChaCha8Rng::seed_from_u64(2019);
        let mut draw = move || chance.random_range(-1.0..1.0_f64);
        let factor = DMatrix::from_fn(COLUMNS, COLUMNS, |_, _| draw());
        let hessian = DMatrix::identity(COLUMNS, COLUMNS) + &factor * factor.transpose() * 0.3;
        let target: Vec<f64> = (0..COLUMNS).map(|_| pull * draw()).collect();
        let gradient = (0..COLUMNS)
            .map(|i| -(0..COLUMNS).map(|k| hessian[(i, k)] * target[k]).sum::<f64>())
            .collect();
        let (mut rows, mut offsets) = (DenseRows::new(COLUMNS), Vec::new());
        let mut bundle = vec![0.0; COLUMNS];
        for row in 0..ROWS {
            if row % 50 == 0 {
                bundle = (0..COLUMNS).map(|_| draw()).collect();
            }
            let normal: Vec<f64> = bundle.iter().map(|a| a + 0.05 * draw()).collect();
            offsets.push(2.0 + 0.1 * draw());
            rows.push(&normal);
        }
        Self { cost: QuadraticCost::new(hessian).unwrap(), gradient, rows, offsets }
    }

    fn borrowed(&self) -> QuadraticProgram<'_> {
        QuadraticProgram {
            cost: &self.cost,
            gradient: &self.gradient,
            rows: &self.rows,
            offsets: &self.offsets,
        }
    }
}

const PLACES: [(&str, f64); 2] = [("interior", 0.3), ("edge", 5.0)];

fn program(place: &str) -> Program {
    Program::new(PLACES.iter().find(|(name, _)| *name == place).unwrap().1)
}

fn solved(solution: &QuadraticSolution, place: &str) {
    assert_eq!(solution.status, Status::Optimal);
    let active = solution.active.iter().filter(|active| active.multiplier > 1e-6).count();
    assert_eq!(active == 0, place == "interior", "{active} active rows");
}

#[divan::bench(args = ["interior", "edge"], max_time = 3)]
fn cold_by_dual_active_set(bencher: divan::Bencher<'_, '_>, place: &str) {
    let program = program(place);
    let mut solver = DualActiveSet::default();
    let mut solve = || solver.solve(&program.borrowed(), &[], Budget::UNLIMITED).unwrap();
    solved(&solve(), place);
    bencher.bench_local(solve);
}

#[divan::bench(args = ["edge"], max_time = 3)]
fn warm_by_dual_active_set(bencher: divan::Bencher<'_, '_>, place: &str) {
    let program = program(place);
    let mut solver = DualActiveSet::default();
    let cold = solver.solve(&program.borrowed(), &[], Budget::UNLIMITED).unwrap();
    let start = cold.active_rows();
    bencher.bench_local(|| solver.solve(&program.borrowed(), &start, Budget::UNLIMITED).unwrap());
}

#[divan::bench(args = ["interior", "edge"], max_time = 10, sample_count = 10)]
fn by_clarabel(bencher: divan::Bencher<'_, '_>, place: &str) {
    let program = program(place);
    solved(&Clarabel.solve_quadratic(&program.borrowed(), Budget::UNLIMITED).unwrap(), place);
    bencher.bench_local(|| Clarabel.solve_quadratic(&program.borrowed(), Budget::UNLIMITED));
}
