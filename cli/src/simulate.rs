//! `vbar simulate`.

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use clap::{Args, ValueEnum};
use vbar_client::v1::HorizonSearch;
use vbar_simulator::{
    AbortMission, AbortRunOptions, Mission, MissionFile, PlanMission, PlanRunOptions, ProgressBar,
    Report, RunOptions, SamplingMission, SamplingRunOptions, draw,
};

use crate::{
    failure::Failure,
    flights::{self, Telling},
    json,
    mission::MissionArguments,
    plans::ChangeArguments,
    session::Session,
};

/// The report goes to standard output; pictures and traces go to a folder, whose files are named
/// on standard error.
#[derive(Debug, Args)]
pub(crate) struct SimulateArguments {
    #[command(flatten)]
    mission: MissionArguments,
    /// How the horizon is searched instead of the mission's own way
    #[arg(long, value_name = "SEARCH")]
    search: Option<Search>,
    /// Number of runs, from each start where a mission names several [default: the mission's]
    #[arg(long, value_name = "N")]
    runs: Option<u32>,
    /// Start of every stream of chance: the same seed flies the same runs
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Runs in flight at once [default: 16, at most what the node computes at once]
    #[arg(long, value_name = "N")]
    concurrency: Option<NonZeroUsize>,
    /// Fly a named variant of the mission
    #[arg(long, value_name = "NAME")]
    variant: Option<String>,
    /// Turn the thrust by these angles about R, T and N, in degrees, instead of the mission's
    /// disturbance
    #[arg(
        long,
        value_name = "R,T,N",
        value_delimiter = ',',
        num_args = 3,
        allow_negative_numbers = true
    )]
    misalignment_deg: Option<Vec<f64>>,
    /// Ask for every step with both searches and count the answers that differ
    #[arg(long)]
    compare_search: bool,
    /// Sweep the weight of fuel over these values
    #[arg(long, value_name = "W,W,...", value_delimiter = ',')]
    fuel_weights: Vec<f64>,
    /// How to print the report
    #[arg(long, value_name = "FORMAT", default_value = "table")]
    format: Format,
    /// Folder for pictures, traces and the JSON report [default: out/NAME-OF-THE-MISSION]
    #[arg(long, value_name = "DIRECTORY")]
    out: Option<PathBuf>,
    /// Only print the report: no pictures, and none of the runs that only they need
    #[arg(long, conflicts_with = "out")]
    no_pictures: bool,
    #[command(flatten)]
    changes: ChangeArguments,
}

impl SimulateArguments {
    /// How the flights of mission `name` are reported.
    fn telling(&self, name: &str) -> Telling {
        let folder = || self.out.clone().unwrap_or_else(|| Path::new("out").join(name));
        Telling { format: self.format, out: (!self.no_pictures).then(folder) }
    }

    /// Changes of a plan mean nothing for other missions.
    fn refuse_changes(&self) -> Result<(), Failure> {
        match self.changes.given() {
            Some(name) => Err(Failure::usage(format!("{name} is not for this mission"))),
            None => Ok(()),
        }
    }

