//! What flights under abort-safe control showed.

mod summary;
mod table;

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
};

use serde_json::{Map, Value, json};

use crate::{
    campaign::abort::{AbortCampaign, AbortFlight, AbortOutcome, AbortSample, AbortStep, Origin},
    mission::AbortMission,
};
pub(crate) use summary::GAUGE_TOLERANCE;
pub use summary::{AbortSummary, DriftFigures, FailureFigures, PhaseFigures};

/// Everything flown in answer to one call of [`crate::fly_aborts`].
#[derive(Debug, Clone)]
pub struct AbortReport {
    /// The mission as its file says.
    pub mission: AbortMission,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Flights of each variant.
    pub runs: u32,
    /// One a variant, in the order flown.
    pub campaigns: Vec<AbortCampaign>,
}

/// Two variants, step by step.
#[derive(Debug, Clone, PartialEq)]
pub struct PathComparison {
    /// Names of both.
    pub variants: [String; 2],
    /// Steps that both flew.
    pub steps: usize,
    /// Largest distance between the two at the same step, over all runs.
    pub largest_distance_m: f64,
    /// Mean delta-v of each.
    pub delta_v_m_s: [f64; 2],
}

impl AbortReport {
    /// An aligned text table, figures of the paper and of the reference beside ours.
    #[must_use]
    pub fn table(&self) -> String {
        table::report(self)
    }

    /// For programs: `mission`, `seed`, `runs`, the keys of the first variant, and `variants`: one
    /// object a variant, by name.
    ///
    /// Of each variant:
    ///
    /// - `runs`, `arrived`, `infeasible`, `redraws`: runs by how they ended;
    /// - `delta_v_m_s` (sum of |force| over axes and steps, times the step over the mass), `steps`
    ///   and, with failures, `failure_step`, `failure_gauge`, `least_gauge_after_failure`,
    ///   `least_distance_after_failure_m`: each with `mean`, `std`, `min`, `q25`, `median`, `q75`,
    ///   `max`;
    /// - `steps_flown`, `softened_steps` (some half-space had to give way: the program was
    ///   infeasible), `abort_steps`, `uncertified_steps`;
    /// - `modes`: verdicts on the next state of every step, counted over failures: `inside` a
    ///   backward reachable set, abort `found`, `none_proved`, `undecided`;
    /// - `drifts`: by truth, what becomes of flown states under total failure: `states`,
    ///   `states_drifting_in`, `least_gauge` (at the instants looked at), `least_gauge_throughout`
    ///   (between them too), `least_distance_m`;
    /// - `failures`: `runs`, `runs_entering` the region, `runs_entering_feasible` (without a
    ///   softened step before), `runs_without_abort`;
    /// - `phases`: of each `kind`, `sets` kept, `sets_of_all_modes` there would be without mode dominance,
    ///   `modes` asked, `modes_kept`, `steps`, `time_s`,
    ///   `delta_v_m_s`, `softened_steps`, `begins_at_step`, `unsafe_at_step`, `safe_until_next`;
    /// - `warnings` of the artifact, `artifact_bytes`, `step_latency_ms`, and figures of others:
    ///   `published`, `reference`.
    ///
    /// `compared` has one object a pair of variants.
    #[must_use]
    pub fn json(&self) -> Value {
        let mut top = Map::new();
        top.insert("mission".into(), self.mission.name.clone().into());
        top.insert("seed".into(), self.seed.into());
        let mut variants = Map::new();
        for campaign in &self.campaigns {
            let map = variant_json(campaign);
            if variants.is_empty() {
                top.extend(map.clone());
            }
            variants.insert(campaign.case.name.clone(), map.into());
        }
        top.insert("runs".into(), self.runs.into());
        top.insert("variants".into(), variants.into());
        let compared = self.compared();
        if !compared.is_empty() {
            top.insert("compared".into(), compared.iter().map(comparison_json).collect());
        }
        let sources = &self.mission.published;
        top.insert(
            "sources".into(),
            json!({ "published": sources.source, "reference": sources.reference }),
        );
        top.into()
    }

    /// The pairs of variants that the mission compares, as far as they were flown.
    #[must_use]
    pub fn compared(&self) -> Vec<PathComparison> {
        let named = |name: &String| self.campaigns.iter().find(|one| one.case.name == *name);
        let pairs = &self.mission.simulation.compared;
        pairs.iter().filter_map(|[a, b]| Some(compare(named(a)?, named(b)?))).collect()
    }

