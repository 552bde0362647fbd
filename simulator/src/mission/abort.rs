//! Missions under abort-safe control [AguilarMarsillach2022].
//!
//! `simulation` says what is flown:
//!
//! - `runs`: flights of every variant, each from a start of its own;
//! - `initial_state`: `{"fixed": ...}`, or `{"ring": ...}` for starts by chance, see [`AbortStart`];
//! - `truth`: what moves both craft: `"linear"`, the equations linearised about the target's
//!   Keplerian orbit, or `{"nonlinear": {"j2": true, "sun_moon": true}}`, both in inertial space;
//! - `failure`: which thrusters are left, and from when, see [`FailureLaw`]. From then on the
//!   flight follows the aborts that the service answers with;
//! - `drift`: how long flights go on after a failure, how often that is looked at, and under which
//!   truths. Without a failure in the mission every flown state is judged as if all thrusters
//!   failed there, by the region of its phase;
//! - `phase_sets`: the service is asked at every state about the unsafe sets of every phase;
//! - `variants`: named changes, flown in this order. `problem` is merged into the mission's own
//!   (RFC 7396, and lists by index); `steps` ends the flight after so many; `published` and `reference` hold figures of
//!   the paper and of an independent implementation, by their names in the report;
//! - `compared`: pairs of variants whose paths are compared step by step.
//!
//! States are judged by the mission's own regions, whatever a variant makes of its problem: that is
//! how a controller without safety is judged.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use serde::Deserialize;
use serde_json::Value;
use vbar_proto::v1;

use super::{MissionError, abort_model::AbortModel, check_name, check_runs, parse_problem, read};

/// Most steps of a flight.
const STEPS_MAX: u32 = 100_000;

/// Most orbital periods that a state drifts to be judged.
const PERIODS_MAX: f64 = 100.0;

/// A parsed and checked mission under abort-safe control.
#[derive(Debug, Clone)]
pub struct AbortMission {
    /// Short name, used in file names.
    pub name: String,
    /// Provenance.
    pub description: String,
    /// What the service is asked.
    pub problem: v1::Problem,
    /// Where figures beside ours come from.
    pub published: AbortSources,
    pub(crate) simulation: AbortSimulation,
    /// The problem as its file has it, for variants to change.
    problem_json: Value,
}

/// Where figures beside ours come from.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AbortSources {
    /// Which paper and which figure or section.
    #[serde(default)]
    pub source: String,
    /// Which other implementation.
    #[serde(default)]
    pub reference: String,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AbortSimulation {
    pub runs: u32,
    pub initial_state: AbortStart,
    pub truth: AbortTruth,
    pub failure: Option<FailureLaw>,
    pub drift: DriftLaw,
    #[serde(default)]
    pub phase_sets: bool,
    pub variants: Vec<AbortVariant>,
    #[serde(default)]
    pub compared: Vec<[String; 2]>,
}

/// What moves both craft.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum AbortTruth {
    /// The equations of motion linearised about the target's Keplerian orbit.
    Linear,
    /// Newton's law in inertial space.
    Nonlinear {
        /// With the Earth's flattening.
        j2: bool,
        /// With the attraction of Sun and Moon; needs the problem's epoch.
        sun_moon: bool,
    },
}

/// How a flight starts; RTN.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum AbortStart {
    /// Given.
    Fixed { position_m: [f64; 3], velocity_m_s: [f64; 3] },
    /// Drawn.
    Ring(RingLaw),
}

/// Distance from the target in the orbital plane uniform in `radius_m`, angle uniform, cross track
/// uniform within `cross_track_m`, velocity normal along each axis; kept if the squared gauge of
/// free drift in the first phase's region stays above `gauge_squared_min` for its safety horizon, by
/// the linear truth.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RingLaw {
    pub radius_m: [f64; 2],
    pub cross_track_m: f64,
    pub speed_deviation_m_s: f64,
    pub gauge_squared_min: f64,
}

/// Thrusters that fail.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FailureLaw {
    /// When.
    pub when: FailureMoment,
    /// The thrusters that are left, as the problem numbers them; none: total failure.
    pub working: Vec<i32>,
}

