//! The simulator's own reading of a disturbance-feedback problem, in SI, radians and LVLH.

use nalgebra::{Matrix6, Vector6};
use vbar_proto::v1::{
    self, Frame, initial_state, instants::Spacing, navigation_error::Form, target_orbit,
};

use super::{
    model::{matrix, three},
    plan::disturbance_feedback,
};
use crate::plant::{
    EARTH_MU_M3_S2, lvlh,
    two_body::{Elements, mean_anomaly, true_anomaly},
};

/// Most instants of a plan that is flown.
const INSTANTS_MAX: i32 = 1000;

/// What is flown and by which rules.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PlanModel {
    /// Orbit of the target at the first instant; zero angles where the problem gives none.
    pub elements: Elements,
    /// The problem gives the orbit's orientation.
    pub oriented: bool,
    /// The instants, from 0.
    pub elapsed_s: Vec<f64>,
    /// Measured state at the first instant, LVLH, m and m/s.
    pub initial: Vector6<f64>,
    /// State wanted at the last instant, LVLH, m and m/s.
    pub target: Vector6<f64>,
    /// Largest impulse an axis.
    pub delta_v_max_m_s: f64,
    /// For every instant the matrix that takes the unit ball to the ellipsoid of errors, LVLH.
    pub errors: Vec<Matrix6<f64>>,
}

impl PlanModel {
    /// Reads a problem; all faults are returned together.
    pub(crate) fn new(problem: &v1::Problem) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let Some(inner) = disturbance_feedback(problem) else {
            return Err(vec![format!("{HERE}: required")]);
        };
        let place = format!("{HERE}.orbit");
        let (elements, oriented) = orbit(&place, inner.orbit.as_ref(), &mut faults);
        let initial = match inner.initial.as_ref().and_then(|initial| initial.form.as_ref()) {
            Some(initial_state::Form::Relative(state)) => {
                relative(&format!("{HERE}.initial.relative"), Some(state), &mut faults)
            }
            _ => {
                let reason = "the simulator reads relative states only";
                faults.push(format!("{HERE}.initial: {reason}"));
                Vector6::zeros()
            }
        };
        let place = format!("{HERE}.target_state");
        let target = relative(&place, inner.target_state.as_ref(), &mut faults);
        let delta_v_max_m_s = inner.delta_v_max_m_s.unwrap_or(f64::NAN);
        if !(delta_v_max_m_s.is_finite() && delta_v_max_m_s > 0.0) {
            faults.push(format!("{HERE}.delta_v_max_m_s: required, greater than 0"));
        }
        let elapsed_s = instants(inner.instants.as_ref(), &elements, &mut faults);
        let errors = errors(&inner.navigation_errors, elapsed_s.len(), &mut faults);
        if !faults.is_empty() {
            return Err(faults);
        }
        Ok(Self { elements, oriented, elapsed_s, initial, target, delta_v_max_m_s, errors })
    }
}

const HERE: &str = "problem.disturbance_feedback";

/// The orbit at `place`, and whether its orientation is given.
pub(super) fn orbit(
    place: &str,
    orbit: Option<&v1::TargetOrbit>,
    faults: &mut Vec<String>,
) -> (Elements, bool) {
    let place = format!("{place}.elements");
    let Some(target_orbit::Form::Elements(given)) = orbit.and_then(|orbit| orbit.form.as_ref())
    else {
        faults.push(format!("{place}: the simulator reads elements only"));
        return (reference_orbit(), false);
    };
    let semi_major_axis_m = given.semi_major_axis_m.unwrap_or(f64::NAN);
    let eccentricity = given.eccentricity.unwrap_or(f64::NAN);
    let true_anomaly_deg = given.true_anomaly_deg.unwrap_or(f64::NAN);
    if !(0.0..1.0).contains(&eccentricity) {
        faults.push(format!("{place}.eccentricity: required, at least 0, below 1"));
    } else if !((6.4e6..1e9).contains(&(semi_major_axis_m * (1.0 - eccentricity)))) {
        faults.push(format!("{place}.semi_major_axis_m: required, perigee above 6400 km"));
    }
    if !true_anomaly_deg.is_finite() {
        faults.push(format!("{place}.true_anomaly_deg: required, finite"));
    }
    let angles = [given.inclination_deg, given.raan_deg, given.argument_of_perigee_deg];
    let oriented = angles.iter().all(Option::is_some);
    if (!oriented && angles.iter().any(Option::is_some))
        || angles.iter().flatten().any(|angle| !angle.is_finite())
    {
        faults.push(format!("{place}: inclination, node and perigee: all three, finite, or none"));
    }
    if !faults.is_empty() {
        return (reference_orbit(), oriented);
    }
    let [inclination_rad, ascending_node_rad, argument_of_perigee_rad] =
        angles.map(|angle| angle.unwrap_or(0.0).to_radians());
    let elements = Elements {
        semi_major_axis_m,
        eccentricity,
        inclination_rad,
        ascending_node_rad,
        argument_of_perigee_rad,
        mean_anomaly_rad: mean_anomaly(true_anomaly_deg.to_radians(), eccentricity),
    };
    (elements, oriented)
}

