//! Plans with disturbance feedback: how long one takes, and how many the fast path answers.
//!
//! `cargo bench -p vbar-guidance --bench plan`. Read ratios, not times: machines are shared.

#![allow(clippy::print_stdout, reason = "a bench prints what it measured")]

use nalgebra::Vector3;
use vbar_guidance::{
    Budget,
    control::disturbance_feedback::{
        ArrivalMetric, EFFORT_WEIGHT_DEFAULT, FUEL_WEIGHT_DEFAULT, Instants, Plan, Problem, plan,
    },
    frames::{InFrame, RelativeState},
    orbit::KeplerOrbit,
    sets::{Ellipsoid, OuterSum},
    units::{Angle, Distance, Seconds},
};

fn main() {
    fast_path_share();
    divan::main();
}

/// [Deaconu2014, Table 1], for so many instants and seconds, with so much thrust.
fn prisma(count: usize, duration_s: f64, delta_v_max_m_s: f64) -> Problem {
    let state = |p: [f64; 3], v: [f64; 3]| RelativeState {
        position_m: InFrame::new(Vector3::from(p)),
        velocity_m_s: InFrame::new(Vector3::from(v)),
    };
    let a = Distance::from_metres(7_011_000.0);
    let noise = Ellipsoid::from_semi_axes(&[0.02, 0.02, 0.02, 0.002, 0.002, 0.002]);
    Problem {
        orbit: KeplerOrbit::new(a, 0.004, Angle::from_radians(0.0), None).unwrap(),
        epoch: None,
        initial: state([10_000.0, 0.0, 0.0], [0.0; 3]),
        target_state: state([330.0, 0.0, 30.0], [0.0, 0.0, -0.0158]),
        instants: Instants::EqualTime { count, duration: Seconds::from_seconds(duration_s) },
        delta_v_max_m_s,
        navigation_errors: vec![noise.unwrap()],
        outer_sum: OuterSum::MinVolume,
        metric: ArrivalMetric::Scaled6,
        fuel_weight: FUEL_WEIGHT_DEFAULT,
        effort_weight: EFFORT_WEIGHT_DEFAULT,
        compare_open_loop: false,
    }
}

/// Durations of Table 3, thrust from scarce to ample, 6 to 20 instants.
fn fast_path_share() {
    let (mut plans, mut fast) = (0, 0);
    for duration in [6_000.0, 9_000.0, 12_000.0, 18_000.0] {
        for limit in [0.3, 0.5, 1.0, 2.0] {
            for count in [6, 10, 20] {
                if let Ok(plan) = plan(&prisma(count, duration, limit), Budget::UNLIMITED) {
                    plans += 1;
                    fast += usize::from(plan.origin().fast_path);
                }
            }
        }
    }
    println!("fast path: {fast} of {plans} feasible plans");
}

/// Ample thrust: closed form and one linear program.
#[divan::bench(args = [10, 20, 40], max_time = 3)]
fn plan_by_the_fast_path(bencher: divan::Bencher<'_, '_>, count: usize) {
    let problem = prisma(count, 18_000.0, 2.0);
    assert!(plan(&problem, Budget::UNLIMITED).unwrap().origin().fast_path);
    bencher.bench_local(|| plan(&problem, Budget::UNLIMITED).unwrap());
}

/// Scarce thrust: the conic program.
#[divan::bench(args = [10, 20, 40], max_time = 5)]
fn plan_by_cones(bencher: divan::Bencher<'_, '_>, count: usize) {
    let problem = prisma(count, 6_000.0, 0.35);
    assert!(!plan(&problem, Budget::UNLIMITED).unwrap().origin().fast_path);
    bencher.bench_local(|| plan(&problem, Budget::UNLIMITED).unwrap());
}

/// Reading a plan back: everything is recomputed, the certificate included.
#[divan::bench(args = [10, 40], max_time = 3)]
fn plan_from_bytes(bencher: divan::Bencher<'_, '_>, count: usize) {
    let bytes = plan(&prisma(count, 18_000.0, 2.0), Budget::UNLIMITED).unwrap().to_bytes();
    bencher.bench_local(|| Plan::from_bytes(&bytes).unwrap());
}
