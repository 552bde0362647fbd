//! `vbar simulate` of missions under sampled chance constraints.

use std::{
    fs,
    path::{Path, PathBuf},
};

use vbar_simulator::{
    ProgressBar, SamplingMission, SamplingReport, SamplingRunOptions, draw_sampling, fly_sampling,
};

use crate::{
    failure::Failure,
    json,
    session::{NodeArguments, Session},
    simulate::{Format, failure, tell},
};

/// What the flights of a mission are asked for.
pub(crate) struct FlightOptions {
    pub(crate) run: SamplingRunOptions,
    pub(crate) format: Format,
    /// Folder for pictures and the report as files.
    pub(crate) out: Option<PathBuf>,
}

/// Flies a mission and reports.
pub(crate) async fn fly(
    mission: &SamplingMission,
    node: &NodeArguments,
    options: FlightOptions,
) -> Result<(), Failure> {
    let session = Session::open(node).await?;
    let progress = ProgressBar::default();
    let flown = fly_sampling(&session.client, mission, &options.run, &progress).await;
    session.close().await;
    let report = flown.map_err(failure)?;
    match options.format {
        Format::Table => json::print(report.table().trim_end())?,
        Format::Json => json::print(&format!("{:#}", report.json()))?,
    }
    match &options.out {
        Some(folder) => write(&report, folder),
        None => Ok(()),
    }
}

/// Pictures and the report; every step of every flight in the folder `traces`.
fn write(report: &SamplingReport, folder: &Path) -> Result<(), Failure> {
    let cannot = |fault: &dyn std::fmt::Display| {
        Failure::cannot_write(format!("{}: {fault}", folder.display()))
    };
    let mut written = draw_sampling(report, folder).map_err(|fault| cannot(&fault))?;
    let path = folder.join(format!("{}_report.json", report.mission.name));
    fs::write(&path, format!("{:#}\n", report.json())).map_err(|fault| cannot(&fault))?;
    written.push(path);
    tell(&written, folder);
    report.write_traces(&folder.join("traces")).map_err(|fault| cannot(&fault))?;
    Ok(())
}
