//! Laws of chance of a campaign: initial states, disturbances, randomised parameters.
//!
//! Every draw takes its stream of chance as an argument, so a run depends on the seed and its own
//! number alone.

use std::num::NonZeroU32;

use nalgebra::{DVector, Vector3, Vector6};
use rand::{Rng, RngExt as _};
use serde::Deserialize;
use vbar_proto::v1;

use crate::{
    mission::{
        model::{DisturbanceModel, HillModel, Kind, Model},
        variable_horizon_mut,
    },
    plant::two_body::Elements,
};

/// Draws of a rejection law before it gives up.
const DRAWS_MAX: u32 = 1_000_000;

/// Which equations move the true state.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum TruthLaw {
    /// The problem's own linear model: Hill's equations in SI, or the general linear plant.
    Linear,
    /// Both spacecraft in inertial space.
    TwoBody(OrbitElements),
}

/// Osculating elements of the target at the mission's start.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct OrbitElements {
    pub semi_major_axis_km: f64,
    pub eccentricity: f64,
    pub inclination_deg: f64,
    pub ascending_node_deg: f64,
    pub argument_of_perigee_deg: f64,
    pub mean_anomaly_deg: f64,
    pub j2: bool,
}

impl OrbitElements {
    pub(crate) fn radians(&self) -> Elements {
        Elements {
            semi_major_axis_m: self.semi_major_axis_km * 1e3,
            eccentricity: self.eccentricity,
            inclination_rad: self.inclination_deg.to_radians(),
            ascending_node_rad: self.ascending_node_deg.to_radians(),
            argument_of_perigee_rad: self.argument_of_perigee_deg.to_radians(),
            mean_anomaly_rad: self.mean_anomaly_deg.to_radians(),
        }
    }

    pub(crate) fn check(&self, place: &str, faults: &mut Vec<String>) {
        let perigee_km = self.semi_major_axis_km * (1.0 - self.eccentricity);
        if !(0.0..1.0).contains(&self.eccentricity) || !(6400.0..1e6).contains(&perigee_km) {
            faults.push(format!("{place}: an ellipse with its perigee above 6400 km"));
        }
        let angles = [
            self.inclination_deg,
            self.ascending_node_deg,
            self.argument_of_perigee_deg,
            self.mean_anomaly_deg,
        ];
        if angles.iter().any(|angle| !angle.is_finite() || angle.abs() > 360.0) {
            faults.push(format!("{place}: angles within a full turn"));
        }
    }
}

impl TruthLaw {
    pub(crate) fn check(&self, place: &str, model: &Model, faults: &mut Vec<String>) {
        let Self::TwoBody(elements) = self else { return };
        if matches!(model.kind, Kind::Linear(_)) {
            faults.push(format!("{place}.two_body: only for a spacecraft plant"));
        }
        elements.check(&format!("{place}.two_body"), faults);
    }
}

/// How x(0) is chosen.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum InitialLaw {
    /// Given, SI.
    Fixed { position_m: [f64; 3], velocity_m_s: [f64; 3] },
    /// Given, in the linear plant's units.
    FixedComponents(Vec<f64>),
    /// Direction uniform on the sphere and distance uniform between the two values, kept if inside
    /// the docking cone at k = 0; velocity uniform per axis.
    InCone { distance_m: [f64; 2], velocity_half_width_m_s: f64 },
    /// Uniform in a box of a two-state linear plant, leaving out S(infinity) of its gain.
    Box { lower: Vec<f64>, upper: Vec<f64>, exclude_invariant_set: bool },
}

