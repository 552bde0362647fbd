//! Orbits, epochs and states as ground stations have them: `vbar/v1/orbits.proto`.

mod epoch;
mod mean_elements;
mod omm;

use nalgebra::Vector3;
use vbar_guidance::{
    epoch::Epoch,
    frames::{InFrame, InertialAxes, RelativeState, Rtn},
    orbit::{EARTH_RADIUS_M, InertialState, KeplerOrbit, Orientation, relative_state},
    units::{Angle, Distance, Seconds},
};
use vbar_proto::v1;

use super::{
    Door, Parse, Path,
    types::{self, number, unknown_enum, vector3},
};

pub(super) use epoch::{CALENDAR, calendar_after, ccsds_time_system, is_calendar, render_epoch};

/// The target's orbit, and when the mission starts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Target {
    pub(super) orbit: KeplerOrbit,
    pub(super) epoch: Option<Epoch>,
}

impl Parse for Target {
    type Message = v1::TargetOrbit;

    fn parse(message: &v1::TargetOrbit, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::target_orbit::Form;
        const FORMS: &str = "one of elements, tle, omm, state";
        let place = path.field("epoch");
        let epoch: Option<Option<Epoch>> = door.optional(&message.epoch, place);
        let mean = matches!(message.form, Some(Form::Tle(_) | Form::Omm(_)));
        if mean && message.epoch.is_none() {
            let _: Option<()> =
                door.refuse(place, "the mission's start, to propagate mean elements to", "nothing");
        }
        let start = epoch.flatten();
        let orbit = match &message.form {
            None => door.refuse(path, FORMS, "nothing"),
            Some(Form::Elements(elements)) => keplerian(elements, path.field("elements"), door),
            Some(Form::Tle(text)) => from_tle(text, start.as_ref(), path.field("tle"), door),
            Some(Form::Omm(text)) => from_omm(text, start.as_ref(), path.field("omm"), door),
            Some(Form::State(state)) => {
                let path = path.field("state");
                InertialState::parse(state, path, door)
                    .and_then(|state| through(&state, path, door))
            }
        };
        Some(Self { orbit: orbit?, epoch: epoch? })
    }
}

/// Writes an orbit with its elements, whatever it was read from.
pub(super) fn render_target(orbit: &KeplerOrbit, epoch: Option<&Epoch>) -> v1::TargetOrbit {
    let orientation = orbit.orientation();
    let degrees = |pick: fn(&Orientation) -> Angle| orientation.map(|o| exact_degrees(pick(o)));
    let elements = v1::KeplerianElements {
        semi_major_axis_m: Some(orbit.semi_major_axis().metres()),
        eccentricity: Some(orbit.eccentricity()),
        true_anomaly_deg: Some(exact_degrees(orbit.true_anomaly())),
        inclination_deg: degrees(|o| o.inclination),
        raan_deg: degrees(|o| o.raan),
        argument_of_perigee_deg: degrees(|o| o.argument_of_perigee),
        frame: orientation.map_or(0, |o| render_axes(o.axes).into()),
    };
    v1::TargetOrbit {
        form: Some(v1::target_orbit::Form::Elements(elements)),
        epoch: epoch.map(render_epoch),
    }
}

/// Degrees that give exactly these radians when they are read again, so that a mission that was
/// written and read is the same mission to the last bit.
fn exact_degrees(angle: Angle) -> f64 {
    let degrees = angle.degrees();
    let candidates = [degrees, degrees.next_up(), degrees.next_down()];
    candidates.into_iter().find(|&d| Angle::from_degrees(d) == angle).unwrap_or(degrees)
}

/// An angle that was computed, moved by at most a rounding to one that has exact degrees.
fn with_degrees(angle: Angle) -> Angle {
    Angle::from_degrees(angle.degrees())
}

