//! Projections of polytopes along coordinates.

use super::{EXACT, HalfSpaces, NoInterior, irredundant};
use crate::budget::Budget;

/// Rows that an elimination may make before redundant ones are removed.
const PAIRS_MAX: usize = 400_000;

/// Why no projection was made.
#[derive(Debug, Clone, PartialEq)]
pub enum EliminationError {
    /// The polytope has no interior.
    NoInterior(NoInterior),
    /// More pairs of rows than are considered.
    TooManyPairs(usize),
}

impl From<NoInterior> for EliminationError {
    fn from(reason: NoInterior) -> Self {
        Self::NoInterior(reason)
    }
}

/// {x : there is u with (x, u) in the polytope}, for the last `eliminated` coordinates u: exact,
/// by the method of Fourier and Motzkin with redundant rows removed after every coordinate.
///
/// # Errors
/// [`EliminationError`].
pub fn project_out_last(
    polytope: &HalfSpaces,
    eliminated: usize,
    budget: Budget<'_>,
) -> Result<HalfSpaces, EliminationError> {
    let mut rows = reduced(polytope, budget)?;
    for _ in 0..eliminated {
        rows = reduced(&eliminate_one(&rows, budget)?, budget)?;
    }
    Ok(rows)
}

fn reduced(rows: &HalfSpaces, budget: Budget<'_>) -> Result<HalfSpaces, EliminationError> {
    let none = HalfSpaces::new(rows.dimension());
    let kept = irredundant(rows, &none, EXACT, budget)?.kept;
    Ok(rows.select(&kept))
}

/// Every pair of rows that bound the last coordinate from both sides, added so that it cancels.
fn eliminate_one(rows: &HalfSpaces, budget: Budget<'_>) -> Result<HalfSpaces, EliminationError> {
    let n = rows.dimension() - 1;
    let last = |row: usize| rows.normal(row)[n] * rows.rows().scale(row);
    // A coordinate that is rounding against the rest of its row does not bound.
    let (mut upper, mut lower) = (Vec::new(), Vec::new());
    let mut projected = HalfSpaces::new(n);
    for row in 0..rows.len() {
        match last(row) {
            a if a > 1e-13 => upper.push(row),
            a if a < -1e-13 => lower.push(row),
            _ => projected.push(&rows.normal(row)[..n], rows.offset(row)),
        }
    }
    let pairs = upper.len().saturating_mul(lower.len());
    if pairs > PAIRS_MAX {
        return Err(EliminationError::TooManyPairs(pairs));
    }
    let mut normal = vec![0.0; n];
    for &above in &upper {
        budget.check().map_err(NoInterior::from)?;
        for &below in &lower {
            // Weights that make the last coordinates +1 and -1.
            let (w, v) = (1.0 / rows.normal(above)[n], -1.0 / rows.normal(below)[n]);
            for (sum, (a, b)) in
                normal.iter_mut().zip(rows.normal(above).iter().zip(rows.normal(below)))
            {
                *sum = w * a + v * b;
            }
            let offset = w * rows.offset(above) + v * rows.offset(below);
            let size = normal.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
            let parts = (w / rows.rows().scale(above)).max(v / rows.rows().scale(below));
            if size > 1e-13 * parts {
                projected.push(&normal.iter().map(|a| a / size).collect::<Vec<_>>(), offset / size);
            } else if offset < 0.0 {
                // Two opposite rows without a gap between them: nothing is left.
                projected.push(&vec![0.0; n], offset / parts);
            }
        }
    }
    Ok(projected)
}
