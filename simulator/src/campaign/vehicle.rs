//! The true state and what moves it.

use nalgebra::{DVector, Vector3, Vector6};
use rand::Rng;

use crate::{
    mission::{
        law::{RunDisturbance, TruthLaw, six},
        model::{HillModel, Kind, Model},
    },
    plant::{hill::HillPlant, two_body::TwoBody},
};

/// A plant in some state.
#[derive(Debug, Clone)]
pub(crate) enum Vehicle {
    /// Hill's equations, SI.
    Hill { plant: Box<HillPlant>, state: Vector6<f64> },
    /// Two bodies in inertial space.
    TwoBody(Box<TwoBody>),
    /// A general linear plant, in its own units.
    Linear { state: DVector<f64> },
}

impl Vehicle {
    /// At `start`: SI for a spacecraft, the plant's units otherwise.
    pub(crate) fn new(model: &Model, truth: &TruthLaw, start: &DVector<f64>) -> Self {
        match (&model.kind, truth) {
            (Kind::Linear(_), _) => Self::Linear { state: start.clone() },
            (Kind::Hill(hill), TruthLaw::Linear) => Self::Hill {
                plant: Box::new(HillPlant::new(hill.mean_motion_rad_s, hill.sample_time_s)),
                state: six(start),
            },
            (Kind::Hill(_), TruthLaw::TwoBody(elements)) => {
                Self::TwoBody(Box::new(TwoBody::new(&elements.radians(), elements.j2, &six(start))))
            }
        }
    }

    /// What a perfect sensor sees: SI in RTN, or the plant's units.
    pub(crate) fn state(&self) -> DVector<f64> {
        match self {
            Self::Hill { state, .. } => DVector::from_column_slice(state.as_slice()),
            Self::TwoBody(pair) => DVector::from_column_slice(pair.relative().as_slice()),
            Self::Linear { state } => state.clone(),
        }
    }

    /// Applies a command for one sample: m/s^2 for a spacecraft, the plant's units otherwise.
    pub(crate) fn advance(
        &mut self,
        model: &Model,
        command: &DVector<f64>,
        disturbance: &RunDisturbance,
        chance: &mut impl Rng,
    ) {
        let additive = disturbance.additive(model, chance);
        match (self, &model.kind) {
            (Self::Linear { state }, Kind::Linear(linear)) => {
                *state = linear.plant.advance(state, command) + additive;
            }
            (Self::Hill { plant, state }, Kind::Hill(hill)) => {
                let thrust = disturbance.applied(&thrust(command));
                *state = plant.advance(state, &thrust) + hill.to_si(&additive);
            }
            (Self::TwoBody(pair), Kind::Hill(hill)) => {
                pair.advance(hill.sample_time_s, &disturbance.applied(&thrust(command)));
            }
            (Self::Linear { .. }, Kind::Hill(_))
            | (Self::Hill { .. } | Self::TwoBody(_), Kind::Linear(_)) => {
                unreachable!("a vehicle is made from its own model")
            }
        }
    }
}

fn thrust(command: &DVector<f64>) -> Vector3<f64> {
    Vector3::new(command[0], command[1], command[2])
}

/// What the rules say about a state at sample `k`: least margin, normalised; `None` where there is
/// no constraint or the reference has ended.
pub(crate) fn state_margin_nd(model: &Model, k: usize, state: &DVector<f64>) -> Option<f64> {
    match &model.kind {
        Kind::Linear(linear) => linear.state_set.as_ref().map(|set| set.margin(state)),
        Kind::Hill(hill) => {
            let cone = hill.cone?;
            let port = hill.target.at(k)?.port_m;
            let position = Vector3::new(state[0], state[1], state[2]);
            Some(cone.margin_m(&port, &position) / hill.position_unit_m())
        }
    }
}

/// Least margin of a command, normalised: bounds and further half-spaces.
pub(crate) fn input_margin_nd(model: &Model, command: &DVector<f64>) -> f64 {
    match &model.kind {
        Kind::Hill(hill) => 1.0 - command.amax() / hill.acceleration_max_m_s2,
        Kind::Linear(linear) => {
            let bounds =
                (command - &linear.input_lower).min().min((&linear.input_upper - command).min());
            linear.input_set.as_ref().map_or(bounds, |set| bounds.min(set.margin(command)))
        }
    }
}

/// The reference at sample `k`, in the units of the state; `None` beyond its end.
pub(crate) fn reference(model: &Model, k: usize) -> Option<DVector<f64>> {
    match &model.kind {
        Kind::Linear(linear) => linear.reference(k),
        Kind::Hill(hill) => hill_reference(hill, k),
    }
}

fn hill_reference(hill: &HillModel, k: usize) -> Option<DVector<f64>> {
    let points = hill.target.at(k)?;
    let (position, velocity) = (points.capture_m, points.capture_velocity_m_s);
    Some(DVector::from_vec([position.as_slice(), velocity.as_slice()].concat()))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha12Rng;

    use super::*;
    use crate::{
        mission::{Mission, variable_horizon_mut},
        tests::{golden_cases, vector},
    };

    /// Foreign numbers: the recorded spacecraft loops, replayed through the SI plant, with
    /// reference and disturbance scaled by the simulator's own units.
    #[test]
    fn vehicle_replays_recorded_loops() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        let mission = Mission::load(&folder.join("leo_tumbler.json")).expect("a mission");
        let mut checked = 0;
        for trace in golden_cases("traces_atc.json") {
            let physical = &trace["physical"];
            let number = |key: &str| physical[key].as_f64().expect(key);
            let mut problem = mission.problem.clone();
            if let Some(inner) = variable_horizon_mut(&mut problem)
                && let Some(vbar_proto::v1::variable_horizon_problem::Plant::Hill(hill)) =
                    &mut inner.plant
            {
                use vbar_proto::v1::hill_plant::{Orbit, Sampling};
                hill.orbit = Some(Orbit::MeanMotionDegS(number("eta").to_degrees()));
                hill.sampling = Some(Sampling::SampleTimeS(number("dt_s")));
                hill.acceleration_max_m_s2 = Some(number("a_max"));
            }
            let model = Model::new(&problem).expect("a model");
            let Kind::Hill(hill) = &model.kind else { panic!("a spacecraft") };
            let unit = hill.position_unit_m();
            assert!((unit / number("pos_unit_m") - 1.0).abs() < 1e-12);
            let steps = trace["steps"].as_array().expect("steps");
            let mut chance = ChaCha12Rng::seed_from_u64(0);
            for (index, step) in steps.iter().enumerate() {
                let start = hill.to_si(&vector(&step["x"]));
                let start = DVector::from_column_slice(start.as_slice());
                let mut vehicle = Vehicle::new(&model, &TruthLaw::Linear, &start);
                let command = vector(&step["u_used"]) * hill.acceleration_max_m_s2;
                let w = RunDisturbance::Constant(vector(&step["w"]));
                vehicle.advance(&model, &command, &w, &mut chance);
                let recorded = match steps.get(index + 1) {
                    Some(next) => hill.to_si(&vector(&next["x"])),
                    None => hill.to_si(&vector(&trace["x_final"])),
                };
                let error = (six(&vehicle.state()) - recorded).amax();
                // States reach 50 m; the numbers are recorded to full precision.
                assert!(error < 1e-11, "{} step {index}: {error} m", trace["id"]);
                checked += 1;
            }
        }
        assert!(checked > 60, "only {checked} steps");
    }
}