fn keplerian(
    message: &v1::KeplerianElements,
    path: Path<'_>,
    door: &mut Door,
) -> Option<KeplerOrbit> {
    let place = path.field("semi_major_axis_m");
    let expected = "a finite number above the Earth's radius of 6378137 m";
    let a = door
        .required(&message.semi_major_axis_m, place)
        .and_then(|&a| number(a, |a| a > EARTH_RADIUS_M, expected, place, door));
    let place = path.field("eccentricity");
    let e = door.required(&message.eccentricity, place).and_then(|&e| {
        number(e, |e| (0.0..1.0).contains(&e), "at least 0, below 1 (an ellipse)", place, door)
    });
    let place = path.field("true_anomaly_deg");
    let anomaly = door
        .required(&message.true_anomaly_deg, place)
        .and_then(|&degrees| angle(degrees, place, door));
    let orientation = orientation(message, path, door);
    let orbit = KeplerOrbit::new(Distance::from_metres(a?), e?, anomaly?, orientation?);
    match orbit {
        Ok(orbit) => Some(orbit),
        Err(fault) => door.refuse(path, "an elliptic orbit", fault),
    }
}

fn angle(degrees: f64, path: Path<'_>, door: &mut Door) -> Option<Angle> {
    let expected = "a finite number of degrees of magnitude up to 360000";
    number(degrees, |d| d.abs() <= 360_000.0, expected, path, door).map(Angle::from_degrees)
}

