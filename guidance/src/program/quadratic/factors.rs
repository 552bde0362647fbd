//! The active rows of a dual active-set method, with the factors that dual steps need.
//!
//! With n_j = -a_j the normals of the active rows (n x q), H = L L' and L^-1 N = Q [R; 0], kept
//! are J = L^-T Q (n x n) and the upper triangle R. Goldfarb and Idnani, "A numerically stable
//! dual method for solving strictly convex quadratic programs", Mathematical Programming 27, 1983.

use super::QuadraticCost;

/// A row whose new part is below this, relative to the whole, depends on the active ones.
const DEPENDENT: f64 = 1e-10;

/// A point that is optimal for its active rows, which grow until no row is violated.
#[derive(Debug, Default)]
pub(crate) struct ActiveSet {
    n: usize,
    /// J, column by column; the first q columns span the active rows.
    j: Vec<f64>,
    /// R, column by column, n values a column.
    r: Vec<f64>,
    /// Ids of the active rows, as the caller names them.
    ids: Vec<usize>,
    /// Their normals a_j, one after the other, and offsets b_j.
    normals: Vec<f64>,
    offsets: Vec<f64>,
    multipliers: Vec<f64>,
    point: Vec<f64>,
    /// The optimum without rows, -H^-1 g.
    unconstrained: Vec<f64>,
    /// Rows that entered or left since the last reset.
    iterations: usize,
    // Scratch.
    projected: Vec<f64>,
    direction: Vec<f64>,
    change: Vec<f64>,
}

/// What came of a violated row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Entry {
    /// It is active now, others may have left.
    Active,
    /// With the active rows it has no common point: weight 1 for it and
    /// [`ActiveSet::ray`] for them is a Farkas ray.
    Infeasible,
    /// Too many rows entered and left.
    Stalled,
}

impl ActiveSet {
    /// No active rows, at -H^-1 g.
    pub(crate) fn reset(&mut self, cost: &QuadraticCost, gradient: &[f64]) {
        let n = cost.variables();
        self.n = n;
        self.iterations = 0;
        self.r.resize(n * n, 0.0);
        self.direction.resize(n, 0.0);
        self.projected.resize(n, 0.0);
        self.change.resize(n, 0.0);
        self.unconstrained.clear();
        self.unconstrained.resize(n, 0.0);
        for k in 0..n {
            let column = cost.factor_column(k);
            let along = dot(column, gradient);
            add_scaled(&mut self.unconstrained, -along, column);
        }
        self.restart(cost);
    }

    /// Drops every row, keeps the program.
    fn restart(&mut self, cost: &QuadraticCost) {
        self.j.clear();
        (0..self.n).for_each(|k| self.j.extend_from_slice(cost.factor_column(k)));
        self.ids.clear();
        self.normals.clear();
        self.offsets.clear();
        self.multipliers.clear();
        self.point.clone_from(&self.unconstrained);
    }

    /// Starts from rows that were active elsewhere: dependent ones are left out, and those whose
    /// multiplier has the wrong sign leave again, so that what remains is optimal for itself.
    pub(crate) fn start_from<'r>(
        &mut self,
        cost: &QuadraticCost,
        rows: impl Iterator<Item = (usize, &'r [f64], f64)>,
    ) {
        for (id, normal, offset) in rows {
            if self.ids.len() < self.n && !self.ids.contains(&id) {
                self.project(normal);
                if self.independent() {
                    self.append(id, normal, offset, 0.0);
                }
            }
        }
        self.settle();
        while let Some(worst) = (0..self.ids.len())
            .filter(|&k| self.multipliers[k] < 0.0)
            .min_by(|&a, &b| self.multipliers[a].total_cmp(&self.multipliers[b]))
        {
            self.drop(worst);
            self.settle();
        }
        if !self.point.iter().all(|x| x.is_finite()) {
            self.restart(cost);
        }
    }

