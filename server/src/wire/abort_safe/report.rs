//! Safety reports: `SafetyReport`.

use std::sync::Arc;

use vbar_guidance::{
    Budget, Interruption,
    control::{
        Fault,
        abort_safe::{Artifact as Prepared, SafetyQuestion, StateVerdict, safety_report},
        disturbance_feedback::{Plan, PlannedState},
    },
    dynamics::{RelativeVector, elliptic_step},
    frames::{RTN_FROM_LVLH_CCSDS, RelativeState},
    mission::ThrustMode,
    orbit::KeplerOrbit,
    reach::{AbortVerdict, Flight},
    units::Seconds,
};
use vbar_proto::v1;

use super::{problem::mode_list, verdict::render_state_verdict};
use crate::wire::{
    Artifact, ArtifactId, Controller, Door, Parse, Path, Problem, Provenance, Render, Violations,
    count,
    types::{integer, relative_state},
};

/// Most verdicts of one report, states times modes: a few megabytes.
const VERDICTS_MAX: usize = 100_000;
/// Parts of a sample by which a burn may miss one and still count as at it.
const SAMPLE_TOLERANCE: f64 = 1e-6;
/// Most numbers in the sequences of one report: 8 MB.
const SEQUENCE_NUMBERS_MAX: usize = 1_000_000;

/// `SafetyReport`.
#[derive(Debug)]
pub(crate) struct ReportCall {
    /// Orbit, thrusters and regions: an artifact or a problem.
    pub(crate) controller: Controller,
    /// What is asked of it.
    pub(crate) question: Question,
}

/// What is asked about a trajectory.
#[derive(Debug)]
pub(crate) struct Question {
    course: Course,
    /// `None`: decided by the states' positions.
    phase: Option<usize>,
    /// Empty: those of the phase.
    modes: Vec<ThrustMode>,
    omit_sequences: bool,
}

/// What is judged.
#[derive(Debug)]
enum Course {
    /// States one sample apart.
    States { first_step: usize, states: Vec<RelativeVector> },
    /// A kept plan of which burns are missed: only from one burn on, or from each in turn.
    MissedBurns { plan: ArtifactId, only: Option<usize> },
}

/// Why there is no report.
#[derive(Debug)]
pub(crate) enum ReportFault {
    /// The request does not fit the controller or the plan.
    Violations(Violations),
    /// No time was left.
    Interrupted(Interruption),
    /// The answer would be too large; the sentence says what to ask for instead.
    TooLarge(String),
}

impl From<Interruption> for ReportFault {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

impl Parse for ReportCall {
    type Message = v1::SafetyReportRequest;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let controller = controller(message, path, door);
        let course = course(message, path, door);
        let steps = door.limits.steps_max;
        let phase = message.phase_index.map_or(Some(None), |phase| {
            integer(phase, 0..=steps, path.field("phase_index"), door).map(Some)
        });
        // How many thrusters there are is known to the controller only.
        let modes = match message.modes.is_empty() {
            true => Some(Vec::new()),
            false => mode_list(&message.modes, None, path.field("modes"), door),
        };
        let question = Question {
            course: course?,
            phase: phase?,
            modes: modes?,
            omit_sequences: message.omit_sequences,
        };
        Some(Self { controller: controller?, question })
    }
}

