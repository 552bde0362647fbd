//! Campaigns under sampled chance constraints: every controller from every start, many times.

pub(crate) mod flight;
pub(crate) mod vehicle;

use std::{num::NonZeroUsize, sync::Arc};

use vbar_client::Client;
use vbar_proto::v1::{self, OfflineSamplingScheme as Scheme};

use super::{Progress, SimulationError, concurrency, crew::Crew, flight::make};
use crate::{
    mission::{
        MissionError, RUNS_MAX, SamplingMission,
        sampling::{sampling_scheme_name, sampling_scheme_named, without_first_step_set},
        sampling_law::AttitudeLaw,
        sampling_model::SamplingModel,
    },
    report::sampling::SamplingReport,
};
pub use flight::{SamplingFlight, SamplingOutcome, SamplingSample, SamplingStep};

/// Which controllers are flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SamplingSchemeChoice {
    /// This one.
    One(Scheme),
    /// Every controller the mission compares, its own first.
    All,
}

impl std::str::FromStr for SamplingSchemeChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.eq_ignore_ascii_case("all") {
            return Ok(Self::All);
        }
        sampling_scheme_named(text).map(Self::One).ok_or_else(|| {
            format!("{text} is not OFFLINE_SAMPLING, LINEAR_QUADRATIC, TUBE_ROBUST or all")
        })
    }
}

/// What to fly; the default flies the mission as its file says.
#[derive(Debug, Clone, Default)]
pub struct SamplingRunOptions {
    /// Instead of all that the mission compares.
    pub scheme: Option<SamplingSchemeChoice>,
    /// Flights from each start, instead of the mission's number.
    pub repetitions: Option<u32>,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Runs in flight at once, instead of twice what the server computes at once.
    pub concurrency: Option<NonZeroUsize>,
    /// Fly this variant of the mission.
    pub variant: Option<String>,
}

/// All flights under one controller.
#[derive(Debug, Clone)]
pub struct SamplingCampaign {
    /// What was flown.
    pub scheme: Scheme,
    /// What its precompute made, or why there is nothing to fly.
    pub prepared: Result<v1::OfflineSamplingArtifact, String>,
    /// In order of run number: the repetitions of the first start, of the second, and so on.
    pub flights: Vec<SamplingFlight>,
}

/// Flies a mission against a node and measures what comes out.
///
/// A start from which the first-step set leaves no first step is flown without that set, and its
/// flights say so.
///
/// # Errors
/// When the options do not fit the mission, a call is not answered, or an answer contradicts the
/// contract. An infeasible controller or run is a result.
pub async fn fly_sampling(
    client: &Client,
    mission: &SamplingMission,
    options: &SamplingRunOptions,
    progress: &dyn Progress,
) -> Result<SamplingReport, SimulationError> {
    let mission = match &options.variant {
        None => mission.clone(),
        Some(name) => mission
            .with_variant(name)
            .map_err(|fault| SimulationError::Options(fault.to_string()))?,
    };
    let repetitions = options.repetitions.unwrap_or(mission.simulation.repetitions);
    let starts = mission.simulation.starts.len();
    let starts = u32::try_from(starts).unwrap_or(u32::MAX);
    let runs = repetitions.saturating_mul(starts);
    if !(1..=RUNS_MAX).contains(&runs) {
        let what = format!("flights: 1 to {RUNS_MAX}, got {repetitions} from {starts} starts");
        return Err(SimulationError::Options(what));
    }
    let concurrency = concurrency(client, options.concurrency).await?;
    let crew = Crew { concurrency, client, progress };
    let attitude = hold(client, &mission).await?;
    let mut campaigns = Vec::new();
    for scheme in chosen(&mission, options)? {
        let problem = mission.problem_under(scheme)?;
        let flyable = Flyable {
            mission: mission.clone(),
            model: SamplingModel::new(&problem).map_err(MissionError::Invalid)?,
            artifact_id: String::new(),
            attitude: attitude.clone(),
            excluded_starts: false,
            repetitions,
            seed: options.seed,
        };
        campaigns.push(fly_scheme(&crew, &problem, flyable, scheme, runs).await?);
    }
    Ok(SamplingReport { mission, seed: options.seed, repetitions, campaigns })
}

