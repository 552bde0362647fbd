//! Programs over second-order cones, and Clarabel for them.

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT, SecondOrderConeT, ZeroConeT},
    },
};

use super::{Status, clarabel::run};
use crate::budget::{Budget, Interruption};

/// Minimise sum_j (quadratic_j x_j² + linear_j x_j) subject to rows in cones.
///
/// Each row says constant + sum entries x; rows are added family by family.
#[derive(Debug, Clone, Default)]
pub struct ConeProgram {
    linear: Vec<f64>,
    quadratic: Vec<(usize, f64)>,
    triplets: (Vec<usize>, Vec<usize>, Vec<f64>),
    constants: Vec<f64>,
    cones: Vec<SupportedConeT<f64>>,
}

/// An affine expression constant + sum (column, value).
#[derive(Debug, Clone, Default)]
pub struct Affine {
    /// What it is at x = 0.
    pub constant: f64,
    /// Column and value.
    pub entries: Vec<(usize, f64)>,
}

/// What the solver says; to be checked by whoever asked.
#[derive(Debug, Clone)]
pub struct ConeSolution {
    /// How it ended; infeasibility is claimed, not proved, here.
    pub status: Status,
    /// x.
    pub x: Vec<f64>,
    /// Interior-point iterations.
    pub iterations: usize,
}

impl ConeProgram {
    /// Adds `count` variables without cost; returns the first one's index.
    pub fn variables(&mut self, count: usize) -> usize {
        let first = self.linear.len();
        self.linear.resize(first + count, 0.0);
        first
    }

    /// Adds `cost` x_column to the objective.
    pub fn add_linear_cost(&mut self, column: usize, cost: f64) {
        self.linear[column] += cost;
    }

    /// Adds `cost` x_column² to the objective.
    pub fn add_square_cost(&mut self, column: usize, cost: f64) {
        self.quadratic.push((column, cost));
    }

    /// Each expression is 0.
    pub fn zero(&mut self, rows: &[Affine]) {
        self.rows(rows);
        self.cones.push(ZeroConeT(rows.len()));
    }

    /// Each expression is at least 0.
    pub fn nonnegative(&mut self, rows: &[Affine]) {
        self.rows(rows);
        self.cones.push(NonnegativeConeT(rows.len()));
    }

    /// The first expression is at least the Euclidean norm of the others.
    pub fn norm_at_most(&mut self, rows: &[Affine]) {
        self.rows(rows);
        self.cones.push(SecondOrderConeT(rows.len()));
    }

    /// Clarabel wants A x + s = b with s in the cone: b the constants, A minus the entries.
    fn rows(&mut self, rows: &[Affine]) {
        for row in rows {
            for &(column, value) in row.entries.iter().filter(|(_, value)| *value != 0.0) {
                self.triplets.0.push(self.constants.len());
                self.triplets.1.push(column);
                self.triplets.2.push(-value);
            }
            self.constants.push(row.constant);
        }
    }

    /// Solves, tight first and then to the solver's usual tolerance. Looks at the budget before a
    /// solve and in every iteration; iterations are bounded.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn solve(&self, budget: Budget<'_>) -> Result<ConeSolution, Interruption> {
        budget.check()?;
        let usual = DefaultSettings { verbose: false, max_iter: 200, ..DefaultSettings::default() };
        let tight = DefaultSettings {
            tol_gap_abs: 1e-9,
            tol_gap_rel: 1e-9,
            tol_feas: 1e-9,
            ..usual.clone()
        };
        let first = self.solve_with(tight, budget)?;
        if first.status == Status::Optimal || first.status == Status::PrimalInfeasible {
            return Ok(first);
        }
        let second = self.solve_with(usual, budget)?;
        Ok(ConeSolution { iterations: first.iterations + second.iterations, ..second })
    }

    fn solve_with(
        &self,
        settings: DefaultSettings<f64>,
        budget: Budget<'_>,
    ) -> Result<ConeSolution, Interruption> {
        let (rows, columns) = (self.constants.len(), self.linear.len());
        let (i, j, v) = self.triplets.clone();
        let matrix = CscMatrix::new_from_triplets(rows, columns, i, j, v);
        let places: Vec<usize> = self.quadratic.iter().map(|(column, _)| *column).collect();
        // Clarabel halves the quadratic form.
        let values = self.quadratic.iter().map(|(_, cost)| 2.0 * cost).collect();
        let square = CscMatrix::new_from_triplets(columns, columns, places.clone(), places, values);
        let solver = DefaultSolver::new(
            &square,
            &self.linear,
            &matrix,
            &self.constants,
            &self.cones,
            settings,
        );
        let Ok(mut solver) = solver else {
            let status = Status::NumericalFailure;
            return Ok(ConeSolution { status, x: Vec::new(), iterations: 0 });
        };
        run(&mut solver, budget)?;
        let solution = solver.solution;
        let status = match solution.status {
            SolverStatus::Solved => Status::Optimal,
            SolverStatus::AlmostSolved => Status::Inaccurate,
            SolverStatus::PrimalInfeasible => Status::PrimalInfeasible,
            SolverStatus::MaxIterations => Status::BudgetExhausted,
            _ => Status::NumericalFailure,
        };
        Ok(ConeSolution { status, x: solution.x, iterations: solution.iterations as usize })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn x(column: usize) -> Affine {
        Affine { constant: 0.0, entries: vec![(column, 1.0)] }
    }

    fn constant(constant: f64) -> Affine {
        Affine { constant, entries: Vec::new() }
    }

    #[test]
    fn cone_program_finds_the_nearest_point_of_a_disc() {
        // Least (3 - x)² is at x = 1 on the unit disc.
        let mut program = ConeProgram::default();
        let first = program.variables(2);
        program.add_square_cost(first, 1.0);
        program.add_linear_cost(first, -6.0);
        program.norm_at_most(&[constant(1.0), x(first), x(first + 1)]);
        let solution = program.solve(Budget::UNLIMITED).unwrap();
        assert_eq!(solution.status, Status::Optimal);
        assert!((solution.x[first] - 1.0).abs() < 1e-8 && solution.x[first + 1].abs() < 1e-6);
    }

    #[test]
    fn cone_program_without_a_point_is_infeasible() {
        let mut program = ConeProgram::default();
        let first = program.variables(1);
        program.nonnegative(&[x(first)]);
        program.zero(&[Affine { constant: 1.0, entries: vec![(first, 1.0)] }]);
        assert_eq!(program.solve(Budget::UNLIMITED).unwrap().status, Status::PrimalInfeasible);
    }
}
