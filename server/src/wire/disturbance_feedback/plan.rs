//! Writing a plan.

use vbar_guidance::{
    control::{
        Claim,
        disturbance_feedback::{ArrivalSet, BurnBounds, Gain, Plan, PlanCertificate, PlannedState},
    },
    epoch::Epoch,
};
use vbar_proto::v1;

use super::{render_problem, render_state};
use crate::wire::{
    count,
    orbits::{calendar_after, components, render_epoch},
    types::render_matrix,
};

/// Writes a plan: burns, gains, and everything that follows from them.
pub(super) fn render_plan(plan: &Plan) -> v1::DisturbanceFeedbackPlan {
    let outcome = plan.outcome();
    let epoch = plan.problem().epoch.as_ref();
    v1::DisturbanceFeedbackPlan {
        burns: outcome.burns.iter().map(|burn| render_burn(burn, epoch)).collect(),
        gains: plan.gains().iter().map(render_gain).collect(),
        states: outcome.states.iter().map(render_planned).collect(),
        arrival: Some(render_arrival(&outcome.arrival)),
        open_loop_arrival: outcome.open_loop_arrival.as_ref().map(render_arrival),
        disturbance_shapes_nd: outcome.disturbance_shapes.iter().map(render_matrix).collect(),
        objective: outcome.objective,
        trace: outcome.trace,
        fuel_m_s: outcome.fuel_m_s,
        certificate: Some(render_certificate(&outcome.certificate)),
        diagnostics: Some(v1::PlanDiagnostics {
            fast_path: plan.origin().fast_path,
            conic_iterations: count(plan.origin().conic_iterations),
            delta_v_max_least_m_s: outcome.delta_v_max_least_m_s,
        }),
        trace_shares: outcome.trace_shares.clone(),
        effort_m_s: outcome.effort_m_s,
    }
}

/// Writes a plan as the one arm of the message that every method's plans share.
pub(super) fn wrapped(plan: &Plan) -> v1::Plan {
    v1::Plan { disturbance_feedback: Some(render_plan(plan)), ..v1::Plan::default() }
}

/// Writes a plan with its mission.
pub(in crate::wire) fn render_document(plan: &Plan) -> v1::PlanDocument {
    let method = v1::problem::Method::DisturbanceFeedback(render_problem(plan.problem()));
    let problem = Some(v1::Problem { method: Some(method) });
    v1::PlanDocument { problem, plan: Some(wrapped(plan)) }
}

/// Writes a plan in one line, but for its id and size.
pub(in crate::wire) fn render_line(plan: &Plan) -> v1::PlanSummary {
    let outcome = plan.outcome();
    v1::PlanSummary {
        epoch: plan.problem().epoch.as_ref().map(render_epoch),
        duration_s: outcome.states.last().map_or(0.0, |last| last.elapsed.seconds()),
        burns: count(outcome.burns.len()),
        fuel_m_s: outcome.fuel_m_s,
        ..v1::PlanSummary::default()
    }
}

/// When a burn is, as the plan's epoch tells it; empty without an epoch.
pub(super) fn burn_epoch(burn: &BurnBounds, epoch: Option<&Epoch>) -> String {
    epoch.map(|epoch| calendar_after(epoch, burn.elapsed)).unwrap_or_default()
}

fn render_burn(burn: &BurnBounds, epoch: Option<&Epoch>) -> v1::Burn {
    v1::Burn {
        elapsed_s: burn.elapsed.seconds(),
        epoch: burn_epoch(burn, epoch),
        frame: v1::Frame::LvlhCcsds.into(),
        delta_v_m_s: components(&burn.delta_v_m_s),
        correction_max_m_s: components(&burn.correction_max_m_s),
        saturation_margin_m_s: components(&burn.saturation_margin_m_s),
    }
}

fn render_gain(gain: &Gain) -> v1::FeedbackGain {
    v1::FeedbackGain {
        burn_index: count(gain.burn),
        disturbance_index: count(gain.disturbance),
        gain: Some(render_matrix(&gain.matrix)),
    }
}

fn render_planned(planned: &PlannedState) -> v1::PlannedState {
    v1::PlannedState {
        elapsed_s: planned.elapsed.seconds(),
        true_anomaly_deg: planned.true_anomaly.degrees(),
        state: Some(render_state(&planned.state)),
        outer_shape: Some(render_matrix(&planned.outer_shape)),
    }
}

fn render_arrival(arrival: &ArrivalSet) -> v1::ArrivalSet {
    v1::ArrivalSet {
        shape: Some(render_matrix(&arrival.outer_shape)),
        in_plane_semi_axes_m: arrival.in_plane_semi_axes_m.to_vec(),
        position_semi_axes_m: arrival.position_semi_axes_m.to_vec(),
        position_shape: Some(render_matrix(&arrival.position_shape)),
    }
}

/// Writes the proof.
pub(in crate::wire) fn render_certificate(certificate: &PlanCertificate) -> v1::PlanCertificate {
    let optimality = match certificate.claim {
        Claim::FixedHorizon => v1::Optimality::FixedHorizon,
        Claim::Global => v1::Optimality::Global,
        Claim::GlobalToHorizonMax => v1::Optimality::GlobalToHorizonMax,
        Claim::LocalInHorizon => v1::Optimality::LocalInHorizon,
        Claim::Feasible => v1::Optimality::Feasible,
        Claim::PreviousPlanTail => v1::Optimality::PreviousPlanTail,
    };
    v1::PlanCertificate {
        passed: certificate.passed,
        trace: certificate.trace,
        dynamics_residual_nd: certificate.dynamics_residual,
        saturation_margin_m_s: certificate.saturation_margin_m_s,
        objective_lower_bound: certificate.objective_lower_bound,
        relative_gap: certificate.relative_gap,
        optimality: optimality.into(),
        matrix_inequality_margin: certificate.matrix_inequality_margin,
    }
}
