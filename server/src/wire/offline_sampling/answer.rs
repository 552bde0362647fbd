//! Answers of offline sampling, and the method as the service sees it.

use nalgebra::{DMatrix, DVector};
use sha2::{Digest, Sha256};
use vbar_guidance::{
    Budget, Method,
    control::{
        Certificate, Fault, PrepareError,
        offline_sampling::{
            self as method, Artifact, Branch, Command, Coordinates, GroupSummary, OfflineSampling,
            Redundancy, Scheme, Step, TubeSummary, Verdict,
        },
    },
    reach::{HalfSpaces, StageFamily},
};
use vbar_proto::v1;

use crate::wire::{
    Planning, SolverWork, VerdictKind, Wired, count, same_for_every_method,
    types::{
        ElapsedAndState, MeasuredState, Units, render_certificate, render_infeasible,
        render_matrix, render_rows,
    },
};

impl Wired for OfflineSampling {
    const METHOD: Method = Method::OfflineSampling;
    const PLANNING: Planning = Planning::Stepwise;

    same_for_every_method!();

    fn units(_: &method::Problem) -> Units {
        // Rows are over state and corrections together: their margins are no lengths.
        Units::scaled(None)
    }

    fn check(problem: &method::Problem, budget: Budget<'_>) -> Result<(), PrepareError> {
        method::check(problem, budget)
    }

    fn render_summary(artifact: &Artifact) -> v1::artifact::Summary {
        v1::artifact::Summary::OfflineSampling(render_artifact(artifact))
    }

    fn measurement(
        artifact: &Artifact,
        measured: &ElapsedAndState,
    ) -> Result<method::Measurement, Fault> {
        let state = match (&measured.state, artifact.problem().coordinates) {
            (MeasuredState::Relative(state), Coordinates::Rtn) => {
                let (position, velocity) = (state.position_m, state.velocity_m_s);
                let both = position.components.iter().chain(velocity.components.iter()).copied();
                DVector::from_iterator(6, both)
            }
            (MeasuredState::Linear(state), Coordinates::General | Coordinates::Planar) => {
                state.clone()
            }
            (MeasuredState::Linear(_), Coordinates::Rtn) => {
                return Err(Fault::new("", "relative: the state of a spacecraft", "linear"));
            }
            (MeasuredState::Relative(_), Coordinates::General | Coordinates::Planar) => {
                return Err(Fault::new("", "linear: the plant has no orbit", "relative"));
            }
        };
        Ok(method::Measurement { state, elapsed: measured.elapsed })
    }

    fn kind(step: &Step) -> VerdictKind {
        match step.verdict {
            Verdict::Command(_) => VerdictKind::Command,
            Verdict::Infeasible(_) => VerdictKind::Infeasible,
        }
    }

    /// The previous plan's tail is flown where no answer exists: it says so, and by how much its
    /// prediction misses.
    fn may_leave(step: &Step) -> bool {
        step.diagnostics.branch == Branch::PreviousPlanTail
            || step.certificate.as_ref().is_some_and(|certificate| certificate.passed)
    }

    fn work(step: &Step) -> SolverWork {
        SolverWork {
            simplex_pivots: 0,
            general_solver_calls: usize::from(step.diagnostics.general_solver),
        }
    }

    fn render_step(artifact: &Artifact, step: &Step, omit_prediction: bool) -> v1::StepResponse {
        use v1::step_response::{Diagnostics, Verdict as Message};
        let command = match &step.verdict {
            Verdict::Command(command) => Some(command),
            Verdict::Infeasible(_) => None,
        };
        let verdict = match &step.verdict {
            Verdict::Command(command) => {
                Message::Command(render_command(artifact.problem(), step.index, command))
            }
            Verdict::Infeasible(why) => {
                Message::Infeasible(render_infeasible(why, Self::units(artifact.problem())))
            }
        };
        let predicted = command.filter(|_| !omit_prediction);
        v1::StepResponse {
            controller_state: bytes::Bytes::new(),
            step_index: count(step.index),
            prediction: predicted.map(|command| render_prediction(artifact.problem(), command)),
            certificate: step.certificate.as_ref().map(|c| render_certificate(c, None)),
            realised_disturbance: None,
            provenance: None,
            verdict: Some(verdict),
            diagnostics: Some(Diagnostics::OfflineSampling(render_diagnostics(
                artifact, step, command,
            ))),
        }
    }
}

fn render_artifact(artifact: &Artifact) -> v1::OfflineSamplingArtifact {
    let (summary, problem) = (artifact.summary(), artifact.problem());
    let scheme = match problem.scheme {
        Scheme::OfflineSampling => v1::OfflineSamplingScheme::OfflineSampling,
        Scheme::LinearQuadratic => v1::OfflineSamplingScheme::LinearQuadratic,
        Scheme::TubeRobust => v1::OfflineSamplingScheme::TubeRobust,
    };
    v1::OfflineSamplingArtifact {
        scheme: scheme.into(),
        gain: Some(render_matrix(&summary.gain)),
        terminal_weight: Some(render_matrix(&summary.terminal_weight)),
        expected_cost_sha256: digest(artifact.expected_cost()),
        groups: summary.groups.iter().map(render_group).collect(),
        sampled_rows: long(summary.rows()),
        kept_rows: long(summary.kept_rows()),
        doubtful_rows: long(summary.doubtful_rows),
        removed_excess: summary.outer_excess,
        inner_scaled: matches!(problem.redundancy, Redundancy::InnerScaled { .. }),
        joint_confidence_statement: artifact.confidence_statement(),
        joint_confidence: summary.joint_confidence,
        terminal_set: Some(render_half_spaces(artifact.terminal_set())),
        first_step_rows: long(summary.first_step_rows),
        first_step_limited: summary.first_step_limited,
        sample_time_s: problem.sample_time_s(),
        terminal_iterations: count(summary.terminal_iterations),
        checked_points: count(summary.checked_points),
        checked_excess: summary.checked_excess,
        tube: summary.tube.as_ref().map(render_tube),
    }
}