/// When thrusters fail.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum FailureMoment {
    /// At this step, before its command.
    AtStep(u32),
    /// When the gauge of the position in the first phase's region has fallen to a value drawn
    /// uniformly from these limits.
    AtGauge([f64; 2]),
}

/// How flights are judged.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DriftLaw {
    /// Orbital periods after a failure.
    pub periods: f64,
    /// Time between the instants that are looked at; the least distance is found between them too.
    pub sample_s: f64,
    /// What moves both craft, one verdict each.
    pub truths: Vec<AbortTruth>,
}

/// A named change of the mission.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AbortVariant {
    pub name: String,
    problem: Option<Value>,
    steps: Option<u32>,
    initial_state: Option<AbortStart>,
    truth: Option<AbortTruth>,
    failure: Option<FailureLaw>,
    #[serde(default)]
    published: BTreeMap<String, f64>,
    #[serde(default)]
    reference: BTreeMap<String, f64>,
}

/// A variant of a mission, ready to be flown.
#[derive(Debug, Clone)]
pub struct AbortCase {
    /// The variant's name.
    pub name: String,
    /// What the service is asked.
    pub problem: v1::Problem,
    /// The paper's figures, by their names in the report.
    pub published: BTreeMap<String, f64>,
    /// The same of an independent implementation.
    pub reference: BTreeMap<String, f64>,
    /// The flight ends after so many steps.
    pub(crate) steps: Option<u32>,
    pub(crate) initial_state: AbortStart,
    pub(crate) truth: AbortTruth,
    pub(crate) failure: Option<FailureLaw>,
    /// The problem as the simulator understands it.
    pub(crate) model: AbortModel,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AbortFile {
    name: String,
    description: String,
    problem: Value,
    simulation: AbortSimulation,
    #[serde(default)]
    published: AbortSources,
}

impl AbortMission {
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
    /// As [`AbortMission::load`].
    pub fn parse(text: &str) -> Result<Self, MissionError> {
        let file: AbortFile = serde_json::from_str(text)?;
        let mission = Self {
            name: file.name,
            description: file.description,
            problem: parse_problem(file.problem.clone())?,
            published: file.published,
            simulation: file.simulation,
            problem_json: file.problem,
        };
        mission.check()?;
        Ok(mission)
    }

    /// Names of the variants, in the order in which they are flown.
    pub fn variants(&self) -> impl Iterator<Item = &str> {
        self.simulation.variants.iter().map(|variant| variant.name.as_str())
    }

    /// A variant with its changes made.
    ///
    /// # Errors
    /// Which variants there are, if none has this name; or what is wrong with its problem.
    pub fn case(&self, name: &str) -> Result<AbortCase, MissionError> {
        let Some(variant) = self.simulation.variants.iter().find(|variant| variant.name == name)
        else {
            let known: Vec<&str> = self.variants().collect();
            let fault = format!("no variant is called {name}; there are: {}", known.join(", "));
            return Err(MissionError::Invalid(vec![fault]));
        };
        let mut json = self.problem_json.clone();
        if let Some(patch) = &variant.problem {
            merge(&mut json, patch);
        }
        let problem = parse_problem(json)?;
        let model = AbortModel::new(&problem).map_err(MissionError::Invalid)?;
        let simulation = &self.simulation;
        Ok(AbortCase {
            name: name.to_owned(),
            problem,
            published: variant.published.clone(),
            reference: variant.reference.clone(),
            steps: variant.steps,
            initial_state: variant
                .initial_state
                .as_ref()
                .unwrap_or(&simulation.initial_state)
                .clone(),
            truth: variant.truth.unwrap_or(simulation.truth),
            failure: variant.failure.as_ref().or(simulation.failure.as_ref()).cloned(),
            model,
        })
    }

    /// The mission's own problem as the simulator understands it.
    pub(crate) fn model(&self) -> Result<AbortModel, MissionError> {
        AbortModel::new(&self.problem).map_err(MissionError::Invalid)
    }

