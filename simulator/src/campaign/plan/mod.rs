//! Campaigns of plans: a plan is computed once, kept by the node, and flown many times.

pub(crate) mod ellipsoid;
pub(crate) mod flight;

use std::{num::NonZeroUsize, sync::Arc};

use vbar_client::Client;
use vbar_proto::v1::{self, ArrivalMetric, compute_plan_response::Outcome};

use super::{Progress, SimulationError, concurrency, crew::Crew, flight::Patience};
use crate::{
    mission::{PlanChanges, PlanMission, RUNS_MAX, plan_model::PlanModel},
    report::plan::PlanReport,
};
use ellipsoid::Ellipsoid;
pub use flight::{FlownBurn, OpenLoopEnd, PlanFlight, PlanSample};

/// What to fly; the default flies the mission as its file says.
#[derive(Debug, Clone, Default)]
pub struct PlanRunOptions {
    /// Instead of the mission's number of runs.
    pub runs: Option<u32>,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Runs in flight at once, instead of twice what the server computes at once.
    pub concurrency: Option<NonZeroUsize>,
    /// Fly this variant alone.
    pub variant: Option<String>,
    /// Further changes of every problem flown.
    pub changes: PlanChanges,
    /// Compute also what only the pictures need: the mission's table.
    pub with_pictures: bool,
}

/// What came of asking for a plan.
#[derive(Debug, Clone, PartialEq)]
pub enum PlanAnswer {
    /// A plan, kept by the node.
    Plan(Box<Planned>),
    /// Why there is none.
    Infeasible(Box<v1::Infeasible>),
}

/// A plan and its name.
#[derive(Debug, Clone, PartialEq)]
pub struct Planned {
    /// Names it on the node.
    pub plan_id: String,
    /// Burns, gains, sets, proof.
    pub plan: v1::DisturbanceFeedbackPlan,
}

impl PlanAnswer {
    /// Reads the answer of a node.
    ///
    /// # Errors
    /// What the answer lacks.
    pub fn read(response: v1::ComputePlanResponse) -> Result<Self, String> {
        match response.outcome {
            Some(Outcome::Infeasible(why)) => Ok(Self::Infeasible(why.into())),
            None => Err("neither a plan nor a reason why there is none".into()),
            Some(Outcome::Plan(plan)) => {
                let plan = plan.disturbance_feedback.ok_or("a plan of another method")?;
                if response.plan_id.is_empty() {
                    return Err("a plan that was not kept".into());
                }
                Ok(Self::Plan(Planned { plan_id: response.plan_id, plan }.into()))
            }
        }
    }

    /// The plan, if there is one.
    #[must_use]
    pub fn plan(&self) -> Option<&Planned> {
        match self {
            Self::Plan(planned) => Some(planned),
            Self::Infeasible(_) => None,
        }
    }
}

/// A mission (or variant) with what came of asking for its plan.
#[derive(Debug, Clone)]
pub struct PlanRow {
    /// What was asked.
    pub mission: PlanMission,
    /// What was answered.
    pub answer: PlanAnswer,
}

/// A plan and its flights; no flights where there is no plan.
#[derive(Debug, Clone)]
pub struct PlanCampaign {
    /// What was planned.
    pub row: PlanRow,
    /// In order of run number.
    pub flights: Vec<PlanFlight>,
}

/// Asks for the plan of `mission`.
///
/// # Errors
/// When the call is not answered or the answer contradicts the contract. That there is no plan is
/// an answer.
pub async fn compute_plan(
    client: &Client,
    mission: &PlanMission,
) -> Result<PlanAnswer, SimulationError> {
    let request =
        v1::ComputePlanRequest { problem: Some(mission.problem.clone()), ..Default::default() };
    let mut patience = Patience::new(0);
    let response = loop {
        match client.plan(request.clone()).await {
            Ok(response) => break response,
            Err(error) => patience.after(error).await?,
        }
    };
    PlanAnswer::read(response).map_err(|what| SimulationError::Answer { run: 0, what })
}

/// Asks for every plan of the mission's table, in `metric` or in the table's own.
///
/// # Errors
/// As [`compute_plan`]; and where the mission has no table.
pub async fn compute_table(
    client: &Client,
    mission: &PlanMission,
    metric: Option<ArrivalMetric>,
) -> Result<Vec<PlanRow>, SimulationError> {
    if mission.tabulated().is_empty() {
        let what = format!("the mission {} has no table of variants", mission.name);
        return Err(SimulationError::Options(what));
    }
    let metric = metric.or(mission.table_metric());
    let changes = PlanChanges { metric, ..PlanChanges::default() };
    let mut rows = Vec::new();
    for name in mission.tabulated() {
        let mission = mission.with_variant(name)?.with(&changes)?;
        let answer = compute_plan(client, &mission).await?;
        rows.push(PlanRow { mission, answer });
    }
    Ok(rows)
}

