//! The service: what each call means, whatever it came over.

#[cfg(test)]
mod aftermath;
mod artifacts;
mod cache;
mod clock;
mod error;
#[cfg(test)]
mod full_disk;
mod jobs;
mod leases;
mod operations;
mod record;
mod session;
mod shelves;

use std::{
    io,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use tokio::sync::Semaphore;
use vbar_guidance::{
    Budget, Method,
    control::{Certificate, Claim, PrepareError, StepError},
};

pub(crate) use crate::compute::Timed;
pub(crate) use error::{Code, Error};
pub(crate) use session::{Session, SessionAnswer};

pub(crate) use artifacts::Range;
#[cfg(feature = "fuzzing")]
pub(crate) use jobs::stored as stored_jobs;
#[cfg(feature = "fuzzing")]
pub(crate) use leases::rewritten as lease_rewritten;
pub(crate) use operations::Watching;
#[cfg(feature = "fuzzing")]
pub(crate) use record::{decode as decode_record, encode as encode_record};

use crate::{
    access::Caller,
    compute::{Compute, Task, Terms},
    config::Config,
    store::{Shared, Shelf, Store, StoreError},
    telemetry::{ClaimLabels, Metrics, OutcomeLabels},
    wire::{
        Artifact, ArtifactId, Controller, ControllerState, DecidedStep, Document, ElapsedAndState,
        ExportCall, InTime, InfoAnswer, InfoCall, KeptPlanAnswer, KeptPlanCall, Limits, PlanAnswer,
        PlanCall, PlanResult, PlanVerdict, PlansAnswer, PlansCall, Problem, ReportAnswer,
        ReportCall, SolverWork, State, StateFault, StepAnswer, StepCall, StoredArtifact,
        UploadAnswer, UploadCall, VerdictKind,
    },
};
use cache::{Cache, Outcome};
use clock::Clock;
use jobs::{Fleet, JobLimits, Jobs, Single};
use leases::Leases;
use operations::Precompute;
use session::StateSource;
use shelves::{Shelves, provenance};

/// Where a problem's own message stands in every request that carries one.
fn problem_path(method: Method) -> String {
    format!("problem.{}", method.name())
}

/// Whether a caller can use what is certified but not the problem's artifact, when time is short.
///
/// A plan can be flown whatever else its problem has. A step's controller state goes on to the next
/// step, whose artifact must be the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Haste {
    Welcome,
    Refused,
}

/// In the count of artifacts: there was no time for one.
const CUT_SHORT: &str = "cut_short";

/// A decoded artifact with where it comes from.
type Loaded = StoredArtifact;

/// The controller that a step names, or the answer that there is none.
enum Found {
    Controller(Loaded),
    None(StepAnswer),
}

/// What a call brings besides its message.
#[derive(Debug, Clone)]
pub(crate) struct Call {
    /// Who asks.
    pub(crate) caller: Caller,
    /// When an answer is no longer of use.
    pub(crate) deadline: Instant,
}

impl Call {
    /// What compute threads need to know of it.
    fn terms(&self) -> Terms {
        Terms { caller: Arc::clone(self.caller.name()), deadline: self.deadline }
    }

    /// When to answer with what there is, so that it still arrives in time.
    fn answer_by(&self) -> Instant {
        let left = self.deadline.saturating_duration_since(Instant::now());
        self.deadline - (left / 10).min(Duration::from_millis(500))
    }
}

/// A store that was opened.
#[derive(Debug, Clone)]
pub(crate) enum OpenStore {
    /// This process has it for itself.
    Own(Arc<dyn Store>),
    /// Others use it too.
    Shared(Arc<dyn Shared>),
}

/// The service.
#[derive(Debug)]
pub(crate) struct Service {
    compute: Compute,
    shelves: Arc<Shelves>,
    jobs: Arc<dyn Jobs<Precompute>>,
    watching: Arc<Semaphore>,
    precompute_wait: Duration,
    metrics: Arc<Metrics>,
    info: InfoAnswer,
}

