//! Whether an answer is worth what it says, without a solver.

use nalgebra::DVector;

use super::{
    Artifact, Branch, Evidence, Measurement, Scheme, State, Step, TerminalFallback, Trajectory,
    Verdict,
    certify::{self, Statement, TOLERANCE},
    present::{Behind, Present},
    stages::{Stages, Terminal},
    state::Flight,
    step,
};
use crate::control::{Certificate, Claim, StepError};

/// Makes the certificate of `answer` again from what went into the step and from the answer's own
/// trajectory; `None` if it gives no command.
///
/// Nothing in the answer is believed. Its states are compared with what A and B make of their
/// predecessors, its inputs and states with the tightened constraints, its end with the terminal
/// set that the problem prescribes at this step, its cost and lower bound with what trajectory and
/// multipliers give. The certificate passes only if the rest of the answer agrees with the
/// trajectory too: command, horizon, terminal centre, the state for the next step. For an answer as
/// it was given, the result equals the certificate in it.
///
/// What a claim says of *other* horizons is quoted, not proved: that takes a search. No program is
/// solved, except that the terminal point of a plant with a general state polytope and
/// [`TerminalPoint::Projection`](super::TerminalPoint::Projection) is a projection.
///
/// # Errors
/// [`StepError`] if `before` or `measurement` do not fit the artifact.
pub fn verify_step(
    artifact: &Artifact,
    before: &State,
    measurement: &Measurement,
    answer: &Step,
) -> Result<Option<Certificate>, StepError> {
    let present = Present::new(artifact, before, measurement)?;
    if !matches!(answer.verdict, Verdict::Command(_)) {
        return Ok(None);
    }
    let certificate = match &present.behind {
        Some(behind) if artifact.problem.scheme == Scheme::TubeOptimalControl => {
            present.around_plan(&behind.flight, answer)
        }
        _ => present.planned_now(answer),
    };
    Ok(Some(certificate.unwrap_or_else(|| certify::refused(claim(answer)))))
}

/// The terminal constraint that a problem prescribes, and how an answer describes it.
struct Prescribed {
    terminal: Terminal,
    powers: Vec<usize>,
    centre: Vec<f64>,
}

