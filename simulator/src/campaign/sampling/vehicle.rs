//! The true state and what moves it.

use nalgebra::{DVector, Vector2, Vector3, Vector4, Vector6};
use rand::Rng;

use crate::{
    mission::{
        law::{six, uniform},
        sampling_law::{AttitudeLaw, Drawn, HillLaw, NoiseLaw, PlanarLaw, SamplingTruth},
    },
    plant::{hill::HillPlant, planar::PlanarPlant, two_body::TwoBody},
};

/// A chaser in some state, with the parameters drawn for it.
#[derive(Debug, Clone)]
pub(crate) enum Vehicle {
    /// On a flat table.
    Planar { law: PlanarLaw, parameters: [f64; 4], state: Vector4<f64> },
    /// By Hill's equations.
    Hill { law: HillLaw, plant: Box<HillPlant>, mass_kg: f64, state: Vector6<f64> },
    /// In inertial space.
    TwoBody { pair: Box<TwoBody>, mass_kg: f64 },
}

impl Vehicle {
    /// At `start`, SI with the target at the origin, with its first parameters drawn.
    pub(crate) fn new(
        truth: &SamplingTruth,
        start: &DVector<f64>,
        sample_time_s: f64,
        chance: &mut impl Rng,
    ) -> Self {
        match truth {
            SamplingTruth::Planar(law) => Self::Planar {
                law: law.clone(),
                parameters: draw_planar(law, chance),
                state: Vector4::from_column_slice(start.as_slice()),
            },
            SamplingTruth::Hill(law) => {
                let (plant, mass_kg) = draw_hill(law, sample_time_s, chance);
                Self::Hill { law: law.clone(), plant: plant.into(), mass_kg, state: six(start) }
            }
            SamplingTruth::TwoBody(law) => {
                let pair = TwoBody::new(&law.orbit.radians(), law.orbit.j2, &six(start));
                let [low, high] = law.mass_kg;
                Self::TwoBody { pair: pair.into(), mass_kg: uniform(chance, low, high) }
            }
        }
    }

    /// What a perfect sensor sees, SI.
    pub(crate) fn state(&self) -> DVector<f64> {
        match self {
            Self::Planar { state, .. } => DVector::from_column_slice(state.as_slice()),
            Self::Hill { state, .. } => DVector::from_column_slice(state.as_slice()),
            Self::TwoBody { pair, .. } => DVector::from_column_slice(pair.relative().as_slice()),
        }
    }

    /// Moves on by one sample under `force_n`, then adds what disturbs the state.
    pub(crate) fn advance(
        &mut self,
        force_n: &[f64],
        disturbance: &[NoiseLaw],
        sample_time_s: f64,
        chance: &mut impl Rng,
    ) {
        self.redraw(sample_time_s, chance);
        let noise: Vec<f64> = disturbance.iter().map(|law| law.draw(chance)).collect();
        match self {
            Self::Planar { law, parameters, state } => {
                let plant = PlanarPlant { coupling: law.coupling, mass_kg: law.mass_kg };
                let force = Vector2::from_column_slice(force_n);
                *state = plant.advance(state, &force, parameters, sample_time_s)
                    + Vector4::from_column_slice(&noise);
            }
            Self::Hill { plant, mass_kg, state, .. } => {
                let acceleration = Vector3::from_column_slice(force_n) / *mass_kg;
                *state = plant.advance(state, &acceleration) + Vector6::from_column_slice(&noise);
            }
            Self::TwoBody { pair, mass_kg } => {
                pair.advance(sample_time_s, &(Vector3::from_column_slice(force_n) / *mass_kg));
                // The mission refuses laws of the position for this truth.
                pair.push(&Vector3::from_column_slice(&noise[3..]));
            }
        }
    }

    /// Draws the parameters of the coming sample, where the law says so.
    fn redraw(&mut self, sample_time_s: f64, chance: &mut impl Rng) {
        match self {
            Self::Planar { law, parameters, .. } if law.drawn == Drawn::EachStep => {
                *parameters = draw_planar(law, chance);
            }
            Self::Hill { law, plant, mass_kg, .. } if law.drawn == Drawn::EachStep => {
                let drawn = draw_hill(law, sample_time_s, chance);
                (**plant, *mass_kg) = drawn;
            }
            Self::Planar { .. } | Self::Hill { .. } | Self::TwoBody { .. } => {}
        }
    }
}

fn draw_planar(law: &PlanarLaw, chance: &mut impl Rng) -> [f64; 4] {
    law.parameters.map(|[low, high]| uniform(chance, low, high))
}

fn draw_hill(law: &HillLaw, sample_time_s: f64, chance: &mut impl Rng) -> (HillPlant, f64) {
    let [low, high] = law.mean_motion_deg_s;
    let plant = HillPlant::new(uniform(chance, low, high).to_radians(), sample_time_s);
    (plant, uniform(chance, law.mass_kg[0], law.mass_kg[1]))
}

/// A chaser that turns about one axis.
#[derive(Debug, Clone)]
pub(crate) struct Turning {
    inertia_kg_m2: f64,
    /// Angle and rate, deg and deg/s.
    pub state: [f64; 2],
}

