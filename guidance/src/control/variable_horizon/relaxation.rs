//! What would make an infeasible problem feasible: the least relaxation of each family of rows.
//!
//! A proof of infeasibility at a relaxation t is a combination of rows whose contradiction
//! shrinks linearly as t grows: where it vanishes is a lower bound on the least relaxation. So
//! from the proof at t = 0 on, each program is solved just beyond the bound that the last proof
//! gave. That is Newton's method on a convex piecewise linear function; three or four programs
//! reach the least relaxation to [`MARGIN`], each from the vertex of the one before.

use super::search::Search;
use crate::{
    budget::Budget,
    control::{ConstraintFamily, Relaxation},
    program::{
        Basis, DualSimplex, HorizonProgram, Multiplier, Solution, Solver, Status,
        farkas_contradiction,
    },
};

/// Beyond its lower bound by this share a relaxation is tried, so that what is reported suffices
/// and is the least to five percent.
const MARGIN: f64 = 0.05;
/// Relaxations that are of interest, scaled units.
const LARGEST: f64 = 1e3;
/// A relaxation of less than this is not told from none.
const SMALLEST: f64 = 1e-9;
/// Newton's method ends after as many proofs as there are kinks; it never took ten.
const PROOFS_MAX: usize = 50;

/// Least relaxation of each family over two horizons, the one that distance and inputs suggest
/// and twice that; and where neither helps at `limit`, the longest.
///
/// What a shorter horizon needs bounds what is looked for in a longer one, where the first proofs
/// mostly say already that nothing less will do.
pub(super) fn least_relaxations(search: &mut Search<'_, '_>, limit: usize) -> Vec<Relaxation> {
    let guess = search.stages.guess().clamp(1, limit);
    let mut horizons = vec![guess, (2 * guess).min(limit), limit];
    horizons.dedup();
    let families = [ConstraintFamily::State, ConstraintFamily::Input, ConstraintFamily::Terminal];
    let mut found: [Option<Relaxation>; 3] = [None; 3];
    for horizon in horizons {
        let Some(terminal) = search.stages.terminal(horizon) else { continue };
        let program = search.stages.program(horizon, &terminal);
        let mut question = Question::new(&program, search.budget);
        let Some(unrelaxed) = question.solve(None) else { continue };
        for (family, found) in families.into_iter().zip(&mut found) {
            if found.is_some() && horizon > 2 * guess {
                continue;
            }
            let known = found.map_or(LARGEST, |r| r.amount);
            if let Some(amount) = question.least(&unrelaxed, family, known) {
                *found = Some(Relaxation { family, horizon, amount });
            }
        }
    }
    found.into_iter().flatten().collect()
}

/// Whether a program is feasible, asked again and again with rows relaxed.
struct Question<'a, 'b> {
    program: &'a HorizonProgram<'a>,
    budget: Budget<'b>,
    simplex: DualSimplex,
}

impl<'a, 'b> Question<'a, 'b> {
    fn new(program: &'a HorizonProgram<'a>, budget: Budget<'b>) -> Self {
        Self { program, budget, simplex: DualSimplex::default() }
    }

    /// The program with rows relaxed and any cost; `None` if the solver cannot tell.
    fn solve(&mut self, relaxed: Option<(&Relaxed, &Basis)>) -> Option<Solution> {
        let unrelaxed = Relaxed::new(self.program, ConstraintFamily::State, 0.0);
        let (relaxed, start) = relaxed.map_or((&unrelaxed, None), |(r, start)| (r, Some(start)));
        let program = relaxed.program(self.program);
        let solution = self.simplex.solve(&program, start, None, self.budget).ok()?;
        matches!(solution.status, Status::Optimal | Status::PrimalInfeasible).then_some(solution)
    }

    /// Least relaxation of `family`, if there is one below `known`; `unrelaxed` is the answer to
    /// the program as it is.
    fn least(&mut self, unrelaxed: &Solution, family: ConstraintFamily, known: f64) -> Option<f64> {
        let mut last = unrelaxed.clone();
        for _ in 0..PROOFS_MAX {
            if last.status == Status::Optimal {
                // Not even the first program was infeasible.
                return None;
            }
            let bound = self.least_by_proof(&last.multipliers, family)?;
            let amount = (bound * (1.0 + MARGIN)).max(SMALLEST);
            if amount >= known {
                return None;
            }
            let relaxed = Relaxed::new(self.program, family, amount);
            last = self.solve(Some((&relaxed, &last.basis)))?;
            if last.status == Status::Optimal {
                return Some(amount);
            }
        }
        None
    }

