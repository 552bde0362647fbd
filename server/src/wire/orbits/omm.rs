//! CCSDS orbit mean-elements messages (502.0-B-3, section 4) in KVN, with the theory SGP4.
//!
//! Strict: a keyword that the standard does not have, or has twice, is refused. What SGP4 does not
//! need (covariance, spacecraft parameters) is known and left alone.

use sgp4::{Classification, Elements, chrono::NaiveDate};

use super::epoch::Calendar;

/// Keywords that change nothing about the propagated state.
const UNUSED: [&str; 17] = [
    "CREATION_DATE",
    "ORIGINATOR",
    "MESSAGE_ID",
    "CLASSIFICATION",
    "OBJECT_ID",
    "REF_FRAME_EPOCH",
    "GM",
    "MASS",
    "SOLAR_RAD_AREA",
    "SOLAR_RAD_COEFF",
    "DRAG_AREA",
    "DRAG_COEFF",
    "COV_REF_FRAME",
    "ELEMENT_SET_NO",
    "REV_AT_EPOCH",
    "CLASSIFICATION_TYPE",
    "NORAD_CAT_ID",
];

/// One fault: the keyword, what was expected, what was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct OmmFault {
    pub(super) keyword: String,
    pub(super) expected: String,
    pub(super) got: String,
}

/// Reads the elements, or every fault.
pub(super) fn read_omm(text: &str) -> Result<Elements, Vec<OmmFault>> {
    let mut omm = Omm { entries: Vec::new(), faults: Vec::new() };
    omm.collect(text);
    let elements = omm.elements();
    match elements {
        Some(elements) if omm.faults.is_empty() => Ok(elements),
        _ => Err(omm.faults),
    }
}

/// `KEYWORD = value` lines, and what is wrong with them.
struct Omm<'a> {
    entries: Vec<(&'a str, &'a str)>,
    faults: Vec<OmmFault>,
}

impl<'a> Omm<'a> {
    fn collect(&mut self, text: &'a str) {
        for (number, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line == "COMMENT" || line.starts_with("COMMENT ") {
                continue;
            }
            let Some((keyword, value)) = line.split_once('=') else {
                let shown: String = line.chars().take(60).collect();
                self.refuse(&format!("line {}", number + 1), "KEYWORD = value", &shown);
                continue;
            };
            let (keyword, value) = (keyword.trim(), without_unit(value.trim()));
            if self.find(keyword).is_some() {
                self.refuse(keyword, "the keyword once", "it twice");
            } else {
                self.entries.push((keyword, value));
            }
        }
    }

    fn elements(&mut self) -> Option<Elements> {
        let version = self.one_of("CCSDS_OMM_VERS", &["2.0", "3.0"]);
        let centre = self.one_of("CENTER_NAME", &["EARTH"]);
        let frame = self.one_of("REF_FRAME", &["TEME"]);
        let system = self.one_of("TIME_SYSTEM", &["UTC"]);
        let theory = self.one_of("MEAN_ELEMENT_THEORY", &["SGP4", "SGP/SGP4"]);
        let ephemeris =
            self.given("EPHEMERIS_TYPE").then(|| self.one_of("EPHEMERIS_TYPE", &["0", "2"]));
        let datetime = self.epoch();
        let mean_motion = self.number("MEAN_MOTION", |n| n > 0.0, "a number above 0 (rev/day)");
        let eccentricity =
            self.number("ECCENTRICITY", |e| (0.0..1.0).contains(&e), "at least 0, below 1");
        let mut angle = |name| self.number(name, f64::is_finite, "a number of degrees");
        let inclination = angle("INCLINATION");
        let right_ascension = angle("RA_OF_ASC_NODE");
        let argument_of_perigee = angle("ARG_OF_PERICENTER");
        let mean_anomaly = angle("MEAN_ANOMALY");
        let drag_term = self.number("BSTAR", f64::is_finite, "a number (1/Earth radii)");
        let object_name = self.text("OBJECT_NAME");
        // SGP4 does not use these two; where they stand they must be numbers.
        let mut rate = |name| {
            if self.given(name) { self.number(name, f64::is_finite, "a number") } else { Some(0.0) }
        };
        let mean_motion_dot = rate("MEAN_MOTION_DOT");
        let mean_motion_ddot = rate("MEAN_MOTION_DDOT");
        self.refuse_unknown();
        version.and(centre).and(frame).and(system).and(theory)?;
        ephemeris.unwrap_or(Some(()))?;
        Some(Elements {
            object_name,
            international_designator: None,
            norad_id: 0,
            classification: Classification::Unclassified,
            datetime: datetime?,
            mean_motion_dot: mean_motion_dot?,
            mean_motion_ddot: mean_motion_ddot?,
            drag_term: drag_term?,
            element_set_number: 0,
            inclination: inclination?,
            right_ascension: right_ascension?,
            eccentricity: eccentricity?,
            argument_of_perigee: argument_of_perigee?,
            mean_anomaly: mean_anomaly?,
            mean_motion: mean_motion?,
            revolution_number: 0,
            ephemeris_type: 0,
        })
    }

