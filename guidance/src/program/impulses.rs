//! Least impulses that reach a state: a linear program with few rows and a bounded simplex for it.
//!
//! ```text
//! minimise sum_j |v_j|   subject to   B v = r,   |v_j| <= limit_j
//! ```
//!
//! With m rows (6 for a rendezvous) every basis is m x m, so it is inverted afresh at every pivot:
//! nothing drifts. What the simplex says is believed only as far as [`impulse_bound`] and the
//! residual of B v = r, which share nothing with it, confirm.

use nalgebra::DMatrix;

/// What came of a program of least impulses.
#[derive(Debug, Clone, PartialEq)]
pub enum Impulses {
    /// A cheapest v, n values, with multipliers y, m values, that prove it: see [`impulse_bound`].
    Optimal {
        /// v.
        impulses: Vec<f64>,
        /// y.
        multipliers: Vec<f64>,
    },
    /// No v exists: y with y'r > sum_j limit_j |b_j'y|.
    Infeasible {
        /// y, m values.
        ray: Vec<f64>,
    },
    /// The pivot limit was reached, or a basis could not be inverted.
    Stalled,
}

/// Pivots before the rule changes to Bland's, which cannot cycle.
const DANTZIG_PIVOTS: usize = 500;
/// Pivots before giving up.
const PIVOTS_MAX: usize = 5_000;
/// Reduced costs above minus this are not negative; costs are 0 or 1.
const COST_TOLERANCE: f64 = 1e-12;
/// What phase 1 may leave of the right side: rounding, because at the edge of feasibility a pivot
/// can magnify it a hundredfold.
const RESIDUAL_TOLERANCE: f64 = 1e-13;

/// Solves the program: `columns` is B (m x n), `right` r (m), `limits` n values, each >= 0.
#[must_use]
pub fn least_impulses(columns: &DMatrix<f64>, right: &[f64], limits: &[f64]) -> Impulses {
    let mut simplex = Simplex::new(columns, right, limits);
    let Some(left) = simplex.minimise() else { return Impulses::Stalled };
    let size = simplex.right.iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    if left > RESIDUAL_TOLERANCE * size {
        return Impulses::Infeasible { ray: simplex.multipliers() };
    }
    simplex.start_phase_two();
    if simplex.minimise().is_none() {
        return Impulses::Stalled;
    }
    Impulses::Optimal { impulses: simplex.impulses(), multipliers: simplex.multipliers() }
}

/// A lower bound on sum |v_j| over all v with B v = r and |v_j| <= limit_j, from any y at all:
/// y'r - sum_j limit_j max(|b_j'y| - 1, 0), by weak duality.
#[must_use]
pub fn impulse_bound(
    columns: &DMatrix<f64>,
    right: &[f64],
    limits: &[f64],
    multipliers: &[f64],
) -> f64 {
    let gain: f64 = multipliers.iter().zip(right).map(|(y, r)| y * r).sum();
    let loss: f64 = (0..columns.ncols())
        .map(|j| limits[j] * (along(columns, j, multipliers).abs() - 1.0).max(0.0))
        .sum();
    gain - loss
}

/// Least limit, the same for every component, for which B v = r has a solution, with the ray that
/// proves every smaller one infeasible; `None` if the simplex stalls or no limit would do.
///
/// Newton's method on rays: each ray y proves that the limit is at least y'r / sum_j |b_j'y|, and
/// there are finitely many.
#[must_use]
pub fn least_limit(columns: &DMatrix<f64>, right: &[f64]) -> Option<(f64, Vec<f64>)> {
    let bound = |y: &[f64]| -> f64 {
        let gain: f64 = y.iter().zip(right).map(|(y, r)| y * r).sum();
        gain / (0..columns.ncols()).map(|j| along(columns, j, y).abs()).sum::<f64>()
    };
    if right.iter().all(|&r| r == 0.0) {
        return Some((0.0, vec![0.0; right.len()]));
    }
    let mut ray = right.to_vec();
    let mut limit = bound(&ray);
    for _ in 0..100 {
        if !limit.is_finite() {
            return None;
        }
        match least_impulses(columns, right, &vec![limit; columns.ncols()]) {
            Impulses::Stalled => return None,
            Impulses::Optimal { .. } => return Some((limit, ray)),
            Impulses::Infeasible { ray: better } => {
                let next = bound(&better);
                if !(next > limit * (1.0 + 1e-13)) {
                    return Some((limit, ray));
                }
                (limit, ray) = (next, better);
            }
        }
    }
    Some((limit, ray))
}

/// b_j' y.
fn along(columns: &DMatrix<f64>, j: usize, y: &[f64]) -> f64 {
    y.iter().enumerate().map(|(i, y)| columns[(i, j)] * y).sum()
}

