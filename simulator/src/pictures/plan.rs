//! Plans: trajectories and final errors [Deaconu2014, figs. 2-3], arrival sets against the
//! mission's duration [Deaconu2014, tables 3-4].

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::{
    PictureError,
    chart::{
        Area, Axes, BLUE, GREEN, INK, Mark, PURPLE, Points, SKY, VERMILION, counted, dashed, dots,
        equal, from_zero, line, page, panel, range, shape,
    },
};
use crate::{
    campaign::plan::{PlanCampaign, PlanFlight, PlanRow, ellipsoid::Ellipsoid},
    mission::metric_name,
    report::plan::PlanReport,
};

/// Trajectories drawn, as many as in the paper's figures; the final errors are those of all runs.
const LINES_MAX: usize = 50;

/// Draws every picture that `report` has the data for, into the folder `out`; returns the files.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn draw_plans(report: &PlanReport, out: &Path) -> Result<Vec<PathBuf>, PictureError> {
    fs::create_dir_all(out)?;
    let name = &report.mission.name;
    let mut written = Vec::new();
    for campaign in report.campaigns.iter().filter(|campaign| !campaign.flights.is_empty()) {
        let file = format!("{name}_{}_trajectories.svg", campaign.row.mission.label());
        written.push(trajectories(&out.join(file), campaign)?);
    }
    if report.table.iter().filter(|row| row.answer.plan().is_some()).count() > 1 {
        written.push(axes_against_duration(&out.join(format!("{name}_axes.svg")), &report.table)?);
    }
    Ok(written)
}

/// The whole approach, the final errors in the arrival set, and those of the open loop.
fn trajectories(path: &Path, campaign: &PlanCampaign) -> Result<PathBuf, PictureError> {
    let mission = &campaign.row.mission;
    let flights = &campaign.flights;
    let model = mission.model().map_err(|fault| PictureError::Drawing(fault.to_string()))?;
    let title = format!(
        "{} {}: {} instants, {}",
        mission.name,
        mission.label(),
        model.elapsed_s.len(),
        counted(flights.len())
    );
    let legend = [
        ("one run", Mark::Line, BLUE),
        ("instant of run 0", Mark::Dot, INK),
        ("final error", Mark::Dot, BLUE),
        ("guaranteed arrival set", Mark::Patch, GREEN),
        ("open loop", Mark::Dot, VERMILION),
        ("open-loop set", Mark::Patch, VERMILION),
    ];
    let sets = Sets::new(campaign)?;
    let wanted = (model.target[0], model.target[2]);
    page(path, (1380, 520), &title, &legend, |area| {
        let thirds = area.split_evenly((1, 3));
        approach(&thirds[0], flights)?;
        final_errors(&thirds[1], flights, &sets, wanted, false)?;
        final_errors(&thirds[2], flights, &sets, wanted, true)
    })
}

/// Outlines of the arrival sets in the orbital plane.
struct Sets {
    feedback: Points,
    open_loop: Option<Points>,
}

impl Sets {
    fn new(campaign: &PlanCampaign) -> Result<Self, PictureError> {
        let planned = campaign.row.answer.plan();
        let plan = planned.map(|planned| &planned.plan);
        let outline = |place: &str, set| {
            Ellipsoid::new(place, set).map(|set| set.outline()).map_err(PictureError::Drawing)
        };
        let open_loop = plan.and_then(|plan| plan.open_loop_arrival.as_ref());
        Ok(Self {
            feedback: outline("arrival", plan.and_then(|plan| plan.arrival.as_ref()))?,
            open_loop: match open_loop {
                None => None,
                given => Some(outline("open_loop_arrival", given)?),
            },
        })
    }
}

fn approach(area: &Area<'_>, flights: &[PlanFlight]) -> Result<(), PictureError> {
    let shown = &flights[..flights.len().min(LINES_MAX)];
    let all = || shown.iter().flat_map(|flight| flight.path.iter().copied());
    let axes = Axes {
        x: range(all().map(|point| point.0)),
        y: range(all().map(|point| point.1)),
        x_name: "along-track x [m]",
        y_name: "nadir z [m]",
        title: format!("whole approach, {}", counted(shown.len())),
    };
    let mut chart = panel(area, &axes)?;
    let opacity = (12.0_f64 / shown.len() as f64).clamp(0.15, 1.0);
    for flight in shown {
        line(&mut chart, flight.path.clone(), BLUE, opacity, 1)?;
    }
    let burns = shown.first().map_or(&[][..], |flight| &flight.samples);
    dots(&mut chart, burns.iter().map(|sample| flat(&sample.truth)).collect(), INK, 3)
}

