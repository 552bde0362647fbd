//! Any discrete-time linear plant: `x(k+1) = A x(k) + B u(k) + w(k)`.

use nalgebra::{DMatrix, DVector};

/// The plant, in its own units.
#[derive(Debug, Clone)]
pub(crate) struct LinearPlant {
    /// n x n.
    pub a: DMatrix<f64>,
    /// n x m.
    pub b: DMatrix<f64>,
}

impl LinearPlant {
    /// The next state without disturbance.
    pub(crate) fn advance(&self, state: &DVector<f64>, input: &DVector<f64>) -> DVector<f64> {
        &self.a * state + &self.b * input
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{golden_cases, vector};

    /// Foreign numbers: the recorded loops of the double integrator, replayed state by state.
    #[test]
    fn linear_plant_replays_recorded_loops() {
        let plant = LinearPlant {
            a: DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]),
            b: DMatrix::from_row_slice(2, 1, &[0.0, 1.0]),
        };
        let mut checked = 0;
        for trace in golden_cases("traces_003_ftc_special.json") {
            let steps = trace["steps"].as_array().expect("steps");
            if vector(&steps[0]["x"]).len() != 2 {
                continue;
            }
            for (index, step) in steps.iter().enumerate() {
                let next = plant.advance(&vector(&step["x"]), &vector(&step["u_used"]))
                    + vector(&step["w"]);
                let recorded = match steps.get(index + 1) {
                    Some(following) => vector(&following["x"]),
                    None => vector(&trace["x_final"]),
                };
                assert!((next - recorded).amax() < 1e-12, "step {index}");
                checked += 1;
            }
        }
        assert!(checked > 30, "only {checked} steps");
    }
}
