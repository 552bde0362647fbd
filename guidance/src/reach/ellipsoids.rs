//! Backward reachable sets of an ellipsoid in free drift, for every start along the orbit.

use std::ops::Range;

use nalgebra::{DMatrix, SMatrix};

use super::reading::{ReadError, numbers};
use crate::{
    budget::{Budget, Interruption},
    bytes::{Reader, Writer},
    dynamics::{PeriodicPlant, RelativeVector, TransitionMatrix},
    matrices::product_fixed,
    sets::CentredEllipsoid,
};

/// Coefficients of x'Px when radial and along-track motion do not mix with the normal one: 10 in
/// the plane, 3 across it.
const DECOUPLED: usize = 13;
/// Coefficients of a general symmetric form.
const COUPLED: usize = 21;
/// Components of the state within the orbital plane.
const PLANE: [usize; 4] = [0, 1, 3, 4];
/// Components across it.
const ACROSS: [usize; 2] = [2, 5];
/// Instants between two looks at the budget.
const BUDGET_PERIOD: usize = 1024;

/// For every start k of a range and every instant t = 0 .. N s after it, the set of states at k
/// that drift into the ellipsoid at that instant: {x : x' Phi' P Phi x <= 1}. Instants count the
/// s parts of a step. [AguilarMarsillach2022, eq. 22]
///
/// The sets belong to their start's own time index. A craft at index k is threatened by the sets
/// of start k alone; the union over all starts, which the paper takes in (12), holds states that
/// no craft can reach at the index for which they are dangerous, and makes the paper's own start
/// infeasible. It is offered as [`EllipsoidUnion::nearest_untimed`].
#[derive(Debug, Clone, PartialEq)]
pub struct EllipsoidUnion {
    first: usize,
    starts: usize,
    instants: usize,
    terms: usize,
    /// [start][term][instant]: one start's search runs straight through memory.
    coefficients: Vec<f64>,
}

/// A set near a state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NearEllipsoid {
    /// Start k.
    pub start: usize,
    /// Instant after the start, in parts of a step.
    pub instant: usize,
    /// x'Px: at most 1 inside, the square of the gauge.
    pub gauge_squared: f64,
}

impl EllipsoidUnion {
    /// The sets of the starts `starts` for a safety horizon of `horizon` steps.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    ///
    /// # Panics
    /// If the ellipsoid is not six-dimensional.
    pub fn new(
        plant: &PeriodicPlant,
        set: &CentredEllipsoid,
        horizon: usize,
        starts: Range<usize>,
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        assert_eq!(set.precision().nrows(), 6, "an ellipsoid of relative states");
        let precision = TransitionMatrix::from_fn(|i, j| set.precision()[(i, j)]);
        let mixes = PLANE.iter().any(|&i| ACROSS.iter().any(|&j| precision[(i, j)] != 0.0));
        let parts = plant.fraction_count();
        let instants = horizon * parts + 1;
        let terms = if mixes { COUPLED } else { DECOUPLED };
        let mut coefficients = vec![0.0; starts.len() * terms * instants];
        for (block, k) in coefficients.chunks_exact_mut(terms * instants).zip(starts.clone()) {
            let mut phi = TransitionMatrix::identity();
            for t in 0..instants {
                if t % BUDGET_PERIOD == 0 {
                    budget.check()?;
                }
                let (step, part) = (t / parts, t % parts);
                if part == 0 {
                    if step > 0 {
                        phi = product_fixed(&plant.step(k + step - 1).a, &phi);
                    }
                    store(block, instants, t, &phi, &precision, mixes);
                } else {
                    let partial = product_fixed(&plant.fraction(k + step, part).a, &phi);
                    store(block, instants, t, &partial, &precision, mixes);
                }
            }
        }
        Ok(Self { first: starts.start, starts: starts.len(), instants, terms, coefficients })
    }

