//! Finding burns and gains: in closed form if that can be proved best, else by cones.

use nalgebra::{DMatrix, Vector3};

use super::{
    Gain, Origin, Plan, Problem,
    conic::{self, Draft},
    model::LinearModel,
};
use crate::{
    budget::{Budget, Interruption},
    control::{
        ConstraintFamily, Failure, Fault, Infeasibility, PrepareError, ProofRow, Relaxation,
    },
    matrices::{least_answer, product},
    program::{Impulses, least_impulses},
};

/// A limit this much (relative) below the least one is still enough: rounding of both.
const LIMIT_ROUNDING: f64 = 1e-9;
/// The fast path answers if its gap is below this: what is left is rounding, not fuel.
const GAP_OF_FAST_PATH: f64 = 1e-9;

/// A row is overdrawn beyond this share of the limit: less is the conic solver's own rounding,
/// which the linear program for the burns takes out.
const OVERDRAWN: f64 = 1e-7;

/// A plan, and whether there was time for all of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Designed {
    /// The plan, certified either way.
    pub plan: Plan,
    /// The deadline came before the search ended: with more time there would be a better plan, so
    /// this is not what the problem's artifact is.
    pub is_cut_short: bool,
}

/// Computes a plan, or the best there is when the deadline comes.
///
/// # Errors
/// As [`super::plan`].
pub fn design(problem: &Problem, budget: Budget<'_>) -> Result<Designed, PrepareError> {
    budget.check()?;
    let model = LinearModel::of(problem)?;
    reachable(problem, &model)?;
    budget.check()?;
    let quick = Origin { fast_path: true, conic_iterations: 0 };
    let patient = budget.beyond_deadline();
    if let Some(draft) = closed_form(&model, patient)?
        && let Some(plan) = finished(problem, draft, quick, patient)?
        && plan.outcome().certificate.relative_gap <= GAP_OF_FAST_PATH
    {
        return Ok(Designed { plan, is_cut_short: false });
    }
    let mut search = ConicSearch { drafts: Vec::new(), iterations: 0 };
    let failed = match search.run(problem, &model, budget) {
        Ok(plan) => return Ok(Designed { plan, is_cut_short: false }),
        Err(Failure::Interrupted(Interruption::Cancelled)) => {
            return Err(Failure::Interrupted(Interruption::Cancelled).into());
        }
        Err(failure) => failure,
    };
    // Out of time, or defeated by numbers: a plan that is certified but not proved best still
    // flies, and its certificate says how far from best it can be.
    let is_cut_short = matches!(failed, Failure::Interrupted(_));
    let best = search.best_repaired(problem, &model, patient)?.ok_or(failed)?;
    Ok(Designed { plan: best, is_cut_short })
}

/// The general way: ever more rows rationed until the answer respects every limit.
struct ConicSearch {
    /// Where programs ended that gave no plan.
    drafts: Vec<Draft>,
    iterations: usize,
}

impl ConicSearch {
    fn run(
        &mut self,
        problem: &Problem,
        model: &LinearModel,
        budget: Budget<'_>,
    ) -> Result<Plan, Failure> {
        let patient = budget.beyond_deadline();
        let gains = closed_form_gains(model, &vec![1.0; 3 * model.burns()], patient)?;
        let burns = cheapest_burns(model, &[]).unwrap_or_default();
        let mut scarce = vec![false; 3 * model.burns()];
        let first = Draft { burns, gains };
        let mut overdrawn = overdrawn_rows(model, &first);
        self.drafts.push(first);
        while !overdrawn.is_empty() {
            overdrawn.iter().for_each(|&row| scarce[row] = true);
            let relaxed = conic::solve(model, problem.effort_weight, &scarce, budget)?;
            self.iterations += relaxed.iterations;
            let Some(draft) = relaxed.draft else { break };
            overdrawn = overdrawn_rows(model, &draft);
            overdrawn.retain(|&row| !scarce[row]);
            let done = overdrawn.is_empty() && relaxed.solved;
            self.drafts.push(draft.clone());
            if done {
                let plan = match weakened(model, &draft.gains, patient)? {
                    Some(draft) => finished(problem, draft, self.origin(), patient)?,
                    None => None,
                };
                let failed = || Failure::Numerical("a plan failed its certificate".into());
                return plan.ok_or_else(failed);
            }
        }
        Err(Failure::Numerical("the conic program was not solved".into()))
    }

    fn origin(&self) -> Origin {
        Origin { fast_path: false, conic_iterations: self.iterations }
    }

    /// The cheapest plan that weaker gains of any draft give. Gains of 0 always give one.
    fn best_repaired(
        &self,
        problem: &Problem,
        model: &LinearModel,
        budget: Budget<'_>,
    ) -> Result<Option<Plan>, Interruption> {
        let mut plans = Vec::new();
        for draft in &self.drafts {
            if let Some(draft) = weakened(model, &draft.gains, budget)? {
                plans.extend(finished(problem, draft, self.origin(), budget)?);
            }
        }
        let by_objective =
            |a: &Plan, b: &Plan| a.outcome().objective.total_cmp(&b.outcome().objective);
        Ok(plans.into_iter().min_by(by_objective))
    }
}

