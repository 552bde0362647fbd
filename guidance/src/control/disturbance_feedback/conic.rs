//! The general way: problem (24) as a program over second-order cones, with as few rows as it
//! takes.
//!
//! By Schur complement the matrix inequality (23) says Q_f >= sum_i M_i W_i M_i' / tau_i with
//! sum tau_i <= 1, and for given M_i the least trace of H Q_f H' is (sum_i |H M_i P_i|_F)². So no
//! semidefinite cone is needed.
//!
//! Most thrust rows (burn, axis) have room for all the corrections that anyone would want. So only
//! the *scarce* rows are rationed in the program; the others are assumed to have room for
//! anything, which leaves of each disturbance only the part outside their range, and the program
//! small. Where that assumption turns out wrong, the row becomes scarce and the program is solved
//! again. Each program relaxes (24), so an answer that respects every limit is optimal.

use nalgebra::{DMatrix, Vector3};

use super::{Gain, model::LinearModel};
use crate::{
    budget::{Budget, Interruption},
    matrices::{least_answer, product, range, solve_lower_right, transposed_product},
    program::{Affine, ConeProgram, Status},
};

/// Burns and gains, not yet believed.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Draft {
    pub(super) burns: Vec<Vector3<f64>>,
    /// Ordered by burn, then by disturbance.
    pub(super) gains: Vec<Gain>,
}

/// What came of one program.
pub(super) struct Relaxed {
    /// Where the solver ended; `None` if nowhere.
    pub(super) draft: Option<Draft>,
    /// It ended at an optimum. A draft is of use without: what it is worth, its certificate says.
    pub(super) solved: bool,
    /// At least 1: the count also says that this path was taken.
    pub(super) iterations: usize,
}

/// Free rows keep at least this share of their weight, so that none is lost to the range.
const WEIGHT_LEAST: f64 = 1e-3;

/// One disturbance in the program: what the free rows cannot answer, and the scarce rows.
struct Share {
    /// Scarce thrust rows after the disturbance.
    scarce: Vec<usize>,
    /// Free thrust rows after the disturbance.
    free: Vec<usize>,
    /// d x d: what is left of H G_i P_i outside the range of the free rows, columns in `basis`.
    effect: DMatrix<f64>,
    /// d x (scarce rows): what they can do about it.
    answers: DMatrix<f64>,
    /// 6 x d, orthonormal: answers outside its span would be wasted.
    basis: DMatrix<f64>,
    /// Unit of the scarce rows' answers, m/s.
    unit: f64,
    /// First variable of the answers (scarce rows x d) and of their norms (scarce rows).
    first_answer: usize,
    first_norm: usize,
    /// Variable of s_i.
    share: usize,
}

/// Solves the program in which the thrust rows (3 burn + axis) marked `scarce` are rationed.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub(super) fn solve(
    model: &LinearModel,
    effort_weight: f64,
    scarce: &[bool],
    budget: Budget<'_>,
) -> Result<Relaxed, Interruption> {
    let mut program = ConeProgram::default();
    let rows = 3 * model.burns();
    let burns = program.variables(rows);
    let magnitudes = program.variables(rows);
    let total = program.variables(1);
    let mut shares = Vec::with_capacity(model.burns());
    for i in 0..model.burns() {
        budget.check()?;
        shares.push(share(model, i, scarce));
    }
    for share in &mut shares {
        share.share = program.variables(1);
        share.first_answer = program.variables(share.scarce.len() * share.basis.ncols());
        share.first_norm = program.variables(share.scarce.len());
    }
    let bound = model.lower_bound(budget)?;
    let least: f64 = bound.trace_shares.iter().sum();
    let size = if least > 0.0 { least } else { 1.0 };
    let unit = bound.objective.max(f64::MIN_POSITIVE);
    program.add_square_cost(total, size * size / unit);
    for row in 0..rows {
        program.add_linear_cost(magnitudes + row, model.fuel_weight * model.limit / unit);
    }
    for share in &shares {
        for row in 0..share.scarce.len() {
            program.add_linear_cost(share.first_norm + row, effort_weight * share.unit / unit);
        }
    }
    add_end(&mut program, burns, model);
    add_total(&mut program, total, &shares);
    add_saturation(&mut program, (burns, magnitudes), &shares, model.limit);
    shares.iter().for_each(|share| add_share(&mut program, share, size));
    let solution = program.solve(budget)?;
    let solved = matches!(solution.status, Status::Optimal | Status::Inaccurate);
    let usable = !solution.x.is_empty() && solution.x.iter().all(|x| x.is_finite());
    let patient = budget.beyond_deadline();
    let draft = usable.then(|| interpreted(model, burns, &shares, &solution.x, patient));
    let draft = draft.transpose()?;
    Ok(Relaxed { draft, solved, iterations: solution.iterations.max(1) })
}