/// Revised simplex on v = plus - minus, both in [0, limit], with one artificial a row.
///
/// Columns: n plus, n minus, m artificial.
struct Simplex {
    /// m x n, rows scaled to a largest entry of 1.
    columns: DMatrix<f64>,
    right: Vec<f64>,
    row_scale: Vec<f64>,
    /// Sign of each artificial column.
    signs: Vec<f64>,
    upper: Vec<f64>,
    cost: Vec<f64>,
    basis: Vec<usize>,
    /// Of every column: where it stands if it is not basic.
    at_upper: Vec<bool>,
    basic: Vec<bool>,
    inverse: DMatrix<f64>,
    values: Vec<f64>,
}

impl Simplex {
    fn new(columns: &DMatrix<f64>, right: &[f64], limits: &[f64]) -> Self {
        let (m, n) = columns.shape();
        let largest = |i: usize| columns.row(i).iter().fold(0.0, |a: f64, x| a.max(x.abs()));
        let row_scale: Vec<f64> =
            (0..m).map(|i| if largest(i) > 0.0 { 1.0 / largest(i) } else { 1.0 }).collect();
        let right: Vec<f64> = right.iter().zip(&row_scale).map(|(r, s)| r * s).collect();
        let upper = [limits, limits, &vec![f64::INFINITY; m]].concat();
        let mut basic = vec![false; 2 * n + m];
        basic[2 * n..].fill(true);
        Self {
            columns: DMatrix::from_fn(m, n, |i, j| columns[(i, j)] * row_scale[i]),
            signs: right.iter().map(|&r| if r < 0.0 { -1.0 } else { 1.0 }).collect(),
            values: right.iter().map(|r| r.abs()).collect(),
            right,
            row_scale,
            upper,
            cost: (0..2 * n + m).map(|j| if j < 2 * n { 0.0 } else { 1.0 }).collect(),
            basis: (2 * n..2 * n + m).collect(),
            at_upper: vec![false; 2 * n + m],
            basic,
            inverse: DMatrix::identity(m, m),
        }
    }

    /// Artificials stay at 0, impulses cost their magnitude.
    fn start_phase_two(&mut self) {
        let impulses = 2 * self.columns.ncols();
        self.cost[..impulses].fill(1.0);
        self.cost[impulses..].fill(0.0);
        self.upper[impulses..].fill(0.0);
    }

    fn entry(&self, i: usize, column: usize) -> f64 {
        let n = self.columns.ncols();
        if column < n {
            self.columns[(i, column)]
        } else if column < 2 * n {
            -self.columns[(i, column - n)]
        } else if column - 2 * n == i {
            self.signs[i]
        } else {
            0.0
        }
    }

    /// Pivots until nothing improves; the cost, or `None` if it does not end.
    fn minimise(&mut self) -> Option<f64> {
        for pivot in 0..PIVOTS_MAX {
            self.refresh()?;
            let y = self.scaled_multipliers();
            let Some(entering) = self.entering(&y, pivot >= DANTZIG_PIVOTS) else {
                let basic: f64 =
                    self.basis.iter().zip(&self.values).map(|(&j, x)| self.cost[j] * x).sum();
                return Some(basic);
            };
            self.pivot(entering)?;
        }
        None
    }

    /// Inverse of the basis and values of the basic columns, from scratch.
    fn refresh(&mut self) -> Option<()> {
        let m = self.basis.len();
        let basis = DMatrix::from_fn(m, m, |i, k| self.entry(i, self.basis[k]));
        self.inverse = inverted(basis)?;
        let mut rest = self.right.clone();
        for j in 0..self.upper.len() {
            if self.at_upper[j] && !self.basic[j] {
                for (i, rest) in rest.iter_mut().enumerate() {
                    *rest -= self.entry(i, j) * self.upper[j];
                }
            }
        }
        // Near the least limit bases are nearly singular. The residual of an explicit inverse grows
        // with that, two rounds of refinement bring it back to rounding.
        self.values = vec![0.0; m];
        for _ in 0..3 {
            let residual: Vec<f64> = (0..m)
                .map(|i| {
                    let reached = self.basis.iter().zip(&self.values);
                    rest[i] - reached.map(|(&j, x)| self.entry(i, j) * x).sum::<f64>()
                })
                .collect();
            for k in 0..m {
                self.values[k] += (0..m).map(|i| self.inverse[(k, i)] * residual[i]).sum::<f64>();
            }
        }
        Some(())
    }

    fn scaled_multipliers(&self) -> Vec<f64> {
        let m = self.basis.len();
        (0..m)
            .map(|i| (0..m).map(|k| self.cost[self.basis[k]] * self.inverse[(k, i)]).sum())
            .collect()
    }

    /// y of the rows as they were given.
    fn multipliers(&self) -> Vec<f64> {
        self.scaled_multipliers().iter().zip(&self.row_scale).map(|(y, s)| y * s).collect()
    }

    /// A column whose reduced cost says that moving it off its bound pays: the most negative, or
    /// the first.
    fn entering(&self, y: &[f64], first: bool) -> Option<usize> {
        let mut best = None;
        let mut most = COST_TOLERANCE;
        for j in 0..self.upper.len() {
            if self.basic[j] || self.upper[j] == 0.0 {
                continue;
            }
            let reduced: f64 =
                self.cost[j] - y.iter().enumerate().map(|(i, y)| y * self.entry(i, j)).sum::<f64>();
            let gain = if self.at_upper[j] { reduced } else { -reduced };
            if gain > most {
                best = Some(j);
                if first {
                    break;
                }
                most = gain;
            }
        }
        best
    }

