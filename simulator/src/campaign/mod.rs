//! Campaigns: many runs of one mission over the network, many at once.
//!
//! A run depends on the seed and on its own number, never on how many others fly beside it.

pub(crate) mod abort;
pub(crate) mod crew;
pub(crate) mod flight;
pub(crate) mod plan;
pub(crate) mod progress;
pub(crate) mod sampling;
pub(crate) mod search;
pub(crate) mod sets;
pub(crate) mod vehicle;

use std::{num::NonZeroUsize, sync::Arc};

use vbar_client::Client;
use vbar_proto::v1::{
    self, HorizonSearch, VariableHorizonArtifact, VariableHorizonScheme as Scheme,
};

use crate::{
    mission::{
        Mission, MissionError, RUNS_MAX, law::DisturbanceLaw, scheme_name, variable_horizon_mut,
    },
    report::Report,
};
use crew::Crew;
pub use flight::Flight;
pub use progress::{Progress, ProgressBar, Silent};

/// Runs in flight for every computation the server does at once: enough to keep it busy while
/// answers travel, few enough that latency is not mostly waiting.
const FLIGHTS_PER_COMPUTATION: usize = 2;

/// Most runs in flight at once.
const CONCURRENCY_MAX: usize = 1024;

/// Which schemes are flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SchemeChoice {
    /// This one.
    One(Scheme),
    /// Every scheme the mission compares, its own first.
    All,
}

impl std::str::FromStr for SchemeChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let name = text.to_ascii_uppercase().replace('-', "_");
        if name == "ALL" {
            return Ok(Self::All);
        }
        crate::mission::scheme_named(&name).map(Self::One).ok_or_else(|| {
            format!(
                "{text} is not a scheme: ADAPTIVE_TERMINAL, FIXED_TERMINAL, \
                 TUBE_OPTIMAL_CONTROL, NOMINAL or all"
            )
        })
    }
}

/// What to fly; the default flies the mission as its file says.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Instead of the problem's own scheme.
    pub scheme: Option<SchemeChoice>,
    /// Instead of the problem's own search.
    pub search: Option<HorizonSearch>,
    /// Instead of the mission's number of runs.
    pub runs: Option<u32>,
    /// Start of every stream of chance.
    pub seed: u64,
    /// Runs in flight at once, instead of twice what the server computes at once.
    pub concurrency: Option<NonZeroUsize>,
    /// Fly this variant of the mission.
    pub variant: Option<String>,
    /// Turn the thrust by these angles (RTN, degrees) instead of the mission's disturbance.
    pub misalignment_deg: Option<[f64; 3]>,
    /// Ask for every step with LOCAL and with ENUMERATION on the same state, and count answers
    /// that differ.
    pub compare_search: bool,
    /// Sweep these fuel weights too.
    pub fuel_weights: Vec<f64>,
    /// Fly also what only the pictures need: the detailed variant and the mission's own sweep.
    pub with_pictures: bool,
}

/// Why a campaign could not be flown. Infeasible missions are results, not errors.
#[derive(Debug, thiserror::Error)]
pub enum SimulationError {
    /// The options ask for something the mission does not have.
    #[error("{0}")]
    Options(String),
    /// The mission cannot be flown as changed by the options.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// A call was not answered.
    #[error("run {run}: {source}")]
    Client {
        /// Which run; 0 also where no run had begun.
        run: u32,
        /// What the client says.
        source: vbar_client::Error,
    },
    /// The service answered something that contradicts the contract or the simulator.
    #[error("run {run}: the answer makes no sense: {what}")]
    Answer {
        /// Which run.
        run: u32,
        /// What is wrong with it.
        what: String,
    },
    /// The law of the initial state found no acceptable one.
    #[error("run {run}: no feasible start in {tries} draws; the last refusal: {reason}")]
    NoStart {
        /// Which run.
        run: u32,
        /// Draws made.
        tries: u32,
        /// Why the last one was refused.
        reason: String,
    },
    /// A task of ours ended early.
    #[error("a run stopped unexpectedly: {0}")]
    Task(#[from] tokio::task::JoinError),
}

/// All runs of one scheme.
#[derive(Debug, Clone)]
pub struct Campaign {
    /// What was flown.
    pub scheme: Scheme,
    /// In order of run number.
    pub flights: Vec<Flight>,
    /// What the precompute of run 0 found.
    pub artifact: VariableHorizonArtifact,
}

/// Mean results of one weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SweepPoint {
    /// gamma_v.
    pub fuel_weight: f64,
    /// Mean of the sum of |u|, normalised; over runs that arrived.
    pub fuel: f64,
    /// Mean number of commands.
    pub completion_steps: f64,
    /// Runs that arrived.
    pub arrived: u32,
}

