//! One step: the online program, and what is flown where it has no answer.

use nalgebra::DVector;

use super::{Artifact, RowOrigin, Scheme, State, conflict::conflict};
use crate::{
    budget::{Budget, Interruption},
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Failure, Fault, Infeasibility,
        StepError,
    },
    matrices::times_vector,
    program::{
        Clarabel, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, QuadraticSolution,
        Status, prove_infeasible, verify_quadratic,
    },
    reach::{StageFamily, StageGroup},
    units::Seconds,
};

/// Largest violation of a row of unit length that a certificate passes, relative to 1 + |b|.
const TOLERANCE: f64 = 1e-8;

/// A measurement must be this near to a step's time, as a share of the sample time.
const EPOCH_TOLERANCE: f64 = 1e-3;

/// What was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// x, n values, the target at the origin.
    pub state: DVector<f64>,
    /// Time since the mission's start: that of the step that the controller state is for, or a
    /// whole number of steps later, then those in between were missed. Needs a plant with a
    /// sample time.
    pub elapsed: Option<Seconds>,
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
    /// z_0, the nominal state whose tube the state is in; with [`Scheme::TubeRobust`] only.
    pub nominal: Option<DVector<f64>>,
    /// x_0 .. x_T of the expected plant under u_l = K x_l + v_l.
    pub expected_states: Vec<DVector<f64>>,
    /// u_0 .. u_{T-1} of the same.
    pub expected_inputs: Vec<DVector<f64>>,
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
    /// Steps for which no measurement came since the last answer.
    pub missed_steps: usize,
    /// Why there was no optimum, where there was none: rows that exclude each other.
    pub conflict: Option<Infeasibility>,
}

/// Whose answer it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Branch {
    /// The online program's; the certificate says whether it is proved to be the best.
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
    let present = Present::new(artifact, state, measurement)?;
    let (gradient, offsets) = artifact.online(present.x.as_slice());
    let program = QuadraticProgram {
        cost: artifact.quadratic(),
        gradient: &gradient,
        rows: artifact.decision_rows(),
        offsets: &offsets,
    };
    let (solution, general) = match solve(&program, &state.active, budget) {
        Ok(solved) => solved,
        Err(Failure::Interrupted(Interruption::Cancelled)) => {
            return Err(Interruption::Cancelled.into());
        }
        Err(failure) => return present.undecided(&program, failure),
    };
    let diagnostics = Diagnostics {
        branch: Branch::None,
        expected_cost: None,
        iterations: solution.iterations,
        scans: solution.scans,
        general_solver: general,
        missed_steps: present.missed,
        conflict: None,
    };
    if solution.status == Status::PrimalInfeasible {
        return present.fall_back(&program, &solution, diagnostics, budget);
    }
    // Where answers end multipliers grow without bound, and rounding takes the proof of optimality
    // with it: what satisfies every row is a command still, and claims no more.
    let passed = |claim| {
        let certificate = certify(artifact, &program, &solution, present.x, claim);
        certificate.passed.then_some(certificate)
    };
    let Some(certificate) = passed(Claim::Global).or_else(|| passed(Claim::Feasible)) else {
        let failure = Failure::Numerical("the optimum did not pass its certificate".into());
        return present.undecided(&program, failure);
    };
    let command = present.command(&solution.point, false);
    Ok(Step {
        index: present.step,
        next: present.next(&command, solution.active_rows()),
        diagnostics: Diagnostics {
            branch: Branch::Optimum,
            expected_cost: Some(certificate.cost),
            ..diagnostics
        },
        certificate: Some(certificate),
        verdict: Verdict::Command(command),
    })
}

/// The step to be decided.
struct Present<'a> {
    artifact: &'a Artifact,
    step: usize,
    missed: usize,
    x: &'a DVector<f64>,
    /// Decisions of the previous plan for this step; `None` at the start.
    tail: Option<Vec<f64>>,
}

