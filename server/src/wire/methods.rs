//! The methods as the service sees them: values whose method it never learns.
//!
//! A method says in [`Wired`], beside its own messages, how it is read, flown and written; what is
//! here forgets which method it was. A new one adds a line to [`Problem`]'s parser and to
//! [`wired`].

use std::{any::Any, fmt, marker::PhantomData, sync::Arc};

use vbar_guidance::{
    Budget, Interruption, Method,
    control::{
        Certificate, Controller, Failure, Fault, Infeasibility, PrepareError, StepError,
        abort_safe::{self, AbortSafe},
        disturbance_feedback::{self, DisturbanceFeedback},
        offline_sampling::OfflineSampling,
        variable_horizon::VariableHorizon,
    },
    reach::ReadError,
};
use vbar_proto::v1::{self, compute_plan_response::Outcome, problem::Method as Message};

use super::{
    Claimed, Document, Door, ElapsedAndState, Missing, Order, Parse, Path, Unwritten, Violations,
    disturbance_feedback as df, export, types,
};

/// One method on the wire: its own messages, and what the service asks of it.
pub(super) trait Wired:
    Controller<
        Problem: Parse + Clone + fmt::Debug + Send + Sync + 'static,
        Shard: Send + 'static,
        Artifact: fmt::Debug + Send + Sync + 'static,
        State: Clone + fmt::Debug + Send + Sync + 'static,
        Answer: fmt::Debug + Send + Sync + 'static,
    > + Send
    + Sync
    + 'static
{
    /// Whose messages these are.
    const METHOD: Method;
    /// What `ComputePlan` means for it.
    const PLANNING: Planning;
    /// Whether measurements may say that thrusters have failed.
    const SEES_FAILURES: bool = false;

    /// Our own encoding of the parsed values; its digest names the problem.
    fn canonical_bytes(problem: &Self::Problem) -> Vec<u8>;
    /// Units of the amounts by which constraints are missed.
    fn units(problem: &Self::Problem) -> types::Units;
    /// Finds every fault that only the mathematics sees: a whole precompute, unless the method
    /// knows a shorter way.
    fn check(problem: &Self::Problem, budget: Budget<'_>) -> Result<(), PrepareError> {
        Self::prepare_in_time(problem, budget).map(drop)
    }

    /// The artifact, or something certified to fly instead when the deadline comes before it.
    fn prepare_in_time(
        problem: &Self::Problem,
        budget: Budget<'_>,
    ) -> Result<InTime<Self::Artifact>, PrepareError> {
        let shards = (0..Self::shards(problem)).map(|i| Self::run_shard(problem, i, budget));
        let artifact = Self::merge(problem, shards.collect::<Result<_, _>>()?, budget)?;
        Ok(InTime { artifact, is_cut_short: false })
    }

    /// The problem an artifact was made for.
    fn problem(artifact: &Self::Artifact) -> &Self::Problem;
    /// Its own bytes.
    fn artifact_to_bytes(artifact: &Self::Artifact) -> Vec<u8>;
    /// Reads and checks again what [`Wired::artifact_to_bytes`] wrote.
    fn artifact_from_bytes(bytes: &[u8], budget: Budget<'_>) -> Result<Self::Artifact, ReadError>;
    /// Writes the method's own summary.
    fn render_summary(artifact: &Self::Artifact) -> v1::artifact::Summary;
    /// The artifact as a plan that can be kept and flown, if that is what it is.
    fn as_plan(_artifact: &Self::Artifact) -> Option<&disturbance_feedback::Plan> {
        None
    }

    /// The artifact as one that safety reports are made with, if that is what it is.
    fn as_abort_safe(_artifact: &Self::Artifact) -> Option<&abort_safe::Artifact> {
        None
    }

    /// The step a state is for.
    fn step_index(state: &Self::State) -> usize;
    /// Its own bytes.
    fn state_to_bytes(state: &Self::State) -> Vec<u8>;
    /// Reads what [`Wired::state_to_bytes`] wrote.
    fn state_from_bytes(bytes: &[u8]) -> Result<Self::State, String>;

    /// The measurement as this artifact takes it; the fault's field is relative to it.
    fn measurement(
        artifact: &Self::Artifact,
        measured: &ElapsedAndState,
    ) -> Result<Self::Measurement, Fault>;

    /// The state for the next step.
    fn next(step: &Self::Answer) -> &Self::State;
    /// What was decided.
    fn kind(step: &Self::Answer) -> VerdictKind;
    /// The proof, if there is a command.
    fn certificate(step: &Self::Answer) -> Option<&Certificate>;
    /// Whether a command may leave: its proof holds, or it says itself that it promises nothing.
    fn may_leave(step: &Self::Answer) -> bool {
        Self::certificate(step).is_some_and(|certificate| certificate.passed)
    }
    /// What the solvers did.
    fn work(step: &Self::Answer) -> SolverWork;
    /// Everything of a step's answer but what its envelope knows: controller state, provenance.
    fn render_step(
        artifact: &Self::Artifact,
        step: &Self::Answer,
        omit_prediction: bool,
    ) -> v1::StepResponse;

    /// Computes a plan to fly without re-optimising; `initial` is there if
    /// [`Planning::FromMeasurement`]. Not asked of a method that is [`Planning::Stepwise`].
    fn plan(
        _artifact: &Self::Artifact,
        _initial: Option<&ElapsedAndState>,
        _budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        let what = format!("{} decides step by step and has no plan", Self::METHOD.name());
        Err(Failure::Numerical(what).into())
    }
}

/// The functions of [`Wired`] that are the same words for every method, because guidance's types
/// have the same names for the same things.
macro_rules! same_for_every_method {
    () => {
        fn canonical_bytes(problem: &Self::Problem) -> Vec<u8> {
            problem.canonical_bytes()
        }

        fn problem(artifact: &Self::Artifact) -> &Self::Problem {
            artifact.problem()
        }

        fn artifact_to_bytes(artifact: &Self::Artifact) -> Vec<u8> {
            artifact.to_bytes()
        }

        fn artifact_from_bytes(
            bytes: &[u8],
            budget: vbar_guidance::Budget<'_>,
        ) -> Result<Self::Artifact, vbar_guidance::reach::ReadError> {
            <Self::Artifact>::from_bytes_within(bytes, budget)
        }

        fn step_index(state: &Self::State) -> usize {
            state.step_index()
        }

        fn state_to_bytes(state: &Self::State) -> Vec<u8> {
            state.to_bytes()
        }

        fn state_from_bytes(bytes: &[u8]) -> Result<Self::State, String> {
            <Self::State>::from_bytes(bytes).map_err(|fault| fault.to_string())
        }

        fn next(step: &Self::Answer) -> &Self::State {
            &step.next
        }

        fn certificate(step: &Self::Answer) -> Option<&Certificate> {
            step.certificate.as_ref()
        }
    };
}
pub(super) use same_for_every_method;

/// What a precompute with a deadline comes to.
#[derive(Debug)]
pub(crate) struct InTime<A> {
    /// The artifact, or what can be flown instead.
    pub(crate) artifact: A,
    /// It is not the problem's artifact: there was no time for that.
    pub(crate) is_cut_short: bool,
}

/// What `ComputePlan` means for a method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Planning {
    /// It plans from a state that comes with the request.
    FromMeasurement,
    /// Its artifact is the plan; the problem has its initial state.
    IsArtifact,
    /// It decides step by step: there is no plan to fly without asking again.
    Stepwise,
}

