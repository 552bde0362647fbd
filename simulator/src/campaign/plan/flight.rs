//! One flight of a plan, and the same nominal burns flown blindly.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use nalgebra::{Vector3, Vector6};
use rand::{Rng, RngExt as _};
use vbar_client::{Client, ClosedLoop};
use vbar_proto::v1::{
    self, ArrivalMetric, Frame, Measurement, StepResponse, measurement, step_response,
    step_stream_request::Controller,
};

use super::Flyable;
use crate::{
    campaign::{
        SimulationError,
        flight::{Patience, stream_of_chance},
    },
    mission::{
        plan::{NoiseLaw, PlanTruth},
        plan_model::PlanModel,
    },
    plant::{lvlh, two_body::TwoBody},
};

/// Pieces of the drawn path between two instants.
const PIECES: u32 = 24;

/// Largest disagreement with the node about times and distances, relative: rounding only.
const AGREEMENT: f64 = 1e-9;

/// Largest disagreement with the node about a level, relative: the sets' condition number times
/// rounding.
const LEVEL_AGREEMENT: f64 = 1e-6;

/// A level above 1 by no more than this is rounding.
pub(crate) const LEVEL_TOLERANCE: f64 = 1e-9;

/// One flight of a plan, from its first measurement to its arrival. Vectors are LVLH, m and m/s.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanFlight {
    /// Number of the run.
    pub run: u32,
    /// True and measured states at the instants, just before the burns.
    pub samples: Vec<PlanSample>,
    /// Burns at all instants but the last.
    pub burns: Vec<FlownBurn>,
    /// Disturbances the service saw between instants, in the measure of the assumed set: at most 1
    /// inside.
    pub disturbance_gauges: Vec<f64>,
    /// The service saw a disturbance outside the assumed set.
    pub outside_assumed_set: bool,
    /// Level of the measured position's error in the guaranteed arrival set, `sqrt(e' Q^-1 e)`
    /// [Deaconu2014, eq. 21]: at most 1 inside.
    pub position_level: f64,
    /// The same with position and velocity.
    pub state_level: f64,
    /// The same as `position_level` for the true position, which the set does not promise: it
    /// differs from the measured one by the last error.
    pub true_position_level: f64,
    /// Distance of the true position from the one wanted.
    pub final_distance_m: f64,
    /// The nominal burns alone, from the same start.
    pub open_loop: OpenLoopEnd,
    /// The true path in the orbital plane (x, z).
    pub path: Vec<(f64, f64)>,
    /// From question to answer, as the client sees it.
    pub latencies: Vec<Duration>,
}

/// A state at an instant.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanSample {
    /// Since the mission's start.
    pub elapsed_s: f64,
    /// Position and velocity as they are.
    pub truth: [f64; 6],
    /// As the service was told.
    pub measured: [f64; 6],
}

/// A burn as it was flown.
#[derive(Debug, Clone, PartialEq)]
pub struct FlownBurn {
    /// What acted.
    pub delta_v_m_s: [f64; 3],
    /// Its nominal part.
    pub nominal_m_s: [f64; 3],
    /// The correction before clipping.
    pub correction_m_s: [f64; 3],
    /// The wanted impulse exceeded the bound along some axis.
    pub clipped: bool,
    /// How far the measured state lay from the nominal one: at most 1 inside the planned bound.
    pub deviation_gauge: f64,
}

/// Where the nominal burns alone lead.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenLoopEnd {
    /// True state at the last instant.
    pub truth: [f64; 6],
    /// What would be measured there: the same last error.
    pub measured: [f64; 6],
    /// Level of the measured position's error in the arrival set guaranteed with feedback.
    pub position_level: f64,
    /// The same in the arrival set predicted without feedback, if the plan has it.
    pub own_position_level: Option<f64>,
    /// Distance of the true position from the one wanted.
    pub final_distance_m: f64,
}

impl OpenLoopEnd {
    /// The measured position would arrive inside the set guaranteed with feedback.
    #[must_use]
    pub fn inside(&self) -> bool {
        self.position_level <= 1.0 + LEVEL_TOLERANCE
    }
}

