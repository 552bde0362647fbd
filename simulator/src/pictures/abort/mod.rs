//! Flights under abort-safe control: paths with their free drifts [AguilarMarsillach2022, figs.
//! 8-11], before and after a failure [figs. 12-13], where states stand to the unsafe sets [fig. 16],
//! forces [fig. 17], and variants beside each other [fig. 7].

mod paths;
mod series;

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::PictureError;
use crate::{
    campaign::abort::{AbortCampaign, AbortFlight},
    report::abort::AbortReport,
};

/// Draws every picture that `report` has the data for, into the folder `out`; returns the files.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn draw_aborts(report: &AbortReport, out: &Path) -> Result<Vec<PathBuf>, PictureError> {
    fs::create_dir_all(out)?;
    let file = |what: &str| out.join(format!("{}_{what}.svg", report.mission.name));
    let flown = || report.campaigns.iter().filter(|campaign| !campaign.flights.is_empty());
    let mut written = Vec::new();
    for campaign in flown() {
        let name = &campaign.case.name;
        let trajectory = file(&format!("{name}_trajectory"));
        written.push(match campaign.flights.iter().any(|flight| flight.failure.is_some()) {
            true => paths::failures(&trajectory, report, campaign)?,
            false => paths::approach(&trajectory, report, campaign)?,
        });
        if campaign.flights.iter().any(AbortFlight::is_judged) {
            written.push(series::safety(&file(&format!("{name}_safety")), report, campaign)?);
        }
        written.push(series::inputs(&file(&format!("{name}_inputs")), report, campaign)?);
    }
    for names in &report.mission.simulation.compared {
        let found = |name: &String| flown().find(|campaign| campaign.case.name == *name);
        if let (Some(first), Some(second)) = (found(&names[0]), found(&names[1])) {
            let pair = file(&format!("{}_beside_{}", names[0], names[1]));
            written.push(paths::compared(&pair, report, [first, second])?);
        }
    }
    Ok(written)
}

impl AbortFlight {
    /// Something is known about where its states stand to unsafe sets.
    fn is_judged(&self) -> bool {
        self.samples
            .iter()
            .any(|sample| !(sample.drifts.is_empty() && sample.unsafe_sets.is_empty()))
    }
}

