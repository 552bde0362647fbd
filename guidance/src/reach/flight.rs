//! A flight sampled in time, and what happens between its samples.

use nalgebra::{Matrix3, Vector3};

use crate::{
    dynamics::{PeriodicPlant, RelativeVector},
    matrices::product_fixed,
};

/// States at equal times: the samples of a plant and the parts between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Flight {
    spacing_s: f64,
    states: Vec<RelativeVector>,
}

/// The closest moment of a flight, between samples too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Closest {
    /// p'Wp of the position, or |p|^2 in square metres without W.
    pub least: f64,
    /// Seconds after the flight's start.
    pub at_s: f64,
}

impl Flight {
    /// From sample `start` under forces held for a step each, newtons, RTN.
    #[must_use]
    pub fn under(
        plant: &PeriodicPlant,
        start: usize,
        x: &RelativeVector,
        forces_n: &[Vector3<f64>],
    ) -> Self {
        let parts = plant.fraction_count();
        let mut states = Vec::with_capacity(forces_n.len() * parts + 1);
        let mut x = *x;
        states.push(x);
        for (j, force) in forces_n.iter().enumerate() {
            for part in 1..parts {
                states.push(plant.fraction(start + j, part).advance(&x, force));
            }
            x = plant.advance(start + j, &x, force);
            states.push(x);
        }
        Self { spacing_s: plant.sample_time().seconds() / parts as f64, states }
    }

    /// Without thrust, for `steps` steps.
    #[must_use]
    pub fn drifting(plant: &PeriodicPlant, start: usize, x: &RelativeVector, steps: usize) -> Self {
        let parts = plant.fraction_count();
        let mut states = Vec::with_capacity(steps * parts + 1);
        let mut x = *x;
        states.push(x);
        for j in 0..steps {
            let between =
                (1..parts).map(|part| product_fixed(&plant.fraction(start + j, part).a, &x));
            states.extend(between);
            x = product_fixed(&plant.step(start + j).a, &x);
            states.push(x);
        }
        Self { spacing_s: plant.sample_time().seconds() / parts as f64, states }
    }

    /// From states that are `spacing_s` apart.
    #[must_use]
    pub fn from_states(spacing_s: f64, states: Vec<RelativeVector>) -> Self {
        Self { spacing_s, states }
    }

    /// The states.
    #[must_use]
    pub fn states(&self) -> &[RelativeVector] {
        &self.states
    }

    /// Seconds between them.
    #[must_use]
    pub fn spacing_s(&self) -> f64 {
        self.spacing_s
    }

    /// The closest moment to the target's centre of mass; `least` is in square metres, infinite
    /// for a flight without states.
    #[must_use]
    pub fn closest_to_target(&self) -> Closest {
        let never = Closest { least: f64::INFINITY, at_s: 0.0 };
        self.closest(&Matrix3::identity()).unwrap_or(never)
    }

    /// The least p'Wp over the whole flight, W (3 x 3) positive definite.
    ///
    /// Between samples the position is the cubic through their positions and velocities. Its error
    /// is about (n dt)^4 / 384 of the distance for a mean motion n: 4e-9 for 30 s in low orbit.
    #[must_use]
    pub fn closest(&self, weight: &Matrix3<f64>) -> Option<Closest> {
        let form = |p: &Vector3<f64>| p.dot(&(weight * p));
        let at = |i: usize| self.states[i].fixed_rows::<3>(0).into_owned();
        let first = self.states.first().map(|_| Closest { least: form(&at(0)), at_s: 0.0 })?;
        let sampled = (1..self.states.len()).fold(first, |best, i| {
            let least = form(&at(i));
            if least < best.least {
                Closest { least, at_s: i as f64 * self.spacing_s }
            } else {
                best
            }
        });
        Some((1..self.states.len()).fold(sampled, |best, i| {
            let within = Segment::between(&self.states[i - 1], &self.states[i], self.spacing_s);
            // No point of a cubic leaves the hull of its control points, so its gauge is at least
            // the ends' less the polygon's length.
            let gauge = |p: &Vector3<f64>| form(p).sqrt();
            let polygon: f64 = within.control.windows(2).map(|c| gauge(&(c[1] - c[0]))).sum();
            let ends = gauge(&within.control[0]).min(gauge(&within.control[3]));
            if ends - polygon >= best.least.sqrt() {
                return best;
            }
            let (least, share) = within.least(&form);
            if least < best.least {
                Closest { least, at_s: (i as f64 - 1.0 + share) * self.spacing_s }
            } else {
                best
            }
        }))
    }
}

/// A cubic by its control points.
struct Segment {
    control: [Vector3<f64>; 4],
}

impl Segment {
    fn between(from: &RelativeVector, to: &RelativeVector, spacing_s: f64) -> Self {
        let p = |x: &RelativeVector| x.fixed_rows::<3>(0).into_owned();
        let v = |x: &RelativeVector| x.fixed_rows::<3>(3) * (spacing_s / 3.0);
        Self { control: [p(from), p(from) + v(from), p(to) - v(to), p(to)] }
    }

    fn at(&self, share: f64) -> Vector3<f64> {
        let [a, b, c, d] = &self.control;
        let rest = 1.0 - share;
        a * (rest * rest * rest)
            + b * (3.0 * rest * rest * share)
            + c * (3.0 * rest * share * share)
            + d * (share * share * share)
    }

    /// Least value of `form`, and where: a scan, then golden sections around its best.
    fn least(&self, form: &impl Fn(&Vector3<f64>) -> f64) -> (f64, f64) {
        const SCAN: usize = 16;
        let value = |share: f64| form(&self.at(share));
        let best = (0..=SCAN)
            .map(|i| i as f64 / SCAN as f64)
            .min_by(|a, b| value(*a).total_cmp(&value(*b)))
            .unwrap_or(0.0);
        let width = 1.0 / SCAN as f64;
        let (mut low, mut high) = ((best - width).max(0.0), (best + width).min(1.0));
        let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
        for _ in 0..40 {
            let (left, right) = (high - golden * (high - low), low + golden * (high - low));
            if value(left) < value(right) {
                high = right;
            } else {
                low = left;
            }
        }
        let middle = 0.5 * (low + high);
        if value(middle) < value(best) { (value(middle), middle) } else { (value(best), best) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closest_moment_between_samples_is_found() {
        // Straight past the target at 5 m/s, 3 m aside: nearest 0.4 s after the second sample.
        let state = |t: f64| {
            RelativeVector::from_column_slice(&[5.0 * (t - 30.4), 3.0, 0.0, 5.0, 0.0, 0.0])
        };
        let flight = Flight::from_states(30.0, vec![state(0.0), state(30.0), state(60.0)]);
        let closest = flight.closest(&Matrix3::identity()).unwrap();
        assert!((closest.least.sqrt() - 3.0).abs() < 1e-9 && (closest.at_s - 30.4).abs() < 1e-6);
        assert_eq!(Flight::from_states(1.0, Vec::new()).closest(&Matrix3::identity()), None);
    }
}
