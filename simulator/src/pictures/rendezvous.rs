//! Spacecraft: trajectory with cone and tube, positions, snapshots of the cone.

use std::path::{Path, PathBuf};

use nalgebra::{DMatrix, Matrix3, Vector3};

use super::{
    PictureError, appearance,
    chart::{
        Area, Axes, BLUE, GREEN, INK, Mark, Points, SKY, counted, dashed, dots, equal, line, page,
        panel, range, shape,
    },
    scheme_legend,
};
use crate::{
    campaign::{
        Campaign, Flight,
        sets::{ErrorSets, outline},
    },
    mission::{
        Mission,
        model::{HillModel, Kind},
    },
};

/// Runs drawn into one panel; more would only blacken it.
const LINES_MAX: usize = 200;

/// Cones drawn along one trajectory, and snapshots of one run.
const CONES: usize = 4;
const SNAPSHOTS: usize = 6;

/// Distance that the enlarged panel shows around the end, m.
const CLOSE_M: f64 = 6.0;

/// The orbital plane: along-track to the right, radial up. Left the whole approach of every
/// scheme, right the last metres of the first scheme with the tube about its first plan.
pub(super) fn trajectory(
    path: &Path,
    mission: &Mission,
    campaigns: &[Campaign],
    hill: &HillModel,
) -> Result<PathBuf, PictureError> {
    let title = format!("{}: one run of each scheme in the orbital plane", mission.name);
    let mut legend = scheme_legend(campaigns, Mark::Line);
    legend.push(("capture point", Mark::Dashed, INK));
    legend.push(("cone", Mark::Patch, GREEN));
    legend.push(("tube of the first plan", Mark::Patch, SKY));
    page(path, (1180, 600), &title, &legend, |area| {
        let halves = area.split_evenly((1, 2));
        let Some(flight) = campaigns.first().and_then(|c| c.flights.first()) else {
            return Ok(());
        };
        let tube = tube(&campaigns[0], flight)?;
        let all = || campaigns.iter().filter_map(|campaign| campaign.flights.first());
        let cones = cone_steps(flight).filter_map(|k| cone_shadow(hill, flight, k)).flatten();
        let paths = all().flat_map(in_plane).chain(capture_path(flight));
        let points: Points = paths.chain(cones).collect();
        draw_plane(&halves[0], "whole approach", &points, campaigns, hill, flight, &tube)?;
        let end = flight.samples.last().map_or((0.0, 0.0), |sample| flat(&sample.reference));
        let square = [(-CLOSE_M, -CLOSE_M), (CLOSE_M, CLOSE_M)];
        let close: Points = square.map(|(x, y)| (end.0 + x, end.1 + y)).to_vec();
        draw_plane(&halves[1], "last metres", &close, campaigns, hill, flight, &tube)
    })
}

fn draw_plane(
    area: &Area<'_>,
    title: &str,
    shown: &[(f64, f64)],
    campaigns: &[Campaign],
    hill: &HillModel,
    flight: &Flight,
    tube: &[Points],
) -> Result<(), PictureError> {
    let x = range(shown.iter().map(|point| point.0));
    let y = range(shown.iter().map(|point| point.1));
    let (x, y) = equal(area, x, y);
    let axes = Axes { x, y, x_name: "along-track [m]", y_name: "radial [m]", title: title.into() };
    let mut chart = panel(area, &axes)?;
    for cone in cone_steps(flight).filter_map(|k| cone_shadow(hill, flight, k)) {
        shape(&mut chart, cone, GREEN, 0.12)?;
    }
    for section in tube {
        shape(&mut chart, section.clone(), SKY, 0.35)?;
    }
    dashed(&mut chart, capture_path(flight), INK)?;
    for campaign in campaigns.iter().rev() {
        let Some(flight) = campaign.flights.first() else { continue };
        let color = appearance(campaign.scheme).1;
        line(&mut chart, in_plane(flight), color, 1.0, 2)?;
        dots(&mut chart, in_plane(flight).into_iter().next_back().into_iter().collect(), color, 5)?;
    }
    Ok(())
}