impl<'a> Present<'a> {
    /// Checks state and measurement against the artifact, and catches up on missed steps.
    fn new(
        artifact: &'a Artifact,
        state: &State,
        measurement: &'a Measurement,
    ) -> Result<Self, StepError> {
        let problem = artifact.problem();
        let (n, m) = problem.dimensions();
        let nominal = if problem.scheme == Scheme::TubeRobust { n } else { 0 };
        if !state.fits(problem.horizon * m, nominal, artifact.rows().len()) {
            return Err(StepError::State("it does not fit this artifact".into()));
        }
        let x = &measurement.state;
        let mut faults = Vec::new();
        if x.len() != n || !x.iter().all(|x| x.is_finite()) {
            faults.push(Fault::new("state", format!("{n} finite values"), format!("{x:?}")));
        }
        let missed = missed_steps(problem.sample_time_s(), state.step, measurement.elapsed);
        let missed = missed.map_err(|fault| faults.push(fault));
        let (true, Ok(missed)) = (faults.is_empty(), missed) else {
            return Err(StepError::Measurement(faults));
        };
        let commands_left = problem.horizon - 1;
        if missed > commands_left && state.step > 0 {
            return Err(StepError::PlanExhausted { missed, commands_left });
        }
        let tail = (state.step > 0).then(|| tail(artifact, state, missed, x));
        Ok(Self { artifact, step: state.step.saturating_add(missed), missed, x, tail })
    }

    /// The command of decisions d.
    fn command(&self, decisions: &[f64], clipped: bool) -> Command {
        let (n, m) = self.artifact.problem().dimensions();
        let (corrections, place) = decisions.split_at(self.artifact.problem().horizon * m);
        let (mut states, mut inputs) = (vec![self.x.clone()], Vec::new());
        for v in corrections.chunks_exact(m) {
            let input = input(self.artifact, &states[inputs.len()], v);
            states.push(self.artifact.expected_step(&states[inputs.len()], &input));
            inputs.push(input);
        }
        Command {
            input: inputs[0].clone(),
            corrections: corrections.to_vec(),
            clipped,
            nominal: (place.len() == n).then(|| self.x - DVector::from_column_slice(place)),
            expected_states: states,
            expected_inputs: inputs,
        }
    }

    /// What the next step starts from: the plan one step on, with v = 0 at its end.
    fn next(&self, command: &Command, mut active: Vec<usize>) -> State {
        let (_, m) = self.artifact.problem().dimensions();
        let (first, rest) = command.corrections.split_at(m);
        let mut tail = rest.to_vec();
        tail.resize(command.corrections.len(), 0.0);
        let nominal = command.nominal.as_ref().map_or_else(Vec::new, |z| {
            let input = input(self.artifact, z, first);
            self.artifact.expected_step(z, &input).as_slice().to_vec()
        });
        active.truncate(tail.len() + nominal.len());
        State { step: self.step + 1, tail, nominal, active }
    }

    /// No corrections satisfy the rows: the previous plan's tail, if there is one.
    fn fall_back(
        &self,
        program: &QuadraticProgram<'_>,
        solution: &QuadraticSolution,
        diagnostics: Diagnostics,
        budget: Budget<'_>,
    ) -> Result<Step, StepError> {
        let conflict = conflict(self.artifact, program, &solution.active, budget);
        if let (Err(StepError::Failure(failure @ Failure::Numerical(_))), Some(_)) =
            (&conflict, &self.tail)
        {
            return self.undecided(program, failure.clone());
        }
        let conflict = conflict?;
        let diagnostics = Diagnostics { conflict: Some(conflict.clone()), ..diagnostics };
        match &self.tail {
            Some(tail) => self.fly_tail(tail, program, diagnostics),
            None => Ok(Step {
                index: self.step,
                verdict: Verdict::Infeasible(conflict),
                next: State::START,
                certificate: None,
                diagnostics,
            }),
        }
    }

    /// The time was over before the program was solved, or no solver could tell whether it has an
    /// answer, as can be where the last one ends: the previous plan's tail is still an answer, and
    /// says that it is no more than that.
    fn undecided(
        &self,
        program: &QuadraticProgram<'_>,
        failure: Failure,
    ) -> Result<Step, StepError> {
        let Some(tail) = &self.tail else { return Err(failure.into()) };
        let diagnostics = Diagnostics {
            branch: Branch::None,
            expected_cost: None,
            iterations: 0,
            scans: 0,
            general_solver: matches!(failure, Failure::Numerical(_)),
            missed_steps: self.missed,
            conflict: None,
        };
        self.fly_tail(tail, program, diagnostics)
    }

