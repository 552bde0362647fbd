//! Campaigns under abort-safe control: closed loops, failures of thrusters, and where free drift or
//! an abort leads.

pub(crate) mod flight;
pub(crate) mod judge;
mod session;
mod start;

use std::{num::NonZeroUsize, sync::Arc};

use vbar_client::Client;
use vbar_proto::v1::{self, artifact::Summary, precompute_response::Outcome};

use super::{Progress, SimulationError, concurrency, crew::Crew, flight::Patience};
use crate::{
    mission::{
        AbortCase, AbortMission, RUNS_MAX,
        abort::{AbortSimulation, AbortTruth},
    },
    report::abort::AbortReport,
};
pub use flight::{
    AbortFlight, AbortOutcome, AbortSample, AbortStep, FlownFailure, ModeCounts, Origin,
};
pub use judge::{Drift, UnsafeSets};
use judge::{Judge, World};

/// What to fly; the default flies the mission as its file says.
#[derive(Debug, Clone, Default)]
pub struct AbortRunOptions {
    /// Instead of the mission's number of runs.
    pub runs: Option<u32>,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Runs in flight at once, instead of twice what the server computes at once.
    pub concurrency: Option<NonZeroUsize>,
    /// Fly this variant alone.
    pub variant: Option<String>,
}

/// A variant and its flights.
#[derive(Debug, Clone)]
pub struct AbortCampaign {
    /// What was flown.
    pub case: AbortCase,
    /// What the precompute made.
    pub artifact: v1::AbortSafeArtifact,
    /// Size of the artifact's bytes on the node.
    pub artifact_bytes: i64,
    /// In order of run number.
    pub flights: Vec<AbortFlight>,
    /// What drifts are judged under.
    pub(crate) judged_by: Vec<AbortTruth>,
}

/// Flies a mission's variants against a node and measures what comes out.
///
/// # Errors
/// When the options do not fit the mission, a call is not answered, or an answer contradicts the
/// contract. An infeasible run is a result.
pub async fn fly_aborts(
    client: &Client,
    mission: &AbortMission,
    options: &AbortRunOptions,
    progress: &dyn Progress,
) -> Result<AbortReport, SimulationError> {
    let runs = options.runs.unwrap_or(mission.simulation.runs);
    if !(1..=RUNS_MAX).contains(&runs) {
        return Err(SimulationError::Options(format!("runs: 1 to {RUNS_MAX}, got {runs}")));
    }
    let names: Vec<&str> = match &options.variant {
        Some(name) => vec![name.as_str()],
        None => mission.variants().collect(),
    };
    let cases: Result<Vec<AbortCase>, _> =
        names.into_iter().map(|name| mission.case(name)).collect();
    let cases = cases.map_err(|fault| SimulationError::Options(fault.to_string()))?;
    let concurrency = concurrency(client, options.concurrency).await?;
    let crew = Crew { concurrency, client, progress };
    let mut campaigns = Vec::new();
    for case in cases {
        campaigns.push(fly_case(&crew, mission, case, runs, options.seed).await?);
    }
    Ok(AbortReport { mission: mission.clone(), seed: options.seed, runs, campaigns })
}

async fn fly_case(
    crew: &Crew<'_>,
    mission: &AbortMission,
    case: AbortCase,
    runs: u32,
    seed: u64,
) -> Result<AbortCampaign, SimulationError> {
    let made = precompute(crew.client, &case).await?;
    let label = format!("{} {}", mission.name, case.name);
    let flyable = Flyable {
        world: World::new(mission, &case)?,
        judge: Judge::new(mission, &case)?,
        simulation: mission.simulation.clone(),
        artifact_id: made.artifact_id,
        case,
        seed,
    };
    let flyable = Arc::new(flyable);
    let flights = crew
        .each(flyable.clone(), runs, &label, |client, flyable, run| async move {
            flight::fly(&client, &flyable, run).await
        })
        .await?;
    Ok(AbortCampaign {
        case: flyable.case.clone(),
        artifact: made.artifact,
        artifact_bytes: made.size_bytes,
        flights,
        judged_by: mission.simulation.drift.truths.clone(),
    })
}

/// Everything a run needs.
#[derive(Debug)]
pub(crate) struct Flyable {
    pub case: AbortCase,
    pub simulation: AbortSimulation,
    pub artifact_id: String,
    pub world: World,
    pub judge: Judge,
    pub seed: u64,
}

/// An artifact on the node.
struct Made {
    artifact_id: String,
    size_bytes: i64,
    artifact: v1::AbortSafeArtifact,
}

async fn precompute(client: &Client, case: &AbortCase) -> Result<Made, SimulationError> {
    let answer = |what: String| SimulationError::Answer { run: 0, what };
    let mut patience = Patience::new(0);
    let made = loop {
        match client.precompute(case.problem.clone()).await {
            Ok(made) => break made,
            Err(error) => patience.after(error).await?,
        }
    };
    match made.outcome {
        Some(Outcome::Artifact(v1::Artifact {
            artifact_id,
            size_bytes,
            summary: Some(Summary::AbortSafe(artifact)),
            ..
        })) => Ok(Made { artifact_id, size_bytes, artifact }),
        Some(Outcome::Artifact(_)) => Err(answer("an artifact without its summary".into())),
        Some(Outcome::Infeasible(why)) => {
            Err(answer(format!("sets of a region are always there: {}", why.reason)))
        }
        None => Err(answer("a precompute without an outcome".into())),
    }
}
