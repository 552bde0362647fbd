//! Plans and their flights as aligned text.

use std::fmt::Write as _;

use vbar_proto::v1;

use super::{Asked, PlanReport, PlanSummary};
use crate::{
    campaign::plan::{PlanAnswer, PlanCampaign, PlanRow, Planned},
    mission::{
        PlanMission, metric_name,
        plan::{NoiseLaw, PlanTruth},
    },
    report::{
        Statistics,
        table::{align, number},
    },
};

/// Renders the whole report.
pub(super) fn report(report: &PlanReport) -> String {
    let mission = &report.mission;
    let plural = if report.runs == 1 { "" } else { "s" };
    let mut text = format!(
        "{}, {} run{plural} of each plan, seed {}; {}, {}\n",
        mission.name,
        report.runs,
        report.seed,
        truth(mission),
        noise(mission),
    );
    for campaign in &report.campaigns {
        // Writing into a String cannot fail.
        let _ = write!(text, "\n{}", flown(campaign));
    }
    if !report.table.is_empty() {
        let _ = write!(text, "\n{}", rows(&report.table));
    }
    text
}

fn truth(mission: &PlanMission) -> &'static str {
    match mission.simulation.truth {
        PlanTruth::TwoBody { j2: true } => "true motion of two bodies with J2",
        PlanTruth::TwoBody { j2: false } => "true motion of two bodies",
    }
}

fn noise(mission: &PlanMission) -> &'static str {
    match mission.simulation.noise {
        NoiseLaw::Surface => "errors on the surface of the assumed set",
        NoiseLaw::Inside => "errors uniform in the assumed set",
        NoiseLaw::None => "perfect measurements",
    }
}

/// One plan's promise and its flights.
fn flown(campaign: &PlanCampaign) -> String {
    let row = &campaign.row;
    let mut text = format!("{}\n", heading(row));
    let planned = match &row.answer {
        PlanAnswer::Infeasible(why) => return format!("{text}  no plan: {}\n", why.reason),
        PlanAnswer::Plan(planned) => planned,
    };
    text.push_str(&axes(row, planned));
    let summary = PlanSummary::new(campaign);
    let titles = ["", "mean", "std", "min", "median", "max"].map(str::to_owned).to_vec();
    let mut lines = vec![titles];
    lines.extend(summary.metrics.iter().map(|(name, values)| statistics(label(name), values)));
    for (name, values) in &summary.open_loop_metrics {
        lines.push(statistics(format!("open loop: {}", label(name)), values));
    }
    text.push_str(&align(&lines));
    let _ = writeln!(
        text,
        "  inside the arrival set {} of {}; without feedback {} of {}\n  \
         burns {}, clipped {} (in {} runs); runs outside the assumed errors {}",
        summary.inside,
        summary.runs,
        summary.open_loop_inside,
        summary.runs,
        summary.burns,
        summary.clipped_burns,
        summary.clipped_runs,
        summary.outside_assumed_set_runs,
    );
    if let Some((p50, p99)) = summary.latency_ms {
        let _ = writeln!(text, "  step latency p50 {p50:.3} ms, p99 {p99:.3} ms");
    }
    text
}

fn statistics(label: String, values: &Statistics) -> Vec<String> {
    let Statistics { mean, std, min, median, max, .. } = values;
    let numbers = [mean, std, min, median, max].map(|value| number(*value));
    std::iter::once(label).chain(numbers).collect()
}

fn label(metric: &str) -> String {
    match metric {
        "position_level" => "position level".into(),
        "own_position_level" => "position level in its own set".into(),
        "state_level" => "state level".into(),
        "true_position_level" => "true position level".into(),
        "final_distance_m" => "final distance [m]".into(),
        "fuel_flown_m_s" => "fuel flown [m/s]".into(),
        "disturbance_gauge" => "largest disturbance gauge".into(),
        other => other.replace('_', " "),
    }
}

