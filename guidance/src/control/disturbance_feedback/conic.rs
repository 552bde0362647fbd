//! The general way: problem (24) as a program over second-order cones.
//!
//! By Schur complement the matrix inequality (23) says Q_f >= sum_i M_i W_i M_i' / tau_i with
//! sum tau_i <= 1, and for given M_i the least trace of H Q_f H' is (sum_i |H M_i P_i|_F)². So no
//! semidefinite cone is needed, and no iterate can leave it.

use nalgebra::{DMatrix, Vector3};

use super::{Gain, model::LinearModel};
use crate::{
    budget::{Budget, Interruption},
    matrices::{product, pseudo_inverse, solve_lower_right},
    program::{Affine, ConeProgram, Status},
};

/// Burns and gains, not yet believed.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Draft {
    pub(super) burns: Vec<Vector3<f64>>,
    /// Ordered by burn, then by disturbance.
    pub(super) gains: Vec<Gain>,
}

/// Where the variables stand, and their units.
struct Layout {
    /// Burns, in units of the limit: 3 a burn.
    burns: usize,
    /// Their magnitudes.
    magnitudes: usize,
    /// s_i, in units of `size`.
    shares: usize,
    /// Y_ki = L_ki P_i, 18 a pair row by row, in units of `answer_units[i]`.
    answers: usize,
    /// Norms of the rows of Y_ki, 3 a pair, same units.
    norms: usize,
    /// sum s_i.
    total: usize,
    /// Unit of s.
    size: f64,
    /// Unit of the answers to disturbance i, m/s.
    answer_units: Vec<f64>,
}

/// Solves (24): minimise s² + fuel_weight sum z + effort_weight sum of row norms, with
/// s >= sum_i |H M_i P_i|_F and (16), (19), (20). `None` with the iterations if the solver gave up.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub(super) fn solve(
    model: &LinearModel,
    effort_weight: f64,
    budget: Budget<'_>,
) -> Result<(Option<Draft>, usize), Interruption> {
    let (program, layout) = formulated(model, effort_weight);
    let solution = program.solve(budget)?;
    let usable = matches!(solution.status, Status::Optimal | Status::Inaccurate);
    let draft = usable.then(|| interpreted(model, &layout, &solution.x));
    // The count also says that this path was taken: it is never 0.
    Ok((draft, solution.iterations.max(1)))
}

/// Index of the pair (burn, disturbance) in the order of gains.
fn pair(burn: usize, disturbance: usize) -> usize {
    burn * burn.saturating_sub(1) / 2 + disturbance
}

fn formulated(model: &LinearModel, effort_weight: f64) -> (ConeProgram, Layout) {
    let burns = model.burns();
    let pairs = pair(burns, 0);
    let bound = model.lower_bound();
    let least: f64 = bound.trace_shares.iter().sum();
    let mut program = ConeProgram::default();
    let layout = Layout {
        burns: program.variables(3 * burns),
        magnitudes: program.variables(3 * burns),
        shares: program.variables(burns),
        answers: program.variables(18 * pairs),
        norms: program.variables(3 * pairs),
        total: program.variables(1),
        size: if least > 0.0 { least } else { 1.0 },
        answer_units: (0..burns).map(|i| answer_unit(model, i)).collect(),
    };
    let unit = bound.objective.max(f64::MIN_POSITIVE);
    program.add_square_cost(layout.total, layout.size * layout.size / unit);
    for j in 0..3 * burns {
        program.add_linear_cost(layout.magnitudes + j, model.fuel_weight * model.limit / unit);
    }
    for k in 0..burns {
        for i in 0..k {
            let cost = effort_weight * layout.answer_units[i] / unit;
            for axis in 0..3 {
                program.add_linear_cost(layout.norms + 3 * pair(k, i) + axis, cost);
            }
        }
    }
    add_equalities(&mut program, &layout, model);
    add_saturation(&mut program, &layout, model);
    add_shares(&mut program, &layout, model);
    (program, layout)
}

/// The size of the least answer to disturbance `i`, at most the limit.
fn answer_unit(model: &LinearModel, i: usize) -> f64 {
    let (inverse, _) = pseudo_inverse(&model.answers(i));
    let largest =
        product(&inverse, &model.unanswered(i)).iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    if largest > 0.0 { largest.min(model.limit) } else { model.limit }
}