/// A plan, or why there is none.
#[derive(Debug)]
pub(crate) struct PlanVerdict {
    /// As it is answered.
    pub(super) outcome: Outcome,
    /// The proof; `None` if it was checked when the artifact was made, or without a plan.
    pub(crate) certificate: Option<Certificate>,
    /// What the solvers did.
    pub(crate) work: SolverWork,
}

impl PlanVerdict {
    /// There is none.
    pub(super) fn infeasible(why: &Infeasibility, units: types::Units) -> Self {
        Self {
            outcome: Outcome::Infeasible(types::render_infeasible(why, units)),
            certificate: None,
            work: SolverWork::default(),
        }
    }

    /// Whether there is no plan.
    pub(crate) fn is_infeasible(&self) -> bool {
        matches!(self.outcome, Outcome::Infeasible(_))
    }
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
    Abort,
    Arrived,
    Infeasible,
}

const METHODS: &str = "one of variable_horizon, disturbance_feedback, abort_safe, offline_sampling";

/// A mission.
#[derive(Debug, Clone)]
pub(crate) struct Problem(Arc<dyn AnyProblem>);

impl Parse for Problem {
    type Message = v1::Problem;

    fn parse(message: &v1::Problem, path: Path<'_>, door: &mut Door) -> Option<Self> {
        match &message.method {
            None => door.refuse(path, METHODS, "nothing"),
            Some(Message::VariableHorizon(problem)) => {
                asked::<VariableHorizon>(problem, path.field("variable_horizon"), door)
            }
            Some(Message::DisturbanceFeedback(problem)) => {
                asked::<DisturbanceFeedback>(problem, path.field("disturbance_feedback"), door)
            }
            Some(Message::AbortSafe(problem)) => {
                asked::<AbortSafe>(problem, path.field("abort_safe"), door)
            }
            Some(Message::OfflineSampling(problem)) => {
                asked::<OfflineSampling>(problem, path.field("offline_sampling"), door)
            }
        }
    }
}