impl Service {
    /// A service that computes with `compute` and keeps what it makes in `store`. Goes on with the
    /// jobs that the store remembers. Blocks on the store.
    ///
    /// # Errors
    /// If the store cannot be read or the system gives no thread for jobs.
    pub(crate) fn open(
        compute: Compute,
        store: OpenStore,
        config: &Config,
        metrics: Arc<Metrics>,
        info: InfoAnswer,
    ) -> io::Result<Self> {
        let (term, bytes_max) = (config.artifact_lifetime, config.artifact_bytes_max);
        let kept: Arc<dyn Store> = match &store {
            OpenStore::Own(store) => Arc::clone(store),
            OpenStore::Shared(store) => Arc::clone(store) as _,
        };
        let is_shared = matches!(store, OpenStore::Shared(_));
        let clock = Arc::new(Clock::of_system());
        let leases =
            Leases::open(Arc::clone(&kept), Arc::clone(&clock), term, bytes_max, is_shared)
                .map_err(io::Error::other)?;
        let shelves = Arc::new(Shelves {
            store: kept,
            cache: Cache::new(config.cache_bytes_max),
            leases,
            metrics: Arc::clone(&metrics),
        });
        let limits = JobLimits {
            threads: config.job_threads,
            unfinished_max: config.jobs_unfinished_max,
            time_max: config.job_time_max,
            attempts_max: config.job_attempts_max,
            kept_for: config.operation_lifetime,
        };
        let restore = {
            let (limits, shelves) = (info.limits, Arc::clone(&shelves));
            move |id, problem: &[u8]| Precompute::again(id, problem, &limits, &shelves)
        };
        let counts = Arc::clone(&metrics);
        let jobs: Arc<dyn Jobs<Precompute>> = match store {
            OpenStore::Own(store) => Arc::new(Single::open(store, clock, limits, counts, restore)?),
            OpenStore::Shared(store) => {
                Arc::new(Fleet::open(store, clock, limits, counts, Box::new(restore))?)
            }
        };
        let watching = Arc::new(Semaphore::new(config.watchers_max));
        let precompute_wait = config.precompute_wait;
        Ok(Self { compute, shelves, jobs, watching, precompute_wait, metrics, info })
    }

    /// Writes down and removes what time has changed. Blocks on the store.
    pub(crate) fn sweep(&self) {
        for id in self.shelves.leases.sweep() {
            self.shelves.cache.forget(&(Shelf::Artifacts, id));
            self.metrics.artifacts_expired.inc();
            tracing::info!(%id, "artifact expired");
        }
        self.jobs.sweep();
    }

    /// Hands back what jobs are at and lets nobody wait any longer. Blocks on the store, and on
    /// threads that are slow to stop for at most `grace`.
    pub(crate) fn stop(&self, grace: Duration) {
        self.jobs.stop(grace);
    }