impl PlanFlight {
    /// The measured position arrived inside the guaranteed set.
    #[must_use]
    pub fn inside(&self) -> bool {
        self.position_level <= 1.0 + LEVEL_TOLERANCE
    }

    /// Sum of |delta-v| over burns and axes, m/s.
    #[must_use]
    pub fn fuel_m_s(&self) -> f64 {
        self.burns.iter().flat_map(|burn| burn.delta_v_m_s).map(f64::abs).sum()
    }

    /// Burns that were clipped.
    #[must_use]
    pub fn clipped_burns(&self) -> usize {
        self.burns.iter().filter(|burn| burn.clipped).count()
    }

    /// Largest disturbance seen, in the measure of the assumed set.
    #[must_use]
    pub fn largest_disturbance_gauge(&self) -> Option<f64> {
        self.disturbance_gauges.iter().copied().reduce(f64::max)
    }
}

/// Flies run number `run`.
pub(crate) async fn fly(
    client: &Client,
    flyable: &Arc<Flyable>,
    run: u32,
) -> Result<PlanFlight, SimulationError> {
    let model = &flyable.model;
    let errors = draw_errors(flyable, run);
    let open_loop = {
        let (flyable, errors) = (flyable.clone(), errors.clone());
        aside(move || fly_open_loop(&flyable, &errors)).await?
    };
    let mut flight = PlanFlight {
        run,
        samples: Vec::new(),
        burns: Vec::new(),
        disturbance_gauges: Vec::new(),
        outside_assumed_set: false,
        position_level: f64::NAN,
        state_level: f64::NAN,
        true_position_level: f64::NAN,
        final_distance_m: f64::NAN,
        open_loop,
        path: Vec::new(),
        latencies: Vec::new(),
    };
    let mut pair = truth_at_start(flyable, &errors);
    let mut session = Session::open(client, flyable, run).await?;
    let last = model.elapsed_s.len() - 1;
    for k in 0..=last {
        let truth = seen(&pair);
        // The planned first state is the first measurement itself.
        let measured = if k == 0 { model.initial } else { truth - errors[k] };
        let elapsed_s = model.elapsed_s[k];
        flight.samples.push(PlanSample {
            elapsed_s,
            truth: truth.into(),
            measured: measured.into(),
        });
        let burn = session.ask(k, &measured, &mut flight).await?;
        if k == last {
            break;
        }
        let Some(burn) = burn else {
            let what = format!("an arrival at instant {k} of {last}");
            return Err(SimulationError::Answer { run, what });
        };
        pair.push(&lvlh::rtn_from_lvlh(&Vector3::from(burn.delta_v_m_s)));
        flight.burns.push(burn);
        let duration_s = model.elapsed_s[k + 1] - elapsed_s;
        let (moved, way) = aside(move || coast(pair, duration_s)).await?;
        flight.path.extend(way);
        pair = moved;
    }
    flight.judge(flyable);
    Ok(flight)
}

impl PlanFlight {
    /// Fills in how well it arrived.
    fn judge(&mut self, flyable: &Flyable) {
        let Some(end) = self.samples.last() else { return };
        let wanted = &flyable.model.target;
        let measured = Vector6::from(end.measured) - wanted;
        let truth = Vector6::from(end.truth) - wanted;
        self.position_level = flyable.arrival.position_level(&measured);
        self.state_level = flyable.arrival.state_level(&measured);
        self.true_position_level = flyable.arrival.position_level(&truth);
        self.final_distance_m = truth.fixed_rows::<3>(0).norm();
    }
}

/// Errors of the measurements at all instants: true state minus measured state.
fn draw_errors(flyable: &Flyable, run: u32) -> Vec<Vector6<f64>> {
    let mut chance = stream_of_chance(flyable.seed, run, 1);
    let law = flyable.mission.simulation.noise;
    flyable.model.errors.iter().map(|root| root * draw_unit(law, &mut chance)).collect()
}

