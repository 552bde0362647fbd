//! The mission as a value: what is asked of a plan with disturbance feedback.

use crate::{
    control::Fault,
    epoch::Epoch,
    frames::{LvlhCcsds, RelativeState},
    orbit::{EARTH_RADIUS_M, KeplerOrbit},
    sets::{ConvexSet, Ellipsoid, OuterSum},
    units::Seconds,
};

/// Most instants of a plan; a server's own limit may be lower.
pub const INSTANTS_MAX: usize = 64;

/// A rendezvous in a fixed time by impulses at fixed instants, against bounded navigation errors.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Orbit of the target, at the first instant.
    pub orbit: KeplerOrbit,
    /// When the mission starts: a label for documents, not used.
    pub epoch: Option<Epoch>,
    /// State at the first instant, as measured.
    pub initial: RelativeState<LvlhCcsds>,
    /// State wanted at the last instant.
    pub target_state: RelativeState<LvlhCcsds>,
    /// When burns may happen: N instants, burns at all but the last.
    pub instants: Instants,
    /// Largest impulse along each axis of `LVLH_CCSDS`, m/s.
    pub delta_v_max_m_s: f64,
    /// Sets of the errors of measured states, `LVLH_CCSDS`, m and m/s: one for all instants, or N.
    pub navigation_errors: Vec<Ellipsoid>,
    /// Which outer ellipsoid stands for the sum of two.
    pub outer_sum: OuterSum,
    /// What a small arrival set means.
    pub metric: ArrivalMetric,
    /// Cost of one m/s of nominal impulse beside the trace in the metric's own units, >= 0.
    pub fuel_weight: f64,
    /// Cost of one m/s of worst-case correction, >= 0; no part of the reported objective.
    pub effort_weight: f64,
    /// Also report the arrival set without feedback.
    pub compare_open_loop: bool,
}

/// Weight of fuel unless said otherwise: that of [Deaconu2014, eq. 24].
pub const FUEL_WEIGHT_DEFAULT: f64 = 1.0;

/// Weight of effort unless said otherwise: enough to choose among equal gains.
pub const EFFORT_WEIGHT_DEFAULT: f64 = 1e-2;

/// When burns may happen.
#[derive(Debug, Clone, PartialEq)]
pub enum Instants {
    /// Equally spaced in time.
    EqualTime {
        /// Number N of instants, at least 2.
        count: usize,
        /// From the first to the last.
        duration: Seconds,
    },
    /// Equally spaced in true anomaly.
    EqualTrueAnomaly {
        /// Number N of instants, at least 2.
        count: usize,
        /// From the first to the last.
        duration: Seconds,
    },
    /// Time since the mission's start, one by one: starts at 0, increases.
    Given(Vec<Seconds>),
}

/// In which variables the trace of the arrival set is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArrivalMetric {
    /// Position in metres.
    Position,
    /// Scaled position and velocity, as in the paper.
    Scaled6,
    /// Position in metres and velocity in metres per second.
    Physical6,
}

impl Instants {
    /// Number N of instants.
    #[must_use]
    pub fn count(&self) -> usize {
        match self {
            Self::EqualTime { count, .. } | Self::EqualTrueAnomaly { count, .. } => *count,
            Self::Given(times) => times.len(),
        }
    }

    fn faults(&self) -> Vec<Fault> {
        let arm = match self {
            Self::EqualTime { .. } => "equal_time",
            Self::EqualTrueAnomaly { .. } => "equal_true_anomaly",
            Self::Given(_) => "given",
        };
        let mut faults = Vec::new();
        if !(2..=INSTANTS_MAX).contains(&self.count()) {
            let list = if arm == "given" { "elapsed_s" } else { "count" };
            faults.push(Fault::new(
                format!("instants.{arm}.{list}"),
                format!("from 2 to {INSTANTS_MAX} instants"),
                self.count().to_string(),
            ));
        }
        match self {
            Self::EqualTime { duration, .. } | Self::EqualTrueAnomaly { duration, .. } => {
                let duration = duration.seconds();
                if !(duration > 0.0 && duration.is_finite()) {
                    let field = format!("instants.{arm}.duration_s");
                    faults.push(Fault::new(field, "a positive number", duration.to_string()));
                }
            }
            Self::Given(times) => faults.extend(given_faults(times)),
        }
        faults
    }
}

fn given_faults(times: &[Seconds]) -> Vec<Fault> {
    let mut faults = Vec::new();
    let field = |i: usize| format!("instants.given.elapsed_s[{i}]");
    if let Some(first) = times.first().filter(|first| first.seconds() != 0.0) {
        faults.push(Fault::new(field(0), "0", first.seconds().to_string()));
    }
    for (i, pair) in times.windows(2).enumerate() {
        let (before, after) = (pair[0].seconds(), pair[1].seconds());
        if !(after > before && after.is_finite()) {
            let expected = format!("a time after {before}");
            faults.push(Fault::new(field(i + 1), expected, after.to_string()));
        }
    }
    faults
}

impl Problem {
    /// Everything wrong with the problem that needs no computation; empty if nothing is.
    #[must_use]
    pub fn faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        let a = self.orbit.semi_major_axis().metres();
        if !(a >= EARTH_RADIUS_M) {
            let expected = format!("at least the Earth's radius, {EARTH_RADIUS_M}");
            let field = "orbit.elements.semi_major_axis_m";
            faults.push(Fault::new(field, expected, a.to_string()));
        }
        for (field, state) in
            [("initial.relative", &self.initial), ("target_state", &self.target_state)]
        {
            let parts = [("position_m", &state.position_m), ("velocity_m_s", &state.velocity_m_s)];
            for (part, vector) in parts {
                if let Some(x) = vector.components.iter().find(|x| !x.is_finite()) {
                    let field = format!("{field}.{part}");
                    faults.push(Fault::new(field, "finite numbers", x.to_string()));
                }
            }
        }
        faults.extend(self.instants.faults());
        if !(self.delta_v_max_m_s > 0.0 && self.delta_v_max_m_s.is_finite()) {
            let got = self.delta_v_max_m_s.to_string();
            faults.push(Fault::new("delta_v_max_m_s", "a positive number", got));
        }
        for (field, weight) in
            [("fuel_weight", self.fuel_weight), ("effort_weight", self.effort_weight)]
        {
            if !(weight >= 0.0 && weight.is_finite()) {
                faults.push(Fault::new(field, "a number, at least 0", weight.to_string()));
            }
        }
        faults.extend(self.navigation_faults());
        faults
    }

    fn navigation_faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        let (sets, count) = (self.navigation_errors.len(), self.instants.count());
        if sets != 1 && sets != count {
            let expected = format!("one set, or one for each of {count} instants");
            faults.push(Fault::new("navigation_errors", expected, format!("{sets} sets")));
        }
        for (i, set) in self.navigation_errors.iter().enumerate() {
            if set.dimension() != 6 {
                let field = format!("navigation_errors[{i}]");
                faults.push(Fault::new(field, "6 dimensions", set.dimension().to_string()));
            }
        }
        faults
    }

    /// Set of the error of the state measured at instant `k`.
    pub(super) fn navigation_error(&self, k: usize) -> &Ellipsoid {
        if self.navigation_errors.len() == 1 {
            &self.navigation_errors[0]
        } else {
            &self.navigation_errors[k]
        }
    }
}
