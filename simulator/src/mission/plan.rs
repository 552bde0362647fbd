//! Missions of fixed-time plans with disturbance feedback [Deaconu2014].
//!
//! `simulation` says how plans are flown:
//!
//! - `runs`: how often;
//! - `truth`: `{"two_body": {"j2": true}}`, both craft in inertial space;
//! - `noise`: where a measurement's error lies in the ellipsoid the problem assumes: `"surface"`,
//!   `"inside"` (uniform), `"none"`;
//! - `variants`: named changes of the problem, each with its own `published` figures;
//! - `flown`: the variants that are flown unless one is asked for; empty: the problem itself;
//! - `table`: the metric and the variants that make up the paper's table.
//!
//! `published` holds the paper's semi-axes of the arrival set in the orbital plane, with feedback
//! and in open loop.

use std::{collections::BTreeMap, path::Path};

use serde::Deserialize;
use vbar_proto::v1::{self, ArrivalMetric, instants::Spacing};

use super::{MissionError, check_name, check_runs, parse_problem, plan_model::PlanModel, read};

/// A parsed and checked mission whose answer is a plan.
#[derive(Debug, Clone)]
pub struct PlanMission {
    /// Short name, used in file names.
    pub name: String,
    /// Provenance.
    pub description: String,
    /// What the service is asked.
    pub problem: v1::Problem,
    /// The paper's figures for this problem.
    pub published: PublishedAxes,
    /// The variant this is, if any.
    pub variant: Option<String>,
    pub(crate) simulation: PlanSimulation,
}

/// Semi-axes of the arrival set in the orbital plane as a paper prints them, longer first.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedAxes {
    /// Which paper and which table.
    #[serde(default)]
    pub source: String,
    /// With disturbance feedback.
    pub feedback_axes_m: Option<[f64; 2]>,
    /// Without.
    pub open_loop_axes_m: Option<[f64; 2]>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanSimulation {
    /// Default number of runs.
    pub runs: u32,
    /// What moves both craft.
    pub truth: PlanTruth,
    /// Where errors of measurements lie.
    pub noise: NoiseLaw,
    /// Variants flown unless one is asked for.
    #[serde(default)]
    pub flown: Vec<String>,
    /// The paper's table.
    pub table: Option<PlanTableLaw>,
    /// Named changes of the problem.
    #[serde(default)]
    pub variants: BTreeMap<String, PlanVariant>,
}

/// What moves both craft.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum PlanTruth {
    /// Newton's law in inertial space, on the problem's own orbit.
    TwoBody {
        /// With the Earth's flattening.
        j2: bool,
    },
}

/// Where the error of a measurement lies in the ellipsoid that the problem assumes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum NoiseLaw {
    /// On its surface, the image of a direction uniform on the unit sphere.
    Surface,
    /// Uniform inside.
    Inside,
    /// In its centre: perfect measurements.
    None,
}

/// Which variants make up a table, and in which metric.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanTableLaw {
    pub metric: String,
    pub variants: Vec<String>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanVariant {
    /// Time from first to last instant.
    duration_s: Option<f64>,
    /// Number N of instants.
    instants: Option<i32>,
    /// Largest impulse an axis.
    delta_v_max_m_s: Option<f64>,
    /// Figures for this variant; the mission's own do not apply to it.
    #[serde(default)]
    published: PublishedAxes,
}

/// Changes of a plan's problem; absent ones leave it as it is.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PlanChanges {
    /// Time from first to last instant.
    pub duration_s: Option<f64>,
    /// Number N of instants; burns at all but the last.
    pub instants: Option<i32>,
    /// Largest impulse along each axis.
    pub delta_v_max_m_s: Option<f64>,
    /// In which variables the arrival set is small.
    pub metric: Option<ArrivalMetric>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanFile {
    name: String,
    description: String,
    problem: serde_json::Value,
    simulation: PlanSimulation,
    #[serde(default)]
    published: PublishedAxes,
}

impl PlanMission {
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
    /// As [`PlanMission::load`].
    pub fn parse(text: &str) -> Result<Self, MissionError> {
        let file: PlanFile = serde_json::from_str(text)?;
        let mission = Self {
            name: file.name,
            description: file.description,
            problem: parse_problem(file.problem)?,
            published: file.published,
            variant: None,
            simulation: file.simulation,
        };
        mission.check()?;
        Ok(mission)
    }

    /// Names of the variants.
    pub fn variants(&self) -> impl Iterator<Item = &str> {
        self.simulation.variants.keys().map(String::as_str)
    }

    /// The variants that make up the paper's table, in its order; empty without a table.
    #[must_use]
    pub fn tabulated(&self) -> &[String] {
        self.simulation.table.as_ref().map_or(&[], |table| &table.variants)
    }

