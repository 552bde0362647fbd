//! The target's way through inertial space, computed once and shared by all who fly near it.

use nalgebra::{Vector3, Vector6};

use super::{
    hermite::{Moment, quintic},
    runge_kutta,
    sun_moon::{SunAndMoon, tides},
    two_body::{
        Elements, OrbitFrame, STEP_MAX, free_fall_time_s, gravity, inertial_state, position_of,
        stacked, velocity_of,
    },
};

/// Time between two tabulated states. The interpolation's error, `(w h)^6 r / 46080`, is under
/// 1e-9 m in any orbit above the atmosphere.
const SPACING_S: f64 = 10.0;

/// Everything that pulls at a craft except its own thrusters.
#[derive(Debug, Clone)]
pub(crate) struct Forces {
    /// Earth's second zonal harmonic; 0 for a round Earth.
    pub j2: f64,
    /// Sun and Moon, if they act.
    pub sun_moon: Option<SunAndMoon>,
}

impl Forces {
    /// The field as it stands at one time.
    pub(super) fn at(&self, time_s: f64) -> Field {
        Field { j2: self.j2, bodies: self.sun_moon.as_ref().map(|both| both.positions_m(time_s)) }
    }
}

/// Gravity at one time.
pub(super) struct Field {
    j2: f64,
    bodies: Option<[Vector3<f64>; 2]>,
}

impl Field {
    /// Acceleration at `position` from the Earth's centre, m/s^2, inertial axes.
    pub(super) fn pull(&self, position: &Vector3<f64>) -> Vector3<f64> {
        let earth = gravity(position, self.j2);
        self.bodies.as_ref().map_or(earth, |bodies| earth + tides(bodies, position))
    }
}

/// The target's state at any time of a stretch that begins at 0.
#[derive(Debug, Clone)]
pub(super) struct TargetTrack {
    moments: Vec<Moment>,
}

impl TargetTrack {
    /// From `elements` at time 0 on, for `duration_s`.
    pub(super) fn new(elements: &Elements, forces: &Forces, duration_s: f64) -> Self {
        let rate = |time: f64, state: &Vector6<f64>| {
            stacked(&velocity_of(state), &forces.at(time).pull(&position_of(state)))
        };
        let step_max =
            |_, state: &Vector6<f64>| STEP_MAX * free_fall_time_s(position_of(state).norm());
        let count = (duration_s / SPACING_S).ceil() as usize + 1;
        let mut state = inertial_state(elements);
        let moments = (0..=count).map(|index| {
            let time = index as f64 * SPACING_S;
            let here = state;
            state = runge_kutta::integrate(here, time, SPACING_S, step_max, rate);
            Moment { state: here, acceleration: velocity_of(&rate(time, &here)) }
        });
        Self { moments: moments.collect() }
    }

    /// Inertial [position m, velocity m/s].
    ///
    /// # Panics
    /// Outside the stretch the track was made for: whoever made it knew how long the flight is.
    pub(super) fn state(&self, time_s: f64) -> Vector6<f64> {
        let last = (self.moments.len() - 1) as f64 * SPACING_S;
        assert!((0.0..=last).contains(&time_s), "{time_s} s lies outside the track, 0 to {last} s");
        let index = ((time_s / SPACING_S) as usize).min(self.moments.len() - 2);
        let fraction = time_s / SPACING_S - index as f64;
        quintic(&self.moments[index], &self.moments[index + 1], SPACING_S, fraction)
    }

    /// The rotating frame, and the state it belongs to.
    pub(super) fn frame(&self, forces: &Forces, time_s: f64) -> OrbitFrame {
        let state = self.state(time_s);
        OrbitFrame::new(&state, &forces.at(time_s).pull(&position_of(&state)))
    }
}
