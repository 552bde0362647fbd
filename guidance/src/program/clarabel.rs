//! The general back-end: Clarabel, an interior-point solver, on the uncondensed sparse program.
//!
//! Deliberately a different formulation from [`super::DualSimplex`]: states stay variables and
//! absolute values become epigraphs, so that a fault in one does not hide in the other.

use std::sync::{Arc, OnceLock};

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, IPSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT, ZeroConeT},
    },
};

use super::{Basis, HorizonProgram, Multiplier, RowFamily, RowId, Solution, Solver, Status};
use crate::budget::{Budget, Interruption};

/// The general back-end. Looks at the budget before a solve and in every iteration.
#[derive(Debug, Default, Clone, Copy)]
pub struct Clarabel;

/// Runs a solver of Clarabel's, which asks the budget in every iteration.
pub(super) fn run(solver: &mut DefaultSolver<f64>, budget: Budget<'_>) -> Result<(), Interruption> {
    let heard = Arc::new(OnceLock::new());
    if let Some(question) = budget.question() {
        let (question, heard) = (Arc::clone(question), Arc::clone(&heard));
        solver.set_termination_callback(move |_| {
            question().is_some_and(|why| heard.set(why).is_ok())
        });
    }
    solver.solve();
    heard.get().map_or(Ok(()), |why| Err(*why))
}

impl Solver for Clarabel {
    fn solve(
        &mut self,
        program: &HorizonProgram<'_>,
        _start: Option<&Basis>,
        cut_off: Option<f64>,
        budget: Budget<'_>,
    ) -> Result<Solution, Interruption> {
        budget.check()?;
        let sparse = SparseProgram::new(program, None);
        let answer = sparse.solve(budget)?;
        let mut solution = sparse.interpret(program, &answer);
        if solution.status == Status::Optimal
            && cut_off.is_some_and(|limit| solution.objective >= limit)
        {
            solution.status = Status::CutOff;
        }
        Ok(solution)
    }
}

/// Least t >= 0 such that the program becomes feasible when every row of `family` (of unit
/// length, or each component of the terminal point, or each input bound) is relaxed by t while
/// all others hold; `None` if no t does.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub fn least_relaxation(
    program: &HorizonProgram<'_>,
    family: RelaxedFamily,
    budget: Budget<'_>,
) -> Result<Option<f64>, Interruption> {
    let sparse = SparseProgram::new(program, Some(family));
    let answer = sparse.solve(budget)?;
    Ok(matches!(answer.status, SolverStatus::Solved | SolverStatus::AlmostSolved)
        .then(|| answer.x[sparse.layout.relaxation].max(0.0)))
}

/// What [`least_relaxation`] relaxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RelaxedFamily {
    /// State rows.
    Stage,
    /// Input bounds and input rows.
    Input,
    /// Components of the terminal point.
    Terminal,
}

/// First variable of each kind: inputs, their absolute values, scaled states, terminal
/// coefficients, tracking deviations, the relaxation.
#[derive(Debug, Clone, Copy)]
struct Layout {
    magnitudes: usize,
    states: usize,
    coefficients: usize,
    deviations: usize,
    relaxation: usize,
    end: usize,
}

struct SparseProgram {
    layout: Layout,
    objective: Vec<f64>,
    triplets: (Vec<usize>, Vec<usize>, Vec<f64>),
    right: Vec<f64>,
    equalities: usize,
    /// Rows whose multiplier is wanted, with their position, scale and sign.
    named: Vec<(RowId, usize, f64)>,
    /// Units of the state variables.
    units: Vec<f64>,
}

struct Answer {
    status: SolverStatus,
    x: Vec<f64>,
    z: Vec<f64>,
    iterations: u32,
}

impl SparseProgram {
    fn new(program: &HorizonProgram<'_>, relaxed: Option<RelaxedFamily>) -> Self {
        let (n, m, horizon) = (program.states(), program.inputs(), program.horizon);
        let tracked = if program.tracking_weight > 0.0 { program.tracked_stages } else { 0 };
        let magnitudes = horizon * m;
        let states = 2 * horizon * m;
        let coefficients = states + horizon * n;
        let deviations = coefficients + program.terminal_generator_count();
        let relaxation = deviations + tracked * n;
        let end = relaxation + usize::from(relaxed.is_some());
        let layout = Layout { magnitudes, states, coefficients, deviations, relaxation, end };
        let mut objective = vec![0.0; end];
        if relaxed.is_some() {
            objective[relaxation] = 1.0;
        } else {
            objective[magnitudes..states].fill(program.input_cost);
            objective[deviations..relaxation].fill(program.tracking_weight);
        }
        let reach = program.plant.reach(horizon);
        let units = reach.iter().map(|&r| if r > 0.0 { r } else { 1.0 }).collect();
        let mut sparse = Self {
            layout,
            objective,
            triplets: (Vec::new(), Vec::new(), Vec::new()),
            right: Vec::new(),
            equalities: 0,
            named: Vec::new(),
            units,
        };
        sparse.add_dynamics(program);
        if relaxed != Some(RelaxedFamily::Terminal) {
            sparse.add_terminal(program, 1.0, false, true);
            sparse.equalities = sparse.right.len();
        } else {
            sparse.equalities = sparse.right.len();
            sparse.add_terminal(program, 1.0, true, false);
            sparse.add_terminal(program, -1.0, true, false);
        }
        sparse.add_inputs(program, relaxed == Some(RelaxedFamily::Input));
        sparse.add_stage_rows(program, relaxed == Some(RelaxedFamily::Stage));
        sparse.add_tracking(program, tracked);
        for e in 0..program.terminal_generator_count() {
            for sign in [1.0, -1.0] {
                sparse.row(1.0, &[(coefficients + e, sign)]);
            }
        }
        if relaxed.is_some() {
            sparse.row(0.0, &[(relaxation, -1.0)]);
        }
        sparse
    }

