//! CCSDS orbit comprehensive message, 502.0-B-3 section 6, in KVN: the nominal burns as one
//! manoeuvre block. And the reader of such blocks.

use nalgebra::Vector3;
use vbar_guidance::{control::disturbance_feedback::Plan, units::Seconds};

use super::{EPOCH, Labels, Missing, calendar_after, real};
use crate::wire::orbits::{ccsds_time_system, is_calendar};

/// The axes of the burns by the name of the SANA registry of orbit-relative frames.
const FRAME: &str = "LVLH_ROTATING";
const COMPOSITION: &str = "TIME_ABSOLUTE, MAN_DURA, DV_X, DV_Y, DV_Z";

/// Writes the burns.
pub(super) fn write(plan: &Plan, plan_id: &str, labels: &Labels) -> Result<String, Missing> {
    let Some(epoch) = &plan.problem().epoch else { return Err(Missing(vec![EPOCH])) };
    let outcome = plan.outcome();
    let at = |elapsed: Seconds| calendar_after(epoch, elapsed);
    let start = at(Seconds::from_seconds(0.0));
    let stop = outcome.states.last().map_or_else(|| start.clone(), |last| at(last.elapsed));
    let mut lines = vec![
        "CCSDS_OCM_VERS = 3.0".to_owned(),
        format!("CREATION_DATE = {}", labels.created(epoch)),
        format!("ORIGINATOR = {}", labels.originator),
        format!("MESSAGE_ID = {plan_id}"),
        String::new(),
        "META_START".to_owned(),
        format!("OBJECT_NAME = {}", labels.chaser_name),
        format!("OBJECT_DESIGNATOR = {}", labels.chaser_designator),
        format!("TIME_SYSTEM = {}", ccsds_time_system(epoch.time_system)),
        format!("EPOCH_TZERO = {start}"),
        format!("START_TIME = {start}"),
        format!("STOP_TIME = {stop}"),
        "META_STOP".to_owned(),
        String::new(),
        "MAN_START".to_owned(),
        "COMMENT Nominal impulses of a rendezvous plan with disturbance feedback.".to_owned(),
        "COMMENT Corrections by the plan's gains are added in flight; they are not in here."
            .to_owned(),
        format!(
            "COMMENT MAN_REF_FRAME is that of the orbit of the target, {}: x along-track,",
            labels.target_name
        ),
        "COMMENT y minus orbit normal, z nadir. It is not that of this object's own orbit."
            .to_owned(),
        "COMMENT An impulse has duration 0.".to_owned(),
        "MAN_ID = RENDEZVOUS".to_owned(),
        "MAN_BASIS = PLANNED".to_owned(),
        "MAN_DEVICE_ID = ALL".to_owned(),
        format!("MAN_REF_FRAME = {FRAME}"),
        "DC_TYPE = CONTINUOUS".to_owned(),
        format!("MAN_COMPOSITION = {COMPOSITION}"),
        "MAN_UNITS = s, km/s, km/s, km/s".to_owned(),
    ];
    for burn in &outcome.burns {
        let components: Vec<String> = burn.delta_v_m_s.iter().map(|v| real(v / 1e3)).collect();
        lines.push(format!("{} 0.0 {}", at(burn.elapsed), components.join(" ")));
    }
    lines.push("MAN_STOP".to_owned());
    Ok(lines.join("\n") + "\n")
}

/// One burn as an OCM has it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct OcmBurn {
    /// As written, in the message's time system.
    pub(crate) epoch: String,
    /// `LVLH_CCSDS`.
    pub(crate) delta_v_m_s: Vector3<f64>,
}

/// One fault: keyword or line, what was expected, what was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OcmFault {
    pub(crate) place: String,
    pub(crate) expected: String,
    pub(crate) got: String,
}

/// Reads the impulses of every manoeuvre block; other blocks of the message are left alone.
///
/// # Errors
/// Every fault: above all a block without the frame of its vectors.
pub(crate) fn read_burns(text: &str) -> Result<Vec<OcmBurn>, Vec<OcmFault>> {
    let mut reader = Reader { burns: Vec::new(), faults: Vec::new() };
    let mut block: Option<Block<'_>> = None;
    let mut versions = 0;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        match (line, &mut block) {
            ("MAN_START", None) => block = Some(Block::default()),
            ("MAN_STOP", Some(_)) => {
                if let Some(block) = block.take() {
                    reader.end(&block);
                }
            }
            (_, Some(block)) if !line.is_empty() && !line.starts_with("COMMENT") => {
                block.lines.push((number + 1, line));
            }
            (_, None) if line.starts_with("CCSDS_OCM_VERS") => versions += 1,
            _ => {}
        }
    }
    if versions != 1 {
        reader.refuse("CCSDS_OCM_VERS", "the keyword once", &versions.to_string());
    }
    if block.is_some() {
        reader.refuse("MAN_START", "MAN_STOP after it", "the end of the message");
    }
    if reader.faults.is_empty() { Ok(reader.burns) } else { Err(reader.faults) }
}