/// Disturbance `i` without what the free rows can answer.
fn share(model: &LinearModel, i: usize, scarce: &[bool]) -> Share {
    let later = 3 * (i + 1)..3 * model.burns();
    let (answers, effect) = (model.answers(i), model.unanswered(i));
    let of = |wanted: bool| -> Vec<usize> {
        later.clone().filter(|&row| scarce[row] == wanted).collect()
    };
    let (scarce_rows, free) = (of(true), of(false));
    let columns = |rows: &[usize]| -> DMatrix<f64> {
        let places: Vec<usize> = rows.iter().map(|row| row - later.start).collect();
        answers.select_columns(&places)
    };
    let within = range(&columns(&free), 1e-12);
    let m = effect.nrows();
    // What is left of the space when the range of the free rows is taken out.
    let outside = DMatrix::identity(m, m) - product(&within, &within.transpose());
    let complement = range(&outside, 0.5).columns(0, m - within.ncols()).into_owned();
    let left = transposed_product(&complement, &effect);
    let basis = range(&left.transpose(), 1e-14);
    let answers = transposed_product(&complement, &columns(&scarce_rows));
    let effect = product(&left, &basis);
    let largest = least_answer(&answers, &effect).iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    Share {
        unit: if largest > 0.0 { largest.min(model.limit) } else { model.limit },
        scarce: if basis.ncols() == 0 { Vec::new() } else { scarce_rows },
        free,
        effect,
        answers,
        basis,
        first_answer: 0,
        first_norm: 0,
        share: 0,
    }
}

fn variable(column: usize) -> Affine {
    Affine { constant: 0.0, entries: vec![(column, 1.0)] }
}

/// (16): the nominal end is the target; each row in units of its largest entry.
fn add_end(program: &mut ConeProgram, burns: usize, model: &LinearModel) {
    let (map, right) = (model.burn_map(), model.shortfall());
    let rows: Vec<Affine> = (0..6)
        .map(|i| {
            let largest = map.row(i).iter().fold(f64::MIN_POSITIVE, |a: f64, x| a.max(x.abs()));
            let entries = (0..map.ncols()).map(|j| (burns + j, map[(i, j)] / largest));
            Affine { constant: -right[i] / (largest * model.limit), entries: entries.collect() }
        })
        .collect();
    program.zero(&rows);
}

/// total = sum of the shares.
fn add_total(program: &mut ConeProgram, total: usize, shares: &[Share]) {
    let shares = shares.iter().map(|share| (share.share, -1.0));
    let entries = std::iter::once((total, 1.0)).chain(shares).collect();
    program.zero(&[Affine { constant: 0.0, entries }]);
}

