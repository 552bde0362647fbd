//! The reference simulator of vbar: flies missions against a node and shows what comes out.
//!
//! It is a customer like any other. It knows the service through `vbar-client` alone, never the
//! mathematics behind it: plant, scaling, docking cone and reference motion are written a second
//! time, from the papers, so that one wrong sign cannot hide in both.
//!
//! A mission file ([`MissionFile`]) says what the service is asked and against which truth it is
//! flown. Closed loops ([`Mission`]) are flown by [`simulate`], plans ([`PlanMission`]) by
//! [`fly_plans`], loops that can be aborted ([`AbortMission`]) by [`fly_aborts`], loops under
//! sampled chance constraints ([`SamplingMission`]) by [`fly_sampling`], many runs at once; the
//! [`Report`], [`PlanReport`], [`AbortReport`] or [`SamplingReport`] holds every trace, the
//! statistics and the published figures; [`draw`], [`draw_plans`], [`draw_aborts`] and
//! [`draw_sampling`] make pictures of it.

mod campaign;
mod clearance;
mod mission;
mod pictures;
mod plant;
mod report;

pub use campaign::{
    Campaign, Flight, Progress, ProgressBar, RunOptions, SchemeChoice, Silent, SimulationError,
    SweepPoint,
    abort::{
        AbortCampaign, AbortFlight, AbortOutcome, AbortRunOptions, AbortSample, AbortStep, Drift,
        FlownFailure, ModeCounts, Origin, UnsafeSets, fly_aborts,
    },
    flight::{Outcome, Sample, Step, VIOLATION_TOLERANCE_ND},
    plan::{
        FlownBurn, OpenLoopEnd, PlanAnswer, PlanCampaign, PlanFlight, PlanRow, PlanRunOptions,
        PlanSample, Planned, compute_plan, compute_table, fly_plans,
    },
    sampling::{
        SamplingCampaign, SamplingFlight, SamplingOutcome, SamplingRunOptions, SamplingSample,
        SamplingSchemeChoice, SamplingStep, fly_sampling,
    },
    search::SearchComparison,
    simulate,
};
pub use mission::{
    AbortCase, AbortMission, AbortSources, Mission, MissionError, MissionFile, PlanChanges,
    PlanMission, Published, PublishedAxes, PublishedEffort, RUNS_MAX, SamplingMission, metric_name,
    metric_named, sampling_scheme_name, sampling_scheme_named,
};
pub use pictures::{
    PictureError, abort::draw_aborts, draw, plan::draw_plans, sampling::draw_sampling,
};
pub use report::{
    Report, Statistics, Summary,
    abort::{
        AbortReport, AbortSummary, DriftFigures, FailureFigures, PathComparison, PhaseFigures,
    },
    plan::{PlanReport, PlanSummary, plan_rows_json, plan_rows_text, plan_text},
    sampling::{SamplingReport, SamplingSummary},
};

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector, Vector3};

    /// The cases of one file of reference numbers (see `tests/golden/variable_horizon`).
    pub(crate) fn golden_cases(file: &str) -> Vec<serde_json::Value> {
        match golden_file("variable_horizon", file) {
            serde_json::Value::Array(cases) => cases,
            other => panic!("{file} is not a list: {other}"),
        }
    }

    /// One file of a family of reference numbers (see `tests/golden`).
    pub(crate) fn golden_file(family: &str, file: &str) -> serde_json::Value {
        let path = format!("{}/../tests/golden/{family}/{file}", env!("CARGO_MANIFEST_DIR"));
        let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{path}: {e}"));
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{path}: {e}"))
    }

    /// One case of abort safety (see `tests/golden/abort_safe`).
    pub(crate) fn abort_case(name: &str) -> serde_json::Value {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/abort_safe");
        let path = format!("{folder}/{name}.json");
        let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{path}: {e}"));
        serde_json::from_str(&text).unwrap_or_else(|e| panic!("{path}: {e}"))
    }

    /// A list of rows.
    pub(crate) fn matrix(json: &serde_json::Value) -> DMatrix<f64> {
        let rows: Vec<_> = json.as_array().expect("rows").iter().map(vector).collect();
        DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j])
    }

    /// Every reference case of a spacecraft near a target with a constant spin.
    pub(crate) fn spinning_cases() -> impl Iterator<Item = serde_json::Value> {
        let files =
            ["adversarial.json", "envisat_p0.json", "mc000_p0.json", "tumbling_sat_003.json"];
        files.into_iter().flat_map(golden_cases).filter(|case| {
            let physical = &case["physical"];
            physical["dt_s"].is_number() && physical["omega_rad_s"].is_array()
        })
    }

    /// A list of three numbers.
    pub(crate) fn vector3(json: &serde_json::Value) -> Vector3<f64> {
        Vector3::from_column_slice(vector(json).as_slice())
    }

    /// A list of numbers.
    pub(crate) fn vector(json: &serde_json::Value) -> DVector<f64> {
        let numbers = json.as_array().expect("a list").iter();
        DVector::from_iterator(numbers.len(), numbers.map(|n| n.as_f64().expect("a number")))
    }
}