/// Flies a mission against a node and measures what comes out.
///
/// # Errors
/// When the options do not fit the mission, a call is not answered, or an answer contradicts the
/// contract. An infeasible run is a result.
pub async fn simulate(
    client: &Client,
    mission: &Mission,
    options: &RunOptions,
    progress: &dyn Progress,
) -> Result<Report, SimulationError> {
    let mission = adapted(mission, options)?;
    let runs = options.runs.unwrap_or(mission.simulation.runs);
    if !(1..=RUNS_MAX).contains(&runs) {
        return Err(SimulationError::Options(format!("runs: 1 to {RUNS_MAX}, got {runs}")));
    }
    let concurrency = concurrency(client, options.concurrency).await?;
    let mut campaigns = Vec::new();
    for scheme in chosen_schemes(&mission, options)? {
        let plan = Plan::new(&mission, options, scheme, concurrency);
        campaigns.push(plan.fly(client, runs, scheme_name(scheme), progress).await?);
    }
    let comparison = if options.compare_search {
        let plan = Plan::new(&mission, options, campaigns[0].scheme, concurrency);
        Some(plan.compare(client, runs, progress).await?)
    } else {
        None
    };
    let detailed = match &mission.simulation.detailed_variant {
        Some(name) if options.with_pictures && options.variant.is_none() => {
            detailed(client, &mission, options, name, concurrency, progress).await?
        }
        _ => Vec::new(),
    };
    let sweep = sweep(client, &mission, options, runs, concurrency, progress).await?;
    Ok(Report::new(mission, options.seed, campaigns, detailed, sweep, comparison))
}

/// The mission as the options change it.
fn adapted(mission: &Mission, options: &RunOptions) -> Result<Mission, SimulationError> {
    let mut mission = match &options.variant {
        None => mission.clone(),
        Some(name) => mission.variant(name).ok_or_else(|| {
            let known: Vec<&str> = mission.variants().collect();
            let known = known.join(", ");
            SimulationError::Options(format!("no variant is called {name}; there are: {known}"))
        })?,
    };
    if let Some(angle_deg) = options.misalignment_deg {
        mission.simulation.disturbance = DisturbanceLaw::FixedMisalignment { angle_deg };
    }
    if let (Some(search), Some(inner)) =
        (options.search, variable_horizon_mut(&mut mission.problem))
    {
        inner.set_search(search);
    }
    mission.check()?;
    Ok(mission)
}

fn chosen_schemes(mission: &Mission, options: &RunOptions) -> Result<Vec<Scheme>, SimulationError> {
    let own = mission.scheme();
    match options.scheme {
        None => Ok(vec![own]),
        Some(SchemeChoice::One(Scheme::Unspecified)) => {
            Err(SimulationError::Options("the scheme must be named".into()))
        }
        Some(SchemeChoice::One(scheme)) => Ok(vec![scheme]),
        Some(SchemeChoice::All) => {
            let compared = mission.compared_schemes();
            let others = compared.into_iter().filter(|scheme| *scheme != own);
            Ok(std::iter::once(own).chain(others).collect())
        }
    }
}

/// As many runs at once as asked for, else by what the server says it computes at once.
async fn concurrency(
    client: &Client,
    asked: Option<NonZeroUsize>,
) -> Result<usize, SimulationError> {
    if let Some(asked) = asked {
        return Ok(asked.get().min(CONCURRENCY_MAX));
    }
    let info = client.server_info().await;
    let info = info.map_err(|source| SimulationError::Client { run: 0, source })?;
    let limit = info.limits.map_or(1, |limits| limits.concurrent_computations_max);
    let limit = usize::try_from(limit).unwrap_or(1).max(1);
    Ok(limit.saturating_mul(FLIGHTS_PER_COMPUTATION).min(CONCURRENCY_MAX))
}