/// Stands in for an orbit that was refused, so that the other fields can still be looked at.
fn reference_orbit() -> Elements {
    Elements {
        semi_major_axis_m: 7e6,
        eccentricity: 0.0,
        inclination_rad: 0.0,
        ascending_node_rad: 0.0,
        argument_of_perigee_rad: 0.0,
        mean_anomaly_rad: 0.0,
    }
}

fn relative(
    place: &str,
    state: Option<&v1::RelativeState>,
    faults: &mut Vec<String>,
) -> Vector6<f64> {
    let Some(state) = state else {
        faults.push(format!("{place}: required"));
        return Vector6::zeros();
    };
    let position = three(&format!("{place}.position_m"), &state.position_m, faults);
    let velocity = three(&format!("{place}.velocity_m_s"), &state.velocity_m_s, faults);
    let given = Vector6::from_fn(|row, _| if row < 3 { position[row] } else { velocity[row - 3] });
    match state.frame() {
        Frame::LvlhCcsds => given,
        Frame::Rtn => lvlh::state_lvlh_from_rtn(&given),
        Frame::Unspecified => {
            faults.push(format!("{place}.frame: required"));
            given
        }
    }
}

/// Times of the instants since the first.
fn instants(
    instants: Option<&v1::Instants>,
    orbit: &Elements,
    faults: &mut Vec<String>,
) -> Vec<f64> {
    let place = format!("{HERE}.instants");
    match instants.and_then(|instants| instants.spacing.as_ref()) {
        None => {
            faults.push(format!("{place}: required"));
            Vec::new()
        }
        Some(Spacing::EqualTime(equal)) => match checked(&place, equal, faults) {
            None => Vec::new(),
            Some((count, duration_s)) => {
                (0..count).map(|k| duration_s * f64::from(k) / f64::from(count - 1)).collect()
            }
        },
        Some(Spacing::EqualTrueAnomaly(equal)) => match checked(&place, equal, faults) {
            None => Vec::new(),
            Some((count, duration_s)) => equal_true_anomaly(orbit, count, duration_s),
        },
        Some(Spacing::Given(given)) => {
            let times = &given.elapsed_s;
            let rising = times.windows(2).all(|pair| pair[0] < pair[1]);
            let finite = times.iter().all(|time| time.is_finite());
            if times.len() < 2 || times.first() != Some(&0.0) || !rising || !finite {
                faults.push(format!("{place}.given.elapsed_s: two or more, rising from 0"));
            }
            times.clone()
        }
    }
}

fn checked(place: &str, equal: &v1::EqualInstants, faults: &mut Vec<String>) -> Option<(i32, f64)> {
    let duration_s = equal.duration_s.unwrap_or(f64::NAN);
    let timely = duration_s.is_finite() && duration_s > 0.0;
    if !timely {
        faults.push(format!("{place}.duration_s: required, greater than 0"));
    }
    let counted = (2..=INSTANTS_MAX).contains(&equal.count);
    if !counted {
        faults.push(format!("{place}.count: 2 to {INSTANTS_MAX}, got {}", equal.count));
    }
    (timely && counted).then_some((equal.count, duration_s))
}

/// Kepler's equation there and back: the angles are equally spaced, the times follow.
fn equal_true_anomaly(orbit: &Elements, count: i32, duration_s: f64) -> Vec<f64> {
    let (first, e) = (orbit.mean_anomaly_rad, orbit.eccentricity);
    let n = (EARTH_MU_M3_S2 / orbit.semi_major_axis_m.powi(3)).sqrt();
    let [from, to] = [first, first + n * duration_s].map(|mean| true_anomaly(mean, e));
    let angle = |k: i32| from + (to - from) * f64::from(k) / f64::from(count - 1);
    let mut times: Vec<f64> = (0..count).map(|k| (mean_anomaly(angle(k), e) - first) / n).collect();
    // The ends are given, not computed.
    times[0] = 0.0;
    if let Some(last) = times.last_mut() {
        *last = duration_s;
    }
    times
}

/// One ellipsoid an instant.
fn errors(
    given: &[v1::NavigationError],
    instants: usize,
    faults: &mut Vec<String>,
) -> Vec<Matrix6<f64>> {
    let place = format!("{HERE}.navigation_errors");
    if given.is_empty() || (given.len() != 1 && given.len() != instants) {
        faults.push(format!("{place}: one, or one an instant ({instants}), got {}", given.len()));
        return Vec::new();
    }
    let read: Vec<Matrix6<f64>> = given
        .iter()
        .enumerate()
        .map(|(index, error)| ellipsoid(&format!("{place}[{index}]"), error, faults))
        .collect();
    (0..instants).map(|k| read[k.min(read.len() - 1)]).collect()
}

