//! Certificates and named infeasibility, from the program and the answer alone.

use nalgebra::DMatrix;

use super::{
    Evidence, Trajectory,
    relaxation::least_relaxations,
    search::{Found, InfeasibleHorizon, Proof, Search},
    stages::{Stages, as_f64},
};
use crate::{
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Infeasibility, ProofRow, Relaxation,
    },
    program::{
        HorizonProgram, Residual, Residuals, RowFamily, dual_bound, simulate, verify_trajectory,
    },
};

/// Largest violation that passes, scaled units, rows of unit length: tens of micrometres.
pub(super) const TOLERANCE: f64 = 1e-9;
/// Largest relative gap that passes for an optimum.
const GAP_TOLERANCE: f64 = 1e-7;

/// Rows of an infeasibility proof that are quoted.
const QUOTED_ROWS: usize = 8;

/// A verified answer.
pub(super) struct Verified {
    pub(super) trajectory: Trajectory,
    pub(super) evidence: Evidence,
    pub(super) certificate: Certificate,
}

/// Verifies what a search found.
pub(super) fn verify_found(search: &Search<'_, '_>, found: &Found) -> Verified {
    let program = search.stages.program(found.horizon, &found.terminal);
    let claim = match found.proof {
        Proof::Global => Claim::Global,
        Proof::ToHorizonMax => Claim::GlobalToHorizonMax,
        Proof::Local => Claim::LocalInHorizon,
        Proof::Fixed => Claim::FixedHorizon,
        Proof::None => Claim::Feasible,
    };
    let evidence = Evidence {
        terminal_coefficients: found.solution.terminal_coefficients.clone(),
        multipliers: found.solution.multipliers.clone(),
    };
    let lower_bound = Some(lower_bound(&search.stages, &program, &evidence));
    let statement = Statement { claim, cost: Some(found.cost), lower_bound };
    verify_inputs(&search.stages, &program, &found.solution.inputs, evidence, statement)
}

/// What the multipliers prove of J at this horizon; N itself for minimum time.
pub(super) fn lower_bound(
    stages: &Stages<'_>,
    program: &HorizonProgram<'_>,
    evidence: &Evidence,
) -> f64 {
    if stages.artifact.is_minimum_time() {
        as_f64(program.horizon)
    } else {
        dual_bound(program, &evidence.multipliers).value
    }
}

/// Verifies the trajectory that inputs lead to.
pub(super) fn verify_inputs(
    stages: &Stages<'_>,
    program: &HorizonProgram<'_>,
    inputs: &[f64],
    evidence: Evidence,
    statement: Statement,
) -> Verified {
    let (n, m) = (program.states(), program.inputs());
    let trajectory = Trajectory {
        states: DMatrix::from_row_slice(program.horizon + 1, n, &simulate(program, inputs)),
        inputs: DMatrix::from_row_slice(program.horizon, m, inputs),
    };
    let certificate = certificate(stages, program, &trajectory, &evidence, statement);
    Verified { trajectory, evidence, certificate }
}

/// What is said of a trajectory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Statement {
    pub(super) claim: Claim,
    /// The stated J; `None` where nothing was stated before.
    pub(super) cost: Option<f64>,
    /// Proved lower bound on J; a claim of optimality needs one.
    pub(super) lower_bound: Option<f64>,
}

