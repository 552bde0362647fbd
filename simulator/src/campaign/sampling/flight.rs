//! One flight: the loop over the network closed from a start to the docking.

use std::time::Duration;

use nalgebra::DVector;
use rand_chacha::ChaCha12Rng;
use vbar_client::{Client, ClosedLoop};
use vbar_proto::v1::{
    self, Frame, Measurement, SamplingBranch, StepResponse, measurement, step_response,
    step_stream_request::Controller,
};

use super::{
    Flyable, Holding,
    vehicle::{Turning, Vehicle},
};
use crate::{
    campaign::{
        SimulationError,
        flight::{ask, stream_of_chance},
    },
    mission::sampling_model::SamplingModel,
};

/// A row exceeded by more than this counts as violated, in the row's own units; what a certificate
/// passes for rows of unit length.
const ROW_TOLERANCE: f64 = 1e-8;

/// One flight.
#[derive(Debug, Clone)]
pub struct SamplingFlight {
    /// Number of the run: repetitions of the first start first.
    pub run: u32,
    /// Name of the start.
    pub start: String,
    /// Flown without the problem's first-step set, because the start lies outside it.
    pub excluded_start: bool,
    /// How it ended.
    pub outcome: SamplingOutcome,
    /// True states at k = 0, 1, ...
    pub samples: Vec<SamplingSample>,
    /// Commands at k = 0, 1, ...; one fewer than samples.
    pub steps: Vec<SamplingStep>,
    /// Angle and rate at k = 0, 1, ..., deg and deg/s; empty without an attitude loop.
    pub attitude: Vec<[f64; 2]>,
    /// Between two commands.
    pub sample_time_s: f64,
}

/// How a flight ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SamplingOutcome {
    /// Within the docking distance.
    Docked,
    /// No command was possible; the service's reason.
    Infeasible(String),
    /// The mission's longest duration has passed.
    StepsExhausted,
}

/// The truth at one instant.
#[derive(Debug, Clone)]
pub struct SamplingSample {
    /// SI, the target at the origin.
    pub state: Vec<f64>,
    /// From the target.
    pub distance_m: f64,
    /// Which rows of the state constraints are violated.
    pub violated: Vec<bool>,
}

/// One command and how it came about.
#[derive(Debug, Clone)]
pub struct SamplingStep {
    /// What was asked for.
    pub command_n: Vec<f64>,
    /// What the thrusters made of it.
    pub delivered_n: Vec<f64>,
    /// Least margin to the input constraints, N.
    pub input_margin_n: f64,
    /// Whose answer it is.
    pub branch: SamplingBranch,
    /// The command was moved into the input set.
    pub clipped: bool,
    /// Expected cost of the plan.
    pub expected_cost: f64,
    /// Rows that entered or left the active set.
    pub iterations: i32,
    /// The general solver had to decide.
    pub general_solver: bool,
    /// The certificate passed.
    pub certified: bool,
    /// Time from question to answer, as the client sees it.
    pub latency: Duration,
}

impl SamplingFlight {
    /// It came within the docking distance.
    #[must_use]
    pub fn docked(&self) -> bool {
        self.outcome == SamplingOutcome::Docked
    }

    /// From the start to the last sample.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.sample_time_s * self.steps.len() as f64
    }

    /// Sum of |force|, 1-norm, times the sample time [Mammarella2019, eq. 25]; of what was
    /// delivered.
    #[must_use]
    pub fn effort_ns(&self) -> f64 {
        let forces = self.steps.iter().flat_map(|step| &step.delivered_n);
        self.sample_time_s * forces.map(|force| force.abs()).sum::<f64>()
    }

    /// Samples after the start at which a row of the state constraints was violated, row by row.
    #[must_use]
    pub fn violations(&self) -> Vec<usize> {
        let rows = self.samples.first().map_or(0, |sample| sample.violated.len());
        let flown = &self.samples[1..];
        (0..rows).map(|row| flown.iter().filter(|sample| sample.violated[row]).count()).collect()
    }

    /// Commands of the previous plan's tail, which carries no guarantee.
    #[must_use]
    pub fn tail_steps(&self) -> usize {
        let tail = |step: &&SamplingStep| step.branch == SamplingBranch::PreviousPlanTail;
        self.steps.iter().filter(tail).count()
    }

    /// The largest angle from the wanted attitude once the flight has lasted `settled_s`.
    #[must_use]
    pub fn largest_angle_deg(&self, settled_s: f64) -> Option<f64> {
        let settled = self
            .attitude
            .iter()
            .enumerate()
            .filter(|(k, _)| *k as f64 * self.sample_time_s >= settled_s);
        settled.map(|(_, [angle, _])| angle.abs()).reduce(f64::max)
    }
}

