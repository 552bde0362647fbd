//! One step: the online program, and what is flown where it has no answer.

use nalgebra::DVector;

use super::{Artifact, State};
use crate::{
    budget::Budget,
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Failure, Fault, Infeasibility,
        ProofRow, StepError,
    },
    matrices::times_vector,
    program::{
        ActiveRow, Clarabel, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram,
        QuadraticSolution, Status, prove_infeasible, verify_quadratic,
    },
    reach::{StageFamily, StageGroup},
};

/// Largest violation of a row of unit length that a certificate passes, relative to 1 + |b|.
const TOLERANCE: f64 = 1e-8;

/// What was measured: x, n values, the target at the origin.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// x.
    pub state: DVector<f64>,
}

/// One decided step.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The step this answers, from 0.
    pub index: usize,
    /// The decision.
    pub verdict: Verdict,
    /// To be handed to the next step.
    pub next: State,
    /// The proof; `None` without a command.
    pub certificate: Option<Certificate>,
    /// How it came about.
    pub diagnostics: Diagnostics,
}

/// The decision.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Do this.
    Command(Command),
    /// No corrections satisfy the rows, and there is no plan to fall back on.
    Infeasible(Infeasibility),
}

/// What to do until the next step.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// u = K x + v_0, m values.
    pub input: DVector<f64>,
    /// v_0 .. v_{T-1}.
    pub corrections: Vec<f64>,
    /// The input was moved into the input set: only where the previous plan's tail is flown.
    pub clipped: bool,
}

/// How a step came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnostics {
    /// Whose answer it is.
    pub branch: Branch,
    /// Expected cost z'S z; `None` without a command.
    pub expected_cost: Option<f64>,
    /// Rows that entered or left.
    pub iterations: usize,
    /// Times all rows were looked at.
    pub scans: usize,
    /// The general solver had to decide.
    pub general_solver: bool,
    /// Why there was no optimum, where there was none: rows that exclude each other.
    pub conflict: Option<Infeasibility>,
}

/// Whose answer it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Branch {
    /// The online program's.
    Optimum,
    /// The previous plan's, one step on, with v = 0 at its end. No guarantee.
    PreviousPlanTail,
    /// Nobody's.
    None,
}

pub(super) fn step(
    artifact: &Artifact,
    state: &State,
    measurement: &Measurement,
    budget: Budget<'_>,
) -> Result<Step, StepError> {
    let (n, _) = artifact.problem().dimensions();
    let x = &measurement.state;
    if x.len() != n || !x.iter().all(|x| x.is_finite()) {
        let got = format!("{x:?}");
        return Err(StepError::Measurement(vec![Fault::new(
            "state",
            format!("{n} finite values"),
            got,
        )]));
    }
    let rows = artifact.correction_rows();
    if !state.fits(rows.columns(), rows.len()) {
        return Err(StepError::State("it does not fit this artifact".into()));
    }
    let (gradient, offsets) = artifact.online(x.as_slice());
    let program = QuadraticProgram {
        cost: artifact.quadratic(),
        gradient: &gradient,
        rows,
        offsets: &offsets,
    };
    let (solution, general) = solve(&program, &state.active, budget)?;
    if solution.status == Status::PrimalInfeasible {
        let conflict = conflict(artifact, &program, &solution.active);
        return fall_back(artifact, state, x, &program, (&solution, general), conflict);
    }
    let certificate = certify(artifact, &program, &solution, x, Claim::Global);
    if !certificate.passed {
        return Err(Failure::Numerical("the optimum did not pass its certificate".into()).into());
    }
    let input = input(artifact, x, &solution.point);
    Ok(Step {
        index: state.step,
        next: next(artifact, state, &solution.point, solution.active_rows()),
        diagnostics: Diagnostics {
            branch: Branch::Optimum,
            expected_cost: Some(certificate.cost),
            iterations: solution.iterations,
            scans: solution.scans,
            general_solver: general,
            conflict: None,
        },
        certificate: Some(certificate),
        verdict: Verdict::Command(Command { input, corrections: solution.point, clipped: false }),
    })
}

/// The fast solver, and the general one where it does not trust itself.
fn solve(
    program: &QuadraticProgram<'_>,
    start: &[usize],
    budget: Budget<'_>,
) -> Result<(QuadraticSolution, bool), StepError> {
    let solution = DualActiveSet::default().solve(program, start, budget)?;
    match solution.status {
        Status::Optimal | Status::PrimalInfeasible => return Ok((solution, false)),
        _ => {}
    }
    let general = Clarabel.solve_quadratic(program);
    budget.check()?;
    match general.status {
        Status::Optimal => Ok((general, true)),
        Status::PrimalInfeasible
            if prove_infeasible(program.rows, program.offsets, &general.active).radius > 1e6 =>
        {
            Ok((general, true))
        }
        other => Err(Failure::Numerical(format!("both solvers gave up: {other:?}")).into()),
    }
}

/// u = K x + v_0.
fn input(artifact: &Artifact, x: &DVector<f64>, corrections: &[f64]) -> DVector<f64> {
    let fed_back = times_vector(&artifact.summary().gain, x);
    DVector::from_iterator(fed_back.len(), fed_back.iter().zip(corrections).map(|(k, v)| k + v))
}

/// The corrections one step on, with 0 at the end.
fn next(artifact: &Artifact, state: &State, corrections: &[f64], active: Vec<usize>) -> State {
    let (_, m) = artifact.problem().dimensions();
    let mut tail = corrections[m..].to_vec();
    tail.resize(corrections.len(), 0.0);
    let mut active = active;
    active.truncate(corrections.len());
    State { step: state.step + 1, tail, active }
}

