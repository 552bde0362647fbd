//! Laws of scalar random numbers, drawn by their quantile.

use super::Stream;

/// A bounded law of one number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ScalarLaw {
    /// Always this.
    Constant(f64),
    /// Uniform between two numbers.
    Uniform {
        /// Lower end.
        low: f64,
        /// Upper end.
        high: f64,
    },
    /// Gaussian of mean 0 with all mass outside +-bound cut off.
    TruncatedGaussian {
        /// Standard deviation before the cut.
        deviation: f64,
        /// Largest absolute value, > 0.
        bound: f64,
    },
}

/// Which bounds do not make a law.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("low <= high, deviation > 0 and bound > 0 are needed, all finite")]
pub struct ScalarLawError;

impl ScalarLaw {
    /// Are the numbers a law?
    ///
    /// # Errors
    /// [`ScalarLawError`].
    pub fn check(&self) -> Result<(), ScalarLawError> {
        let sound = match *self {
            Self::Constant(value) => value.is_finite(),
            Self::Uniform { low, high } => low.is_finite() && high.is_finite() && low <= high,
            Self::TruncatedGaussian { deviation, bound } => {
                deviation > 0.0 && deviation.is_finite() && bound > 0.0 && bound.is_finite()
            }
        };
        if sound { Ok(()) } else { Err(ScalarLawError) }
    }

    /// The number that a share `u` in [0, 1] of all draws falls below.
    #[must_use]
    pub fn quantile(&self, u: f64) -> f64 {
        match *self {
            Self::Constant(value) => value,
            Self::Uniform { low, high } => low + u * (high - low),
            Self::TruncatedGaussian { deviation, bound } => {
                truncated_gaussian_quantile(u, deviation, bound)
            }
        }
    }

    /// Draws one number.
    pub fn draw(&self, stream: &mut Stream) -> f64 {
        self.quantile(stream.uniform())
    }

    /// Least and largest value.
    #[must_use]
    pub fn range(&self) -> (f64, f64) {
        match *self {
            Self::Constant(value) => (value, value),
            Self::Uniform { low, high } => (low, high),
            Self::TruncatedGaussian { bound, .. } => (-bound, bound),
        }
    }

    /// Expected value.
    #[must_use]
    pub fn mean(&self) -> f64 {
        match *self {
            Self::Constant(value) => value,
            Self::Uniform { low, high } => 0.5 * (low + high),
            Self::TruncatedGaussian { .. } => 0.0,
        }
    }
}

/// x with P(X <= x) = u for X = N(0, deviation^2) given |X| <= bound.
///
/// By symmetry x(u) = -x(1 - u), and for x >= 0 erf(x / s) = (2u - 1) erf(bound / s) with s =
/// deviation sqrt(2). Solved by Newton's method inside a bracket that halves where Newton leaves
/// it, on the complement erfc where erf has no digits left.
fn truncated_gaussian_quantile(u: f64, deviation: f64, bound: f64) -> f64 {
    if u < 0.5 {
        return -truncated_gaussian_quantile(1.0 - u, deviation, bound);
    }
    let scale = deviation * std::f64::consts::SQRT_2;
    let end = bound / scale;
    let share = 2.0 * u - 1.0;
    if share <= 0.0 || share >= 1.0 {
        return share.clamp(0.0, 1.0) * bound;
    }
    let tail = end > 1.0;
    // erfc(t) = 1 - share erf(end) = (1 - share) + share erfc(end).
    let wanted =
        if tail { (1.0 - share) + share * libm::erfc(end) } else { share * libm::erf(end) };
    let (mut low, mut high) = (0.0, end);
    let mut t = share * end;
    for _ in 0..200 {
        let miss = if tail { wanted - libm::erfc(t) } else { libm::erf(t) - wanted };
        if miss < 0.0 {
            low = t;
        } else {
            high = t;
        }
        let slope = std::f64::consts::FRAC_2_SQRT_PI * libm::exp(-t * t);
        let newton = t - miss / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - t).abs() <= 1e-16 * end {
            return next * scale;
        }
        t = next;
    }
    t * scale
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn truncated_gaussian_quantile_inverts_its_distribution() {
        for (deviation, bound) in [(1.0, 5e-3), (1.0, 1.0), (1.0, 3.0), (0.1, 1.0), (1.0, 7.0)] {
            let law = ScalarLaw::TruncatedGaussian { deviation, bound };
            let scale = deviation * std::f64::consts::SQRT_2;
            for u in [0.0, 1e-6, 0.01, 0.3, 0.5, 0.6, 0.9, 0.999, 1.0] {
                let x = law.quantile(u);
                let back = 0.5 + 0.5 * libm::erf(x / scale) / libm::erf(bound / scale);
                assert!((back - u).abs() < 1e-14, "{deviation} {bound} {u}: {back}");
                assert_eq!(x, -law.quantile(1.0 - u), "{deviation} {bound} {u}");
            }
        }
    }

    #[test]
    fn nearly_untruncated_gaussian_has_its_known_quantile() {
        // The 97.5 % point of the standard normal law, from any table.
        let law = ScalarLaw::TruncatedGaussian { deviation: 1.0, bound: 12.0 };
        assert!((law.quantile(0.975) - 1.959_963_984_540_054).abs() < 1e-12);
    }

    #[test]
    fn law_without_sense_is_refused() {
        for law in [
            ScalarLaw::Constant(f64::NAN),
            ScalarLaw::Uniform { low: 1.0, high: 0.0 },
            ScalarLaw::TruncatedGaussian { deviation: 0.0, bound: 1.0 },
            ScalarLaw::TruncatedGaussian { deviation: 1.0, bound: -1.0 },
        ] {
            assert_eq!(law.check(), Err(ScalarLawError), "{law:?}");
        }
    }
}
