//! CCSDS orbit ephemeris message, 502.0-B-3 section 5, version 2.0, in KVN: inertial states of the
//! chaser on the nominal trajectory, with a covariance at every state.
//!
//! One segment an arc between burns, because a burn is a jump in velocity that no interpolation may
//! cross.

use nalgebra::{DMatrix, Matrix3, Vector3};
use vbar_guidance::{
    Budget, Interruption,
    control::disturbance_feedback::{Coast, Plan},
    epoch::Epoch,
    frames::RTN_FROM_LVLH_CCSDS,
    orbit::{EARTH_MU_M3_S2, InertialState, KeplerOrbit, chaser_state},
    units::Seconds,
};

use super::{EPOCH, Labels, Missing, ORIENTATION, Unwritten, calendar_after, real};
use crate::wire::orbits::{ccsds_frame, ccsds_time_system};

/// Largest angle that the target turns between two states, at its fastest: interpolation of degree
/// 7 then errs by less than a millimetre.
const STEP_ANGLE_RAD: f64 = 0.1;
/// Fewest intervals of an arc: interpolation of degree 7 needs eight states.
const INTERVALS_MIN: usize = 7;
/// Most states of a document, about sixty revolutions: it stays below the 4 MB that clients take.
/// A longer mission gets longer steps.
const STATES_MAX: usize = 4_000;
/// Covariance of what is uniform in an ellipsoid of dimension 6 over its shape matrix.
const COVARIANCE_OVER_SHAPE: f64 = 1.0 / 8.0;

/// One line of the ephemeris.
struct Point {
    elapsed: Seconds,
    state: InertialState,
    /// 6 x 6, inertial axes, m and m/s.
    covariance: DMatrix<f64>,
}

/// Writes the ephemeris.
pub(super) fn write(
    plan: &Plan,
    plan_id: &str,
    labels: &Labels,
    budget: Budget<'_>,
) -> Result<String, Unwritten> {
    let problem = plan.problem();
    let (Some(epoch), Some(orientation)) = (&problem.epoch, problem.orbit.orientation()) else {
        let mut missing = Vec::new();
        if problem.epoch.is_none() {
            missing.push(EPOCH);
        }
        if problem.orbit.orientation().is_none() {
            missing.extend(ORIENTATION);
        }
        return Err(Missing(missing).into());
    };
    let mut lines = vec![
        "CCSDS_OEM_VERS = 2.0".to_owned(),
        format!("COMMENT Nominal trajectory of rendezvous plan {plan_id}"),
        format!("COMMENT relative to {}, whose motion is Keplerian.", labels.target_name),
        format!("CREATION_DATE = {}", labels.created(epoch)),
        format!("ORIGINATOR = {}", labels.originator),
    ];
    let frame = ccsds_frame(orientation.axes);
    let arcs = plan.burns().len();
    for coast in (0..arcs).filter_map(|k| plan.coast(k)) {
        let points = points(&problem.orbit, &coast, STATES_MAX / arcs, budget)?;
        segment(&mut lines, &points, epoch, frame, labels);
    }
    Ok(lines.join("\n") + "\n")
}

fn segment(lines: &mut Vec<String>, points: &[Point], epoch: &Epoch, frame: &str, labels: &Labels) {
    let at = |point: &Point| calendar_after(epoch, point.elapsed);
    let ends = points.first().zip(points.last());
    let (start, stop) = ends.map(|(first, last)| (at(first), at(last))).unwrap_or_default();
    lines.extend([
        String::new(),
        "META_START".to_owned(),
        "COMMENT An arc between two burns; the burn at its start is included.".to_owned(),
        format!("OBJECT_NAME = {}", labels.chaser_name),
        format!("OBJECT_ID = {}", labels.chaser_designator),
        "CENTER_NAME = EARTH".to_owned(),
        format!("REF_FRAME = {frame}"),
        format!("TIME_SYSTEM = {}", ccsds_time_system(epoch.time_system)),
        format!("START_TIME = {start}"),
        format!("STOP_TIME = {stop}"),
        "INTERPOLATION = HERMITE".to_owned(),
        "INTERPOLATION_DEGREE = 7".to_owned(),
        "META_STOP".to_owned(),
    ]);
    for point in points {
        let components =
            point.state.position_m.components.iter().chain(&point.state.velocity_m_s.components);
        let numbers: Vec<String> = components.map(|x| real(x / 1e3)).collect();
        lines.push(format!("{} {}", at(point), numbers.join(" ")));
    }
    lines.extend([
        String::new(),
        "COVARIANCE_START".to_owned(),
        "COMMENT The plan bounds the error by an ellipsoid {d: d' S^-1 d <= 1} in the rotating axes"
            .to_owned(),
        "COMMENT of the target's orbit. Taken as uniform in it, its covariance is S/8; turned to"
            .to_owned(),
        format!("COMMENT {frame} with the rate of those axes. km**2, km**2/s, km**2/s**2."),
    ]);
    for point in points {
        lines.push(format!("EPOCH = {}", at(point)));
        for row in 0..6 {
            let numbers: Vec<String> =
                (0..=row).map(|column| real(point.covariance[(row, column)] / 1e6)).collect();
            lines.push(numbers.join(" "));
        }
    }
    lines.push("COVARIANCE_STOP".to_owned());
}

