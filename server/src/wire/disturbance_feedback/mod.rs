//! Disturbance feedback: `vbar/v1/disturbance_feedback.proto` and
//! `vbar_guidance::control::disturbance_feedback`.

mod answer;
mod claim;
mod plan;

use nalgebra::DMatrix;
use vbar_guidance::{
    control::disturbance_feedback::{
        self as method, ArrivalMetric, EFFORT_WEIGHT_DEFAULT, FUEL_WEIGHT_DEFAULT, Instants,
    },
    frames::{LvlhCcsds, RTN_FROM_LVLH_CCSDS, RelativeState, Rtn},
    orbit::KeplerOrbit,
    sets::{Ellipsoid, OuterSum},
    units::Seconds,
};
use vbar_proto::v1;

use super::{
    Door, Parse, Path, count,
    orbits::{Target, components, initial_state, render_target},
    types::{
        Axes, Size, integer, list, matrix, not_negative, positive, relative_state, render_matrix,
        unknown_enum,
    },
};

pub(crate) use claim::Claimed;
pub(super) use plan::{
    render_certificate as render_plan_certificate, render_document, render_line,
};

/// Longest mission: three years. Epochs and anomalies keep their digits well beyond.
const DURATION_MAX_S: f64 = 1e8;

impl Parse for method::Problem {
    type Message = v1::DisturbanceFeedbackProblem;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let target: Option<Target> = door.message(&message.orbit, path.field("orbit"));
        let orbit = target.as_ref().map(|target| target.orbit);
        let initial = initial(message, orbit.as_ref(), path.field("initial"), door);
        let place = path.field("target_state");
        let target_state = door
            .required(&message.target_state, place)
            .and_then(|state| relative_state(state, place, door));
        let place = path.field("instants");
        let instants: Option<Instants> = door.message(&message.instants, place);
        let place = path.field("delta_v_max_m_s");
        let delta_v_max_m_s = door
            .required(&message.delta_v_max_m_s, place)
            .and_then(|&limit| positive(limit, place, door));
        let navigation_errors =
            navigation_errors(message, instants.as_ref(), path.field("navigation_errors"), door);
        let outer_sum = outer_sum(message.outer_sum, path.field("outer_sum"), door);
        let metric = metric(message.metric, path.field("metric"), door);
        let mut weight = |given: Option<f64>, default: f64, name| {
            not_negative(given.unwrap_or(default), path.field(name), door)
        };
        let fuel_weight = weight(message.fuel_weight, FUEL_WEIGHT_DEFAULT, "fuel_weight");
        let effort_weight = weight(message.effort_weight, EFFORT_WEIGHT_DEFAULT, "effort_weight");
        Some(Self {
            orbit: orbit?,
            epoch: target?.epoch,
            initial: in_lvlh(&initial?),
            target_state: in_lvlh(&target_state?),
            instants: instants?,
            delta_v_max_m_s: delta_v_max_m_s?,
            navigation_errors: navigation_errors?,
            outer_sum: outer_sum?,
            metric: metric?,
            fuel_weight: fuel_weight?,
            effort_weight: effort_weight?,
            compare_open_loop: message.compare_open_loop,
        })
    }
}

