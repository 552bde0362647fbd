//! The mission as a value: what is asked of an abort-safe controller.

use nalgebra::{Matrix3, SMatrix};

use crate::{
    epoch::Epoch,
    mission::{AvoidanceSet, ThrustMode, Thrusters},
    orbit::KeplerOrbit,
    units::{Distance, Mass, Seconds},
};

/// A rendezvous that can be aborted at every step.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// The moment of step 0, for documents; the mathematics counts from it.
    pub epoch: Option<Epoch>,
    /// The target's orbit; its true anomaly is that of step 0.
    pub orbit: KeplerOrbit,
    /// Of the chaser.
    pub mass: Mass,
    /// Length of a step.
    pub sample_time: Seconds,
    /// kp: steps after which the plant repeats; 1 on a circular orbit.
    pub steps_per_period: usize,
    /// Of the chaser, fixed in RTN.
    pub thrusters: Thrusters,
    /// In the order of the approach, at least one.
    pub phases: Vec<Phase>,
    /// N_p: steps that the regulator looks ahead.
    pub prediction_horizon: usize,
    /// rho > 0: how far beyond a half-space predicted states must stay, in parts of its gauge
    /// (metres for half-spaces without one). [AguilarMarsillach2022, eq. 29]
    pub clearance: f64,
    /// Which sets threaten a predicted state.
    pub timing: SetTiming,
    /// How half-spaces that leave them out are found.
    pub separation: Separation,
    /// What to do when no trajectory clears every half-space.
    pub fallback: Fallback,
    /// Largest distance from the target at which the last phase counts as arrived.
    pub arrival: Distance,
    /// The fastest approach that is plausible, m/s: sets bounded below it are warned of.
    pub fastest_approach_m_s: f64,
    /// Most linear programs that the search for one abort may solve.
    pub abort_programs_max: usize,
    /// How far beyond a face an aborting craft must stay, metres; per second for faces of speeds.
    pub abort_clearance: f64,
    /// Longest mission, steps.
    pub steps_max: usize,
}

/// A part of the approach with its own region to avoid.
#[derive(Debug, Clone, PartialEq)]
pub struct Phase {
    /// What the craft must not be carried into.
    pub safety: Safety,
    /// Weights of the regulator.
    pub weights: Weights,
    /// The next phase begins when the chaser is nearer than this to the region, or to the
    /// target where there is none. The last phase has no next one.
    pub advance_within: Distance,
}

/// Which failures must be survived.
#[derive(Debug, Clone, PartialEq)]
pub enum Safety {
    /// Total failure: free drift keeps out of the set.
    Passive(Watch),
    /// Each of these modes can steer out of it.
    Active {
        /// The set.
        watch: Watch,
        /// Working thrusters after each failure that must be survived.
        modes: Vec<ThrustMode>,
    },
    /// The final approach: nothing is avoided.
    None,
}

/// A set to avoid, and how closely it is watched.
#[derive(Debug, Clone, PartialEq)]
pub struct Watch {
    /// The set.
    pub avoid: AvoidanceSet,
    /// gamma >= 1 against what the model leaves out. [AguilarMarsillach2022, sec. V.D]
    pub inflation: f64,
    /// N: steps after a failure for which safety is promised.
    pub horizon: usize,
    /// s >= 1: equal parts of a step at which it is promised too.
    pub fractions: usize,
    /// l >= 1: sets that each predicted state is kept out of.
    pub nearest: usize,
}

/// x_N'M x_N + sum x_j'L x_j + u_j'R u_j with x in metres and metres per second, u in newtons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// L, symmetric positive semidefinite.
    pub stage: SMatrix<f64, 6, 6>,
    /// R, symmetric positive definite.
    pub input: Matrix3<f64>,
    /// M, symmetric positive semidefinite.
    pub terminal: SMatrix<f64, 6, 6>,
}

/// Which sets threaten a predicted state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SetTiming {
    /// Those that start at its own time index.
    Timed,
    /// Those of every start along the orbit: (12) taken literally. Makes the paper's own start
    /// infeasible.
    Untimed,
}

/// How half-spaces that leave sets out are found.
///
/// A common half-space need not exist, and one that leaves the predicted state out rarely does for
/// sets on different sides of it. Then, and in phases whose sets are of the other kind, each set
/// gets its own tangent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Separation {
    /// One a set: the tangent where the ray to the predicted state leaves it, which is the optimum
    /// of the other two for a single set. [AguilarMarsillach2022, remark 5]
    Tangent,
    /// One for all the nearest polytopes by a linear program. [AguilarMarsillach2022, eq. 28]
    LinearProgram,
    /// One for all the nearest ellipsoids by a second-order cone program.
    /// [AguilarMarsillach2022, eq. 32]
    SecondOrderCone,
}

/// What to do when no trajectory clears every half-space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fallback {
    /// Violate them as little as possible, and say so.
    Soften,
    /// Leave with all thrusters that work. [AguilarMarsillach2022, remark 6]
    Abort,
}

impl Safety {
    /// The set that is watched, if any.
    #[must_use]
    pub fn watch(&self) -> Option<&Watch> {
        match self {
            Self::Passive(watch) | Self::Active { watch, .. } => Some(watch),
            Self::None => None,
        }
    }

    /// Working thrusters after each failure that must be survived.
    #[must_use]
    pub fn modes(&self) -> &[ThrustMode] {
        match self {
            Self::Passive(_) => &[ThrustMode::NONE],
            Self::Active { modes, .. } => modes,
            Self::None => &[],
        }
    }
}