/// (19) and (20), in units of the limit; corrections count on scarce rows only.
fn add_saturation(
    program: &mut ConeProgram,
    (burns, magnitudes): (usize, usize),
    shares: &[Share],
    limit: f64,
) {
    let mut rows = Vec::new();
    for row in 0..magnitudes - burns {
        for sign in [1.0, -1.0] {
            let entries = vec![(magnitudes + row, 1.0), (burns + row, sign)];
            rows.push(Affine { constant: 0.0, entries });
        }
        let mut entries = vec![(magnitudes + row, -1.0)];
        for share in shares {
            if let Some(place) = share.scarce.iter().position(|&scarce| scarce == row) {
                entries.push((share.first_norm + place, -share.unit / limit));
            }
        }
        rows.push(Affine { constant: 1.0, entries });
    }
    program.nonnegative(&rows);
}

/// s_i is at least the norm of what remains, and each row's norm that of its answer.
fn add_share(program: &mut ConeProgram, share: &Share, size: f64) {
    let d = share.basis.ncols();
    let mut rows = vec![variable(share.share)];
    for r in 0..share.effect.nrows() {
        for c in 0..d {
            let entry = |place: usize| {
                let column = share.first_answer + place * d + c;
                (column, share.answers[(r, place)] * share.unit / size)
            };
            rows.push(Affine {
                constant: share.effect[(r, c)] / size,
                entries: (0..share.scarce.len()).map(entry).collect(),
            });
        }
    }
    program.norm_at_most(&rows);
    for place in 0..share.scarce.len() {
        let answers = (0..d).map(|c| variable(share.first_answer + place * d + c));
        let rows: Vec<Affine> =
            std::iter::once(variable(share.first_norm + place)).chain(answers).collect();
        program.norm_at_most(&rows);
    }
}

/// Burns and scarce answers from the solver; the free rows answer the rest, each by its room.
fn interpreted(
    model: &LinearModel,
    burns: usize,
    shares: &[Share],
    x: &[f64],
    budget: Budget<'_>,
) -> Result<Draft, Interruption> {
    let weight = |row: usize| (1.0 - x[burns + row].abs()).max(WEIGHT_LEAST);
    let mut gains = Vec::new();
    for (i, share) in shares.iter().enumerate() {
        budget.check()?;
        let first = 3 * (i + 1);
        let (map, mut rest) = (model.answers(i), model.unanswered(i));
        let mut answer = DMatrix::zeros(map.ncols(), 6);
        let d = share.basis.ncols();
        for (place, row) in share.scarce.iter().enumerate() {
            let start = share.first_answer + place * d;
            let reduced = DMatrix::from_row_slice(1, d, &x[start..start + d]) * share.unit;
            let whole = product(&reduced, &share.basis.transpose());
            answer.row_mut(row - first).copy_from(&whole);
        }
        rest += product(&map, &answer);
        let weighted = DMatrix::from_fn(map.nrows(), share.free.len(), |r, c| {
            map[(r, share.free[c] - first)] * weight(share.free[c])
        });
        let completion = least_answer(&weighted, &rest);
        for (place, &row) in share.free.iter().enumerate() {
            let scaled = completion.row(place) * -weight(row);
            answer.row_mut(row - first).copy_from(&scaled);
        }
        gains.extend(gains_of(model, i, &answer));
    }
    gains.sort_by_key(|gain: &Gain| (gain.burn, gain.disturbance));
    let limit = model.limit;
    let burn = |k: usize| Vector3::from_fn(|axis, _| x[burns + 3 * k + axis] * limit);
    Ok(Draft { burns: (0..model.burns()).map(burn).collect(), gains })
}

/// L_ki = Y_ki P_i^-1 of all later burns from the stacked answers Y_i (3 (later burns) x 6).
pub(super) fn gains_of(
    model: &LinearModel,
    disturbance: usize,
    answer: &DMatrix<f64>,
) -> impl Iterator<Item = Gain> {
    let root = model.disturbances[disturbance].root();
    let gain = move |burn: usize| {
        let block = answer.rows(3 * (burn - disturbance - 1), 3).into_owned();
        Gain { burn, disturbance, matrix: solve_lower_right(&block, root) }
    };
    (disturbance + 1..model.burns()).map(gain)
}
