//! Answers of abort safety, and the method as the service sees it.

use nalgebra::Vector3;
use vbar_guidance::{
    Method,
    control::{
        Certificate, Fault,
        abort_safe::{
            self as method, AbortCommand, AbortOrigin, AbortReason, AbortSafe, Artifact, Command,
            Diagnostics, PhaseSummary, Problem, Step, Trajectory, UnsafeState, Verdict,
        },
    },
    dynamics::RelativeVector,
    units::Seconds,
};
use vbar_proto::v1;

use super::verdict::{
    force_now, render_sequence, render_state, render_state_verdict, render_working,
};
use crate::wire::{
    Planning, SolverWork, VerdictKind, Wired, count,
    orbits::{calendar_after, components},
    same_for_every_method,
    types::{
        ElapsedAndState, MeasuredState, Units, render_certificate, render_infeasible,
        render_vectors,
    },
};

impl Wired for AbortSafe {
    const METHOD: Method = Method::AbortSafe;
    const PLANNING: Planning = Planning::Stepwise;
    const SEES_FAILURES: bool = true;

    same_for_every_method!();

    /// Half-spaces of reachable sets are in parts of a gauge, forces in parts of a thruster's.
    fn units(_: &Problem) -> Units {
        Units::scaled(None)
    }

    fn render_summary(artifact: &Artifact) -> v1::artifact::Summary {
        v1::artifact::Summary::AbortSafe(render_artifact(artifact))
    }

    fn as_abort_safe(artifact: &Artifact) -> Option<&Artifact> {
        Some(artifact)
    }

    fn measurement(
        _: &method::Artifact,
        measured: &ElapsedAndState,
    ) -> Result<method::Measurement, Fault> {
        match &measured.state {
            MeasuredState::Relative(state) => Ok(method::Measurement {
                state: *state,
                elapsed: measured.elapsed,
                working: measured.working,
            }),
            MeasuredState::Linear(_) => {
                Err(Fault::new("", "relative: the state of a spacecraft", "linear"))
            }
        }
    }

    fn kind(step: &Step) -> VerdictKind {
        match step.verdict {
            Verdict::Command(_) => VerdictKind::Command,
            Verdict::Abort(_) => VerdictKind::Abort,
            Verdict::Arrived(_) => VerdictKind::Arrived,
            Verdict::Infeasible(_) => VerdictKind::Infeasible,
        }
    }

    fn work(step: &Step) -> SolverWork {
        let general_solver_calls = usize::from(step.diagnostics.by_general_solver);
        SolverWork { simplex_pivots: 0, general_solver_calls }
    }

    fn render_step(artifact: &Artifact, step: &Step, omit_prediction: bool) -> v1::StepResponse {
        render_step(artifact, step, omit_prediction)
    }
}

fn render_artifact(artifact: &Artifact) -> v1::AbortSafeArtifact {
    let problem = artifact.problem();
    let summary = artifact.summary();
    let phase = |(asked, made): (&method::Phase, &PhaseSummary)| v1::AbortSafePhaseSummary {
        sets: i64::try_from(made.sets).unwrap_or(i64::MAX),
        size_bytes: i64::try_from(made.size_bytes).unwrap_or(i64::MAX),
        modes: count(asked.safety.modes().len()),
        dominating_modes: made.dominating_modes.iter().copied().map(render_working).collect(),
        hides_approaches_above_m_s: made.hides_approaches_above_m_s,
        outer_box: made.outer_box,
        crosses_unseen_m: made.crosses_unseen_m,
        sets_of_all_modes: made
            .sets_of_all_modes
            .map(|sets| i64::try_from(sets).unwrap_or(i64::MAX)),
    };
    v1::AbortSafeArtifact {
        steps_per_period: count(problem.steps_per_period),
        fold_error_s: summary.fold_error.seconds(),
        phases: problem.phases.iter().zip(&summary.phases).map(phase).collect(),
        warnings: summary.warnings(),
    }
}