fn chosen(
    mission: &SamplingMission,
    options: &SamplingRunOptions,
) -> Result<Vec<Scheme>, SimulationError> {
    match options.scheme {
        None | Some(SamplingSchemeChoice::All) => Ok(mission.compared_schemes()),
        // A baseline's problem lacks what sampling needs.
        Some(SamplingSchemeChoice::One(Scheme::OfflineSampling))
            if mission.scheme() != Scheme::OfflineSampling =>
        {
            let own = sampling_scheme_name(mission.scheme());
            Err(SimulationError::Options(format!("the mission says how to fly {own} only")))
        }
        Some(SamplingSchemeChoice::One(scheme)) => Ok(vec![scheme]),
    }
}

/// Everything a run needs.
#[derive(Debug, Clone)]
struct Flyable {
    mission: SamplingMission,
    model: SamplingModel,
    artifact_id: String,
    attitude: Option<Holding>,
    /// Only starts outside the problem's first-step set are flown, without that set.
    excluded_starts: bool,
    repetitions: u32,
    seed: u64,
}

/// The attitude's controller, ready to fly.
#[derive(Debug, Clone)]
struct Holding {
    law: AttitudeLaw,
    model: SamplingModel,
    artifact_id: String,
}

/// Prepares the attitude's controller, if the mission has one.
async fn hold(
    client: &Client,
    mission: &SamplingMission,
) -> Result<Option<Holding>, SimulationError> {
    let Some(law) = mission.simulation.attitude.clone() else { return Ok(None) };
    let problem = law.problem()?;
    let model = SamplingModel::new(&problem).map_err(MissionError::Invalid)?;
    match make(client, 0, &problem).await? {
        Ok(made) => Ok(Some(Holding { law, model, artifact_id: made.artifact_id })),
        Err(reason) => {
            let fault = format!("simulation.attitude.problem: {reason}");
            Err(MissionError::Invalid(vec![fault]).into())
        }
    }
}

async fn fly_scheme(
    crew: &Crew<'_>,
    problem: &v1::Problem,
    flyable: Flyable,
    scheme: Scheme,
    runs: u32,
) -> Result<SamplingCampaign, SimulationError> {
    let label = format!("{} {}", flyable.mission.name, sampling_scheme_name(scheme));
    let (artifact_id, artifact) = match prepare(crew.client, problem).await? {
        Ok(prepared) => prepared,
        Err(reason) => {
            return Ok(SamplingCampaign { scheme, prepared: Err(reason), flights: Vec::new() });
        }
    };
    let bound = Flyable { artifact_id, ..flyable.clone() };
    let mut flights = fly_runs(crew, bound, (0..runs).collect(), &label).await?;
    if let Some(problem) = without_first_step_set(problem) {
        let refused = |flight: &&SamplingFlight| {
            flight.steps.is_empty() && matches!(flight.outcome, SamplingOutcome::Infeasible(_))
        };
        let again: Vec<u32> = flights.iter().filter(refused).map(|flight| flight.run).collect();
        if !again.is_empty()
            && let Ok((artifact_id, _)) = prepare(crew.client, &problem).await?
        {
            let free = Flyable { artifact_id, excluded_starts: true, ..flyable };
            let label = format!("{label} without first-step set");
            for flight in fly_runs(crew, free, again, &label).await? {
                let run = flight.run as usize;
                flights[run] = flight;
            }
        }
    }
    Ok(SamplingCampaign { scheme, prepared: Ok(artifact), flights })
}

async fn fly_runs(
    crew: &Crew<'_>,
    flyable: Flyable,
    runs: Vec<u32>,
    label: &str,
) -> Result<Vec<SamplingFlight>, SimulationError> {
    let count = u32::try_from(runs.len()).unwrap_or(u32::MAX);
    let shared = Arc::new((flyable, runs));
    crew.each(shared, count, label, |client, shared, index| async move {
        let (flyable, runs) = &*shared;
        flight::fly(&client, flyable, runs[index as usize]).await
    })
    .await
}

/// Name and summary of the artifact of `problem`; the inner error is the service's reason.
async fn prepare(
    client: &Client,
    problem: &v1::Problem,
) -> Result<Result<(String, v1::OfflineSamplingArtifact), String>, SimulationError> {
    let made = match make(client, 0, problem).await? {
        Ok(made) => made,
        Err(reason) => return Ok(Err(reason)),
    };
    match made.summary {
        Some(v1::artifact::Summary::OfflineSampling(summary)) => {
            Ok(Ok((made.artifact_id, summary)))
        }
        _ => {
            let what = "an artifact without its summary".to_owned();
            Err(SimulationError::Answer { run: 0, what })
        }
    }
}
