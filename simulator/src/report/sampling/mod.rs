//! What flights under sampled chance constraints showed.

mod table;

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
};

use serde_json::{Map, Value, json};

use super::{Statistics, latency_ms};
use crate::{
    campaign::sampling::{SamplingCampaign, SamplingFlight, SamplingOutcome, SamplingStep},
    mission::{SamplingMission, sampling_scheme_name},
};

/// Everything flown in answer to one call of [`crate::fly_sampling`].
#[derive(Debug, Clone)]
pub struct SamplingReport {
    /// The mission as it was flown.
    pub mission: SamplingMission,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Flights from each start.
    pub repetitions: u32,
    /// One per controller, the mission's own first.
    pub campaigns: Vec<SamplingCampaign>,
}

impl SamplingReport {
    /// An aligned text table, published figures beside ours.
    #[must_use]
    pub fn table(&self) -> String {
        table::render(self)
    }

    /// For programs: `mission`, `variant`, `seed`, `repetitions` and `controllers`, an object each
    /// by name, with either `infeasible` (the reason why there is no such controller) or
    ///
    /// - `artifact`: `sampled_rows`, `kept_rows`, `removed_excess`, `first_step_rows`,
    ///   `joint_confidence`, of the sampled controller;
    /// - the figures of all flights and, in `starts`, those from each start: `flights`, `docked`,
    ///   `infeasible`, `steps_exhausted`, `without_first_step_set` (flights from starts that the
    ///   first-step set excludes), `time_to_dock_s` and `control_effort_ns` (over the flights that
    ///   docked, with `mean`, `std`, `min`, `q25`, `median`, `q75`, `max`), `steps`, `tail_steps`
    ///   (commands without guarantee), `uncertified_steps`, `input_violations`,
    ///   `worst_violation` (`row` and `share` of the state constraint violated most often, over
    ///   all samples after the start; the problem's `epsilon` beside it), `largest_angle_deg` and
    ///   `step_latency_ms`.
    ///
    /// `published` has the paper's figures.
    #[must_use]
    pub fn json(&self) -> Value {
        let mut controllers = Map::new();
        for campaign in &self.campaigns {
            let name = sampling_scheme_name(campaign.scheme);
            controllers.insert(name.into(), self.campaign_json(campaign));
        }
        let published = &self.mission.published;
        json!({
            "mission": self.mission.name,
            "variant": self.mission.variant,
            "seed": self.seed,
            "repetitions": self.repetitions,
            "controllers": controllers,
            "published": {
                "source": published.source,
                "control_effort_ns": published.control_effort_ns,
                "time_to_dock_s": published.time_to_dock_s,
            },
        })
    }

    fn campaign_json(&self, campaign: &SamplingCampaign) -> Value {
        let artifact = match &campaign.prepared {
            Err(reason) => return json!({ "infeasible": reason }),
            Ok(artifact) => artifact,
        };
        let mut map = self.summary(campaign, None).json();
        let starts = self.starts().map(|start| {
            (start.to_owned(), Value::from(self.summary(campaign, Some(start)).json()))
        });
        map.insert("starts".into(), starts.collect::<Map<_, _>>().into());
        map.insert(
            "artifact".into(),
            json!({
                "sampled_rows": artifact.sampled_rows,
                "kept_rows": artifact.kept_rows,
                "removed_excess": artifact.removed_excess,
                "first_step_rows": artifact.first_step_rows,
                "joint_confidence": artifact.joint_confidence,
            }),
        );
        map.into()
    }

    /// Names of the starts, in the mission's order.
    fn starts(&self) -> impl Iterator<Item = &str> {
        self.mission.simulation.starts.iter().map(|start| start.name.as_str())
    }

    /// Sums up a controller's flights, from one start or from all.
    #[must_use]
    pub fn summary(&self, campaign: &SamplingCampaign, start: Option<&str>) -> SamplingSummary {
        let from = |flight: &&SamplingFlight| start.is_none_or(|start| flight.start == start);
        let flights: Vec<&SamplingFlight> = campaign.flights.iter().filter(from).collect();
        let model = self.mission.model();
        let (rows, violation) =
            model.map_or((Vec::new(), None), |model| (model.row_names, model.violation));
        SamplingSummary::new(&flights, &rows, violation)
    }

    /// Writes one CSV file per run and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_traces(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        fs::create_dir_all(folder)?;
        let mut written = Vec::new();
        for campaign in &self.campaigns {
            let scheme = sampling_scheme_name(campaign.scheme).to_lowercase();
            for flight in &campaign.flights {
                let run = format!("{scheme}_{}_{:05}", flight.start, flight.run);
                let path = folder.join(format!("{}_{run}.csv", self.mission.name));
                fs::write(&path, csv(flight))?;
                written.push(path);
            }
        }
        Ok(written)
    }
}

/// The figures of some flights under one controller.
#[derive(Debug, Clone, PartialEq)]
pub struct SamplingSummary {
    /// Flights.
    pub flights: usize,
    /// That came within the docking distance.
    pub docked: usize,
    /// That ended because no command was possible.
    pub infeasible: usize,
    /// That took longer than the mission allows.
    pub steps_exhausted: usize,
    /// Flown without the first-step set, because it excludes their start.
    pub without_first_step_set: usize,
    /// Of the flights that docked.
    pub time_to_dock_s: Option<Statistics>,
    /// Sum of |force| times the sample time; of the flights that docked.
    pub control_effort_ns: Option<Statistics>,
    /// Commands.
    pub steps: usize,
    /// Commands of a previous plan's tail.
    pub tail_steps: usize,
    /// Commands whose certificate did not pass.
    pub uncertified_steps: usize,
    /// Commands outside the input constraints.
    pub input_violations: usize,
    /// The state constraint that was violated most often and in which share of all samples after
    /// the start; none if none ever was.
    pub worst_violation: Option<(String, f64)>,
    /// The share that the problem allows.
    pub violation_allowed: Option<f64>,
    /// The largest angle in the second half of a flight.
    pub largest_angle_deg: Option<f64>,
    /// Steps' p50 and p99 as the client sees them, ms.
    pub latency_ms: Option<(f64, f64)>,
}

