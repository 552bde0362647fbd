//! Where the capture point and the docking port are: motion of the target's body.
//!
//! All vectors are RTN components about the target's centre of mass. With a constant spin the
//! points obey `p' = omega x p`, omega relative to RTN [Quartullo2025a, eq. 3]. A torque-free
//! body obeys Euler's equations; whether its rate is meant against inertial space or against RTN
//! is part of the mission.

use nalgebra::{Matrix3, Vector3};

/// Longest step of the integration of Euler's equations, in radians of rotation.
const STEP_MAX_RAD: f64 = 0.003;

/// How the body moves relative to RTN.
#[derive(Debug, Clone)]
pub(crate) enum BodyMotion {
    /// Not at all.
    Fixed,
    /// About an axis fixed in RTN, rad/s.
    Spin(Vector3<f64>),
    /// Attitude and rate tabulated at the samples.
    Tabulated(Vec<Attitude>),
    /// The points themselves given at the samples.
    Points(Vec<BodyPoints>),
}

/// Orientation relative to the start, and rate.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Attitude {
    /// Takes RTN components at the start to RTN components now.
    turned: Matrix3<f64>,
    /// Rate relative to RTN, RTN components, rad/s.
    rate: Vector3<f64>,
}

/// The two points of the body that matter, at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BodyPoints {
    /// Where the chaser's centre of mass must go, m.
    pub capture_m: Vector3<f64>,
    /// Its velocity in RTN, m/s.
    pub capture_velocity_m_s: Vector3<f64>,
    /// Apex of the docking cone, m.
    pub port_m: Vector3<f64>,
}

/// Body motion with the points it carries.
#[derive(Debug, Clone)]
pub(crate) struct Target {
    /// How the body moves.
    pub motion: BodyMotion,
    /// Capture point at the start, m; unused where the points are given.
    pub capture_m: Vector3<f64>,
    /// Docking port at the start, m; unused where the points are given.
    pub port_m: Vector3<f64>,
    /// Length of a sample, s.
    pub sample_time_s: f64,
}

impl Target {
    /// The points at sample `k`; `None` beyond the end of a table.
    pub(crate) fn at(&self, k: usize) -> Option<BodyPoints> {
        let attitude = match &self.motion {
            BodyMotion::Points(table) => return table.get(k).copied(),
            BodyMotion::Tabulated(table) => *table.get(k)?,
            BodyMotion::Fixed => Attitude { turned: Matrix3::identity(), rate: Vector3::zeros() },
            BodyMotion::Spin(rate) => {
                let angle = rate.norm() * self.sample_time_s * k as f64;
                Attitude { turned: rotation(rate, angle), rate: *rate }
            }
        };
        let capture_m = attitude.turned * self.capture_m;
        Some(BodyPoints {
            capture_m,
            capture_velocity_m_s: attitude.rate.cross(&capture_m),
            port_m: attitude.turned * self.port_m,
        })
    }
}

/// Rotation about `axis` (any length; zero gives the identity) by `angle_rad`.
pub(crate) fn rotation(axis: &Vector3<f64>, angle_rad: f64) -> Matrix3<f64> {
    let length = axis.norm();
    if length == 0.0 {
        return Matrix3::identity();
    }
    let cross = (axis / length).cross_matrix();
    Matrix3::identity() + cross * angle_rad.sin() + cross * cross * (1.0 - angle_rad.cos())
}

/// A torque-free rigid body at the start.
#[derive(Debug, Clone)]
pub(crate) struct TorqueFreeBody {
    /// Principal moments; only their ratios matter.
    pub inertia: Vector3<f64>,
    /// Body axes in RTN at the start.
    pub rtn_from_body: Matrix3<f64>,
    /// Angular velocity in body axes, rad/s.
    pub rate_body: Vector3<f64>,
    /// Rate of RTN against the frame in which Euler's equations hold, rad/s about the normal:
    /// the mean motion, or 0 when RTN itself is treated as inertial.
    pub frame_rate_rad_s: f64,
}

