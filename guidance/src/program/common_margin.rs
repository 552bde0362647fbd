//! The largest margin that a few rows can have in common over the unit box.

/// maximise t subject to a_i z - b_i >= t for every row i, 0 <= z <= 1.
///
/// Few rows, many variables: a bounded-variable primal simplex whose basis is as large as the
/// number of rows. It needs no first phase, because t may start below zero.
#[derive(Debug, Clone, Default)]
pub struct CommonMargin {
    variables: usize,
    /// a_i, one row after the other.
    rows: Vec<f64>,
    /// b_i.
    offsets: Vec<f64>,
}

/// What came of it; both sides are recomputed from the rows alone.
#[derive(Debug, Clone, PartialEq)]
pub struct MarginAnswer {
    /// z, within the box.
    pub point: Vec<f64>,
    /// min_i a_i z - b_i at that point: the optimum is not below this.
    pub margin: f64,
    /// Weights y >= 0 of the rows with sum 1.
    pub weights: Vec<f64>,
    /// sum_j max(0, (y'A)_j) - y'b: the optimum is not above this.
    pub bound: f64,
    /// Pivots and bound flips.
    pub iterations: usize,
}

/// A reduced cost or a step below this is rounding; rows are of size 1.
const ROUNDING: f64 = 1e-11;
/// A pivot below this is not taken if another one is allowed.
const PIVOT_MIN: f64 = 1e-7;
/// Pivots after which the inverse is computed afresh.
const REFACTOR_AFTER: usize = 40;
/// Steps without progress after which the first candidate enters instead of the steepest.
const STALLED_AFTER: usize = 30;

impl CommonMargin {
    /// No rows yet, over `variables` variables.
    #[must_use]
    pub fn new(variables: usize) -> Self {
        Self { variables, rows: Vec::new(), offsets: Vec::new() }
    }

    /// Appends the row a z >= b + t.
    ///
    /// # Panics
    /// If its length is not the number of variables.
    pub fn push(&mut self, row: &[f64], offset: f64) {
        assert_eq!(row.len(), self.variables, "length of a row");
        self.rows.extend_from_slice(row);
        self.offsets.push(offset);
    }

    /// Takes the last row away.
    pub fn pop(&mut self) {
        self.offsets.pop();
        self.rows.truncate(self.offsets.len() * self.variables);
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.offsets.len()
    }

    /// No rows at all?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.offsets.is_empty()
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.rows[i * self.variables..][..self.variables]
    }

    /// min_i a_i z - b_i; infinite without rows.
    #[must_use]
    pub fn margin_at(&self, point: &[f64]) -> f64 {
        (0..self.len())
            .map(|i| sum_product(self.row(i), point) - self.offsets[i])
            .fold(f64::INFINITY, f64::min)
    }

    /// An upper bound on the optimum from any weights: negative ones are dropped, the rest is
    /// scaled to sum 1. Infinite if nothing is left.
    #[must_use]
    pub fn bound_from(&self, weights: &[f64]) -> f64 {
        let total: f64 = weights.iter().map(|y| y.max(0.0)).sum();
        if !(total > 0.0) {
            return f64::INFINITY;
        }
        let mut combined = vec![0.0; self.variables];
        let mut bound = 0.0;
        for i in 0..self.len() {
            let y = weights[i].max(0.0) / total;
            combined.iter_mut().zip(self.row(i)).for_each(|(sum, a)| *sum += y * a);
            bound -= y * self.offsets[i];
        }
        bound + combined.iter().map(|c| c.max(0.0)).sum::<f64>()
    }

    /// Solves it; stops as soon as the optimum is proved to be below `enough`, or reached
    /// `plenty`.
    #[must_use]
    pub fn solve(&self, enough: f64, plenty: f64) -> MarginAnswer {
        if self.is_empty() {
            let point = vec![0.0; self.variables];
            let (margin, bound) = (f64::INFINITY, f64::INFINITY);
            return MarginAnswer { point, margin, weights: Vec::new(), bound, iterations: 0 };
        }
        let mut simplex = Simplex::new(self);
        let limit = 200 + 20 * self.len() + 4 * self.variables;
        let mut weights = simplex.weights();
        while simplex.iterations < limit {
            if simplex.margin() >= plenty || self.bound_from(&weights) < enough {
                break;
            }
            if !simplex.improve(&weights) {
                break;
            }
            weights = simplex.weights();
        }
        let point = simplex.point();
        let weights: Vec<f64> = weights.iter().map(|y| y.max(0.0)).collect();
        MarginAnswer {
            margin: self.margin_at(&point),
            bound: self.bound_from(&weights),
            point,
            weights,
            iterations: simplex.iterations,
        }
    }
}

