//! Abort-safe rendezvous: building the sets, and one step in its parts.
//!
//! `cargo bench -p vbar-guidance --bench abort_safe`. Read ratios, not times: machines are shared
//! and noisy.

#![allow(clippy::print_stdout, reason = "sizes belong beside the times")]

use nalgebra::{DVector, Matrix3, SMatrix, Vector3};
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        abort_safe::{
            AbortSafe, Artifact, Fallback, Measurement, Phase, Problem, Safety, Separation,
            SetTiming, Watch, Weights,
        },
    },
    dynamics::{PeriodicPlant, RelativeVector},
    frames::{InFrame, RelativeState},
    mission::{AvoidanceRegion, AvoidanceSet, Thrusters},
    orbit::KeplerOrbit,
    program::{PolytopeView, RegulatorProgram, StateCut, nearest_point_of_polytope},
    reach::{
        AbortQuestion, EllipsoidUnion, NearEllipsoid, PassiveQuestion, PolytopeQuestion,
        PolytopeUnion, cut_off_ellipsoid, cut_off_ellipsoids, cut_off_polytopes, find_abort,
        passive_safety,
    },
    sets::{CentredEllipsoid, Polytope, ZonotopeFacets},
    units::{Angle, Distance, Force, Mass, Seconds},
};

fn main() {
    let union =
        EllipsoidUnion::new(&elliptic(), &approach_ellipsoid(), 636, 0..212, Budget::UNLIMITED)
            .unwrap();
    println!("{} ellipsoids in {:.1} MB", union.len(), union.size_bytes() as f64 / 1e6);
    divan::main();
}

/// The V-bar approach: e = 0.1, f_0 = 145 deg. [AguilarMarsillach2022, VI.A2]
fn elliptic() -> PeriodicPlant {
    plant(7_419_320.0, 0.1, 145.0, 212)
}

fn plant(axis_m: f64, e: f64, anomaly_deg: f64, steps: usize) -> PeriodicPlant {
    let anomaly = Angle::from_degrees(anomaly_deg);
    let orbit = KeplerOrbit::new(Distance::from_metres(axis_m), e, anomaly, None).unwrap();
    let (mass, step) = (Mass::from_kilograms(4000.0), Seconds::from_seconds(30.0));
    PeriodicPlant::new(&orbit, mass, step, steps, 1)
}

fn approach_ellipsoid() -> CentredEllipsoid {
    CentredEllipsoid::from_semi_axes(&[1e3, 2e3, 1e3, 100.0, 100.0, 100.0])
}

fn passive_union() -> EllipsoidUnion {
    EllipsoidUnion::new(&elliptic(), &approach_ellipsoid(), 636, 0..212, Budget::UNLIMITED).unwrap()
}

fn cube() -> Polytope {
    let region = AvoidanceRegion::HalfWidths(Vector3::repeat(20.0));
    AvoidanceSet::new(region, 6.0).unwrap().outer_polytope()
}

fn thrusters() -> Thrusters {
    Thrusters::cube_corners(Force::from_newtons(20.0)).unwrap()
}

fn states() -> Vec<RelativeVector> {
    let along = |i: usize| 5e3 - 80.0 * i as f64;
    (0..31)
        .map(|i| RelativeVector::from_column_slice(&[90.0, along(i), 0.0, 0.2, -2.7, 0.0]))
        .collect()
}

#[divan::bench(max_time = 10)]
fn passive_union_of_an_elliptic_orbit(bencher: divan::Bencher<'_, '_>) {
    let (plant, set) = (elliptic(), approach_ellipsoid());
    bencher
        .bench_local(|| EllipsoidUnion::new(&plant, &set, 636, 0..212, Budget::UNLIMITED).unwrap());
}

#[divan::bench]
fn plant_of_an_elliptic_orbit(bencher: divan::Bencher<'_, '_>) {
    bencher.bench_local(elliptic);
}

