//! One whole step of offline sampling on the docking of [Mammarella2019], in its published size.
//!
//! `cargo bench -p vbar-guidance --bench offline_sampling`; the precompute comes first and takes
//! about a minute. `VBAR_BENCH_SAMPLES` sets the samples a group; 400, reduced exactly, leave
//! about ten thousand rows over twenty corrections. Both back-ends in one run, because only the
//! ratio survives a shared machine.

use std::sync::LazyLock;

use nalgebra::DVector;
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        offline_sampling::{
            Artifact, Branch, Measurement, OfflineSampling, Problem, Redundancy, State, Step,
        },
    },
    program::{Clarabel, DenseRows, QuadraticCost, QuadraticProgram, Status},
    reach::GrowthLimits,
};

#[path = "../tests/guidance/poseidyn_mission.rs"]
mod poseidyn_mission;

static SAMPLED: LazyLock<Artifact> = LazyLock::new(|| prepare(None));
static WITH_FIRST_STEP: LazyLock<Artifact> =
    LazyLock::new(|| prepare(Some(GrowthLimits { rounds: 12, directions: 60, facets_max: 1500 })));

fn main() {
    divan::main();
}

fn prepare(first_step: Option<GrowthLimits>) -> Artifact {
    let samples = std::env::var("VBAR_BENCH_SAMPLES").ok().and_then(|text| text.parse().ok());
    let problem = Problem {
        redundancy: Redundancy::Exact,
        first_step,
        ..poseidyn_mission::problem(samples.unwrap_or(400))
    };
    let run = |shard| OfflineSampling::run_shard(&problem, shard, Budget::UNLIMITED).unwrap();
    let shards = (0..OfflineSampling::shards(&problem)).map(run).collect();
    let artifact = OfflineSampling::merge(&problem, shards, Budget::UNLIMITED).unwrap();
    #[allow(clippy::print_stdout, reason = "the size of what is measured belongs to the figures")]
    {
        println!("{} rows over {} corrections", artifact.rows().len(), 2 * problem.horizon);
    }
    artifact
}

fn step(artifact: &Artifact, state: &State, x: &DVector<f64>) -> Step {
    let measurement = Measurement { state: x.clone(), elapsed: None };
    OfflineSampling::step(artifact, state, &measurement, Budget::UNLIMITED).unwrap()
}

/// On the cone's axis: half way, or nearly as far out as an answer exists.
fn place(artifact: &Artifact, name: &str) -> DVector<f64> {
    let at = |distance: f64| DVector::from_vec(vec![distance, distance, 0.0, 0.0]);
    if name == "interior" {
        return at(0.5);
    }
    let start = OfflineSampling::start(artifact);
    let (mut inside, mut outside) = (0.5, 4.0);
    // To a millimetre: on the edge itself no solver is sure.
    for _ in 0..12 {
        let middle = 0.5 * (inside + outside);
        if step(artifact, &start, &at(middle)).diagnostics.branch == Branch::Optimum {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    at(inside - 0.02)
}

fn bench_step(bencher: divan::Bencher<'_, '_>, artifact: &Artifact, name: &str) {
    let x = place(artifact, name);
    let start = OfflineSampling::start(artifact);
    bencher.bench_local(|| step(artifact, &start, &x));
}

#[divan::bench(args = ["interior", "edge"], max_time = 3)]
fn cold(bencher: divan::Bencher<'_, '_>, name: &str) {
    bench_step(bencher, &SAMPLED, name);
}

#[divan::bench(args = ["interior", "edge"], max_time = 3)]
fn cold_with_first_step_set(bencher: divan::Bencher<'_, '_>, name: &str) {
    bench_step(bencher, &WITH_FIRST_STEP, name);
}

/// The step after one as expected, with its active rows: what a closed loop pays.
#[divan::bench(args = ["interior", "edge"], max_time = 3)]
fn warm(bencher: divan::Bencher<'_, '_>, name: &str) {
    let x = place(&SAMPLED, name);
    let first = step(&SAMPLED, &OfflineSampling::start(&SAMPLED), &x);
    bencher.bench_local(|| step(&SAMPLED, &first.next, &x));
}

/// The same program by an interior-point method on all rows, nothing else of a step.
#[divan::bench(args = ["interior", "edge"], max_time = 10, sample_count = 5)]
fn program_by_clarabel(bencher: divan::Bencher<'_, '_>, name: &str) {
    let x = place(&SAMPLED, name);
    let (n, rows, cost) = (x.len(), SAMPLED.rows(), SAMPLED.expected_cost());
    let width = rows.dimension() - n;
    let quadratic = QuadraticCost::new(cost.view((n, n), (width, width)) * 2.0).unwrap();
    let gradient: Vec<f64> = (n..n + width)
        .map(|i| 2.0 * ((0..n).map(|k| cost[(i, k)] * x[k]).sum::<f64>() + cost[(i, n + width)]))
        .collect();
    let (mut lines, mut offsets) = (DenseRows::new(width), Vec::new());
    for row in 0..rows.len() {
        let (state, corrections) = rows.normal(row).split_at(n);
        lines.push(corrections);
        let at: f64 = state.iter().zip(x.iter()).map(|(a, x)| a * x).sum();
        offsets.push(rows.offset(row) - at);
    }
    let program =
        QuadraticProgram { cost: &quadratic, gradient: &gradient, rows: &lines, offsets: &offsets };
    let solve = || Clarabel.solve_quadratic(&program, Budget::UNLIMITED).unwrap();
    assert_eq!(solve().status, Status::Optimal);
    bencher.bench_local(solve);
}
