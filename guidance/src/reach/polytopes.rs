//! Backward reachable sets of a polytope for thrust modes, for every start along the orbit.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, SMatrix, Vector3};

use super::reading::{ReadError, items, numbers};
use crate::{
    budget::{Budget, Interruption},
    bytes::{Reader, Writer},
    dynamics::{HeldStep, PeriodicPlant, RelativeVector},
    matrices::product_fixed,
    program::polytope_is_empty,
    sets::Polytope,
};

/// For every start k of a range, every mode and every instant after the start, the states at k
/// from which the craft is in the polytope at that instant *whatever* its working thrusters do:
/// {x : H_j x <= l_j}. [AguilarMarsillach2022, eqs. 20, 21]
///
/// The normals are the same for all modes; only offsets differ. Rows that others imply are kept:
/// a box has 12 rows for ever, and offsets can be compared set by set.
///
/// Being in one of these sets is "there is an instant such that for all thrusts"; being unable to
/// abort is "for all thrusts there is an instant". The first implies the second, and not the other
/// way round: proposition III.1 fails. See [`super::find_abort`].
#[derive(Debug, Clone, PartialEq)]
pub struct PolytopeUnion {
    first: usize,
    rows: usize,
    modes: usize,
    starts: Vec<StartSets>,
}

/// The sets of one start.
#[derive(Debug, Clone, PartialEq, Default)]
struct StartSets {
    /// instants x rows x 6 values, for the instants of `kept`.
    normals: Vec<f64>,
    /// Instants at which some mode's set is not empty, ascending.
    kept: Vec<usize>,
    /// (place in `kept`, mode), ascending.
    sets: Vec<(usize, usize)>,
    /// rows values a set.
    offsets: Vec<f64>,
}

/// One set of the union.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReachablePolytope<'a> {
    /// Which of the modes.
    pub mode: usize,
    /// Instant after the start, in parts of a step.
    pub instant: usize,
    /// rows x 6 values, row by row.
    pub normals: &'a [f64],
    /// One a row.
    pub offsets: &'a [f64],
}

/// What a union is made of.
#[derive(Debug, Clone, Copy)]
pub struct PolytopeQuestion<'a> {
    /// The plant, with its parts of steps.
    pub plant: &'a PeriodicPlant,
    /// The polytope of states to avoid.
    pub avoid: &'a Polytope,
    /// Force of each thruster at full thrust, newtons, RTN.
    pub full_forces_n: &'a [Vector3<f64>],
    /// Bits of the working thrusters of each mode.
    pub modes: &'a [u32],
    /// Safety horizon N, steps.
    pub horizon: usize,
}

impl PolytopeUnion {
    /// The sets of the starts `starts`.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    ///
    /// # Panics
    /// If the polytope is not six-dimensional.
    pub fn new(
        question: &PolytopeQuestion<'_>,
        starts: Range<usize>,
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let mut union = Self {
            first: starts.start,
            rows: question.avoid.offsets().len(),
            modes: question.modes.len(),
            starts: vec![StartSets::default(); starts.len()],
        };
        let first = starts.start;
        visit_sets(question, starts, budget, |start, instant, chain| {
            union.starts[start - first].add(instant, chain);
        })?;
        Ok(union)
    }

    /// How many sets [`Self::new`] would hold, without holding them.
    ///
    /// # Errors
    /// As [`Self::new`].
    ///
    /// # Panics
    /// As [`Self::new`].
    pub fn count(
        question: &PolytopeQuestion<'_>,
        starts: Range<usize>,
        budget: Budget<'_>,
    ) -> Result<usize, Interruption> {
        let mut count = 0;
        visit_sets(question, starts, budget, |_, _, chain| count += chain.sets())?;
        Ok(count)
    }

