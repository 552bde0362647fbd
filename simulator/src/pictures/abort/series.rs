//! What flights did, and where they stood to the unsafe sets, against time.

use std::path::{Path, PathBuf};

use super::title;
use crate::{
    campaign::abort::{AbortCampaign, AbortFlight},
    pictures::{
        PictureError,
        chart::{
            Area, Axes, BLUE, GREEN, INK, Mark, Panel, VERMILION, counted, dashed, line, note,
            page, panel, range, shape,
        },
    },
    report::abort::AbortReport,
};

/// Gauges above this are far outside; a panel that reached them would hide the border.
const GAUGE_SHOWN: f64 = 2.0;

/// Lines drawn into one panel.
const LINES_MAX: usize = 60;

/// Least gauge of the drift from every state, and the phases whose unsafe sets hold it
/// [AguilarMarsillach2022, fig. 16]; of the first run.
pub(super) fn safety(
    path: &Path,
    report: &AbortReport,
    campaign: &AbortCampaign,
) -> Result<PathBuf, PictureError> {
    let Some(flight) = campaign.flights.first() else {
        return Err(PictureError::Drawing("no flight".into()));
    };
    let mut legend = vec![("next phase begins, or failure", Mark::Dashed, INK)];
    let drifts = flight.samples.iter().any(|sample| !sample.drifts.is_empty());
    if drifts {
        let names = ["drift, first truth", "drift, second truth"];
        for (index, name) in names.into_iter().enumerate().take(campaign.judged_by.len()) {
            legend.push((name, Mark::Line, if index == 0 { BLUE } else { GREEN }));
        }
        legend.push(("border of the region", Mark::Dashed, VERMILION));
    }
    let sets = flight.samples.iter().map(|sample| sample.unsafe_sets.len()).max().unwrap_or(0);
    if sets > 0 {
        legend.push(("inside unsafe sets", Mark::Patch, VERMILION));
    }
    let rows = usize::from(drifts) + usize::from(sets > 0);
    let height = 90 + 250 * u32::try_from(rows).unwrap_or(1);
    let title = format!("{}: safety of run {}", title(report, campaign), flight.run);
    page(path, (960, height), &title, &legend, |area| {
        let areas = area.split_evenly((rows, 1));
        if drifts {
            gauges(&areas[0], campaign, flight)?;
        }
        if sets > 0 {
            memberships(&areas[rows - 1], campaign, flight, sets)?;
        }
        Ok(())
    })
}

fn gauges(
    area: &Area<'_>,
    campaign: &AbortCampaign,
    flight: &AbortFlight,
) -> Result<(), PictureError> {
    let end = minutes(campaign, flight.samples.len());
    let axes = Axes {
        x: 0.0..end,
        y: 0.0..GAUGE_SHOWN,
        x_name: "time [min]",
        y_name: "least gauge of the drift",
        title: String::new(),
    };
    let mut chart = panel(area, &axes)?;
    turning_points(&mut chart, campaign, flight, GAUGE_SHOWN)?;
    dashed(&mut chart, vec![(0.0, 1.0), (end, 1.0)], VERMILION)?;
    for (index, color) in [BLUE, GREEN].into_iter().enumerate() {
        let samples = flight.samples.iter().enumerate();
        let points = samples.filter_map(|(k, sample)| {
            let drift = sample.drifts.get(index)?;
            Some((minutes(campaign, k), drift.least_gauge))
        });
        line(&mut chart, points.collect(), color, 0.8, if index == 0 { 3 } else { 1 })?;
    }
    Ok(())
}

fn memberships(
    area: &Area<'_>,
    campaign: &AbortCampaign,
    flight: &AbortFlight,
    phases: usize,
) -> Result<(), PictureError> {
    let end = minutes(campaign, flight.samples.len());
    let axes = Axes {
        x: 0.0..end,
        y: 0.0..phases as f64,
        x_name: "time [min]",
        y_name: "phase, from above",
        title: String::new(),
    };
    let mut chart = panel(area, &axes)?;
    for phase in 0..phases {
        let bottom = (phases - 1 - phase) as f64;
        for (k, sample) in flight.samples.iter().enumerate() {
            if sample.unsafe_sets.get(phase).copied().unwrap_or(false) {
                let (from, to) = (minutes(campaign, k), minutes(campaign, k + 1));
                let (low, high) = (bottom + 0.1, bottom + 0.6);
                let bar = vec![(from, low), (to, low), (to, high), (from, high)];
                shape(&mut chart, bar, VERMILION, 0.5)?;
            }
        }
        let kind = campaign.case.model.phases.get(phase).map_or("", |phase| phase.kind.name());
        note(&mut chart, (0.5 * end, bottom + 0.65), format!("sets of phase {phase}, {kind}"))?;
    }
    turning_points(&mut chart, campaign, flight, phases as f64)
}

/// Forces along the three axes [AguilarMarsillach2022, figs. 12, 13 and 17].
pub(super) fn inputs(
    path: &Path,
    report: &AbortReport,
    campaign: &AbortCampaign,
) -> Result<PathBuf, PictureError> {
    let flights = &campaign.flights[..campaign.flights.len().min(LINES_MAX)];
    let powered = |flight: &AbortFlight| {
        let last = flight.steps.iter().rposition(|step| step.force_n != [0.0; 3]);
        last.map_or(1, |last| last + 2).min(flight.steps.len())
    };
    let end = minutes(campaign, flights.iter().map(powered).max().unwrap_or(1));
    let all = || flights.iter().flat_map(|flight| &flight.steps).flat_map(|step| step.force_n);
    let title = format!("{}: forces, {}", title(report, campaign), counted(flights.len()));
    let legend =
        [("one run", Mark::Line, BLUE), ("next phase begins, or failure", Mark::Dashed, INK)];
    page(path, (960, 620), &title, &legend, |area| {
        let names = ["radial [N]", "along-track [N]", "cross-track [N]"];
        for (axis, area) in area.split_evenly((3, 1)).iter().enumerate() {
            let axes = Axes {
                x: 0.0..end,
                y: range(all()),
                x_name: if axis == 2 { "time [min]" } else { "" },
                y_name: names[axis],
                title: String::new(),
            };
            let mut chart = panel(area, &axes)?;
            if let [flight] = flights {
                for height in [axes.y.start, axes.y.end] {
                    turning_points(&mut chart, campaign, flight, height)?;
                }
            }
            let opacity = (12.0 / flights.len() as f64).clamp(0.15, 1.0);
            for flight in flights {
                let held = flight.steps.iter().enumerate().flat_map(|(k, step)| {
                    [k, k + 1].map(|k| (minutes(campaign, k), step.force_n[axis]))
                });
                line(&mut chart, held.collect(), BLUE, opacity, 1)?;
            }
        }
        Ok(())
    })
}

/// Upright lines from 0 to `height` where a phase begins and where thrusters fail.
fn turning_points(
    chart: &mut Panel<'_, '_>,
    campaign: &AbortCampaign,
    flight: &AbortFlight,
    height: f64,
) -> Result<(), PictureError> {
    let changes = (1..flight.samples.len())
        .filter(|k| flight.samples[*k].phase > flight.samples[*k - 1].phase);
    let failure = flight.failure.iter().map(|failure| failure.step);
    for k in changes.chain(failure) {
        let time = minutes(campaign, k);
        dashed(chart, vec![(time, 0.0), (time, height)], INK)?;
    }
    Ok(())
}

/// When step `k` begins.
fn minutes(campaign: &AbortCampaign, k: usize) -> f64 {
    k as f64 * campaign.case.model.sample_time_s / 60.0
}