    /// Flies the previous plan's tail, clipped into the input set, and says so.
    fn fly_tail(
        &self,
        tail: &[f64],
        program: &QuadraticProgram<'_>,
        diagnostics: Diagnostics,
    ) -> Result<Step, StepError> {
        let artifact = self.artifact;
        let wanted = input(artifact, self.x, tail);
        let input = nearest_input(artifact, &wanted)?;
        let clipped = (&input - &wanted).amax() > 0.0;
        let mut decisions = tail.to_vec();
        for (v, (u, w)) in decisions.iter_mut().zip(input.iter().zip(wanted.iter())) {
            *v += u - w;
        }
        let flown = QuadraticSolution {
            status: Status::BudgetExhausted,
            point: decisions.clone(),
            // Nothing looks at it: a tail claims no optimum.
            objective: f64::NAN,
            active: Vec::new(),
            iterations: 0,
            scans: 0,
        };
        let certificate = certify(artifact, program, &flown, self.x, Claim::PreviousPlanTail);
        let diagnostics = Diagnostics {
            branch: Branch::PreviousPlanTail,
            expected_cost: Some(certificate.cost),
            ..diagnostics
        };
        let command = Command { input, ..self.command(&decisions, clipped) };
        Ok(Step {
            index: self.step,
            next: self.next(&command, Vec::new()),
            verdict: Verdict::Command(command),
            certificate: Some(certificate),
            diagnostics,
        })
    }
}

/// How many steps after the one that was expected.
fn missed_steps(
    sample_time_s: Option<f64>,
    step: usize,
    elapsed: Option<Seconds>,
) -> Result<usize, Fault> {
    let Some(elapsed) = elapsed else { return Ok(0) };
    let got = format!("{}", elapsed.seconds());
    let Some(sample_time) = sample_time_s else {
        return Err(Fault::new("elapsed_s", "none, because the plant has no sample time", got));
    };
    let late = elapsed.seconds() / sample_time - step as f64;
    let whole = libm::round(late);
    if (0.0..1e9).contains(&whole) && (late - whole).abs() <= EPOCH_TOLERANCE {
        return Ok(whole as usize);
    }
    let expected = format!("{} or a whole number of steps later", step as f64 * sample_time);
    Err(Fault::new("elapsed_s", expected, got))
}

/// Decisions of the last plan, `missed` steps on, for the present state.
fn tail(artifact: &Artifact, state: &State, missed: usize, x: &DVector<f64>) -> Vec<f64> {
    let (_, m) = artifact.problem().dimensions();
    let mut nominal = DVector::from_column_slice(&state.nominal);
    if !nominal.is_empty() {
        for v in state.tail.chunks_exact(m).take(missed) {
            let input = input(artifact, &nominal, v);
            nominal = artifact.expected_step(&nominal, &input);
        }
    }
    let mut decisions = state.tail[missed * m..].to_vec();
    decisions.resize(state.tail.len(), 0.0);
    decisions.extend(x.iter().zip(nominal.iter()).map(|(x, z)| x - z));
    decisions
}

/// The fast solver, and the general one where it does not trust itself.
fn solve(
    program: &QuadraticProgram<'_>,
    start: &[usize],
    budget: Budget<'_>,
) -> Result<(QuadraticSolution, bool), Failure> {
    let solution = DualActiveSet::default().solve(program, start, budget)?;
    match solution.status {
        Status::Optimal | Status::PrimalInfeasible => return Ok((solution, false)),
        _ => {}
    }
    let general = Clarabel.solve_quadratic(program, budget)?;
    match general.status {
        Status::Optimal => Ok((general, true)),
        Status::PrimalInfeasible
            if prove_infeasible(program.rows, program.offsets, &general.active).radius > 1e6 =>
        {
            Ok((general, true))
        }
        other => Err(Failure::Numerical(format!("both solvers gave up: {other:?}"))),
    }
}

/// u = K x + v.
fn input(artifact: &Artifact, x: &DVector<f64>, corrections: &[f64]) -> DVector<f64> {
    let fed_back = times_vector(&artifact.summary().gain, x);
    DVector::from_iterator(fed_back.len(), fed_back.iter().zip(corrections).map(|(k, v)| k + v))
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

/// The family and stage of a row; the first-step rows bound the state of stage 1.
pub(super) fn family(origin: RowOrigin) -> (ConstraintFamily, usize) {
    match origin {
        RowOrigin::FirstStep => (ConstraintFamily::FirstStep, 1),
        RowOrigin::Tube => (ConstraintFamily::Tube, 0),
        RowOrigin::Stage(StageGroup { family, stage }) => (
            match family {
                StageFamily::State => ConstraintFamily::State,
                StageFamily::Input => ConstraintFamily::Input,
                StageFamily::Terminal => ConstraintFamily::Terminal,
            },
            stage,
        ),
    }
}