    /// Puts ranges of starts that follow each other together; `None` if they do not.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn joined(parts: Vec<Self>, budget: Budget<'_>) -> Result<Option<Self>, Interruption> {
        let numbers: usize = parts.iter().map(|part| part.coefficients.len()).sum();
        let mut parts = parts.into_iter();
        let Some(mut whole) = parts.next() else { return Ok(None) };
        whole.coefficients.reserve_exact(numbers - whole.coefficients.len());
        for part in parts {
            budget.check()?;
            let follows = part.first == whole.first + whole.starts
                && (part.instants, part.terms) == (whole.instants, whole.terms);
            if !follows {
                return Ok(None);
            }
            whole.starts += part.starts;
            whole.coefficients.extend(part.coefficients);
        }
        Ok(Some(whole))
    }

    /// Number of starts.
    #[must_use]
    pub fn starts(&self) -> usize {
        self.starts
    }

    /// Number of sets.
    #[must_use]
    pub fn len(&self) -> usize {
        self.starts * self.instants
    }

    /// No set at all?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of all coefficients.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.coefficients.len() * size_of::<f64>()
    }

    /// P of the set of start k (folded into the period) and an instant.
    #[must_use]
    pub fn precision(&self, k: usize, instant: usize) -> DMatrix<f64> {
        let block = self.block(k);
        let mut matrix = DMatrix::zeros(6, 6);
        for (term, (i, j)) in pairs(self.terms).into_iter().enumerate() {
            let value = block[term * self.instants + instant];
            matrix[(i, j)] = value;
            matrix[(j, i)] = value;
        }
        matrix
    }

    /// Half-space that holds the set of start k and `instant` and touches it where `x` is
    /// nearest along its ray: (h, h x - 1). `None` at the origin.
    #[must_use]
    pub fn tangent(
        &self,
        k: usize,
        instant: usize,
        x: &RelativeVector,
    ) -> Option<(RelativeVector, f64)> {
        let precision = self.precision(k, instant);
        let px = RelativeVector::from_fn(|i, _| (0..6).map(|j| precision[(i, j)] * x[j]).sum());
        let gauge = (0..6).map(|i| px[i] * x[i]).sum::<f64>().sqrt();
        (gauge > 0.0).then(|| (px / gauge, gauge - 1.0))
    }

    /// x'Px for every instant of start k, into `gauges`.
    pub fn gauges_squared(&self, k: usize, x: &RelativeVector, gauges: &mut Vec<f64>) {
        gauges.clear();
        gauges.resize(self.instants, 0.0);
        let block = self.block(k);
        for (term, (i, j)) in pairs(self.terms).into_iter().enumerate() {
            let weight = if i == j { x[i] * x[i] } else { 2.0 * x[i] * x[j] };
            let values = &block[term * self.instants..][..self.instants];
            gauges.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value);
        }
    }

    /// The `count` sets of start k with the least gauge at `x`, least first.
    ///
    /// Ranked by gauge, which has no unit: a Euclidean distance would add metres to metres per
    /// second, as the paper's (27) does.
    #[must_use]
    pub fn nearest(&self, k: usize, x: &RelativeVector, count: usize) -> Vec<NearEllipsoid> {
        let mut gauges = Vec::new();
        self.gauges_squared(k, x, &mut gauges);
        let mut near: Vec<NearEllipsoid> = Vec::with_capacity(count + 1);
        for (instant, &gauge_squared) in gauges.iter().enumerate() {
            keep_least(&mut near, count, NearEllipsoid { start: k, instant, gauge_squared });
        }
        near
    }

    /// The same over the starts of the whole period: the union (12) taken literally.
    #[must_use]
    pub fn nearest_untimed(&self, x: &RelativeVector, count: usize) -> Vec<NearEllipsoid> {
        let mut near: Vec<NearEllipsoid> = Vec::with_capacity(count + 1);
        for k in self.first..self.first + self.starts {
            self.nearest(k, x, count).into_iter().for_each(|set| keep_least(&mut near, count, set));
        }
        near
    }

    /// Appends the coefficients.
    pub(crate) fn write(&self, writer: &mut Writer) {
        writer.count(self.first);
        writer.count(self.starts);
        writer.count(self.instants);
        writer.count(self.terms);
        writer.numbers(&self.coefficients);
    }

    /// Reads what [`Self::write`] wrote, for the starts `starts` and so many instants.
    pub(crate) fn read(
        reader: &mut Reader<'_>,
        starts: Range<usize>,
        instants: usize,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let union = Self {
            first: reader.count()?,
            starts: reader.count()?,
            instants: reader.count()?,
            terms: reader.count()?,
            coefficients: numbers(reader, budget)?,
        };
        let sizes = (union.first, union.starts, union.instants)
            == (starts.start, starts.len(), instants)
            && [DECOUPLED, COUPLED].contains(&union.terms)
            && union.coefficients.len() == starts.len() * instants * union.terms;
        if sizes { Ok(union) } else { Err(reader.fault("ellipsoids of another problem").into()) }
    }

    fn block(&self, k: usize) -> &[f64] {
        let start = (k + self.starts - self.first % self.starts.max(1)) % self.starts.max(1);
        let length = self.terms * self.instants;
        &self.coefficients[start * length..][..length]
    }
}

