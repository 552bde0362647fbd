//! What an answer is worth, recomputed from the program alone: no factor of a solver is used.

use super::{ActiveRow, DenseRows, QuadraticProgram, QuadraticSolution};
use crate::budget::{Budget, Interruption};

/// How far a point and its multipliers are from the conditions of optimality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QuadraticResiduals {
    /// z'Hz / 2 + g'z.
    pub objective: f64,
    /// Largest entry of Hz + g + A'y, relative to the largest of its terms.
    pub stationarity: f64,
    /// Largest a_i z - b_i per unit normal, relative to 1 + |b_i| / |a_i|; negative is margin.
    pub violation: f64,
    /// The row of that violation.
    pub worst_row: Option<usize>,
    /// Least multiplier; 0 without any.
    pub least_multiplier: f64,
    /// Sum of y_i |a_i z - b_i|, relative to 1 + |objective|: the duality gap, since the rest of
    /// it vanishes with the stationarity.
    pub gap: f64,
}

/// Recomputes every condition.
#[must_use]
pub fn verify_quadratic(
    program: &QuadraticProgram<'_>,
    solution: &QuadraticSolution,
) -> QuadraticResiduals {
    verify_quadratic_within(program, solution, Budget::UNLIMITED)
        .expect("this budget never interrupts")
}

/// The same, if there is time.
pub(super) fn verify_quadratic_within(
    program: &QuadraticProgram<'_>,
    solution: &QuadraticSolution,
    budget: Budget<'_>,
) -> Result<QuadraticResiduals, Interruption> {
    let point = &solution.point;
    let mut products = Vec::with_capacity(program.rows.len());
    program.rows.products_within(point, &mut products, budget)?;
    let mut worst = (f64::NEG_INFINITY, None);
    for (row, product) in products.iter().enumerate() {
        let (offset, scale) = (program.offsets[row], program.rows.scale(row));
        let violation = (product - offset) * scale / (1.0 + offset.abs() * scale);
        if !(violation <= worst.0) {
            worst = (violation, Some(row));
        }
    }
    let mut gradient = times_hessian(program, point);
    let mut size = 1.0_f64;
    for (sum, g) in gradient.iter_mut().zip(program.gradient) {
        size = size.max(sum.abs()).max(g.abs());
        *sum += g;
    }
    let (mut least, mut gap) = (0.0_f64, 0.0);
    for active in &solution.active {
        for (sum, a) in gradient.iter_mut().zip(program.rows.normal(active.row)) {
            *sum += active.multiplier * a;
            size = size.max((active.multiplier * a).abs());
        }
        least = least.min(active.multiplier);
        gap += active.multiplier * (products[active.row] - program.offsets[active.row]).abs();
    }
    let objective = objective(program, point);
    Ok(QuadraticResiduals {
        objective,
        stationarity: gradient.iter().fold(0.0_f64, |a, x| a.max(x.abs())) / size,
        violation: worst.0,
        worst_row: worst.1,
        least_multiplier: least,
        gap: gap / (1.0 + objective.abs()),
    })
}

/// What a ray y >= 0 proves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InfeasibilityProof {
    /// -b'y with y scaled to sum |a_i| y_i = 1: by how much the rows miss each other; a proof
    /// needs it positive.
    pub margin: f64,
    /// No point with a norm below this satisfies all rows: margin / |A'y|; infinite if exact.
    pub radius: f64,
}

/// Evaluates a Farkas ray: y'A = 0 and y'b < 0 leave no point.
#[must_use]
pub fn prove_infeasible(
    rows: &DenseRows,
    offsets: &[f64],
    ray: &[ActiveRow],
) -> InfeasibilityProof {
    let mut combination = vec![0.0; rows.columns()];
    let (mut weight, mut right) = (0.0, 0.0);
    for active in ray {
        let value = active.multiplier.max(0.0);
        weight += value / rows.scale(active.row);
        right += value * offsets[active.row];
        for (sum, a) in combination.iter_mut().zip(rows.normal(active.row)) {
            *sum += value * a;
        }
    }
    if !(weight > 0.0 && right < 0.0) {
        return InfeasibilityProof { margin: 0.0, radius: 0.0 };
    }
    let residual = combination.iter().map(|x| x * x).sum::<f64>().sqrt();
    let radius = if residual > 0.0 { -right / residual } else { f64::INFINITY };
    InfeasibilityProof { margin: -right / weight, radius }
}

/// z'Hz / 2 + g'z.
pub(super) fn objective(program: &QuadraticProgram<'_>, point: &[f64]) -> f64 {
    let product = times_hessian(program, point);
    let terms = point.iter().zip(product.iter().zip(program.gradient));
    terms.map(|(z, (h, g))| z * (0.5 * h + g)).sum()
}

/// Hz, column by column: memory is read straight, and each component is still summed in order.
fn times_hessian(program: &QuadraticProgram<'_>, point: &[f64]) -> Vec<f64> {
    let n = point.len();
    let mut product = vec![0.0; n];
    let columns = program.cost.hessian().as_slice().chunks_exact(n.max(1));
    for (column, z) in columns.zip(point) {
        product.iter_mut().zip(column).for_each(|(sum, h)| *sum += h * z);
    }
    product
}
