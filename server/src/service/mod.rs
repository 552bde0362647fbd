//! The service: what each call means, whatever it came over.

mod cache;
mod error;
mod record;
mod session;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use vbar_guidance::{
    Budget, Method,
    control::{Certificate, PrepareError, StepError},
};

pub(crate) use crate::compute::Timed;
pub(crate) use error::{Code, Error};
pub(crate) use session::{Session, SessionAnswer};

use crate::{
    compute::Compute,
    store::{Put, RecordStore, Shelf},
    telemetry::{Metrics, OutcomeLabels},
    wire::{
        Artifact, ArtifactAnswer, ArtifactCall, ArtifactId, Controller, ControllerState,
        DecidedStep, Document, ElapsedAndState, ExportCall, InfoAnswer, InfoCall, KeptPlanAnswer,
        KeptPlanCall, Limits, OperationAnswer, OperationName, OperationsAnswer, OperationsCall,
        PlanAnswer, PlanCall, PlanResult, PlanVerdict, PlansAnswer, PlansCall, PrecomputeCall,
        Problem, Provenance, ReportAnswer, ReportCall, SolverWork, State, StateFault, StepAnswer,
        StepCall, UploadAnswer, UploadCall, VerdictKind,
    },
};
use cache::{Cache, Outcome};
use session::StateSource;

/// Where a problem's own message stands in every request that carries one.
fn problem_path(method: Method) -> String {
    format!("problem.{}", method.name())
}

/// A decoded artifact with where it comes from.
type Loaded = ArtifactAnswer;

/// The controller that a step names, or the answer that there is none.
enum Found {
    Controller(Loaded),
    None(StepAnswer),
}

/// What a call brings besides its message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Call {
    /// When an answer is no longer of use.
    pub(crate) deadline: Instant,
}

/// The service.
#[derive(Debug)]
pub(crate) struct Service {
    compute: Compute,
    store: Arc<dyn RecordStore>,
    cache: Cache,
    metrics: Arc<Metrics>,
    info: InfoAnswer,
}

impl Service {
    /// A service that computes with `compute`, keeps artifacts and plans in `store` and at most
    /// `cache_bytes_max` bytes of them in memory.
    pub(crate) fn new(
        compute: Compute,
        store: Arc<dyn RecordStore>,
        cache_bytes_max: usize,
        metrics: Arc<Metrics>,
        info: InfoAnswer,
    ) -> Self {
        Self { compute, store, cache: Cache::new(cache_bytes_max), metrics, info }
    }

    /// The limits in force.
    pub(crate) fn info(&self, _: InfoCall) -> InfoAnswer {
        self.info
    }

    /// The limits that requests are parsed with.
    pub(crate) fn limits(&self) -> Limits {
        self.info.limits
    }

    /// Metrics.
    pub(crate) fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    /// When a call that starts now must be answered: its own wish, within the server's limit.
    pub(crate) fn deadline(&self, wish: Option<Duration>) -> Instant {
        let limit = self.info.computation_time_max;
        Instant::now() + wish.map_or(limit, |wish| wish.min(limit))
    }

    /// `Step`.
    pub(crate) async fn step(
        &self,
        ask: StepCall,
        call: &Call,
    ) -> Result<Timed<StepAnswer>, Error> {
        let artifact = match self.controller(ask.controller, call).await? {
            Found::Controller(artifact) => artifact,
            Found::None(value) => return Ok(Timed { value, compute: Duration::ZERO }),
        };
        let state = StateSource::Envelope(ask.controller_state);
        let decided = self.decide(artifact, state, ask.measurement, ask.omit_prediction, call);
        decided.await.map(|timed| timed.map(StepAnswer::Decided))
    }

