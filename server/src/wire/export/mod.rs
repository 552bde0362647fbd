//! Plans as documents: pure functions of a plan and the names on its cover.
//!
//! A document that needs what the mission does not have is not written; what is missing is named.

mod csv;
mod ocm;
mod oem;

use bytes::Bytes;
use vbar_guidance::{
    Budget, Interruption, control::disturbance_feedback::Plan, epoch::Epoch, units::Seconds,
};
use vbar_proto::v1;

use super::{
    Door, Parse, Path, Render,
    orbits::{CALENDAR, calendar_after, is_calendar},
    types::unknown_enum,
};

pub(crate) use ocm::{OcmBurn, OcmFault, read_burns as read_ocm_burns};

/// What is asked for.
#[derive(Debug, Clone)]
pub(crate) struct Order {
    format: Format,
    labels: Labels,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Ocm,
    Oem,
    Csv,
    Binary,
}

/// Names on the cover of CCSDS documents.
#[derive(Debug, Clone)]
struct Labels {
    chaser_name: String,
    target_name: String,
    chaser_designator: String,
    originator: String,
    /// UTC; `None`: the mission's start.
    creation_date: Option<String>,
}

/// A document.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Document {
    pub(crate) content: Bytes,
    pub(crate) content_type: &'static str,
    pub(crate) file_name: String,
}

/// Fields of the mission that a format needs and the mission lacks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Missing(pub(crate) Vec<&'static str>);

/// Why no document is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Unwritten {
    /// What the mission lacks.
    Lacks(Missing),
    /// Stopped from outside.
    Interrupted(Interruption),
}

impl From<Missing> for Unwritten {
    fn from(missing: Missing) -> Self {
        Self::Lacks(missing)
    }
}

impl From<Interruption> for Unwritten {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// Writes `plan`, which is called `plan_id`.
///
/// # Errors
/// [`Unwritten`].
pub(crate) fn export(
    plan: &Plan,
    plan_id: &str,
    order: &Order,
    budget: Budget<'_>,
) -> Result<Document, Unwritten> {
    budget.check()?;
    let (content, content_type, extension) = match order.format {
        Format::Ocm => (ocm::write(plan, plan_id, &order.labels)?.into(), TEXT, "ocm"),
        Format::Oem => (oem::write(plan, plan_id, &order.labels, budget)?.into(), TEXT, "oem"),
        Format::Csv => (csv::write(plan).into(), "text/csv; charset=utf-8", "csv"),
        // `proto/UPLINK.md` has it byte by byte; its sha256 is the plan's id.
        Format::Binary => (plan.to_bytes().into(), "application/octet-stream", "bin"),
    };
    let short: String = plan_id.chars().take(12).collect();
    Ok(Document { content, content_type, file_name: format!("plan-{short}.{extension}") })
}

const TEXT: &str = "text/plain; charset=us-ascii";

/// Where the mission's fields stand in a kept plan's document.
const EPOCH: &str = "problem.disturbance_feedback.orbit.epoch";
const ORIENTATION: [&str; 4] = [
    "problem.disturbance_feedback.orbit.elements.inclination_deg",
    "problem.disturbance_feedback.orbit.elements.raan_deg",
    "problem.disturbance_feedback.orbit.elements.argument_of_perigee_deg",
    "problem.disturbance_feedback.orbit.elements.frame",
];

impl Parse for Order {
    type Message = v1::ExportPlanRequest;

    fn parse(message: &v1::ExportPlanRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        const FORMATS: &str = "PLAN_FORMAT_CCSDS_OCM, _CCSDS_OEM, _CSV or _BINARY";
        let place = path.field("format");
        let format = match v1::PlanFormat::try_from(message.format) {
            Ok(v1::PlanFormat::CcsdsOcm) => Some(Format::Ocm),
            Ok(v1::PlanFormat::CcsdsOem) => Some(Format::Oem),
            Ok(v1::PlanFormat::Csv) => Some(Format::Csv),
            Ok(v1::PlanFormat::Binary) => Some(Format::Binary),
            Ok(unspecified @ v1::PlanFormat::Unspecified) => {
                door.refuse(place, FORMATS, unspecified.as_str_name())
            }
            Err(_) => unknown_enum(message.format, FORMATS, place, door),
        };
        let mut label = |text: &str, default: &str, name| {
            label(if text.is_empty() { default } else { text }, path.field(name), door)
        };
        let chaser_name = label(&message.chaser_name, "CHASER", "chaser_name");
        let target_name = label(&message.target_name, "TARGET", "target_name");
        let designator = label(&message.chaser_designator, "UNKNOWN", "chaser_designator");
        let originator = label(&message.originator, "VBAR", "originator");
        let creation_date = match message.creation_date.as_str() {
            "" => Some(None),
            text if is_calendar(text) => Some(Some(text.to_owned())),
            text => {
                let shown: String = text.chars().take(40).collect();
                door.refuse(path.field("creation_date"), CALENDAR, format!("{shown:?}"))
            }
        };
        Some(Self {
            format: format?,
            labels: Labels {
                chaser_name: chaser_name?,
                target_name: target_name?,
                chaser_designator: designator?,
                originator: originator?,
                creation_date: creation_date?,
            },
        })
    }
}

/// A value of a keyword: a line break in it would be a keyword of the caller's own.
fn label(text: &str, path: Path<'_>, door: &mut Door) -> Option<String> {
    const LENGTH_MAX: usize = 64;
    let printable = text.bytes().all(|c| c == b' ' || c.is_ascii_graphic());
    if printable && text.len() <= LENGTH_MAX && text.trim() == text {
        return Some(text.to_owned());
    }
    let shown: String = text.chars().take(80).collect();
    door.refuse(path, "up to 64 printable ASCII characters", format!("{shown:?}"))
}

impl Render for Document {
    type Message = v1::ExportPlanResponse;

    fn render(&self) -> v1::ExportPlanResponse {
        v1::ExportPlanResponse {
            content: self.content.clone(),
            content_type: self.content_type.to_owned(),
            file_name: self.file_name.clone(),
        }
    }
}

impl Labels {
    /// CREATION_DATE: what was asked for, else the mission's start in UTC, so that the same request
    /// gives the same bytes.
    fn created(&self, epoch: &Epoch) -> String {
        match &self.creation_date {
            Some(date) => date.clone(),
            None => {
                let utc = Epoch { time_system: vbar_guidance::epoch::TimeSystem::Utc, ..*epoch };
                calendar_after(&utc, Seconds::from_seconds(0.0))
            }
        }
    }
}

/// A real number with the 16 digits that CCSDS documents allow.
fn real(value: f64) -> String {
    format!("{value:.15e}")
}