/// Errors of the measured final positions; with or without those of the open loop.
fn final_errors(
    area: &Area<'_>,
    flights: &[PlanFlight],
    sets: &Sets,
    wanted: (f64, f64),
    with_open_loop: bool,
) -> Result<(), PictureError> {
    let error = |state: &[f64; 6]| {
        let (x, z) = flat(state);
        (x - wanted.0, z - wanted.1)
    };
    let closed: Points =
        flights.iter().filter_map(|f| f.samples.last()).map(|end| error(&end.measured)).collect();
    let open: Points = match with_open_loop {
        true => flights.iter().map(|flight| error(&flight.open_loop.measured)).collect(),
        false => Points::new(),
    };
    let blind_set = sets.open_loop.as_ref().filter(|_| with_open_loop);
    let blind = || blind_set.into_iter().flatten();
    let all = || sets.feedback.iter().chain(&closed).chain(&open).chain(blind());
    let x = range(all().map(|point| point.0));
    let y = range(all().map(|point| point.1));
    let (x, y) = equal(area, x, y);
    let title = if with_open_loop { "beside the open loop" } else { "final errors" };
    let axes =
        Axes { x, y, x_name: "error in x [m]", y_name: "error in z [m]", title: title.into() };
    let mut chart = panel(area, &axes)?;
    if let Some(set) = blind_set {
        shape(&mut chart, set.clone(), VERMILION, 0.12)?;
    }
    shape(&mut chart, sets.feedback.clone(), GREEN, 0.2)?;
    dots(&mut chart, open, VERMILION, 2)?;
    dots(&mut chart, closed, BLUE, 2)
}

fn flat(state: &[f64; 6]) -> (f64, f64) {
    (state[0], state[2])
}

/// Longer and shorter semi-axis against the duration, with feedback and in open loop.
fn axes_against_duration(path: &Path, rows: &[PlanRow]) -> Result<PathBuf, PictureError> {
    let Some(first) = rows.first() else {
        return Err(PictureError::Drawing("a table without rows".into()));
    };
    let metric = metric_name(first.mission.metric());
    let title = format!("{}: semi-axes of the arrival set, {metric}", first.mission.name);
    let published = rows.iter().any(|row| row.mission.published.feedback_axes_m.is_some());
    let mut legend =
        vec![("with feedback", Mark::Line, BLUE), ("open loop", Mark::Dashed, VERMILION)];
    if published {
        legend.push(("feedback, paper", Mark::Dot, SKY));
        legend.push(("open loop, paper", Mark::Dot, PURPLE));
    }
    page(path, (1080, 460), &title, &legend, |area| {
        let halves = area.split_evenly((1, 2));
        for (axis, name) in ["longer semi-axis [m]", "shorter semi-axis [m]"].iter().enumerate() {
            duration_panel(&halves[axis], rows, axis, name)?;
        }
        Ok(())
    })
}

fn duration_panel(
    area: &Area<'_>,
    rows: &[PlanRow],
    axis: usize,
    y_name: &'static str,
) -> Result<(), PictureError> {
    // The paper's figures of a column without a plan of ours have another row beside them.
    let planned = || rows.iter().filter(|row| row.answer.plan().is_some());
    let points = |value: &dyn Fn(&PlanRow) -> Option<f64>| -> Points {
        planned().filter_map(|row| Some((duration_s(row)?, value(row)?))).collect()
    };
    let plan = |row: &PlanRow| row.answer.plan().map(|planned| planned.plan.clone());
    let ours = points(&|row| plan(row)?.arrival?.in_plane_semi_axes_m.get(axis).copied());
    let blind =
        points(&|row| plan(row)?.open_loop_arrival?.in_plane_semi_axes_m.get(axis).copied());
    let paper = points(&|row| row.mission.published.feedback_axes_m.map(|axes| axes[axis]));
    let paper_blind = points(&|row| row.mission.published.open_loop_axes_m.map(|axes| axes[axis]));
    let all = || ours.iter().chain(&blind).chain(&paper).chain(&paper_blind);
    let axes = Axes {
        x: range(all().map(|point| point.0)),
        y: from_zero(all().map(|point| point.1)),
        x_name: "duration [s]",
        y_name,
        title: String::new(),
    };
    let mut chart = panel(area, &axes)?;
    dots(&mut chart, paper, SKY, 7)?;
    dots(&mut chart, paper_blind, PURPLE, 7)?;
    line(&mut chart, ours.clone(), BLUE, 1.0, 2)?;
    dots(&mut chart, ours, BLUE, 3)?;
    dashed(&mut chart, blind.clone(), VERMILION)?;
    dots(&mut chart, blind, VERMILION, 3)
}

fn duration_s(row: &PlanRow) -> Option<f64> {
    row.mission.model().ok().and_then(|model| model.elapsed_s.last().copied())
}