    /// Options of closed loops with a variable horizon alone, and whether they were given.
    fn horizon_options(&self) -> [(&'static str, bool); 4] {
        [
            ("--search", self.search.is_some()),
            ("--misalignment-deg", self.misalignment_deg.is_some()),
            ("--compare-search", self.compare_search),
            ("--fuel-weights", !self.fuel_weights.is_empty()),
        ]
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Search {
    /// From a guess to the nearest feasible horizon, then downhill
    Local,
    /// Every horizon that could still be better
    Enumeration,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum Format {
    /// For people
    Table,
    /// For programs
    Json,
}

/// Flies a mission and reports.
pub(crate) async fn simulate(arguments: SimulateArguments) -> Result<(), Failure> {
    let mission = match arguments.mission.load()? {
        MissionFile::AbortSafe(mission) => return fly_aborts(&mission, arguments).await,
        MissionFile::DisturbanceFeedback(mission) => return fly_plans(&mission, arguments).await,
        MissionFile::OfflineSampling(mission) => return fly_sampling(&mission, arguments).await,
        MissionFile::VariableHorizon(mission) => *mission,
    };
    if let Some(name) = arguments.changes.given() {
        return Err(Failure::usage(format!("{name} is not for a closed-loop mission")));
    }
    let options = options(&arguments)?;
    let session = Session::open(&arguments.mission.node).await?;
    let progress = ProgressBar::default();
    let flown = vbar_simulator::simulate(&session.client, &mission, &options, &progress).await;
    session.close().await;
    let report = flown.map_err(failure)?;
    match arguments.format {
        Format::Table => json::print(&report.table())?,
        Format::Json => json::print(&format!("{:#}", report.json()))?,
    }
    if !arguments.no_pictures {
        let folder = arguments.out.unwrap_or_else(|| Path::new("out").join(&mission.name));
        tell_pictures(&mission, &report, &folder)?;
    }
    Ok(())
}

/// Flies a mission under abort-safe control.
async fn fly_aborts(mission: &AbortMission, arguments: SimulateArguments) -> Result<(), Failure> {
    arguments.refuse_changes()?;
    arguments.mission.refuse(arguments.horizon_options())?;
    let telling = arguments.telling(&mission.name);
    let options = AbortRunOptions {
        runs: arguments.runs,
        seed: arguments.seed,
        concurrency: arguments.concurrency,
        variant: arguments.variant,
    };
    flights::fly(&arguments.mission.node, &telling, async |client, progress| {
        let flown = vbar_simulator::fly_aborts(client, mission, &options, progress).await;
        flown.map(flights::of_aborts)
    })
    .await
}

/// Flies the plans of a mission with disturbance feedback.
async fn fly_plans(mission: &PlanMission, arguments: SimulateArguments) -> Result<(), Failure> {
    arguments.mission.refuse(arguments.horizon_options())?;
    let telling = arguments.telling(&mission.name);
    let options = PlanRunOptions {
        runs: arguments.runs,
        seed: arguments.seed,
        concurrency: arguments.concurrency,
        variant: arguments.variant,
        with_pictures: !arguments.no_pictures,
        changes: arguments.changes.changes(),
    };
    flights::fly(&arguments.mission.node, &telling, async |client, progress| {
        let flown = vbar_simulator::fly_plans(client, mission, &options, progress).await;
        flown.map(flights::of_plans)
    })
    .await
}

/// Flies a mission under sampled chance constraints.
async fn fly_sampling(
    mission: &SamplingMission,
    arguments: SimulateArguments,
) -> Result<(), Failure> {
    arguments.refuse_changes()?;
    let foreign = arguments.horizon_options().into_iter().find(|(_, given)| *given);
    if let Some((name, _)) = foreign {
        return Err(Failure::usage(format!("{name} is not for this mission")));
    }
    let telling = arguments.telling(&mission.name);
    let options = SamplingRunOptions {
        scheme: arguments.mission.scheme()?,
        repetitions: arguments.runs,
        seed: arguments.seed,
        concurrency: arguments.concurrency,
        variant: arguments.variant,
    };
    flights::fly(&arguments.mission.node, &telling, async |client, progress| {
        let flown = vbar_simulator::fly_sampling(client, mission, &options, progress).await;
        flown.map(flights::of_sampling)
    })
    .await
}

fn options(arguments: &SimulateArguments) -> Result<RunOptions, Failure> {
    let misalignment_deg = match arguments.misalignment_deg.as_deref() {
        None => None,
        Some(&[r, t, n]) => Some([r, t, n]),
        Some(other) => {
            let message = format!("--misalignment-deg: three angles, got {}", other.len());
            return Err(Failure::usage(message));
        }
    };
    Ok(RunOptions {
        scheme: arguments.mission.scheme()?,
        search: arguments.search.map(|search| match search {
            Search::Local => HorizonSearch::Local,
            Search::Enumeration => HorizonSearch::Enumeration,
        }),
        runs: arguments.runs,
        seed: arguments.seed,
        concurrency: arguments.concurrency,
        variant: arguments.variant.clone(),
        misalignment_deg,
        compare_search: arguments.compare_search,
        fuel_weights: arguments.fuel_weights.clone(),
        with_pictures: !arguments.no_pictures,
    })
}

fn tell_pictures(mission: &Mission, report: &Report, folder: &Path) -> Result<(), Failure> {
    let drawn = draw(mission, report, folder)
        .map_err(|fault| Failure::cannot_write(format!("{}: {fault}", folder.display())))?;
    tell(&drawn, folder);
    Ok(())
}

/// Names what was written.
pub(crate) fn tell(written: &[PathBuf], folder: &Path) {
    eprintln!("{} files in {}:", written.len(), folder.display());
    for path in written {
        eprintln!("  {}", path.display());
    }
}

pub(crate) fn failure(error: vbar_simulator::SimulationError) -> Failure {
    use vbar_simulator::SimulationError as Error;
    let message = error.to_string();
    match error {
        Error::Options(_) => Failure::usage(message),
        Error::Client { run, source } => Failure::from(source).in_run(run),
        Error::Mission(_) | Error::NoStart { .. } => Failure::data(message),
        Error::Answer { .. } | Error::Task(_) => Failure::ours(message),
    }
}