impl Turning {
    pub(crate) fn new(law: &AttitudeLaw, chance: &mut impl Rng) -> Self {
        let [low, high] = law.inertia_kg_m2;
        Self { inertia_kg_m2: uniform(chance, low, high), state: law.start }
    }

    /// Turns for one sample under a constant torque, then adds what disturbs the state.
    pub(crate) fn advance(
        &mut self,
        torque_nm: f64,
        disturbance: &[NoiseLaw; 2],
        duration_s: f64,
        chance: &mut impl Rng,
    ) {
        let [angle, rate] = self.state;
        let pushed = (torque_nm / self.inertia_kg_m2).to_degrees() * duration_s;
        self.state = [
            angle + (rate + 0.5 * pushed) * duration_s + disturbance[0].draw(chance),
            rate + pushed + disturbance[1].draw(chance),
        ];
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha12Rng;

    use super::*;
    use crate::{mission::law::OrbitElements, mission::sampling_law::TwoBodyLaw};

    const QUIET: [NoiseLaw; 6] = [NoiseLaw::None; 6];

    fn flown(truth: &SamplingTruth, force: [f64; 3], samples: usize) -> DVector<f64> {
        let mut chance = ChaCha12Rng::seed_from_u64(1);
        let start = DVector::from_vec(vec![1.0, -20.0, 0.5, 0.0, 0.1, 0.0]);
        let mut vehicle = Vehicle::new(truth, &start, 10.0, &mut chance);
        for _ in 0..samples {
            vehicle.advance(&force, &QUIET, 10.0, &mut chance);
        }
        vehicle.state()
    }

    /// Two laws of motion written apart agree where both hold: near the target, for minutes.
    #[test]
    fn vehicle_moves_alike_by_hill_and_in_inertial_space() {
        let semi_major_axis_km: f64 = 6778.137;
        let mean_motion = (398_600.441_8 / semi_major_axis_km.powi(3)).sqrt().to_degrees();
        let hill = SamplingTruth::Hill(HillLaw {
            mean_motion_deg_s: [mean_motion; 2],
            mass_kg: [500.0; 2],
            drawn: Drawn::EachStep,
        });
        let orbit = OrbitElements {
            semi_major_axis_km,
            eccentricity: 0.0,
            inclination_deg: 51.6,
            ascending_node_deg: 0.0,
            argument_of_perigee_deg: 0.0,
            mean_anomaly_deg: 30.0,
            j2: false,
        };
        let inertial = SamplingTruth::TwoBody(TwoBodyLaw { orbit, mass_kg: [500.0; 2] });
        let force = [0.3, -0.2, 0.1];
        let [hill, inertial] = [hill, inertial].map(|truth| flown(&truth, force, 20));
        // The linear model drops terms of 30 m / 6778 km of the tidal acceleration: 0.1 mm here.
        assert!((&hill - &inertial).amax() < 1e-3, "{hill} {inertial}");
        assert!(hill.rows(0, 3).norm() > 10.0, "it has hardly moved: {hill}");
    }

    #[test]
    fn vehicle_draws_its_parameters_as_often_as_its_law_says() {
        let law = |drawn| {
            SamplingTruth::Hill(HillLaw {
                mean_motion_deg_s: [0.06, 0.07],
                mass_kg: [400.0, 600.0],
                drawn,
            })
        };
        let masses = |truth: &SamplingTruth| -> Vec<f64> {
            let mut chance = ChaCha12Rng::seed_from_u64(7);
            let mut vehicle = Vehicle::new(truth, &DVector::zeros(6), 10.0, &mut chance);
            let mut mass = || {
                vehicle.advance(&[0.0; 3], &QUIET, 10.0, &mut chance);
                match &vehicle {
                    Vehicle::Hill { mass_kg, .. } => *mass_kg,
                    other => panic!("{other:?}"),
                }
            };
            (0..50).map(|_| mass()).collect()
        };
        let each_run = masses(&law(Drawn::EachRun));
        assert!(each_run.iter().all(|mass| *mass == each_run[0]));
        let each_step = masses(&law(Drawn::EachStep));
        assert!(each_step.windows(2).all(|pair| pair[0] != pair[1]));
        assert!(each_step.iter().all(|mass| (400.0..600.0).contains(mass)));
    }

    #[test]
    fn turning_under_a_torque_is_uniformly_accelerated() {
        let mut turning = Turning { inertia_kg_m2: 0.25, state: [10.0, -1.0] };
        let quiet = [NoiseLaw::None; 2];
        turning.advance(0.01, &quiet, 5.0, &mut ChaCha12Rng::seed_from_u64(0));
        let acceleration = 0.04_f64.to_degrees();
        let expected = [10.0 - 5.0 + 12.5 * acceleration, -1.0 + 5.0 * acceleration];
        for (is, should) in turning.state.iter().zip(expected) {
            assert!((is - should).abs() < 1e-12, "{:?}", turning.state);
        }
    }
}
