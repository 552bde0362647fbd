//! Mean elements: two-line sets and orbit mean-elements messages, propagated by SGP4.
//!
//! The constants are those the elements were made with (WGS-72), so a state agrees with what other
//! tools make of the same elements.

use nalgebra::Vector3;
use sgp4::{
    Constants, Elements, MinutesSinceEpoch, Orbit,
    chrono::{Datelike as _, Timelike as _},
};
use vbar_guidance::{
    epoch::{Epoch, TimeSystem},
    frames::{InFrame, InertialAxes},
    orbit::InertialState,
};

use super::epoch::{Calendar, seconds_between};

/// Length of a line.
const LINE_LENGTH: usize = 69;

/// Why a set of elements cannot be used: what was expected, and what was found.
pub(super) type ElementFault = (String, String);

fn fault(expected: impl Into<String>, got: impl Into<String>) -> ElementFault {
    (expected.into(), got.into())
}

/// Reads two lines, or three with a name first.
pub(super) fn read_tle(text: &str) -> Result<Elements, ElementFault> {
    let lines: Vec<&str> =
        text.lines().map(str::trim_end).filter(|line| !line.is_empty()).collect();
    let (name, first, second) = match lines[..] {
        [first, second] => (None, first, second),
        [name, first, second] => (Some(name), first, second),
        _ => return Err(fault("two lines, or three with a name first", lines.len().to_string())),
    };
    for (number, line) in [("1", first), ("2", second)] {
        check_line(number, line)?;
    }
    let name = name.map(|name| name.strip_prefix("0 ").unwrap_or(name).to_owned());
    let elements = Elements::from_tle(name, first.as_bytes(), second.as_bytes())
        .map_err(|found| fault("a two-line element set", found.to_string()))?;
    finite(elements)
}

/// What the library takes for granted: ASCII, and a checksum that is a digit.
fn check_line(number: &str, line: &str) -> Result<(), ElementFault> {
    if !line.is_ascii() || line.len() != LINE_LENGTH {
        let got = format!("{} characters in line {number}", line.chars().count());
        return Err(fault(format!("{LINE_LENGTH} ASCII characters in each line"), got));
    }
    if !line.starts_with(number) {
        return Err(fault(format!("line {number} to begin with {number}"), format!("{line:?}")));
    }
    let (sum, given) = line.split_at(LINE_LENGTH - 1);
    let sum: u32 =
        sum.chars().map(|c| if c == '-' { 1 } else { c.to_digit(10).unwrap_or(0) }).sum();
    let expected = (sum % 10).to_string();
    if given != expected {
        return Err(fault(format!("checksum {expected} at the end of line {number}"), given));
    }
    Ok(())
}

/// The text of a number in a column may be `nan`.
fn finite(elements: Elements) -> Result<Elements, ElementFault> {
    let numbers = [
        ("the eccentricity", elements.eccentricity),
        ("the inclination", elements.inclination),
        ("the right ascension", elements.right_ascension),
        ("the argument of perigee", elements.argument_of_perigee),
        ("the mean anomaly", elements.mean_anomaly),
        ("the mean motion", elements.mean_motion),
        ("the drag term", elements.drag_term),
    ];
    match numbers.iter().find(|(_, value)| !value.is_finite()) {
        Some((name, value)) => {
            Err(fault(format!("{name} to be a finite number"), value.to_string()))
        }
        None => Ok(elements),
    }
}

/// The state at `epoch`, in TEME.
pub(super) fn propagated(
    elements: &Elements,
    epoch: &Epoch,
) -> Result<InertialState, ElementFault> {
    let own = own_epoch(elements).ok_or_else(|| {
        fault("elements of the years 1972 to 2200", elements.datetime.to_string())
    })?;
    let minutes = seconds_between(&own, epoch) / 60.0;
    let constants = constants(elements).map_err(|found| fault(PROPAGATED, found.to_string()))?;
    let state = constants
        .propagate(MinutesSinceEpoch(minutes))
        .map_err(|found| fault(PROPAGATED, found.to_string()))?;
    let metres = |kilometres: [f64; 3]| InFrame::new(Vector3::from(kilometres) * 1e3);
    Ok(InertialState {
        axes: InertialAxes::Teme,
        position_m: metres(state.position),
        velocity_m_s: metres(state.velocity),
    })
}

const PROPAGATED: &str = "elements that SGP4 can propagate to the mission's start";

