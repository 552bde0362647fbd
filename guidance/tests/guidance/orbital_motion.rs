//! Kepler's motion, inertial and relative states, and motion relative to an elliptic orbit.

use nalgebra::{DMatrix, DVector, Vector3};
use vbar_guidance::{
    dynamics::{TschaunerHempel, clohessy_wiltshire, yamanaka_ankersen},
    frames::{InFrame, InertialAxes, RTN_FROM_LVLH_CCSDS, RelativeState, Rtn},
    orbit::{InertialState, KeplerOrbit, Orientation, chaser_state, relative_state},
    units::{Angle, Distance, Seconds},
};

fn orbit(e: f64, nu_rad: f64) -> KeplerOrbit {
    let orientation = Orientation {
        inclination: Angle::from_degrees(51.6),
        raan: Angle::from_degrees(200.0),
        argument_of_perigee: Angle::from_degrees(70.0),
        axes: InertialAxes::Eme2000,
    };
    // Perigee at 7000 km, whatever the eccentricity.
    let a = Distance::from_metres(7e6 / (1.0 - e));
    KeplerOrbit::new(a, e, Angle::from_radians(nu_rad), Some(orientation)).unwrap()
}

const ECCENTRICITIES: [f64; 6] = [0.0, 1e-8, 0.004, 0.3, 0.7988, 0.97];

#[test]
fn transition_matrices_compose() {
    for e in ECCENTRICITIES {
        for nu in [-2.5, 0.0, 1.0] {
            let orbit = orbit(e, nu);
            let times = [0.0, 0.37, 1.61].map(|share| orbit.period().seconds() * share);
            let nus = times.map(|t| orbit.true_anomaly_after(Seconds::from_seconds(t)));
            let phi = |i: usize, j: usize| {
                let duration = Seconds::from_seconds(times[j] - times[i]);
                yamanaka_ankersen(&orbit, nus[i], nus[j], duration)
            };
            let (whole, parts) = (phi(0, 2), phi(1, 2) * phi(0, 1));
            // What the product itself cannot hold: its terms are larger than its sum.
            let size = phi(1, 2).abs() * phi(0, 1).abs();
            let off = (&whole - parts).amax() / size.amax().max(whole.amax());
            assert!(off < 1e-12, "e = {e}, nu = {nu}: {off:e}");
            assert!((phi(1, 1) - DMatrix::identity(6, 6)).amax() < 1e-12 / (1.0 - e), "e = {e}");
        }
    }
}

/// x'' = 2 z', y'' = -y, z'' = 3 z / rho - 2 x' [YamanakaAnkersen2002, eq. 15], derivatives by
/// true anomaly.
fn tschauner_hempel(e: f64, nu: f64, x: &DVector<f64>) -> DVector<f64> {
    let rho = 1.0 + e * libm::cos(nu);
    let turn = [2.0 * x[5], -x[1], 3.0 * x[2] / rho - 2.0 * x[3]];
    DVector::from_column_slice(&[x[3], x[4], x[5], turn[0], turn[1], turn[2]])
}

#[test]
fn transition_matrix_agrees_with_integration() {
    for e in ECCENTRICITIES {
        for nu in [-2.5, 0.3] {
            let orbit = orbit(e, nu);
            let duration = Seconds::from_seconds(0.8 * orbit.period().seconds());
            let end = orbit.true_anomaly_after(duration);
            let phi = yamanaka_ankersen(&orbit, orbit.true_anomaly(), end, duration);
            // Runge and Kutta's fourth order: 40,000 steps leave about 1e-14.
            let steps = 40_000;
            let h = (end.radians() - nu) / f64::from(steps);
            let mut worst: f64 = 0.0;
            for column in 0..6 {
                let mut x = DVector::zeros(6);
                x[column] = 1.0;
                for step in 0..steps {
                    let at = nu + h * f64::from(step);
                    let k1 = tschauner_hempel(e, at, &x);
                    let k2 = tschauner_hempel(e, at + 0.5 * h, &(&x + &k1 * (0.5 * h)));
                    let k3 = tschauner_hempel(e, at + 0.5 * h, &(&x + &k2 * (0.5 * h)));
                    let k4 = tschauner_hempel(e, at + h, &(&x + &k3 * h));
                    x += (k1 + k2 * 2.0 + k3 * 2.0 + k4) * (h / 6.0);
                }
                worst = worst.max((phi.column(column) - x).amax());
            }
            let off = worst / phi.amax();
            assert!(off < 1e-12, "e = {e}, nu = {nu}: {off:e}");
        }
    }
}

#[test]
fn transition_matrix_of_a_circular_orbit_is_clohessy_wiltshire() {
    let orbit = orbit(0.0, 0.4);
    for share in [0.01, 0.3, 1.7] {
        let duration = Seconds::from_seconds(share * orbit.period().seconds());
        let end = orbit.true_anomaly_after(duration);
        let phi = yamanaka_ankersen(&orbit, orbit.true_anomaly(), end, duration);
        let (expected, _) = clohessy_wiltshire(end.radians() - 0.4);
        let mut turn = DMatrix::zeros(6, 6);
        for column in 0..3 {
            let axis = InFrame::new(Vector3::ith(column, 1.0));
            let turned = (RTN_FROM_LVLH_CCSDS * axis).components;
            turn.view_mut((0, column), (3, 1)).copy_from(&turned);
            turn.view_mut((3, column + 3), (3, 1)).copy_from(&turned);
        }
        let off = (&turn * phi * turn.transpose() - &expected).amax() / expected.amax();
        assert!(off < 1e-13, "{share}: {off:e}");
    }
}