    /// Writes one CSV file a variant, one line a run, and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_runs(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        self.write(folder, |campaign| {
            vec![(format!("{}_runs", campaign.case.name), runs_csv(campaign))]
        })
    }

    /// Writes one CSV file a run, one line a step, and returns their paths.
    ///
    /// # Errors
    /// When the folder or a file cannot be written.
    pub fn write_traces(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        self.write(folder, |campaign| {
            let trace = |flight: &AbortFlight| {
                let name = format!("{}_{:05}", campaign.case.name, flight.run);
                (name, trace_csv(flight, campaign))
            };
            campaign.flights.iter().map(trace).collect()
        })
    }

    fn write(
        &self,
        folder: &Path,
        files: impl Fn(&AbortCampaign) -> Vec<(String, String)>,
    ) -> io::Result<Vec<PathBuf>> {
        fs::create_dir_all(folder)?;
        let mut written = Vec::new();
        for (name, text) in self.campaigns.iter().flat_map(files) {
            let path = folder.join(format!("{}_{name}.csv", self.mission.name));
            fs::write(&path, text)?;
            written.push(path);
        }
        Ok(written)
    }
}

fn compare(a: &AbortCampaign, b: &AbortCampaign) -> PathComparison {
    let flights = || a.flights.iter().zip(&b.flights);
    let away = |(a, b): (&AbortSample, &AbortSample)| {
        (0..3).map(|axis| (a.state[axis] - b.state[axis]).powi(2)).sum::<f64>().sqrt()
    };
    let distances = flights().flat_map(|(a, b)| a.samples.iter().zip(&b.samples).map(away));
    let mean = |campaign: &AbortCampaign| {
        let each = campaign.flights.iter().map(|flight| flight.delta_v_m_s(&campaign.case));
        each.sum::<f64>() / campaign.flights.len() as f64
    };
    PathComparison {
        variants: [a, b].map(|campaign| campaign.case.name.clone()),
        steps: flights().map(|(a, b)| a.steps.len().min(b.steps.len())).min().unwrap_or(0),
        largest_distance_m: distances.fold(0.0, f64::max),
        delta_v_m_s: [a, b].map(mean),
    }
}

fn comparison_json(compared: &PathComparison) -> Value {
    json!({
        "variants": compared.variants,
        "steps": compared.steps,
        "largest_distance_m": compared.largest_distance_m,
        "delta_v_m_s": compared.delta_v_m_s,
    })
}

fn variant_json(campaign: &AbortCampaign) -> Map<String, Value> {
    let summary = AbortSummary::new(campaign);
    let mut map = Map::new();
    for (name, statistics) in &summary.metrics {
        map.insert((*name).to_owned(), statistics.json());
    }
    let (p50, p99) = summary.latency_ms.unzip();
    let modes = summary.modes;
    let drifts: Map<String, Value> = summary.drifts.iter().map(drift_json).collect();
    let failures = summary.failures.map(|failures| {
        json!({
            "runs": failures.runs,
            "runs_entering": failures.runs_entering,
            "runs_entering_feasible": failures.runs_entering_feasible,
            "runs_without_abort": failures.runs_without_abort,
        })
    });
    let rest = [
        ("runs", summary.runs.into()),
        ("arrived", summary.arrived.into()),
        ("infeasible", summary.infeasible.into()),
        ("redraws", summary.redraws.into()),
        ("steps_flown", summary.steps.into()),
        ("softened_steps", summary.softened_steps.into()),
        ("abort_steps", summary.abort_steps.into()),
        ("uncertified_steps", summary.uncertified_steps.into()),
        (
            "modes",
            json!({ "inside": modes.inside, "found": modes.found,
            "none_proved": modes.none_proved, "undecided": modes.undecided }),
        ),
        ("drifts", drifts.into()),
        ("failures", failures.into()),
        ("phases", summary.phases.iter().map(phase_json).collect()),
        ("warnings", campaign.artifact.warnings.clone().into()),
        ("artifact_bytes", campaign.artifact_bytes.into()),
        ("step_latency_ms", json!({ "p50": p50, "p99": p99 })),
        ("published", json!(campaign.case.published)),
        ("reference", json!(campaign.case.reference)),
    ];
    map.extend(rest.map(|(name, value)| (name.to_owned(), value)));
    map
}

fn drift_json(drift: &DriftFigures) -> (String, Value) {
    let figures = json!({
        "states": drift.states,
        "states_drifting_in": drift.states_drifting_in,
        "least_gauge": drift.least_gauge,
        "least_gauge_throughout": drift.least_gauge_throughout,
        "least_distance_m": drift.least_distance_m,
    });
    (drift.truth.to_owned(), figures)
}