    fn check(&self) -> Result<(), MissionError> {
        let mut faults = Vec::new();
        check_name(&self.name, &mut faults);
        let simulation = &self.simulation;
        check_runs("simulation.runs", simulation.runs, &mut faults);
        simulation.drift.check("simulation.drift", &mut faults);
        self.check_names(&mut faults);
        match self.model() {
            Err(MissionError::Invalid(inner)) => faults.extend(inner),
            Err(other) => return Err(other),
            Ok(own) => {
                for truth in &simulation.drift.truths {
                    truth.check("simulation.drift.truths", &own, &mut faults);
                }
                for name in self.variants() {
                    let place = format!("simulation.variants.{name}");
                    match self.case(name) {
                        Ok(case) => case.check(&place, &own, &mut faults),
                        Err(fault) => faults.push(format!("{place}.problem: {fault}")),
                    }
                }
            }
        }
        if faults.is_empty() { Ok(()) } else { Err(MissionError::Invalid(faults)) }
    }

    fn check_names(&self, faults: &mut Vec<String>) {
        if self.simulation.variants.is_empty() {
            faults.push("simulation.variants: at least one".into());
        }
        let mut known = BTreeSet::new();
        for name in self.variants() {
            let mut wrong = Vec::new();
            check_name(name, &mut wrong);
            faults.extend(wrong.iter().map(|fault| format!("simulation.variants: {fault}")));
            if !known.insert(name) {
                faults.push(format!("simulation.variants: {name} is named twice"));
            }
        }
        for name in self.simulation.compared.iter().flatten() {
            if !known.contains(name.as_str()) {
                faults.push(format!("simulation.compared: no variant is called {name}"));
            }
        }
    }
}

impl AbortCase {
    /// What a force held for a step costs: the sum over the axes, as the paper counts.
    pub(crate) fn delta_v_m_s(&self, force_n: &[f64; 3]) -> f64 {
        let impulse: f64 = force_n.iter().map(|force| force.abs()).sum();
        impulse * self.model.sample_time_s / self.model.mass_kg
    }

    /// Longest flight, steps.
    pub(crate) fn steps_max(&self) -> u32 {
        self.steps.unwrap_or(self.model.steps_max)
    }

    /// `own` is the mission's own problem, whose regions judge.
    fn check(&self, place: &str, own: &AbortModel, faults: &mut Vec<String>) {
        if self.steps.is_some_and(|steps| !(1..=STEPS_MAX).contains(&steps)) {
            faults.push(format!("{place}.steps: 1 to {STEPS_MAX}"));
        }
        if self.model.phases.len() > own.phases.len() {
            faults.push(format!("{place}.problem: more phases than the mission has regions for"));
        }
        self.truth.check(&format!("{place}.truth"), &self.model, faults);
        self.initial_state.check(&format!("{place}.initial_state"), own, faults);
        if let Some(failure) = &self.failure {
            failure.check(&format!("{place}.failure"), own, faults);
        }
    }
}

impl AbortTruth {
    /// As in reports.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Nonlinear { j2: false, sun_moon: false } => "nonlinear",
            Self::Nonlinear { j2: true, sun_moon: false } => "nonlinear_j2",
            Self::Nonlinear { j2: false, sun_moon: true } => "nonlinear_sun_moon",
            Self::Nonlinear { j2: true, sun_moon: true } => "nonlinear_j2_sun_moon",
        }
    }

    fn check(self, place: &str, model: &AbortModel, faults: &mut Vec<String>) {
        let Self::Nonlinear { j2, sun_moon } = self else { return };
        if (j2 || sun_moon) && !model.oriented {
            let reason = "perturbations need the orbit's inclination, node and argument of perigee";
            faults.push(format!("{place}.nonlinear: {reason}"));
        }
        if sun_moon && model.epoch.is_none() {
            faults.push(format!("{place}.nonlinear.sun_moon: needs the orbit's epoch"));
        }
    }
}