/// A point of the unit ball in six dimensions.
fn draw_unit(law: NoiseLaw, chance: &mut impl Rng) -> Vector6<f64> {
    if law == NoiseLaw::None {
        return Vector6::zeros();
    }
    // Six independent normal numbers point in a direction uniform on the sphere.
    let direction = loop {
        let normal = Vector6::from_fn(|_, _| standard_normal(chance));
        if normal.norm() > 0.0 {
            break normal.normalize();
        }
    };
    match law {
        // The share of the ball's volume below radius r is r^6.
        NoiseLaw::Inside => direction * chance.random::<f64>().powf(1.0 / 6.0),
        NoiseLaw::Surface | NoiseLaw::None => direction,
    }
}

/// Box and Muller.
pub(crate) fn standard_normal(chance: &mut impl Rng) -> f64 {
    let (uniform, angle) = (1.0 - chance.random::<f64>(), chance.random::<f64>());
    (-2.0 * uniform.ln()).sqrt() * (std::f64::consts::TAU * angle).cos()
}

fn truth_at_start(flyable: &Flyable, errors: &[Vector6<f64>]) -> TwoBody {
    let PlanTruth::TwoBody { j2 } = flyable.mission.simulation.truth;
    let start = flyable.model.initial + errors[0];
    TwoBody::new(&flyable.model.elements, j2, &lvlh::state_rtn_from_lvlh(&start))
}

/// What a perfect sensor sees, LVLH.
fn seen(pair: &TwoBody) -> Vector6<f64> {
    lvlh::state_lvlh_from_rtn(&pair.relative())
}

/// Computes elsewhere, so that answers are not kept waiting by it: an hour of orbit takes
/// milliseconds.
pub(crate) async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, SimulationError> {
    Ok(tokio::task::spawn_blocking(work).await?)
}

/// Moves both for `duration_s` without thrust and notes the way.
fn coast(mut pair: TwoBody, duration_s: f64) -> (TwoBody, Vec<(f64, f64)>) {
    let place = |pair: &TwoBody| {
        let state = seen(pair);
        (state[0], state[2])
    };
    let mut way = vec![place(&pair)];
    for _ in 0..PIECES {
        pair.advance(duration_s / f64::from(PIECES), &Vector3::zeros());
        way.push(place(&pair));
    }
    (pair, way)
}

/// The nominal burns alone, from the same true start.
fn fly_open_loop(flyable: &Flyable, errors: &[Vector6<f64>]) -> OpenLoopEnd {
    let model = &flyable.model;
    let mut pair = truth_at_start(flyable, errors);
    for (burn, times) in flyable.nominal.iter().zip(model.elapsed_s.windows(2)) {
        pair.push(&lvlh::rtn_from_lvlh(burn));
        pair.advance(times[1] - times[0], &Vector3::zeros());
    }
    let truth = seen(&pair);
    let measured = truth - errors[errors.len() - 1];
    let error = measured - model.target;
    OpenLoopEnd {
        truth: truth.into(),
        measured: measured.into(),
        position_level: flyable.arrival.position_level(&error),
        own_position_level: flyable
            .open_loop_arrival
            .as_ref()
            .map(|set| set.position_level(&error)),
        final_distance_m: (truth - model.target).fixed_rows::<3>(0).norm(),
    }
}

/// The nominal burns of a plan; the fault says how they contradict the problem.
pub(crate) fn nominal_burns(
    plan: &v1::DisturbanceFeedbackPlan,
    model: &PlanModel,
) -> Result<Vec<Vector3<f64>>, String> {
    let instants = model.elapsed_s.len();
    if plan.burns.len() + 1 != instants {
        return Err(format!("{} burns for {instants} instants", plan.burns.len()));
    }
    let duration = model.elapsed_s[instants - 1];
    let mut burns = Vec::new();
    for (k, burn) in plan.burns.iter().enumerate() {
        if (burn.elapsed_s - model.elapsed_s[k]).abs() > AGREEMENT * duration {
            let ours = model.elapsed_s[k];
            return Err(format!("burn {k} at {} s, it is due at {ours} s", burn.elapsed_s));
        }
        if burn.frame() != Frame::LvlhCcsds {
            return Err(format!("burn {k} is not in LVLH_CCSDS"));
        }
        let delta_v = components(&burn.delta_v_m_s).ok_or(format!("burn {k}: three numbers"))?;
        burns.push(delta_v);
    }
    Ok(burns)
}

/// A loop over the network, with everything the simulator expects of it.
struct Session<'a> {
    closed_loop: ClosedLoop,
    flyable: &'a Flyable,
    run: u32,
}