fn phase_json(phase: &PhaseFigures) -> Value {
    json!({
        "kind": phase.kind,
        "sets": phase.sets,
        "sets_of_all_modes": phase.sets_of_all_modes,
        "modes": phase.modes,
        "modes_kept": phase.modes_kept,
        "steps": phase.steps,
        "time_s": phase.time_s,
        "delta_v_m_s": phase.delta_v_m_s,
        "softened_steps": phase.softened_steps,
        "begins_at_step": phase.begins_at_step,
        "unsafe_at_step": phase.unsafe_at_step,
        "safe_until_next": phase.safe_until_next,
    })
}

/// One line a run.
fn runs_csv(campaign: &AbortCampaign) -> String {
    let mut text = String::from(
        "run,outcome,steps,delta_v_m_s,softened_steps,failure_step,failure_gauge,entered,\
         least_gauge_after_failure,least_distance_after_failure_m\n",
    );
    for flight in &campaign.flights {
        let outcome = match flight.outcome {
            AbortOutcome::Arrived => "ARRIVED",
            AbortOutcome::StepsFlown => "STEPS_FLOWN",
            AbortOutcome::Failed => "FAILED",
            AbortOutcome::Infeasible(_) => "INFEASIBLE",
        };
        // Writing into a String cannot fail.
        let _ = write!(
            text,
            "{},{outcome},{},{:e},{}",
            flight.run,
            flight.steps.len(),
            flight.delta_v_m_s(&campaign.case),
            flight.softened_steps(),
        );
        let Some(failure) = &flight.failure else {
            text.push_str(",,,,,\n");
            continue;
        };
        let gauge = failure.gauge.map_or_else(String::new, |gauge| format!("{gauge:e}"));
        let after = &failure.after;
        let least = |values: Vec<f64>| values.into_iter().fold(f64::INFINITY, f64::min);
        let _ = writeln!(
            text,
            ",{},{gauge},{},{:e},{:e}",
            failure.step,
            flight.entered(),
            least(after.iter().map(|drift| drift.least_gauge_throughout).collect()),
            least(after.iter().map(|drift| drift.least_distance_m).collect()),
        );
    }
    text
}

/// One line a step: true state, phase, what was flown, and what becomes of the state.
fn trace_csv(flight: &AbortFlight, campaign: &AbortCampaign) -> String {
    let mut text = String::from(
        "k,elapsed_s,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s,phase,fx_n,fy_n,fz_n,origin,softened,\
         aborts_found,aborts_none_proved,aborts_undecided",
    );
    let has_drifts = flight.samples.iter().any(|sample| !sample.drifts.is_empty());
    let truths = campaign.judged_by.iter().filter(|_| has_drifts);
    for truth in truths.clone() {
        let _ = write!(text, ",least_gauge_{}", truth.name());
    }
    let phases = flight.samples.first().map_or(0, |sample| sample.unsafe_sets.len());
    for phase in 0..phases {
        let _ = write!(text, ",unsafe_in_phase_{phase}");
    }
    text.push('\n');
    for (k, sample) in flight.samples.iter().enumerate() {
        let _ = write!(text, "{k},{}", k as f64 * campaign.case.model.sample_time_s);
        sample.state.iter().for_each(|component| {
            let _ = write!(text, ",{component:e}");
        });
        let _ = write!(text, ",{}", sample.phase);
        text.push_str(&flight.steps.get(k).map_or_else(|| ",".repeat(8), step_csv));
        for index in 0..truths.clone().count() {
            let least = sample.drifts.get(index).map(|drift| format!("{:e}", drift.least_gauge));
            let _ = write!(text, ",{}", least.unwrap_or_default());
        }
        sample.unsafe_sets.iter().for_each(|inside| {
            let _ = write!(text, ",{inside}");
        });
        text.push('\n');
    }
    text
}

fn step_csv(step: &AbortStep) -> String {
    let [x, y, z] = step.force_n;
    let origin = match step.origin {
        Origin::Command => "COMMAND",
        Origin::Abort(reason) => reason.as_str_name().trim_start_matches("ABORT_REASON_"),
        Origin::Rest => "REST",
    };
    let next = step.next;
    format!(
        ",{x:e},{y:e},{z:e},{origin},{},{},{},{}",
        step.softened, next.found, next.none_proved, next.undecided
    )
}
