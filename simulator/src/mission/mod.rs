//! A mission file: the problem the service is asked to solve, the truth it is flown against, and
//! the published figures printed beside ours.
//!
//! Top level: `name`, `description` (where the numbers come from, and what the paper leaves open),
//! `problem` (canonical JSON of `vbar.v1.Problem`), `simulation`, `published`. The last two mean
//! what the problem's method needs: see [`AbortMission`], [`Mission`], [`PlanMission`] and
//! [`SamplingMission`]. Unknown fields are refused
//! everywhere.

pub(crate) mod abort;
pub(crate) mod abort_model;
pub(crate) mod law;
pub(crate) mod model;
pub(crate) mod plan;
pub(crate) mod plan_model;
pub(crate) mod sampling;
pub(crate) mod sampling_law;
pub(crate) mod sampling_model;
mod start;

use std::{collections::BTreeMap, fs, path::Path};

use prost_reflect::{DeserializeOptions, DynamicMessage};
use serde::Deserialize;
use vbar_proto::{
    DESCRIPTORS,
    v1::{self, VariableHorizonScheme as Scheme},
};

pub use abort::{AbortCase, AbortMission, AbortSources};
use law::{DisturbanceLaw, InitialLaw, Randomisation, TruthLaw};
use model::Model;
pub use plan::{PlanChanges, PlanMission, PublishedAxes, metric_name, metric_named};
pub use sampling::{PublishedEffort, SamplingMission, sampling_scheme_name, sampling_scheme_named};

/// Largest mission file that is read.
const FILE_BYTES_MAX: u64 = 16 << 20;

/// Most runs of one campaign.
pub const RUNS_MAX: u32 = 100_000;

/// A mission of whichever method its problem names.
#[derive(Debug, Clone)]
pub enum MissionFile {
    /// Closed loops that can be aborted at every step.
    AbortSafe(Box<AbortMission>),
    /// Closed loops under variable-horizon control.
    VariableHorizon(Box<Mission>),
    /// Fixed-time plans with disturbance feedback.
    DisturbanceFeedback(Box<PlanMission>),
    /// Closed loops under sampled chance constraints.
    OfflineSampling(Box<SamplingMission>),
}

impl MissionFile {
    /// Reads and checks a mission file.
    ///
    /// # Errors
    /// When the file cannot be read, is not of the right shape, or names values that make no
    /// sense; every such value is listed.
    pub fn load(path: &Path) -> Result<Self, MissionError> {
        Self::parse(&read(path)?)
    }

    /// Checks the text of a mission file.
    ///
    /// # Errors
    /// As [`MissionFile::load`].
    pub fn parse(text: &str) -> Result<Self, MissionError> {
        /// Which arm the problem has, before anything else is looked at.
        #[derive(Deserialize)]
        struct Head {
            problem: BTreeMap<String, serde::de::IgnoredAny>,
        }
        let head: Head = serde_json::from_str(text)?;
        let asks = |arms: [&str; 2]| arms.iter().any(|arm| head.problem.contains_key(*arm));
        if asks(["abortSafe", "abort_safe"]) {
            return AbortMission::parse(text).map(|mission| Self::AbortSafe(mission.into()));
        }
        if asks(["disturbanceFeedback", "disturbance_feedback"]) {
            return PlanMission::parse(text)
                .map(|mission| Self::DisturbanceFeedback(mission.into()));
        }
        if asks(["offlineSampling", "offline_sampling"]) {
            return SamplingMission::parse(text)
                .map(|mission| Self::OfflineSampling(mission.into()));
        }
        Mission::parse(text).map(|mission| Self::VariableHorizon(mission.into()))
    }

    /// Short name, used in file names.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::AbortSafe(mission) => &mission.name,
            Self::VariableHorizon(mission) => &mission.name,
            Self::DisturbanceFeedback(mission) => &mission.name,
            Self::OfflineSampling(mission) => &mission.name,
        }
    }

    /// What the service is asked.
    #[must_use]
    pub fn into_problem(self) -> v1::Problem {
        match self {
            Self::AbortSafe(mission) => mission.problem,
            Self::VariableHorizon(mission) => mission.problem,
            Self::DisturbanceFeedback(mission) => mission.problem,
            Self::OfflineSampling(mission) => mission.problem,
        }
    }
}