    fn find(&self, keyword: &str) -> Option<&'a str> {
        self.entries.iter().find(|(name, _)| *name == keyword).map(|(_, value)| *value)
    }

    fn given(&self, keyword: &str) -> bool {
        self.find(keyword).is_some()
    }

    fn text(&mut self, keyword: &'static str) -> Option<String> {
        let found = self.find(keyword).filter(|value| !value.is_empty());
        if found.is_none() {
            self.refuse(keyword, "a value (the keyword is required)", "nothing");
        }
        found.map(str::to_owned)
    }

    fn one_of(&mut self, keyword: &'static str, allowed: &[&str]) -> Option<()> {
        let found = self.text(keyword)?;
        if allowed.contains(&found.as_str()) {
            return Some(());
        }
        self.refuse(keyword, &allowed.join(" or "), &found);
        None
    }

    fn number(
        &mut self,
        keyword: &'static str,
        fits: impl Fn(f64) -> bool,
        expected: &str,
    ) -> Option<f64> {
        let found = self.text(keyword)?;
        match found.parse::<f64>() {
            Ok(value) if value.is_finite() && fits(value) => Some(value),
            _ => {
                self.refuse(keyword, expected, &found);
                None
            }
        }
    }

    fn epoch(&mut self) -> Option<sgp4::chrono::NaiveDateTime> {
        let found = self.text("EPOCH")?;
        // The standard lets the letter Z end a calendar in UTC.
        let calendar = Calendar::read(found.strip_suffix('Z').unwrap_or(&found));
        let datetime = calendar.and_then(|c| {
            let date = NaiveDate::from_ymd_opt(c.year, c.month.into(), c.day.into())?;
            date.and_hms_nano_opt(c.hour.into(), c.minute.into(), c.second.into(), c.nanosecond)
        });
        if datetime.is_none() {
            self.refuse("EPOCH", super::epoch::CALENDAR, &found);
        }
        datetime
    }

    fn refuse_unknown(&mut self) {
        const USED: [&str; 18] = [
            "CCSDS_OMM_VERS",
            "CENTER_NAME",
            "REF_FRAME",
            "TIME_SYSTEM",
            "MEAN_ELEMENT_THEORY",
            "EPHEMERIS_TYPE",
            "EPOCH",
            "MEAN_MOTION",
            "ECCENTRICITY",
            "INCLINATION",
            "RA_OF_ASC_NODE",
            "ARG_OF_PERICENTER",
            "MEAN_ANOMALY",
            "BSTAR",
            "OBJECT_NAME",
            "MEAN_MOTION_DOT",
            "MEAN_MOTION_DDOT",
            "OBJECT_ID",
        ];
        let entries = std::mem::take(&mut self.entries);
        for (keyword, value) in &entries {
            let known = USED.contains(keyword)
                || UNUSED.contains(keyword)
                || keyword.starts_with("USER_DEFINED_")
                || is_covariance(keyword);
            if !known {
                self.refuse(keyword, "a keyword of an OMM for SGP4", value);
            }
        }
        self.entries = entries;
    }

    fn refuse(&mut self, keyword: &str, expected: &str, got: &str) {
        let shown = |text: &str| text.chars().take(80).collect::<String>();
        self.faults.push(OmmFault {
            keyword: shown(keyword),
            expected: expected.to_owned(),
            got: shown(got),
        });
    }
}

/// `CX_X` to `CZ_DOT_Z_DOT`.
fn is_covariance(keyword: &str) -> bool {
    const AXES: [&str; 6] = ["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"];
    let Some(pair) = keyword.strip_prefix('C') else { return false };
    AXES.iter().any(|first| {
        let second = pair.strip_prefix(first).and_then(|rest| rest.strip_prefix('_'));
        second.is_some_and(|second| AXES.contains(&second))
    })
}

/// `98.2 [deg]` without its unit.
fn without_unit(value: &str) -> &str {
    match value.rfind('[') {
        Some(at) if value.ends_with(']') => value[..at].trim_end(),
        _ => value,
    }
}