impl AbortStart {
    fn check(&self, place: &str, own: &AbortModel, faults: &mut Vec<String>) {
        match self {
            Self::Fixed { position_m, velocity_m_s } => {
                if position_m.iter().chain(velocity_m_s).any(|value| !value.is_finite()) {
                    faults.push(format!("{place}.fixed: finite values"));
                }
            }
            Self::Ring(ring) => {
                let [near, far] = ring.radius_m;
                if !(near.is_finite() && far.is_finite() && near > 0.0 && near <= far) {
                    faults.push(format!("{place}.ring.radius_m: 0 < near <= far"));
                }
                let spreads = [ring.cross_track_m, ring.speed_deviation_m_s];
                if spreads.iter().any(|spread| !(spread.is_finite() && *spread >= 0.0)) {
                    faults.push(format!("{place}.ring: spreads of at least 0"));
                }
                if own.first_region().is_none() {
                    faults.push(format!("{place}.ring: the first phase has no region"));
                }
            }
        }
    }
}

impl FailureLaw {
    fn check(&self, place: &str, own: &AbortModel, faults: &mut Vec<String>) {
        if self.working.iter().any(|thruster| !own.thrusters.contains(thruster)) {
            let known = &own.thrusters;
            faults.push(format!("{place}.working: thrusters {} to {}", known.start(), known.end()));
        }
        if let FailureMoment::AtGauge([low, high]) = self.when {
            if !(low.is_finite() && high.is_finite() && 1.0 <= low && low <= high) {
                faults.push(format!("{place}.when.at_gauge: 1 <= low <= high"));
            }
            if own.first_region().is_none() {
                faults.push(format!("{place}.when.at_gauge: the first phase has no region"));
            }
        }
    }
}

impl DriftLaw {
    fn check(&self, place: &str, faults: &mut Vec<String>) {
        if !(self.periods > 0.0 && self.periods <= PERIODS_MAX) {
            faults.push(format!("{place}.periods: above 0, at most {PERIODS_MAX}"));
        }
        if !(self.sample_s.is_finite() && self.sample_s >= 0.1) {
            faults.push(format!("{place}.sample_s: at least 0.1"));
        }
        if self.truths.is_empty() {
            faults.push(format!("{place}.truths: at least one"));
        }
    }
}

/// Merges a change into a JSON value as RFC 7396 has it. Beyond it, members of a list are changed by
/// their index: `{"phases": {"0": {...}, "1": null}}` changes the first and drops the second.
fn merge(target: &mut Value, patch: &Value) {
    let Value::Object(changes) = patch else {
        *target = patch.clone();
        return;
    };
    if let Value::Array(members) = target
        && let Some(places) = indices(changes, members.len())
    {
        for (place, change) in places.into_iter().rev() {
            match change {
                Value::Null => drop(members.remove(place)),
                change => merge(&mut members[place], change),
            }
        }
        return;
    }
    if !target.is_object() {
        *target = Value::Object(serde_json::Map::new());
    }
    let Value::Object(members) = target else { return };
    for (key, change) in changes {
        if change.is_null() {
            members.remove(key);
        } else {
            merge(members.entry(key.clone()).or_insert(Value::Null), change);
        }
    }
}

