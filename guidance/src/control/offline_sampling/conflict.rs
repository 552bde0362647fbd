//! Why a step has no answer, and the least that would have to give.

use nalgebra::DMatrix;

use super::{Artifact, step::family};
use crate::{
    budget::Budget,
    control::{ConstraintFamily, Infeasibility, ProofRow, Relaxation, StepError},
    program::{
        ActiveRow, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status,
        prove_infeasible,
    },
};

/// Weight of |d|^2 against the square of the shift: small, so that the shift is the least.
const PULL: f64 = 1e-7;

/// The rows that exclude each other, heaviest first, and for each of their families the least
/// uniform shift that leaves decisions.
pub(super) fn conflict(
    artifact: &Artifact,
    program: &QuadraticProgram<'_>,
    ray: &[ActiveRow],
    budget: Budget<'_>,
) -> Result<Infeasibility, StepError> {
    let weight = |active: &ActiveRow| active.multiplier / program.rows.scale(active.row);
    let sum: f64 = ray.iter().map(weight).sum();
    let mut rows: Vec<ProofRow> = ray
        .iter()
        .map(|active| {
            let (family, stage) = family(artifact.origin(active.row));
            ProofRow { family, stage, row: active.row, weight: weight(active) / sum }
        })
        .collect();
    rows.sort_by(|a, b| b.weight.total_cmp(&a.weight).then(a.row.cmp(&b.row)));
    let mut families: Vec<ConstraintFamily> = rows.iter().map(|row| row.family).collect();
    families.sort_unstable();
    families.dedup();
    let mut relaxations = Vec::new();
    for family in families {
        if let Some(amount) = least_shift(artifact, program, family, budget)? {
            relaxations.push(Relaxation { family, horizon: artifact.problem().horizon, amount });
        }
    }
    let margin = prove_infeasible(program.rows, program.offsets, ray).margin;
    Ok(Infeasibility {
        reason: format!(
            "no corrections satisfy {} rows together; they miss by {margin:.3e}",
            rows.len()
        ),
        horizon: artifact.problem().horizon,
        rows,
        relaxations,
        all_horizons_proved: true,
    })
}

/// Least t for which the rows, those of one family moved outwards by t per unit normal, have a
/// common point; `None` if no shift of this family helps.
fn least_shift(
    artifact: &Artifact,
    program: &QuadraticProgram<'_>,
    shifted: ConstraintFamily,
    budget: Budget<'_>,
) -> Result<Option<f64>, StepError> {
    let width = program.rows.columns();
    let mut rows = DenseRows::new(width + 1);
    let mut normal = vec![0.0; width + 1];
    for row in 0..program.rows.len() {
        normal[..width].copy_from_slice(program.rows.normal(row));
        let moves = family(artifact.origin(row)).0 == shifted;
        normal[width] = if moves { -1.0 / program.rows.scale(row) } else { 0.0 };
        rows.push(&normal);
    }
    let mut hessian = DMatrix::identity(width + 1, width + 1) * PULL;
    hessian[(width, width)] = 1.0;
    let Ok(cost) = QuadraticCost::new(hessian) else { return Ok(None) };
    let gradient = vec![0.0; width + 1];
    let lifted = QuadraticProgram {
        cost: &cost,
        gradient: &gradient,
        rows: &rows,
        offsets: program.offsets,
    };
    let solution = DualActiveSet::default().solve(&lifted, &[], budget)?;
    Ok((solution.status == Status::Optimal).then(|| solution.point[width]))
}
