//! One decision: Algorithm 1 of both papers, and the baselines.

use nalgebra::DVector;

use super::{
    Arrival, Artifact, Branch, Command, Diagnostics, Evidence, Measurement, Plan, PlanOutcome,
    RealisedDisturbance, Scheme, Step, TerminalFallback, Trajectory, Trial, Tube, Verdict,
    certify::{self, Statement, TOLERANCE, Verified},
    present::{Behind, GAUGE_TOLERANCE, Present},
    search::{Found, Goal, Proof, Search},
    stages::{Stages, Terminal},
    state::{Flight, State},
};
use crate::{
    budget::{Budget, Interruption},
    control::{Claim, Failure, Infeasibility, StepError},
    matrices::times_vector,
    program::{Basis, zonotope_gauge},
    units::{Force, Seconds},
};

/// Equality is normal in line 11 for W = {0} or without fuel weight: not a failure to decrease.
const DECREASE_TOLERANCE: f64 = 1e-9;

/// Decides the next command.
///
/// # Errors
/// [`StepError`].
pub(super) fn step(
    artifact: &Artifact,
    state: &State,
    measurement: &Measurement,
    budget: Budget<'_>,
) -> Result<Step, StepError> {
    let present = Present::new(artifact, state, measurement)?;
    let Some(behind) = &present.behind else {
        return first_step(artifact, &present.measured, budget);
    };
    if behind.flight.horizon == 1 {
        return Ok(arrive(&present, behind));
    }
    let context = Context { present: &present, behind };
    match artifact.problem.scheme {
        Scheme::TubeOptimalControl => context.tube_feedback(),
        Scheme::AdaptiveTerminal | Scheme::FixedTerminal | Scheme::Nominal => {
            context.receding_horizon(budget)
        }
    }
}

/// The plan from the mission's start.
///
/// # Errors
/// [`StepError`].
pub(super) fn plan(
    artifact: &Artifact,
    initial: &Measurement,
    budget: Budget<'_>,
) -> Result<PlanOutcome, StepError> {
    let measured = Present::new(artifact, &State::START, initial)?.measured;
    let mut search = start_search(artifact, &measured, budget);
    let (verified, found) = match solve_first(&mut search)? {
        Ok(solved) => solved,
        Err(infeasible) => return Ok(PlanOutcome::Infeasible(infeasible)),
    };
    let commands = (0..found.horizon)
        .map(|k| {
            let input = verified.trajectory.inputs.row(k).transpose();
            command(artifact, k, input, k + 1 == found.horizon)
        })
        .collect();
    let tube = (artifact.problem.scheme == Scheme::TubeOptimalControl).then(|| Tube {
        half_widths: artifact.tube.half_widths(found.horizon, artifact.tables.states()),
        final_generators: artifact.tube.sum(0..found.horizon).generators().clone(),
    });
    let flight = first_flight(&measured, &found, &verified);
    let work = Work::of_all(&mut search);
    let diagnostics = diagnostics(artifact, Branch::TerminalPoint, Some(&flight), work);
    Ok(PlanOutcome::Plan(Plan {
        commands,
        trajectory: verified.trajectory,
        tube,
        certificate: verified.certificate,
        diagnostics,
    }))
}

fn start_search<'a, 'b>(
    artifact: &'a Artifact,
    measured: &DVector<f64>,
    budget: Budget<'b>,
) -> Search<'a, 'b> {
    Search::new(Stages::new(artifact, 0, measured.as_slice()), None, budget)
}

/// P_0, verified.
fn solve_first(
    search: &mut Search<'_, '_>,
) -> Result<Result<(Verified, Found), Infeasibility>, StepError> {
    if let Some(infeasible) = certify::initial_state_fault(search) {
        return Ok(Err(infeasible));
    }
    let limit = search.stages.horizon_limit();
    let guess = search.stages.artifact.problem.horizon_guess;
    let guess = guess.unwrap_or_else(|| search.stages.guess());
    let found = match search.run(&Goal::Own, guess, limit) {
        Ok(Some(found)) => found,
        Ok(None) => return Ok(Err(certify::name_infeasibility(search, limit))),
        Err(failure) => rescued_incumbent(search, failure, f64::INFINITY)?,
    };
    let verified = certify::verify_found(search, &found);
    if verified.certificate.passed {
        Ok(Ok((verified, found)))
    } else {
        Err(uncertified(&verified).into())
    }
}