/// Samples at which the cone is drawn.
fn cone_steps(flight: &Flight) -> impl Iterator<Item = usize> {
    let last = flight.samples.len().saturating_sub(1);
    (0..CONES).map(move |index| last * index / (CONES - 1))
}

/// The cone at sample `k`, as deep as the chaser is, seen along the orbit normal.
fn cone_shadow(hill: &HillModel, flight: &Flight, k: usize) -> Option<Points> {
    let (apex, corners) = cone_corners(hill, flight, k)?;
    let corners = std::iter::once(apex).chain(corners).map(|corner| (corner[1], corner[0]));
    Some(hull(corners.collect()))
}

/// Apex and the four corners of the cone's base, a little beyond the chaser.
fn cone_corners(
    hill: &HillModel,
    flight: &Flight,
    k: usize,
) -> Option<(Vector3<f64>, [Vector3<f64>; 4])> {
    let cone = hill.cone?;
    let port = hill.target.at(k)?.port_m;
    let position = position(&flight.samples.get(k)?.state);
    let axis = port.normalize();
    let depth = (axis.dot(&position) - port.norm()).max(0.5) * 1.15;
    Some((port, cone.edges(&port).map(|edge| port + edge * (depth / edge.dot(&axis)))))
}

/// Cross-sections of the tube about the first plan, in the plane.
fn tube(campaign: &Campaign, flight: &Flight) -> Result<Vec<Points>, PictureError> {
    let planned = flight.first_prediction.as_ref().and_then(|p| p.positions_m.as_ref());
    let (Some(planned), Some(unit)) = (planned, flight.position_unit_m()) else {
        return Ok(Vec::new());
    };
    let sets = ErrorSets::new(&campaign.artifact).map_err(PictureError::Drawing)?;
    let mut sections = Vec::new();
    for (j, centre) in planned.values.chunks_exact(3).enumerate() {
        let generators: DMatrix<f64> = sets.generators(j) * unit;
        let section = outline(&generators, [1, 0]);
        sections.push(section.into_iter().map(|(x, y)| (centre[1] + x, centre[0] + y)).collect());
    }
    Ok(sections)
}

/// RTN components of every run, the reference dashed [Quartullo2025a, fig. 10].
pub(super) fn positions(
    path: &Path,
    mission: &Mission,
    campaign: &Campaign,
) -> Result<PathBuf, PictureError> {
    let flights = &campaign.flights[..campaign.flights.len().min(LINES_MAX)];
    let (name, color) = appearance(campaign.scheme);
    let title = format!("{}: position in {}, {name}", mission.name, counted(flights.len()));
    let mut legend = vec![("one run", Mark::Line, color)];
    // With parameters drawn run by run there is no common reference.
    let common = mission.simulation.randomised.is_none();
    if common {
        legend.push(("capture point", Mark::Dashed, INK));
    }
    page(path, (860, 760), &title, &legend, |area| {
        let rows = area.split_evenly((3, 1));
        let longest = flights.iter().max_by_key(|flight| flight.samples.len());
        let steps = longest.map_or(1, |flight| flight.samples.len() - 1);
        let names = ["radial [m]", "along-track [m]", "normal [m]"];
        for (row, y_name) in names.into_iter().enumerate() {
            let component = |flight: &Flight| -> Points {
                let samples = flight.samples.iter().enumerate();
                samples.map(|(k, sample)| (k as f64, sample.state[row])).collect()
            };
            let axes = Axes {
                x: 0.0..steps as f64,
                y: range(flights.iter().flat_map(component).map(|point| point.1)),
                x_name: if row == 2 { "step k" } else { "" },
                y_name,
                title: String::new(),
            };
            let mut chart = panel(&rows[row], &axes)?;
            let opacity = (12.0 / flights.len() as f64).clamp(0.15, 1.0);
            for flight in flights {
                line(&mut chart, component(flight), color, opacity, 1)?;
            }
            if let (true, Some(flight)) = (common, longest) {
                let samples = flight.samples.iter().enumerate();
                let reference = samples.map(|(k, s)| (k as f64, s.reference[row])).collect();
                dashed(&mut chart, reference, INK)?;
            }
        }
        Ok(())
    })
}

