//! What follows from A and B alone, for every horizon up to the longest.

use nalgebra::DMatrix;

use super::anchors::Anchors;
use crate::budget::{Budget, Interruption};

/// A, B, bounds on the products A^i B, and the recursions in anchored form.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantTables {
    n: usize,
    m: usize,
    /// A column by column, n x n: the forward recursion adds columns.
    a_columns: Vec<f64>,
    /// A row by row: the costate recursion adds rows.
    a_rows: Vec<f64>,
    /// B column by column, n x m.
    b_columns: Vec<f64>,
    /// Largest |entry| in row r of A^i B over i < j, at [j n + r], j = 0 .. horizon_max.
    reach: Vec<f64>,
    anchors: Anchors,
}

impl PlantTables {
    /// For A (n x n), B (n x m) and horizons up to `horizon_max`.
    #[must_use]
    pub fn new(a: &DMatrix<f64>, b: &DMatrix<f64>, horizon_max: usize) -> Self {
        Self::within(a, b, horizon_max, Budget::UNLIMITED).expect("this budget never interrupts")
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn within(
        a: &DMatrix<f64>,
        b: &DMatrix<f64>,
        horizon_max: usize,
        budget: Budget<'_>,
    ) -> Result<Self, Interruption> {
        let (n, m) = (a.nrows(), b.ncols());
        let by_rows = |x: &DMatrix<f64>| -> Vec<f64> { x.transpose().as_slice().to_vec() };
        let mut reach = vec![0.0; n];
        let mut response = b.clone();
        for j in 0..horizon_max {
            budget.check()?;
            for r in 0..n {
                let largest = response.row(r).amax();
                reach.push(f64::max(reach[j * n + r], largest));
            }
            response = crate::matrices::product(a, &response);
        }
        let size = |r: &f64| if *r > 0.0 { *r } else { 1.0 };
        let units: Vec<f64> = reach[horizon_max * n..].iter().map(size).collect();
        Ok(Self {
            n,
            m,
            a_columns: a.as_slice().to_vec(),
            a_rows: by_rows(a),
            b_columns: b.as_slice().to_vec(),
            reach,
            anchors: Anchors::new(a, b, &units, horizon_max, budget)?,
        })
    }

    /// State components n.
    #[must_use]
    pub fn states(&self) -> usize {
        self.n
    }

    /// Input components m.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.m
    }

    /// Longest horizon covered.
    #[must_use]
    pub fn horizon_max(&self) -> usize {
        self.reach.len() / self.n - 1
    }

    /// A (n x n) and B (n x m), each column by column: for whoever recomputes without the tables.
    pub(crate) fn matrices(&self) -> (&[f64], &[f64]) {
        (&self.a_columns, &self.b_columns)
    }

    /// The recursions in anchored form, for stages up to the longest horizon.
    pub(crate) fn anchors(&self) -> &Anchors {
        &self.anchors
    }

    /// Bound on how much a unit input before stage j moves each state component at stage j.
    pub(crate) fn reach(&self, stage: usize) -> &[f64] {
        &self.reach[stage * self.n..][..self.n]
    }

    /// States z_0 .. z_N of inputs v_0 .. v_{N-1}, into `states` ((N + 1) n values, z_0 given).
    pub(crate) fn roll_forward(&self, inputs: &[f64], states: &mut [f64]) {
        match (self.n, self.m) {
            (6, 3) => self.roll_forward_sized::<6, 3>(inputs, states),
            (2, 1) => self.roll_forward_sized::<2, 1>(inputs, states),
            _ => self.roll_forward_any(inputs, states),
        }
    }

    fn roll_forward_sized<const N: usize, const M: usize>(
        &self,
        inputs: &[f64],
        states: &mut [f64],
    ) {
        let (a, _) = self.a_columns.as_chunks::<N>();
        let (b, _) = self.b_columns.as_chunks::<N>();
        let (states, _) = states.as_chunks_mut::<N>();
        let mut z = states[0];
        for (v, out) in inputs.as_chunks::<M>().0.iter().zip(&mut states[1..]) {
            let mut next = [0.0; N];
            for c in 0..N {
                for r in 0..N {
                    next[r] += a[c][r] * z[c];
                }
            }
            for c in 0..M {
                for r in 0..N {
                    next[r] += b[c][r] * v[c];
                }
            }
            z = next;
            *out = next;
        }
    }

    fn roll_forward_any(&self, inputs: &[f64], states: &mut [f64]) {
        let n = self.n;
        for (j, v) in inputs.chunks_exact(self.m).enumerate() {
            let (past, future) = states.split_at_mut((j + 1) * n);
            let (z, next) = (&past[j * n..], &mut future[..n]);
            next.fill(0.0);
            for (column, weight) in self.a_columns.chunks_exact(n).zip(z) {
                add_scaled(next, column, *weight);
            }
            for (column, weight) in self.b_columns.chunks_exact(n).zip(v) {
                add_scaled(next, column, *weight);
            }
        }
    }

    /// out = A' costate.
    pub(crate) fn costate_back(&self, costate: &[f64], out: &mut [f64]) {
        match self.n {
            6 => self.costate_back_sized(6, costate, out),
            n => self.costate_back_sized(n, costate, out),
        }
    }

    /// Inlined where the size is a constant, so that the loops over it unroll.
    #[inline(always)]
    fn costate_back_sized(&self, n: usize, costate: &[f64], out: &mut [f64]) {
        let out = &mut out[..n];
        out.fill(0.0);
        for (row, weight) in self.a_rows.chunks_exact(n).zip(costate) {
            out.iter_mut().zip(row).for_each(|(value, a)| *value += weight * a);
        }
    }

    /// out = B' costate.
    pub(crate) fn input_gradient(&self, costate: &[f64], out: &mut [f64]) {
        match self.n {
            6 => self.input_gradient_sized(6, costate, out),
            n => self.input_gradient_sized(n, costate, out),
        }
    }

    #[inline(always)]
    fn input_gradient_sized(&self, n: usize, costate: &[f64], out: &mut [f64]) {
        let costate = &costate[..n];
        for (value, column) in out.iter_mut().zip(self.b_columns.chunks_exact(n)) {
            *value = column.iter().zip(costate).map(|(b, l)| b * l).sum();
        }
    }
}

/// target += weight * source.
pub(crate) fn add_scaled(target: &mut [f64], source: &[f64], weight: f64) {
    for (t, s) in target.iter_mut().zip(source) {
        *t += weight * s;
    }
}
