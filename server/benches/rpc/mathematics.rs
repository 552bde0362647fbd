//! The same mission without a network: one program by both back-ends, and a first step by both
//! searches.

use std::time::Instant;

use nalgebra::{DVector, Vector3};
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        variable_horizon::{
            Artifact, GainChoice, HillPlant, HorizonSearch, MeasuredState, Measurement, Plant,
            Problem, Scheme, TerminalFallback, TerminalPoint, VariableHorizon, Weights,
        },
    },
    dynamics::HillScaling,
    frames::{InFrame, RelativeState},
    mission::{BodyMotion, DisturbanceSet, DockingCone, TargetMotion},
    program::{Clarabel, DualSimplex, Solver},
    units::{Acceleration, Angle},
};

use crate::{Row, histogram, record};

const CALLS: usize = 2000;
const HORIZON: usize = 26;
const ACCELERATION_MAX_M_S2: f64 = 0.025;

/// Clarabel's row comes first: it is what the others are compared with.
pub(crate) fn measure() -> Vec<Row> {
    vec![
        program("LP N = 26, Clarabel", &mut || Box::new(Clarabel)),
        program("LP N = 26, simplex, cold", &mut || Box::new(DualSimplex::default())),
        first_step("first step, LOCAL", HorizonSearch::Local),
        first_step("first step, ENUMERATION", HorizonSearch::Enumeration),
    ]
}

/// One program, its rows built anew and with a solver that remembers nothing.
fn program(name: &'static str, solver: &mut dyn FnMut() -> Box<dyn Solver>) -> Row {
    let artifact = Artifact::prepare(&envisat(HorizonSearch::Local)).expect("an artifact");
    let start = scaling().scaled(&start());
    let mut call = histogram();
    for count in 0..CALLS / 10 + CALLS {
        let begin = Instant::now();
        let answer = artifact.solve_horizon(0, &start, HORIZON, &mut *solver());
        let time = begin.elapsed();
        assert!(answer.expect("an answer").cost.is_some());
        if count >= CALLS / 10 {
            record(&mut call, time);
        }
    }
    Row { name, call, compute: None, programs: 0, fallbacks: 0 }
}

fn first_step(name: &'static str, search: HorizonSearch) -> Row {
    let artifact = Artifact::prepare(&envisat(search)).expect("an artifact");
    let state = MeasuredState::Relative(scaling().physical(scaled_start().as_slice()));
    let measurement = Measurement { state, elapsed: None };
    let begin_of_mission = VariableHorizon::start(&artifact);
    let mut row = Row { name, call: histogram(), compute: None, programs: 0, fallbacks: 0 };
    for count in 0..CALLS / 10 + CALLS {
        let begin = Instant::now();
        let step =
            VariableHorizon::step(&artifact, &begin_of_mission, &measurement, Budget::UNLIMITED);
        let time = begin.elapsed();
        let diagnostics = step.expect("a step").diagnostics;
        row.programs += diagnostics.trials.len();
        row.fallbacks += diagnostics.general_solver_calls;
        if count >= CALLS / 10 {
            record(&mut row.call, time);
        }
    }
    row
}

fn mean_motion_rad_s() -> f64 {
    (3.986_004_418e14 / 7_140_000.0_f64.powi(3)).sqrt()
}

fn scaling() -> HillScaling {
    HillScaling::new(mean_motion_rad_s(), ACCELERATION_MAX_M_S2)
}

fn spin_rad_s() -> Vector3<f64> {
    Vector3::new(-0.01, -0.88, -0.47).normalize() * (std::f64::consts::TAU / 280.0)
}

fn docking_axis() -> Vector3<f64> {
    Vector3::new(0.983, -0.096, 0.158).normalize()
}

fn start() -> RelativeState {
    let position = docking_axis() * 50.0;
    RelativeState {
        position_m: InFrame::new(position),
        velocity_m_s: InFrame::new(spin_rad_s().cross(&position)),
    }
}

fn scaled_start() -> DVector<f64> {
    scaling().scaled(&start())
}

/// What `missions::envisat` says, in the words of the mathematics.
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
        horizon_max: 60,
        horizon_guess: None,
        terminal_point: TerminalPoint::Projection,
        fallback: TerminalFallback::PreviousHorizon,
        steps_max: 200,
        fixed_terminal_terms: None,
    }
}