/// Flies run number `run`. Chance is that of the run: every controller meets the same.
pub(super) async fn fly(
    client: &Client,
    flyable: &Flyable,
    run: u32,
) -> Result<SamplingFlight, SimulationError> {
    let simulation = &flyable.mission.simulation;
    let start = &simulation.starts[(run / flyable.repetitions) as usize];
    let state = start.state(&simulation.target_m);
    let mut chance = stream_of_chance(flyable.seed, run, 0);
    let model = &flyable.model;
    let sample_time_s = model.sample_time_s;
    let mut vehicle = Vehicle::new(&simulation.truth, &state, sample_time_s, &mut chance);
    let mut session = Session::open(client, &flyable.artifact_id, run).await?;
    let mut attitude = match &flyable.attitude {
        None => None,
        Some(holding) => Some(AttitudeLoop::open(client, flyable, holding, run).await?),
    };
    let thrusters = simulation.thrusters.thrusters();
    let mut flight = SamplingFlight {
        run,
        start: start.name.clone(),
        excluded_start: flyable.excluded_starts,
        outcome: SamplingOutcome::StepsExhausted,
        samples: vec![sample(model, &vehicle.state())],
        steps: Vec::new(),
        attitude: attitude.iter().map(|attitude| attitude.turning.state).collect(),
        sample_time_s,
    };
    for k in 0..simulation.docking.steps_max {
        let decided = session.decide(k, measurement(model, k, &vehicle.state())).await?;
        let (response, latency) = match decided {
            Decision::Command(response, latency) => (response, latency),
            Decision::Infeasible(reason) => {
                flight.outcome = SamplingOutcome::Infeasible(reason);
                break;
            }
        };
        let step = read(model, &response, latency)
            .map_err(|what| SimulationError::Answer { run, what })?;
        let delivered_n = thrusters.delivered(&step.command_n, sample_time_s);
        vehicle.advance(&delivered_n, &simulation.disturbance, sample_time_s, &mut chance);
        flight.steps.push(SamplingStep { delivered_n, ..step });
        flight.samples.push(sample(model, &vehicle.state()));
        if let Some(attitude) = &mut attitude {
            flight.attitude.push(attitude.turn(k, sample_time_s).await?);
        }
        let near = flight
            .samples
            .last()
            .is_some_and(|sample| sample.distance_m <= simulation.docking.distance_m);
        if near {
            flight.outcome = SamplingOutcome::Docked;
            break;
        }
    }
    Ok(flight)
}

/// The second loop: the chaser's angle under a controller of its own.
struct AttitudeLoop<'a> {
    session: Session,
    holding: &'a Holding,
    turning: Turning,
    chance: ChaCha12Rng,
    run: u32,
}

impl<'a> AttitudeLoop<'a> {
    async fn open(
        client: &Client,
        flyable: &Flyable,
        holding: &'a Holding,
        run: u32,
    ) -> Result<Self, SimulationError> {
        let mut chance = stream_of_chance(flyable.seed, run, 1);
        let turning = Turning::new(&holding.law, &mut chance);
        let session = Session::open(client, &holding.artifact_id, run).await?;
        Ok(Self { session, holding, turning, chance, run })
    }

    /// Holds the attitude over one sample; the state after it.
    async fn turn(&mut self, k: u32, sample_time_s: f64) -> Result<[f64; 2], SimulationError> {
        let run = self.run;
        let answer = |what: String| SimulationError::Answer { run, what };
        let model = &self.holding.model;
        let state = DVector::from_column_slice(&self.turning.state);
        let torque_nm = match self.session.decide(k, measurement(model, k, &state)).await? {
            Decision::Command(response, latency) => {
                read(model, &response, latency).map_err(answer)?.command_n[0]
            }
            // It turns on freely; the report shows how far.
            Decision::Infeasible(_) => 0.0,
        };
        let law = &self.holding.law;
        self.turning.advance(torque_nm, &law.disturbance, sample_time_s, &mut self.chance);
        Ok(self.turning.state)
    }
}

