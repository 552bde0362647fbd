//! The linear model of a problem: instants, transition matrices, disturbance sets, metric.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{ArrivalMetric, Instants, Problem, outcome::physical_values};
use crate::{
    budget::{Budget, Interruption},
    control::{Failure, PrepareError},
    dynamics::{TschaunerHempel, yamanaka_ankersen},
    frames::{InFrame, LvlhCcsds, RelativeState},
    matrices::{frobenius, product, range, times_vector, transposed_product},
    program::{Impulses, impulse_bound, least_impulses, least_limit},
    sets::Ellipsoid,
    units::{Angle, Seconds},
};

/// Everything linear about a problem, in scaled variables [Deaconu2014, eq. 1]. Instants, burns
/// and disturbances count from 0: burn k happens at instant k, disturbance i acts between instants
/// i and i + 1.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearModel {
    /// N times since the start.
    pub elapsed: Vec<Seconds>,
    /// N true anomalies, counting revolutions.
    pub anomalies: Vec<Angle>,
    /// N scalings.
    pub scales: Vec<TschaunerHempel>,
    /// A_k (6 x 6), N - 1: from instant k to the next.
    pub steps: Vec<DMatrix<f64>>,
    /// N matrices (6 x 6): from instant k to the last.
    pub to_end: Vec<DMatrix<f64>>,
    /// N - 1 matrices (6 x 3): what burn k, m/s, adds to the last state.
    pub final_maps: Vec<DMatrix<f64>>,
    /// N sets of errors of the measured state.
    pub errors: Vec<Ellipsoid>,
    /// N - 1 sets of w_i. [Deaconu2014, eq. 8]
    pub disturbances: Vec<Ellipsoid>,
    /// H (m x 6): metric's variables from the last scaled state.
    pub metric: DMatrix<f64>,
    /// First state.
    pub initial: DVector<f64>,
    /// Last state wanted.
    pub target: DVector<f64>,
    /// Largest impulse along an axis, m/s.
    pub limit: f64,
    /// Cost of fuel.
    pub fuel_weight: f64,
}

/// Directions of the last state that burns move by less than this, beside the most they move, are
/// out of reach: instants half a revolution apart leave 1e-16, the least useful impulse 1e-6.
const REACH_CUT_OFF: f64 = 1e-9;

/// A lower bound on the objective of every plan, from the problem alone.
#[derive(Debug, Clone, PartialEq)]
pub struct LowerBound {
    /// Least |H M_i P_i|_F that any gains can reach, one a disturbance.
    pub trace_shares: Vec<f64>,
    /// (sum of the shares)² + fuel weight times the least fuel.
    pub objective: f64,
}

impl LinearModel {
    /// The model of a problem.
    ///
    /// # Errors
    /// The problem's faults, and a disturbance set that rounding has destroyed.
    pub fn of(problem: &Problem) -> Result<Self, PrepareError> {
        let faults = problem.faults();
        if faults.is_empty() {
            Ok(Self::new(problem).map_err(Failure::Numerical)?)
        } else {
            Err(PrepareError::Faults(faults))
        }
    }

