//! Elliptic motion about the Earth.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Vector3};

use super::{EARTH_MU_M3_S2, InertialState};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    frames::{InFrame, InertialAxes},
    units::{Angle, Distance, Seconds},
};

/// An elliptic orbit about the Earth, with the true anomaly at the mission's start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeplerOrbit {
    semi_major_axis_m: f64,
    eccentricity: f64,
    true_anomaly_rad: f64,
    orientation: Option<Orientation>,
}

/// How the orbit lies in inertial axes. The relative motion does not depend on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientation {
    /// Of the orbital plane to the equator.
    pub inclination: Angle,
    /// Right ascension of the ascending node.
    pub raan: Angle,
    /// From the ascending node to perigee; on a circular orbit, to where the true anomaly is 0.
    pub argument_of_perigee: Angle,
    /// The axes that these angles refer to.
    pub axes: InertialAxes,
}

/// Why there is no such orbit.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum OrbitError {
    /// Not finite or not positive.
    #[error("the semi-major axis must be positive, not {0} m")]
    SemiMajorAxis(f64),
    /// Not an ellipse.
    #[error("the eccentricity must be at least 0 and below 1, not {0}")]
    Eccentricity(f64),
    /// An angle is not finite.
    #[error("every angle must be finite")]
    Angle,
    /// The motion is on a straight line, or a component is not finite.
    #[error("position and velocity do not span an orbital plane")]
    Rectilinear,
}

/// Below this, perigee cannot be told from rounding and the node takes its place.
const CIRCULAR: f64 = 1e-11;

impl KeplerOrbit {
    /// An orbit from its elements at the mission's start.
    ///
    /// The true anomaly may count revolutions: what is derived from it counts on from there.
    ///
    /// # Errors
    /// [`OrbitError`]: a semi-major axis that is not positive, an eccentricity outside [0, 1), an
    /// angle that is not finite.
    pub fn new(
        semi_major_axis: Distance,
        eccentricity: f64,
        true_anomaly: Angle,
        orientation: Option<Orientation>,
    ) -> Result<Self, OrbitError> {
        let semi_major_axis_m = semi_major_axis.metres();
        if !(semi_major_axis_m > 0.0 && semi_major_axis_m.is_finite()) {
            return Err(OrbitError::SemiMajorAxis(semi_major_axis_m));
        }
        if !(0.0..1.0).contains(&eccentricity) {
            return Err(OrbitError::Eccentricity(eccentricity));
        }
        let angles = orientation.map_or([0.0; 3], |o| {
            [o.inclination.radians(), o.raan.radians(), o.argument_of_perigee.radians()]
        });
        let true_anomaly_rad = true_anomaly.radians();
        if !(true_anomaly_rad.is_finite() && angles.iter().all(|angle| angle.is_finite())) {
            return Err(OrbitError::Angle);
        }
        Ok(Self { semi_major_axis_m, eccentricity, true_anomaly_rad, orientation })
    }

    /// The orbit that passes through an inertial state at the mission's start.
    ///
    /// On a circular orbit anomalies count from the ascending node, on an equatorial one the node
    /// is the first axis.
    ///
    /// # Errors
    /// [`OrbitError`] for a state that is not on an ellipse.
    pub fn through(state: &InertialState) -> Result<Self, OrbitError> {
        let (r, v) = (state.position_m.components, state.velocity_m_s.components);
        let (distance, speed_squared) = (r.norm(), v.norm_squared());
        let momentum = r.cross(&v);
        if !(momentum.norm() > 1e-12 * distance * speed_squared.sqrt()) {
            return Err(OrbitError::Rectilinear);
        }
        let semi_major_axis = 1.0 / (2.0 / distance - speed_squared / EARTH_MU_M3_S2);
        let to_perigee = v.cross(&momentum) / EARTH_MU_M3_S2 - r / distance;
        let eccentricity = to_perigee.norm();
        let normal = momentum.normalize();
        let equatorial = libm::hypot(normal.x, normal.y) < CIRCULAR;
        let node = if equatorial {
            Vector3::x()
        } else {
            Vector3::new(-normal.y, normal.x, 0.0).normalize()
        };
        let circular = eccentricity < CIRCULAR;
        let perigee = if circular { node } else { to_perigee / eccentricity };
        let orientation = Orientation {
            inclination: Angle::from_radians(libm::atan2(
                libm::hypot(normal.x, normal.y),
                normal.z,
            )),
            raan: Angle::from_radians(positive(libm::atan2(node.y, node.x))),
            argument_of_perigee: Angle::from_radians(angle_between(&node, &perigee, &normal)),
            axes: state.axes,
        };
        let true_anomaly = Angle::from_radians(angle_between(&perigee, &r, &normal));
        let eccentricity = if circular { 0.0 } else { eccentricity };
        let semi_major_axis = Distance::from_metres(semi_major_axis);
        Self::new(semi_major_axis, eccentricity, true_anomaly, Some(orientation))
    }