/// Keeps the `count` least, in order; the earlier of equals first.
fn keep_least(near: &mut Vec<NearEllipsoid>, count: usize, set: NearEllipsoid) {
    if near.len() == count && near.last().is_none_or(|l| set.gauge_squared >= l.gauge_squared) {
        return;
    }
    let place = near.partition_point(|other| other.gauge_squared <= set.gauge_squared);
    near.insert(place, set);
    near.truncate(count);
}

/// Entries of the symmetric matrix that the terms are, in their order.
fn pairs(terms: usize) -> Vec<(usize, usize)> {
    let within = |components: &[usize]| -> Vec<(usize, usize)> {
        (0..components.len())
            .flat_map(|i| (0..=i).map(move |j| (i, j)))
            .map(|(i, j)| (components[i], components[j]))
            .collect()
    };
    if terms == COUPLED {
        within(&[0, 1, 2, 3, 4, 5])
    } else {
        within(&PLANE).into_iter().chain(within(&ACROSS)).collect()
    }
}

fn store(
    block: &mut [f64],
    instants: usize,
    t: usize,
    phi: &TransitionMatrix,
    precision: &TransitionMatrix,
    mixes: bool,
) {
    let mut term = 0;
    let mut put = |value: f64| {
        block[term * instants + t] = value;
        term += 1;
    };
    if mixes {
        congruence(phi, precision, &[0, 1, 2, 3, 4, 5], &mut put);
    } else {
        congruence::<4>(phi, precision, &PLANE, &mut put);
        congruence::<2>(phi, precision, &ACROSS, &mut put);
    }
}

