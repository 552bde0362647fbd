//! The report as aligned text.

use std::fmt::Write as _;

use super::{Report, Statistics, Summary};
use crate::mission::scheme_name;

/// Column titles of the metrics' table.
const TITLES: [&str; 7] = ["", "mean", "std", "min", "median", "max", "published"];

/// Renders the whole report.
pub(super) fn render(report: &Report) -> String {
    let mut text = String::new();
    let summaries: Vec<Summary> = report.campaigns.iter().map(Summary::new).collect();
    let runs = summaries.first().map_or(0, |summary| summary.runs);
    let plural = if runs == 1 { "" } else { "s" };
    // Writing into a String cannot fail.
    let _ = writeln!(text, "{}, {runs} run{plural}, seed {}", report.mission.name, report.seed);
    for summary in &summaries {
        let _ = write!(text, "\n{}", scheme(report, summary));
    }
    if summaries.len() > 1 {
        let _ = write!(text, "\n{}", compared(&summaries));
    }
    if !report.sweep.is_empty() {
        text.push_str(&sweep(report));
    }
    if let Some(comparison) = &report.comparison {
        let _ = writeln!(
            text,
            "\nLOCAL against ENUMERATION: {} steps of {} runs, {} with another horizon, {} with \
             another cost, {} with another branch; waiting {:.2} s and {:.2} s",
            comparison.steps,
            comparison.runs,
            comparison.different_horizon,
            comparison.different_cost,
            comparison.different_branch,
            comparison.local.as_secs_f64(),
            comparison.enumeration.as_secs_f64(),
        );
    }
    if !report.mission.published.source.is_empty() {
        let _ = writeln!(text, "\npublished: {}", report.mission.published.source);
    }
    text
}

fn scheme(report: &Report, summary: &Summary) -> String {
    let name = scheme_name(summary.scheme);
    let mut rows = vec![TITLES.map(str::to_owned).to_vec()];
    for (metric, statistics) in &summary.metrics {
        let Statistics { mean, std, min, median, max, .. } = statistics;
        let mut row = vec![label(metric)];
        row.extend([mean, std, min, median, max].map(|value| number(*value)));
        row.push(published(report, name, metric));
        rows.push(row);
    }
    let mut text = format!("{name}\n{}", align(&rows));
    let first = summary.first_violation_step.map_or_else(String::new, |step| {
        let paper = published(report, name, "first_violation_step");
        let paper = if paper.is_empty() { paper } else { format!(", published {paper}") };
        format!(" (first at step {step:.1} on average{paper})")
    });
    let _ = writeln!(
        text,
        "  arrived {} of {}; infeasible {}; starts drawn again {}\n  \
         runs with a violation {}{first}; worst margin {}",
        summary.arrived,
        summary.runs,
        summary.infeasible,
        summary.redraws,
        summary.constraint_violations,
        margins(summary),
    );
    let _ = writeln!(
        text,
        "  steps {}{}; without certificate {}; disturbance outside its set {}; programs for the \
         general solver {}",
        summary.steps,
        fallback(report, summary),
        summary.uncertified_steps,
        summary.outside_assumed_set_steps,
        summary.general_solver_calls,
    );
    if let Some((p50, p99)) = summary.latency_ms {
        let _ = writeln!(text, "  step latency p50 {p50:.3} ms, p99 {p99:.3} ms");
    }
    text
}

fn margins(summary: &Summary) -> String {
    let state = summary.worst_margin.map(|margin| format!("{margin:.3e}"));
    let metres = summary.worst_margin_m.map(|margin| format!(" ({margin:.3} m)"));
    let input = summary.worst_input_margin.map(|margin| format!(", of the input {margin:.3e}"));
    let outside = (summary.arrived_outside > summary.constraint_violations).then(|| {
        format!("; arrivals outside, which the problem allows, {}", summary.arrived_outside)
    });
    let parts = [state.or(Some("none".into())), metres, input, outside];
    parts.into_iter().flatten().collect()
}