/// (16), each row in units of its own largest entry; and the sum of shares.
fn add_equalities(program: &mut ConeProgram, layout: &Layout, model: &LinearModel) {
    let (map, right) = (model.burn_map(), model.shortfall());
    let mut rows: Vec<Affine> = (0..6)
        .map(|i| {
            let largest = map.row(i).iter().fold(f64::MIN_POSITIVE, |a: f64, x| a.max(x.abs()));
            let entries = (0..map.ncols()).map(|j| (layout.burns + j, map[(i, j)] / largest));
            Affine { constant: -right[i] / (largest * model.limit), entries: entries.collect() }
        })
        .collect();
    let shares = (0..model.burns()).map(|i| (layout.shares + i, -1.0));
    let entries = std::iter::once((layout.total, 1.0)).chain(shares).collect();
    rows.push(Affine { constant: 0.0, entries });
    program.zero(&rows);
}

/// (19) and (20).
fn add_saturation(program: &mut ConeProgram, layout: &Layout, model: &LinearModel) {
    let mut rows = Vec::new();
    for k in 0..model.burns() {
        for axis in 0..3 {
            let (burn, magnitude) = (layout.burns + 3 * k + axis, layout.magnitudes + 3 * k + axis);
            for sign in [1.0, -1.0] {
                let entries = vec![(magnitude, 1.0), (burn, sign)];
                rows.push(Affine { constant: 0.0, entries });
            }
            let mut entries = vec![(magnitude, -1.0)];
            entries.extend((0..k).map(|i| {
                let norm = layout.norms + 3 * pair(k, i) + axis;
                (norm, -layout.answer_units[i] / model.limit)
            }));
            rows.push(Affine { constant: 1.0, entries });
        }
    }
    program.nonnegative(&rows);
    let x = |column: usize| Affine { constant: 0.0, entries: vec![(column, 1.0)] };
    for p in 0..pair(model.burns(), 0) {
        for axis in 0..3 {
            let mut rows = vec![x(layout.norms + 3 * p + axis)];
            rows.extend((0..6).map(|c| x(layout.answers + 18 * p + 6 * axis + c)));
            program.norm_at_most(&rows);
        }
    }
}

/// |H M_i P_i|_F <= s_i with H M_i P_i = H G_i P_i + sum_k H B_k Y_ki.
fn add_shares(program: &mut ConeProgram, layout: &Layout, model: &LinearModel) {
    for i in 0..model.burns() {
        let (effect, answers) = (model.unanswered(i), model.answers(i));
        let scale = layout.answer_units[i] / layout.size;
        let mut rows = vec![Affine { constant: 0.0, entries: vec![(layout.shares + i, 1.0)] }];
        for r in 0..effect.nrows() {
            for c in 0..6 {
                let entry = |column: usize| {
                    let (k, axis) = (i + 1 + column / 3, column % 3);
                    let place = layout.answers + 18 * pair(k, i) + 6 * axis + c;
                    (place, answers[(r, column)] * scale)
                };
                rows.push(Affine {
                    constant: effect[(r, c)] / layout.size,
                    entries: (0..answers.ncols()).map(entry).collect(),
                });
            }
        }
        program.norm_at_most(&rows);
    }
}

fn interpreted(model: &LinearModel, layout: &Layout, x: &[f64]) -> Draft {
    let burns = (0..model.burns())
        .map(|k| Vector3::from_fn(|axis, _| x[layout.burns + 3 * k + axis] * model.limit))
        .collect();
    let mut gains = Vec::new();
    for burn in 0..model.burns() {
        for disturbance in 0..burn {
            let unit = layout.answer_units[disturbance];
            let first = layout.answers + 18 * pair(burn, disturbance);
            let answer = DMatrix::from_row_slice(3, 6, &x[first..first + 18]) * unit;
            let matrix = solve_lower_right(&answer, model.disturbances[disturbance].root());
            gains.push(Gain { burn, disturbance, matrix });
        }
    }
    Draft { burns, gains }
}
