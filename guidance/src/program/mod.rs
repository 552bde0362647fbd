//! Optimisation programs: what is asked ([`HorizonProgram`]), how ([`Solver`]), what came of it
//! ([`Solution`]), and whether it is true ([`verify`], which trusts no solver).
//!
//! Beside them stand smaller kinds: [`least_impulses`] and, over second-order cones,
//! [`ConeProgram`]; dense quadratic programs with very many rows ([`QuadraticProgram`],
//! [`DualActiveSet`], [`verify_quadratic`]).

mod anchors;
mod clarabel;
mod common_margin;
mod dual_simplex;
mod gauge;
mod impulses;
mod projection;
mod quadratic;
mod regulator;
mod second_order;
mod separation;
mod tables;
mod verify;

pub use clarabel::{Clarabel, RelaxedFamily, least_relaxation};
pub use common_margin::{CommonMargin, MarginAnswer};
pub use dual_simplex::DualSimplex;
pub use gauge::zonotope_gauge;
pub use impulses::{Impulses, impulse_bound, least_impulses, least_limit};
pub use projection::project_onto_polytope;
pub use quadratic::{
    ActiveRow, DenseRows, DualActiveSet, InfeasibilityProof, NotPositiveDefinite, QuadraticCost,
    QuadraticProgram, QuadraticResiduals, QuadraticSolution, prove_infeasible, verify_quadratic,
};
pub(crate) use quadratic::{ActiveSet, Entry};
pub use regulator::{
    CondensedRegulator, RegulatorAnswer, RegulatorProgram, RelaxedRows, Softness, StateCut,
};
pub use second_order::{Affine, ConeProgram, ConeSolution};
pub use separation::{
    PolytopeView, Separation, SeparationOutcome, nearest_point_of_polytope, polytope_is_empty,
    separate_from_ellipsoids, separate_from_polytopes,
};
pub use tables::PlantTables;
pub use verify::{
    DualBound, Residual, Residuals, dual_bound, farkas_contradiction, farkas_margin, simulate,
    verify, verify_trajectory,
};

use crate::budget::{Budget, Interruption};

/// A linear program over the inputs of a linear plant and a fixed horizon N:
///
/// ```text
/// minimise   constant + cost sum_j |v_j|_1 + weight sum_{j <= tracked} |z_j - r_j|_1
/// subject to z_0 = initial, z_{j+1} = A z_j + B v_j
///            lower_j <= v_j <= upper_j                          j = 0 .. N-1
///            input_normals v_j <= input_offsets_j               j = 0 .. N-1
///            stage_normals_j z_j <= stage_offsets_j             j = 1 .. constrained
///            z_N in {centre + generators xi : |xi|_inf <= 1}
/// ```
///
/// All arrays are flat and row by row, the stage outermost; index 0 of stage data is stage 1.
#[derive(Debug, Clone, Copy)]
pub struct HorizonProgram<'a> {
    /// A, B and what follows from them alone.
    pub plant: &'a PlantTables,
    /// z_0, n values.
    pub initial: &'a [f64],
    /// N >= 1.
    pub horizon: usize,
    /// Cost of |input|, >= 0.
    pub input_cost: f64,
    /// N m values.
    pub input_lower: &'a [f64],
    /// N m values.
    pub input_upper: &'a [f64],
    /// q m values, the same for every stage.
    pub input_normals: &'a [f64],
    /// N q values.
    pub input_offsets: &'a [f64],
    /// Rows a stage of `stage_normals`.
    pub stage_rows: usize,
    /// Last stage that carries state constraints.
    pub constrained_stages: usize,
    /// At least `constrained_stages` x `stage_rows` x n values.
    pub stage_normals: &'a [f64],
    /// At least `constrained_stages` x `stage_rows` values.
    pub stage_offsets: &'a [f64],
    /// Weight of tracking, >= 0.
    pub tracking_weight: f64,
    /// Last stage that is tracked.
    pub tracked_stages: usize,
    /// At least `tracked_stages` x n values.
    pub tracking_reference: &'a [f64],
    /// Centre of the terminal set, n values.
    pub terminal_centre: &'a [f64],
    /// p x n values, one generator after the other; empty for a point.
    pub terminal_generators: &'a [f64],
    /// Added to the objective.
    pub constant: f64,
}

/// A row of a [`HorizonProgram`] that can carry a multiplier.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RowId {
    /// Which rows are meant.
    pub family: RowFamily,
    /// Stage j; inputs count from 0, states from 1.
    pub stage: usize,
    /// Row within the stage.
    pub index: usize,
}