impl TorqueFreeBody {
    /// The attitude at `samples` instants, `sample_time_s` apart, the first at the start.
    pub(crate) fn tabulate(&self, sample_time_s: f64, samples: usize) -> Vec<Attitude> {
        let mut body = self.rtn_from_body;
        let mut rate = self.rate_body;
        let steps = (rate.norm() * sample_time_s / STEP_MAX_RAD).ceil().max(1.0);
        let step = sample_time_s / steps;
        let mut table = Vec::with_capacity(samples);
        for k in 0..samples {
            let normal = Vector3::z();
            let elapsed = sample_time_s * k as f64;
            // RTN turns by +angle, so what is at rest in inertial space turns by -angle in RTN.
            let to_rtn = rotation(&normal, -self.frame_rate_rad_s * elapsed);
            let now = to_rtn * body;
            table.push(Attitude {
                turned: now * self.rtn_from_body.transpose(),
                rate: now * rate - normal * self.frame_rate_rad_s,
            });
            for _ in 0..steps as u32 {
                (body, rate) = self.runge_kutta(body, rate, step);
            }
        }
        table
    }

    /// Euler's equations and `C' = C [rate x]`, one classical Runge-Kutta step.
    fn runge_kutta(
        &self,
        body: Matrix3<f64>,
        rate: Vector3<f64>,
        h: f64,
    ) -> (Matrix3<f64>, Vector3<f64>) {
        let slope = |c: &Matrix3<f64>, w: &Vector3<f64>| {
            let momentum = self.inertia.component_mul(w);
            (c * w.cross_matrix(), momentum.cross(w).component_div(&self.inertia))
        };
        let (c1, w1) = slope(&body, &rate);
        let (c2, w2) = slope(&(body + c1 * (0.5 * h)), &(rate + w1 * (0.5 * h)));
        let (c3, w3) = slope(&(body + c2 * (0.5 * h)), &(rate + w2 * (0.5 * h)));
        let (c4, w4) = slope(&(body + c3 * h), &(rate + w3 * h));
        let body = body + (c1 + (c2 + c3) * 2.0 + c4) * (h / 6.0);
        let rate = rate + (w1 + (w2 + w3) * 2.0 + w4) * (h / 6.0);
        (orthonormal(&body), rate)
    }
}

