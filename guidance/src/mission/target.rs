//! Motion of the target's body: where capture point and docking port are at each sample.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use crate::budget::{Budget, Interruption};

/// Motion of the points that matter, relative to the target's centre of mass, in RTN.
#[derive(Debug, Clone, PartialEq)]
pub enum TargetMotion {
    /// Points fixed in a rigid body.
    Rigid {
        /// Where the chaser must go, at the mission's start, metres.
        capture_point_m: Vector3<f64>,
        /// Apex of the docking cone at the mission's start, metres.
        docking_port_m: Vector3<f64>,
        /// How the body moves.
        body: BodyMotion,
    },
    /// Points given sample by sample.
    Sampled(Vec<TargetSample>),
}

/// Motion of a rigid body relative to RTN.
#[derive(Debug, Clone, PartialEq)]
pub enum BodyMotion {
    /// At rest in RTN.
    Fixed,
    /// Constant angular velocity relative to RTN, radians per second.
    Spin(Vector3<f64>),
    /// Torque-free, any inertia.
    TorqueFree {
        /// Principal moments; only ratios matter.
        inertia: Vector3<f64>,
        /// Takes body components to RTN components at the start.
        rtn_from_body: UnitQuaternion<f64>,
        /// Initial angular velocity in the body's principal axes, radians per second.
        rate_body_rad_s: Vector3<f64>,
        /// What that velocity is relative to.
        relative_to: RateReference,
    },
}

/// What an angular velocity is measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RateReference {
    /// Inertial space: RTN's own rotation is subtracted.
    Inertial,
    /// RTN, treated as if it were inertial, as [Quartullo2025a, eq. 3] does.
    Rtn,
}

/// One sample of a target's motion, RTN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetSample {
    /// Where the chaser must go, metres.
    pub capture_point_m: Vector3<f64>,
    /// Its velocity in the rotating frame, metres per second.
    pub capture_velocity_m_s: Vector3<f64>,
    /// Apex of the docking cone, metres.
    pub docking_port_m: Vector3<f64>,
}

/// Largest turn of one integration step, radians: leaves errors near 1e-13 a radian.
const TURN_MAX_RAD: f64 = 2e-3;
/// Integration steps between two looks at the budget.
const BUDGET_PERIOD: usize = 256;

/// Most integration steps of a motion, all samples together: a second or two. A body that turns as
/// fast as EnviSat takes half of them in ten thousand samples.
const INTEGRATION_STEPS_MAX: usize = 10_000_000;

impl TargetMotion {
    /// Samples 0 .. count - 1, one every `sample_time_s`; fewer if that is all there are, or if the
    /// body turns too often to follow it so long.
    ///
    /// `mean_motion_rad_s` is RTN's own angular velocity about its z axis.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn samples(
        &self,
        mean_motion_rad_s: f64,
        sample_time_s: f64,
        count: usize,
        budget: Budget<'_>,
    ) -> Result<Vec<TargetSample>, Interruption> {
        match self {
            Self::Sampled(samples) => Ok(samples.iter().take(count).copied().collect()),
            Self::Rigid { capture_point_m, docking_port_m, body } => {
                let poses = body.poses(mean_motion_rad_s, sample_time_s, count, budget)?;
                let sample = |pose: &Pose| TargetSample {
                    capture_point_m: pose.attitude * capture_point_m,
                    capture_velocity_m_s: pose.rate_rad_s.cross(&(pose.attitude * capture_point_m)),
                    docking_port_m: pose.attitude * docking_port_m,
                };
                Ok(poses.iter().map(sample).collect())
            }
        }
    }
}

/// Attitude since the start and angular velocity, both relative to RTN and in RTN.
struct Pose {
    attitude: Matrix3<f64>,
    rate_rad_s: Vector3<f64>,
}

