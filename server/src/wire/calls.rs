//! The service's calls: what each asks and answers.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use vbar_guidance::{Method, control::Infeasibility};
use vbar_proto::{google::longrunning, v1};

use super::{
    Artifact, ArtifactId, Candidate, Claimed, Door, ElapsedAndState, Limits, Order, Parse, Path,
    PlanVerdict, Planning, Problem, Provenance, Render, Step, count, types::BUILD_VERSION,
};

/// Which controller decides.
#[derive(Debug)]
pub(crate) enum Controller {
    /// One that a precompute made.
    Artifact(ArtifactId),
    /// A kept plan.
    Plan(ArtifactId),
    /// The mission itself.
    Problem(Problem),
}

/// `Step`.
#[derive(Debug)]
pub(crate) struct StepCall {
    pub(crate) controller: Controller,
    pub(crate) controller_state: Bytes,
    pub(crate) measurement: ElapsedAndState,
    pub(crate) omit_prediction: bool,
}

impl Parse for StepCall {
    type Message = v1::StepRequest;

    fn parse(message: &v1::StepRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::step_request::Controller as Message;
        let controller = match &message.controller {
            None => door.refuse(path.field("controller"), CONTROLLER, "nothing"),
            Some(Message::ArtifactId(id)) => {
                ArtifactId::parse(id, path.field("artifact_id"), door).map(Controller::Artifact)
            }
            Some(Message::Problem(problem)) => {
                Problem::parse(problem, path.field("problem"), door).map(Controller::Problem)
            }
            Some(Message::PlanId(id)) => {
                ArtifactId::parse(id, path.field("plan_id"), door).map(Controller::Plan)
            }
        };
        let measurement = door.message(&message.measurement, path.field("measurement"));
        Some(Self {
            controller: controller?,
            controller_state: message.controller_state.clone(),
            measurement: measurement?,
            omit_prediction: message.omit_prediction,
        })
    }
}

const CONTROLLER: &str = "one of artifact_id, problem, plan_id";

/// One message of `StepStream`.
#[derive(Debug)]
pub(crate) struct StreamCall {
    pub(crate) controller: Option<Controller>,
    pub(crate) controller_state: Option<Bytes>,
    pub(crate) measurement: Option<ElapsedAndState>,
    pub(crate) omit_prediction: bool,
}

impl Parse for StreamCall {
    type Message = v1::StepStreamRequest;

    fn parse(message: &v1::StepStreamRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::step_stream_request::Controller as Message;
        let controller = match &message.controller {
            None => Some(None),
            Some(Message::ArtifactId(id)) => ArtifactId::parse(id, path.field("artifact_id"), door)
                .map(|id| Some(Controller::Artifact(id))),
            Some(Message::Problem(problem)) => Problem::parse(problem, path.field("problem"), door)
                .map(|problem| Some(Controller::Problem(problem))),
            Some(Message::PlanId(id)) => ArtifactId::parse(id, path.field("plan_id"), door)
                .map(|id| Some(Controller::Plan(id))),
        };
        let measurement = door.optional(&message.measurement, path.field("measurement"));
        Some(Self {
            controller: controller?,
            controller_state: message.controller_state.clone(),
            measurement: measurement?,
            omit_prediction: message.omit_prediction,
        })
    }
}

/// Answer of `Step` and of one message of `StepStream`.
#[derive(Debug)]
pub(crate) enum StepAnswer {
    /// The controller decided.
    Decided(DecidedStep),
    /// No controller exists for the problem that came with the step.
    NoController { problem: Problem, why: Arc<Infeasibility>, provenance: Arc<Provenance> },
}

/// A decision of a controller.
#[derive(Debug)]
pub(crate) struct DecidedStep {
    pub(crate) provenance: Arc<Provenance>,
    pub(crate) step: Step,
    pub(crate) controller_state: Bytes,
    pub(crate) omit_prediction: bool,
}

impl Render for StepAnswer {
    type Message = v1::StepResponse;

    fn render(&self) -> v1::StepResponse {
        match self {
            Self::Decided(decided) => v1::StepResponse {
                controller_state: decided.controller_state.clone(),
                provenance: Some(decided.provenance.render()),
                ..decided.step.render(decided.omit_prediction)
            },
            Self::NoController { problem, why, provenance } => v1::StepResponse {
                verdict: Some(v1::step_response::Verdict::Infeasible(
                    problem.render_infeasible(why),
                )),
                provenance: Some(provenance.render()),
                ..v1::StepResponse::default()
            },
        }
    }
}

