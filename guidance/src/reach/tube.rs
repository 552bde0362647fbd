//! The error tube of u = v + K (x - z): S(j) = W + A_K W + ... + A_K^(j-1) W.

use nalgebra::{DMatrix, DVector, DVectorView, Vector3};

use crate::{
    budget::{Budget, Interruption},
    matrices::product,
    sets::Zonotope,
};

/// The sums are stopped when every entry of A_K^i G and K A_K^i G is below this, so the tail that
/// is left out is below rounding. Stated in the artifact.
const SERIES_TOLERANCE: f64 = 1e-18;
/// Most terms of a sum. A slower loop than this contracts by less than 1 % a step.
const SERIES_TERMS_MAX: usize = 5000;
/// Most generators for which the supremum in [`Tube::decrease`] is enumerated.
const ENUMERATED_GENERATORS_MAX: usize = 14;
/// Most products in that enumeration: a few seconds. A loop that contracts slowly has many terms.
const ENUMERATED_PRODUCTS_MAX: usize = 4_000_000_000;

/// The tube of a loop A_K = A + B K under disturbances in W. [Quartullo2025a, eq. 15], where
/// "A_i^k" must read A_K^i; [Quartullo2025b, eq. 6].
#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    /// A_K^i G, n x p, i = 0, 1, ...
    powers: Vec<DMatrix<f64>>,
    /// K A_K^i G, m x p.
    fed_back: Vec<DMatrix<f64>>,
    /// First three rows of A_K^i G, generator by generator, one after the other: what position
    /// constraints ask for at every stage of every step.
    positions: Vec<Vector3<f64>>,
}

/// Why there is no tube.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TubeError {
    /// The loop does not contract.
    #[error("A + B K does not contract below 1e-18 within {SERIES_TERMS_MAX} steps")]
    NoContraction,
    /// Stopped from outside.
    #[error("stopped: {0:?}")]
    Interrupted(Interruption),
}

impl From<Interruption> for TubeError {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

/// By how much the optimal cost falls at each step at least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decrease {
    /// lambda_bar.
    pub lambda_bar: f64,
    /// The supremum over W was found exactly; else `lambda_bar` is a lower bound.
    pub exact: bool,
}