#[divan::bench]
fn active_union_of_255_modes_on_the_stations_orbit(bencher: divan::Bencher<'_, '_>) {
    let plant = plant(6_726_270.0, 0.0, 0.0, 1);
    let (avoid, forces) = (cube(), thrusters().full_forces_n());
    let modes: Vec<u32> = thrusters().failure_modes().iter().map(|m| m.bits()).collect();
    bencher.bench_local(|| {
        let question = PolytopeQuestion {
            plant: &plant,
            avoid: &avoid,
            full_forces_n: &forces,
            modes: &modes,
            horizon: 46,
        };
        PolytopeUnion::new(&question, 0..1, Budget::UNLIMITED).unwrap().len()
    });
}

#[divan::bench(args = [1, 3])]
fn step_search_of_31_states_timed(bencher: divan::Bencher<'_, '_>, nearest: usize) {
    let union =
        EllipsoidUnion::new(&elliptic(), &approach_ellipsoid(), 636, 0..212, Budget::UNLIMITED)
            .unwrap();
    let states = states();
    bencher.bench_local(|| {
        states.iter().enumerate().map(|(i, x)| union.nearest(i, x, nearest).len()).sum::<usize>()
    });
}

#[divan::bench]
fn search_of_one_state_untimed(bencher: divan::Bencher<'_, '_>) {
    let union =
        EllipsoidUnion::new(&elliptic(), &approach_ellipsoid(), 636, 0..212, Budget::UNLIMITED)
            .unwrap();
    bencher.bench_local(|| union.nearest_untimed(&states()[3], 1));
}

/// What a step of N_p = 30, l = 3 is made of.
struct PassiveStep {
    plant: PeriodicPlant,
    union: EllipsoidUnion,
    facets: ZonotopeFacets,
}

impl PassiveStep {
    fn new() -> Self {
        let plant = elliptic();
        let union =
            EllipsoidUnion::new(&plant, &approach_ellipsoid(), 636, 0..212, Budget::UNLIMITED)
                .unwrap();
        let thrusters = thrusters();
        Self { plant, union, facets: thrusters.admissible(thrusters.nominal()).facets() }
    }

    fn cuts(&self) -> Vec<StateCut> {
        let near = states().into_iter().enumerate().skip(1).flat_map(|(stage, x)| {
            let near = self.union.nearest(stage, &x, 3);
            near.into_iter().map(move |set| (stage, x, set))
        });
        near.map(|(stage, x, set)| {
            let cut = cut_off_ellipsoid(&self.union, set.start, set.instant, &x).unwrap();
            StateCut { stage, normal: cut.normal, offset: cut.offset + 1e-4 }
        })
        .collect()
    }