impl<'a> Session<'a> {
    async fn open(
        client: &Client,
        flyable: &'a Flyable,
        run: u32,
    ) -> Result<Self, SimulationError> {
        let controller = Controller::PlanId(flyable.plan_id.clone());
        let opened = client.closed_loop(controller).await;
        let opened = opened.map_err(|source| SimulationError::Client { run, source })?;
        Ok(Self { closed_loop: opened.without_prediction(), flyable, run })
    }

    /// Tells the measurement at instant `k` and takes the burn, or `None` at the arrival.
    async fn ask(
        &mut self,
        k: usize,
        measured: &Vector6<f64>,
        flight: &mut PlanFlight,
    ) -> Result<Option<FlownBurn>, SimulationError> {
        let question = Measurement {
            state: Some(measurement::State::Relative(v1::RelativeState {
                frame: Frame::LvlhCcsds.into(),
                position_m: measured.as_slice()[..3].to_vec(),
                velocity_m_s: measured.as_slice()[3..].to_vec(),
            })),
            elapsed_s: Some(self.flyable.model.elapsed_s[k]),
            ..Measurement::default()
        };
        let asked = Instant::now();
        let mut patience = Patience::new(self.run);
        let response = loop {
            match self.closed_loop.step(question.clone()).await {
                Ok(response) => break response,
                Err(error) => patience.after(error).await?,
            }
        };
        flight.latencies.push(asked.elapsed());
        if let Some(realised) = &response.realised_disturbance {
            flight.disturbance_gauges.extend(realised.gauge);
            flight.outside_assumed_set |= realised.outside_assumed_set;
        }
        let run = self.run;
        self.read(&response, k, measured).map_err(|what| SimulationError::Answer { run, what })
    }

    fn read(
        &self,
        response: &StepResponse,
        k: usize,
        measured: &Vector6<f64>,
    ) -> Result<Option<FlownBurn>, String> {
        if usize::try_from(response.step_index) != Ok(k) {
            return Err(format!("instant {k} was answered as {}", response.step_index));
        }
        if (response.realised_disturbance.is_some()) != (k > 0) {
            return Err(format!(
                "instant {k}: the disturbance seen belongs to every instant but 0"
            ));
        }
        match &response.verdict {
            None => Err("a step without a verdict".into()),
            Some(step_response::Verdict::Abort(_)) => {
                Err("an abort where none is to be had".into())
            }
            Some(step_response::Verdict::Infeasible(why)) => {
                Err(format!("a plan that cannot be flown: {}", why.reason))
            }
            Some(step_response::Verdict::Arrived(arrival)) => {
                self.check_arrival(arrival, k, measured)?;
                self.check_level(arrival, response, measured)?;
                Ok(None)
            }
            Some(step_response::Verdict::Command(command)) => {
                self.burn(command, response, k).map(Some)
            }
        }
    }

    /// The service must see the arrival as it is.
    fn check_arrival(
        &self,
        arrival: &v1::Arrival,
        k: usize,
        measured: &Vector6<f64>,
    ) -> Result<(), String> {
        let model = &self.flyable.model;
        if k + 1 != model.elapsed_s.len() {
            return Err(format!("an arrival at instant {k}"));
        }
        if usize::try_from(arrival.completion_steps) != Ok(k) {
            return Err(format!("{} burns, {k} were given", arrival.completion_steps));
        }
        let ours = (measured - model.target).fixed_rows::<3>(0).norm();
        let theirs = arrival.distance_m.ok_or("an arrival without its distance")?;
        if (ours - theirs).abs() > AGREEMENT * (1.0 + model.initial.fixed_rows::<3>(0).norm()) {
            return Err(format!("a final distance of {theirs} m, it was measured as {ours} m"));
        }
        Ok(())
    }