fn uncertified(verified: &Verified) -> Failure {
    Failure::Numerical(format!(
        "an answer did not pass its certificate: {:?}",
        verified.certificate
    ))
}

/// When time runs out, the best certified answer so far is still an answer.
fn rescued_incumbent(
    search: &mut Search<'_, '_>,
    failure: Failure,
    cost_max: f64,
) -> Result<Found, Failure> {
    if failure == Failure::Interrupted(Interruption::Cancelled) {
        return Err(failure);
    }
    match search.incumbent.take() {
        Some(found) if found.cost <= cost_max => Ok(Found { proof: Proof::None, ..found }),
        _ => Err(failure),
    }
}

fn first_step(
    artifact: &Artifact,
    measured: &DVector<f64>,
    budget: Budget<'_>,
) -> Result<Step, StepError> {
    let mut search = start_search(artifact, measured, budget);
    match solve_first(&mut search)? {
        Err(infeasible) => {
            let work = Work::of_all(&mut search);
            Ok(Step {
                index: 0,
                verdict: Verdict::Infeasible(infeasible),
                next: State::START,
                trajectory: None,
                certificate: None,
                evidence: None,
                disturbance: None,
                diagnostics: diagnostics(artifact, Branch::None, None, work),
            })
        }
        Ok((verified, found)) => {
            let flight = first_flight(measured, &found, &verified);
            let branch = if artifact.problem.scheme == Scheme::TubeOptimalControl {
                Branch::TubeFeedback
            } else if artifact.problem.scheme == Scheme::FixedTerminal {
                Branch::TerminalSet
            } else {
                Branch::TerminalPoint
            };
            let work = Work::of_all(&mut search);
            let diagnostics = diagnostics(artifact, branch, Some(&flight), work);
            Ok(commanded(artifact, 0, flight, verified, None, diagnostics))
        }
    }
}

fn first_flight(measured: &DVector<f64>, found: &Found, verified: &Verified) -> Flight {
    Flight {
        previous_state: measured.clone(),
        previous_input: verified.trajectory.inputs.row(0).transpose(),
        cost: found.cost,
        horizon: found.horizon,
        adapted_step: 0,
        adapted_horizon: found.horizon,
        centre: found.terminal.centre.clone(),
        powers: Vec::new(),
        plan_step: 0,
        plan_initial: measured.as_slice().to_vec(),
        plan_inputs: found.solution.inputs.clone(),
        basis: found.solution.basis.clone(),
    }
}

/// A step after the first.
#[derive(Clone, Copy)]
struct Context<'a> {
    present: &'a Present<'a>,
    behind: &'a Behind<'a>,
}

/// What a receding-horizon step settled on.
struct Settled {
    found: Found,
    branch: Branch,
    /// J and N of the problem with the terminal point.
    point: Option<(f64, usize)>,
    powers: Vec<usize>,
}