/// Flies the previous plan's tail, clipped into the input set, and says so.
fn fall_back(
    artifact: &Artifact,
    state: &State,
    x: &DVector<f64>,
    program: &QuadraticProgram<'_>,
    (solution, general_solver): (&QuadraticSolution, bool),
    conflict: Infeasibility,
) -> Result<Step, StepError> {
    let mut diagnostics = Diagnostics {
        branch: Branch::None,
        expected_cost: None,
        iterations: solution.iterations,
        scans: solution.scans,
        general_solver,
        conflict: Some(conflict.clone()),
    };
    if state.tail.is_empty() {
        return Ok(Step {
            index: state.step,
            verdict: Verdict::Infeasible(conflict),
            next: state.clone(),
            certificate: None,
            diagnostics,
        });
    }
    let wanted = input(artifact, x, &state.tail);
    let input = nearest_input(artifact, &wanted)?;
    let clipped = (&input - &wanted).amax() > 0.0;
    let mut corrections = state.tail.clone();
    for (v, (u, w)) in corrections.iter_mut().zip(input.iter().zip(wanted.iter())) {
        *v += u - w;
    }
    let flown =
        QuadraticSolution { point: corrections.clone(), active: Vec::new(), ..solution.clone() };
    let certificate = certify(artifact, program, &flown, x, Claim::PreviousPlanTail);
    diagnostics.branch = Branch::PreviousPlanTail;
    diagnostics.expected_cost = Some(certificate.cost);
    Ok(Step {
        index: state.step,
        next: next(artifact, state, &corrections, Vec::new()),
        verdict: Verdict::Command(Command { input, corrections, clipped }),
        certificate: Some(certificate),
        diagnostics,
    })
}

/// The nearest input of the input set; the same one if it is inside.
fn nearest_input(artifact: &Artifact, wanted: &DVector<f64>) -> Result<DVector<f64>, StepError> {
    let set = &artifact.problem().input_set;
    if set.margins(wanted).iter().all(|&margin| margin >= 0.0) {
        return Ok(wanted.clone());
    }
    let cost = QuadraticCost::identity(wanted.len());
    let gradient: Vec<f64> = wanted.iter().map(|u| -u).collect();
    let program = QuadraticProgram {
        cost: &cost,
        gradient: &gradient,
        rows: &DenseRows::from_matrix(set.normals()),
        offsets: set.offsets().as_slice(),
    };
    let solution = DualActiveSet::default().solve(&program, &[], Budget::UNLIMITED)?;
    match solution.status {
        Status::Optimal => Ok(DVector::from_vec(solution.point)),
        other => Err(Failure::Numerical(format!("no nearest input: {other:?}")).into()),
    }
}

/// The worst row of every family, and the gap, from the program alone.
fn certify(
    artifact: &Artifact,
    program: &QuadraticProgram<'_>,
    solution: &QuadraticSolution,
    x: &DVector<f64>,
    claim: Claim,
) -> Certificate {
    let residuals = verify_quadratic(program, solution);
    let mut products = Vec::with_capacity(program.rows.len());
    program.rows.products(&solution.point, &mut products);
    let mut margins: Vec<ConstraintMargin> = Vec::new();
    for (row, product) in products.iter().enumerate() {
        let (family, stage) = family(artifact.origin(row));
        let margin = (program.offsets[row] - product) * program.rows.scale(row);
        match margins.iter_mut().find(|worst| worst.family == family) {
            Some(worst) if margin < worst.margin => {
                *worst = ConstraintMargin { family, stage, row, margin };
            }
            Some(_) => {}
            None => margins.push(ConstraintMargin { family, stage, row, margin }),
        }
    }
    let cost = artifact.expected_cost_at(x.as_slice(), &solution.point);
    let optimal = claim == Claim::Global;
    let proved = residuals.stationarity <= TOLERANCE
        && residuals.least_multiplier >= 0.0
        && residuals.gap <= TOLERANCE;
    Certificate {
        passed: residuals.violation <= TOLERANCE && (!optimal || proved),
        claim,
        tolerance: TOLERANCE,
        // Predictions are rows here, not states with equations of their own.
        dynamics_residual: 0.0,
        margins,
        cost,
        lower_bound: optimal.then(|| cost - residuals.gap * (1.0 + residuals.objective.abs())),
    }
}

/// The rows that exclude each other, heaviest first.
fn conflict(
    artifact: &Artifact,
    program: &QuadraticProgram<'_>,
    ray: &[ActiveRow],
) -> Infeasibility {
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
    let margin = prove_infeasible(program.rows, program.offsets, ray).margin;
    Infeasibility {
        reason: format!(
            "no corrections satisfy {} rows together; they miss by {margin:.3e}",
            rows.len()
        ),
        horizon: artifact.problem().horizon,
        rows,
        relaxations: Vec::new(),
        all_horizons_proved: true,
    }
}

/// The family and stage of a row; the first-step rows bound the state of stage 1.
fn family(origin: Option<StageGroup>) -> (ConstraintFamily, usize) {
    match origin {
        None => (ConstraintFamily::Dynamics, 1),
        Some(StageGroup { family: StageFamily::State, stage }) => (ConstraintFamily::State, stage),
        Some(StageGroup { family: StageFamily::Input, stage }) => (ConstraintFamily::Input, stage),
        Some(StageGroup { family: StageFamily::Terminal, stage }) => {
            (ConstraintFamily::Terminal, stage)
        }
    }
}
