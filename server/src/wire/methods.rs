//! The methods as the service sees them: values whose method only this file looks at.
//!
//! A new method adds an arm to each enum here, beside its own file; transport, service and store
//! never learn its name.

use vbar_guidance::{
    Budget, Method,
    control::{
        Certificate, Controller, Fault, Infeasibility, PrepareError, StepError,
        disturbance_feedback::{self, DisturbanceFeedback},
        variable_horizon::{self, VariableHorizon},
    },
};
use vbar_proto::v1::{self, problem::Method as Message};

use super::{
    Claimed, Document, Door, ElapsedAndState, Missing, Order, Parse, Path, Violations,
    disturbance_feedback as df, export, types, variable_horizon as wire,
};

/// A mission.
#[derive(Debug, Clone)]
pub(crate) enum Problem {
    VariableHorizon(Box<variable_horizon::Problem>),
    DisturbanceFeedback(Box<disturbance_feedback::Problem>),
}

/// What a precompute made.
#[derive(Debug)]
pub(crate) enum Artifact {
    VariableHorizon(Box<variable_horizon::Artifact>),
    /// A plan is its own controller.
    DisturbanceFeedback(Box<disturbance_feedback::Plan>),
}

/// What one step hands to the next.
#[derive(Debug, Clone)]
pub(crate) enum State {
    VariableHorizon(variable_horizon::State),
    DisturbanceFeedback(disturbance_feedback::State),
}

/// A decided step.
#[derive(Debug)]
pub(crate) enum Step {
    VariableHorizon(Box<variable_horizon::Step>),
    DisturbanceFeedback(Box<disturbance_feedback::Step>),
}

/// A plan, or why there is none.
#[derive(Debug)]
pub(crate) enum PlanVerdict {
    VariableHorizon(Box<variable_horizon::PlanOutcome>),
    /// The artifact is the plan.
    DisturbanceFeedback,
}

/// What the solvers did for one answer.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SolverWork {
    /// Pivots of the simplex.
    pub(crate) simplex_pivots: usize,
    /// Programs handed to the general solver.
    pub(crate) general_solver_calls: usize,
}

/// What was decided, for counting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum VerdictKind {
    Command,
    Arrived,
    Infeasible,
}

impl Parse for Problem {
    type Message = v1::Problem;

    fn parse(message: &v1::Problem, path: Path<'_>, door: &mut Door) -> Option<Self> {
        match &message.method {
            None => door.refuse(path, "one of variable_horizon, disturbance_feedback", "nothing"),
            Some(Message::VariableHorizon(problem)) => {
                Parse::parse(problem, path.field("variable_horizon"), door)
                    .map(|problem| Self::VariableHorizon(Box::new(problem)))
            }
            Some(Message::DisturbanceFeedback(problem)) => {
                Parse::parse(problem, path.field("disturbance_feedback"), door)
                    .map(|problem| Self::DisturbanceFeedback(Box::new(problem)))
            }
        }
    }
}

impl Problem {
    /// Whether a request for a plan has to bring the state at the mission's start.
    pub(super) fn wants_initial(message: &v1::Problem) -> bool {
        !matches!(message.method, Some(Message::DisturbanceFeedback(_)))
    }

    /// Whose problem it is.
    pub(crate) fn method(&self) -> Method {
        match self {
            Self::VariableHorizon(_) => Method::VariableHorizon,
            Self::DisturbanceFeedback(_) => Method::DisturbanceFeedback,
        }
    }

    /// Our own encoding of the parsed values; its digest names the problem.
    pub(crate) fn canonical_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(problem) => problem.canonical_bytes(),
            Self::DisturbanceFeedback(problem) => problem.canonical_bytes(),
        }
    }

    /// Thinks long once.
    pub(crate) fn prepare(&self, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
        match self {
            Self::VariableHorizon(problem) => prepare::<VariableHorizon>(problem, budget)
                .map(|artifact| Artifact::VariableHorizon(Box::new(artifact))),
            Self::DisturbanceFeedback(problem) => prepare::<DisturbanceFeedback>(problem, budget)
                .map(|plan| Artifact::DisturbanceFeedback(Box::new(plan))),
        }
    }

    /// Writes why no artifact can be made.
    pub(super) fn render_infeasible(&self, why: &Infeasibility) -> v1::Infeasible {
        match self {
            Self::VariableHorizon(problem) => {
                types::render_infeasible(why, types::Units::scaled(wire::position_unit_m(problem)))
            }
            Self::DisturbanceFeedback(problem) => {
                types::render_infeasible(why, types::Units::impulses(problem.delta_v_max_m_s))
            }
        }
    }
}

