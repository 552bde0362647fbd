//! What the server says about itself: metrics, request ids and traces.

mod metrics;
mod trace;

pub(crate) use metrics::{
    CallLabels, ClaimLabels, LaneLabels, MethodLabels, Metrics, OutcomeLabels, RefusalLabels,
};
pub(crate) use trace::{REQUEST_ID, RequestId};

/// What every token of ours begins with: nothing that holds it is fit to be logged.
pub(crate) const TOKEN_PREFIX: &str = "vbar_";
