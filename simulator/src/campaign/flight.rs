//! One run: draw a start, close the loop over the network, keep what happened.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use nalgebra::DVector;
use rand::SeedableRng as _;
use rand_chacha::ChaCha12Rng;
use vbar_client::{Client, ClosedLoop, Code};
use vbar_proto::v1::{
    self, Branch, Measurement, StepResponse, VariableHorizonArtifact,
    VariableHorizonScheme as Scheme, measurement, step_response, step_stream_request::Controller,
};

use super::{
    Plan, SimulationError,
    sets::{ErrorSets, contains_in_plane, radius},
    vehicle::{Vehicle, input_margin_nd, reference, state_margin_nd},
};
use crate::mission::{
    law::RunDisturbance,
    model::{Kind, Model},
};

/// Draws of a start before a run gives up.
pub(crate) const STARTS_MAX: u32 = 10_000;

/// How often a call is repeated when the node is busy, and how long to wait in between.
const BUSY_ATTEMPTS_MAX: u32 = 200;
const BUSY_PAUSE: Duration = Duration::from_millis(5);

/// Largest disagreement with the node about the final distance, normalised: rounding only.
const DISTANCE_TOLERANCE_ND: f64 = 1e-9;

/// A sample outside its constraints by more than this counts as a violation, normalised.
pub const VIOLATION_TOLERANCE_ND: f64 = 1e-9;

/// One run, from its accepted start to its end.
#[derive(Debug, Clone)]
pub struct Flight {
    /// Number of the run.
    pub run: u32,
    /// Starts that were refused as infeasible before this one.
    pub redraws: u32,
    /// How it ended.
    pub outcome: Outcome,
    /// True states at k = 0, 1, ...
    pub samples: Vec<Sample>,
    /// Commands at k = 0, 1, ...; one fewer than samples.
    pub steps: Vec<Step>,
    /// What was predicted at k = 0, in the first run of a campaign.
    pub first_prediction: Option<v1::Prediction>,
    /// Radius of the guaranteed final set on position, m; of the whole set for a plant without
    /// metres. Only after an arrival.
    pub final_set_radius: Option<f64>,
    pub(crate) model: Arc<Model>,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// The service said so, and the simulator counted the same number of steps.
    Arrived,
    /// No command was possible; the service's reason.
    Infeasible(String),
    /// The mission's longest duration has passed.
    StepsExhausted,
}

/// The truth at one instant.
#[derive(Debug, Clone)]
pub struct Sample {
    /// SI in RTN for a spacecraft, else the plant's units.
    pub state: Vec<f64>,
    /// Where the capture point (or the reference) is and how it moves, same units.
    pub reference: Vec<f64>,
    /// Least margin to the state constraints, normalised; `None` without constraints.
    pub margin_nd: Option<f64>,
}

/// One command and how it came about.
#[derive(Debug, Clone)]
pub struct Step {
    /// Commanded input over its largest value for a spacecraft, else in the plant's units.
    pub input: Vec<f64>,
    /// Least margin to the input constraints, normalised.
    pub input_margin_nd: f64,
    /// Optimal cost J.
    pub cost: f64,
    /// Horizon N.
    pub horizon: i32,
    /// Which problem gave the command.
    pub branch: Branch,
    /// Step at which the terminal point was last adapted, q.
    pub adapted_step: i32,
    /// Horizon at step q.
    pub adapted_horizon: i32,
    /// Programs that the simplex gave up.
    pub general_solver_calls: i32,
    /// The certificate passed.
    pub certified: bool,
    /// The service saw a disturbance outside the set it assumes.
    pub outside_assumed_set: bool,
    /// Time from question to answer, as the client sees it.
    pub latency: Duration,
}

impl Flight {
    /// The service declared arrival.
    #[must_use]
    pub fn arrived(&self) -> bool {
        self.outcome == Outcome::Arrived
    }

    /// Distance from the capture point at the end: metres, or the norm for a plant without them.
    #[must_use]
    pub fn final_distance(&self) -> f64 {
        self.samples.last().map_or(f64::NAN, |sample| deviation(&self.model, sample))
    }

