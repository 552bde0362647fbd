//! A plan in one's hand, without a node: the same checks and documents that a node gives.
//!
//! Pure functions of bytes. A plan is either JSON (a `vbar.v1.PlanDocument`, or the answer of
//! `GetPlan` that holds one) or the compact form of `PLAN_FORMAT_BINARY`; which one it is shows in
//! its first byte.

use std::fmt;

use vbar_proto::v1;

use crate::Limits;

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
    todo!("{bytes:?} {limits:?}")
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
    todo!("{bytes:?} {request:?} {limits:?}")
}