impl BodyMotion {
    fn poses(
        &self,
        mean_motion_rad_s: f64,
        sample_time_s: f64,
        count: usize,
        budget: Budget<'_>,
    ) -> Result<Vec<Pose>, Interruption> {
        budget.check()?;
        Ok(match self {
            Self::Fixed => (0..count)
                .map(|_| Pose { attitude: Matrix3::identity(), rate_rad_s: Vector3::zeros() })
                .collect(),
            Self::Spin(rate) => (0..count)
                .map(|k| Pose {
                    attitude: rotation(rate, sample_time_s * as_f64(k)),
                    rate_rad_s: *rate,
                })
                .collect(),
            Self::TorqueFree { inertia, rtn_from_body, rate_body_rad_s, relative_to } => {
                let orbit = match relative_to {
                    RateReference::Inertial => Vector3::z() * mean_motion_rad_s,
                    RateReference::Rtn => Vector3::zeros(),
                };
                let mut spinning = RigidBody {
                    attitude: *rtn_from_body.quaternion(),
                    rate: *rate_body_rad_s,
                    inertia: *inertia,
                };
                let start = rtn_from_body.to_rotation_matrix().into_inner();
                let mut poses = Vec::new();
                let mut left = INTEGRATION_STEPS_MAX;
                for k in 0..count {
                    if k > 0 {
                        let steps = spinning.steps(sample_time_s);
                        let Some(rest) = left.checked_sub(steps) else { break };
                        spinning.advance(sample_time_s, steps, budget)?;
                        left = rest;
                    }
                    // The axes "at rest" agree with RTN at the start and turn back by the orbit.
                    let back = rotation(&orbit, -sample_time_s * as_f64(k));
                    let from_body = back * spinning.rotation();
                    poses.push(Pose {
                        attitude: from_body * start.transpose(),
                        rate_rad_s: from_body * spinning.rate - orbit,
                    });
                }
                poses
            }
        })
    }
}

#[allow(clippy::cast_precision_loss, reason = "sample indices are far below 2^53")]
fn as_f64(k: usize) -> f64 {
    k as f64
}

/// Rotation by the angle rate * time about the rate, by Rodrigues' formula.
fn rotation(rate: &Vector3<f64>, time: f64) -> Matrix3<f64> {
    let speed = rate.norm();
    if speed == 0.0 {
        return Matrix3::identity();
    }
    let k = rate / speed;
    let angle = speed * time;
    let half = libm::sin(0.5 * angle);
    let skew = Matrix3::new(0.0, -k.z, k.y, k.z, 0.0, -k.x, -k.y, k.x, 0.0);
    Matrix3::identity() + skew * libm::sin(angle) + skew * skew * (2.0 * half * half)
}

/// Euler's equations without torque in the body's principal axes.
struct RigidBody {
    attitude: Quaternion<f64>,
    rate: Vector3<f64>,
    inertia: Vector3<f64>,
}

impl RigidBody {
    fn rotation(&self) -> Matrix3<f64> {
        UnitQuaternion::from_quaternion(self.attitude).to_rotation_matrix().into_inner()
    }

    /// Steps of at most [`TURN_MAX_RAD`] in `time`.
    fn steps(&self, time: f64) -> usize {
        let (smallest, largest) = (self.inertia.min(), self.inertia.max());
        let turn = self.rate.norm() * time * (largest / smallest);
        let steps = libm::ceil(turn / TURN_MAX_RAD).max(1.0);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at least 1")]
        let whole = steps as usize;
        if turn.is_nan() { usize::MAX } else { whole }
    }

    /// Classical Runge-Kutta steps.
    fn advance(&mut self, time: f64, steps: usize, budget: Budget<'_>) -> Result<(), Interruption> {
        let h = time / as_f64(steps);
        for step in 0..steps {
            if step % BUDGET_PERIOD == 0 {
                budget.check()?;
            }
            let (q, w) = (self.attitude, self.rate);
            let (q1, w1) = self.derivative(q, w);
            let (q2, w2) = self.derivative(q + q1 * (0.5 * h), w + w1 * (0.5 * h));
            let (q3, w3) = self.derivative(q + q2 * (0.5 * h), w + w2 * (0.5 * h));
            let (q4, w4) = self.derivative(q + q3 * h, w + w3 * h);
            let attitude = q + (q1 + (q2 + q3) * 2.0 + q4) * (h / 6.0);
            self.attitude = attitude / attitude.norm();
            self.rate = w + (w1 + (w2 + w3) * 2.0 + w4) * (h / 6.0);
        }
        Ok(())
    }

