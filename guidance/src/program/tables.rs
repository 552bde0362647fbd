//! What follows from A and B alone, for every horizon up to the longest.

use nalgebra::DMatrix;

/// A, B, the products A^i B and bounds on their entries.
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
    /// A^i B row by row (n x m), i = 0 .. horizon_max - 1.
    responses: Vec<f64>,
    /// Largest |entry| in row r of A^i B over i < j, at [j n + r], j = 0 .. horizon_max.
    reach: Vec<f64>,
}

impl PlantTables {
    /// For A (n x n), B (n x m) and horizons up to `horizon_max`.
    #[must_use]
    pub fn new(a: &DMatrix<f64>, b: &DMatrix<f64>, horizon_max: usize) -> Self {
        let (n, m) = (a.nrows(), b.ncols());
        let by_rows = |x: &DMatrix<f64>| -> Vec<f64> { x.transpose().as_slice().to_vec() };
        let mut tables = Self {
            n,
            m,
            a_columns: a.as_slice().to_vec(),
            a_rows: by_rows(a),
            b_columns: b.as_slice().to_vec(),
            responses: Vec::with_capacity(horizon_max * n * m),
            reach: vec![0.0; n],
        };
        let mut response = b.clone();
        for j in 0..horizon_max {
            tables.responses.extend(by_rows(&response));
            for r in 0..n {
                let largest = response.row(r).amax();
                tables.reach.push(tables.reach[j * n + r].max(largest));
            }
            response = crate::matrices::product(a, &response);
        }
        tables
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
        self.responses.len() / (self.n * self.m)
    }

    /// A (n x n) and B (n x m), each column by column: for whoever recomputes without the tables.
    pub(crate) fn matrices(&self) -> (&[f64], &[f64]) {
        (&self.a_columns, &self.b_columns)
    }

    /// Row r of A^i B.
    pub(crate) fn response_row(&self, i: usize, r: usize) -> &[f64] {
        &self.responses[(i * self.n + r) * self.m..][..self.m]
    }

    /// Bound on how much a unit input before stage j moves each state component at stage j.
    pub(crate) fn reach(&self, stage: usize) -> &[f64] {
        &self.reach[stage * self.n..][..self.n]
    }

    /// Coefficients of normal' z_stage on the inputs v_0 .. v_{stage-1}, into `out` (stage m
    /// values): normal' A^(stage-1-i) B.
    pub(crate) fn coefficients(&self, normal: &[f64], stage: usize, scale: f64, out: &mut [f64]) {
        let out = &mut out[..stage * self.m];
        out.fill(0.0);
        for (r, &weight) in normal.iter().enumerate() {
            let weight = weight * scale;
            if weight == 0.0 {
                continue;
            }
            for (i, chunk) in out.chunks_exact_mut(self.m).enumerate() {
                let response = self.response_row(stage - 1 - i, r);
                for (value, entry) in chunk.iter_mut().zip(response) {
                    *value += weight * entry;
                }
            }
        }
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
        out.fill(0.0);
        for (row, weight) in self.a_rows.chunks_exact(self.n).zip(costate) {
            add_scaled(out, row, *weight);
        }
    }

    /// out = B' costate.
    pub(crate) fn input_gradient(&self, costate: &[f64], out: &mut [f64]) {
        for (value, column) in out.iter_mut().zip(self.b_columns.chunks_exact(self.n)) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_agree_with_the_recursion() {
        // Laws: the condensed row applied to the inputs equals the row applied to the state that
        // the recursion reaches from 0. n = 3, m = 2 takes the unsized path.
        let a = DMatrix::from_row_slice(3, 3, &[0.9, 0.2, 0.0, -0.1, 1.1, 0.3, 0.0, 0.2, 0.7]);
        let b = DMatrix::from_row_slice(3, 2, &[1.0, 0.0, 0.5, -1.0, 0.0, 2.0]);
        let tables = PlantTables::new(&a, &b, 5);
        let inputs = [0.3, -0.2, 1.0, 0.5, -0.7, 0.1, 0.9, -1.0, 0.4, 0.6];
        let mut states = vec![0.0; 18];
        tables.roll_forward(&inputs, &mut states);
        let normal = [0.4, -1.3, 2.0];
        for stage in 1..=5 {
            let mut coefficients = vec![0.0; 10];
            tables.coefficients(&normal, stage, 1.0, &mut coefficients);
            let condensed: f64 = coefficients.iter().zip(&inputs).map(|(c, v)| c * v).sum();
            let z = &states[stage * 3..][..3];
            let direct: f64 = normal.iter().zip(z).map(|(h, z)| h * z).sum();
            assert!((condensed - direct).abs() < 1e-13, "stage {stage}: {condensed} {direct}");
        }
    }
}
