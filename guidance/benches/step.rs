//! Hot paths of the mathematics: one program by both back-ends, the two searches, a whole step.
//!
//! `cargo bench -p vbar-guidance`. Read ratios, not times: machines are shared and noisy.

use nalgebra::{DVector, Vector3};
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        variable_horizon::{
            Artifact, GainChoice, HillPlant, HorizonSearch, MeasuredState, Measurement, Plant,
            Problem, Scheme, State, TerminalFallback, TerminalPoint, VariableHorizon, Verdict,
            Weights,
        },
    },
    dynamics::HillScaling,
    frames::{InFrame, RelativeState},
    mission::{BodyMotion, DisturbanceSet, DockingCone, TargetMotion},
    program::{Clarabel, DualSimplex, Solver},
    units::{Acceleration, Angle},
};

fn main() {
    divan::main();
}

const ACCELERATION_MAX_M_S2: f64 = 0.025;

fn mean_motion_rad_s() -> f64 {
    libm::sqrt(3.986_004_418e14 / libm::pow(7_140_000.0, 3.0))
}

fn spin_rad_s() -> Vector3<f64> {
    Vector3::new(-0.01, -0.88, -0.47).normalize() * (std::f64::consts::TAU / 280.0)
}

fn docking_axis() -> Vector3<f64> {
    Vector3::new(0.983, -0.096, 0.158).normalize()
}

/// EnviSat with the geometry of `simulator/missions/envisat.json`.
fn envisat(search: HorizonSearch) -> Problem {
    Problem {
        plant: Plant::Hill(HillPlant {
            mean_motion_rad_s: mean_motion_rad_s(),
            sample_angle: Angle::from_radians(std::f64::consts::TAU / 1024.0),
            acceleration_max: Acceleration::from_m_s2(ACCELERATION_MAX_M_S2),
            mass: None,
            cone: Some(DockingCone {
                half_angle: Angle::from_degrees(25.0),
                face_roll: Angle::from_radians(0.0),
            }),
            target: TargetMotion::Rigid {
                capture_point_m: docking_axis() * 1.5,
                docking_port_m: docking_axis() * 1.5,
                body: BodyMotion::Spin(spin_rad_s()),
            },
            disturbance: DisturbanceSet::Misalignment(Angle::from_degrees(1.0)),
        }),
        scheme: Scheme::AdaptiveTerminal,
        gain: GainChoice::Poles(vec![0.6, 0.6, 0.6, 0.5, 0.5, 0.5]),
        weights: Weights { fuel: 5.0, tracking: 0.0 },
        search,
        horizon_max: 160,
        horizon_guess: None,
        terminal_point: TerminalPoint::Projection,
        fallback: TerminalFallback::PreviousHorizon,
        steps_max: 200,
        fixed_terminal_terms: None,
    }
}

fn scaling() -> HillScaling {
    HillScaling::new(mean_motion_rad_s(), ACCELERATION_MAX_M_S2)
}

fn scaled_start() -> DVector<f64> {
    let position = docking_axis() * 50.0;
    scaling().scaled(&RelativeState {
        position_m: InFrame::new(position),
        velocity_m_s: InFrame::new(spin_rad_s().cross(&position)),
    })
}

fn measured(x: &DVector<f64>) -> Measurement {
    let state = MeasuredState::Relative(scaling().physical(x.as_slice()));
    Measurement { state, elapsed: None }
}

/// The loop after `steps` undisturbed commands.
fn flown(artifact: &Artifact, steps: usize) -> (State, Measurement) {
    let summary = artifact.summary();
    let mut x = scaled_start();
    let mut state = VariableHorizon::start(artifact);
    for _ in 0..steps {
        let step =
            VariableHorizon::step(artifact, &state, &measured(&x), Budget::UNLIMITED).unwrap();
        let Verdict::Command(command) = step.verdict else { panic!("arrived too early") };
        x = &summary.a * x + &summary.b * command.input;
        state = step.next;
    }
    (state, measured(&x))
}

fn one_program(bencher: divan::Bencher<'_, '_>, horizon: usize, solver: &mut dyn Solver) {
    let artifact = Artifact::prepare(&envisat(HorizonSearch::Local)).unwrap();
    let x = scaled_start();
    bencher.bench_local(|| artifact.solve_horizon(0, &x, horizon, solver).unwrap().cost);
}

#[divan::bench(args = [26, 60, 120])]
fn program_by_simplex_cold(bencher: divan::Bencher<'_, '_>, horizon: usize) {
    one_program(bencher, horizon, &mut DualSimplex::default());
}

#[divan::bench(args = [26, 60, 120], max_time = 2)]
fn program_by_clarabel(bencher: divan::Bencher<'_, '_>, horizon: usize) {
    one_program(bencher, horizon, &mut Clarabel);
}

#[divan::bench(args = ["local", "enumeration"], max_time = 3)]
fn first_step(bencher: divan::Bencher<'_, '_>, search: &str) {
    let search = if search == "local" { HorizonSearch::Local } else { HorizonSearch::Enumeration };
    let artifact = Artifact::prepare(&envisat(search)).unwrap();
    let (state, measurement) = flown(&artifact, 0);
    bencher.bench_local(|| {
        VariableHorizon::step(&artifact, &state, &measurement, Budget::UNLIMITED).unwrap()
    });
}

#[divan::bench(args = [1, 10, 20])]
fn step_in_flight(bencher: divan::Bencher<'_, '_>, after: usize) {
    let artifact = Artifact::prepare(&envisat(HorizonSearch::Local)).unwrap();
    let (state, measurement) = flown(&artifact, after);
    bencher.bench_local(|| {
        VariableHorizon::step(&artifact, &state, &measurement, Budget::UNLIMITED).unwrap()
    });
}

#[divan::bench]
fn prepare(bencher: divan::Bencher<'_, '_>) {
    let problem = envisat(HorizonSearch::Local);
    bencher.bench_local(|| Artifact::prepare(&problem).unwrap());
}

#[divan::bench]
fn artifact_from_bytes(bencher: divan::Bencher<'_, '_>) {
    let bytes = Artifact::prepare(&envisat(HorizonSearch::Local)).unwrap().to_bytes();
    bencher.bench_local(|| Artifact::from_bytes(&bytes).unwrap());
}
