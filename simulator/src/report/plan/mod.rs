//! What plans promise and what their flights showed.

mod table;

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
};

use serde_json::{Map, Value, json};
use vbar_proto::v1;

use super::{Statistics, latency_ms};
use crate::{
    campaign::plan::{FlownBurn, PlanAnswer, PlanCampaign, PlanFlight, PlanRow, PlanSample},
    mission::{PlanMission, metric_name, plan::PlanTruth},
};

/// Everything flown in answer to one call of [`crate::fly_plans`].
#[derive(Debug, Clone)]
pub struct PlanReport {
    /// The mission as its file says.
    pub mission: PlanMission,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Flights of each plan.
    pub runs: u32,
    /// One per plan flown.
    pub campaigns: Vec<PlanCampaign>,
    /// The mission's table; only with pictures.
    pub table: Vec<PlanRow>,
}

impl PlanReport {
    /// An aligned text table, published figures beside ours.
    #[must_use]
    pub fn table(&self) -> String {
        table::report(self)
    }

    /// For programs: `mission`, `seed`, `runs`, the keys of the first plan flown, and `plans`:
    /// one object a plan, named by its variant (`problem` for the mission's own).
    ///
    /// Of each plan, beside what [`plan_rows_json`] says of it:
    ///
    /// - `runs`, and `inside_arrival_set`: runs whose measured position arrived inside the set;
    /// - `position_level`, `state_level`: `sqrt(e' Q^-1 e)` of the measured error in the
    ///   guaranteed set, of position alone and of the whole state; at most 1 inside;
    /// - `true_position_level`, `final_distance_m`: of the true position;
    /// - `fuel_flown_m_s`: sum of |delta-v| over burns and axes;
    /// - `burns`, `clipped_burns`, `clipped_runs`;
    /// - `disturbance_gauge`: the largest of each run in the measure of the assumed set, and
    ///   `outside_assumed_set_runs`: runs in which it exceeded 1, which voids the guarantee;
    /// - `open_loop`: the nominal burns alone from the same starts: `inside_arrival_set` (the set
    ///   guaranteed with feedback), `position_level` in it, `final_distance_m`, and
    ///   `own_position_level` in the set predicted without feedback;
    /// - `step_latency_ms`.
    ///
    /// Every level, distance and fuel has `mean`, `std`, `min`, `q25`, `median`, `q75`, `max`.
    #[must_use]
    pub fn json(&self) -> Value {
        let mut top = Map::new();
        top.insert("mission".into(), self.mission.name.clone().into());
        top.insert("seed".into(), self.seed.into());
        let truth = match self.mission.simulation.truth {
            PlanTruth::TwoBody { j2: true } => "two_body_j2",
            PlanTruth::TwoBody { j2: false } => "two_body",
        };
        top.insert("truth".into(), truth.into());
        let mut plans = Map::new();
        for campaign in &self.campaigns {
            let mut map = row_json(&campaign.row);
            if !campaign.flights.is_empty() {
                map.extend(PlanSummary::new(campaign).json());
            }
            if plans.is_empty() {
                top.extend(map.clone());
            }
            plans.insert(campaign.row.mission.label().into(), map.into());
        }
        top.insert("runs".into(), self.runs.into());
        top.insert("plans".into(), plans.into());
        if !self.table.is_empty() {
            top.insert("table".into(), plan_rows_json(&self.table));
        }
        top.into()
    }

    /// Writes one CSV file per plan, one line a run, and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_runs(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        fs::create_dir_all(folder)?;
        let mut written = Vec::new();
        for campaign in self.campaigns.iter().filter(|campaign| !campaign.flights.is_empty()) {
            let name = format!("{}_{}_runs.csv", self.mission.name, campaign.row.mission.label());
            let path = folder.join(name);
            fs::write(&path, runs_csv(&campaign.flights))?;
            written.push(path);
        }
        Ok(written)
    }

    /// Writes one CSV file per run, one line an instant, and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_traces(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        fs::create_dir_all(folder)?;
        let mut written = Vec::new();
        for campaign in &self.campaigns {
            let label = campaign.row.mission.label();
            for flight in &campaign.flights {
                let name = format!("{}_{label}_{:05}.csv", self.mission.name, flight.run);
                let path = folder.join(name);
                fs::write(&path, trace_csv(flight))?;
                written.push(path);
            }
        }
        Ok(written)
    }
}