impl Tube {
    /// For A_K (n x n), K (m x n) and W.
    ///
    /// # Errors
    /// [`TubeError`]: the powers of A_K do not vanish, or the budget ended.
    pub fn new(
        closed_loop: &DMatrix<f64>,
        gain: &DMatrix<f64>,
        disturbance: &Zonotope,
        budget: Budget<'_>,
    ) -> Result<Self, TubeError> {
        let mut powers = Vec::new();
        let mut fed_back = Vec::new();
        // Also watched without W, so that W = {0} does not hide an unstable loop.
        let mut power = DMatrix::identity(closed_loop.nrows(), closed_loop.ncols());
        let mut generators = disturbance.generators().clone();
        for _ in 0..SERIES_TERMS_MAX {
            budget.check()?;
            let seen = product(gain, &generators);
            let size = generators.iter().chain(seen.iter()).fold(0.0_f64, |a, x| a.max(x.abs()));
            if power.amax() < 1.0 && size < SERIES_TOLERANCE {
                let first_three = |g: DVectorView<'_, f64>| {
                    let entry = |i: usize| g.get(i).copied().unwrap_or(0.0);
                    Vector3::new(entry(0), entry(1), entry(2))
                };
                let positions = powers.iter().flat_map(|power: &DMatrix<f64>| {
                    power.column_iter().map(|g| first_three(g.as_view())).collect::<Vec<_>>()
                });
                let positions = positions.collect();
                return Ok(Self { powers, fed_back, positions });
            }
            if !(power.amax() < 1e30) {
                return Err(TubeError::NoContraction);
            }
            powers.push(generators.clone());
            fed_back.push(seen);
            generators = product(closed_loop, &generators);
            power = product(closed_loop, &power);
        }
        Err(TubeError::NoContraction)
    }

    /// Bytes of a tube whose sums are as long as they may be, for n states, m inputs and so many
    /// generators.
    #[must_use]
    pub fn bytes_max(n: usize, m: usize, generators: usize) -> usize {
        // A generator's image, what is fed back of it, its position.
        let numbers = generators.saturating_mul(n.saturating_add(m).saturating_add(3));
        let term = numbers.saturating_mul(size_of::<f64>());
        let term = term.saturating_add(2 * size_of::<DMatrix<f64>>());
        term.saturating_mul(SERIES_TERMS_MAX)
    }

    /// Terms kept of the infinite sums.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.powers.len()
    }

    /// The first neglected term is below this.
    #[must_use]
    pub fn tolerance(&self) -> f64 {
        SERIES_TOLERANCE
    }

    /// A_K^i G, n x p; `None` beyond the kept terms.
    #[must_use]
    pub fn power(&self, i: usize) -> Option<&DMatrix<f64>> {
        self.powers.get(i)
    }

    /// Generators of the sum of A_K^i W over `exponents`, side by side.
    #[must_use]
    pub fn sum(&self, exponents: impl IntoIterator<Item = usize>) -> Zonotope {
        let columns: Vec<DVector<f64>> = exponents
            .into_iter()
            .filter_map(|i| self.powers.get(i))
            .flat_map(|power| power.column_iter().map(|column| column.into_owned()))
            .collect();
        let n = self.powers.first().map_or(0, DMatrix::nrows);
        Zonotope::centred(if columns.is_empty() {
            DMatrix::zeros(n, 0)
        } else {
            DMatrix::from_columns(&columns)
        })
    }

    /// Half widths of the box around S(j), for j = 0 .. `last`: (last + 1) x n.
    #[must_use]
    pub fn half_widths(&self, last: usize, states: usize) -> DMatrix<f64> {
        running_sums(&self.powers, last, states)
    }

    /// Half widths of the box around K S(j), for j = 0 .. `last`: (last + 1) x m. This is what
    /// the tube takes from a box of inputs. [Quartullo2025a, eq. 20]
    #[must_use]
    pub fn input_half_widths(&self, last: usize, inputs: usize) -> DMatrix<f64> {
        running_sums(&self.fed_back, last, inputs)
    }

    /// rho(h, A_K^i W) = sum_g |h' A_K^i G_g|: what term i adds to the margin of the row `normal`.
    #[must_use]
    pub fn state_term(&self, i: usize, normal: &[f64]) -> f64 {
        self.powers.get(i).map_or(0.0, |power| support(power, normal))
    }

    /// rho(h_i, S(j)) for the normals h_i of position constraints: how far face i moves inwards
    /// at stage j. [Quartullo2025a, sec. IV.B]
    #[must_use]
    pub fn face_margins<const F: usize>(
        &self,
        normals: &[Vector3<f64>; F],
        stage: usize,
    ) -> [f64; F] {
        let mut margins = [0.0; F];
        let generators = self.powers.first().map_or(0, DMatrix::ncols);
        let terms = stage.min(self.terms()) * generators;
        for position in &self.positions[..terms] {
            for (margin, normal) in margins.iter_mut().zip(normals) {
                *margin += normal.dot(position).abs();
            }
        }
        margins
    }

    /// rho(h, K A_K^i W): the same for a row on the input.
    #[must_use]
    pub fn input_term(&self, i: usize, normal: &[f64]) -> f64 {
        self.fed_back.get(i).map_or(0.0, |power| support(power, normal))
    }

    /// lambda_bar = 1 - sup over w in W of sum_j (tracking |A_K^j w|_1 + fuel |K A_K^j w|_1).
    /// [Quartullo2025a, eq. 23; Quartullo2025b, eq. 14]
    ///
    /// The supremum of a convex function over a zonotope is at a sign combination of its
    /// generators: enumerated up to 14 of them where that does not take too long, else bounded by
    /// the sum over the generators.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn decrease(
        &self,
        fuel: f64,
        tracking: f64,
        budget: Budget<'_>,
    ) -> Result<Decrease, Interruption> {
        let p = self.powers.first().map_or(0, DMatrix::ncols);
        if p == 0 || (fuel == 0.0 && tracking == 0.0) {
            return Ok(Decrease { lambda_bar: 1.0, exact: true });
        }
        let weigh = |combine: &dyn Fn(&DMatrix<f64>) -> f64| {
            let tracked: f64 = self.powers.iter().map(combine).sum();
            let spent: f64 = self.fed_back.iter().map(combine).sum();
            tracking * tracked + fuel * spent
        };
        if p > ENUMERATED_GENERATORS_MAX || self.sign_products(p) > ENUMERATED_PRODUCTS_MAX {
            // Triangle inequality.
            let supremum = weigh(&|power| power.iter().map(|x| x.abs()).sum());
            return Ok(Decrease { lambda_bar: 1.0 - supremum, exact: false });
        }
        // w and -w weigh the same: the last sign is fixed.
        let mut supremum = 0.0;
        for signs in 0..1usize << (p - 1) {
            budget.check()?;
            let weight = weigh(&|power| {
                power
                    .row_iter()
                    .map(|row| {
                        let signed = row
                            .iter()
                            .enumerate()
                            .map(|(g, x)| if signs >> g & 1 == 1 { -x } else { *x });
                        signed.sum::<f64>().abs()
                    })
                    .sum()
            });
            supremum = f64::max(supremum, weight);
        }
        Ok(Decrease { lambda_bar: 1.0 - supremum, exact: true })
    }
}