/// What is basic in a row: variables count 0 .. n-1, t is n, the slack of row i is n + 1 + i.
struct Simplex<'a> {
    program: &'a CommonMargin,
    basis: Vec<usize>,
    values: Vec<f64>,
    /// Inverse of the basis, row by row.
    inverse: Vec<f64>,
    /// Nonbasic variable is at 1, not at 0.
    at_one: Vec<bool>,
    is_basic: Vec<bool>,
    iterations: usize,
    pivots: usize,
    stalled: usize,
}

impl<'a> Simplex<'a> {
    /// z = 0, t as large as that allows.
    fn new(program: &'a CommonMargin) -> Self {
        let (n, r) = (program.variables, program.len());
        // At z = 0 the margin of row i is -b_i.
        let tightest =
            (0..r).max_by(|&i, &j| program.offsets[i].total_cmp(&program.offsets[j])).unwrap_or(0);
        let mut basis: Vec<usize> = (0..r).map(|i| n + 1 + i).collect();
        basis[tightest] = n;
        let mut is_basic = vec![false; n + 1 + r];
        basis.iter().for_each(|&v| is_basic[v] = true);
        let mut simplex = Self {
            program,
            basis,
            values: vec![0.0; r],
            inverse: vec![0.0; r * r],
            at_one: vec![false; n],
            is_basic,
            iterations: 0,
            pivots: 0,
            stalled: 0,
        };
        simplex.refactor();
        simplex
    }

    fn rows(&self) -> usize {
        self.basis.len()
    }

    /// Entry i of the column of a variable in a_i z - t - s_i = b_i.
    fn entry(&self, i: usize, variable: usize) -> f64 {
        let n = self.program.variables;
        match variable {
            v if v < n => self.program.rows[i * n + v],
            v if v == n => -1.0,
            v => -f64::from(u8::from(v - n - 1 == i)),
        }
    }

    /// Row of the basis in which t is; it never leaves.
    fn margin_row(&self) -> usize {
        self.basis.iter().position(|&v| v == self.program.variables).unwrap_or(0)
    }

    fn margin(&self) -> f64 {
        self.values[self.margin_row()]
    }

    /// y = -(row of t in the inverse); sums to 1, negative where a slack should enter.
    fn weights(&self) -> Vec<f64> {
        let r = self.rows();
        self.inverse[self.margin_row() * r..][..r].iter().map(|x| -x).collect()
    }

    fn point(&self) -> Vec<f64> {
        let mut z: Vec<f64> = self.at_one.iter().map(|&one| f64::from(u8::from(one))).collect();
        for (&variable, &value) in self.basis.iter().zip(&self.values) {
            if variable < z.len() {
                z[variable] = value.clamp(0.0, 1.0);
            }
        }
        z
    }

    /// One step of the simplex; false at the optimum or if no step is possible.
    fn improve(&mut self, weights: &[f64]) -> bool {
        let Some(entering) = self.entering(weights) else { return false };
        let r = self.rows();
        let n = self.program.variables;
        let downwards = entering < n && self.at_one[entering];
        let sign = if downwards { -1.0 } else { 1.0 };
        // The basic values change by -step * column.
        let mut column = vec![0.0; r];
        for i in 0..r {
            let a = sign * self.entry(i, entering);
            if a != 0.0 {
                (0..r).for_each(|k| column[k] += self.inverse[k * r + i] * a);
            }
        }
        let own = if entering < n { 1.0 } else { f64::INFINITY };
        let (step, leaving) = self.ratio_test(&column, own);
        if !step.is_finite() {
            return false;
        }
        self.iterations += 1;
        self.stalled = if step > ROUNDING { 0 } else { self.stalled + 1 };
        self.values.iter_mut().zip(&column).for_each(|(value, c)| *value -= step * c);
        let Some((row, to_one)) = leaving else {
            self.at_one[entering] = !self.at_one[entering];
            return true;
        };
        let left = self.basis[row];
        self.is_basic[left] = false;
        if left < n {
            self.at_one[left] = to_one;
        }
        self.is_basic[entering] = true;
        self.basis[row] = entering;
        self.values[row] = if downwards { 1.0 - step } else { step };
        self.replace(row, &column, sign);
        self.pivots += 1;
        if self.pivots.is_multiple_of(REFACTOR_AFTER) {
            self.refactor();
        }
        true
    }

