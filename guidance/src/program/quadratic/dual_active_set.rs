//! A dual active-set method on a lazy working set.
//!
//! From the optimum without rows, violated rows enter one after the other; every point on the way
//! is optimal for the rows that are active, so the objective only rises and the first point that
//! violates nothing is the answer. Of ten thousand rows a few dozen ever matter: all are looked
//! at to find the worst of every block, then the method works on those alone until they are
//! satisfied, then all are looked at again. The last look is the proof of feasibility.

use super::{
    ActiveRow, ActiveSet, Entry, QuadraticProgram, QuadraticSolution, prove_infeasible,
    verify::verify_quadratic_within,
};
use crate::{
    budget::{Budget, Interruption},
    program::Status,
};

/// Violation, per unit normal and relative to 1 + |b| / |a|, that still counts as met.
const FEASIBILITY: f64 = 1e-10;
/// The same for what is returned, after all rounding.
const FEASIBILITY_ACCEPTED: f64 = 1e-9;
/// Relative size of Hz + g + A'y accepted at an optimum.
const STATIONARITY_ACCEPTED: f64 = 1e-9;
/// A ray is believed if it rules out every point within this many times the size of the answer's
/// own numbers; a smaller radius is rounding.
const RADIUS_ACCEPTED: f64 = 1e6;
/// Looks at an optimum, with a step of iterative refinement after each that was not passed.
const REFINEMENTS_MAX: usize = 4;
/// Rows of a block, of which a look keeps the worst.
const BLOCK: usize = 64;
/// Rows between two looks at the budget.
const BUDGET_PERIOD: usize = 64 * BLOCK;
/// Rows that join the working set after a look, at most.
const JOINING_MAX: usize = 24;

/// The solver, with the memory it reuses. No result depends on what was solved before.
#[derive(Debug, Default)]
pub struct DualActiveSet {
    active: ActiveSet,
    /// Rows that are watched at every step.
    working: Vec<usize>,
    /// Violation and row of those that join.
    joining: Vec<(f64, usize)>,
    padded: Vec<f64>,
    scans: usize,
}

impl DualActiveSet {
    /// Solves `program`, from the rows `start` that were active in a similar one.
    ///
    /// The status is `Optimal` or `PrimalInfeasible` only if the answer passed its verification
    /// from the program alone; else `BudgetExhausted` or `NumericalFailure`.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget, asked whenever a row enters and while all are looked at.
    pub fn solve(
        &mut self,
        program: &QuadraticProgram<'_>,
        start: &[usize],
        budget: Budget<'_>,
    ) -> Result<QuadraticSolution, Interruption> {
        let proved = |solution: &QuadraticSolution| {
            matches!(solution.status, Status::Optimal | Status::PrimalInfeasible)
        };
        let mut solution = self.attempt(program, start, budget)?;
        if !proved(&solution) && !start.is_empty() {
            // Where an old active set misleads, the cold start does not.
            solution = self.attempt(program, &[], budget)?;
        }
        if !proved(&solution) {
            // The same rows with fresh factors.
            solution = self.attempt(program, &solution.active_rows(), budget)?;
        }
        Ok(solution)
    }

    fn attempt(
        &mut self,
        program: &QuadraticProgram<'_>,
        start: &[usize],
        budget: Budget<'_>,
    ) -> Result<QuadraticSolution, Interruption> {
        let n = program.cost.variables();
        let iterations_max = 100 * (n + 10);
        self.scans = 0;
        self.working.clear();
        self.working.extend(start.iter().filter(|&&row| row < program.rows.len()));
        self.active.reset(program.cost, program.gradient);
        let rows =
            self.working.iter().map(|&row| (row, program.rows.normal(row), program.offsets[row]));
        self.active.start_from(program.cost, rows);
        loop {
            while let Some(row) = self.worst_of_working(program) {
                budget.check()?;
                let (normal, offset) = (program.rows.normal(row), program.offsets[row]);
                match self.active.enter(row, normal, offset, iterations_max) {
                    Entry::Active => {}
                    Entry::Infeasible => return Ok(self.infeasible(program, row)),
                    Entry::Stalled => {
                        return Ok(self.solution(program, Status::BudgetExhausted));
                    }
                }
            }
            self.active.settle();
            if !self.active.point().iter().all(|x| x.is_finite()) {
                return Ok(self.solution(program, Status::NumericalFailure));
            }
            if !self.look_at_all(program, budget)? {
                return self.optimal(program, budget);
            }
        }
    }

