//! One flight: the loop closed over the network, thrusters failing, and what becomes of the states.

use std::{sync::Arc, time::Duration};

use nalgebra::{Vector3, Vector6};
use vbar_client::Client;
use vbar_proto::v1::{self, AbortReason};

use super::{
    Drift, Flyable, UnsafeSets,
    session::{Decided, Decision, Session, count, relative},
    start,
};
use crate::{
    campaign::{SimulationError, flight::Patience, plan::flight::aside},
    mission::abort::{FailureLaw, FailureMoment},
};

/// Most states of one safety report that is asked for.
const REPORT_STATES_MAX: usize = 100;

/// One flight, from its start to its end. Vectors are RTN.
#[derive(Debug, Clone, PartialEq)]
pub struct AbortFlight {
    /// Number of the run.
    pub run: u32,
    /// Starts drawn before this one and not kept.
    pub redraws: u32,
    /// How it ended.
    pub outcome: AbortOutcome,
    /// True states at steps 0, 1, ...
    pub samples: Vec<AbortSample>,
    /// What was flown from each of them but the last.
    pub steps: Vec<AbortStep>,
    /// Thrusters that failed on the way.
    pub failure: Option<FlownFailure>,
}

/// How a flight ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AbortOutcome {
    /// The service said so.
    Arrived,
    /// As many steps as the mission asks for were flown.
    StepsFlown,
    /// Thrusters failed, and what was left to do was done.
    Failed,
    /// No command and no abort exist; the service's reason.
    Infeasible(String),
}

/// The truth at one step.
#[derive(Debug, Clone, PartialEq)]
pub struct AbortSample {
    /// Position, m, and velocity, m/s.
    pub state: [f64; 6],
    /// The phase that the service decided in here; at the end, before it.
    pub phase: usize,
    /// What becomes of it if all thrusters fail here, one verdict a truth of the mission.
    pub drifts: Vec<Drift>,
    /// Inside the unsafe sets of each phase.
    pub unsafe_sets: UnsafeSets,
}

/// What was flown in one step.
#[derive(Debug, Clone, PartialEq)]
pub struct AbortStep {
    /// Held for the step.
    pub force_n: [f64; 3],
    /// The phase it was decided in.
    pub phase: usize,
    /// Where its force comes from.
    pub origin: Origin,
    /// Some half-space had to give way.
    pub softened: bool,
    /// The certificate passed; aborts have none.
    pub certified: bool,
    /// What could be done if thrusters failed at the next sample.
    pub next: ModeCounts,
    /// From question to answer, as the client sees it.
    pub latency: Duration,
}

impl std::iter::Sum for ModeCounts {
    fn sum<I: Iterator<Item = Self>>(counts: I) -> Self {
        counts.fold(Self::default(), |sum, one| Self {
            inside: sum.inside + one.inside,
            found: sum.found + one.found,
            none_proved: sum.none_proved + one.none_proved,
            undecided: sum.undecided + one.undecided,
        })
    }
}

/// Where the force of a step comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The regulator's command.
    Command,
    /// An abort in the service's answer.
    Abort(AbortReason),
    /// The rest of the last abort, or nothing: the service had no answer.
    Rest,
}

/// Verdicts on a state, counted over the modes that must be survived.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ModeCounts {
    /// Inside a backward reachable set.
    pub inside: usize,
    /// An abort was found.
    pub found: usize,
    /// It was proved that there is none.
    pub none_proved: usize,
    /// Neither.
    pub undecided: usize,
}

/// Thrusters that failed, and what came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct FlownFailure {
    /// At this step, before its command.
    pub step: usize,
    /// Thrusters that were left.
    pub working: Vec<i32>,
    /// Gauge of the position in the first phase's region then.
    pub gauge: Option<f64>,
    /// What the service found to do: `None` if it found no abort at the failure itself.
    pub abort: Option<AbortReason>,
    /// Later steps without an abort, on which the rest of the last one was flown.
    pub steps_without_abort: usize,
    /// How the flight after the failure passes the region, one verdict a truth of the mission.
    pub after: Vec<Drift>,
}

impl AbortFlight {
    /// Sum of |force| over the axes and steps, times the step over the mass: the paper's delta-v.
    #[must_use]
    pub fn delta_v_m_s(&self, case: &crate::AbortCase) -> f64 {
        self.steps.iter().map(|step| case.delta_v_m_s(&step.force_n)).sum()
    }

    /// Commands for which some half-space had to give way.
    #[must_use]
    pub fn softened_steps(&self) -> usize {
        self.steps.iter().filter(|step| step.softened).count()
    }

    /// Steps flown before any failure.
    #[must_use]
    pub fn steps_before_failure(&self) -> usize {
        self.failure.as_ref().map_or(self.steps.len(), |failure| failure.step)
    }

    /// First step at which a phase (or a later one) decided.
    #[must_use]
    pub fn begins_at(&self, phase: usize) -> Option<usize> {
        self.steps.iter().position(|step| step.phase >= phase)
    }