    /// The relaxation at which a proof of infeasibility ceases to be one; `None` if none does.
    fn least_by_proof(&self, ray: &[Multiplier], family: ConstraintFamily) -> Option<f64> {
        let contradiction = |amount: f64| {
            let relaxed = Relaxed::new(self.program, family, amount);
            farkas_contradiction(&relaxed.program(self.program), ray)
        };
        let (left, size) = contradiction(0.0);
        let (shrunk, _) = contradiction(1.0);
        let slope = left - shrunk;
        // What is left of the slope by rounding is none.
        (slope > 1e-12 * size).then(|| (left / slope).max(0.0))
    }
}

/// A program with one family relaxed, as a mere question of feasibility.
struct Relaxed {
    stage_offsets: Vec<f64>,
    input_lower: Vec<f64>,
    input_upper: Vec<f64>,
    input_offsets: Vec<f64>,
    terminal_generators: Vec<f64>,
}

impl Relaxed {
    fn new(program: &HorizonProgram<'_>, family: ConstraintFamily, amount: f64) -> Self {
        let (n, m) = (program.states(), program.inputs());
        let by = |wanted: ConstraintFamily| if family == wanted { amount } else { 0.0 };
        let length = |row: &[f64]| row.iter().map(|x| x * x).sum::<f64>().sqrt();
        let (state, input) = (by(ConstraintFamily::State), by(ConstraintFamily::Input));
        let rows = program.constrained_stages * program.stage_rows;
        let normals = program.stage_normals.chunks_exact(n);
        let lengths: Vec<f64> = program.input_normals.chunks_exact(m).map(length).collect();
        let mut terminal_generators = program.terminal_generators.to_vec();
        if family == ConstraintFamily::Terminal {
            for i in 0..n {
                terminal_generators.extend((0..n).map(|j| if i == j { amount } else { 0.0 }));
            }
        }
        Self {
            stage_offsets: (program.stage_offsets[..rows].iter().zip(normals))
                .map(|(offset, normal)| offset + state * length(normal))
                .collect(),
            input_lower: program.input_lower.iter().map(|lower| lower - input).collect(),
            input_upper: program.input_upper.iter().map(|upper| upper + input).collect(),
            input_offsets: (program.input_offsets.iter().zip(lengths.iter().cycle()))
                .map(|(offset, length)| offset + input * length)
                .collect(),
            terminal_generators,
        }
    }

    fn program<'a>(&'a self, original: &HorizonProgram<'a>) -> HorizonProgram<'a> {
        HorizonProgram {
            input_cost: 1.0,
            tracking_weight: 0.0,
            tracked_stages: 0,
            stage_offsets: &self.stage_offsets,
            input_lower: &self.input_lower,
            input_upper: &self.input_upper,
            input_offsets: &self.input_offsets,
            terminal_generators: &self.terminal_generators,
            ..*original
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;
    use crate::program::{PlantTables, RelaxedFamily, least_relaxation};

    #[test]
    fn relaxation_agrees_with_the_general_solver() {
        // A double integrator asked to go 10 in 4 steps of at most 1, at a speed of at most 1.
        let a = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]);
        let b = DMatrix::from_row_slice(2, 1, &[0.5, 1.0]);
        let plant = PlantTables::new(&a, &b, 4);
        let program = HorizonProgram {
            plant: &plant,
            initial: &[0.0, 0.0],
            horizon: 4,
            input_cost: 1.0,
            input_lower: &[-1.0; 4],
            input_upper: &[1.0; 4],
            input_normals: &[],
            input_offsets: &[],
            stage_rows: 1,
            constrained_stages: 3,
            stage_normals: &[0.0, 1.0, 0.0, 1.0, 0.0, 1.0],
            stage_offsets: &[1.0; 3],
            tracking_weight: 0.0,
            tracked_stages: 0,
            tracking_reference: &[],
            terminal_centre: &[3.5, 0.0],
            terminal_generators: &[],
            constant: 0.0,
        };
        for (family, relaxed) in [
            (ConstraintFamily::State, RelaxedFamily::Stage),
            (ConstraintFamily::Input, RelaxedFamily::Input),
            (ConstraintFamily::Terminal, RelaxedFamily::Terminal),
        ] {
            let mut question = Question::new(&program, Budget::UNLIMITED);
            let unrelaxed = question.solve(None).unwrap();
            let fast = question.least(&unrelaxed, family, LARGEST);
            let general = least_relaxation(&program, relaxed, Budget::UNLIMITED).unwrap();
            match (fast, general) {
                (Some(fast), Some(general)) => {
                    assert!(
                        fast / general < 1.0501 && fast / general > 0.9999,
                        "{family:?} {fast} {general}"
                    );
                }
                (None, None) => {}
                other => panic!("{family:?}: {other:?}"),
            }
            // And nothing better than what is known is no news.
            assert_eq!(question.least(&unrelaxed, family, 1e-3), None);
        }
    }
}
