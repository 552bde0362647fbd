//! The floating spacecraft of a flat table: on air bearings, pushed by cold gas
//! [Mammarella2019, sec. III].
//!
//! State [x, y, x', y'] in m and m/s with the docking position at the origin, force [F_x, F_y] in
//! N, both along the table's axes.

use nalgebra::{Vector2, Vector4};
use serde::Deserialize;

/// Longest step of the integration, s: the paper's own period of navigation. The classical
/// Runge-Kutta method then errs by less than 1e-14 of the state over 5 s.
const STEP_MAX_S: f64 = 0.02;

/// On what the second parameter acts in the third row of A(q).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Coupling {
    /// The position y, as equation (24) is printed.
    Printed,
    /// The velocity of y, as the equations (21) say from which (24) comes.
    ClohessyWiltshire,
}

/// One chaser on the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlanarPlant {
    /// Which A(q) is meant.
    pub coupling: Coupling,
    /// What q_4 deviates from, as 1 / mass.
    pub mass_kg: f64,
}

impl PlanarPlant {
    /// The state after `duration_s` under a constant force and the parameters q_1 .. q_4, which
    /// are in 1/s, 1/s (1/s^2 on a position), 1/s^2 and 1/kg.
    pub(crate) fn advance(
        &self,
        state: &Vector4<f64>,
        force_n: &Vector2<f64>,
        parameters: &[f64; 4],
        duration_s: f64,
    ) -> Vector4<f64> {
        let steps = (duration_s / STEP_MAX_S).ceil().max(1.0);
        let h = duration_s / steps;
        let mut x = *state;
        // A whole number after `ceil`.
        for _ in 0..steps as u64 {
            let rate = |x: &Vector4<f64>| self.rate(x, force_n, parameters);
            let k1 = rate(&x);
            let k2 = rate(&(x + k1 * (0.5 * h)));
            let k3 = rate(&(x + k2 * (0.5 * h)));
            let k4 = rate(&(x + k3 * h));
            x += (k1 + (k2 + k3) * 2.0 + k4) * (h / 6.0);
        }
        x
    }

    /// x' = A(q) x + B(q) u. [Mammarella2019, eq. 24]
    fn rate(&self, x: &Vector4<f64>, u: &Vector2<f64>, q: &[f64; 4]) -> Vector4<f64> {
        let coupled = match self.coupling {
            Coupling::Printed => x[1],
            Coupling::ClohessyWiltshire => x[3],
        };
        let per_mass = 1.0 / self.mass_kg + q[3];
        Vector4::new(
            q[0] * x[0] + x[2],
            q[0] * x[1] + x[3],
            2.0 * q[1] * coupled + per_mass * u[0],
            3.0 * q[2] * x[1] - 2.0 * q[1] * x[2] + per_mass * u[1],
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{golden_file, matrix, vector};

    /// Foreign numbers: every column of the exact discretisation, by flying its unit vector.
    #[test]
    fn planar_plant_moves_as_its_exact_discretisation() {
        let file = golden_file("offline_sampling", "g02_discretise.json");
        let tolerance = file["tol"].as_f64().expect("tol");
        let mut checked = 0;
        for case in file["cases"].as_array().expect("cases") {
            let coupling = match case["variant"].as_str() {
                Some("printed") => Coupling::Printed,
                Some("cw") => Coupling::ClohessyWiltshire,
                other => panic!("variant {other:?}"),
            };
            let plant = PlanarPlant { coupling, mass_kg: case["mass"].as_f64().expect("mass") };
            let parameters: [f64; 4] = std::array::from_fn(|i| vector(&case["q"])[i]);
            let duration_s = case["dt"].as_f64().expect("dt");
            let (a, b) = (matrix(&case["Ad_zoh"]), matrix(&case["Bd_zoh"]));
            for column in 0..6 {
                let mut state = Vector4::zeros();
                let mut force = Vector2::zeros();
                let expected = match column {
                    0..4 => {
                        state[column] = 1.0;
                        a.column(column)
                    }
                    _ => {
                        force[column - 4] = 1.0;
                        b.column(column - 4)
                    }
                };
                let end = plant.advance(&state, &force, &parameters, duration_s);
                let error = (end - expected).amax();
                assert!(error < tolerance, "{coupling:?} column {column}: {error}");
                checked += 1;
            }
        }
        assert!(checked >= 72, "only {checked} columns");
    }

    /// Without deviations it is a free body: straight motion, and v = F t / m.
    #[test]
    fn planar_plant_without_deviations_is_a_double_integrator() {
        let plant = PlanarPlant { coupling: Coupling::Printed, mass_kg: 10.0 };
        let state = Vector4::new(1.0, 2.0, 0.1, -0.2);
        let end = plant.advance(&state, &Vector2::new(0.3, 0.1), &[0.0; 4], 5.0);
        let expected = Vector4::new(1.0 + 0.5 + 0.375, 2.0 - 1.0 + 0.125, 0.25, -0.15);
        assert!((end - expected).amax() < 1e-13, "{end}");
    }
}
