//! Moments: `vbar.v1.Epoch`, and calendars of CCSDS documents.
//!
//! Leap seconds are those the library knows; none has been announced since 2017.

use hifitime::{Duration, TimeScale, Unit};
use vbar_guidance::{
    epoch::{Epoch, TimeSystem},
    units::Seconds,
};
use vbar_proto::v1;

use crate::wire::{Door, Parse, Path, types::unknown_enum};

/// First and last year of an epoch: UTC has whole leap seconds from 1972 on, and nobody plans a
/// rendezvous beyond.
const YEARS: std::ops::RangeInclusive<i32> = 1972..=2200;

/// A date and a time of day, in no particular scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Calendar {
    pub(super) year: i32,
    pub(super) month: u8,
    pub(super) day: u8,
    pub(super) hour: u8,
    pub(super) minute: u8,
    pub(super) second: u8,
    pub(super) nanosecond: u32,
}

/// What [`Calendar::read`] takes.
pub(in crate::wire) const CALENDAR: &str =
    "a calendar date such as 2027-03-01T12:00:00.000, without offset, year 1972 to 2200";

impl Calendar {
    /// `YYYY-MM-DDThh:mm:ss` with up to nine decimals. Second 60 is refused: calendars with it
    /// cannot be told from those a second earlier once they are counted.
    pub(super) fn read(text: &str) -> Option<Self> {
        let (whole, fraction) = text.split_once('.').unwrap_or((text, "0"));
        let digits = |text: &str| text.bytes().all(|c| c.is_ascii_digit());
        if whole.len() != 19 || !whole.is_ascii() || !digits(fraction) {
            return None;
        }
        let marks = [(4, b'-'), (7, b'-'), (10, b'T'), (13, b':'), (16, b':')];
        if marks.iter().any(|&(at, mark)| whole.as_bytes()[at] != mark) {
            return None;
        }
        let number = |from: usize, to: usize| -> Option<u8> {
            let field = &whole[from..to];
            if digits(field) { field.parse().ok() } else { None }
        };
        let year = if digits(&whole[..4]) { whole[..4].parse().ok()? } else { return None };
        let nanosecond = match fraction.len() {
            1..=9 => format!("{fraction:0<9}").parse().ok()?,
            _ => return None,
        };
        let read = Self {
            year,
            month: number(5, 7)?,
            day: number(8, 10)?,
            hour: number(11, 13)?,
            minute: number(14, 16)?,
            second: number(17, 19)?,
            nanosecond,
        };
        let sane = YEARS.contains(&year) && read.hour < 24 && read.second < 60;
        sane.then_some(read)
    }

    /// The moment it names in a scale; `None` for a day that does not exist.
    pub(super) fn moment(&self, system: TimeSystem) -> Option<Epoch> {
        let moment = hifitime::Epoch::maybe_from_gregorian(
            self.year,
            self.month,
            self.day,
            self.hour,
            self.minute,
            self.second,
            self.nanosecond,
            scale(system),
        );
        let since = moment.ok()?.to_tai_duration() - j2000_tai();
        let nanoseconds = i64::try_from(since.total_nanoseconds()).ok()?;
        Some(Epoch { nanoseconds_since_j2000_tai: nanoseconds, time_system: system })
    }
}

/// Whether a text is a calendar of a day that exists.
pub(in crate::wire) fn is_calendar(text: &str) -> bool {
    Calendar::read(text).and_then(|calendar| calendar.moment(TimeSystem::Utc)).is_some()
}

/// The calendar `elapsed` after an epoch, in the epoch's own scale: nanoseconds, at least three
/// decimals.
pub(in crate::wire) fn calendar_after(epoch: &Epoch, elapsed: Seconds) -> String {
    let since = Duration::from_total_nanoseconds(epoch.nanoseconds_since_j2000_tai.into())
        + elapsed.seconds() * Unit::Second;
    let moment = hifitime::Epoch::from_tai_duration(j2000_tai() + since);
    let (year, month, day, hour, minute, second, nanosecond) =
        moment.to_gregorian(scale(epoch.time_system));
    let fraction = format!("{nanosecond:09}");
    let kept = fraction.trim_end_matches('0').len().max(3);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{}", &fraction[..kept])
}

/// Seconds of atomic time from one epoch to another.
pub(super) fn seconds_between(from: &Epoch, to: &Epoch) -> f64 {
    let nanoseconds =
        i128::from(to.nanoseconds_since_j2000_tai) - i128::from(from.nanoseconds_since_j2000_tai);
    Duration::from_total_nanoseconds(nanoseconds).to_seconds()
}

/// The name that CCSDS documents have for a scale.
pub(in crate::wire) fn ccsds_time_system(system: TimeSystem) -> &'static str {
    match system {
        TimeSystem::Utc => "UTC",
        TimeSystem::Tai => "TAI",
        TimeSystem::Tt => "TT",
        TimeSystem::Gps => "GPS",
        TimeSystem::Tdb => "TDB",
    }
}

/// Writes an epoch.
pub(in crate::wire) fn render_epoch(epoch: &Epoch) -> v1::Epoch {
    let time_system = match epoch.time_system {
        TimeSystem::Utc => v1::TimeSystem::Utc,
        TimeSystem::Tai => v1::TimeSystem::Tai,
        TimeSystem::Tt => v1::TimeSystem::Tt,
        TimeSystem::Gps => v1::TimeSystem::Gps,
        TimeSystem::Tdb => v1::TimeSystem::Tdb,
    };
    v1::Epoch {
        calendar: calendar_after(epoch, Seconds::from_seconds(0.0)),
        time_system: time_system.into(),
    }
}