impl Context<'_> {
    fn receding_horizon(self, budget: Budget<'_>) -> Result<Step, StepError> {
        let Present { artifact, step, ref measured, .. } = *self.present;
        let stages = Stages::new(artifact, step, measured.as_slice());
        let start = self.behind.flight.basis.shifted();
        let mut search = Search::new(stages, Some(start), budget);
        let mut trials = Vec::new();
        let settled = match self.settle(&mut search, &mut trials) {
            Ok(settled) => settled,
            Err(Failure::Interrupted(Interruption::Cancelled)) => {
                return Err(Failure::Interrupted(Interruption::Cancelled).into());
            }
            Err(failure) => return self.previous_plan_tail(&mut search, trials, failure),
        };
        trials.append(&mut search.restart());
        let Some(settled) = settled else {
            let limit = search.stages.horizon_limit();
            let mut infeasible = certify::name_infeasibility(&mut search, limit);
            if let Some(excuse) = self.behind.excuse() {
                infeasible.reason.push_str(excuse);
            }
            return Ok(self.infeasible(infeasible, Work::of(&search, trials)));
        };
        let verified = certify::verify_found(&search, &settled.found);
        if !verified.certificate.passed {
            let failure = uncertified(&verified);
            return self.previous_plan_tail(&mut search, trials, failure);
        }
        let flight = self.next_flight(&settled, &verified);
        let work = Work::of(&search, trials);
        let mut diagnostics = self.diagnostics(settled.branch, &flight, work);
        diagnostics.point = settled.point;
        Ok(self.commanded(flight, verified, diagnostics))
    }

    /// Lines 10 to 20 of Algorithm 1; for the baselines line 10 only. `None`: infeasible.
    fn settle(
        &self,
        search: &mut Search<'_, '_>,
        trials: &mut Vec<Trial>,
    ) -> Result<Option<Settled>, Failure> {
        let artifact = self.present.artifact;
        let flight = &*self.behind.flight;
        let limit = search.stages.horizon_limit();
        let adaptive = artifact.is_adaptive();
        // A deviation that no feedback bounded ends the promised decrease; it starts anew here.
        let cost_max = if adaptive && !self.behind.lost_the_tube() {
            flight.cost - artifact.decrease.lambda_bar
                + DECREASE_TOLERANCE * (1.0 + flight.cost.abs())
        } else {
            f64::INFINITY
        };
        let found = match search.run(&Goal::Own, flight.horizon - 1, limit) {
            Ok(found) => found,
            Err(failure) => Some(rescued_incumbent(search, failure, cost_max)?),
        };
        let point = found.as_ref().map(|found| (found.cost, found.horizon));
        if let Some(found) = found.filter(|found| found.cost <= cost_max) {
            let own_set = artifact.problem.scheme == Scheme::FixedTerminal;
            let branch = if own_set { Branch::TerminalSet } else { Branch::TerminalPoint };
            return Ok(Some(Settled { found, branch, point, powers: Vec::new() }));
        }
        if !adaptive {
            return Ok(None);
        }
        trials.append(&mut search.restart());
        let mut powers = flight.powers.clone();
        powers.push(flight.horizon - 1);
        let horizon = flight.horizon - 1;
        let found = match artifact.problem.fallback {
            TerminalFallback::PreviousHorizon => {
                let centre = flight.centre.clone();
                search.fixed(&Goal::GrownFixed { centre, powers: powers.clone() }, horizon)?
            }
            TerminalFallback::FreeHorizon => {
                let goal = Goal::GrownReference { powers: powers.clone() };
                match search.run(&goal, horizon, horizon.min(limit)) {
                    Ok(found) => found,
                    Err(failure) => Some(rescued_incumbent(search, failure, f64::INFINITY)?),
                }
            }
        };
        Ok(found.map(|found| Settled { found, branch: Branch::TerminalSet, point, powers }))
    }

    fn next_flight(&self, settled: &Settled, verified: &Verified) -> Flight {
        let (found, present, before) = (&settled.found, self.present, &self.behind.flight);
        let adapted = settled.powers.is_empty();
        Flight {
            previous_state: present.measured.clone(),
            previous_input: verified.trajectory.inputs.row(0).transpose(),
            cost: found.cost,
            horizon: found.horizon,
            adapted_step: if adapted { present.step } else { before.adapted_step },
            adapted_horizon: if adapted { found.horizon } else { before.adapted_horizon },
            centre: found.terminal.centre.clone(),
            powers: settled.powers.clone(),
            plan_step: present.step,
            plan_initial: present.measured.as_slice().to_vec(),
            plan_inputs: found.solution.inputs.clone(),
            basis: found.solution.basis.clone(),
        }
    }

    /// The candidate of the recursive-feasibility proof [Quartullo2025a, eq. A5]: the previous
    /// plan without its first input, corrected by v(j) + K A_K^j w. Feasible without solving
    /// anything, as long as w is in W; verified all the same.
    fn previous_plan_tail(
        self,
        search: &mut Search<'_, '_>,
        mut trials: Vec<Trial>,
        failure: Failure,
    ) -> Result<Step, StepError> {
        trials.append(&mut search.restart());
        let Present { artifact, step, ref measured, .. } = *self.present;
        let before = &*self.behind.flight;
        if self.behind.disturbance.outside_guaranteed_tube || !artifact.is_tightened() {
            return Err(failure.into());
        }
        let tail = PlanTail::new(artifact, before, &self.behind.disturbance.components);
        let horizon = tail.horizon;
        search.stages.extend_to(horizon);
        let program = search.stages.program(horizon, &tail.terminal);
        let claim = Claim::PreviousPlanTail;
        let statement = Statement { claim, cost: None, lower_bound: None };
        let nothing = Evidence::default();
        let verified =
            certify::verify_inputs(&search.stages, &program, &tail.inputs, nothing, statement);
        if !verified.certificate.passed {
            return Err(failure.into());
        }
        let mut powers = before.powers.clone();
        if artifact.is_adaptive() {
            powers.push(horizon);
        }
        let flight = Flight {
            previous_state: measured.clone(),
            previous_input: verified.trajectory.inputs.row(0).transpose(),
            cost: verified.certificate.cost,
            horizon,
            powers,
            plan_step: step,
            plan_initial: measured.as_slice().to_vec(),
            plan_inputs: tail.inputs,
            basis: Basis::default(),
            ..before.clone()
        };
        let work = Work::of(search, trials);
        let diagnostics = self.diagnostics(Branch::PreviousPlanTail, &flight, work);
        Ok(self.commanded(flight, verified, diagnostics))
    }

    /// u = v + K (x - z) around the plan of step 0. [Quartullo2025a, eq. 16]
    fn tube_feedback(self) -> Result<Step, StepError> {
        let Present { artifact, step, ref measured, .. } = *self.present;
        let before = &*self.behind.flight;
        let whole = verified_plan(artifact, before);
        let since = step - before.plan_step;
        let input = fed_back_input(artifact, &whole.trajectory, since, measured);
        if let Some(excess) = artifact.input_excess(&input) {
            let infeasible = Infeasibility {
                reason: format!(
                    "the tube feedback exceeds the input bounds by {excess:.3e}: the state has \
                     left the tube around the plan"
                ),
                horizon: before.horizon - 1,
                rows: Vec::new(),
                relaxations: Vec::new(),
                all_horizons_proved: false,
            };
            return Ok(self.infeasible(infeasible, Work::default()));
        }
        if !whole.certificate.passed {
            return Err(uncertified(&whole).into());
        }
        let verified = Verified { trajectory: ahead(&whole.trajectory, since), ..whole };
        let flight = Flight {
            previous_state: measured.clone(),
            previous_input: input,
            horizon: verified.trajectory.horizon(),
            ..before.clone()
        };
        let diagnostics = self.diagnostics(Branch::TubeFeedback, &flight, Work::default());
        Ok(self.commanded(flight, verified, diagnostics))
    }

    fn diagnostics(self, branch: Branch, flight: &Flight, work: Work) -> Diagnostics {
        let missed_steps = self.behind.missed;
        let artifact = self.present.artifact;
        Diagnostics { missed_steps, ..diagnostics(artifact, branch, Some(flight), work) }
    }

    fn commanded(self, flight: Flight, verified: Verified, diagnostics: Diagnostics) -> Step {
        let Present { artifact, step, .. } = *self.present;
        let disturbance = Some(self.behind.disturbance.clone());
        commanded(artifact, step, flight, verified, disturbance, diagnostics)
    }

    /// Hands on the state that was given: the next measurement finds one more step missed.
    fn infeasible(self, infeasible: Infeasibility, work: Work) -> Step {
        Step {
            index: self.present.step,
            verdict: Verdict::Infeasible(infeasible),
            next: self.present.given.clone(),
            trajectory: None,
            certificate: None,
            evidence: None,
            disturbance: Some(self.behind.disturbance.clone()),
            diagnostics: self.diagnostics(Branch::None, &self.behind.flight, work),
        }
    }
}

