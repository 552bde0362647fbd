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

    /// The least p'Wp over the whole flight, W (3 x 3) positive definite; `None` without states.
    ///
    /// Between samples the position is the cubic through their positions and velocities. Its error
    /// is about (n dt)^4 / 384 of the distance for a mean motion n: 4e-9 for 30 s in low orbit.
    #[must_use]
    pub fn closest(&self, weight: &Matrix3<f64>) -> Option<Closest> {
        let (instant, least) = self.least_at_instants(weight)?;
        let mut closest = Closest { least, at_s: instant as f64 * self.spacing_s };
        for (i, pair) in self.states.windows(2).enumerate() {
            let segment = Segment::between(&pair[0], &pair[1], self.spacing_s);
            if segment.stays_beyond(weight, closest.least) {
                continue;
            }
            let (least, share) = segment.least(|share| form(weight, &segment.position(share)));
            if least < closest.least {
                closest = Closest { least, at_s: (i as f64 + share) * self.spacing_s };
            }
        }
        Some(closest)
    }

    /// The first instant of the least p'Wp at the instants, with it; `None` without states.
    #[must_use]
    pub fn least_at_instants(&self, weight: &Matrix3<f64>) -> Option<(usize, f64)> {
        let values = self.states.iter().map(|x| form(weight, &position(x)));
        values.enumerate().reduce(|best, other| if other.1 < best.1 { other } else { best })
    }

    /// Seconds until p'Wp is at most 1 for the first time, between instants too.
    #[must_use]
    pub fn first_within(&self, weight: &Matrix3<f64>) -> Option<f64> {
        if self.states.first().is_some_and(|x| form(weight, &position(x)) <= 1.0) {
            return Some(0.0);
        }
        self.states.windows(2).enumerate().find_map(|(i, pair)| {
            let segment = Segment::between(&pair[0], &pair[1], self.spacing_s);
            if segment.stays_beyond(weight, 1.0) {
                return None;
            }
            let value = |share: f64| form(weight, &segment.position(share));
            let (least, share) = segment.least(value);
            (least <= 1.0).then(|| {
                // Outside where the segment begins, inside at its least: halved to rounding.
                let (mut outside, mut inside) = (0.0, share);
                for _ in 0..50 {
                    let middle = 0.5 * (outside + inside);
                    *(if value(middle) <= 1.0 { &mut inside } else { &mut outside }) = middle;
                }
                (i as f64 + inside) * self.spacing_s
            })
        })
    }
}

fn position(x: &RelativeVector) -> Vector3<f64> {
    x.fixed_rows::<3>(0).into_owned()
}

/// p'Wp.
fn form(weight: &Matrix3<f64>, p: &Vector3<f64>) -> f64 {
    p.dot(&(weight * p))
}

/// A cubic by its control points.
pub(super) struct Segment {
    pub(super) control: [Vector3<f64>; 4],
    spacing_s: f64,
}

impl Segment {
    pub(super) fn between(from: &RelativeVector, to: &RelativeVector, spacing_s: f64) -> Self {
        let (p, q) = (position(from), position(to));
        let way = |x: &RelativeVector| x.fixed_rows::<3>(3) * (spacing_s / 3.0);
        Self { control: [p, p + way(from), q - way(to), q], spacing_s }
    }

    /// Proves, if it can, that p'Wp stays at or above `least`: no point of a cubic leaves the hull
    /// of its control points, so its gauge is at least the ends' less the polygon's length.
    fn stays_beyond(&self, weight: &Matrix3<f64>, least: f64) -> bool {
        let [a, b, c, d] = &self.control;
        let ends = form(weight, a).min(form(weight, d));
        let sides = [b - a, c - b, d - c].map(|side| form(weight, &side));
        // Roots are dear: (a + b)^2 <= 2 a^2 + 2 b^2 settles what is far away.
        if ends >= 2.0 * least + 6.0 * (sides[0] + sides[1] + sides[2]) {
            return true;
        }
        let polygon: f64 = sides.iter().map(|side| side.sqrt()).sum();
        ends.sqrt() - polygon >= least.sqrt()
    }

    /// Control points of the velocity, which is a parabola.
    pub(super) fn velocity_control(&self) -> [Vector3<f64>; 3] {
        let rate = 3.0 / self.spacing_s;
        std::array::from_fn(|i| (self.control[i + 1] - self.control[i]) * rate)
    }

    pub(super) fn velocity(&self, share: f64) -> Vector3<f64> {
        let [a, b, c] = self.velocity_control();
        let rest = 1.0 - share;
        a * (rest * rest) + b * (2.0 * rest * share) + c * (share * share)
    }

    pub(super) fn position(&self, share: f64) -> Vector3<f64> {
        let [a, b, c, d] = &self.control;
        let rest = 1.0 - share;
        a * (rest * rest * rest)
            + b * (3.0 * rest * rest * share)
            + c * (3.0 * rest * share * share)
            + d * (share * share * share)
    }

    /// Least of `value` over the segment, and where: a scan, then golden sections around its best.
    pub(super) fn least(&self, value: impl Fn(f64) -> f64) -> (f64, f64) {
        const SCAN: usize = 16;
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
