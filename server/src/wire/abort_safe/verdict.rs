//! Verdicts on states and aborts, written.

use nalgebra::{DMatrix, Vector3};
use vbar_guidance::{
    control::abort_safe::{Artifact, Problem, StateVerdict},
    dynamics::RelativeVector,
    mission::ThrustMode,
    reach::{Abort, AbortVerdict, DriftVerdict, PassiveVerdict},
};
use vbar_proto::v1;

use crate::wire::{
    count,
    types::{render_matrix, render_vectors},
};

pub(super) fn render_working(mode: ThrustMode) -> v1::WorkingThrusters {
    v1::WorkingThrusters { indices: mode.working().map(count).collect() }
}

/// Without its sequences if `omit_sequences`.
pub(super) fn render_state_verdict(
    artifact: &Artifact,
    verdict: &StateVerdict,
    omit_sequences: bool,
) -> v1::StateVerdict {
    let problem = artifact.problem();
    let mut sequences = Sequences::default();
    let modes: Vec<v1::ModeVerdict> = verdict
        .modes
        .iter()
        .map(|mode| {
            let (existence, abort, programs) = match &mode.abort {
                AbortVerdict::Found(abort) => {
                    (v1::AbortExistence::Found, Some(abort), abort.programs)
                }
                AbortVerdict::NoneProved { programs } => {
                    (v1::AbortExistence::NoneProved, None, *programs)
                }
                AbortVerdict::Undecided { programs } => {
                    (v1::AbortExistence::Undecided, None, *programs)
                }
            };
            v1::ModeVerdict {
                working_thrusters: Some(render_working(mode.working)),
                inside_reachable_set: mode.inside_reachable_set(),
                abort: existence.into(),
                sequence_index: abort
                    .filter(|_| !omit_sequences)
                    .map(|abort| count(sequences.index_of(abort))),
                margin: abort.map(|abort| abort.margin),
                closest_distance_m: abort.map(|abort| abort.closest.least.sqrt()),
                time_to_violation_s: mode.doomed_after_s,
                programs: count(programs),
            }
        })
        .collect();
    let of = |existence: v1::AbortExistence| {
        count(modes.iter().filter(|mode| mode.abort() == existence).count())
    };
    v1::StateVerdict {
        step_index: count(verdict.index),
        phase_index: count(verdict.phase),
        state: Some(render_state(&verdict.state)),
        modes_inside: count(modes.iter().filter(|mode| mode.inside_reachable_set).count()),
        modes_found: of(v1::AbortExistence::Found),
        modes_none_proved: of(v1::AbortExistence::NoneProved),
        modes_undecided: of(v1::AbortExistence::Undecided),
        modes,
        sequences: sequences
            .distinct
            .into_iter()
            .map(|abort| render_sequence(problem, verdict.index, abort))
            .collect(),
        drift: verdict.drift.as_ref().map(|drift| render_drift(artifact, verdict.phase, drift)),
    }
}

/// Aborts that differ: a mode's abort is often one of a mode with fewer thrusters.
#[derive(Default)]
struct Sequences<'a> {
    distinct: Vec<&'a Abort>,
}

impl<'a> Sequences<'a> {
    fn index_of(&mut self, abort: &'a Abort) -> usize {
        let known = self.distinct.iter().position(|other| other.throttles == abort.throttles);
        known.unwrap_or_else(|| {
            self.distinct.push(abort);
            self.distinct.len() - 1
        })
    }
}

pub(super) fn render_state(state: &RelativeVector) -> v1::RelativeState {
    v1::RelativeState {
        frame: v1::Frame::Rtn.into(),
        position_m: state.as_slice()[..3].to_vec(),
        velocity_m_s: state.as_slice()[3..].to_vec(),
    }
}

/// An abort that starts at a step.
pub(super) fn render_sequence(problem: &Problem, step: usize, abort: &Abort) -> v1::AbortSequence {
    let step_s = problem.sample_time.seconds();
    let thrusters = problem.thrusters.list().len();
    let throttles =
        DMatrix::from_fn(abort.throttles.len(), thrusters, |i, j| abort.throttles[i][j]);
    v1::AbortSequence {
        elapsed_s: step as f64 * step_s,
        step_s,
        horizon_steps: count(abort.horizon),
        throttles: Some(render_matrix(&throttles)),
        forces_n: Some(render_vectors(&abort.forces_n)),
        margin: abort.margin,
        margin_throughout: abort.margin_throughout,
        closest_distance_m: abort.closest.least.sqrt(),
        closest_after_s: abort.closest.at_s,
        programs: count(abort.programs),
    }
}

/// The force of an abort now; none once it only drifts.
pub(super) fn force_now(abort: &Abort) -> Vector3<f64> {
    abort.forces_n.first().copied().unwrap_or_default()
}

fn render_drift(artifact: &Artifact, phase: usize, drift: &PassiveVerdict) -> v1::DriftVerdicts {
    let problem = artifact.problem();
    let fractions = problem.phases.get(phase).and_then(|phase| phase.safety.watch());
    let parts = fractions.map_or(1, |watch| watch.fractions);
    let spacing_s = problem.sample_time.seconds() / parts as f64;
    v1::DriftVerdicts {
        linear: Some(render_one_drift(&drift.linear, spacing_s)),
        two_body: Some(render_one_drift(&drift.two_body, spacing_s)),
    }
}

fn render_one_drift(drift: &DriftVerdict, spacing_s: f64) -> v1::DriftVerdict {
    v1::DriftVerdict {
        safe_at_instants: drift.safe_at_instants(),
        safe_throughout: drift.safe_throughout(),
        least_position_gauge: drift.least_position_gauge_squared.sqrt(),
        least_position_gauge_after_s: drift.position_instant as f64 * spacing_s,
        least_state_gauge: drift.least_state_gauge_squared.sqrt(),
        least_state_gauge_after_s: drift.state_instant as f64 * spacing_s,
        least_gauge_throughout: drift.closest_gauge.least.sqrt(),
        least_gauge_throughout_after_s: drift.closest_gauge.at_s,
        closest_distance_m: drift.closest_distance.least.sqrt(),
        closest_after_s: drift.closest_distance.at_s,
        time_to_violation_s: drift.entered_s,
    }
}
