//! The service's calls: what each asks and answers.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use vbar_guidance::{Method, control::Infeasibility};
use vbar_proto::v1;

use super::{
    Artifact, ArtifactId, Candidate, Claimed, Door, ElapsedAndState, Limits, Order, Parse, Path,
    PlanVerdict, Planning, Problem, Provenance, Render, Step,
    build::BUILD,
    count,
    paging::{page_size, page_token},
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
            build_version: BUILD.version.to_owned(),
            build: Some(BUILD.message()),
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
                sampled_rows_max: count(self.limits.sampled_rows_max),
                plant_vertices_max: count(self.limits.plant_vertices_max),
                problem_bytes_max: i64::try_from(self.limits.problem_bytes_max).unwrap_or(i64::MAX),
                concurrent_computations_max: count(self.compute_threads),
                computation_time_max_s: self.computation_time_max.as_secs_f64(),
            }),
        }
    }
}