impl InitialLaw {
    pub(crate) fn check(&self, place: &str, model: &Model, faults: &mut Vec<String>) {
        let finite = |values: &[f64]| values.iter().all(|value| value.is_finite());
        let hill = match &model.kind {
            Kind::Hill(hill) => Some(hill),
            Kind::Linear(_) => None,
        };
        match self {
            Self::Fixed { position_m, velocity_m_s } => {
                if hill.is_none() || !finite(position_m) || !finite(velocity_m_s) {
                    faults.push(format!("{place}.fixed: finite values, for a spacecraft plant"));
                }
            }
            Self::FixedComponents(components) => {
                if hill.is_some() || components.len() != model.states() || !finite(components) {
                    let states = model.states();
                    faults.push(format!("{place}.fixed_components: {states} for a linear plant"));
                }
            }
            Self::InCone { distance_m: [near, far], velocity_half_width_m_s } => {
                if hill.is_none_or(|hill| hill.cone.is_none()) {
                    faults.push(format!("{place}.in_cone: only with a docking cone"));
                }
                if !(finite(&[*near, *far]) && *near > 0.0 && near <= far) {
                    faults.push(format!("{place}.in_cone.distance_m: 0 < near <= far"));
                }
                if !(velocity_half_width_m_s.is_finite() && *velocity_half_width_m_s >= 0.0) {
                    faults.push(format!("{place}.in_cone.velocity_half_width_m_s: >= 0"));
                }
            }
            Self::Box { lower, upper, exclude_invariant_set } => {
                let states = model.states();
                let ordered = lower.iter().zip(upper).all(|(l, u)| l <= u);
                let sizes = lower.len() == states && upper.len() == states;
                if hill.is_some() || !sizes || !finite(lower) || !finite(upper) || !ordered {
                    faults.push(format!("{place}.box: {states} ordered bounds, linear plant"));
                }
                if *exclude_invariant_set && states != 2 {
                    faults.push(format!("{place}.box.exclude_invariant_set: two states only"));
                }
            }
        }
    }

    /// Draws a state: SI for a spacecraft, the plant's own units otherwise. `invariant` tells
    /// whether a state lies in S(infinity). `None` when the law keeps rejecting.
    pub(crate) fn draw(
        &self,
        model: &Model,
        invariant: &dyn Fn(&DVector<f64>) -> bool,
        chance: &mut impl Rng,
    ) -> Option<DVector<f64>> {
        match (self, &model.kind) {
            (Self::Fixed { position_m, velocity_m_s }, _) => {
                Some(DVector::from_vec([position_m.as_slice(), velocity_m_s].concat()))
            }
            (Self::FixedComponents(components), _) => Some(DVector::from_column_slice(components)),
            (Self::InCone { distance_m, velocity_half_width_m_s }, Kind::Hill(hill)) => {
                in_cone(hill, *distance_m, *velocity_half_width_m_s, chance)
            }
            (Self::InCone { .. }, Kind::Linear(_)) => None,
            (Self::Box { lower, upper, exclude_invariant_set }, _) => {
                (0..DRAWS_MAX).find_map(|_| {
                    let state = DVector::from_iterator(
                        lower.len(),
                        lower.iter().zip(upper).map(|(l, u)| uniform(chance, *l, *u)),
                    );
                    (!(*exclude_invariant_set && invariant(&state))).then_some(state)
                })
            }
        }
    }
}

fn in_cone(
    hill: &HillModel,
    [near, far]: [f64; 2],
    speed: f64,
    chance: &mut impl Rng,
) -> Option<DVector<f64>> {
    let cone = hill.cone?;
    let port = hill.target.at(0)?.port_m;
    for _ in 0..DRAWS_MAX {
        let position = direction(chance) * uniform(chance, near, far);
        if cone.margin_m(&port, &position) >= 0.0 {
            let velocity: [f64; 3] = std::array::from_fn(|_| uniform(chance, -speed, speed));
            return Some(DVector::from_vec([position.as_slice(), &velocity].concat()));
        }
    }
    None
}

/// A direction uniform on the sphere: height and longitude are uniform (Archimedes).
fn direction(chance: &mut impl Rng) -> Vector3<f64> {
    let height = uniform(chance, -1.0, 1.0);
    let (s, c) = uniform(chance, 0.0, std::f64::consts::TAU).sin_cos();
    let radius = (1.0 - height * height).sqrt();
    Vector3::new(radius * c, radius * s, height)
}

pub(crate) fn uniform(chance: &mut impl Rng, lower: f64, upper: f64) -> f64 {
    lower + (upper - lower) * chance.random::<f64>()
}