/// Chaser, docking port and cone at some steps of one run [Quartullo2025a, fig. 11], seen
/// obliquely: along-track to the right, normal up, radial towards the lower left.
pub(super) fn snapshots(
    path: &Path,
    mission: &Mission,
    flight: &Flight,
) -> Result<PathBuf, PictureError> {
    let Kind::Hill(hill) = &flight.model.kind else {
        return Err(PictureError::Drawing("snapshots need a spacecraft".into()));
    };
    let title = format!("{}: snapshots of one run", mission.name);
    let legend = [
        ("chaser", Mark::Dot, BLUE),
        ("docking port", Mark::Dot, INK),
        ("docking cone", Mark::Patch, GREEN),
    ];
    let seen = |point: &Vector3<f64>| {
        let view = oblique_view() * point;
        (view[0], view[1])
    };
    page(path, (1180, 780), &title, &legend, |area| {
        let panels = area.split_evenly((2, SNAPSHOTS / 2));
        let last = flight.samples.len().saturating_sub(1);
        for (index, panel_area) in panels.iter().enumerate() {
            let k = last * index / (SNAPSHOTS - 1);
            let Some((apex, base)) = cone_corners(hill, flight, k) else { continue };
            let chaser = position(&flight.samples[k].state);
            let corners: Points = base.iter().map(seen).collect();
            let points = || corners.iter().copied().chain([seen(&apex), seen(&chaser), (0.0, 0.0)]);
            let x = range(points().map(|point| point.0));
            let y = range(points().map(|point| point.1));
            let (x, y) = equal(panel_area, x, y);
            let title = format!("k = {k}");
            let axes = Axes { x, y, x_name: "oblique view [m]", y_name: "", title };
            let mut chart = panel(panel_area, &axes)?;
            for face in 0..4 {
                let side = vec![seen(&apex), corners[face], corners[(face + 1) % 4]];
                shape(&mut chart, side, GREEN, 0.12)?;
            }
            dots(&mut chart, vec![seen(&apex)], INK, 4)?;
            dots(&mut chart, vec![seen(&chaser)], BLUE, 5)?;
        }
        Ok(())
    })
}

/// Rows: right and up of the oblique view, from RTN.
fn oblique_view() -> Matrix3<f64> {
    let (shift, lift) = (-0.42, -0.28);
    Matrix3::new(shift, 1.0, 0.0, lift, 0.0, 1.0, 0.0, 0.0, 0.0)
}

fn position(state: &[f64]) -> Vector3<f64> {
    Vector3::new(state[0], state[1], state[2])
}

/// (along-track, radial) of an RTN state.
fn flat(state: &[f64]) -> (f64, f64) {
    (state[1], state[0])
}

/// The path in the plane; of a run that never arrives, only up to its first violation.
fn in_plane(flight: &Flight) -> Points {
    let all = flight.samples.len();
    let shown =
        if flight.arrived() { all } else { flight.first_violation().map_or(all, |k| k + 1) };
    flight.samples[..shown].iter().map(|sample| flat(&sample.state)).collect()
}

fn capture_path(flight: &Flight) -> Points {
    flight.samples.iter().map(|sample| flat(&sample.reference)).collect()
}

/// Convex hull in the plane (monotone chain).
fn hull(mut points: Points) -> Points {
    points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let half = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut chain: Points = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..] {
                let turn = (b.0 - a.0) * (point.1 - a.1) - (b.1 - a.1) * (point.0 - a.0);
                if turn > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut around = half(&mut points.iter().copied());
    around.extend(half(&mut points.iter().rev().copied()));
    around
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hull_drops_inner_points() {
        let points = vec![(0.0, 0.0), (2.0, 0.0), (1.0, 0.5), (2.0, 2.0), (0.0, 2.0), (1.0, 0.0)];
        assert_eq!(hull(points), [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]);
    }
}
