//! Finding burns and gains: in closed form if that can be proved best, else by cones.

use nalgebra::{DMatrix, Vector3};

use super::{
    Gain, Origin, Plan, Problem,
    conic::{self, Draft},
    model::LinearModel,
    outcome::GAP_CLOSED,
};
use crate::{
    budget::Budget,
    control::{
        ConstraintFamily, Failure, Fault, Infeasibility, PrepareError, ProofRow, Relaxation,
    },
    matrices::{product, pseudo_inverse, solve_lower_right},
    program::{Impulses, least_impulses},
};

/// A limit this much (relative) below the least one is still enough: rounding of both.
const LIMIT_ROUNDING: f64 = 1e-9;
/// The fast path answers if its gap is below this: what is left is rounding, not fuel.
const GAP_OF_FAST_PATH: f64 = 1e-9;

/// Computes a plan; see [`super::plan`].
///
/// # Errors
/// [`PrepareError`].
pub(super) fn design(problem: &Problem, budget: Budget<'_>) -> Result<Plan, PrepareError> {
    budget.check()?;
    let model = LinearModel::of(problem)?;
    reachable(problem, &model)?;
    budget.check()?;
    let quick = closed_form(&model).and_then(|draft| finished(problem, draft, 0));
    let quick = match quick {
        Some(plan) if plan.outcome().certificate.relative_gap <= GAP_OF_FAST_PATH => {
            return Ok(plan);
        }
        other => other,
    };
    let (draft, iterations) = conic::solve(&model, problem.effort_weight, budget)?;
    let careful =
        draft.and_then(|draft| finished(problem, with_cheapest_burns(&model, draft), iterations));
    // Both passed their certificates; the cheaper is the answer.
    match (quick, careful) {
        (Some(a), Some(b)) if a.outcome().objective <= b.outcome().objective => Ok(a),
        (_, Some(plan)) => Ok(plan),
        (Some(plan), None) if plan.outcome().certificate.relative_gap <= GAP_CLOSED => Ok(plan),
        (_, None) => Err(Failure::Numerical("no plan passed its certificate".into()).into()),
    }
}

/// Fails with a fault if no impulses reach the target state, or with the least limit if the
/// problem's is too low. Gains of 0 cost no margin, so this is a matter of the burns alone.
fn reachable(problem: &Problem, model: &LinearModel) -> Result<(), PrepareError> {
    if !model.is_reachable() {
        return Err(PrepareError::Faults(vec![singular_grid(model)]));
    }
    let Some((least, ray)) = model.least_limit() else {
        return Err(Failure::Numerical("the least impulse was not found".into()).into());
    };
    if problem.delta_v_max_m_s >= least * (1.0 - LIMIT_ROUNDING) {
        return Ok(());
    }
    Err(PrepareError::Infeasible(infeasibility(model, least, &ray)))
}

fn singular_grid(model: &LinearModel) -> Fault {
    let (share, dimension) = model.unreachable_share();
    let burns = model.burns();
    let turn = |k: usize| model.anomalies[k].degrees() - model.anomalies[0].degrees();
    let turns: Vec<String> = (0..=burns).map(|k| format!("{:.3}", turn(k))).collect();
    Fault::new(
        "instants",
        "burns from which impulses of some size reach the target state: at least two, and not \
         all half a revolution apart",
        format!(
            "singular: {burns} burns reach {dimension} of 6 dimensions and {:.3e} of the way \
             stays out of reach; instants at {} deg",
            share,
            turns.join(", ")
        ),
    )
}

fn infeasibility(model: &LinearModel, least: f64, ray: &[f64]) -> Infeasibility {
    let map = model.burn_map();
    let weight = |j: usize| (0..6).map(|i| map[(i, j)] * ray[i]).sum::<f64>().abs();
    let total: f64 = (0..map.ncols()).map(weight).sum();
    let mut rows: Vec<ProofRow> = (0..map.ncols())
        .map(|j| ProofRow {
            family: ConstraintFamily::Input,
            stage: j / 3,
            row: j % 3,
            weight: weight(j) / total,
        })
        .filter(|row| row.weight > 1e-9)
        .collect();
    rows.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    Infeasibility {
        reason: format!(
            "no burns within delta_v_max_m_s = {} reach the target state at the last instant; the \
             least limit that does is {least:.9} m/s",
            model.limit
        ),
        horizon: model.burns(),
        rows,
        relaxations: vec![Relaxation {
            family: ConstraintFamily::Input,
            horizon: model.burns(),
            amount: least / model.limit - 1.0,
        }],
        all_horizons_proved: true,
    }
}

