//! The report as aligned text.

use std::fmt::Write as _;

use vbar_proto::v1::OfflineSamplingScheme as Scheme;

use super::{SamplingReport, SamplingSummary, Statistics};
use crate::{
    campaign::sampling::SamplingCampaign,
    mission::sampling_scheme_name,
    report::table::{align, number},
};

const TITLES: [&str; 9] = [
    "from",
    "flights",
    "docked",
    "time to dock [s]",
    "min",
    "max",
    "effort [N s]",
    "std",
    "worst row [%]",
];

/// Renders the whole report.
pub(super) fn render(report: &SamplingReport) -> String {
    let mission = &report.mission;
    let variant = mission.variant.as_ref().map_or_else(String::new, |name| format!(" {name}"));
    let starts = mission.simulation.starts.len();
    let mut text = format!(
        "{}{variant}, {} from each of {starts} starts, seed {}\n",
        mission.name, report.repetitions, report.seed
    );
    for campaign in &report.campaigns {
        // Writing into a String cannot fail.
        let _ = write!(text, "\n{}", controller(report, campaign));
    }
    let _ = write!(text, "\n{}", compared(report));
    text
}

fn controller(report: &SamplingReport, campaign: &SamplingCampaign) -> String {
    let name = sampling_scheme_name(campaign.scheme);
    let artifact = match &campaign.prepared {
        Err(reason) => return format!("{name}\n  no such controller: {reason}\n"),
        Ok(artifact) => artifact,
    };
    let mut rows = vec![TITLES.map(str::to_owned).to_vec()];
    rows.extend(report.starts().map(|start| row(start, &report.summary(campaign, Some(start)))));
    let all = report.summary(campaign, None);
    rows.push(row("all", &all));
    let mut text = format!("{name}\n{}", align(&rows));
    if campaign.scheme == Scheme::OfflineSampling {
        let confidence = artifact.joint_confidence.map_or_else(
            || "none, the sample size is not the bound's".to_owned(),
            |confidence| format!("{confidence}"),
        );
        let _ = writeln!(
            text,
            "  {} sampled rows, {} kept, {} of the first-step set; joint confidence {confidence}",
            artifact.sampled_rows, artifact.kept_rows, artifact.first_step_rows,
        );
    }
    if all.without_first_step_set > 0 {
        let count = all.without_first_step_set;
        let _ = writeln!(
            text,
            "  {count} flights without the first-step set, because their start lies outside it"
        );
    }
    text + &counts(&all)
}

fn row(from: &str, summary: &SamplingSummary) -> Vec<String> {
    let figure = |statistics: &Option<Statistics>, which: fn(&Statistics) -> f64| {
        statistics.as_ref().map_or_else(|| "-".to_owned(), |statistics| number(which(statistics)))
    };
    let (time, effort) = (&summary.time_to_dock_s, &summary.control_effort_ns);
    let worst = match &summary.worst_violation {
        None => "0".to_owned(),
        Some((row, share)) => format!("{:.2} ({row})", 100.0 * share),
    };
    vec![
        from.to_owned(),
        summary.flights.to_string(),
        summary.docked.to_string(),
        figure(time, |s| s.mean),
        figure(time, |s| s.min),
        figure(time, |s| s.max),
        figure(effort, |s| s.mean),
        figure(effort, |s| s.std),
        worst,
    ]
}

fn counts(all: &SamplingSummary) -> String {
    let mut text = format!(
        "  commands {}, of a previous plan's tail {}, without certificate {}, outside the input \
         constraints {}; flights without a command {}, too long {}\n",
        all.steps,
        all.tail_steps,
        all.uncertified_steps,
        all.input_violations,
        all.infeasible,
        all.steps_exhausted,
    );
    if let Some(angle) = all.largest_angle_deg {
        let _ = writeln!(text, "  largest angle in the second half of a flight {angle:.2} deg");
    }
    if let Some((p50, p99)) = all.latency_ms {
        let _ = writeln!(text, "  step latency p50 {p50:.3} ms, p99 {p99:.3} ms");
    }
    text
}

/// Mean efforts side by side, as Table III of [Mammarella2019].
fn compared(report: &SamplingReport) -> String {
    let published = &report.mission.published;
    let mut rows = vec![["mean effort [N s]", "ours", "published"].map(str::to_owned).to_vec()];
    for campaign in &report.campaigns {
        let name = sampling_scheme_name(campaign.scheme);
        let effort = report.summary(campaign, None).control_effort_ns;
        let ours = effort.map_or_else(|| "-".to_owned(), |effort| number(effort.mean));
        let paper = published.control_effort_ns.get(name);
        let paper = paper.map_or_else(String::new, |effort| format!("{effort}"));
        rows.push(vec![name.to_owned(), ours, paper]);
    }
    let mut text = align(&rows);
    if let Some([least, most]) = published.time_to_dock_s {
        let _ = writeln!(text, "  published time to dock {least} to {most} s");
    }
    if let Some(allowed) = report.mission.model().ok().and_then(|model| model.violation) {
        let _ = writeln!(text, "  a row may be violated in {} % of all cases", 100.0 * allowed);
    }
    if !published.source.is_empty() {
        let _ = writeln!(text, "\npublished: {}", published.source);
    }
    text
}