impl Parse for Epoch {
    type Message = v1::Epoch;

    fn parse(message: &v1::Epoch, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let place = path.field("time_system");
        let expected = "TIME_SYSTEM_UTC, _TAI, _TT, _GPS or _TDB";
        let system = match v1::TimeSystem::try_from(message.time_system) {
            Ok(v1::TimeSystem::Utc) => Some(TimeSystem::Utc),
            Ok(v1::TimeSystem::Tai) => Some(TimeSystem::Tai),
            Ok(v1::TimeSystem::Tt) => Some(TimeSystem::Tt),
            Ok(v1::TimeSystem::Gps) => Some(TimeSystem::Gps),
            Ok(v1::TimeSystem::Tdb) => Some(TimeSystem::Tdb),
            Ok(unspecified @ v1::TimeSystem::Unspecified) => {
                door.refuse(place, expected, unspecified.as_str_name())
            }
            Err(_) => unknown_enum(message.time_system, expected, place, door),
        };
        // The day is checked in any scale, so that both faults are told at once.
        let any = system.unwrap_or(TimeSystem::Tai);
        let moment = Calendar::read(&message.calendar).and_then(|calendar| calendar.moment(any));
        if moment.is_none() {
            let shown: String = message.calendar.chars().take(40).collect();
            return door.refuse(path.field("calendar"), CALENDAR, format!("{shown:?}"));
        }
        system.and(moment)
    }
}

fn scale(system: TimeSystem) -> TimeScale {
    match system {
        TimeSystem::Utc => TimeScale::UTC,
        TimeSystem::Tai => TimeScale::TAI,
        TimeSystem::Tt => TimeScale::TT,
        TimeSystem::Gps => TimeScale::GPST,
        TimeSystem::Tdb => TimeScale::TDB,
    }
}

/// From the library's own zero to 2000-01-01T12:00:00 TAI.
fn j2000_tai() -> Duration {
    hifitime::Epoch::from_gregorian_tai_at_noon(2000, 1, 1).to_tai_duration()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SYSTEMS: [TimeSystem; 5] =
        [TimeSystem::Utc, TimeSystem::Tai, TimeSystem::Tt, TimeSystem::Gps, TimeSystem::Tdb];

    fn moment(text: &str, system: TimeSystem) -> Epoch {
        Calendar::read(text).and_then(|calendar| calendar.moment(system)).expect(text)
    }

    fn after(text: &str, system: TimeSystem, seconds: f64) -> String {
        calendar_after(&moment(text, system), Seconds::from_seconds(seconds))
    }

    #[test]
    fn epoch_there_and_back_in_every_scale() {
        for text in ["2027-03-01T12:00:00.000", "1999-12-31T23:59:59.999999999"] {
            for system in SYSTEMS {
                assert_eq!(after(text, system, 0.0), text, "{system:?}");
            }
        }
    }

    /// TT - TAI = 32.184 s and TAI - GPS = 19 s by definition; TAI - UTC = 37 s since 2017 (IERS
    /// Bulletin C 52).
    #[test]
    fn epoch_scales_differ_by_what_they_should() {
        let text = "2027-03-01T12:00:00.000";
        let tai = moment(text, TimeSystem::Tai);
        let later = |system, seconds: f64| {
            let difference = seconds_between(&tai, &moment(text, system));
            assert!((difference - seconds).abs() < 1e-9, "{system:?} {difference}");
        };
        later(TimeSystem::Tt, -32.184);
        later(TimeSystem::Gps, 19.0);
        later(TimeSystem::Utc, 37.0);
        // TDB stays within 2 ms of TT.
        let tdb = seconds_between(&moment(text, TimeSystem::Tt), &moment(text, TimeSystem::Tdb));
        assert!(tdb.abs() < 2e-3, "{tdb}");
    }

    #[test]
    fn epoch_counts_a_leap_second_in_utc_only() {
        let text = "2016-12-31T23:59:50.000";
        assert_eq!(after(text, TimeSystem::Utc, 20.0), "2017-01-01T00:00:09.000");
        assert_eq!(after(text, TimeSystem::Tai, 20.0), "2017-01-01T00:00:10.000");
    }

    #[test]
    fn calendar_malformed_is_refused() {
        for text in [
            "",
            "2027-03-01",
            "2027-03-01T12:00:00Z",
            "2027-03-01T12:00:00+00",
            "2027-03-01T12:00:00.",
            "2027-03-01T12:00:00.0000000001",
            "2027-03-01 12:00:00",
            "2027-13-01T12:00:00",
            "2027-02-29T12:00:00",
            "2027-03-01T24:00:00",
            "2027-03-01T12:60:00",
            "2016-12-31T23:59:60",
            "1969-03-01T12:00:00",
            "2201-03-01T12:00:00",
            "+027-03-01T12:00:00",
            "２027-03-01T12:00:0",
        ] {
            let read = Calendar::read(text).and_then(|c| c.moment(TimeSystem::Utc));
            assert_eq!(read, None, "{text:?}");
        }
    }
}