/// What each method's artifacts and states are read with.
fn wired(method: Method) -> &'static dyn AnyMethod {
    match method {
        Method::VariableHorizon => &Of::<VariableHorizon>(PhantomData),
        Method::DisturbanceFeedback => &Of::<DisturbanceFeedback>(PhantomData),
        Method::AbortSafe => &Of::<AbortSafe>(PhantomData),
        Method::OfflineSampling => &Of::<OfflineSampling>(PhantomData),
    }
}

fn asked<M: Wired>(
    message: &<M::Problem as Parse>::Message,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Problem> {
    let problem = M::Problem::parse(message, path, door)?;
    let problem = Problem(Arc::new(Asked::<M>(problem)));
    let (bytes, most) = (problem.memory_bytes(), door.limits.problem_bytes_max);
    if bytes > most {
        let expected = format!("a problem that takes at most about {} MiB of memory", most >> 20);
        return door.refuse(path, expected, format!("one that takes about {} MiB", bytes >> 20));
    }
    Some(problem)
}

impl Problem {
    /// What `ComputePlan` means for the method of a message, if it names one.
    pub(super) fn planning(message: &v1::Problem) -> Option<Planning> {
        Some(match message.method.as_ref()? {
            Message::VariableHorizon(_) => VariableHorizon::PLANNING,
            Message::DisturbanceFeedback(_) => DisturbanceFeedback::PLANNING,
            Message::AbortSafe(_) => AbortSafe::PLANNING,
            Message::OfflineSampling(_) => OfflineSampling::PLANNING,
        })
    }

    /// Whose problem it is.
    pub(crate) fn method(&self) -> Method {
        self.0.method()
    }

    /// Our own encoding of the parsed values; its digest names the problem.
    pub(crate) fn canonical_bytes(&self) -> Vec<u8> {
        self.0.canonical_bytes()
    }

    /// About the most bytes that a precompute and what it makes take, from dimensions alone.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.0.memory_bytes()
    }

    /// Number of shards of its precompute, at least 1.
    pub(crate) fn shards(&self) -> usize {
        self.0.shards()
    }

    /// Computes one shard.
    pub(crate) fn run_shard(
        &self,
        shard: usize,
        budget: Budget<'_>,
    ) -> Result<Shard, PrepareError> {
        self.0.run_shard(shard, budget)
    }

    /// Bytes of a shard, for whoever merges it elsewhere.
    ///
    /// # Panics
    /// If the shard is one of another method.
    pub(crate) fn shard_to_bytes(&self, shard: &Shard) -> Vec<u8> {
        self.0.shard_to_bytes(shard)
    }

    /// Reads and checks what [`Problem::shard_to_bytes`] wrote for this problem, however long that
    /// takes.
    #[cfg(feature = "fuzzing")]
    pub(crate) fn shard_from_bytes(&self, bytes: &[u8]) -> Result<Shard, Unread> {
        self.shard_from_bytes_within(bytes, Budget::UNLIMITED)
    }

    /// The same, if there is time.
    pub(crate) fn shard_from_bytes_within(
        &self,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Shard, Unread> {
        self.0.shard_from_bytes(bytes, budget)
    }

    /// Puts shards, in their order, together.
    pub(crate) fn merge(
        &self,
        shards: Vec<Shard>,
        budget: Budget<'_>,
    ) -> Result<Artifact, PrepareError> {
        self.0.merge(shards, budget)
    }

    /// Thinks long once: every shard in order, on the caller's thread.
    pub(crate) fn prepare(&self, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
        let shards = (0..self.shards()).map(|shard| self.run_shard(shard, budget));
        self.merge(shards.collect::<Result<_, _>>()?, budget)
    }

    /// The same, or something certified to fly instead when the deadline comes before it.
    pub(crate) fn prepare_in_time(
        &self,
        budget: Budget<'_>,
    ) -> Result<InTime<Artifact>, PrepareError> {
        self.0.prepare_in_time(budget)
    }

    /// Finds every fault that only the mathematics sees, and makes nothing.
    pub(crate) fn check(&self, budget: Budget<'_>) -> Result<(), PrepareError> {
        self.0.check(budget)
    }

    /// Writes why no artifact can be made.
    pub(super) fn render_infeasible(&self, why: &Infeasibility) -> v1::Infeasible {
        types::render_infeasible(why, self.0.units())
    }
}

/// Part of an artifact that was computed on its own.
pub(crate) struct Shard(Box<dyn Any + Send>);

/// What a precompute made.
#[derive(Debug, Clone)]
pub(crate) struct Artifact(Arc<dyn AnyArtifact>);

impl Artifact {
    /// Whose artifact it is.
    pub(crate) fn method(&self) -> Method {
        self.0.method()
    }

    /// The canonical bytes of the problem it was made for.
    pub(crate) fn canonical_problem(&self) -> Vec<u8> {
        self.0.canonical_problem()
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        self.0.to_bytes()
    }

    /// Reads and checks again what [`Artifact::to_bytes`] wrote, however long that takes.
    #[cfg(feature = "fuzzing")]
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, Unread> {
        Self::from_bytes_within(method, bytes, Budget::UNLIMITED)
    }

    /// The same, if there is time.
    pub(crate) fn from_bytes_within(
        method: Method,
        bytes: &[u8],
        budget: Budget<'_>,
    ) -> Result<Self, Unread> {
        wired(method).artifact_from_bytes(bytes, budget)
    }

    /// The state before the first step.
    pub(crate) fn start(&self) -> State {
        self.0.start()
    }

    /// Decides the next command.
    pub(crate) fn step(
        &self,
        state: &State,
        measured: &ElapsedAndState,
        budget: Budget<'_>,
    ) -> Result<Step, StepError> {
        Arc::clone(&self.0).step(&*state.0, measured, budget).map(Step)
    }

    /// Computes a plan to fly without re-optimising; `initial` is there if the method wants it.
    pub(crate) fn plan(
        &self,
        initial: Option<&ElapsedAndState>,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        self.0.plan(initial, budget)
    }

    /// Whether it is itself a plan, which can be kept and flown.
    pub(crate) fn is_plan(&self) -> bool {
        self.0.as_plan().is_some()
    }

    /// What safety reports are made with; `None` for other methods.
    pub(super) fn as_abort_safe(&self) -> Option<&abort_safe::Artifact> {
        self.0.as_abort_safe()
    }

    /// The plan that it is; `None` for what is no plan.
    pub(super) fn as_plan(&self) -> Option<&disturbance_feedback::Plan> {
        self.0.as_plan()
    }

    /// Writes a plan as a document, however long that takes; `None` for what is no plan.
    pub(crate) fn export(&self, plan_id: &str, order: &Order) -> Option<Result<Document, Missing>> {
        let written = self.export_within(plan_id, order, Budget::UNLIMITED)?;
        Some(written.map_err(|unwritten| match unwritten {
            Unwritten::Lacks(missing) => missing,
            Unwritten::Interrupted(why) => unreachable!("an unlimited budget said {why:?}"),
        }))
    }

    /// The same, if there is time.
    pub(crate) fn export_within(
        &self,
        plan_id: &str,
        order: &Order,
        budget: Budget<'_>,
    ) -> Option<Result<Document, Unwritten>> {
        self.0.as_plan().map(|plan| export::export(plan, plan_id, order, budget))
    }

    /// Writes a plan with its mission; `None` for what is no plan.
    pub(crate) fn render_document(&self) -> Option<v1::PlanDocument> {
        self.0.as_plan().map(df::render_document)
    }

    /// Writes a plan in one line; `None` for what is no plan.
    pub(super) fn render_line(&self) -> Option<v1::PlanSummary> {
        self.0.as_plan().map(df::render_line)
    }

    /// Writes the proof of a plan; `None` for what is no plan.
    pub(crate) fn render_plan_certificate(&self) -> Option<v1::PlanCertificate> {
        self.0.as_plan().map(|plan| df::render_plan_certificate(&plan.outcome().certificate))
    }

    /// Writes the method's own summary.
    pub(super) fn render_summary(&self) -> v1::artifact::Summary {
        self.0.render_summary()
    }
}

/// What one step hands to the next.
#[derive(Debug, Clone)]
pub(crate) struct State(Arc<dyn AnyState>);

impl State {
    /// The step it is for.
    pub(crate) fn step_index(&self) -> usize {
        self.0.step_index()
    }

    /// Its own bytes.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        self.0.to_bytes()
    }

    /// Reads what [`State::to_bytes`] wrote for a method.
    pub(crate) fn from_bytes(method: Method, bytes: &[u8]) -> Result<Self, String> {
        wired(method).state_from_bytes(bytes)
    }
}

