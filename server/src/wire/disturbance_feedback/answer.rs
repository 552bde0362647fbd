//! Answers of disturbance feedback, and the method as the service sees it.

use nalgebra::Vector3;
use vbar_guidance::{
    Budget, Method,
    control::{
        Certificate, Fault, PrepareError, StepError,
        disturbance_feedback::{
            self as method, BurnCommand, Diagnostics, DisturbanceFeedback, Plan, Step, Verdict,
        },
    },
    frames::{RTN_FROM_LVLH_CCSDS, RelativeState, Rtn},
};
use vbar_proto::v1;

use super::{
    in_lvlh,
    plan::{render_plan, wrapped},
};
use crate::wire::{
    InTime, PlanVerdict, Planning, SolverWork, VerdictKind, Wired, count,
    orbits::{calendar_after, components},
    same_for_every_method,
    types::{ElapsedAndState, MeasuredState, Units, render_certificate, render_vectors},
};

impl Wired for DisturbanceFeedback {
    const METHOD: Method = Method::DisturbanceFeedback;
    const PLANNING: Planning = Planning::IsArtifact;

    same_for_every_method!();

    fn units(problem: &method::Problem) -> Units {
        Units::impulses(problem.delta_v_max_m_s)
    }

    fn prepare_in_time(
        problem: &method::Problem,
        budget: Budget<'_>,
    ) -> Result<InTime<Plan>, PrepareError> {
        let method::Designed { plan, is_cut_short } = method::design(problem, budget)?;
        Ok(InTime { artifact: plan, is_cut_short })
    }

    fn render_summary(plan: &Plan) -> v1::artifact::Summary {
        let plan = Some(render_plan(plan));
        v1::artifact::Summary::DisturbanceFeedback(v1::DisturbanceFeedbackArtifact { plan })
    }

    fn as_plan(plan: &Plan) -> Option<&Plan> {
        Some(plan)
    }

    fn measurement(_: &Plan, measured: &ElapsedAndState) -> Result<method::Measurement, Fault> {
        match &measured.state {
            MeasuredState::Relative(state) => {
                Ok(method::Measurement { state: in_lvlh(state), elapsed: measured.elapsed })
            }
            MeasuredState::Linear(_) => {
                Err(Fault::new("", "relative: the state of a spacecraft", "linear"))
            }
        }
    }

    fn kind(step: &Step) -> VerdictKind {
        match step.verdict {
            Verdict::Burn(_) => VerdictKind::Command,
            Verdict::Arrived(_) => VerdictKind::Arrived,
        }
    }

    /// Flying a plan solves nothing.
    fn work(_: &Step) -> SolverWork {
        SolverWork::default()
    }

    fn render_step(plan: &Plan, step: &Step, omit_prediction: bool) -> v1::StepResponse {
        render_step(plan, step, omit_prediction)
    }

    fn plan(
        plan: &Plan,
        _: Option<&ElapsedAndState>,
        _: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        Ok(PlanVerdict {
            outcome: v1::compute_plan_response::Outcome::Plan(wrapped(plan)),
            // Checked when the plan was made.
            certificate: None,
            work: SolverWork::default(),
        })
    }
}

/// Everything of a step's answer but what the envelope knows: controller state, provenance.
fn render_step(plan: &Plan, step: &Step, omit_prediction: bool) -> v1::StepResponse {
    use v1::step_response::{Diagnostics as Message, Verdict as VerdictMessage};
    let (verdict, level) = match &step.verdict {
        Verdict::Burn(burn) => (VerdictMessage::Command(render_command(plan, burn)), None),
        Verdict::Arrived(arrival) => {
            let message = v1::Arrival {
                completion_steps: count(arrival.burns),
                distance_m: Some(arrival.distance_m),
                deviation_norm_nd: arrival.deviation_norm,
                inside_guaranteed_set: arrival.inside_guaranteed_set,
            };
            (VerdictMessage::Arrived(message), Some(arrival.level))
        }
    };
    let disturbance = step.disturbance.as_ref().map(|disturbance| v1::RealisedDisturbance {
        components_nd: disturbance.components.iter().copied().collect(),
        gauge: Some(disturbance.gauge),
        residual_norm_nd: 0.0,
        outside_assumed_set: disturbance.outside_assumed_set,
        steps: 1,
        outside_guaranteed_tube: disturbance.outside_assumed_set,
    });
    v1::StepResponse {
        controller_state: bytes::Bytes::new(),
        step_index: count(step.index),
        prediction: (!omit_prediction).then(|| render_prediction(plan, step.index)),
        certificate: step.certificate.as_ref().map(|c| render_certificate(c, None)),
        realised_disturbance: disturbance,
        provenance: None,
        verdict: Some(verdict),
        diagnostics: Some(Message::DisturbanceFeedback(render_diagnostics(
            &step.diagnostics,
            level,
        ))),
    }
}

fn render_command(plan: &Plan, burn: &BurnCommand) -> v1::Command {
    let epoch = plan.problem().epoch.as_ref();
    v1::Command {
        elapsed_s: burn.elapsed.seconds(),
        frame: v1::Frame::LvlhCcsds.into(),
        delta_v_m_s: components(&burn.delta_v_m_s),
        epoch: epoch.map(|epoch| calendar_after(epoch, burn.elapsed)).unwrap_or_default(),
        last: burn.last,
        ..v1::Command::default()
    }
}

fn render_diagnostics(
    diagnostics: &Diagnostics,
    arrival_level: Option<f64>,
) -> v1::DisturbanceFeedbackDiagnostics {
    v1::DisturbanceFeedbackDiagnostics {
        nominal_delta_v_m_s: components(&diagnostics.nominal_delta_v_m_s),
        correction_m_s: components(&diagnostics.correction_m_s),
        clipped: diagnostics.clipped,
        deviation_gauge: diagnostics.deviation_gauge,
        arrival_level,
    }
}

/// The planned states from this instant on, in RTN as every prediction is.
fn render_prediction(plan: &Plan, index: usize) -> v1::Prediction {
    let ahead: Vec<RelativeState<Rtn>> = plan
        .outcome()
        .states
        .iter()
        .skip(index)
        .map(|planned| planned.state.rotated(RTN_FROM_LVLH_CCSDS))
        .collect();
    let rows = |pick: fn(&RelativeState<Rtn>) -> Vector3<f64>| {
        Some(render_vectors(&ahead.iter().map(pick).collect::<Vec<_>>()))
    };
    v1::Prediction {
        positions_m: rows(|state| state.position_m.components),
        velocities_m_s: rows(|state| state.velocity_m_s.components),
        ..v1::Prediction::default()
    }
}
