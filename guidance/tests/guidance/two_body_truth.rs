//! Target and chaser integrated in inertial axes, by the tests alone: what the linear plant is
//! compared with.

use nalgebra::{Matrix3, Vector3};
use serde_json::Value;
use vbar_guidance::dynamics::RelativeVector;

const MU: f64 = 3.986_004_418e14;
/// Integration step, s: Runge-Kutta's error is (n h)^4 / 120 of a kilometre's motion, 1e-15.
const STEP_S: f64 = 0.5;

/// The target's inertial state at a moment, and how the Earth pulls.
pub(crate) struct Truth {
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    /// J2 and the Earth's radius.
    oblateness: Option<(f64, f64)>,
}

impl Truth {
    /// From a case's orbit (km, degrees, node and perigee at 0), `elapsed` seconds after its
    /// anomaly; Kepler's equation solved once more, by bisection.
    pub(crate) fn new(orbit: &Value, elapsed: f64) -> Self {
        let field = |name: &str| orbit[name].as_f64().unwrap_or(0.0);
        let (a, e) = (field("a_km") * 1e3, field("e"));
        let nu = field("f0_deg").to_radians();
        let eccentric =
            2.0 * ((1.0 - e).sqrt() * (nu / 2.0).sin()).atan2((1.0 + e).sqrt() * (nu / 2.0).cos());
        let mean = eccentric - e * eccentric.sin() + (MU / (a * a * a)).sqrt() * elapsed;
        let (mut low, mut high) = (mean - 1.0, mean + 1.0);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if middle - e * middle.sin() < mean { low = middle } else { high = middle }
        }
        let (s, c) = low.sin_cos();
        let root = (1.0 - e * e).sqrt();
        let rate = (MU / (a * a * a)).sqrt() / (1.0 - e * c);
        let tilt = field("i_deg").to_radians();
        let turn = Matrix3::new(
            1.0,
            0.0,
            0.0, //
            0.0,
            tilt.cos(),
            -tilt.sin(), //
            0.0,
            tilt.sin(),
            tilt.cos(),
        );
        Self {
            position: turn * Vector3::new(a * (c - e), a * root * s, 0.0),
            velocity: turn * Vector3::new(-a * s * rate, a * root * c * rate, 0.0),
            oblateness: None,
        }
    }

    /// With the second zonal harmonic, on target and chaser.
    pub(crate) fn oblate(self, j2: f64, radius_m: f64) -> Self {
        Self { oblateness: Some((j2, radius_m)), ..self }
    }

    /// The relative state after `duration` seconds under an acceleration that is constant in the
    /// target's rotating frame.
    pub(crate) fn after(
        &self,
        x: &RelativeVector,
        acceleration: &Vector3<f64>,
        duration: f64,
    ) -> RelativeVector {
        let frame = Frame::of(&self.position, &self.velocity);
        let offset = x.fixed_rows::<3>(0).into_owned();
        let speed = x.fixed_rows::<3>(3) + frame.rate.cross(&offset);
        let mut z = [
            self.position,
            self.velocity,
            self.position + frame.inertial_from_rtn * offset,
            self.velocity + frame.inertial_from_rtn * speed,
        ];
        let count = (duration / STEP_S).ceil();
        let h = duration / count;
        let plus = |z: &[Vector3<f64>; 4], k: &[Vector3<f64>; 4], f: f64| {
            std::array::from_fn(|i| z[i] + k[i] * f)
        };
        for _ in 0..count as usize {
            let k1 = self.derivative(&z, acceleration);
            let k2 = self.derivative(&plus(&z, &k1, h / 2.0), acceleration);
            let k3 = self.derivative(&plus(&z, &k2, h / 2.0), acceleration);
            let k4 = self.derivative(&plus(&z, &k3, h), acceleration);
            z = std::array::from_fn(|i| z[i] + (k1[i] + (k2[i] + k3[i]) * 2.0 + k4[i]) * (h / 6.0));
        }
        let frame = Frame::of(&z[0], &z[1]);
        let back = frame.inertial_from_rtn.transpose();
        let offset = back * (z[2] - z[0]);
        let speed = back * (z[3] - z[1]) - frame.rate.cross(&offset);
        let mut end = RelativeVector::zeros();
        end.fixed_rows_mut::<3>(0).copy_from(&offset);
        end.fixed_rows_mut::<3>(3).copy_from(&speed);
        end
    }

    fn derivative(&self, z: &[Vector3<f64>; 4], acceleration: &Vector3<f64>) -> [Vector3<f64>; 4] {
        let thrust = Frame::of(&z[0], &z[1]).inertial_from_rtn * acceleration;
        [z[1], self.gravity(&z[0]), z[3], self.gravity(&z[2]) + thrust]
    }

    fn gravity(&self, r: &Vector3<f64>) -> Vector3<f64> {
        let distance = r.norm();
        let central = -r * (MU / distance.powi(3));
        let Some((j2, radius)) = self.oblateness else { return central };
        let latitude = 5.0 * (r.z / distance).powi(2);
        let factor = -1.5 * j2 * MU * radius * radius / distance.powi(5);
        let shape = Vector3::new(1.0 - latitude, 1.0 - latitude, 3.0 - latitude);
        central + r.component_mul(&shape) * factor
    }
}

struct Frame {
    inertial_from_rtn: Matrix3<f64>,
    rate: Vector3<f64>,
}

impl Frame {
    fn of(r: &Vector3<f64>, v: &Vector3<f64>) -> Self {
        let momentum = r.cross(v);
        let (radial, normal) = (r.normalize(), momentum.normalize());
        Self {
            inertial_from_rtn: Matrix3::from_columns(&[radial, normal.cross(&radial), normal]),
            rate: Vector3::new(0.0, 0.0, momentum.norm() / r.norm_squared()),
        }
    }
}