/// The matrix that takes the unit ball to the ellipsoid.
fn ellipsoid(place: &str, error: &v1::NavigationError, faults: &mut Vec<String>) -> Matrix6<f64> {
    let (frame, shape, scale) = match &error.form {
        Some(Form::Radii(radii)) => {
            let position = radii.position_radius_m.unwrap_or(f64::NAN);
            let velocity = radii.velocity_radius_m_s.unwrap_or(f64::NAN);
            if !(position > 0.0 && velocity > 0.0 && (position + velocity).is_finite()) {
                faults.push(format!("{place}.radii: both required, greater than 0"));
            }
            let axes = Vector6::from_fn(|row, _| if row < 3 { position } else { velocity });
            return Matrix6::from_diagonal(&axes);
        }
        Some(Form::Shape(given)) => (given.frame(), given.matrix.as_ref(), 1.0),
        Some(Form::Covariance(given)) => {
            (given.frame(), given.matrix.as_ref(), given.sigma_level.unwrap_or(f64::NAN))
        }
        None => {
            faults.push(format!("{place}: required"));
            return Matrix6::identity();
        }
    };
    if frame == Frame::Unspecified || !(scale.is_finite() && scale > 0.0) {
        faults.push(format!("{place}: frame and a positive sigma level are required"));
    }
    let shape = matrix(place, shape, faults);
    if shape.shape() != (6, 6) {
        faults.push(format!("{place}: 6 x 6"));
        return Matrix6::identity();
    }
    let shape = Matrix6::from_fn(|row, column| shape[(row, column)]);
    let Some(root) = shape.cholesky() else {
        faults.push(format!("{place}: positive definite"));
        return Matrix6::identity();
    };
    let columns = root.l() * scale;
    match frame {
        // Turning the axes turns every column.
        Frame::Rtn => {
            let turned: Vec<Vector6<f64>> = columns
                .column_iter()
                .map(|column| lvlh::state_lvlh_from_rtn(&column.into_owned()))
                .collect();
            Matrix6::from_columns(&turned)
        }
        _ => columns,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orbit_of(eccentricity: f64) -> Elements {
        Elements {
            semi_major_axis_m: 24.5e6,
            eccentricity,
            mean_anomaly_rad: mean_anomaly(2.9, eccentricity),
            ..reference_orbit()
        }
    }

    #[test]
    fn plan_model_equal_anomalies_are_equal_in_angle() {
        for eccentricity in [0.0, 0.72] {
            let orbit = orbit_of(eccentricity);
            let n = (EARTH_MU_M3_S2 / orbit.semi_major_axis_m.powi(3)).sqrt();
            let times = equal_true_anomaly(&orbit, 7, 90_000.0);
            let angles: Vec<f64> = times
                .iter()
                .map(|t| true_anomaly(orbit.mean_anomaly_rad + n * t, eccentricity))
                .collect();
            let steps: Vec<f64> = angles.windows(2).map(|pair| pair[1] - pair[0]).collect();
            // More than two revolutions in six steps.
            assert!(steps[0] > 2.0, "{steps:?}");
            // Kepler's equation near perigee at e = 0.72 loses a few digits.
            assert!(steps.iter().all(|step| (step - steps[0]).abs() < 1e-11), "{steps:?}");
        }
    }

    #[test]
    fn plan_model_covariance_in_rtn_is_turned_and_scaled() {
        let mut values = vec![0.0; 36];
        for (row, sigma) in [1.0, 2.0, 3.0, 0.1, 0.2, 0.3_f64].into_iter().enumerate() {
            values[7 * row] = sigma * sigma;
        }
        let matrix = Some(v1::Matrix { rows: 6, columns: 6, values });
        let covariance =
            v1::ErrorCovariance { frame: Frame::Rtn.into(), matrix, sigma_level: Some(3.0) };
        let error = v1::NavigationError { form: Some(Form::Covariance(covariance)) };
        let mut faults = Vec::new();
        let root = ellipsoid("here", &error, &mut faults);
        assert!(faults.is_empty(), "{faults:?}");
        let shape = root * root.transpose();
        // x is along-track (2), y the normal (3), z radial (1); three standard deviations.
        let expected = Vector6::new(6.0, 9.0, 3.0, 0.6, 0.9, 0.3).map(|axis: f64| axis * axis);
        assert!((shape - Matrix6::from_diagonal(&expected)).amax() < 1e-12, "{shape}");
    }

    #[test]
    fn plan_model_names_every_fault() {
        let inner = v1::DisturbanceFeedbackProblem::default();
        let method = Some(v1::problem::Method::DisturbanceFeedback(inner));
        let faults = PlanModel::new(&v1::Problem { method }).expect_err("nothing is given");
        for part in ["orbit", "initial", "target_state", "delta_v_max", "instants", "errors"] {
            assert!(faults.iter().any(|fault| fault.contains(part)), "{part}: {faults:?}");
        }
    }
}