    fn derivative(
        &self,
        attitude: Quaternion<f64>,
        rate: Vector3<f64>,
    ) -> (Quaternion<f64>, Vector3<f64>) {
        let turning = attitude * Quaternion::from_imag(rate) * 0.5;
        let momentum = self.inertia.component_mul(&rate);
        (turning, -rate.cross(&momentum).component_div(&self.inertia))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn torque_free(relative_to: RateReference) -> TargetMotion {
        TargetMotion::Rigid {
            capture_point_m: Vector3::new(1.0, 2.0, 0.5),
            docking_port_m: Vector3::new(0.5, 1.0, 0.25),
            body: BodyMotion::TorqueFree {
                inertia: Vector3::new(1.0, 1.8, 2.4),
                rtn_from_body: UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9),
                rate_body_rad_s: Vector3::new(0.012, 0.001, 0.002),
                relative_to,
            },
        }
    }

    #[test]
    fn velocity_is_the_derivative_of_position() {
        for relative_to in [RateReference::Inertial, RateReference::Rtn] {
            // Central differences over 0.1 s leave about 1e-6 of the third derivative, 2e-6 m/s^3.
            let samples =
                torque_free(relative_to).samples(0.001, 0.05, 60, Budget::UNLIMITED).unwrap();
            for k in [1, 30, 58] {
                let change = samples[k + 1].capture_point_m - samples[k - 1].capture_point_m;
                let error = change / 0.1 - samples[k].capture_velocity_m_s;
                assert!(error.norm() < 1e-8, "{relative_to:?} {k}: {error}");
            }
        }
    }

    #[test]
    fn energy_and_momentum_are_kept_in_tumbling() {
        let mut body = RigidBody {
            attitude: Quaternion::identity(),
            rate: Vector3::new(0.012, 0.001, 0.02),
            inertia: Vector3::new(1.0, 1.8, 2.4),
        };
        let momentum = |b: &RigidBody| b.rotation() * b.inertia.component_mul(&b.rate);
        let energy = |b: &RigidBody| b.inertia.component_mul(&b.rate).dot(&b.rate);
        let (before, energy_before) = (momentum(&body), energy(&body));
        body.advance(3000.0, body.steps(3000.0), Budget::UNLIMITED).unwrap();
        assert!((momentum(&body) - before).norm() < 1e-11 * before.norm());
        assert!((energy(&body) - energy_before).abs() < 1e-11 * energy_before);
    }

    #[test]
    fn motion_that_turns_too_often_has_fewer_samples() {
        let samples = |rate_rad_s: f64, moment: f64| {
            let body = BodyMotion::TorqueFree {
                inertia: Vector3::new(moment, 1.8, 2.4),
                rtn_from_body: UnitQuaternion::identity(),
                rate_body_rad_s: Vector3::new(rate_rad_s, 1e-3, 0.0),
                relative_to: RateReference::Rtn,
            };
            let point = Vector3::x();
            let motion =
                TargetMotion::Rigid { capture_point_m: point, docking_port_m: point, body };
            motion.samples(0.001, 10.0, 10_000, Budget::UNLIMITED).unwrap().len()
        };
        // The second has no moment about an axis, which is no body: its turns are not a number.
        for (rate_rad_s, moment) in [(1e4, 1.0), (f64::MAX, 1.0), (1e-3, 0.0)] {
            assert!(samples(rate_rad_s, moment) < 10, "{rate_rad_s} rad/s about {moment} kg m2");
        }
        assert_eq!(samples(0.01, 1.0), 10_000);
    }

    #[test]
    fn equal_moments_spin_about_a_fixed_axis() {
        let rate = Vector3::new(0.01, -0.02, 0.005);
        let rigid = |body| TargetMotion::Rigid {
            capture_point_m: Vector3::new(1.0, 2.0, 0.5),
            docking_port_m: Vector3::new(0.5, 1.0, 0.25),
            body,
        };
        let tumbling = rigid(BodyMotion::TorqueFree {
            inertia: Vector3::new(2.0, 2.0, 2.0),
            rtn_from_body: UnitQuaternion::identity(),
            rate_body_rad_s: rate,
            relative_to: RateReference::Rtn,
        });
        let spinning = rigid(BodyMotion::Spin(rate));
        let samples =
            |motion: &TargetMotion| motion.samples(0.001, 10.0, 50, Budget::UNLIMITED).unwrap();
        let (a, b) = (samples(&tumbling), samples(&spinning));
        for (a, b) in a.iter().zip(&b) {
            assert!((a.capture_point_m - b.capture_point_m).norm() < 1e-11);
        }
    }
}
