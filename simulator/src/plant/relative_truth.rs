//! The truth of a chaser near a target on any elliptic orbit, linear or not.
//!
//! The chaser's inertial state less the target's, `d`, obeys the difference of the two laws of
//! motion [AguilarMarsillach2022, eqs. 1-2 and 34]:
//!
//! - `d'' = g(t, r + d) - g(t, r) + a` with `g` the pull of the Earth (with J2, or round) and of
//!   Sun and Moon, both taken in full, or
//! - `d'' = -mu / r^3 (d - 3 (d r) r / r^2) + a`, linear in `d`, about a Keplerian orbit. In
//!   rotating axes this is eq. 5 of the paper (which has lost the dots of two velocities), here
//!   never written in them, so that a sign of the rotating terms cannot be wrong twice.
//!
//! `r` is the target, whose way is tabulated once; the acceleration `a` is constant in the
//! rotating RTN frame. Integrating `d` instead of two craft keeps the digits that their difference
//! would lose, and lets steps be long: with at most [`STEP_MAX`] of the free-fall time a step is
//! off by 1e-12 of `d`, a revolution by some 1e-8 of it.

use hifitime::Epoch;
use nalgebra::{Vector3, Vector6};

use super::{
    EARTH_J2, EARTH_MU_M3_S2, runge_kutta,
    sun_moon::SunAndMoon,
    target_track::{Forces, TargetTrack},
    two_body::{
        Elements, OrbitFrame, free_fall_time_s, position_of, rtn_axes, stacked, velocity_of,
    },
};

/// Longest step of the integration, in free-fall times `sqrt(r^3 / mu)`.
const STEP_MAX: f64 = 0.01;

/// By which law both craft move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Law {
    /// Gravity linearised about the target's Keplerian orbit.
    Linear,
    /// Newton's law for each of them.
    Newton {
        /// With the Earth's flattening.
        j2: bool,
        /// With Sun and Moon as they stand from this moment on, which is time 0.
        sun_moon_from: Option<Epoch>,
    },
}

/// The world in which a chaser moves. It holds no chaser: states come in and go out, so flights
/// and drifts from anywhere along them share it.
#[derive(Debug, Clone)]
pub(crate) struct RelativeTruth {
    track: TargetTrack,
    forces: Forces,
    linear: bool,
}

/// Where a chaser was at equally spaced times.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Course {
    /// Time of the first state, s.
    pub start_s: f64,
    /// Time between two states, s.
    pub spacing_s: f64,
    /// [position m, velocity m/s] in the target's rotating RTN frame.
    pub states: Vec<Vector6<f64>>,
}

impl RelativeTruth {
    /// The target on `elements` at time 0, for `duration_s`; `None` if Sun and Moon are asked for
    /// outside the years 1900 to 2100.
    pub(crate) fn new(elements: &Elements, law: Law, duration_s: f64) -> Option<Self> {
        let forces = match law {
            Law::Linear => Forces { j2: 0.0, sun_moon: None },
            Law::Newton { j2, sun_moon_from } => Forces {
                j2: if j2 { EARTH_J2 } else { 0.0 },
                sun_moon: match sun_moon_from {
                    Some(start) => Some(SunAndMoon::new(start, duration_s)?),
                    None => None,
                },
            },
        };
        let track = TargetTrack::new(elements, &forces, duration_s);
        Some(Self { track, forces, linear: law == Law::Linear })
    }

    /// The state `duration_s` after `state`, which holds at `time_s`.
    ///
    /// States are [position m, velocity m/s] in the target's rotating RTN frame, in which
    /// `acceleration` (m/s^2) is constant.
    ///
    /// # Panics
    /// Past the duration this truth was made for.
    pub(crate) fn advance(
        &self,
        time_s: f64,
        state: &Vector6<f64>,
        duration_s: f64,
        acceleration: &Vector3<f64>,
    ) -> Vector6<f64> {
        let offset = self.frame(time_s).offset(state);
        let offset = self.move_on(time_s, offset, duration_s, acceleration);
        self.frame(time_s + duration_s).relative(&offset)
    }

    /// The way from `state` at `time_s` without thrust, sampled every `spacing_s` at least as
    /// far as `duration_s`.
    ///
    /// # Panics
    /// Past the duration this truth was made for.
    pub(crate) fn drift(
        &self,
        time_s: f64,
        state: &Vector6<f64>,
        duration_s: f64,
        spacing_s: f64,
    ) -> Course {
        // A duration that is a multiple of the spacing but for rounding needs no sample more.
        let count = (duration_s / spacing_s - 1e-9).ceil().max(0.0) as usize;
        self.fly(time_s, state, &vec![Vector3::zeros(); count], spacing_s)
    }

