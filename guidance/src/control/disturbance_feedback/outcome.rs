//! What follows from burns and gains: every number that a plan claims, by formulas alone.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{
    Gain, Problem,
    model::{LinearModel, LowerBound},
};
use crate::{
    budget::{Budget, Interruption},
    control::{Claim, Fault},
    frames::{LvlhCcsds, RelativeState},
    matrices::{frobenius, product, solve_lower, symmetric_eigenvalues},
    units::{Angle, Seconds},
};

/// Everything that follows from a problem, burns and gains, by the formulas, without a solver.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// One a burn.
    pub burns: Vec<BurnBounds>,
    /// The N instants.
    pub states: Vec<PlannedState>,
    /// Where the measured state can be at the last instant.
    pub arrival: ArrivalSet,
    /// The same without feedback; only if the problem asks for it.
    pub open_loop_arrival: Option<ArrivalSet>,
    /// N - 1 shape matrices (6 x 6) of the sets of w_i, scaled variables at instant i + 1.
    pub disturbance_shapes: Vec<DMatrix<f64>>,
    /// trace + fuel_weight fuel, the metric's own units.
    pub objective: f64,
    /// Trace of the arrival set's shape in the metric: (sum_i |H M_i P_i|_F)².
    pub trace: f64,
    /// |H M_i P_i|_F, one a disturbance.
    pub trace_shares: Vec<f64>,
    /// Sum of |delta-v| over burns and axes, nominal, m/s.
    pub fuel_m_s: f64,
    /// Sum of the largest corrections over burns and axes, m/s.
    pub effort_m_s: f64,
    /// Least `delta_v_max_m_s` for which a plan exists.
    pub delta_v_max_least_m_s: f64,
    /// The proof.
    pub certificate: PlanCertificate,
}

/// A burn and what corrections can do to it, `LVLH_CCSDS`, m/s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurnBounds {
    /// Time since the mission's start.
    pub elapsed: Seconds,
    /// Nominal.
    pub delta_v_m_s: Vector3<f64>,
    /// What corrections can add or take at most along each axis.
    pub correction_max_m_s: Vector3<f64>,
    /// delta_v_max - |nominal| - correction_max along each axis.
    pub saturation_margin_m_s: Vector3<f64>,
}

/// A nominal state just before its burn, with its bound.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedState {
    /// Time since the mission's start.
    pub elapsed: Seconds,
    /// Of the target, counted on through revolutions.
    pub true_anomaly: Angle,
    /// Nominal.
    pub state: RelativeState<LvlhCcsds>,
    /// 6 x 6, `LVLH_CCSDS`, m and m/s: {d : d' shape^-1 d <= 1} around the nominal state contains
    /// the true (and the measured) state of every flight inside the assumed errors.
    pub outer_shape: DMatrix<f64>,
}

/// An ellipsoid around the target state.
///
/// With the metric `Position` the least position set does not extend to velocity, so there are two
/// sets, both guaranteed: `outer_shape` for the whole state and, tighter, the position set of
/// `position_shape` and the semi-axes. With the other metrics the second is the projection of the
/// first.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrivalSet {
    /// 6 x 6, `LVLH_CCSDS`, m and m/s.
    pub outer_shape: DMatrix<f64>,
    /// 3 x 3, `LVLH_CCSDS`, m².
    pub position_shape: DMatrix<f64>,
    /// Semi-axes of the position set's projection on the orbital plane (x and z), longer first.
    pub in_plane_semi_axes_m: [f64; 2],
    /// Semi-axes of the position set, longest first.
    pub position_semi_axes_m: [f64; 3],
}

/// What is known of a plan without the solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanCertificate {
    /// Everything below within its tolerance.
    pub passed: bool,
    /// Trace of the arrival set, from the gains.
    pub trace: f64,
    /// Largest difference of the last nominal state from the target state, scaled by the largest
    /// component of the two ends of the mission.
    pub dynamics_residual: f64,
    /// Least margin of any burn to saturation, corrections included, m/s.
    pub saturation_margin_m_s: f64,
    /// A lower bound on the objective of every plan for the problem.
    pub objective_lower_bound: f64,
    /// (objective - bound) / (1 + |objective|).
    pub relative_gap: f64,
    /// [`Claim::FixedHorizon`] if the gap is closed, else [`Claim::Feasible`].
    pub claim: Claim,
    /// Least eigenvalue of the matrix of [Deaconu2014, eq. 23] at the multipliers recomputed from
    /// the gains, relative to its largest.
    pub matrix_inequality_margin: f64,
}

