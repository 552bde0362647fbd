//! Many half-spaces, and a point well inside all of them.

use nalgebra::{DMatrix, DVector};

use super::reading::{ReadError, numbers};
use crate::{
    budget::{Budget, Interruption},
    bytes::{Reader, Writer},
    program::{
        ActiveRow, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status,
        prove_infeasible,
    },
    sets::Polytope,
};

/// {x : a_i x <= b_i}, flat and row by row: a [`Polytope`] for hundreds of thousands of rows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HalfSpaces {
    rows: DenseRows,
    offsets: Vec<f64>,
}

/// A point with room around it.
#[derive(Debug, Clone, PartialEq)]
pub struct InteriorPoint {
    /// n values.
    pub point: Vec<f64>,
    /// Distance to the nearest row, > 0.
    pub room: f64,
}

/// Why a set has no interior point.
#[derive(Debug, Clone, PartialEq)]
pub enum NoInterior {
    /// Proved: these rows have no common point.
    Empty {
        /// Weights of a Farkas ray, at most n + 1 rows.
        ray: Vec<ActiveRow>,
        /// By how much the rows miss each other, per unit normal.
        margin: f64,
    },
    /// No ball of even the least radius considered fits into the set.
    Flat {
        /// Largest ball found, per unit normal; can be negative within rounding.
        room: f64,
    },
    /// The solver does not trust its own result.
    Numerical,
    /// Stopped from outside.
    Interrupted(Interruption),
}

impl From<Interruption> for NoInterior {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// Least room that counts as interior, relative to 1 + the size of the point. Below it, rounding
/// of the rows decides what the set is.
const ROOM_MIN: f64 = 1e-7;
/// Larger balls are not looked for: in a set without end they would lead far away.
const ROOM_WANTED: f64 = 1.0;
/// Weight of |x|^2 against the room: small, so that the point is central, not close to 0.
const PULL: f64 = 1e-6;
/// Rows between two looks at the budget.
const BUDGET_PERIOD: usize = 1024;
/// More coordinates are not read back: far above those of any program.
const DIMENSION_MAX: usize = 100_000;

impl HalfSpaces {
    /// The whole space of n dimensions.
    #[must_use]
    pub fn new(n: usize) -> Self {
        Self { rows: DenseRows::new(n), offsets: Vec::new() }
    }

    /// The rows of a polytope.
    #[must_use]
    pub fn from_polytope(polytope: &Polytope) -> Self {
        Self {
            rows: DenseRows::from_matrix(polytope.normals()),
            offsets: polytope.offsets().as_slice().to_vec(),
        }
    }

    /// As a polytope.
    #[must_use]
    pub fn to_polytope(&self) -> Polytope {
        let normals = DMatrix::from_fn(self.len(), self.dimension(), |i, j| self.rows.normal(i)[j]);
        Polytope::new(normals, DVector::from_column_slice(&self.offsets))
    }

    /// Appends `normal` x <= `offset`.
    ///
    /// # Panics
    /// If the normal has not n components.
    pub fn push(&mut self, normal: &[f64], offset: f64) {
        self.rows.push(normal);
        self.offsets.push(offset);
    }

    /// Appends every row of `other`.
    pub fn extend(&mut self, other: &Self) {
        (0..other.len()).for_each(|i| self.push(other.normal(i), other.offsets[i]));
    }

    /// These rows and then those of `other`, if there is time.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn with(&self, other: &Self, budget: Budget<'_>) -> Result<Self, Interruption> {
        let mut both = Self::new(self.dimension());
        for rows in [self, other] {
            for first in (0..rows.len()).step_by(BUDGET_PERIOD) {
                budget.check()?;
                let last = (first + BUDGET_PERIOD).min(rows.len());
                (first..last).for_each(|i| both.push(rows.normal(i), rows.offsets[i]));
            }
        }
        Ok(both)
    }

    /// The rows with these indices, in this order.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        let mut selected = Self::new(self.dimension());
        indices.iter().for_each(|&i| selected.push(self.normal(i), self.offsets[i]));
        selected
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn select_within(
        &self,
        indices: &[usize],
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let mut selected = Self::new(self.dimension());
        for some in indices.chunks(BUDGET_PERIOD) {
            budget.check()?;
            some.iter().for_each(|&i| selected.push(self.normal(i), self.offsets[i]));
        }
        Ok(selected)
    }

