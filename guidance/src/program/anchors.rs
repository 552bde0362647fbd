//! States told from an anchor, so that an input merely adds to everything after it.
//!
//! Stages are taken in blocks of L. Within the block that starts at stage s,
//!
//! ```text
//! z_{s+l} = A^l w_l      w_0 = z_s      w_{l+1} = w_l + A^-(l+1) B v_{s+l}      l = 0 .. L-2
//! ```
//!
//! and from one block to the next z_{s+L} = A^L w_{L-1} + B v_{s+L-1}. A row h' z_{s+l} is the
//! row (A^l' h)' w_l, computed once; after that the forward recursion costs n m a stage in place
//! of n (n + m), the costate recursion the same, and one coefficient of one row costs n.
//!
//! L is as long as A^l and its inverse together do not magnify rounding beyond [`GROWTH_MAX`].
//! For a spacecraft that is the whole horizon; for a plant that forgets quickly it is a few
//! stages; with L = 1 this is the plain recursion, and needs no inverse.

use nalgebra::DMatrix;

use super::tables::add_scaled;
use crate::budget::{Budget, Interruption};

/// Largest product of the largest entries of A^l and A^-l, in units of the reach: four of the
/// sixteen digits, which leaves a hundredth of the solver's feasibility tolerance.
const GROWTH_MAX: f64 = 1e4;

/// The recursions of a plant in anchored form.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Anchors {
    n: usize,
    m: usize,
    /// L.
    block: usize,
    /// A^l row by row, n x n, l = 0 ..= L.
    powers: Vec<f64>,
    /// A^-(l+1) B column by column, n x m, l = 0 .. L-2, then B.
    inputs: Vec<f64>,
}

impl Anchors {
    /// For A (n x n), B (n x m) and stages up to `last`; `units` are sizes of the n components.
    pub(super) fn new(
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        units: &[f64],
        last: usize,
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let (n, m) = (a.nrows(), b.ncols());
        let mut anchors = Self { n, m, block: 1, powers: Vec::new(), inputs: Vec::new() };
        let mut power = DMatrix::identity(n, n);
        anchors.powers.extend(power.iter());
        power.copy_from(a);
        if let Some(inverse) = a.clone().try_inverse() {
            let mut back = inverse.clone();
            while anchors.block <= last && growth(&power, &back, units) <= GROWTH_MAX {
                budget.check()?;
                anchors.powers.extend(power.transpose().iter());
                anchors.inputs.extend(crate::matrices::product(&back, b).iter());
                anchors.block += 1;
                power = crate::matrices::product(a, &power);
                back = crate::matrices::product(&inverse, &back);
            }
        }
        anchors.powers.extend(power.transpose().iter());
        anchors.inputs.extend(b.iter());
        Ok(anchors)
    }

    /// Blocks that have a stage up to `horizon`.
    pub(super) fn blocks(&self, horizon: usize) -> usize {
        horizon / self.block + 1
    }

    /// Block of a stage.
    pub(super) fn block_of(&self, stage: usize) -> usize {
        stage / self.block
    }

    /// Row r of the matrix that takes w at `stage` to z.
    pub(super) fn component(&self, stage: usize, r: usize) -> &[f64] {
        self.power_row(stage % self.block, r)
    }

    fn power_row(&self, l: usize, r: usize) -> &[f64] {
        &self.powers[(l * self.n + r) * self.n..][..self.n]
    }

    /// out = scale times the row on w that `normal` is on z at `stage`.
    pub(super) fn row(&self, normal: &[f64], stage: usize, scale: f64, out: &mut [f64]) {
        match self.n {
            6 => self.row_sized(6, normal, stage, scale, out),
            n => self.row_sized(n, normal, stage, scale, out),
        }
    }

    #[inline(always)]
    fn row_sized(&self, n: usize, normal: &[f64], stage: usize, scale: f64, out: &mut [f64]) {
        let matrix = &self.powers[stage % self.block * n * n..][..n * n];
        let out = &mut out[..n];
        out.fill(0.0);
        for (row, &weight) in matrix.chunks_exact(n).zip(normal) {
            if weight != 0.0 {
                let weight = scale * weight;
                out.iter_mut().zip(row).for_each(|(sum, p)| *sum += weight * p);
            }
        }
    }

    /// w_0 .. w_N (n values each, the first given) under `inputs`.
    pub(super) fn roll_forward(&self, inputs: &[f64], anchored: &mut [f64]) {
        match (self.n, self.m) {
            (6, 3) => self.roll_forward_sized(6, 3, inputs, anchored),
            (2, 1) => self.roll_forward_sized(2, 1, inputs, anchored),
            (n, m) => self.roll_forward_sized(n, m, inputs, anchored),
        }
    }

