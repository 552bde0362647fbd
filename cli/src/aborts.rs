//! `vbar simulate` of missions under abort-safe control.

use std::path::{Path, PathBuf};

use vbar_simulator::{
    AbortMission, AbortReport, AbortRunOptions, ProgressBar, draw_aborts, fly_aborts,
};

use crate::{
    failure::Failure,
    json,
    session::{NodeArguments, Session},
    simulate::{Format, failure},
};

/// What the flights of a mission are asked for.
pub(crate) struct FlightOptions {
    pub(crate) run: AbortRunOptions,
    pub(crate) format: Format,
    /// Folder for pictures and the report as files.
    pub(crate) out: Option<PathBuf>,
}

/// Flies a mission's variants and reports.
pub(crate) async fn fly(
    mission: &AbortMission,
    node: &NodeArguments,
    options: FlightOptions,
) -> Result<(), Failure> {
    let session = Session::open(node).await?;
    let progress = ProgressBar::default();
    let flown = fly_aborts(&session.client, mission, &options.run, &progress).await;
    session.close().await;
    let report = flown.map_err(failure)?;
    match options.format {
        Format::Table => json::print(report.table().trim_end())?,
        Format::Json => json::print(&format!("{:#}", report.json()))?,
    }
    match &options.out {
        Some(folder) => write_files(&report, folder),
        None => Ok(()),
    }
}

/// Pictures, runs, the report and, of a mission of one run, every step of it.
fn write_files(report: &AbortReport, folder: &Path) -> Result<(), Failure> {
    let cannot = |fault: &dyn std::fmt::Display| {
        Failure::cannot_write(format!("{}: {fault}", folder.display()))
    };
    let mut written = draw_aborts(report, folder).map_err(|fault| cannot(&fault))?;
    written.extend(report.write_runs(folder).map_err(|fault| cannot(&fault))?);
    if report.runs == 1 {
        written.extend(report.write_traces(folder).map_err(|fault| cannot(&fault))?);
    }
    let path = folder.join(format!("{}_report.json", report.mission.name));
    std::fs::write(&path, format!("{:#}\n", report.json())).map_err(|fault| cannot(&fault))?;
    written.push(path);
    eprintln!("{} files in {}:", written.len(), folder.display());
    for path in written {
        eprintln!("  {}", path.display());
    }
    Ok(())
}