    /// n.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.rows.columns()
    }

    /// Rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.offsets.len()
    }

    /// No rows?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.offsets.is_empty()
    }

    /// a_i.
    #[must_use]
    pub fn normal(&self, row: usize) -> &[f64] {
        self.rows.normal(row)
    }

    /// b_i.
    #[must_use]
    pub fn offset(&self, row: usize) -> f64 {
        self.offsets[row]
    }

    /// All a_i.
    #[must_use]
    pub fn rows(&self) -> &DenseRows {
        &self.rows
    }

    /// All b_i.
    #[must_use]
    pub fn offsets(&self) -> &[f64] {
        &self.offsets
    }

    /// Largest a_i x - b_i; -infinite without rows. Negative is inside.
    #[must_use]
    pub fn violation(&self, point: &[f64]) -> f64 {
        let mut products = Vec::with_capacity(self.len());
        self.rows.products(point, &mut products);
        products.iter().zip(&self.offsets).map(|(a, b)| a - b).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Every row moved towards `point`, to this share of its distance from it.
    #[must_use]
    pub fn towards(&self, point: &[f64], share: f64) -> Self {
        let mut moved = Self::new(self.dimension());
        for (normal, offset) in (0..self.len()).map(|row| (self.normal(row), self.offset(row))) {
            let at: f64 = normal.iter().zip(point).map(|(a, z)| a * z).sum();
            moved.push(normal, at + (offset - at) * share);
        }
        moved
    }

    /// Least distance of `point` to a row, per unit normal; negative outside, infinite without rows.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn room(&self, point: &[f64], budget: Budget<'_>) -> Result<f64, Interruption> {
        let mut products = Vec::with_capacity(self.len());
        self.rows.products_within(point, &mut products, budget)?;
        Ok((0..self.len())
            .map(|i| (self.offsets[i] - products[i]) * self.rows.scale(i))
            .fold(f64::INFINITY, f64::min))
    }

    /// Appends the rows.
    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.count(self.dimension());
        writer.numbers(&self.offsets);
        for row in 0..self.len() {
            self.normal(row).iter().for_each(|&entry| writer.number(entry));
        }
    }

    /// Reads what [`Self::write`] wrote.
    pub(crate) fn read(reader: &mut Reader<'_>, budget: Budget<'_>) -> Result<Self, ReadError> {
        let dimension = reader.count()?;
        if dimension > DIMENSION_MAX {
            return Err(reader.fault("too many coordinates").into());
        }
        let offsets = numbers(reader, budget)?;
        let mut rows = Self::new(dimension);
        for (row, offset) in offsets.into_iter().enumerate() {
            if row % BUDGET_PERIOD == 0 {
                budget.check()?;
            }
            let normal = (0..dimension).map(|_| reader.number());
            rows.push(&normal.collect::<Result<Vec<_>, _>>()?, offset);
        }
        Ok(rows)
    }

    /// A point with much room to every row: the centre of a large ball inside, of radius 1 if
    /// that fits, by a quadratic program that trades the radius against |x| only slightly.
    ///
    /// # Errors
    /// [`NoInterior`]: proved empty, or too flat.
    pub fn interior_point(&self, budget: Budget<'_>) -> Result<InteriorPoint, NoInterior> {
        let best = self.large_ball(budget)?;
        let size = best.point.iter().fold(1.0_f64, |a, x| a.max(x.abs()));
        if best.room > ROOM_MIN * size {
            return Ok(best);
        }
        Err(self.prove_empty(budget)?.unwrap_or(NoInterior::Flat { room: best.room }))
    }

    /// min PULL |x|^2 / 2 + (t - ROOM_WANTED)^2 / 2 over a_i x + |a_i| t <= b_i.
    fn large_ball(&self, budget: Budget<'_>) -> Result<InteriorPoint, NoInterior> {
        let n = self.dimension();
        let mut lifted = DenseRows::new(n + 1);
        let mut normal = vec![0.0; n + 1];
        for row in 0..self.len() {
            if row % BUDGET_PERIOD == 0 {
                budget.check()?;
            }
            normal[..n].copy_from_slice(self.normal(row));
            normal[n] = 1.0 / self.rows.scale(row);
            lifted.push(&normal);
        }
        let mut hessian = DMatrix::identity(n + 1, n + 1) * PULL;
        hessian[(n, n)] = 1.0;
        let cost = QuadraticCost::new(hessian).map_err(|_| NoInterior::Numerical)?;
        let mut gradient = vec![0.0; n + 1];
        gradient[n] = -ROOM_WANTED;
        let program = QuadraticProgram {
            cost: &cost,
            gradient: &gradient,
            rows: &lifted,
            offsets: &self.offsets,
        };
        let solution = DualActiveSet::default().solve(&program, &[], budget)?;
        if !solution.point.iter().all(|x| x.is_finite()) {
            return Err(NoInterior::Numerical);
        }
        let point = solution.point[..n].to_vec();
        // The room is measured, not believed.
        let room = self.room(&point, budget)?.min(ROOM_WANTED);
        Ok(InteriorPoint { point, room })
    }

    /// A Farkas ray, if there is one.
    fn prove_empty(&self, budget: Budget<'_>) -> Result<Option<NoInterior>, NoInterior> {
        let n = self.dimension();
        let cost = QuadraticCost::identity(n);
        let program = QuadraticProgram {
            cost: &cost,
            gradient: &vec![0.0; n],
            rows: &self.rows,
            offsets: &self.offsets,
        };
        let solution = DualActiveSet::default().solve(&program, &[], budget)?;
        Ok((solution.status == Status::PrimalInfeasible).then(|| {
            let proof = prove_infeasible(&self.rows, &self.offsets, &solution.active);
            NoInterior::Empty { ray: solution.active, margin: proof.margin }
        }))
    }
}