/// The candidate of the recursive-feasibility proof [Quartullo2025a, eq. A5]: the previous plan
/// without its first input, corrected by v(j) + K A_K^j w, and the point where it ends.
pub(super) struct PlanTail {
    pub(super) horizon: usize,
    /// N m values.
    pub(super) inputs: Vec<f64>,
    pub(super) terminal: Terminal,
}

impl PlanTail {
    pub(super) fn new(artifact: &Artifact, flight: &Flight, disturbance: &DVector<f64>) -> Self {
        let (n, m) = (artifact.tables.states(), artifact.tables.inputs());
        let horizon = flight.horizon - 1;
        let nominal = nominal_states(artifact, &flight.plan_initial, &flight.plan_inputs);
        let mut inputs = Vec::with_capacity(horizon * m);
        let mut error = disturbance.clone();
        for j in 0..horizon {
            let correction = times_vector(&artifact.gain, &error);
            let planned = &flight.plan_inputs[(j + 1) * m..][..m];
            inputs.extend(planned.iter().zip(correction.iter()).map(|(v, c)| v + c));
            error = times_vector(&artifact.closed_loop, &error);
        }
        let end = &nominal[(horizon + 1) * n..];
        let centre = end.iter().zip(error.iter()).map(|(z, e)| z + e).collect();
        let terminal = Terminal { centre, generators: Vec::new(), constrain_last: false };
        Self { horizon, inputs, terminal }
    }
}