    /// `SafetyReport`.
    pub(crate) async fn safety_report(
        &self,
        ask: ReportCall,
        call: &Call,
    ) -> Result<Timed<ReportAnswer>, Error> {
        let loaded = match self.controller(ask.controller, call).await? {
            Found::Controller(loaded) => loaded,
            Found::None(_) => {
                let message = "no controller exists for the problem";
                return Err(Error::new(Code::FailedPrecondition, "NO_CONTROLLER", message));
            }
        };
        let question = ask.question;
        let plan = match question.plan() {
            Some(id) => Some(self.load(Shelf::Plans, id, call).await?.artifact),
            None => None,
        };
        let Loaded { artifact, provenance, .. } = loaded;
        let work =
            move |budget: Budget<'_>| question.judge(artifact, plan.as_ref(), provenance, budget);
        let timed = self.compute.run("safety_report", call.deadline, work).await?;
        Ok(Timed { value: timed.value?, compute: timed.compute })
    }

    /// `ComputePlan`. What can be flown as it is, is kept.
    pub(crate) async fn plan(
        &self,
        ask: PlanCall,
        call: &Call,
    ) -> Result<Timed<PlanAnswer>, Error> {
        if ask.validate_only {
            let timed = self.validate(ask.problem, call).await?;
            let (id, method) = timed.value;
            let provenance = Arc::new(provenance(method, id, String::new()));
            let value = PlanAnswer { provenance, outcome: None, plan_id: None };
            return Ok(Timed { value, compute: timed.compute });
        }
        let (method, id) = (ask.problem.method(), record::problem_id(&ask.problem));
        let loaded = match self.obtain(id, ask.problem, call).await? {
            Outcome::Made(loaded) => loaded,
            Outcome::Infeasible(problem, why) => {
                self.planned("infeasible");
                let provenance = Arc::new(provenance(method, id, String::new()));
                let outcome = Some(PlanResult::NoController(problem, why));
                let value = PlanAnswer { provenance, outcome, plan_id: None };
                return Ok(Timed { value, compute: Duration::ZERO });
            }
        };
        let (artifact, store) = (loaded.artifact, Arc::clone(&self.store));
        let initial = ask.initial;
        let work = move |budget: Budget<'_>| -> Result<(PlanVerdict, Option<Loaded>), Error> {
            let verdict = artifact.plan(initial.as_ref(), budget);
            let verdict = verdict.map_err(|fault| Error::step("initial", fault))?;
            let sound = verdict.certificate.as_ref().is_none_or(|certificate| certificate.passed);
            let kept = (sound && artifact.is_plan()).then(|| keep_plan(&*store, artifact));
            Ok((verdict, kept.transpose()?))
        };
        let timed = self.compute.run("plan", call.deadline, work).await?;
        let (verdict, kept) = timed.value?;
        self.count(verdict.work);
        if let Some(certificate) = &verdict.certificate {
            self.withhold_unless(certificate.passed, Some(certificate))?;
        }
        self.planned(if verdict.is_infeasible() { "infeasible" } else { "computed" });
        let plan_id = kept.map(|plan| self.remember(Shelf::Plans, plan).id);
        let outcome = Some(PlanResult::Decided(Box::new(verdict)));
        let value = PlanAnswer { provenance: loaded.provenance, outcome, plan_id };
        Ok(Timed { value, compute: timed.compute })
    }

    /// `UploadPlan`: kept if everything it claims holds.
    pub(crate) async fn upload(
        &self,
        ask: UploadCall,
        call: &Call,
    ) -> Result<Timed<UploadAnswer>, Error> {
        let store = Arc::clone(&self.store);
        let UploadCall { candidate, validate_only } = ask;
        let work = move |_: Budget<'_>| -> Result<(Artifact, Option<Loaded>), Error> {
            let plan = candidate.verify()?;
            let kept = (!validate_only).then(|| keep_plan(&*store, plan.clone()));
            Ok((plan, kept.transpose()?))
        };
        let timed = self.compute.run("verify", call.deadline, work).await?;
        let (plan, kept) = timed.value.inspect_err(|_| self.planned("refused"))?;
        self.planned("uploaded");
        let plan_id = kept.map(|plan| self.remember(Shelf::Plans, plan).id);
        Ok(Timed { value: UploadAnswer { plan, plan_id }, compute: timed.compute })
    }

    /// `GetPlan`.
    pub(crate) async fn kept_plan(
        &self,
        ask: KeptPlanCall,
        call: &Call,
    ) -> Result<KeptPlanAnswer, Error> {
        self.load(Shelf::Plans, ask.id, call).await.map(kept_plan)
    }

    /// `ListPlans`.
    pub(crate) async fn kept_plans(
        &self,
        ask: PlansCall,
        call: &Call,
    ) -> Result<PlansAnswer, Error> {
        let (ids, next) = self.page(Shelf::Plans, ask.after, ask.page_size, call).await?;
        let mut plans = Vec::with_capacity(ids.len());
        for id in ids {
            plans.push(kept_plan(self.load(Shelf::Plans, id, call).await?));
        }
        Ok(PlansAnswer { plans, next })
    }

    /// `ExportPlan`.
    pub(crate) async fn export(
        &self,
        ask: ExportCall,
        call: &Call,
    ) -> Result<Timed<Document>, Error> {
        let ExportCall { id, order } = ask;
        let plan = self.load(Shelf::Plans, id, call).await?.artifact;
        let work = move |_: Budget<'_>| plan.export(&id.to_string(), &order);
        let timed = self.compute.run("export", call.deadline, work).await?;
        match timed.value {
            Some(Ok(value)) => {
                self.planned("exported");
                Ok(Timed { value, compute: timed.compute })
            }
            Some(Err(missing)) => Err(Error::missing(missing)),
            None => Err(Error::internal("NOT_A_PLAN", &id.to_string())),
        }
    }

    /// `Precompute`. It answers when it is done: an operation is its artifact.
    pub(crate) async fn precompute(
        &self,
        ask: PrecomputeCall,
        call: &Call,
    ) -> Result<OperationAnswer, Error> {
        if ask.validate_only {
            let (id, _) = self.validate(ask.problem, call).await?.value;
            return Ok(OperationAnswer::Validated { id });
        }
        let id = record::problem_id(&ask.problem);
        Ok(operation(id, self.obtain(id, ask.problem, call).await?))
    }

    /// `GetArtifact`.
    pub(crate) async fn artifact(
        &self,
        ask: ArtifactCall,
        call: &Call,
    ) -> Result<ArtifactAnswer, Error> {
        self.load(Shelf::Artifacts, ask.id, call).await
    }

    /// `GetOperation` and `WaitOperation`: there is nothing to wait for, because
    /// [`Service::precompute`] answers when it is done.
    pub(crate) async fn operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<OperationAnswer, Error> {
        match self.cache.get(&(Shelf::Artifacts, ask.id)) {
            Some(outcome) => Ok(operation(ask.id, outcome)),
            None => match self.load(Shelf::Artifacts, ask.id, call).await {
                Ok(loaded) => Ok(OperationAnswer::Made(loaded)),
                Err(error) if error.code == Code::NotFound => Err(Error::new(
                    Code::NotFound,
                    "OPERATION_UNKNOWN",
                    format!("operation operations/{} is not known", ask.id),
                )),
                Err(error) => Err(error),
            },
        }
    }

    /// `ListOperations`: every stored artifact is a finished operation.
    pub(crate) async fn operations(
        &self,
        ask: OperationsCall,
        call: &Call,
    ) -> Result<OperationsAnswer, Error> {
        let (ids, next) = self.page(Shelf::Artifacts, ask.after, ask.page_size, call).await?;
        let mut operations = Vec::with_capacity(ids.len());
        for id in ids {
            let loaded = self.load(Shelf::Artifacts, id, call).await?;
            operations.push(OperationAnswer::Made(loaded));
        }
        Ok(OperationsAnswer { operations, next })
    }

    /// Ids of one page of a shelf, and where the next page begins.
    async fn page(
        &self,
        shelf: Shelf,
        after: Option<ArtifactId>,
        page_size: usize,
        call: &Call,
    ) -> Result<(Vec<ArtifactId>, Option<ArtifactId>), Error> {
        let store = Arc::clone(&self.store);
        let list =
            move |_: Budget<'_>| store.list(shelf, after.as_ref().map(|id| &id.0), page_size + 1);
        let mut ids = self.compute.run("list", call.deadline, list).await?.value?;
        let more = ids.len() > page_size;
        ids.truncate(page_size);
        let next = ids.last().filter(|_| more).map(|id| ArtifactId(*id));
        Ok((ids.into_iter().map(ArtifactId).collect(), next))
    }

    /// `CancelOperation`: an operation that can be named is done, and success promises nothing
    /// (AIP-151).
    pub(crate) async fn cancel_operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<(), Error> {
        self.operation(ask, call).await.map(|_| ())
    }

    /// `DeleteOperation`: an operation has no record apart from its artifact, which must stay for
    /// the steps that name it.
    pub(crate) async fn delete_operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<(), Error> {
        self.operation(ask, call).await?;
        Err(Error::new(
            Code::Unimplemented,
            "OPERATION_IS_ITS_ARTIFACT",
            "an operation has no record apart from its artifact, and artifacts are not deleted",
        ))
    }

    /// Decides one step on a compute thread: state in, step, state out.
    async fn decide(
        &self,
        artifact: Loaded,
        state: StateSource,
        measurement: ElapsedAndState,
        omit_prediction: bool,
        call: &Call,
    ) -> Result<Timed<DecidedStep>, Error> {
        let work = move |budget: Budget<'_>| -> Result<DecidedStep, Error> {
            let state = match state {
                StateSource::Decoded(state) => *state,
                StateSource::Envelope(bytes) => load_state(&artifact, &bytes)?,
            };
            let step = artifact.artifact.step(&state, &measurement, budget);
            let step = step.map_err(|fault: StepError| Error::step("measurement", fault))?;
            let controller_state = seal_state(&artifact, &step.next());
            let provenance = artifact.provenance;
            Ok(DecidedStep { provenance, step, controller_state, omit_prediction })
        };
        let timed = self.compute.run("step", call.deadline, work).await?;
        let answer = timed.value?;
        self.count(answer.step.work());
        let outcome = match answer.step.kind() {
            VerdictKind::Command => "command",
            VerdictKind::Abort => "abort",
            VerdictKind::Arrived => "arrived",
            VerdictKind::Infeasible => "infeasible",
        };
        if answer.step.kind() == VerdictKind::Command {
            self.withhold_unless(answer.step.may_leave(), answer.step.certificate())?;
        }
        self.metrics.verdicts.get_or_create(&OutcomeLabels { outcome }).inc();
        Ok(Timed { value: answer, compute: timed.compute })
    }

    /// The artifact a step is to use.
    async fn controller(&self, controller: Controller, call: &Call) -> Result<Found, Error> {
        match controller {
            Controller::Artifact(id) => {
                self.load(Shelf::Artifacts, id, call).await.map(Found::Controller)
            }
            Controller::Plan(id) => self.load(Shelf::Plans, id, call).await.map(Found::Controller),
            Controller::Problem(problem) => {
                let id = record::problem_id(&problem);
                match self.obtain(id, problem, call).await? {
                    Outcome::Made(loaded) => Ok(Found::Controller(loaded)),
                    Outcome::Infeasible(problem, why) => {
                        let provenance = provenance(problem.method(), id, String::new());
                        let provenance = Arc::new(provenance);
                        Ok(Found::None(StepAnswer::NoController { problem, why, provenance }))
                    }
                }
            }
        }
    }

    /// What stands on a shelf.
    async fn load(&self, shelf: Shelf, id: ArtifactId, call: &Call) -> Result<Loaded, Error> {
        if let Some(Outcome::Made(loaded)) = self.cache.get(&(shelf, id)) {
            self.looked_up("hit");
            return Ok(loaded);
        }
        let store = Arc::clone(&self.store);
        let work = move |_: Budget<'_>| stored(&*store, shelf, id);
        let Some(loaded) = self.compute.run("load", call.deadline, work).await?.value? else {
            self.looked_up("unknown");
            let (reason, message) = match shelf {
                Shelf::Artifacts => {
                    ("ARTIFACT_UNKNOWN", format!("artifact {id} is not known; Precompute makes it"))
                }
                Shelf::Plans => ("PLAN_UNKNOWN", format!("plan {id} is not kept here")),
            };
            return Err(Error::new(Code::NotFound, reason, message));
        };
        self.looked_up("loaded");
        Ok(self.remember(shelf, loaded))
    }

    /// Keeps what was loaded in memory for a while.
    fn remember(&self, shelf: Shelf, loaded: Loaded) -> Loaded {
        self.cache.insert((shelf, loaded.id), Outcome::Made(loaded.clone()));
        loaded
    }

    /// What a precompute of `problem`, whose id is `id`, comes to: remembered, stored, or computed
    /// and stored.
    async fn obtain(
        &self,
        id: ArtifactId,
        problem: Problem,
        call: &Call,
    ) -> Result<Outcome, Error> {
        let key = (Shelf::Artifacts, id);
        if let Some(outcome) = self.cache.get(&key) {
            self.looked_up("hit");
            return Ok(outcome);
        }
        let store = Arc::clone(&self.store);
        let work = move |budget: Budget<'_>| -> Result<(Outcome, &'static str), Error> {
            if let Some(loaded) = stored(&*store, Shelf::Artifacts, id)? {
                return Ok((Outcome::Made(loaded), "loaded"));
            }
            let artifact = match problem.prepare(budget) {
                Ok(artifact) => artifact,
                Err(PrepareError::Infeasible(why)) => {
                    return Ok((Outcome::Infeasible(problem, Arc::new(why)), "computed"));
                }
                Err(fault) => {
                    return Err(Error::prepare(&problem_path(problem.method()), fault));
                }
            };
            keep(&*store, id, artifact).map(|loaded| (Outcome::Made(loaded), "computed"))
        };
        let timed = self.compute.run("precompute", call.deadline, work).await?;
        let (outcome, source) = timed.value.inspect_err(|error| {
            if error.reason == CONFLICT {
                self.metrics.artifact_conflicts.inc();
            }
        })?;
        self.looked_up(source);
        self.cache.insert(key, outcome.clone());
        Ok(outcome)
    }

    /// Finds every fault of a problem, those that only the mathematics sees included; keeps
    /// nothing.
    async fn validate(
        &self,
        problem: Problem,
        call: &Call,
    ) -> Result<Timed<(ArtifactId, Method)>, Error> {
        let (id, method) = (record::problem_id(&problem), problem.method());
        if self.cache.get(&(Shelf::Artifacts, id)).is_some() {
            return Ok(Timed { value: (id, method), compute: Duration::ZERO });
        }
        let work = move |budget: Budget<'_>| match problem.check(budget) {
            // That no controller exists is an answer to the request, not a fault in it.
            Ok(()) | Err(PrepareError::Infeasible(_)) => Ok(()),
            Err(fault) => Err(Error::prepare(&problem_path(method), fault)),
        };
        let timed = self.compute.run("validate", call.deadline, work).await?;
        timed.value?;
        Ok(Timed { value: (id, method), compute: timed.compute })
    }

    /// An answer whose certificate did not pass never leaves as a proved answer.
    fn withhold_unless(
        &self,
        may_leave: bool,
        certificate: Option<&Certificate>,
    ) -> Result<(), Error> {
        if may_leave {
            return Ok(());
        }
        self.metrics.certificate_failures.inc();
        let detail = format!("{certificate:?}");
        Err(Error::internal("CERTIFICATE_FAILED", &detail))
    }

    fn count(&self, work: SolverWork) {
        let count = |n: usize| u64::try_from(n).unwrap_or(u64::MAX);
        self.metrics.simplex_pivots.inc_by(count(work.simplex_pivots));
        self.metrics.general_solver_calls.inc_by(count(work.general_solver_calls));
    }

    fn planned(&self, outcome: &'static str) {
        self.metrics.plans.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    fn looked_up(&self, outcome: &'static str) {
        self.metrics.artifacts.get_or_create(&OutcomeLabels { outcome }).inc();
    }
}