    /// The metric of the paper's table.
    #[must_use]
    pub fn table_metric(&self) -> Option<ArrivalMetric> {
        self.simulation.table.as_ref().and_then(|table| metric_named(&table.metric))
    }

    /// The mission as a variant plans it.
    ///
    /// # Errors
    /// Which variants there are, if none has this name; or what cannot be changed.
    pub fn with_variant(&self, name: &str) -> Result<Self, MissionError> {
        let Some(variant) = self.simulation.variants.get(name) else {
            let known: Vec<&str> = self.variants().collect();
            let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            let fault = format!("no variant is called {name}; there are: {known}");
            return Err(MissionError::Invalid(vec![fault]));
        };
        let mut changed = self.with(&PlanChanges {
            duration_s: variant.duration_s,
            instants: variant.instants,
            delta_v_max_m_s: variant.delta_v_max_m_s,
            metric: None,
        })?;
        changed.published.clone_from(&variant.published);
        changed.variant = Some(name.to_owned());
        Ok(changed)
    }

    /// The mission with some numbers of its problem replaced. The paper's figures stay as long as
    /// only the metric changes.
    ///
    /// # Errors
    /// What cannot be changed: only equally spaced instants have a number and a duration.
    pub fn with(&self, changes: &PlanChanges) -> Result<Self, MissionError> {
        let mut changed = self.clone();
        let Some(inner) = disturbance_feedback_mut(&mut changed.problem) else {
            return Ok(changed);
        };
        if changes.duration_s.is_some() || changes.instants.is_some() {
            let spacing = inner.instants.as_mut().and_then(|instants| instants.spacing.as_mut());
            let Some(Spacing::EqualTime(equal) | Spacing::EqualTrueAnomaly(equal)) = spacing else {
                let fault = "number and duration change only where instants are equally spaced";
                return Err(MissionError::Invalid(vec![fault.into()]));
            };
            equal.duration_s = changes.duration_s.or(equal.duration_s);
            equal.count = changes.instants.unwrap_or(equal.count);
            changed.published = PublishedAxes::default();
        }
        if changes.delta_v_max_m_s.is_some() {
            inner.delta_v_max_m_s = changes.delta_v_max_m_s;
            changed.published = PublishedAxes::default();
        }
        if let Some(metric) = changes.metric {
            inner.set_metric(metric);
        }
        Ok(changed)
    }

    /// In which variables the arrival set is small.
    #[must_use]
    pub fn metric(&self) -> ArrivalMetric {
        match disturbance_feedback(&self.problem).map(v1::DisturbanceFeedbackProblem::metric) {
            // As the contract says.
            None | Some(ArrivalMetric::Unspecified) => ArrivalMetric::Position,
            Some(metric) => metric,
        }
    }

    /// Cost of one m/s of nominal impulse.
    pub(crate) fn fuel_weight(&self) -> f64 {
        // As the contract says where none is given.
        disturbance_feedback(&self.problem).and_then(|inner| inner.fuel_weight).unwrap_or(1.0)
    }

    /// The same mission, its problem as the simulator understands it.
    pub(crate) fn model(&self) -> Result<PlanModel, MissionError> {
        PlanModel::new(&self.problem).map_err(MissionError::Invalid)
    }

    fn check(&self) -> Result<(), MissionError> {
        let mut faults = Vec::new();
        check_name(&self.name, &mut faults);
        check_runs("simulation.runs", self.simulation.runs, &mut faults);
        let table = self.simulation.table.as_ref();
        if let Some(table) = table
            && metric_named(&table.metric).is_none()
        {
            faults.push(format!("simulation.table.metric: no metric is called {}", table.metric));
        }
        let places = [("flown", self.simulation.flown.as_slice()), ("table", self.tabulated())];
        for (place, names) in places {
            for name in names.iter().filter(|name| !self.simulation.variants.contains_key(*name)) {
                faults.push(format!("simulation.{place}: no variant is called {name}"));
            }
        }
        let PlanTruth::TwoBody { j2 } = self.simulation.truth;
        match PlanModel::new(&self.problem) {
            Err(model_faults) => faults.extend(model_faults),
            Ok(model) if j2 && !model.oriented => {
                let reason = "J2 needs the orbit's inclination, node and argument of perigee";
                faults.push(format!("simulation.truth.two_body.j2: {reason}"));
            }
            Ok(_) => {}
        }
        for name in self.variants() {
            let place = format!("simulation.variants.{name}");
            let changed = self.with_variant(name).and_then(|variant| variant.model());
            if let Err(MissionError::Invalid(inner)) = changed {
                faults.extend(inner.into_iter().map(|fault| format!("{place}: {fault}")));
            }
        }
        if faults.is_empty() { Ok(()) } else { Err(MissionError::Invalid(faults)) }
    }
}

const METRIC_PREFIX: &str = "ARRIVAL_METRIC_";

