//! Relative motion near an elliptic orbit, linearised, discretised along the orbit.

use nalgebra::{SMatrix, SVector, Vector3};

use crate::{
    budget::{Budget, Interruption},
    matrices::product_fixed,
    orbit::{EARTH_MU_M3_S2, KeplerOrbit},
    units::{Mass, Seconds},
};

/// [x, y, z, x', y', z'] in RTN: metres, metres per second.
pub type RelativeVector = SVector<f64, 6>;
/// 6 x 6, on [`RelativeVector`]s.
pub type TransitionMatrix = SMatrix<f64, 6, 6>;
/// 6 x 3, from forces along RTN in newtons.
pub type ForceMatrix = SMatrix<f64, 6, 3>;

/// The orbital angle turned within one integration step at most. Runge-Kutta's fourth order
/// leaves 24 x (1.5e-3)^5 / 120 = 1.5e-15 of a step of 30 s in low orbit.
const TURN_MAX_RAD: f64 = 1.5e-3;
/// Most integration steps of one sample; reached only by samples of many revolutions.
const INTEGRATION_STEPS_MAX: f64 = 1e6;

/// x(k+1) = A x(k) + B u(k) with the force u held constant in RTN over the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldStep {
    /// A.
    pub a: TransitionMatrix,
    /// B.
    pub b: ForceMatrix,
}

/// The linearised plant sampled along one period: A(k + kp) = A(k), B(k + kp) = B(k).
/// [AguilarMarsillach2022, eq. 7]
///
/// The period is folded even if kp samples are not exactly a revolution; [`Self::fold_error`]
/// says by how much they miss it.
#[derive(Debug, Clone, PartialEq)]
pub struct PeriodicPlant {
    sample_time: Seconds,
    fold_error: Seconds,
    steps: Vec<HeldStep>,
    /// fractions[k][i - 1]: from sample k over i / s of a step.
    fractions: Vec<Vec<HeldStep>>,
    fraction_count: usize,
}

/// Accelerations per unit of state at true anomaly `nu`: the lower half of A(t).
///
/// [AguilarMarsillach2022, eq. 5] with the dots restored on the two Coriolis terms, 2 h / r^2
/// times dy/dt and dx/dt, which the printed text has lost.
fn rates(orbit: &KeplerOrbit, nu: f64) -> SMatrix<f64, 3, 6> {
    let (e, p) = (orbit.eccentricity(), orbit.semi_latus_rectum_m());
    let r = p / (1.0 + e * libm::cos(nu));
    let h = libm::sqrt(EARTH_MU_M3_S2 * p);
    let radial_speed = libm::sqrt(EARTH_MU_M3_S2 / p) * e * libm::sin(nu);
    let gravity = EARTH_MU_M3_S2 / (r * r * r);
    let turn = h / (r * r);
    let slowing = 2.0 * turn * radial_speed / r;
    #[rustfmt::skip]
    let matrix = SMatrix::<f64, 3, 6>::from_row_slice(&[
        2.0 * gravity + turn * turn, -slowing,              0.0,      0.0,         2.0 * turn, 0.0,
        slowing,                     turn * turn - gravity, 0.0,      -2.0 * turn, 0.0,        0.0,
        0.0,                         0.0,                   -gravity, 0.0,         0.0,        0.0,
    ]);
    matrix
}

/// Steps that the integration over `duration` would take, a whole number: the work of
/// [`elliptic_step`], which takes no more than a million.
#[must_use]
pub fn integration_steps(orbit: &KeplerOrbit, duration: Seconds) -> f64 {
    let perigee = orbit.semi_major_axis().metres() * (1.0 - orbit.eccentricity());
    let fastest = libm::sqrt(EARTH_MU_M3_S2 * orbit.semi_latus_rectum_m()) / (perigee * perigee);
    let turned = fastest * duration.seconds();
    libm::ceil(turned / TURN_MAX_RAD)
}

