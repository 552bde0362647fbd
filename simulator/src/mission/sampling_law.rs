//! Laws of a mission under sampled chance constraints: what moves the chaser, what disturbs it,
//! what its thrusters deliver, when it has docked.

use rand::{Rng, RngExt as _};
use serde::Deserialize;

use super::{
    law::{OrbitElements, uniform},
    parse_problem,
    sampling_model::SamplingModel,
};
use crate::plant::{planar::Coupling, thrusters::Thrusters};

/// What moves the chaser.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum SamplingTruth {
    /// On a flat table [Mammarella2019, eq. 24].
    Planar(PlanarLaw),
    /// By Hill's equations, in RTN.
    Hill(HillLaw),
    /// Both craft in inertial space; nothing can be added to a position there.
    TwoBody(TwoBodyLaw),
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PlanarLaw {
    /// Which A(q).
    pub coupling: Coupling,
    /// What q_4 deviates from.
    pub mass_kg: f64,
    /// Least and largest q_1 .. q_4, uniform.
    pub parameters: [[f64; 2]; 4],
    /// How often q is drawn.
    pub drawn: Drawn,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct HillLaw {
    /// Least and largest, uniform.
    pub mean_motion_deg_s: [f64; 2],
    /// Least and largest, uniform.
    pub mass_kg: [f64; 2],
    /// How often both are drawn.
    pub drawn: Drawn,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TwoBodyLaw {
    /// The target's orbit.
    pub orbit: OrbitElements,
    /// Least and largest, uniform, drawn once a run.
    pub mass_kg: [f64; 2],
}

/// How often uncertain parameters are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Drawn {
    /// Anew for every sample, as the paper's assumption 2 says.
    EachStep,
    /// Once a run, as a mass would.
    EachRun,
}

/// Law of one component of the disturbance; mean 0.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum NoiseLaw {
    /// Always 0.
    None,
    /// Uniform between -bound and bound.
    Uniform { bound: f64 },
    /// Gaussian of this deviation with everything outside +-bound cut off.
    TruncatedGaussian { deviation: f64, bound: f64 },
}

/// See [`Thrusters`].
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ThrusterLaw {
    pub force_max_n: f64,
    #[serde(default)]
    pub impulse_min_ns: f64,
}

/// When a flight ends.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Docking {
    /// Docked at this distance from the target.
    pub distance_m: f64,
    /// Given up after so many samples.
    pub steps_max: u32,
}

/// A chaser that turns about one axis under a torque, held by a controller of its own.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct AttitudeLaw {
    /// What the service is asked: state [angle deg, rate deg/s], input torque in N m, the wanted
    /// angle at the origin.
    problem: serde_json::Value,
    /// First angle and rate, deg and deg/s.
    pub start: [f64; 2],
    /// Least and largest, uniform, drawn once a run.
    pub inertia_kg_m2: [f64; 2],
    /// What is added to angle and rate after each sample, deg and deg/s.
    pub disturbance: [NoiseLaw; 2],
}

/// Most samples of one flight.
const STEPS_MAX: u32 = 100_000;

impl SamplingTruth {
    pub(crate) fn check(
        &self,
        place: &str,
        (states, inputs): (usize, usize),
        disturbance: &[NoiseLaw],
        faults: &mut Vec<String>,
    ) {
        let expected = if matches!(self, Self::Planar(_)) { (4, 2) } else { (6, 3) };
        if (states, inputs) != expected {
            faults.push(format!("{place}: not with {states} states and {inputs} inputs"));
        }
        match self {
            Self::Planar(law) => {
                if !(law.mass_kg.is_finite() && law.mass_kg > 0.0) {
                    faults.push(format!("{place}.planar.mass_kg: greater than 0"));
                }
                for (index, range) in law.parameters.iter().enumerate() {
                    check_range(&format!("{place}.planar.parameters[{index}]"), range, faults);
                }
                if !(1.0 / law.mass_kg + law.parameters[3][0] > 0.0) {
                    faults.push(format!("{place}.planar.parameters[3]: above -1 / mass"));
                }
            }
            Self::Hill(law) => {
                let place = format!("{place}.hill");
                check_positive(
                    &format!("{place}.mean_motion_deg_s"),
                    &law.mean_motion_deg_s,
                    faults,
                );
                check_positive(&format!("{place}.mass_kg"), &law.mass_kg, faults);
            }
            Self::TwoBody(law) => {
                let place = format!("{place}.two_body");
                law.orbit.check(&format!("{place}.orbit"), faults);
                check_positive(&format!("{place}.mass_kg"), &law.mass_kg, faults);
                if disturbance.iter().take(3).any(|law| *law != NoiseLaw::None) {
                    faults.push(format!("{place}: nothing can be added to a position here"));
                }
            }
        }
    }
}

impl NoiseLaw {
    pub(crate) fn check(&self, place: &str, faults: &mut Vec<String>) {
        let sound = match *self {
            Self::None => true,
            Self::Uniform { bound } => bound.is_finite() && bound >= 0.0,
            Self::TruncatedGaussian { deviation, bound } => {
                deviation.is_finite() && deviation > 0.0 && bound.is_finite() && bound > 0.0
            }
        };
        if !sound {
            faults.push(format!("{place}: bound >= 0 and deviation > 0, finite"));
        }
    }

