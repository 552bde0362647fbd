//! Control invariant sets grown from inside.

use nalgebra::{DMatrix, DVector};

use super::{HalfSpaces, NoInterior, PlantVertex, invariant::step_back};
use crate::{
    budget::{Budget, Interruption},
    program::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status},
    sampling::Stream,
    sets::{Hull, HullError, vertices},
};

/// Weight of |(x, v)|^2 against the reach along a direction. Any feasible point will do; a small
/// weight makes it a far one.
const PULL: f64 = 1e-4;
/// A point extends the set if it lies beyond it by this share of the set's size.
const WORTHWHILE: f64 = 1e-3;

/// How far a set may grow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrowthLimits {
    /// Steps back.
    pub rounds: usize,
    /// Directions tried in each.
    pub directions: usize,
    /// Facets of the grown set.
    pub facets_max: usize,
}

/// A grown set.
#[derive(Debug, Clone, PartialEq)]
pub struct Growth {
    /// {x : H x <= h}.
    pub set: HalfSpaces,
    /// Its corners.
    pub corners: Vec<DVector<f64>>,
    /// Rounds that added something.
    pub rounds: usize,
    /// It stopped at the limit of facets, not because nothing was left to gain.
    pub limited: bool,
}

/// Why nothing was grown.
#[derive(Debug, Clone, PartialEq)]
pub enum GrowthError {
    /// The seed has no interior.
    Seed(NoInterior),
    /// The seed's vertices could not be listed.
    Hull(HullError),
    /// Stopped from outside.
    Interrupted(Interruption),
    /// A factorisation failed.
    Numerical,
}

impl From<Interruption> for GrowthError {
    fn from(why: Interruption) -> Self {
        Self::Interrupted(why)
    }
}

/// Grows a robust control invariant set from a seed that is one: each round adds states from
/// which some corrections satisfy `feasible` and lead into the present set, whatever the vertex
/// and the disturbance.
///
/// `seed` {x} must be invariant and feasible under v = 0; `feasible` are rows over (x, v_0 ..
/// v_{T-1}), `vertices` closed loops with the input matrix of v_0. The hull of states with such
/// corrections has them too, by convexity; so the result is robustly invariant and inside the
/// projection of `feasible`, by construction and to the solver's tolerance of 1e-9. This replaces
/// the projection of \[Mammarella2019, eq. 14\], from n + T m dimensions, by its inner part that is
/// worth having.
///
/// # Errors
/// [`GrowthError`].
pub fn grow_control_invariant(
    seed: &HalfSpaces,
    feasible: &HalfSpaces,
    plant: &[PlantVertex<'_>],
    limits: GrowthLimits,
    budget: Budget<'_>,
) -> Result<Growth, GrowthError> {
    let n = seed.dimension();
    let interior = seed.interior_point(budget).map_err(|reason| match reason {
        NoInterior::Interrupted(why) => GrowthError::Interrupted(why),
        other => GrowthError::Seed(other),
    })?;
    let interior = DVector::from_vec(interior.point);
    let corners =
        vertices(&seed.to_polytope(), &interior, limits.facets_max, budget).map_err(no_hull)?;
    let mut hull = Hull::new(&corners, limits.facets_max, budget).map_err(no_hull)?;
    let cost =
        QuadraticCost::new(DMatrix::identity(feasible.dimension(), feasible.dimension()) * PULL)
            .map_err(|_| GrowthError::Numerical)?;
    let mut growth = Growth { set: seed.clone(), corners, rounds: 0, limited: false };
    for round in 0..limits.rounds {
        let program = Reach::new(feasible, &growth.set, plant, &cost, budget)?;
        let widths = half_widths(&growth.corners, &interior);
        let mut stream = Stream::new(0, 0, round as u64);
        let mut grown = false;
        for index in 0..limits.directions {
            let direction = direction(index, &widths, &mut stream);
            let Some(point) = program.farthest(&direction, budget)? else { continue };
            let size = (&point - &interior).norm();
            if hull.violation(&point) > WORTHWHILE * size.min(widths.amax()) {
                match hull.insert(&point, limits.facets_max) {
                    Ok(_) => grown = true,
                    Err(_) => growth.limited = true,
                }
            }
        }
        if !grown {
            break;
        }
        growth.rounds = round + 1;
        growth.set = HalfSpaces::from_polytope(&hull.to_polytope());
        growth.corners = hull.corners();
        debug_assert_eq!(growth.set.dimension(), n);
    }
    Ok(growth)
}

fn no_hull(error: HullError) -> GrowthError {
    match error {
        HullError::Interrupted(why) => GrowthError::Interrupted(why),
        other => GrowthError::Hull(other),
    }
}

/// The states from which one step leads into a set.
struct Reach<'a> {
    rows: DenseRows,
    offsets: Vec<f64>,
    cost: &'a QuadraticCost,
    n: usize,
}

impl<'a> Reach<'a> {
    fn new(
        feasible: &HalfSpaces,
        set: &HalfSpaces,
        plant: &[PlantVertex<'_>],
        cost: &'a QuadraticCost,
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let mut rows = feasible.rows().clone();
        let mut offsets = feasible.offsets().to_vec();
        let first = step_back(set, plant, budget)?;
        let mut normal = vec![0.0; feasible.dimension()];
        for row in 0..first.len() {
            normal[..first.dimension()].copy_from_slice(first.normal(row));
            rows.push(&normal);
            offsets.push(first.offset(row));
        }
        Ok(Self { rows, offsets, cost, n: set.dimension() })
    }

    /// A state far along `direction`; `None` if the solver could not prove its answer.
    fn farthest(
        &self,
        direction: &DVector<f64>,
        budget: Budget<'_>,
    ) -> Result<Option<DVector<f64>>, Interruption> {
        let mut gradient = vec![0.0; self.rows.columns()];
        gradient.iter_mut().zip(direction.iter()).for_each(|(g, d)| *g = -d);
        let program = QuadraticProgram {
            cost: self.cost,
            gradient: &gradient,
            rows: &self.rows,
            offsets: &self.offsets,
        };
        let solution = DualActiveSet::default().solve(&program, &[], budget)?;
        let found = solution.status == Status::Optimal;
        Ok(found.then(|| DVector::from_column_slice(&solution.point[..self.n])))
    }
}

fn half_widths(corners: &[DVector<f64>], interior: &DVector<f64>) -> DVector<f64> {
    let mut widths = DVector::zeros(interior.len());
    for corner in corners {
        for i in 0..widths.len() {
            widths[i] = f64::max(widths[i], (corner[i] - interior[i]).abs());
        }
    }
    widths
}

/// The axes first, both ways, then directions that are even on the sphere once every coordinate
/// is measured by the width of the set.
fn direction(index: usize, widths: &DVector<f64>, stream: &mut Stream) -> DVector<f64> {
    let n = widths.len();
    let mut direction = DVector::zeros(n);
    if index < 2 * n {
        direction[index / 2] = if index.is_multiple_of(2) { 1.0 } else { -1.0 };
        return direction;
    }
    loop {
        (0..n).for_each(|i| direction[i] = 2.0 * stream.uniform() - 1.0);
        let length = direction.norm();
        if length > 0.1 && length <= 1.0 {
            let scaled =
                DVector::from_fn(n, |i, _| direction[i] / widths[i].max(f64::MIN_POSITIVE));
            let length = scaled.norm();
            return scaled / length;
        }
    }
}