/// A and B from `start` over `duration`, integrated along the orbit.
///
/// Freezing A at the start instead costs 2e-3 to 8e-3 in A at e = 0.1 and 30 s.
#[must_use]
pub fn elliptic_step(
    orbit: &KeplerOrbit,
    mass: Mass,
    start: Seconds,
    duration: Seconds,
) -> HeldStep {
    let (from, length) = (start.seconds(), duration.seconds());
    let count = integration_steps(orbit, duration).clamp(1.0, INTEGRATION_STEPS_MAX);
    let step = length / count;
    let at = |t: f64| rates(orbit, orbit.true_anomaly_after(Seconds::from_seconds(t)).radians());
    // Columns 0-5: A; 6-8: B for unit acceleration.
    let mut z = SMatrix::<f64, 6, 9>::zeros();
    (0..6).for_each(|i| z[(i, i)] = 1.0);
    let mut here = at(from);
    for i in 0..count as usize {
        let middle = at(from + (i as f64 + 0.5) * step);
        let next = at(from + (i as f64 + 1.0) * step);
        let k1 = derivative(&here, &z);
        let k2 = derivative(&middle, &(z + k1 * (0.5 * step)));
        let k3 = derivative(&middle, &(z + k2 * (0.5 * step)));
        let k4 = derivative(&next, &(z + k3 * step));
        z += (k1 + (k2 + k3) * 2.0 + k4) * (step / 6.0);
        here = next;
    }
    HeldStep {
        a: z.fixed_columns::<6>(0).into_owned(),
        b: z.fixed_columns::<3>(6) / mass.kilograms(),
    }
}

fn derivative(rates: &SMatrix<f64, 3, 6>, z: &SMatrix<f64, 6, 9>) -> SMatrix<f64, 6, 9> {
    let lower = product_fixed(rates, z);
    SMatrix::from_fn(|i, j| match i {
        0..3 => z[(i + 3, j)],
        _ => lower[(i - 3, j)] + if j == i + 3 { 1.0 } else { 0.0 },
    })
}

impl PeriodicPlant {
    /// Samples `steps_per_period` (kp) steps of `sample_time` from the mission's start, each also
    /// cut into `fractions` equal parts for what must be known between samples.
    ///
    /// On a circular orbit one step stands for all: kp = 1 is the plain time-invariant plant.
    ///
    /// # Panics
    /// If `steps_per_period` or `fractions` is 0.
    #[must_use]
    pub fn new(
        orbit: &KeplerOrbit,
        mass: Mass,
        sample_time: Seconds,
        steps_per_period: usize,
        fractions: usize,
    ) -> Self {
        let unlimited = Budget::UNLIMITED;
        Self::within(orbit, mass, sample_time, [steps_per_period, fractions], unlimited)
            .expect("this budget never interrupts")
    }

    /// The same for kp and the parts of a step in `counts`, if there is time.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    ///
    /// # Panics
    /// As [`PeriodicPlant::new`].
    pub fn within(
        orbit: &KeplerOrbit,
        mass: Mass,
        sample_time: Seconds,
        counts: [usize; 2],
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let [steps_per_period, fractions] = counts;
        assert!(steps_per_period > 0 && fractions > 0, "at least one step and one part");
        let time = sample_time.seconds();
        let over = |k: usize, part: f64| {
            budget.check()?;
            let start = Seconds::from_seconds(k as f64 * time);
            Ok(elliptic_step(orbit, mass, start, Seconds::from_seconds(part * time)))
        };
        let part = |i: usize| i as f64 / fractions as f64;
        let whole = steps_per_period as f64 * time - orbit.period().seconds();
        let invariant = orbit.eccentricity() == 0.0 && steps_per_period == 1;
        Ok(Self {
            sample_time,
            fold_error: Seconds::from_seconds(if invariant { 0.0 } else { whole }),
            steps: (0..steps_per_period).map(|k| over(k, 1.0)).collect::<Result<_, _>>()?,
            fractions: (0..steps_per_period)
                .map(|k| (1..fractions).map(|i| over(k, part(i))).collect())
                .collect::<Result<_, _>>()?,
            fraction_count: fractions,
        })
    }

    /// Length of a step.
    #[must_use]
    pub fn sample_time(&self) -> Seconds {
        self.sample_time
    }

    /// kp steps minus one revolution; 0 for a time-invariant plant.
    #[must_use]
    pub fn fold_error(&self) -> Seconds {
        self.fold_error
    }

    /// kp.
    #[must_use]
    pub fn steps_per_period(&self) -> usize {
        self.steps.len()
    }

    /// Parts s that a step is cut into.
    #[must_use]
    pub fn fraction_count(&self) -> usize {
        self.fraction_count
    }

    /// A(k), B(k) for any k.
    #[must_use]
    pub fn step(&self, k: usize) -> &HeldStep {
        &self.steps[k % self.steps.len()]
    }

