//! `vbar plan`, `vbar step`, `vbar health`: one call, one answer as JSON.

use std::{
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
    time::Duration,
};

use clap::Args;
use vbar_client::{
    Client, Options,
    v1::{ComputePlanRequest, Measurement, StepRequest},
};
use vbar_simulator::MissionFile;

use crate::{
    failure::Failure,
    json,
    mission::MissionArguments,
    plans::{self, PlanOptions},
    session::{CredentialArguments, NodeArguments, Session},
};

/// Largest request that is read.
const REQUEST_BYTES_MAX: u64 = 64 << 20;

/// For closed-loop missions the plan starts at the mission's own first state, or at the one given,
/// and is printed as JSON; the scheme tube-optimal-control gives plan and feedback, any other its
/// open-loop plan. For missions with disturbance feedback it is printed as a table, with
/// its proof, and can be exported.
#[derive(Debug, Args)]
pub(crate) struct PlanArguments {
    #[command(flatten)]
    mission: MissionArguments,
    /// File with a Measurement as JSON to start from; - is standard input. Needed where the
    /// mission draws its first state by chance
    #[arg(long, value_name = "FILE")]
    initial: Option<PathBuf>,
    #[command(flatten)]
    options: PlanOptions,
}

/// Everything the decision needs is in the request.
#[derive(Debug, Args)]
pub(crate) struct StepArguments {
    /// File with the StepRequest as JSON; - is standard input
    #[arg(value_name = "REQUEST", default_value = "-")]
    request: PathBuf,
    #[command(flatten)]
    node: NodeArguments,
}

/// Made for the health check of a container.
#[derive(Debug, Args)]
pub(crate) struct HealthArguments {
    /// URL of the node
    #[arg(long, value_name = "URL", env = "VBAR_SERVER", default_value = "http://127.0.0.1:7440")]
    server: String,
    #[command(flatten)]
    credentials: CredentialArguments,
    /// How long to wait for the answer
    #[arg(long, value_name = "SECONDS", default_value_t = 2)]
    timeout_s: u16,
}

pub(crate) async fn plan(arguments: PlanArguments) -> Result<(), Failure> {
    let mission = match arguments.mission.load()? {
        MissionFile::AbortSafe(mission) => {
            let name = &mission.name;
            return Err(Failure::usage(format!("the mission {name} is flown step by step")));
        }
        MissionFile::DisturbanceFeedback(mission) => {
            let foreign = [("--initial", arguments.initial.is_some())];
            arguments.mission.refuse(foreign)?;
            return plans::plan(&mission, &arguments.mission.node, &arguments.options).await;
        }
        MissionFile::OfflineSampling(mission) => {
            let name = &mission.name;
            return Err(Failure::usage(format!("the mission {name} is flown step by step")));
        }
        MissionFile::VariableHorizon(mission) => arguments.mission.under_one_scheme(*mission)?,
    };
    if let Some(name) = arguments.options.given() {
        return Err(Failure::usage(format!("{name} is not for a closed-loop mission")));
    }
    let initial: Measurement = match &arguments.initial {
        Some(path) => json::parse(&read(path)?)?,
        None => mission.fixed_start().ok_or_else(|| {
            Failure::usage("this mission draws its first state by chance: give --initial FILE")
        })?,
    };
    let request = ComputePlanRequest {
        problem: Some(mission.problem),
        initial: Some(initial),
        validate_only: false,
    };
    let session = Session::open(&arguments.mission.node).await?;
    let answer = session.client.plan(request).await;
    session.close().await;
    json::print(&json::render(&answer?)?)
}

pub(crate) async fn step(arguments: StepArguments) -> Result<(), Failure> {
    let request: StepRequest = json::parse(&read(&arguments.request)?)?;
    let session = Session::open(&arguments.node).await?;
    let answer = session.client.step(request).await;
    session.close().await;
    json::print(&json::render(&answer?)?)
}

pub(crate) async fn health(arguments: HealthArguments) -> Result<(), Failure> {
    let time = Duration::from_secs(arguments.timeout_s.into());
    let credentials = arguments.credentials.read()?;
    let options =
        Options { deadline: time, connect_timeout: time, credentials, ..Options::default() };
    let client = Client::connect(&arguments.server, options).await?;
    if client.is_serving().await? {
        json::print("serving")
    } else {
        Err(Failure::unavailable(format!("{} is not serving", arguments.server)))
    }
}

/// The text of a file, or of standard input for `-`.
pub(crate) fn read(path: &Path) -> Result<String, Failure> {
    let named = |fault: io::Error| Failure::data(format!("{}: {fault}", path.display()));
    let source: Box<dyn Read> = if path == Path::new("-") {
        Box::new(io::stdin())
    } else {
        Box::new(File::open(path).map_err(named)?)
    };
    let mut text = String::new();
    let length = source.take(REQUEST_BYTES_MAX + 1).read_to_string(&mut text).map_err(named)?;
    if u64::try_from(length).unwrap_or(u64::MAX) > REQUEST_BYTES_MAX {
        let limit = format!("{}: longer than {REQUEST_BYTES_MAX} bytes", path.display());
        return Err(Failure::data(limit));
    }
    Ok(text)
}