/// Lower half of Phi' P Phi, row by row, for the rows and columns of some components that do not
/// mix with the others.
fn congruence<const N: usize>(
    phi: &TransitionMatrix,
    precision: &TransitionMatrix,
    components: &[usize; N],
    put: &mut impl FnMut(f64),
) {
    let of = |m: &TransitionMatrix| {
        SMatrix::<f64, N, N>::from_fn(|i, j| m[(components[i], components[j])])
    };
    let phi = of(phi);
    let moved = product_fixed(&of(precision), &phi);
    for i in 0..N {
        for j in 0..=i {
            put((0..N).map(|k| phi[(k, i)] * moved[(k, j)]).sum());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        orbit::KeplerOrbit,
        units::{Angle, Distance, Mass, Seconds},
    };

    fn plant(fractions: usize) -> PeriodicPlant {
        let axis = Distance::from_metres(7_419_320.0);
        let orbit = KeplerOrbit::new(axis, 0.1, Angle::from_degrees(145.0), None).unwrap();
        let (mass, step) = (Mass::from_kilograms(4000.0), Seconds::from_seconds(30.0));
        PeriodicPlant::new(&orbit, mass, step, 212, fractions)
    }

    fn approach_ellipsoid() -> CentredEllipsoid {
        CentredEllipsoid::from_semi_axes(&[1e3, 2e3, 1e3, 100.0, 100.0, 100.0])
    }

    fn state() -> RelativeVector {
        RelativeVector::from_column_slice(&[-700.0, 3000.0, 150.0, 0.5, -2.0, 0.3])
    }

    #[test]
    fn gauge_of_a_set_is_the_gauge_where_the_drift_ends() {
        let plant = plant(3);
        let set = approach_ellipsoid();
        let union = EllipsoidUnion::new(&plant, &set, 40, 200..215, Budget::UNLIMITED).unwrap();
        for (k, instant) in [(200, 0), (205, 3 * 17), (211, 3 * 40), (214, 3 * 9 + 2)] {
            let (step, part) = (instant / 3, instant % 3);
            let mut end = product_fixed(&plant.transition(k, step), &state());
            if part > 0 {
                end = product_fixed(&plant.fraction(k + step, part).a, &end);
            }
            let end = nalgebra::DVector::from_column_slice(end.as_slice());
            let mut gauges = Vec::new();
            union.gauges_squared(k, &state(), &mut gauges);
            let error = gauges[instant] / set.gauge_squared(&end) - 1.0;
            assert!(error.abs() < 1e-11, "{k} {instant}: {error:e}");
        }
    }

    #[test]
    fn coupled_ellipsoids_keep_all_their_terms() {
        let plant = plant(1);
        let mut precision = approach_ellipsoid().precision().clone();
        precision[(0, 2)] = 0.3e-6;
        precision[(2, 0)] = 0.3e-6;
        let tilted = CentredEllipsoid::from_precision(precision).unwrap();
        let union = EllipsoidUnion::new(&plant, &tilted, 10, 0..2, Budget::UNLIMITED).unwrap();
        let end = product_fixed(&plant.transition(1, 7), &state());
        let end = nalgebra::DVector::from_column_slice(end.as_slice());
        let mut gauges = Vec::new();
        union.gauges_squared(1, &state(), &mut gauges);
        assert!((gauges[7] / tilted.gauge_squared(&end) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn nearest_are_the_least_of_all() {
        let union =
            EllipsoidUnion::new(&plant(1), &approach_ellipsoid(), 300, 0..4, Budget::UNLIMITED)
                .unwrap();
        let near = union.nearest(2, &state(), 3);
        let mut gauges = Vec::new();
        union.gauges_squared(2, &state(), &mut gauges);
        let mut sorted = gauges.clone();
        sorted.sort_by(f64::total_cmp);
        let found: Vec<f64> = near.iter().map(|set| set.gauge_squared).collect();
        assert_eq!(found, sorted[..3]);
        let everywhere = union.nearest_untimed(&state(), 1)[0];
        assert!(everywhere.gauge_squared <= near[0].gauge_squared);
        let again = union.nearest(everywhere.start, &state(), 1)[0];
        assert_eq!(again, everywhere);
    }

    #[test]
    fn shards_join_to_the_whole() {
        let (plant, set) = (plant(1), approach_ellipsoid());
        let whole = EllipsoidUnion::new(&plant, &set, 20, 0..9, Budget::UNLIMITED).unwrap();
        let part =
            |starts| EllipsoidUnion::new(&plant, &set, 20, starts, Budget::UNLIMITED).unwrap();
        let joined = |parts| EllipsoidUnion::joined(parts, Budget::UNLIMITED).unwrap();
        assert_eq!(joined(vec![part(0..4), part(4..9)]), Some(whole));
        assert_eq!(joined(vec![part(0..4), part(5..9)]), None);
        assert_eq!(joined(Vec::new()), None);
    }
}
