//! What thrusters make of a command.

/// Pairs of on-off thrusters, one pair an axis, that open for part of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Thrusters {
    /// Most that an axis delivers on average over a sample.
    pub force_max_n: f64,
    /// Shortest pulse of an axis, N s: what is below is not flown; 0 for perfect valves.
    pub impulse_min_ns: f64,
}

impl Thrusters {
    /// The mean force of each axis over a sample of `duration_s`.
    pub(crate) fn delivered(&self, commanded_n: &[f64], duration_s: f64) -> Vec<f64> {
        let axis = |force: &f64| {
            let force = force.clamp(-self.force_max_n, self.force_max_n);
            if force.abs() * duration_s < self.impulse_min_ns { 0.0 } else { force }
        };
        commanded_n.iter().map(axis).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thrusters_saturate_and_do_not_deliver_short_pulses() {
        let thrusters = Thrusters { force_max_n: 0.3, impulse_min_ns: 0.05 };
        let cases = [(1.0, 0.3), (-0.31, -0.3), (0.009, 0.0), (-0.0099, 0.0), (0.0101, 0.0101)];
        for (commanded, delivered) in cases {
            assert_eq!(thrusters.delivered(&[commanded], 5.0), [delivered], "{commanded}");
        }
        let perfect = Thrusters { impulse_min_ns: 0.0, ..thrusters };
        assert_eq!(perfect.delivered(&[1e-9, -1e-9], 5.0), [1e-9, -1e-9]);
    }
}