/// Shards in order, on the caller's thread.
fn prepare<C: Controller>(
    problem: &C::Problem,
    budget: Budget<'_>,
) -> Result<C::Artifact, PrepareError> {
    let shards = (0..C::shards(problem))
        .map(|shard| C::run_shard(problem, shard, budget))
        .collect::<Result<_, _>>()?;
    C::merge(problem, shards, budget)
}

impl Artifact {
    /// The canonical bytes of the problem it was made for.
    pub(crate) fn canonical_problem(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(artifact) => artifact.problem().canonical_bytes(),
            Self::DisturbanceFeedback(plan) => plan.problem().canonical_bytes(),
        }
    }

    /// Whose artifact it is.
    pub(crate) fn method(&self) -> Method {
        match self {
            Self::VariableHorizon(_) => Method::VariableHorizon,
            Self::DisturbanceFeedback(_) => Method::DisturbanceFeedback,
        }
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(artifact) => artifact.to_bytes(),
            Self::DisturbanceFeedback(plan) => plan.to_bytes(),
        }
    }

    /// Reads and checks again what [`Artifact::to_bytes`] wrote.
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, String> {
        match method {
            Method::VariableHorizon => variable_horizon::Artifact::from_bytes(bytes)
                .map(|artifact| Self::VariableHorizon(Box::new(artifact)))
                .map_err(|fault| fault.to_string()),
            Method::DisturbanceFeedback => disturbance_feedback::Plan::from_bytes(bytes)
                .map(|plan| Self::DisturbanceFeedback(Box::new(plan)))
                .map_err(|fault| fault.to_string()),
        }
    }

    /// The state before the first step.
    pub(crate) fn start(&self) -> State {
        match self {
            Self::VariableHorizon(artifact) => {
                State::VariableHorizon(VariableHorizon::start(artifact))
            }
            Self::DisturbanceFeedback(plan) => {
                State::DisturbanceFeedback(DisturbanceFeedback::start(plan))
            }
        }
    }

    /// Decides the next command.
    pub(crate) fn step(
        &self,
        state: &State,
        measured: &ElapsedAndState,
        budget: Budget<'_>,
    ) -> Result<Step, StepError> {
        match (self, state) {
            (Self::VariableHorizon(artifact), State::VariableHorizon(state)) => {
                VariableHorizon::step(artifact, state, &wire::measurement(measured), budget)
                    .map(|step| Step::VariableHorizon(Box::new(step)))
            }
            (Self::DisturbanceFeedback(plan), State::DisturbanceFeedback(state)) => {
                let Some(measurement) = df::measurement(measured) else {
                    let fault = Fault::new("", "relative: the state of a spacecraft", "linear");
                    return Err(StepError::Measurement(vec![fault]));
                };
                DisturbanceFeedback::step(plan, state, &measurement, budget)
                    .map(|step| Step::DisturbanceFeedback(Box::new(step)))
            }
            (Self::VariableHorizon(_), State::DisturbanceFeedback(_))
            | (Self::DisturbanceFeedback(_), State::VariableHorizon(_)) => {
                Err(StepError::State("it belongs to another method".to_owned()))
            }
        }
    }

    /// Computes a plan to fly without re-optimising; `initial` is there if the method wants it.
    pub(crate) fn plan(
        &self,
        initial: Option<&ElapsedAndState>,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        match (self, initial) {
            (Self::VariableHorizon(artifact), Some(initial)) => {
                variable_horizon::plan(artifact, &wire::measurement(initial), budget)
                    .map(|outcome| PlanVerdict::VariableHorizon(Box::new(outcome)))
            }
            (Self::VariableHorizon(_), None) => {
                let fault = Fault::new("", "a value (the field is required)", "nothing");
                Err(StepError::Measurement(vec![fault]))
            }
            (Self::DisturbanceFeedback(_), _) => Ok(PlanVerdict::DisturbanceFeedback),
        }
    }

    /// Whether it is itself a plan, which can be kept and flown.
    pub(crate) fn is_plan(&self) -> bool {
        matches!(self, Self::DisturbanceFeedback(_))
    }

    /// Writes a plan as a document; `None` for what is no plan.
    pub(crate) fn export(&self, plan_id: &str, order: &Order) -> Option<Result<Document, Missing>> {
        match self {
            Self::VariableHorizon(_) => None,
            Self::DisturbanceFeedback(plan) => Some(export::export(plan, plan_id, order)),
        }
    }

    /// Writes a plan with its mission; `None` for what is no plan.
    pub(crate) fn render_document(&self) -> Option<v1::PlanDocument> {
        match self {
            Self::VariableHorizon(_) => None,
            Self::DisturbanceFeedback(plan) => {
                let method = Message::DisturbanceFeedback(df::render_problem(plan.problem()));
                Some(v1::PlanDocument {
                    problem: Some(v1::Problem { method: Some(method) }),
                    plan: Some(df::wrapped(plan)),
                })
            }
        }
    }

    /// Writes a plan in one line; `None` for what is no plan.
    pub(super) fn render_line(&self) -> Option<v1::PlanSummary> {
        match self {
            Self::VariableHorizon(_) => None,
            Self::DisturbanceFeedback(plan) => Some(df::render_line(plan)),
        }
    }

    /// Writes the proof of a plan; `None` for what is no plan.
    pub(crate) fn render_plan_certificate(&self) -> Option<v1::PlanCertificate> {
        match self {
            Self::VariableHorizon(_) => None,
            Self::DisturbanceFeedback(plan) => {
                Some(df::render_plan_certificate(&plan.outcome().certificate))
            }
        }
    }

    /// Writes the method's own summary.
    pub(super) fn render_summary(&self) -> v1::artifact::Summary {
        match self {
            Self::VariableHorizon(artifact) => {
                v1::artifact::Summary::VariableHorizon(wire::render_artifact(artifact))
            }
            Self::DisturbanceFeedback(plan) => {
                let plan = Some(df::render_plan(plan));
                let summary = v1::DisturbanceFeedbackArtifact { plan };
                v1::artifact::Summary::DisturbanceFeedback(summary)
            }
        }
    }

    /// Writes a step's answer but for what its envelope knows.
    pub(super) fn render_step(&self, step: &Step, omit_prediction: bool) -> v1::StepResponse {
        match (self, step) {
            (Self::VariableHorizon(artifact), Step::VariableHorizon(step)) => {
                wire::render_step(artifact, step, omit_prediction)
            }
            (Self::DisturbanceFeedback(plan), Step::DisturbanceFeedback(step)) => {
                df::render_step(plan, step, omit_prediction)
            }
            // A step is rendered by the artifact that decided it.
            (Self::VariableHorizon(_), Step::DisturbanceFeedback(_))
            | (Self::DisturbanceFeedback(_), Step::VariableHorizon(_)) => {
                v1::StepResponse::default()
            }
        }
    }

    /// Writes a plan's outcome.
    pub(super) fn render_plan(
        &self,
        verdict: &PlanVerdict,
    ) -> Option<v1::compute_plan_response::Outcome> {
        use v1::compute_plan_response::Outcome;
        match (self, verdict) {
            (Self::VariableHorizon(artifact), PlanVerdict::VariableHorizon(outcome)) => {
                Some(match &**outcome {
                    variable_horizon::PlanOutcome::Plan(plan) => {
                        Outcome::Plan(wire::render_plan(artifact, plan))
                    }
                    variable_horizon::PlanOutcome::Infeasible(why) => {
                        let unit = wire::position_unit_m(artifact.problem());
                        Outcome::Infeasible(types::render_infeasible(
                            why,
                            types::Units::scaled(unit),
                        ))
                    }
                })
            }
            (Self::DisturbanceFeedback(plan), PlanVerdict::DisturbanceFeedback) => {
                Some(Outcome::Plan(df::wrapped(plan)))
            }
            // A verdict is rendered by the artifact that gave it.
            (Self::VariableHorizon(_), PlanVerdict::DisturbanceFeedback)
            | (Self::DisturbanceFeedback(_), PlanVerdict::VariableHorizon(_)) => None,
        }
    }
}