    /// The steepest variable whose move raises t; the first one after many idle steps.
    fn entering(&self, weights: &[f64]) -> Option<usize> {
        let n = self.program.variables;
        let mut slopes = vec![0.0; n];
        for i in 0..self.rows() {
            let y = weights[i];
            if y != 0.0 {
                let row = self.program.row(i);
                slopes.iter_mut().zip(row).for_each(|(slope, a)| *slope += y * a);
            }
        }
        let mut best: Option<(usize, f64)> = None;
        let gains = slopes
            .iter()
            .enumerate()
            .map(|(j, &slope)| (j, if self.at_one[j] { -slope } else { slope }));
        let slacks = weights.iter().enumerate().map(|(i, &y)| (n + 1 + i, -y));
        for (variable, gain) in gains.chain(slacks) {
            if gain > ROUNDING && !self.is_basic[variable] {
                if self.stalled > STALLED_AFTER {
                    return Some(variable);
                }
                if best.is_none_or(|(_, most)| gain > most) {
                    best = Some((variable, gain));
                }
            }
        }
        best.map(|(variable, _)| variable)
    }

    /// How far, and which basic row then leaves and whether at 1; `None`: the entering variable
    /// reaches its own other bound first.
    fn ratio_test(&self, column: &[f64], own: f64) -> (f64, Option<(usize, bool)>) {
        let n = self.program.variables;
        let limit = |k: usize| -> Option<(f64, bool)> {
            let (variable, c, value) = (self.basis[k], column[k], self.values[k]);
            if variable == n || c.abs() <= ROUNDING {
                return None;
            }
            if c > 0.0 {
                Some((value.max(0.0) / c, false))
            } else if variable < n {
                Some(((1.0 - value).max(0.0) / -c, true))
            } else {
                None
            }
        };
        let (mut step, mut leaving) = (own, None);
        let mut size = 0.0;
        for k in 0..self.rows() {
            let Some((most, to_one)) = limit(k) else { continue };
            let shorter = most < step - ROUNDING;
            let steadier = most <= step + ROUNDING && column[k].abs() > size && leaving.is_some();
            if shorter && (column[k].abs() > PIVOT_MIN || leaving.is_none()) || steadier {
                step = most.min(step);
                leaving = Some((k, to_one));
                size = column[k].abs();
            }
        }
        (step, leaving)
    }

    /// Product-form update of the inverse.
    fn replace(&mut self, row: usize, column: &[f64], sign: f64) {
        let r = self.rows();
        // The column was made for the signed variable.
        let pivot = column[row] * sign;
        let scaled: Vec<f64> = self.inverse[row * r..][..r].iter().map(|x| x / pivot).collect();
        for k in 0..r {
            let factor = column[k] * sign;
            if k != row && factor != 0.0 {
                let target = &mut self.inverse[k * r..][..r];
                target.iter_mut().zip(&scaled).for_each(|(x, s)| *x -= factor * s);
            }
        }
        self.inverse[row * r..][..r].copy_from_slice(&scaled);
    }

    /// Inverse and basic values from the rows, which takes out what rounding has added.
    fn refactor(&mut self) {
        let r = self.rows();
        let matrix = nalgebra::DMatrix::from_fn(r, r, |i, k| self.entry(i, self.basis[k]));
        let Some(inverse) = matrix.try_inverse() else { return };
        for i in 0..r {
            (0..r).for_each(|k| self.inverse[i * r + k] = inverse[(i, k)]);
        }
        let n = self.program.variables;
        let right: Vec<f64> = (0..r)
            .map(|i| {
                let fixed: f64 = (0..n)
                    .filter(|&j| self.at_one[j] && !self.is_basic[j])
                    .map(|j| self.program.rows[i * n + j])
                    .sum();
                self.program.offsets[i] - fixed
            })
            .collect();
        for k in 0..r {
            self.values[k] = sum_product(&self.inverse[k * r..][..r], &right);
        }
    }
}