    fn with_program<T>(&self, work: impl FnOnce(&RegulatorProgram<'_>) -> T) -> T {
        let steps: Vec<_> = (0..30).map(|k| (self.plant.step(k).a, self.plant.step(k).b)).collect();
        let one = SMatrix::<f64, 6, 6>::identity();
        work(&RegulatorProgram {
            steps: &steps,
            initial: &RelativeVector::from_column_slice(&[0.0, 5e3, 0.0, 0.0, 0.0, 0.0]),
            stage_cost: &(one * 1e-6),
            terminal_cost: &(one * 1e-4),
            input_cost: &(Matrix3::identity() * 1.3e-2),
            origin: &Vector3::zeros(),
            basis: &(&self.facets.basis * 20.0),
            facets: self.facets.facets.normals(),
            facet_offsets: &(self.facets.facets.offsets() / 20.0),
            cuts: &self.cuts(),
            softness: None,
        })
    }
}

#[divan::bench]
fn step_search_and_cuts(bencher: divan::Bencher<'_, '_>) {
    let step = PassiveStep::new();
    bencher.bench_local(|| step.cuts().len());
}

#[divan::bench]
fn step_condensing(bencher: divan::Bencher<'_, '_>) {
    let step = PassiveStep::new();
    step.with_program(|program| bencher.bench_local(|| program.condense().unwrap()));
}

#[divan::bench(args = ["cold", "warm"])]
fn step_quadratic_program(bencher: divan::Bencher<'_, '_>, from: &str) {
    let step = PassiveStep::new();
    step.with_program(|program| {
        let condensed = program.condense().unwrap();
        let solved = program.solve(&condensed, &[], Budget::UNLIMITED).unwrap();
        let active: Vec<usize> = solved.active.iter().map(|active| active.row).collect();
        let begin: &[usize] = if from == "warm" { &active } else { &[] };
        bencher.bench_local(|| program.solve(&condensed, begin, Budget::UNLIMITED).unwrap());
    });
}

/// Linear and two-body drift over three periods, with what happens between samples.
#[divan::bench]
fn passive_verdict(bencher: divan::Bencher<'_, '_>) {
    let axis = Distance::from_metres(7_419_320.0);
    let orbit = KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap();
    let (plant, avoid) = (elliptic(), approach_ellipsoid());
    let question = PassiveQuestion { plant: &plant, orbit: &orbit, avoid: &avoid, horizon: 636 };
    bencher.bench_local(|| passive_safety(&question, 0, &states()[3]).unwrap());
}

/// (23) with everything around it, as the front door gives it: the paper's V-bar approach, N_p = 30,
/// l = 3, three periods of safety. The first step has no prediction; the tenth starts from the
/// ninth's.
#[divan::bench(args = [1, 10])]
fn step_whole(bencher: divan::Bencher<'_, '_>, which: usize) {
    let axis = Distance::from_metres(7_419_320.0);
    let ellipsoid = AvoidanceRegion::SemiAxes(Vector3::new(1e3, 2e3, 1e3));
    let watch = Watch {
        avoid: AvoidanceSet::new(ellipsoid, 100.0).unwrap(),
        inflation: 1.0,
        horizon: 636,
        fractions: 1,
        nearest: 3,
    };
    let one = SMatrix::<f64, 6, 6>::identity();
    let weights =
        Weights { stage: one * 1e-6, input: Matrix3::identity() * 1.3e-2, terminal: one * 1e-4 };
    let advance_within = Distance::from_metres(0.0);
    let problem = Problem {
        epoch: None,
        orbit: KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap(),
        mass: Mass::from_kilograms(4000.0),
        sample_time: Seconds::from_seconds(30.0),
        steps_per_period: 212,
        thrusters: thrusters(),
        phases: vec![Phase { safety: Safety::Passive(watch), weights, advance_within }],
        prediction_horizon: 30,
        clearance: 1e-4,
        timing: SetTiming::Timed,
        separation: Separation::Tangent,
        fallback: Fallback::Soften,
        arrival: Distance::from_metres(1.0),
        fastest_approach_m_s: 5.0,
        abort_programs_max: 2000,
        abort_clearance: 1e-3,
        steps_max: 2000,
    };
    let artifact = Artifact::prepare(&problem).unwrap();
    let mut state = AbortSafe::start(&artifact);
    let mut x = RelativeVector::from_column_slice(&[0.0, 5e3, 0.0, 0.0, 0.0, 0.0]);
    let step = |state: &_, x: &RelativeVector| {
        let state_of = |first: usize| InFrame::new(x.fixed_rows::<3>(first).into_owned());
        let measured = RelativeState { position_m: state_of(0), velocity_m_s: state_of(3) };
        let measurement = Measurement { state: measured, elapsed: None, working: None };
        AbortSafe::step(&artifact, state, &measurement, Budget::UNLIMITED).unwrap()
    };
    for _ in 1..which {
        let answer = step(&state, &x);
        x = answer.trajectory.unwrap().states[1];
        state = answer.next;
    }
    bencher.bench_local(|| step(&state, &x));
}

/// Every failure but the total one, without the eight that stand for all: about 184,000 sets.
#[divan::bench(max_time = 10)]
fn active_union_of_254_modes_on_an_elliptic_orbit(bencher: divan::Bencher<'_, '_>) {
    let (plant, avoid, forces) = (elliptic(), cube(), thrusters().full_forces_n());
    let modes: Vec<u32> = thrusters().failure_modes()[1..].iter().map(|m| m.bits()).collect();
    bencher.bench_local(|| {
        let question = PolytopeQuestion {
            plant: &plant,
            avoid: &avoid,
            full_forces_n: &forces,
            modes: &modes,
            horizon: 47,
        };
        PolytopeUnion::new(&question, 0..212, Budget::UNLIMITED).unwrap().len()
    });
}

/// Table II of the paper: 0.94 ms for the distance to a polytope, 0.16 ms to an ellipsoid and
/// 0.011 ms for a radial projection, on its author's laptop.
#[divan::bench]
fn table_2_distance_to_a_polytope(bencher: divan::Bencher<'_, '_>) {
    let cube = cube();
    let x = DVector::from_vec(vec![90.0, 150.0, -30.0, 0.2, -2.7, 0.1]);
    let sides = PolytopeView { normals: cube.normals(), offsets: cube.offsets() };
    bencher.bench_local(|| nearest_point_of_polytope(sides, &x).unwrap());
}

#[divan::bench]
fn table_2_distance_to_an_ellipsoid(bencher: divan::Bencher<'_, '_>) {
    let set = approach_ellipsoid();
    let x = DVector::from_vec(vec![90.0, 5e3, -30.0, 0.2, -2.7, 0.1]);
    bencher.bench_local(|| set.nearest_point(&x));
}

#[divan::bench]
fn table_2_radial_projection(bencher: divan::Bencher<'_, '_>) {
    let set = approach_ellipsoid();
    let x = DVector::from_vec(vec![90.0, 5e3, -30.0, 0.2, -2.7, 0.1]);
    bencher.bench_local(|| set.tangent(&x).unwrap());
}

/// Table III: half-spaces off so many sets at once, by the linear program (28), by the second-order
/// cone program (32), and the tangents of each.
#[divan::bench(args = [1, 3, 10])]
fn table_3_linear_program(bencher: divan::Bencher<'_, '_>, count: usize) {
    let (plant, avoid, forces) = (elliptic(), cube(), thrusters().full_forces_n());
    let question = PolytopeQuestion {
        plant: &plant,
        avoid: &avoid,
        full_forces_n: &forces,
        modes: &[0],
        horizon: 47,
    };
    let union = PolytopeUnion::new(&question, 0..1, Budget::UNLIMITED).unwrap();
    let x = RelativeVector::from_column_slice(&[90.0, 150.0, -30.0, 0.0, 0.2, 0.0]);
    let near = union.nearest(0, &x, count);
    bencher.bench_local(|| cut_off_polytopes(near.iter().map(|(_, set)| set), &x));
}

#[divan::bench(args = [1, 3, 10])]
fn table_3_second_order_cone_program(bencher: divan::Bencher<'_, '_>, count: usize) {
    let union = passive_union();
    let near = union.nearest(3, &states()[3], count);
    bencher.bench_local(|| cut_off_ellipsoids(&union, &near, &states()[3]));
}

#[divan::bench(args = [1, 3, 10])]
fn table_3_tangents(bencher: divan::Bencher<'_, '_>, count: usize) {
    let (union, x) = (passive_union(), states()[3]);
    let near = union.nearest(3, &x, count);
    bencher.bench_local(|| {
        let cut = |set: &NearEllipsoid| cut_off_ellipsoid(&union, set.start, set.instant, &x);
        near.iter().filter_map(cut).map(|cut| cut.clearance).sum::<f64>()
    });
}

/// The proof that no abort exists where no reachable set says so.
#[divan::bench]
fn abort_refuted_by_branching(bencher: divan::Bencher<'_, '_>) {
    let plant = plant(7_419_320.0, 0.1, 140.0, 212);
    let (avoid, forces) = (cube(), thrusters().full_forces_n());
    let x = [-86.16, -100.56, -169.83, 0.6485, 0.8655, 1.3665];
    let x = RelativeVector::from_column_slice(&x);
    let question = AbortQuestion {
        plant: &plant,
        avoid: &avoid,
        clearances: &[1e-3; 12],
        full_forces_n: &forces,
        working: 1 << 7,
        start: 0,
        horizon: 54,
        programs_max: 5000,
        throughout: false,
    };
    bencher.bench_local(|| find_abort(&question, &x, Budget::UNLIMITED).unwrap());
}
