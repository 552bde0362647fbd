//! How near a course comes to a region that must not be entered, between its samples too.

mod region;

pub(crate) use region::Region;

use crate::plant::{hermite, relative_truth::Course};

/// Refinement of a time: the share of a sampling interval below which nobody asks further. Near a
/// minimum the value is flat, so its own error is the square of this.
const RESOLUTION: f64 = 1e-6;

/// How a course passes a region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Clearance {
    /// Least gauge of the position: below 1 inside, 1 on the border.
    pub least_gauge: f64,
    /// When, s from the course's start.
    pub least_gauge_at_s: f64,
    /// Least gauge among the samples alone.
    pub least_gauge_sampled: f64,
    /// Least distance from the target's centre, m.
    pub least_distance_m: f64,
    /// When, s from the course's start.
    pub least_distance_at_s: f64,
    /// When the course is first inside, s from its start.
    pub entry_s: Option<f64>,
}

impl Clearance {
    /// Of a whole course, its continuous way between samples taken from positions and velocities
    /// at both ends.
    ///
    /// # Panics
    /// If the course has no state.
    pub(crate) fn of(course: &Course, region: &Region) -> Self {
        assert!(!course.states.is_empty(), "a course has at least one state");
        let gauge = |at: f64| region.gauge(&position(course, at));
        let (least_gauge, gauge_at) = least(course, &gauge);
        let (least_distance_m, distance_at) = least(course, &|at: f64| position(course, at).norm());
        let sampled = (0..course.states.len()).map(|index| gauge(index as f64));
        Self {
            least_gauge,
            least_gauge_at_s: gauge_at * course.spacing_s,
            least_gauge_sampled: sampled.fold(f64::INFINITY, f64::min),
            least_distance_m,
            least_distance_at_s: distance_at * course.spacing_s,
            entry_s: entry(course, &gauge).map(|at| at * course.spacing_s),
        }
    }
}

/// Position, m, at a time counted in sampling intervals from the course's start.
fn position(course: &Course, at: f64) -> nalgebra::Vector3<f64> {
    let last = course.states.len() - 1;
    let index = (at as usize).min(last.saturating_sub(1));
    let (from, to) = (&course.states[index], &course.states[(index + 1).min(last)]);
    hermite::cubic(from, to, course.spacing_s, at - index as f64)
}

/// The least value of `of` along the course, and where.
fn least(course: &Course, of: &impl Fn(f64) -> f64) -> (f64, f64) {
    let dips = dips(course, of);
    dips.into_iter().fold((f64::INFINITY, 0.0), |best, dip| if dip.0 < best.0 { dip } else { best })
}