    pub(crate) fn draw(&self, chance: &mut impl Rng) -> f64 {
        match *self {
            Self::None => 0.0,
            Self::Uniform { bound } => uniform(chance, -bound, bound),
            // Uniform proposals, kept with a share that follows the density: exact, and short of
            // work for the bounds below a deviation that missions have.
            Self::TruncatedGaussian { deviation, bound } => loop {
                let x = uniform(chance, -bound, bound);
                if chance.random::<f64>() < (-0.5 * (x / deviation).powi(2)).exp() {
                    return x;
                }
            },
        }
    }
}

impl ThrusterLaw {
    pub(crate) fn check(&self, place: &str, faults: &mut Vec<String>) {
        if !(self.force_max_n.is_finite() && self.force_max_n > 0.0) {
            faults.push(format!("{place}.force_max_n: greater than 0"));
        }
        if !(self.impulse_min_ns.is_finite() && self.impulse_min_ns >= 0.0) {
            faults.push(format!("{place}.impulse_min_ns: at least 0"));
        }
    }

    pub(crate) fn thrusters(self) -> Thrusters {
        Thrusters { force_max_n: self.force_max_n, impulse_min_ns: self.impulse_min_ns }
    }
}

impl Docking {
    pub(crate) fn check(self, place: &str, faults: &mut Vec<String>) {
        if !(self.distance_m.is_finite() && self.distance_m > 0.0) {
            faults.push(format!("{place}.distance_m: greater than 0"));
        }
        if !(1..=STEPS_MAX).contains(&self.steps_max) {
            faults.push(format!("{place}.steps_max: 1 to {STEPS_MAX}"));
        }
    }
}

impl AttitudeLaw {
    /// The problem of the attitude's controller.
    pub(crate) fn problem(&self) -> Result<vbar_proto::v1::Problem, super::MissionError> {
        parse_problem(self.problem.clone())
    }

    pub(crate) fn check(&self, place: &str, translation: &SamplingModel, faults: &mut Vec<String>) {
        match self.problem().map(|problem| SamplingModel::new(&problem)) {
            Err(fault) => faults.push(format!("{place}.problem: {fault}")),
            Ok(Err(inner)) => {
                faults.extend(inner.into_iter().map(|fault| format!("{place}.{fault}")));
            }
            Ok(Ok(model)) => {
                if (model.states(), model.inputs()) != (2, 1) {
                    faults.push(format!("{place}.problem: two states and one input"));
                }
                if model.sample_time_s != translation.sample_time_s {
                    faults.push(format!("{place}.problem: the sample time of the mission"));
                }
            }
        }
        if !self.start.iter().all(|value| value.is_finite()) {
            faults.push(format!("{place}.start: finite"));
        }
        check_positive(&format!("{place}.inertia_kg_m2"), &self.inertia_kg_m2, faults);
        for (index, law) in self.disturbance.iter().enumerate() {
            law.check(&format!("{place}.disturbance[{index}]"), faults);
        }
    }
}

fn check_range(place: &str, [low, high]: &[f64; 2], faults: &mut Vec<String>) {
    if !(low.is_finite() && high.is_finite() && low <= high) {
        faults.push(format!("{place}: least and largest, finite"));
    }
}

fn check_positive(place: &str, range: &[f64; 2], faults: &mut Vec<String>) {
    check_range(place, range, faults);
    if !(range[0] > 0.0) {
        faults.push(format!("{place}: greater than 0"));
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha12Rng;

    use super::*;

    #[test]
    fn noise_keeps_its_bounds_mean_and_deviation() {
        // Deviations of the laws in closed form: b / sqrt(3); for the standard normal cut at one
        // deviation sqrt(1 - 2 phi(1) / (2 Phi(1) - 1)) = 0.539 560.
        let cases = [
            (NoiseLaw::Uniform { bound: 0.3 }, 0.3 / 3.0_f64.sqrt(), 0.3),
            (NoiseLaw::TruncatedGaussian { deviation: 1.0, bound: 1.0 }, 0.539_560, 1.0),
            (
                NoiseLaw::TruncatedGaussian { deviation: 1.0, bound: 5e-3 },
                5e-3 / 3.0_f64.sqrt(),
                5e-3,
            ),
        ];
        let mut chance = ChaCha12Rng::seed_from_u64(3);
        let count = 40_000;
        for (law, deviation, bound) in cases {
            let drawn: Vec<f64> = (0..count).map(|_| law.draw(&mut chance)).collect();
            assert!(drawn.iter().all(|x| x.abs() <= bound), "{law:?}");
            let mean = drawn.iter().sum::<f64>() / f64::from(count);
            let square = drawn.iter().map(|x| x * x).sum::<f64>() / f64::from(count);
            // Five standard errors of the mean; the deviation's are smaller.
            let error = 5.0 * deviation / f64::from(count).sqrt();
            assert!(mean.abs() < error, "{law:?}: mean {mean}");
            assert!((square.sqrt() - deviation).abs() < error, "{law:?}: {}", square.sqrt());
        }
        assert_eq!(NoiseLaw::None.draw(&mut chance), 0.0);
    }
}
