//! Which of very many half-spaces are needed.
//!
//! Around an interior point z_0 every row reads a_i y <= 1. A row is redundant if no y satisfies
//! the others and has a_i y >= 1: a small feasibility program, whose Farkas ray writes a_i as a
//! combination of other rows with weights that sum to at most 1. Most rows are refused by a
//! handful of others, so the program is solved against the rows known to be needed only. Where
//! they leave a point y, the row that this point violates most is needed for certain (the ray
//! from z_0 to y leaves the set through it), whichever it is; so all rows are looked at only once
//! for every needed row. Clarkson, "More output-sensitive geometric algorithms", FOCS 1994.
//!
//! Groups of rows can be reduced on their own and the survivors together ([`irredundant`] with a
//! context), in any order and on any machine: a removed row rests on kept rows alone.

use nalgebra::DMatrix;

use super::{HalfSpaces, InteriorPoint, NoInterior, dominance::Dominance};
use crate::{
    budget::{Budget, Interruption},
    program::{ActiveSet, DenseRows, Entry, QuadraticCost},
};

/// A removed row may be violated by this at most, relative to its distance from the interior
/// point: rounding only.
pub const EXACT: f64 = 1e-9;
/// Two rows violated by the same, within rounding.
const TIE: f64 = 1e-11;
/// Misfit of a certificate, relative to the row: |a_i - sum y_j a_j|, in units in which the rows
/// have size 1 on average.
const MISFIT_MAX: f64 = 1e-8;
/// Rows that took part in recent certificates are tried first.
const RECENT_MAX: usize = 96;
/// Below so many candidates a box around the set does not pay.
const DOMINANCE_WORTHWHILE: usize = 500;
/// Rows between two looks at the budget where each may need a program.
const BUDGET_PERIOD: usize = 64;
/// The same where each takes a few products.
const ROWS_BETWEEN_LOOKS: usize = 1024;
/// The same where each takes one.
const PRODUCTS_BETWEEN_LOOKS: usize = 16_384;

/// What is left of a set of rows, and what that costs.
#[derive(Debug, Clone, PartialEq)]
pub struct Reduction {
    /// Indices of the rows that are needed, increasing.
    pub kept: Vec<usize>,
    /// The point about which rows are measured.
    pub interior: InteriorPoint,
    /// Every removed row i holds as a_i y <= 1 + this wherever the kept rows and the context do,
    /// y measured from the interior point: the kept rows are an outer set by that factor. From
    /// the certificates; at most the tolerance asked for.
    pub outer_excess: f64,
    /// Rows whose program did not end in a verified certificate; they were kept.
    pub doubtful: usize,
}

impl Reduction {
    /// The kept rows, moved towards the interior point by 1 / (1 + excess): an inner set, whose
    /// every point satisfies the removed rows too.
    #[must_use]
    pub fn inner(&self, candidates: &HalfSpaces) -> HalfSpaces {
        let kept = candidates.select(&self.kept);
        kept.towards(&self.interior.point, 1.0 / (1.0 + self.outer_excess))
    }
}

/// Finds the rows of `candidates` that are needed beside the `context`, which is kept in any case.
///
/// `tolerance` is [`EXACT`], or a larger epsilon: then rows that cut off less than that are
/// removed too, and only [`Reduction::inner`] of the result may be used where safety counts.
///
/// # Errors
/// [`NoInterior`] if all rows together leave no room.
pub fn irredundant(
    candidates: &HalfSpaces,
    context: &HalfSpaces,
    tolerance: f64,
    budget: Budget<'_>,
) -> Result<Reduction, NoInterior> {
    let all = candidates.with(context, budget)?;
    let interior = all.interior_point(budget)?;
    reduce(candidates.len(), &all, interior, tolerance, budget)
}

/// [`irredundant`], with rows measured about a point of the caller. Reductions about the same
/// point add up: what one removes within 1 + epsilon and the next within 1 + epsilon' of what the
/// first had left holds within (1 + epsilon)(1 + epsilon').
///
/// # Errors
/// [`NoInterior::Numerical`] if the point does not lie inside all rows.
pub fn irredundant_about(
    point: &InteriorPoint,
    candidates: &HalfSpaces,
    context: &HalfSpaces,
    tolerance: f64,
    budget: Budget<'_>,
) -> Result<Reduction, NoInterior> {
    let all = candidates.with(context, budget)?;
    if !(all.room(&point.point, budget)? > 0.0) {
        return Err(NoInterior::Numerical);
    }
    reduce(candidates.len(), &all, point.clone(), tolerance, budget)
}