    /// Appends entries (column, value) . x (+ slack) = right.
    fn row(&mut self, right: f64, entries: &[(usize, f64)]) {
        let row = self.right.len();
        for &(column, value) in entries {
            if value != 0.0 {
                self.triplets.0.push(row);
                self.triplets.1.push(column);
                self.triplets.2.push(value);
            }
        }
        self.right.push(right);
    }

    fn name(&mut self, family: RowFamily, stage: usize, index: usize, scale: f64) {
        self.named.push((RowId { family, stage, index }, self.right.len(), scale));
    }

    /// Index of state component `c` at `stage` >= 1.
    fn state(&self, stage: usize, c: usize) -> usize {
        self.layout.states + (stage - 1) * self.units.len() + c
    }

    /// z_{j+1} - A z_j - B v_j = 0, each row in units of its component.
    fn add_dynamics(&mut self, program: &HorizonProgram<'_>) {
        let (n, m) = (program.states(), program.inputs());
        let mut unit = vec![0.0; n];
        let mut a_row = vec![0.0; n];
        let mut b_row = vec![0.0; m];
        for stage in 0..program.horizon {
            for r in 0..n {
                unit.fill(0.0);
                unit[r] = 1.0;
                program.plant.costate_back(&unit, &mut a_row);
                program.plant.input_gradient(&unit, &mut b_row);
                let size = self.units[r];
                let mut entries = vec![(self.state(stage + 1, r), 1.0)];
                entries.extend((0..m).map(|i| (stage * m + i, -b_row[i] / size)));
                let mut right = 0.0;
                for c in 0..n {
                    if stage == 0 {
                        right += a_row[c] * program.initial[c] / size;
                    } else {
                        entries.push((self.state(stage, c), -a_row[c] * self.units[c] / size));
                    }
                }
                self.row(right, &entries);
            }
        }
    }

    fn add_terminal(
        &mut self,
        program: &HorizonProgram<'_>,
        sign: f64,
        relaxed: bool,
        named: bool,
    ) {
        let n = program.states();
        for c in 0..n {
            let size = self.units[c];
            let mut entries = vec![(self.state(program.horizon, c), sign)];
            let generators = program.terminal_generators.chunks_exact(n).enumerate();
            let first = self.layout.coefficients;
            entries.extend(generators.map(|(e, g)| (first + e, -sign * g[c] / size)));
            if relaxed {
                entries.push((self.layout.relaxation, -1.0 / size));
            }
            if named {
                self.name(RowFamily::Terminal, program.horizon, c, 1.0 / size);
            }
            self.row(sign * program.terminal_centre[c] / size, &entries);
        }
    }

    fn add_inputs(&mut self, program: &HorizonProgram<'_>, relaxed: bool) {
        let m = program.inputs();
        let slack = |entries: &mut Vec<(usize, f64)>, layout: Layout| {
            if relaxed {
                entries.push((layout.relaxation, -1.0));
            }
        };
        for i in 0..program.horizon * m {
            for (sign, right) in [(1.0, program.input_upper[i]), (-1.0, -program.input_lower[i])] {
                let mut entries = vec![(i, sign)];
                slack(&mut entries, self.layout);
                self.row(right, &entries);
                self.row(0.0, &[(i, sign), (self.layout.magnitudes + i, -1.0)]);
            }
        }
        for stage in 0..program.horizon {
            for (index, normal) in program.input_normals.chunks_exact(m).enumerate() {
                let mut entries: Vec<_> =
                    normal.iter().enumerate().map(|(i, h)| (stage * m + i, *h)).collect();
                slack(&mut entries, self.layout);
                self.name(RowFamily::Input, stage, index, 1.0);
                self.row(program.input_offsets[stage * program.input_rows() + index], &entries);
            }
        }
    }

