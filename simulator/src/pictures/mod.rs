//! Pictures of a report, as SVG files.
//!
//! Which are drawn follows from what was flown: a spacecraft gets its trajectory, positions,
//! snapshots of the cone; a plane plant gets its sets; several schemes get box plots.

pub(crate) mod abort;
mod chart;
pub(crate) mod plan;
mod plane;
mod region;
mod rendezvous;
pub(crate) mod sampling;
mod series;

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use plotters::{drawing::DrawingAreaErrorKind, style::RGBColor};
use vbar_proto::v1::VariableHorizonScheme as Scheme;

use crate::{
    campaign::{Campaign, Flight},
    mission::{Mission, model::Kind},
    report::Report,
};

/// Why a picture could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// A file could not be written.
    #[error("a picture could not be written: {0}")]
    Io(#[from] io::Error),
    /// The drawing library refused.
    #[error("a picture could not be drawn: {0}")]
    Drawing(String),
}

impl<E: std::error::Error + Send + Sync> From<DrawingAreaErrorKind<E>> for PictureError {
    fn from(fault: DrawingAreaErrorKind<E>) -> Self {
        Self::Drawing(fault.to_string())
    }
}

/// Draws every picture that `report` has the data for, into the folder `out`; returns the files.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn draw(mission: &Mission, report: &Report, out: &Path) -> Result<Vec<PathBuf>, PictureError> {
    fs::create_dir_all(out)?;
    let file = |what: &str| out.join(format!("{}_{what}.svg", mission.name));
    let mut written = Vec::new();
    let Some(main) = report.campaigns.first() else { return Ok(written) };
    // One run in detail: the variant made for it, else run 0 of every scheme.
    let detail = if report.detailed.is_empty() { &report.campaigns } else { &report.detailed };
    let Some(flight) = detail.first().and_then(|campaign| campaign.flights.first()) else {
        return Ok(written);
    };
    match &flight.model.kind {
        Kind::Hill(hill) => {
            written.push(rendezvous::trajectory(&file("trajectory"), mission, detail, hill)?);
            written.push(rendezvous::positions(&file("positions"), mission, main)?);
            if hill.cone.is_some() {
                written.push(rendezvous::snapshots(&file("cone_snapshots"), mission, flight)?);
            }
        }
        Kind::Linear(_) if flight.model.states() == 2 => {
            written.push(plane::final_states(&file("final_states"), mission, &report.campaigns)?);
            written.push(plane::trajectories(&file("trajectories"), mission, detail)?);
        }
        Kind::Linear(_) => {}
    }
    written.push(series::inputs(&file("inputs"), mission, main)?);
    written.push(series::cost_and_horizon(&file("cost_horizon"), mission, &detail[0])?);
    let arrives = |campaign: &Campaign| campaign.flights.iter().any(Flight::arrived);
    if report.campaigns.iter().filter(|campaign| arrives(campaign)).count() > 1 {
        written.push(series::boxes(&file("schemes"), mission, &report.campaigns)?);
    }
    if !report.sweep.is_empty() {
        written.push(series::sweep(&file("fuel_weight"), mission, &report.sweep)?);
    }
    Ok(written)
}

/// A scheme's name in a legend, and its colour in every picture.
fn appearance(scheme: Scheme) -> (&'static str, RGBColor) {
    match scheme {
        Scheme::AdaptiveTerminal => ("adaptive terminal", chart::BLUE),
        Scheme::TubeOptimalControl => ("tube optimal control", chart::GREEN),
        Scheme::FixedTerminal => ("fixed terminal", chart::VERMILION),
        Scheme::Nominal => ("nominal", chart::PURPLE),
        Scheme::Unspecified => ("unnamed", chart::INK),
    }
}

