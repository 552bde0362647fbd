//! Flying a plan: one burn an instant, by arithmetic alone.

use nalgebra::{DVector, Vector3};

use super::{
    Arrival, BurnCommand, Diagnostics, Measurement, Plan, RealisedDisturbance, State, Step,
    Verdict,
    outcome::{SATURATION_TOLERANCE, gain, physical_values},
    state::Flight,
};
use crate::{
    control::{Certificate, ConstraintFamily, ConstraintMargin, Fault, StepError},
    matrices::times_vector,
    sets::Ellipsoid,
    units::Seconds,
};

/// A measurement must be this near to its instant, as a share of the interval before or after.
const EPOCH_TOLERANCE: f64 = 1e-3;
/// A gauge up to here is inside the assumed set: unit conversions round.
const GAUGE_TOLERANCE: f64 = 1e-6;

/// Answers one instant.
///
/// # Errors
/// [`StepError`].
pub(super) fn step(
    plan: &Plan,
    state: &State,
    measurement: &Measurement,
) -> Result<Step, StepError> {
    let model = plan.model();
    if !state.fits(model.elapsed.len()) {
        return Err(StepError::State("it was not made by this plan".into()));
    }
    let k = state.instant;
    let measured = measured_state(plan, k, measurement)?;
    let mut disturbances = Vec::new();
    let mut disturbance = None;
    if let Some(flight) = &state.flight {
        let w = realised(plan, k - 1, flight, &measured);
        disturbances.clone_from(&flight.disturbances);
        disturbances.push(w.components.clone());
        disturbance = Some(w);
    }
    let deviation_gauge = deviation_gauge(plan, k, measurement);
    if k == model.burns() {
        return Ok(arrive(plan, state, &measured, disturbance, deviation_gauge));
    }
    let nominal = plan.burns()[k];
    let mut correction = Vector3::zeros();
    for (i, w) in disturbances.iter().enumerate() {
        let answer = times_vector(&gain(plan.gains(), k, i).matrix, w);
        correction += Vector3::new(answer[0], answer[1], answer[2]);
    }
    let limit = plan.problem().delta_v_max_m_s;
    let wanted = nominal + correction;
    let delta_v_m_s = wanted.map(|v| v.clamp(-limit, limit));
    // At instant 0 the plan's own first state stays in place of the measured one: see the module.
    let previous_state = if k == 0 { model.initial.clone() } else { measured };
    let flight = Flight { previous_state, previous_delta_v_m_s: delta_v_m_s, disturbances };
    let elapsed = model.elapsed[k];
    Ok(Step {
        index: k,
        verdict: Verdict::Burn(BurnCommand { elapsed, delta_v_m_s, last: k + 1 == model.burns() }),
        next: State { instant: k + 1, flight: Some(flight) },
        certificate: Some(certificate(plan, &delta_v_m_s)),
        disturbance,
        diagnostics: Diagnostics {
            nominal_delta_v_m_s: nominal,
            correction_m_s: correction,
            clipped: (wanted - delta_v_m_s).amax() > SATURATION_TOLERANCE * limit,
            deviation_gauge,
        },
    })
}

/// The scaled measured state, if it is one of this instant.
fn measured_state(
    plan: &Plan,
    k: usize,
    measurement: &Measurement,
) -> Result<DVector<f64>, StepError> {
    let model = plan.model();
    let mut faults = Vec::new();
    let parts = [
        ("relative.position_m", &measurement.state.position_m),
        ("relative.velocity_m_s", &measurement.state.velocity_m_s),
    ];
    for (field, vector) in parts {
        if let Some(x) = vector.components.iter().find(|x| !x.is_finite()) {
            faults.push(Fault::new(field, "finite numbers", x.to_string()));
        }
    }
    if let Some(elapsed) = measurement.elapsed {
        let times = &model.elapsed;
        let interval = |k: usize| times[k + 1].seconds() - times[k].seconds();
        let near = (k > 0).then(|| interval(k - 1));
        let shorter = (k < model.burns()).then(|| interval(k));
        let room = near.into_iter().chain(shorter).fold(f64::INFINITY, f64::min);
        let off = (elapsed.seconds() - times[k].seconds()).abs();
        if !(off <= EPOCH_TOLERANCE * room) {
            let expected = format!("{} (instant {k})", times[k].seconds());
            faults.push(Fault::new("elapsed_s", expected, elapsed.seconds().to_string()));
        }
    }
    if faults.is_empty() {
        Ok(model.scaled(k, &measurement.state))
    } else {
        Err(StepError::Measurement(faults))
    }
}