/// `ComputePlan`.
#[derive(Debug)]
pub(crate) struct PlanCall {
    pub(crate) problem: Problem,
    /// There if the method wants it.
    pub(crate) initial: Option<ElapsedAndState>,
    pub(crate) validate_only: bool,
}

impl Parse for PlanCall {
    type Message = v1::ComputePlanRequest;

    fn parse(message: &v1::ComputePlanRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let problem = door.message(&message.problem, path.field("problem"));
        let place = path.field("initial");
        let planning = message.problem.as_ref().and_then(Problem::planning);
        let initial = match (planning, &message.initial) {
            (Some(Planning::IsArtifact), Some(_)) => {
                door.refuse(place, "nothing: the problem has its initial state", "a measurement")
            }
            (Some(Planning::IsArtifact), None) => Some(None),
            (Some(Planning::Stepwise), _) => {
                let expected = "a method that plans: variable_horizon, disturbance_feedback";
                door.refuse(path.field("problem"), expected, "one that decides step by step")
            }
            (_, initial) => door.message(initial, place).map(Some),
        };
        Some(Self { problem: problem?, initial: initial?, validate_only: message.validate_only })
    }
}

/// Answer of `ComputePlan`.
#[derive(Debug)]
pub(crate) struct PlanAnswer {
    pub(crate) provenance: Arc<Provenance>,
    /// `None` if only validated.
    pub(crate) outcome: Option<PlanResult>,
    /// Of the plan, if it was kept.
    pub(crate) plan_id: Option<ArtifactId>,
}

/// What came of a plan.
#[derive(Debug)]
pub(crate) enum PlanResult {
    /// The controller exists; the verdict says whether a plan does.
    Decided(Box<PlanVerdict>),
    /// Already the controller does not exist.
    NoController(Problem, Arc<Infeasibility>),
}

impl Render for PlanAnswer {
    type Message = v1::ComputePlanResponse;

    fn render(&self) -> v1::ComputePlanResponse {
        use v1::compute_plan_response::Outcome;
        let outcome = self.outcome.as_ref().map(|outcome| match outcome {
            PlanResult::Decided(verdict) => verdict.outcome.clone(),
            PlanResult::NoController(problem, why) => {
                Outcome::Infeasible(problem.render_infeasible(why))
            }
        });
        v1::ComputePlanResponse {
            provenance: Some(self.provenance.render()),
            outcome,
            plan_id: self.plan_id.map(|id| id.to_string()).unwrap_or_default(),
        }
    }
}

/// `UploadPlan`.
#[derive(Debug)]
pub(crate) struct UploadCall {
    pub(crate) candidate: Candidate,
    pub(crate) validate_only: bool,
}

impl Parse for UploadCall {
    type Message = v1::UploadPlanRequest;

    fn parse(message: &v1::UploadPlanRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::upload_plan_request::Content;
        let candidate = match &message.content {
            None => door.refuse(path, "one of document, binary", "nothing"),
            Some(Content::Document(document)) => {
                Claimed::parse(document, path.field("document"), door)
                    .map(|claimed| Candidate::Document(Box::new(claimed)))
            }
            Some(Content::Binary(bytes)) => Some(Candidate::Binary(bytes.clone())),
        };
        Some(Self { candidate: candidate?, validate_only: message.validate_only })
    }
}

/// Answer of `UploadPlan`.
#[derive(Debug)]
pub(crate) struct UploadAnswer {
    pub(crate) plan: Artifact,
    /// `None` if only validated.
    pub(crate) plan_id: Option<ArtifactId>,
}

impl Render for UploadAnswer {
    type Message = v1::UploadPlanResponse;

    fn render(&self) -> v1::UploadPlanResponse {
        v1::UploadPlanResponse {
            plan_id: self.plan_id.map(|id| id.to_string()).unwrap_or_default(),
            certificate: self.plan.render_plan_certificate(),
        }
    }
}

/// `GetPlan`.
#[derive(Debug)]
pub(crate) struct KeptPlanCall {
    pub(crate) id: ArtifactId,
}

impl Parse for KeptPlanCall {
    type Message = v1::GetPlanRequest;