/// Thrust rows (3 burn + axis) whose burn and corrections together exceed the limit.
fn overdrawn_rows(model: &LinearModel, draft: &Draft) -> Vec<usize> {
    let room = rooms(model, &draft.gains);
    let burns: Vec<f64> = draft.burns.iter().flat_map(|burn| burn.data.0[0]).collect();
    let over = |&row: &usize| burns[row].abs() > room[row] + OVERDRAWN * model.limit;
    (0..burns.len()).filter(over).collect()
}

/// `gains` with the cheapest burns beside them, or the largest share of the gains for which there
/// are any: a conic solver's gains may want a hair more than there is.
fn weakened(
    model: &LinearModel,
    gains: &[Gain],
    budget: Budget<'_>,
) -> Result<Option<Draft>, Interruption> {
    let scaled = |share: f64| -> Vec<Gain> {
        gains.iter().map(|gain| Gain { matrix: &gain.matrix * share, ..gain.clone() }).collect()
    };
    if let Some(burns) = cheapest_burns(model, gains) {
        return Ok(Some(Draft { burns, gains: gains.to_vec() }));
    }
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..30 {
        budget.check()?;
        let middle = 0.5 * (low + high);
        if cheapest_burns(model, &scaled(middle)).is_some() {
            low = middle;
        } else {
            high = middle;
        }
    }
    let gains = scaled(low);
    Ok(cheapest_burns(model, &gains).map(|burns| Draft { burns, gains }))
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
fn closed_form(model: &LinearModel, budget: Budget<'_>) -> Result<Option<Draft>, Interruption> {
    let even = vec![1.0; 3 * model.burns()];
    let first = closed_form_gains(model, &even, budget)?;
    if let Some(burns) = cheapest_burns(model, &first) {
        return Ok(Some(Draft { burns, gains: first }));
    }
    budget.check()?;
    let Some(nominal) = cheapest_burns(model, &[]) else { return Ok(None) };
    let spare: Vec<f64> = nominal
        .iter()
        .flat_map(|burn| burn.map(|v| (1.0 - v.abs() / model.limit).max(0.0)).data.0[0])
        .collect();
    let gains = closed_form_gains(model, &spare, budget)?;
    Ok(cheapest_burns(model, &gains).map(|burns| Draft { burns, gains }))
}

/// L_ki of all later burns k: the least (weighted) answer that leaves nothing of H G_i P_i within
/// their range, -D (R_i D)^+ H G_i P_i with R_i the map of those burns and D the `weights`.
fn closed_form_gains(
    model: &LinearModel,
    weights: &[f64],
    budget: Budget<'_>,
) -> Result<Vec<Gain>, Interruption> {
    let mut gains = Vec::new();
    for i in 0..model.burns() {
        budget.check()?;
        let mut answers = model.answers(i);
        let weights = &weights[3 * (i + 1)..];
        for (column, weight) in weights.iter().enumerate() {
            answers.column_mut(column).scale_mut(*weight);
        }
        let answer = least_answer(&answers, &model.unanswered(i));
        let answer = DMatrix::from_fn(weights.len(), 6, |r, c| -weights[r] * answer[(r, c)]);
        gains.extend(conic::gains_of(model, i, &answer));
    }
    gains.sort_by_key(|gain: &Gain| (gain.burn, gain.disturbance));
    Ok(gains)
}

/// The cheapest burns that leave room for the corrections of `gains`; `None` if there are none.
fn cheapest_burns(model: &LinearModel, gains: &[Gain]) -> Option<Vec<Vector3<f64>>> {
    let limits = rooms(model, gains);
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

/// What the corrections of `gains` leave of the limit, one a thrust row.
fn rooms(model: &LinearModel, gains: &[Gain]) -> Vec<f64> {
    let mut rooms = vec![model.limit; 3 * model.burns()];
    for gain in gains {
        let correction = product(&gain.matrix, model.disturbances[gain.disturbance].root());
        for axis in 0..3 {
            rooms[3 * gain.burn + axis] -=
                correction.row(axis).iter().map(|x| x * x).sum::<f64>().sqrt();
        }
    }
    rooms
}

/// The plan, if it passes its certificate.
fn finished(
    problem: &Problem,
    draft: Draft,
    origin: Origin,
    budget: Budget<'_>,
) -> Result<Option<Plan>, Interruption> {
    let Draft { burns, gains } = draft;
    match Plan::from_burns_and_gains_within(problem.clone(), burns, gains, origin, budget) {
        Ok(plan) => Ok(Some(plan)),
        Err(PrepareError::Failure(Failure::Interrupted(why))) => Err(why),
        Err(_) => Ok(None),
    }
}