const CONFLICT: &str = "ARTIFACT_CONFLICT";

fn operation(id: ArtifactId, outcome: Outcome) -> OperationAnswer {
    match outcome {
        Outcome::Made(loaded) => OperationAnswer::Made(loaded),
        Outcome::Infeasible(problem, why) => OperationAnswer::Infeasible { id, problem, why },
    }
}

fn provenance(method: Method, id: ArtifactId, content_sha256: String) -> Provenance {
    Provenance {
        method: method.name(),
        method_version: method.version(),
        artifact_id: id.to_string(),
        content_sha256,
    }
}

/// `id` is the name under which it was asked for: the problem's for an artifact, the content's for
/// a plan. Controller states are bound to it.
fn loaded(id: ArtifactId, artifact: Artifact, bytes: &[u8]) -> Loaded {
    let method = artifact.method();
    let problem = record::artifact_id(method, &artifact.canonical_problem());
    let provenance = provenance(method, problem, record::content_id(bytes).to_string());
    Loaded { id, artifact, provenance: Arc::new(provenance), size_bytes: bytes.len() }
}

fn kept_plan(loaded: Loaded) -> KeptPlanAnswer {
    let Loaded { id, artifact, provenance, size_bytes } = loaded;
    KeptPlanAnswer { id, plan: artifact, provenance, size_bytes }
}

