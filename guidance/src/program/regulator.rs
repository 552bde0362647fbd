//! A regulator with a finite horizon over a time-varying plant with forces in a polytope, as a
//! dense quadratic program over the forces.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};

use super::{
    ActiveRow, Affine, Clarabel, ConeProgram, DenseRows, DualActiveSet, NotPositiveDefinite,
    QuadraticCost, QuadraticProgram, QuadraticSolution, Status,
};
use crate::{
    budget::{Budget, Interruption},
    matrices::{product_fixed, transposed_fixed_product},
};

/// ```text
/// minimise   x_N'M x_N + sum_{j<N} x_j'L x_j + u_j'R u_j
/// subject to x_{j+1} = A_j x_j + B_j u_j
///            u_j = origin + basis w_j,  facets w_j <= facet_offsets
///            normal x_stage >= offset                          for every cut
/// ```
///
/// [AguilarMarsillach2022, eq. 23] with (23c) made of half-spaces (29). The variables are w, so
/// forces that fill only a plane or a line, as after failures, need no equalities. Scale `basis`
/// so that w is about 1.
#[derive(Debug, Clone, Copy)]
pub struct RegulatorProgram<'a> {
    /// A_j, B_j for j = 0 .. N-1.
    pub steps: &'a [(SMatrix<f64, 6, 6>, SMatrix<f64, 6, 3>)],
    /// x_0.
    pub initial: &'a SVector<f64, 6>,
    /// L, symmetric positive semidefinite.
    pub stage_cost: &'a SMatrix<f64, 6, 6>,
    /// M, the same.
    pub terminal_cost: &'a SMatrix<f64, 6, 6>,
    /// R, symmetric positive definite.
    pub input_cost: &'a Matrix3<f64>,
    /// A point of the forces' affine hull.
    pub origin: &'a Vector3<f64>,
    /// 3 x d, d <= 3.
    pub basis: &'a DMatrix<f64>,
    /// q x d.
    pub facets: &'a DMatrix<f64>,
    /// q.
    pub facet_offsets: &'a DVector<f64>,
    /// What the states must clear.
    pub cuts: &'a [StateCut],
    /// Cuts may be violated at this price.
    pub softness: Option<Softness>,
}

/// normal x_stage >= offset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StateCut {
    /// j, from 1; a cut at stage 0 speaks of the initial state, which no force changes.
    pub stage: usize,
    /// h.
    pub normal: SVector<f64, 6>,
    /// Right side.
    pub offset: f64,
}

/// Price of a violation v of a cut: linear v + quadratic v^2, in units of the objective.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Softness {
    /// Large enough, it keeps cuts that can be kept.
    pub linear: f64,
    /// Positive.
    pub quadratic: f64,
}

/// Responses of the states to the forces before them.
struct Responses {
    stages: usize,
    /// A_{i-1} .. A_{l+1} B_l basis (unused columns 0), for i = l + 1 .. N, l by l.
    maps: Vec<SMatrix<f64, 6, 3>>,
}

impl Responses {
    fn new(program: &RegulatorProgram<'_>) -> Self {
        let (n, d) = (program.horizon(), program.inputs());
        let basis = Matrix3::from_fn(|i, c| if c < d { program.basis[(i, c)] } else { 0.0 });
        let mut maps = Vec::with_capacity(n * (n + 1) / 2);
        for l in 0..n {
            let mut response = product_fixed(&program.steps[l].1, &basis);
            maps.push(response);
            for (a, _) in &program.steps[l + 1..] {
                response = product_fixed(a, &response);
                maps.push(response);
            }
        }
        Self { stages: n, maps }
    }

    /// Of x_i to the forces of stage l < i.
    fn of(&self, l: usize, i: usize) -> &SMatrix<f64, 6, 3> {
        // Stages before l have N, N - 1, .. responses.
        &self.maps[l * self.stages - l * l.saturating_sub(1) / 2 + i - l - 1]
    }
}