    /// Sum of |input|, 1-norm, as the method scales it.
    #[must_use]
    pub fn fuel(&self) -> f64 {
        self.steps.iter().flat_map(|step| &step.input).map(|component| component.abs()).sum()
    }

    /// What the thrusters of the three axes deliver together, m/s; `None` without metres.
    #[must_use]
    pub fn delta_v_m_s(&self) -> Option<f64> {
        match &self.model.kind {
            Kind::Hill(hill) => Some(self.fuel() * hill.acceleration_max_m_s2 * hill.sample_time_s),
            Kind::Linear(_) => None,
        }
    }

    /// Metres in one normalised unit of position.
    #[must_use]
    pub fn position_unit_m(&self) -> Option<f64> {
        match &self.model.kind {
            Kind::Hill(hill) => Some(hill.position_unit_m()),
            Kind::Linear(_) => None,
        }
    }

    /// The samples at which the problem imposes its state constraints.
    fn constrained_samples(&self) -> &[Sample] {
        let free = self.arrived() && !self.model.constrained_at_arrival;
        &self.samples[..self.samples.len() - usize::from(free)]
    }

    /// Arrived outside the state constraints, which a problem may allow.
    #[must_use]
    pub fn arrived_outside(&self) -> bool {
        let last = self.samples.last().and_then(|sample| sample.margin_nd);
        self.arrived() && last.is_some_and(|margin| margin < -VIOLATION_TOLERANCE_ND)
    }

    /// Least margin to the state constraints over all samples, normalised; `None` without any.
    #[must_use]
    pub fn worst_margin_nd(&self) -> Option<f64> {
        self.constrained_samples().iter().filter_map(|sample| sample.margin_nd).reduce(f64::min)
    }

    /// Least margin to the input constraints over all commands, normalised.
    #[must_use]
    pub fn worst_input_margin_nd(&self) -> Option<f64> {
        self.steps.iter().map(|step| step.input_margin_nd).reduce(f64::min)
    }

    /// First step at which the state or the command was outside.
    #[must_use]
    pub fn first_violation(&self) -> Option<usize> {
        let outside = |margin: f64| margin < -VIOLATION_TOLERANCE_ND;
        let samples = self.constrained_samples();
        (0..samples.len()).find(|&k| {
            samples[k].margin_nd.is_some_and(outside)
                || self.steps.get(k).is_some_and(|step| outside(step.input_margin_nd))
        })
    }
}

/// What a run needs from the service before it starts.
#[derive(Debug, Clone)]
pub(crate) struct Prepared {
    pub artifact_id: String,
    pub artifact: VariableHorizonArtifact,
    pub sets: ErrorSets,
    pub model: Arc<Model>,
}

/// Flies run number `run`; the artifact is that of its problem.
pub(crate) async fn fly(
    client: &Client,
    plan: &Plan,
    run: u32,
) -> Result<(Flight, VariableHorizonArtifact), SimulationError> {
    let mut starts = Starts::of(plan, run);
    let mut reason = String::new();
    for redraws in 0..STARTS_MAX {
        let candidate = starts.draw(client, plan).await?;
        let (prepared, start) = match candidate {
            Candidate::Start(prepared, start) => (prepared, start),
            Candidate::Refused(why) => {
                reason = why;
                continue;
            }
        };
        let mut flight = close_loop(client, plan, run, &prepared, &start).await?;
        flight.redraws = redraws;
        match &flight.outcome {
            Outcome::Infeasible(why) if flight.steps.is_empty() && plan.start_is_random() => {
                reason.clone_from(why);
            }
            _ => return Ok((flight, prepared.artifact)),
        }
    }
    Err(SimulationError::NoStart { run, tries: STARTS_MAX, reason })
}

/// A start, or why there is none.
pub(crate) enum Candidate {
    Start(Box<Prepared>, DVector<f64>),
    Refused(String),
}