/// The nominal end may miss the target by this much of the mission's size.
pub(super) const RESIDUAL_TOLERANCE: f64 = 1e-9;
/// A burn may exceed its limit by this much of the limit.
pub(super) const SATURATION_TOLERANCE: f64 = 1e-9;
/// The matrix of (23) is singular at the best multipliers: its least eigenvalue is rounding.
pub(super) const EIGENVALUE_TOLERANCE: f64 = 1e-9;
/// A gap up to here is closed: the relative accuracy asked of an objective.
pub(super) const GAP_CLOSED: f64 = 1e-6;
/// A bound may exceed the objective by this much: rounding of both.
pub(super) const GAP_ROUNDING: f64 = 1e-9;

/// M_i P_i (6 x 6) of every disturbance that has acted before one instant.
pub(super) type Effects = Vec<DMatrix<f64>>;

impl Outcome {
    /// Recomputes everything from a model, burns (m/s) and gains.
    pub(super) fn new(
        problem: &Problem,
        model: &LinearModel,
        burns: &[Vector3<f64>],
        gains: &[Gain],
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let nominal = nominal_states(model, burns);
        let (states, effects) = planned_states(model, &nominal, gains, budget)?;
        let in_metric: Effects = effects.iter().map(|e| product(&model.metric, e)).collect();
        let trace_shares: Vec<f64> = in_metric.iter().map(frobenius).collect();
        let sum: f64 = trace_shares.iter().sum();
        let fuel_m_s = burns.iter().flat_map(|burn| burn.iter()).map(|v| v.abs()).sum();
        let bounds = burn_bounds(model, burns, gains);
        let effort_m_s = bounds.iter().flat_map(|b| b.correction_max_m_s.data.0[0]).sum();
        budget.check()?;
        let matrix_inequality_margin = matrix_inequality_margin(&in_metric);
        budget.check()?;
        let mut outcome = Self {
            arrival: arrival_set(model, &effects, &trace_shares),
            open_loop_arrival: problem.compare_open_loop.then(|| open_loop_set(model)),
            disturbance_shapes: model.disturbances.iter().map(|w| w.shape().clone()).collect(),
            objective: sum * sum + model.fuel_weight * fuel_m_s,
            trace: sum * sum,
            trace_shares,
            fuel_m_s,
            effort_m_s,
            delta_v_max_least_m_s: model.least_limit().map_or(f64::INFINITY, |(limit, _)| limit),
            certificate: PlanCertificate {
                passed: false,
                trace: sum * sum,
                dynamics_residual: dynamics_residual(model, &nominal),
                saturation_margin_m_s: least_margin(&bounds),
                objective_lower_bound: 0.0,
                relative_gap: 0.0,
                claim: Claim::Feasible,
                matrix_inequality_margin,
            },
            burns: bounds,
            states,
        };
        outcome.judge(&model.lower_bound(budget)?, model.limit);
        Ok(outcome)
    }

    fn judge(&mut self, bound: &LowerBound, limit: f64) {
        let gap = (self.objective - bound.objective) / (1.0 + self.objective.abs());
        let certificate = &mut self.certificate;
        certificate.objective_lower_bound = bound.objective;
        certificate.relative_gap = gap;
        if gap <= GAP_CLOSED {
            certificate.claim = Claim::FixedHorizon;
        }
        certificate.passed = certificate.faults(limit).is_empty();
    }
}

