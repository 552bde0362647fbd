//! Summaries of many numbers.

use serde_json::{Value, json};

/// What is said about a set of numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Statistics {
    /// How many.
    pub count: usize,
    /// Arithmetic mean.
    pub mean: f64,
    /// Sample standard deviation (n - 1); 0 for a single number.
    pub std: f64,
    /// Least.
    pub min: f64,
    /// First quartile, by linear interpolation between order statistics.
    pub q25: f64,
    /// Median.
    pub median: f64,
    /// Third quartile.
    pub q75: f64,
    /// Greatest.
    pub max: f64,
}

impl Statistics {
    /// `None` for no numbers at all.
    #[must_use]
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.into_iter().collect();
        sorted.sort_by(f64::total_cmp);
        let (min, max) = (*sorted.first()?, *sorted.last()?);
        let count = sorted.len();
        let mean = sorted.iter().sum::<f64>() / count as f64;
        let squares: f64 = sorted.iter().map(|value| (value - mean).powi(2)).sum();
        let std = if count > 1 { (squares / (count - 1) as f64).sqrt() } else { 0.0 };
        let quantile = |share: f64| quantile(&sorted, share);
        let (q25, median, q75) = (quantile(0.25), quantile(0.5), quantile(0.75));
        Some(Self { count, mean, std, min, q25, median, q75, max })
    }

    /// As in the report.
    #[must_use]
    pub fn json(&self) -> Value {
        json!({
            "mean": self.mean, "std": self.std, "min": self.min, "q25": self.q25,
            "median": self.median, "q75": self.q75, "max": self.max,
        })
    }
}

/// The value below which a `share` of the sorted numbers lie.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (low, high) = (place.floor() as usize, place.ceil() as usize);
    sorted[low] + (sorted[high] - sorted[low]) * (place - low as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_of_a_known_set() {
        let s = Statistics::of([4.0, 1.0, 2.0, 3.0, 10.0]).expect("numbers");
        assert_eq!((s.count, s.min, s.median, s.max), (5, 1.0, 3.0, 10.0));
        assert_eq!((s.q25, s.q75, s.mean), (2.0, 4.0, 4.0));
        // Squares about 4: 0 + 9 + 4 + 1 + 36 = 50; 50 / 4.
        assert!((s.std - 12.5_f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn statistics_interpolate_between_order_statistics() {
        let s = Statistics::of([0.0, 1.0]).expect("numbers");
        assert_eq!((s.q25, s.median, s.q75), (0.25, 0.5, 0.75));
    }

    #[test]
    fn statistics_of_nothing_are_absent() {
        assert_eq!(Statistics::of([]), None);
    }
}
