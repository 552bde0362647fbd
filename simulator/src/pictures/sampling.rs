//! Flights under sampled chance constraints: trajectories in the cone, the terminal region, effort
//! against time to dock [Mammarella2019, figs. 5-7].

use std::{
    fs,
    path::{Path, PathBuf},
};

use plotters::style::RGBColor;
use vbar_proto::v1;

use super::{
    PictureError,
    chart::{
        Area, Axes, BLUE, GREEN, INK, Mark, PURPLE, Points, SKY, VERMILION, counted, dots, equal,
        from_zero, line, page, panel, range, shape,
    },
    region::{circle, shadow, slice_at_rest},
};
use crate::{
    campaign::sampling::{SamplingCampaign, SamplingFlight},
    mission::{
        SamplingMission,
        sampling_model::{SamplingModel, half_spaces},
        sampling_scheme_name,
    },
    report::sampling::SamplingReport,
};

/// Colours of the starts, in the mission's order.
const COLORS: [RGBColor; 5] = [BLUE, VERMILION, GREEN, PURPLE, SKY];

/// How much of the surroundings of the target the close view shows, in docking distances.
const CLOSE_VIEW: f64 = 3.5;

/// Draws every picture that `report` has the data for, into the folder `out`; returns the files.
///
/// # Errors
/// When the folder or a file cannot be written.
pub fn draw_sampling(report: &SamplingReport, out: &Path) -> Result<Vec<PathBuf>, PictureError> {
    fs::create_dir_all(out)?;
    let flown: Vec<&SamplingCampaign> =
        report.campaigns.iter().filter(|campaign| !campaign.flights.is_empty()).collect();
    let Some(main) = flown.first() else { return Ok(Vec::new()) };
    let model = report.mission.model().map_err(|e| PictureError::Drawing(e.to_string()))?;
    let scene = Scene { report, model };
    let file = |what: &str| out.join(format!("{}_{what}.svg", report.mission.name));
    let mut written = vec![scene.trajectories(&file("trajectories"), &flown)?];
    if scene.model.states() == 4 {
        written.push(scene.terminal_region(&file("terminal_region"), main)?);
    }
    if flown.iter().any(|campaign| campaign.flights.iter().any(SamplingFlight::docked)) {
        written.push(scene.effort(&file("effort"), &flown)?);
    }
    Ok(written)
}

struct Scene<'a> {
    report: &'a SamplingReport,
    model: SamplingModel,
}

