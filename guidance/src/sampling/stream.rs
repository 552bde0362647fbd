//! Streams of chance that are independent of each other and of who draws first.

use rand_chacha::{
    ChaCha12Rng,
    rand_core::{Rng, SeedableRng},
};

/// The random numbers of one sample: a function of (seed, group, sample) alone, so that samples
/// can be drawn in any order, on any thread, on any machine.
#[derive(Debug, Clone)]
pub struct Stream {
    generator: ChaCha12Rng,
}

impl Stream {
    /// The stream of `sample` in `group`.
    ///
    /// The key of the cipher is the seed, the group and the sample, in that order; equal only for
    /// equal triples.
    #[must_use]
    pub fn new(seed: u64, group: u64, sample: u64) -> Self {
        let mut key = [0; 32];
        for (place, value) in key.chunks_exact_mut(8).zip([seed, group, sample]) {
            place.copy_from_slice(&value.to_le_bytes());
        }
        Self { generator: ChaCha12Rng::from_seed(key) }
    }

    /// Uniform on the open interval (0, 1): one of the 2^52 midpoints between multiples of 2^-52,
    /// so that quantiles are finite and the law is symmetric.
    pub fn uniform(&mut self) -> f64 {
        let bits = self.generator.next_u64() >> 12;
        (bits as f64 + 0.5) / 4_503_599_627_370_496.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_functions_of_their_key_and_differ() {
        let first = |seed, group, sample| Stream::new(seed, group, sample).uniform();
        assert_eq!(first(1, 2, 3), first(1, 2, 3));
        let keys = [(1, 2, 3), (2, 2, 3), (1, 3, 3), (1, 2, 4), (2, 1, 3), (3, 2, 1)];
        let mut values: Vec<f64> = keys.iter().map(|&(a, b, c)| first(a, b, c)).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        assert_eq!(values.len(), keys.len());
    }

    #[test]
    fn uniform_has_its_moments() {
        let mut stream = Stream::new(7, 0, 0);
        let count = 40_000;
        let values: Vec<f64> = (0..count).map(|_| stream.uniform()).collect();
        assert!(values.iter().all(|&u| u > 0.0 && u < 1.0));
        let mean = values.iter().sum::<f64>() / f64::from(count);
        let variance = values.iter().map(|u| (u - 0.5) * (u - 0.5)).sum::<f64>() / f64::from(count);
        // Four standard errors: sqrt(1/12/n) and sqrt(1/180/n).
        assert!((mean - 0.5).abs() < 4.0 * (1.0 / 12.0 / f64::from(count)).sqrt(), "{mean}");
        let error = (variance - 1.0 / 12.0).abs();
        assert!(error < 4.0 * (1.0 / 180.0 / f64::from(count)).sqrt(), "{variance}");
    }
}
