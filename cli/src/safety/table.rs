//! A safety report as aligned text.

use std::fmt::Write as _;

use vbar_client::v1::{
    AbortExistence, DriftVerdict, ModeVerdict, SafetyReportResponse, StateVerdict,
};

/// Width of a column.
const WIDTH: usize = 12;

/// One line a state, then the counts.
pub(super) fn render(report: &SafetyReportResponse) -> String {
    let titles = [
        "step",
        "phase",
        "x [m]",
        "y [m]",
        "z [m]",
        "failures",
        "abort",
        "none",
        "undecided",
        "doomed",
        "after [s]",
        "drift",
        "enters [s]",
        "nearest [m]",
    ];
    let mut text = row(titles.map(str::to_owned));
    for state in &report.states {
        text.push_str(&row(cells(state)));
    }
    let Some(summary) = &report.summary else { return text };
    // Writing into a String cannot fail.
    let _ = writeln!(
        text,
        "\n{} verdicts on {} states: abort found {}, proved impossible {}, undecided {}; states inside \
         a reachable set: {}",
        summary.verdicts,
        report.states.len(),
        summary.found,
        summary.none_proved,
        summary.undecided,
        summary.states_inside,
    );
    match summary.first_without_abort.and_then(|index| usize::try_from(index).ok()) {
        None => text.push_str("every failure at every state can be survived\n"),
        Some(index) => {
            let step = report.states.get(index).map_or(0, |state| state.step_index);
            let _ = writeln!(text, "first state without an abort for some failure: step {step}");
        }
    }
    let _ = writeln!(
        text,
        "nearest to the target: {:.3} m, {:.1} s after the mission's start",
        summary.closest_distance_m, summary.closest_elapsed_s,
    );
    for warning in &summary.warnings {
        let _ = writeln!(text, "warning: {warning}");
    }
    text
}

fn row<const N: usize>(cells: [String; N]) -> String {
    let padded: String = cells.iter().map(|cell| format!("{cell:>WIDTH$}")).collect();
    format!("{}\n", padded.trim_end())
}

fn cells(state: &StateVerdict) -> [String; 14] {
    let count = |which: AbortExistence| {
        state.modes.iter().filter(|mode| mode.abort() == which).count().to_string()
    };
    let doomed = || state.modes.iter().filter(|mode| mode.inside_reachable_set);
    let position = state.state.as_ref().map_or(&[][..], |state| &state.position_m);
    let at = |axis: usize| position.get(axis).map_or_else(String::new, |x| format!("{x:.2}"));
    let drift = state.drift.as_ref();
    // The nonlinear one is nearer to the truth.
    let drift = drift.and_then(|drift| drift.two_body.as_ref().or(drift.linear.as_ref()));
    let aborts = state.modes.iter().filter_map(|mode: &ModeVerdict| mode.closest_distance_m);
    let nearest = aborts.chain(drift.map(|drift| drift.closest_distance_m)).reduce(f64::min);
    [
        state.step_index.to_string(),
        state.phase_index.to_string(),
        at(0),
        at(1),
        at(2),
        state.modes.len().to_string(),
        count(AbortExistence::Found),
        count(AbortExistence::NoneProved),
        count(AbortExistence::Undecided),
        doomed().count().to_string(),
        seconds(doomed().filter_map(|mode| mode.time_to_violation_s).reduce(f64::min)),
        drift.map_or_else(|| "-".into(), |drift| verdict(drift).to_owned()),
        seconds(drift.and_then(|drift| drift.time_to_violation_s)),
        nearest.map_or_else(|| "-".into(), |nearest| format!("{nearest:.2}")),
    ]
}

fn verdict(drift: &DriftVerdict) -> &'static str {
    if drift.safe_throughout { "safe" } else { "ENTERS" }
}

fn seconds(time: Option<f64>) -> String {
    time.map_or_else(|| "-".into(), |time| format!("{time:.1}"))
}
