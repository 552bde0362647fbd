//! Motion between two moments at which it is known (Hermite interpolation).

use nalgebra::{Vector3, Vector6};

use super::two_body::{position_of, stacked, velocity_of};

/// Position at `fraction` in [0, 1] of `span_s` between two states [position m, velocity m/s].
///
/// The error is at most `span^4 / 384` times the position's fourth derivative.
pub(crate) fn cubic(
    from: &Vector6<f64>,
    to: &Vector6<f64>,
    span_s: f64,
    fraction: f64,
) -> Vector3<f64> {
    let s = fraction;
    let rest = 1.0 - s;
    position_of(from) * ((1.0 + 2.0 * s) * rest * rest)
        + velocity_of(from) * (span_s * s * rest * rest)
        + position_of(to) * (s * s * (3.0 - 2.0 * s))
        - velocity_of(to) * (span_s * s * s * rest)
}

/// A moment of a motion: [position m, velocity m/s] and acceleration, m/s^2.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    pub state: Vector6<f64>,
    pub acceleration: Vector3<f64>,
}

/// State at `fraction` in [0, 1] of `span_s` between two moments.
///
/// The position's error is at most `span^6 / 46080` times its sixth derivative.
pub(super) fn quintic(from: &Moment, to: &Moment, span_s: f64, fraction: f64) -> Vector6<f64> {
    let (s, h) = (fraction, span_s);
    let (p, v) = (position_of(&from.state), velocity_of(&from.state) * h);
    let half_a = from.acceleration * (0.5 * h * h);
    // What constant acceleration would leave undone, and its first two derivatives in `s`.
    let missed = position_of(&to.state) - p - v - half_a;
    let missed_speed = velocity_of(&to.state) * h - v - half_a * 2.0;
    let missed_pull = to.acceleration * (h * h) - half_a * 2.0;
    let third = missed * 10.0 - missed_speed * 4.0 + missed_pull * 0.5;
    let fourth = missed * -15.0 + missed_speed * 7.0 - missed_pull;
    let fifth = missed * 6.0 - missed_speed * 3.0 + missed_pull * 0.5;
    let position = p + (v + (half_a + (third + (fourth + fifth * s) * s) * s) * s) * s;
    let slope = v + (half_a * 2.0 + (third * 3.0 + (fourth * 4.0 + fifth * (5.0 * s)) * s) * s) * s;
    stacked(&position, &(slope / h))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Any polynomial of the degree comes back, with its derivative.
    #[test]
    fn interpolation_is_exact_for_polynomials_of_its_degree() {
        let at = |degree: i32, t: f64| {
            let power = |k: i32| if k < 0 { 0.0 } else { t.powi(k) };
            let d = f64::from(degree);
            let direction = Vector3::new(1.0, -2.0, 0.5);
            Moment {
                state: stacked(&(direction * power(degree)), &(direction * d * power(degree - 1))),
                acceleration: direction * d * (d - 1.0) * power(degree - 2),
            }
        };
        let (start, span) = (1.5, 0.8);
        for degree in 0..=5 {
            let (from, to) = (at(degree, start), at(degree, start + span));
            for fraction in [0.0, 0.3, 0.5, 0.9, 1.0] {
                let expected = at(degree, start + span * fraction).state;
                let found = quintic(&from, &to, span, fraction);
                // Rounding of the largest power here, 2.3^5 = 64.
                assert!((found - expected).amax() < 1e-12, "degree {degree}: {found} {expected}");
                if degree <= 3 {
                    let found = cubic(&from.state, &to.state, span, fraction);
                    assert!((found - position_of(&expected)).amax() < 1e-12, "degree {degree}");
                }
            }
        }
    }
}
