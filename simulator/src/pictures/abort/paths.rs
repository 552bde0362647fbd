//! Where flights lead, in the orbital plane, across it, and near the target.

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use nalgebra::{Vector3, Vector6};
use plotters::style::RGBColor;

use super::title;
use crate::{
    campaign::abort::{AbortCampaign, AbortFlight, AbortSample, Drift, judge::relative_truth},
    clearance::Region,
    pictures::{
        PictureError,
        chart::{
            Area, Axes, BLUE, Entry, GREEN, GREY, INK, Mark, PURPLE, Points, VERMILION, counted,
            dots, equal, line, page, panel, range, shape,
        },
    },
    plant::relative_truth::RelativeTruth,
    report::abort::{AbortReport, GAUGE_TOLERANCE},
};

/// Free drifts drawn of one flight; more would only fill the panel.
const ARCS_MAX: usize = 72;

/// Time between two points of a drift: a thousandth of a revolution in low orbit is no corner.
const ARC_SPACING_S: f64 = 30.0;

/// Sideways motion below this share of the rest is not worth a panel.
const SIDEWAYS_MIN: f64 = 0.01;

/// One flight, with the way it would drift from where it was left [AguilarMarsillach2022, figs.
/// 8-10].
pub(super) fn approach(
    path: &Path,
    report: &AbortReport,
    campaign: &AbortCampaign,
) -> Result<PathBuf, PictureError> {
    let mut scene = Scene::new(report)?;
    let Some(flight) = campaign.flights.first() else {
        return Err(PictureError::Drawing("no flight".into()));
    };
    let arcs = drifts(report, campaign, flight)?;
    let (entering, clear): (Vec<Arc>, Vec<Arc>) = arcs.into_iter().partition(|arc| arc.enters);
    let some_enter = !entering.is_empty();
    let line = |color, opacity| move |arc: Arc| Line::new(arc.points, color, opacity, 1);
    scene.lines.extend(clear.into_iter().map(line(GREY, 0.6)));
    scene.lines.extend(entering.into_iter().map(line(VERMILION, 0.5)));
    let flown: Vec<Vector3<f64>> = flight.samples.iter().map(position).collect();
    scene.focus.extend(&flown);
    scene.marks.extend(flown.first().map(|start| (*start, INK)));
    scene.marks.extend(phase_starts(flight).map(|start| (start, GREEN)));
    scene.lines.push(Line::new(flown, BLUE, 1.0, 2));
    let mut legend = vec![
        ("flown", Mark::Line, BLUE),
        ("start", Mark::Dot, INK),
        ("next phase begins", Mark::Dot, GREEN),
        ("region kept free", Mark::Patch, PURPLE),
        ("drift from there", Mark::Line, GREY),
    ];
    if some_enter {
        legend.push(("drift into the region", Mark::Line, VERMILION));
    }
    scene.draw(path, &title(report, campaign), &legend)
}

/// Every run before and after its thrusters failed [AguilarMarsillach2022, figs. 11-13].
pub(super) fn failures(
    path: &Path,
    report: &AbortReport,
    campaign: &AbortCampaign,
) -> Result<PathBuf, PictureError> {
    let mut scene = Scene::new(report)?;
    let world = Adrift::new(report, campaign)?;
    let (mut clear, mut entering, mut before) = (Vec::new(), Vec::new(), Vec::new());
    for flight in &campaign.flights {
        let Some(last) = flight.samples.len().checked_sub(1) else { continue };
        let failed = flight.steps_before_failure().min(last);
        let way = |samples: &[AbortSample]| samples.iter().map(position).collect::<Vec<_>>();
        let flown = way(&flight.samples[..=failed]);
        scene.focus.extend(&flown);
        before.push(Line::new(flown, BLUE, 0.8, 1));
        let Some(failure) = &flight.failure else { continue };
        scene.marks.push((position(&flight.samples[failed]), INK));
        // With no thruster left nothing more was asked of the service: the rest is drift.
        let after = match failure.working.is_empty() {
            true => world.drift(failed, &flight.samples[failed]),
            false => way(&flight.samples[failed..]),
        };
        match flight.entered() {
            true => entering.push(Line::new(after, VERMILION, 0.9, 2)),
            false => clear.push(Line::new(after, GREY, 0.6, 1)),
        }
    }
    let entered = entering.len();
    scene.lines.extend(clear.into_iter().chain(before).chain(entering));
    let runs = campaign.flights.len();
    let title = format!("{}: {entered} of {} enter", title(report, campaign), counted(runs));
    let legend = [
        ("thrusters work", Mark::Line, BLUE),
        ("they fail", Mark::Dot, INK),
        ("after the failure", Mark::Line, GREY),
        ("after it, entering", Mark::Line, VERMILION),
        ("region kept free", Mark::Patch, PURPLE),
    ];
    scene.draw(path, &title, &legend)
}