/// The first `candidates` rows are to be decided, the others stay.
fn reduce(
    candidates: usize,
    all: &HalfSpaces,
    interior: InteriorPoint,
    tolerance: f64,
    budget: Budget<'_>,
) -> Result<Reduction, NoInterior> {
    let mut search = Search::new(all, candidates, &interior, tolerance, budget)?;
    if candidates < all.len() && candidates > DOMINANCE_WORTHWHILE {
        // Only rows that stay may carry the box, or rows could remove each other.
        search.dominance = Dominance::new(&search.context_rows(), budget)?;
    }
    for row in 0..candidates {
        if row % BUDGET_PERIOD == 0 {
            budget.check()?;
            budget.tell(row, candidates);
        }
        if search.fate[row] == Fate::Open {
            search.decide(row, budget)?;
        }
    }
    if search.ties {
        search.clean_up(budget)?;
    }
    let kept = (0..candidates).filter(|&row| search.fate[row] == Fate::Needed).collect();
    Ok(Reduction { kept, interior, outer_excess: search.outer_excess, doubtful: search.doubtful })
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Open,
    Needed,
    Removed,
}

struct Search {
    /// a_i y <= 1, candidates first, then the context, in coordinates that make the set round.
    polar: DenseRows,
    candidates: usize,
    fate: Vec<Fate>,
    tolerance: f64,
    cost: QuadraticCost,
    /// Rows known to be needed, the context first.
    needed: Vec<usize>,
    /// Those of recent certificates, the latest last.
    recent: Vec<usize>,
    outer_excess: f64,
    doubtful: usize,
    /// Two different rows were met at once: one of them may have been taken for needed wrongly.
    ties: bool,
    dominance: Option<Dominance>,
    active: ActiveSet,
    padded: Vec<f64>,
    reversed: Vec<f64>,
}

/// Every row times the matrix: M a_i.
fn mapped(
    rows: &DenseRows,
    matrix: &DMatrix<f64>,
    budget: Budget<'_>,
) -> Result<DenseRows, Interruption> {
    let by_rows = DenseRows::from_matrix(matrix);
    let mut image = DenseRows::new(matrix.nrows());
    let mut normal = Vec::with_capacity(matrix.nrows());
    for row in 0..rows.len() {
        if row % ROWS_BETWEEN_LOOKS == 0 {
            budget.check()?;
        }
        by_rows.products(rows.normal(row), &mut normal);
        image.push(&normal);
    }
    Ok(image)
}

/// Orthonormal axes, one a row, along which rows differ from the multiple of the row before that
/// is nearest to them.
fn axes_of_differences(
    rows: &DenseRows,
    candidates: usize,
    budget: Budget<'_>,
) -> Result<DMatrix<f64>, Interruption> {
    let n = rows.columns();
    let mut spread = DMatrix::<f64>::zeros(n, n);
    let mut rest = vec![0.0; n];
    for row in 1..candidates {
        if row % ROWS_BETWEEN_LOOKS == 0 {
            budget.check()?;
        }
        let (before, this) = (rows.normal(row - 1), rows.normal(row));
        let square: f64 = before.iter().map(|a| a * a).sum();
        let along: f64 = before.iter().zip(this).map(|(a, b)| a * b).sum();
        // The first row of another bundle says nothing about differences within one.
        if !(along * along > 0.5 * square * this.iter().map(|a| a * a).sum::<f64>()) {
            continue;
        }
        let pairs = this.iter().zip(before);
        rest.iter_mut().zip(pairs).for_each(|(r, (a, b))| *r = a - along / square * b);
        for i in 0..n {
            for j in 0..n {
                spread[(i, j)] += rest[i] * rest[j];
            }
        }
    }
    let axes = spread.symmetric_eigen().eigenvectors.transpose();
    Ok(if axes.iter().all(|x| x.is_finite()) { axes } else { DMatrix::identity(n, n) })
}

/// How a feasibility program ended.
enum Outcome {
    Redundant,
    /// The needed rows leave a point, kept in the active set.
    Open,
    Doubtful,
}

