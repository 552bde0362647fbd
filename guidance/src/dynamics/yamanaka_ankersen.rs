//! Relative motion near an elliptic orbit, in closed form.

use nalgebra::DMatrix;

use crate::{
    orbit::{EARTH_MU_M3_S2, KeplerOrbit},
    units::{Angle, Seconds},
};

/// The scaled variables of Tschauner and Hempel at one true anomaly.
///
/// With rho = 1 + e cos nu: scaled position = rho position, scaled velocity = -e sin nu position +
/// c velocity, c = sqrt(p³/mu) / rho. Both are in metres. [Deaconu2014, eq. 1]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TschaunerHempel {
    /// rho = 1 + e cos nu.
    pub rho: f64,
    /// e sin nu.
    pub shear: f64,
    /// c = sqrt(p³/mu) / rho, seconds: also what an impulse of 1 m/s adds to the scaled velocity.
    pub velocity_scale_s: f64,
}

impl TschaunerHempel {
    /// The variables of `orbit` at `true_anomaly`.
    #[must_use]
    pub fn new(orbit: &KeplerOrbit, true_anomaly: Angle) -> Self {
        let (e, p) = (orbit.eccentricity(), orbit.semi_latus_rectum_m());
        let nu = true_anomaly.radians();
        let rho = 1.0 + e * libm::cos(nu);
        let time_unit = p * libm::sqrt(p / EARTH_MU_M3_S2);
        Self { rho, shear: e * libm::sin(nu), velocity_scale_s: time_unit / rho }
    }

    /// T (6 x 6): scaled from physical state, any axes that rotate with the target.
    #[must_use]
    pub fn scaled_from_physical(&self) -> DMatrix<f64> {
        self.blocks(self.rho, -self.shear, self.velocity_scale_s)
    }

    /// The inverse of T (6 x 6): physical from scaled state.
    #[must_use]
    pub fn physical_from_scaled(&self) -> DMatrix<f64> {
        let shear = self.shear / (self.rho * self.velocity_scale_s);
        self.blocks(1.0 / self.rho, shear, 1.0 / self.velocity_scale_s)
    }

    fn blocks(&self, position: f64, mixed: f64, velocity: f64) -> DMatrix<f64> {
        let mut matrix = DMatrix::zeros(6, 6);
        for i in 0..3 {
            matrix[(i, i)] = position;
            matrix[(i + 3, i)] = mixed;
            matrix[(i + 3, i + 3)] = velocity;
        }
        matrix
    }
}

/// Transition matrix (6 x 6) of the scaled state, axes `LVLH_CCSDS`, from true anomaly `from` to
/// `to` (both counting revolutions), `duration` apart. Exact for the linearised motion on any
/// orbit with e in [0, 1). [YamanakaAnkersen2002, eqs. 80-84]
#[must_use]
pub fn yamanaka_ankersen(
    orbit: &KeplerOrbit,
    from: Angle,
    to: Angle,
    duration: Seconds,
) -> DMatrix<f64> {
    let (e, p) = (orbit.eccentricity(), orbit.semi_latus_rectum_m());
    // J = sqrt(mu / p³) (t - t0).
    let j = libm::sqrt(EARTH_MU_M3_S2 / p) / p * duration.seconds();
    let in_plane = fundamental(e, to.radians(), j) * fundamental_inverse(e, from.radians());
    let swing = to.radians() - from.radians();
    let (sine, cosine) = (libm::sin(swing), libm::cos(swing));
    let mut phi = DMatrix::zeros(6, 6);
    for (i, row) in IN_PLANE.into_iter().enumerate() {
        for (k, column) in IN_PLANE.into_iter().enumerate() {
            phi[(row, column)] = in_plane[(i, k)];
        }
    }
    phi[(1, 1)] = cosine;
    phi[(1, 4)] = sine;
    phi[(4, 1)] = -sine;
    phi[(4, 4)] = cosine;
    phi
}

/// Where x, z, x', z' stand in the state.
const IN_PLANE: [usize; 4] = [0, 2, 3, 5];

type Matrix4 = nalgebra::Matrix4<f64>;

/// Fundamental solutions of the in-plane motion, columns, at `nu` with J = `j`.
fn fundamental(e: f64, nu: f64, j: f64) -> Matrix4 {
    let (sine, cosine) = (libm::sin(nu), libm::cos(nu));
    let rho = 1.0 + e * cosine;
    let (s, c) = (rho * sine, rho * cosine);
    let ds = cosine + e * libm::cos(2.0 * nu);
    let dc = -(sine + e * libm::sin(2.0 * nu));
    let stretch = 1.0 + 1.0 / rho;
    #[rustfmt::skip]
    let matrix = Matrix4::new(
        1.0, -c * stretch, s * stretch,   3.0 * rho * rho * j,
        0.0, s,            c,             2.0 - 3.0 * e * s * j,
        0.0, 2.0 * s,      2.0 * c - e,   3.0 * (1.0 - 2.0 * e * s * j),
        0.0, ds,           dc,            -3.0 * e * (ds * j + s / (rho * rho)),
    );
    matrix
}

/// Inverse of [`fundamental`] at J = 0.
fn fundamental_inverse(e: f64, nu: f64) -> Matrix4 {
    let (sine, cosine) = (libm::sin(nu), libm::cos(nu));
    let rho = 1.0 + e * cosine;
    let (s, c) = (rho * sine, rho * cosine);
    let stretch = 1.0 + 1.0 / rho;
    let one = (1.0 - e) * (1.0 + e);
    #[rustfmt::skip]
    let matrix = Matrix4::new(
        one, 3.0 * e * s * (1.0 / rho + 1.0 / (rho * rho)), -e * s * stretch, 2.0 - e * c,
        0.0, -3.0 * s * (1.0 / rho + e * e / (rho * rho)),  s * stretch,      c - 2.0 * e,
        0.0, -3.0 * (c / rho + e),                          c * stretch + e,  -s,
        0.0, 3.0 * rho - one,                               -rho * rho,       e * s,
    );
    matrix / one
}
