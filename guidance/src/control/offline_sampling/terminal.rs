//! The terminal set, and what would have to move where there is none.

use nalgebra::{DMatrix, DVector};

use super::design::infeasible;
use crate::{
    budget::{Budget, Interruption},
    control::{ConstraintFamily, Fault, Infeasibility, PrepareError, Relaxation},
    matrices::product,
    reach::{HalfSpaces, Invariant, InvariantLimits, PlantVertex, max_robust_positive_invariant},
};

/// Terms of the sum of a disturbance's images are below this share of the sum when it stops.
const SERIES_SHARE: f64 = 1e-9;
/// Most terms of it.
const SERIES_TERMS_MAX: usize = 10_000;
/// How near to the least offsets the search comes, relative.
const OFFSET_SHARE: f64 = 0.01;
/// Offsets beyond this many times what the expected plant needs are not tried.
const OFFSET_FACTOR_MAX: f64 = 64.0;

/// A set that u = K x never leaves.
pub(super) struct Terminal {
    pub(super) set: HalfSpaces,
    pub(super) iterations: usize,
}

/// The largest robust invariant set of u = K x in the state and input constraints.
/// [Mammarella2019, assumption 3]
///
/// # Errors
/// Infeasible, with the least offsets that leave a set, if there is none; a fault of
/// `terminal_limits` if that stays undecided.
pub(super) fn terminal_set(
    state: &HalfSpaces,
    input: &HalfSpaces,
    gain: &DMatrix<f64>,
    closed: &[PlantVertex<'_>],
    limits: InvariantLimits,
    budget: Budget<'_>,
) -> Result<Terminal, PrepareError> {
    let rows = fed_back_rows(state, input, gain);
    match max_robust_positive_invariant(&rows, closed, limits, budget) {
        Invariant::Found { set, iterations, .. } => Ok(Terminal { set, iterations }),
        Invariant::Interrupted(why) => Err(why.into()),
        Invariant::Empty { iterations, .. } => {
            let reason = format!(
                "no set around the target stays in the constraints under the gain: nothing is \
                 left after {iterations} steps back"
            );
            Err(match least_offsets(&rows, closed, limits, budget)? {
                Some(offsets) => needed(&reason, &rows, state.len(), &offsets),
                None => infeasible(reason),
            })
        }
        Invariant::Undecided { iterations, rows } => {
            let got = format!("undecided after {iterations} steps back with {rows} rows");
            let expected = "limits under which the terminal set is found or excluded";
            Err(PrepareError::Faults(vec![Fault::new("terminal_limits", expected, got)]))
        }
    }
}

/// State rows, then input rows with u = K x, over x.
pub(super) fn fed_back_rows(
    state: &HalfSpaces,
    input: &HalfSpaces,
    gain: &DMatrix<f64>,
) -> HalfSpaces {
    let mut rows = state.clone();
    for row in 0..input.len() {
        let normal = DMatrix::from_row_slice(1, gain.nrows(), input.normal(row));
        rows.push(product(&normal, gain).as_slice(), input.offset(row));
    }
    rows
}

/// Offsets that leave a set, each as it is or as small as it can be: all that must grow grow in
/// proportion to what the disturbance takes from them under the mean of the vertices, so that
/// metres and metres per second are not mixed. `None` if the disturbance takes nothing or no
/// factor tried is enough.
fn least_offsets(
    rows: &HalfSpaces,
    closed: &[PlantVertex<'_>],
    limits: InvariantLimits,
    budget: Budget<'_>,
) -> Result<Option<Vec<f64>>, PrepareError> {
    let taken = taken_by_disturbance(rows, closed, budget)?;
    if !taken.iter().any(|&t| t > 0.0) {
        return Ok(None);
    }
    let offsets = |factor: f64| -> Vec<f64> {
        (0..rows.len()).map(|row| rows.offset(row).max(factor * taken[row])).collect()
    };
    let found = |factor: f64| -> Result<bool, PrepareError> {
        let mut moved = HalfSpaces::new(rows.dimension());
        for (row, offset) in offsets(factor).into_iter().enumerate() {
            moved.push(rows.normal(row), offset);
        }
        match max_robust_positive_invariant(&moved, closed, limits, budget) {
            Invariant::Found { .. } => Ok(true),
            Invariant::Interrupted(why) => Err(why.into()),
            Invariant::Empty { .. } | Invariant::Undecided { .. } => Ok(false),
        }
    };
    let (mut low, mut high) = (0.0, 1.0);
    while !found(high)? {
        low = high;
        high *= 2.0;
        if high > OFFSET_FACTOR_MAX {
            return Ok(None);
        }
    }
    while high - low > OFFSET_SHARE * high {
        let middle = 0.5 * (low + high);
        if found(middle)? {
            high = middle;
        } else {
            low = middle;
        }
    }
    Ok(Some(offsets(high)))
}

/// Support of the sum of all images of the disturbance, for every row, under the mean of the
/// vertices: less room than this leaves no invariant set.
fn taken_by_disturbance(
    rows: &HalfSpaces,
    closed: &[PlantVertex<'_>],
    budget: Budget<'_>,
) -> Result<Vec<f64>, Interruption> {
    let n = rows.dimension();
    let mut mean = DMatrix::zeros(n, n);
    closed.iter().for_each(|vertex| mean += &vertex.a);
    mean /= closed.len().max(1) as f64;
    let back = mean.transpose();
    let support = |row: usize| {
        let mut direction = DVector::from_column_slice(rows.normal(row));
        let mut sum = 0.0;
        for _ in 0..SERIES_TERMS_MAX {
            budget.check()?;
            let support =
                |vertex: &PlantVertex<'_>| vertex.disturbance.support_function(&direction);
            let term = closed.iter().map(support).fold(0.0, f64::max);
            sum += term;
            if term <= SERIES_SHARE * sum {
                break;
            }
            direction = crate::matrices::times_vector(&back, &direction);
        }
        Ok(sum)
    };
    (0..rows.len()).map(support).collect()
}

/// Says which rows must move, and how far: `rows` are state rows and then input rows with u = K x.
pub(super) fn needed(
    reason: &str,
    rows: &HalfSpaces,
    state_rows: usize,
    offsets: &[f64],
) -> PrepareError {
    let mut words = Vec::new();
    let mut relaxations: Vec<Relaxation> = Vec::new();
    for (row, &offset) in offsets.iter().enumerate() {
        let scale = rows.rows().scale(row);
        let (is, least) = (rows.offset(row) * scale, offset * scale);
        if least <= is {
            continue;
        }
        let (family, set, index) = if row < state_rows {
            (ConstraintFamily::State, "state_set", row)
        } else {
            (ConstraintFamily::Input, "input_set with u = K x", row - state_rows)
        };
        words.push(format!("row {index} of {set} at {least:.4} instead of {is:.4}"));
        let amount = least - is;
        match relaxations.iter_mut().find(|relaxation| relaxation.family == family) {
            Some(relaxation) => relaxation.amount = relaxation.amount.max(amount),
            None => relaxations.push(Relaxation { family, horizon: 0, amount }),
        }
    }
    PrepareError::Infeasible(Infeasibility {
        reason: format!(
            "{reason}; there is a set if the target keeps these least distances: {}",
            words.join(", ")
        ),
        horizon: 0,
        rows: Vec::new(),
        relaxations,
        all_horizons_proved: true,
    })
}
