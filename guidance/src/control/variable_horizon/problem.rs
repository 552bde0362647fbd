//! The mission as a value: what is asked of a variable-horizon controller.

use nalgebra::{DMatrix, DVector};

use crate::{
    mission::{DisturbanceSet, DockingCone, TargetMotion},
    sets::{Polytope, Zonotope},
    units::{Acceleration, Angle, Mass, Seconds},
};

/// A mission for one of the variable-horizon controllers.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// What is controlled.
    pub plant: Plant,
    /// Which controller.
    pub scheme: Scheme,
    /// How the tube feedback K is found.
    pub gain: GainChoice,
    /// Weights of the cost.
    pub weights: Weights,
    /// How the horizon is searched.
    pub search: HorizonSearch,
    /// Longest horizon considered, at least 1.
    pub horizon_max: usize,
    /// First guess of the local search at step 0; `None`: from a minimum-time estimate.
    pub horizon_guess: Option<usize>,
    /// Where the nominal trajectory ends.
    pub terminal_point: TerminalPoint,
    /// What `AdaptiveTerminal` does when the cost does not fall enough.
    pub fallback: TerminalFallback,
    /// Longest mission, steps.
    pub steps_max: usize,
    /// `FixedTerminal`: terms that stand for the infinite sum; `None`: until below 1e-18.
    pub fixed_terminal_terms: Option<usize>,
}

/// What is controlled.
#[derive(Debug, Clone, PartialEq)]
pub enum Plant {
    /// A chaser near a target on a circular orbit.
    Hill(HillPlant),
    /// Any discrete-time linear plant.
    Linear(LinearPlant),
}

/// A chaser near a target on a circular orbit; all vectors in RTN.
#[derive(Debug, Clone, PartialEq)]
pub struct HillPlant {
    /// Mean motion eta of the target's orbit, radians per second.
    pub mean_motion_rad_s: f64,
    /// Orbital angle tau_s of one sample.
    pub sample_angle: Angle,
    /// Largest acceleration along each RTN axis.
    pub acceleration_max: Acceleration,
    /// Mass of the chaser, if forces are wanted.
    pub mass: Option<Mass>,
    /// Docking cone; `None`: no state constraint.
    pub cone: Option<DockingCone>,
    /// Motion of capture point and docking port.
    pub target: TargetMotion,
    /// Disturbances of one step.
    pub disturbance: DisturbanceSet,
}

/// x(k+1) = A x(k) + B u(k) + w(k), in the plant's own units.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearPlant {
    /// A, n x n.
    pub a: DMatrix<f64>,
    /// B, n x m.
    pub b: DMatrix<f64>,
    /// Least inputs, m.
    pub input_lower: DVector<f64>,
    /// Greatest inputs, m.
    pub input_upper: DVector<f64>,
    /// Further half-spaces on the input.
    pub input_set: Option<Polytope>,
    /// State constraints; `None`: none.
    pub state_set: Option<Polytope>,
    /// Disturbances of one step, centred at 0.
    pub disturbance: Zonotope,
    /// Reference states at steps 0, 1, ...; a single one is held for ever.
    pub reference: Vec<DVector<f64>>,
    /// Length of a step, if time means something.
    pub sample_time: Option<Seconds>,
}

/// Which controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheme {
    /// Algorithm 1 of both papers.
    AdaptiveTerminal,
    /// Fixed terminal set sequence: the baseline FTC / FTCS.
    FixedTerminal,
    /// One plan, then tube feedback: the baseline TBOC.
    TubeOptimalControl,
    /// No tightening; not robust.
    Nominal,
}

/// How the tube feedback K in u = v + K (x - z) is found.
#[derive(Debug, Clone, PartialEq)]
pub enum GainChoice {
    /// K itself, m x n, scaled.
    Explicit(DMatrix<f64>),
    /// n real poles of A + B K.
    Poles(Vec<f64>),
    /// Weights of the infinite-horizon discrete regulator.
    Lqr {
        /// n x n, symmetric positive semidefinite.
        state: DMatrix<f64>,
        /// m x m, symmetric positive definite.
        input: DMatrix<f64>,
    },
}

/// J = N + tracking sum |z - r|_1 + fuel sum |v|_1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// gamma_v >= 0.
    pub fuel: f64,
    /// gamma_z >= 0.
    pub tracking: f64,
}

/// How the horizon is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HorizonSearch {
    /// From a guess to the nearest feasible horizon, then downhill.
    Local,
    /// Every horizon that could still be better.
    Enumeration,
}

/// Where the nominal trajectory ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TerminalPoint {
    /// Nearest point of the tightened state set to the reference [Quartullo2025a, eq. 21].
    Projection,
    /// The reference itself [Quartullo2025b, eq. 12].
    Reference,
}

/// The problem solved when the cost does not fall by lambda_bar.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TerminalFallback {
    /// Horizon N(k-1) - 1, centred on the last terminal point [Quartullo2025a, line 14].
    PreviousHorizon,
    /// Any horizon up to N(k-1) - 1, centred on the reference [Quartullo2025b, line 13].
    FreeHorizon,
}