/// The starts of one run, one after the other until one can be flown.
pub(crate) struct Starts {
    run: u32,
    chance: ChaCha12Rng,
    /// The problem with the parameters last drawn, and how many more starts are drawn with them.
    problem: Option<(v1::Problem, u32)>,
}

impl Starts {
    pub(crate) fn of(plan: &Plan, run: u32) -> Self {
        Self { run, chance: stream_of_chance(plan.seed, run, 0), problem: None }
    }

    /// Draws parameters, unless the last are good for another start, and a start, and has the
    /// service prepare for them.
    pub(crate) async fn draw(
        &mut self,
        client: &Client,
        plan: &Plan,
    ) -> Result<Candidate, SimulationError> {
        let run = self.run;
        let problem = self.parameters(plan);
        let prepared = match prepare(client, run, problem).await? {
            Ok(prepared) => prepared,
            Err(reason) if plan.start_is_random() => return Ok(Candidate::Refused(reason)),
            Err(reason) => return Err(SimulationError::NoStart { run, tries: 1, reason }),
        };
        let limit = prepared.sets.generators_of_limit();
        let inside = |state: &_| contains_in_plane(&limit, state);
        let law = &plan.mission.simulation.initial_state;
        Ok(match law.draw(&prepared.model, &inside, &mut self.chance) {
            Some(start) => Candidate::Start(Box::new(prepared), start),
            None => Candidate::Refused("the law of the initial state rejects every draw".into()),
        })
    }

    fn parameters(&mut self, plan: &Plan) -> v1::Problem {
        let Some(randomised) = &plan.mission.simulation.randomised else {
            return plan.mission.problem.clone();
        };
        if let Some((problem, left)) = &mut self.problem
            && *left > 0
        {
            *left -= 1;
            return problem.clone();
        }
        let mut problem = plan.mission.problem.clone();
        randomised.apply(&mut problem, &mut self.chance);
        self.problem = Some((problem.clone(), randomised.starts_per_draw.get() - 1));
        problem
    }
}

impl Plan {
    /// Another draw can give another start.
    pub(crate) fn start_is_random(&self) -> bool {
        use crate::mission::law::InitialLaw;
        let simulation = &self.mission.simulation;
        let fixed = matches!(
            simulation.initial_state,
            InitialLaw::Fixed { .. } | InitialLaw::FixedComponents(_)
        );
        !fixed || simulation.randomised.is_some()
    }
}

/// Chance of one purpose in one run: 0 for the start, 1 for the disturbance. The start of run 7
/// does not depend on how many runs there are, and its disturbance not on how many starts were
/// refused.
pub(crate) fn stream_of_chance(seed: u64, run: u32, purpose: u64) -> ChaCha12Rng {
    let mut chance = ChaCha12Rng::seed_from_u64(seed);
    chance.set_stream(u64::from(run) * 2 + purpose);
    chance
}

/// A node that is busy says RESOURCE_EXHAUSTED at once; it is asked again a little later.
pub(crate) struct Patience {
    run: u32,
    attempts: u32,
}

impl Patience {
    pub(crate) fn new(run: u32) -> Self {
        Self { run, attempts: 0 }
    }

    /// Waits if the node was busy; any other error, or too many, ends the run.
    pub(crate) async fn after(&mut self, error: vbar_client::Error) -> Result<(), SimulationError> {
        self.attempts += 1;
        if error.code != Code::ResourceExhausted || self.attempts >= BUSY_ATTEMPTS_MAX {
            return Err(SimulationError::Client { run: self.run, source: error });
        }
        tokio::time::sleep(error.retry_after.unwrap_or(BUSY_PAUSE)).await;
        Ok(())
    }
}

/// Asks a loop for its next decision; the time from question to answer comes with it.
pub(crate) async fn ask(
    closed_loop: &mut ClosedLoop,
    question: Measurement,
    run: u32,
) -> Result<(StepResponse, Duration), SimulationError> {
    let asked = Instant::now();
    let mut patience = Patience::new(run);
    loop {
        match closed_loop.step(question.clone()).await {
            Ok(response) => return Ok((response, asked.elapsed())),
            Err(error) => patience.after(error).await?,
        }
    }
}