    /// Lets the violated row `normal` z <= `offset` enter.
    pub(crate) fn enter(
        &mut self,
        id: usize,
        normal: &[f64],
        offset: f64,
        iterations_max: usize,
    ) -> Entry {
        let mut multiplier = 0.0;
        loop {
            self.iterations += 1;
            if self.iterations > iterations_max {
                return Entry::Stalled;
            }
            self.project(normal);
            let active = self.ids.len();
            self.back_substitute(active);
            let blocking = (0..active)
                .filter(|&k| self.change[k] > 0.0)
                .map(|k| (k, (self.multipliers[k] / self.change[k]).max(0.0)))
                .min_by(|a, b| a.1.total_cmp(&b.1));
            let independent = self.independent();
            let length: f64 = self.projected[active..].iter().map(|d| d * d).sum();
            let full = if independent {
                ((dot(normal, &self.point) - offset) / length).max(0.0)
            } else {
                f64::INFINITY
            };
            let step = match blocking {
                None if !independent => return Entry::Infeasible,
                Some((_, step)) if step < full => step,
                _ => full,
            };
            for k in 0..active {
                self.multipliers[k] = (self.multipliers[k] - step * self.change[k]).max(0.0);
            }
            multiplier += step;
            if independent {
                self.find_direction();
                let Self { point, direction, .. } = self;
                add_scaled(point, step, direction);
            }
            match blocking {
                Some((k, limit)) if limit < full => self.drop(k),
                _ => {
                    self.append(id, normal, offset, multiplier);
                    return Entry::Active;
                }
            }
        }
    }

    /// Recomputes point and multipliers from the factors and the rows, which takes out the drift
    /// of many steps.
    pub(crate) fn settle(&mut self) {
        let (n, q) = (self.n, self.ids.len());
        // R' w = N' z - b' at the unconstrained optimum; z = z_0 + J_1 w, multipliers R^-1 w.
        for k in 0..q {
            let normal = &self.normals[k * n..][..n];
            let violation = dot(normal, &self.unconstrained) - self.offsets[k];
            let known: f64 = (0..k).map(|i| self.r[k * n + i] * self.projected[i]).sum();
            self.projected[k] = (violation - known) / self.r[k * n + k];
        }
        self.point.clone_from(&self.unconstrained);
        for k in 0..q {
            let Self { point, j, projected, .. } = self;
            add_scaled(point, projected[k], &j[k * n..][..n]);
        }
        self.back_substitute(q);
        self.multipliers.copy_from_slice(&self.change[..q]);
    }

    /// One step of iterative refinement: solves for what the conditions of optimality, evaluated
    /// from H and the rows, still lack.
    pub(crate) fn refine(&mut self, cost: &QuadraticCost, gradient: &[f64]) {
        let (n, q) = (self.n, self.ids.len());
        // Stationarity Hz + g + A'y, into `direction`.
        for i in 0..n {
            let curvature: f64 = (0..n).map(|k| cost.hessian()[(i, k)] * self.point[k]).sum();
            let force: f64 = (0..q).map(|k| self.normals[k * n + i] * self.multipliers[k]).sum();
            self.direction[i] = curvature + gradient[i] + force;
        }
        let lacking: Vec<f64> =
            (0..n).map(|k| dot(&self.j[k * n..][..n], &self.direction)).collect();
        // dz = J y with R' y_1 = A z - b and y_2 = -J_2' r; dy = R^-1 (y_1 + J_1' r).
        for k in 0..q {
            let violation = dot(&self.normals[k * n..][..n], &self.point) - self.offsets[k];
            let known: f64 = (0..k).map(|i| self.r[k * n + i] * self.projected[i]).sum();
            self.projected[k] = (violation - known) / self.r[k * n + k];
        }
        (q..n).for_each(|k| self.projected[k] = -lacking[k]);
        for k in 0..n {
            let Self { point, j, projected, .. } = self;
            add_scaled(point, projected[k], &j[k * n..][..n]);
        }
        (0..q).for_each(|k| self.projected[k] += lacking[k]);
        self.back_substitute(q);
        let Self { multipliers, change, .. } = self;
        add_scaled(multipliers, 1.0, change);
    }

    /// Weights of the active rows in the ray that [`Entry::Infeasible`] speaks of.
    pub(crate) fn ray(&self) -> impl Iterator<Item = (usize, f64)> {
        self.ids.iter().copied().zip(self.change.iter().map(|r| (-r).max(0.0)))
    }

    /// Active rows and their multipliers, in the order of entry.
    pub(crate) fn active(&self) -> impl Iterator<Item = (usize, f64)> {
        self.ids.iter().copied().zip(self.multipliers.iter().copied())
    }

    /// z.
    pub(crate) fn point(&self) -> &[f64] {
        &self.point
    }

    /// Rows that entered or left since the last reset.
    pub(crate) fn iterations(&self) -> usize {
        self.iterations
    }