impl PlanCertificate {
    /// Every number by which the certificate fails.
    pub(super) fn faults(&self, limit: f64) -> Vec<Fault> {
        let mut faults = Vec::new();
        let mut at_most = |field: &str, value: f64, bound: f64| {
            // A value that is not a number is a fault too.
            if !(value <= bound) {
                let expected = format!("at most {bound:e}");
                faults.push(Fault::new(field, expected, format!("{value:e}")));
            }
        };
        at_most("certificate.dynamics_residual_nd", self.dynamics_residual, RESIDUAL_TOLERANCE);
        at_most("certificate.relative_gap (negated)", -self.relative_gap, GAP_ROUNDING);
        let mut at_least = |field: &str, value: f64, bound: f64| {
            if !(value >= bound) {
                let expected = format!("at least {bound:e}");
                faults.push(Fault::new(field, expected, format!("{value:e}")));
            }
        };
        at_least(
            "certificate.saturation_margin_m_s",
            self.saturation_margin_m_s,
            -SATURATION_TOLERANCE * limit,
        );
        at_least(
            "certificate.matrix_inequality_margin",
            self.matrix_inequality_margin,
            -EIGENVALUE_TOLERANCE,
        );
        faults
    }
}

/// x at every instant, from the first state and the burns alone. [Deaconu2014, eq. 15]
fn nominal_states(model: &LinearModel, burns: &[Vector3<f64>]) -> Vec<DVector<f64>> {
    let mut states = vec![model.initial.clone()];
    for (k, burn) in burns.iter().enumerate() {
        states.push(model.advanced(k, &states[k], burn));
    }
    states
}

fn dynamics_residual(model: &LinearModel, nominal: &[DVector<f64>]) -> f64 {
    let size = model.initial.amax().max(model.target.amax()).max(f64::MIN_POSITIVE);
    (&nominal[model.burns()] - &model.target).amax() / size
}

/// The instants with their bounds, and the effects M_i P_i of all disturbances at the last.
///
/// Before burn k the measured state is off by sum_i M_i w_i, i < k, with M_i = I at instant i + 1
/// and M_i <- A_k (M_i + [0; c_k L_ki]) from k to k + 1; the true state is off by one navigation
/// error more. Both lie in the outer ellipsoid of the sum.
fn planned_states(
    model: &LinearModel,
    nominal: &[DVector<f64>],
    gains: &[Gain],
    budget: Budget<'_>,
) -> Result<(Vec<PlannedState>, Effects), Interruption> {
    let mut effects = Effects::new();
    let mut states = Vec::with_capacity(nominal.len());
    for (k, state) in nominal.iter().enumerate() {
        budget.check()?;
        let scaled = outer_shape(model, k, &effects, true);
        states.push(PlannedState {
            elapsed: model.elapsed[k],
            true_anomaly: model.anomalies[k],
            state: model.physical(k, state),
            outer_shape: physical_shape(model, k, &scaled),
        });
        if k < model.burns() {
            effects = advanced_effects(model, k, &effects, gains);
        }
    }
    Ok((states, effects))
}

fn advanced_effects(model: &LinearModel, k: usize, effects: &Effects, gains: &[Gain]) -> Effects {
    let corrected = corrected_effects(model, k, effects, gains);
    let mut advanced: Effects =
        corrected.iter().map(|after| product(&model.steps[k], after)).collect();
    advanced.push(model.disturbances[k].root().clone());
    advanced
}

/// The effects just after burn k: each with its correction.
fn corrected_effects(model: &LinearModel, k: usize, effects: &Effects, gains: &[Gain]) -> Effects {
    let corrected = |(i, effect): (usize, &DMatrix<f64>)| {
        let mut after = effect.clone();
        let correction = product(&gain(gains, k, i).matrix, model.disturbances[i].root());
        for row in 0..3 {
            for column in 0..6 {
                after[(3 + row, column)] +=
                    model.scales[k].velocity_scale_s * correction[(row, column)];
            }
        }
        after
    };
    effects.iter().enumerate().map(corrected).collect()
}

/// The effects just after burn k.
pub(super) fn effects_after_burn(model: &LinearModel, k: usize, gains: &[Gain]) -> Effects {
    let mut effects = Effects::new();
    for earlier in 0..k {
        effects = advanced_effects(model, earlier, &effects, gains);
    }
    corrected_effects(model, k, &effects, gains)
}

