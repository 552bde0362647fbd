//! Extreme points of what is left of a set of rows, against all of them.

use nalgebra::DMatrix;

use super::{HalfSpaces, InteriorPoint};
use crate::{
    budget::{Budget, Interruption},
    program::{DualActiveSet, QuadraticCost, QuadraticProgram, Status},
};

/// Weight of |y|^2 against the reach along a row: small, so that the point is an extreme one.
const PULL: f64 = 1e-6;

/// What was found at extreme points.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ExtremeCheck {
    /// Points at which every row was looked at.
    pub points: usize,
    /// Largest a_i y - 1 of any row there, y measured from the inner point in units of the row's
    /// distance from it; 0 if none is violated.
    pub excess: f64,
}

impl ExtremeCheck {
    /// Both together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self { points: self.points + other.points, excess: self.excess.max(other.excess) }
    }
}

/// Looks at every row of `all` at points of `kept` that lie as far out as any along `points` rows
/// of `all`, spread evenly over them: a row that was removed wrongly is found where it cuts.
///
/// `kept` may be empty only if `all` is; `about` lies inside of both. Where a row reaches without
/// end the search finds no point, and the row counts as violated without end.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub fn check_extremes(
    kept: &HalfSpaces,
    all: &HalfSpaces,
    about: &InteriorPoint,
    points: usize,
    budget: Budget<'_>,
) -> Result<ExtremeCheck, Interruption> {
    let n = all.dimension();
    let mut check = ExtremeCheck::default();
    let Ok(cost) = QuadraticCost::new(DMatrix::identity(n, n) * PULL) else { return Ok(check) };
    let mut rooms = Vec::new();
    all.rows().products_within(&about.point, &mut rooms, budget)?;
    rooms.iter_mut().zip(all.offsets()).for_each(|(room, b)| *room = b - *room);
    let mut at_centre = Vec::new();
    kept.rows().products(&about.point, &mut at_centre);
    let offsets: Vec<f64> = kept.offsets().iter().zip(&at_centre).map(|(b, at)| b - at).collect();
    let mut solver = DualActiveSet::default();
    let mut products = Vec::new();
    for point in 0..points.min(all.len()) {
        let row = point * all.len() / points.min(all.len());
        let gradient: Vec<f64> = all.normal(row).iter().map(|a| -a / rooms[row]).collect();
        let program = QuadraticProgram {
            cost: &cost,
            gradient: &gradient,
            rows: kept.rows(),
            offsets: &offsets,
        };
        let solution = solver.solve(&program, &[], budget)?;
        if solution.status != Status::Optimal {
            continue;
        }
        check.points += 1;
        all.rows().products_within(&solution.point, &mut products, budget)?;
        for (product, room) in products.iter().zip(&rooms) {
            check.excess = check.excess.max(product / room - 1.0);
        }
    }
    Ok(check)
}