    /// Inlined where the sizes are constants, so that the loops over them unroll.
    #[inline(always)]
    fn roll_forward_sized(&self, n: usize, m: usize, inputs: &[f64], anchored: &mut [f64]) {
        let mut stages = anchored.chunks_exact_mut(n);
        let Some(mut w) = stages.next() else { return };
        let mut inputs = inputs.chunks_exact(m);
        loop {
            // The block's input matrices; the last one belongs to the way to the next block.
            for (l, columns) in self.inputs.chunks_exact(n * m).enumerate() {
                let (Some(next), Some(v)) = (stages.next(), inputs.next()) else { return };
                if l + 1 < self.block {
                    next.copy_from_slice(w);
                } else {
                    let rows = self.powers[self.block * n * n..].chunks_exact(n);
                    next.iter_mut().zip(rows).for_each(|(value, row)| *value = dot(row, w));
                }
                // Most inputs are at rest at zero.
                if v.iter().any(|v| *v != 0.0) {
                    for (column, &weight) in columns.chunks_exact(n).zip(v) {
                        next.iter_mut().zip(column).for_each(|(z, b)| *z += weight * b);
                    }
                }
                w = next;
            }
        }
    }

    /// Gradient of sum_j rows_j' w_j on the inputs; `rows` holds n values for each of the stages
    /// 0 .. N, and the gradient is added to `out`.
    pub(super) fn add_gradient(&self, rows: &[f64], costate: &mut Vec<f64>, out: &mut [f64]) {
        match (self.n, self.m) {
            (6, 3) => self.add_gradient_sized(6, 3, rows, costate, out),
            (2, 1) => self.add_gradient_sized(2, 1, rows, costate, out),
            (n, m) => self.add_gradient_sized(n, m, rows, costate, out),
        }
    }

    #[inline(always)]
    fn add_gradient_sized(
        &self,
        n: usize,
        m: usize,
        rows: &[f64],
        costate: &mut Vec<f64>,
        out: &mut [f64],
    ) {
        costate.clear();
        costate.resize(2 * n, 0.0);
        let (costate, carried) = costate.split_at_mut(n);
        let rows = rows[n..].chunks(self.block * n).zip(out.chunks_mut(self.block * m));
        for (rows, out) in rows.rev() {
            let whole = out.len() == self.block * m;
            let stages = rows.chunks_exact(n).zip(self.inputs.chunks_exact(n * m));
            let stages = stages.zip(out.chunks_exact_mut(m));
            for (l, ((row, columns), out)) in stages.enumerate().rev() {
                costate.iter_mut().zip(row).for_each(|(sum, h)| *sum += h);
                let columns = columns.chunks_exact(n);
                out.iter_mut().zip(columns).for_each(|(value, b)| *value += dot(b, costate));
                if whole && l + 1 == self.block {
                    carried.fill(0.0);
                    for (r, &weight) in costate.iter().enumerate() {
                        add_scaled(carried, self.power_row(self.block, r), weight);
                    }
                    costate.copy_from_slice(carried);
                }
            }
        }
    }

    /// A row on w at `stage` as it looks from every block up to its own, n values each into
    /// `images`; the rest is filled with zeros.
    pub(super) fn images(&self, row: &[f64], stage: usize, images: &mut [f64]) {
        let n = self.n;
        images.fill(0.0);
        let own = self.block_of(stage);
        images[own * n..][..n].copy_from_slice(row);
        for block in (0..own).rev() {
            let (earlier, later) = images.split_at_mut((block + 1) * n);
            for (r, &weight) in later[..n].iter().enumerate() {
                add_scaled(&mut earlier[block * n..], self.power_row(self.block, r), weight);
            }
        }
    }

    /// Coefficient of a row, given by its images, on component `c` of the input at `stage`, which
    /// must lie before the row's own stage.
    pub(super) fn coefficient(&self, images: &[f64], stage: usize, c: usize) -> f64 {
        let (n, l) = (self.n, stage % self.block);
        let block = stage / self.block + usize::from(l + 1 == self.block);
        dot(&images[block * n..][..n], &self.inputs[(l * self.m + c) * n..][..n])
    }
}

/// How much A^l and its inverse together magnify, in the given units.
fn growth(power: &DMatrix<f64>, back: &DMatrix<f64>, units: &[f64]) -> f64 {
    let largest = |matrix: &DMatrix<f64>| {
        let entries = (0..units.len()).flat_map(|r| (0..units.len()).map(move |c| (r, c)));
        entries.fold(0.0_f64, |most, (r, c)| most.max((matrix[(r, c)] * units[c] / units[r]).abs()))
    };
    largest(power) * largest(back)
}

