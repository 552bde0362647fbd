//! Words every method answers with: certificates and named infeasibility.

/// Which constraint of a problem is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ConstraintFamily {
    /// Dynamics of the nominal trajectory.
    Dynamics,
    /// State constraints along the trajectory, tightened.
    State,
    /// Input bounds, tightened.
    Input,
    /// The terminal point or set.
    Terminal,
    /// The measured state itself lies outside the state constraints.
    InitialState,
    /// The tightened input set is empty.
    EmptyInputSet,
    /// The tightened state set is empty.
    EmptyStateSet,
    /// The set in which the state must lie after one step, so that every later step has an answer.
    FirstStep,
    /// The invariant tube around the nominal trajectory, in which the state must lie.
    Tube,
}

/// What an answer claims about its cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// Least over all horizons.
    Global,
    /// Least over all horizons up to the longest considered.
    GlobalToHorizonMax,
    /// Exact at its horizon, no better at the neighbouring ones.
    LocalInHorizon,
    /// Exact for a prescribed horizon.
    FixedHorizon,
    /// Certified feasible, not proved optimal.
    Feasible,
    /// The previous certified plan's tail.
    PreviousPlanTail,
}

/// Recomputed from the answer alone, by code that shares nothing with the solvers.
#[derive(Debug, Clone, PartialEq)]
pub struct Certificate {
    /// Every violation within `tolerance`, and the gap closed if the claim needs it.
    pub passed: bool,
    /// What the answer claims.
    pub claim: Claim,
    /// Largest violation allowed, scaled units, rows of unit length.
    pub tolerance: f64,
    /// Largest residual of the nominal dynamics, scaled.
    pub dynamics_residual: f64,
    /// Tightest row of each family.
    pub margins: Vec<ConstraintMargin>,
    /// Cost recomputed from the trajectory.
    pub cost: f64,
    /// Lower bound on the cost at this horizon, recomputed from the multipliers.
    pub lower_bound: Option<f64>,
}

impl Certificate {
    /// (cost - lower bound) / (1 + |cost|), if there is a bound.
    #[must_use]
    pub fn relative_gap(&self) -> Option<f64> {
        self.lower_bound.map(|bound| (self.cost - bound) / (1.0 + self.cost.abs()))
    }
}

/// The tightest row of a family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConstraintMargin {
    /// Which family.
    pub family: ConstraintFamily,
    /// Steps ahead of the present one.
    pub stage: usize,
    /// Row within the family at that stage.
    pub row: usize,
    /// Right side minus left side, scaled units, rows of unit length.
    pub margin: f64,
}

/// No command satisfies the problem.
#[derive(Debug, Clone, PartialEq)]
pub struct Infeasibility {
    /// One sentence.
    pub reason: String,
    /// The horizon whose proof is quoted.
    pub horizon: usize,
    /// The rows that carry the proof, heaviest first; weights sum to at most 1.
    pub rows: Vec<ProofRow>,
    /// Least relaxations found, one a family that can help.
    pub relaxations: Vec<Relaxation>,
    /// Every horizon up to the longest was proved infeasible.
    pub all_horizons_proved: bool,
}

/// One row of an infeasibility proof.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProofRow {
    /// Which family.
    pub family: ConstraintFamily,
    /// Steps ahead of the present one.
    pub stage: usize,
    /// Row within the family at that stage.
    pub row: usize,
    /// Share of the proof, 0 to 1.
    pub weight: f64,
}

/// The smallest change to one family, all others kept, that makes the problem feasible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Relaxation {
    /// Which family.
    pub family: ConstraintFamily,
    /// The horizon at which it is least among those examined.
    pub horizon: usize,
    /// Uniform shift of every row of the family, scaled units, rows of unit length.
    pub amount: f64,
}