/// Two variants, run by run [AguilarMarsillach2022, fig. 7].
pub(super) fn compared(
    path: &Path,
    report: &AbortReport,
    pair: [&AbortCampaign; 2],
) -> Result<PathBuf, PictureError> {
    let mut scene = Scene::new(report)?;
    for (campaign, color, width) in [(pair[0], BLUE, 3), (pair[1], VERMILION, 1)] {
        for flight in &campaign.flights {
            let flown: Vec<Vector3<f64>> = flight.samples.iter().map(position).collect();
            scene.focus.extend(&flown);
            scene.marks.extend(flown.first().map(|start| (*start, INK)));
            scene.lines.push(Line::new(flown, color, 0.9, width));
        }
    }
    let [first, second] = pair.map(|campaign| campaign.case.name.as_str());
    let title = format!("{}: {first} and {second}", report.mission.name);
    let legend = [
        ("the first", Mark::Line, BLUE),
        ("the second", Mark::Line, VERMILION),
        ("start", Mark::Dot, INK),
        ("region kept free", Mark::Patch, PURPLE),
    ];
    scene.draw(path, &title, &legend)
}

/// A free drift, and whether it enters the region of its phase.
struct Arc {
    points: Vec<Vector3<f64>>,
    enters: bool,
}

/// Drifts from the judged states of a flight.
fn drifts(
    report: &AbortReport,
    campaign: &AbortCampaign,
    flight: &AbortFlight,
) -> Result<Vec<Arc>, PictureError> {
    let judged: Vec<usize> =
        (0..flight.samples.len()).filter(|k| !flight.samples[*k].drifts.is_empty()).collect();
    if judged.is_empty() {
        return Ok(Vec::new());
    }
    let world = Adrift::new(report, campaign)?;
    let arc = |k: &usize| {
        let sample = &flight.samples[*k];
        let inside = |drift: &Drift| drift.least_gauge < 1.0 - GAUGE_TOLERANCE;
        Arc { points: world.drift(*k, sample), enters: sample.drifts.first().is_some_and(inside) }
    };
    Ok(judged.iter().step_by(judged.len().div_ceil(ARCS_MAX)).map(arc).collect())
}

/// Free drift under the first truth that a mission judges by, for as long as it judges.
struct Adrift {
    truth: RelativeTruth,
    step_s: f64,
    duration_s: f64,
}

impl Adrift {
    fn new(report: &AbortReport, campaign: &AbortCampaign) -> Result<Self, PictureError> {
        let Some(law) = campaign.judged_by.first() else {
            return Err(PictureError::Drawing("a mission that judges by no truth".into()));
        };
        let truth = relative_truth(&report.mission, &campaign.case, *law)
            .map_err(|fault| PictureError::Drawing(fault.to_string()))?;
        let model = &campaign.case.model;
        let duration_s = report.mission.simulation.drift.periods * model.period_s();
        Ok(Self { truth, step_s: model.sample_time_s, duration_s })
    }

    /// Places after `sample`, which is that of step `k`.
    fn drift(&self, k: usize, sample: &AbortSample) -> Vec<Vector3<f64>> {
        let state = Vector6::from(sample.state);
        let course =
            self.truth.drift(k as f64 * self.step_s, &state, self.duration_s, ARC_SPACING_S);
        course.states.iter().map(|state| state.fixed_rows::<3>(0).into()).collect()
    }
}

fn phase_starts(flight: &AbortFlight) -> impl Iterator<Item = Vector3<f64>> + '_ {
    let changes = flight.samples.windows(2).filter(|pair| pair[1].phase > pair[0].phase);
    changes.map(|pair| position(&pair[1]))
}

fn position(sample: &AbortSample) -> Vector3<f64> {
    Vector3::new(sample.state[0], sample.state[1], sample.state[2])
}

/// A line through places about the target, RTN, m.
struct Line {
    points: Vec<Vector3<f64>>,
    color: RGBColor,
    opacity: f64,
    width: u32,
}

impl Line {
    fn new(points: Vec<Vector3<f64>>, color: RGBColor, opacity: f64, width: u32) -> Self {
        Self { points, color, opacity, width }
    }
}

/// What is seen about the target, RTN, m.
struct Scene {
    regions: Vec<Region>,
    lines: Vec<Line>,
    marks: Vec<(Vector3<f64>, RGBColor)>,
    /// What must be visible.
    focus: Vec<Vector3<f64>>,
}