/// Removes the drift of an integrated rotation (Gram-Schmidt on its columns).
fn orthonormal(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    let x = matrix.column(0).normalize();
    let y = (matrix.column(1) - x * x.dot(&matrix.column(1))).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{golden_cases, spinning_cases, vector, vector3};

    fn target(motion: BodyMotion, point: Vector3<f64>, sample_time_s: f64) -> Target {
        Target { motion, capture_m: point, port_m: point, sample_time_s }
    }

    /// Foreign numbers: reference states r(k) of every spacecraft case.
    #[test]
    fn rotation_spin_agrees_with_reference_cases() {
        let mut checked = 0;
        for case in spinning_cases() {
            let physical = &case["physical"];
            let three = |key: &str| vector3(&physical[key]);
            let dt = physical["dt_s"].as_f64().unwrap();
            let motion = BodyMotion::Spin(three("omega_rad_s"));
            let target = target(motion, three("p_ref0_m"), dt);
            let first = case["k"].as_u64().unwrap_or(0) as usize;
            for (ahead, expected) in case["expected"]["r"].as_object().expect("r") {
                let ahead: usize = ahead.parse().expect("a step");
                let points = target.at(first + ahead).expect("spin has no end");
                let expected = vector(expected);
                for row in 0..3 {
                    let position = points.capture_m[row] / physical["pos_unit_m"].as_f64().unwrap();
                    let velocity = points.capture_velocity_m_s[row]
                        / physical["vel_unit_m_s"].as_f64().unwrap();
                    assert!((position - expected[row]).abs() < 1e-15, "{}", case["id"]);
                    assert!((velocity - expected[row + 3]).abs() < 1e-14, "{}", case["id"]);
                }
                checked += 1;
            }
        }
        assert!(checked > 100, "only {checked} states");
    }

    /// Foreign numbers: reference states of the torque-free case, whose body axes start along RTN.
    #[test]
    fn rotation_torque_free_agrees_with_reference_case() {
        let cases = golden_cases("adversarial.json");
        let case = cases.iter().find(|case| case["physical"]["omega0_body"].is_array());
        let case = case.expect("the torque-free case");
        let physical = &case["physical"];
        let number = |key: &str| physical[key].as_f64().expect(key);
        let three = |key: &str| vector3(&physical[key]);
        let body = TorqueFreeBody {
            inertia: three("inertia_ratio"),
            rtn_from_body: Matrix3::identity(),
            rate_body: three("omega0_body"),
            frame_rate_rad_s: 0.0,
        };
        let table = BodyMotion::Tabulated(body.tabulate(number("dt_s"), 80));
        let target = target(table, three("p_ref0_m"), number("dt_s"));
        for (step, expected) in case["expected"]["r"].as_object().expect("r") {
            let points = target.at(step.parse().expect("a step")).expect("within the table");
            let expected = vector(expected);
            for row in 0..3 {
                let position = points.capture_m[row] / number("pos_unit_m");
                let velocity = points.capture_velocity_m_s[row] / number("vel_unit_m_s");
                // Both sides integrate; their own tolerances meet here.
                assert!((position - expected[row]).abs() < 1e-12, "step {step}");
                assert!((velocity - expected[row + 3]).abs() < 1e-11, "step {step}");
            }
        }
    }

    #[test]
    fn rotation_torque_free_sphere_is_a_constant_spin() {
        let rate = Vector3::new(0.01, -0.02, 0.005);
        let body = TorqueFreeBody {
            inertia: Vector3::new(3.0, 3.0, 3.0),
            rtn_from_body: rotation(&Vector3::new(1.0, 2.0, -1.0), 0.7),
            rate_body: rate,
            frame_rate_rad_s: 0.0,
        };
        let point = Vector3::new(1.5, 0.2, -0.3);
        let free = target(BodyMotion::Tabulated(body.tabulate(10.0, 40)), point, 10.0);
        let spin = target(BodyMotion::Spin(body.rtn_from_body * rate), point, 10.0);
        for k in 0..40 {
            let (a, b) = (free.at(k).unwrap(), spin.at(k).unwrap());
            assert!((a.capture_m - b.capture_m).norm() < 1e-9, "step {k}");
            assert!((a.capture_velocity_m_s - b.capture_velocity_m_s).norm() < 1e-11, "step {k}");
        }
    }

    #[test]
    fn rotation_torque_free_keeps_energy_and_inertial_momentum() {
        let body = TorqueFreeBody {
            inertia: Vector3::new(1.0, 2.5, 3.0),
            rtn_from_body: rotation(&Vector3::new(0.3, -1.0, 0.4), 1.1),
            rate_body: Vector3::new(0.02, 0.03, -0.01),
            frame_rate_rad_s: 0.0,
        };
        let momentum = |attitude: &Attitude| {
            let now = attitude.turned * body.rtn_from_body;
            now * body.inertia.component_mul(&(now.transpose() * attitude.rate))
        };
        let table = body.tabulate(20.0, 100);
        let start = momentum(&table[0]);
        for (k, attitude) in table.iter().enumerate() {
            assert!((momentum(attitude) - start).norm() < 1e-8 * start.norm(), "step {k}");
        }
    }

    /// Velocity must be the derivative of position, also when RTN's own rotation is subtracted.
    #[test]
    fn rotation_velocity_is_the_derivative_of_position() {
        let body = TorqueFreeBody {
            inertia: Vector3::new(1.0, 2.5, 3.0),
            rtn_from_body: rotation(&Vector3::new(0.3, -1.0, 0.4), 1.1),
            rate_body: Vector3::new(0.02, 0.03, -0.01),
            frame_rate_rad_s: 1.1e-3,
        };
        let h = 0.05;
        let table = BodyMotion::Tabulated(body.tabulate(h, 200));
        let target = target(table, Vector3::new(-1.7, 0.3, 0.1), h);
        for k in [1, 50, 198] {
            let (before, after) = (target.at(k - 1).unwrap(), target.at(k + 1).unwrap());
            let slope = (after.capture_m - before.capture_m) / (2.0 * h);
            let error = (slope - target.at(k).unwrap().capture_velocity_m_s).norm();
            assert!(error < 1e-7, "step {k}: {error}");
        }
    }

    #[test]
    fn rotation_body_at_rest_in_inertial_space_turns_backwards_in_rtn() {
        let body = TorqueFreeBody {
            inertia: Vector3::new(1.0, 2.0, 3.0),
            rtn_from_body: Matrix3::identity(),
            rate_body: Vector3::zeros(),
            frame_rate_rad_s: 0.01,
        };
        let table = BodyMotion::Tabulated(body.tabulate(10.0, 2));
        let after = target(table, Vector3::x(), 10.0).at(1).unwrap().capture_m;
        assert!((after - Vector3::new(0.1_f64.cos(), -(0.1_f64.sin()), 0.0)).norm() < 1e-14);
    }
}