/// Has the artifact of `problem` made; the inner error is the service's reason.
pub(crate) async fn make(
    client: &Client,
    run: u32,
    problem: &v1::Problem,
) -> Result<Result<v1::Artifact, String>, SimulationError> {
    let mut patience = Patience::new(run);
    let made = loop {
        match client.precompute(problem.clone()).await {
            Ok(made) => break made,
            Err(error) => patience.after(error).await?,
        }
    };
    match made.outcome {
        Some(v1::precompute_response::Outcome::Artifact(artifact)) => Ok(Ok(artifact)),
        Some(v1::precompute_response::Outcome::Infeasible(why)) => Ok(Err(why.reason)),
        None => {
            let what = "a precompute without an outcome".to_owned();
            Err(SimulationError::Answer { run, what })
        }
    }
}

/// Makes the artifact of `problem` and reads it; the inner error is the service's reason.
async fn prepare(
    client: &Client,
    run: u32,
    problem: v1::Problem,
) -> Result<Result<Prepared, String>, SimulationError> {
    let model = Model::new(&problem).map_err(crate::mission::MissionError::Invalid)?;
    let made = match make(client, run, &problem).await? {
        Ok(made) => made,
        Err(reason) => return Ok(Err(reason)),
    };
    let answer = |what: &str| SimulationError::Answer { run, what: what.to_owned() };
    let Some(v1::artifact::Summary::VariableHorizon(artifact)) = made.summary else {
        return Err(answer("an artifact without its summary"));
    };
    let sets = ErrorSets::new(&artifact).map_err(|what| answer(&what))?;
    let model = Arc::new(model);
    Ok(Ok(Prepared { artifact_id: made.artifact_id, artifact, sets, model }))
}

/// Flies from `start` until arrival, infeasibility or the end of the mission.
async fn close_loop(
    client: &Client,
    plan: &Plan,
    run: u32,
    prepared: &Prepared,
    start: &DVector<f64>,
) -> Result<Flight, SimulationError> {
    let model = &prepared.model;
    let mut chance = stream_of_chance(plan.seed, run, 1);
    let simulation = &plan.mission.simulation;
    let disturbance: RunDisturbance = simulation.disturbance.begin(model, &mut chance);
    let mut vehicle = Vehicle::new(model, &simulation.truth, start);
    let mut session = Session::open(client, run, prepared, run == 0).await?;
    let mut flight = Flight {
        run,
        redraws: 0,
        outcome: Outcome::StepsExhausted,
        samples: vec![sample(model, 0, &vehicle.state(), run)?],
        steps: Vec::new(),
        first_prediction: None,
        final_set_radius: None,
        model: model.clone(),
    };
    for k in 0..=model.steps_max {
        let (decision, prediction) = session.decide(&vehicle.state()).await?;
        if k == 0 {
            flight.first_prediction = prediction;
        }
        match decision {
            Decision::Command(command, step) => {
                vehicle.advance(model, &command, &disturbance, &mut chance);
                flight.steps.push(step);
                flight.samples.push(sample(model, k + 1, &vehicle.state(), run)?);
            }
            Decision::Arrived => {
                flight.outcome = Outcome::Arrived;
                flight.final_set_radius = final_set_radius(&flight, plan, &prepared.sets);
                break;
            }
            Decision::Infeasible(reason) => {
                flight.outcome = Outcome::Infeasible(reason);
                break;
            }
        }
    }
    Ok(flight)
}

/// Radius of the set the scheme guarantees around its terminal point: S(N) with N the horizon at
/// which that point was last adapted, S(infinity) for the fixed terminal set, none without a tube.
fn final_set_radius(flight: &Flight, plan: &Plan, sets: &ErrorSets) -> Option<f64> {
    let generators = match plan.mission.scheme() {
        Scheme::AdaptiveTerminal | Scheme::TubeOptimalControl => {
            sets.generators(usize::try_from(flight.steps.last()?.adapted_horizon).ok()?)
        }
        Scheme::FixedTerminal => sets.generators_of_limit(),
        Scheme::Nominal | Scheme::Unspecified => return None,
    };
    Some(match flight.position_unit_m() {
        Some(unit) => radius(&generators, 3) * unit,
        None => radius(&generators, generators.nrows()),
    })
}

