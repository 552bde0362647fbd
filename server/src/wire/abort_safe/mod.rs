//! Abort safety: `vbar/v1/abort_safe.proto`, safety reports, and
//! `vbar_guidance::control::abort_safe`.

mod answer;
mod problem;
mod report;
mod verdict;

pub(crate) use report::{ReportAnswer, ReportCall, ReportFault};