#[cfg(test)]
mod tests {
    use super::{super::mean_elements::read_tle, *};

    /// The figures of the two-line set of satellite 00005 (see the tests of two-line sets).
    const OMM: &str = "\
        CCSDS_OMM_VERS = 2.0\n\
        COMMENT the same elements as its two lines\n\
        CREATION_DATE = 2000-06-28T00:00:00\n\
        ORIGINATOR = TEST\n\
        OBJECT_NAME = VANGUARD 1\n\
        OBJECT_ID = 1958-002B\n\
        CENTER_NAME = EARTH\n\
        REF_FRAME = TEME\n\
        TIME_SYSTEM = UTC\n\
        MEAN_ELEMENT_THEORY = SGP4\n\
        EPOCH = 2000-06-27T18:50:19.733568\n\
        MEAN_MOTION = 10.82419157\n\
        ECCENTRICITY = 0.1859667\n\
        INCLINATION = 34.2682 [deg]\n\
        RA_OF_ASC_NODE = 348.7242 [deg]\n\
        ARG_OF_PERICENTER = 331.7664 [deg]\n\
        MEAN_ANOMALY = 19.3264 [deg]\n\
        EPHEMERIS_TYPE = 0\n\
        CLASSIFICATION_TYPE = U\n\
        NORAD_CAT_ID = 5\n\
        ELEMENT_SET_NO = 475\n\
        REV_AT_EPOCH = 41366\n\
        BSTAR = 0.000028098\n\
        MEAN_MOTION_DOT = 0.00000023\n\
        MEAN_MOTION_DDOT = 0\n";

    #[test]
    fn omm_says_what_the_two_lines_say() {
        let tle = read_tle(
            "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n\
             2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667",
        )
        .unwrap();
        let omm = read_omm(OMM).unwrap();
        let numbers = |e: &Elements| {
            [
                e.mean_motion,
                e.eccentricity,
                e.inclination,
                e.right_ascension,
                e.argument_of_perigee,
                e.mean_anomaly,
                e.drag_term,
            ]
        };
        assert_eq!(numbers(&omm), numbers(&tle));
        // Eight decimals of a day are a millisecond.
        assert!((omm.datetime - tle.datetime).num_milliseconds().abs() <= 1);
    }

    #[test]
    fn omm_every_fault_is_named_at_once() {
        let text = OMM
            .replace("ECCENTRICITY = 0.1859667", "ECCENTRICITY = 1.2")
            .replace("REF_FRAME = TEME\n", "REF_FRAME = EME2000\n")
            .replace("BSTAR = 0.000028098\n", "")
            .replace("EPOCH = 2000-06-27T", "EPOCH = 2000-06-37T")
            + "KEEP_OUT = 5\nnonsense\nOBJECT_NAME = AGAIN\n";
        let mut keywords: Vec<_> =
            read_omm(&text).unwrap_err().into_iter().map(|fault| fault.keyword).collect();
        keywords.sort();
        let expected =
            ["BSTAR", "ECCENTRICITY", "EPOCH", "KEEP_OUT", "OBJECT_NAME", "REF_FRAME", "line 26"];
        assert_eq!(keywords, expected);
    }

    #[test]
    fn omm_every_missing_required_keyword_is_named() {
        for keyword in [
            "CCSDS_OMM_VERS",
            "OBJECT_NAME",
            "CENTER_NAME",
            "REF_FRAME",
            "TIME_SYSTEM",
            "MEAN_ELEMENT_THEORY",
            "EPOCH",
            "MEAN_MOTION",
            "ECCENTRICITY",
            "INCLINATION",
            "RA_OF_ASC_NODE",
            "ARG_OF_PERICENTER",
            "MEAN_ANOMALY",
            "BSTAR",
        ] {
            let without: String =
                OMM.lines().filter(|l| !l.starts_with(keyword)).map(|l| format!("{l}\n")).collect();
            let faults = read_omm(&without).unwrap_err();
            assert!(faults.len() == 1 && faults[0].keyword == keyword, "{keyword}: {faults:?}");
        }
    }

    #[test]
    fn omm_covariance_and_own_parameters_are_left_alone() {
        let more = format!("{OMM}CX_X = 1\nCZ_DOT_Y_DOT = 2\nUSER_DEFINED_A = x\nMASS = 1 [kg]\n");
        assert!(read_omm(&more).is_ok());
        assert!(read_omm(&format!("{OMM}CX_Q = 1\n")).is_err());
    }
}