/// Gains in closed form and the cheapest burns beside them, if there are any: first the gains of
/// least effort, then those that spare the burns which the nominal plan needs.
fn closed_form(model: &LinearModel) -> Option<Draft> {
    let even = vec![1.0; 3 * model.burns()];
    let first = closed_form_gains(model, &even);
    if let Some(burns) = cheapest_burns(model, &first) {
        return Some(Draft { burns, gains: first });
    }
    let nominal = cheapest_burns(model, &[])?;
    let spare: Vec<f64> = nominal
        .iter()
        .flat_map(|burn| burn.map(|v| (1.0 - v.abs() / model.limit).max(0.0)).data.0[0])
        .collect();
    let gains = closed_form_gains(model, &spare);
    let burns = cheapest_burns(model, &gains)?;
    Some(Draft { burns, gains })
}

/// L_ki of all later burns k: the least (weighted) answer that leaves nothing of H G_i P_i within
/// their range, -D (R_i D)^+ H G_i P_i with R_i the map of those burns and D the `weights`.
fn closed_form_gains(model: &LinearModel, weights: &[f64]) -> Vec<Gain> {
    let mut gains = Vec::new();
    for i in 0..model.burns() {
        let mut answers = model.answers(i);
        let weights = &weights[3 * (i + 1)..];
        for (column, weight) in weights.iter().enumerate() {
            answers.column_mut(column).scale_mut(*weight);
        }
        let (inverse, _) = pseudo_inverse(&answers);
        let answer = product(&inverse, &model.unanswered(i));
        for k in i + 1..model.burns() {
            let first = 3 * (k - i - 1);
            let scaled =
                DMatrix::from_fn(3, 6, |r, c| -weights[first + r] * answer[(first + r, c)]);
            let matrix = solve_lower_right(&scaled, model.disturbances[i].root());
            gains.push(Gain { burn: k, disturbance: i, matrix });
        }
    }
    gains.sort_by_key(|gain| (gain.burn, gain.disturbance));
    gains
}

/// The cheapest burns that leave room for the corrections of `gains`; `None` if there are none.
fn cheapest_burns(model: &LinearModel, gains: &[Gain]) -> Option<Vec<Vector3<f64>>> {
    let mut limits = vec![model.limit; 3 * model.burns()];
    for gain in gains {
        let correction = product(&gain.matrix, model.disturbances[gain.disturbance].root());
        for axis in 0..3 {
            limits[3 * gain.burn + axis] -=
                correction.row(axis).iter().map(|x| x * x).sum::<f64>().sqrt();
        }
    }
    if limits.iter().any(|limit| !(*limit >= 0.0)) {
        return None;
    }
    match least_impulses(&model.burn_map(), model.shortfall().as_slice(), &limits) {
        Impulses::Optimal { impulses, .. } => {
            Some(impulses.chunks_exact(3).map(Vector3::from_column_slice).collect())
        }
        Impulses::Infeasible { .. } | Impulses::Stalled => None,
    }
}

/// The conic solver's gains with burns from the exact linear program, where that has a solution.
fn with_cheapest_burns(model: &LinearModel, draft: Draft) -> Draft {
    match cheapest_burns(model, &draft.gains) {
        Some(burns) => Draft { burns, ..draft },
        None => draft,
    }
}

/// The plan, if it passes its certificate.
fn finished(problem: &Problem, draft: Draft, conic_iterations: usize) -> Option<Plan> {
    let origin = Origin { fast_path: conic_iterations == 0, conic_iterations };
    Plan::from_burns_and_gains(problem.clone(), draft.burns, draft.gains, origin).ok()
}