impl Tube {
    /// Products in the enumeration of all signs of p generators.
    fn sign_products(&self, p: usize) -> usize {
        let entries = |terms: &[DMatrix<f64>]| terms.iter().map(DMatrix::len).sum::<usize>();
        (entries(&self.powers) + entries(&self.fed_back)).saturating_mul(1 << (p - 1))
    }
}

fn support(generators: &DMatrix<f64>, normal: &[f64]) -> f64 {
    generators
        .column_iter()
        .map(|g| g.iter().zip(normal).map(|(g, h)| g * h).sum::<f64>().abs())
        .sum()
}

fn running_sums(terms: &[DMatrix<f64>], last: usize, components: usize) -> DMatrix<f64> {
    let mut sums = DMatrix::zeros(last + 1, components);
    for j in 0..last {
        for r in 0..components {
            let term: f64 =
                terms.get(j).map_or(0.0, |term| term.row(r).iter().map(|x| x.abs()).sum());
            sums[(j + 1, r)] = sums[(j, r)] + term;
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    fn double_integrator() -> Tube {
        // [Quartullo2025b, sec. 4.1]
        let gain = DMatrix::from_row_slice(1, 2, &[-0.06, -0.5]);
        let closed = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, -0.06, 0.5]);
        let w = DMatrix::from_row_slice(2, 2, &[0.1, 0.0, 0.0, 0.4]);
        Tube::new(&closed, &gain, &Zonotope::centred(w), Budget::UNLIMITED).unwrap()
    }

    #[test]
    fn decrease_of_the_double_integrator_is_the_papers() {
        // Paper: 0.27; the independent implementation: 0.2671478.
        let decrease = double_integrator().decrease(1.0, 0.02, Budget::UNLIMITED).unwrap();
        assert!((decrease.lambda_bar - 0.2671478).abs() < 1e-7 && decrease.exact);
    }

    #[test]
    fn half_widths_grow_and_converge() {
        let tube = double_integrator();
        let widths = tube.half_widths(400, 2);
        assert_eq!(widths.row(0).amax(), 0.0);
        assert!((widths[(1, 0)] - 0.1).abs() < 1e-15);
        for j in 0..400 {
            assert!(widths[(j + 1, 0)] >= widths[(j, 0)]);
        }
        assert_eq!(widths.row(399), widths.row(400));
    }

    #[test]
    fn supremum_that_takes_too_long_is_bounded_instead() {
        let tube = |pole: f64| {
            let closed = DMatrix::identity(14, 14) * pole;
            let gain = DMatrix::from_element(1, 14, 0.1);
            let set = Zonotope::centred(DMatrix::identity(14, 14) * 1e-6);
            let tube = Tube::new(&closed, &gain, &set, Budget::UNLIMITED).unwrap();
            tube.decrease(1.0, 1.0, Budget::UNLIMITED).unwrap()
        };
        let (quick, slow) = (tube(1e-3), tube(0.99));
        assert!(quick.exact && !slow.exact);
        // 14 generators with |w|_1 = 1e-6 and |K w|_1 = 1e-7, and a geometric series.
        assert!((1.0 - slow.lambda_bar - 1.1 * 14e-6 / 0.01).abs() < 1e-12);
    }

    #[test]
    fn unstable_loop_is_refused_even_without_disturbance() {
        let one = DMatrix::from_element(1, 1, 1.0);
        let none = Zonotope::centred(DMatrix::zeros(1, 0));
        let tube = |a: &DMatrix<f64>| Tube::new(a, &one, &none, Budget::UNLIMITED);
        assert_eq!(tube(&one), Err(TubeError::NoContraction));
        assert_eq!(tube(&(&one * 1.5)), Err(TubeError::NoContraction));
    }
}
