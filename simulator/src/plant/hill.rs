//! Linear relative motion about a circular orbit (Hill-Clohessy-Wiltshire), in SI.
//!
//! Axes are RTN: x radial outward, y along-track, z orbit normal. The equations
//! `x'' = 3 n^2 x + 2 n y' + a_x`, `y'' = -2 n x' + a_y`, `z'' = -n^2 z + a_z` are
//! [Quartullo2025a, eq. 2] with time and length put back; their solution under a constant
//! acceleration is written out here instead of being taken from a matrix exponential.

use nalgebra::{Matrix6, Matrix6x3, Vector3, Vector6};

/// One sample of linear relative motion, thrust held constant.
#[derive(Debug, Clone)]
pub(crate) struct HillPlant {
    /// State after the sample from the state before, 6 x 6.
    transition: Matrix6<f64>,
    /// State after the sample from the acceleration during it, 6 x 3.
    forcing: Matrix6x3<f64>,
}

impl HillPlant {
    /// The motion over `sample_time_s` about an orbit of mean motion `mean_motion_rad_s`.
    pub(crate) fn new(mean_motion_rad_s: f64, sample_time_s: f64) -> Self {
        Self {
            transition: transition(mean_motion_rad_s, sample_time_s),
            forcing: forcing(mean_motion_rad_s, sample_time_s),
        }
    }

    /// The state one sample later: `state` is [position m, velocity m/s], `acceleration` m/s^2.
    pub(crate) fn advance(
        &self,
        state: &Vector6<f64>,
        acceleration: &Vector3<f64>,
    ) -> Vector6<f64> {
        self.transition * state + self.forcing * acceleration
    }
}

#[rustfmt::skip]
fn transition(n: f64, t: f64) -> Matrix6<f64> {
    let (s, c) = (n * t).sin_cos();
    let lag = angle_minus_sine(n * t);
    let versine = versine(n * t);
    Matrix6::new(
        4.0 - 3.0 * c,        0.0, 0.0,     s / n,               2.0 * versine / n,          0.0,
        -6.0 * lag,           1.0, 0.0,     -2.0 * versine / n,  (s - 3.0 * lag) / n,        0.0,
        0.0,                  0.0, c,       0.0,                 0.0,                        s / n,
        3.0 * n * s,          0.0, 0.0,     c,                   2.0 * s,                    0.0,
        -6.0 * n * versine,   0.0, 0.0,     -2.0 * s,            4.0 * c - 3.0,              0.0,
        0.0,                  0.0, -n * s,  0.0,                 0.0,                        c,
    )
}

#[rustfmt::skip]
fn forcing(n: f64, t: f64) -> Matrix6x3<f64> {
    let s = (n * t).sin();
    let lag = angle_minus_sine(n * t);
    let versine = versine(n * t);
    let nn = n * n;
    Matrix6x3::new(
        versine / nn,       2.0 * lag / nn,                      0.0,
        -2.0 * lag / nn,    4.0 * versine / nn - 1.5 * t * t,    0.0,
        0.0,                0.0,                                 versine / nn,
        s / n,              2.0 * versine / n,                   0.0,
        -2.0 * versine / n, (s - 3.0 * lag) / n,                 0.0,
        0.0,                0.0,                                 s / n,
    )
}

/// `1 - cos(angle)` without cancellation.
fn versine(angle: f64) -> f64 {
    let half = (0.5 * angle).sin();
    2.0 * half * half
}