fn fallback(report: &Report, summary: &Summary) -> String {
    let Some(share) = summary.fallback_share else { return String::new() };
    let paper = published(report, scheme_name(summary.scheme), "fallback_share");
    let paper = if paper.is_empty() { paper } else { format!(" (published {paper})") };
    format!("; fallback share {share:.3}{paper}")
}

/// Means side by side, percent against the first, as Table 1 of [Quartullo2025a].
fn compared(summaries: &[Summary]) -> String {
    let first = &summaries[0];
    let mut rows = vec![vec![String::from("mean")]];
    rows[0].extend(summaries.iter().map(|summary| scheme_name(summary.scheme).to_owned()));
    for (metric, ours) in &first.metrics {
        let mut row = vec![label(metric), number(ours.mean)];
        row.extend(summaries[1..].iter().map(|summary| match summary.metric(metric) {
            None => String::from("-"),
            Some(theirs) => {
                let percent = 100.0 * (theirs.mean / ours.mean - 1.0);
                format!("{} ({percent:+.1} %)", number(theirs.mean))
            }
        }));
        rows.push(row);
    }
    align(&rows)
}

fn sweep(report: &Report) -> String {
    let mut rows = vec![["fuel weight", "fuel", "steps", "arrived"].map(str::to_owned).to_vec()];
    for point in &report.sweep {
        let steps = format!("{:.2}", point.completion_steps);
        let weight = format!("{}", point.fuel_weight);
        rows.push(vec![weight, number(point.fuel), steps, point.arrived.to_string()]);
    }
    format!("\n{}", align(&rows))
}

fn published(report: &Report, scheme: &str, metric: &str) -> String {
    let figures = report.mission.published.schemes.get(scheme).and_then(|m| m.get(metric));
    let Some(figures) = figures else { return String::new() };
    let said: Vec<String> = ["mean", "std", "min", "median", "max"]
        .iter()
        .filter_map(|name| Some((name, figures.get(*name)?)))
        .map(|(name, value)| match *name {
            "mean" => format!("{value}"),
            other => format!("{other} {value}"),
        })
        .collect();
    said.join(", ")
}

fn label(metric: &str) -> String {
    let (name, unit) = match metric {
        "final_distance_m" => ("final distance", " [m]"),
        "final_set_radius_m" => ("final set radius", " [m]"),
        "delta_v_m_s" => ("delta-v", " [m/s]"),
        "adapted_horizon" => ("last horizon N(q)", ""),
        other => return other.replace('_', " "),
    };
    format!("{name}{unit}")
}

/// Four significant digits, without exponents in the usual range.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let magnitude = value.abs().log10().floor();
    if !(-4.0..6.0).contains(&magnitude) {
        return format!("{value:.3e}");
    }
    // Between 0 and 7 after the test above.
    let decimals = (3.0 - magnitude).max(0.0) as usize;
    format!("{value:.decimals$}")
}

/// Columns padded to their widest cell: the first to the left, the others to the right.
pub(super) fn align(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max()
    };
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::from("  ");
        for (column, cell) in row.iter().enumerate() {
            let pad = widths[column] - cell.chars().count();
            let pad = " ".repeat(pad);
            let gap = if column == 0 { "" } else { "  " };
            match column {
                0 => line.extend([cell.as_str(), pad.as_str()]),
                _ => line.extend([gap, pad.as_str(), cell.as_str()]),
            }
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_numbers_have_four_digits() {
        let cases = [(0.38, "0.3800"), (25.934, "25.93"), (0.0, "0"), (-1234.6, "-1235")];
        for (value, expected) in cases {
            assert_eq!(number(value), expected);
        }
        assert_eq!(number(1.5e-9), "1.500e-9");
    }

    #[test]
    fn table_columns_align() {
        let rows = [["a", "1"], ["longer", "22222"]].map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(align(&rows), "  a           1\n  longer  22222\n");
    }
}
