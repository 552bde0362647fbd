//! The precompute of [Mammarella2019] at its published size, on threads of this program:
//!
//! `cargo run --release -p vbar-guidance --example sampled_precompute -- SAMPLES THREADS [exact]`
//!
//! 7303 samples a group make the paper's 956,693 rows. Prints what each shard took, what was kept,
//! what is certified, and a digest that does not depend on the number of threads.

#![allow(clippy::print_stdout, reason = "an example prints what it found")]

use std::{
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Instant,
};

use vbar_guidance::{
    Budget,
    control::{
        Controller,
        offline_sampling::{Artifact, OfflineSampling, Problem, Redundancy, Shard},
    },
    reach::GrowthLimits,
};

#[path = "../tests/guidance/poseidyn_mission.rs"]
mod poseidyn_mission;

/// Starts A, B and C, from the apex of the cone.
const STARTS_M: [[f64; 2]; 3] = [[2.5, 2.5], [2.9, 1.75], [2.75, 2.1]];

fn main() {
    let mut arguments = std::env::args().skip(1);
    let mut number =
        |or: usize| arguments.next().map_or(or, |text| text.parse().expect("a number"));
    let (size, threads) = (number(300), number(2));
    let mut problem = poseidyn_mission::problem(size);
    if arguments.next().is_some() {
        problem.redundancy = Redundancy::Exact;
    }
    let start = Instant::now();
    let artifact = prepare(&problem, threads);
    let bytes = artifact.to_bytes();
    report(&artifact);
    println!(
        "{size} samples a group on {threads} threads: {:.1} s, {} bytes, digest {:016x}",
        start.elapsed().as_secs_f64(),
        bytes.len(),
        digest(&bytes)
    );
    // The first-step set, grown beside: what it takes, and which starts lie in it.
    problem.first_step = Some(GrowthLimits { rounds: 12, directions: 60, facets_max: 1500 });
    let start = Instant::now();
    let artifact = prepare(&problem, threads);
    let Some(set) = artifact.first_step_set() else { return };
    println!(
        "with a first-step set of {} rows, {} of them needed: {:.1} s",
        set.len(),
        artifact.summary().first_step_rows,
        start.elapsed().as_secs_f64()
    );
    let [x, y] = poseidyn_mission::TARGET_M;
    for (name, start) in ["A", "B", "C"].into_iter().zip(STARTS_M) {
        let violation = set.violation(&[start[0] - x, start[1] - y, 0.0, 0.0]);
        println!("start {name}: violation {violation:.4} m");
    }
}

fn prepare(problem: &Problem, threads: usize) -> Artifact {
    let count = OfflineSampling::shards(problem);
    let next = AtomicUsize::new(0);
    let done: Mutex<Vec<(usize, Shard)>> = Mutex::default();
    let work = || {
        loop {
            let shard = next.fetch_add(1, Ordering::Relaxed);
            if shard >= count {
                return;
            }
            let start = Instant::now();
            let result = OfflineSampling::run_shard(problem, shard, Budget::UNLIMITED);
            let result = result.unwrap_or_else(|error| panic!("shard {shard}: {error:?}"));
            if let Some(rows) = result.survivors() {
                println!(
                    "shard {shard}: {} rows left, excess {:.2e}, {:.2} s",
                    rows.rows.rows.len(),
                    rows.outer_excess,
                    start.elapsed().as_secs_f64()
                );
            }
            done.lock().expect("no shard panics").push((shard, result));
        }
    };
    std::thread::scope(|scope| {
        (0..threads).for_each(|_| {
            scope.spawn(work);
        });
    });
    let mut done = done.into_inner().expect("no shard panics");
    done.sort_by_key(|(shard, _)| *shard);
    let shards = done.into_iter().map(|(_, shard)| shard).collect();
    let start = Instant::now();
    let artifact = OfflineSampling::merge(problem, shards, Budget::UNLIMITED).expect("merged");
    println!("merged in {:.2} s", start.elapsed().as_secs_f64());
    artifact
}

fn report(artifact: &Artifact) {
    let summary = artifact.summary();
    for group in &summary.groups {
        println!("{:?}: {} of {} rows kept", group.group, group.kept, group.rows);
    }
    println!(
        "terminal set {} rows after {} steps; {} of {} rows kept, {} doubtful; certified excess \
         {:.3e}, at {} extreme points {:.3e}",
        summary.terminal_rows,
        summary.terminal_iterations,
        summary.kept_rows(),
        summary.rows(),
        summary.doubtful_rows,
        summary.outer_excess,
        summary.checked_points,
        summary.checked_excess
    );
    println!("{}", artifact.confidence_statement());
}

/// FNV-1a: enough to compare two runs.
fn digest(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}