    /// First step at which the state is in an unsafe set of a phase; `None` where nobody asked.
    #[must_use]
    pub fn unsafe_at(&self, phase: usize) -> Option<Option<usize>> {
        let asked = self.samples.first()?.unsafe_sets.len() > phase;
        asked.then(|| self.samples.iter().position(|sample| sample.unsafe_sets[phase]))
    }

    /// The state enters the unsafe sets of a phase only after the next one has begun
    /// [AguilarMarsillach2022, fig. 16].
    #[must_use]
    pub fn safe_until_next(&self, phase: usize) -> bool {
        let Some(Some(inside)) = self.unsafe_at(phase) else { return true };
        self.begins_at(phase + 1).is_some_and(|next| inside > next)
    }

    /// What was flown after a failure came inside the region, by the first truth of the mission
    /// under which it did.
    #[must_use]
    pub fn entered(&self) -> bool {
        let after = self.failure.iter().flat_map(|failure| &failure.after);
        after.clone().any(|drift| drift.entry_s.is_some())
    }
}

/// Flies run number `run`.
pub(crate) async fn fly(
    client: &Client,
    flyable: &Arc<Flyable>,
    run: u32,
) -> Result<AbortFlight, SimulationError> {
    let start = {
        let flyable = flyable.clone();
        aside(move || start::draw(&flyable, run)).await??
    };
    let mut flight = AbortFlight {
        run,
        redraws: start.redraws,
        outcome: AbortOutcome::StepsFlown,
        samples: Vec::new(),
        steps: Vec::new(),
        failure: None,
    };
    let mut leg = Leg {
        session: Session::open(client, flyable, run).await?,
        flyable,
        state: start.state,
        rest: Vec::new(),
    };
    for k in 0..flyable.case.steps_max() {
        if let Some(law) = &flyable.case.failure
            && leg.fails(law, k, start.failure_gauge)
        {
            leg.fail(law, k, &mut flight).await?;
            break;
        }
        if let Some(end) = leg.step(k, &mut flight).await? {
            flight.outcome = end;
            break;
        }
    }
    if flight.samples.len() == flight.steps.len() {
        let phase = flight.steps.last().map_or(0, |step| step.phase);
        flight.samples.push(leg.sample(phase));
    }
    judge(client, flyable, run, flight).await
}

/// A flight under way.
struct Leg<'a> {
    session: Session<'a>,
    flyable: &'a Arc<Flyable>,
    state: Vector6<f64>,
    /// What is left of the last abort.
    rest: Vec<Vector3<f64>>,
}

impl Leg<'_> {
    fn sample(&self, phase: usize) -> AbortSample {
        AbortSample {
            state: self.state.into(),
            phase,
            drifts: Vec::new(),
            unsafe_sets: UnsafeSets::new(),
        }
    }

    fn fails(&self, law: &FailureLaw, k: u32, gauge: Option<f64>) -> bool {
        match (law.when, gauge) {
            (FailureMoment::AtStep(step), _) => k == step,
            (FailureMoment::AtGauge(_), Some(limit)) => {
                self.flyable.judge.gauge(0, &self.state).is_some_and(|here| here <= limit)
            }
            (FailureMoment::AtGauge(_), None) => false,
        }
    }

    /// One step with all thrusters; how the flight ended, if it did.
    async fn step(
        &mut self,
        k: u32,
        flight: &mut AbortFlight,
    ) -> Result<Option<AbortOutcome>, SimulationError> {
        let decision = self.session.decide(k, &self.state, None).await?;
        flight.samples.push(self.sample(decision.phase));
        let (force, origin) = match &decision.what {
            Decided::Arrived => return Ok(Some(AbortOutcome::Arrived)),
            Decided::Infeasible(why) => return Ok(Some(AbortOutcome::Infeasible(why.clone()))),
            Decided::Force(force) => (*force, Origin::Command),
            Decided::Abort(reason, forces) => (forces[0], Origin::Abort(*reason)),
        };
        flight.steps.push(flown(&decision, &force, origin));
        self.advance(k, &force).await?;
        Ok(None)
    }

    /// Moves the truth on; elsewhere, so that answers are not kept waiting by it.
    async fn advance(&mut self, k: u32, force: &Vector3<f64>) -> Result<(), SimulationError> {
        let (flyable, state, force) = (self.flyable.clone(), self.state, *force);
        self.state = aside(move || flyable.world.advance(k, &state, &force)).await?;
        Ok(())
    }

    /// Thrusters fail at step `k`: the rest of the flight.
    async fn fail(
        &mut self,
        law: &FailureLaw,
        k: u32,
        flight: &mut AbortFlight,
    ) -> Result<(), SimulationError> {
        flight.outcome = AbortOutcome::Failed;
        let judge = &self.flyable.judge;
        let (at, gauge) = (self.state, judge.gauge(0, &self.state));
        let total = law.working.is_empty();
        // With nothing left to thrust with, drift is what follows, whatever is answered.
        let steps = if total { 1 } else { judge.steps_after_failure() };
        let mut failure = FlownFailure {
            step: flight.steps.len(),
            working: law.working.clone(),
            gauge,
            abort: None,
            steps_without_abort: 0,
            after: Vec::new(),
        };
        let (mut forces, mut phase) = (Vec::new(), 0);
        for step in 0..steps {
            let decision = self.session.decide(k + step, &self.state, Some(&law.working)).await?;
            phase = decision.phase;
            flight.samples.push(self.sample(phase));
            let (force, origin) = match &decision.what {
                Decided::Abort(reason, sequence) => {
                    self.rest = sequence[1..].iter().rev().copied().collect();
                    (sequence[0], Origin::Abort(*reason))
                }
                Decided::Force(force) => (*force, Origin::Command),
                Decided::Infeasible(_) | Decided::Arrived => {
                    failure.steps_without_abort += 1;
                    (self.rest.pop().unwrap_or_default(), Origin::Rest)
                }
            };
            if let (0, Origin::Abort(reason)) = (step, origin) {
                failure.abort = Some(reason);
            }
            if total {
                break;
            }
            flight.steps.push(flown(&decision, &force, origin));
            forces.push(force);
            self.advance(k + step, &force).await?;
        }
        let flyable = self.flyable.clone();
        failure.after = aside(move || {
            let region = flyable.judge.region(phase);
            flyable.judge.after(k, &at, region, &forces)
        })
        .await?;
        flight.failure = Some(failure);
        Ok(())
    }
}

