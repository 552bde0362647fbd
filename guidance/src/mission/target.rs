//! Motion of the target's body: where capture point and docking port are at each sample.

use nalgebra::{UnitQuaternion, Vector3};

/// Motion of the points that matter, relative to the target's centre of mass, in RTN.
#[derive(Debug, Clone, PartialEq)]
pub enum TargetMotion {
    /// Points fixed in a rigid body.
    Rigid {
        /// Where the chaser must go, at the mission's start, metres.
        capture_point_m: Vector3<f64>,
        /// Apex of the docking cone at the mission's start, metres.
        docking_port_m: Vector3<f64>,
        /// How the body moves.
        body: BodyMotion,
    },
    /// Points given sample by sample.
    Sampled(Vec<TargetSample>),
}

/// Motion of a rigid body relative to RTN.
#[derive(Debug, Clone, PartialEq)]
pub enum BodyMotion {
    /// At rest in RTN.
    Fixed,
    /// Constant angular velocity relative to RTN, radians per second.
    Spin(Vector3<f64>),
    /// Torque-free, any inertia.
    TorqueFree {
        /// Principal moments; only ratios matter.
        inertia: Vector3<f64>,
        /// Takes body components to RTN components at the start.
        rtn_from_body: UnitQuaternion<f64>,
        /// Initial angular velocity in the body's principal axes, radians per second.
        rate_body_rad_s: Vector3<f64>,
        /// What that velocity is relative to.
        relative_to: RateReference,
    },
}

/// What an angular velocity is measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RateReference {
    /// Inertial space: RTN's own rotation is subtracted.
    Inertial,
    /// RTN, treated as if it were inertial, as [Quartullo2025a, eq. 3] does.
    Rtn,
}

/// One sample of a target's motion, RTN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetSample {
    /// Where the chaser must go, metres.
    pub capture_point_m: Vector3<f64>,
    /// Its velocity in the rotating frame, metres per second.
    pub capture_velocity_m_s: Vector3<f64>,
    /// Apex of the docking cone, metres.
    pub docking_port_m: Vector3<f64>,
}