/// w = x(k+1) - A x(k) - B u(k) between instants `k` and `k` + 1. [Deaconu2014, eqs. 6-7]
fn realised(
    plan: &Plan,
    k: usize,
    flight: &Flight,
    measured: &DVector<f64>,
) -> RealisedDisturbance {
    let model = plan.model();
    let predicted = model.advanced(k, &flight.previous_state, &flight.previous_delta_v_m_s);
    let components = measured - predicted;
    let gauge = model.disturbances[k].gauge(&components);
    let outside_assumed_set = !(gauge <= 1.0 + GAUGE_TOLERANCE);
    RealisedDisturbance { components, gauge, outside_assumed_set }
}

/// Gauge of the measured deviation from the nominal state in the planned bound.
fn deviation_gauge(plan: &Plan, k: usize, measurement: &Measurement) -> f64 {
    let planned = &plan.outcome().states[k];
    let deviation = physical_values(&measurement.state) - physical_values(&planned.state);
    Ellipsoid::from_shape(planned.outer_shape.clone())
        .map_or(f64::INFINITY, |bound| bound.gauge(&deviation))
}

fn arrive(
    plan: &Plan,
    state: &State,
    measured: &DVector<f64>,
    disturbance: Option<RealisedDisturbance>,
    deviation_gauge: f64,
) -> Step {
    let model = plan.model();
    let deviation = measured - &model.target;
    let level = plan.arrival_level(&deviation);
    let position = times_vector(&model.scales[model.burns()].physical_from_scaled(), &deviation);
    let distance_m = position.rows(0, 3).iter().map(|x| x * x).sum::<f64>().sqrt();
    Step {
        index: state.instant,
        verdict: Verdict::Arrived(Arrival {
            burns: model.burns(),
            distance_m,
            deviation_norm: deviation.iter().map(|x| x * x).sum::<f64>().sqrt(),
            level,
            inside_guaranteed_set: level <= 1.0 + GAUGE_TOLERANCE,
        }),
        next: state.clone(),
        certificate: None,
        disturbance,
        diagnostics: Diagnostics {
            nominal_delta_v_m_s: Vector3::zeros(),
            correction_m_s: Vector3::zeros(),
            clipped: false,
            deviation_gauge,
        },
    }
}

/// The burn against its limit, with the plan's own cost and bound.
fn certificate(plan: &Plan, delta_v_m_s: &Vector3<f64>) -> Certificate {
    let (limit, of_plan) = (plan.problem().delta_v_max_m_s, &plan.outcome().certificate);
    let row = delta_v_m_s.iamax();
    let margin = 1.0 - delta_v_m_s[row].abs() / limit;
    Certificate {
        passed: of_plan.passed && margin >= -SATURATION_TOLERANCE,
        claim: of_plan.claim,
        tolerance: SATURATION_TOLERANCE,
        dynamics_residual: of_plan.dynamics_residual,
        margins: vec![ConstraintMargin { family: ConstraintFamily::Input, stage: 0, row, margin }],
        cost: plan.outcome().objective,
        lower_bound: Some(of_plan.objective_lower_bound),
    }
}

impl Plan {
    /// Time of the instant that `state` is for.
    #[must_use]
    pub fn instant_time(&self, state: &State) -> Option<Seconds> {
        self.model().elapsed.get(state.instant).copied()
    }

    /// sqrt(e' Q^-1 e) of a scaled deviation at the last instant, in the metric.
    /// [Deaconu2014, eq. 21]
    pub(super) fn arrival_level(&self, deviation: &DVector<f64>) -> f64 {
        let model = self.model();
        let arrival = &self.outcome().arrival;
        let physical = times_vector(&model.scales[model.burns()].physical_from_scaled(), deviation);
        let (shape, point) = if model.metric.nrows() == 6 {
            (arrival.outer_shape.clone(), physical)
        } else {
            (arrival.position_shape.clone(), physical.rows(0, 3).into())
        };
        Ellipsoid::from_shape(shape).map_or(f64::INFINITY, |set| set.gauge(&point))
    }
}
