//! `vbar precompute`: thinks long once, and says how far it is.

use std::cell::RefCell;

use clap::Args;
use vbar_client::{
    Client,
    v1::{PrecomputeMetadata, PrecomputeResponse, Problem},
};
use vbar_simulator::{MissionFile, ProgressBar};

use crate::{failure::Failure, json, mission::MissionArguments, session::Session};

/// Parts of the bar.
const WHOLE: u32 = 1000;

/// Give a running node with --server: what a node of our own makes is gone when the command ends.
/// Ctrl-C stops the computation on the node too.
#[derive(Debug, Args)]
pub(crate) struct PrecomputeArguments {
    #[command(flatten)]
    mission: MissionArguments,
}

pub(crate) async fn precompute(arguments: PrecomputeArguments) -> Result<(), Failure> {
    let problem = match arguments.mission.load()? {
        MissionFile::AbortSafe(mission) => {
            arguments.mission.refuse([])?;
            mission.problem
        }
        MissionFile::DisturbanceFeedback(mission) => {
            arguments.mission.refuse([])?;
            mission.problem
        }
        MissionFile::OfflineSampling(mission) => arguments.mission.sampling_problem(&mission)?,
        MissionFile::VariableHorizon(mission) => {
            arguments.mission.under_one_scheme(*mission)?.problem
        }
    };
    let session = Session::open(&arguments.mission.node).await?;
    let answer = watched(&session.client, problem).await;
    session.close().await;
    json::print(&json::render(&answer?)?)
}

/// Waits for the artifact with a bar on standard error, until Ctrl-C.
async fn watched(client: &Client, problem: Problem) -> Result<PrecomputeResponse, Failure> {
    let bar = ProgressBar::default();
    let operation = RefCell::new(None);
    let report = |metadata: &PrecomputeMetadata| {
        bar.show(&label(metadata), position(metadata.fraction_done), WHOLE.into());
        *operation.borrow_mut() = Some(format!("operations/{}", metadata.artifact_id));
    };
    let answer = tokio::select! {
        answer = client.precompute_reporting(problem, report) => Some(answer),
        _ = tokio::signal::ctrl_c() => None,
    };
    bar.close();
    if let Some(answer) = answer {
        return Ok(answer?);
    }
    let Some(name) = operation.into_inner() else {
        return Err(Failure::interrupted("interrupted before the node had answered"));
    };
    client.cancel_operation(&name).await?;
    Err(Failure::interrupted(format!("interrupted; {name} was cancelled on the node")))
}

/// What is being done, how much of it is done and how long the rest will take.
fn label(metadata: &PrecomputeMetadata) -> String {
    let PrecomputeMetadata { phase, shards_done, shards_total, .. } = metadata;
    let rest = match metadata.remaining_s {
        Some(seconds) if seconds.is_finite() => format!(", {seconds:.0} s left"),
        _ => String::new(),
    };
    format!("{phase} {shards_done}/{shards_total}{rest}")
}

fn position(fraction: f64) -> u64 {
    // From 0 to 1 by contract; the cast saturates.
    (fraction * f64::from(WHOLE)) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn label_says_what_remains_only_if_it_is_known() {
        let mut metadata = PrecomputeMetadata {
            phase: "computing".to_owned(),
            shards_done: 3,
            shards_total: 12,
            ..PrecomputeMetadata::default()
        };
        assert_eq!(label(&metadata), "computing 3/12");
        metadata.remaining_s = Some(41.6);
        assert_eq!(label(&metadata), "computing 3/12, 42 s left");
        assert_eq!([0.0, 0.5, 1.0, 2.0].map(position), [0, 500, 1000, 2000]);
    }
}