    /// The model of a problem without faults; `Err` says which set rounding has destroyed.
    pub(super) fn new(problem: &Problem) -> Result<Self, String> {
        let orbit = &problem.orbit;
        let (elapsed, anomalies) = instants(problem);
        let last = elapsed.len() - 1;
        let transition = |from: usize, to: usize| {
            let duration = elapsed[to].seconds() - elapsed[from].seconds();
            let duration = Seconds::from_seconds(duration);
            yamanaka_ankersen(orbit, anomalies[from], anomalies[to], duration)
        };
        let scales: Vec<_> = anomalies.iter().map(|&nu| TschaunerHempel::new(orbit, nu)).collect();
        let steps: Vec<_> = (0..last).map(|k| transition(k, k + 1)).collect();
        let mut to_end: Vec<_> = (0..last).map(|k| transition(k, last)).collect();
        to_end.push(DMatrix::identity(6, 6));
        let final_maps =
            (0..last).map(|k| to_end[k].columns(3, 3) * scales[k].velocity_scale_s).collect();
        let errors = (0..=last)
            .map(|k| problem.navigation_error(k).mapped(&scales[k].scaled_from_physical()))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|fault| format!("a scaled navigation error: {fault}"))?;
        let disturbances = (0..last)
            .map(|k| {
                let carried = errors[k].mapped(&steps[k])?;
                carried.outer_minkowski_sum(&errors[k + 1], problem.outer_sum)
            })
            .collect::<Result<Vec<_>, _>>()
            .map_err(|fault| format!("a disturbance set: {fault}"))?;
        let metric = match problem.metric {
            ArrivalMetric::Scaled6 => DMatrix::identity(6, 6),
            ArrivalMetric::Physical6 => scales[last].physical_from_scaled(),
            ArrivalMetric::Position => scales[last].physical_from_scaled().rows(0, 3).into(),
        };
        Ok(Self {
            initial: scaled(&scales[0], &problem.initial),
            target: scaled(&scales[last], &problem.target_state),
            elapsed,
            anomalies,
            scales,
            steps,
            to_end,
            final_maps,
            errors,
            disturbances,
            metric,
            limit: problem.delta_v_max_m_s,
            fuel_weight: problem.fuel_weight,
        })
    }

    /// Number N - 1 of burns, and of disturbances.
    pub(super) fn burns(&self) -> usize {
        self.steps.len()
    }

    /// The scaled state at instant `k`.
    pub(super) fn scaled(&self, k: usize, state: &RelativeState<LvlhCcsds>) -> DVector<f64> {
        scaled(&self.scales[k], state)
    }

    /// The physical state at instant `k`.
    pub(super) fn physical(&self, k: usize, state: &DVector<f64>) -> RelativeState<LvlhCcsds> {
        let x = times_vector(&self.scales[k].physical_from_scaled(), state);
        RelativeState {
            position_m: InFrame::new(Vector3::new(x[0], x[1], x[2])),
            velocity_m_s: InFrame::new(Vector3::new(x[3], x[4], x[5])),
        }
    }

    /// The state before burn `k` + 1, from that before burn `k` and the burn in m/s.
    pub(super) fn advanced(
        &self,
        k: usize,
        state: &DVector<f64>,
        burn: &Vector3<f64>,
    ) -> DVector<f64> {
        let mut after = state.clone();
        for axis in 0..3 {
            after[3 + axis] += self.scales[k].velocity_scale_s * burn[axis];
        }
        times_vector(&self.steps[k], &after)
    }

    /// B_N (6 x 3 (N - 1)): the last state from all burns.
    pub(super) fn burn_map(&self) -> DMatrix<f64> {
        let mut map = DMatrix::zeros(6, 3 * self.burns());
        for (k, block) in self.final_maps.iter().enumerate() {
            map.columns_mut(3 * k, 3).copy_from(block);
        }
        map
    }

    /// What burns must add to the last state: r = x_f - A_N x_1.
    pub(super) fn shortfall(&self) -> DVector<f64> {
        &self.target - times_vector(&self.to_end[0], &self.initial)
    }

    /// H times the maps of the burns that can still answer disturbance `i` (m x 3 (N - 2 - i)).
    pub(super) fn answers(&self, i: usize) -> DMatrix<f64> {
        let later = self.burns() - i - 1;
        let mut answers = DMatrix::zeros(self.metric.nrows(), 3 * later);
        for (column, k) in (i + 1..self.burns()).enumerate() {
            answers
                .columns_mut(3 * column, 3)
                .copy_from(&product(&self.metric, &self.final_maps[k]));
        }
        answers
    }

    /// H G_i P_i (m x 6): what disturbance `i` does to the last state if nothing answers it, as the
    /// image of the unit ball.
    pub(super) fn unanswered(&self, i: usize) -> DMatrix<f64> {
        let to_end = product(&self.metric, &self.to_end[i + 1]);
        product(&to_end, self.disturbances[i].root())
    }

    /// How far, as a share of it, the shortfall lies off what burns of any size can reach, and the
    /// dimension of that.
    pub(super) fn unreachable_share(&self) -> (f64, usize) {
        let map = self.burn_map();
        let within = range(&map, REACH_CUT_OFF);
        let shortfall = self.shortfall();
        let column = DMatrix::from_column_slice(6, 1, shortfall.as_slice());
        let size = frobenius(&column);
        let inside = product(&within, &transposed_product(&within, &column));
        let share = if size > 0.0 { frobenius(&(&column - inside)) / size } else { 0.0 };
        (share, within.ncols())
    }

    /// Is there a burn plan if impulses may be as large as they like?
    pub(super) fn is_reachable(&self) -> bool {
        self.unreachable_share().0 <= REACH_CUT_OFF
    }

    /// Least `delta_v_max_m_s` for which a plan exists, with the ray that proves it; `None` if none
    /// would do.
    pub(super) fn least_limit(&self) -> Option<(f64, Vec<f64>)> {
        if !self.is_reachable() {
            return None;
        }
        least_limit(&self.burn_map(), self.shortfall().as_slice())
    }

    /// A lower bound on the objective of every plan: no gains leave less of disturbance i than the
    /// part of H G_i P_i outside the range of the later burns, and no burns cost less than the linear
    /// program without corrections.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn lower_bound(&self, budget: Budget<'_>) -> Result<LowerBound, Interruption> {
        let trace_shares = (0..self.burns())
            .map(|i| {
                budget.check()?;
                let effect = self.unanswered(i);
                let within = range(&self.answers(i), 1e-12);
                let answered = product(&within, &transposed_product(&within, &effect));
                Ok(frobenius(&(effect - answered)))
            })
            .collect::<Result<Vec<f64>, Interruption>>()?;
        let sum: f64 = trace_shares.iter().sum();
        budget.check()?;
        let objective = sum * sum + self.fuel_weight * self.least_fuel();
        Ok(LowerBound { objective, trace_shares })
    }

    /// A lower bound on the fuel, m/s: from the multipliers of the linear program, whoever found
    /// them.
    fn least_fuel(&self) -> f64 {
        let (map, right) = (self.burn_map(), self.shortfall());
        let limits = vec![self.limit; map.ncols()];
        match least_impulses(&map, right.as_slice(), &limits) {
            Impulses::Optimal { multipliers, .. } => {
                impulse_bound(&map, right.as_slice(), &limits, &multipliers).max(0.0)
            }
            Impulses::Infeasible { .. } | Impulses::Stalled => 0.0,
        }
    }
}