/// A decided step.
#[derive(Debug)]
pub(crate) struct Step(Box<dyn AnyStep>);

impl Step {
    /// The state for the next step.
    pub(crate) fn next(&self) -> State {
        self.0.next()
    }

    /// What was decided.
    pub(crate) fn kind(&self) -> VerdictKind {
        self.0.kind()
    }

    /// The proof, if there is a command.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        self.0.certificate()
    }

    /// Whether a command may leave: its proof holds, or it says itself that it promises nothing.
    pub(crate) fn may_leave(&self) -> bool {
        self.0.may_leave()
    }

    /// What the solvers did.
    pub(crate) fn work(&self) -> SolverWork {
        self.0.work()
    }

    /// Writes the answer but for what its envelope knows.
    pub(super) fn render(&self, omit_prediction: bool) -> v1::StepResponse {
        self.0.render(omit_prediction)
    }
}

/// A method, without its values.
trait AnyMethod: Sync {
    fn artifact_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Artifact, Unread>;
    fn state_from_bytes(&self, bytes: &[u8]) -> Result<State, String>;
}

struct Of<M>(PhantomData<M>);

impl<M: Wired> AnyMethod for Of<M> {
    fn artifact_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Artifact, Unread> {
        Ok(Made::<M>::artifact(M::artifact_from_bytes(bytes, budget)?))
    }