/// What disturbs the plant.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum DisturbanceLaw {
    /// Nothing.
    None,
    /// Uniform in W at every step (in the generators' cube, if W is a zonotope).
    Uniform,
    /// A random vertex of W (a random choice of signs) at every step.
    Vertices,
    /// One random vertex a run.
    ConstantVertex,
    /// The same given vector at every step, scaled units.
    Constant { components_nd: Vec<f64> },
    /// The applied thrust is turned by a small rotation, drawn once a run, uniform per axis:
    /// u + angle x u.
    Misalignment { angle_max_deg: f64 },
    /// The same with given angles.
    FixedMisalignment { angle_deg: [f64; 3] },
}

impl DisturbanceLaw {
    pub(crate) fn check(
        &self,
        place: &str,
        model: &Model,
        truth: &TruthLaw,
        faults: &mut Vec<String>,
    ) {
        let hill = matches!(model.kind, Kind::Hill(_));
        let two_body = matches!(truth, TruthLaw::TwoBody(_));
        let additive = matches!(
            self,
            Self::Uniform | Self::Vertices | Self::ConstantVertex | Self::Constant { .. }
        );
        if additive && two_body {
            faults.push(format!("{place}: additive laws need the linear truth"));
        }
        let samples_w = matches!(self, Self::Uniform | Self::Vertices | Self::ConstantVertex);
        if samples_w && matches!(model.disturbance, DisturbanceModel::FromErrors) {
            faults.push(format!("{place}: W is made from errors; use a misalignment law"));
        }
        match self {
            Self::Constant { components_nd } => {
                let states = model.states();
                if components_nd.len() != states || components_nd.iter().any(|c| !c.is_finite()) {
                    faults.push(format!("{place}.constant: {states} finite components"));
                }
            }
            Self::Misalignment { angle_max_deg } => {
                if !hill || !(0.0..=90.0).contains(angle_max_deg) {
                    faults.push(format!("{place}.misalignment: 0 to 90 degrees, spacecraft only"));
                }
            }
            Self::FixedMisalignment { angle_deg } => {
                if !hill || angle_deg.iter().any(|a| !(-90.0..=90.0).contains(a)) {
                    faults.push(format!("{place}.fixed_misalignment: within 90 degrees"));
                }
            }
            Self::None | Self::Uniform | Self::Vertices | Self::ConstantVertex => {}
        }
    }

    /// What is settled once a run.
    pub(crate) fn begin(&self, model: &Model, chance: &mut impl Rng) -> RunDisturbance {
        match self {
            Self::None => RunDisturbance::None,
            Self::Uniform => RunDisturbance::Uniform,
            Self::Vertices => RunDisturbance::Vertices,
            Self::ConstantVertex => {
                RunDisturbance::Constant(sample(&model.disturbance, model.states(), &mut || {
                    sign(chance)
                }))
            }
            Self::Constant { components_nd } => {
                RunDisturbance::Constant(DVector::from_column_slice(components_nd))
            }
            Self::Misalignment { angle_max_deg } => {
                let largest = angle_max_deg.to_radians();
                let angles: [f64; 3] = std::array::from_fn(|_| uniform(chance, -largest, largest));
                RunDisturbance::Misalignment(Vector3::from(angles))
            }
            Self::FixedMisalignment { angle_deg } => {
                RunDisturbance::Misalignment(Vector3::from(*angle_deg).map(f64::to_radians))
            }
        }
    }
}

/// The disturbance of one run.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum RunDisturbance {
    None,
    Uniform,
    Vertices,
    Constant(DVector<f64>),
    /// Small rotation of the thrust, rad.
    Misalignment(Vector3<f64>),
}

impl RunDisturbance {
    /// Additive part at one step, scaled units; zero for a misalignment, which acts on the thrust.
    pub(crate) fn additive(&self, model: &Model, chance: &mut impl Rng) -> DVector<f64> {
        let states = model.states();
        match self {
            Self::None | Self::Misalignment(_) => DVector::zeros(states),
            Self::Constant(components) => components.clone(),
            Self::Uniform => sample(&model.disturbance, states, &mut || uniform(chance, -1.0, 1.0)),
            Self::Vertices => sample(&model.disturbance, states, &mut || sign(chance)),
        }
    }