impl State {
    /// The step it is for.
    pub(crate) fn step_index(&self) -> usize {
        match self {
            Self::VariableHorizon(state) => state.step_index(),
            Self::DisturbanceFeedback(state) => state.step_index(),
        }
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(state) => state.to_bytes(),
            Self::DisturbanceFeedback(state) => state.to_bytes(),
        }
    }

    /// Reads what [`State::to_bytes`] wrote for a method.
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, String> {
        match method {
            Method::VariableHorizon => variable_horizon::State::from_bytes(bytes)
                .map(Self::VariableHorizon)
                .map_err(|fault| fault.to_string()),
            Method::DisturbanceFeedback => disturbance_feedback::State::from_bytes(bytes)
                .map(Self::DisturbanceFeedback)
                .map_err(|fault| fault.to_string()),
        }
    }
}

impl Step {
    /// The state for the next step.
    pub(crate) fn next(&self) -> State {
        match self {
            Self::VariableHorizon(step) => State::VariableHorizon(step.next.clone()),
            Self::DisturbanceFeedback(step) => State::DisturbanceFeedback(step.next.clone()),
        }
    }

    /// What was decided.
    pub(crate) fn kind(&self) -> VerdictKind {
        match self {
            Self::VariableHorizon(step) => match step.verdict {
                variable_horizon::Verdict::Command(_) => VerdictKind::Command,
                variable_horizon::Verdict::Arrived(_) => VerdictKind::Arrived,
                variable_horizon::Verdict::Infeasible(_) => VerdictKind::Infeasible,
            },
            Self::DisturbanceFeedback(step) => match step.verdict {
                disturbance_feedback::Verdict::Burn(_) => VerdictKind::Command,
                disturbance_feedback::Verdict::Arrived(_) => VerdictKind::Arrived,
            },
        }
    }