/// A panel of a scene: along-track to the right, `up` upwards.
struct View<'a> {
    up: usize,
    visible: &'a [Vector3<f64>],
    title: &'static str,
}

impl Scene {
    fn new(report: &AbortReport) -> Result<Self, PictureError> {
        let model =
            report.mission.model().map_err(|fault| PictureError::Drawing(fault.to_string()))?;
        let regions = model.phases.iter().filter_map(|phase| phase.region).collect();
        Ok(Self { regions, lines: Vec::new(), marks: Vec::new(), focus: Vec::new() })
    }

    fn draw(&self, path: &Path, title: &str, legend: &[Entry]) -> Result<PathBuf, PictureError> {
        let mut whole = self.focus.clone();
        whole.extend(self.regions.iter().flat_map(corners));
        let near: Vec<Vector3<f64>> =
            self.smallest().iter().flat_map(corners).map(|corner| corner * 3.0).collect();
        let mut views = vec![View { up: 0, visible: &whole, title: "in the orbital plane" }];
        let largest = |axis: usize| whole.iter().map(|p| p[axis].abs()).fold(0.0, f64::max);
        let sideways = self.focus.iter().map(|p| p[2].abs()).fold(0.0, f64::max);
        if sideways > SIDEWAYS_MIN * largest(1) {
            views.push(View { up: 2, visible: &whole, title: "across the orbital plane" });
        }
        if !near.is_empty() {
            views.push(View { up: 0, visible: &near, title: "near the target" });
        }
        let width = 460 * u32::try_from(views.len()).unwrap_or(1).max(2);
        page(path, (width, 520), title, legend, |area| {
            for (area, view) in area.split_evenly((1, views.len())).iter().zip(&views) {
                self.panel(area, view)?;
            }
            Ok(())
        })
    }

    /// The region of the last part of the approach, if it is too small to be seen from afar.
    fn smallest(&self) -> Option<Region> {
        let last = *self.regions.last()?;
        let size = |region: &Region| corners(region)[0].amax();
        let far = self.focus.iter().map(nalgebra::Vector3::amax).fold(0.0, f64::max);
        (4.0 * size(&last) < far).then_some(last)
    }

    fn panel(&self, area: &Area<'_>, view: &View<'_>) -> Result<(), PictureError> {
        let far = view.visible.iter().map(nalgebra::Vector3::amax).fold(0.0, f64::max);
        let in_km = far > 2000.0;
        let unit = if in_km { 1e-3 } else { 1.0 };
        let flat = |p: &Vector3<f64>| (p[1] * unit, p[view.up] * unit);
        let seen: Points = view.visible.iter().map(flat).collect();
        let (x, y): (Range<f64>, Range<f64>) =
            equal(area, range(seen.iter().map(|p| p.0)), range(seen.iter().map(|p| p.1)));
        let axes = Axes {
            x,
            y,
            x_name: if in_km { "along-track [km]" } else { "along-track [m]" },
            y_name: match (view.up, in_km) {
                (0, true) => "radial [km]",
                (0, false) => "radial [m]",
                (_, true) => "cross-track [km]",
                (_, false) => "cross-track [m]",
            },
            title: view.title.into(),
        };
        let mut chart = panel(area, &axes)?;
        for region in &self.regions {
            let outline = outline(region, view.up).into_iter().map(|p| (p.0 * unit, p.1 * unit));
            shape(&mut chart, outline.collect(), PURPLE, 0.2)?;
        }
        for drawn in &self.lines {
            let points = drawn.points.iter().map(flat).collect();
            line(&mut chart, points, drawn.color, drawn.opacity, drawn.width)?;
        }
        for (place, color) in &self.marks {
            dots(&mut chart, vec![flat(place)], *color, 4)?;
        }
        Ok(())
    }
}

/// Two opposite corners of the box around a region.
fn corners(region: &Region) -> [Vector3<f64>; 2] {
    let (Region::Ellipsoid { semi_axes_m: corner } | Region::Box { half_widths_m: corner }) =
        region;
    [*corner, -corner]
}

/// The region's shadow on the along-track axis and the axis `up`, m.
fn outline(region: &Region, up: usize) -> Points {
    match region {
        Region::Ellipsoid { semi_axes_m } => {
            let point = |index: u32| {
                let (s, c) = f64::from(index).to_radians().sin_cos();
                (semi_axes_m[1] * c, semi_axes_m[up] * s)
            };
            (0..360).step_by(3).map(point).collect()
        }
        Region::Box { half_widths_m } => {
            let (along, up) = (half_widths_m[1], half_widths_m[up]);
            vec![(along, up), (-along, up), (-along, -up), (along, -up)]
        }
    }
}