/// Sum of products; the six terms of a spacecraft in pairs, which the machine adds two at a time.
#[inline]
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    match (a.as_array::<6>(), b.as_array::<6>()) {
        (Some(a), Some(b)) => {
            (a[0] * b[0] + a[2] * b[2] + a[4] * b[4]) + (a[1] * b[1] + a[3] * b[3] + a[5] * b[5])
        }
        _ => a.iter().zip(b).map(|(x, y)| x * y).sum(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::program::PlantTables;

    /// Rows, coefficients and gradient in anchored form against the recursion on z.
    fn check(a: &DMatrix<f64>, b: &DMatrix<f64>, expected_block: Option<usize>) {
        let (n, m, horizon) = (a.nrows(), b.ncols(), 11);
        let tables = PlantTables::new(a, b, horizon);
        let anchors = tables.anchors();
        if let Some(block) = expected_block {
            assert_eq!(anchors.block, block);
        }
        let wave = |i: usize| libm::sin(1.3 * i as f64 + 0.4);
        let inputs: Vec<f64> = (0..horizon * m).map(wave).collect();
        let initial: Vec<f64> = (0..n).map(|i| wave(i + 50)).collect();
        let mut states = vec![0.0; (horizon + 1) * n];
        states[..n].copy_from_slice(&initial);
        let mut anchored = states.clone();
        tables.roll_forward(&inputs, &mut states);
        anchors.roll_forward(&inputs, &mut anchored);
        let free = {
            let mut free = vec![0.0; (horizon + 1) * n];
            free[..n].copy_from_slice(&initial);
            anchors.roll_forward(&vec![0.0; horizon * m], &mut free);
            free
        };
        let normal: Vec<f64> = (0..n).map(|i| wave(i + 90)).collect();
        let (mut row, mut images) = (vec![0.0; n], vec![0.0; anchors.blocks(horizon) * n]);
        for stage in 1..=horizon {
            anchors.row(&normal, stage, 2.0, &mut row);
            let direct = 2.0 * dot(&normal, &states[stage * n..][..n]);
            let size = 1.0 + states[stage * n..][..n].iter().map(|z| z.abs()).sum::<f64>();
            let through = dot(&row, &anchored[stage * n..][..n]);
            assert!((through - direct).abs() < 1e-11 * size, "{stage}: {through} {direct}");

            // The same from the coefficients, and from the gradient.
            anchors.images(&row, stage, &mut images);
            let mut rows = vec![0.0; (horizon + 1) * n];
            rows[stage * n..][..n].copy_from_slice(&row);
            let mut gradient = vec![0.0; horizon * m];
            anchors.add_gradient(&rows, &mut Vec::new(), &mut gradient);
            let mut total = dot(&row, &free[stage * n..][..n]);
            for i in 0..stage * m {
                let coefficient = anchors.coefficient(&images, i / m, i % m);
                assert!((coefficient - gradient[i]).abs() < 1e-11 * size, "{stage} {i}");
                total += coefficient * inputs[i];
            }
            assert!((total - direct).abs() < 1e-11 * size, "{stage}: {total} {direct}");
            assert!(gradient[stage * m..].iter().all(|d| *d == 0.0));
        }
    }

    #[test]
    fn anchored_form_agrees_with_the_recursion() {
        // One block for a plant that can be run backwards.
        let a = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]);
        let b = DMatrix::from_row_slice(2, 1, &[0.5, 1.0]);
        check(&a, &b, Some(12));
        // Relative motion over a tenth of a radian, impulses as input.
        let t = 0.1;
        let (s, c) = (libm::sin(t), libm::cos(t));
        #[rustfmt::skip]
        let a = DMatrix::from_row_slice(6, 6, &[
            4.0 - 3.0 * c, 0.0, 0.0, s, 2.0 * (1.0 - c), 0.0,
            6.0 * (s - t), 1.0, 0.0, 2.0 * (c - 1.0), 4.0 * s - 3.0 * t, 0.0,
            0.0, 0.0, c, 0.0, 0.0, s,
            3.0 * s, 0.0, 0.0, c, 2.0 * s, 0.0,
            6.0 * (c - 1.0), 0.0, 0.0, -2.0 * s, 4.0 * c - 3.0, 0.0,
            0.0, 0.0, -s, 0.0, 0.0, c,
        ]);
        let b = a.columns(3, 3).into_owned();
        check(&a, &b, Some(12));
        // Several for one that forgets, and the plain recursion for one without an inverse.
        let a = DMatrix::from_row_slice(3, 3, &[0.2, 0.1, 0.0, -0.1, 0.3, 0.1, 0.0, 0.2, 0.15]);
        let b = DMatrix::from_row_slice(3, 2, &[1.0, 0.0, 0.5, -1.0, 0.0, 2.0]);
        check(&a, &b, None);
        let singular = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 0.0]);
        check(&singular, &DMatrix::from_row_slice(2, 1, &[0.5, 1.0]), Some(1));
    }
}