/// The text of a mission file of acceptable size.
fn read(path: &Path) -> Result<String, MissionError> {
    let unreadable = |source| MissionError::Unreadable { path: path.display().to_string(), source };
    let size = fs::metadata(path).map_err(unreadable)?.len();
    if size > FILE_BYTES_MAX {
        let fault = format!("the file has {size} bytes, at most {FILE_BYTES_MAX} are read");
        return Err(MissionError::Invalid(vec![fault]));
    }
    fs::read_to_string(path).map_err(unreadable)
}

/// A parsed and checked mission of the variable-horizon method.
#[derive(Debug, Clone)]
pub struct Mission {
    /// Short name, used in file names.
    pub name: String,
    /// Provenance.
    pub description: String,
    /// What the service is asked.
    pub problem: v1::Problem,
    /// Figures from the paper.
    pub published: Published,
    pub(crate) simulation: Simulation,
}

/// Why a mission file was refused.
#[derive(Debug, thiserror::Error)]
pub enum MissionError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    Unreadable {
        /// Which file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not JSON of the right shape.
    #[error("not a mission file: {0}")]
    Malformed(#[from] serde_json::Error),
    /// Values that make no sense, all of them.
    #[error("the mission cannot be flown: {}", .0.join("; "))]
    Invalid(Vec<String>),
}

/// Figures from a paper: scheme, then metric, then statistic.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// Which paper and which table.
    pub source: String,
    /// `schemes[scheme][metric][statistic]`, names as in the report.
    #[serde(default)]
    pub schemes: BTreeMap<String, BTreeMap<String, BTreeMap<String, f64>>>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Simulation {
    /// Default number of runs.
    pub runs: u32,
    /// The plant that is flown.
    pub truth: TruthLaw,
    /// How x(0) is chosen.
    pub initial_state: InitialLaw,
    /// What disturbs the plant.
    pub disturbance: DisturbanceLaw,
    /// Parameters drawn anew for every run.
    pub randomised: Option<Randomisation>,
    /// Schemes that are compared when all are asked for.
    pub compared_schemes: Vec<String>,
    /// Weights to sweep for the fuel/time figure.
    pub fuel_weight_sweep: Option<FuelWeightSweep>,
    /// Named changes of the above.
    #[serde(default)]
    pub variants: BTreeMap<String, Variant>,
    /// The variant whose single run is drawn step by step.
    pub detailed_variant: Option<String>,
}

/// A fuel-weight sweep.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FuelWeightSweep {
    /// Weights gamma_v.
    pub weights: Vec<f64>,
    /// Runs per weight.
    pub runs: u32,
}

/// What a variant changes; absent fields stay.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Variant {
    pub runs: Option<u32>,
    pub truth: Option<TruthLaw>,
    pub initial_state: Option<InitialLaw>,
    pub disturbance: Option<DisturbanceLaw>,
    /// Figures for this variant; the mission's own do not apply to it.
    #[serde(default)]
    pub published: Published,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ClosedLoopFile {
    name: String,
    description: String,
    problem: serde_json::Value,
    simulation: Simulation,
    #[serde(default)]
    published: Published,
}

impl Mission {
    /// Reads and checks a mission file.
    ///
    /// # Errors
    /// When the file cannot be read, is not of the right shape, or names values that make no
    /// sense; every such value is listed.
    pub fn load(path: &Path) -> Result<Self, MissionError> {
        Self::parse(&read(path)?)
    }

    /// Checks the text of a mission file.
    ///
    /// # Errors
    /// As [`Mission::load`].
    pub fn parse(text: &str) -> Result<Self, MissionError> {
        let file: ClosedLoopFile = serde_json::from_str(text)?;
        let problem = parse_problem(file.problem)?;
        let mission = Self {
            name: file.name,
            description: file.description,
            problem,
            published: file.published,
            simulation: file.simulation,
        };
        mission.check()?;
        Ok(mission)
    }

