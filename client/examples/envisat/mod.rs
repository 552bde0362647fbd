//! The mission all examples fly: a chaser 50 m from EnviSat, which turns once in 280 s.
//!
//! Orbit, spin, thrust, cone and weights are those of [Quartullo2025a, sec. V.B]; the paper does
//! not print the docking axis nor the start, so both are ours.

use std::f64::consts::TAU;

use vbar_client::v1::{
    ConstantSpin, DisturbanceSet, DockingCone, Frame, Gain, HillPlant, HorizonSearch, Measurement,
    Poles, Problem, RelativeState, TargetRotation, ThrustMisalignment, VariableHorizonProblem,
    VariableHorizonScheme, disturbance_set, gain, hill_plant, measurement, problem,
    target_rotation, variable_horizon_problem,
};

/// Direction of the docking port from the target's centre of mass, RTN.
const PORT_AXIS: [f64; 3] = [0.983, -0.096, 0.158];
/// Direction of the target's angular velocity relative to RTN.
const SPIN_AXIS: [f64; 3] = [-0.01, -0.88, -0.47];
/// Duration of one turn.
const SPIN_PERIOD_S: f64 = 280.0;
const SEMI_MAJOR_AXIS_M: f64 = 7_140_000.0;
const SAMPLE_ANGLE_DEG: f64 = 0.3515625;
/// Earth's gravitational parameter, m^3/s^2.
const MU: f64 = 3.986004418e14;

/// The mission.
pub(crate) fn problem() -> Problem {
    let mission = VariableHorizonProblem {
        plant: Some(variable_horizon_problem::Plant::Hill(plant())),
        gain: Some(Gain {
            form: Some(gain::Form::Poles(Poles { values: vec![0.6, 0.6, 0.6, 0.5, 0.5, 0.5] })),
        }),
        fuel_weight: Some(5.0),
        horizon_max: 60,
        ..with_scheme()
    };
    Problem { method: Some(problem::Method::VariableHorizon(mission)) }
}

/// Where the chaser is seen at step 0: 50 m out on the docking axis, turning with it.
pub(crate) fn start() -> Measurement {
    let position = scaled(PORT_AXIS, 50.0);
    let velocity = cross(scaled(SPIN_AXIS, TAU / SPIN_PERIOD_S), position);
    measured(position.to_vec(), velocity.to_vec(), 0)
}

/// A measurement taken when step `step` is due.
pub(crate) fn measured(position_m: Vec<f64>, velocity_m_s: Vec<f64>, step: u32) -> Measurement {
    let state = RelativeState { frame: Frame::Rtn.into(), position_m, velocity_m_s };
    Measurement {
        state: Some(measurement::State::Relative(state)),
        elapsed_s: Some(f64::from(step) * sample_time_s()),
        ..Measurement::default()
    }
}

/// Time one command is held.
pub(crate) fn sample_time_s() -> f64 {
    SAMPLE_ANGLE_DEG.to_radians() / (MU / SEMI_MAJOR_AXIS_M.powi(3)).sqrt()
}

fn with_scheme() -> VariableHorizonProblem {
    let mut mission = VariableHorizonProblem::default();
    mission.set_scheme(VariableHorizonScheme::AdaptiveTerminal);
    mission.set_search(HorizonSearch::Local);
    mission
}

fn plant() -> HillPlant {
    let spin = scaled(SPIN_AXIS, 360.0 / SPIN_PERIOD_S);
    HillPlant {
        orbit: Some(hill_plant::Orbit::SemiMajorAxisM(SEMI_MAJOR_AXIS_M)),
        sampling: Some(hill_plant::Sampling::SampleAngleDeg(SAMPLE_ANGLE_DEG)),
        acceleration_max_m_s2: Some(0.025),
        frame: Frame::Rtn.into(),
        capture_point_m: scaled(PORT_AXIS, 1.5).to_vec(),
        cone: Some(DockingCone { half_angle_deg: Some(25.0), ..DockingCone::default() }),
        rotation: Some(TargetRotation {
            motion: Some(target_rotation::Motion::Spin(ConstantSpin {
                angular_velocity_deg_s: spin.to_vec(),
            })),
        }),
        disturbance: Some(DisturbanceSet {
            form: Some(disturbance_set::Form::Misalignment(ThrustMisalignment {
                angle_max_deg: Some(1.0),
            })),
        }),
        ..HillPlant::default()
    }
}

/// `axis`, brought to `length`.
fn scaled(axis: [f64; 3], length: f64) -> [f64; 3] {
    let norm = axis.iter().map(|a| a * a).sum::<f64>().sqrt();
    axis.map(|a| a / norm * length)
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