    fn state_from_bytes(&self, bytes: &[u8]) -> Result<State, String> {
        M::state_from_bytes(bytes).map(Between::<M>::state)
    }
}

trait AnyProblem: fmt::Debug + Send + Sync {
    fn method(&self) -> Method;
    fn canonical_bytes(&self) -> Vec<u8>;
    fn units(&self) -> types::Units;
    fn check(&self, budget: Budget<'_>) -> Result<(), PrepareError>;
    fn prepare_in_time(&self, budget: Budget<'_>) -> Result<InTime<Artifact>, PrepareError>;
    fn memory_bytes(&self) -> usize;
    fn shards(&self) -> usize;
    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<Shard, PrepareError>;
    fn shard_to_bytes(&self, shard: &Shard) -> Vec<u8>;
    fn shard_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Shard, Unread>;
    fn merge(&self, shards: Vec<Shard>, budget: Budget<'_>) -> Result<Artifact, PrepareError>;
}

/// A problem of method `M`.
struct Asked<M: Wired>(M::Problem);

impl<M: Wired> fmt::Debug for Asked<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<M: Wired> AnyProblem for Asked<M> {
    fn method(&self) -> Method {
        M::METHOD
    }

    fn canonical_bytes(&self) -> Vec<u8> {
        M::canonical_bytes(&self.0)
    }

    fn units(&self) -> types::Units {
        M::units(&self.0)
    }

    fn check(&self, budget: Budget<'_>) -> Result<(), PrepareError> {
        M::check(&self.0, budget)
    }

    fn prepare_in_time(&self, budget: Budget<'_>) -> Result<InTime<Artifact>, PrepareError> {
        let InTime { artifact, is_cut_short } = M::prepare_in_time(&self.0, budget)?;
        Ok(InTime { artifact: Made::<M>::artifact(artifact), is_cut_short })
    }

    fn memory_bytes(&self) -> usize {
        M::memory_bytes(&self.0)
    }

    fn shards(&self) -> usize {
        M::shards(&self.0)
    }

    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<Shard, PrepareError> {
        M::run_shard(&self.0, shard, budget).map(|shard| Shard(Box::new(shard)))
    }

    fn shard_to_bytes(&self, Shard(shard): &Shard) -> Vec<u8> {
        let own = shard.downcast_ref().expect("a problem is given its own method's shards");
        M::shard_to_bytes(&self.0, own)
    }

    fn shard_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Shard, Unread> {
        Ok(Shard(Box::new(M::shard_from_bytes(&self.0, bytes, budget)?)))
    }

    fn merge(&self, shards: Vec<Shard>, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
        let own = shards.into_iter().map(|Shard(shard)| match shard.downcast::<M::Shard>() {
            Ok(shard) => Ok(*shard),
            Err(_) => Err(Failure::Numerical("a shard of another method".to_owned())),
        });
        M::merge(&self.0, own.collect::<Result<_, _>>()?, budget).map(Made::<M>::artifact)
    }
}

trait AnyArtifact: fmt::Debug + Send + Sync {
    fn method(&self) -> Method;
    fn canonical_problem(&self) -> Vec<u8>;
    fn to_bytes(&self) -> Vec<u8>;
    fn start(&self) -> State;
    fn step(
        self: Arc<Self>,
        state: &dyn AnyState,
        measured: &ElapsedAndState,
        budget: Budget<'_>,
    ) -> Result<Box<dyn AnyStep>, StepError>;
    fn plan(
        &self,
        initial: Option<&ElapsedAndState>,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError>;
    fn as_plan(&self) -> Option<&disturbance_feedback::Plan>;
    fn as_abort_safe(&self) -> Option<&abort_safe::Artifact>;
    fn render_summary(&self) -> v1::artifact::Summary;
}

/// An artifact of method `M`.
struct Made<M: Wired>(M::Artifact);

impl<M: Wired> Made<M> {
    fn artifact(made: M::Artifact) -> Artifact {
        Artifact(Arc::new(Self(made)))
    }
}

/// A method that does not know of failures must not ignore one.
fn understood<M: Wired>(measured: &ElapsedAndState) -> Result<(), StepError> {
    if M::SEES_FAILURES || measured.working.is_none() {
        return Ok(());
    }
    let expected = format!("nothing: {} does not know of failures", M::METHOD.name());
    let fault = Fault::new("working_thrusters", expected, "thrusters");
    Err(StepError::Measurement(vec![fault]))
}

impl<M: Wired> fmt::Debug for Made<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<M: Wired> AnyArtifact for Made<M> {
    fn method(&self) -> Method {
        M::METHOD
    }

    fn canonical_problem(&self) -> Vec<u8> {
        M::canonical_bytes(M::problem(&self.0))
    }

    fn to_bytes(&self) -> Vec<u8> {
        M::artifact_to_bytes(&self.0)
    }

    fn start(&self) -> State {
        Between::<M>::state(M::start(&self.0))
    }

    fn step(
        self: Arc<Self>,
        state: &dyn AnyState,
        measured: &ElapsedAndState,
        budget: Budget<'_>,
    ) -> Result<Box<dyn AnyStep>, StepError> {
        let state: &dyn Any = state;
        let Some(Between(state)) = state.downcast_ref::<Between<M>>() else {
            return Err(StepError::State("it belongs to another method".to_owned()));
        };
        understood::<M>(measured)?;
        let measurement = M::measurement(&self.0, measured)
            .map_err(|fault| StepError::Measurement(vec![fault]))?;
        let answer = M::step(&self.0, state, &measurement, budget)?;
        Ok(Box::new(Decided { by: self, answer }))
    }

    fn plan(
        &self,
        initial: Option<&ElapsedAndState>,
        budget: Budget<'_>,
    ) -> Result<PlanVerdict, StepError> {
        initial.map_or(Ok(()), understood::<M>)?;
        M::plan(&self.0, initial, budget)
    }

    fn as_plan(&self) -> Option<&disturbance_feedback::Plan> {
        M::as_plan(&self.0)
    }

    fn as_abort_safe(&self) -> Option<&abort_safe::Artifact> {
        M::as_abort_safe(&self.0)
    }

    fn render_summary(&self) -> v1::artifact::Summary {
        M::render_summary(&self.0)
    }
}

trait AnyState: Any + fmt::Debug + Send + Sync {
    fn step_index(&self) -> usize;
    fn to_bytes(&self) -> Vec<u8>;
}

/// A state of method `M`, between two steps.
struct Between<M: Wired>(M::State);

impl<M: Wired> Between<M> {
    fn state(state: M::State) -> State {
        State(Arc::new(Self(state)))
    }
}

impl<M: Wired> fmt::Debug for Between<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<M: Wired> AnyState for Between<M> {
    fn step_index(&self) -> usize {
        M::step_index(&self.0)
    }

    fn to_bytes(&self) -> Vec<u8> {
        M::state_to_bytes(&self.0)
    }
}

trait AnyStep: fmt::Debug + Send + Sync {
    fn next(&self) -> State;
    fn kind(&self) -> VerdictKind;
    fn certificate(&self) -> Option<&Certificate>;
    fn may_leave(&self) -> bool;
    fn work(&self) -> SolverWork;
    fn render(&self, omit_prediction: bool) -> v1::StepResponse;
}

/// A step that an artifact of method `M` decided.
struct Decided<M: Wired> {
    by: Arc<Made<M>>,
    answer: M::Answer,
}

impl<M: Wired> fmt::Debug for Decided<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.answer.fmt(f)
    }
}

impl<M: Wired> AnyStep for Decided<M> {
    fn next(&self) -> State {
        Between::<M>::state(M::next(&self.answer).clone())
    }

    fn kind(&self) -> VerdictKind {
        M::kind(&self.answer)
    }

    fn certificate(&self) -> Option<&Certificate> {
        M::certificate(&self.answer)
    }

    fn may_leave(&self) -> bool {
        M::may_leave(&self.answer)
    }

    fn work(&self) -> SolverWork {
        M::work(&self.answer)
    }

    fn render(&self, omit_prediction: bool) -> v1::StepResponse {
        M::render_step(&self.by.0, &self.answer, omit_prediction)
    }
}

/// Why what was kept is not read.
#[derive(Debug)]
pub(crate) enum Unread {
    /// It is not what it should be.
    Damaged(String),
    /// Stopped from outside.
    Interrupted(Interruption),
}

impl From<ReadError> for Unread {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Bytes(fault) => Self::Damaged(fault.to_string()),
            ReadError::Interrupted(why) => Self::Interrupted(why),
        }
    }
}

