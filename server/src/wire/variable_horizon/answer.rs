//! Answers of variable horizon, and the method as the service sees it.

use nalgebra::Vector3;
use vbar_guidance::{
    Budget, Method,
    control::{
        Certificate, Fault, StepError,
        variable_horizon::{
            self as method, Branch, Plan, PlanOutcome, Step, TrialOutcome, VariableHorizon, Verdict,
        },
    },
    dynamics::HillScaling,
    units::Seconds,
};
use vbar_proto::v1;

use crate::wire::{
    PlanVerdict, Planning, SolverWork, VerdictKind, Wired, count, same_for_every_method,
    types::{
        ElapsedAndState, MeasuredState, Units, render_certificate, render_infeasible,
        render_matrix, render_vectors,
    },
};

impl Wired for VariableHorizon {
    const METHOD: Method = Method::VariableHorizon;
    const PLANNING: Planning = Planning::FromMeasurement;

    same_for_every_method!();

    fn units(problem: &method::Problem) -> Units {
        Units::scaled(position_unit_m(problem))
    }

    fn render_summary(artifact: &method::Artifact) -> v1::artifact::Summary {
        v1::artifact::Summary::VariableHorizon(render_artifact(artifact))
    }

    fn measurement(
        _: &method::Artifact,
        measured: &ElapsedAndState,
    ) -> Result<method::Measurement, Fault> {
        Ok(measurement(measured))
    }

    fn kind(step: &Step) -> VerdictKind {
        match step.verdict {
            Verdict::Command(_) => VerdictKind::Command,
            Verdict::Arrived(_) => VerdictKind::Arrived,
            Verdict::Infeasible(_) => VerdictKind::Infeasible,
        }
    }

    fn work(step: &Step) -> SolverWork {
        work(&step.diagnostics)
    }

    fn render_step(
        artifact: &method::Artifact,
        step: &Step,
        omit_prediction: bool,
    ) -> v1::StepResponse {
        render_step(artifact, step, omit_prediction)
    }

    fn plan(
        artifact: &method::Artifact,
        initial: Option<&ElapsedAndState>,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        let Some(initial) = initial else {
            let fault = Fault::new("", "a value (the field is required)", "nothing");
            return Err(StepError::Measurement(vec![fault]));
        };
        method::plan(artifact, &measurement(initial), budget).map(|outcome| match outcome {
            PlanOutcome::Plan(plan) => PlanVerdict {
                outcome: v1::compute_plan_response::Outcome::Plan(render_plan(artifact, &plan)),
                work: work(&plan.diagnostics),
                certificate: Some(plan.certificate),
            },
            PlanOutcome::Infeasible(why) => {
                PlanVerdict::infeasible(&why, Self::units(artifact.problem()))
            }
        })
    }
}

fn work(diagnostics: &method::Diagnostics) -> SolverWork {
    SolverWork {
        simplex_pivots: diagnostics.simplex_pivots,
        general_solver_calls: diagnostics.general_solver_calls,
    }
}

/// The measurement as this method takes it.
fn measurement(measured: &ElapsedAndState) -> method::Measurement {
    method::Measurement {
        state: match &measured.state {
            MeasuredState::Relative(state) => method::MeasuredState::Relative(*state),
            MeasuredState::Linear(state) => method::MeasuredState::Linear(state.clone()),
        },
        elapsed: measured.elapsed,
    }
}

/// Metres in one unit of scaled position of a spacecraft plant.
fn position_unit_m(problem: &method::Problem) -> Option<f64> {
    match &problem.plant {
        method::Plant::Hill(hill) => {
            Some(HillScaling::new(hill.mean_motion_rad_s, hill.acceleration_max.m_s2()))
                .map(|scaling| scaling.position_unit_m)
        }
        method::Plant::Linear(_) => None,
    }
}

fn render_artifact(artifact: &method::Artifact) -> v1::VariableHorizonArtifact {
    let summary = artifact.summary();
    v1::VariableHorizonArtifact {
        gain: Some(render_matrix(&summary.gain)),
        spectral_radius: summary.spectral_radius,
        lambda_bar: summary.lambda_bar,
        completion_guaranteed: summary.lambda_bar > 0.0,
        lambda_bar_exact: summary.lambda_bar_exact,
        series_terms: count(summary.series_terms),
        series_tolerance: summary.series_tolerance,
        horizon_usable: count(summary.horizon_usable),
        disturbance_generators_nd: Some(render_matrix(&summary.disturbance_generators)),
        a: Some(render_matrix(&summary.a)),
        b: Some(render_matrix(&summary.b)),
        position_unit_m: summary.position_unit_m,
        velocity_unit_m_s: summary.velocity_unit_m_s,
        sample_time_s: summary.sample_time_s,
    }
}

/// Everything of a step's answer but what the envelope knows: controller state, provenance.
fn render_step(
    artifact: &method::Artifact,
    step: &Step,
    omit_prediction: bool,
) -> v1::StepResponse {
    use v1::step_response::{Diagnostics, Verdict as Message};
    let unit = position_unit_m(artifact.problem());
    let verdict = match &step.verdict {
        Verdict::Command(command) => Message::Command(render_command(command)),
        Verdict::Arrived(arrival) => Message::Arrived(v1::Arrival {
            completion_steps: count(arrival.completion_steps),
            distance_m: arrival.distance_m,
            deviation_norm_nd: arrival.deviation_norm,
            inside_guaranteed_set: arrival.inside_guaranteed_set,
        }),
        Verdict::Infeasible(why) => {
            Message::Infeasible(render_infeasible(why, Units::scaled(unit)))
        }
    };
    let trajectory = step.trajectory.as_ref().filter(|_| !omit_prediction);
    v1::StepResponse {
        controller_state: bytes::Bytes::new(),
        step_index: count(step.index),
        prediction: trajectory.map(|trajectory| render_prediction(artifact, trajectory)),
        certificate: step.certificate.as_ref().map(|c| render_certificate(c, unit)),
        realised_disturbance: step.disturbance.as_ref().map(render_disturbance),
        provenance: None,
        verdict: Some(verdict),
        diagnostics: Some(Diagnostics::VariableHorizon(render_diagnostics(&step.diagnostics))),
    }
}

