//! Flies a mission and tells what came of it, whichever method it is of.

use std::{
    fmt::Display,
    fs,
    path::{Path, PathBuf},
};

use serde_json::Value;
use vbar_client::Client;
use vbar_simulator::{
    AbortReport, PlanReport, ProgressBar, SamplingReport, SimulationError, draw_aborts, draw_plans,
    draw_sampling,
};

use crate::{
    failure::Failure,
    json,
    session::{NodeArguments, Session},
    simulate::{Format, failure, tell},
};

/// How flights are reported.
pub(crate) struct Telling {
    /// On standard output.
    pub(crate) format: Format,
    /// Folder for pictures and the report as files.
    pub(crate) out: Option<PathBuf>,
}

/// What flights of a mission came to.
pub(crate) struct Told<W> {
    /// Of the mission.
    pub(crate) name: String,
    /// For people.
    pub(crate) table: String,
    /// For programs.
    pub(crate) json: Value,
    /// Writes pictures and tables to a folder; returns what is worth naming.
    pub(crate) write: W,
}

/// Flies and reports.
pub(crate) async fn fly<W>(
    node: &NodeArguments,
    telling: &Telling,
    flights: impl AsyncFnOnce(&Client, &ProgressBar) -> Result<Told<W>, SimulationError>,
) -> Result<(), Failure>
where
    W: FnOnce(&Path) -> Result<Vec<PathBuf>, String>,
{
    let session = Session::open(node).await?;
    let flown = flights(&session.client, &ProgressBar::default()).await;
    session.close().await;
    let Told { name, table, json, write } = flown.map_err(failure)?;
    let json = format!("{json:#}");
    json::print(match telling.format {
        Format::Table => table.trim_end(),
        Format::Json => &json,
    })?;
    let Some(folder) = &telling.out else { return Ok(()) };
    let cannot =
        |fault: &dyn Display| Failure::cannot_write(format!("{}: {fault}", folder.display()));
    let mut written = write(folder).map_err(|fault| cannot(&fault))?;
    let path = folder.join(format!("{name}_report.json"));
    fs::write(&path, json + "\n").map_err(|fault| cannot(&fault))?;
    written.push(path);
    tell(&written, folder);
    Ok(())
}

/// The flights of a mission's plans.
pub(crate) fn of_plans(
    report: PlanReport,
) -> Told<impl FnOnce(&Path) -> Result<Vec<PathBuf>, String>> {
    Told {
        name: report.mission.name.clone(),
        table: report.table(),
        json: report.json(),
        write: move |folder: &Path| {
            let mut written = draw_plans(&report, folder).map_err(said)?;
            written.extend(report.write_runs(folder).map_err(said)?);
            Ok(written)
        },
    }
}

/// The flights of a mission under abort-safe control; of one run with every step of it.
pub(crate) fn of_aborts(
    report: AbortReport,
) -> Told<impl FnOnce(&Path) -> Result<Vec<PathBuf>, String>> {
    Told {
        name: report.mission.name.clone(),
        table: report.table(),
        json: report.json(),
        write: move |folder: &Path| {
            let mut written = draw_aborts(&report, folder).map_err(said)?;
            written.extend(report.write_runs(folder).map_err(said)?);
            if report.runs == 1 {
                written.extend(report.write_traces(folder).map_err(said)?);
            }
            Ok(written)
        },
    }
}

/// The flights of a mission under sampled chance constraints, every step of them unnamed in the
/// folder `traces`.
pub(crate) fn of_sampling(
    report: SamplingReport,
) -> Told<impl FnOnce(&Path) -> Result<Vec<PathBuf>, String>> {
    Told {
        name: report.mission.name.clone(),
        table: report.table(),
        json: report.json(),
        write: move |folder: &Path| {
            let written = draw_sampling(&report, folder).map_err(said)?;
            report.write_traces(&folder.join("traces")).map_err(said)?;
            Ok(written)
        },
    }
}

fn said(fault: impl Display) -> String {
    fault.to_string()
}