fn scaled(scale: &TschaunerHempel, state: &RelativeState<LvlhCcsds>) -> DVector<f64> {
    times_vector(&scale.scaled_from_physical(), &physical_values(state))
}

/// N times since the start, and the true anomalies there.
fn instants(problem: &Problem) -> (Vec<Seconds>, Vec<Angle>) {
    let orbit = &problem.orbit;
    let shares = |count: usize| (0..count).map(move |k| as_f64(k) / as_f64(count - 1));
    match &problem.instants {
        Instants::EqualTime { count, duration } => {
            let times = shares(*count).map(|s| Seconds::from_seconds(s * duration.seconds()));
            at_times(problem, times.collect())
        }
        Instants::Given(times) => at_times(problem, times.clone()),
        Instants::EqualTrueAnomaly { count, duration } => {
            let first = orbit.true_anomaly().radians();
            let last = orbit.true_anomaly_after(*duration).radians();
            let anomalies: Vec<Angle> =
                shares(*count).map(|s| Angle::from_radians(first + s * (last - first))).collect();
            let mut times: Vec<Seconds> =
                anomalies.iter().map(|&nu| orbit.elapsed_at(nu)).collect();
            // The ends are given, not found.
            times[0] = Seconds::from_seconds(0.0);
            times[*count - 1] = *duration;
            (times, anomalies)
        }
    }
}

fn at_times(problem: &Problem, times: Vec<Seconds>) -> (Vec<Seconds>, Vec<Angle>) {
    let anomalies = times.iter().map(|&t| problem.orbit.true_anomaly_after(t)).collect();
    (times, anomalies)
}

/// Exact for every count of instants.
pub(super) fn as_f64(count: usize) -> f64 {
    u32::try_from(count).map_or(f64::INFINITY, f64::from)
}