    /// The proof, if there is a command.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        match self {
            Self::VariableHorizon(step) => step.certificate.as_ref(),
            Self::DisturbanceFeedback(step) => step.certificate.as_ref(),
        }
    }

    /// What the solvers did.
    pub(crate) fn work(&self) -> SolverWork {
        match self {
            Self::VariableHorizon(step) => work(&step.diagnostics),
            // Flying a plan solves nothing.
            Self::DisturbanceFeedback(_) => SolverWork::default(),
        }
    }
}

impl PlanVerdict {
    /// The proof, if there is a plan.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        self.plan().map(|plan| &plan.certificate)
    }

    /// Whether there is no plan.
    pub(crate) fn is_infeasible(&self) -> bool {
        match self {
            Self::VariableHorizon(_) => self.plan().is_none(),
            Self::DisturbanceFeedback => false,
        }
    }

    /// What the solvers did; unknown without a plan.
    pub(crate) fn work(&self) -> SolverWork {
        self.plan().map(|plan| work(&plan.diagnostics)).unwrap_or_default()
    }

    fn plan(&self) -> Option<&variable_horizon::Plan> {
        match self {
            Self::VariableHorizon(outcome) => match &**outcome {
                variable_horizon::PlanOutcome::Plan(plan) => Some(plan),
                variable_horizon::PlanOutcome::Infeasible(_) => None,
            },
            // Its certificate was checked when it was made.
            Self::DisturbanceFeedback => None,
        }
    }
}

/// A plan that a caller brings, not checked yet.
#[derive(Debug)]
pub(crate) enum Candidate {
    /// A document, and what it claims.
    Document(Box<Claimed>),
    /// The compact form.
    Binary(bytes::Bytes),
}

impl Candidate {
    /// The plan, if it is one and everything it claims holds.
    ///
    /// # Errors
    /// Every claim that does not hold.
    pub(crate) fn verify(self) -> Result<Artifact, Violations> {
        let plan = match self {
            Self::Document(claimed) => claimed.verify()?,
            Self::Binary(bytes) => {
                disturbance_feedback::Plan::from_bytes(&bytes).map_err(|fault| {
                    let expected = "a plan as PLAN_FORMAT_BINARY writes it";
                    let fault = Fault::new("binary", expected, fault.to_string());
                    Violations::under("", vec![fault])
                })?
            }
        };
        Ok(Artifact::DisturbanceFeedback(Box::new(plan)))
    }
}

fn work(diagnostics: &variable_horizon::Diagnostics) -> SolverWork {
    SolverWork {
        simplex_pivots: diagnostics.simplex_pivots,
        general_solver_calls: diagnostics.general_solver_calls,
    }
}
