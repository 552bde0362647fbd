//! Looking into an artifact: what a report, a picture or a test wants to see of the problem.

use nalgebra::{DMatrix, DVector};

use super::{
    Artifact,
    artifact::Corridor,
    stages::{Stages, as_f64},
};
use crate::{
    budget::Budget,
    control::Failure,
    program::{Residuals, Solution, Solver, Status, verify},
};

/// State constraints normals * x <= offsets at one step, and what the tube takes from them.
#[derive(Debug, Clone, PartialEq)]
pub struct StateRows {
    /// q x n, not of unit length.
    pub normals: DMatrix<f64>,
    /// q values, before tightening.
    pub offsets: DVector<f64>,
    /// rho(h_i, S(j)), to be subtracted.
    pub margins: DVector<f64>,
}

/// A program of one horizon, solved and checked.
#[derive(Debug, Clone, PartialEq)]
pub struct HorizonAnswer {
    /// J; `None` if infeasible.
    pub cost: Option<f64>,
    /// What the solver said.
    pub solution: Solution,
    /// Residuals of its inputs, if optimal.
    pub residuals: Option<Residuals>,
}

impl Artifact {
    /// r(step), scaled; `None` beyond the table.
    #[must_use]
    pub fn reference(&self, step: usize) -> Option<&DVector<f64>> {
        self.model.reference(step)
    }

    /// Longest horizon that can start at `step`.
    #[must_use]
    pub fn horizon_limit(&self, step: usize) -> usize {
        Stages::new(self, step, &[]).horizon_limit()
    }

    /// State constraints of X(step + ahead) with the margins of S(ahead).
    #[must_use]
    pub fn state_rows(&self, step: usize, ahead: usize) -> Option<StateRows> {
        let (normals, offsets) = match &self.model.corridor {
            Corridor::Free => return None,
            Corridor::Polytope(set) => (set.normals().clone(), set.offsets().clone()),
            Corridor::Cone(faces) => {
                let faces = faces.get(step + ahead)?;
                let mut normals = DMatrix::zeros(faces.normals.len(), 6);
                for (i, normal) in faces.normals.iter().enumerate() {
                    normals.fixed_view_mut::<1, 3>(i, 0).copy_from(&normal.transpose());
                }
                (normals, DVector::from_column_slice(&faces.offsets))
            }
        };
        let terms = if self.is_tightened() { ahead } else { 0 };
        let margin = |row: usize| -> f64 {
            let normal: Vec<f64> = normals.row(row).iter().copied().collect();
            (0..terms).map(|i| self.tube.state_term(i, &normal)).sum()
        };
        let margins = DVector::from_fn(normals.nrows(), |row, _| margin(row));
        Some(StateRows { normals, offsets, margins })
    }

    /// Half widths of K S(ahead), m values: what the tube takes from each input.
    #[must_use]
    pub fn input_margins(&self, ahead: usize) -> DVector<f64> {
        let m = self.tables.inputs();
        self.tube.input_half_widths(ahead, m).row(ahead).transpose()
    }

    /// Centre of the scheme's own terminal constraint for a trajectory of `horizon` from `step`:
    /// z^r, r or r~. `None` if the tightened state set is empty there.
    #[must_use]
    pub fn terminal_centre(&self, step: usize, horizon: usize) -> Option<DVector<f64>> {
        let mut stages = Stages::new(self, step, &[]);
        stages.terminal(horizon).map(|terminal| DVector::from_vec(terminal.centre))
    }

    /// Margins of a scaled state in X(step), rows of unit length; empty without constraints.
    #[must_use]
    pub fn state_margins(&self, step: usize, state: &DVector<f64>) -> Vec<f64> {
        Stages::new(self, step, state.as_slice()).present_margins()
    }

    /// Solves the scheme's own program of one horizon from a scaled state with a solver of the
    /// caller's choice: how back-ends are compared.
    ///
    /// # Errors
    /// [`Failure::Numerical`] if the solver gave up.
    pub fn solve_horizon(
        &self,
        step: usize,
        state: &DVector<f64>,
        horizon: usize,
        solver: &mut dyn Solver,
    ) -> Result<HorizonAnswer, Failure> {
        let mut stages = Stages::new(self, step, state.as_slice());
        let infeasible = |solution| HorizonAnswer { cost: None, solution, residuals: None };
        let nothing = || Solution {
            status: Status::PrimalInfeasible,
            objective: f64::INFINITY,
            inputs: Vec::new(),
            terminal_coefficients: Vec::new(),
            multipliers: Vec::new(),
            basis: crate::program::Basis::default(),
            iterations: 0,
        };
        if horizon == 0 || horizon > stages.horizon_limit() {
            return Ok(infeasible(nothing()));
        }
        let Some(terminal) = stages.terminal(horizon) else { return Ok(infeasible(nothing())) };
        let program = stages.program(horizon, &terminal);
        let solution = solver.solve(&program, None, None, Budget::UNLIMITED)?;
        match solution.status {
            Status::PrimalInfeasible => Ok(infeasible(solution)),
            Status::Optimal => {
                let residuals = verify(&program, &solution.inputs, &solution.terminal_coefficients);
                let cost =
                    if self.is_minimum_time() { as_f64(horizon) } else { solution.objective };
                Ok(HorizonAnswer { cost: Some(cost), solution, residuals: Some(residuals) })
            }
            status => Err(Failure::Numerical(format!("horizon {horizon}: {status:?}"))),
        }
    }
}