/// The certificate of a trajectory that nobody vouches for: every state is taken as it stands
/// and compared with what the plant makes of its predecessor.
///
/// The one place where certificates are made; [`super::verify_step`] comes here too.
pub(super) fn certificate(
    stages: &Stages<'_>,
    program: &HorizonProgram<'_>,
    trajectory: &Trajectory,
    evidence: &Evidence,
    statement: Statement,
) -> Certificate {
    let Statement { claim, cost: stated_cost, lower_bound } = statement;
    if !is_of_shape(trajectory, program) {
        return refused(claim);
    }
    let states = row_by_row(&trajectory.states);
    let inputs = row_by_row(&trajectory.inputs);
    let residuals = verify_trajectory(program, &states, &inputs, &evidence.terminal_coefficients);
    let margins = margins(&residuals);
    let dynamics_residual = dynamics_residual(stages, program.initial, &states, &inputs);
    let minimum_time = stages.artifact.is_minimum_time();
    let cost = if minimum_time { as_f64(program.horizon) } else { residuals.objective };
    let generators = program.terminal_generator_count();
    let in_set = evidence.terminal_coefficients.len() == generators
        && residuals.terminal_coefficient.is_none_or(|excess| excess <= TOLERANCE);
    let mut certificate = Certificate {
        passed: false,
        claim,
        tolerance: TOLERANCE,
        dynamics_residual,
        margins,
        cost,
        lower_bound,
    };
    let near = |gap: f64| gap.abs() <= GAP_TOLERANCE;
    let cost_holds = stated_cost.is_none_or(|stated| near((stated - cost) / (1.0 + cost.abs())));
    let claims_optimum = !matches!(claim, Claim::Feasible | Claim::PreviousPlanTail);
    let gap_closed = !claims_optimum || certificate.relative_gap().is_some_and(near);
    certificate.passed = in_set
        && cost_holds
        && gap_closed
        && dynamics_residual <= TOLERANCE
        && certificate.margins.iter().all(|margin| margin.margin >= -TOLERANCE);
    certificate
}

/// The certificate of what is not even a trajectory of its problem.
pub(super) fn refused(claim: Claim) -> Certificate {
    Certificate {
        passed: false,
        claim,
        tolerance: TOLERANCE,
        dynamics_residual: f64::INFINITY,
        margins: Vec::new(),
        cost: f64::INFINITY,
        lower_bound: None,
    }
}

fn is_of_shape(trajectory: &Trajectory, program: &HorizonProgram<'_>) -> bool {
    trajectory.states.shape() == (program.horizon + 1, program.states())
        && trajectory.inputs.shape() == (program.horizon, program.inputs())
        && is_finite(trajectory)
}

/// Comparisons and maxima overlook what is not a number.
pub(super) fn is_finite(trajectory: &Trajectory) -> bool {
    trajectory.states.iter().chain(trajectory.inputs.iter()).all(|x| x.is_finite())
}

pub(super) fn row_by_row(matrix: &DMatrix<f64>) -> Vec<f64> {
    let columns = matrix.ncols();
    (0..matrix.len()).map(|i| matrix[(i / columns, i % columns)]).collect()
}

/// The tightest row of each family that there is.
fn margins(residuals: &Residuals) -> Vec<ConstraintMargin> {
    let tightest_input = [residuals.input_bound, residuals.input_row]
        .into_iter()
        .flatten()
        .max_by(|a, b| a.value.total_cmp(&b.value));
    let families = [
        (ConstraintFamily::State, residuals.stage_row),
        (ConstraintFamily::Input, tightest_input),
        (ConstraintFamily::Terminal, Some(residuals.terminal)),
    ];
    families
        .into_iter()
        .filter_map(|(family, residual)| residual.map(|r| margin(family, r)))
        .collect()
}

fn margin(family: ConstraintFamily, residual: Residual) -> ConstraintMargin {
    ConstraintMargin { family, stage: residual.stage, row: residual.index, margin: -residual.value }
}

/// max |z_0 - x| and |z_{j+1} - A z_j - B v_j|, with the artifact's own matrices.
fn dynamics_residual(stages: &Stages<'_>, initial: &[f64], states: &[f64], inputs: &[f64]) -> f64 {
    let model = &stages.artifact.model;
    let (n, m) = (model.a.nrows(), model.b.ncols());
    let differences =
        |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let mut worst = differences(&states[..n], initial);
    let mut next = vec![0.0; n];
    for (j, v) in inputs.chunks_exact(m).enumerate() {
        let (z, reached) = (&states[j * n..][..n], &states[(j + 1) * n..][..n]);
        let columns = model.a.as_slice().chunks_exact(n).chain(model.b.as_slice().chunks_exact(n));
        next.fill(0.0);
        for (column, weight) in columns.zip(z.iter().chain(v)) {
            next.iter_mut().zip(column).for_each(|(next, entry)| *next += entry * weight);
        }
        worst = worst.max(differences(&next, reached));
    }
    worst
}