/// The families of rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum RowFamily {
    /// stage_normals z <= stage_offsets; multipliers >= 0.
    Stage,
    /// z - r, with multipliers within +- weight.
    Tracking,
    /// input_normals v <= input_offsets; multipliers >= 0.
    Input,
    /// z_N - centre - generators xi = 0; free multipliers.
    Terminal,
}

/// A multiplier of a row: the Lagrangian is objective + sum value (left side - right side).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Multiplier {
    /// Of this row.
    pub row: RowId,
    /// In the row's own scale.
    pub value: f64,
}

/// How a solver ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Optimal to the solver's tolerance.
    Optimal,
    /// Infeasible; the multipliers are a Farkas ray.
    PrimalInfeasible,
    /// The optimum is at least the cut-off; the multipliers prove it.
    CutOff,
    /// Near an optimum, not to tolerance.
    Inaccurate,
    /// The iteration limit was reached.
    BudgetExhausted,
    /// The solver does not trust its own result.
    NumericalFailure,
}

/// What a solver returns. Trust it after [`verify`] only.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// How it ended.
    pub status: Status,
    /// Objective of `inputs`; the bound if cut off; meaningless otherwise.
    pub objective: f64,
    /// N m values if optimal.
    pub inputs: Vec<f64>,
    /// p values if optimal.
    pub terminal_coefficients: Vec<f64>,
    /// Nonzero multipliers, or the ray.
    pub multipliers: Vec<Multiplier>,
    /// Where a later solve can start from; empty if the solver has none.
    pub basis: Basis,
    /// Iterations spent.
    pub iterations: usize,
}

/// A vertex, named so that it can be carried to other horizons and later steps.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Basis {
    /// Rows that hold with equality and carry a free multiplier.
    pub rows: Vec<RowId>,
    /// Inputs strictly between their breakpoints.
    pub columns: Vec<BasicColumn>,
}

/// An input component between two breakpoints of its cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BasicColumn {
    /// Stage of the input, from 0; N for a terminal coefficient.
    pub stage: usize,
    /// Component of the input, or index of the terminal coefficient.
    pub index: usize,
    /// Which segment of its piecewise linear cost, from 0.
    pub segment: usize,
}

impl Basis {
    /// The basis as the next step sees it: every stage one earlier, what falls off dropped.
    #[must_use]
    pub fn shifted(&self) -> Self {
        let rows = self.rows.iter().filter_map(|row| {
            let first = usize::from(row.family != RowFamily::Input);
            (row.stage > first).then(|| RowId { stage: row.stage - 1, ..*row })
        });
        let columns = self.columns.iter().filter(|column| column.stage > 0);
        Self {
            rows: rows.collect(),
            columns: columns.map(|c| BasicColumn { stage: c.stage - 1, ..*c }).collect(),
        }
    }
}

/// A way to solve a [`HorizonProgram`].
pub trait Solver {
    /// Solves `program`, from `start` if the solver can use it, and stops as soon as the optimum
    /// is proved to be at least `cut_off`.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    fn solve(
        &mut self,
        program: &HorizonProgram<'_>,
        start: Option<&Basis>,
        cut_off: Option<f64>,
        budget: Budget<'_>,
    ) -> Result<Solution, Interruption>;
}

impl HorizonProgram<'_> {
    /// State components n.
    #[must_use]
    pub fn states(&self) -> usize {
        self.plant.states()
    }

    /// Input components m.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.plant.inputs()
    }

    /// Input rows q a stage.
    #[must_use]
    pub fn input_rows(&self) -> usize {
        self.input_normals.len() / self.inputs()
    }

    /// Terminal generators p.
    #[must_use]
    pub fn terminal_generator_count(&self) -> usize {
        self.terminal_generators.len() / self.states()
    }

    /// Normal of row `row` at stage `stage` >= 1.
    pub(crate) fn stage_normal(&self, stage: usize, row: usize) -> &[f64] {
        let n = self.states();
        &self.stage_normals[((stage - 1) * self.stage_rows + row) * n..][..n]
    }

    /// Offset of row `row` at stage `stage` >= 1.
    pub(crate) fn stage_offset(&self, stage: usize, row: usize) -> f64 {
        self.stage_offsets[(stage - 1) * self.stage_rows + row]
    }

    /// Reference at stage `stage` >= 1.
    pub(crate) fn reference(&self, stage: usize) -> &[f64] {
        let n = self.states();
        &self.tracking_reference[(stage - 1) * n..][..n]
    }
}