    /// Half of the longer axis.
    #[must_use]
    pub fn semi_major_axis(&self) -> Distance {
        Distance::from_metres(self.semi_major_axis_m)
    }

    /// At least 0, below 1.
    #[must_use]
    pub fn eccentricity(&self) -> f64 {
        self.eccentricity
    }

    /// At the mission's start, as given.
    #[must_use]
    pub fn true_anomaly(&self) -> Angle {
        Angle::from_radians(self.true_anomaly_rad)
    }

    /// How the orbit lies in inertial axes, if known.
    #[must_use]
    pub fn orientation(&self) -> Option<&Orientation> {
        self.orientation.as_ref()
    }

    /// p = a (1 - e²), metres.
    #[must_use]
    pub fn semi_latus_rectum_m(&self) -> f64 {
        self.semi_major_axis_m * (1.0 - self.eccentricity) * (1.0 + self.eccentricity)
    }

    /// sqrt(mu / a³), radians per second.
    #[must_use]
    pub fn mean_motion_rad_s(&self) -> f64 {
        let a = self.semi_major_axis_m;
        libm::sqrt(EARTH_MU_M3_S2 / a) / a
    }

    /// One revolution.
    #[must_use]
    pub fn period(&self) -> Seconds {
        Seconds::from_seconds(TAU / self.mean_motion_rad_s())
    }

    /// True anomaly `elapsed` after the mission's start, counted on through revolutions.
    #[must_use]
    pub fn true_anomaly_after(&self, elapsed: Seconds) -> Angle {
        let start = mean_from_true(self.eccentricity, self.true_anomaly_rad);
        let mean = start + self.mean_motion_rad_s() * elapsed.seconds();
        if elapsed.seconds() == 0.0 {
            return self.true_anomaly();
        }
        Angle::from_radians(true_from_mean(self.eccentricity, mean))
    }

    /// Time from the mission's start until `true_anomaly`, which counts revolutions.
    #[must_use]
    pub fn elapsed_at(&self, true_anomaly: Angle) -> Seconds {
        let mean = |nu| mean_from_true(self.eccentricity, nu);
        let angle = mean(true_anomaly.radians()) - mean(self.true_anomaly_rad);
        Seconds::from_seconds(angle / self.mean_motion_rad_s())
    }

    /// Inertial state `elapsed` after the mission's start; `None` if the orientation is unknown.
    #[must_use]
    pub fn inertial_state_after(&self, elapsed: Seconds) -> Option<InertialState> {
        let orientation = self.orientation?;
        let (e, p) = (self.eccentricity, self.semi_latus_rectum_m());
        let nu = self.true_anomaly_after(elapsed).radians();
        let (sine, cosine) = (libm::sin(nu), libm::cos(nu));
        let (r, v) = (p / (1.0 + e * cosine), libm::sqrt(EARTH_MU_M3_S2 / p));
        let inertial_from_perifocal = orientation.inertial_from_perifocal();
        let position = Vector3::new(r * cosine, r * sine, 0.0);
        let velocity = Vector3::new(-v * sine, v * (e + cosine), 0.0);
        Some(InertialState {
            axes: orientation.axes,
            position_m: InFrame::new(inertial_from_perifocal * position),
            velocity_m_s: InFrame::new(inertial_from_perifocal * velocity),
        })
    }