impl Search {
    fn new(
        all: &HalfSpaces,
        candidates: usize,
        interior: &InteriorPoint,
        tolerance: f64,
        budget: Budget<'_>,
    ) -> Result<Self, NoInterior> {
        let n = all.dimension();
        let mut polar = DenseRows::new(n);
        let mut moments = DMatrix::zeros(n, n);
        let mut normal = vec![0.0; n];
        for row in 0..all.len() {
            if row % ROWS_BETWEEN_LOOKS == 0 {
                budget.check()?;
            }
            let a = all.normal(row);
            let at: f64 = a.iter().zip(&interior.point).map(|(a, z)| a * z).sum();
            let room = all.offset(row) - at;
            normal.iter_mut().zip(a).for_each(|(scaled, a)| *scaled = a / room);
            polar.push(&normal);
            for i in 0..n {
                for j in 0..n {
                    moments[(i, j)] += normal[i] * normal[j];
                }
            }
        }
        // Coordinates in which the mean of a a' is the identity make the set round, whatever the
        // units.
        moments /= all.len().max(1) as f64;
        let floor = 1e-9 * moments.trace().max(f64::MIN_POSITIVE) / n as f64;
        let metric = QuadraticCost::new(moments + DMatrix::identity(n, n) * floor)
            .map_err(|_| NoInterior::Numerical)?;
        let whiten = DMatrix::from_fn(n, n, |k, i| metric.factor_column(k)[i]);
        let round = mapped(&polar, &whiten, budget)?;
        // Turned so that neighbours differ along few axes: then a box along the axes is tight for
        // what they differ by.
        let axes = axes_of_differences(&round, candidates, budget)?;
        let round = mapped(&round, &axes, budget)?;
        Ok(Self {
            fate: vec![Fate::Open; candidates],
            needed: (candidates..all.len()).collect(),
            recent: Vec::new(),
            reversed: vec![0.0; n],
            padded: Vec::new(),
            active: ActiveSet::default(),
            outer_excess: 0.0,
            doubtful: 0,
            ties: false,
            dominance: None,
            polar: round,
            candidates,
            tolerance,
            cost: QuadraticCost::identity(n),
        })
    }

    /// The rows that stay in any case.
    fn context_rows(&self) -> DenseRows {
        let mut rows = DenseRows::new(self.polar.columns());
        (self.candidates..self.polar.len()).for_each(|row| rows.push(self.polar.normal(row)));
        rows
    }

    /// Settles the fate of an open row, and finds other needed rows on the way.
    fn decide(&mut self, row: usize, budget: Budget<'_>) -> Result<(), Interruption> {
        if self.polar.normal(row).iter().all(|&a| a == 0.0) {
            // 0 <= b with b > 0, since the interior point satisfies it.
            self.fate[row] = Fate::Removed;
            return Ok(());
        }
        let Self { dominance, polar, tolerance, .. } = self;
        let behind = dominance.as_mut().and_then(|front| front.excess(polar, row, *tolerance));
        if let Some(excess) = behind {
            self.outer_excess = self.outer_excess.max(excess);
            self.fate[row] = Fate::Removed;
            return Ok(());
        }
        self.begin(row);
        loop {
            match self.against_needed(row, None, budget)? {
                Outcome::Redundant => self.fate[row] = Fate::Removed,
                Outcome::Doubtful => {
                    self.doubtful += 1;
                    self.fate[row] = Fate::Needed;
                    self.needed.push(row);
                }
                Outcome::Open => {
                    let worst = self.worst_of_open(row, budget)?;
                    self.fate[worst] = Fate::Needed;
                    self.needed.push(worst);
                    self.touch(worst);
                    if let Some(front) = &mut self.dominance {
                        front.add(&self.polar, worst);
                    }
                }
            }
            if self.fate[row] != Fate::Open {
                return Ok(());
            }
        }
    }

    /// The nearest point to z_0 with a_row y = 1 + tolerance, no other row known yet.
    fn begin(&mut self, row: usize) {
        let zero = vec![0.0; self.cost.variables()];
        self.active.reset(&self.cost, &zero);
        self.reversed.copy_from_slice(self.polar.normal(row));
        self.reversed.iter_mut().for_each(|a| *a = -*a);
        self.active.enter(row, &self.reversed, -(1.0 + self.tolerance), usize::MAX);
    }

    /// Goes on until the needed rows are satisfied or exclude the row; `without` is left out.
    fn against_needed(
        &mut self,
        row: usize,
        without: Option<usize>,
        budget: Budget<'_>,
    ) -> Result<Outcome, Interruption> {
        let iterations_max = 60 * (self.cost.variables() + 5);
        while let Some(worst) = self.worst_of_needed(without) {
            budget.check()?;
            let Self { active, polar, .. } = self;
            match active.enter(worst, polar.normal(worst), 1.0, iterations_max) {
                Entry::Active => {}
                Entry::Infeasible => return Ok(self.certify(row, worst)),
                Entry::Stalled => return Ok(Outcome::Doubtful),
            }
            if !self.active.point().iter().all(|y| y.is_finite()) {
                return Ok(Outcome::Doubtful);
            }
            if let Some(excess) = self.proved_by_the_box(row) {
                self.outer_excess = self.outer_excess.max(excess);
                return Ok(Outcome::Redundant);
            }
        }
        Ok(Outcome::Open)
    }