/// The single run that is drawn step by step, for every scheme the mission compares.
async fn detailed(
    client: &Client,
    mission: &Mission,
    options: &RunOptions,
    name: &str,
    concurrency: usize,
    progress: &dyn Progress,
) -> Result<Vec<Campaign>, SimulationError> {
    let Some(variant) = mission.variant(name) else { return Ok(Vec::new()) };
    let everything = RunOptions { scheme: Some(SchemeChoice::All), ..RunOptions::default() };
    let mut flown = Vec::new();
    for scheme in chosen_schemes(&variant, &everything)? {
        let plan = Plan::new(&variant, options, scheme, concurrency);
        let label = format!("{name} {}", scheme_name(scheme));
        flown.push(plan.fly(client, 1, &label, progress).await?);
    }
    Ok(flown)
}

async fn sweep(
    client: &Client,
    mission: &Mission,
    options: &RunOptions,
    runs: u32,
    concurrency: usize,
    progress: &dyn Progress,
) -> Result<Vec<SweepPoint>, SimulationError> {
    let (weights, runs) = match &mission.simulation.fuel_weight_sweep {
        _ if !options.fuel_weights.is_empty() => (options.fuel_weights.clone(), runs),
        Some(sweep) if options.with_pictures => (sweep.weights.clone(), sweep.runs.min(runs)),
        _ => return Ok(Vec::new()),
    };
    let mut points = Vec::new();
    for fuel_weight in weights {
        let mut plan = Plan::new(mission, options, mission.scheme(), concurrency);
        plan.set_fuel_weight(fuel_weight);
        let label = format!("gamma_v {fuel_weight}");
        let campaign = plan.fly(client, runs, &label, progress).await?;
        let arrived: Vec<&Flight> = campaign.flights.iter().filter(|f| f.arrived()).collect();
        let mean = |value: fn(&Flight) -> f64| {
            arrived.iter().map(|flight| value(flight)).sum::<f64>() / arrived.len() as f64
        };
        points.push(SweepPoint {
            fuel_weight,
            fuel: mean(Flight::fuel),
            completion_steps: mean(|flight| flight.steps.len() as f64),
            arrived: u32::try_from(arrived.len()).unwrap_or(u32::MAX),
        });
    }
    Ok(points)
}

/// One scheme of one mission, ready to be flown.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub mission: Mission,
    pub seed: u64,
    concurrency: usize,
}

impl Plan {
    fn new(mission: &Mission, options: &RunOptions, scheme: Scheme, concurrency: usize) -> Self {
        let mut mission = mission.clone();
        if let Some(inner) = variable_horizon_mut(&mut mission.problem) {
            inner.set_scheme(scheme);
        }
        Self { mission, seed: options.seed, concurrency }
    }

    fn set_fuel_weight(&mut self, fuel_weight: f64) {
        if let Some(inner) = variable_horizon_mut(&mut self.mission.problem) {
            inner.fuel_weight = Some(fuel_weight);
        }
    }

    /// Flies runs 0 to `runs`.
    async fn fly(
        self,
        client: &Client,
        runs: u32,
        label: &str,
        progress: &dyn Progress,
    ) -> Result<Campaign, SimulationError> {
        let scheme = self.mission.scheme();
        let crew = Crew { concurrency: self.concurrency, client, progress };
        let flown = crew
            .each(Arc::new(self), runs, label, |client, plan, run| async move {
                flight::fly(&client, &plan, run).await
            })
            .await?;
        let mut artifact = None;
        let mut flights = Vec::with_capacity(flown.len());
        for (flight, found) in flown {
            artifact.get_or_insert(found);
            flights.push(flight);
        }
        let artifact = artifact.ok_or_else(|| SimulationError::Options("no runs".into()))?;
        Ok(Campaign { scheme, flights, artifact })
    }

    /// Asks for every step twice.
    async fn compare(
        self,
        client: &Client,
        runs: u32,
        progress: &dyn Progress,
    ) -> Result<search::SearchComparison, SimulationError> {
        let label = "LOCAL against ENUMERATION";
        let crew = Crew { concurrency: self.concurrency, client, progress };
        let counted = crew
            .each(Arc::new(self), runs, label, |client, plan, run| async move {
                search::compare(&client, &plan, run).await
            })
            .await?;
        Ok(counted.into_iter().sum())
    }
}

/// The same mission under another search.
pub(crate) fn with_search(problem: &v1::Problem, search: HorizonSearch) -> v1::Problem {
    let mut problem = problem.clone();
    if let Some(inner) = variable_horizon_mut(&mut problem) {
        inner.set_search(search);
    }
    problem
}