/// Of the entries row by row, 64-bit little endian.
fn digest(matrix: &DMatrix<f64>) -> String {
    let mut hasher = Sha256::new();
    for row in matrix.row_iter() {
        row.iter().for_each(|entry| hasher.update(entry.to_le_bytes()));
    }
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn long(value: usize) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn render_group(summary: &GroupSummary) -> v1::SampledGroup {
    let family = match summary.group.family {
        StageFamily::State => v1::ConstraintFamily::State,
        StageFamily::Input => v1::ConstraintFamily::Input,
        StageFamily::Terminal => v1::ConstraintFamily::Terminal,
    };
    v1::SampledGroup {
        family: family.into(),
        stage: count(summary.group.stage),
        samples: count(summary.samples),
        rows: count(summary.rows),
        kept_rows: count(summary.kept),
    }
}

fn render_half_spaces(set: &HalfSpaces) -> v1::PolytopeSet {
    let values = (0..set.len()).flat_map(|row| set.normal(row).iter().copied()).collect();
    let (rows, columns) = (count(set.len()), count(set.dimension()));
    v1::PolytopeSet {
        normals: Some(v1::Matrix { rows, columns, values }),
        offsets: set.offsets().to_vec(),
    }
}

fn render_tube(tube: &TubeSummary) -> v1::RobustTube {
    let widths = |widths: &DVector<f64>| widths.iter().copied().collect();
    v1::RobustTube {
        rows: count(tube.rows),
        state_half_widths: widths(&tube.state_half_widths),
        input_half_widths: widths(&tube.input_half_widths),
        disturbance_half_widths: widths(&tube.disturbance_half_widths),
    }
}

fn render_command(problem: &method::Problem, index: usize, command: &Command) -> v1::Command {
    let time = problem.sample_time_s();
    let input: Vec<f64> = command.input.iter().copied().collect();
    let (frame, force_n) = match problem.coordinates {
        Coordinates::Rtn => (v1::Frame::Rtn, input.clone()),
        Coordinates::Planar => (v1::Frame::Unspecified, input.clone()),
        Coordinates::General => (v1::Frame::Unspecified, Vec::new()),
    };
    v1::Command {
        elapsed_s: time.map_or(0.0, |time| index as f64 * time),
        duration_s: time,
        frame: frame.into(),
        force_n,
        input_nd: input,
        ..v1::Command::default()
    }
}

/// The expected plant's flight under the corrections.
fn render_prediction(problem: &method::Problem, command: &Command) -> v1::Prediction {
    let states = command.expected_states.as_slice();
    let part = |columns: std::ops::Range<usize>| {
        let part = |state: &DVector<f64>| state.as_slice()[columns.clone()].to_vec();
        (problem.coordinates == Coordinates::Rtn).then(|| render_rows(states.iter().map(part)))
    };
    v1::Prediction {
        states_nd: Some(render_rows(states.iter().map(|state| state.as_slice().to_vec()))),
        inputs_nd: Some(render_rows(
            command.expected_inputs.iter().map(|input| input.as_slice().to_vec()),
        )),
        positions_m: part(0..3),
        velocities_m_s: part(3..6),
        accelerations_m_s2: None,
    }
}

fn render_diagnostics(
    artifact: &Artifact,
    step: &Step,
    command: Option<&Command>,
) -> v1::OfflineSamplingDiagnostics {
    let diagnostics = &step.diagnostics;
    let branch = match diagnostics.branch {
        Branch::Optimum => v1::SamplingBranch::Optimum,
        Branch::PreviousPlanTail => v1::SamplingBranch::PreviousPlanTail,
        Branch::None => v1::SamplingBranch::Unspecified,
    };
    let (_, inputs) = artifact.problem().dimensions();
    // Where nothing is flown, the verdict has it.
    let conflict = diagnostics.conflict.as_ref().filter(|_| command.is_some());
    let conflict = conflict.map(|why| render_infeasible(why, Units::scaled(None)).rows);
    let nominal = command.and_then(|command| command.nominal.as_ref());
    v1::OfflineSamplingDiagnostics {
        branch: branch.into(),
        expected_cost: diagnostics.expected_cost,
        corrections: command
            .map(|command| render_rows(command.corrections.chunks(inputs).map(<[f64]>::to_vec))),
        clipped: command.is_some_and(|command| command.clipped),
        iterations: count(diagnostics.iterations),
        scans: count(diagnostics.scans),
        general_solver: diagnostics.general_solver,
        conflict: conflict.unwrap_or_default(),
        missed_steps: count(diagnostics.missed_steps),
        nominal_state: nominal.map(|state| state.iter().copied().collect()).unwrap_or_default(),
    }
}