/// Gains are ordered by burn, then by disturbance: burn k has k of them.
pub(super) fn gain(gains: &[Gain], burn: usize, disturbance: usize) -> &Gain {
    &gains[burn * burn.saturating_sub(1) / 2 + disturbance]
}

/// An outer ellipsoid (scaled) of the sum of the effects, and of the navigation error if asked,
/// at instant `k`: the one of least trace in units of that error.
fn outer_shape(
    model: &LinearModel,
    k: usize,
    effects: &[DMatrix<f64>],
    and_error: bool,
) -> DMatrix<f64> {
    let root = model.errors[k].root();
    let mut roots: Vec<&DMatrix<f64>> = effects.iter().collect();
    if and_error || effects.is_empty() {
        roots.push(root);
    }
    let sizes: Vec<f64> =
        roots.iter().map(|effect| frobenius(&solve_lower(root, effect))).collect();
    sum_shape(&roots, &sizes)
}

/// sum_i E_i E_i' / tau_i with tau_i = size_i / sum of sizes: contains the sum of the ellipsoids
/// E_i ball, and of all such the least trace in the measure that made the sizes.
pub(super) fn sum_shape(effects: &[&DMatrix<f64>], sizes: &[f64]) -> DMatrix<f64> {
    let total: f64 = sizes.iter().sum();
    let rows = effects[0].nrows();
    let mut shape = DMatrix::zeros(rows, rows);
    for (effect, size) in effects.iter().zip(sizes).filter(|(_, size)| **size > 0.0) {
        shape += product(effect, &effect.transpose()) * (total / size);
    }
    shape
}

/// T^-1 S T^-T at instant `k`.
fn physical_shape(model: &LinearModel, k: usize, scaled: &DMatrix<f64>) -> DMatrix<f64> {
    let map = model.scales[k].physical_from_scaled();
    let image = product(&product(&map, scaled), &map.transpose());
    // Exactly symmetric: the two halves are sums in different orders.
    DMatrix::from_fn(6, 6, |i, j| 0.5 * (image[(i, j)] + image[(j, i)]))
}

/// The set of the last measured state. [Deaconu2014, eqs. 21-23]: at the best multipliers
/// tau_i = s_i / sum s the shape is sum_i M_i P_i² M_i' / tau_i.
fn arrival_set(model: &LinearModel, effects: &Effects, trace_shares: &[f64]) -> ArrivalSet {
    let last = model.burns();
    let whole_state = model.metric.nrows() == 6;
    let effects_: Vec<&DMatrix<f64>> = effects.iter().collect();
    let in_metric = physical_shape(model, last, &sum_shape(&effects_, trace_shares));
    if whole_state {
        return with_axes(in_metric.clone(), in_metric.view((0, 0), (3, 3)).into());
    }
    let whole = physical_shape(model, last, &outer_shape(model, last, effects, false));
    with_axes(whole, in_metric.view((0, 0), (3, 3)).into())
}

/// The first navigation error carried to the end without any correction.
fn open_loop_set(model: &LinearModel) -> ArrivalSet {
    let carried = product(&model.to_end[0], model.errors[0].root());
    let scaled = product(&carried, &carried.transpose());
    let shape = physical_shape(model, model.burns(), &scaled);
    let position = shape.view((0, 0), (3, 3)).into();
    with_axes(shape, position)
}

fn with_axes(outer_shape: DMatrix<f64>, position_shape: DMatrix<f64>) -> ArrivalSet {
    let axes = |block: DMatrix<f64>| -> Vec<f64> {
        symmetric_eigenvalues(&block).into_iter().rev().map(|l| l.max(0.0).sqrt()).collect()
    };
    let in_plane = axes(position_shape.select_rows(&[0, 2]).select_columns(&[0, 2]));
    let position = axes(position_shape.clone());
    ArrivalSet {
        outer_shape,
        in_plane_semi_axes_m: [in_plane[0], in_plane[1]],
        position_semi_axes_m: [position[0], position[1], position[2]],
        position_shape,
    }
}

