//! What a step or a plan answers.

use nalgebra::{DMatrix, DVector, Vector3};

use super::State;
use crate::{
    control::{Certificate, Infeasibility},
    frames::RelativeState,
    program::Multiplier,
    units::{Acceleration, Force, Seconds},
};

/// What was measured, and when.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// The state.
    pub state: MeasuredState,
    /// Time since the mission's start; must equal the step's time, where the plant has one, or be
    /// a whole number of steps later: then those in between were missed.
    pub elapsed: Option<Seconds>,
}

/// The measured state, in the plant's border units.
#[derive(Debug, Clone, PartialEq)]
pub enum MeasuredState {
    /// Of a chaser, in RTN.
    Relative(RelativeState),
    /// Of a general linear plant, n values.
    Linear(DVector<f64>),
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
    /// The nominal trajectory ahead; `None` without a command.
    pub trajectory: Option<Trajectory>,
    /// The proof; `None` without a command.
    pub certificate: Option<Certificate>,
    /// What the proof needs besides the trajectory; `None` without a command.
    pub evidence: Option<Evidence>,
    /// What acted since the previous step; `None` at step 0.
    pub disturbance: Option<RealisedDisturbance>,
    /// How it came about.
    pub diagnostics: Diagnostics,
}

/// The decision.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Do this.
    Command(Command),
    /// The mission is complete.
    Arrived(Arrival),
    /// No command satisfies the problem.
    Infeasible(Infeasibility),
}

/// What to do until the next step.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// Start since the mission's start; 0 for a plant without a sample time.
    pub elapsed: Seconds,
    /// How long the input is held.
    pub duration: Option<Seconds>,
    /// Scaled input, m values.
    pub input: DVector<f64>,
    /// Acceleration along RTN; `None` for a general linear plant.
    pub acceleration: Option<[Acceleration; 3]>,
    /// Force along RTN, if the mass is known.
    pub force: Option<[Force; 3]>,
    /// The next step answers with an arrival.
    pub last: bool,
}

/// The mission is complete.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// Number of commands given, T_c.
    pub completion_steps: usize,
    /// Distance from the capture point, metres; `None` for a general linear plant.
    pub distance_m: Option<f64>,
    /// |x - r|_2, scaled.
    pub deviation_norm: f64,
    /// x lies in the terminal point plus S(N_q), the set that the method guarantees.
    pub inside_guaranteed_set: bool,
}

/// A nominal trajectory z_0 .. z_N under v_0 .. v_{N-1}, scaled.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// (N + 1) x n.
    pub states: DMatrix<f64>,
    /// N x m.
    pub inputs: DMatrix<f64>,
}

impl Trajectory {
    /// Number N of inputs.
    #[must_use]
    pub fn horizon(&self) -> usize {
        self.inputs.nrows()
    }
}

/// What a certificate needs besides the trajectory, so that whoever holds an answer can make it
/// again without a solver.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Evidence {
    /// xi with z_N = centre + generators xi; empty for a terminal point.
    pub terminal_coefficients: Vec<f64>,
    /// Multipliers that prove the lower bound on the cost; empty if none is claimed or if it was
    /// proved at step 0.
    pub multipliers: Vec<Multiplier>,
}

/// The disturbance since the previous step.
#[derive(Debug, Clone, PartialEq)]
pub struct RealisedDisturbance {
    /// w = x(k) - A x(k-1) - B u(k-1), scaled; after m missed steps x(k) less the state that the
    /// planned inputs lead to from the last measurement.
    pub components: DVector<f64>,
    /// Least t with the projection of w on the span of the generators in t W; `None` if W = {0}.
    /// After m missed steps W + A W + ... + A^m W takes the place of W.
    pub gauge: Option<f64>,
    /// Norm of the part of w outside that span.
    pub residual_norm: f64,
    /// w is not in that set: some disturbance left W, and the guarantee is void from here on.
    pub outside_assumed_set: bool,
    /// Steps over which it acted: 1, or m + 1 after m missed steps.
    pub steps: usize,
    /// The last answer's guarantee does not reach over these steps. The same as
    /// `outside_assumed_set`, unless steps were missed: then nothing held the deviation in the
    /// tube, and although W was kept it can lie outside S(m + 1). What was promised of feasibility
    /// and decrease ends; if this answer gives a command, it promises the same anew. Tube feedback
    /// makes no new plan: there the promise stays lost.
    pub outside_guaranteed_tube: bool,
}

/// How a step came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnostics {
    /// Which problem gave the command.
    pub branch: Branch,
    /// J of the answer.
    pub cost: f64,
    /// N of the answer: commands left, this one included.
    pub horizon: usize,
    /// J and N of the problem with the terminal point, if feasible.
    pub point: Option<(f64, usize)>,
    /// Step q at which the terminal point was last adapted.
    pub adapted_step: usize,
    /// Horizon at step q.
    pub adapted_horizon: usize,
    /// Exponents i of the sets A_K^i W in the terminal set.
    pub terminal_set_powers: Vec<usize>,
    /// Terminal point, or centre of the terminal set, scaled.
    pub terminal_centre: DVector<f64>,
    /// Horizons tried, in order.
    pub trials: Vec<Trial>,
    /// Pivots of the dual simplex.
    pub simplex_pivots: usize,
    /// Programs handed to the general solver because the simplex reported trouble.
    pub general_solver_calls: usize,
    /// Required decrease of the cost, for each step.
    pub lambda: f64,
    /// Steps before this one for which no measurement came: their commands were taken to be those
    /// that the last answer planned.
    pub missed_steps: usize,
}

/// Which problem gave the command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Branch {
    /// Terminal point.
    TerminalPoint,
    /// Grown terminal set.
    TerminalSet,
    /// Tube feedback around the plan of step 0.
    TubeFeedback,
    /// Tail of the previous plan.
    PreviousPlanTail,
    /// No command: arrived or infeasible.
    None,
}

/// One horizon that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trial {
    /// N.
    pub horizon: usize,
    /// What came of it.
    pub outcome: TrialOutcome,
}

/// What came of a horizon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrialOutcome {
    /// Solved: its cost J.
    Optimal(f64),
    /// Proved infeasible.
    Infeasible,
    /// Proved no better than the best so far: a lower bound on its J.
    CutOff(f64),
}

/// Commands that need no further optimisation.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// One command a step, nominal.
    pub commands: Vec<Command>,
    /// The nominal trajectory.
    pub trajectory: Trajectory,
    /// Where the true state can be under tube feedback; `None` for an open-loop plan.
    pub tube: Option<Tube>,
    /// The proof.
    pub certificate: Certificate,
    /// How it came about.
    pub diagnostics: Diagnostics,
}

/// S(0) .. S(N) around a plan, scaled.
#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    /// (N + 1) x n: half widths of the box around S(j).
    pub half_widths: DMatrix<f64>,
    /// Generators of S(N), n x p.
    pub final_generators: DMatrix<f64>,
}

/// A plan, or why there is none.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "one is made a call and never stored in bulk")]
pub enum PlanOutcome {
    /// The plan.
    Plan(Plan),
    /// Why there is none.
    Infeasible(Infeasibility),
}

/// A trajectory of a chaser in SI units, RTN.
#[derive(Debug, Clone, PartialEq)]
pub struct PhysicalTrajectory {
    /// N + 1 positions, metres.
    pub positions_m: Vec<Vector3<f64>>,
    /// N + 1 velocities, metres per second.
    pub velocities_m_s: Vec<Vector3<f64>>,
    /// N accelerations, metres per second squared.
    pub accelerations_m_s2: Vec<Vector3<f64>>,
}
