//! A loop over the network, with everything the simulator expects of its answers.

use std::time::{Duration, Instant};

use nalgebra::{Vector3, Vector6};
use vbar_client::{Client, ClosedLoop};
use vbar_proto::v1::{
    self, AbortExistence, AbortReason, Frame, Measurement, StepResponse, measurement,
    step_response::{Diagnostics, Verdict},
    step_stream_request::Controller,
};

use super::{Flyable, ModeCounts};
use crate::campaign::{SimulationError, flight::Patience};

/// Largest disagreement about an abort's first thrust, of the sequence's largest: rounding only.
const AGREEMENT: f64 = 1e-9;

/// What the service decided.
#[derive(Debug)]
pub(super) struct Decision {
    /// The phase it was decided in.
    pub phase: usize,
    pub what: Decided,
    /// Some half-space had to give way.
    pub softened: bool,
    /// The certificate passed.
    pub certified: bool,
    /// What could be done if thrusters failed at the next sample.
    pub next: ModeCounts,
    /// From question to answer.
    pub latency: Duration,
}

/// The decision itself.
#[derive(Debug)]
pub(super) enum Decided {
    /// Along RTN.
    Force(Vector3<f64>),
    /// Forces from this step on, one a step; the first is to be flown now.
    Abort(AbortReason, Vec<Vector3<f64>>),
    Arrived,
    /// Why not.
    Infeasible(String),
}

pub(super) struct Session<'a> {
    closed_loop: ClosedLoop,
    flyable: &'a Flyable,
    run: u32,
}

impl<'a> Session<'a> {
    pub(super) async fn open(
        client: &Client,
        flyable: &'a Flyable,
        run: u32,
    ) -> Result<Self, SimulationError> {
        let controller = Controller::ArtifactId(flyable.artifact_id.clone());
        let opened = client.closed_loop(controller).await;
        let opened = opened.map_err(|source| SimulationError::Client { run, source })?;
        Ok(Self { closed_loop: opened.without_prediction(), flyable, run })
    }

    /// Tells the state at step `k`, and which thrusters are left where not all are.
    pub(super) async fn decide(
        &mut self,
        k: u32,
        state: &Vector6<f64>,
        working: Option<&[i32]>,
    ) -> Result<Decision, SimulationError> {
        let question = Measurement {
            state: Some(measurement::State::Relative(relative(state))),
            elapsed_s: Some(f64::from(k) * self.flyable.case.model.sample_time_s),
            working_thrusters: working
                .map(|indices| v1::WorkingThrusters { indices: indices.to_vec() }),
        };
        let asked = Instant::now();
        let mut patience = Patience::new(self.run);
        let response = loop {
            match self.closed_loop.step(question.clone()).await {
                Ok(response) => break response,
                Err(error) => patience.after(error).await?,
            }
        };
        let latency = asked.elapsed();
        let run = self.run;
        let read = read(&response, k, working.is_some());
        let decision = read.map_err(|what| SimulationError::Answer { run, what })?;
        Ok(Decision { latency, ..decision })
    }
}

/// A state as the contract has it.
pub(super) fn relative(state: &Vector6<f64>) -> v1::RelativeState {
    v1::RelativeState {
        frame: Frame::Rtn.into(),
        position_m: state.as_slice()[..3].to_vec(),
        velocity_m_s: state.as_slice()[3..].to_vec(),
    }
}

fn read(response: &StepResponse, k: u32, failed: bool) -> Result<Decision, String> {
    if u32::try_from(response.step_index) != Ok(k) {
        return Err(format!("step {k} was answered as {}", response.step_index));
    }
    let Some(Diagnostics::AbortSafe(how)) = &response.diagnostics else {
        return Err("an answer without diagnostics".into());
    };
    let what = match &response.verdict {
        None => return Err("a step without a verdict".into()),
        Some(Verdict::Arrived(_)) => Decided::Arrived,
        Some(Verdict::Infeasible(why)) => Decided::Infeasible(why.reason.clone()),
        Some(Verdict::Command(command)) => Decided::Force(force(command)?),
        Some(Verdict::Abort(abort)) => {
            let reason = abort.reason();
            if (reason == AbortReason::Failure) && !failed {
                return Err("an abort for a failure of which nobody spoke".into());
            }
            Decided::Abort(reason, sequence(abort)?)
        }
    };
    Ok(Decision {
        phase: usize::try_from(how.phase_index).map_err(|_| "a phase below 0".to_owned())?,
        certified: response.certificate.as_ref().is_some_and(|proof| proof.passed),
        softened: how.softened,
        next: how.next_state.as_ref().map(count).unwrap_or_default(),
        what,
        latency: Duration::ZERO,
    })
}

/// Verdicts on a state, one a mode.
pub(super) fn count(state: &v1::StateVerdict) -> ModeCounts {
    let mut counts = ModeCounts::default();
    for mode in &state.modes {
        counts.inside += usize::from(mode.inside_reachable_set);
        match mode.abort() {
            AbortExistence::Found => counts.found += 1,
            AbortExistence::NoneProved => counts.none_proved += 1,
            AbortExistence::Undecided | AbortExistence::Unspecified => counts.undecided += 1,
        }
    }
    counts
}

fn force(command: &v1::Command) -> Result<Vector3<f64>, String> {
    if command.frame() != Frame::Rtn {
        return Err("a command that is not in RTN".into());
    }
    three(&command.force_n).ok_or_else(|| "a command without a force".into())
}

/// Forces of an abort, the first as its command says.
fn sequence(abort: &v1::AbortCommand) -> Result<Vec<Vector3<f64>>, String> {
    let first = force(abort.command.as_ref().ok_or("an abort without a command")?)?;
    let given = abort.sequence.as_ref().ok_or("an abort without its sequence")?;
    let rows = given.forces_n.as_ref().map_or(&[][..], |rows| &rows.values);
    let forces: Option<Vec<_>> = rows.chunks(3).map(three).collect();
    let mut forces = forces.ok_or("an abort whose forces are not three numbers a step")?;
    if forces.is_empty() {
        // Drift from here on.
        forces.push(Vector3::zeros());
    }
    let largest = forces.iter().map(Vector3::norm).fold(0.0, f64::max);
    if (forces[0] - first).norm() > AGREEMENT * largest {
        return Err(format!("an abort that begins with {first:?}, not with {:?}", forces[0]));
    }
    Ok(forces)
}

/// Three finite numbers.
fn three(values: &[f64]) -> Option<Vector3<f64>> {
    match values {
        [x, y, z] if values.iter().all(|value| value.is_finite()) => Some(Vector3::new(*x, *y, *z)),
        _ => None,
    }
}
