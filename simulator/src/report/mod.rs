//! What a campaign showed: numbers for programs, a table for people, traces for other tools.

pub(crate) mod abort;
pub(crate) mod plan;
pub(crate) mod sampling;
mod statistics;
mod table;

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
    time::Duration,
};

use hdrhistogram::Histogram;
use serde_json::{Map, Value, json};
use vbar_proto::v1::{Branch, VariableHorizonScheme as Scheme};

use crate::{
    campaign::{Campaign, Flight, SweepPoint, flight::Outcome, search::SearchComparison},
    mission::{Mission, scheme_name},
};
pub use statistics::Statistics;

/// Everything flown in answer to one call of [`crate::simulate`].
#[derive(Debug, Clone)]
pub struct Report {
    /// The mission as it was flown, options applied.
    pub mission: Mission,
    /// Start of every stream of chance.
    pub seed: u64,
    /// One per scheme, the asked one first.
    pub campaigns: Vec<Campaign>,
    /// The single run that the pictures show step by step, per scheme.
    pub detailed: Vec<Campaign>,
    /// Fuel-weight sweep.
    pub sweep: Vec<SweepPoint>,
    /// LOCAL against ENUMERATION.
    pub comparison: Option<SearchComparison>,
}

impl Report {
    pub(crate) fn new(
        mission: Mission,
        seed: u64,
        campaigns: Vec<Campaign>,
        detailed: Vec<Campaign>,
        sweep: Vec<SweepPoint>,
        comparison: Option<SearchComparison>,
    ) -> Self {
        Self { mission, seed, campaigns, detailed, sweep, comparison }
    }

    /// An aligned text table, published figures beside ours.
    #[must_use]
    pub fn table(&self) -> String {
        table::render(self)
    }

    /// Canonical keys; those of the first scheme at the top level.
    #[must_use]
    pub fn json(&self) -> Value {
        let mut top = Map::new();
        top.insert("mission".into(), self.mission.name.clone().into());
        top.insert("seed".into(), self.seed.into());
        let summaries: Vec<Summary> = self.campaigns.iter().map(Summary::new).collect();
        if let Some(first) = summaries.first() {
            top.extend(first.json());
        }
        if summaries.len() > 1 {
            let mut schemes = Map::new();
            for summary in &summaries {
                schemes.insert(scheme_name(summary.scheme).into(), summary.json().into());
            }
            top.insert("schemes".into(), schemes.into());
            top.insert("relative_to_first".into(), relative(&summaries));
        }
        if !self.sweep.is_empty() {
            top.insert("fuel_weight_sweep".into(), sweep_json(&self.sweep));
        }
        if let Some(comparison) = &self.comparison {
            top.insert("search_comparison".into(), comparison_json(comparison));
        }
        let published = &self.mission.published;
        if !published.schemes.is_empty() {
            top.insert(
                "published".into(),
                json!({ "source": published.source, "schemes": published.schemes }),
            );
        }
        top.into()
    }

    /// Writes one CSV file per run and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_traces(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        fs::create_dir_all(folder)?;
        let mut written = Vec::new();
        for campaign in &self.campaigns {
            for flight in &campaign.flights {
                let scheme = scheme_name(campaign.scheme).to_lowercase();
                let name = format!("{}_{scheme}_{:05}.csv", self.mission.name, flight.run);
                let path = folder.join(name);
                fs::write(&path, csv(flight))?;
                written.push(path);
            }
        }
        Ok(written)
    }
}

