//! The methods as the service sees them: values whose method only this file looks at.
//!
//! A new method adds an arm to each enum here, beside its own file; transport, service and store
//! never learn its name.

use vbar_guidance::{
    Budget, Method,
    control::{
        Certificate, Controller, Infeasibility, PrepareError, StepError,
        variable_horizon::{self, VariableHorizon},
    },
};
use vbar_proto::v1::{self, problem::Method as Message};

use super::{Door, ElapsedAndState, Parse, Path, types, variable_horizon as wire};

/// A mission.
#[derive(Debug, Clone)]
pub(crate) enum Problem {
    VariableHorizon(Box<variable_horizon::Problem>),
}

/// What a precompute made.
#[derive(Debug)]
pub(crate) enum Artifact {
    VariableHorizon(Box<variable_horizon::Artifact>),
}

/// What one step hands to the next.
#[derive(Debug, Clone)]
pub(crate) enum State {
    VariableHorizon(variable_horizon::State),
}

/// A decided step.
#[derive(Debug)]
pub(crate) enum Step {
    VariableHorizon(Box<variable_horizon::Step>),
}

/// A plan, or why there is none.
#[derive(Debug)]
pub(crate) enum PlanVerdict {
    VariableHorizon(Box<variable_horizon::PlanOutcome>),
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
            None => door.refuse(path, "one of variable_horizon", "nothing"),
            Some(Message::VariableHorizon(problem)) => {
                Parse::parse(problem, path.field("variable_horizon"), door)
                    .map(|problem| Self::VariableHorizon(Box::new(problem)))
            }
        }
    }
}

impl Problem {
    /// Whose problem it is.
    pub(crate) fn method(&self) -> Method {
        match self {
            Self::VariableHorizon(_) => Method::VariableHorizon,
        }
    }

    /// Our own encoding of the parsed values; its digest names the problem.
    pub(crate) fn canonical_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(problem) => problem.canonical_bytes(),
        }
    }

    /// Thinks long once.
    pub(crate) fn prepare(&self, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
        match self {
            Self::VariableHorizon(problem) => prepare::<VariableHorizon>(problem, budget)
                .map(|artifact| Artifact::VariableHorizon(Box::new(artifact))),
        }
    }

    /// Writes why no artifact can be made.
    pub(super) fn render_infeasible(&self, why: &Infeasibility) -> v1::Infeasible {
        match self {
            Self::VariableHorizon(problem) => {
                types::render_infeasible(why, wire::position_unit_m(problem))
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
    C::merge(problem, shards)
}

impl Artifact {
    /// The canonical bytes of the problem it was made for.
    pub(crate) fn canonical_problem(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(artifact) => artifact.problem().canonical_bytes(),
        }
    }

    /// Whose artifact it is.
    pub(crate) fn method(&self) -> Method {
        match self {
            Self::VariableHorizon(_) => Method::VariableHorizon,
        }
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(artifact) => artifact.to_bytes(),
        }
    }

    /// Reads and checks again what [`Artifact::to_bytes`] wrote.
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, String> {
        match method {
            Method::VariableHorizon => variable_horizon::Artifact::from_bytes(bytes)
                .map(|artifact| Self::VariableHorizon(Box::new(artifact)))
                .map_err(|fault| fault.to_string()),
        }
    }

    /// The state before the first step.
    pub(crate) fn start(&self) -> State {
        match self {
            Self::VariableHorizon(artifact) => {
                State::VariableHorizon(VariableHorizon::start(artifact))
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
        }
    }

    /// Computes a plan to fly without re-optimising.
    pub(crate) fn plan(
        &self,
        initial: &ElapsedAndState,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        match self {
            Self::VariableHorizon(artifact) => {
                variable_horizon::plan(artifact, &wire::measurement(initial), budget)
                    .map(|outcome| PlanVerdict::VariableHorizon(Box::new(outcome)))
            }
        }
    }

    /// Writes the method's own summary.
    pub(super) fn render_summary(&self) -> v1::artifact::Summary {
        match self {
            Self::VariableHorizon(artifact) => {
                v1::artifact::Summary::VariableHorizon(wire::render_artifact(artifact))
            }
        }
    }

    /// Writes a step's answer but for what its envelope knows.
    pub(super) fn render_step(&self, step: &Step, omit_prediction: bool) -> v1::StepResponse {
        match (self, step) {
            (Self::VariableHorizon(artifact), Step::VariableHorizon(step)) => {
                wire::render_step(artifact, step, omit_prediction)
            }
        }
    }

    /// Writes a plan's outcome.
    pub(super) fn render_plan(&self, verdict: &PlanVerdict) -> v1::compute_plan_response::Outcome {
        use v1::compute_plan_response::Outcome;
        match (self, verdict) {
            (Self::VariableHorizon(artifact), PlanVerdict::VariableHorizon(outcome)) => {
                match &**outcome {
                    variable_horizon::PlanOutcome::Plan(plan) => {
                        Outcome::Plan(wire::render_plan(artifact, plan))
                    }
                    variable_horizon::PlanOutcome::Infeasible(why) => {
                        let unit = wire::position_unit_m(artifact.problem());
                        Outcome::Infeasible(types::render_infeasible(why, unit))
                    }
                }
            }
        }
    }
}

impl State {
    /// The step it is for.
    pub(crate) fn step_index(&self) -> usize {
        match self {
            Self::VariableHorizon(state) => state.step_index(),
        }
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::VariableHorizon(state) => state.to_bytes(),
        }
    }

    /// Reads what [`State::to_bytes`] wrote for a method.
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, String> {
        match method {
            Method::VariableHorizon => variable_horizon::State::from_bytes(bytes)
                .map(Self::VariableHorizon)
                .map_err(|fault| fault.to_string()),
        }
    }
}

impl Step {
    /// The state for the next step.
    pub(crate) fn next(&self) -> State {
        match self {
            Self::VariableHorizon(step) => State::VariableHorizon(step.next.clone()),
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
        }
    }

    /// The proof, if there is a command.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        match self {
            Self::VariableHorizon(step) => step.certificate.as_ref(),
        }
    }

    /// What the solvers did.
    pub(crate) fn work(&self) -> SolverWork {
        match self {
            Self::VariableHorizon(step) => work(&step.diagnostics),
        }
    }
}

impl PlanVerdict {
    /// The proof, if there is a plan.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        self.plan().map(|plan| &plan.certificate)
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
        }
    }
}

fn work(diagnostics: &variable_horizon::Diagnostics) -> SolverWork {
    SolverWork {
        simplex_pivots: diagnostics.simplex_pivots,
        general_solver_calls: diagnostics.general_solver_calls,
    }
}
