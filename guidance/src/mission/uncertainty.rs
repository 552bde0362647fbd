//! Sets of disturbances as a mission states them.

use nalgebra::{DMatrix, Matrix6, Vector3};

use crate::{dynamics::HillScaling, sets::Zonotope, units::Angle};

/// Disturbances w of one step of the scaled Hill plant, centred at 0.
#[derive(Debug, Clone, PartialEq)]
pub enum DisturbanceSet {
    /// W = {0}.
    None,
    /// |w_i| <= half width, scaled units, 6 values.
    Box(Vec<f64>),
    /// A box in SI units.
    BoxSi {
        /// Half widths along RTN, metres.
        position_m: Vector3<f64>,
        /// Half widths along RTN, metres per second.
        velocity_m_s: Vector3<f64>,
    },
    /// Generators in scaled units, 6 x p.
    Generators(DMatrix<f64>),
    /// W = 2 angle B U, which contains B M(angle) u for every admissible u: the cross product of
    /// a misalignment within +-angle per axis with |u|_inf <= 1 is at most 2 angle per axis.
    /// [Quartullo2025a, sec. V.B]
    Misalignment(Angle),
    /// From what is known of thrusters and of navigation.
    ActuationAndNavigation(ActuationAndNavigation),
}

/// What thrusters and navigation do to one step; ours, the papers state W directly.
///
/// The controller sees estimates y = x + e. With x(k+1) = A x(k) + B (u + du) they obey
/// y(k+1) = A y(k) + B u + w with w = e(k+1) - A e(k) + B du, so
/// W = E + (-A) E + B D, where E holds the errors of an estimate and D those of an input.
/// The guarantee then is one about the estimates: the true state is off by an element of E.
#[derive(Debug, Clone, PartialEq)]
pub struct ActuationAndNavigation {
    /// Errors of the estimates; `None`: none.
    pub navigation: Option<Box<NavigationCovariance>>,
    /// Largest |delivered| / |commanded| - 1 in magnitude, at least 0.
    pub thrust_magnitude_error: f64,
    /// Largest angle of the rotation from commanded to delivered thrust, about any axis, in
    /// [0, pi/2].
    pub pointing_error_max: Angle,
}

/// Covariance of the estimated relative state, and how much of it is to be withstood.
#[derive(Debug, Clone, PartialEq)]
pub struct NavigationCovariance {
    covariance: Matrix6<f64>,
    sigma_level: f64,
    /// F with F F' >= covariance, lower triangular.
    factor: Matrix6<f64>,
}

/// Why a matrix is no covariance, or a level none.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CovarianceFault {
    /// Largest difference of two entries that mirror each other.
    #[error("not symmetric: entries differ by {0:e}")]
    NotSymmetric(f64),
    /// Some combination of components would have a negative variance.
    #[error("not positive semidefinite: component {0} given those before it has negative variance")]
    Indefinite(usize),
    /// Not a finite number above 0.
    #[error("the sigma level is {0}")]
    SigmaLevel(f64),
}

impl DisturbanceSet {
    /// The zonotope in scaled units, for the scaled matrices `a` (6 x 6) and `b` (6 x 3).
    #[must_use]
    pub fn zonotope(&self, scaling: &HillScaling, a: &DMatrix<f64>, b: &DMatrix<f64>) -> Zonotope {
        let generators = match self {
            Self::None => DMatrix::zeros(6, 0),
            Self::Box(half_widths) => diagonal(half_widths),
            Self::BoxSi { position_m, velocity_m_s } => {
                let position = position_m.iter().map(|p| p / scaling.position_unit_m);
                let velocity = velocity_m_s.iter().map(|v| v / scaling.velocity_unit_m_s);
                diagonal(&position.chain(velocity).collect::<Vec<_>>())
            }
            Self::Generators(generators) => generators.clone(),
            Self::Misalignment(angle) => b * (2.0 * angle.radians()),
            Self::ActuationAndNavigation(errors) => return errors.outer_zonotope(scaling, a, b),
        };
        Zonotope::centred(generators)
    }
}

impl ActuationAndNavigation {
    /// E + (-A) E + B D in scaled units, with outer approximations of E and D.
    #[must_use]
    pub fn outer_zonotope(
        &self,
        scaling: &HillScaling,
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
    ) -> Zonotope {
        let estimates = self.navigation.as_ref().map_or_else(
            || Zonotope::centred(DMatrix::zeros(6, 0)),
            |navigation| navigation.outer_zonotope(scaling),
        );
        let before = estimates.linear_map(a);
        let half_width = self.outer_input_error();
        let columns = if half_width == 0.0 { 0 } else { b.ncols() };
        let inputs = Zonotope::centred(b.columns(0, columns) * half_width);
        estimates.minkowski_sum(&before).minkowski_sum(&inputs)
    }