    /// The way from `state` at `time_s` under `accelerations`, each held for `spacing_s`.
    ///
    /// # Panics
    /// Past the duration this truth was made for.
    pub(crate) fn fly(
        &self,
        time_s: f64,
        state: &Vector6<f64>,
        accelerations: &[Vector3<f64>],
        spacing_s: f64,
    ) -> Course {
        let mut states = vec![*state];
        let mut offset = self.frame(time_s).offset(state);
        for (index, acceleration) in accelerations.iter().enumerate() {
            let from = time_s + index as f64 * spacing_s;
            offset = self.move_on(from, offset, spacing_s, acceleration);
            states.push(self.frame(from + spacing_s).relative(&offset));
        }
        Course { start_s: time_s, spacing_s, states }
    }

    fn frame(&self, time_s: f64) -> OrbitFrame {
        self.track.frame(&self.forces, time_s)
    }

    fn move_on(
        &self,
        time_s: f64,
        offset: Vector6<f64>,
        duration_s: f64,
        acceleration: &Vector3<f64>,
    ) -> Vector6<f64> {
        let step_max = |time: f64, _: &Vector6<f64>| {
            STEP_MAX * free_fall_time_s(position_of(&self.track.state(time)).norm())
        };
        let rate = |time: f64, offset: &Vector6<f64>| {
            let target = self.track.state(time);
            let thrust = rtn_axes(&target) * acceleration;
            let pull = self.pull_apart(time, &position_of(&target), &position_of(offset));
            stacked(&velocity_of(offset), &(pull + thrust))
        };
        runge_kutta::integrate(offset, time_s, duration_s, step_max, rate)
    }