/// The figures of one campaign.
#[derive(Debug, Clone)]
pub struct Summary {
    /// What was flown.
    pub scheme: Scheme,
    /// Runs.
    pub runs: usize,
    /// Starts refused as infeasible.
    pub redraws: u64,
    /// Runs that ended in an arrival.
    pub arrived: usize,
    /// Runs that ended because no command was possible.
    pub infeasible: usize,
    /// Runs with any sample or command outside its constraints.
    pub constraint_violations: usize,
    /// Runs that arrived outside the state constraints; a violation only where the problem imposes
    /// them at the arrival.
    pub arrived_outside: usize,
    /// Mean step of the first violation, over the runs that have one.
    pub first_violation_step: Option<f64>,
    /// Least margin to the state constraints over all runs, normalised; none without any.
    pub worst_margin: Option<f64>,
    /// The same in metres, taken run by run.
    pub worst_margin_m: Option<f64>,
    /// Least margin to the input constraints, normalised; 0 is a command at its bound.
    pub worst_input_margin: Option<f64>,
    /// The plant is measured in metres.
    pub in_metres: bool,
    /// Metrics by their name in the report.
    pub metrics: Vec<(&'static str, Statistics)>,
    /// Share of steps whose command came from the grown terminal set; only the adaptive scheme
    /// has one.
    pub fallback_share: Option<f64>,
    /// Commands in total.
    pub steps: usize,
    /// Commands whose certificate did not pass.
    pub uncertified_steps: usize,
    /// Steps at which the service saw a disturbance outside its assumed set.
    pub outside_assumed_set_steps: usize,
    /// Linear programs that the simplex gave up.
    pub general_solver_calls: i64,
    /// Steps' p50 and p99 as the client sees them, ms.
    pub latency_ms: Option<(f64, f64)>,
}

impl Summary {
    /// Sums a campaign up. Distances, fuel and times are over the runs that arrived.
    #[must_use]
    pub fn new(campaign: &Campaign) -> Self {
        let flights = &campaign.flights;
        let first: Vec<f64> =
            flights.iter().filter_map(|f| f.first_violation().map(|k| k as f64)).collect();
        let steps = || flights.iter().flat_map(|flight| &flight.steps);
        let count = steps().count();
        let fallback = steps().filter(|step| step.branch == Branch::TerminalSet).count();
        let in_metres =
            |flight: &Flight| Some(flight.worst_margin_nd()? * flight.position_unit_m()?);
        let adaptive = campaign.scheme == Scheme::AdaptiveTerminal && count > 0;
        Self {
            scheme: campaign.scheme,
            runs: flights.len(),
            redraws: flights.iter().map(|flight| u64::from(flight.redraws)).sum(),
            arrived: flights.iter().filter(|flight| flight.arrived()).count(),
            infeasible: flights
                .iter()
                .filter(|flight| matches!(flight.outcome, Outcome::Infeasible(_)))
                .count(),
            constraint_violations: first.len(),
            arrived_outside: flights.iter().filter(|flight| flight.arrived_outside()).count(),
            first_violation_step: Statistics::of(first).map(|s| s.mean),
            worst_margin: flights.iter().filter_map(Flight::worst_margin_nd).reduce(f64::min),
            worst_input_margin: flights
                .iter()
                .filter_map(Flight::worst_input_margin_nd)
                .reduce(f64::min),
            worst_margin_m: flights.iter().filter_map(in_metres).reduce(f64::min),
            in_metres: flights.iter().any(|flight| flight.position_unit_m().is_some()),
            metrics: metrics(campaign),
            fallback_share: adaptive.then(|| fallback as f64 / count as f64),
            steps: count,
            uncertified_steps: steps().filter(|step| !step.certified).count(),
            outside_assumed_set_steps: steps().filter(|step| step.outside_assumed_set).count(),
            general_solver_calls: steps().map(|step| i64::from(step.general_solver_calls)).sum(),
            latency_ms: latency_ms(steps().map(|step| step.latency)),
        }
    }

    /// A metric by its name in the report.
    #[must_use]
    pub fn metric(&self, name: &str) -> Option<&Statistics> {
        self.metrics.iter().find(|(known, _)| *known == name).map(|(_, statistics)| statistics)
    }