/// The program over w: z'Hz / 2 + g'z with rows.
#[derive(Debug, Clone, PartialEq)]
pub struct CondensedRegulator {
    /// H with its factor.
    pub cost: QuadraticCost,
    /// g.
    pub gradient: Vec<f64>,
    /// Facets stage by stage, then cuts, then signs of violations.
    pub rows: DenseRows,
    /// Right sides.
    pub offsets: Vec<f64>,
}

/// Which rows may give way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RelaxedRows {
    /// Limits of the forces.
    Facets,
    /// What the states must clear.
    Cuts,
}

/// What came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct RegulatorAnswer {
    /// `Optimal` and `PrimalInfeasible` are verified.
    pub status: Status,
    /// u_0 .. u_(N-1); empty unless optimal.
    pub inputs: Vec<Vector3<f64>>,
    /// x_0 .. x_N; empty unless optimal.
    pub states: Vec<SVector<f64, 6>>,
    /// The objective (23a) of these, without the price of violations.
    pub objective: f64,
    /// max(0, offset - normal x) of each cut.
    pub violations: Vec<f64>,
    /// Rows that hold with equality, or those of the proof that there is no answer.
    pub active: Vec<ActiveRow>,
    /// Rows that entered or left.
    pub iterations: usize,
    /// The dual active set did not do it and the general solver did.
    pub by_general_solver: bool,
}

