//! Missions under sampled chance constraints: closed loops from named starts to the docking.
//!
//! `simulation`: `repetitions` of each of the `starts` against the `truth`, whose `disturbance` is
//! added to the state after each sample, until the chaser is within `docking`. Starts are given
//! relative to some origin and become states relative to `target_m`, the origin of the problem.
//! `compared_schemes` and `variants` are JSON merge patches (RFC 7396), of the problem's method and
//! of `problem` and `simulation`.

use std::{collections::BTreeMap, path::Path};

use nalgebra::DVector;
use serde::Deserialize;
use serde_json::Value;
use vbar_proto::v1::{
    self, NoFirstStepSet, OfflineSamplingScheme as Scheme, offline_sampling_problem::FirstStep,
};

use super::{
    MissionError, check_name, check_runs, parse_problem, read,
    sampling_law::{AttitudeLaw, Docking, NoiseLaw, SamplingTruth, ThrusterLaw},
    sampling_model::SamplingModel,
};

/// A parsed and checked mission of the offline-sampling method.
#[derive(Debug, Clone)]
pub struct SamplingMission {
    /// Short name, used in file names.
    pub name: String,
    /// Provenance.
    pub description: String,
    /// What the service is asked.
    pub problem: v1::Problem,
    /// The paper's figures.
    pub published: PublishedEffort,
    /// The variant this is, if any.
    pub variant: Option<String>,
    pub(crate) simulation: SamplingSimulation,
    /// The file, for variants to change.
    source: Value,
}

/// A paper's means over all starts.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedEffort {
    /// Which paper and which table.
    #[serde(default)]
    pub source: String,
    /// Sum of |force| times the sample time, N s, by controller.
    #[serde(default)]
    pub control_effort_ns: BTreeMap<String, f64>,
    /// From the fastest to the slowest docking.
    pub time_to_dock_s: Option<[f64; 2]>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SamplingSimulation {
    /// Flights from each start.
    pub repetitions: u32,
    /// Where the chaser begins.
    pub starts: Vec<Start>,
    /// The target, from the same origin as the starts.
    pub target_m: Vec<f64>,
    /// What moves the chaser.
    pub truth: SamplingTruth,
    /// What is added to the state after each sample, one law a component.
    pub disturbance: Vec<NoiseLaw>,
    /// What becomes of a command.
    pub thrusters: ThrusterLaw,
    /// When a flight ends.
    pub docking: Docking,
    /// Controllers flown beside the problem's own, each with a merge patch of the problem's method.
    #[serde(default)]
    pub compared_schemes: BTreeMap<String, Value>,
    /// A second loop that holds the chaser's attitude.
    pub attitude: Option<AttitudeLaw>,
    /// Merge patches of this file.
    #[serde(default)]
    pub variants: BTreeMap<String, Value>,
}

/// Where a flight begins.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Start {
    pub name: String,
    pub position_m: Vec<f64>,
    pub velocity_m_s: Vec<f64>,
}