    /// Names of the variants.
    pub fn variants(&self) -> impl Iterator<Item = &str> {
        self.simulation.variants.keys().map(String::as_str)
    }

    /// The mission as a variant flies it.
    #[must_use]
    pub fn variant(&self, name: &str) -> Option<Self> {
        let variant = self.simulation.variants.get(name)?;
        let mut changed = self.clone();
        let simulation = &mut changed.simulation;
        simulation.runs = variant.runs.unwrap_or(simulation.runs);
        if let Some(truth) = &variant.truth {
            simulation.truth = truth.clone();
        }
        if let Some(initial_state) = &variant.initial_state {
            simulation.initial_state = initial_state.clone();
        }
        if let Some(disturbance) = &variant.disturbance {
            simulation.disturbance = disturbance.clone();
        }
        changed.published.clone_from(&variant.published);
        Some(changed)
    }

    /// The scheme that the problem itself names.
    #[must_use]
    pub fn scheme(&self) -> Scheme {
        variable_horizon(&self.problem)
            .map_or(Scheme::Unspecified, v1::VariableHorizonProblem::scheme)
    }

    /// The schemes flown when all are asked for, in the order of the file.
    #[must_use]
    pub fn compared_schemes(&self) -> Vec<Scheme> {
        self.simulation.compared_schemes.iter().filter_map(|name| scheme_named(name)).collect()
    }

    pub(crate) fn check(&self) -> Result<(), MissionError> {
        let mut faults = Vec::new();
        check_name(&self.name, &mut faults);
        let compared = &self.simulation.compared_schemes;
        for name in compared.iter().filter(|name| scheme_named(name).is_none()) {
            faults.push(format!("simulation.compared_schemes: no scheme is called {name}"));
        }
        for (index, scheme) in compared.iter().enumerate() {
            if compared[..index].contains(scheme) {
                faults.push(format!("simulation.compared_schemes: {scheme} is named twice"));
            }
        }
        if let Some(name) = &self.simulation.detailed_variant
            && !self.simulation.variants.contains_key(name)
        {
            faults.push(format!("simulation.detailed_variant: no variant is called {name}"));
        }
        if let Some(sweep) = &self.simulation.fuel_weight_sweep {
            check_runs("simulation.fuel_weight_sweep.runs", sweep.runs, &mut faults);
            if sweep.weights.is_empty() || sweep.weights.iter().any(|w| !w.is_finite() || *w < 0.0)
            {
                faults.push("simulation.fuel_weight_sweep.weights: one or more, each >= 0".into());
            }
        }
        match Model::new(&self.problem) {
            Err(model_faults) => faults.extend(model_faults),
            Ok(model) => {
                self.check_laws("simulation", &model, &mut faults);
                for name in self.variants() {
                    let variant = self.variant(name).unwrap_or_else(|| self.clone());
                    let place = format!("simulation.variants.{name}");
                    variant.check_laws(&place, &model, &mut faults);
                }
            }
        }
        if faults.is_empty() { Ok(()) } else { Err(MissionError::Invalid(faults)) }
    }

    fn check_laws(&self, place: &str, model: &Model, faults: &mut Vec<String>) {
        let simulation = &self.simulation;
        check_runs(&format!("{place}.runs"), simulation.runs, faults);
        simulation.truth.check(&format!("{place}.truth"), model, faults);
        simulation.initial_state.check(&format!("{place}.initial_state"), model, faults);
        let truth = &simulation.truth;
        simulation.disturbance.check(&format!("{place}.disturbance"), model, truth, faults);
        if let Some(randomised) = &simulation.randomised {
            randomised.check(&format!("{place}.randomised"), model, faults);
        }
    }
}

/// A name goes into file names.
fn check_name(name: &str, faults: &mut Vec<String>) {
    let ok = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if name.is_empty() || !name.chars().all(ok) {
        faults.push("name: letters, digits, '_' and '-' only".to_owned());
    }
}

fn check_runs(place: &str, runs: u32, faults: &mut Vec<String>) {
    if !(1..=RUNS_MAX).contains(&runs) {
        faults.push(format!("{place}: 1 to {RUNS_MAX}, got {runs}"));
    }
}

