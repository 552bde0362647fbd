//! Sizes that nobody has are refused before any work grows with them: in problems, and in bytes
//! that claim to be artifacts.

use nalgebra::{UnitQuaternion, Vector3};
use vbar_guidance::{
    control::{
        PrepareError, abort_safe,
        variable_horizon::{Artifact, Plant, Problem, Scheme},
    },
    mission::{BodyMotion, RateReference, TargetMotion},
    orbit::KeplerOrbit,
    units::{Angle, Distance, Seconds},
};

use crate::{
    abort_safe_loop::station,
    laws::{DisturbanceLaw, example},
};

/// Far beyond every limit, and still a count that can be read.
const ABSURD: usize = 49_999_999;

#[test]
fn variable_horizon_problem_of_absurd_size_is_a_fault_by_field() {
    let problem = example(Scheme::AdaptiveTerminal, DisturbanceLaw::Uniform).problem();
    let absurd = Problem { steps_max: ABSURD, horizon_max: ABSURD, ..problem };
    let Err(PrepareError::Faults(faults)) = Artifact::prepare(&absurd) else { panic!("prepared") };
    let fields: Vec<&str> = faults.iter().map(|fault| &*fault.field).collect();
    assert_eq!(fields, ["horizon_max", "steps_max"]);
}

#[test]
fn variable_horizon_artifact_whose_sizes_were_altered_is_refused() {
    // Numbers that occur nowhere else in the bytes.
    let (steps_max, horizon_max) = (31_337, 61);
    let problem = example(Scheme::AdaptiveTerminal, DisturbanceLaw::Uniform).problem();
    let bytes =
        Artifact::prepare(&Problem { steps_max, horizon_max, ..problem }).unwrap().to_bytes();
    for (size, field) in [(steps_max, "steps_max"), (horizon_max, "horizon_max")] {
        let size = (size as u64).to_le_bytes();
        let places: Vec<usize> =
            (0..bytes.len() - 8).filter(|&i| bytes[i..i + 8] == size).collect();
        let [place] = places[..] else { panic!("{field} at {places:?}") };
        let mut altered = bytes.clone();
        altered[place..place + 8].copy_from_slice(&(ABSURD as u64).to_le_bytes());
        let why = Artifact::from_bytes(&altered).unwrap_err().what;
        assert!(why.starts_with(field), "{why}");
    }
}

/// The reader's answer, and that of whoever prepares the problem: the field at fault.
#[test]
fn variable_horizon_target_that_turns_too_often_is_a_fault_by_field() {
    let problem = example(Scheme::AdaptiveTerminal, DisturbanceLaw::Uniform).problem();
    let turning = |rate_rad_s: f64| {
        let Plant::Hill(mut plant) = problem.plant.clone() else { panic!("in orbit") };
        let point = Vector3::new(1.5, 0.0, 0.0);
        plant.target = TargetMotion::Rigid {
            capture_point_m: point,
            docking_port_m: point,
            body: BodyMotion::TorqueFree {
                // EnviSat's.
                inertia: Vector3::new(17_023.0, 124_825.0, 129_112.0),
                rtn_from_body: UnitQuaternion::identity(),
                rate_body_rad_s: Vector3::new(0.0, 0.0, rate_rad_s),
                relative_to: RateReference::Inertial,
            },
        };
        Problem { plant: Plant::Hill(plant), ..problem.clone() }
    };
    // A number that occurs nowhere else in the bytes.
    let slow: f64 = 0.012_345;
    let bytes = Artifact::prepare(&turning(slow)).unwrap().to_bytes();
    // What a spacecraft never does: an hour of integration if it were tried.
    let fast: f64 = 1e5;
    let Err(PrepareError::Faults(faults)) = Artifact::prepare(&turning(fast)) else {
        panic!("prepared")
    };
    let fields: Vec<&str> = faults.iter().map(|fault| &*fault.field).collect();
    assert_eq!(fields, ["hill.rotation.torque_free"]);
    let place = bytes.windows(8).position(|eight| eight == slow.to_le_bytes()).unwrap();
    let mut altered = bytes;
    altered[place..place + 8].copy_from_slice(&fast.to_le_bytes());
    let why = Artifact::from_bytes(&altered).unwrap_err().what;
    assert!(why.starts_with("hill.rotation.torque_free"), "{why}");
}

#[test]
fn abort_safe_problem_whose_plant_takes_ages_is_a_fault_by_field() {
    let fields = |problem: &abort_safe::Problem| -> Vec<String> {
        let Err(PrepareError::Faults(faults)) = abort_safe::Artifact::prepare(problem) else {
            panic!("prepared")
        };
        faults.into_iter().map(|fault| fault.field).collect()
    };
    let around = |axis_m: f64, eccentricity: f64| {
        let axis = Distance::from_metres(axis_m);
        KeplerOrbit::new(axis, eccentricity, Angle::from_degrees(0.0), None).unwrap()
    };
    // What altered bytes had: no orbit of the Earth.
    let inside = abort_safe::Problem { orbit: around(1e-318, 0.0), ..station(6) };
    assert_eq!(fields(&inside), ["sample_time_s"]);
    // Through the Earth's centre, almost.
    let orbit = around(8e6, 1.0 - 1e-9);
    let steps_per_period = 200;
    let sample_time = Seconds::from_seconds(orbit.period().seconds() / 200.0);
    let grazing = abort_safe::Problem { orbit, sample_time, steps_per_period, ..station(6) };
    assert_eq!(fields(&grazing), ["sample_time_s"]);
}