/// Reads and checks what stands on a shelf under `id`.
fn stored(store: &dyn RecordStore, shelf: Shelf, id: ArtifactId) -> Result<Option<Loaded>, Error> {
    let Some(record) = store.get(shelf, &id.0)? else { return Ok(None) };
    match record::decode(shelf, id, &record) {
        Ok((artifact, bytes)) => Ok(Some(loaded(id, artifact, bytes))),
        Err(what) => {
            tracing::error!(%id, what, "unreadable record");
            let (reason, kind) = match shelf {
                Shelf::Artifacts => ("ARTIFACT_DAMAGED", "artifact"),
                Shelf::Plans => ("PLAN_DAMAGED", "plan"),
            };
            let message = format!("the record of {kind} {id} cannot be used: {what}");
            Err(Error::new(Code::DataLoss, reason, message))
        }
    }
}

/// Stores a new artifact. If another call was faster, both must have made the same bytes.
fn keep(store: &dyn RecordStore, id: ArtifactId, artifact: Artifact) -> Result<Loaded, Error> {
    put(store, Shelf::Artifacts, id, artifact)
}

/// Stores a plan under the digest of its content; the same plan twice is one plan.
fn keep_plan(store: &dyn RecordStore, plan: Artifact) -> Result<Loaded, Error> {
    let id = record::content_id(&plan.to_bytes());
    put(store, Shelf::Plans, id, plan)
}

