//! Quantities against the step, box plots, sweeps.

use std::path::{Path, PathBuf};

use plotters::{
    element::{PathElement, Rectangle},
    style::{Color as _, ShapeStyle},
};
use vbar_proto::v1::Branch;

use super::{
    PictureError, appearance,
    chart::{
        Area, Axes, BLUE, INK, Mark, Panel, VERMILION, counted, dashed, dots, from_zero, line,
        note, page, panel, range,
    },
    scheme_legend,
};
use crate::{
    campaign::{Campaign, Flight, SweepPoint},
    mission::{Mission, model::Kind},
    report::Statistics,
};

/// Lines drawn into one panel; more would only blacken it.
const LINES_MAX: usize = 200;

/// Greatest input component of every run against the step [Quartullo2025a, fig. A1].
pub(super) fn inputs(
    path: &Path,
    mission: &Mission,
    campaign: &Campaign,
) -> Result<PathBuf, PictureError> {
    let flights = &campaign.flights[..campaign.flights.len().min(LINES_MAX)];
    let bound = flights.first().map_or(1.0, input_bound);
    let longest = flights.iter().map(|flight| flight.steps.len()).max().unwrap_or(1);
    let title = format!("{}: largest input component, {}", mission.name, counted(flights.len()));
    let legend = [("one run", Mark::Line, BLUE), ("bound", Mark::Dashed, VERMILION)];
    page(path, (860, 420), &title, &legend, |area| {
        let axes = Axes {
            x: 0.0..longest as f64,
            y: 0.0..bound * 1.1,
            x_name: "step k",
            y_name: "max |u(k)|",
            title: String::new(),
        };
        let mut chart = panel(area, &axes)?;
        let opacity = (12.0 / flights.len() as f64).clamp(0.15, 1.0);
        for flight in flights {
            line(&mut chart, held(flight), BLUE, opacity, 1)?;
        }
        dashed(&mut chart, vec![(0.0, bound), (longest as f64, bound)], VERMILION)
    })
}

/// The largest component, held over each sample.
fn held(flight: &Flight) -> Vec<(f64, f64)> {
    let largest = |input: &[f64]| input.iter().fold(0.0_f64, |max, u| max.max(u.abs()));
    let steps = flight.steps.iter().enumerate();
    steps.flat_map(|(k, step)| [k, k + 1].map(|k| (k as f64, largest(&step.input)))).collect()
}

fn input_bound(flight: &Flight) -> f64 {
    match &flight.model.kind {
        Kind::Hill(_) => 1.0,
        Kind::Linear(linear) => linear.input_upper.amax().max(linear.input_lower.amax()),
    }
}

/// J and N of the first run against the step [Quartullo2025a, fig. A2].
pub(super) fn cost_and_horizon(
    path: &Path,
    mission: &Mission,
    campaign: &Campaign,
) -> Result<PathBuf, PictureError> {
    let steps = campaign.flights.first().map_or(&[][..], |flight| &flight.steps);
    let series = |value: &dyn Fn(usize) -> f64| -> Vec<(f64, f64)> {
        (0..steps.len()).map(|k| (k as f64, value(k))).collect()
    };
    let cost = series(&|k| steps[k].cost);
    let horizon = series(&|k| f64::from(steps[k].horizon));
    let name = appearance(campaign.scheme).0;
    let title = format!("{}: optimal cost and horizon of one run, {name}", mission.name);
    let legend = [("terminal point", Mark::Dot, BLUE), ("terminal set", Mark::Dot, VERMILION)];
    page(path, (860, 620), &title, &legend, |area| {
        let rows = area.split_evenly((2, 1));
        for (row, (values, y_name)) in
            [(cost, "cost J(k)"), (horizon, "horizon N(k)")].into_iter().enumerate()
        {
            let axes = Axes {
                x: -0.5..steps.len() as f64,
                y: from_zero(values.iter().map(|point| point.1)),
                x_name: if row == 1 { "step k" } else { "" },
                y_name,
                title: String::new(),
            };
            let mut chart = panel(&rows[row], &axes)?;
            line(&mut chart, values.clone(), INK, 0.4, 1)?;
            let (set, point): (Vec<_>, Vec<_>) = values
                .into_iter()
                .partition(|(k, _)| steps[*k as usize].branch == Branch::TerminalSet);
            dots(&mut chart, point, BLUE, 4)?;
            dots(&mut chart, set, VERMILION, 4)?;
        }
        Ok(())
    })
}