    /// From sample k over `i` of s parts of a step, 0 < i < s.
    #[must_use]
    pub fn fraction(&self, k: usize, i: usize) -> &HeldStep {
        &self.fractions[k % self.steps.len()][i - 1]
    }

    /// Phi(k + j, k) = A(k+j-1) ... A(k).
    #[must_use]
    pub fn transition(&self, k: usize, j: usize) -> TransitionMatrix {
        (k..k + j).fold(TransitionMatrix::identity(), |phi, i| product_fixed(&self.step(i).a, &phi))
    }

    /// A(k) x + B(k) u.
    #[must_use]
    pub fn advance(&self, k: usize, x: &RelativeVector, force_n: &Vector3<f64>) -> RelativeVector {
        self.step(k).advance(x, force_n)
    }
}

impl HeldStep {
    /// A x + B u.
    #[must_use]
    pub fn advance(&self, x: &RelativeVector, force_n: &Vector3<f64>) -> RelativeVector {
        product_fixed(&self.a, x) + product_fixed(&self.b, force_n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        dynamics::clohessy_wiltshire,
        units::{Angle, Distance},
    };

    fn orbit(e: f64, degrees: f64) -> KeplerOrbit {
        let axis = Distance::from_metres(7_419_320.0);
        KeplerOrbit::new(axis, e, Angle::from_degrees(degrees), None).unwrap()
    }

    const ONE_KG: Mass = Mass::from_kilograms(1.0);

    fn over(orbit: &KeplerOrbit, start: f64, duration: f64) -> HeldStep {
        let (start, duration) = (Seconds::from_seconds(start), Seconds::from_seconds(duration));
        elliptic_step(orbit, ONE_KG, start, duration)
    }

    #[test]
    fn circular_orbit_gives_the_closed_form() {
        let orbit = orbit(0.0, 20.0);
        let n = orbit.mean_motion_rad_s();
        let step = over(&orbit, 100.0, 400.0);
        let (a, b) = clohessy_wiltshire(n * 400.0);
        // The closed form is in units of time 1 / n.
        let unit = |i: usize| if i < 3 { 1.0 } else { n };
        for i in 0..6 {
            for j in 0..6 {
                let expected = a[(i, j)] * unit(i) / unit(j);
                let error = (step.a[(i, j)] - expected).abs() * unit(j) / unit(i);
                assert!(error < 1e-12, "A[{i}, {j}]: {error:e}");
            }
            for j in 0..3 {
                let expected = b[(i, j)] * unit(i) / (n * n);
                let error = (step.b[(i, j)] - expected).abs() * (n * n) / unit(i);
                assert!(error < 1e-12, "B[{i}, {j}]: {error:e}");
            }
        }
    }

    #[test]
    fn parts_of_a_step_compose_to_the_whole() {
        let orbit = orbit(0.6, 300.0);
        let (first, second) = (over(&orbit, 50.0, 70.0), over(&orbit, 120.0, 230.0));
        let whole = over(&orbit, 50.0, 300.0);
        let a = product_fixed(&second.a, &first.a);
        let b = product_fixed(&second.a, &first.b) + second.b;
        assert!((a - whole.a).amax() < 1e-11 * whole.a.amax());
        assert!((b - whole.b).amax() < 1e-11 * whole.b.amax());
    }

    #[test]
    fn period_is_folded_and_its_error_is_said() {
        let orbit = orbit(0.1, 145.0);
        let seconds = Seconds::from_seconds(30.0);
        let plant = PeriodicPlant::new(&orbit, ONE_KG, seconds, 212, 3);
        assert_eq!(plant.step(5), plant.step(5 + 2 * 212));
        // Published: the period is 6360.000280736046 s.
        assert!((plant.fold_error().seconds() + 0.000280736046).abs() < 1e-9);
        let phi = plant.transition(200, 20);
        let composed = product_fixed(&plant.transition(210, 10), &plant.transition(200, 10));
        assert!((phi - composed).amax() < 1e-13 * phi.amax());
        // Two thirds of a step, then the rest of it.
        let rest = over(&orbit, 7.0 * 30.0 + 20.0, 10.0);
        let whole = product_fixed(&rest.a, &plant.fraction(7, 2).a);
        assert!((whole - plant.step(7).a).amax() < 1e-12 * 30.0);
    }
}