/// Names of the mission and of a variant.
fn title(report: &AbortReport, campaign: &AbortCampaign) -> String {
    format!("{} {}", report.mission.name, campaign.case.name)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use nalgebra::{Vector3, Vector6};
    use vbar_proto::v1;

    use super::*;
    use crate::{
        campaign::abort::{
            AbortOutcome, AbortSample, AbortStep, FlownFailure, ModeCounts, Origin,
            judge::{Judge, World},
        },
        mission::AbortMission,
    };

    fn mission(name: &str) -> AbortMission {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        AbortMission::load(&folder.join(name)).expect(name)
    }

    /// The simulator's own truth under forces of its own: `steps` times a push that brakes and
    /// pulls towards the target, with every state judged.
    fn flown(
        mission: &AbortMission,
        variant: &str,
        start: Vector6<f64>,
        steps: u32,
    ) -> AbortCampaign {
        let case = mission.case(variant).expect("a variant");
        let world = World::new(mission, &case).expect("a world");
        let judge = Judge::new(mission, &case).expect("a judge");
        let mut flight = AbortFlight {
            run: 0,
            redraws: 0,
            outcome: AbortOutcome::StepsFlown,
            samples: Vec::new(),
            steps: Vec::new(),
            failure: None,
        };
        let mut state = start;
        for k in 0..=steps {
            let drifts = judge.drifts(k, &state, 0);
            let gauge = judge.gauge(0, &state).unwrap_or(f64::INFINITY);
            let unsafe_sets = vec![gauge < 2.0, false];
            flight.samples.push(AbortSample { state: state.into(), phase: 0, drifts, unsafe_sets });
            let way = Vector3::new(state[0], state[1], state[2]);
            let speed = Vector3::new(state[3], state[4], state[5]);
            let force = (way * -4e-3 - speed * 8.0).map(|push| push.clamp(-20.0, 20.0));
            flight.steps.push(AbortStep {
                force_n: force.into(),
                phase: 0,
                origin: Origin::Command,
                softened: false,
                certified: true,
                next: ModeCounts::default(),
                latency: Duration::ZERO,
            });
            state = world.advance(k, &state, &force);
        }
        flight.steps.pop();
        AbortCampaign {
            case,
            artifact: v1::AbortSafeArtifact::default(),
            artifact_bytes: 0,
            flights: vec![flight],
            judged_by: mission.simulation.drift.truths.clone(),
        }
    }

    /// 5 km ahead, rising: half a revolution later the drift crosses the target's place, for a
    /// mean motion of about 1e-3 rad/s.
    fn drifting_in() -> Vector6<f64> {
        Vector6::new(0.0, 5000.0, 0.0, 1.25, 0.0, 0.0)
    }

    fn drawn(mission: &AbortMission, campaigns: Vec<AbortCampaign>) -> Vec<(String, String)> {
        let folder = tempfile::tempdir().expect("a folder");
        let report = AbortReport { mission: mission.clone(), seed: 1, runs: 1, campaigns };
        let files = draw_aborts(&report, folder.path()).expect("pictures");
        let read = |file: PathBuf| {
            let text = fs::read_to_string(&file).expect("a file");
            assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"), "{file:?}");
            assert!(!text.contains("NaN"), "{file:?}");
            assert!(text.matches("<poly").count() > 3, "{file:?} shows nothing");
            let name = file.file_name().and_then(|name| name.to_str()).expect("a name");
            (name.to_owned(), text)
        };
        files.into_iter().map(read).collect()
    }

    #[test]
    fn pictures_of_an_approach_show_where_it_would_drift() {
        let mission = mission("vbar_elliptic.json");
        let pictures = drawn(&mission, vec![flown(&mission, "safe", drifting_in(), 40)]);
        let names: Vec<&str> = pictures.iter().map(|(name, _)| name.as_str()).collect();
        let expected = ["trajectory", "safety", "inputs"];
        assert_eq!(names, expected.map(|what| format!("vbar_elliptic_safe_{what}.svg")));
        // At rest none does.
        let legend = |text: &str| text.contains("drift into the region");
        assert!(legend(&pictures[0].1));
        let still = Vector6::new(0.0, 5000.0, 0.0, 0.0, 0.0, 0.0);
        let pictures = drawn(&mission, vec![flown(&mission, "safe", still, 1)]);
        assert!(!legend(&pictures[0].1));
    }

    #[test]
    fn pictures_of_a_failure_count_the_entries() {
        let mission = mission("vbar_elliptic.json");
        let mut campaign = flown(&mission, "safe", drifting_in(), 1);
        let judge = Judge::new(&mission, &campaign.case).expect("a judge");
        let flight = &mut campaign.flights[0];
        let last = flight.samples.last_mut().expect("a sample");
        flight.failure = Some(FlownFailure {
            step: flight.steps.len(),
            working: Vec::new(),
            gauge: judge.gauge(0, &Vector6::from(last.state)),
            abort: None,
            steps_without_abort: 0,
            after: last.drifts.clone(),
        });
        let entered = flight.entered();
        assert!(entered, "it drifts in");
        let pictures = drawn(&mission, vec![campaign]);
        assert!(pictures[0].1.contains("1 of 1 run enter"), "{}", pictures[0].0);
    }

    #[test]
    fn pictures_of_compared_variants_lie_beside_the_others() {
        let mission = mission("vbar_elliptic.json");
        let start = Vector6::new(0.0, 5000.0, 0.0, 0.0, 0.0, 0.0);
        let pair = ["circular_tangent", "circular_cone"];
        let campaigns = pair.map(|variant| flown(&mission, variant, start, 2));
        let pictures = drawn(&mission, campaigns.to_vec());
        let (name, _) = pictures.last().expect("a picture");
        assert_eq!(name, "vbar_elliptic_circular_tangent_beside_circular_cone.svg");
    }
}