impl Scene<'_> {
    fn mission(&self) -> &SamplingMission {
        &self.report.mission
    }

    /// Which two components a panel shows, with their names.
    fn views(&self) -> Vec<([usize; 2], [&'static str; 2])> {
        if self.model.relative {
            let along = "along-track [m]";
            vec![([1, 0], [along, "radial [m]"]), ([1, 2], [along, "orbit normal [m]"])]
        } else {
            vec![([0, 1], ["x [m]", "y [m]"])]
        }
    }

    /// A state as the mission's own axes have it.
    fn place(&self, state: &[f64], [x, y]: [usize; 2]) -> (f64, f64) {
        let target = &self.mission().simulation.target_m;
        (state[x] + target[x], state[y] + target[y])
    }

    fn path(&self, flight: &SamplingFlight, view: [usize; 2]) -> Points {
        flight.samples.iter().map(|sample| self.place(&sample.state, view)).collect()
    }

    fn target(&self, view: [usize; 2]) -> (f64, f64) {
        self.place(&vec![0.0; self.model.states()], view)
    }

    fn color(&self, flight: &SamplingFlight) -> RGBColor {
        let starts = &self.mission().simulation.starts;
        let index = starts.iter().position(|start| start.name == flight.start).unwrap_or(0);
        COLORS[index % COLORS.len()]
    }

    /// One entry a start, then `others`.
    fn legend(
        &self,
        mark: Mark,
        others: &[(&str, Mark, RGBColor)],
    ) -> Vec<(String, Mark, RGBColor)> {
        let starts = self.mission().simulation.starts.iter().zip(COLORS.into_iter().cycle());
        let starts = starts.map(|(start, color)| (format!("from {}", start.name), mark, color));
        let others = others.iter().map(|(name, mark, color)| ((*name).to_owned(), *mark, *color));
        starts.chain(others).collect()
    }

    fn cone(&self, length_m: f64) -> Option<Points> {
        let target = &self.mission().simulation.target_m;
        let corners = self.model.cone?.corners(length_m);
        Some(corners.iter().map(|[x, y]| (x + target[0], y + target[1])).collect())
    }

    /// Every flight, a panel for each controller and view.
    fn trajectories(
        &self,
        path: &Path,
        flown: &[&SamplingCampaign],
    ) -> Result<PathBuf, PictureError> {
        let views = self.views();
        let runs = flown[0].flights.len();
        let title = format!("{}: {} of each controller", self.mission().name, counted(runs));
        let mut others = vec![("docking distance", Mark::Patch, INK)];
        if self.model.cone.is_some() {
            others.push(("cone", Mark::Patch, SKY));
        }
        let legend = self.legend(Mark::Line, &others);
        let size = (460 * flown.len().max(2) as u32, 84 + 420 * views.len() as u32);
        page(path, size, &title, &legend, |area| {
            let cells = area.split_evenly((views.len(), flown.len()));
            for (row, (view, names)) in views.iter().enumerate() {
                for (column, campaign) in flown.iter().enumerate() {
                    let cell = &cells[row * flown.len() + column];
                    self.trajectory_panel(cell, campaign, *view, *names, flown)?;
                }
            }
            Ok(())
        })
    }

    fn trajectory_panel(
        &self,
        area: &Area<'_>,
        campaign: &SamplingCampaign,
        view: [usize; 2],
        [x_name, y_name]: [&'static str; 2],
        all: &[&SamplingCampaign],
    ) -> Result<(), PictureError> {
        let target = self.target(view);
        let radius = self.mission().simulation.docking.distance_m;
        let flights = || all.iter().flat_map(|campaign| &campaign.flights);
        let mut seen: Points = flights().flat_map(|flight| self.path(flight, view)).collect();
        seen.extend(circle(target, radius));
        let length =
            seen.iter().map(|p| (p.0 - target.0).hypot(p.1 - target.1)).fold(0.0, f64::max);
        let cone = self.cone(1.2 * length);
        seen.extend(cone.iter().flatten());
        let (x, y) = equal(area, range(seen.iter().map(|p| p.0)), range(seen.iter().map(|p| p.1)));
        let title = readable(campaign.scheme);
        let mut chart = panel(area, &Axes { x, y, x_name, y_name, title })?;
        if let Some(cone) = cone {
            shape(&mut chart, cone, SKY, 0.15)?;
        }
        shape(&mut chart, circle(target, radius), INK, 0.2)?;
        for flight in &campaign.flights {
            line(&mut chart, self.path(flight, view), self.color(flight), 0.55, 1)?;
        }
        dots(&mut chart, vec![target], INK, 3)
    }

    /// The surroundings of the target: the last part of every flight, and the terminal set.
    fn terminal_region(
        &self,
        path: &Path,
        campaign: &SamplingCampaign,
    ) -> Result<PathBuf, PictureError> {
        let view = [0, 1];
        let target = self.target(view);
        let radius = self.mission().simulation.docking.distance_m;
        let moved = |points: Points| -> Points {
            points.into_iter().map(|(x, y)| (x + target.0, y + target.1)).collect()
        };
        let empty = v1::PolytopeSet::default();
        let given = campaign.prepared.as_ref().ok().and_then(|made| made.terminal_set.as_ref());
        let mut faults = Vec::new();
        let set = half_spaces("terminal_set", given.unwrap_or(&empty), 4, &mut faults);
        if !faults.is_empty() {
            return Err(PictureError::Drawing(faults.join("; ")));
        }
        let title = format!(
            "{}: around the target, {} under {}",
            self.mission().name,
            counted(campaign.flights.len()),
            readable(campaign.scheme)
        );
        let others = [
            ("terminal set, any velocity", Mark::Patch, GREEN),
            ("at rest", Mark::Patch, PURPLE),
            ("docking distance", Mark::Patch, INK),
        ];
        let legend = self.legend(Mark::Line, &others);
        page(path, (920, 720), &title, &legend, |area| {
            let reach = CLOSE_VIEW * radius;
            let around = |middle: f64| middle - reach..middle + reach;
            let (x, y) = equal(area, around(target.0), around(target.1));
            let axes = Axes { x, y, x_name: "x [m]", y_name: "y [m]", title: String::new() };
            let mut chart = panel(area, &axes)?;
            if let Some(cone) = self.cone(10.0 * reach) {
                shape(&mut chart, cone, SKY, 0.12)?;
            }
            if let Some(shadow) = shadow(&set) {
                shape(&mut chart, moved(shadow), GREEN, 0.25)?;
            }
            shape(&mut chart, moved(slice_at_rest(&set)), PURPLE, 0.3)?;
            shape(&mut chart, circle(target, radius), INK, 0.15)?;
            for flight in &campaign.flights {
                let flown = self.path(flight, view);
                let last = flown.last().copied();
                line(&mut chart, flown, self.color(flight), 0.6, 1)?;
                dots(&mut chart, last.into_iter().collect(), self.color(flight), 3)?;
            }
            dots(&mut chart, vec![target], INK, 4)
        })
    }

    /// Effort of every flight that docked against its time to dock, a panel for each controller.
    fn effort(&self, path: &Path, flown: &[&SamplingCampaign]) -> Result<PathBuf, PictureError> {
        let title = format!("{}: effort against time to dock", self.mission().name);
        let legend = self.legend(Mark::Dot, &[]);
        let docked = |campaign: &&'_ SamplingCampaign| -> Points {
            let docked = campaign.flights.iter().filter(|flight| flight.docked());
            docked.map(|flight| (flight.duration_s(), flight.effort_ns())).collect()
        };
        let all: Points = flown.iter().flat_map(docked).collect();
        let size = (460 * flown.len().max(2) as u32, 460);
        page(path, size, &title, &legend, |area| {
            let cells = area.split_evenly((1, flown.len()));
            for (cell, campaign) in cells.iter().zip(flown) {
                let axes = Axes {
                    x: range(all.iter().map(|point| point.0)),
                    y: from_zero(all.iter().map(|point| point.1)),
                    x_name: "time to dock [s]",
                    y_name: "effort [N s]",
                    title: readable(campaign.scheme),
                };
                let mut chart = panel(cell, &axes)?;
                for flight in campaign.flights.iter().filter(|flight| flight.docked()) {
                    let point = (flight.duration_s(), flight.effort_ns());
                    dots(&mut chart, vec![point], self.color(flight), 4)?;
                }
            }
            Ok(())
        })
    }
}

/// A controller's name for people.
fn readable(scheme: v1::OfflineSamplingScheme) -> String {
    sampling_scheme_name(scheme).to_lowercase().replace('_', " ")
}