/// Final distance, fuel and duration of the schemes [Quartullo2025a, figs. 6-8]: boxes from the
/// first to the third quartile, whiskers to the extremes.
pub(super) fn boxes(
    path: &Path,
    mission: &Mission,
    campaigns: &[Campaign],
) -> Result<PathBuf, PictureError> {
    // A scheme that never arrives has no box.
    let arrives = |campaign: &&Campaign| campaign.flights.iter().any(Flight::arrived);
    let campaigns: Vec<&Campaign> = campaigns.iter().filter(arrives).collect();
    let Some(first) = campaigns.first() else {
        return Err(PictureError::Drawing("no run of any scheme arrived".into()));
    };
    let metres = first.flights.first().is_some_and(|f| f.position_unit_m().is_some());
    let distance = if metres { "final distance [m]" } else { "final norm" };
    let runs = first.flights.len();
    let title = format!("{}: {} of each scheme, medians above", mission.name, counted(runs));
    let legend = scheme_legend(campaigns.iter().copied(), Mark::Patch);
    page(path, (960, 440), &title, &legend, |area| {
        let columns = area.split_evenly((1, 3));
        box_panel(&columns[0], distance, &campaigns, &Flight::final_distance)?;
        box_panel(&columns[1], "fuel, sum of |u|", &campaigns, &Flight::fuel)?;
        box_panel(&columns[2], "completion time, steps", &campaigns, &|f| f.steps.len() as f64)
    })
}

fn box_panel(
    area: &Area<'_>,
    title: &str,
    campaigns: &[&Campaign],
    value: &dyn Fn(&Flight) -> f64,
) -> Result<(), PictureError> {
    let statistics: Vec<Option<Statistics>> = campaigns
        .iter()
        .map(|campaign| {
            let arrived = campaign.flights.iter().filter(|flight| flight.arrived());
            Statistics::of(arrived.map(value))
        })
        .collect();
    let axes = Axes {
        x: 0.0..campaigns.len() as f64,
        y: from_zero(statistics.iter().flatten().map(|s| s.max)),
        x_name: "",
        y_name: "",
        title: title.to_owned(),
    };
    let mut chart = super::chart::unnumbered_panel(area, &axes)?;
    for (index, (campaign, statistics)) in campaigns.iter().zip(&statistics).enumerate() {
        let Some(s) = statistics else { continue };
        draw_box(&mut chart, index as f64 + 0.5, s, appearance(campaign.scheme).1)?;
    }
    Ok(())
}

fn draw_box(
    chart: &mut Panel<'_, '_>,
    x: f64,
    s: &Statistics,
    color: plotters::style::RGBColor,
) -> Result<(), PictureError> {
    let (half, cap) = (0.25, 0.12);
    chart.draw_series([Rectangle::new(
        [(x - half, s.q25), (x + half, s.q75)],
        color.mix(0.35).filled(),
    )])?;
    let edge = ShapeStyle::from(color).stroke_width(2);
    chart.draw_series([Rectangle::new([(x - half, s.q25), (x + half, s.q75)], edge)])?;
    let thick = ShapeStyle::from(INK).stroke_width(3);
    let strokes = [
        (vec![(x, s.q75), (x, s.max)], edge),
        (vec![(x, s.q25), (x, s.min)], edge),
        (vec![(x - cap, s.max), (x + cap, s.max)], edge),
        (vec![(x - cap, s.min), (x + cap, s.min)], edge),
        (vec![(x - half, s.median), (x + half, s.median)], thick),
    ];
    chart.draw_series(strokes.map(|(points, style)| PathElement::new(points, style)))?;
    note(chart, (x, s.max), format!("{:.2}", s.median))
}

/// Mean fuel and duration against the fuel weight [Quartullo2025a, fig. 12].
pub(super) fn sweep(
    path: &Path,
    mission: &Mission,
    points: &[SweepPoint],
) -> Result<PathBuf, PictureError> {
    let title = format!("{}: mean fuel and duration against the fuel weight", mission.name);
    page(path, (860, 620), &title, &[("mean over the runs", Mark::Line, BLUE)], |area| {
        let rows = area.split_evenly((2, 1));
        let fuel: fn(&SweepPoint) -> f64 = |point| point.fuel;
        let steps: fn(&SweepPoint) -> f64 = |point| point.completion_steps;
        for (row, (value, y_name)) in
            [(fuel, "fuel, sum of |u|"), (steps, "completion time, steps")].into_iter().enumerate()
        {
            let values: Vec<(f64, f64)> = points
                .iter()
                .map(|point| (point.fuel_weight, value(point)))
                .filter(|point| point.1.is_finite())
                .collect();
            let axes = Axes {
                x: range(values.iter().map(|point| point.0)),
                y: range(values.iter().map(|point| point.1)),
                x_name: if row == 1 { "fuel weight gamma_v" } else { "" },
                y_name,
                title: String::new(),
            };
            let mut chart = panel(&rows[row], &axes)?;
            line(&mut chart, values.clone(), BLUE, 1.0, 2)?;
            dots(&mut chart, values, BLUE, 3)?;
        }
        Ok(())
    })
}