/// The lines between MAN_START and MAN_STOP.
#[derive(Default)]
struct Block<'a> {
    lines: Vec<(usize, &'a str)>,
}

impl<'a> Block<'a> {
    fn value(&self, keyword: &str) -> Option<&'a str> {
        self.lines.iter().find_map(|(_, line)| {
            let (name, value) = line.split_once('=')?;
            (name.trim() == keyword).then(|| value.trim())
        })
    }
}

struct Reader {
    burns: Vec<OcmBurn>,
    faults: Vec<OcmFault>,
}

impl Reader {
    fn end(&mut self, block: &Block<'_>) {
        for (keyword, expected) in [("MAN_REF_FRAME", FRAME), ("MAN_COMPOSITION", COMPOSITION)] {
            match block.value(keyword) {
                Some(found) if same_words(found, expected) => {}
                Some("LVLH") => {
                    let got = "LVLH, which does not say which of its meanings it has";
                    self.refuse(keyword, expected, got);
                }
                Some(other) => self.refuse(keyword, expected, other),
                None => self.refuse(keyword, expected, "nothing"),
            }
        }
        for (number, line) in block.lines.iter().filter(|(_, line)| !line.contains('=')) {
            match burn(line) {
                Some(burn) => self.burns.push(burn),
                None => self.refuse(&format!("line {number}"), COMPOSITION, line),
            }
        }
    }

    fn refuse(&mut self, place: &str, expected: &str, got: &str) {
        self.faults.push(OcmFault {
            place: place.to_owned(),
            expected: expected.to_owned(),
            got: got.chars().take(80).collect(),
        });
    }
}

/// Commas with and without a space mean the same.
fn same_words(a: &str, b: &str) -> bool {
    let words = |text: &str| text.split(',').map(|w| w.trim().to_owned()).collect::<Vec<_>>();
    words(a) == words(b)
}

fn burn(line: &str) -> Option<OcmBurn> {
    let mut words = line.split_whitespace();
    let epoch = words.next().filter(|epoch| is_calendar(epoch))?.to_owned();
    let mut number = || words.next()?.parse::<f64>().ok().filter(|value| value.is_finite());
    let duration = number()?;
    let delta_v_m_s = Vector3::new(number()?, number()?, number()?) * 1e3;
    (duration == 0.0 && words.next().is_none()).then_some(OcmBurn { epoch, delta_v_m_s })
}

#[cfg(test)]
mod tests {
    use super::*;

    const OCM: &str = "\
        CCSDS_OCM_VERS = 3.0\n\
        META_START\n\
        TIME_SYSTEM = UTC\n\
        META_STOP\n\
        MAN_START\n\
        COMMENT one impulse\n\
        MAN_ID = RENDEZVOUS\n\
        MAN_REF_FRAME = LVLH_ROTATING\n\
        MAN_COMPOSITION = TIME_ABSOLUTE,MAN_DURA, DV_X,DV_Y,DV_Z\n\
        2027-03-01T12:00:00.000 0.0 1.5e-4 0 -2e-5\n\
        MAN_STOP\n";

    fn places(text: &str) -> Vec<String> {
        read_burns(text).unwrap_err().into_iter().map(|fault| fault.place).collect()
    }

    #[test]
    fn ocm_burns_come_in_metres_per_second() {
        let burns = read_burns(OCM).unwrap();
        assert_eq!(burns.len(), 1);
        assert_eq!(burns[0].epoch, "2027-03-01T12:00:00.000");
        // km/s to m/s is one rounding.
        assert!((burns[0].delta_v_m_s - Vector3::new(0.15, 0.0, -0.02)).norm() < 1e-15);
    }

    #[test]
    fn ocm_without_a_frame_is_refused_by_name() {
        let frame = "MAN_REF_FRAME = LVLH_ROTATING\n";
        assert_eq!(places(&OCM.replace(frame, "")), ["MAN_REF_FRAME"]);
        assert_eq!(places(&OCM.replace(frame, "MAN_REF_FRAME = LVLH\n")), ["MAN_REF_FRAME"]);
        assert_eq!(
            places(&OCM.replace(frame, "MAN_REF_FRAME = RSW_ROTATING\n")),
            ["MAN_REF_FRAME"]
        );
    }

    #[test]
    fn ocm_malformed_lines_are_named() {
        assert_eq!(places(&OCM.replace(" -2e-5", "")), ["line 10"]);
        assert_eq!(places(&OCM.replace("1.5e-4", "nan")), ["line 10"]);
        assert_eq!(places(&OCM.replace(" 0.0 1.5", " 2.0 1.5")), ["line 10"]);
        assert_eq!(places(&OCM.replace("MAN_STOP\n", "")), ["MAN_START"]);
        assert_eq!(places("nothing of the kind"), ["CCSDS_OCM_VERS"]);
    }
}