/// The figures of one plan's flights.
#[derive(Debug, Clone)]
pub struct PlanSummary {
    /// Flights.
    pub runs: usize,
    /// Whose measured position arrived inside the guaranteed set.
    pub inside: usize,
    /// Levels, distances and fuel by their name in the report.
    pub metrics: Vec<(&'static str, Statistics)>,
    /// Burns of all runs.
    pub burns: usize,
    /// Burns that were clipped.
    pub clipped_burns: usize,
    /// Runs with a clipped burn.
    pub clipped_runs: usize,
    /// Runs with a disturbance outside the assumed set.
    pub outside_assumed_set_runs: usize,
    /// Runs whose nominal burns alone arrive inside the set guaranteed with feedback.
    pub open_loop_inside: usize,
    /// The same metrics of the nominal burns alone.
    pub open_loop_metrics: Vec<(&'static str, Statistics)>,
    /// Steps' p50 and p99 as the client sees them, ms.
    pub latency_ms: Option<(f64, f64)>,
}

impl PlanSummary {
    /// Sums a campaign up.
    #[must_use]
    pub fn new(campaign: &PlanCampaign) -> Self {
        let flights = &campaign.flights;
        let count = |holds: fn(&PlanFlight) -> bool| flights.iter().filter(|f| holds(f)).count();
        let over = |value: fn(&PlanFlight) -> f64| Statistics::of(flights.iter().map(value));
        let some = |value: fn(&PlanFlight) -> Option<f64>| {
            Statistics::of(flights.iter().filter_map(value))
        };
        let metrics = [
            ("position_level", over(|flight| flight.position_level)),
            ("state_level", over(|flight| flight.state_level)),
            ("true_position_level", over(|flight| flight.true_position_level)),
            ("final_distance_m", over(|flight| flight.final_distance_m)),
            ("fuel_flown_m_s", over(PlanFlight::fuel_m_s)),
            ("disturbance_gauge", some(PlanFlight::largest_disturbance_gauge)),
        ];
        let open_loop_metrics = [
            ("position_level", over(|flight| flight.open_loop.position_level)),
            ("own_position_level", some(|flight| flight.open_loop.own_position_level)),
            ("final_distance_m", over(|flight| flight.open_loop.final_distance_m)),
        ];
        let present = |(name, statistics): (&'static str, Option<Statistics>)| {
            statistics.map(|statistics| (name, statistics))
        };
        Self {
            runs: flights.len(),
            inside: count(PlanFlight::inside),
            metrics: metrics.into_iter().filter_map(present).collect(),
            burns: flights.iter().map(|flight| flight.burns.len()).sum(),
            clipped_burns: flights.iter().map(PlanFlight::clipped_burns).sum(),
            clipped_runs: count(|flight| flight.clipped_burns() > 0),
            outside_assumed_set_runs: count(|flight| flight.outside_assumed_set),
            open_loop_inside: count(|flight| flight.open_loop.inside()),
            open_loop_metrics: open_loop_metrics.into_iter().filter_map(present).collect(),
            latency_ms: latency_ms(flights.iter().flat_map(|flight| &flight.latencies).copied()),
        }
    }

    /// A metric by its name in the report.
    #[must_use]
    pub fn metric(&self, name: &str) -> Option<&Statistics> {
        self.metrics.iter().find(|(known, _)| *known == name).map(|(_, statistics)| statistics)
    }

    fn json(&self) -> Map<String, Value> {
        let statistics = |metrics: &[(&str, Statistics)]| -> Map<String, Value> {
            metrics.iter().map(|(name, values)| ((*name).to_owned(), values.json())).collect()
        };
        let mut map = statistics(&self.metrics);
        let mut open_loop = statistics(&self.open_loop_metrics);
        open_loop.insert("inside_arrival_set".into(), self.open_loop_inside.into());
        let (p50, p99) = self.latency_ms.unzip();
        let counts = [
            ("runs", self.runs.into()),
            ("inside_arrival_set", self.inside.into()),
            ("burns", self.burns.into()),
            ("clipped_burns", self.clipped_burns.into()),
            ("clipped_runs", self.clipped_runs.into()),
            ("outside_assumed_set_runs", self.outside_assumed_set_runs.into()),
            ("open_loop", open_loop.into()),
            ("step_latency_ms", json!({ "p50": p50, "p99": p99 })),
        ];
        map.extend(counts.map(|(name, value)| (name.to_owned(), value)));
        map
    }
}

/// One plan as text: sets, objective, burns, proof; or why there is none.
#[must_use]
pub fn plan_text(row: &PlanRow) -> String {
    table::plan(row)
}

/// Plans as a text table: a line each, the paper's figures beside ours.
#[must_use]
pub fn plan_rows_text(rows: &[PlanRow]) -> String {
    table::rows(rows)
}

/// Plans as JSON, an object each: `variant` (null for the mission's own problem), `duration_s`,
/// `instants`, `delta_v_max_m_s`, `metric`; then either `infeasible` with its `reason` and
/// `relaxations`, or `plan_id`, `in_plane_semi_axes_m`, `position_semi_axes_m`,
/// `open_loop_in_plane_semi_axes_m`, `objective`, `trace`, `fuel_m_s`, `effort_m_s`,
/// `delta_v_max_least_m_s`, `fast_path`, `certificate`; and `published`.
#[must_use]
pub fn plan_rows_json(rows: &[PlanRow]) -> Value {
    rows.iter().map(|row| Value::from(row_json(row))).collect()
}

fn row_json(row: &PlanRow) -> Map<String, Value> {
    let mut map = Map::new();
    let mut put = |key: &str, value: Value| {
        map.insert(key.into(), value);
    };
    let asked = Asked::new(&row.mission);
    put("variant", row.mission.variant.clone().into());
    put("duration_s", asked.duration_s.into());
    put("instants", asked.instants.into());
    put("delta_v_max_m_s", asked.delta_v_max_m_s.into());
    put("metric", metric_name(row.mission.metric()).into());
    match &row.answer {
        PlanAnswer::Infeasible(why) => {
            let relaxation = |relaxation: &v1::Relaxation| {
                let family = relaxation.family().as_str_name();
                json!({ "family": family, "amount_nd": relaxation.amount_nd,
                "amount_m_s": relaxation.amount_m_s })
            };
            let relaxations: Vec<Value> = why.relaxations.iter().map(relaxation).collect();
            put("infeasible", json!({ "reason": why.reason, "relaxations": relaxations }));
        }
        PlanAnswer::Plan(planned) => {
            let plan = &planned.plan;
            put("plan_id", planned.plan_id.clone().into());
            let arrival = plan.arrival.clone().unwrap_or_default();
            put("in_plane_semi_axes_m", arrival.in_plane_semi_axes_m.into());
            put("position_semi_axes_m", arrival.position_semi_axes_m.into());
            let open_loop = plan.open_loop_arrival.as_ref();
            let axes = open_loop.map(|set| set.in_plane_semi_axes_m.clone());
            put("open_loop_in_plane_semi_axes_m", axes.into());
            put("objective", plan.objective.into());
            put("trace", plan.trace.into());
            put("fuel_m_s", plan.fuel_m_s.into());
            put("effort_m_s", plan.effort_m_s.into());
            let found = plan.diagnostics.as_ref();
            put("delta_v_max_least_m_s", found.map(|how| how.delta_v_max_least_m_s).into());
            put("fast_path", found.map(|how| how.fast_path).into());
            put("certificate", plan.certificate.as_ref().map(certificate_json).into());
        }
    }
    let published = &row.mission.published;
    if !published.source.is_empty() {
        let figures = json!({
            "source": published.source,
            "in_plane_semi_axes_m": published.feedback_axes_m,
            "open_loop_in_plane_semi_axes_m": published.open_loop_axes_m,
        });
        put("published", figures);
    }
    map
}

fn certificate_json(proof: &v1::PlanCertificate) -> Value {
    json!({
        "passed": proof.passed,
        "trace": proof.trace,
        "dynamics_residual_nd": proof.dynamics_residual_nd,
        "saturation_margin_m_s": proof.saturation_margin_m_s,
        "objective_lower_bound": proof.objective_lower_bound,
        "relative_gap": proof.relative_gap,
        "optimality": proof.optimality().as_str_name(),
        "matrix_inequality_margin": proof.matrix_inequality_margin,
    })
}

/// What was asked, in numbers.
struct Asked {
    duration_s: Option<f64>,
    instants: Option<usize>,
    delta_v_max_m_s: Option<f64>,
    fuel_weight: f64,
}

impl Asked {
    fn new(mission: &PlanMission) -> Self {
        let model = mission.model().ok();
        let times = model.as_ref().map(|model| &model.elapsed_s);
        Self {
            duration_s: times.and_then(|times| times.last().copied()),
            instants: times.map(Vec::len),
            delta_v_max_m_s: model.as_ref().map(|model| model.delta_v_max_m_s),
            fuel_weight: mission.fuel_weight(),
        }
    }
}

const SIX: [&str; 6] = ["x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"];

/// One line a run.
fn runs_csv(flights: &[PlanFlight]) -> String {
    let mut text = String::from(
        "run,position_level,state_level,true_position_level,final_distance_m,fuel_flown_m_s,\
         clipped_burns,disturbance_gauge,outside_assumed_set,open_loop_position_level,\
         open_loop_final_distance_m\n",
    );
    for flight in flights {
        let gauge = flight.largest_disturbance_gauge().map_or_else(String::new, |g| g.to_string());
        // Writing into a String cannot fail.
        let _ = writeln!(
            text,
            "{},{:e},{:e},{:e},{:e},{:e},{},{gauge},{},{:e},{:e}",
            flight.run,
            flight.position_level,
            flight.state_level,
            flight.true_position_level,
            flight.final_distance_m,
            flight.fuel_m_s(),
            flight.clipped_burns(),
            flight.outside_assumed_set,
            flight.open_loop.position_level,
            flight.open_loop.final_distance_m,
        );
    }
    text
}

/// One line an instant: true and measured state, burn, and what the service saw; LVLH.
fn trace_csv(flight: &PlanFlight) -> String {
    let mut text = String::from("k,elapsed_s");
    let columns = |text: &mut String, name: &str, parts: &[&str]| {
        for part in parts {
            let _ = write!(text, ",{name}_{part}");
        }
    };
    columns(&mut text, "true", &SIX);
    columns(&mut text, "measured", &SIX);
    for name in ["delta_v", "nominal", "correction"] {
        columns(&mut text, name, &["x_m_s", "y_m_s", "z_m_s"]);
    }
    text.push_str(",clipped,deviation_gauge,disturbance_gauge\n");
    for (k, sample) in flight.samples.iter().enumerate() {
        trace_line(&mut text, k, sample, flight.burns.get(k));
        // The disturbance seen at instant k acted between k - 1 and k.
        let gauge = k.checked_sub(1).and_then(|before| flight.disturbance_gauges.get(before));
        let _ = writeln!(text, ",{}", gauge.map_or_else(String::new, |gauge| format!("{gauge:e}")));
    }
    text
}

fn trace_line(text: &mut String, k: usize, sample: &PlanSample, burn: Option<&FlownBurn>) {
    let _ = write!(text, "{k},{}", sample.elapsed_s);
    for value in sample.truth.iter().chain(&sample.measured) {
        let _ = write!(text, ",{value:e}");
    }
    match burn {
        // Three vectors, two flags.
        None => text.push_str(&",".repeat(11)),
        Some(burn) => {
            let parts = [burn.delta_v_m_s, burn.nominal_m_s, burn.correction_m_s];
            for value in parts.as_flattened() {
                let _ = write!(text, ",{value:e}");
            }
            let _ = write!(text, ",{},{:e}", burn.clipped, burn.deviation_gauge);
        }
    }
}