fn controller(
    message: &v1::SafetyReportRequest,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Controller> {
    use v1::safety_report_request::Controller as Message;
    match &message.controller {
        None => door.refuse(path.field("controller"), "one of artifact_id, problem", "nothing"),
        Some(Message::ArtifactId(id)) => {
            ArtifactId::parse(id, path.field("artifact_id"), door).map(Controller::Artifact)
        }
        Some(Message::Problem(problem)) => {
            let path = path.field("problem");
            match &problem.method {
                None | Some(v1::problem::Method::AbortSafe(_)) => {
                    Problem::parse(problem, path, door).map(Controller::Problem)
                }
                Some(_) => door.refuse(path, "abort_safe", "a problem of another method"),
            }
        }
    }
}

fn course(message: &v1::SafetyReportRequest, path: Path<'_>, door: &mut Door) -> Option<Course> {
    use v1::safety_report_request::Trajectory as Message;
    let steps = door.limits.steps_max;
    let place = path.field("first_step_index");
    match &message.trajectory {
        None => door.refuse(path.field("trajectory"), "one of states, missed_burns", "nothing"),
        Some(Message::States(given)) => {
            let first_step = integer(message.first_step_index, 0..=steps, place, door);
            let path = path.field("states");
            let states = states(&given.states, path.field("states"), door);
            Some(Course::States { first_step: first_step?, states: states? })
        }
        Some(Message::MissedBurns(_)) if message.first_step_index != 0 => {
            door.refuse(place, "nothing: the plan knows its times", message.first_step_index)
        }
        Some(Message::MissedBurns(missed)) => {
            let path = path.field("missed_burns");
            let plan = ArtifactId::parse(&missed.plan_id, path.field("plan_id"), door);
            let only = missed.first_missed_burn.map_or(Some(None), |burn| {
                let most = door.limits.plan_instants_max;
                integer(burn, 0..=most, path.field("first_missed_burn"), door).map(Some)
            });
            Some(Course::MissedBurns { plan: plan?, only: only? })
        }
    }
}

fn states(
    given: &[v1::RelativeState],
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<RelativeVector>> {
    let most = door.limits.report_states_max;
    if !(1..=most).contains(&given.len()) {
        return door.refuse(path, format!("1 to {most} states"), given.len());
    }
    let states: Vec<Option<RelativeVector>> = given
        .iter()
        .enumerate()
        .map(|(i, state)| relative_state(state, path.index(i), door).map(|state| vector(&state)))
        .collect();
    states.into_iter().collect()
}

fn vector(state: &RelativeState) -> RelativeVector {
    let (p, v) = (state.position_m.components, state.velocity_m_s.components);
    RelativeVector::new(p.x, p.y, p.z, v.x, v.y, v.z)
}

impl Question {
    /// The kept plan that is needed.
    pub(crate) fn plan(&self) -> Option<ArtifactId> {
        match self.course {
            Course::States { .. } => None,
            Course::MissedBurns { plan, .. } => Some(plan),
        }
    }

    /// Judges every state.
    ///
    /// # Errors
    /// [`ReportFault`].
    pub(crate) fn judge(
        &self,
        artifact: Artifact,
        plan: Option<&Artifact>,
        provenance: Arc<Provenance>,
        budget: Budget<'_>,
    ) -> Result<ReportAnswer, ReportFault> {
        let Some(prepared) = artifact.as_abort_safe() else {
            return Err(fault(
                "artifact_id",
                "an artifact of abort_safe",
                artifact.method().name(),
            ));
        };
        self.check(prepared)?;
        let step_s = prepared.problem().sample_time.seconds();
        let (legs, closest) = match &self.course {
            Course::States { first_step, states } => {
                let flight = Flight::from_states(step_s, states.clone()).closest_to_target();
                let closest = (flight.least.sqrt(), *first_step as f64 * step_s + flight.at_s);
                (vec![(*first_step, states.clone())], closest)
            }
            Course::MissedBurns { only, .. } => {
                let plan = plan.and_then(Artifact::as_plan).ok_or_else(|| {
                    fault("missed_burns.plan_id", "a plan of disturbance_feedback", "another one")
                })?;
                let legs = missed_legs(prepared, plan, *only)?;
                let nearest = legs.iter().map(|(k, x)| (x.fixed_rows::<3>(0).norm(), *k));
                let (distance, k) = nearest.reduce(|a, b| if b.0 < a.0 { b } else { a }).unwrap_or(
                    // A plan has a burn at least.
                    (f64::INFINITY, 0),
                );
                let legs = legs.into_iter().map(|(k, x)| (k, vec![x])).collect();
                (legs, (distance, k as f64 * step_s))
            }
        };
        let states: usize = legs.iter().map(|(_, states): &(usize, Vec<_>)| states.len()).sum();
        self.room_for(prepared, states)?;
        let mut verdicts = Vec::with_capacity(states);
        for (first, states) in &legs {
            let question = SafetyQuestion {
                phase: self.phase,
                first: *first,
                states,
                modes: (!self.modes.is_empty()).then_some(self.modes.as_slice()),
            };
            verdicts.extend(safety_report(prepared, &question, budget)?);
        }
        let answer = ReportAnswer {
            verdicts,
            closest,
            omit_sequences: self.omit_sequences,
            artifact,
            provenance,
        };
        answer.fits()?;
        Ok(answer)
    }

    /// What only the controller knows to be wrong.
    fn check(&self, prepared: &Prepared) -> Result<(), ReportFault> {
        let problem = prepared.problem();
        let phases = problem.phases.len();
        if let Some(phase) = self.phase.filter(|&phase| phase >= phases) {
            let expected = format!("a phase of the mission, 0 to {}", phases - 1);
            return Err(fault("phase_index", &expected, &phase.to_string()));
        }
        let all = problem.thrusters.nominal();
        if let Some(i) = self.modes.iter().position(|mode| !mode.is_within(all)) {
            let expected = format!("thrusters from 0 to {}", problem.thrusters.list().len() - 1);
            return Err(fault(&format!("modes[{i}].indices"), &expected, "another one"));
        }
        Ok(())
    }

    fn room_for(&self, prepared: &Prepared, states: usize) -> Result<(), ReportFault> {
        let phases = &prepared.problem().phases;
        let modes = match (self.modes.len(), self.phase) {
            (0, Some(phase)) => phases[phase].safety.modes().len(),
            (0, None) => phases.iter().map(|phase| phase.safety.modes().len()).max().unwrap_or(0),
            (given, _) => given,
        };
        if states.saturating_mul(modes) > VERDICTS_MAX {
            return Err(ReportFault::TooLarge(format!(
                "{states} states with {modes} modes are more than {VERDICTS_MAX} verdicts: ask \
                 for fewer states, or name fewer modes"
            )));
        }
        Ok(())
    }
}

fn fault(field: &str, expected: &str, got: &str) -> ReportFault {
    ReportFault::Violations(Violations::under("", vec![Fault::new(field, expected, got)]))
}

/// For every burn in question: the state from which the chaser drifts if this burn and all later
/// ones are missed, taken on to the next sample of the mission.
fn missed_legs(
    prepared: &Prepared,
    plan: &Plan,
    only: Option<usize>,
) -> Result<Vec<(usize, RelativeVector)>, ReportFault> {
    let problem = prepared.problem();
    let (ours, theirs) = (&problem.orbit, &plan.problem().orbit);
    let elements =
        |orbit: &KeplerOrbit| (orbit.semi_major_axis(), orbit.eccentricity(), orbit.true_anomaly());
    if elements(ours) != elements(theirs) {
        let expected = "a plan on the mission's orbit that starts where it starts";
        return Err(fault("missed_burns.plan_id", expected, "a plan on another orbit"));
    }
    let burns = plan.burns().len();
    if let Some(burn) = only.filter(|&burn| burn >= burns) {
        let expected = format!("a burn of the plan, 0 to {}", burns - 1);
        return Err(fault("missed_burns.first_missed_burn", &expected, &burn.to_string()));
    }
    let planned = plan.outcome().states.iter().take(burns).enumerate();
    let wanted = planned.filter(|(burn, _)| only.is_none_or(|only| only == *burn));
    let step_s = problem.sample_time.seconds();
    Ok(wanted
        .map(|(_, PlannedState { elapsed, state, .. })| {
            let x = vector(&state.rotated(RTN_FROM_LVLH_CCSDS));
            // A burn at a sample is at that sample, whatever rounding says.
            let sample = (elapsed.seconds() / step_s - SAMPLE_TOLERANCE).ceil();
            let rest_s = sample * step_s - elapsed.seconds();
            if rest_s <= 0.0 {
                return (sample as usize, x);
            }
            let rest = Seconds::from_seconds(rest_s);
            let drift = elliptic_step(ours, problem.mass, *elapsed, rest);
            (sample as usize, drift.a * x)
        })
        .collect())
}

/// Answer of `SafetyReport`.
#[derive(Debug)]
pub(crate) struct ReportAnswer {
    artifact: Artifact,
    provenance: Arc<Provenance>,
    verdicts: Vec<StateVerdict>,
    /// Metres, and seconds since the mission's start.
    closest: (f64, f64),
    omit_sequences: bool,
}

impl ReportAnswer {
    fn fits(&self) -> Result<(), ReportFault> {
        let aborts =
            self.verdicts.iter().flat_map(|verdict| &verdict.modes).filter_map(|mode| match &mode
                .abort
            {
                AbortVerdict::Found(abort) => Some(abort),
                AbortVerdict::NoneProved { .. } | AbortVerdict::Undecided { .. } => None,
            });
        let numbers: usize = aborts
            .map(|abort| abort.throttles.iter().map(|row| row.len() + 3).sum::<usize>())
            .sum();
        if !self.omit_sequences && numbers > SEQUENCE_NUMBERS_MAX {
            let what = "the abort sequences are too many for one answer: ask for fewer states, or \
                        with omit_sequences";
            return Err(ReportFault::TooLarge(what.to_owned()));
        }
        Ok(())
    }

    fn summary(&self, prepared: &Prepared, states: &[v1::StateVerdict]) -> v1::SafetySummary {
        let sum = |pick: fn(&v1::StateVerdict) -> i32| states.iter().map(pick).sum();
        let without = |state: &v1::StateVerdict| state.modes_none_proved + state.modes_undecided;
        v1::SafetySummary {
            verdicts: sum(|state| count(state.modes.len())),
            found: sum(|state| state.modes_found),
            none_proved: sum(|state| state.modes_none_proved),
            undecided: sum(|state| state.modes_undecided),
            states_inside: count(states.iter().filter(|state| state.modes_inside > 0).count()),
            first_without_abort: states.iter().position(|state| without(state) > 0).map(count),
            closest_distance_m: self.closest.0,
            closest_elapsed_s: self.closest.1,
            warnings: prepared.summary().warnings(),
        }
    }
}

impl Render for ReportAnswer {
    type Message = v1::SafetyReportResponse;

    fn render(&self) -> v1::SafetyReportResponse {
        let provenance = Some(self.provenance.render());
        let Some(prepared) = self.artifact.as_abort_safe() else {
            return v1::SafetyReportResponse { provenance, ..v1::SafetyReportResponse::default() };
        };
        let states: Vec<v1::StateVerdict> = self
            .verdicts
            .iter()
            .map(|verdict| render_state_verdict(prepared, verdict, self.omit_sequences))
            .collect();
        let summary = Some(self.summary(prepared, &states));
        v1::SafetyReportResponse { states, summary, provenance }
    }
}
