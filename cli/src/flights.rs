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
pub(crate) trait FlightReport {
    /// Of the mission.
    fn name(&self) -> &str;
    /// For people.
    fn table(&self) -> String;
    /// For programs.
    fn json(&self) -> Value;
    /// Writes pictures and tables; returns what is worth naming.
    fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, String>;
}

/// Flies and reports.
pub(crate) async fn fly<R: FlightReport>(
    node: &NodeArguments,
    telling: &Telling,
    flights: impl AsyncFnOnce(&Client, &ProgressBar) -> Result<R, SimulationError>,
) -> Result<(), Failure> {
    let session = Session::open(node).await?;
    let flown = flights(&session.client, &ProgressBar::default()).await;
    session.close().await;
    let report = flown.map_err(failure)?;
    match telling.format {
        Format::Table => json::print(report.table().trim_end())?,
        Format::Json => json::print(&format!("{:#}", report.json()))?,
    }
    match &telling.out {
        Some(folder) => write_files(&report, folder),
        None => Ok(()),
    }
}

/// Pictures and tables, and the report beside them.
fn write_files(report: &impl FlightReport, folder: &Path) -> Result<(), Failure> {
    let cannot =
        |fault: &dyn Display| Failure::cannot_write(format!("{}: {fault}", folder.display()));
    let mut written = report.write(folder).map_err(|fault| cannot(&fault))?;
    let path = folder.join(format!("{}_report.json", report.name()));
    fs::write(&path, format!("{:#}\n", report.json())).map_err(|fault| cannot(&fault))?;
    written.push(path);
    tell(&written, folder);
    Ok(())
}

fn said(fault: impl Display) -> String {
    fault.to_string()
}

impl FlightReport for PlanReport {
    fn name(&self) -> &str {
        &self.mission.name
    }

    fn table(&self) -> String {
        self.table()
    }

    fn json(&self) -> Value {
        self.json()
    }

    fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, String> {
        let mut written = draw_plans(self, folder).map_err(said)?;
        written.extend(self.write_runs(folder).map_err(said)?);
        Ok(written)
    }
}

impl FlightReport for AbortReport {
    fn name(&self) -> &str {
        &self.mission.name
    }

    fn table(&self) -> String {
        self.table()
    }

    fn json(&self) -> Value {
        self.json()
    }

    /// Every step too, of a mission of one run.
    fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, String> {
        let mut written = draw_aborts(self, folder).map_err(said)?;
        written.extend(self.write_runs(folder).map_err(said)?);
        if self.runs == 1 {
            written.extend(self.write_traces(folder).map_err(said)?);
        }
        Ok(written)
    }
}

impl FlightReport for SamplingReport {
    fn name(&self) -> &str {
        &self.mission.name
    }

    fn table(&self) -> String {
        self.table()
    }

    fn json(&self) -> Value {
        self.json()
    }

    /// Every step of every flight too, in the folder `traces`, unnamed.
    fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, String> {
        let written = draw_sampling(self, folder).map_err(said)?;
        self.write_traces(&folder.join("traces")).map_err(said)?;
        Ok(written)
    }
}