    /// `projected` = J' n for n = -normal.
    fn project(&mut self, normal: &[f64]) {
        let n = self.n;
        for k in 0..n {
            self.projected[k] = -dot(&self.j[k * n..][..n], normal);
        }
    }

    /// Has the projected row a part of its own?
    fn independent(&self) -> bool {
        let whole: f64 = self.projected.iter().map(|d| d * d).sum();
        let own: f64 = self.projected[self.ids.len()..].iter().map(|d| d * d).sum();
        own > DEPENDENT * DEPENDENT * whole
    }

    /// `change` = R^-1 `projected`, over the first q components.
    fn back_substitute(&mut self, q: usize) {
        let n = self.n;
        self.change[..q].copy_from_slice(&self.projected[..q]);
        for k in (0..q).rev() {
            self.change[k] /= self.r[k * n + k];
            let value = self.change[k];
            add_scaled(&mut self.change[..k], -value, &self.r[k * n..][..k]);
        }
    }

    /// `direction` = J_2 d_2: where the point moves for a unit of the entering multiplier.
    fn find_direction(&mut self) {
        let n = self.n;
        self.direction.fill(0.0);
        for k in self.ids.len()..n {
            let Self { direction, j, projected, .. } = self;
            add_scaled(direction, projected[k], &j[k * n..][..n]);
        }
    }

    /// Makes the projected row active: a reflection turns its own part into one column of J.
    fn append(&mut self, id: usize, normal: &[f64], offset: f64, multiplier: f64) {
        let (n, q) = (self.n, self.ids.len());
        let own = &self.projected[q..];
        let rest: f64 = own[1..].iter().map(|d| d * d).sum();
        let length = (own[0] * own[0] + rest).sqrt();
        self.r[q * n..][..q].copy_from_slice(&self.projected[..q]);
        self.r[q * n + q] = length;
        if rest > 0.0 {
            // v = d_2 - |d_2| e_1 without cancellation; J_2 -= (J_2 v) v' 2 / |v|^2.
            let first = own[0];
            let head = if first > 0.0 { -rest / (first + length) } else { first - length };
            self.projected[q] = head;
            let factor = 2.0 / (head * head + rest);
            self.find_direction();
            for k in q..n {
                let Self { direction, j, projected, .. } = self;
                add_scaled(&mut j[k * n..][..n], -factor * projected[k], direction);
            }
        } else if own[0] < 0.0 {
            self.j[q * n..][..n].iter_mut().for_each(|x| *x = -*x);
        }
        self.ids.push(id);
        self.normals.extend_from_slice(normal);
        self.offsets.push(offset);
        self.multipliers.push(multiplier);
    }

    /// Takes active row `k` out: rotations make R triangular again.
    fn drop(&mut self, k: usize) {
        let (n, q) = (self.n, self.ids.len());
        self.ids.remove(k);
        self.offsets.remove(k);
        self.multipliers.remove(k);
        self.normals.drain(k * n..(k + 1) * n);
        self.r.copy_within((k + 1) * n..q * n, k * n);
        for i in k..q - 1 {
            let (above, below) = (self.r[i * n + i], self.r[i * n + i + 1]);
            let length = libm::hypot(above, below);
            if length == 0.0 {
                continue;
            }
            let (c, s) = (above / length, below / length);
            for column in i..q - 1 {
                let (a, b) = (self.r[column * n + i], self.r[column * n + i + 1]);
                self.r[column * n + i] = c * a + s * b;
                self.r[column * n + i + 1] = c * b - s * a;
            }
            let (left, right) = self.j[i * n..(i + 2) * n].split_at_mut(n);
            for (a, b) in left.iter_mut().zip(right) {
                (*a, *b) = (c * *a + s * *b, c * *b - s * *a);
            }
        }
    }
}

#[inline]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (mut lanes, n) = ([0.0; 4], a.len().min(b.len()));
    let (a, b) = (&a[..n], &b[..n]);
    let (a_four, b_four) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a_four.remainder().iter().zip(b_four.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a_four.zip(b_four) {
        for k in 0..4 {
            lanes[k] += a[k] * b[k];
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]) + rest
}

#[inline]
fn add_scaled(sum: &mut [f64], factor: f64, vector: &[f64]) {
    for (s, v) in sum.iter_mut().zip(vector) {
        *s += factor * v;
    }
}
