//! Half-spaces between a point and convex sets, emptiness of polytopes, nearest points of them.

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, IPSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT, SecondOrderConeT, ZeroConeT},
    },
};
use nalgebra::{DMatrix, DVector};

use super::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status};
use crate::{budget::Budget, matrices::times_vector};

/// A polytope that lies elsewhere, {y : normals y <= offsets}: normals q x n, offsets q.
#[derive(Debug, Clone, Copy)]
pub struct PolytopeView<'a> {
    /// q x n.
    pub normals: &'a DMatrix<f64>,
    /// q.
    pub offsets: &'a DVector<f64>,
}

/// {y : normal y <= 1} holds all the sets.
#[derive(Debug, Clone, PartialEq)]
pub struct Separation {
    /// h.
    pub normal: DVector<f64>,
    /// h x - 1, the largest possible: negative if no half-space around the origin that holds all
    /// the sets leaves x out.
    pub clearance: f64,
}

/// What came of a separation.
#[derive(Debug, Clone, PartialEq)]
pub enum SeparationOutcome {
    /// The best half-space.
    Found(Separation),
    /// The clearance has no bound, which needs the origin outside the sets.
    Unbounded,
    /// The solver failed.
    Failed,
}

/// Largest clearance of x from one half-space that holds every polytope {y : H y <= l}, without
/// the paper's s >= 0. Problem (28) is feasible if and only if it is not negative.
/// [AguilarMarsillach2022, eq. 28]
///
/// A common half-space rarely exists for many sets; the method takes one for each set instead,
/// which has a closed form. This program is the general case and the check on it.
#[must_use]
pub fn separate_from_polytopes(sets: &[PolytopeView<'_>], x: &DVector<f64>) -> SeparationOutcome {
    let n = x.len();
    let units = row_units(sets, n);
    // Variables: h in units (n), s, then the multipliers of each set's rows.
    let multipliers: usize = sets.iter().map(|set| set.offsets.len()).sum();
    let mut program = Sparse::new(n + 1 + multipliers);
    program.cost[n] = -1.0;
    let mut first = n + 1;
    for set in sets {
        // H' lambda - h = 0, each component in its unit.
        for c in 0..n {
            let row = (0..set.offsets.len()).map(|r| (first + r, set.normals[(r, c)] * units[c]));
            program.row(0.0, row.chain([(c, -1.0)]));
        }
        first += set.offsets.len();
    }
    let equalities = program.right.len();
    program.row(-1.0, (0..n).map(|c| (c, -x[c] / units[c])).chain([(n, 1.0)]));
    first = n + 1;
    for set in sets {
        program.row(1.0, (0..set.offsets.len()).map(|r| (first + r, set.offsets[r])));
        first += set.offsets.len();
    }
    (0..multipliers).for_each(|r| program.row(0.0, [(n + 1 + r, -1.0)]));
    let inequalities = program.right.len() - equalities;
    let cones = [ZeroConeT(equalities), NonnegativeConeT(inequalities)];
    program.separation(&cones, &units)
}

/// Largest clearance of x from one half-space that holds every ellipsoid {y : y'Py <= 1}, without
/// the paper's s >= 0. The cone is on Q^(1/2) a: (31) and (32d) print Q a.
/// [AguilarMarsillach2022, eq. 32]
#[must_use]
pub fn separate_from_ellipsoids(
    precisions: &[&DMatrix<f64>],
    x: &DVector<f64>,
) -> SeparationOutcome {
    let n = x.len();
    let units: Vec<f64> = (0..n)
        .map(|c| precisions.iter().map(|p| p[(c, c)]).fold(0.0, f64::max).sqrt().recip())
        .collect();
    let mut program = Sparse::new(n + 1);
    program.cost[n] = -1.0;
    program.row(-1.0, (0..n).map(|c| (c, -x[c] / units[c])).chain([(n, 1.0)]));
    let mut cones: Vec<SupportedConeT<f64>> = vec![NonnegativeConeT(1)];
    for precision in precisions {
        // In units, P = L L' and the support of a is |L^-1 a|.
        let scaled = DMatrix::from_fn(n, n, |i, j| precision[(i, j)] * units[i] * units[j]);
        let root = nalgebra::Cholesky::new(scaled).map(|factor| factor.l());
        let Some(inverse) = root.and_then(|l| l.try_inverse()) else {
            return SeparationOutcome::Failed;
        };
        program.row(1.0, []);
        for r in 0..n {
            program.row(0.0, (0..=r).map(|c| (c, -inverse[(r, c)])));
        }
        cones.push(SecondOrderConeT(n + 1));
    }
    program.separation(&cones, &units)
}

/// Is {y : normals y <= offsets} empty? By the largest radius of a ball in it, in parts of the
/// largest offset.
#[must_use]
pub fn polytope_is_empty(normals: &DMatrix<f64>, offsets: &DVector<f64>) -> bool {
    let size = offsets.amax();
    let n = normals.ncols();
    let mut program = Sparse::new(n + 1);
    program.cost[n] = -1.0;
    for (r, normal) in normals.row_iter().enumerate() {
        let length = normal.norm();
        if length == 0.0 {
            if offsets[r] < 0.0 {
                return true;
            }
            continue;
        }
        let entries = (0..n).map(|c| (c, normal[c] / length)).chain([(n, 1.0)]);
        program.row(offsets[r] / length / size.max(f64::MIN_POSITIVE), entries);
    }
    // A ball of radius 1 is more than enough; without this an unbounded set has no largest one.
    program.row(1.0, [(n, 1.0)]);
    let cones = [NonnegativeConeT(program.right.len())];
    let Some((status, point)) = program.solve(&cones) else { return false };
    status == SolverStatus::Solved && point[n] < 0.0
}

/// The point of a polytope nearest to x in the Euclidean norm, by the dual active set; `None` if
/// the polytope is empty or the answer failed its verification.
#[must_use]
pub fn nearest_point_of_polytope(set: PolytopeView<'_>, x: &DVector<f64>) -> Option<DVector<f64>> {
    let margins = set.offsets - times_vector(set.normals, x);
    if margins.iter().all(|&margin| margin >= 0.0) {
        return Some(x.clone());
    }
    // Over y - x, so that numbers are as large as the distance.
    let program = QuadraticProgram {
        cost: &QuadraticCost::identity(x.len()),
        gradient: &vec![0.0; x.len()],
        rows: &DenseRows::from_matrix(set.normals),
        offsets: margins.as_slice(),
    };
    let solution = DualActiveSet::default().solve(&program, &[], Budget::UNLIMITED).ok()?;
    (solution.status == Status::Optimal).then(|| x + DVector::from_vec(solution.point))
}

/// A unit for each component of h: what makes the largest entry of its column 1 beside the largest
/// offset.
fn row_units(sets: &[PolytopeView<'_>], n: usize) -> Vec<f64> {
    let unit = |c: usize| {
        let largest = sets
            .iter()
            .map(|set| set.normals.column(c).amax() / set.offsets.amax())
            .fold(0.0, f64::max);
        if largest > 0.0 { 1.0 / largest } else { 1.0 }
    };
    (0..n).map(unit).collect()
}

/// A conic program, row by row.
struct Sparse {
    cost: Vec<f64>,
    triplets: (Vec<usize>, Vec<usize>, Vec<f64>),
    right: Vec<f64>,
}

impl Sparse {
    fn new(variables: usize) -> Self {
        let triplets = (Vec::new(), Vec::new(), Vec::new());
        Self { cost: vec![0.0; variables], triplets, right: Vec::new() }
    }

    fn row(&mut self, right: f64, entries: impl IntoIterator<Item = (usize, f64)>) {
        for (column, value) in entries {
            if value != 0.0 {
                self.triplets.0.push(self.right.len());
                self.triplets.1.push(column);
                self.triplets.2.push(value);
            }
        }
        self.right.push(right);
    }

    fn solve(&self, cones: &[SupportedConeT<f64>]) -> Option<(SolverStatus, Vec<f64>)> {
        let n = self.cost.len();
        let (rows, columns, values) = self.triplets.clone();
        let matrix = CscMatrix::new_from_triplets(self.right.len(), n, rows, columns, values);
        let settings = DefaultSettings {
            verbose: false,
            tol_gap_abs: 1e-11,
            tol_gap_rel: 1e-11,
            tol_feas: 1e-11,
            ..DefaultSettings::default()
        };
        let none = CscMatrix::zeros((n, n));
        let mut solver =
            DefaultSolver::new(&none, &self.cost, &matrix, &self.right, cones, settings).ok()?;
        solver.solve();
        Some((solver.solution.status, solver.solution.x))
    }

    /// The first variables are h in units, then comes the clearance.
    fn separation(&self, cones: &[SupportedConeT<f64>], units: &[f64]) -> SeparationOutcome {
        let n = units.len();
        match self.solve(cones) {
            Some((SolverStatus::Solved | SolverStatus::AlmostSolved, point)) => {
                let normal = DVector::from_fn(n, |c, _| point[c] / units[c]);
                SeparationOutcome::Found(Separation { normal, clearance: point[n] })
            }
            Some((SolverStatus::DualInfeasible | SolverStatus::AlmostDualInfeasible, _)) => {
                SeparationOutcome::Unbounded
            }
            _ => SeparationOutcome::Failed,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(offsets: [f64; 4]) -> (DMatrix<f64>, DVector<f64>) {
        let normals = [1.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, -1.0];
        (DMatrix::from_row_slice(4, 2, &normals), DVector::from_row_slice(&offsets))
    }

    fn of(set: &(DMatrix<f64>, DVector<f64>)) -> PolytopeView<'_> {
        PolytopeView { normals: &set.0, offsets: &set.1 }
    }

    fn with_semi_axes(axes: [f64; 2]) -> DMatrix<f64> {
        DMatrix::from_diagonal(&DVector::from_row_slice(&axes).map(|a| 1.0 / (a * a)))
    }

    fn found(outcome: SeparationOutcome) -> Separation {
        let SeparationOutcome::Found(separation) = outcome else { panic!("{outcome:?}") };
        separation
    }

    #[test]
    fn one_polytope_has_the_closed_form() {
        let set = square([2.0, 1.0, 2.0, 1.0]);
        let x = DVector::from_vec(vec![3.0, 2.5]);
        let separation = found(separate_from_polytopes(&[of(&set)], &x));
        assert!((separation.clearance - 1.5).abs() < 1e-8, "max H x / l - 1");
    }

    #[test]
    fn origin_outside_can_leave_the_clearance_unbounded() {
        // 1 <= x <= 2, |y| <= 1. No half-space {h y <= 1} can be turned further and further about
        // the set if the point lies on a ray through it.
        let set = square([2.0, 1.0, -1.0, 1.0]);
        let hidden = DVector::from_vec(vec![3.0, 2.5]);
        assert!(
            (found(separate_from_polytopes(&[of(&set)], &hidden)).clearance - 1.5).abs() < 1e-8
        );
        let aside = DVector::from_vec(vec![1.0, 3.0]);
        assert_eq!(separate_from_polytopes(&[of(&set)], &aside), SeparationOutcome::Unbounded);
    }

    #[test]
    fn one_ellipsoid_has_the_tangent() {
        let precision = with_semi_axes([2.0, 1e3]);
        let x = DVector::from_vec(vec![3.0, 2500.0]);
        let gauge = x.dot(&(&precision * &x)).sqrt();
        let separation = found(separate_from_ellipsoids(&[&precision], &x));
        assert!((separation.clearance - (gauge - 1.0)).abs() < 1e-8);
        assert!((separation.normal - &precision * &x / gauge).amax() < 1e-8);
    }

    #[test]
    fn common_half_space_holds_both_ellipsoids() {
        let sets = [[2.0, 1.0], [1.0, 2.0]].map(with_semi_axes);
        let x = DVector::from_vec(vec![3.0, 3.0]);
        let separation = found(separate_from_ellipsoids(&[&sets[0], &sets[1]], &x));
        for (a, b) in [(2.0, 1.0), (1.0, 2.0)] {
            let h = &separation.normal;
            assert!(libm::hypot(a * h[0], b * h[1]) <= 1.0 + 1e-8);
        }
        // By symmetry h = (c, c) with c sqrt 5 = 1.
        assert!((separation.clearance - (6.0 / 5.0_f64.sqrt() - 1.0)).abs() < 1e-8);
    }

    #[test]
    fn emptiness_and_nearest_points() {
        let empty = square([1.0, 1.0, -1.5, 1.0]);
        assert!(polytope_is_empty(&empty.0, &empty.1));
        let touching = square([1.0, 1.0, 1.0, 1.0]);
        assert!(!polytope_is_empty(&touching.0, &touching.1));
        let x = DVector::from_vec(vec![3.0, 0.5]);
        let nearest = nearest_point_of_polytope(of(&touching), &x).unwrap();
        assert!((nearest - DVector::from_vec(vec![1.0, 0.5])).norm() < 1e-12);
        assert_eq!(nearest_point_of_polytope(of(&empty), &x), None);
    }
}
