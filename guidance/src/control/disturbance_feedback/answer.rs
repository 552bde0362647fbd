//! What a flown instant answers.

use nalgebra::{DVector, Vector3};

use super::State;
use crate::{
    control::Certificate,
    frames::{LvlhCcsds, RelativeState},
    units::Seconds,
};

/// What was measured, and when.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// The measured state.
    pub state: RelativeState<LvlhCcsds>,
    /// Time since the mission's start; must be that of the instant.
    pub elapsed: Option<Seconds>,
}

/// One flown instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The instant this answers, from 0.
    pub index: usize,
    /// Burn or arrival.
    pub verdict: Verdict,
    /// To be handed to the next instant.
    pub next: State,
    /// The proof that the burn keeps its limits, with the plan's own numbers; `None` at arrival.
    pub certificate: Option<Certificate>,
    /// What acted since the previous instant; `None` at instant 0.
    pub disturbance: Option<RealisedDisturbance>,
    /// How it came about.
    pub diagnostics: Diagnostics,
}

/// The decision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Burn now.
    Burn(BurnCommand),
    /// The last instant is reached.
    Arrived(Arrival),
}

/// An impulse to give now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurnCommand {
    /// Time since the mission's start.
    pub elapsed: Seconds,
    /// The impulse, `LVLH_CCSDS`, m/s, within the limits.
    pub delta_v_m_s: Vector3<f64>,
    /// The next instant answers with an arrival.
    pub last: bool,
}

/// The last instant is reached.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// Number of burns given.
    pub burns: usize,
    /// Distance of the measured position from the target state's, metres.
    pub distance_m: f64,
    /// |x - x_f|_2 of the measured state, scaled variables.
    pub deviation_norm: f64,
    /// e' Q_f^-1 e in the problem's metric [Deaconu2014, eq. 21]: at most 1 inside.
    pub level: f64,
    /// The level is at most 1: the measured state lies in the arrival set that was guaranteed.
    pub inside_guaranteed_set: bool,
}

/// The disturbance since the previous instant.
#[derive(Debug, Clone, PartialEq)]
pub struct RealisedDisturbance {
    /// w = x(k+1) - A x(k) - B u(k) [Deaconu2014, eqs. 6-7], scaled, 6 values.
    pub components: DVector<f64>,
    /// Least t with w in t times its set.
    pub gauge: f64,
    /// w is not in its set: the guarantee is void from here on.
    pub outside_assumed_set: bool,
}

/// How an instant's answer came about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Diagnostics {
    /// Nominal part of the burn, m/s; 0 at arrival.
    pub nominal_delta_v_m_s: Vector3<f64>,
    /// Correction before clipping, m/s; 0 at arrival.
    pub correction_m_s: Vector3<f64>,
    /// The wanted impulse exceeded the limit along some axis and was clipped there.
    pub clipped: bool,
    /// How far the measured state lies from the nominal one, measured by the planned outer bound:
    /// at most 1 inside.
    pub deviation_gauge: f64,
}