    /// Half width of a box around D, the errors du of inputs |u|_inf <= 1.
    ///
    /// Delivered is (1 + phi) R u, |phi| <= f, R a rotation about a unit vector k by at most
    /// theta, so du = phi u + (1 + phi) ((cos theta - 1) (I - k k') u + sin theta k x u). In a
    /// component, over all k: |u| <= 1, |(I - k k') u| <= (1 + sqrt 3) / 2, |k x u| <= sqrt 2.
    /// For small angles this is f + sqrt 2 theta, which is reached.
    #[must_use]
    pub fn outer_input_error(&self) -> f64 {
        let (f, theta) = (self.thrust_magnitude_error, self.pointing_error_max.radians());
        let half_sine = libm::sin(0.5 * theta);
        let shortened = 2.0 * half_sine * half_sine * 0.5 * (1.0 + libm::sqrt(3.0));
        let turned = std::f64::consts::SQRT_2 * libm::sin(theta);
        f + (1.0 + f) * (shortened + turned)
    }
}

impl NavigationCovariance {
    /// `covariance`: position (m), then velocity (m/s), along RTN; symmetric and positive
    /// semidefinite up to rounding. The errors to be withstood are the ellipsoid
    /// {e : e' covariance^-1 e <= sigma_level^2}.
    ///
    /// # Errors
    /// [`CovarianceFault`].
    pub fn new(covariance: Matrix6<f64>, sigma_level: f64) -> Result<Self, CovarianceFault> {
        if !(sigma_level > 0.0 && sigma_level.is_finite()) {
            return Err(CovarianceFault::SigmaLevel(sigma_level));
        }
        let factor = outer_factor(&covariance)?;
        Ok(Self { covariance, sigma_level, factor })
    }

    /// The covariance, RTN, SI.
    #[must_use]
    pub fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }

    /// How many standard deviations are withstood.
    #[must_use]
    pub fn sigma_level(&self) -> f64 {
        self.sigma_level
    }

    /// E in scaled units: {sigma F xi : |xi|_inf <= 1}, which contains the ellipsoid, where
    /// |xi|_2 <= 1, and follows its correlations. Its support is at most sqrt 6 times the
    /// ellipsoid's; for a diagonal covariance it is the box of sigma standard deviations.
    #[must_use]
    pub fn outer_zonotope(&self, scaling: &HillScaling) -> Zonotope {
        let used: Vec<usize> = (0..6).filter(|&j| self.factor.column(j).amax() > 0.0).collect();
        Zonotope::centred(DMatrix::from_fn(6, used.len(), |i, j| {
            let unit = if i < 3 { scaling.position_unit_m } else { scaling.velocity_unit_m_s };
            self.sigma_level * self.factor[(i, used[j])] / unit
        }))
    }
}

/// Lower triangular F with F F' = P + 1e-12 diag(P): Cholesky's on the correlations, so that
/// metres and metres per second do not meet. The little that is added covers the rounding of a
/// singular P and keeps F on the outer side.
fn outer_factor(covariance: &Matrix6<f64>) -> Result<Matrix6<f64>, CovarianceFault> {
    /// On correlations; far above the rounding of six terms, far below any filter's knowledge.
    const ROUNDING: f64 = 1e-12;
    let asymmetry = (covariance - covariance.transpose()).amax();
    if !(asymmetry <= ROUNDING * covariance.amax()) {
        return Err(CovarianceFault::NotSymmetric(asymmetry));
    }
    let mut deviations = [0.0; 6];
    for (i, deviation) in deviations.iter_mut().enumerate() {
        let variance = covariance[(i, i)];
        // No error, or none alone: then nothing may be correlated with it.
        let alone = variance == 0.0 && covariance.row(i).amax() > 0.0;
        if !(variance >= 0.0) || alone {
            return Err(CovarianceFault::Indefinite(i));
        }
        *deviation = libm::sqrt(variance);
    }
    let correlation = |i: usize, j: usize| match deviations[i] * deviations[j] {
        _ if i == j => 1.0 + ROUNDING,
        0.0 => 0.0,
        scale => covariance[(i, j)] / scale,
    };
    let mut factor = Matrix6::zeros();
    for j in 0..6 {
        let explained: f64 = (0..j).map(|l| factor[(j, l)] * factor[(j, l)]).sum();
        let left = correlation(j, j) - explained;
        if !(left > 0.0) {
            return Err(CovarianceFault::Indefinite(j));
        }
        factor[(j, j)] = libm::sqrt(left);
        for i in j + 1..6 {
            let shared: f64 = (0..j).map(|l| factor[(i, l)] * factor[(j, l)]).sum();
            factor[(i, j)] = (correlation(i, j) - shared) / factor[(j, j)];
        }
    }
    Ok(Matrix6::from_fn(|i, j| deviations[i] * factor[(i, j)]))
}

/// Generators of a box; half widths of 0 need none.
fn diagonal(half_widths: &[f64]) -> DMatrix<f64> {
    let used: Vec<usize> = (0..half_widths.len()).filter(|&i| half_widths[i] != 0.0).collect();
    let mut generators = DMatrix::zeros(half_widths.len(), used.len());
    for (column, &row) in used.iter().enumerate() {
        generators[(row, column)] = half_widths[row];
    }
    generators
}
