//! Disturbance sets made from what a ground station knows: sampled errors lie inside.

use nalgebra::{DMatrix, DVector, Matrix6, Rotation3, Unit, Vector3, Vector6};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    dynamics::{HillScaling, clohessy_wiltshire},
    mission::{ActuationAndNavigation, CovarianceFault, DisturbanceSet, NavigationCovariance},
    program::zonotope_gauge,
    sets::ConvexSet,
    units::Angle,
};

/// EnviSat's plant [Quartullo2025a, sec. V.B]: 360 / 1024 degrees a step, 25 mm/s^2.
fn plant() -> (HillScaling, DMatrix<f64>, DMatrix<f64>) {
    let (a, b) = clohessy_wiltshire(std::f64::consts::TAU / 1024.0);
    (HillScaling::new(1.046e-3, 0.025), a, b)
}

fn uniform<const N: usize>(random: &mut ChaCha8Rng) -> [f64; N] {
    std::array::from_fn(|_| random.random_range(-1.0..=1.0))
}

/// R' R of random entries, with standard deviations of decimetres and millimetres a second; a
/// number of components is left without any error.
fn covariance(exact_components: usize, random: &mut ChaCha8Rng) -> Matrix6<f64> {
    let mut root = Matrix6::from_fn(|_, _| random.random_range(-1.0..1.0));
    for mut column in root.column_iter_mut().take(exact_components) {
        column.fill(0.0);
    }
    let units = Matrix6::from_diagonal(&Vector6::new(0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3));
    let covariance = units * root.transpose() * root * units;
    // The product is symmetric up to the order of its sums.
    (covariance + covariance.transpose()) * 0.5
}

/// The thrust that is delivered for `u`: turned by at most `theta` about any axis, longer or
/// shorter by at most the share `f`.
fn delivered(u: Vector3<f64>, theta: f64, f: f64, random: &mut ChaCha8Rng) -> Vector3<f64> {
    let axis = Vector3::from(uniform::<3>(random));
    let axis = Unit::new_normalize(axis + Vector3::repeat(1e-9));
    let share: f64 = if random.random() { 1.0 } else { random.random_range(0.0..1.0) };
    let length = if random.random() { f } else { random.random_range(-f..=f) };
    Rotation3::from_axis_angle(&axis, theta * share) * u * (1.0 + length)
}

/// Scaled w = e(k+1) - A e(k) + B du for one drawn set of errors, the ellipsoid's surface and the
/// corners of the input box included.
fn drawn(
    covariance: &Matrix6<f64>,
    sigma: f64,
    (theta, f): (f64, f64),
    random: &mut ChaCha8Rng,
) -> DVector<f64> {
    let (scaling, a, b) = plant();
    let eigen = covariance.symmetric_eigen();
    let root = eigen.eigenvalues.map(|value| value.max(0.0).sqrt());
    let error = |random: &mut ChaCha8Rng| {
        let direction = Vector6::from(uniform::<6>(random));
        let inside = direction / direction.norm() * sigma;
        let si = eigen.eigenvectors * root.component_mul(&inside);
        DVector::from_fn(6, |i, _| {
            si[i] / if i < 3 { scaling.position_unit_m } else { scaling.velocity_unit_m_s }
        })
    };
    let (before, after) = (error(random), error(random));
    let u = Vector3::from(uniform::<3>(random));
    let u = if random.random() { u.map(f64::signum) } else { u };
    let du = delivered(u, theta, f, random) - u;
    after - &a * before + &b * DVector::from_column_slice(du.as_slice())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    /// Whatever is drawn from the stated errors lies in W.
    #[test]
    fn actuation_and_navigation_contain_every_drawn_error(
        seed: u64,
        sigma in 0.5..5.0_f64,
        theta_deg in 0.0..60.0_f64,
        f in 0.0..0.5_f64,
        exact_components in 0usize..4,
    ) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let covariance = covariance(exact_components, &mut random);
        let pointing_error_max = Angle::from_degrees(theta_deg);
        let navigation = NavigationCovariance::new(covariance, sigma).unwrap();
        let set = DisturbanceSet::ActuationAndNavigation(ActuationAndNavigation {
            navigation: Some(Box::new(navigation)),
            thrust_magnitude_error: f,
            pointing_error_max,
        });
        let (scaling, a, b) = plant();
        let zonotope = set.zonotope(&scaling, &a, &b);
        let theta = pointing_error_max.radians();
        for _ in 0..20 {
            let w = drawn(&covariance, sigma, (theta, f), &mut random);
            // The gauge is solved to 1e-10; eigenvalues of a singular covariance carry the square
            // root of their rounding, 1e-8 of a standard deviation.
            if exact_components == 0 {
                let gauge = zonotope_gauge(zonotope.generators(), &w);
                prop_assert!(gauge.is_some_and(|gauge| gauge <= 1.0 + 1e-7), "{:?}", gauge);
            }
            let d = DVector::from_column_slice(&uniform::<6>(&mut random));
            let support = zonotope.support_function(&d);
            prop_assert!(d.dot(&w) <= support * (1.0 + 1e-6), "{} {}", d.dot(&w), support);
        }
    }

    /// The zonotope is at least the ellipsoid and at most sqrt 6 times as wide.
    #[test]
    fn navigation_set_is_outer_and_within_sqrt_6(seed: u64, sigma in 0.5..5.0_f64) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let covariance = covariance(0, &mut random);
        let (scaling, ..) = plant();
        let set = NavigationCovariance::new(covariance, sigma).unwrap().outer_zonotope(&scaling);
        for _ in 0..50 {
            let d = Vector6::from(uniform::<6>(&mut random));
            let si = Vector6::from_fn(|i, _| {
                d[i] / if i < 3 { scaling.position_unit_m } else { scaling.velocity_unit_m_s }
            });
            // sup of d' e over the ellipsoid.
            let exact = sigma * (si.transpose() * covariance * si)[0].sqrt();
            let outer = set.support_function(&DVector::from_column_slice(d.as_slice()));
            prop_assert!(outer >= exact * (1.0 - 1e-12), "{} {}", outer, exact);
            prop_assert!(outer <= exact * 6.0_f64.sqrt() * (1.0 + 1e-9), "{} {}", outer, exact);
        }
    }
}