    /// Puts ranges of starts that follow each other together; `None` if they do not.
    #[must_use]
    pub fn joined(parts: Vec<Self>) -> Option<Self> {
        let mut parts = parts.into_iter();
        let mut whole = parts.next()?;
        for part in parts {
            let follows = part.first == whole.first + whole.starts.len()
                && (part.rows, part.modes) == (whole.rows, whole.modes);
            if !follows {
                return None;
            }
            whole.starts.extend(part.starts);
        }
        Some(whole)
    }

    /// Number of starts.
    #[must_use]
    pub fn starts(&self) -> usize {
        self.starts.len()
    }

    /// Number of sets that are not empty.
    #[must_use]
    pub fn len(&self) -> usize {
        self.starts.iter().map(|start| start.sets.len()).sum()
    }

    /// No set at all?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of all numbers.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        let of = |start: &StartSets| {
            (start.normals.len() + start.offsets.len()) * size_of::<f64>()
                + start.kept.len() * size_of::<usize>()
                + start.sets.len() * size_of::<(usize, usize)>()
        };
        self.starts.iter().map(of).sum()
    }

    /// The sets of start k (folded into the period), by instant, then by mode.
    pub fn sets(&self, k: usize) -> impl Iterator<Item = ReachablePolytope<'_>> {
        let count = self.starts.len().max(1);
        let start = &self.starts[(k + count - self.first % count) % count];
        start.sets.iter().enumerate().map(|(i, &(place, mode))| ReachablePolytope {
            mode,
            instant: start.kept[place],
            normals: &start.normals[place * self.rows * 6..][..self.rows * 6],
            offsets: &start.offsets[i * self.rows..][..self.rows],
        })
    }

    /// Appends the sets.
    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.count(self.first);
        writer.count(self.rows);
        writer.count(self.modes);
        writer.count(self.starts.len());
        for start in &self.starts {
            writer.small_counts(&start.kept);
            writer.count(start.sets.len());
            start.sets.iter().for_each(|&(place, mode)| writer.small_counts(&[place, mode]));
            writer.numbers(&start.normals);
            writer.numbers(&start.offsets);
        }
    }

    /// Reads what [`Self::write`] wrote, for the starts `starts` and so many rows, modes and
    /// instants.
    pub(crate) fn read(
        reader: &mut Reader<'_>,
        starts: Range<usize>,
        rows: usize,
        modes: usize,
        instants: usize,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let sizes = [reader.count()?, reader.count()?, reader.count()?, reader.count()?];
        if sizes != [starts.start, rows, modes, starts.len()] {
            return Err(reader.fault("polytopes of another problem").into());
        }
        let start = |reader: &mut Reader<'_>| -> Result<StartSets, ReadError> {
            budget.check()?;
            let kept = reader.small_counts()?;
            let count = reader.count()?;
            let set = |reader: &mut Reader<'_>| match reader.small_counts()?[..] {
                [place, mode] if place < kept.len() && mode < modes => Ok((place, mode)),
                _ => Err(reader.fault("a set of no instant or mode")),
            };
            let sets = items(count, reader, budget, set)?;
            let (normals, offsets) = (numbers(reader, budget)?, numbers(reader, budget)?);
            let found = StartSets { normals, kept, sets, offsets };
            let fits = found.normals.len() == found.kept.len() * rows * 6
                && found.offsets.len() == found.sets.len() * rows
                && found.kept.iter().all(|&instant| instant < instants)
                && found.kept.is_sorted_by(|a, b| a < b)
                && found.sets.is_sorted_by(|a, b| a < b);
            if fits { Ok(found) } else { Err(reader.fault("sets of other sizes").into()) }
        };
        let first = starts.start;
        let starts = starts.map(|_| start(reader)).collect::<Result<_, _>>()?;
        Ok(Self { first, rows, modes, starts })
    }

    /// The `count` sets of start k in which `x` is deepest or to which it is nearest, by
    /// [`ReachablePolytope::nearness`], nearest first.
    #[must_use]
    pub fn nearest(
        &self,
        k: usize,
        x: &RelativeVector,
        count: usize,
    ) -> Vec<(f64, ReachablePolytope<'_>)> {
        nearest_of(self.sets(k), x, count)
    }

    /// The same over the starts of the whole period: the union (12) taken literally.
    #[must_use]
    pub fn nearest_untimed(
        &self,
        x: &RelativeVector,
        count: usize,
    ) -> Vec<(f64, ReachablePolytope<'_>)> {
        let starts = self.first..self.first + self.starts.len();
        nearest_of(starts.flat_map(|k| self.sets(k)), x, count)
    }
}

