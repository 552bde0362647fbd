//! The report as aligned text.

use std::{collections::BTreeMap, fmt::Write as _};

use super::{AbortReport, AbortSummary, GAUGE_TOLERANCE, PathComparison, PhaseFigures};
use crate::{
    campaign::abort::AbortCampaign,
    report::table::{align, number},
};

/// Renders the whole report.
pub(super) fn report(report: &AbortReport) -> String {
    let plural = if report.runs == 1 { "" } else { "s" };
    let name = &report.mission.name;
    let mut text = format!("{name}, {} run{plural} a variant, seed {}\n", report.runs, report.seed);
    for campaign in &report.campaigns {
        let _ = write!(text, "\n{}", variant(campaign));
    }
    for compared in report.compared() {
        let _ = write!(text, "\n{}", comparison(&compared));
    }
    let sources = &report.mission.published;
    for (what, source) in [("published", &sources.source), ("reference", &sources.reference)] {
        if !source.is_empty() {
            let _ = write!(text, "\n{what}: {source}");
        }
    }
    text.push('\n');
    text
}

fn variant(campaign: &AbortCampaign) -> String {
    let summary = AbortSummary::new(campaign);
    let mut text = format!("{}\n{}", campaign.case.name, figures(campaign, &summary));
    if summary.phases.len() > 1 || summary.phases.iter().any(|phase| phase.sets > 0) {
        let _ = write!(text, "{}", phases(&summary));
    }
    let modes = summary.modes;
    let _ = writeln!(
        text,
        "  steps {}; some half-space gave way at {}; aborting {}; without certificate {}; arrived \
         {} of {}; infeasible {}",
        summary.steps,
        summary.softened_steps,
        summary.abort_steps,
        summary.uncertified_steps,
        summary.arrived,
        summary.runs,
        summary.infeasible,
    );
    if modes.found + modes.none_proved + modes.undecided > 0 {
        let _ = writeln!(
            text,
            "  failures of the next states: abort found for {}, proved impossible for {}, undecided \
             {}; in a reachable set {}",
            modes.found, modes.none_proved, modes.undecided, modes.inside,
        );
    }
    if let Some((p50, p99)) = summary.latency_ms {
        let _ = writeln!(text, "  step latency p50 {p50:.3} ms, p99 {p99:.3} ms");
    }
    for warning in &campaign.artifact.warnings {
        let _ = writeln!(text, "  warning: {warning}");
    }
    text
}

/// Ours, the paper's, the reference's.
fn figures(campaign: &AbortCampaign, summary: &AbortSummary) -> String {
    let several = summary.runs > 1;
    let mut titles = vec![String::new(), "ours".into()];
    if several {
        titles.extend(["min", "max"].map(str::to_owned));
    }
    titles.extend(["published", "reference"].map(str::to_owned));
    let mut lines = vec![titles];
    let others = [&campaign.case.published, &campaign.case.reference];
    let mut line = |label: &str, key: &str, ours: String, spread: Option<[f64; 2]>| {
        let mut cells = vec![label.to_owned(), ours];
        if several {
            let spread = spread.map_or_else(Default::default, |both| both.map(number));
            cells.extend(spread);
        }
        cells.extend(others.map(|figures| beside(figures, key)));
        lines.push(cells);
    };
    for (key, statistics) in &summary.metrics {
        let spread = Some([statistics.min, statistics.max]);
        line(label(key), key, number(statistics.mean), spread);
    }
    for drift in &summary.drifts {
        let of = |what: &str| format!("{what}, {}", drift.truth);
        let states = format!("{} of {}", drift.states_drifting_in, drift.states);
        let limit = format!("states drifting in (gauge below {})", 1.0 - GAUGE_TOLERANCE);
        line(&of(&limit), "states_drifting_in", states, None);
        line(&of("least gauge of drifts"), "least_gauge", number(drift.least_gauge), None);
        let throughout = number(drift.least_gauge_throughout);
        line(&of("between the instants too"), "least_gauge_throughout", throughout, None);
    }
    if let Some(failures) = summary.failures {
        let entering = format!("{} of {}", failures.runs_entering, failures.runs);
        line("runs entering the region", "runs_entering", entering, None);
        let feasible = failures.runs_entering_feasible.to_string();
        line("of these with feasible programs", "runs_entering_feasible", feasible, None);
        let without = failures.runs_without_abort.to_string();
        line("runs without an abort", "runs_without_abort", without, None);
    }
    align(&lines)
}

fn beside(figures: &BTreeMap<String, f64>, key: &str) -> String {
    figures.get(key).map_or_else(String::new, f64::to_string)
}

fn label(metric: &str) -> &str {
    match metric {
        "delta_v_m_s" => "delta-v, sum of axes [m/s]",
        "failure_step" => "failure at step",
        "failure_gauge" => "gauge at the failure",
        "least_gauge_after_failure" => "least gauge after it",
        "least_distance_after_failure_m" => "least distance after it [m]",
        other => other,
    }
}

fn phases(summary: &AbortSummary) -> String {
    let titles = [
        "phase",
        "from step",
        "time [s]",
        "delta-v [m/s]",
        "steps",
        "gave way",
        "sets",
        "of all modes",
        "modes kept",
        "of",
        "in unsafe sets from",
        "only after the next began",
    ];
    let mut lines = vec![titles.map(str::to_owned).to_vec()];
    for (index, phase) in summary.phases.iter().enumerate() {
        lines.push(phase_cells(index, phase));
    }
    align(&lines)
}

fn phase_cells(index: usize, phase: &PhaseFigures) -> Vec<String> {
    let step = |step: Option<usize>| step.map_or_else(|| "-".to_owned(), |step| step.to_string());
    let safe = match phase.safe_until_next {
        Some(true) => "yes",
        Some(false) => "NO",
        None => "-",
    };
    vec![
        format!("{index} {}", phase.kind),
        step(phase.begins_at_step),
        number(phase.time_s),
        number(phase.delta_v_m_s),
        phase.steps.to_string(),
        phase.softened_steps.to_string(),
        phase.sets.to_string(),
        phase.sets_of_all_modes.map_or_else(|| "-".to_owned(), |sets| sets.to_string()),
        phase.modes_kept.to_string(),
        phase.modes.to_string(),
        step(phase.unsafe_at_step),
        safe.to_owned(),
    ]
}

fn comparison(compared: &PathComparison) -> String {
    let [a, b] = &compared.variants;
    let [ours, theirs] = compared.delta_v_m_s;
    format!(
        "{a} against {b}: paths at most {} m apart over {} steps; delta-v {} and {} m/s\n",
        number(compared.largest_distance_m),
        compared.steps,
        number(ours),
        number(theirs),
    )
}