    fn parse(message: &v1::GetPlanRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        ArtifactId::parse(&message.plan_id, path.field("plan_id"), door).map(|id| Self { id })
    }
}

/// A kept plan: of `GetPlan`, and a line of `ListPlans`.
#[derive(Debug)]
pub(crate) struct KeptPlanAnswer {
    pub(crate) id: ArtifactId,
    pub(crate) plan: Artifact,
    pub(crate) provenance: Arc<Provenance>,
    pub(crate) size_bytes: usize,
}

impl KeptPlanAnswer {
    fn line(&self) -> v1::PlanSummary {
        v1::PlanSummary {
            plan_id: self.id.to_string(),
            method: self.plan.method().name().to_owned(),
            size_bytes: i64::try_from(self.size_bytes).unwrap_or(i64::MAX),
            ..self.plan.render_line().unwrap_or_default()
        }
    }
}

impl Render for KeptPlanAnswer {
    type Message = v1::GetPlanResponse;

    fn render(&self) -> v1::GetPlanResponse {
        v1::GetPlanResponse {
            plan_id: self.id.to_string(),
            document: self.plan.render_document(),
            provenance: Some(self.provenance.render()),
        }
    }
}

/// `ListPlans`.
#[derive(Debug)]
pub(crate) struct PlansCall {
    pub(crate) page_size: usize,
    pub(crate) after: Option<ArtifactId>,
}

/// Plans on one page unless asked for fewer: each is read and checked again.
const PLANS_PAGE_SIZE: usize = 50;

impl Parse for PlansCall {
    type Message = v1::ListPlansRequest;

    fn parse(message: &v1::ListPlansRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let page_size = page_size(message.page_size, PLANS_PAGE_SIZE, path, door);
        let after = page_token(&message.page_token, path, door);
        Some(Self { page_size: page_size?, after: after? })
    }
}

/// AIP-158: 0 means the default, more than the most is cut to it.
fn page_size(given: i32, most: usize, path: Path<'_>, door: &mut Door) -> Option<usize> {
    match usize::try_from(given) {
        Ok(0) => Some(most),
        Ok(size) => Some(size.min(most)),
        Err(_) => door.refuse(path.field("page_size"), "at least 0", given),
    }
}

/// A token is the id that the page before it ended with.
#[allow(clippy::option_option, reason = "absent and wrong are different things here")]
fn page_token(token: &str, path: Path<'_>, door: &mut Door) -> Option<Option<ArtifactId>> {
    if token.is_empty() {
        return Some(None);
    }
    ArtifactId::from_hex(token).map(Some).or_else(|| {
        let shown: String = token.chars().take(100).collect();
        let expected = "a token from an earlier page";
        door.refuse(path.field("page_token"), expected, format!("{shown:?}"))
    })
}

/// Answer of `ListPlans`.
#[derive(Debug)]
pub(crate) struct PlansAnswer {
    pub(crate) plans: Vec<KeptPlanAnswer>,
    pub(crate) next: Option<ArtifactId>,
}

impl Render for PlansAnswer {
    type Message = v1::ListPlansResponse;

    fn render(&self) -> v1::ListPlansResponse {
        v1::ListPlansResponse {
            plans: self.plans.iter().map(KeptPlanAnswer::line).collect(),
            next_page_token: self.next.map(|id| id.to_string()).unwrap_or_default(),
        }
    }
}

/// `ExportPlan`.
#[derive(Debug)]
pub(crate) struct ExportCall {
    pub(crate) id: ArtifactId,
    pub(crate) order: Order,
}

impl Parse for ExportCall {
    type Message = v1::ExportPlanRequest;

    fn parse(message: &v1::ExportPlanRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let id = ArtifactId::parse(&message.plan_id, path.field("plan_id"), door);
        let order = Order::parse(message, path, door);
        Some(Self { id: id?, order: order? })
    }
}

/// `Precompute`.
#[derive(Debug)]
pub(crate) struct PrecomputeCall {
    pub(crate) problem: Problem,
    pub(crate) validate_only: bool,
}

impl Parse for PrecomputeCall {
    type Message = v1::PrecomputeRequest;

