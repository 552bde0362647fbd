//! The explicit inverse of the active rows in the basic columns.

/// Inverse of the p x p matrix M with one row an active row and one column a basic column;
/// `inverse[i p + j]` belongs to basic column i and active row j. p is the number of rows that
/// hold with equality, so a dozen where the program has hundreds of rows.
#[derive(Debug, Default)]
pub(super) struct Kernel {
    size: usize,
    inverse: Vec<f64>,
    scratch: Vec<f64>,
}

impl Kernel {
    pub(super) fn clear(&mut self) {
        self.size = 0;
        self.inverse.clear();
    }

    pub(super) fn row(&self, column: usize) -> &[f64] {
        &self.inverse[column * self.size..][..self.size]
    }

    /// Euclidean length of a row of the inverse.
    pub(super) fn norm(&self, column: usize) -> f64 {
        dot(self.row(column), self.row(column)).sqrt()
    }

    fn at(&self, column: usize, row: usize) -> f64 {
        self.inverse[column * self.size + row]
    }

    /// out = M^-1 right.
    pub(super) fn solve(&self, right: &[f64], out: &mut Vec<f64>) {
        out.clear();
        out.extend((0..self.size).map(|i| dot(self.row(i), right)));
    }

    /// out' = left' M^-1.
    pub(super) fn solve_transposed(&self, left: &[f64], out: &mut Vec<f64>) {
        out.clear();
        out.resize(self.size, 0.0);
        for (i, weight) in left.iter().enumerate() {
            for (value, entry) in out.iter_mut().zip(self.row(i)) {
                *value += weight * entry;
            }
        }
    }

    /// The basic column that can be dropped together with active row `row` at least cost in
    /// accuracy.
    pub(super) fn partner_of_row(&self, row: usize) -> usize {
        (0..self.size)
            .max_by(|&a, &b| self.at(a, row).abs().total_cmp(&self.at(b, row).abs()))
            .unwrap_or(0)
    }

    /// Appends an active row and a basic column. `column` = M^-1 m with m the new column in the
    /// old rows; `row` = a' M^-1 with a the new row in the old columns; `pivot` the Schur
    /// complement.
    pub(super) fn border(&mut self, column: &[f64], row: &[f64], pivot: f64) {
        let (old, new) = (self.size, self.size + 1);
        self.scratch.clear();
        for i in 0..old {
            let weight = column[i] / pivot;
            let entries = self.inverse[i * old..][..old].iter().zip(row);
            self.scratch.extend(entries.map(|(entry, r)| entry + weight * r));
            self.scratch.push(-weight);
        }
        self.scratch.extend(row.iter().map(|r| -r / pivot));
        self.scratch.push(1.0 / pivot);
        self.size = new;
        std::mem::swap(&mut self.inverse, &mut self.scratch);
    }

    /// Drops basic column `column` and active row `row`; both lists close their gap by moving
    /// the last element into it.
    pub(super) fn shrink(&mut self, column: usize, row: usize) {
        let (old, new) = (self.size, self.size - 1);
        let pivot = self.at(column, row);
        self.scratch.clear();
        self.scratch.resize(new * new, 0.0);
        // Old index of what stands at `i` after the swap.
        let source = |i: usize, gap: usize| if i == gap { old - 1 } else { i };
        for i in 0..new {
            let from = source(i, column);
            let weight = self.at(from, row) / pivot;
            for j in 0..new {
                let to = source(j, row);
                self.scratch[i * new + j] = self.at(from, to) - weight * self.at(column, to);
            }
        }
        self.size = new;
        std::mem::swap(&mut self.inverse, &mut self.scratch);
    }

    /// Replaces basic column `column`; `entering` = M^-1 m with m the new column.
    pub(super) fn replace_column(&mut self, column: usize, entering: &[f64]) {
        let p = self.size;
        let pivot = entering[column];
        self.scratch.clear();
        self.scratch.extend(self.inverse[column * p..][..p].iter().map(|entry| entry / pivot));
        for i in 0..p {
            let target = &mut self.inverse[i * p..][..p];
            if i == column {
                target.copy_from_slice(&self.scratch);
            } else {
                for (value, entry) in target.iter_mut().zip(&self.scratch) {
                    *value -= entering[i] * entry;
                }
            }
        }
    }

    /// Replaces active row `row`; `entering` = a' M^-1 with a the new row.
    pub(super) fn replace_row(&mut self, row: usize, entering: &[f64]) {
        let p = self.size;
        let pivot = entering[row];
        for i in 0..p {
            let target = &mut self.inverse[i * p..][..p];
            let share = target[row] / pivot;
            for j in 0..p {
                target[j] -= entering[j] * share;
            }
            target[row] = share;
        }
    }

