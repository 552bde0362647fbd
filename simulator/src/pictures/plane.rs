//! Plants with two states: sets and states in the plane [Quartullo2025b, figs. 1-2].

use std::path::{Path, PathBuf};

use super::{
    PictureError, appearance,
    chart::{
        Axes, INK, Mark, Panel, SKY, VERMILION, counted, dots, line, page, panel, range, shape,
    },
    scheme_legend,
};
use crate::{
    campaign::{
        Campaign, Flight,
        sets::{ErrorSets, outline},
    },
    mission::Mission,
    report::Statistics,
};

/// Final states of every scheme, with S(infinity) and S of the usual last horizon.
pub(super) fn final_states(
    path: &Path,
    mission: &Mission,
    campaigns: &[Campaign],
) -> Result<PathBuf, PictureError> {
    let sets = Sets::new(&campaigns[0])?;
    let runs = campaigns[0].flights.len();
    let title = format!("{}: final states of {}, {}", mission.name, counted(runs), sets.name());
    let mut legend = sets.legend();
    legend.extend(scheme_legend(campaigns, Mark::Dot));
    page(path, (860, 560), &title, &legend, |area| {
        let finals = |campaign: &Campaign| -> Vec<(f64, f64)> {
            let arrived = campaign.flights.iter().filter(|flight| flight.arrived());
            arrived.filter_map(|f| f.samples.last()).map(|s| (s.state[0], s.state[1])).collect()
        };
        let points: Vec<(f64, f64)> = campaigns.iter().flat_map(finals).collect();
        let mut chart = panel(area, &sets.axes(&points))?;
        sets.draw(&mut chart)?;
        // The first scheme last, so that its dots lie on top.
        for campaign in campaigns.iter().rev() {
            dots(&mut chart, finals(campaign), appearance(campaign.scheme).1, 3)?;
        }
        Ok(())
    })
}

/// One run of every scheme, with the sets and the state constraints.
pub(super) fn trajectories(
    path: &Path,
    mission: &Mission,
    campaigns: &[Campaign],
) -> Result<PathBuf, PictureError> {
    let sets = Sets::new(&campaigns[0])?;
    let title = format!("{}: one run of each scheme, {}", mission.name, sets.name());
    let mut legend = sets.legend();
    legend.extend(scheme_legend(campaigns, Mark::Line));
    page(path, (860, 560), &title, &legend, |area| {
        let states = |flight: &Flight| -> Vec<(f64, f64)> {
            flight.samples.iter().map(|sample| (sample.state[0], sample.state[1])).collect()
        };
        let first = |campaign: &Campaign| campaign.flights.first().map_or(Vec::new(), states);
        let points: Vec<(f64, f64)> = campaigns.iter().flat_map(first).collect();
        let mut chart = panel(area, &sets.axes(&points))?;
        sets.draw(&mut chart)?;
        for campaign in campaigns.iter().rev() {
            let color = appearance(campaign.scheme).1;
            line(&mut chart, first(campaign), color, 1.0, 2)?;
            dots(&mut chart, first(campaign), color, 3)?;
        }
        dots(&mut chart, vec![(0.0, 0.0)], INK, 3)
    })
}

struct Sets {
    limit: Vec<(f64, f64)>,
    last: Vec<(f64, f64)>,
    /// Most frequent last horizon.
    terms: usize,
}

impl Sets {
    fn new(campaign: &Campaign) -> Result<Self, PictureError> {
        let sets = ErrorSets::new(&campaign.artifact).map_err(PictureError::Drawing)?;
        let horizons = campaign.flights.iter().filter_map(|flight| flight.steps.last());
        let usual = Statistics::of(horizons.map(|step| f64::from(step.adapted_horizon)));
        let terms = usual.map_or(0, |statistics| statistics.median.round() as usize);
        Ok(Self {
            limit: outline(&sets.generators_of_limit(), [0, 1]),
            last: outline(&sets.generators(terms), [0, 1]),
            terms,
        })
    }

    fn name(&self) -> String {
        format!("last horizon {}", self.terms)
    }

    fn legend(&self) -> Vec<super::chart::Entry> {
        vec![("S(infinity)", Mark::Patch, VERMILION), ("S(last horizon)", Mark::Patch, SKY)]
    }

    fn axes(&self, points: &[(f64, f64)]) -> Axes {
        let all = || points.iter().chain(&self.limit);
        Axes {
            x: range(all().map(|point| point.0)),
            y: range(all().map(|point| point.1)),
            x_name: "x1",
            y_name: "x2",
            title: String::new(),
        }
    }

    fn draw(&self, chart: &mut Panel<'_, '_>) -> Result<(), PictureError> {
        shape(chart, self.limit.clone(), VERMILION, 0.15)?;
        shape(chart, self.last.clone(), SKY, 0.5)
    }
}