#[test]
fn elements_come_back_from_the_state() {
    for e in [0.0, 1e-6, 0.3, 0.9] {
        for nu in [0.0, 1.0, 4.0] {
            let orbit = orbit(e, nu);
            let state = orbit.inertial_state_after(Seconds::from_seconds(0.0)).unwrap();
            let back = KeplerOrbit::through(&state).unwrap();
            let a = orbit.semi_major_axis().metres();
            assert!((back.semi_major_axis().metres() / a - 1.0).abs() < 1e-13 / (1.0 - e));
            assert!((back.eccentricity() - e).abs() < 1e-14);
            // On a circle the angles are a matter of taste; the motion is not.
            for t in [0.0, 500.0, 20_000.0] {
                let at = |orbit: &KeplerOrbit| {
                    orbit.inertial_state_after(Seconds::from_seconds(t)).unwrap()
                };
                let (a, b) = (at(&orbit), at(&back));
                let off = (a.position_m.components - b.position_m.components).norm();
                assert!(off < 1e-4, "e = {e}, nu = {nu}, {t} s: {off:e} m");
            }
        }
    }
}

#[test]
fn states_that_are_on_no_ellipse_are_refused() {
    let state = |p: [f64; 3], v: [f64; 3]| InertialState {
        axes: InertialAxes::Gcrf,
        position_m: InFrame::new(Vector3::from(p)),
        velocity_m_s: InFrame::new(Vector3::from(v)),
    };
    for (p, v) in [
        ([7e6, 0.0, 0.0], [0.0, 12e3, 0.0]),
        ([7e6, 0.0, 0.0], [1e3, 0.0, 0.0]),
        ([0.0; 3], [0.0, 7e3, 0.0]),
        ([f64::NAN, 0.0, 0.0], [0.0, 7e3, 0.0]),
    ] {
        assert!(KeplerOrbit::through(&state(p, v)).is_err(), "{p:?} {v:?}");
    }
}

#[test]
fn relative_and_inertial_states_are_inverse() {
    let target = orbit(0.3, 1.0).inertial_state_after(Seconds::from_seconds(123.0)).unwrap();
    let relative = RelativeState::<Rtn> {
        position_m: InFrame::new(Vector3::new(-120.0, 3_000.0, 45.0)),
        velocity_m_s: InFrame::new(Vector3::new(0.3, -1.5, 0.02)),
    };
    let chaser = chaser_state(&target, &relative).unwrap();
    let back = relative_state(&target, &chaser).unwrap();
    // Positions are differences of numbers of 1e7 m, velocities of 1e4 m/s.
    assert!((back.position_m.components - relative.position_m.components).norm() < 1e-8);
    assert!((back.velocity_m_s.components - relative.velocity_m_s.components).norm() < 1e-11);
    let elsewhere = InertialState { axes: InertialAxes::Teme, ..chaser };
    assert_eq!(relative_state(&target, &elsewhere), None);
}

#[test]
fn linearised_motion_is_the_limit_of_two_keplerian_ones() {
    // Two craft flown by Kepler's equation, a metre apart: the transition matrix predicts the
    // second from the first to the square of their distance over the radius.
    let target = orbit(0.4, 0.7);
    let start = target.inertial_state_after(Seconds::from_seconds(0.0)).unwrap();
    let relative = RelativeState::<Rtn> {
        position_m: InFrame::new(Vector3::new(60.0, -80.0, 30.0)),
        velocity_m_s: InFrame::new(Vector3::new(0.05, -0.02, 0.03)),
    };
    let chaser = KeplerOrbit::through(&chaser_state(&start, &relative).unwrap()).unwrap();
    let duration = Seconds::from_seconds(4_000.0);
    let at = |orbit: &KeplerOrbit| orbit.inertial_state_after(duration).unwrap();
    let flown = relative_state(&at(&target), &at(&chaser)).unwrap();
    let flown = flown.rotated(RTN_FROM_LVLH_CCSDS.inverse()).position_m.components;
    let (from, to) = (target.true_anomaly(), target.true_anomaly_after(duration));
    let first = relative.rotated(RTN_FROM_LVLH_CCSDS.inverse());
    let (p, v) = (first.position_m.components, first.velocity_m_s.components);
    let x = DVector::from_column_slice(&[p.x, p.y, p.z, v.x, v.y, v.z]);
    let predicted = TschaunerHempel::new(&target, to).physical_from_scaled()
        * yamanaka_ankersen(&target, from, to, duration)
        * TschaunerHempel::new(&target, from).scaled_from_physical()
        * x;
    let off = (flown - predicted.fixed_rows::<3>(0)).norm();
    assert!(off < 0.05 && flown.norm() > 100.0, "{off} m of {} m", flown.norm());
}