    /// Why calls that need the store would not be answered, if they would not.
    pub(crate) async fn store_fault(&self) -> Option<String> {
        let store = Arc::clone(&self.shelves.store);
        let reached = tokio::task::spawn_blocking(move || store.reach());
        match reached.await {
            Ok(Ok(())) => None,
            // Whoever asks need not be known: paths are for the log.
            Ok(Err(fault @ StoreError::Io { .. })) => {
                tracing::error!(%fault, "store");
                Some("the store cannot be written".to_owned())
            }
            Ok(Err(fault)) => Some(fault.to_string()),
            Err(fault) => Some(fault.to_string()),
        }
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
        let timed = self.compute.run(Task::SafetyReport, &call.terms(), work).await?;
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
        let loaded = match self.obtain(id, ask.problem, Haste::Welcome, call).await? {
            Outcome::Made(loaded) => loaded,
            Outcome::Infeasible(problem, why) => {
                self.planned("infeasible");
                let provenance = Arc::new(provenance(method, id, String::new()));
                let outcome = Some(PlanResult::NoController(problem, why));
                let value = PlanAnswer { provenance, outcome, plan_id: None };
                return Ok(Timed { value, compute: Duration::ZERO });
            }
        };
        let (artifact, shelves) = (loaded.artifact, Arc::clone(&self.shelves));
        let initial = ask.initial;
        let work = move |budget: Budget<'_>| -> Result<(PlanVerdict, Option<Loaded>), Error> {
            let verdict = artifact.plan(initial.as_ref(), budget);
            let verdict = verdict.map_err(|fault| Error::step("initial", fault))?;
            let sound = verdict.certificate.as_ref().is_none_or(|certificate| certificate.passed);
            let kept = (sound && artifact.is_plan()).then(|| shelves.keep_plan(&artifact, budget));
            Ok((verdict, kept.transpose()?))
        };
        let timed = self.compute.run(Task::Plan.of(method), &call.terms(), work).await?;
        let (verdict, kept) = timed.value?;
        self.count(verdict.work);
        if let Some(certificate) = &verdict.certificate {
            self.withhold_unless(certificate.passed, Some(certificate))?;
        }
        self.planned(if verdict.is_infeasible() { "infeasible" } else { "computed" });
        let plan_id = kept.map(|plan| self.shelves.remember(Shelf::Plans, plan).id);
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
        let shelves = Arc::clone(&self.shelves);
        let UploadCall { candidate, validate_only } = ask;
        let work = move |budget: Budget<'_>| -> Result<(Artifact, Option<Loaded>), Error> {
            let plan = candidate.verify_within(budget)?;
            let kept = (!validate_only).then(|| shelves.keep_plan(&plan, budget));
            Ok((plan, kept.transpose()?))
        };
        let timed = self.compute.run(Task::Verify, &call.terms(), work).await?;
        let (plan, kept) = timed.value.inspect_err(|_| self.planned("refused"))?;
        self.planned("uploaded");
        let plan_id = kept.map(|plan| self.shelves.remember(Shelf::Plans, plan).id);
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
        let work = move |budget: Budget<'_>| plan.export_within(&id.to_string(), &order, budget);
        let timed = self.compute.run(Task::Export, &call.terms(), work).await?;
        match timed.value {
            Some(Ok(value)) => {
                self.planned("exported");
                Ok(Timed { value, compute: timed.compute })
            }
            Some(Err(unwritten)) => Err(unwritten.into()),
            None => Err(Error::internal("NOT_A_PLAN", &id.to_string())),
        }
    }

    /// Ids of one page of a shelf, and where the next page begins.
    async fn page(
        &self,
        shelf: Shelf,
        after: Option<ArtifactId>,
        page_size: usize,
        call: &Call,
    ) -> Result<(Vec<ArtifactId>, Option<ArtifactId>), Error> {
        let shelves = Arc::clone(&self.shelves);
        let list = move |_: Budget<'_>| {
            shelves.store.list(shelf, after.as_ref().map(|id| &id.0), page_size + 1)
        };
        let mut ids = self.compute.run(Task::List, &call.terms(), list).await?.value?;
        let more = ids.len() > page_size;
        ids.truncate(page_size);
        let next = ids.last().filter(|_| more).map(|id| ArtifactId(*id));
        Ok((ids.into_iter().map(ArtifactId).collect(), next))
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
        let (id, method) = (artifact.id, artifact.artifact.method());
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
        let timed = self.compute.run(Task::Step.of(method), &call.terms(), work).await?;
        let answer = timed.value?;
        self.shelves.leases.extend(id);
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
        if let Some(certificate) = answer.step.certificate() {
            let labels = ClaimLabels { claim: claim_name(certificate.claim) };
            self.metrics.commands.get_or_create(&labels).inc();
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
                match self.obtain(id, problem, Haste::Refused, call).await? {
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
        if let Some(Outcome::Made(loaded)) = self.shelves.cache.get(&(shelf, id)) {
            self.shelves.looked_up("hit");
            return Ok(loaded);
        }
        let shelves = Arc::clone(&self.shelves);
        let work = move |budget: Budget<'_>| shelves.stored(shelf, id, budget);
        let Some(loaded) = self.compute.run(Task::Load, &call.terms(), work).await?.value? else {
            self.shelves.looked_up("unknown");
            let (reason, message) = match shelf {
                Shelf::Artifacts => {
                    ("ARTIFACT_UNKNOWN", format!("artifact {id} is not known; Precompute makes it"))
                }
                Shelf::Plans => ("PLAN_UNKNOWN", format!("plan {id} is not kept here")),
                Shelf::Problems | Shelf::Shards => {
                    ("RECORD_UNKNOWN", format!("{id} is not among {}", shelf.name()))
                }
            };
            return Err(Error::new(Code::NotFound, reason, message));
        };
        self.shelves.looked_up("loaded");
        Ok(self.shelves.remember(shelf, loaded))
    }

    /// What a precompute of `problem`, whose id is `id`, comes to: remembered, stored, or computed
    /// and stored.
    async fn obtain(
        &self,
        id: ArtifactId,
        problem: Problem,
        haste: Haste,
        call: &Call,
    ) -> Result<Outcome, Error> {
        let (key, method) = ((Shelf::Artifacts, id), problem.method());
        if let Some(outcome) = self.shelves.cache.get(&key) {
            self.shelves.looked_up("hit");
            return Ok(outcome);
        }
        let shelves = Arc::clone(&self.shelves);
        let work = move |budget: Budget<'_>| -> Result<(Outcome, &'static str), Error> {
            if let Some(loaded) = shelves.stored(Shelf::Artifacts, id, budget)? {
                return Ok((Outcome::Made(loaded), "loaded"));
            }
            let prepared = match haste {
                Haste::Welcome => problem.prepare_in_time(budget),
                Haste::Refused => {
                    problem.prepare(budget).map(|artifact| InTime { artifact, is_cut_short: false })
                }
            };
            match prepared {
                Ok(InTime { artifact, is_cut_short: false }) => {
                    match shelves.keep(id, &artifact, budget) {
                        // No step waits for somebody to make room; the node's memory keeps it
                        // meanwhile.
                        Err(Error { reason: error::STORE_FULL, .. }) => {
                            let loaded = shelves::unkept(id, &artifact, budget)?;
                            Ok((Outcome::Made(loaded), "unkept"))
                        }
                        kept => kept.map(|loaded| (Outcome::Made(loaded), "computed")),
                    }
                }
                Ok(InTime { artifact, is_cut_short: true }) => {
                    let unkept = shelves::unkept(id, &artifact, budget);
                    unkept.map(|loaded| (Outcome::Made(loaded), CUT_SHORT))
                }
                Err(PrepareError::Infeasible(why)) => {
                    Ok((Outcome::Infeasible(problem, Arc::new(why)), "computed"))
                }
                Err(fault) => Err(Error::prepare(&problem_path(problem.method()), fault)),
            }
        };
        let timed = self.compute.run(Task::Precompute.of(method), &call.terms(), work).await?;
        let (outcome, source) = timed.value?;
        self.shelves.looked_up(source);
        if source != CUT_SHORT {
            self.shelves.cache.insert(key, outcome.clone());
        }
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
        if self.shelves.cache.get(&(Shelf::Artifacts, id)).is_some() {
            return Ok(Timed { value: (id, method), compute: Duration::ZERO });
        }
        let work = move |budget: Budget<'_>| match problem.check(budget) {
            // That no controller exists is an answer to the request, not a fault in it.
            Ok(()) | Err(PrepareError::Infeasible(_)) => Ok(()),
            Err(fault) => Err(Error::prepare(&problem_path(method), fault)),
        };
        let timed = self.compute.run(Task::Validate.of(method), &call.terms(), work).await?;
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
}

/// In the count of commands.
fn claim_name(claim: Claim) -> &'static str {
    match claim {
        Claim::Global => "global",
        Claim::GlobalToHorizonMax => "global_to_horizon_max",
        Claim::LocalInHorizon => "local_in_horizon",
        Claim::FixedHorizon => "fixed_horizon",
        Claim::Feasible => "feasible",
        Claim::PreviousPlanTail => "previous_plan_tail",
    }
}

fn kept_plan(loaded: Loaded) -> KeptPlanAnswer {
    let Loaded { id, artifact, provenance, size_bytes } = loaded;
    KeptPlanAnswer { id, plan: artifact, provenance, size_bytes }
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
