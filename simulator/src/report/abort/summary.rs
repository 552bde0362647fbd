//! The figures of one variant's flights.

use crate::{
    campaign::abort::{AbortCampaign, AbortFlight, AbortOutcome, Drift, ModeCounts, Origin},
    mission::{abort::AbortTruth, abort_model::PhaseKind},
    report::{Statistics, latency_ms},
};

/// A state drifts into a region if its gauge falls below 1 by more than this: the solver's
/// tolerance, and what positions lack of the states that the sets are made of.
pub(crate) const GAUGE_TOLERANCE: f64 = 1e-3;

/// The figures of one variant's flights.
#[derive(Debug, Clone)]
pub struct AbortSummary {
    /// Flights.
    pub runs: usize,
    /// How many ended in an arrival.
    pub arrived: usize,
    /// How many ended because neither a command nor an abort existed.
    pub infeasible: usize,
    /// Starts drawn and not kept.
    pub redraws: u64,
    /// Delta-v, steps and, with failures, how near to the region flights came.
    pub metrics: Vec<(&'static str, Statistics)>,
    /// Flown steps of all runs.
    pub steps: usize,
    /// Commands for which some half-space had to give way.
    pub softened_steps: usize,
    /// Steps of aborts.
    pub abort_steps: usize,
    /// Commands whose certificate did not pass.
    pub uncertified_steps: usize,
    /// Verdicts on the next state of every step, over modes.
    pub modes: ModeCounts,
    /// Flown states as free drift has them, one a truth of the mission; only without failures.
    pub drifts: Vec<DriftFigures>,
    /// Runs with a failure.
    pub failures: Option<FailureFigures>,
    /// One a phase of the variant's problem.
    pub phases: Vec<PhaseFigures>,
    /// Steps' p50 and p99 as the client sees them, ms.
    pub latency_ms: Option<(f64, f64)>,
}

/// What becomes of flown states if all thrusters fail there.
#[derive(Debug, Clone, Copy)]
pub struct DriftFigures {
    /// What moves both craft.
    pub truth: &'static str,
    /// States judged.
    pub states: usize,
    /// States that drift into the region of their phase.
    pub states_drifting_in: usize,
    /// Least gauge among the instants that are looked at.
    pub least_gauge: f64,
    /// The same between them too.
    pub least_gauge_throughout: f64,
    /// Least distance from the target.
    pub least_distance_m: f64,
}

/// What became of runs whose thrusters failed.
#[derive(Debug, Clone, Copy)]
pub struct FailureFigures {
    /// Runs with a failure.
    pub runs: usize,
    /// Runs that came inside the region after it.
    pub runs_entering: usize,
    /// Of these, runs all of whose programs had been feasible until then.
    pub runs_entering_feasible: usize,
    /// Runs for which the service found no abort at the failure.
    pub runs_without_abort: usize,
}

/// A phase of a variant.
#[derive(Debug, Clone)]
pub struct PhaseFigures {
    /// What it promises.
    pub kind: &'static str,
    /// Unsafe sets that the artifact keeps.
    pub sets: i64,
    /// Sets there would be if those of every mode were kept; `None` where nobody counted.
    pub sets_of_all_modes: Option<i64>,
    /// Modes that must be survived.
    pub modes: i32,
    /// Modes whose sets are kept.
    pub modes_kept: usize,
    /// Steps flown in it, all runs.
    pub steps: usize,
    /// Time spent in it, all runs.
    pub time_s: f64,
    /// Delta-v spent in it, all runs.
    pub delta_v_m_s: f64,
    /// Commands for which some half-space had to give way.
    pub softened_steps: usize,
    /// First step decided in it, in the first run.
    pub begins_at_step: Option<usize>,
    /// First step at which the state is in one of its unsafe sets, in the first run.
    pub unsafe_at_step: Option<usize>,
    /// In every run the state was outside its unsafe sets until the next phase had begun. `None` in
    /// phases that avoid nothing, and where it was not asked for.
    pub safe_until_next: Option<bool>,
}

impl AbortSummary {
    /// Sums a campaign up.
    #[must_use]
    pub fn new(campaign: &AbortCampaign) -> Self {
        let flights = &campaign.flights;
        let ended = |how: fn(&AbortOutcome) -> bool| {
            flights.iter().filter(|flight| how(&flight.outcome)).count()
        };
        let steps = || flights.iter().flat_map(|flight| &flight.steps);
        Self {
            runs: flights.len(),
            arrived: ended(|how| *how == AbortOutcome::Arrived),
            infeasible: ended(|how| matches!(how, AbortOutcome::Infeasible(_))),
            redraws: flights.iter().map(|flight| u64::from(flight.redraws)).sum(),
            metrics: metrics(campaign),
            steps: steps().count(),
            softened_steps: steps().filter(|step| step.softened).count(),
            abort_steps: steps().filter(|step| matches!(step.origin, Origin::Abort(_))).count(),
            uncertified_steps: steps()
                .filter(|step| !step.certified && step.origin == Origin::Command)
                .count(),
            modes: steps().map(|step| step.next).sum(),
            drifts: drifts(campaign),
            failures: failures(flights),
            phases: (0..campaign.artifact.phases.len())
                .map(|phase| phase_figures(campaign, phase))
                .collect(),
            latency_ms: latency_ms(steps().map(|step| step.latency)),
        }
    }