/// The plan of step 0, as tube feedback follows it, verified as a whole.
pub(super) fn verified_plan(artifact: &Artifact, flight: &Flight) -> Verified {
    let mut stages = Stages::new(artifact, flight.plan_step, &flight.plan_initial);
    let horizon = flight.plan_inputs.len() / artifact.tables.inputs();
    stages.extend_to(horizon);
    let centre = flight.centre.clone();
    let terminal = Terminal { centre, generators: Vec::new(), constrain_last: false };
    let program = stages.program(horizon, &terminal);
    let statement = Statement {
        claim: Claim::FixedHorizon,
        cost: Some(flight.cost),
        lower_bound: Some(flight.cost),
    };
    let nothing = Evidence::default();
    certify::verify_inputs(&stages, &program, &flight.plan_inputs, nothing, statement)
}

/// u = v + K (x - z) around a plan, `since` steps after its start. [Quartullo2025a, eq. 16]
pub(super) fn fed_back_input(
    artifact: &Artifact,
    plan: &Trajectory,
    since: usize,
    measured: &DVector<f64>,
) -> DVector<f64> {
    let deviation = measured - plan.states.row(since).transpose();
    plan.inputs.row(since).transpose() + times_vector(&artifact.gain, &deviation)
}

/// What is left of a plan `since` steps after its start.
pub(super) fn ahead(plan: &Trajectory, since: usize) -> Trajectory {
    let left = plan.horizon() - since;
    Trajectory {
        states: plan.states.rows(since, left + 1).into_owned(),
        inputs: plan.inputs.rows(since, left).into_owned(),
    }
}

pub(super) fn nominal_states(artifact: &Artifact, initial: &[f64], inputs: &[f64]) -> Vec<f64> {
    let horizon = inputs.len() / artifact.tables.inputs();
    let mut states = vec![0.0; (horizon + 1) * initial.len()];
    states[..initial.len()].copy_from_slice(initial);
    artifact.tables.roll_forward(inputs, &mut states);
    states
}

fn commanded(
    artifact: &Artifact,
    step: usize,
    flight: Flight,
    verified: Verified,
    disturbance: Option<RealisedDisturbance>,
    diagnostics: Diagnostics,
) -> Step {
    let last = flight.horizon == 1;
    Step {
        index: step,
        verdict: Verdict::Command(command(artifact, step, flight.previous_input.clone(), last)),
        next: State { step: step + 1, flight: Some(flight) },
        trajectory: Some(verified.trajectory),
        certificate: Some(verified.certificate),
        evidence: Some(verified.evidence),
        disturbance,
        diagnostics,
    }
}

pub(super) fn command(
    artifact: &Artifact,
    step: usize,
    input: DVector<f64>,
    last: bool,
) -> Command {
    let accelerations = artifact.model.scaling.map(|scaling| {
        let unit = scaling.acceleration_unit_m_s2;
        [0, 1, 2].map(|i| crate::units::Acceleration::from_m_s2(input[i] * unit))
    });
    let mass = match &artifact.problem.plant {
        super::Plant::Hill(plant) => plant.mass,
        super::Plant::Linear(_) => None,
    };
    let force = |mass: crate::units::Mass| -> Option<[Force; 3]> {
        accelerations.map(|a| a.map(|a| mass * a))
    };
    Command {
        elapsed: Seconds::from_seconds(artifact.elapsed_s(step)),
        duration: artifact.model.sample_time,
        input,
        acceleration: accelerations,
        force: mass.and_then(force),
        last,
    }
}