/// `angle - sin(angle)`, by its series where the difference would cancel.
fn angle_minus_sine(angle: f64) -> f64 {
    if angle.abs() > 0.5 {
        return angle - angle.sin();
    }
    let square = angle * angle;
    let mut term = angle * square / 6.0;
    let mut sum = 0.0;
    let mut order = 3.0;
    while term.abs() > f64::EPSILON * f64::EPSILON * angle.abs() {
        sum += term;
        term *= -square / ((order + 1.0) * (order + 2.0));
        order += 2.0;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::golden_cases;

    const MEAN_MOTION: f64 = 1.038e-3;

    fn acceleration_of_motion(state: &Vector6<f64>, a: &Vector3<f64>) -> Vector6<f64> {
        let n = MEAN_MOTION;
        Vector6::new(
            state[3],
            state[4],
            state[5],
            3.0 * n * n * state[0] + 2.0 * n * state[4] + a[0],
            -2.0 * n * state[3] + a[1],
            -n * n * state[2] + a[2],
        )
    }

    /// The written-out solution satisfies the differential equation (central difference in time).
    #[test]
    fn hill_solution_satisfies_its_differential_equation() {
        let start = Vector6::new(120.0, -340.0, 55.0, 0.3, -0.2, 0.1);
        let push = Vector3::new(0.01, -0.02, 0.03);
        let at = |t: f64| HillPlant::new(MEAN_MOTION, t).advance(&start, &push);
        for t in [1.0, 11.8, 300.0, 2000.0] {
            let step = 1e-2;
            let rate = (at(t + step) - at(t - step)) / (2.0 * step);
            let error = (rate - acceleration_of_motion(&at(t), &push)).amax();
            // Truncation step^2 / 6 * x''' ~ 1e-11; rounding 1e-16 * 1e5 m / step ~ 1e-9.
            assert!(error < 1e-8, "t = {t}: {error}");
        }
    }

    #[test]
    fn hill_drift_free_ellipse_closes_after_one_orbit() {
        // y' = -2 n x is the condition for a closed 2:1 ellipse.
        let start = Vector6::new(100.0, 20.0, 30.0, 0.05, -2.0 * MEAN_MOTION * 100.0, 0.02);
        let period = std::f64::consts::TAU / MEAN_MOTION;
        let end = HillPlant::new(MEAN_MOTION, period).advance(&start, &Vector3::zeros());
        assert!((end - start).amax() < 1e-9, "{}", end - start);
    }

    #[test]
    fn hill_steps_compose() {
        let start = Vector6::new(-45.0, -8.0, 3.0, 0.1, 0.2, -0.3);
        let push = Vector3::new(0.02, -0.01, 0.03);
        let whole = HillPlant::new(MEAN_MOTION, 20.0).advance(&start, &push);
        let half = HillPlant::new(MEAN_MOTION, 10.0);
        let twice = half.advance(&half.advance(&start, &push), &push);
        assert!((whole - twice).amax() < 1e-12 * whole.amax(), "{}", whole - twice);
    }

    /// Foreign numbers: normalised A and B of every spacecraft case of the reference set.
    #[test]
    fn hill_matrices_agree_with_reference_cases() {
        let mut checked = 0;
        let files =
            ["adversarial.json", "envisat_p0.json", "mc000_p0.json", "tumbling_sat_003.json"];
        for case in files.iter().flat_map(|file| golden_cases(file)) {
            let physical = &case["physical"];
            let Some(eta) = physical["eta"].as_f64() else { continue };
            let number = |key: &str| physical[key].as_f64().expect(key);
            let plant = HillPlant::new(eta, number("dt_s"));
            let (position, velocity) = (number("pos_unit_m"), number("vel_unit_m_s"));
            let unit = |row: usize| if row < 3 { position } else { velocity };
            for row in 0..6 {
                for column in 0..6 {
                    let ours = plant.transition[(row, column)] * unit(column) / unit(row);
                    let theirs = case["A"][row][column].as_f64().expect("A");
                    assert!((ours - theirs).abs() < 1e-14, "A[{row}][{column}] {ours} {theirs}");
                }
                for column in 0..3 {
                    let ours = plant.forcing[(row, column)] * number("a_max") / unit(row);
                    let theirs = case["B"][row][column].as_f64().expect("B");
                    assert!((ours - theirs).abs() < 1e-15, "B[{row}][{column}] {ours} {theirs}");
                }
            }
            checked += 1;
        }
        assert!(checked >= 20, "only {checked} cases");
    }
}