/// Everything of a step's answer but what the envelope knows.
fn render_step(artifact: &Artifact, step: &Step, omit_prediction: bool) -> v1::StepResponse {
    use v1::step_response::{Diagnostics as Message, Verdict as VerdictMessage};
    let problem = artifact.problem();
    let softened = matches!(&step.verdict, Verdict::Command(command) if command.softened);
    let verdict = match &step.verdict {
        Verdict::Command(command) => VerdictMessage::Command(render_command(problem, command)),
        Verdict::Abort(abort) => VerdictMessage::Abort(render_abort(problem, step.index, abort)),
        Verdict::Arrived(arrival) => VerdictMessage::Arrived(v1::Arrival {
            completion_steps: count(arrival.completion_steps),
            distance_m: Some(arrival.distance_m),
            deviation_norm_nd: arrival.distance_m / problem.arrival.metres(),
            // Safety is what the method guarantees, not where the approach ends.
            inside_guaranteed_set: false,
        }),
        Verdict::Infeasible(why) => {
            VerdictMessage::Infeasible(render_infeasible(why, Units::scaled(None)))
        }
    };
    let prediction = step.trajectory.as_ref().filter(|_| !omit_prediction);
    let mut diagnostics = render_diagnostics(&step.diagnostics);
    diagnostics.phase_index = count(step.phase);
    diagnostics.softened = softened;
    diagnostics.warnings = artifact.summary().warnings();
    diagnostics.unsafe_state = step.unsafe_state.as_ref().map(render_unsafe_state);
    diagnostics.next_state = step
        .safety
        .as_ref()
        .map(|verdict| render_state_verdict(artifact, verdict, omit_prediction));
    v1::StepResponse {
        step_index: count(step.index),
        prediction: prediction.map(|trajectory| render_prediction(problem, trajectory)),
        certificate: step.certificate.as_ref().map(|c| render_certificate(c, None)),
        verdict: Some(verdict),
        diagnostics: Some(Message::AbortSafe(diagnostics)),
        ..v1::StepResponse::default()
    }
}

fn render_command(problem: &Problem, command: &Command) -> v1::Command {
    held_force(problem, command.elapsed, &command.force_n)
}

/// A force held for one step.
fn held_force(problem: &Problem, elapsed: Seconds, force_n: &Vector3<f64>) -> v1::Command {
    let epoch = problem.epoch.as_ref();
    v1::Command {
        elapsed_s: elapsed.seconds(),
        duration_s: Some(problem.sample_time.seconds()),
        frame: v1::Frame::Rtn.into(),
        acceleration_m_s2: components(&(force_n / problem.mass.kilograms())),
        force_n: components(force_n),
        epoch: epoch.map(|epoch| calendar_after(epoch, elapsed)).unwrap_or_default(),
        ..v1::Command::default()
    }
}

fn render_abort(problem: &Problem, step: usize, command: &AbortCommand) -> v1::AbortCommand {
    let reason = match command.reason {
        AbortReason::Failure => v1::AbortReason::Failure,
        AbortReason::NoTrajectory => v1::AbortReason::NoTrajectory,
        AbortReason::UnderWay => v1::AbortReason::UnderWay,
    };
    let origin = match command.origin {
        AbortOrigin::Searched => v1::AbortOrigin::Searched,
        AbortOrigin::Kept => v1::AbortOrigin::Kept,
        AbortOrigin::Tail => v1::AbortOrigin::Tail,
    };
    let elapsed = Seconds::from_seconds(step as f64 * problem.sample_time.seconds());
    v1::AbortCommand {
        reason: reason.into(),
        command: Some(held_force(problem, elapsed, &force_now(&command.abort))),
        working_thrusters: Some(render_working(command.working)),
        sequence: Some(render_sequence(problem, step, &command.abort)),
        origin: origin.into(),
        began_step_index: count(command.began),
    }
}

fn render_prediction(problem: &Problem, trajectory: &Trajectory) -> v1::Prediction {
    let rows = |first: usize| {
        let part = |x: &RelativeVector| Vector3::new(x[first], x[first + 1], x[first + 2]);
        Some(render_vectors(&trajectory.states.iter().map(part).collect::<Vec<_>>()))
    };
    let mass = problem.mass.kilograms();
    let accelerations: Vec<_> = trajectory.forces_n.iter().map(|force| force / mass).collect();
    v1::Prediction {
        positions_m: rows(0),
        velocities_m_s: rows(3),
        accelerations_m_s2: Some(render_vectors(&accelerations)),
        ..v1::Prediction::default()
    }
}

fn render_unsafe_state(found: &UnsafeState) -> v1::UnsafeState {
    v1::UnsafeState {
        working_thrusters: Some(render_working(found.working)),
        time_to_violation_s: found.doomed_after_s,
        gauge: found.gauge,
        outside: found.outside.as_ref().map(render_state),
    }
}

/// Without phase, warnings and the verdicts on this state and the next.
fn render_diagnostics(diagnostics: &Diagnostics) -> v1::AbortSafeDiagnostics {
    let closest = diagnostics.closest;
    v1::AbortSafeDiagnostics {
        distance_m: diagnostics.distance_m,
        cuts: count(diagnostics.cuts),
        least_clearance: (diagnostics.cuts > 0).then_some(diagnostics.least_clearance),
        violation: diagnostics.violation,
        closest_distance_m: closest.map(|closest| closest.least.sqrt()),
        closest_after_s: closest.map(|closest| closest.at_s),
        iterations: count(diagnostics.iterations),
        general_solver: diagnostics.by_general_solver,
        softened_because: diagnostics
            .infeasibility
            .as_ref()
            .map(|why| render_infeasible(why, Units::scaled(None))),
        ..v1::AbortSafeDiagnostics::default()
    }
}