    /// How gravity changes the distance between target and chaser.
    fn pull_apart(&self, time_s: f64, target: &Vector3<f64>, away: &Vector3<f64>) -> Vector3<f64> {
        if self.linear {
            let radius = target.norm();
            let along = target * (3.0 * target.dot(away) / (radius * radius));
            return (along - away) * (EARTH_MU_M3_S2 / radius.powi(3));
        }
        let field = self.forces.at(time_s);
        field.pull(&(target + away)) - field.pull(target)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use serde_json::Value;

    use super::*;
    use crate::{
        plant::{
            hill::HillPlant,
            two_body::{TwoBody, mean_anomaly},
        },
        tests::{abort_case, vector, vector3},
    };

    const LINEAR: Law = Law::Linear;
    const NEWTON: Law = Law::Newton { j2: false, sun_moon_from: None };
    const NEWTON_J2: Law = Law::Newton { j2: true, sun_moon_from: None };

    fn realistic() -> Law {
        let start = "2022-01-01T00:00:00 UTC".parse().expect("a date");
        Law::Newton { j2: true, sun_moon_from: Some(start) }
    }

    /// [AguilarMarsillach2022, sec. VI.A.2].
    fn paper() -> Elements {
        Elements {
            semi_major_axis_m: 7_419_320.0,
            eccentricity: 0.1,
            inclination_rad: 0.01_f64.to_radians(),
            ascending_node_rad: 0.0,
            argument_of_perigee_rad: 0.0,
            mean_anomaly_rad: mean_anomaly(145.0_f64.to_radians(), 0.1),
        }
    }

    fn inclined() -> Elements {
        Elements { inclination_rad: 0.9, ascending_node_rad: 5.3, ..paper() }
    }

    fn truth(elements: &Elements, law: Law, duration_s: f64) -> RelativeTruth {
        RelativeTruth::new(elements, law, duration_s).expect("a date within 1900-2100")
    }

    /// A list of six in km and km/s, in m and m/s.
    fn state_of(json: &Value) -> Vector6<f64> {
        Vector6::from_column_slice((vector(json) * 1e3).as_slice())
    }

    fn assert_orbit_is_the_papers(case: &Value) {
        let orbit = &case["inputs"]["orbit"];
        let elements = [("a_km", 7419.32), ("e", 0.1), ("f0_deg", 145.0), ("i_deg", 0.01)];
        for (key, value) in elements {
            assert_eq!(orbit[key].as_f64(), Some(value), "{key}");
        }
    }

    #[test]
    fn relative_truth_has_the_reference_transition_matrices() {
        let case = abort_case("phi_01");
        assert_orbit_is_the_papers(&case);
        let truth = truth(&paper(), LINEAR, 3000.0);
        for (steps, expected) in [1.0, 10.0, 100.0].iter().zip(0..) {
            let rows = &case["expected"]["Phi"][expected];
            let expected =
                nalgebra::Matrix6::from_fn(|i, j| rows[i][j].as_f64().expect("a number"));
            for column in 0..6 {
                let unit = Vector6::from_fn(|row, _| f64::from(u8::from(row == column)));
                let found = truth.advance(0.0, &unit, steps * 30.0, &Vector3::zeros());
                // The case's own tolerance, of the largest entry.
                let error = (found - expected.column(column)).amax();
                assert!(error < 1e-8 * expected.amax(), "{steps} steps, column {column}: {error}");
            }
        }
    }

    #[test]
    fn relative_truth_makes_the_reference_steps() {
        let case = abort_case("plant_01");
        assert_orbit_is_the_papers(&case);
        let (inputs, expected) = (&case["inputs"], &case["expected"]);
        let acceleration = vector3(&inputs["u"]) * 1e3 / 4000.0;
        for (law, key) in [(NEWTON, "x_next"), (LINEAR, "x_next_linear")] {
            let start = state_of(&inputs["x"]);
            let found = truth(&paper(), law, 30.0).advance(0.0, &start, 30.0, &acceleration);
            // The case says 1e-9 km; its digits allow more of the velocity than of the position.
            assert!((found - state_of(&expected[key])).amax() < 1e-6, "{law:?}: {found}");
        }
    }

    #[test]
    fn relative_truth_drifts_as_the_reference_under_j2() {
        let case = abort_case("plant_03_j2");
        assert_orbit_is_the_papers(&case);
        let (inputs, expected) = (&case["inputs"], &case["expected"]);
        let start = state_of(&inputs["x0"]);
        for (law, key) in [(NEWTON_J2, "x_end"), (LINEAR, "x_end_unperturbed_linear")] {
            let course = truth(&paper(), law, 6360.0).drift(0.0, &start, 6360.0, 30.0);
            let end = course.states.last().expect("an end");
            // The case says 1e-6 km.
            let error = (end - state_of(&expected[key])).amax();
            assert!(error < 1e-3, "{law:?}: {error}");
        }
    }

    /// The same way by another integrator, at its own steps: both craft in full.
    #[test]
    fn relative_truth_agrees_with_two_bodies_under_thrust() {
        let start = Vector6::new(-500.0, 3000.0, 200.0, 0.3, 0.4, -0.2);
        let push = Vector3::new(1e-3, -2e-3, 1.5e-3);
        let law = truth(&inclined(), NEWTON_J2, 6000.0);
        let mut pair = TwoBody::new(&inclined(), true, &start);
        pair.advance(6000.0, &push);
        let found = law.advance(0.0, &start, 6000.0, &push);
        // Rounding of 7e6 m in the pair, grown by a revolution.
        let error = (found - pair.relative()).fixed_rows::<3>(0).norm();
        assert!(error < 1e-4, "{error} m");
    }

    #[test]
    fn relative_truth_on_a_circle_is_hills() {
        let circle = Elements { eccentricity: 0.0, ..inclined() };
        let n = (EARTH_MU_M3_S2 / circle.semi_major_axis_m.powi(3)).sqrt();
        let start = Vector6::new(-500.0, 3000.0, 200.0, 0.3, 0.4, -0.2);
        let push = Vector3::new(1e-3, -2e-3, 1.5e-3);
        let expected = HillPlant::new(n, 6000.0).advance(&start, &push);
        let found = truth(&circle, LINEAR, 6000.0).advance(0.0, &start, 6000.0, &push);
        // The stated accuracy, 1e-8 of the largest coordinate.
        assert!((found - expected).amax() < 1e-8 * expected.amax(), "{found} {expected}");
    }

    /// What the linear law leaves out is of second order in the separation.
    #[test]
    fn relative_truth_is_linear_up_to_second_order() {
        let (linear, newton) =
            (truth(&inclined(), LINEAR, 6360.0), truth(&inclined(), NEWTON, 6360.0));
        let difference = |scale: f64| {
            let start = Vector6::new(-500.0, 3000.0, 200.0, 0.3, 0.4, -0.2) * scale;
            let end = |law: &RelativeTruth| law.advance(0.0, &start, 6360.0, &Vector3::zeros());
            (end(&linear) - end(&newton)).fixed_rows::<3>(0).norm()
        };
        let order = (difference(1.0) / difference(0.1)).log10();
        assert!((order - 2.0).abs() < 0.05, "order {order}");
    }

    /// Two orbits near each other keep their difference of energy and of angular momentum; the
    /// linear law keeps their linear parts.
    #[test]
    fn relative_truth_keeps_energy_and_momentum() {
        let start = Vector6::new(-500.0, 3000.0, 200.0, 0.3, 0.4, -0.2);
        for law in [LINEAR, NEWTON] {
            let truth = truth(&inclined(), law, 19_080.0);
            let kept = |time: f64, relative: &Vector6<f64>| {
                let target = truth.track.state(time);
                let offset = truth.frame(time).offset(relative);
                let (r, v) = (position_of(&target), velocity_of(&target));
                let (d, w) = (position_of(&offset), velocity_of(&offset));
                let potential = |at: &Vector3<f64>| -EARTH_MU_M3_S2 / at.norm();
                let momentum = d.cross(&v) + r.cross(&w);
                if law == LINEAR {
                    (v.dot(&w) + EARTH_MU_M3_S2 * r.dot(&d) / r.norm().powi(3), momentum)
                } else {
                    let kinetic = v.dot(&w) + 0.5 * w.norm_squared();
                    (kinetic + potential(&(r + d)) - potential(&r), momentum + d.cross(&w))
                }
            };
            let course = truth.drift(0.0, &start, 19_080.0, 10.0);
            let (energy, momentum) = kept(0.0, &start);
            for (index, state) in course.states.iter().enumerate().step_by(100) {
                let (energy_now, momentum_now) = kept(index as f64 * 10.0, state);
                // 1e-8 of the terms that cancel in it: |v| times 3 km n, and of |r| times that.
                assert!((energy_now - energy).abs() < 1e-8 * 7e3 * 3.0, "{law:?} {index}");
                assert!((momentum_now - momentum).norm() < 1e-8 * 7e6 * 3.0, "{law:?} {index}");
            }
        }
    }

    /// The linear motion comes back to itself turned by one revolution: no drift without a
    /// difference of energy.
    #[test]
    fn relative_truth_closes_after_a_revolution_at_equal_energy() {
        let elements = inclined();
        let period = TAU / (EARTH_MU_M3_S2 / elements.semi_major_axis_m.powi(3)).sqrt();
        let truth = truth(&elements, LINEAR, period);
        let target = truth.track.state(0.0);
        // A state turned about the Earth's axis has the target's energy.
        let turned = stacked(
            &Vector3::z().cross(&position_of(&target)),
            &Vector3::z().cross(&velocity_of(&target)),
        ) * 3e-4;
        let start = truth.frame(0.0).relative(&turned);
        let end = truth.advance(0.0, &start, period, &Vector3::zeros());
        assert!(start.norm() > 1e3);
        // The stated accuracy, 1e-8, twice: on the way out and of what it does to the period.
        assert!((end - start).amax() < 2e-8 * start.amax(), "{}", end - start);
    }

    /// Sun and Moon act on both: over three revolutions in low orbit they part them by
    /// centimetres to metres at kilometres of distance, far less than J2 does.
    #[test]
    fn relative_truth_feels_sun_and_moon_a_little() {
        let start = Vector6::new(-500.0, 3000.0, 200.0, 0.0, 0.4, 0.0);
        let end = |law: Law| {
            truth(&inclined(), law, 19_080.0).advance(0.0, &start, 19_080.0, &Vector3::zeros())
        };
        let apart = |a: Law, b: Law| (end(a) - end(b)).fixed_rows::<3>(0).norm();
        let (bodies, flattening) = (apart(realistic(), NEWTON_J2), apart(NEWTON_J2, NEWTON));
        assert!((1e-3..5.0).contains(&bodies), "{bodies} m");
        assert!((10.0..2000.0).contains(&flattening), "{flattening} m");
    }

    /// A flight in pieces is the flight in one, and later starts meet the target where it is.
    #[test]
    fn relative_truth_continues_from_any_time() {
        let truth = truth(&inclined(), realistic(), 9000.0);
        let start = Vector6::new(-500.0, 3000.0, 200.0, 0.3, 0.4, -0.2);
        let push = Vector3::new(1e-3, -2e-3, 1.5e-3);
        let whole = truth.advance(600.0, &start, 8000.0, &push);
        let half = truth.advance(600.0, &start, 4000.0, &push);
        let pieces = truth.advance(4600.0, &half, 4000.0, &push);
        // The stated accuracy, at 80 km in the end.
        assert!((whole - pieces).amax() < 1e-8 * whole.amax(), "{}", whole - pieces);
        let course = truth.fly(600.0, &start, &[push; 800], 10.0);
        assert!((whole - course.states[800]).amax() < 1e-8 * whole.amax());
        assert_eq!(truth.drift(0.0, &start, 95.0, 30.0).states.len(), 5);
        assert_eq!(truth.drift(0.0, &start, 0.3, 0.1).states.len(), 4);
    }
}