/// Why a caller's plan is not taken.
#[derive(Debug)]
pub(crate) enum Unverified {
    /// What does not hold.
    Claims(Violations),
    /// Stopped from outside.
    Interrupted(Interruption),
}

impl From<Violations> for Unverified {
    fn from(violations: Violations) -> Self {
        Self::Claims(violations)
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
        self.verify_within(Budget::UNLIMITED).map_err(|unverified| match unverified {
            Unverified::Claims(violations) => violations,
            Unverified::Interrupted(why) => unreachable!("an unlimited budget said {why:?}"),
        })
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`Unverified`].
    pub(crate) fn verify_within(self, budget: Budget<'_>) -> Result<Artifact, Unverified> {
        let plan = match self {
            Self::Document(claimed) => claimed.verify(budget)?,
            Self::Binary(bytes) => {
                let read = disturbance_feedback::Plan::from_bytes_within(&bytes, budget);
                read.map_err(|error| match error {
                    ReadError::Interrupted(why) => Unverified::Interrupted(why),
                    ReadError::Bytes(fault) => {
                        let expected = "a plan as PLAN_FORMAT_BINARY writes it";
                        let fault = Fault::new("binary", expected, fault.to_string());
                        Unverified::Claims(Violations::under("", vec![fault]))
                    }
                })?
            }
        };
        Ok(Made::<DisturbanceFeedback>::artifact(plan))
    }
}