    fn parse(message: &v1::PrecomputeRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let problem = door.message(&message.problem, path.field("problem"));
        // An operation is named by its problem, so that a repeated request finds it anyway; the
        // request's own id needs no memory, only its form is checked (AIP-155).
        let request_id = &message.request_id;
        if !request_id.is_empty() && !is_uuid(request_id) {
            let shown: String = request_id.chars().take(80).collect();
            let path = path.field("request_id");
            return door.refuse(path, "a UUID or nothing", format!("{shown:?}"));
        }
        Some(Self { problem: problem?, validate_only: message.validate_only })
    }
}

fn is_uuid(text: &str) -> bool {
    text.len() == 36
        && text.bytes().enumerate().all(|(i, c)| match i {
            8 | 13 | 18 | 23 => c == b'-',
            _ => c.is_ascii_hexdigit(),
        })
}

/// `GetArtifact`.
#[derive(Debug)]
pub(crate) struct ArtifactCall {
    pub(crate) id: ArtifactId,
}

impl Parse for ArtifactCall {
    type Message = v1::GetArtifactRequest;

    fn parse(message: &v1::GetArtifactRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        ArtifactId::parse(&message.artifact_id, path.field("artifact_id"), door)
            .map(|id| Self { id })
    }
}

/// An artifact's summary.
#[derive(Debug, Clone)]
pub(crate) struct ArtifactAnswer {
    pub(crate) id: ArtifactId,
    pub(crate) artifact: Artifact,
    pub(crate) provenance: Arc<Provenance>,
    pub(crate) size_bytes: usize,
}

impl ArtifactAnswer {
    fn summary(&self) -> v1::Artifact {
        v1::Artifact {
            artifact_id: self.provenance.artifact_id.clone(),
            size_bytes: i64::try_from(self.size_bytes).unwrap_or(i64::MAX),
            provenance: Some(self.provenance.render()),
            summary: Some(self.artifact.render_summary()),
        }
    }
}

impl Render for ArtifactAnswer {
    type Message = v1::GetArtifactResponse;

    fn render(&self) -> v1::GetArtifactResponse {
        v1::GetArtifactResponse { artifact: Some(self.summary()) }
    }
}

/// An operation. It needs no record of its own: it is named by its artifact, and it is done as
/// soon as the artifact is stored.
#[derive(Debug)]
pub(crate) enum OperationAnswer {
    /// The artifact exists.
    Made(ArtifactAnswer),
    /// It cannot exist.
    Infeasible { id: ArtifactId, problem: Problem, why: Arc<Infeasibility> },
    /// The problem was only checked.
    Validated { id: ArtifactId },
}

impl Render for OperationAnswer {
    type Message = longrunning::Operation;

    fn render(&self) -> longrunning::Operation {
        use v1::precompute_response::Outcome;
        let (artifact_id, outcome) = match self {
            Self::Made(made) => {
                (made.provenance.artifact_id.clone(), Some(Outcome::Artifact(made.summary())))
            }
            Self::Infeasible { id, problem, why } => {
                (id.to_string(), Some(Outcome::Infeasible(problem.render_infeasible(why))))
            }
            Self::Validated { id } => (id.to_string(), None),
        };
        let done = outcome.is_some();
        let metadata = v1::PrecomputeMetadata {
            artifact_id: artifact_id.clone(),
            fraction_done: if done { 1.0 } else { 0.0 },
            phase: if done { "done" } else { "validated" }.to_owned(),
        };
        let response = outcome.map(|outcome| v1::PrecomputeResponse { outcome: Some(outcome) });
        longrunning::Operation {
            // A request that was only checked started nothing that could be asked for.
            name: if done { format!("operations/{artifact_id}") } else { String::new() },
            metadata: Some(any(&metadata)),
            done,
            result: response.map(|r| longrunning::operation::Result::Response(any(&r))),
        }
    }
}

fn any<M: prost::Name>(message: &M) -> prost_types::Any {
    prost_types::Any { type_url: M::type_url(), value: message.encode_to_vec() }
}

/// Names an operation: of `GetOperation`, `WaitOperation`, `CancelOperation`, `DeleteOperation`.
#[derive(Debug)]
pub(crate) struct OperationName {
    pub(crate) id: ArtifactId,
}

impl OperationName {
    fn read(name: &str, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let id = name.strip_prefix("operations/").and_then(ArtifactId::from_hex);
        id.map(|id| Self { id }).or_else(|| {
            let shown: String = name.chars().take(100).collect();
            let expected = "`operations/` and 64 lower-case hexadecimal digits";
            door.refuse(path, expected, format!("{shown:?}"))
        })
    }
}

