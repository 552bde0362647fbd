//! Rows that one other row makes redundant, within a box.
//!
//! Samples of one constraint are nearly parallel, and differ most in how much room the disturbance
//! leaves them; so most of them lie behind another one wherever the set can be. With a box around
//! the set and a_i = s a_j + r, s >= 0, a_i y <= s + max over the box of r y: that costs one run
//! over a row, where the general test costs a program.

use nalgebra::DMatrix;

use crate::{
    budget::{Budget, Interruption},
    program::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status},
};

/// Weight of |y|^2 against the reach along an axis.
const PULL: f64 = 1e-7;
/// Largest share of a bound that may come from that weight.
const SHARE_MAX: f64 = 0.01;
/// Rows tried as the one in front, those that were lately in front first.
const FRONT_MAX: usize = 192;

/// A box around {y : a_i y <= 1} and the rows that were lately in front of others.
#[derive(Debug)]
pub(super) struct Dominance {
    /// Middle and half width of every side, padded as rows are.
    middle: Vec<f64>,
    half: Vec<f64>,
    front: Vec<Front>,
    padded: Vec<f64>,
}

/// A row that others may lie behind.
#[derive(Debug, Clone, Copy)]
struct Front {
    row: usize,
    /// 1 / |a|^2.
    inverse_square: f64,
}

impl Dominance {
    /// From rows that stay whatever happens; `None` if they do not bound the set.
    ///
    /// The bounds follow from multipliers: e = sum y_j a_j + r gives e'y <= sum y_j + r'y, and
    /// what r contributes is bounded by the box itself.
    pub(super) fn new(kept: &DenseRows, budget: Budget<'_>) -> Result<Option<Self>, Interruption> {
        let n = kept.columns();
        let Ok(cost) = QuadraticCost::new(DMatrix::identity(n, n) * PULL) else {
            return Ok(None);
        };
        let offsets = vec![1.0; kept.len()];
        let mut solver = DualActiveSet::default();
        let (mut reach, mut left_over) = (vec![[0.0; 2]; n], 0.0_f64);
        for axis in 0..n {
            for (side, sign) in [-1.0, 1.0].into_iter().enumerate() {
                let mut gradient = vec![0.0; n];
                gradient[axis] = -sign;
                let program = QuadraticProgram {
                    cost: &cost,
                    gradient: &gradient,
                    rows: kept,
                    offsets: &offsets,
                };
                let solution = solver.solve(&program, &[], budget)?;
                if solution.status != Status::Optimal {
                    return Ok(None);
                }
                // r, from the rows and not from the point.
                let mut rest: Vec<f64> = gradient.iter().map(|g| -g).collect();
                for active in &solution.active {
                    reach[axis][side] += active.multiplier;
                    for (r, a) in rest.iter_mut().zip(kept.normal(active.row)) {
                        *r -= active.multiplier * a;
                    }
                }
                left_over = left_over.max(rest.iter().map(|r| r.abs()).sum());
            }
        }
        if !(left_over < SHARE_MAX) {
            return Ok(None);
        }
        let largest = reach.iter().flatten().fold(0.0_f64, |a, &b| a.max(b));
        let share = left_over * largest / (1.0 - left_over);
        let middle: Vec<f64> = reach.iter().map(|sides| 0.5 * (sides[1] - sides[0])).collect();
        let half: Vec<f64> =
            reach.iter().map(|sides| 0.5 * (sides[1] + sides[0]) + share).collect();
        let mut this =
            Self { middle: Vec::new(), half: Vec::new(), front: Vec::new(), padded: Vec::new() };
        kept.pad(&middle, &mut this.middle);
        kept.pad(&half, &mut this.half);
        Ok(Some(this))
    }

    /// Lets `row`, which is needed, be tried from now on.
    pub(super) fn add(&mut self, rows: &DenseRows, row: usize) {
        let square: f64 = rows.normal(row).iter().map(|a| a * a).sum();
        self.front.truncate(FRONT_MAX - 1);
        self.front.insert(0, Front { row, inverse_square: 1.0 / square });
    }

    /// Largest r y in the box.
    pub(super) fn reach(&self, rest: &[f64]) -> f64 {
        let sides = self.middle.iter().zip(&self.half);
        rest.iter().zip(sides).map(|(r, (middle, half))| r * middle + r.abs() * half).sum()
    }

    /// If `row` lies behind one of the rows in front, everywhere in the box, but for a share of at
    /// most `tolerance`: that share, at least 0.
    pub(super) fn excess(&mut self, rows: &DenseRows, row: usize, tolerance: f64) -> Option<f64> {
        rows.pad(rows.normal(row), &mut self.padded);
        let Self { middle, half, front, padded } = self;
        let found = front.iter().enumerate().find_map(|(place, other)| {
            let scale = rows.product(other.row, padded) * other.inverse_square;
            let bound = scale + rows.reach_of_rest(other.row, scale, padded, (middle, half));
            (scale >= 0.0 && bound <= 1.0 + tolerance).then_some((place, bound - 1.0))
        });
        let (place, excess) = found?;
        front[..=place].rotate_right(1);
        Some(excess.max(0.0))
    }
}