/// Where `of` first falls below 1.
fn entry(course: &Course, of: &impl Fn(f64) -> f64) -> Option<f64> {
    if of(0.0) < 1.0 {
        return Some(0.0);
    }
    // A course that is outside at first and inside later passes a dip, and the first dip below 1
    // is the first of them all or lies behind none that is inside.
    let (_, inside) = dips(course, of).into_iter().find(|(value, _)| *value < 1.0)?;
    let before = (0..=inside as usize).take_while(|index| of(*index as f64) >= 1.0).last()?;
    let (mut outside, mut inside) = (before as f64, inside.min(before as f64 + 1.0));
    while inside - outside > RESOLUTION {
        let middle = 0.5 * (outside + inside);
        if of(middle) < 1.0 {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    Some(inside)
}

/// Every local minimum of `of` along the course, with its place, in order of time.
fn dips(course: &Course, of: &impl Fn(f64) -> f64) -> Vec<(f64, f64)> {
    let values: Vec<f64> = (0..course.states.len()).map(|index| of(index as f64)).collect();
    let last = values.len() - 1;
    let is_low = |index: &usize| {
        let left = index.checked_sub(1).is_none_or(|before| values[before] >= values[*index]);
        left && (*index == last || values[index + 1] >= values[*index])
    };
    let refined = (0..=last).filter(is_low).map(|index| {
        let (from, to) = (index.saturating_sub(1), (index + 1).min(last));
        let (value, at) = golden_section(from as f64, to as f64, of);
        // An end of the course is no inner minimum; its own value stands.
        if value < values[index] { (value, at) } else { (values[index], index as f64) }
    });
    refined.collect()
}

/// The least value of a function with one minimum in [from, to], and where.
fn golden_section(from: f64, to: f64, of: &impl Fn(f64) -> f64) -> (f64, f64) {
    let ratio = 0.5 * (5.0_f64.sqrt() - 1.0);
    let (mut from, mut to) = (from, to);
    let mut left = to - ratio * (to - from);
    let mut right = from + ratio * (to - from);
    let (mut at_left, mut at_right) = (of(left), of(right));
    while to - from > RESOLUTION {
        if at_left < at_right {
            (to, right, at_right) = (right, left, at_left);
            left = to - ratio * (to - from);
            at_left = of(left);
        } else {
            (from, left, at_left) = (left, right, at_right);
            right = from + ratio * (to - from);
            at_right = of(right);
        }
    }
    if at_left < at_right { (at_left, left) } else { (at_right, right) }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector3, Vector6};

    use super::*;
    use crate::{
        plant::{
            relative_truth::{Law, RelativeTruth},
            two_body::{Elements, mean_anomaly},
        },
        tests::{abort_case, vector},
    };

    /// Past the target at 6 m/s, `miss_m` away at `closest_s`, seen every 30 s.
    fn straight(miss_m: f64, closest_s: f64) -> Course {
        let at = |index: u32| {
            let along = 6.0 * (f64::from(index) * 30.0 - closest_s);
            Vector6::new(miss_m, along, 0.0, 0.0, 6.0, 0.0)
        };
        Course { start_s: 0.0, spacing_s: 30.0, states: (0..=10).map(at).collect() }
    }

    fn sphere(radius_m: f64) -> Region {
        Region::Ellipsoid { semi_axes_m: Vector3::repeat(radius_m) }
    }

    #[test]
    fn clearance_finds_what_samples_do_not_see() {
        let course = straight(15.0, 134.0);
        for region in [sphere(20.0), Region::Box { half_widths_m: Vector3::repeat(20.0) }] {
            let clearance = Clearance::of(&course, &region);
            assert!(clearance.least_gauge_sampled > 1.0, "{clearance:?}");
            assert!((clearance.least_gauge - 0.75).abs() < 1e-9, "{clearance:?}");
            assert!((clearance.least_distance_m - 15.0).abs() < 1e-6, "{clearance:?}");
            assert!((clearance.least_distance_at_s - 134.0).abs() < 0.01, "{clearance:?}");
            let half_width = match region {
                Region::Ellipsoid { .. } => (20.0_f64.powi(2) - 15.0 * 15.0).sqrt(),
                Region::Box { .. } => 20.0,
            };
            let entry = clearance.entry_s.expect("it enters");
            assert!((entry - (134.0 - half_width / 6.0)).abs() < 1e-3, "{entry}");
        }
    }

    #[test]
    fn clearance_of_courses_that_begin_or_end_at_their_nearest() {
        let entering = Clearance::of(&straight(0.0, 305.0), &sphere(100.0));
        assert!((entering.least_distance_m - 30.0).abs() < 1e-9, "{entering:?}");
        assert!((entering.least_gauge_at_s - 300.0).abs() < 1e-9, "{entering:?}");
        let entry = entering.entry_s.expect("it enters");
        assert!((entry - (305.0 - 100.0 / 6.0)).abs() < 1e-3, "{entry}");
        let leaving = Clearance::of(&straight(0.0, -5.0), &sphere(100.0));
        assert_eq!(leaving.entry_s, Some(0.0));
        assert!((leaving.least_gauge - 0.3).abs() < 1e-12, "{leaving:?}");
        let outside = Clearance::of(&straight(120.0, 134.0), &sphere(100.0));
        assert_eq!(outside.entry_s, None);
        let here = Course { states: vec![Vector6::repeat(3.0)], ..straight(0.0, 0.0) };
        assert_eq!(Clearance::of(&here, &sphere(1.0)).least_distance_m, 27.0_f64.sqrt());
    }

    #[test]
    fn clearance_reports_the_first_of_two_entries() {
        let mut there_and_back = straight(0.0, 134.0);
        let back = straight(0.0, 134.0).states;
        there_and_back.states.extend(back.iter().map(|state| {
            // Turned round at the far end, which is an edge no physical course has.
            Vector6::new(state[0], -state[1] + 64.0, 0.0, 0.0, -6.0, 0.0)
        }));
        let clearance = Clearance::of(&there_and_back, &sphere(50.0));
        let entry = clearance.entry_s.expect("it enters");
        assert!((entry - (134.0 - 50.0 / 6.0)).abs() < 1e-3, "{entry}");
    }

    /// Foreign numbers: the recorded safe approach drifts outside the approach ellipsoid for
    /// three periods from wherever it is left, in the linear world and in Newton's.
    #[test]
    fn clearance_of_the_recorded_safe_approach() {
        let case = abort_case("closedloop_vbar_safe");
        let orbit = Elements {
            semi_major_axis_m: 7_419_320.0,
            eccentricity: 0.1,
            inclination_rad: 0.01_f64.to_radians(),
            ascending_node_rad: 0.0,
            argument_of_perigee_rad: 0.0,
            mean_anomaly_rad: mean_anomaly(145.0_f64.to_radians(), 0.1),
        };
        let region = Region::Ellipsoid { semi_axes_m: vector3_km(&case["inputs"]["semiaxes"]) };
        let recorded = case["expected"]["states_at"].as_object().expect("states");
        let newton = Law::Newton { j2: false, sun_moon_from: None };
        let mut nearest = f64::INFINITY;
        for law in [Law::Linear, newton] {
            let truth = RelativeTruth::new(&orbit, law, (143.0 + 636.0) * 30.0).expect("a truth");
            for (step, state) in recorded {
                let time = step.parse::<f64>().expect("a step") * 30.0;
                let state = Vector6::from_column_slice((vector(state) * 1e3).as_slice());
                let course = truth.drift(time, &state, 636.0 * 30.0, 30.0);
                let clearance = Clearance::of(&course, &region);
                // The case's least gauge^2 over all steps is 0.99996 with the speed's share in
                // it, which is at most (3 / 100)^2; `entry` may see a graze between samples.
                assert!(clearance.least_gauge_sampled > 0.9995, "{law:?} {step} {clearance:?}");
                assert!(clearance.least_gauge > 0.999, "{law:?} {step} {clearance:?}");
                nearest = nearest.min(clearance.least_gauge);
            }
        }
        // The approach uses the freedom it has.
        assert!(nearest < 1.01, "{nearest}");
    }

    fn vector3_km(json: &serde_json::Value) -> Vector3<f64> {
        crate::tests::vector3(json) * 1e3
    }
}