fn sum_product(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests {
    use ::clarabel::{
        algebra::CscMatrix,
        solver::{DefaultSettings, DefaultSolver, IPSolver, SupportedConeT::NonnegativeConeT},
    };
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn random(rng: &mut ChaCha8Rng, rows: usize, variables: usize) -> CommonMargin {
        let mut program = CommonMargin::new(variables);
        for _ in 0..rows {
            let row: Vec<f64> = (0..variables).map(|_| rng.random_range(-1.0..1.0)).collect();
            program.push(&row, rng.random_range(-1.0..1.0));
        }
        program
    }

    /// The same by interior point: min -t, rows t - a z <= -b, bounds on z.
    fn by_clarabel(program: &CommonMargin) -> f64 {
        let (n, r) = (program.variables, program.len());
        let (mut rows, mut columns, mut values) = (Vec::new(), Vec::new(), Vec::new());
        let mut right = Vec::new();
        let mut entry = |row: usize, column: usize, value: f64| {
            rows.push(row);
            columns.push(column);
            values.push(value);
        };
        for i in 0..r {
            (0..n).for_each(|j| entry(i, j, -program.row(i)[j]));
            entry(i, n, 1.0);
            right.push(-program.offsets[i]);
        }
        for j in 0..n {
            entry(r + 2 * j, j, 1.0);
            entry(r + 2 * j + 1, j, -1.0);
            right.extend([1.0, 0.0]);
        }
        let matrix = CscMatrix::new_from_triplets(r + 2 * n, n + 1, rows, columns, values);
        let mut cost = vec![0.0; n + 1];
        cost[n] = -1.0;
        let none = CscMatrix::zeros((n + 1, n + 1));
        let settings = DefaultSettings { verbose: false, ..DefaultSettings::default() };
        let cones = [NonnegativeConeT(r + 2 * n)];
        let mut solver =
            DefaultSolver::new(&none, &cost, &matrix, &right, &cones, settings).unwrap();
        solver.solve();
        solver.solution.x[n]
    }

    #[test]
    fn optimum_is_clarabels_and_closed_from_both_sides() {
        let seed = 20_221_110;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for case in 0..200 {
            let (rows, variables) = (rng.random_range(1..25), rng.random_range(1..80));
            let program = random(&mut rng, rows, variables);
            let answer = program.solve(f64::NEG_INFINITY, f64::INFINITY);
            let gap = answer.bound - answer.margin;
            assert!((-1e-12..1e-9).contains(&gap), "seed {seed} case {case}: gap {gap:e}");
            let other = by_clarabel(&program);
            assert!((answer.margin - other).abs() < 1e-6, "{case}: {} {other}", answer.margin);
            assert!(answer.point.iter().all(|z| (0.0..=1.0).contains(z)));
        }
    }

    #[test]
    fn stops_early_with_a_proof_either_way() {
        let mut program = CommonMargin::new(2);
        program.push(&[1.0, 0.0], 3.0);
        program.push(&[0.0, 1.0], 0.2);
        let answer = program.solve(0.0, f64::INFINITY);
        assert!(answer.bound < 0.0, "1 - 3 at most: {answer:?}");
        program.pop();
        program.pop();
        program.push(&[1.0, 1.0], -5.0);
        let answer = program.solve(0.0, 1.0);
        assert!(answer.margin >= 1.0);
        assert_eq!(CommonMargin::new(3).solve(0.0, 1.0).margin, f64::INFINITY);
    }

    #[test]
    fn degenerate_rows_do_not_cycle() {
        let mut program = CommonMargin::new(30);
        for i in 0..12 {
            let row: Vec<f64> = (0..30).map(|j| f64::from(u8::from(j % 3 == i % 3))).collect();
            program.push(&row, 0.0);
        }
        let answer = program.solve(f64::NEG_INFINITY, f64::INFINITY);
        assert!((answer.margin - 10.0).abs() < 1e-12 && (answer.bound - 10.0).abs() < 1e-12);
    }
}