impl Present<'_> {
    /// A trajectory from the measured state. `None` if the answer cannot even be one.
    fn planned_now(&self, answer: &Step) -> Option<Certificate> {
        let trajectory = answer.trajectory.as_ref()?;
        let evidence = answer.evidence.as_ref()?;
        let mut stages = Stages::new(self.artifact, self.step, self.measured.as_slice());
        let horizon = trajectory.horizon();
        if !(1..=stages.horizon_limit()).contains(&horizon) {
            return None;
        }
        stages.extend_to(horizon);
        let prescribed = self.prescribed(&mut stages, horizon, answer)?;
        let program = stages.program(horizon, &prescribed.terminal);
        let claim = claim(answer);
        let is_tail = claim == Claim::PreviousPlanTail;
        let lower_bound = (!is_tail).then(|| certify::lower_bound(&stages, &program, evidence));
        let cost = Some(answer.diagnostics.cost);
        let statement = Statement { claim, cost, lower_bound };
        let mut certificate =
            certify::certificate(&stages, &program, trajectory, evidence, statement);
        let stated = &answer.diagnostics;
        certificate.passed = certificate.passed
            && is_tail == (stated.branch == Branch::PreviousPlanTail)
            && stated.terminal_set_powers == prescribed.powers
            && is_near(stated.terminal_centre.as_slice(), &prescribed.centre)
            && self.agrees(answer, trajectory, &first_input(trajectory), 0);
        Some(certificate)
    }

    /// Tube feedback around the plan of step 0.
    fn around_plan(&self, flight: &Flight, answer: &Step) -> Option<Certificate> {
        let trajectory = answer.trajectory.as_ref()?;
        let whole = step::verified_plan(self.artifact, flight);
        let since = self.step - flight.plan_step;
        let ahead = step::ahead(&whole.trajectory, since);
        if trajectory.states.shape() != ahead.states.shape()
            || trajectory.inputs.shape() != ahead.inputs.shape()
            || !certify::is_finite(trajectory)
        {
            return None;
        }
        let states = (&trajectory.states - &ahead.states).amax();
        let inputs = (&trajectory.inputs - &ahead.inputs).amax();
        let input = step::fed_back_input(self.artifact, &whole.trajectory, since, &self.measured);
        let mut certificate = whole.certificate;
        certificate.dynamics_residual = certificate.dynamics_residual.max(states).max(inputs);
        let stated = &answer.diagnostics;
        certificate.passed = certificate.passed
            && certificate.dynamics_residual <= TOLERANCE
            && claim(answer) == certificate.claim
            && answer.evidence == Some(Evidence::default())
            && stated.branch == Branch::TubeFeedback
            && is_near(&[stated.cost], &[flight.cost])
            && stated.terminal_set_powers == flight.powers
            && is_near(stated.terminal_centre.as_slice(), &flight.centre)
            && self.artifact.input_excess(&input).is_none()
            && self.agrees(answer, trajectory, &input, since);
        Some(certificate)
    }

    /// The terminal constraint of the branch that the answer names.
    fn prescribed(
        &self,
        stages: &mut Stages<'_>,
        horizon: usize,
        answer: &Step,
    ) -> Option<Prescribed> {
        let artifact = self.artifact;
        let own = |stages: &mut Stages<'_>| {
            let terminal = stages.terminal(horizon)?;
            let centre = terminal.centre.clone();
            Some(Prescribed { terminal, powers: Vec::new(), centre })
        };
        match (answer.diagnostics.branch, &self.behind) {
            (Branch::TerminalPoint, _) if artifact.problem.scheme != Scheme::FixedTerminal => {
                own(stages)
            }
            (Branch::TerminalSet, _) if artifact.problem.scheme == Scheme::FixedTerminal => {
                own(stages)
            }
            (Branch::TubeFeedback, None) => own(stages),
            (Branch::TerminalSet, Some(Behind { flight, .. })) if artifact.is_adaptive() => {
                let left = flight.horizon - 1;
                let mut powers = flight.powers.clone();
                powers.push(left);
                let (centre, constrain_last) = match artifact.problem.fallback {
                    TerminalFallback::PreviousHorizon if horizon == left => {
                        (flight.centre.clone(), true)
                    }
                    TerminalFallback::FreeHorizon if horizon <= left => {
                        let reference = artifact.model.reference(self.step + horizon)?;
                        (reference.as_slice().to_vec(), false)
                    }
                    _ => return None,
                };
                let terminal = stages.grown_terminal(centre.clone(), &powers, constrain_last);
                Some(Prescribed { terminal, powers, centre })
            }
            (Branch::PreviousPlanTail, Some(Behind { flight, disturbance, .. })) => {
                let tail = step::PlanTail::new(artifact, flight, &disturbance.components);
                let mut powers = flight.powers.clone();
                if artifact.is_adaptive() {
                    powers.push(tail.horizon);
                }
                let (terminal, centre) = (tail.terminal, flight.centre.clone());
                (tail.horizon == horizon).then_some(Prescribed { terminal, powers, centre })
            }
            _ => None,
        }
    }

    /// Does the rest of the answer say what its trajectory and its first input say?
    ///
    /// `since`: steps between the start of the plan that is handed on and the present one.
    fn agrees(
        &self,
        answer: &Step,
        trajectory: &Trajectory,
        input: &DVector<f64>,
        since: usize,
    ) -> bool {
        let horizon = trajectory.horizon();
        let Verdict::Command(given) = &answer.verdict else { return false };
        let command = step::command(self.artifact, self.step, input.clone(), horizon == 1);
        let Some(next) = &answer.next.flight else { return false };
        let planned = certify::row_by_row(&trajectory.inputs);
        let stated = &answer.diagnostics;
        *given == command
            && answer.index == self.step
            && stated.missed_steps == self.behind.as_ref().map_or(0, |behind| behind.missed)
            && answer.disturbance == self.behind.as_ref().map(|behind| behind.disturbance.clone())
            && stated.horizon == horizon
            && answer.next.step == self.step + 1
            && next.horizon == horizon
            && next.cost.to_bits() == stated.cost.to_bits()
            && next.previous_state == self.measured
            && next.previous_input == *input
            && next.plan_step + since == self.step
            && next.plan_inputs.get(since * input.len()..) == Some(&planned[..])
            && next.powers == stated.terminal_set_powers
            && next.centre == stated.terminal_centre.as_slice()
    }
}

fn claim(answer: &Step) -> Claim {
    answer.certificate.as_ref().map_or(Claim::Feasible, |certificate| certificate.claim)
}

fn first_input(trajectory: &Trajectory) -> DVector<f64> {
    trajectory.inputs.row(0).transpose()
}

fn is_near(stated: &[f64], derived: &[f64]) -> bool {
    stated.len() == derived.len()
        && stated.iter().zip(derived).all(|(a, b)| (a - b).abs() <= TOLERANCE)
}