fn sample(
    model: &Model,
    k: usize,
    state: &DVector<f64>,
    run: u32,
) -> Result<Sample, SimulationError> {
    let reference = reference(model, k).ok_or_else(|| SimulationError::Answer {
        run,
        what: format!("the mission goes on at step {k}, where its reference has ended"),
    })?;
    Ok(Sample {
        state: state.as_slice().to_vec(),
        reference: reference.as_slice().to_vec(),
        margin_nd: state_margin_nd(model, k, state),
    })
}

/// Distance from the reference: of the positions in metres, or of the whole state.
fn deviation(model: &Model, sample: &Sample) -> f64 {
    let compared = match model.kind {
        Kind::Hill(_) => 3,
        Kind::Linear(_) => sample.state.len(),
    };
    let pairs = sample.state.iter().zip(&sample.reference).take(compared);
    pairs.map(|(is, should)| (is - should).powi(2)).sum::<f64>().sqrt()
}

/// A loop over the network, with everything the simulator expects of it.
pub(crate) struct Session {
    closed_loop: ClosedLoop,
    run: u32,
    model: Arc<Model>,
    commands: usize,
    last_announced: bool,
}

/// What the service decided.
pub(crate) enum Decision {
    /// m/s^2 for a spacecraft, the plant's units otherwise.
    Command(DVector<f64>, Step),
    Arrived,
    Infeasible(String),
}

impl Session {
    pub(crate) async fn open(
        client: &Client,
        run: u32,
        prepared: &Prepared,
        with_prediction: bool,
    ) -> Result<Self, SimulationError> {
        let controller = Controller::ArtifactId(prepared.artifact_id.clone());
        let opened = client.closed_loop(controller).await;
        let closed_loop = opened.map_err(|source| SimulationError::Client { run, source })?;
        let closed_loop =
            if with_prediction { closed_loop } else { closed_loop.without_prediction() };
        let model = prepared.model.clone();
        Ok(Self { closed_loop, run, model, commands: 0, last_announced: false })
    }

    /// Asks for the command at `state` and checks that the answer fits what went before.
    pub(crate) async fn decide(
        &mut self,
        state: &DVector<f64>,
    ) -> Result<(Decision, Option<v1::Prediction>), SimulationError> {
        let question = self.measurement(state);
        let (response, latency) = ask(&mut self.closed_loop, question, self.run).await?;
        let prediction = response.prediction.clone();
        let decision = self.read(response, state, latency);
        let run = self.run;
        let decision = decision.map_err(|what| SimulationError::Answer { run, what })?;
        Ok((decision, prediction))
    }

    fn measurement(&self, state: &DVector<f64>) -> Measurement {
        match &self.model.kind {
            Kind::Hill(hill) => Measurement {
                state: Some(measurement::State::Relative(v1::RelativeState {
                    frame: v1::Frame::Rtn.into(),
                    position_m: state.as_slice()[..3].to_vec(),
                    velocity_m_s: state.as_slice()[3..].to_vec(),
                })),
                elapsed_s: Some(hill.sample_time_s * self.commands as f64),
                ..Measurement::default()
            },
            Kind::Linear(_) => Measurement {
                state: Some(measurement::State::Linear(v1::LinearState {
                    components: state.as_slice().to_vec(),
                })),
                ..Measurement::default()
            },
        }
    }