fn own_epoch(elements: &Elements) -> Option<Epoch> {
    let (date, time) = (elements.datetime.date(), elements.datetime.time());
    let calendar = Calendar {
        year: date.year(),
        month: u8::try_from(date.month()).ok()?,
        day: u8::try_from(date.day()).ok()?,
        hour: u8::try_from(time.hour()).ok()?,
        minute: u8::try_from(time.minute()).ok()?,
        second: u8::try_from(time.second()).ok()?,
        nanosecond: time.nanosecond(),
    };
    calendar.moment(TimeSystem::Utc).filter(|_| (1972..=2200).contains(&calendar.year))
}

fn constants(elements: &Elements) -> Result<Constants, sgp4::ElementsError> {
    let radians = f64::to_radians;
    // Revolutions a day to radians a minute.
    let mean_motion = elements.mean_motion * (std::f64::consts::PI / 720.0);
    let orbit = Orbit::from_kozai_elements(
        &sgp4::WGS72,
        radians(elements.inclination),
        radians(elements.right_ascension),
        elements.eccentricity,
        radians(elements.argument_of_perigee),
        radians(elements.mean_anomaly),
        mean_motion,
    )?;
    Ok(Constants::new(
        sgp4::WGS72,
        sgp4::iau_epoch_to_sidereal_time,
        elements.epoch(),
        elements.drag_term,
        orbit,
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From the test set of Vallado, Crawford, Hujsak, Kelso, "Revisiting Spacetrack Report #3",
    /// AIAA 2006-6753: satellite 00005.
    const VANGUARD: &str = "\
        1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n\
        2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667\n";

    fn at(elements: &Elements, minutes: f64) -> InertialState {
        let mut epoch = own_epoch(elements).unwrap();
        #[allow(clippy::cast_possible_truncation, reason = "whole minutes in nanoseconds")]
        let nanoseconds = (minutes * 60e9) as i64;
        epoch.nanoseconds_since_j2000_tai += nanoseconds;
        propagated(elements, &epoch).unwrap()
    }

    #[test]
    fn tle_propagates_as_the_reference_programme_does() {
        let elements = read_tle(VANGUARD).unwrap();
        for (minutes, position_km, velocity_km_s) in [
            (
                0.0,
                [7022.46529266, -1400.08296755, 0.03995155],
                [1.893841015, 6.405893759, 4.534807250],
            ),
            (
                360.0,
                [-7154.03120202, -3783.17682504, -3536.19412294],
                [4.741887409, -4.151817765, -2.093935425],
            ),
        ] {
            let state = at(&elements, minutes);
            let position = state.position_m.components / 1e3 - Vector3::from(position_km);
            let velocity = state.velocity_m_s.components / 1e3 - Vector3::from(velocity_km_s);
            // The reference prints 1e-8 km and 1e-9 km/s.
            assert!(position.norm() < 2e-8, "{minutes} min: {position}");
            assert!(velocity.norm() < 2e-9, "{minutes} min: {velocity}");
        }
    }

    #[test]
    fn tle_every_changed_digit_of_its_lines_is_found() {
        let lines: Vec<&str> = VANGUARD.lines().collect();
        for (which, line) in lines.iter().enumerate() {
            for (at, digit) in line.char_indices().filter(|(_, c)| c.is_ascii_digit()) {
                let other = if digit == '9' { '0' } else { char::from(digit as u8 + 1) };
                let mut changed = (*line).to_owned();
                changed.replace_range(at..=at, &other.to_string());
                let mut text = lines.clone();
                text[which] = &changed;
                assert!(read_tle(&text.join("\n")).is_err(), "line {which}, column {at}");
            }
        }
        let (expected, got) = read_tle(&VANGUARD.replacen("4753", "4754", 1)).unwrap_err();
        assert_eq!((expected.as_str(), got.as_str()), ("checksum 3 at the end of line 1", "4"));
    }

    #[test]
    fn tle_malformed_is_named() {
        let named = |text: &str| read_tle(text).unwrap_err();
        assert_eq!(named("").1, "0");
        assert!(named("1 00005U\n2 00005").1.contains("characters in line 1"));
        assert!(named(&VANGUARD.replace(" 34.2682", " 34.é682")).1.contains("line 2"));
        let lines: Vec<&str> = VANGUARD.lines().collect();
        assert!(named(&format!("{}\n{}", lines[1], lines[0])).0.contains("begin with 1"));
        // A checksum that is no digit.
        assert_eq!(named(&VANGUARD.replacen("4753", "475-", 1)).1, "-");
        let with_name = format!("0 VANGUARD 1\n{VANGUARD}");
        assert_eq!(read_tle(&with_name).unwrap().object_name.as_deref(), Some("VANGUARD 1"));
    }
}
