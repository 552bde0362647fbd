//! Certificates and named infeasibility, from the program and the answer alone.

use nalgebra::DMatrix;

use super::{
    Trajectory,
    relaxation::least_relaxations,
    search::{Found, InfeasibleHorizon, Proof, Search},
    stages::as_f64,
};
use crate::{
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Infeasibility, ProofRow, Relaxation,
    },
    program::{HorizonProgram, Residual, RowFamily, dual_bound, verify},
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
    pub(super) certificate: Certificate,
}

/// Verifies what a search found.
pub(super) fn verify_found(search: &Search<'_, '_>, found: &Found) -> Verified {
    let program = search.stages.program(found.horizon, &found.terminal);
    let minimum_time = search.stages.artifact.is_minimum_time();
    let bound = if minimum_time {
        as_f64(found.horizon)
    } else {
        dual_bound(&program, &found.solution.multipliers).value
    };
    let claim = match found.proof {
        Proof::Global => Claim::Global,
        Proof::ToHorizonMax => Claim::GlobalToHorizonMax,
        Proof::Local => Claim::LocalInHorizon,
        Proof::Fixed => Claim::FixedHorizon,
        Proof::None => Claim::Feasible,
    };
    let inputs = &found.solution.inputs;
    let coefficients = &found.solution.terminal_coefficients;
    let mut verified = verify_inputs(search, &program, inputs, coefficients, claim, Some(bound));
    if minimum_time {
        verified.certificate.cost = as_f64(found.horizon);
        verified.certificate.passed &= verified.certificate.relative_gap() == Some(0.0);
    }
    verified
}

/// Verifies inputs against a program; a claim of optimality needs a bound.
pub(super) fn verify_inputs(
    search: &Search<'_, '_>,
    program: &HorizonProgram<'_>,
    inputs: &[f64],
    coefficients: &[f64],
    claim: Claim,
    lower_bound: Option<f64>,
) -> Verified {
    let residuals = verify(program, inputs, coefficients);
    let (n, m) = (program.states(), program.inputs());
    let trajectory = Trajectory {
        states: DMatrix::from_row_slice(program.horizon + 1, n, &residuals.states),
        inputs: DMatrix::from_row_slice(program.horizon, m, inputs),
    };
    let dynamics_residual = dynamics_residual(search, &trajectory);
    let tightest_input = [residuals.input_bound, residuals.input_row]
        .into_iter()
        .flatten()
        .max_by(|a, b| a.value.total_cmp(&b.value));
    let families = [
        (ConstraintFamily::State, residuals.stage_row),
        (ConstraintFamily::Input, tightest_input),
        (ConstraintFamily::Terminal, Some(residuals.terminal)),
    ];
    let margins: Vec<ConstraintMargin> = families
        .into_iter()
        .filter_map(|(family, residual)| residual.map(|r| margin(family, r)))
        .collect();
    let minimum_time = search.stages.artifact.is_minimum_time();
    let outside_set = residuals.terminal_coefficient.is_some_and(|excess| excess > TOLERANCE);
    let mut certificate = Certificate {
        passed: !outside_set
            && dynamics_residual <= TOLERANCE
            && margins.iter().all(|margin| margin.margin >= -TOLERANCE),
        claim,
        tolerance: TOLERANCE,
        dynamics_residual,
        margins,
        cost: residuals.objective,
        lower_bound,
    };
    let claims_optimum = !matches!(claim, Claim::Feasible | Claim::PreviousPlanTail);
    if claims_optimum && !minimum_time {
        let gap = certificate.relative_gap();
        certificate.passed &= gap.is_some_and(|gap| gap.abs() <= GAP_TOLERANCE);
    }
    Verified { trajectory, certificate }
}

fn margin(family: ConstraintFamily, residual: Residual) -> ConstraintMargin {
    ConstraintMargin { family, stage: residual.stage, row: residual.index, margin: -residual.value }
}

/// max |z_{j+1} - A z_j - B v_j|, with the artifact's matrices and not the solver's tables.
fn dynamics_residual(search: &Search<'_, '_>, trajectory: &Trajectory) -> f64 {
    let model = &search.stages.artifact.model;
    let (states, inputs) = (&trajectory.states, &trajectory.inputs);
    let mut largest = 0.0_f64;
    for j in 0..trajectory.horizon() {
        for i in 0..states.ncols() {
            let free: f64 = (0..states.ncols()).map(|c| model.a[(i, c)] * states[(j, c)]).sum();
            let forced: f64 = (0..inputs.ncols()).map(|c| model.b[(i, c)] * inputs[(j, c)]).sum();
            largest = largest.max((states[(j + 1, i)] - (free + forced)).abs());
        }
    }
    largest
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
