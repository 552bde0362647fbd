//! A plan in one's hand, without a node: the same checks and documents that a node gives.
//!
//! Pure functions of bytes. A plan is either JSON (a `vbar.v1.PlanDocument`, or the answer of
//! `GetPlan` that holds one) or the compact form of `PLAN_FORMAT_BINARY`; which one it is shows in
//! its first byte, which for JSON is a brace.

use std::fmt;

use bytes::Bytes;
use prost::Name as _;
use prost_reflect::{DeserializeOptions, DynamicMessage};
use sha2::{Digest, Sha256};
use vbar_proto::{DESCRIPTORS, v1};

use crate::wire::{
    Artifact, ArtifactId, Candidate, Claimed, Limits, Missing, Order, Render as _, Violation,
    Violations, parse, read_ocm_burns,
};

/// A plan whose claims hold.
#[derive(Debug, Clone, PartialEq)]
pub struct VerifiedPlan {
    /// Hex sha256 of its bytes, as a node would name it.
    pub plan_id: String,
    /// Mission and plan, every number that follows from mission, burns and gains recomputed.
    pub document: v1::PlanDocument,
    /// The proof, recomputed.
    pub certificate: v1::PlanCertificate,
}

/// Why a plan was refused, or a document not written.
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// Name of the `google.rpc.Code` a node would answer with, such as `INVALID_ARGUMENT`.
    pub code: &'static str,
    /// One sentence.
    pub message: String,
    /// Every fault, by field; empty if the bytes could not be read at all.
    pub violations: Vec<FieldFault>,
}

/// One fault of a plan.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldFault {
    /// Where, such as `plan.disturbance_feedback.burns[2].delta_v_m_s[0]`.
    pub path: String,
    /// What would be right: for a claim, what follows from mission, burns and gains.
    pub expected: String,
    /// What was found.
    pub got: String,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Refusal {}

/// Recomputes everything a plan claims from its mission, burns and gains.
///
/// # Errors
/// [`Refusal`] with every claim that does not hold.
pub fn verify_plan(bytes: &[u8], limits: &Limits) -> Result<VerifiedPlan, Refusal> {
    let plan = verified(bytes, limits)?;
    let (Some(document), Some(certificate)) =
        (plan.render_document(), plan.render_plan_certificate())
    else {
        return Err(Refusal::unreadable("not a plan that can be kept"));
    };
    Ok(VerifiedPlan { plan_id: plan_id(&plan), document, certificate })
}

/// Writes a plan as a document; `request.plan_id` is not looked at.
///
/// # Errors
/// [`Refusal`] if the plan's claims do not hold, or if its mission lacks what the format needs.
pub fn export(
    bytes: &[u8],
    request: &v1::ExportPlanRequest,
    limits: &Limits,
) -> Result<v1::ExportPlanResponse, Refusal> {
    let order: Order = parse(request, limits)?;
    let plan = verified(bytes, limits)?;
    match plan.export(&plan_id(&plan), &order) {
        Some(Ok(document)) => Ok(document.render()),
        Some(Err(Missing(fields))) => Err(Refusal {
            code: "FAILED_PRECONDITION",
            message: format!("the mission lacks what this format needs: {}", fields.join(", ")),
            violations: fields
                .into_iter()
                .map(|path| FieldFault {
                    path: path.to_owned(),
                    expected: "a value (this format needs it)".to_owned(),
                    got: "nothing".to_owned(),
                })
                .collect(),
        }),
        None => Err(Refusal::unreadable("not a plan that can be exported")),
    }
}

/// Reads the impulses of a CCSDS orbit comprehensive message, as [`export`] writes it: epochs in
/// the message's own time system, vectors in `LVLH_CCSDS`.
///
/// # Errors
/// [`Refusal`] with every fault; a manoeuvre block without a frame is one.
pub fn read_ocm(bytes: &[u8]) -> Result<Vec<v1::Burn>, Refusal> {
    let text = std::str::from_utf8(bytes)
        .map_err(|fault| Refusal::unreadable(format!("not a text in UTF-8: {fault}")))?;
    let burn = |burn: crate::wire::OcmBurn| v1::Burn {
        epoch: burn.epoch,
        frame: v1::Frame::LvlhCcsds.into(),
        delta_v_m_s: burn.delta_v_m_s.iter().copied().collect(),
        ..v1::Burn::default()
    };
    match read_ocm_burns(text) {
        Ok(burns) => Ok(burns.into_iter().map(burn).collect()),
        Err(faults) => {
            let fault = |fault: crate::wire::OcmFault| Violation {
                path: fault.place,
                expected: fault.expected,
                got: fault.got,
            };
            Err(Violations(faults.into_iter().map(fault).collect()).into())
        }
    }
}

/// Reads a plan in either form and checks its claims.
fn verified(bytes: &[u8], limits: &Limits) -> Result<Artifact, Refusal> {
    let text = bytes.trim_ascii_start();
    let candidate = if text.starts_with(b"{") {
        let claimed: Claimed = parse(&document(text)?, limits)?;
        Candidate::Document(Box::new(claimed))
    } else {
        Candidate::Binary(Bytes::copy_from_slice(bytes))
    };
    Ok(candidate.verify()?)
}

/// The document, whether it stands alone or in an answer of `GetPlan`.
fn document(text: &[u8]) -> Result<v1::PlanDocument, Refusal> {
    let unreadable =
        |fault: serde_json::Error| Refusal::unreadable(format!("not a plan's document: {fault}"));
    let value: serde_json::Value = serde_json::from_slice(text).map_err(unreadable)?;
    let value = match value {
        serde_json::Value::Object(mut answer) if answer.contains_key("document") => {
            answer.remove("document").unwrap_or_default()
        }
        other => other,
    };
    let descriptor = DESCRIPTORS
        .get_message_by_name(&v1::PlanDocument::full_name())
        .ok_or_else(|| Refusal::unreadable("this build lacks its own contract"))?;
    let options = DeserializeOptions::new().deny_unknown_fields(true);
    DynamicMessage::deserialize_with_options(descriptor, value, &options)
        .map_err(unreadable)?
        .transcode_to()
        .map_err(|fault| Refusal::unreadable(format!("not a plan's document: {fault}")))
}

fn plan_id(plan: &Artifact) -> String {
    ArtifactId(Sha256::digest(plan.to_bytes()).into()).to_string()
}

impl Refusal {
    fn unreadable(message: impl Into<String>) -> Self {
        Self { code: "INVALID_ARGUMENT", message: message.into(), violations: Vec::new() }
    }
}

impl From<Violations> for Refusal {
    fn from(Violations(violations): Violations) -> Self {
        let count = violations.len();
        let first = violations.first();
        let first = first.map(|v| format!("{}: {v}", v.path)).unwrap_or_default();
        let message = match count {
            0 | 1 => first,
            _ => format!("{count} faults; the first: {first}"),
        };
        let fault = |violation: Violation| FieldFault {
            path: violation.path,
            expected: violation.expected,
            got: violation.got,
        };
        let violations = violations.into_iter().map(fault).collect();
        Self { code: "INVALID_ARGUMENT", message, violations }
    }
}