    /// The most violated row of the working set.
    fn worst_of_working(&mut self, program: &QuadraticProgram<'_>) -> Option<usize> {
        let rows = program.rows;
        rows.pad(self.active.point(), &mut self.padded);
        let mut worst = (0.0, None);
        for &row in &self.working {
            let violation = violation(program, row, &self.padded);
            if violation > worst.0 {
                worst = (violation, Some(row));
            }
        }
        worst.1
    }

    /// Lets the worst row of every block join the working set; false if no row is violated.
    fn look_at_all(
        &mut self,
        program: &QuadraticProgram<'_>,
        budget: Budget<'_>,
    ) -> Result<bool, Interruption> {
        let rows = program.rows;
        self.scans += 1;
        self.joining.clear();
        rows.pad(self.active.point(), &mut self.padded);
        for first in (0..rows.len()).step_by(BLOCK) {
            if first % BUDGET_PERIOD == 0 {
                budget.check()?;
            }
            let mut worst = (0.0, first);
            for row in first..(first + BLOCK).min(rows.len()) {
                let violation = violation(program, row, &self.padded);
                if violation > worst.0 {
                    worst = (violation, row);
                }
            }
            if worst.0 > 0.0 {
                self.joining.push(worst);
            }
        }
        self.joining.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        self.joining.truncate(JOINING_MAX);
        let mut joined = false;
        for &(_, row) in &self.joining {
            // A row that is watched and still violated here is a matter of rounding.
            if !self.working.contains(&row) {
                self.working.push(row);
                joined = true;
            }
        }
        Ok(joined)
    }

    fn optimal(
        &mut self,
        program: &QuadraticProgram<'_>,
        budget: Budget<'_>,
    ) -> Result<QuadraticSolution, Interruption> {
        for _ in 0..REFINEMENTS_MAX {
            let solution = self.solution(program, Status::Optimal);
            let residuals = verify_quadratic_within(program, &solution, budget)?;
            if residuals.violation <= FEASIBILITY_ACCEPTED
                && residuals.stationarity <= STATIONARITY_ACCEPTED
                && residuals.least_multiplier >= 0.0
            {
                return Ok(solution);
            }
            self.active.refine(program.cost, program.gradient);
        }
        Ok(self.solution(program, Status::NumericalFailure))
    }

    fn infeasible(&self, program: &QuadraticProgram<'_>, row: usize) -> QuadraticSolution {
        let mut solution = self.solution(program, Status::PrimalInfeasible);
        let ray = self.active.ray().chain([(row, 1.0)]).filter(|entry| entry.1 > 0.0);
        solution.active = ray.map(|(row, multiplier)| ActiveRow { row, multiplier }).collect();
        let proof = prove_infeasible(program.rows, program.offsets, &solution.active);
        let size = solution.point.iter().fold(1.0_f64, |a, x| a.max(x.abs()));
        if !(proof.radius >= RADIUS_ACCEPTED * size) {
            solution.status = Status::NumericalFailure;
        }
        solution
    }

    fn solution(&self, program: &QuadraticProgram<'_>, status: Status) -> QuadraticSolution {
        let active =
            self.active.active().map(|(row, value)| ActiveRow { row, multiplier: value.max(0.0) });
        let point = self.active.point().to_vec();
        let objective = super::verify::objective(program, &point);
        QuadraticSolution {
            status,
            objective,
            active: active.collect(),
            point,
            iterations: self.active.iterations(),
            scans: self.scans,
        }
    }
}

/// Violation of a row per unit normal, less what is allowed.
#[inline]
fn violation(program: &QuadraticProgram<'_>, row: usize, padded: &[f64]) -> f64 {
    let (offset, scale) = (program.offsets[row], program.rows.scale(row));
    (program.rows.product(row, padded) - offset) * scale
        - FEASIBILITY * (1.0 + offset.abs() * scale)
}