/// Why the measured state itself is refused, if it is. Checked once, at the mission's start:
/// later the guarantee covers it.
pub(super) fn initial_state_fault(search: &Search<'_, '_>) -> Option<Infeasibility> {
    let margins = search.stages.present_margins();
    let (row, margin) = margins
        .into_iter()
        .enumerate()
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .filter(|&(_, margin)| margin < -TOLERANCE)?;
    Some(Infeasibility {
        reason: format!(
            "the state at the mission's start lies outside the state constraints: \
             row {row} is violated by {:.6e} (scaled units)",
            -margin
        ),
        horizon: 0,
        rows: vec![ProofRow { family: ConstraintFamily::InitialState, stage: 0, row, weight: 1.0 }],
        relaxations: vec![Relaxation {
            family: ConstraintFamily::InitialState,
            horizon: 0,
            amount: -margin,
        }],
        all_horizons_proved: true,
    })
}

/// Why no horizon up to `limit` is feasible.
pub(super) fn name_infeasibility(search: &mut Search<'_, '_>, limit: usize) -> Infeasibility {
    if limit == 0 {
        return empty_inputs(search);
    }
    let relaxations = least_relaxations(search, limit);
    let Some(proved) = search.infeasible.clone() else {
        return Infeasibility {
            reason: "no horizon was tried".into(),
            horizon: 0,
            rows: Vec::new(),
            relaxations,
            all_horizons_proved: false,
        };
    };
    let rows = proof_rows(search, &proved);
    let heaviest = rows.first().map_or_else(
        || "the tightened state set is empty at its end".to_owned(),
        |row| match row.family {
            ConstraintFamily::Terminal => "the terminal point cannot be reached in time".to_owned(),
            ConstraintFamily::Input => {
                format!("the inputs at stage {} are too weak", row.stage)
            }
            _ => format!("the state constraint {} at stage {} is in the way", row.row, row.stage),
        },
    );
    Infeasibility {
        reason: format!(
            "no horizon up to {limit} is feasible; at horizon {}: {heaviest}",
            proved.horizon
        ),
        horizon: proved.horizon,
        rows,
        relaxations,
        all_horizons_proved: true,
    }
}

fn empty_inputs(search: &Search<'_, '_>) -> Infeasibility {
    let empty = search.stages.artifact.horizon_usable == 0;
    let (reason, family) = if empty {
        (
            "the tube takes more than the whole input at the first stage",
            ConstraintFamily::EmptyInputSet,
        )
    } else {
        ("the reference ends at this step", ConstraintFamily::Terminal)
    };
    Infeasibility {
        reason: reason.into(),
        horizon: 1,
        rows: vec![ProofRow { family, stage: 0, row: 0, weight: 1.0 }],
        relaxations: Vec::new(),
        all_horizons_proved: true,
    }
}

/// Shares of a Farkas proof: what each multiplier adds to the contradiction, over all of them.
fn proof_rows(search: &Search<'_, '_>, proved: &InfeasibleHorizon) -> Vec<ProofRow> {
    let (Some(ray), Some(terminal)) = (&proved.ray, &proved.terminal) else {
        return vec![ProofRow {
            family: ConstraintFamily::EmptyStateSet,
            stage: proved.horizon,
            row: 0,
            weight: 1.0,
        }];
    };
    let program = search.stages.program(proved.horizon, terminal);
    let reach = |stage: usize| program.plant.reach(stage);
    let mut rows: Vec<ProofRow> = ray
        .iter()
        .map(|multiplier| {
            let row = multiplier.row;
            // In units of the input, so that positions and velocities compare.
            let (family, effect) = match row.family {
                RowFamily::Stage => {
                    let normal = program.stage_normal(row.stage, row.index);
                    let sum = normal.iter().zip(reach(row.stage)).map(|(h, r)| h.abs() * r).sum();
                    (ConstraintFamily::State, sum)
                }
                RowFamily::Input => (ConstraintFamily::Input, 1.0),
                RowFamily::Tracking => (ConstraintFamily::Dynamics, 0.0),
                RowFamily::Terminal => (ConstraintFamily::Terminal, reach(row.stage)[row.index]),
            };
            let weight = multiplier.value.abs() * effect;
            ProofRow { family, stage: row.stage, row: row.index, weight }
        })
        .collect();
    let total: f64 = rows.iter().map(|row| row.weight).sum();
    if total > 0.0 {
        rows.iter_mut().for_each(|row| row.weight /= total);
    }
    rows.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    rows.truncate(QUOTED_ROWS);
    rows.retain(|row| row.weight > 1e-6);
    rows
}
