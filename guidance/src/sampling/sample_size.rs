//! How many samples make a sampled constraint hold with the probability asked for.

/// The bound is proved for violations below this. [Mammarella2019, sec. II.A]
pub const VIOLATION_MAX: f64 = 0.14;

/// Numbers for which the bound says nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SampleSizeError {
    /// epsilon outside (0, 0.14).
    #[error("the violation must lie strictly between 0 and {VIOLATION_MAX}")]
    Violation,
    /// delta outside (0, 1).
    #[error("the confidence's complement must lie strictly between 0 and 1")]
    Confidence,
}

/// N(d, epsilon, delta) = 4.1 / epsilon (ln(21.64 / delta) + 4.39 d log2(8 e / epsilon)): with so
/// many samples, the polytope in d variables that satisfies one linear constraint for all of them
/// lies in the set that satisfies it with probability 1 - epsilon, with confidence 1 - delta.
/// [Mammarella2019, sec. II.A]
///
/// # Errors
/// [`SampleSizeError`].
pub fn sample_size_bound(
    variables: usize,
    violation: f64,
    confidence_complement: f64,
) -> Result<f64, SampleSizeError> {
    if !(violation > 0.0 && violation < VIOLATION_MAX) {
        return Err(SampleSizeError::Violation);
    }
    if !(confidence_complement > 0.0 && confidence_complement < 1.0) {
        return Err(SampleSizeError::Confidence);
    }
    let confidence = libm::log(21.64 / confidence_complement);
    let complexity = 4.39 * variables as f64 * libm::log2(8.0 * std::f64::consts::E / violation);
    Ok(4.1 / violation * (confidence + complexity))
}

/// [`sample_size_bound`], rounded up to whole samples.
///
/// # Errors
/// [`SampleSizeError`].
pub fn sample_size(
    variables: usize,
    violation: f64,
    confidence_complement: f64,
) -> Result<usize, SampleSizeError> {
    // Far below 2^53 for any number of variables that fits a machine.
    sample_size_bound(variables, violation, confidence_complement).map(|n| n.ceil() as usize)
}

/// Probability that any of `claims`, each of confidence 1 - delta, is wrong: at most the sum.
/// This is the joint statement the sampled sets make; none stronger is proved.
#[must_use]
pub fn failure_of_any(claims: usize, confidence_complement: f64) -> f64 {
    (claims as f64 * confidence_complement).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sample_sizes_of_the_paper() {
        // [Mammarella2019, sec. IV]: "the ensuing number of samples is equal to 32,370", which is
        // one group of d = 10; the sum of the text's own N_x + N_u + N_T, with d = n + l m,
        // n = 4, m = 2, T = 10, l = 0..9 for the states, 1..9 for the inputs, is 899,806.
        let size = |d| sample_size(d, 0.05, 1e-3).unwrap();
        assert_eq!(size(10), 32_370);
        let states: usize = (0..10).map(|l| size(4 + 2 * l)).sum();
        let inputs: usize = (1..10).map(|l| size(4 + 2 * l)).sum();
        assert_eq!(states + inputs + size(24), 899_806);
    }

    #[test]
    fn sample_size_outside_the_proof_is_refused() {
        for violation in [0.0, 0.14, -0.1, f64::NAN] {
            assert_eq!(sample_size(4, violation, 1e-3), Err(SampleSizeError::Violation));
        }
        for delta in [0.0, 1.0, -1.0, f64::NAN] {
            assert_eq!(sample_size(4, 0.05, delta), Err(SampleSizeError::Confidence));
        }
    }

    #[test]
    fn joint_confidence_is_the_sum() {
        assert_eq!(failure_of_any(20, 1e-3), 0.02);
        assert_eq!(failure_of_any(5000, 1e-3), 1.0);
    }
}