    /// Inertial states at equal times, the first one `start` after the mission's start; `None` if
    /// the orientation is unknown.
    ///
    /// Several times faster than one state after the other: the eccentric anomaly is carried on
    /// by its Taylor series, so that Kepler's equation needs a sine and a cosine a state.
    pub fn inertial_states(
        &self,
        start: Seconds,
        spacing: Seconds,
    ) -> Option<impl Iterator<Item = InertialState>> {
        let orientation = self.orientation?;
        let (a, e, n) = (self.semi_major_axis_m, self.eccentricity, self.mean_motion_rad_s());
        let (b, axes) = (a * libm::sqrt((1.0 - e) * (1.0 + e)), orientation.axes);
        let inertial_from_perifocal = orientation.inertial_from_perifocal();
        let mean = mean_from_true(e, self.true_anomaly_rad) + n * start.seconds();
        Some(EccentricAnomalies::new(e, mean, n * spacing.seconds()).map(move |(sine, cosine)| {
            let speed = n / (1.0 - e * cosine);
            let position = Vector3::new(a * (cosine - e), b * sine, 0.0);
            let velocity = Vector3::new(-a * sine * speed, b * cosine * speed, 0.0);
            InertialState {
                axes,
                position_m: InFrame::new(inertial_from_perifocal * position),
                velocity_m_s: InFrame::new(inertial_from_perifocal * velocity),
            }
        }))
    }
}

/// Sines and cosines of the eccentric anomaly at equal steps of the mean one.
struct EccentricAnomalies {
    e: f64,
    first_mean: f64,
    step: f64,
    count: usize,
    eccentric: f64,
    sine: f64,
    cosine: f64,
}

/// A correction of the eccentric anomaly below this changes its sine and cosine by their Taylor
/// series to the last bit: what is left out is of the third order.
const SMALL_CORRECTION_RAD: f64 = 3e-6;

impl EccentricAnomalies {
    fn new(e: f64, first_mean: f64, step: f64) -> Self {
        Self { e, first_mean, step, count: 0, eccentric: 0.0, sine: 0.0, cosine: 0.0 }
    }

    /// From the anomaly before: E' = 1 / (1 - e cos E) with respect to the mean one, and the two
    /// derivatives of that. `None` if the series has not come close enough.
    fn carried_on(&self, mean: f64) -> Option<(f64, f64, f64)> {
        let e = self.e;
        let slope = 1.0 / (1.0 - e * self.cosine);
        let (es, ec) = (e * self.sine, e * self.cosine);
        let second = -es * slope * slope * slope;
        let third = (3.0 * es * es * slope - ec) * slope * slope * slope * slope;
        let step = self.step;
        let guess =
            self.eccentric + step * (slope + step * (0.5 * second + step * third * (1.0 / 6.0)));
        let (sine, cosine) = (libm::sin(guess), libm::cos(guess));
        let rest = 1.0 - e * cosine;
        let excess = guess - e * sine - mean;
        let newton = excess / rest;
        // Halley's step, whose error is of the third order too.
        let change = -excess / (rest - 0.5 * newton * e * sine);
        (change.abs() <= SMALL_CORRECTION_RAD).then(|| {
            let half = 0.5 * change * change;
            let turned =
                (sine + cosine * change - sine * half, cosine - sine * change - cosine * half);
            (guess + change, turned.0, turned.1)
        })
    }
}

impl Iterator for EccentricAnomalies {
    type Item = (f64, f64);

    fn next(&mut self) -> Option<(f64, f64)> {
        let mean = self.first_mean + self.count as f64 * self.step;
        let carried = if self.count > 0 { self.carried_on(mean) } else { None };
        (self.eccentric, self.sine, self.cosine) = carried.unwrap_or_else(|| {
            let (turns, within) = revolutions(mean);
            let eccentric = eccentric_from_mean(self.e, within);
            (turns * TAU + eccentric, libm::sin(eccentric), libm::cos(eccentric))
        });
        self.count += 1;
        Some((self.sine, self.cosine))
    }
}

impl Orientation {
    /// Columns: towards perigee, in the plane a right angle on, normal.
    fn inertial_from_perifocal(&self) -> Matrix3<f64> {
        let turn = |angle: Angle| (libm::sin(angle.radians()), libm::cos(angle.radians()));
        let about_z = |(s, c): (f64, f64)| Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
        let about_x = |(s, c): (f64, f64)| Matrix3::new(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c);
        about_z(turn(self.raan))
            * about_x(turn(self.inclination))
            * about_z(turn(self.argument_of_perigee))
    }
}