    /// Inverts `matrix` (rows x columns, row by row) as far as it has rank, by exchanging rows
    /// with columns in place, each time at the largest entry left.
    ///
    /// A pivot below `tolerance` times the largest entry of all ends it. Returns the kept (row,
    /// column) pairs of indices; the inverse is in that order.
    pub(super) fn factor(
        &mut self,
        matrix: &mut [f64],
        rows: usize,
        columns: usize,
        tolerance: f64,
    ) -> Vec<(usize, usize)> {
        let mut kept: Vec<(usize, usize)> = Vec::with_capacity(rows.min(columns));
        let mut row_is_free = vec![true; rows];
        let mut column_is_free = vec![true; columns];
        let mut largest = 0.0;
        while let Some((i, j)) = largest_entry(matrix, &row_is_free, &column_is_free) {
            let pivot = matrix[i * columns + j];
            if kept.is_empty() {
                largest = pivot.abs();
            }
            if pivot.abs() <= tolerance * largest {
                break;
            }
            self.exchange(matrix, columns, (i, j));
            kept.push((i, j));
            row_is_free[i] = false;
            column_is_free[j] = false;
        }
        self.size = kept.len();
        self.inverse.clear();
        for &(i, _) in &kept {
            self.inverse.extend(kept.iter().map(|&(_, j)| matrix[i * columns + j]));
        }
        kept
    }

    /// From y = M x to the same relation solved for x_j, with y_i on the other side.
    fn exchange(&mut self, matrix: &mut [f64], columns: usize, (i, j): (usize, usize)) {
        let pivot = matrix[i * columns + j];
        self.scratch.clear();
        self.scratch.extend(matrix[i * columns..][..columns].iter().map(|entry| -entry / pivot));
        self.scratch[j] = 1.0 / pivot;
        for (r, row) in matrix.chunks_exact_mut(columns).enumerate() {
            if r == i {
                row.copy_from_slice(&self.scratch);
                continue;
            }
            let weight = row[j];
            row[j] = 0.0;
            row.iter_mut().zip(&self.scratch).for_each(|(entry, p)| *entry += weight * p);
        }
    }
}

fn largest_entry(
    matrix: &[f64],
    row_is_free: &[bool],
    column_is_free: &[bool],
) -> Option<(usize, usize)> {
    let mut best = None;
    let mut largest = 0.0;
    let rows = matrix.chunks_exact(column_is_free.len().max(1)).zip(row_is_free).enumerate();
    for (i, (row, _)) in rows.filter(|(_, (_, free))| **free) {
        for (j, (entry, free)) in row.iter().zip(column_is_free).enumerate() {
            if *free && entry.abs() > largest {
                largest = entry.abs();
                best = Some((i, j));
            }
        }
    }
    best
}

/// Sum of products, four sums at a time: one alone would wait for itself at every term.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, a_rest) = a.as_chunks::<4>();
    let (b, b_rest) = b.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (a, b) in a.iter().zip(b) {
        for i in 0..4 {
            sums[i] += a[i] * b[i];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    (sums[0] + sums[2]) + (sums[1] + sums[3]) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// M^-1 M = I for a matrix given by rows.
    fn check(kernel: &Kernel, matrix: &[Vec<f64>]) {
        let p = matrix.len();
        for i in 0..p {
            for j in 0..p {
                let entry: f64 = (0..p).map(|k| kernel.at(i, k) * matrix[k][j]).sum();
                let expected = f64::from(u8::from(i == j));
                assert!((entry - expected).abs() < 1e-12, "({i}, {j}): {entry}");
            }
        }
    }

    #[test]
    fn updates_agree_with_the_definition() {
        let mut m = vec![vec![2.0, 1.0, 0.5], vec![-1.0, 3.0, 1.0], vec![0.3, -0.7, 1.5]];
        let mut flat: Vec<f64> = m.concat();
        let mut kernel = Kernel::default();
        let kept = kernel.factor(&mut flat, 3, 3, 1e-9);
        // Reorder M as the factorisation kept it.
        m = kept.iter().map(|&(r, _)| kept.iter().map(|&(_, c)| m[r][c]).collect()).collect();
        check(&kernel, &m);

        let new_column = [0.4, -2.0, 1.1];
        let mut entering = Vec::new();
        kernel.solve(&new_column, &mut entering);
        kernel.replace_column(1, &entering);
        for (row, value) in m.iter_mut().zip(new_column) {
            row[1] = value;
        }
        check(&kernel, &m);

        let new_row = [1.0, 0.2, -0.9];
        let mut rho = Vec::new();
        kernel.solve_transposed(&new_row, &mut rho);
        kernel.replace_row(2, &rho);
        m[2] = new_row.to_vec();
        check(&kernel, &m);

        let (column, row, corner) = ([0.1, 0.2, 0.3], [-0.4, 0.5, 0.6], 2.5);
        let (mut c, mut r) = (Vec::new(), Vec::new());
        kernel.solve(&column, &mut c);
        kernel.solve_transposed(&row, &mut r);
        kernel.border(&c, &r, corner - dot(&row, &c));
        for (line, value) in m.iter_mut().zip(column) {
            line.push(value);
        }
        m.push(vec![-0.4, 0.5, 0.6, corner]);
        check(&kernel, &m);

        kernel.shrink(1, 0);
        m.swap_remove(0);
        for line in &mut m {
            line.swap_remove(1);
        }
        check(&kernel, &m);
    }

    #[test]
    fn factor_drops_what_has_no_rank() {
        let mut kernel = Kernel::default();
        // The third row is the sum of the first two.
        let kept = kernel.factor(&mut [1.0, 2.0, 0.0, 1.0, 1.0, 3.0], 3, 2, 1e-9);
        assert_eq!(kept.len(), 2);
        let kept = kernel.factor(&mut [1.0, 2.0, 2.0, 4.0], 2, 2, 1e-9);
        assert_eq!(kept.len(), 1);
    }
}