/// States from just after the burn to just before the next one.
fn points(
    orbit: &KeplerOrbit,
    coast: &Coast,
    most: usize,
    budget: Budget<'_>,
) -> Result<Vec<Point>, Interruption> {
    let (start, stop) = (coast.start().seconds(), coast.end().seconds());
    let intervals = intervals(orbit, stop - start).min(most - 1);
    #[allow(clippy::cast_precision_loss, reason = "at most STATES_MAX")]
    let share = |i: usize| i as f64 / intervals as f64;
    let elapsed = |i: usize| match i {
        // The ends are the instants themselves, to the last bit.
        0 => start,
        _ if i == intervals => stop,
        _ => start + (stop - start) * share(i),
    };
    let mut points = Vec::with_capacity(intervals + 1);
    for i in 0..=intervals {
        budget.check()?;
        points.extend(point(orbit, coast, Seconds::from_seconds(elapsed(i))));
    }
    Ok(points)
}

/// The chaser at `elapsed`; `None` only for an orbit without orientation, which the caller has
/// refused.
fn point(orbit: &KeplerOrbit, coast: &Coast, elapsed: Seconds) -> Option<Point> {
    let relative = coast.at(elapsed);
    let target = orbit.inertial_state_after(elapsed)?;
    let map = inertial_from_lvlh(&target);
    let covariance = &map * (relative.outer_shape * COVARIANCE_OVER_SHAPE) * map.transpose();
    let state = chaser_state(&target, &relative.state.rotated(RTN_FROM_LVLH_CCSDS))?;
    Some(Point { elapsed, state, covariance })
}

fn intervals(orbit: &KeplerOrbit, duration_s: f64) -> usize {
    let (e, p) = (orbit.eccentricity(), orbit.semi_latus_rectum_m());
    let fastest = (EARTH_MU_M3_S2 / p).sqrt() / p * (1.0 + e) * (1.0 + e);
    let wanted = (duration_s * fastest / STEP_ANGLE_RAD).ceil();
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a saturating cast of a positive number"
    )]
    let wanted = wanted as usize;
    wanted.max(INTERVALS_MIN)
}

/// J (6 x 6) that takes a difference of relative states in `LVLH_CCSDS` to the difference of
/// inertial ones: [R, 0; R [omega x], R], R the axes as columns, omega = -h / r^2 y.
fn inertial_from_lvlh(target: &InertialState) -> DMatrix<f64> {
    let (r, v) = (target.position_m.components, target.velocity_m_s.components);
    let momentum = r.cross(&v);
    let (nadir, minus_normal) = (-r.normalize(), -momentum.normalize());
    let rotation = Matrix3::from_columns(&[minus_normal.cross(&nadir), minus_normal, nadir]);
    let rate = Vector3::new(0.0, -momentum.norm() / r.norm_squared(), 0.0);
    let mut map = DMatrix::zeros(6, 6);
    map.view_mut((0, 0), (3, 3)).copy_from(&rotation);
    map.view_mut((3, 3), (3, 3)).copy_from(&rotation);
    map.view_mut((3, 0), (3, 3)).copy_from(&(rotation * rate.cross_matrix()));
    map
}