fn render_plan(artifact: &method::Artifact, plan: &Plan) -> v1::Plan {
    let unit = position_unit_m(artifact.problem());
    v1::Plan {
        commands: plan.commands.iter().map(render_command).collect(),
        prediction: Some(render_prediction(artifact, &plan.trajectory)),
        gain: plan.tube.as_ref().map(|_| render_matrix(&artifact.summary().gain)),
        tube: plan.tube.as_ref().map(|tube| v1::Tube {
            half_width_nd: Some(render_matrix(&tube.half_widths)),
            position_half_width_m: unit
                .map(|unit| render_matrix(&(tube.half_widths.columns(0, 3) * unit))),
            final_generators_nd: Some(render_matrix(&tube.final_generators)),
        }),
        certificate: Some(render_certificate(&plan.certificate, unit)),
        variable_horizon: Some(render_diagnostics(&plan.diagnostics)),
        disturbance_feedback: None,
    }
}

fn render_command(command: &method::Command) -> v1::Command {
    let frame = match command.acceleration {
        Some(_) => v1::Frame::Rtn,
        None => v1::Frame::Unspecified,
    };
    let acceleration = command.acceleration.iter().flatten().map(|a| a.m_s2());
    v1::Command {
        elapsed_s: command.elapsed.seconds(),
        duration_s: command.duration.map(Seconds::seconds),
        frame: frame.into(),
        acceleration_m_s2: acceleration.collect(),
        force_n: command.force.iter().flatten().map(|f| f.newtons()).collect(),
        input_nd: command.input.iter().copied().collect(),
        last: command.last,
        ..v1::Command::default()
    }
}

fn render_prediction(
    artifact: &method::Artifact,
    trajectory: &method::Trajectory,
) -> v1::Prediction {
    let physical = artifact.physical(trajectory);
    let rows = |pick: fn(&method::PhysicalTrajectory) -> &[Vector3<f64>]| {
        physical.as_ref().map(|p| render_vectors(pick(p)))
    };
    v1::Prediction {
        states_nd: Some(render_matrix(&trajectory.states)),
        inputs_nd: Some(render_matrix(&trajectory.inputs)),
        positions_m: rows(|p| &p.positions_m),
        velocities_m_s: rows(|p| &p.velocities_m_s),
        accelerations_m_s2: rows(|p| &p.accelerations_m_s2),
    }
}

fn render_disturbance(disturbance: &method::RealisedDisturbance) -> v1::RealisedDisturbance {
    v1::RealisedDisturbance {
        components_nd: disturbance.components.iter().copied().collect(),
        gauge: disturbance.gauge,
        residual_norm_nd: disturbance.residual_norm,
        outside_assumed_set: disturbance.outside_assumed_set,
        steps: count(disturbance.steps),
        outside_guaranteed_tube: disturbance.outside_guaranteed_tube,
    }
}

fn render_diagnostics(diagnostics: &method::Diagnostics) -> v1::VariableHorizonDiagnostics {
    let branch = match diagnostics.branch {
        Branch::TerminalPoint => v1::Branch::TerminalPoint,
        Branch::TerminalSet => v1::Branch::TerminalSet,
        Branch::TubeFeedback => v1::Branch::TubeFeedback,
        Branch::PreviousPlanTail => v1::Branch::PreviousPlanTail,
        Branch::None => v1::Branch::Unspecified,
    };
    let trial = |trial: &method::Trial| {
        let (outcome, cost) = match trial.outcome {
            TrialOutcome::Optimal(cost) => (v1::TrialOutcome::Optimal, Some(cost)),
            TrialOutcome::Infeasible => (v1::TrialOutcome::Infeasible, None),
            TrialOutcome::CutOff(bound) => (v1::TrialOutcome::CutOff, Some(bound)),
        };
        v1::HorizonTrial { horizon: count(trial.horizon), outcome: outcome.into(), cost }
    };
    v1::VariableHorizonDiagnostics {
        branch: branch.into(),
        cost: diagnostics.cost,
        horizon: count(diagnostics.horizon),
        point_cost: diagnostics.point.map(|(cost, _)| cost),
        point_horizon: diagnostics.point.map(|(_, horizon)| count(horizon)),
        adapted_step: count(diagnostics.adapted_step),
        adapted_horizon: count(diagnostics.adapted_horizon),
        terminal_set_powers: diagnostics.terminal_set_powers.iter().map(|&i| count(i)).collect(),
        terminal_centre_nd: diagnostics.terminal_centre.iter().copied().collect(),
        trials: diagnostics.trials.iter().map(trial).collect(),
        simplex_pivots: count(diagnostics.simplex_pivots),
        general_solver_calls: count(diagnostics.general_solver_calls),
        lambda: diagnostics.lambda,
        missed_steps: count(diagnostics.missed_steps),
    }
}
