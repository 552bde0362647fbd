//! Sets that a plant with uncertain matrices and bounded disturbance never has to leave.

use nalgebra::{DMatrix, DVector};

use super::{
    EXACT, HalfSpaces, NoInterior, elimination::EliminationError, irredundant, project_out_last,
};
use crate::{
    budget::{Budget, Interruption},
    sets::ConvexSet,
};

/// One vertex of an uncertain plant, x+ = A x + B u + w with w in its own image of the
/// disturbance set.
pub struct PlantVertex<'a> {
    /// A, n x n.
    pub a: DMatrix<f64>,
    /// B, n x m; m = 0 for a closed loop.
    pub b: DMatrix<f64>,
    /// B_w W.
    pub disturbance: &'a dyn ConvexSet,
}

/// How far an iteration may go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InvariantLimits {
    /// Steps back.
    pub iterations_max: usize,
    /// Rows after redundant ones are removed.
    pub rows_max: usize,
}

/// How the search for a set ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Invariant {
    /// Found, and proved by a last step back that cuts off no more than `excess`.
    Found {
        /// The set, without redundant rows.
        set: HalfSpaces,
        /// Steps back until nothing was cut off any more.
        iterations: usize,
        /// The step back cuts off at most this share of the distance to the set's inner point.
        excess: f64,
    },
    /// Proved: no such set exists in the constraints, or none with an interior.
    Empty {
        /// The step back at which nothing was left.
        iterations: usize,
        /// What was left.
        reason: NoInterior,
    },
    /// The limits were reached: neither found nor excluded.
    Undecided {
        /// Steps taken.
        iterations: usize,
        /// Rows of the last set, an outer one.
        rows: usize,
    },
    /// Stopped from outside.
    Interrupted(Interruption),
}

/// A step back that cuts off less than this share counts as none where convergence is only
/// asymptotic.
const CONVERGED: f64 = 1e-8;

/// The largest set in `constraints` that x+ = A_j x + w stays in for every vertex j and every w.
/// [Mammarella2019, assumption 3]
///
/// Rows of steps back are added until all of the next ones are redundant.
#[must_use]
pub fn max_robust_positive_invariant(
    constraints: &HalfSpaces,
    vertices: &[PlantVertex<'_>],
    limits: InvariantLimits,
    budget: Budget<'_>,
) -> Invariant {
    let back = |set: &HalfSpaces, budget: Budget<'_>| {
        step_back(set, vertices, budget).map_err(|why| NoInterior::from(why).into())
    };
    let found = max_invariant(constraints, limits, budget, back);
    found.unwrap_or_else(Invariant::from_end)
}

/// The largest set of states in `constraints` (rows over x and u) from which some u keeps the
/// state in the set for every vertex and every w. [Mammarella2019, eq. 14 ff.]
///
/// `constraints` are over n + m coordinates; each step back projects the inputs out exactly, so
/// this is for few inputs. `state_constraints` are over x alone.
#[must_use]
pub fn max_robust_control_invariant(
    constraints: &HalfSpaces,
    state_constraints: &HalfSpaces,
    vertices: &[PlantVertex<'_>],
    limits: InvariantLimits,
    budget: Budget<'_>,
) -> Invariant {
    let inputs = vertices.first().map_or(0, |vertex| vertex.b.ncols());
    let start = project_out_last(constraints, inputs, budget).map(|mut rows| {
        rows.extend(state_constraints);
        rows
    });
    let start = match start {
        Ok(start) => start,
        Err(error) => return Invariant::from_end(End::from(error)),
    };
    let back = |set: &HalfSpaces, budget: Budget<'_>| {
        let mut both = constraints.clone();
        both.extend(&step_back(set, vertices, budget).map_err(NoInterior::from)?);
        project_out_last(&both, inputs, budget)
    };
    max_invariant(&start, limits, budget, back).unwrap_or_else(Invariant::from_end)
}

/// Why an iteration ended without a set.
enum End {
    NoInterior(NoInterior),
    TooManyRows(usize),
}

impl From<EliminationError> for End {
    fn from(error: EliminationError) -> Self {
        match error {
            EliminationError::NoInterior(reason) => Self::NoInterior(reason),
            EliminationError::TooManyPairs(pairs) => Self::TooManyRows(pairs),
        }
    }
}

impl From<NoInterior> for End {
    fn from(reason: NoInterior) -> Self {
        Self::NoInterior(reason)
    }
}

impl Invariant {
    fn from_end(end: End) -> Self {
        Self::ended(end, 0)
    }

    fn ended(end: End, iterations: usize) -> Self {
        match end {
            End::NoInterior(NoInterior::Interrupted(why)) => Self::Interrupted(why),
            End::NoInterior(NoInterior::Numerical) => Self::Undecided { iterations, rows: 0 },
            End::NoInterior(reason) => Self::Empty { iterations, reason },
            End::TooManyRows(rows) => Self::Undecided { iterations, rows },
        }
    }
}

/// Intersects with steps back until the next one cuts off nothing.
fn max_invariant(
    constraints: &HalfSpaces,
    limits: InvariantLimits,
    budget: Budget<'_>,
    back: impl Fn(&HalfSpaces, Budget<'_>) -> Result<HalfSpaces, EliminationError>,
) -> Result<Invariant, End> {
    let none = HalfSpaces::new(constraints.dimension());
    let mut set = constraints.select(&irredundant(constraints, &none, EXACT, budget)?.kept);
    for iterations in 0..limits.iterations_max {
        let cut = match back(&set, budget) {
            Ok(cut) => cut,
            Err(error) => return Ok(Invariant::ended(error.into(), iterations + 1)),
        };
        let new = match irredundant(&cut, &set, CONVERGED, budget) {
            Ok(new) => new,
            Err(reason) => return Ok(Invariant::ended(reason.into(), iterations + 1)),
        };
        if new.kept.is_empty() {
            return Ok(Invariant::Found { set, iterations, excess: new.outer_excess });
        }
        set.extend(&cut);
        set = match irredundant(&set, &none, EXACT, budget) {
            Ok(reduction) => set.select(&reduction.kept),
            Err(reason) => return Ok(Invariant::ended(reason.into(), iterations + 1)),
        };
        if set.len() > limits.rows_max {
            return Ok(Invariant::Undecided { iterations: iterations + 1, rows: set.len() });
        }
    }
    Ok(Invariant::Undecided { iterations: limits.iterations_max, rows: set.len() })
}

/// {(x, u) : A_j x + B_j u + w in the set for every j and w}: every row times every vertex, its
/// offset less the support of the disturbance.
///
/// # Errors
/// The [`Interruption`] of the budget.
pub fn step_back(
    set: &HalfSpaces,
    vertices: &[PlantVertex<'_>],
    budget: Budget<'_>,
) -> Result<HalfSpaces, Interruption> {
    let columns = vertices.first().map_or(0, |v| v.a.ncols() + v.b.ncols());
    let mut rows = HalfSpaces::new(columns);
    let mut normal = vec![0.0; columns];
    for row in 0..set.len() {
        budget.check()?;
        let direction = DVector::from_column_slice(set.normal(row));
        for vertex in vertices {
            for (c, column) in vertex.a.column_iter().chain(vertex.b.column_iter()).enumerate() {
                normal[c] = direction.iter().zip(column.iter()).map(|(h, a)| h * a).sum();
            }
            let taken = vertex.disturbance.support_function(&direction);
            rows.push(&normal, set.offset(row) - taken);
        }
    }
    Ok(rows)
}
