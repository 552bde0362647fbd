//! `vbar safety`: what could be done along a trajectory if thrusters failed.

mod table;
mod trajectory;

use std::path::PathBuf;

use clap::Args;
use vbar_client::v1::{
    SafetyReportRequest,
    safety_report_request::{Controller, Trajectory},
};
use vbar_simulator::MissionFile;

use crate::{
    calls::read,
    failure::Failure,
    json,
    session::{NodeArguments, Session},
    simulate::Format,
};

/// At every state, for every failure of the mission: is there an abort, is the state doomed and
/// when, how near does free drift come. Exit code 65 for a trajectory that makes no sense; unsafe
/// states are an answer.
#[derive(Debug, Args)]
pub(crate) struct SafetyArguments {
    /// File with a SafetyReportRequest as JSON; with --mission also states one sample apart: a
    /// StateTrajectory as JSON, or CSV with the columns x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s (RTN),
    /// such as the traces that `vbar simulate` writes; - is standard input
    #[arg(value_name = "TRAJECTORY")]
    trajectory: PathBuf,
    /// Mission file whose orbit, thrusters and regions count, such as simulator/missions/iss.json
    #[arg(long, value_name = "MISSION")]
    mission: Option<PathBuf>,
    /// Phase to judge every state in, from 0 [default: the one a flight would be in]
    #[arg(long, value_name = "N", requires = "mission")]
    phase: Option<i32>,
    /// Step of the first state: decides where on the orbit it is [default: 0, or the column k]
    #[arg(long, value_name = "K", requires = "mission")]
    first_step: Option<i32>,
    /// How to print the answer; JSON has the aborts themselves too
    #[arg(long, value_name = "FORMAT", default_value = "table")]
    format: Format,
    #[command(flatten)]
    node: NodeArguments,
}

/// Asks for a safety report and prints it.
pub(crate) async fn safety(arguments: SafetyArguments) -> Result<(), Failure> {
    let mut request = request(&arguments)?;
    request.omit_sequences |= matches!(arguments.format, Format::Table);
    let session = Session::open(&arguments.node).await?;
    let answer = session.client.safety_report(request).await;
    session.close().await;
    match arguments.format {
        Format::Table => json::print(table::render(&answer?).trim_end()),
        Format::Json => json::print(&json::render(&answer?)?),
    }
}

fn request(arguments: &SafetyArguments) -> Result<SafetyReportRequest, Failure> {
    let text = read(&arguments.trajectory)?;
    let Some(path) = &arguments.mission else { return json::parse(&text) };
    let mission = MissionFile::load(path).map_err(|fault| Failure::data(fault.to_string()))?;
    let MissionFile::AbortSafe(mission) = mission else {
        let name = mission.name();
        return Err(Failure::data(format!("the mission {name} has no failures to survive")));
    };
    let given = trajectory::parse(&text)
        .map_err(|fault| fault.in_file(&arguments.trajectory.display().to_string()))?;
    Ok(SafetyReportRequest {
        controller: Some(Controller::Problem(mission.problem)),
        trajectory: Some(Trajectory::States(given.states)),
        phase_index: arguments.phase,
        first_step_index: arguments.first_step.unwrap_or(given.first_step),
        modes: Vec::new(),
        omit_sequences: false,
    })
}