/// A command further outside its constraints than this counts, N.
const INPUT_TOLERANCE_N: f64 = 1e-8;

impl SamplingSummary {
    fn new(flights: &[&SamplingFlight], rows: &[String], violation: Option<f64>) -> Self {
        let docked = || flights.iter().filter(|flight| flight.docked());
        let steps = || flights.iter().flat_map(|flight| &flight.steps);
        let count = |holds: fn(&SamplingStep) -> bool| steps().filter(|step| holds(step)).count();
        let ended = |holds: fn(&SamplingOutcome) -> bool| {
            flights.iter().filter(|flight| holds(&flight.outcome)).count()
        };
        let angles = flights.iter().filter_map(|f| f.largest_angle_deg(0.5 * f.duration_s()));
        Self {
            flights: flights.len(),
            docked: docked().count(),
            infeasible: ended(|outcome| matches!(outcome, SamplingOutcome::Infeasible(_))),
            steps_exhausted: ended(|outcome| *outcome == SamplingOutcome::StepsExhausted),
            without_first_step_set: flights.iter().filter(|f| f.excluded_start).count(),
            time_to_dock_s: Statistics::of(docked().map(|flight| flight.duration_s())),
            control_effort_ns: Statistics::of(docked().map(|flight| flight.effort_ns())),
            steps: steps().count(),
            tail_steps: flights.iter().map(|flight| flight.tail_steps()).sum(),
            uncertified_steps: count(|step| !step.certified),
            input_violations: count(|step| step.input_margin_n < -INPUT_TOLERANCE_N),
            worst_violation: worst_violation(flights, rows),
            violation_allowed: violation,
            largest_angle_deg: angles.reduce(f64::max),
            latency_ms: latency_ms(steps().map(|step| step.latency)),
        }
    }

    fn json(&self) -> Map<String, Value> {
        let (p50, p99) = self.latency_ms.unzip();
        let worst =
            self.worst_violation.as_ref().map(|(row, share)| json!({ "row": row, "share": share }));
        let members = [
            ("flights", self.flights.into()),
            ("docked", self.docked.into()),
            ("infeasible", self.infeasible.into()),
            ("steps_exhausted", self.steps_exhausted.into()),
            ("without_first_step_set", self.without_first_step_set.into()),
            ("time_to_dock_s", self.time_to_dock_s.as_ref().map(Statistics::json).into()),
            ("control_effort_ns", self.control_effort_ns.as_ref().map(Statistics::json).into()),
            ("steps", self.steps.into()),
            ("tail_steps", self.tail_steps.into()),
            ("uncertified_steps", self.uncertified_steps.into()),
            ("input_violations", self.input_violations.into()),
            ("worst_violation", worst.into()),
            ("epsilon", self.violation_allowed.into()),
            ("largest_angle_deg", self.largest_angle_deg.into()),
            ("step_latency_ms", json!({ "p50": p50, "p99": p99 })),
        ];
        members.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }
}

/// The row that is violated in the largest share of all samples after the start.
fn worst_violation(flights: &[&SamplingFlight], rows: &[String]) -> Option<(String, f64)> {
    let samples: usize = flights.iter().map(|flight| flight.steps.len()).sum();
    let counts = flights.iter().map(|flight| flight.violations()).reduce(|mut sum, counts| {
        sum.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
        sum
    })?;
    let (row, count) = counts.into_iter().enumerate().max_by_key(|(_, count)| *count)?;
    let name = rows.get(row).cloned().unwrap_or_else(|| row.to_string());
    (count > 0).then(|| (name, count as f64 / samples as f64))
}

/// One line a sample: state, distance, violated rows; and the command given there, if any.
fn csv(flight: &SamplingFlight) -> String {
    let states = flight.samples.first().map_or(0, |sample| sample.state.len());
    let inputs = flight.steps.first().map_or(0, |step| step.command_n.len());
    let numbered = |name: &str, count: usize| -> String {
        (0..count).map(|i| format!(",{name}{i}")).collect()
    };
    let mut text = format!(
        "k,elapsed_s{},distance_m,violated_rows,angle_deg{}{},branch,expected_cost\n",
        numbered("state", states),
        numbered("command_n", inputs),
        numbered("delivered_n", inputs),
    );
    for (k, sample) in flight.samples.iter().enumerate() {
        // Writing into a String cannot fail.
        let _ = write!(text, "{k},{}", k as f64 * flight.sample_time_s);
        for value in &sample.state {
            let _ = write!(text, ",{value:e}");
        }
        let violated = sample.violated.iter().filter(|violated| **violated).count();
        let angle = flight.attitude.get(k).map_or_else(String::new, |[angle, _]| angle.to_string());
        let _ = write!(text, ",{:e},{violated},{angle}", sample.distance_m);
        match flight.steps.get(k) {
            None => text.push_str(&",".repeat(2 * inputs + 2)),
            Some(step) => {
                for value in step.command_n.iter().chain(&step.delivered_n) {
                    let _ = write!(text, ",{value:e}");
                }
                let branch = step.branch.as_str_name().trim_start_matches("SAMPLING_BRANCH_");
                let _ = write!(text, ",{branch},{:e}", step.expected_cost);
            }
        }
        text.push('\n');
    }
    text
}