impl Start {
    /// The state with the target at the origin.
    pub(crate) fn state(&self, target_m: &[f64]) -> DVector<f64> {
        let position = self.position_m.iter().zip(target_m).map(|(start, target)| start - target);
        DVector::from_vec(position.chain(self.velocity_m_s.iter().copied()).collect())
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SamplingFile {
    name: String,
    description: String,
    problem: Value,
    simulation: SamplingSimulation,
    #[serde(default)]
    published: PublishedEffort,
}

impl SamplingMission {
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
    /// As [`SamplingMission::load`].
    pub fn parse(text: &str) -> Result<Self, MissionError> {
        let mission = Self::from_source(serde_json::from_str(text)?, None)?;
        let mut faults = Vec::new();
        for name in mission.variants() {
            match mission.with_variant(name) {
                Ok(_) => {}
                Err(MissionError::Invalid(inner)) => {
                    let place = format!("simulation.variants.{name}");
                    faults.extend(inner.into_iter().map(|fault| format!("{place}: {fault}")));
                }
                Err(other) => faults.push(format!("simulation.variants.{name}: {other}")),
            }
        }
        if faults.is_empty() { Ok(mission) } else { Err(MissionError::Invalid(faults)) }
    }

    fn from_source(source: Value, variant: Option<&str>) -> Result<Self, MissionError> {
        let file: SamplingFile = serde_json::from_value(source.clone())?;
        let mission = Self {
            name: file.name,
            description: file.description,
            problem: parse_problem(file.problem)?,
            published: file.published,
            variant: variant.map(str::to_owned),
            simulation: file.simulation,
            source,
        };
        mission.check()?;
        Ok(mission)
    }

    /// Names of the variants.
    pub fn variants(&self) -> impl Iterator<Item = &str> {
        self.simulation.variants.keys().map(String::as_str)
    }

    /// The mission as a variant flies it.
    ///
    /// # Errors
    /// Which variants there are, if none has this name; or why it cannot be flown.
    pub fn with_variant(&self, name: &str) -> Result<Self, MissionError> {
        let Some(patch) = self.simulation.variants.get(name) else {
            let known: Vec<&str> = self.variants().collect();
            let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            let fault = format!("no variant is called {name}; there are: {known}");
            return Err(MissionError::Invalid(vec![fault]));
        };
        let mut source = self.source.clone();
        for part in ["problem", "simulation"] {
            if let Some(patch) = patch.get(part) {
                merge(&mut source[part], patch);
            }
        }
        Self::from_source(source, Some(name))
    }

    /// The controller that the problem itself names.
    #[must_use]
    pub fn scheme(&self) -> Scheme {
        offline_sampling(&self.problem)
            .map_or(Scheme::Unspecified, v1::OfflineSamplingProblem::scheme)
    }

    /// The controllers flown unless one is asked for, the problem's own first.
    #[must_use]
    pub fn compared_schemes(&self) -> Vec<Scheme> {
        let own = self.scheme();
        let named = self.simulation.compared_schemes.iter();
        let others = named.filter_map(|(name, _)| sampling_scheme_named(name));
        let others = others.filter(|scheme| *scheme != own);
        std::iter::once(own).chain(others).collect()
    }

    /// The problem under another controller, changed as the mission says; what only the sampled
    /// one has is left out for others.
    ///
    /// # Errors
    /// When the changed problem is not one of the contract's.
    pub fn problem_under(&self, scheme: Scheme) -> Result<v1::Problem, MissionError> {
        if scheme == self.scheme() {
            return Ok(self.problem.clone());
        }
        let mut source = self.source["problem"].clone();
        let name = sampling_scheme_name(scheme);
        let patch = self.simulation.compared_schemes.get(name);
        for arm in source.as_object_mut().into_iter().flat_map(|arms| arms.values_mut()) {
            merge(arm, patch.unwrap_or(&Value::Object(serde_json::Map::new())));
        }
        let mut problem = parse_problem(source)?;
        if let Some(inner) = offline_sampling_mut(&mut problem) {
            inner.set_scheme(scheme);
            if scheme != Scheme::OfflineSampling {
                (inner.samples, inner.redundancy) = (None, None);
                (inner.first_step, inner.seed) = (None, None);
            }
        }
        Ok(problem)
    }

    /// The same mission, its problem as the simulator understands it.
    pub(crate) fn model(&self) -> Result<SamplingModel, MissionError> {
        SamplingModel::new(&self.problem).map_err(MissionError::Invalid)
    }

    fn check(&self) -> Result<(), MissionError> {
        let mut faults = Vec::new();
        let simulation = &self.simulation;
        check_name(&self.name, &mut faults);
        check_runs("simulation.repetitions", simulation.repetitions, &mut faults);
        let compared = &simulation.compared_schemes;
        for name in compared.keys() {
            let place = format!("simulation.compared_schemes.{name}");
            match sampling_scheme_named(name).map(|scheme| self.problem_under(scheme)) {
                None => faults.push(format!("{place}: no scheme is called so")),
                Some(Err(fault)) => faults.push(format!("{place}: {fault}")),
                Some(Ok(problem)) => {
                    let inner = SamplingModel::new(&problem).err().unwrap_or_default();
                    faults.extend(inner.into_iter().map(|fault| format!("{place}: {fault}")));
                }
            }
        }
        for (name, patch) in &simulation.variants {
            let parts = patch.as_object().map(|object| object.keys().cloned().collect());
            let parts: Vec<String> = parts.unwrap_or_else(|| vec![patch.to_string()]);
            for part in parts.iter().filter(|part| !["problem", "simulation"].contains(&&***part)) {
                let place = format!("simulation.variants.{name}");
                faults.push(format!("{place}: problem and simulation change, not {part}"));
            }
        }
        match self.model() {
            Err(MissionError::Invalid(inner)) => faults.extend(inner),
            Err(other) => faults.push(other.to_string()),
            Ok(model) => simulation.check(&model, &mut faults),
        }
        if faults.is_empty() { Ok(()) } else { Err(MissionError::Invalid(faults)) }
    }
}

impl SamplingSimulation {
    fn check(&self, model: &SamplingModel, faults: &mut Vec<String>) {
        let (states, inputs) = (model.states(), model.inputs());
        let positions = states / 2;
        let finite = |values: &[f64]| {
            values.len() == positions && values.iter().all(|value| value.is_finite())
        };
        if self.starts.is_empty() {
            faults.push("simulation.starts: at least one".into());
        }
        for (index, start) in self.starts.iter().enumerate() {
            check_name(&start.name, faults);
            if self.starts[..index].iter().any(|other| other.name == start.name) {
                faults.push(format!("simulation.starts: {} is named twice", start.name));
            }
            if !finite(&start.position_m) || !finite(&start.velocity_m_s) {
                let place = format!("simulation.starts.{}", start.name);
                faults.push(format!("{place}: {positions} finite components each"));
            }
        }
        if !finite(&self.target_m) {
            faults.push(format!("simulation.target_m: {positions} finite components"));
        }
        if self.disturbance.len() != states {
            faults.push(format!("simulation.disturbance: {states} laws"));
        }
        for (index, law) in self.disturbance.iter().enumerate() {
            law.check(&format!("simulation.disturbance[{index}]"), faults);
        }
        let sizes = (states, inputs);
        self.truth.check("simulation.truth", sizes, &self.disturbance, faults);
        self.thrusters.check("simulation.thrusters", faults);
        self.docking.check("simulation.docking", faults);
        if let Some(attitude) = &self.attitude {
            attitude.check("simulation.attitude", model, faults);
        }
    }
}

/// The controller whose name on the wire ends in `name`.
#[must_use]
pub fn sampling_scheme_named(name: &str) -> Option<Scheme> {
    let name = name.to_ascii_uppercase().replace('-', "_");
    Scheme::from_str_name(&format!("{SCHEME_PREFIX}{name}"))
        .filter(|scheme| *scheme != Scheme::Unspecified)
}

/// The short name of a controller, as in reports and on the command line.
#[must_use]
pub fn sampling_scheme_name(scheme: Scheme) -> &'static str {
    scheme.as_str_name().trim_start_matches(SCHEME_PREFIX)
}

const SCHEME_PREFIX: &str = "OFFLINE_SAMPLING_SCHEME_";

/// The problem without its first-step set; `None` if it imposes none.
pub(crate) fn without_first_step_set(problem: &v1::Problem) -> Option<v1::Problem> {
    let imposed = offline_sampling(problem)?.first_step.as_ref();
    matches!(imposed, Some(FirstStep::FirstStepSet(_))).then(|| {
        let mut problem = problem.clone();
        if let Some(inner) = offline_sampling_mut(&mut problem) {
            inner.first_step = Some(FirstStep::NoFirstStepSet(NoFirstStepSet {}));
        }
        problem
    })
}

/// The offline-sampling arm of a problem.
pub(crate) fn offline_sampling(problem: &v1::Problem) -> Option<&v1::OfflineSamplingProblem> {
    match &problem.method {
        Some(v1::problem::Method::OfflineSampling(inner)) => Some(inner),
        _ => None,
    }
}

/// The same, to be changed.
fn offline_sampling_mut(problem: &mut v1::Problem) -> Option<&mut v1::OfflineSamplingProblem> {
    match &mut problem.method {
        Some(v1::problem::Method::OfflineSampling(inner)) => Some(inner),
        _ => None,
    }
}

/// Changes `value` as `patch` says: objects member by member, null removes, all else replaces
/// (RFC 7396).
fn merge(value: &mut Value, patch: &Value) {
    let Value::Object(changes) = patch else {
        *value = patch.clone();
        return;
    };
    if !value.is_object() {
        *value = Value::Object(serde_json::Map::new());
    }
    let Value::Object(members) = value else { return };
    for (name, change) in changes {
        if change.is_null() {
            members.remove(name);
        } else {
            merge(members.entry(name.clone()).or_insert(Value::Null), change);
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn poseidyn() -> Value {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/missions/poseidyn.json");
        serde_json::from_str(&std::fs::read_to_string(path).expect("poseidyn.json")).expect("JSON")
    }

    fn refusal(change: impl FnOnce(&mut Value)) -> String {
        let mut json = poseidyn();
        change(&mut json);
        SamplingMission::parse(&json.to_string()).expect_err("must be refused").to_string()
    }

    /// The examples of RFC 7396, appendix A, that a mission can need.
    #[test]
    fn merge_patches_objects_as_the_standard_says() {
        let cases = [
            (json!({"a": "b"}), json!({"a": "c"}), json!({"a": "c"})),
            (json!({"a": "b"}), json!({"b": "c"}), json!({"a": "b", "b": "c"})),
            (json!({"a": "b", "b": "c"}), json!({"a": null}), json!({"b": "c"})),
            (json!({"a": ["b"]}), json!({"a": "c"}), json!({"a": "c"})),
            (
                json!({"a": {"b": "c"}}),
                json!({"a": {"b": "d", "c": null}}),
                json!({"a": {"b": "d"}}),
            ),
            (json!({}), json!({"a": {"bb": {"ccc": null}}}), json!({"a": {"bb": {}}})),
            (json!([1, 2]), json!({"a": "b", "c": null}), json!({"a": "b"})),
        ];
        for (mut value, patch, expected) in cases {
            merge(&mut value, &patch);
            assert_eq!(value, expected);
        }
    }

    #[test]
    fn sampling_mission_starts_are_states_about_the_target() {
        let mission = SamplingMission::parse(&poseidyn().to_string()).expect("a mission");
        let start = &mission.simulation.starts[1];
        assert_eq!(start.name, "B");
        let state = start.state(&mission.simulation.target_m);
        let expected = [2.6, 1.45, 0.0, 0.0];
        assert!((state - DVector::from_row_slice(&expected)).amax() < 1e-15);
    }

    #[test]
    fn sampling_mission_flies_baselines_without_what_only_sampling_has() {
        let mission = SamplingMission::parse(&poseidyn().to_string()).expect("a mission");
        let schemes = [Scheme::OfflineSampling, Scheme::LinearQuadratic, Scheme::TubeRobust];
        assert_eq!(mission.compared_schemes(), schemes);
        let robust = mission.problem_under(Scheme::TubeRobust).expect("a problem");
        let robust = offline_sampling(&robust).expect("the arm");
        assert!(robust.samples.is_none() && robust.redundancy.is_none());
        assert!(robust.first_step.is_none() && robust.seed.is_none());
        assert!(robust.state_set.is_some());
        // As the mission's patch says, and only there.
        let offsets = |problem: &v1::OfflineSamplingProblem| {
            problem.input_set.as_ref().expect("a set").offsets.clone()
        };
        assert_eq!(offsets(robust), [0.15; 4]);
        assert_eq!(offsets(offline_sampling(&mission.problem).expect("the arm")), [0.3; 4]);
    }

    #[test]
    fn sampling_mission_variants_are_merge_patches() {
        let mission = SamplingMission::parse(&poseidyn().to_string()).expect("a mission");
        let printed = mission.with_variant("published_rows").expect("a variant");
        let size = |mission: &SamplingMission| {
            offline_sampling(&mission.problem).expect("the arm").samples.as_ref()?.size
        };
        assert_eq!(size(&printed), Some(7303));
        assert_ne!(size(&mission), size(&printed));
        assert_eq!(printed.simulation.starts, mission.simulation.starts);
        let fault = mission.with_variant("moon").expect_err("no such variant").to_string();
        assert!(fault.contains("published_rows"), "{fault}");
    }

    #[test]
    fn sampling_mission_faults_are_reported_together() {
        let text = refusal(|m| {
            let simulation = &mut m["simulation"];
            simulation["repetitions"] = 0.into();
            simulation["compared_schemes"] = json!({"FANCY": {}});
            simulation["starts"][0]["position_m"] = json!([1.0]);
            simulation["starts"][1]["name"] = "C".into();
            simulation["target_m"] = json!([1.0, 2.0, 3.0]);
            simulation["disturbance"] = json!([]);
            simulation["thrusters"]["force_max_n"] = (-1.0).into();
            simulation["docking"]["distance_m"] = 0.0.into();
            simulation["truth"]["planar"]["mass_kg"] = 0.0.into();
        });
        for part in [
            "repetitions",
            "FANCY",
            "starts.A",
            "C is named twice",
            "target_m",
            "disturbance",
            "force_max_n",
            "distance_m",
            "mass_kg",
        ] {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
        let text = refusal(|m| m["simulation"]["variants"]["wrong"] = json!({"name": "x"}));
        assert!(text.contains("variants.wrong") && text.contains("name"), "{text}");
        let patch = json!({"simulation": {"repetitions": 0}});
        let text = refusal(|m| m["simulation"]["variants"]["wrong"] = patch);
        assert!(text.contains("variants.wrong") && text.contains("repetitions"), "{text}");
    }

    #[test]
    fn sampling_mission_unknown_fields_and_truncated_text_are_refused() {
        assert!(refusal(|m| m["simulation"]["wind"] = 1.into()).contains("wind"));
        let inside = refusal(|m| m["problem"]["offlineSampling"]["wind"] = 1.into());
        assert!(inside.contains("wind"), "{inside}");
        let text = poseidyn().to_string();
        for length in (0..text.len()).step_by(97) {
            assert!(SamplingMission::parse(&text[..length]).is_err(), "{length}");
        }
    }
}