/// The metric whose name on the wire ends in `name`.
#[must_use]
pub fn metric_named(name: &str) -> Option<ArrivalMetric> {
    let name = name.to_ascii_uppercase().replace('-', "_");
    ArrivalMetric::from_str_name(&format!("{METRIC_PREFIX}{name}"))
        .filter(|metric| *metric != ArrivalMetric::Unspecified)
}

/// The short name of a metric, as in reports and on the command line.
#[must_use]
pub fn metric_name(metric: ArrivalMetric) -> &'static str {
    metric.as_str_name().trim_start_matches(METRIC_PREFIX)
}

/// The disturbance-feedback arm of a problem.
pub(crate) fn disturbance_feedback(
    problem: &v1::Problem,
) -> Option<&v1::DisturbanceFeedbackProblem> {
    match &problem.method {
        Some(v1::problem::Method::DisturbanceFeedback(inner)) => Some(inner),
        _ => None,
    }
}

/// The same, to be changed.
fn disturbance_feedback_mut(
    problem: &mut v1::Problem,
) -> Option<&mut v1::DisturbanceFeedbackProblem> {
    match &mut problem.method {
        Some(v1::problem::Method::DisturbanceFeedback(inner)) => Some(inner),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prisma() -> serde_json::Value {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/missions/prisma.json");
        serde_json::from_str(&std::fs::read_to_string(path).expect("prisma.json")).expect("JSON")
    }

    fn refusal(change: impl FnOnce(&mut serde_json::Value)) -> String {
        let mut json = prisma();
        change(&mut json);
        PlanMission::parse(&json.to_string()).expect_err("must be refused").to_string()
    }

    #[test]
    fn plan_mission_variants_change_what_they_name() {
        let mission = PlanMission::parse(&prisma().to_string()).expect("a mission");
        let printed = mission.with_variant("6000s_as_printed").expect("a variant");
        let model = printed.model().expect("a model");
        assert_eq!(model.elapsed_s.last(), Some(&6000.0));
        assert_eq!(model.delta_v_max_m_s, 0.26);
        let six = mission.with_variant("18000s_n6").expect("a variant").model().expect("a model");
        assert_eq!(six.elapsed_s.len(), 6);
        assert_eq!(six.elapsed_s[1], 3600.0);
    }

    #[test]
    fn plan_mission_loses_the_papers_figures_with_the_papers_problem() {
        let mission = PlanMission::parse(&prisma().to_string()).expect("a mission");
        let column = mission.with_variant("9000s").expect("a variant");
        assert_eq!(column.published.feedback_axes_m, Some([5.77, 3.53]));
        let metric = PlanChanges { metric: Some(ArrivalMetric::Scaled6), ..Default::default() };
        assert!(column.with(&metric).expect("a metric").published.feedback_axes_m.is_some());
        let longer = PlanChanges { duration_s: Some(9001.0), ..Default::default() };
        assert_eq!(column.with(&longer).expect("a time").published, PublishedAxes::default());
    }

    #[test]
    fn plan_mission_faults_are_reported_together() {
        let text = refusal(|m| {
            m["simulation"]["runs"] = 0.into();
            m["simulation"]["flown"] = serde_json::json!(["moon"]);
            m["simulation"]["table"]["metric"] = "FANCY".into();
            m["simulation"]["variants"]["9000s"]["duration_s"] = (-1.0).into();
            m["problem"]["disturbanceFeedback"]["orbit"]["elements"]["eccentricity"] = 1.5.into();
        });
        for part in ["simulation.runs", "moon", "FANCY", "variants.9000s", "eccentricity"] {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
    }

    #[test]
    fn plan_mission_with_j2_needs_an_orientation() {
        let text = refusal(|m| {
            let elements = &mut m["problem"]["disturbanceFeedback"]["orbit"]["elements"];
            for field in ["inclinationDeg", "raanDeg", "argumentOfPerigeeDeg", "frame"] {
                elements.as_object_mut().expect("elements").remove(field);
            }
        });
        assert!(text.contains("j2"), "{text}");
    }

    #[test]
    fn plan_mission_unknown_fields_and_truncated_text_are_refused() {
        assert!(refusal(|m| m["simulation"]["wind"] = 1.into()).contains("wind"));
        let variant = refusal(|m| m["simulation"]["variants"]["9000s"]["wind"] = 1.into());
        assert!(variant.contains("wind"), "{variant}");
        let text = prisma().to_string();
        for length in (0..text.len()).step_by(97) {
            assert!(PlanMission::parse(&text[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn metric_names_are_those_of_the_contract() {
        for metric in [ArrivalMetric::Position, ArrivalMetric::Scaled6, ArrivalMetric::Physical6] {
            assert_eq!(metric_named(metric_name(metric)), Some(metric));
        }
        assert_eq!(metric_named("scaled-6"), Some(ArrivalMetric::Scaled6));
        assert_eq!(metric_named("UNSPECIFIED"), None);
    }
}