/// Flies a mission's plans against a node and measures what comes out.
///
/// # Errors
/// When the options do not fit the mission, a call is not answered, or an answer contradicts the
/// contract. That a variant has no plan is a result.
pub async fn fly_plans(
    client: &Client,
    mission: &PlanMission,
    options: &PlanRunOptions,
    progress: &dyn Progress,
) -> Result<PlanReport, SimulationError> {
    let runs = options.runs.unwrap_or(mission.simulation.runs);
    if !(1..=RUNS_MAX).contains(&runs) {
        return Err(SimulationError::Options(format!("runs: 1 to {RUNS_MAX}, got {runs}")));
    }
    let concurrency = concurrency(client, options.concurrency).await?;
    let crew = Crew { concurrency, client, progress };
    let mut campaigns = Vec::new();
    for mission in flown(mission, options)? {
        let answer = compute_plan(client, &mission).await?;
        let row = PlanRow { mission, answer };
        let flights = match row.answer.plan() {
            None => Vec::new(),
            Some(planned) => {
                let flyable = Flyable::new(&row.mission, planned, options.seed)?;
                let label = format!("{} {}", row.mission.name, row.mission.label());
                crew.each(Arc::new(flyable), runs, &label, |client, flyable, run| async move {
                    flight::fly(&client, &flyable, run).await
                })
                .await?
            }
        };
        campaigns.push(PlanCampaign { row, flights });
    }
    let table = match options.with_pictures && !mission.tabulated().is_empty() {
        true => compute_table(client, mission, options.changes.metric).await?,
        false => Vec::new(),
    };
    Ok(PlanReport { mission: mission.clone(), seed: options.seed, runs, campaigns, table })
}

/// The problems that are flown.
fn flown(
    mission: &PlanMission,
    options: &PlanRunOptions,
) -> Result<Vec<PlanMission>, SimulationError> {
    let chosen = match &options.variant {
        Some(name) => std::slice::from_ref(name),
        None => mission.simulation.flown.as_slice(),
    };
    let chosen: Result<Vec<PlanMission>, _> = match chosen {
        [] => mission.with(&options.changes).map(|mission| vec![mission]),
        names => {
            names.iter().map(|name| mission.with_variant(name)?.with(&options.changes)).collect()
        }
    };
    chosen.map_err(|fault| SimulationError::Options(fault.to_string()))
}

impl PlanMission {
    /// The variant's name, or `problem` for the mission's own problem.
    #[must_use]
    pub fn label(&self) -> &str {
        self.variant.as_deref().unwrap_or("problem")
    }
}

/// Everything a run needs.
#[derive(Debug)]
pub(crate) struct Flyable {
    pub mission: PlanMission,
    pub model: PlanModel,
    pub plan_id: String,
    /// Nominal burns, LVLH, m/s.
    pub nominal: Vec<nalgebra::Vector3<f64>>,
    pub arrival: Ellipsoid,
    pub open_loop_arrival: Option<Ellipsoid>,
    pub seed: u64,
}

impl Flyable {
    fn new(mission: &PlanMission, planned: &Planned, seed: u64) -> Result<Self, SimulationError> {
        let answer = |what: String| SimulationError::Answer { run: 0, what };
        let model = mission.model()?;
        let plan = &planned.plan;
        let arrival = Ellipsoid::new("arrival", plan.arrival.as_ref()).map_err(answer)?;
        let open_loop_arrival = match &plan.open_loop_arrival {
            None => None,
            given => Some(Ellipsoid::new("open_loop_arrival", given.as_ref()).map_err(answer)?),
        };
        check_axes(plan.arrival.as_ref(), &arrival).map_err(answer)?;
        let burns = flight::nominal_burns(plan, &model).map_err(answer)?;
        Ok(Self {
            mission: mission.clone(),
            model,
            plan_id: planned.plan_id.clone(),
            nominal: burns,
            arrival,
            open_loop_arrival,
            seed,
        })
    }
}

/// The axes an answer states must be those of the shape it gives.
fn check_axes(stated: Option<&v1::ArrivalSet>, set: &Ellipsoid) -> Result<(), String> {
    let stated = stated.map_or(&[][..], |stated| &stated.in_plane_semi_axes_m);
    let ours = set.in_plane_semi_axes_m();
    // Both come from the same digits; what an eigenvalue solver loses is far below this.
    let same = |(a, b): (&f64, &f64)| (a - b).abs() <= 1e-6 * ours[0];
    if stated.len() != 2 || !stated.iter().zip(&ours).all(same) {
        return Err(format!("in-plane axes {stated:?} of a shape that has {ours:?}"));
    }
    Ok(())
}