    /// The level is computed twice; here the two meet.
    fn check_level(
        &self,
        arrival: &v1::Arrival,
        response: &StepResponse,
        measured: &Vector6<f64>,
    ) -> Result<(), String> {
        let how = diagnostics(response)?;
        let theirs = how.arrival_level.ok_or("an arrival without its level")?;
        let error = measured - self.flyable.model.target;
        let ours = match self.flyable.mission.metric() {
            ArrivalMetric::Scaled6 | ArrivalMetric::Physical6 => {
                self.flyable.arrival.state_level(&error)
            }
            ArrivalMetric::Position | ArrivalMetric::Unspecified => {
                self.flyable.arrival.position_level(&error)
            }
        };
        if (ours - theirs).abs() > LEVEL_AGREEMENT * (1.0 + ours) {
            return Err(format!("an arrival at level {theirs}, by its own set it is {ours}"));
        }
        let inside = theirs <= 1.0 + LEVEL_AGREEMENT;
        if arrival.inside_guaranteed_set != inside {
            let said = arrival.inside_guaranteed_set;
            return Err(format!("an arrival at level {theirs} that is inside: {said}"));
        }
        Ok(())
    }

    fn burn(
        &self,
        command: &v1::Command,
        response: &StepResponse,
        k: usize,
    ) -> Result<FlownBurn, String> {
        let model = &self.flyable.model;
        let last = model.elapsed_s.len() - 1;
        if k >= last {
            return Err("a burn where the plan has arrived".into());
        }
        let due = model.elapsed_s[k];
        if (command.elapsed_s - due).abs() > AGREEMENT * model.elapsed_s[last] {
            return Err(format!("a burn for {} s, it is {due} s", command.elapsed_s));
        }
        if command.last != (k + 1 == last) {
            return Err(format!("burn {k} says last = {}", command.last));
        }
        if command.frame() != Frame::LvlhCcsds {
            return Err("a burn that is not in LVLH_CCSDS".into());
        }
        let delta_v = components(&command.delta_v_m_s).ok_or("a burn without its delta-v")?;
        if delta_v.amax() > model.delta_v_max_m_s * (1.0 + AGREEMENT) {
            return Err(format!("a burn beyond the bound: {:?} m/s", command.delta_v_m_s));
        }
        let how = diagnostics(response)?;
        let nominal = components(&how.nominal_delta_v_m_s).ok_or("a burn without nominal part")?;
        let correction = components(&how.correction_m_s).ok_or("a burn without correction")?;
        if !how.clipped && (nominal + correction - delta_v).amax() > AGREEMENT {
            return Err("a burn that is not the sum of its parts".into());
        }
        Ok(FlownBurn {
            delta_v_m_s: delta_v.into(),
            nominal_m_s: nominal.into(),
            correction_m_s: correction.into(),
            clipped: how.clipped,
            deviation_gauge: how.deviation_gauge,
        })
    }
}

fn diagnostics(response: &StepResponse) -> Result<&v1::DisturbanceFeedbackDiagnostics, String> {
    match &response.diagnostics {
        Some(step_response::Diagnostics::DisturbanceFeedback(how)) => Ok(how),
        _ => Err("an answer without diagnostics".into()),
    }
}

/// Three finite numbers.
fn components(values: &[f64]) -> Option<Vector3<f64>> {
    match values {
        [x, y, z] if values.iter().all(|value| value.is_finite()) => Some(Vector3::new(*x, *y, *z)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha12Rng;

    use super::*;

    #[test]
    fn noise_lies_where_its_law_says() {
        let mut chance = ChaCha12Rng::seed_from_u64(5);
        let (mut within, mut second) = (0_u32, nalgebra::Matrix6::zeros());
        for _ in 0..20_000 {
            let on = draw_unit(NoiseLaw::Surface, &mut chance);
            assert!((on.norm() - 1.0).abs() < 1e-12);
            second += on * on.transpose() / 20_000.0;
            let inside = draw_unit(NoiseLaw::Inside, &mut chance).norm();
            assert!(inside <= 1.0);
            within += u32::from(inside < 0.5_f64.powf(1.0 / 6.0));
        }
        // E[d d'] = I / 6, standard error about 0.002.
        assert!((second - nalgebra::Matrix6::identity() / 6.0).amax() < 0.01, "{second}");
        // Half of the volume lies within that radius; standard error 71.
        assert!(within.abs_diff(10_000) < 400, "{within}");
        assert_eq!(draw_unit(NoiseLaw::None, &mut chance), Vector6::zeros());
    }
}
