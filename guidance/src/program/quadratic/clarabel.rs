//! The general back-end for quadratic programs: Clarabel, on all rows at once.

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT},
    },
};

use super::{ActiveRow, QuadraticProgram, QuadraticSolution, verify::objective};
use crate::{
    budget::{Budget, Interruption},
    program::{Clarabel, Status, clarabel::run},
};

impl Clarabel {
    /// Solves a dense quadratic program, looking at all rows in every iteration.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn solve_quadratic(
        &self,
        program: &QuadraticProgram<'_>,
        budget: Budget<'_>,
    ) -> Result<QuadraticSolution, Interruption> {
        budget.check()?;
        let (n, rows) = (program.cost.variables(), program.rows.len());
        let hessian = dense(n, n, |i, j| {
            // The upper triangle only.
            if i <= j { program.cost.hessian()[(i, j)] } else { 0.0 }
        });
        let scale = |row: usize| program.rows.scale(row);
        let matrix = dense(rows, n, |i, j| program.rows.normal(i)[j] * scale(i));
        let right: Vec<f64> = (0..rows).map(|row| program.offsets[row] * scale(row)).collect();
        let cones: [SupportedConeT<f64>; 1] = [NonnegativeConeT(rows)];
        let settings = DefaultSettings {
            verbose: false,
            tol_gap_abs: 1e-10,
            tol_gap_rel: 1e-10,
            tol_feas: 1e-10,
            ..DefaultSettings::default()
        };
        let built =
            DefaultSolver::new(&hessian, program.gradient, &matrix, &right, &cones, settings);
        let Ok(mut solver) = built else {
            return Ok(QuadraticSolution {
                status: Status::NumericalFailure,
                point: vec![0.0; n],
                objective: 0.0,
                active: Vec::new(),
                iterations: 0,
                scans: 0,
            });
        };
        run(&mut solver, budget)?;
        let answer = solver.solution;
        let multipliers = answer.z.iter().enumerate().filter(|(_, y)| **y > 0.0);
        Ok(QuadraticSolution {
            status: match answer.status {
                SolverStatus::Solved => Status::Optimal,
                SolverStatus::PrimalInfeasible => Status::PrimalInfeasible,
                SolverStatus::AlmostSolved => Status::Inaccurate,
                SolverStatus::MaxIterations => Status::BudgetExhausted,
                _ => Status::NumericalFailure,
            },
            objective: objective(program, &answer.x),
            active: multipliers
                .map(|(row, y)| ActiveRow { row, multiplier: y * scale(row) })
                .collect(),
            point: answer.x,
            iterations: answer.iterations as usize,
            scans: answer.iterations as usize,
        })
    }
}

/// The nonzero entries of a matrix, column by column.
fn dense(rows: usize, columns: usize, entry: impl Fn(usize, usize) -> f64) -> CscMatrix<f64> {
    let mut starts = vec![0];
    let (mut indices, mut values) = (Vec::new(), Vec::new());
    for j in 0..columns {
        for i in 0..rows {
            let value = entry(i, j);
            if value != 0.0 {
                indices.push(i);
                values.push(value);
            }
        }
        starts.push(values.len());
    }
    CscMatrix::new(rows, columns, starts, indices, values)
}
