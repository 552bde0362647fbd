//! Rows that one other row makes redundant, within a box.
//!
//! Samples of one constraint are nearly parallel, so most of them lie behind another one wherever
//! the set can be: with a box around the set, a_i y <= a_j y + max over the box of (a_i - a_j) y
//! costs one run over a row, where the general test costs a program.

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
const FRONT_MAX: usize = 24;

/// A box around {y : a_i y <= 1} and the rows that were lately in front of others.
#[derive(Debug)]
pub(super) struct Dominance {
    low: Vec<f64>,
    high: Vec<f64>,
    front: Vec<usize>,
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
        Ok(Some(Self {
            low: reach.iter().map(|sides| -(sides[0] + share)).collect(),
            high: reach.iter().map(|sides| sides[1] + share).collect(),
            front: Vec::new(),
        }))
    }

    /// Lets `row`, which is needed, be tried from now on.
    pub(super) fn add(&mut self, row: usize) {
        self.front.truncate(FRONT_MAX - 1);
        self.front.insert(0, row);
    }

    /// Is `row` behind one of the rows in front, everywhere in the box?
    pub(super) fn dominated(&mut self, rows: &DenseRows, row: usize) -> bool {
        let normal = rows.normal(row);
        let place = self.front.iter().position(|&other| {
            let mut largest = 0.0;
            let bounds = self.low.iter().zip(&self.high);
            for ((a, b), (low, high)) in normal.iter().zip(rows.normal(other)).zip(bounds) {
                let difference = a - b;
                largest += (difference * low).max(difference * high);
            }
            largest <= 0.0
        });
        if let Some(place) = place {
            self.front[..=place].rotate_right(1);
        }
        place.is_some()
    }
}