/// What the solvers did for one answer.
#[derive(Default)]
struct Work {
    trials: Vec<Trial>,
    simplex_pivots: usize,
    general_solver_calls: usize,
}

impl Work {
    fn of_all(search: &mut Search<'_, '_>) -> Self {
        let trials = search.restart();
        Self::of(search, trials)
    }

    fn of(search: &Search<'_, '_>, trials: Vec<Trial>) -> Self {
        Self {
            trials,
            simplex_pivots: search.pivots,
            general_solver_calls: search.general_solver_calls,
        }
    }
}

/// `flight`: what the answer hands on; without a command ([`Branch::None`]) what it was given.
fn diagnostics(
    artifact: &Artifact,
    branch: Branch,
    flight: Option<&Flight>,
    work: Work,
) -> Diagnostics {
    let decided = flight.filter(|_| branch != Branch::None).map(|f| (f.cost, f.horizon));
    let (cost, horizon) = decided.unwrap_or((0.0, 0));
    let centre = flight.map(|flight| DVector::from_column_slice(&flight.centre));
    Diagnostics {
        branch,
        cost,
        horizon,
        point: decided.filter(|_| branch == Branch::TerminalPoint),
        adapted_step: flight.map_or(0, |flight| flight.adapted_step),
        adapted_horizon: flight.map_or(0, |flight| flight.adapted_horizon),
        terminal_set_powers: flight.map_or_else(Vec::new, |flight| flight.powers.clone()),
        terminal_centre: centre.unwrap_or_else(|| DVector::zeros(artifact.tables.states())),
        trials: work.trials,
        simplex_pivots: work.simplex_pivots,
        general_solver_calls: work.general_solver_calls,
        lambda: artifact.decrease.lambda_bar,
        missed_steps: 0,
    }
}

/// The step after the last command.
fn arrive(present: &Present<'_>, behind: &Behind<'_>) -> Step {
    let Present { artifact, step, ref measured, .. } = *present;
    let zero = DVector::zeros(measured.len());
    let reference = artifact.model.reference(step).unwrap_or(&zero);
    let deviation = measured - reference;
    let distance =
        artifact.model.scaling.map(|scaling| deviation.rows(0, 3).norm() * scaling.position_unit_m);
    let arrival = Arrival {
        completion_steps: step,
        distance_m: distance,
        deviation_norm: deviation.norm(),
        inside_guaranteed_set: inside_final_set(artifact, &behind.flight, measured),
    };
    let diagnostics = diagnostics(artifact, Branch::None, Some(&behind.flight), Work::default());
    Step {
        index: step,
        verdict: Verdict::Arrived(arrival),
        next: present.given.clone(),
        trajectory: None,
        certificate: None,
        evidence: None,
        disturbance: Some(behind.disturbance.clone()),
        diagnostics: Diagnostics { missed_steps: behind.missed, ..diagnostics },
    }
}

/// Is x in {terminal point} + S(N_q)? [Quartullo2025a, Proposition 1; Quartullo2025b, Theorem 2]
/// For the fixed terminal set S(inf) takes the place of S(N_q).
fn inside_final_set(artifact: &Artifact, flight: &Flight, measured: &DVector<f64>) -> bool {
    let deviation = measured - DVector::from_column_slice(&flight.centre);
    let set = match artifact.problem.scheme {
        Scheme::FixedTerminal => artifact.tube.sum(0..artifact.tube.terms()),
        Scheme::Nominal => return deviation.amax() <= TOLERANCE,
        Scheme::AdaptiveTerminal | Scheme::TubeOptimalControl => {
            artifact.tube.sum(0..flight.adapted_horizon)
        }
    };
    if set.is_point() {
        return deviation.amax() <= TOLERANCE;
    }
    zonotope_gauge(set.generators(), &deviation).is_some_and(|gauge| gauge <= 1.0 + GAUGE_TOLERANCE)
}

impl Artifact {
    /// Time of step `step` since the mission's start; 0 for a plant without a sample time.
    pub(super) fn elapsed_s(&self, step: usize) -> f64 {
        self.model.sample_time.map_or(0.0, |time| super::stages::as_f64(step) * time.seconds())
    }
}