fn nearest_of<'a>(
    sets: impl Iterator<Item = ReachablePolytope<'a>>,
    x: &RelativeVector,
    count: usize,
) -> Vec<(f64, ReachablePolytope<'a>)> {
    let mut near: Vec<(f64, ReachablePolytope<'a>)> = Vec::with_capacity(count + 1);
    for set in sets {
        let nearness = set.nearness(x);
        if near.len() < count || near.last().is_some_and(|last| nearness < last.0) {
            let place = near.partition_point(|other| other.0 <= nearness);
            near.insert(place, (nearness, set));
            near.truncate(count);
        }
    }
    near
}

impl ReachablePolytope<'_> {
    /// H_i x - l_i, row by row: all at most 0 inside.
    #[must_use]
    pub fn excess(&self, x: &RelativeVector) -> Vec<f64> {
        self.normals
            .chunks_exact(6)
            .zip(self.offsets)
            .map(|(h, l)| (0..6).map(|j| h[j] * x[j]).sum::<f64>() - l)
            .collect()
    }

    /// Is the state in the set?
    #[must_use]
    pub fn contains(&self, x: &RelativeVector) -> bool {
        self.excess(x).iter().all(|&e| e <= 0.0)
    }

    /// max_i H_i x / l_i where the origin is inside, the gauge; else 1 plus the largest excess by
    /// the size of its own terms. Without a unit either way, at most 1 inside.
    #[must_use]
    pub fn nearness(&self, x: &RelativeVector) -> f64 {
        let gauge = self.offsets.iter().all(|&l| l > 0.0);
        let rows = self.normals.chunks_exact(6).zip(self.offsets);
        let values = rows.map(|(h, &l)| {
            let product: f64 = (0..6).map(|j| h[j] * x[j]).sum();
            if gauge {
                return product / l;
            }
            let size = l.abs() + (0..6).map(|j| (h[j] * x[j]).abs()).sum::<f64>();
            1.0 + (product - l) / size.max(f64::MIN_POSITIVE)
        });
        values.fold(f64::NEG_INFINITY, f64::max)
    }

    /// The set as a polytope of its own.
    #[must_use]
    pub fn polytope(&self) -> Polytope {
        Polytope::new(
            DMatrix::from_row_slice(self.offsets.len(), 6, self.normals),
            DVector::from_column_slice(self.offsets),
        )
    }
}

/// How emptiness of {x : H Phi x <= l} is decided; Phi can be inverted, so H alone matters.
enum Emptiness {
    /// H = [M; -M] with M square and regular: empty if and only if some l_i + l_{i + 6} < 0.
    Box,
    /// A linear program over the original normals.
    General(DMatrix<f64>),
}

impl Emptiness {
    fn of(avoid: &Polytope) -> Self {
        let normals = avoid.normals();
        let paired = normals.nrows() == 12
            && normals.rows(0, 6) == -normals.rows(6, 6)
            && normals.rows(0, 6).into_owned().try_inverse().is_some();
        if paired { Self::Box } else { Self::General(normals.clone()) }
    }

    fn is_empty(&self, offsets: &[f64]) -> bool {
        match self {
            Self::Box => (0..6).any(|i| offsets[i] + offsets[i + 6] < 0.0),
            Self::General(normals) => {
                polytope_is_empty(normals, &DVector::from_column_slice(offsets))
            }
        }
    }
}