    /// A metric by its name in the report.
    #[must_use]
    pub fn metric(&self, name: &str) -> Option<&Statistics> {
        self.metrics.iter().find(|(known, _)| *known == name).map(|(_, statistics)| statistics)
    }
}

fn metrics(campaign: &AbortCampaign) -> Vec<(&'static str, Statistics)> {
    let flights = || campaign.flights.iter();
    let after = |value: fn(&Drift) -> f64| {
        let each = flights().filter_map(|flight| flight.failure.as_ref());
        Statistics::of(
            each.filter_map(move |failure| failure.after.iter().map(value).reduce(f64::min)),
        )
    };
    let all = [
        ("delta_v_m_s", Statistics::of(flights().map(|flight| flight.delta_v_m_s(&campaign.case)))),
        ("steps", Statistics::of(flights().map(|flight| flight.steps.len() as f64))),
        (
            "failure_step",
            Statistics::of(
                flights().filter_map(|flight| Some(flight.failure.as_ref()?.step as f64)),
            ),
        ),
        (
            "failure_gauge",
            Statistics::of(flights().filter_map(|flight| flight.failure.as_ref()?.gauge)),
        ),
        ("least_gauge_after_failure", after(|drift| drift.least_gauge_throughout)),
        ("least_distance_after_failure_m", after(|drift| drift.least_distance_m)),
    ];
    all.into_iter().filter_map(|(name, statistics)| Some((name, statistics?))).collect()
}

fn drifts(campaign: &AbortCampaign) -> Vec<DriftFigures> {
    let least = |drifts: &[Drift], value: fn(&Drift) -> f64| {
        drifts.iter().map(value).fold(f64::INFINITY, f64::min)
    };
    let samples = || campaign.flights.iter().flat_map(|flight| &flight.samples);
    let one = |(index, truth): (usize, &AbortTruth)| {
        let judged: Vec<Drift> =
            samples().filter_map(|sample| sample.drifts.get(index).copied()).collect();
        let inside = |drift: &&Drift| drift.least_gauge < 1.0 - GAUGE_TOLERANCE;
        (!judged.is_empty()).then(|| DriftFigures {
            truth: truth.name(),
            states: judged.len(),
            states_drifting_in: judged.iter().filter(inside).count(),
            least_gauge: least(&judged, |drift| drift.least_gauge),
            least_gauge_throughout: least(&judged, |drift| drift.least_gauge_throughout),
            least_distance_m: least(&judged, |drift| drift.least_distance_m),
        })
    };
    campaign.judged_by.iter().enumerate().filter_map(one).collect()
}

fn failures(flights: &[AbortFlight]) -> Option<FailureFigures> {
    let failed = || flights.iter().filter_map(|flight| Some((flight, flight.failure.as_ref()?)));
    let entering = || failed().filter(|(flight, _)| flight.entered());
    (failed().count() > 0).then(|| FailureFigures {
        runs: failed().count(),
        runs_entering: entering().count(),
        runs_entering_feasible: entering()
            .filter(|(flight, _)| flight.softened_steps() == 0)
            .count(),
        runs_without_abort: failed().filter(|(_, failure)| failure.abort.is_none()).count(),
    })
}

fn phase_figures(campaign: &AbortCampaign, phase: usize) -> PhaseFigures {
    let made = &campaign.artifact.phases[phase];
    let flights = &campaign.flights;
    let steps =
        || flights.iter().flat_map(|flight| &flight.steps).filter(move |step| step.phase == phase);
    let kind = campaign.case.model.phases.get(phase).map_or(PhaseKind::Free, |phase| phase.kind);
    let first = flights.first();
    let asked = flights.iter().any(|flight| flight.unsafe_at(phase).is_some());
    PhaseFigures {
        kind: kind.name(),
        sets: made.sets,
        sets_of_all_modes: made.sets_of_all_modes,
        modes: made.modes,
        modes_kept: made.dominating_modes.len(),
        steps: steps().count(),
        time_s: steps().count() as f64 * campaign.case.model.sample_time_s,
        delta_v_m_s: steps().map(|step| campaign.case.delta_v_m_s(&step.force_n)).sum(),
        softened_steps: steps().filter(|step| step.softened).count(),
        begins_at_step: first.and_then(|flight| flight.begins_at(phase)),
        unsafe_at_step: first.and_then(|flight| flight.unsafe_at(phase).flatten()),
        safe_until_next: (asked && kind != PhaseKind::Free)
            .then(|| flights.iter().all(|flight| flight.safe_until_next(phase))),
    }
}