    /// The acceleration that really acts when `commanded` was asked for: u + angle x u, the small
    /// rotation M(angle) of [Quartullo2025a, sec. V.B].
    pub(crate) fn applied(&self, commanded: &Vector3<f64>) -> Vector3<f64> {
        match self {
            Self::Misalignment(angle) => commanded + angle.cross(commanded),
            _ => *commanded,
        }
    }
}

fn sign(chance: &mut impl Rng) -> f64 {
    if chance.random::<bool>() { 1.0 } else { -1.0 }
}

fn sample(set: &DisturbanceModel, states: usize, factor: &mut dyn FnMut() -> f64) -> DVector<f64> {
    match set {
        DisturbanceModel::None | DisturbanceModel::FromErrors => DVector::zeros(states),
        DisturbanceModel::Box(half_widths) => half_widths.map(|half_width| half_width * factor()),
        DisturbanceModel::Zonotope(generators) => {
            generators * DVector::from_fn(generators.ncols(), |_, _| factor())
        }
    }
}

/// Parameters of a spacecraft mission drawn anew for every run.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Randomisation {
    /// Least and greatest maximum acceleration, uniform between.
    pub acceleration_max_m_s2: Option<[f64; 2]>,
    /// Least and greatest spin period, uniform between; the axis is that of the problem's spin.
    pub spin_period_s: Option<[f64; 2]>,
    /// Starts drawn with the same parameters before these are drawn again: what is refused for
    /// weak parameters would otherwise leave few of them among the runs.
    #[serde(default = "one_start")]
    pub starts_per_draw: NonZeroU32,
}

fn one_start() -> NonZeroU32 {
    NonZeroU32::MIN
}

impl Randomisation {
    pub(crate) fn check(&self, place: &str, model: &Model, faults: &mut Vec<String>) {
        if matches!(model.kind, Kind::Linear(_)) {
            faults.push(format!("{place}: only for a spacecraft plant"));
        }
        let ranges = [
            ("acceleration_max_m_s2", self.acceleration_max_m_s2),
            ("spin_period_s", self.spin_period_s),
        ];
        for (field, range) in ranges {
            if let Some([least, greatest]) = range
                && !(least.is_finite() && greatest.is_finite() && least > 0.0 && least <= greatest)
            {
                faults.push(format!("{place}.{field}: 0 < least <= greatest"));
            }
        }
        let spins = match &model.kind {
            Kind::Hill(hill) => match hill.target.motion {
                crate::plant::rotation::BodyMotion::Spin(rate) => rate.norm() > 0.0,
                _ => false,
            },
            Kind::Linear(_) => false,
        };
        if self.spin_period_s.is_some() && !spins {
            faults.push(format!("{place}.spin_period_s: the problem's target must spin"));
        }
    }

    /// Draws the parameters and writes them into `problem`.
    pub(crate) fn apply(&self, problem: &mut v1::Problem, chance: &mut impl Rng) {
        let acceleration = self.acceleration_max_m_s2.map(|[l, u]| uniform(chance, l, u));
        let period = self.spin_period_s.map(|[l, u]| uniform(chance, l, u));
        let Some(inner) = variable_horizon_mut(problem) else { return };
        let Some(v1::variable_horizon_problem::Plant::Hill(hill)) = &mut inner.plant else {
            return;
        };
        if acceleration.is_some() {
            hill.acceleration_max_m_s2 = acceleration;
        }
        if let Some(v1::TargetRotation { motion: Some(v1::target_rotation::Motion::Spin(spin)) }) =
            &mut hill.rotation
            && let Some(period) = period
        {
            let rate = &mut spin.angular_velocity_deg_s;
            let length = rate.iter().map(|c| c * c).sum::<f64>().sqrt();
            for component in rate {
                *component *= 360.0 / (period * length);
            }
        }
    }
}

