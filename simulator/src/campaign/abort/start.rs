//! Where a run starts.

use nalgebra::Vector6;
use rand::{Rng, RngExt as _};

use super::Flyable;
use crate::{
    campaign::{
        SimulationError,
        flight::{STARTS_MAX, stream_of_chance},
        plan::flight::standard_normal,
    },
    mission::abort::{AbortStart, FailureMoment, RingLaw},
};

/// How one run goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Start {
    /// RTN, m and m/s.
    pub state: Vector6<f64>,
    /// The gauge at which thrusters fail, if a gauge decides.
    pub failure_gauge: Option<f64>,
    /// Starts drawn before this one and not kept.
    pub redraws: u32,
}

/// Draws the start of a run; variants of a mission draw the same ones.
pub(super) fn draw(flyable: &Flyable, run: u32) -> Result<Start, SimulationError> {
    let mut chance = stream_of_chance(flyable.seed, run, 0);
    let failure_gauge = match flyable.case.failure.as_ref().map(|failure| failure.when) {
        Some(FailureMoment::AtGauge([low, high])) => {
            Some(low + (high - low) * chance.random::<f64>())
        }
        Some(FailureMoment::AtStep(_)) | None => None,
    };
    match &flyable.case.initial_state {
        AbortStart::Fixed { position_m, velocity_m_s } => {
            let components = [position_m.as_slice(), velocity_m_s].concat();
            let state = Vector6::from_column_slice(&components);
            Ok(Start { state, failure_gauge, redraws: 0 })
        }
        AbortStart::Ring(ring) => {
            for redraws in 0..STARTS_MAX {
                let state = on(ring, &mut chance);
                let least = flyable.judge.gauge_squared_of_start(&state);
                if least.is_some_and(|least| least > ring.gauge_squared_min) {
                    return Ok(Start { state, failure_gauge, redraws });
                }
            }
            let least = ring.gauge_squared_min;
            let reason = format!("no draw drifts with a squared gauge above {least}");
            Err(SimulationError::NoStart { run, tries: STARTS_MAX, reason })
        }
    }
}

/// A state on the ring.
fn on(ring: &RingLaw, chance: &mut impl Rng) -> Vector6<f64> {
    let [near, far] = ring.radius_m;
    let radius = near + (far - near) * chance.random::<f64>();
    let (s, c) = (std::f64::consts::TAU * chance.random::<f64>()).sin_cos();
    let across = ring.cross_track_m * (2.0 * chance.random::<f64>() - 1.0);
    let mut speed = || ring.speed_deviation_m_s * standard_normal(chance);
    Vector6::new(radius * c, radius * s, across, speed(), speed(), speed())
}