    fn read(
        &mut self,
        response: StepResponse,
        state: &DVector<f64>,
        latency: Duration,
    ) -> Result<Decision, String> {
        if usize::try_from(response.step_index) != Ok(self.commands) {
            return Err(format!("step {} was answered as {}", self.commands, response.step_index));
        }
        match &response.verdict {
            None => Err("a step without a verdict".into()),
            Some(step_response::Verdict::Abort(_)) => {
                Err("an abort where none is to be had".into())
            }
            Some(step_response::Verdict::Infeasible(why)) => {
                Ok(Decision::Infeasible(why.reason.clone()))
            }
            Some(step_response::Verdict::Arrived(arrival)) => {
                self.check_arrival(arrival, state)?;
                Ok(Decision::Arrived)
            }
            Some(step_response::Verdict::Command(command)) => {
                if self.last_announced {
                    return Err("a command after the one announced as the last".into());
                }
                self.last_announced = command.last;
                let input = self.command(command)?;
                let step = self.step(&response, &input, latency)?;
                self.commands += 1;
                Ok(Decision::Command(input, step))
            }
        }
    }

    fn check_arrival(&self, arrival: &v1::Arrival, state: &DVector<f64>) -> Result<(), String> {
        if !self.last_announced {
            return Err("an arrival that no last command announced".into());
        }
        if usize::try_from(arrival.completion_steps) != Ok(self.commands) {
            let (theirs, ours) = (arrival.completion_steps, self.commands);
            return Err(format!("{theirs} completion steps, {ours} commands were given"));
        }
        // The reference motion is written twice; here the two meet.
        let Kind::Hill(hill) = &self.model.kind else { return Ok(()) };
        let Some(points) = hill.target.at(self.commands) else { return Ok(()) };
        let ours = (state.rows(0, 3) - points.capture_m).norm();
        let theirs = arrival.distance_m.ok_or("an arrival without its distance")?;
        if (ours - theirs).abs() > DISTANCE_TOLERANCE_ND * hill.position_unit_m() {
            return Err(format!("a final distance of {theirs} m, the truth is {ours} m"));
        }
        Ok(())
    }

    /// The command in the units the truth needs.
    fn command(&self, command: &v1::Command) -> Result<DVector<f64>, String> {
        let values = match &self.model.kind {
            Kind::Hill(hill) => {
                let elapsed_s = hill.sample_time_s * self.commands as f64;
                if command.frame() != v1::Frame::Rtn || command.acceleration_m_s2.len() != 3 {
                    return Err("a command without its acceleration in RTN".into());
                }
                if (command.elapsed_s - elapsed_s).abs() > 1e-6 * hill.sample_time_s {
                    let theirs = command.elapsed_s;
                    return Err(format!("a command for {theirs} s, it is {elapsed_s} s"));
                }
                &command.acceleration_m_s2
            }
            Kind::Linear(linear) => {
                if command.input_nd.len() != linear.plant.b.ncols() {
                    return Err("a command of the wrong size".into());
                }
                &command.input_nd
            }
        };
        if values.iter().any(|value| !value.is_finite()) {
            return Err("a command that is not finite".into());
        }
        Ok(DVector::from_column_slice(values))
    }

    fn step(
        &self,
        response: &StepResponse,
        command: &DVector<f64>,
        latency: Duration,
    ) -> Result<Step, String> {
        let Some(step_response::Diagnostics::VariableHorizon(how)) = &response.diagnostics else {
            return Err("a command without diagnostics".into());
        };
        let scale = match &self.model.kind {
            Kind::Hill(hill) => 1.0 / hill.acceleration_max_m_s2,
            Kind::Linear(_) => 1.0,
        };
        let realised = response.realised_disturbance.as_ref();
        Ok(Step {
            input: (command * scale).as_slice().to_vec(),
            input_margin_nd: input_margin_nd(&self.model, command),
            cost: how.cost,
            horizon: how.horizon,
            branch: how.branch(),
            adapted_step: how.adapted_step,
            adapted_horizon: how.adapted_horizon,
            general_solver_calls: how.general_solver_calls,
            certified: response.certificate.as_ref().is_some_and(|proof| proof.passed),
            outside_assumed_set: realised.is_some_and(|realised| realised.outside_assumed_set),
            latency,
        })
    }
}