/// A six-vector from a general one.
pub(crate) fn six(state: &DVector<f64>) -> Vector6<f64> {
    Vector6::from_fn(|row, _| state[row])
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha12Rng;

    use super::*;
    use crate::mission::Mission;

    fn mission(name: &str) -> Mission {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        Mission::load(&folder.join(name)).expect(name)
    }

    #[test]
    fn law_in_cone_stays_in_cone_and_distance_range() {
        let mission = mission("leo_tumbler.json");
        let model = Model::new(&mission.problem).expect("model");
        let Kind::Hill(hill) = &model.kind else { panic!("a spacecraft") };
        let mut chance = ChaCha12Rng::seed_from_u64(1);
        let law = &mission.simulation.initial_state;
        let mut mean = 0.0;
        for _ in 0..500 {
            let state = law.draw(&model, &|_| false, &mut chance).expect("a draw");
            let position = Vector3::new(state[0], state[1], state[2]);
            assert!((20.0..=85.0).contains(&position.norm()));
            assert!(hill.cone.unwrap().margin_m(&hill.target.capture_m, &position) >= 0.0);
            assert!((3..6).all(|row| state[row].abs() <= 0.01));
            mean += position.norm() / 500.0;
        }
        // Uniform in [20, 85] has mean 52.5 and deviation 18.8; the apex at 1.5 m hardly matters.
        assert!((mean - 52.5).abs() < 3.5, "{mean}");
    }

    #[test]
    fn law_directions_are_uniform_on_the_sphere() {
        let mut chance = ChaCha12Rng::seed_from_u64(2);
        let mut second = nalgebra::Matrix3::zeros();
        for _ in 0..20_000 {
            let d = direction(&mut chance);
            assert!((d.norm() - 1.0).abs() < 1e-12);
            second += d * d.transpose() / 20_000.0;
        }
        // E[d d'] = I / 3, standard error about 0.002.
        assert!((second - nalgebra::Matrix3::identity() / 3.0).amax() < 0.01, "{second}");
    }

    #[test]
    fn law_vertices_lie_on_the_corners_and_uniform_inside() {
        let model = Model::new(&mission("leo_tumbler.json").problem).expect("model");
        let DisturbanceModel::Box(half) = &model.disturbance else { panic!("a box") };
        let mut chance = ChaCha12Rng::seed_from_u64(3);
        for _ in 0..100 {
            let corner = RunDisturbance::Vertices.additive(&model, &mut chance);
            assert!((0..6).all(|row| corner[row].abs() == half[row]));
            let inside = RunDisturbance::Uniform.additive(&model, &mut chance);
            assert!((0..6).all(|row| inside[row].abs() <= half[row]));
        }
    }

    #[test]
    fn law_misalignment_is_the_papers_matrix() {
        let angle = Vector3::new(0.01, -0.02, 0.03);
        let u = Vector3::new(0.3, -0.7, 0.9);
        // M of [Quartullo2025a, sec. V.B], written out.
        let m = nalgebra::Matrix3::new(
            0.0, -angle[2], angle[1], angle[2], 0.0, -angle[0], -angle[1], angle[0], 0.0,
        );
        let applied = RunDisturbance::Misalignment(angle).applied(&u);
        assert!((applied - (u + m * u)).norm() < 1e-16);
    }

    #[test]
    fn law_randomisation_sets_period_and_acceleration() {
        let mission = mission("leo_tumbler.json");
        let randomised = mission.simulation.randomised.as_ref().expect("randomised");
        let mut chance = ChaCha12Rng::seed_from_u64(4);
        for _ in 0..100 {
            let mut problem = mission.problem.clone();
            randomised.apply(&mut problem, &mut chance);
            let model = Model::new(&problem).expect("model");
            let Kind::Hill(hill) = &model.kind else { panic!("a spacecraft") };
            assert!((0.005..=0.05).contains(&hill.acceleration_max_m_s2));
            let crate::plant::rotation::BodyMotion::Spin(rate) = hill.target.motion else {
                panic!("a spin")
            };
            assert!((300.0..=600.0).contains(&(std::f64::consts::TAU / rate.norm())));
            assert!(rate[2] > 0.0 && rate[0] == 0.0 && rate[1] == 0.0);
        }
    }
}