/// The scheme whose name on the wire ends in `name`.
pub(crate) fn scheme_named(name: &str) -> Option<Scheme> {
    Scheme::from_str_name(&format!("VARIABLE_HORIZON_SCHEME_{name}"))
        .filter(|scheme| *scheme != Scheme::Unspecified)
}

/// The short name of a scheme, as in reports and on the command line.
pub(crate) fn scheme_name(scheme: Scheme) -> &'static str {
    scheme.as_str_name().trim_start_matches("VARIABLE_HORIZON_SCHEME_")
}

/// The variable-horizon arm of a problem.
pub(crate) fn variable_horizon(problem: &v1::Problem) -> Option<&v1::VariableHorizonProblem> {
    match &problem.method {
        Some(v1::problem::Method::VariableHorizon(inner)) => Some(inner),
        _ => None,
    }
}

/// The same, to be changed.
pub(crate) fn variable_horizon_mut(
    problem: &mut v1::Problem,
) -> Option<&mut v1::VariableHorizonProblem> {
    match &mut problem.method {
        Some(v1::problem::Method::VariableHorizon(inner)) => Some(inner),
        _ => None,
    }
}

fn parse_problem(json: serde_json::Value) -> Result<v1::Problem, MissionError> {
    let descriptor = DESCRIPTORS
        .get_message_by_name("vbar.v1.Problem")
        .ok_or_else(|| MissionError::Invalid(vec!["the contract has no Problem".into()]))?;
    let options = DeserializeOptions::new().deny_unknown_fields(true);
    let message = DynamicMessage::deserialize_with_options(descriptor, json, &options)?;
    message.transcode_to().map_err(|fault| MissionError::Invalid(vec![format!("problem: {fault}")]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn envisat() -> serde_json::Value {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/missions/envisat.json");
        serde_json::from_str(&fs::read_to_string(path).expect("envisat.json")).expect("JSON")
    }

    fn refusal(change: impl FnOnce(&mut serde_json::Value)) -> String {
        let mut json = envisat();
        change(&mut json);
        Mission::parse(&json.to_string()).expect_err("must be refused").to_string()
    }

    #[test]
    fn mission_files_all_load() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        let mut names = Vec::new();
        for entry in fs::read_dir(folder).expect("missions") {
            let path = entry.expect("entry").path();
            let mission = MissionFile::load(&path).unwrap_or_else(|e| panic!("{path:?}: {e}"));
            assert_eq!(path.file_stem().and_then(|s| s.to_str()), Some(mission.name()));
            names.push(mission.name().to_owned());
        }
        names.sort();
        let expected = [
            "active_abort",
            "double_integrator",
            "envisat",
            "gto",
            "hcw_docking",
            "iss",
            "leo_tumbler",
            "perturbed_55",
            "poseidyn",
            "prisma",
            "simbol_x",
            "tumbling_satellite",
            "vbar_elliptic",
        ];
        assert_eq!(names, expected);
    }

    #[test]
    fn mission_unknown_fields_are_refused_by_name() {
        assert!(refusal(|m| m["wind"] = 1.into()).contains("wind"));
        assert!(refusal(|m| m["simulation"]["wind"] = 1.into()).contains("wind"));
        let inside = refusal(|m| m["problem"]["variableHorizon"]["wind"] = 1.into());
        assert!(inside.contains("wind"), "{inside}");
    }

    #[test]
    fn mission_faults_are_reported_together() {
        let text = refusal(|m| {
            m["simulation"]["runs"] = 0.into();
            m["simulation"]["compared_schemes"] = serde_json::json!(["LUCKY"]);
            m["name"] = "../envisat".into();
        });
        for part in ["simulation.runs", "LUCKY", "name:"] {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
    }

    #[test]
    fn mission_truncated_text_is_refused() {
        let text = envisat().to_string();
        for length in (0..text.len()).step_by(97) {
            assert!(Mission::parse(&text[..length]).is_err(), "{length}");
        }
    }
}