macro_rules! named_operation {
    ($($message:ident),*) => {$(
        impl From<&longrunning::$message> for NamedBy {
            fn from(message: &longrunning::$message) -> Self {
                Self(message.name.clone())
            }
        }
    )*};
}

/// A request that names an operation and nothing else that matters.
#[derive(Debug)]
pub(crate) struct NamedBy(String);

impl NamedBy {
    /// By the id in a path.
    pub(crate) fn operation(id: &str) -> Self {
        Self(format!("operations/{id}"))
    }
}

named_operation!(
    GetOperationRequest,
    WaitOperationRequest,
    CancelOperationRequest,
    DeleteOperationRequest
);

impl Parse for OperationName {
    type Message = NamedBy;

    fn parse(message: &NamedBy, path: Path<'_>, door: &mut Door) -> Option<Self> {
        Self::read(&message.0, path.field("name"), door)
    }
}

/// `ListOperations`.
#[derive(Debug)]
pub(crate) struct OperationsCall {
    pub(crate) page_size: usize,
    pub(crate) after: Option<ArtifactId>,
}

/// Operations on one page unless asked for fewer.
const PAGE_SIZE: usize = 100;

impl Parse for OperationsCall {
    type Message = longrunning::ListOperationsRequest;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let mut refuse = |name, expected: &str, got: &str| -> Option<()> {
            let shown: String = got.chars().take(100).collect();
            door.refuse(path.field(name), expected, format!("{shown:?}"))
        };
        let collection = match message.name.as_str() {
            "" | "operations" => Some(()),
            other => refuse("name", "`operations`", other),
        };
        let filter = match message.filter.as_str() {
            "" => Some(()),
            other => refuse("filter", "nothing: filters are not offered", other),
        };
        let after = page_token(&message.page_token, path, door);
        let page_size = page_size(message.page_size, PAGE_SIZE, path, door);
        collection?;
        filter?;
        Some(Self { page_size: page_size?, after: after? })
    }
}

/// Answer of `ListOperations`.
#[derive(Debug)]
pub(crate) struct OperationsAnswer {
    pub(crate) operations: Vec<OperationAnswer>,
    pub(crate) next: Option<ArtifactId>,
}

impl Render for OperationsAnswer {
    type Message = longrunning::ListOperationsResponse;

    fn render(&self) -> Self::Message {
        longrunning::ListOperationsResponse {
            operations: self.operations.iter().map(Render::render).collect(),
            next_page_token: self.next.map(|id| id.to_string()).unwrap_or_default(),
        }
    }
}

/// `GetServerInfo`.
#[derive(Debug)]
pub(crate) struct InfoCall;

impl Parse for InfoCall {
    type Message = v1::GetServerInfoRequest;

    fn parse(_: &v1::GetServerInfoRequest, _: Path<'_>, _: &mut Door) -> Option<Self> {
        Some(Self)
    }
}

/// Answer of `GetServerInfo`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InfoAnswer {
    pub(crate) limits: Limits,
    pub(crate) request_bytes_max: usize,
    pub(crate) compute_threads: usize,
    pub(crate) computation_time_max: Duration,
}

impl Render for InfoAnswer {
    type Message = v1::GetServerInfoResponse;

    fn render(&self) -> v1::GetServerInfoResponse {
        let method = |method: Method| v1::MethodInfo {
            name: method.name().to_owned(),
            version: method.version().to_owned(),
        };
        v1::GetServerInfoResponse {
            build_version: BUILD_VERSION.to_owned(),
            methods: Method::ALL.into_iter().map(method).collect(),
            limits: Some(v1::Limits {
                request_bytes_max: i64::try_from(self.request_bytes_max).unwrap_or(i64::MAX),
                horizon_max: count(self.limits.horizon_max),
                generators_max: count(self.limits.generators_max),
                states_max: count(self.limits.states_max),
                inputs_max: count(self.limits.inputs_max),
                steps_max: count(self.limits.steps_max),
                polytope_rows_max: count(self.limits.polytope_rows_max),
                plan_instants_max: count(self.limits.plan_instants_max),
                report_states_max: count(self.limits.report_states_max),
                concurrent_computations_max: count(self.compute_threads),
                computation_time_max_s: self.computation_time_max.as_secs_f64(),
            }),
        }
    }
}