/// Saturation with corrections. [Deaconu2014, eq. 20]
fn burn_bounds(model: &LinearModel, burns: &[Vector3<f64>], gains: &[Gain]) -> Vec<BurnBounds> {
    let bound = |(k, burn): (usize, &Vector3<f64>)| {
        let mut correction = Vector3::zeros();
        for i in 0..k {
            let answer = product(&gain(gains, k, i).matrix, model.disturbances[i].root());
            for axis in 0..3 {
                correction[axis] += answer.row(axis).iter().map(|x| x * x).sum::<f64>().sqrt();
            }
        }
        BurnBounds {
            elapsed: model.elapsed[k],
            delta_v_m_s: *burn,
            correction_max_m_s: correction,
            saturation_margin_m_s: Vector3::from_fn(|axis, _| {
                model.limit - burn[axis].abs() - correction[axis]
            }),
        }
    };
    burns.iter().enumerate().map(bound).collect()
}

fn least_margin(bounds: &[BurnBounds]) -> f64 {
    let margins = bounds.iter().flat_map(|b| b.saturation_margin_m_s.data.0[0]);
    margins.fold(f64::INFINITY, f64::min)
}

/// Least eigenvalue over greatest of the matrix (23), made free of units by P_i and the trace:
/// [1 - sum tau, 0, 0; 0, diag(tau_i I), X'; 0, X, Q] with X_i = H M_i P_i / s, s = sum s_i,
/// tau_i = s_i / s and Q = sum X_i X_i' / tau_i.
fn matrix_inequality_margin(in_metric: &[DMatrix<f64>]) -> f64 {
    let sizes: Vec<f64> = in_metric.iter().map(frobenius).collect();
    let total: f64 = sizes.iter().sum();
    if !(total > 0.0) {
        // Nothing can go wrong: every effect is 0, and so is the matrix but for tau.
        return 0.0;
    }
    let (m, blocks) = (in_metric[0].nrows(), in_metric.len());
    let size = 1 + 6 * blocks + m;
    let mut matrix = DMatrix::<f64>::zeros(size, size);
    matrix[(0, 0)] = 1.0 - sizes.iter().map(|s| s / total).sum::<f64>();
    let mut shape = DMatrix::zeros(m, m);
    for (i, effect) in in_metric.iter().enumerate() {
        let (tau, first) = (sizes[i] / total, 1 + 6 * i);
        let scaled = effect / total;
        for c in 0..6 {
            matrix[(first + c, first + c)] = tau;
            for r in 0..m {
                matrix[(first + c, size - m + r)] = scaled[(r, c)];
                matrix[(size - m + r, first + c)] = scaled[(r, c)];
            }
        }
        if tau > 0.0 {
            shape += product(&scaled, &scaled.transpose()) / tau;
        }
    }
    matrix.view_mut((size - m, size - m), (m, m)).copy_from(&shape);
    let eigenvalues = matrix.symmetric_eigenvalues();
    let least = eigenvalues.iter().fold(f64::INFINITY, |a: f64, &b| a.min(b));
    let greatest = eigenvalues.iter().fold(0.0, |a: f64, &b| a.max(b));
    least / greatest.max(f64::MIN_POSITIVE)
}

/// Position and velocity as six numbers, m and m/s.
pub(super) fn physical_values(state: &RelativeState<LvlhCcsds>) -> DVector<f64> {
    let (p, v) = (state.position_m.components, state.velocity_m_s.components);
    DVector::from_column_slice(&[p.x, p.y, p.z, v.x, v.y, v.z])
}

/// Number of gains of a plan with so many burns.
pub(super) fn gain_count(burns: usize) -> usize {
    burns * burns.saturating_sub(1) / 2
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gains_are_found_where_they_were_put() {
        let mut gains = Vec::new();
        for burn in 0..7 {
            for disturbance in 0..burn {
                gains.push(Gain { burn, disturbance, matrix: DMatrix::zeros(3, 6) });
            }
        }
        assert_eq!(gains.len(), gain_count(7));
        for sought in &gains {
            assert_eq!(gain(&gains, sought.burn, sought.disturbance), sought);
        }
    }
}