/// Into [0, 2 pi).
fn positive(angle: f64) -> f64 {
    if angle < 0.0 { angle + TAU } else { angle }
}

/// From `a` to `b` about `normal`, in [0, 2 pi).
fn angle_between(a: &Vector3<f64>, b: &Vector3<f64>, normal: &Vector3<f64>) -> f64 {
    positive(libm::atan2(a.cross(b).dot(normal), a.dot(b)))
}

/// Whole revolutions in an angle, halves rounded down, and the rest in [-pi, pi).
fn revolutions(angle: f64) -> (f64, f64) {
    let turns = libm::floor((angle + PI) / TAU);
    (turns, angle - turns * TAU)
}

/// Mean from true anomaly, both counting revolutions.
fn mean_from_true(e: f64, nu: f64) -> f64 {
    let (turns, nu) = revolutions(nu);
    let half = 0.5 * nu;
    let eccentric = 2.0
        * libm::atan2(libm::sqrt(1.0 - e) * libm::sin(half), libm::sqrt(1.0 + e) * libm::cos(half));
    turns * TAU + eccentric - e * libm::sin(eccentric)
}

/// True from mean anomaly, both counting revolutions: Kepler's equation.
fn true_from_mean(e: f64, mean: f64) -> f64 {
    let (turns, mean) = revolutions(mean);
    let eccentric = eccentric_from_mean(e, mean);
    let half = 0.5 * eccentric;
    let nu = 2.0
        * libm::atan2(libm::sqrt(1.0 + e) * libm::sin(half), libm::sqrt(1.0 - e) * libm::cos(half));
    turns * TAU + nu
}

/// Solves E - e sin E = M for M in [-pi, pi]: Newton's method, held in a bracket that halves
/// whenever a step would leave it, so that it ends for every eccentricity below 1.
fn eccentric_from_mean(e: f64, mean: f64) -> f64 {
    let (mut low, mut high) = (mean - e, mean + e);
    let mut eccentric = mean + e * libm::sin(mean);
    // Halving alone would need about 55 rounds.
    for _ in 0..80 {
        let excess = eccentric - e * libm::sin(eccentric) - mean;
        if excess > 0.0 {
            high = eccentric;
        } else {
            low = eccentric;
        }
        let newton = eccentric - excess / (1.0 - e * libm::cos(eccentric));
        let inside = newton > low && newton < high;
        let next = if inside { newton } else { 0.5 * (low + high) };
        if (next - eccentric).abs() <= f64::EPSILON * (1.0 + eccentric.abs()) {
            return next;
        }
        eccentric = next;
    }
    eccentric
}

impl KeplerOrbit {
    /// Writes the canonical bytes of the orbit: SI and radians, the orientation if there is one.
    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.number(self.semi_major_axis().metres());
        writer.number(self.eccentricity());
        writer.number(self.true_anomaly().radians());
        writer.option(self.orientation(), |writer, orientation| {
            writer.number(orientation.inclination.radians());
            writer.number(orientation.raan.radians());
            writer.number(orientation.argument_of_perigee.radians());
            writer.tag(match orientation.axes {
                InertialAxes::Eme2000 => 1,
                InertialAxes::Teme => 2,
                InertialAxes::Gcrf => 3,
            });
        });
    }

    /// Reads and checks what [`KeplerOrbit::write`] wrote.
    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let axis = Distance::from_metres(reader.number()?);
        let eccentricity = reader.number()?;
        let anomaly = Angle::from_radians(reader.number()?);
        let orientation = reader.option(|reader| {
            let angles = [reader.number()?, reader.number()?, reader.number()?];
            let [inclination, raan, argument_of_perigee] = angles.map(Angle::from_radians);
            let axes = match reader.tag()? {
                1 => InertialAxes::Eme2000,
                2 => InertialAxes::Teme,
                3 => InertialAxes::Gcrf,
                other => return Err(reader.fault(format!("inertial axes {other} is not known"))),
            };
            Ok(Orientation { inclination, raan, argument_of_perigee, axes })
        })?;
        Self::new(axis, eccentricity, anomaly, orientation)
            .map_err(|error| reader.fault(error.to_string()))
    }
}