/// One plan in full.
pub(super) fn plan(row: &PlanRow) -> String {
    let mut text = format!("{}\n", heading(row));
    let planned = match &row.answer {
        PlanAnswer::Plan(planned) => planned,
        PlanAnswer::Infeasible(why) => {
            let _ = writeln!(text, "  no plan exists: {}", why.reason);
            return text;
        }
    };
    text.push_str(&axes(row, planned));
    let plan = &planned.plan;
    let weight = Asked::new(&row.mission).fuel_weight;
    let _ = writeln!(
        text,
        "  objective {} = trace {} + {weight} x fuel {} m/s",
        number(plan.objective),
        number(plan.trace),
        number(plan.fuel_m_s),
    );
    let _ = writeln!(text, "  all corrections together at most {} m/s", number(plan.effort_m_s));
    if let Some(how) = &plan.diagnostics {
        let least = number(how.delta_v_max_least_m_s);
        let _ = writeln!(text, "  least bound on a burn with which a plan exists: {least} m/s");
    }
    let _ = write!(text, "\n{}", burns(plan));
    if let Some(proof) = &plan.certificate {
        let _ = write!(text, "\n{}", certificate(proof, plan.diagnostics.as_ref()));
    }
    let _ = writeln!(text, "\n  plan {}", planned.plan_id);
    text
}

fn heading(row: &PlanRow) -> String {
    let asked = Asked::new(&row.mission);
    format!(
        "{} {}: {} instants in {} s, at most {} m/s an axis, metric {}",
        row.mission.name,
        row.mission.label(),
        asked.instants.unwrap_or(0),
        asked.duration_s.unwrap_or(f64::NAN),
        asked.delta_v_max_m_s.unwrap_or(f64::NAN),
        metric_name(row.mission.metric()),
    )
}

/// Semi-axes of the arrival sets.
fn axes(row: &PlanRow, planned: &Planned) -> String {
    let list = |axes: &[f64]| axes.iter().map(|axis| number(*axis)).collect::<Vec<_>>().join("  ");
    let plain = |axes: Option<[f64; 2]>| {
        axes.map_or_else(String::new, |[longer, shorter]| format!("{longer}  {shorter}"))
    };
    let published = &row.mission.published;
    // The paper's figures are in its own metric, whatever this plan's.
    let paper = row.mission.table_metric().filter(|_| published.feedback_axes_m.is_some());
    let paper = paper.map_or_else(String::new, |metric| {
        format!("published, in plane ({})", metric_name(metric))
    });
    let titles = ["arrival set, semi-axes [m]", "in plane", "in space"].map(str::to_owned);
    let mut lines = vec![titles.into_iter().chain([paper]).collect::<Vec<_>>()];
    if let Some(set) = &planned.plan.arrival {
        lines.push(vec![
            "with feedback".into(),
            list(&set.in_plane_semi_axes_m),
            list(&set.position_semi_axes_m),
            plain(published.feedback_axes_m),
        ]);
    }
    if let Some(set) = &planned.plan.open_loop_arrival {
        lines.push(vec![
            "open loop".into(),
            list(&set.in_plane_semi_axes_m),
            list(&set.position_semi_axes_m),
            plain(published.open_loop_axes_m),
        ]);
    }
    align(&lines)
}

fn burns(plan: &v1::DisturbanceFeedbackPlan) -> String {
    let three = |values: &[f64], decimals: usize| {
        let each = values.iter().map(|value| format!("{value:>10.decimals$}"));
        each.collect::<Vec<_>>().join("")
    };
    let with_epochs = plan.burns.iter().any(|burn| !burn.epoch.is_empty());
    let mut titles = vec!["burn".to_owned(), "time [s]".to_owned()];
    if with_epochs {
        titles.push("epoch".into());
    }
    let columns = ["delta-v x, y, z [m/s]", "corrections at most [m/s]", "margin [m/s]"];
    titles.extend(columns.map(str::to_owned));
    let mut lines = vec![titles];
    for (k, burn) in plan.burns.iter().enumerate() {
        let mut line = vec![k.to_string(), format!("{:.3}", burn.elapsed_s)];
        if with_epochs {
            line.push(burn.epoch.clone());
        }
        line.push(three(&burn.delta_v_m_s, 5));
        line.push(three(&burn.correction_max_m_s, 5));
        let least = burn.saturation_margin_m_s.iter().copied().fold(f64::INFINITY, f64::min);
        line.push(format!("{least:.5}"));
        lines.push(line);
    }
    align(&lines)
}