fn initial(
    message: &v1::DisturbanceFeedbackProblem,
    orbit: Option<&KeplerOrbit>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<RelativeState<Rtn>> {
    let initial = door.required(&message.initial, path)?;
    initial_state(initial, orbit, path, door)
}

fn in_lvlh(state: &RelativeState<Rtn>) -> RelativeState<LvlhCcsds> {
    state.rotated(RTN_FROM_LVLH_CCSDS.inverse())
}

impl Parse for Instants {
    type Message = v1::Instants;

    fn parse(message: &v1::Instants, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::instants::Spacing;
        const FORMS: &str = "one of equal_time, equal_true_anomaly, given";
        match &message.spacing {
            None => door.refuse(path, FORMS, "nothing"),
            Some(Spacing::EqualTime(equal)) => {
                let (count, duration) = equal_instants(equal, path.field("equal_time"), door)?;
                Some(Self::EqualTime { count, duration })
            }
            Some(Spacing::EqualTrueAnomaly(equal)) => {
                let path = path.field("equal_true_anomaly");
                let (count, duration) = equal_instants(equal, path, door)?;
                Some(Self::EqualTrueAnomaly { count, duration })
            }
            Some(Spacing::Given(given)) => {
                let path = path.field("given");
                given_instants(&given.elapsed_s, path.field("elapsed_s"), door).map(Self::Given)
            }
        }
    }
}

fn equal_instants(
    message: &v1::EqualInstants,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(usize, Seconds)> {
    let most = door.limits.plan_instants_max;
    let count = integer(message.count, 2..=most, path.field("count"), door);
    let place = path.field("duration_s");
    let duration = door
        .required(&message.duration_s, place)
        .and_then(|&duration| duration_s(duration, place, door));
    Some((count?, Seconds::from_seconds(duration?)))
}

fn duration_s(value: f64, path: Path<'_>, door: &mut Door) -> Option<f64> {
    let expected = "a finite number above 0, at most 1e8 (three years)";
    super::types::number(value, |d| d > 0.0 && d <= DURATION_MAX_S, expected, path, door)
}

fn given_instants(values: &[f64], path: Path<'_>, door: &mut Door) -> Option<Vec<Seconds>> {
    let most = door.limits.plan_instants_max;
    if !(2..=most).contains(&values.len()) {
        return door.refuse(path, format!("2 to {most} instants"), values.len());
    }
    let values = list(values, Size::UpTo(most), path, door)?;
    let mut good = true;
    let mut before = f64::NEG_INFINITY;
    for (i, &value) in values.iter().enumerate() {
        let fault = match i {
            0 if value != 0.0 => Some("0".to_owned()),
            _ if value <= before => Some(format!("a time after {before}")),
            _ if value > DURATION_MAX_S => Some("at most 1e8 (three years)".to_owned()),
            _ => None,
        };
        if let Some(expected) = fault {
            good = false;
            let _: Option<()> = door.refuse(path.index(i), expected, value);
        }
        before = value;
    }
    good.then(|| values.iter().copied().map(Seconds::from_seconds).collect())
}

fn navigation_errors(
    message: &v1::DisturbanceFeedbackProblem,
    instants: Option<&Instants>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<Ellipsoid>> {
    let given = &message.navigation_errors;
    let instants = instants.map(Instants::count);
    // While the instants are at fault any number up to the limit may be right.
    let right = match instants {
        Some(instants) => given.len() == 1 || given.len() == instants,
        None => (1..=door.limits.plan_instants_max).contains(&given.len()),
    };
    if !right {
        let many = instants.map_or("one an instant".to_owned(), |n| format!("{n}, one an instant"));
        return door.refuse(path, format!("1 set, or {many}"), given.len());
    }
    let sets: Vec<Option<Ellipsoid>> = given
        .iter()
        .enumerate()
        .map(|(i, error)| navigation_error(error, path.index(i), door))
        .collect();
    sets.into_iter().collect()
}

fn navigation_error(
    message: &v1::NavigationError,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Ellipsoid> {
    use v1::navigation_error::Form;
    match &message.form {
        None => door.refuse(path, "one of radii, shape, covariance", "nothing"),
        Some(Form::Radii(radii)) => {
            let path = path.field("radii");
            let mut radius = |given: &Option<f64>, name| {
                let place = path.field(name);
                let radius = door.required(given, place).copied()?;
                positive(radius, place, door)
            };
            let position = radius(&radii.position_radius_m, "position_radius_m");
            let velocity = radius(&radii.velocity_radius_m_s, "velocity_radius_m_s");
            let (p, v) = (position?, velocity?);
            ellipsoid(Ellipsoid::from_semi_axes(&[p, p, p, v, v, v]), path, door)
        }
        Some(Form::Shape(shape)) => {
            let path = path.field("shape");
            let matrix = framed_matrix(shape.frame, &shape.matrix, path, door)?;
            ellipsoid(Ellipsoid::from_shape(matrix), path.field("matrix"), door)
        }
        Some(Form::Covariance(covariance)) => {
            let path = path.field("covariance");
            let matrix = framed_matrix(covariance.frame, &covariance.matrix, path, door);
            let place = path.field("sigma_level");
            let level = door
                .required(&covariance.sigma_level, place)
                .and_then(|&level| positive(level, place, door));
            let (matrix, level) = (matrix?, level?);
            let shape = matrix * (level * level);
            ellipsoid(Ellipsoid::from_shape(shape), path.field("matrix"), door)
        }
    }
}

fn ellipsoid<E: std::fmt::Display>(
    made: Result<Ellipsoid, E>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Ellipsoid> {
    match made {
        Ok(ellipsoid) => Some(ellipsoid),
        Err(fault) => door.refuse(path, "a symmetric, positive definite matrix", fault),
    }
}

/// A 6 x 6 matrix about a state, turned to `LVLH_CCSDS`.
fn framed_matrix(
    frame: i32,
    message: &Option<v1::Matrix>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    let axes = Axes::parse(&frame, path.field("frame"), door);
    let place = path.field("matrix");
    let size = (Size::Exactly(6), Size::Exactly(6));
    let matrix = door.required(message, place).and_then(|m| matrix(m, size, place, door));
    let (axes, matrix) = (axes?, matrix?);
    Some(match axes {
        Axes::LvlhCcsds => matrix,
        Axes::Rtn => lvlh_from_rtn(&matrix),
    })
}

/// T S T' for the turn T of positions and velocities: axes only change places and signs, so no
/// digit is lost.
fn lvlh_from_rtn(shape: &DMatrix<f64>) -> DMatrix<f64> {
    // x = T, y = -N, z = -R.
    const AXIS: [(usize, f64); 3] = [(1, 1.0), (2, -1.0), (0, -1.0)];
    let place = |i: usize| (AXIS[i % 3].0 + i / 3 * 3, AXIS[i % 3].1);
    DMatrix::from_fn(6, 6, |i, j| {
        let ((row, sign), (column, other)) = (place(i), place(j));
        sign * other * shape[(row, column)]
    })
}

fn outer_sum(value: i32, path: Path<'_>, door: &mut Door) -> Option<OuterSum> {
    const EXPECTED: &str = "OUTER_SUM_MIN_VOLUME, OUTER_SUM_MIN_TRACE or unspecified";
    match v1::OuterSum::try_from(value) {
        Ok(v1::OuterSum::Unspecified | v1::OuterSum::MinVolume) => Some(OuterSum::MinVolume),
        Ok(v1::OuterSum::MinTrace) => Some(OuterSum::MinTrace),
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn metric(value: i32, path: Path<'_>, door: &mut Door) -> Option<ArrivalMetric> {
    use v1::ArrivalMetric as Message;
    const EXPECTED: &str = "ARRIVAL_METRIC_POSITION, _SCALED_6, _PHYSICAL_6 or unspecified";
    match Message::try_from(value) {
        Ok(Message::Unspecified | Message::Position) => Some(ArrivalMetric::Position),
        Ok(Message::Scaled6) => Some(ArrivalMetric::Scaled6),
        Ok(Message::Physical6) => Some(ArrivalMetric::Physical6),
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

/// Writes a mission in one form, whatever form it was read from: orbits with elements, states
/// relative, errors as shapes, everything in `LVLH_CCSDS`. Reading it gives the same mission.
fn render_problem(problem: &method::Problem) -> v1::DisturbanceFeedbackProblem {
    let error = |set: &Ellipsoid| v1::NavigationError {
        form: Some(v1::navigation_error::Form::Shape(v1::ErrorShape {
            frame: v1::Frame::LvlhCcsds.into(),
            matrix: Some(render_matrix(set.shape())),
        })),
    };
    let outer_sum = match problem.outer_sum {
        OuterSum::MinVolume => v1::OuterSum::MinVolume,
        OuterSum::MinTrace => v1::OuterSum::MinTrace,
    };
    let metric = match problem.metric {
        ArrivalMetric::Position => v1::ArrivalMetric::Position,
        ArrivalMetric::Scaled6 => v1::ArrivalMetric::Scaled6,
        ArrivalMetric::Physical6 => v1::ArrivalMetric::Physical6,
    };
    v1::DisturbanceFeedbackProblem {
        orbit: Some(render_target(&problem.orbit, problem.epoch.as_ref())),
        initial: Some(v1::InitialState {
            form: Some(v1::initial_state::Form::Relative(render_state(&problem.initial))),
        }),
        target_state: Some(render_state(&problem.target_state)),
        instants: Some(render_instants(&problem.instants)),
        delta_v_max_m_s: Some(problem.delta_v_max_m_s),
        navigation_errors: problem.navigation_errors.iter().map(error).collect(),
        outer_sum: outer_sum.into(),
        metric: metric.into(),
        fuel_weight: Some(problem.fuel_weight),
        effort_weight: Some(problem.effort_weight),
        compare_open_loop: problem.compare_open_loop,
    }
}

fn render_instants(instants: &Instants) -> v1::Instants {
    use v1::instants::Spacing;
    let equal = |number: usize, duration: Seconds| v1::EqualInstants {
        count: count(number),
        duration_s: Some(duration.seconds()),
    };
    let spacing = match instants {
        Instants::EqualTime { count, duration } => Spacing::EqualTime(equal(*count, *duration)),
        Instants::EqualTrueAnomaly { count, duration } => {
            Spacing::EqualTrueAnomaly(equal(*count, *duration))
        }
        Instants::Given(times) => Spacing::Given(v1::GivenInstants {
            elapsed_s: times.iter().map(|time| time.seconds()).collect(),
        }),
    };
    v1::Instants { spacing: Some(spacing) }
}

fn render_state(state: &RelativeState<LvlhCcsds>) -> v1::RelativeState {
    v1::RelativeState {
        frame: v1::Frame::LvlhCcsds.into(),
        position_m: components(&state.position_m.components),
        velocity_m_s: components(&state.velocity_m_s.components),
    }
}
