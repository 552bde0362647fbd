//! Does a craft that loses all thrust drift into an ellipsoid? Linear and nonlinear.

use nalgebra::Matrix3;

use super::flight::{Closest, Flight};
use crate::{
    dynamics::{PeriodicPlant, RelativeVector, TransitionMatrix, TwoBodyDrift},
    matrices::product_fixed,
    orbit::{KeplerOrbit, OrbitError},
    sets::CentredEllipsoid,
    units::Seconds,
};

/// Asks what free drift does over the safety horizon.
#[derive(Debug, Clone, Copy)]
pub struct PassiveQuestion<'a> {
    /// The plant, folded into its period.
    pub plant: &'a PeriodicPlant,
    /// The orbit, for the drift without linearisation and folding.
    pub orbit: &'a KeplerOrbit,
    /// The states to avoid.
    pub avoid: &'a CentredEllipsoid,
    /// Safety horizon N, steps.
    pub horizon: usize,
}

/// What free drift does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PassiveVerdict {
    /// As the linear plant predicts it.
    pub linear: DriftVerdict,
    /// As two Kepler orbits have it.
    pub two_body: DriftVerdict,
}

/// One drift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriftVerdict {
    /// Least p'Wp of the positions at the instants, W the block of positions: at most 1 inside
    /// the region, at whatever speed.
    pub least_position_gauge_squared: f64,
    /// The first instant of it.
    pub position_instant: usize,
    /// Least x'Px of the states at the instants: at most 1 in the set, speeds included.
    pub least_state_gauge_squared: f64,
    /// The first instant of it.
    pub state_instant: usize,
    /// Least p'Wp between instants too.
    pub closest_gauge: Closest,
    /// Least distance from the target's centre of mass between instants too; `least` is in square
    /// metres.
    pub closest_distance: Closest,
    /// Seconds until the position is in the region for the first time, between instants too.
    pub entered_s: Option<f64>,
}

impl DriftVerdict {
    /// The positions stay outside at the instants: the sampled promise of the method.
    #[must_use]
    pub fn safe_at_instants(&self) -> bool {
        self.least_position_gauge_squared > 1.0
    }

    /// The positions stay outside between them too.
    #[must_use]
    pub fn safe_throughout(&self) -> bool {
        self.closest_gauge.least > 1.0
    }

    /// The state is in one of the backward reachable sets of its own time index.
    #[must_use]
    pub fn inside_reachable_set(&self) -> bool {
        self.least_state_gauge_squared <= 1.0
    }
}

/// Verdict on the state `x` at sample k.
///
/// # Errors
/// [`OrbitError`] if the chaser of the two-body drift is not on an ellipse.
pub fn passive_safety(
    question: &PassiveQuestion<'_>,
    k: usize,
    x: &RelativeVector,
) -> Result<PassiveVerdict, OrbitError> {
    passive_safety_along(question, k, &Flight::drifting(question.plant, k, x, question.horizon))
}

/// The same of a drift that the linear plant has flown already.
pub(crate) fn passive_safety_along(
    question: &PassiveQuestion<'_>,
    k: usize,
    linear: &Flight,
) -> Result<PassiveVerdict, OrbitError> {
    let x = linear.states().first().ok_or(OrbitError::Rectilinear)?;
    let start_s = k as f64 * question.plant.sample_time().seconds();
    let drift = TwoBodyDrift::new(question.orbit, Seconds::from_seconds(start_s), x)?;
    let spacing = Seconds::from_seconds(linear.spacing_s());
    let states = drift.every(spacing, linear.states().len()).ok_or(OrbitError::Rectilinear)?;
    let two_body = Flight::from_states(linear.spacing_s(), states);
    let judge = |flight: &Flight| judge(flight, question.avoid).ok_or(OrbitError::Rectilinear);
    Ok(PassiveVerdict { linear: judge(linear)?, two_body: judge(&two_body)? })
}

/// `None` for a flight without states.
fn judge(flight: &Flight, avoid: &CentredEllipsoid) -> Option<DriftVerdict> {
    let weight = Matrix3::from_fn(|i, j| avoid.precision()[(i, j)]);
    let precision = TransitionMatrix::from_fn(|i, j| avoid.precision()[(i, j)]);
    let (position_instant, least_position_gauge_squared) = flight.least_at_instants(&weight)?;
    let states = flight.states().iter().map(|x| x.dot(&product_fixed(&precision, x)));
    let (state_instant, least_state_gauge_squared) = first_least(states)?;
    Some(DriftVerdict {
        least_position_gauge_squared,
        position_instant,
        least_state_gauge_squared,
        state_instant,
        closest_gauge: flight.closest(&weight)?,
        closest_distance: flight.closest(&Matrix3::identity())?,
        entered_s: flight.first_within(&weight),
    })
}

fn first_least(values: impl Iterator<Item = f64>) -> Option<(usize, f64)> {
    values.enumerate().reduce(|best, other| if other.1 < best.1 { other } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::{Angle, Distance, Mass};

    #[test]
    fn fast_pass_between_samples_is_seen_only_between_them() {
        let axis = Distance::from_metres(7_419_320.0);
        let orbit = KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap();
        let (mass, step) = (Mass::from_kilograms(4000.0), Seconds::from_seconds(30.0));
        let plant = PeriodicPlant::new(&orbit, mass, step, 212, 1);
        let avoid = CentredEllipsoid::from_semi_axes(&[100.0, 100.0, 100.0, 100.0, 100.0, 100.0]);
        let question = PassiveQuestion { plant: &plant, orbit: &orbit, avoid: &avoid, horizon: 4 };
        // 20 m/s towards the target from 900 m: through it at 45 s, 300 m away at 30 s and 60 s.
        let x = RelativeVector::from_column_slice(&[0.0, 900.0, 0.0, 0.0, -20.0, 0.0]);
        let verdict = passive_safety(&question, 0, &x).unwrap();
        for drift in [verdict.linear, verdict.two_body] {
            assert!(drift.safe_at_instants() && !drift.safe_throughout());
            assert!((drift.closest_gauge.at_s - 45.0).abs() < 1.0, "{drift:?}");
            assert!(drift.closest_distance.least.sqrt() < 50.0, "{drift:?}");
            // 100 m away after 40 s; the drift bends a little.
            assert!((drift.entered_s.unwrap() - 40.0).abs() < 1.0, "{drift:?}");
        }
        // Sampled three times as often it is seen at an instant.
        let finer = PeriodicPlant::new(&orbit, mass, step, 212, 4);
        let question = PassiveQuestion { plant: &finer, ..question };
        assert!(!passive_safety(&question, 0, &x).unwrap().linear.safe_at_instants());
    }
}