fn certificate(proof: &v1::PlanCertificate, how: Option<&v1::PlanDiagnostics>) -> String {
    let passed = if proof.passed { "passed" } else { "NOT PASSED" };
    let optimal = match proof.optimality() {
        v1::Optimality::FixedHorizon => "proved optimal",
        _ => "feasible, not proved optimal",
    };
    let found = how.map_or_else(String::new, |how| {
        if how.fast_path {
            "; found in closed form with one linear program".into()
        } else {
            format!("; found by the conic solver in {} iterations", how.conic_iterations)
        }
    });
    format!(
        "  certificate {passed}, recomputed without the solver: {optimal}, relative gap \
         {:.1e}{found}\n  trace {}; end of the nominal trajectory off by {:.1e} of the mission's \
         size; least margin of a burn {:.5} m/s\n",
        proof.relative_gap,
        number(proof.trace),
        proof.dynamics_residual_nd,
        proof.saturation_margin_m_s,
    )
}

/// A line a plan, ours / published.
pub(super) fn rows(rows: &[PlanRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let mut text = format!("{}: plans in metric {}", first.mission.name, {
        metric_name(first.mission.metric())
    });
    let sources: Vec<&str> = rows.iter().map(|row| row.mission.published.source.as_str()).collect();
    match sources.iter().find(|source| !source.is_empty()) {
        Some(source) => {
            let _ = writeln!(text, "; ours / published ({source})");
        }
        None => text.push('\n'),
    }
    let titles = [
        "variant",
        "time [s]",
        "N",
        "bound [m/s]",
        "feedback, longer [m]",
        "shorter [m]",
        "open loop, longer [m]",
        "shorter [m]",
        "fuel [m/s]",
        "proof",
    ];
    let mut lines = vec![titles.map(str::to_owned).to_vec()];
    let mut reasons = String::new();
    for row in rows {
        let asked = Asked::new(&row.mission);
        let mut line = vec![
            row.mission.label().to_owned(),
            asked.duration_s.map_or_else(String::new, |time| time.to_string()),
            asked.instants.map_or_else(String::new, |count| count.to_string()),
            asked.delta_v_max_m_s.map_or_else(String::new, |bound| bound.to_string()),
        ];
        match &row.answer {
            PlanAnswer::Plan(planned) => line.extend(row_cells(row, planned)),
            PlanAnswer::Infeasible(why) => {
                line.push("no plan".into());
                let _ = writeln!(reasons, "  {}: {}", row.mission.label(), why.reason);
            }
        }
        lines.push(line);
    }
    text.push_str(&align(&lines));
    text.push_str(&reasons);
    text
}

fn row_cells(row: &PlanRow, planned: &Planned) -> Vec<String> {
    let plan = &planned.plan;
    let published = &row.mission.published;
    let beside = |ours: Option<&v1::ArrivalSet>, paper: Option<[f64; 2]>| {
        [0, 1].map(|axis| {
            let ours = ours.and_then(|set| set.in_plane_semi_axes_m.get(axis));
            let ours = ours.map_or_else(|| "-".to_owned(), |axis| format!("{axis:.3}"));
            match paper {
                Some(paper) => format!("{ours} / {}", paper[axis]),
                None => ours,
            }
        })
    };
    let proof = plan.certificate.as_ref();
    let proof = match proof.map(|proof| (proof.passed, proof.optimality())) {
        Some((true, v1::Optimality::FixedHorizon)) => "optimal",
        Some((true, _)) => "feasible",
        Some((false, _)) | None => "NOT PASSED",
    };
    let feedback = beside(plan.arrival.as_ref(), published.feedback_axes_m);
    let open_loop = beside(plan.open_loop_arrival.as_ref(), published.open_loop_axes_m);
    let fuel = format!("{:.4}", plan.fuel_m_s);
    feedback.into_iter().chain(open_loop).chain([fuel, proof.to_owned()]).collect()
}