impl RegulatorProgram<'_> {
    /// N.
    #[must_use]
    pub fn horizon(&self) -> usize {
        self.steps.len()
    }

    fn inputs(&self) -> usize {
        self.basis.ncols()
    }

    fn variables(&self) -> usize {
        let violations = if self.softness.is_some() { self.cuts.len() } else { 0 };
        self.horizon() * self.inputs() + violations
    }

    /// Eliminates the states.
    ///
    /// # Errors
    /// [`NotPositiveDefinite`] if R is not, on the span of the forces.
    pub fn condense(&self) -> Result<CondensedRegulator, NotPositiveDefinite> {
        let forces = self.horizon() * self.inputs();
        let responses = Responses::new(self);
        let mut hessian = self.force_hessian(&responses);
        let mut gradient = self.force_gradient();
        if let Some(softness) = self.softness {
            for i in forces..self.variables() {
                hessian[(i, i)] = 2.0 * softness.quadratic;
                gradient[i] = softness.linear;
            }
        }
        let (rows, offsets) = self.rows(&responses);
        Ok(CondensedRegulator { cost: QuadraticCost::new(hessian)?, gradient, rows, offsets })
    }

    /// B_j basis, 6 x d, for every stage.
    fn input_maps(&self) -> Vec<Vec<SVector<f64, 6>>> {
        let columns: Vec<Vector3<f64>> =
            self.basis.column_iter().map(|c| Vector3::new(c[0], c[1], c[2])).collect();
        let map = |b: &SMatrix<f64, 6, 3>| columns.iter().map(|c| product_fixed(b, c)).collect();
        self.steps.iter().map(|(_, b)| map(b)).collect()
    }

    /// 2 (S' diag(L .. M) S + diag(basis' R basis)). What follows stage j + 1 costs x'P x there
    /// with P_N = M, P_j = L + A_j'P A_j, so the block of stages j >= l is B_j'P_{j+1} times the
    /// response of x_{j+1} to the forces of stage l.
    fn force_hessian(&self, responses: &Responses) -> DMatrix<f64> {
        let (n, d) = (self.horizon(), self.inputs());
        let maps = self.input_maps();
        let mut hessian = DMatrix::zeros(self.variables(), self.variables());
        let mut cost_to_go = *self.terminal_cost;
        for j in (0..n).rev() {
            for (e, map) in maps[j].iter().enumerate() {
                let pull = product_fixed(&cost_to_go, map) * 2.0;
                for l in 0..=j {
                    let response = responses.of(l, j + 1);
                    for c in 0..d {
                        let value: f64 = (0..6).map(|i| pull[i] * response[(i, c)]).sum();
                        hessian[(j * d + e, l * d + c)] = value;
                        hessian[(l * d + c, j * d + e)] = value;
                    }
                }
            }
            let a = &self.steps[j].0;
            cost_to_go =
                self.stage_cost + transposed_fixed_product(a, &product_fixed(&cost_to_go, a));
        }
        for c in 0..d {
            for e in 0..d {
                let of = |k: usize| {
                    Vector3::new(self.basis[(0, k)], self.basis[(1, k)], self.basis[(2, k)])
                };
                let value = 2.0 * of(c).dot(&product_fixed(self.input_cost, &of(e)));
                (0..n).for_each(|l| hessian[(l * d + c, l * d + e)] += value);
            }
        }
        hessian
    }

    /// Gradient at w = 0.
    fn force_gradient(&self) -> Vec<f64> {
        let (n, d) = (self.horizon(), self.inputs());
        let maps = self.input_maps();
        let free = self.states(&vec![*self.origin; n]);
        let mut gradient = vec![0.0; self.variables()];
        let weighted = product_fixed(self.input_cost, self.origin);
        let mut costate = product_fixed(self.terminal_cost, &free[n]);
        for j in (0..n).rev() {
            for (e, map) in maps[j].iter().enumerate() {
                let along: f64 = (0..6).map(|i| map[i] * costate[i]).sum();
                let effort: f64 = (0..3).map(|i| self.basis[(i, e)] * weighted[i]).sum();
                gradient[j * d + e] = 2.0 * (along + effort);
            }
            costate = product_fixed(self.stage_cost, &free[j])
                + transposed_fixed_product(&self.steps[j].0, &costate);
        }
        gradient
    }

    fn rows(&self, responses: &Responses) -> (DenseRows, Vec<f64>) {
        let (n, d, variables) = (self.horizon(), self.inputs(), self.variables());
        let mut rows = DenseRows::new(variables);
        let mut offsets = Vec::new();
        let mut row = vec![0.0; variables];
        for j in 0..n {
            for (f, &offset) in self.facet_offsets.iter().enumerate() {
                row.fill(0.0);
                (0..d).for_each(|c| row[j * d + c] = self.facets[(f, c)]);
                rows.push(&row);
                offsets.push(offset);
            }
        }
        let free = self.states(&vec![*self.origin; n]);
        for (i, cut) in self.cuts.iter().enumerate() {
            row.fill(0.0);
            let stage = cut.stage.min(n);
            for j in 0..stage {
                let response = responses.of(j, stage);
                for c in 0..d {
                    row[j * d + c] = -(0..6).map(|r| cut.normal[r] * response[(r, c)]).sum::<f64>();
                }
            }
            if self.softness.is_some() {
                row[n * d + i] = -1.0;
            }
            rows.push(&row);
            offsets.push(cut.normal.dot(&free[cut.stage.min(n)]) - cut.offset);
        }
        for i in n * d..variables {
            row.fill(0.0);
            row[i] = -1.0;
            rows.push(&row);
            offsets.push(0.0);
        }
        (rows, offsets)
    }

    /// x_0 .. x_N under given forces.
    #[must_use]
    pub fn states(&self, inputs: &[Vector3<f64>]) -> Vec<SVector<f64, 6>> {
        let mut states = vec![*self.initial];
        for ((a, b), u) in self.steps.iter().zip(inputs) {
            let x = states.last().unwrap_or(self.initial);
            states.push(product_fixed(a, x) + product_fixed(b, u));
        }
        states
    }

    /// (23a) of states and forces.
    #[must_use]
    pub fn objective(&self, states: &[SVector<f64, 6>], inputs: &[Vector3<f64>]) -> f64 {
        let form = |m: &SMatrix<f64, 6, 6>, x: &SVector<f64, 6>| x.dot(&product_fixed(m, x));
        let last = states.len().saturating_sub(1);
        let stages: f64 = states[..last].iter().map(|x| form(self.stage_cost, x)).sum();
        let effort: f64 = inputs.iter().map(|u| u.dot(&product_fixed(self.input_cost, u))).sum();
        states.last().map_or(0.0, |x| form(self.terminal_cost, x)) + stages + effort
    }

    /// Solves the condensed program, from the rows that were active in a similar one; by the
    /// general solver if the dual active set cannot prove its answer.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn solve(
        &self,
        condensed: &CondensedRegulator,
        start: &[usize],
        budget: Budget<'_>,
    ) -> Result<RegulatorAnswer, Interruption> {
        let program = QuadraticProgram {
            cost: &condensed.cost,
            gradient: &condensed.gradient,
            rows: &condensed.rows,
            offsets: &condensed.offsets,
        };
        let solution = DualActiveSet::default().solve(&program, start, budget)?;
        if matches!(solution.status, Status::Optimal | Status::PrimalInfeasible) {
            return Ok(self.answer(&solution, false));
        }
        Ok(self.answer(&Clarabel.solve_quadratic(&program, budget)?, true))
    }

    /// The least t >= 0 that, added to the right side of every cut or of every facet, lets the
    /// program have an answer; recomputed from the forces that show it. `None` if the solver
    /// fails. Cuts at stage 0, which no force changes, count as the others.
    ///
    /// # Errors
    /// The [`Interruption`] of the budget.
    pub fn least_relaxation(
        &self,
        condensed: &CondensedRegulator,
        relaxed: RelaxedRows,
        budget: Budget<'_>,
    ) -> Result<Option<f64>, Interruption> {
        let facet_rows = self.horizon() * self.facet_offsets.len();
        let forces = self.horizon() * self.inputs();
        let gives_way = |row: usize| (row < facet_rows) == (relaxed == RelaxedRows::Facets);
        let rows = facet_rows + self.cuts.len();
        let mut program = ConeProgram::default();
        let first = program.variables(forces + 1);
        program.add_linear_cost(first + forces, 1.0);
        let row = |row: usize| {
            let normal = &condensed.rows.normal(row)[..forces];
            let entries = normal.iter().enumerate().map(|(c, a)| (first + c, -a));
            let slack = gives_way(row).then_some((first + forces, 1.0));
            Affine { constant: condensed.offsets[row], entries: entries.chain(slack).collect() }
        };
        let nonnegative = Affine { constant: 0.0, entries: vec![(first + forces, 1.0)] };
        let limits: Vec<Affine> = (0..rows).map(row).chain([nonnegative]).collect();
        program.nonnegative(&limits);
        let solution = program.solve(budget)?;
        let violation = |row: usize| {
            let normal = &condensed.rows.normal(row)[..forces];
            let product: f64 = normal.iter().zip(&solution.x).map(|(a, x)| a * x).sum();
            product - condensed.offsets[row]
        };
        let solved = matches!(solution.status, Status::Optimal | Status::Inaccurate);
        Ok(solved.then(|| (0..rows).filter(|&r| gives_way(r)).map(violation).fold(0.0, f64::max)))
    }

    fn answer(&self, solution: &QuadraticSolution, by_general_solver: bool) -> RegulatorAnswer {
        let (n, d) = (self.horizon(), self.inputs());
        let mut answer = RegulatorAnswer {
            status: solution.status,
            inputs: Vec::new(),
            states: Vec::new(),
            objective: f64::INFINITY,
            violations: Vec::new(),
            active: solution.active.clone(),
            iterations: solution.iterations,
            by_general_solver,
        };
        if solution.status != Status::Optimal {
            return answer;
        }
        let force = |j: usize| {
            let w = &solution.point[j * d..][..d];
            let along = |i: usize| (0..d).map(|c| self.basis[(i, c)] * w[c]).sum::<f64>();
            self.origin + Vector3::new(along(0), along(1), along(2))
        };
        answer.inputs = (0..n).map(force).collect();
        answer.states = self.states(&answer.inputs);
        answer.objective = self.objective(&answer.states, &answer.inputs);
        let violation = |cut: &StateCut| {
            (cut.offset - cut.normal.dot(&answer.states[cut.stage.min(n)])).max(0.0)
        };
        answer.violations = self.cuts.iter().map(violation).collect();
        answer
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A free mass, 10 s steps.
    fn steps(n: usize) -> Vec<(SMatrix<f64, 6, 6>, SMatrix<f64, 6, 3>)> {
        let mut a = SMatrix::<f64, 6, 6>::identity();
        let mut b = SMatrix::<f64, 6, 3>::zeros();
        for i in 0..3 {
            a[(i, i + 3)] = 10.0;
            b[(i, i)] = 50.0;
            b[(i + 3, i)] = 10.0;
        }
        vec![(a, b); n]
    }

    fn check(
        basis: &DMatrix<f64>,
        cuts: &[StateCut],
        softness: Option<Softness>,
    ) -> RegulatorAnswer {
        let d = basis.ncols();
        let facets = DMatrix::from_fn(2 * d, d, |i, j| match (i / 2 == j, i % 2) {
            (false, _) => 0.0,
            (true, 0) => 1.0,
            (true, _) => -1.0,
        });
        let one = SMatrix::<f64, 6, 6>::identity();
        let steps = steps(12);
        let program = RegulatorProgram {
            steps: &steps,
            initial: &SVector::<f64, 6>::from_column_slice(&[200.0, -50.0, 10.0, 0.0, 0.5, 0.0]),
            stage_cost: &(one * 1e-3),
            terminal_cost: &one,
            input_cost: &(Matrix3::identity() * 10.0),
            origin: &Vector3::zeros(),
            basis,
            facets: &facets,
            facet_offsets: &DVector::from_element(2 * d, 1.0),
            cuts,
            softness,
        };
        let condensed = program.condense().unwrap();
        let answer = program.solve(&condensed, &[], Budget::UNLIMITED).unwrap();
        let quadratic = QuadraticProgram {
            cost: &condensed.cost,
            gradient: &condensed.gradient,
            rows: &condensed.rows,
            offsets: &condensed.offsets,
        };
        let general = Clarabel.solve_quadratic(&quadratic, Budget::UNLIMITED).unwrap();
        let general = program.answer(&general, true);
        assert!(!answer.by_general_solver);
        assert_eq!(answer.status, general.status);
        if answer.status == Status::Optimal {
            let priced = |a: &RegulatorAnswer| {
                let price = softness.map_or(0.0, |s| {
                    a.violations.iter().map(|v| s.linear * v + s.quadratic * v * v).sum()
                });
                a.objective + price
            };
            let gap = priced(&answer) / priced(&general) - 1.0;
            assert!(gap.abs() < 1e-6, "{gap:e}");
        }
        answer
    }

    fn away_from_target(stage: usize, offset: f64) -> StateCut {
        let mut normal = SVector::<f64, 6>::zeros();
        normal[0] = 0.01;
        StateCut { stage, normal, offset }
    }

    #[test]
    fn both_solvers_agree_with_and_without_cuts() {
        let basis = DMatrix::identity(3, 3) * 0.5;
        let free = check(&basis, &[], None);
        let cuts: Vec<StateCut> = (1..=12).map(|stage| away_from_target(stage, 1.5)).collect();
        let cut = check(&basis, &cuts, None);
        assert!(cut.objective > free.objective);
        assert!(cut.states[1..].iter().all(|x| x[0] >= 150.0 - 1e-6));
    }

    #[test]
    fn forces_on_a_line_stay_on_it() {
        let line = DMatrix::from_column_slice(3, 1, &[0.3, 0.0, 0.4]);
        let answer = check(&line, &[], None);
        for u in &answer.inputs {
            assert!((u[0] * 0.4 - u[2] * 0.3).abs() < 1e-12 && u[1] == 0.0);
        }
    }

    #[test]
    fn what_cannot_be_cleared_is_infeasible_and_softly_violated() {
        let basis = DMatrix::identity(3, 3) * 0.5;
        let cuts = [away_from_target(1, 5.0)];
        assert_eq!(check(&basis, &cuts, None).status, Status::PrimalInfeasible);
        let soft = Softness { linear: 1e6, quadratic: 1.0 };
        let answer = check(&basis, &cuts, Some(soft));
        // At most 0.5 N over 10 s of 1 kg: 25 m.
        assert!((answer.violations[0] - (5.0 - 2.25)).abs() < 1e-6, "{:?}", answer.violations);
    }
}