fn flown(decision: &Decision, force: &Vector3<f64>, origin: Origin) -> AbortStep {
    AbortStep {
        force_n: (*force).into(),
        phase: decision.phase,
        origin,
        softened: decision.softened,
        certified: decision.certified,
        next: decision.next,
        latency: decision.latency,
    }
}

/// Says of every state of a flight without failure what becomes of it, and which unsafe sets it is
/// in.
async fn judge(
    client: &Client,
    flyable: &Arc<Flyable>,
    run: u32,
    mut flight: AbortFlight,
) -> Result<AbortFlight, SimulationError> {
    if flyable.case.failure.is_some() {
        return Ok(flight);
    }
    let states: Vec<(Vector6<f64>, usize)> =
        flight.samples.iter().map(|sample| (Vector6::from(sample.state), sample.phase)).collect();
    let drifts = drifts(flyable, &states).await?;
    for (sample, drifts) in flight.samples.iter_mut().zip(drifts) {
        sample.drifts = drifts;
    }
    if flyable.simulation.phase_sets {
        for phase in 0..flyable.case.model.phases.len() {
            let inside = unsafe_in(client, flyable, run, phase, &states).await?;
            for (sample, inside) in flight.samples.iter_mut().zip(inside) {
                sample.unsafe_sets.push(inside);
            }
        }
    }
    Ok(flight)
}

/// Drifts of the states of steps 0, 1, ..., on as many processors as there are.
async fn drifts(
    flyable: &Arc<Flyable>,
    states: &[(Vector6<f64>, usize)],
) -> Result<Vec<Vec<Drift>>, SimulationError> {
    let hands = std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get);
    let share = states.len().div_ceil(hands).max(1);
    let parts: Vec<_> = states
        .chunks(share)
        .zip((0_u32..).step_by(share))
        .map(|(states, first)| {
            let (flyable, states) = (flyable.clone(), states.to_vec());
            tokio::spawn(aside(move || {
                let each = states.iter().zip(first..);
                each.map(|((state, phase), k)| flyable.judge.drifts(k, state, *phase))
                    .collect::<Vec<_>>()
            }))
        })
        .collect();
    let mut all = Vec::with_capacity(states.len());
    for part in parts {
        all.extend(part.await??);
    }
    Ok(all)
}

/// Whether each state is in an unsafe set of a phase, as the service says.
async fn unsafe_in(
    client: &Client,
    flyable: &Flyable,
    run: u32,
    phase: usize,
    states: &[(Vector6<f64>, usize)],
) -> Result<Vec<bool>, SimulationError> {
    let answer = |what: String| SimulationError::Answer { run, what };
    let phase = i32::try_from(phase).map_err(|fault| answer(fault.to_string()))?;
    let mut inside = Vec::with_capacity(states.len());
    for (states, first) in states.chunks(REPORT_STATES_MAX).zip((0..).step_by(REPORT_STATES_MAX)) {
        let trajectory = states.iter().map(|(state, _)| relative(state)).collect();
        let request = v1::SafetyReportRequest {
            controller: Some(v1::safety_report_request::Controller::ArtifactId(
                flyable.artifact_id.clone(),
            )),
            trajectory: Some(v1::safety_report_request::Trajectory::States(v1::StateTrajectory {
                states: trajectory,
            })),
            phase_index: Some(phase),
            first_step_index: first,
            modes: Vec::new(),
            omit_sequences: true,
        };
        let mut patience = Patience::new(run);
        let report = loop {
            match client.safety_report(request.clone()).await {
                Ok(report) => break report,
                Err(error) => patience.after(error).await?,
            }
        };
        if report.states.len() != states.len() {
            let counts = (report.states.len(), states.len());
            return Err(answer(format!("a report on {} of {} states", counts.0, counts.1)));
        }
        inside.extend(report.states.iter().map(|state| count(state).inside > 0));
    }
    Ok(inside)
}
