//! The classical Runge-Kutta method of fourth order, for states of any shape.

use std::ops::{Add, Mul};

/// The state `duration` after `state`, which holds at `start`.
///
/// `rate(time, state)` is the state's derivative; `step_max(time, state)` is the longest step
/// allowed from there.
pub(super) fn integrate<S>(
    state: S,
    start: f64,
    duration: f64,
    step_max: impl Fn(f64, &S) -> f64,
    rate: impl Fn(f64, &S) -> S,
) -> S
where
    S: Copy + Add<Output = S> + Mul<f64, Output = S>,
{
    let mut state = state;
    let mut left = duration;
    while left > 0.0 {
        // Equal steps as far as one looks from here, so that none is left over at the end.
        let time = start + (duration - left);
        let steps = (left / step_max(time, &state)).ceil();
        let step = if steps > 1.0 { left / steps } else { left };
        state = advance(state, time, step, &rate);
        left = if steps > 1.0 { left - step } else { 0.0 };
    }
    state
}

fn advance<S>(state: S, time: f64, h: f64, rate: &impl Fn(f64, &S) -> S) -> S
where
    S: Copy + Add<Output = S> + Mul<f64, Output = S>,
{
    let half = 0.5 * h;
    let first = rate(time, &state);
    let second = rate(time + half, &(state + first * half));
    let third = rate(time + half, &(state + second * half));
    let fourth = rate(time + h, &(state + third * h));
    state + (first + (second + third) * 2.0 + fourth) * (h / 6.0)
}