impl StartSets {
    fn add(&mut self, instant: usize, chain: &Chain) {
        self.normals.extend(chain.normals.iter().flat_map(|row| row.iter().copied()));
        for (mode, offsets) in chain.offsets.iter().enumerate() {
            if let Some(offsets) = offsets {
                self.sets.push((self.kept.len(), mode));
                self.offsets.extend(offsets);
            }
        }
        self.kept.push(instant);
    }
}

/// Every start and instant after it at which some mode's set is not empty; for each start, instants
/// ascend.
///
/// The sets that end at one moment are one chain back through the starts before it, so a chain is
/// walked once for all of them.
fn visit_sets(
    question: &PolytopeQuestion<'_>,
    starts: Range<usize>,
    budget: Budget<'_>,
    mut visit: impl FnMut(usize, usize, &Chain),
) -> Result<(), Interruption> {
    assert_eq!(question.avoid.normals().ncols(), 6, "a polytope of relative states");
    let emptiness = Emptiness::of(question.avoid);
    let (parts, horizon) = (question.plant.fraction_count(), question.horizon);
    if starts.is_empty() {
        return Ok(());
    }
    for end in starts.start..starts.end + horizon {
        for part in 0..parts {
            let mut chain = Chain::new(question);
            if part > 0 {
                chain.back(question, &emptiness, question.plant.fraction(end, part), budget)?;
            }
            for start in (starts.start.max(end.saturating_sub(horizon))..=end).rev() {
                if start < end {
                    chain.back(question, &emptiness, question.plant.step(start), budget)?;
                }
                if chain.sets() == 0 {
                    break;
                }
                let instant = (end - start) * parts + part;
                if start < starts.end && instant <= horizon * parts {
                    visit(start, instant, &chain);
                }
            }
        }
    }
    Ok(())
}

/// The sets of all modes that end at one moment, taken back step by step.
struct Chain {
    normals: Vec<SMatrix<f64, 1, 6>>,
    /// `None` once empty: then empty for ever.
    offsets: Vec<Option<Vec<f64>>>,
}

impl Chain {
    fn new(question: &PolytopeQuestion<'_>) -> Self {
        let avoid = question.avoid;
        let normal = |row: usize| avoid.normals().fixed_view::<1, 6>(row, 0).into_owned();
        let offsets = avoid.offsets().as_slice().to_vec();
        Self {
            normals: (0..offsets.len()).map(normal).collect(),
            offsets: vec![Some(offsets); question.modes.len()],
        }
    }

    /// Modes whose set is not empty.
    fn sets(&self) -> usize {
        self.offsets.iter().flatten().count()
    }

    /// One step of (20): H <- H A, l <- min over u of l - H B u, which takes each working
    /// thruster's push along the row.
    fn back(
        &mut self,
        question: &PolytopeQuestion<'_>,
        emptiness: &Emptiness,
        step: &HeldStep,
        budget: Budget<'_>,
    ) -> Result<(), Interruption> {
        budget.check()?;
        for (i, row) in self.normals.iter_mut().enumerate() {
            let along = product_fixed(row, &step.b);
            let push: Vec<f64> = question
                .full_forces_n
                .iter()
                .map(|force| (0..3).map(|c| along[c] * force[c]).sum::<f64>().max(0.0))
                .collect();
            for (bits, offsets) in question.modes.iter().zip(&mut self.offsets) {
                let Some(offsets) = offsets else { continue };
                let working = push.iter().enumerate().filter(|(j, _)| bits >> j & 1 == 1);
                offsets[i] -= working.map(|(_, push)| push).sum::<f64>();
            }
            *row = product_fixed(row, &step.a);
        }
        for offsets in &mut self.offsets {
            if matches!(emptiness, Emptiness::General(_)) {
                budget.check()?;
            }
            if offsets.as_ref().is_some_and(|offsets| emptiness.is_empty(offsets)) {
                *offsets = None;
            }
        }
        Ok(())
    }
}