/// All three angles with their axes, or none.
#[allow(clippy::option_option, reason = "absent and wrong are different things here")]
fn orientation(
    message: &v1::KeplerianElements,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Option<Orientation>> {
    let given = [
        ("inclination_deg", message.inclination_deg),
        ("raan_deg", message.raan_deg),
        ("argument_of_perigee_deg", message.argument_of_perigee_deg),
    ];
    if given.iter().all(|(_, angle)| angle.is_none()) && message.frame == 0 {
        return Some(None);
    }
    let mut angles = given.into_iter().map(|(name, degrees)| {
        let place = path.field(name);
        match degrees {
            Some(degrees) => angle(degrees, place, door),
            None => {
                door.refuse(place, "a value: orientation is given whole or not at all", "nothing")
            }
        }
    });
    let (inclination, raan, perigee) = (angles.next()?, angles.next()?, angles.next()?);
    drop(angles);
    let axes = InertialAxes::parse(&message.frame, path.field("frame"), door);
    Some(Some(Orientation {
        inclination: inclination?,
        raan: raan?,
        argument_of_perigee: perigee?,
        axes: axes?,
    }))
}

fn from_tle(
    text: &str,
    epoch: Option<&Epoch>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<KeplerOrbit> {
    match mean_elements::read_tle(text) {
        Ok(elements) => propagated(&elements, epoch?, path, door),
        Err((expected, got)) => door.refuse(path, expected, got),
    }
}

fn from_omm(
    text: &str,
    epoch: Option<&Epoch>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<KeplerOrbit> {
    match omm::read_omm(text) {
        Ok(elements) => propagated(&elements, epoch?, path, door),
        Err(faults) => {
            for fault in faults {
                let expected = format!("{}: {}", fault.keyword, fault.expected);
                let _: Option<()> = door.refuse(path, expected, fault.got);
            }
            None
        }
    }
}

fn propagated(
    elements: &sgp4::Elements,
    epoch: &Epoch,
    path: Path<'_>,
    door: &mut Door,
) -> Option<KeplerOrbit> {
    match mean_elements::propagated(elements, epoch) {
        Ok(state) => through(&state, path, door),
        Err((expected, got)) => door.refuse(path, expected, got),
    }
}

/// The osculating orbit of a state.
fn through(state: &InertialState, path: Path<'_>, door: &mut Door) -> Option<KeplerOrbit> {
    let orbit = KeplerOrbit::through(state).and_then(|orbit| {
        let orientation = orbit.orientation().map(|o| Orientation {
            inclination: with_degrees(o.inclination),
            raan: with_degrees(o.raan),
            argument_of_perigee: with_degrees(o.argument_of_perigee),
            axes: o.axes,
        });
        let anomaly = with_degrees(orbit.true_anomaly());
        KeplerOrbit::new(orbit.semi_major_axis(), orbit.eccentricity(), anomaly, orientation)
    });
    match orbit {
        Ok(orbit) if orbit.semi_major_axis().metres() > EARTH_RADIUS_M => Some(orbit),
        Ok(orbit) => {
            let got = format!("one with semi-major axis {} m", orbit.semi_major_axis().metres());
            door.refuse(path, "a state on an orbit around the Earth", got)
        }
        Err(fault) => door.refuse(path, "a state on an ellipse", fault),
    }
}

impl Parse for InertialAxes {
    type Message = i32;

    fn parse(message: &i32, path: Path<'_>, door: &mut Door) -> Option<Self> {
        const EXPECTED: &str = "INERTIAL_FRAME_EME2000, _TEME or _GCRF";
        match v1::InertialFrame::try_from(*message) {
            Ok(v1::InertialFrame::Eme2000) => Some(Self::Eme2000),
            Ok(v1::InertialFrame::Teme) => Some(Self::Teme),
            Ok(v1::InertialFrame::Gcrf) => Some(Self::Gcrf),
            Ok(unspecified @ v1::InertialFrame::Unspecified) => {
                door.refuse(path, EXPECTED, unspecified.as_str_name())
            }
            Err(_) => unknown_enum(*message, EXPECTED, path, door),
        }
    }
}

fn render_axes(axes: InertialAxes) -> v1::InertialFrame {
    match axes {
        InertialAxes::Eme2000 => v1::InertialFrame::Eme2000,
        InertialAxes::Teme => v1::InertialFrame::Teme,
        InertialAxes::Gcrf => v1::InertialFrame::Gcrf,
    }
}

/// The name that CCSDS documents have for inertial axes.
pub(super) fn ccsds_frame(axes: InertialAxes) -> &'static str {
    match axes {
        InertialAxes::Eme2000 => "EME2000",
        InertialAxes::Teme => "TEME",
        InertialAxes::Gcrf => "GCRF",
    }
}

impl Parse for InertialState {
    type Message = v1::InertialState;

    fn parse(message: &v1::InertialState, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let axes = InertialAxes::parse(&message.frame, path.field("frame"), door);
        let position = vector3(&message.position_m, path.field("position_m"), door);
        let velocity = vector3(&message.velocity_m_s, path.field("velocity_m_s"), door);
        Some(Self {
            axes: axes?,
            position_m: InFrame::new(position?),
            velocity_m_s: InFrame::new(velocity?),
        })
    }
}

/// The chaser's state relative to the target at the mission's start, in RTN.
pub(super) fn initial_state(
    message: &v1::InitialState,
    orbit: Option<&KeplerOrbit>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<RelativeState<Rtn>> {
    use v1::initial_state::Form;
    match &message.form {
        None => door.refuse(path, "one of relative, chaser", "nothing"),
        Some(Form::Relative(relative)) => {
            types::relative_state(relative, path.field("relative"), door)
        }
        Some(Form::Chaser(chaser)) => {
            let path = path.field("chaser");
            let chaser = InertialState::parse(chaser, path, door)?;
            // An orbit at fault has said so already.
            let orbit = orbit?;
            let Some(target) = orbit.inertial_state_after(Seconds::from_seconds(0.0)) else {
                let expected = "the target's orbit with its orientation, to compare with";
                return door.refuse(path, expected, "an orbit without orientation");
            };
            let relative = relative_state(&target, &chaser);
            relative.or_else(|| {
                let expected =
                    format!("the axes of the target's orbit ({})", ccsds_frame(target.axes));
                door.refuse(path.field("frame"), expected, ccsds_frame(chaser.axes))
            })
        }
    }
}

/// Components of a vector.
pub(super) fn components(vector: &Vector3<f64>) -> Vec<f64> {
    vec![vector.x, vector.y, vector.z]
}