/// The changes of a list's members, by rising index; `None` if some name is no index of it.
fn indices(
    changes: &serde_json::Map<String, Value>,
    length: usize,
) -> Option<BTreeMap<usize, &Value>> {
    let place = |key: &String| key.parse().ok().filter(|place| *place < length);
    changes.iter().map(|(key, change)| Some((place(key)?, change))).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::mission::abort_model::PhaseKind;

    fn file(name: &str) -> Value {
        let path = format!("{}/missions/{name}.json", env!("CARGO_MANIFEST_DIR"));
        serde_json::from_str(&std::fs::read_to_string(path).expect(name)).expect("JSON")
    }

    fn mission(name: &str) -> AbortMission {
        AbortMission::parse(&file(name).to_string()).expect("a mission")
    }

    fn refusal(name: &str, change: impl FnOnce(&mut Value)) -> String {
        let mut json = file(name);
        change(&mut json);
        AbortMission::parse(&json.to_string()).expect_err("must be refused").to_string()
    }

    #[test]
    fn abort_variants_change_what_they_name() {
        let mission = mission("vbar_elliptic");
        let kinds = |name: &str| -> Vec<PhaseKind> {
            let case = mission.case(name).expect("a variant");
            case.model.phases.iter().map(|phase| phase.kind).collect()
        };
        assert_eq!(kinds("unsafe"), [PhaseKind::Free]);
        assert_eq!(kinds("safe"), [PhaseKind::Passive]);
        assert_eq!(kinds("through"), [PhaseKind::Passive; 2]);
        let safe = mission.case("safe").expect("a variant");
        assert_eq!((safe.steps_max(), safe.published["delta_v_m_s"]), (143, 20.6));
        assert_eq!(safe.model.phases[0].horizon_steps, 636);
        let circular = mission.case("circular_cone").expect("a variant");
        assert_eq!(circular.model.elements.eccentricity, 0.0);
        assert_eq!(circular.model.phases[0].horizon_steps, 549);
    }

    #[test]
    fn abort_failures_leave_the_thrusters_they_say() {
        let mission = mission("active_abort");
        let left = |name: &str| {
            let case = mission.case(name).expect("a variant");
            case.failure.expect("a failure").working
        };
        assert_eq!(left("first_fails_safe"), [1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(left("last_left_unsafe"), [7]);
    }

    #[test]
    fn abort_changes_reach_into_objects_and_lists() {
        let mut value = json!({"a": {"b": 1, "c": 2}, "l": [{"x": 1}, 2, 3]});
        merge(&mut value, &json!({"a": {"b": null, "d": 4}, "l": {"0": {"y": 2}, "2": null}}));
        assert_eq!(value, json!({"a": {"c": 2, "d": 4}, "l": [{"x": 1, "y": 2}, 2]}));
        merge(&mut value, &json!({"l": [7], "a": 5}));
        assert_eq!(value, json!({"a": 5, "l": [7]}));
        // What is no index of the list replaces it.
        merge(&mut value, &json!({"l": {"1": 0}}));
        assert_eq!(value["l"], json!({"1": 0}));
    }

    #[test]
    fn abort_faults_are_reported_together() {
        let text = refusal("active_abort", |m| {
            m["simulation"]["runs"] = 0.into();
            m["simulation"]["drift"]["periods"] = (-1.0).into();
            m["simulation"]["variants"][0]["failure"] =
                json!({"when": {"at_gauge": [0.5, 2.0]}, "working": [8]});
            m["simulation"]["variants"][1]["problem"] = json!({"abortSafe": {"wind": 1}});
            m["simulation"]["compared"] = json!([["moon", "sun"]]);
        });
        for part in
            ["simulation.runs", "periods", "thrusters 0 to 7", "at_gauge", "wind", "moon", "sun"]
        {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
        let text = refusal("perturbed_55", |m| {
            let orbit = &mut m["problem"]["abortSafe"]["orbit"];
            orbit.as_object_mut().expect("an orbit").remove("epoch");
            m["simulation"]["initial_state"]["ring"]["radius_m"] = json!([6000.0, 3000.0]);
        });
        for part in ["epoch", "radius_m"] {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
    }

    #[test]
    fn abort_problems_that_cannot_be_judged_are_refused() {
        for (change, part) in [
            (json!({"frame": "FRAME_LVLH_CCSDS"}), "frame"),
            (json!({"massKg": -1.0}), "mass_kg"),
            (json!({"thrusters": null}), "thrusters"),
            (json!({"phases": []}), "phases"),
            (json!({"orbit": {"elements": {"eccentricity": 1.0}}}), "eccentricity"),
            (json!({"orbit": {"epoch": {"calendar": "yesterday"}}}), "epoch"),
        ] {
            let text = refusal("perturbed_55", |m| merge(&mut m["problem"]["abortSafe"], &change));
            assert!(text.contains(part), "{part} is missing in {text}");
        }
    }

    #[test]
    fn abort_unknown_fields_and_truncated_text_are_refused() {
        assert!(refusal("iss", |m| m["simulation"]["wind"] = 1.into()).contains("wind"));
        let inside = refusal("iss", |m| m["simulation"]["variants"][0]["wind"] = 1.into());
        assert!(inside.contains("wind"), "{inside}");
        let text = file("iss").to_string();
        for length in (0..text.len()).step_by(97) {
            assert!(AbortMission::parse(&text[..length]).is_err(), "{length}");
        }
    }
}