#[test]
fn navigation_set_of_independent_errors_is_their_box() {
    let deviations = Vector6::new(0.1, 0.2, 0.05, 1e-3, 2e-3, 0.0);
    let covariance = Matrix6::from_diagonal(&deviations.component_mul(&deviations));
    let (scaling, ..) = plant();
    let set = NavigationCovariance::new(covariance, 3.0).unwrap().outer_zonotope(&scaling);
    assert_eq!(set.generators().ncols(), 5);
    for i in 0..6 {
        let unit = if i < 3 { scaling.position_unit_m } else { scaling.velocity_unit_m_s };
        // 1e-12 is added to every variance.
        assert!((set.half_widths()[i] * unit - 3.0 * deviations[i]).abs() < 1e-12);
    }
}

#[test]
fn input_error_is_the_stated_one_for_small_angles() {
    let errors = |f, degrees| ActuationAndNavigation {
        navigation: None,
        thrust_magnitude_error: f,
        pointing_error_max: Angle::from_degrees(degrees),
    };
    assert_eq!(errors(0.0, 0.0).outer_input_error(), 0.0);
    assert_eq!(errors(0.03, 0.0).outer_input_error(), 0.03);
    // f + sqrt 2 theta; the next terms are f theta and theta^2.
    let theta = 0.1_f64.to_radians();
    let small = errors(1e-3, 0.1).outer_input_error();
    assert!((small - 1e-3 - 2.0_f64.sqrt() * theta).abs() < 1e-5, "{small}");
    // Reached: u = (1, 1, -1) turned about (0, 1, 1) / sqrt 2 moves along -x by sqrt 2 sin theta.
    let axis = Unit::new_normalize(Vector3::new(0.0, 1.0, 1.0));
    let u = Vector3::new(1.0, 1.0, -1.0);
    let moved = (Rotation3::from_axis_angle(&axis, theta) * u - u).amax();
    let outer = errors(0.0, 0.1).outer_input_error();
    assert!(moved <= outer && moved > 0.99 * outer, "{moved} {outer}");
    let (scaling, a, b) = plant();
    assert!(errors(0.0, 0.0).outer_zonotope(&scaling, &a, &b).is_point());
}

#[test]
fn covariance_at_fault_is_named() {
    let good = Matrix6::<f64>::identity();
    let altered = |entries: &[(usize, usize, f64)]| {
        let mut matrix = good;
        entries.iter().for_each(|&(i, j, value)| matrix[(i, j)] = value);
        NavigationCovariance::new(matrix, 3.0).map(|_| ())
    };
    assert_eq!(altered(&[]), Ok(()));
    assert_eq!(altered(&[(0, 1, 0.5)]), Err(CovarianceFault::NotSymmetric(0.5)));
    assert_eq!(altered(&[(2, 2, -1.0)]), Err(CovarianceFault::Indefinite(2)));
    let correlated = |c: f64| altered(&[(0, 4, c), (4, 0, c)]);
    assert_eq!(correlated(1.0 + 1e-9), Err(CovarianceFault::Indefinite(4)));
    // Singular is a covariance still, also with a last digit lost.
    assert_eq!(correlated(1.0), Ok(()));
    assert_eq!(correlated(1.0 + f64::EPSILON), Ok(()));
    // Without error, but correlated.
    let alone = altered(&[(3, 3, 0.0), (3, 5, 0.1), (5, 3, 0.1)]);
    assert_eq!(alone, Err(CovarianceFault::Indefinite(3)));
    for level in [0.0, -1.0, f64::INFINITY] {
        let fault = NavigationCovariance::new(good, level).unwrap_err();
        assert_eq!(fault, CovarianceFault::SigmaLevel(level));
    }
    assert!(NavigationCovariance::new(good * f64::NAN, 3.0).is_err());
}