    fn add_stage_rows(&mut self, program: &HorizonProgram<'_>, relaxed: bool) {
        for stage in 1..=program.constrained_stages {
            for index in 0..program.stage_rows {
                let normal = program.stage_normal(stage, index);
                let length = normal.iter().map(|h| h * h).sum::<f64>().sqrt();
                let mut scaled = vec![0.0; normal.len()];
                for ((value, h), unit) in scaled.iter_mut().zip(normal).zip(&self.units) {
                    *value = h * unit;
                }
                let largest = scaled.iter().fold(f64::MIN_POSITIVE, |a, h| a.max(h.abs()));
                let mut entries: Vec<_> = scaled
                    .iter()
                    .enumerate()
                    .map(|(c, h)| (self.state(stage, c), h / largest))
                    .collect();
                if relaxed {
                    entries.push((self.layout.relaxation, -length / largest));
                }
                self.name(RowFamily::Stage, stage, index, 1.0 / largest);
                self.row(program.stage_offset(stage, index) / largest, &entries);
            }
        }
    }

    fn add_tracking(&mut self, program: &HorizonProgram<'_>, tracked: usize) {
        let n = program.states();
        for stage in 1..=tracked {
            for c in 0..n {
                let deviation = self.layout.deviations + (stage - 1) * n + c;
                let reference = program.reference(stage)[c];
                for sign in [1.0, -1.0] {
                    self.name(RowFamily::Tracking, stage, c, sign);
                    let state = (self.state(stage, c), sign * self.units[c]);
                    self.row(sign * reference, &[state, (deviation, -1.0)]);
                }
            }
        }
    }

    fn solve(&self, budget: Budget<'_>) -> Result<Answer, Interruption> {
        // Tight first; long horizons sometimes stop short of that but reach the defaults.
        let tight = DefaultSettings {
            verbose: false,
            tol_gap_abs: 1e-10,
            tol_gap_rel: 1e-10,
            tol_feas: 1e-11,
            ..DefaultSettings::default()
        };
        let usual = DefaultSettings { verbose: false, ..DefaultSettings::default() };
        let first = self.solve_with(tight, budget)?;
        if first.status == SolverStatus::Solved || first.status == SolverStatus::PrimalInfeasible {
            return Ok(first);
        }
        self.solve_with(usual, budget)
    }

    fn solve_with(
        &self,
        settings: DefaultSettings<f64>,
        budget: Budget<'_>,
    ) -> Result<Answer, Interruption> {
        let (rows, columns) = (self.right.len(), self.layout.end);
        let (i, j, v) = self.triplets.clone();
        let matrix = CscMatrix::new_from_triplets(rows, columns, i, j, v);
        let cones: [SupportedConeT<f64>; 2] =
            [ZeroConeT(self.equalities), NonnegativeConeT(rows - self.equalities)];
        let none = CscMatrix::zeros((columns, columns));
        let built =
            DefaultSolver::new(&none, &self.objective, &matrix, &self.right, &cones, settings);
        Ok(match built {
            Ok(mut solver) => {
                run(&mut solver, budget)?;
                let solution = solver.solution;
                Answer {
                    status: solution.status,
                    x: solution.x,
                    z: solution.z,
                    iterations: solution.iterations,
                }
            }
            Err(_) => Answer {
                status: SolverStatus::NumericalError,
                x: vec![0.0; columns],
                z: vec![0.0; rows],
                iterations: 0,
            },
        })
    }

    fn interpret(&self, program: &HorizonProgram<'_>, answer: &Answer) -> Solution {
        let status = match answer.status {
            SolverStatus::Solved => Status::Optimal,
            SolverStatus::PrimalInfeasible => Status::PrimalInfeasible,
            SolverStatus::AlmostSolved => Status::Inaccurate,
            SolverStatus::MaxIterations => Status::BudgetExhausted,
            _ => Status::NumericalFailure,
        };
        let inputs: Vec<f64> = answer.x[..self.layout.magnitudes]
            .iter()
            .zip(program.input_lower.iter().zip(program.input_upper))
            .map(|(v, (lower, upper))| v.clamp(*lower, *upper))
            .collect();
        let coefficients = &answer.x[self.layout.coefficients..self.layout.deviations];
        let residuals = super::verify(program, &inputs, coefficients);
        let mut multipliers: Vec<Multiplier> = Vec::with_capacity(self.named.len());
        for &(row, position, scale) in &self.named {
            let value = answer.z[position] * scale;
            match multipliers.last_mut() {
                // The two sides of one tracking row.
                Some(last) if last.row == row => last.value += value,
                _ => multipliers.push(Multiplier { row, value }),
            }
        }
        Solution {
            status,
            objective: residuals.objective,
            inputs,
            terminal_coefficients: coefficients.to_vec(),
            multipliers,
            basis: Basis::default(),
            iterations: answer.iterations as usize,
        }
    }
}