    /// Moves `entering` until it or a basic column meets a bound.
    fn pivot(&mut self, entering: usize) -> Option<()> {
        let m = self.basis.len();
        let sign = if self.at_upper[entering] { -1.0 } else { 1.0 };
        let direction: Vec<f64> = (0..m)
            .map(|k| {
                sign * (0..m).map(|i| self.inverse[(k, i)] * self.entry(i, entering)).sum::<f64>()
            })
            .collect();
        // Basic column k falls by direction[k] a unit; it leaves below at 0 or above at its limit.
        let mut step = self.upper[entering];
        let mut leaving: Option<(usize, bool)> = None;
        for (k, &slope) in direction.iter().enumerate() {
            if slope.abs() <= 1e-11 {
                continue;
            }
            let room = if slope > 0.0 {
                self.values[k].max(0.0) / slope
            } else {
                (self.upper[self.basis[k]] - self.values[k]).max(0.0) / -slope
            };
            // Of equals the steeper: a larger pivot keeps the inverse accurate.
            let equal = leaving.is_some_and(|(l, _)| slope.abs() > direction[l].abs());
            if room < step || (room == step && equal) {
                step = room;
                leaving = Some((k, slope < 0.0));
            }
        }
        match leaving {
            None if step.is_finite() => self.at_upper[entering] = !self.at_upper[entering],
            None => return None,
            Some((k, above)) => {
                let left = self.basis[k];
                self.basic[left] = false;
                self.at_upper[left] = above;
                self.basis[k] = entering;
                self.basic[entering] = true;
                self.at_upper[entering] = false;
            }
        }
        Some(())
    }

    fn impulses(&self) -> Vec<f64> {
        let n = self.columns.ncols();
        let mut values: Vec<f64> = (0..2 * n)
            .map(|j| if self.at_upper[j] && !self.basic[j] { self.upper[j] } else { 0.0 })
            .collect();
        for (&j, &value) in self.basis.iter().zip(&self.values) {
            if j < 2 * n {
                values[j] = value.clamp(0.0, self.upper[j]);
            }
        }
        (0..n).map(|j| values[j] - values[n + j]).collect()
    }
}

/// Gauss-Jordan with row pivoting; `None` if singular.
fn inverted(mut a: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let m = a.nrows();
    let mut inverse = DMatrix::identity(m, m);
    for column in 0..m {
        let pivot = (column..m).fold(column, |best, i| {
            if a[(i, column)].abs() > a[(best, column)].abs() { i } else { best }
        });
        let value = a[(pivot, column)];
        if !(value.abs() > 1e-14) {
            return None;
        }
        a.swap_rows(column, pivot);
        inverse.swap_rows(column, pivot);
        for k in 0..m {
            a[(column, k)] /= value;
            inverse[(column, k)] /= value;
        }
        for i in (0..m).filter(|&i| i != column) {
            let factor = a[(i, column)];
            if factor != 0.0 {
                for k in 0..m {
                    a[(i, k)] -= factor * a[(column, k)];
                    inverse[(i, k)] -= factor * inverse[(column, k)];
                }
            }
        }
    }
    Some(inverse)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two rows, three columns; optimum by hand: v = (0, 0, 1) costs 1.
    fn columns() -> DMatrix<f64> {
        DMatrix::from_row_slice(2, 3, &[1.0, 0.0, 1.0, 0.0, 1.0, 1.0])
    }

    #[test]
    fn impulses_are_cheapest_and_proved_so() {
        for (limits, expected) in [([2.0; 3], 1.0), ([0.75; 3], 1.25), ([0.5; 3], 1.5)] {
            let Impulses::Optimal { impulses, multipliers } =
                least_impulses(&columns(), &[1.0, 1.0], &limits)
            else {
                panic!("{limits:?}")
            };
            let cost: f64 = impulses.iter().map(|v| v.abs()).sum();
            let bound = impulse_bound(&columns(), &[1.0, 1.0], &limits, &multipliers);
            assert!((cost - expected).abs() < 1e-12, "{limits:?}: {impulses:?}");
            assert!((bound - expected).abs() < 1e-12, "{limits:?}: {bound}");
        }
    }

    #[test]
    fn impulses_too_small_are_refused_with_a_ray() {
        let limits = [0.25; 3];
        let Impulses::Infeasible { ray } = least_impulses(&columns(), &[1.0, 1.0], &limits) else {
            panic!("feasible")
        };
        let reach: f64 = (0..3).map(|j| 0.25 * along(&columns(), j, &ray).abs()).sum();
        assert!(ray[0] + ray[1] > reach);
        let (limit, _) = least_limit(&columns(), &[1.0, 1.0]).unwrap();
        assert!((limit - 0.5).abs() < 1e-12);
    }
}