/// A loop over the network.
struct Session {
    closed_loop: ClosedLoop,
    run: u32,
}

enum Decision {
    Command(Box<StepResponse>, Duration),
    Infeasible(String),
}

impl Session {
    async fn open(client: &Client, artifact_id: &str, run: u32) -> Result<Self, SimulationError> {
        let controller = Controller::ArtifactId(artifact_id.to_owned());
        let opened = client.closed_loop(controller).await;
        let opened = opened.map_err(|source| SimulationError::Client { run, source })?;
        Ok(Self { closed_loop: opened.without_prediction(), run })
    }

    /// Asks for the command of step `k` and checks that the answer is for it.
    async fn decide(&mut self, k: u32, question: Measurement) -> Result<Decision, SimulationError> {
        let run = self.run;
        let (response, latency) = ask(&mut self.closed_loop, question, run).await?;
        let answer = |what: String| SimulationError::Answer { run, what };
        if u32::try_from(response.step_index) != Ok(k) {
            return Err(answer(format!("step {k} was answered as {}", response.step_index)));
        }
        match &response.verdict {
            Some(step_response::Verdict::Command(_)) => {
                Ok(Decision::Command(response.into(), latency))
            }
            Some(step_response::Verdict::Infeasible(why)) => {
                Ok(Decision::Infeasible(why.reason.clone()))
            }
            Some(other) => Err(answer(format!("neither a command nor a reason: {other:?}"))),
            None => Err(answer("a step without a verdict".into())),
        }
    }
}

fn measurement(model: &SamplingModel, k: u32, state: &DVector<f64>) -> Measurement {
    let state = if model.relative {
        measurement::State::Relative(v1::RelativeState {
            frame: Frame::Rtn.into(),
            position_m: state.as_slice()[..3].to_vec(),
            velocity_m_s: state.as_slice()[3..].to_vec(),
        })
    } else {
        measurement::State::Linear(v1::LinearState { components: state.as_slice().to_vec() })
    };
    let elapsed_s = Some(model.sample_time_s * f64::from(k));
    Measurement { state: Some(state), elapsed_s, ..Measurement::default() }
}

/// The command of an answer and how it came about; nothing delivered yet.
fn read(
    model: &SamplingModel,
    response: &StepResponse,
    latency: Duration,
) -> Result<SamplingStep, String> {
    let Some(step_response::Verdict::Command(command)) = &response.verdict else {
        return Err("an answer without a command".into());
    };
    let Some(step_response::Diagnostics::OfflineSampling(how)) = &response.diagnostics else {
        return Err("a command without diagnostics".into());
    };
    if model.relative && command.frame() != Frame::Rtn {
        return Err("a command that is not in RTN".into());
    }
    let command_n = if model.relative { &command.force_n } else { &command.input_nd };
    if command_n.len() != model.inputs() || command_n.iter().any(|value| !value.is_finite()) {
        return Err(format!("{} finite inputs, got {command_n:?}", model.inputs()));
    }
    Ok(SamplingStep {
        command_n: command_n.clone(),
        delivered_n: Vec::new(),
        input_margin_n: model.input_set.margin(&DVector::from_column_slice(command_n)),
        branch: how.branch(),
        clipped: how.clipped,
        expected_cost: how.expected_cost.ok_or("a command without its expected cost")?,
        iterations: how.iterations,
        general_solver: how.general_solver,
        certified: response.certificate.as_ref().is_some_and(|proof| proof.passed),
        latency,
    })
}

fn sample(model: &SamplingModel, state: &DVector<f64>) -> SamplingSample {
    let margins = &model.state_set.offsets - &model.state_set.normals * state;
    SamplingSample {
        state: state.as_slice().to_vec(),
        distance_m: state.rows(0, state.len() / 2).norm(),
        violated: margins.iter().map(|margin| *margin < -ROW_TOLERANCE).collect(),
    }
}
