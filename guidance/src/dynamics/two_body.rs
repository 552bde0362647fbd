//! Free drift of a chaser without linearisation: two Kepler orbits.

use crate::{
    dynamics::RelativeVector,
    frames::{InFrame, InertialAxes, RelativeState},
    orbit::{InertialState, KeplerOrbit, OrbitError, Orientation, chaser_state, relative_state},
    units::{Angle, Seconds},
};

/// Target and chaser, each on its own Kepler orbit: exact for two bodies, so the error of the
/// linear prediction can be seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoBodyDrift {
    target: KeplerOrbit,
    chaser: KeplerOrbit,
    start: Seconds,
}

impl TwoBodyDrift {
    /// From the relative state [m, m/s] in the target's RTN at `start` after the orbit's epoch.
    ///
    /// # Errors
    /// [`OrbitError`] if the chaser is not on an ellipse.
    pub fn new(
        target: &KeplerOrbit,
        start: Seconds,
        x: &RelativeVector,
    ) -> Result<Self, OrbitError> {
        // The relative motion does not depend on how the orbit lies in space.
        let flat = Orientation {
            inclination: Angle::from_radians(0.0),
            raan: Angle::from_radians(0.0),
            argument_of_perigee: Angle::from_radians(0.0),
            axes: InertialAxes::Eme2000,
        };
        let target = KeplerOrbit::new(
            target.semi_major_axis(),
            target.eccentricity(),
            target.true_anomaly(),
            Some(flat),
        )?;
        let relative = RelativeState {
            position_m: InFrame::new(x.fixed_rows::<3>(0).into_owned()),
            velocity_m_s: InFrame::new(x.fixed_rows::<3>(3).into_owned()),
        };
        let here = target.inertial_state_after(start).ok_or(OrbitError::Rectilinear)?;
        let chaser = chaser_state(&here, &relative).ok_or(OrbitError::Rectilinear)?;
        Ok(Self { target, chaser: KeplerOrbit::through(&chaser)?, start })
    }

    /// The relative state `elapsed` after the start; `None` only if the two orbits lost their
    /// planes, which Kepler orbits do not.
    #[must_use]
    pub fn after(&self, elapsed: Seconds) -> Option<RelativeVector> {
        let since_epoch = Seconds::from_seconds(self.start.seconds() + elapsed.seconds());
        let target = self.target.inertial_state_after(since_epoch)?;
        relative(&target, &self.chaser.inertial_state_after(elapsed)?)
    }

    /// The relative states at `count` instants that are `spacing` apart, the first one at the
    /// start; `None` as for [`Self::after`].
    #[must_use]
    pub fn every(&self, spacing: Seconds, count: usize) -> Option<Vec<RelativeVector>> {
        let targets = self.target.inertial_states(self.start, spacing)?;
        let chasers = self.chaser.inertial_states(Seconds::from_seconds(0.0), spacing)?;
        targets
            .zip(chasers)
            .take(count)
            .map(|(target, chaser)| relative(&target, &chaser))
            .collect()
    }
}

fn relative(target: &InertialState, chaser: &InertialState) -> Option<RelativeVector> {
    let relative = relative_state(target, chaser)?;
    let mut x = RelativeVector::zeros();
    x.fixed_rows_mut::<3>(0).copy_from(&relative.position_m.components);
    x.fixed_rows_mut::<3>(3).copy_from(&relative.velocity_m_s.components);
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        dynamics::elliptic_step,
        units::{Distance, Mass},
    };

    fn orbit() -> KeplerOrbit {
        let axis = Distance::from_metres(7_419_320.0);
        KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap()
    }

    #[test]
    fn small_separations_drift_as_the_linear_model_says() {
        let (orbit, start) = (orbit(), Seconds::from_seconds(600.0));
        let x = RelativeVector::from_column_slice(&[0.3, -0.5, 0.2, 1e-4, 2e-4, -3e-4]);
        let drift = TwoBodyDrift::new(&orbit, start, &x).unwrap();
        let duration = Seconds::from_seconds(1500.0);
        let linear = elliptic_step(&orbit, Mass::from_kilograms(1.0), start, duration).a * x;
        let error = drift.after(duration).unwrap() - linear;
        // Quadratic terms are |x|^2 / r = 1e-7 m; coordinates of 7e6 m round at 1e-9.
        assert!(error.amax() < 2e-6, "{error}");
    }

    #[test]
    fn drift_starts_where_it_was_told() {
        let start = Seconds::from_seconds(42.0);
        let x = RelativeVector::from_column_slice(&[300.0, -5000.0, 20.0, 0.1, 0.2, -0.3]);
        let drift = TwoBodyDrift::new(&orbit(), start, &x).unwrap();
        let error = drift.after(Seconds::from_seconds(0.0)).unwrap() - x;
        assert!(error.fixed_rows::<3>(0).amax() < 1e-7 && error.amax() < 1e-6, "{error}");
    }

    #[test]
    fn equal_times_give_the_states_of_each_time() {
        let x = RelativeVector::from_column_slice(&[300.0, -5000.0, 20.0, 0.1, 0.2, -0.3]);
        for (e, spacing) in [(0.0, 30.0), (0.1, 30.0), (0.1, 1500.0), (0.85, 60.0), (0.85, 4e4)] {
            let axis = Distance::from_metres(40_000_000.0);
            let orbit = KeplerOrbit::new(axis, e, Angle::from_degrees(145.0), None).unwrap();
            let drift = TwoBodyDrift::new(&orbit, Seconds::from_seconds(42.0), &x).unwrap();
            let states = drift.every(Seconds::from_seconds(spacing), 2000).unwrap();
            for (i, state) in states.iter().enumerate().step_by(37) {
                let elapsed = i as f64 * spacing;
                let other = drift.after(Seconds::from_seconds(elapsed)).unwrap();
                // Two positions of 7e7 m round at 1e-8, anomalies by the revolutions they count.
                let tolerance = 1e-6 + 3e-11 * elapsed;
                let error = (state - other).fixed_rows::<3>(0).amax();
                assert!(error < tolerance, "e {e}, {spacing} s, {i}: {error:e}");
            }
        }
    }
}