/// One legend entry a scheme.
fn scheme_legend<'a>(
    campaigns: impl IntoIterator<Item = &'a Campaign>,
    mark: chart::Mark,
) -> Vec<chart::Entry> {
    let entry = |campaign: &Campaign| {
        let (name, color) = appearance(campaign.scheme);
        (name, mark, color)
    };
    campaigns.into_iter().map(entry).collect()
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, time::Duration};

    use nalgebra::{DMatrix, DVector};
    use serde_json::Value;
    use vbar_proto::v1::{self, Branch, VariableHorizonArtifact};

    use super::*;
    use crate::{
        campaign::{
            SweepPoint,
            flight::{Outcome, Sample, Step},
            vehicle,
        },
        mission::model::Model,
        tests::{golden_cases, vector},
    };

    /// A recorded loop as if it had been flown: nothing in it is made up.
    fn recorded(trace: &Value, model: &Arc<Model>) -> Flight {
        let steps = trace["steps"].as_array().expect("steps");
        let states = steps.iter().map(|step| &step["x"]).chain([&trace["x_final"]]);
        let sample = |(k, scaled): (usize, &Value)| {
            let scaled = vector(scaled);
            let state = match &model.kind {
                Kind::Hill(hill) => DVector::from_column_slice(hill.to_si(&scaled).as_slice()),
                Kind::Linear(_) => scaled,
            };
            Sample {
                margin_nd: vehicle::state_margin_nd(model, k, &state),
                state: state.as_slice().to_vec(),
                reference: vehicle::reference(model, k).expect("k").as_slice().to_vec(),
            }
        };
        let step = |step: &Value| Step {
            input: vector(&step["u_used"]).as_slice().to_vec(),
            input_margin_nd: 0.0,
            cost: step["J"].as_f64().expect("J"),
            horizon: step["N"].as_i64().expect("N") as i32,
            branch: match step["branch"].as_str() {
                Some("F" | "C2") => Branch::TerminalSet,
                _ => Branch::TerminalPoint,
            },
            adapted_step: 0,
            adapted_horizon: 3,
            general_solver_calls: 0,
            certified: true,
            outside_assumed_set: false,
            latency: Duration::ZERO,
        };
        Flight {
            run: 0,
            redraws: 0,
            outcome: Outcome::Arrived,
            samples: states.enumerate().map(sample).collect(),
            steps: steps.iter().map(step).collect(),
            first_prediction: None,
            final_set_radius: None,
            model: model.clone(),
        }
    }

    fn artifact(case: &Value) -> VariableHorizonArtifact {
        let message = |rows: &Value| {
            let rows: Vec<DVector<f64>> =
                rows.as_array().expect("rows").iter().map(vector).collect();
            Some(v1::Matrix {
                rows: rows.len() as i32,
                columns: rows[0].len() as i32,
                values: rows.iter().flat_map(|row| row.as_slice().to_vec()).collect(),
            })
        };
        VariableHorizonArtifact {
            a: message(&case["A"]),
            b: message(&case["B"]),
            gain: message(&case["K"]),
            disturbance_generators_nd: message(&case["W_generators"]),
            ..VariableHorizonArtifact::default()
        }
    }

    fn mission(name: &str) -> Mission {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        Mission::load(&folder.join(name)).expect(name)
    }

    fn drawn(mission: Mission, campaigns: Vec<Campaign>, sweep: Vec<SweepPoint>) -> Vec<String> {
        let folder = tempfile::tempdir().expect("a folder");
        let report = Report::new(mission.clone(), 1, campaigns, Vec::new(), sweep, None);
        let files = draw(&mission, &report, folder.path()).expect("pictures");
        let mut names = Vec::new();
        for file in files {
            let text = fs::read_to_string(&file).expect("a file");
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"), "{file:?}");
            assert!(!text.contains("NaN"), "{file:?}");
            assert!(text.matches("<poly").count() > 3, "{file:?} shows nothing");
            names.push(file.file_name().and_then(|n| n.to_str()).expect("a name").to_owned());
        }
        names
    }

    #[test]
    fn pictures_of_a_recorded_rendezvous() {
        let traces = golden_cases("traces_atc.json");
        let trace = traces.iter().find(|trace| trace["id"] == "trace_env_-x").expect("the trace");
        let mission = mission("envisat.json");
        let mut problem = mission.problem.clone();
        // The recorded loop has its docking axis along -x.
        if let Some(inner) = crate::mission::variable_horizon_mut(&mut problem)
            && let Some(v1::variable_horizon_problem::Plant::Hill(hill)) = &mut inner.plant
        {
            hill.capture_point_m = vec![-1.5, 0.0, 0.0];
        }
        let model = Arc::new(Model::new(&problem).expect("a model"));
        let case = &golden_cases("envisat_p0.json")[0];
        let campaign = |scheme| Campaign {
            scheme,
            flights: vec![recorded(trace, &model)],
            artifact: artifact(case),
        };
        let campaigns =
            vec![campaign(Scheme::AdaptiveTerminal), campaign(Scheme::TubeOptimalControl)];
        let point = |fuel_weight: f64| SweepPoint {
            fuel_weight,
            fuel: 40.0 - fuel_weight,
            completion_steps: 20.0 + fuel_weight,
            arrived: 1,
        };
        let names = drawn(mission, campaigns, [0.0, 3.0, 6.0].map(point).to_vec());
        let expected = [
            "trajectory",
            "positions",
            "cone_snapshots",
            "inputs",
            "cost_horizon",
            "schemes",
            "fuel_weight",
        ];
        assert_eq!(names, expected.map(|what| format!("envisat_{what}.svg")));
    }

    #[test]
    fn pictures_of_recorded_plane_loops() {
        let traces = golden_cases("traces_003_ftc_special.json");
        let named = |id: &str| traces.iter().find(|trace| trace["id"] == id).expect("the trace");
        let mission = mission("double_integrator.json");
        let model = Arc::new(Model::new(&mission.problem).expect("a model"));
        let case = &golden_cases("double_integrator_003.json")[0];
        let campaign = |scheme, id: &str| Campaign {
            scheme,
            flights: vec![recorded(named(id), &model)],
            artifact: artifact(case),
        };
        let campaigns = vec![
            campaign(Scheme::AdaptiveTerminal, "di_0_const_gz0.02_gv1"),
            campaign(Scheme::FixedTerminal, "di_1_uni_ftcs"),
        ];
        let names = drawn(mission, campaigns, Vec::new());
        let expected = ["final_states", "trajectories", "inputs", "cost_horizon", "schemes"];
        assert_eq!(names, expected.map(|what| format!("double_integrator_{what}.svg")));
    }

    /// The recorded loops give the recorded figures: distance, norm, and no violation.
    #[test]
    fn report_of_recorded_loops_has_their_figures() {
        let model = Arc::new(Model::new(&mission("double_integrator.json").problem).expect("one"));
        let traces = golden_cases("traces_003_ftc_special.json");
        let trace = traces.iter().find(|t| t["id"] == "di_0_const_gz0.02_gv1").expect("the trace");
        let flight = recorded(trace, &model);
        // The recorded end; [Quartullo2025b, sec. 4.1] says 1.45.
        assert!((flight.final_distance() - 1.294_f64.hypot(0.661)).abs() < 1e-12);
        assert_eq!(flight.first_violation(), None);
        assert_eq!(flight.steps.len(), 25);
    }

    #[test]
    fn shadows_of_matrices_keep_their_shape() {
        let case = &golden_cases("double_integrator_003.json")[0];
        let sets = crate::campaign::sets::ErrorSets::new(&artifact(case)).expect("it fits");
        assert_eq!(sets.generators(2).shape(), (2, 4));
        assert_eq!(sets.generators(0), DMatrix::zeros(2, 0));
    }
}