    fn json(&self) -> Map<String, Value> {
        let mut map = Map::new();
        let mut put = |key: &str, value: Value| {
            map.insert(key.into(), value);
        };
        put("scheme", scheme_name(self.scheme).into());
        put("runs", self.runs.into());
        put("redraws", self.redraws.into());
        put("arrived", self.arrived.into());
        put("infeasible", self.infeasible.into());
        // Means over the runs that arrived: null, not absent, where none did.
        let metres = self.in_metres;
        let distance = if metres { "final_distance_m" } else { "final_norm" };
        for name in [distance, "fuel", "delta_v_m_s", "completion_steps"] {
            if metres || name != "delta_v_m_s" {
                put(name, Value::Null);
            }
        }
        for (name, statistics) in &self.metrics {
            put(name, statistics.json());
        }
        put("constraint_violations", self.constraint_violations.into());
        put("arrived_outside", self.arrived_outside.into());
        put("first_violation_step", self.first_violation_step.into());
        put("worst_margin", self.worst_margin.into());
        put("worst_input_margin", self.worst_input_margin.into());
        put("worst_margin_m", self.worst_margin_m.into());
        put("fallback_share", self.fallback_share.into());
        put("steps", self.steps.into());
        put("uncertified_steps", self.uncertified_steps.into());
        put("outside_assumed_set_steps", self.outside_assumed_set_steps.into());
        put("general_solver_calls", self.general_solver_calls.into());
        let (p50, p99) = self.latency_ms.unzip();
        put("step_latency_ms", json!({ "p50": p50, "p99": p99 }));
        map
    }
}

fn metrics(campaign: &Campaign) -> Vec<(&'static str, Statistics)> {
    let flights = &campaign.flights;
    let arrived = || flights.iter().filter(|flight| flight.arrived());
    let metres = flights.iter().any(|flight| flight.position_unit_m().is_some());
    let (distance, radius) = match metres {
        true => ("final_distance_m", "final_set_radius_m"),
        false => ("final_norm", "final_set_radius"),
    };
    // The other schemes have no terminal point that is adapted.
    let adapts = matches!(campaign.scheme, Scheme::AdaptiveTerminal | Scheme::TubeOptimalControl);
    let last_horizon = |flight: &Flight| {
        flight.steps.last().filter(|_| adapts).map(|step| f64::from(step.adapted_horizon))
    };
    let all = [
        (distance, Statistics::of(arrived().map(Flight::final_distance))),
        ("fuel", Statistics::of(arrived().map(Flight::fuel))),
        ("delta_v_m_s", Statistics::of(arrived().filter_map(Flight::delta_v_m_s))),
        ("completion_steps", Statistics::of(arrived().map(|flight| flight.steps.len() as f64))),
        ("adapted_horizon", Statistics::of(arrived().filter_map(last_horizon))),
        (radius, Statistics::of(arrived().filter_map(|flight| flight.final_set_radius))),
    ];
    all.into_iter().filter_map(|(name, statistics)| Some((name, statistics?))).collect()
}

/// p50 and p99, ms; `None` of nothing.
fn latency_ms(latencies: impl IntoIterator<Item = Duration>) -> Option<(f64, f64)> {
    // Up to a minute in microseconds, three digits: always valid bounds.
    let mut histogram = Histogram::<u64>::new_with_bounds(1, 60_000_000, 3).ok()?;
    for latency in latencies {
        histogram.saturating_record(u64::try_from(latency.as_micros()).unwrap_or(u64::MAX));
    }
    let quantile = |q: f64| histogram.value_at_quantile(q) as f64 / 1e3;
    (!histogram.is_empty()).then(|| (quantile(0.5), quantile(0.99)))
}

/// JSON has no number for a mean over nothing.
fn finite(value: f64) -> Value {
    if value.is_finite() { value.into() } else { Value::Null }
}

/// Means of the other schemes over the first's, as in Table 1 of [Quartullo2025a], percent.
fn relative(summaries: &[Summary]) -> Value {
    let first = &summaries[0];
    let mut schemes = Map::new();
    for other in &summaries[1..] {
        let mut changes = Map::new();
        for (name, ours) in &first.metrics {
            if let Some(theirs) = other.metric(name).filter(|_| ours.mean != 0.0) {
                let percent = 100.0 * (theirs.mean / ours.mean - 1.0);
                changes.insert(format!("{name}_percent"), percent.into());
            }
        }
        schemes.insert(scheme_name(other.scheme).into(), changes.into());
    }
    schemes.into()
}

fn sweep_json(sweep: &[SweepPoint]) -> Value {
    let point = |point: &SweepPoint| {
        json!({
            "fuel_weight": point.fuel_weight, "fuel_mean": finite(point.fuel),
            "completion_steps_mean": finite(point.completion_steps), "arrived": point.arrived,
        })
    };
    sweep.iter().map(point).collect()
}

fn comparison_json(comparison: &SearchComparison) -> Value {
    json!({
        "runs": comparison.runs,
        "steps": comparison.steps,
        "different_branch": comparison.different_branch,
        "different_horizon": comparison.different_horizon,
        "different_cost": comparison.different_cost,
        "local_s": comparison.local.as_secs_f64(),
        "enumeration_s": comparison.enumeration.as_secs_f64(),
    })
}

/// One line a sample: state, reference, margin; and the command given there, if any.
fn csv(flight: &Flight) -> String {
    let sizes = (flight.samples.first(), flight.steps.first());
    let states = sizes.0.map_or(0, |sample| sample.state.len());
    let inputs = sizes.1.map_or(0, |step| step.input.len());
    let mut text = String::from("k");
    let numbered = |name: &str, count: usize| -> String {
        (0..count).map(|i| format!(",{name}{i}")).collect()
    };
    text.push_str(&numbered("state", states));
    text.push_str(&numbered("reference", states));
    text.push_str(",margin_nd");
    text.push_str(&numbered("input", inputs));
    text.push_str(",cost,horizon,branch\n");
    for (k, sample) in flight.samples.iter().enumerate() {
        // Writing into a String cannot fail.
        let _ = write!(text, "{k}");
        for value in sample.state.iter().chain(&sample.reference) {
            let _ = write!(text, ",{value:e}");
        }
        let margin = sample.margin_nd.map_or_else(String::new, |margin| format!("{margin:e}"));
        let _ = write!(text, ",{margin}");
        match flight.steps.get(k) {
            None => text.push_str(&",".repeat(inputs + 3)),
            Some(step) => {
                for value in &step.input {
                    let _ = write!(text, ",{value:e}");
                }
                let branch = step.branch.as_str_name().trim_start_matches("BRANCH_");
                let _ = write!(text, ",{:e},{},{branch}", step.cost, step.horizon);
            }
        }
        text.push('\n');
    }
    text
}