    /// Before the search ends: the active rows combine to nearly a_row, and what is missing is
    /// bounded by the box. The point itself says what is missing, times the row's own weight; what
    /// counts is computed again from the rows.
    fn proved_by_the_box(&self, row: usize) -> Option<f64> {
        let dominance = self.dominance.as_ref()?;
        let (mut own, mut sum) = (0.0, 0.0);
        for (other, weight) in self.active.active() {
            if other == row { own = weight } else { sum += weight }
        }
        let enough = |reach: f64| own > 0.0 && sum / own + reach <= 1.0 + self.tolerance;
        if !enough(dominance.reach(self.active.point()) / own) {
            return None;
        }
        let mut rest = self.polar.normal(row).to_vec();
        for (other, weight) in self.active.active().filter(|&(other, _)| other != row) {
            let share = weight.max(0.0) / own;
            for (r, a) in rest.iter_mut().zip(self.polar.normal(other)) {
                *r -= share * a;
            }
        }
        let reach = dominance.reach(&rest);
        enough(reach).then(|| (sum / own + reach - 1.0).max(0.0))
    }

    /// The most violated row, among recent ones if there is any, else among all needed ones.
    fn worst_of_needed(&mut self, without: Option<usize>) -> Option<usize> {
        self.polar.pad(self.active.point(), &mut self.padded);
        let worst_of = |list: &[usize]| {
            let mut worst = (1.0 + TIE, None);
            for &row in list.iter().filter(|&&row| Some(row) != without) {
                let product = self.polar.product(row, &self.padded);
                if product > worst.0 {
                    worst = (product, Some(row));
                }
            }
            worst.1
        };
        let worst = worst_of(&self.recent).or_else(|| worst_of(&self.needed))?;
        self.touch(worst);
        Some(worst)
    }

    /// The open row with the largest a_i y: the ray to y leaves the set through it. `row` itself
    /// wins ties, and duplicates of it are removed by it later.
    fn worst_of_open(&mut self, row: usize, budget: Budget<'_>) -> Result<usize, Interruption> {
        self.polar.pad(self.active.point(), &mut self.padded);
        let own = self.polar.product(row, &self.padded);
        let mut worst = (own, row);
        let mut tie = false;
        for other in 0..self.candidates {
            if other % PRODUCTS_BETWEEN_LOOKS == 0 {
                budget.check()?;
            }
            if self.fate[other] != Fate::Open || other == row {
                continue;
            }
            let product = self.polar.product(other, &self.padded);
            if product > worst.0 + TIE {
                worst = (product, other);
                tie = false;
            } else if product >= worst.0 - TIE {
                tie = true;
            }
        }
        self.ties |= tie;
        Ok(worst.1)
    }

    /// Is the ray a certificate, by its own arithmetic? a_row = sum y_j a_j with y >= 0 and
    /// sum y_j <= 1 + tolerance.
    fn certify(&mut self, row: usize, last: usize) -> Outcome {
        // The reversed row has weight w in the ray; the others are divided by it.
        let mut own = 0.0;
        let mut sum = 0.0;
        let mut misfit = vec![0.0; self.cost.variables()];
        for (other, weight) in self.active.ray().chain([(last, 1.0)]) {
            if other == row {
                own = weight;
                continue;
            }
            sum += weight;
            for (m, a) in misfit.iter_mut().zip(self.polar.normal(other)) {
                *m += weight * a;
            }
        }
        let size = misfit.iter().fold(0.0_f64, |a, m| a.max(m.abs()));
        for (m, a) in misfit.iter_mut().zip(self.polar.normal(row)) {
            *m -= own * a;
        }
        let misfit = misfit.iter().fold(0.0_f64, |a, m| a.max(m.abs()));
        if !(own > 0.0 && misfit <= MISFIT_MAX * size && sum <= own * (1.0 + self.tolerance)) {
            return Outcome::Doubtful;
        }
        self.outer_excess = self.outer_excess.max(sum / own - 1.0);
        Outcome::Redundant
    }

    /// Puts a row at the end of the recent ones.
    fn touch(&mut self, row: usize) {
        if let Some(place) = self.recent.iter().position(|&other| other == row) {
            self.recent.remove(place);
        } else if self.recent.len() == RECENT_MAX {
            self.recent.remove(0);
        }
        self.recent.push(row);
    }

    /// Where rows were met at once, each needed one must stand against the others again.
    fn clean_up(&mut self, budget: Budget<'_>) -> Result<(), Interruption> {
        let mut place = 0;
        while place < self.needed.len() {
            let row = self.needed[place];
            if row >= self.candidates {
                place += 1;
                continue;
            }
            budget.check()?;
            self.begin(row);
            if matches!(self.against_needed(row, Some(row), budget)?, Outcome::Redundant) {
                self.fate[row] = Fate::Removed;
                self.needed.remove(place);
                self.recent.retain(|&other| other != row);
            } else {
                place += 1;
            }
        }
        Ok(())
    }
}