fn put(
    store: &dyn RecordStore,
    shelf: Shelf,
    id: ArtifactId,
    artifact: Artifact,
) -> Result<Loaded, Error> {
    let bytes = artifact.to_bytes();
    let record = Bytes::from(record::encode(artifact.method(), &bytes));
    match store.put_if_absent(shelf, &id.0, record.clone())? {
        Put::Created => {}
        Put::Existing(existing) if existing == record => {}
        Put::Existing(_) => {
            return Err(Error::internal(CONFLICT, &format!("two contents for {id}")));
        }
    }
    Ok(loaded(id, artifact, &bytes))
}

/// Reads a controller state; an empty one means the start.
fn load_state(artifact: &Loaded, bytes: &[u8]) -> Result<State, Error> {
    if bytes.is_empty() {
        return Ok(artifact.artifact.start());
    }
    let envelope = ControllerState::decode(bytes)?;
    if envelope.artifact_id != artifact.id {
        return Err(StateFault::Artifact(envelope.artifact_id).into());
    }
    let state =
        State::from_bytes(envelope.method, envelope.payload).map_err(StateFault::Payload)?;
    let payload = state.step_index();
    if usize::try_from(envelope.step_index).ok() != Some(payload) {
        return Err(StateFault::StepIndex { envelope: envelope.step_index, payload }.into());
    }
    Ok(state)
}

/// Writes a controller state.
fn seal_state(artifact: &Loaded, state: &State) -> Bytes {
    let payload = state.to_bytes();
    ControllerState {
        method: artifact.artifact.method(),
        artifact_id: artifact.id,
        step_index: u32::try_from(state.step_index()).unwrap_or(u32::MAX),
        payload: &payload,
    }
    .encode()
}
