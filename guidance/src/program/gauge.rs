//! Gauge of a zonotope with many generators.

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, IPSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT, ZeroConeT},
    },
};
use nalgebra::{DMatrix, DVector};

/// Least t with `point` = G xi and |xi|_inf <= t, for generators G (n x p); `None` if the point is
/// outside the span of the generators or the solver fails.
#[must_use]
pub fn zonotope_gauge(generators: &DMatrix<f64>, point: &DVector<f64>) -> Option<f64> {
    let (n, p) = generators.shape();
    // Variables xi (p), t. Rows: G xi = point, each scaled to its largest entry; +-xi - t <= 0.
    let (mut rows, mut columns, mut values) = (Vec::new(), Vec::new(), Vec::new());
    let mut right = Vec::with_capacity(n + 2 * p);
    for r in 0..n {
        let size = generators.row(r).amax();
        let scale = if size > 0.0 { 1.0 / size } else { 1.0 };
        for c in 0..p {
            if generators[(r, c)] != 0.0 {
                rows.push(r);
                columns.push(c);
                values.push(generators[(r, c)] * scale);
            }
        }
        right.push(point[r] * scale);
    }
    for c in 0..p {
        for sign in [1.0, -1.0] {
            rows.extend([right.len(); 2]);
            columns.extend([c, p]);
            values.extend([sign, -1.0]);
            right.push(0.0);
        }
    }
    let matrix = CscMatrix::new_from_triplets(right.len(), p + 1, rows, columns, values);
    let mut objective = vec![0.0; p + 1];
    objective[p] = 1.0;
    let cones: [SupportedConeT<f64>; 2] = [ZeroConeT(n), NonnegativeConeT(2 * p)];
    let settings = DefaultSettings {
        verbose: false,
        tol_gap_abs: 1e-10,
        tol_gap_rel: 1e-10,
        tol_feas: 1e-10,
        ..DefaultSettings::default()
    };
    let none = CscMatrix::zeros((p + 1, p + 1));
    let mut solver =
        DefaultSolver::new(&none, &objective, &matrix, &right, &cones, settings).ok()?;
    solver.solve();
    (solver.solution.status == SolverStatus::Solved).then(|| solver.solution.x[p])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gauge_with_dependent_generators_is_exact() {
        // {(a + c, b + c)}: a hexagon; (2, 2) is its corner, (1.5, -1.5) lies beyond an edge.
        let generators = DMatrix::from_row_slice(2, 3, &[1.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
        let gauge = |x: f64, y: f64| zonotope_gauge(&generators, &DVector::from_vec(vec![x, y]));
        assert!((gauge(2.0, 2.0).unwrap() - 1.0).abs() < 1e-8);
        assert!((gauge(1.5, -1.5).unwrap() - 1.5).abs() < 1e-8);
    }

    #[test]
    fn gauge_outside_the_span_is_none() {
        let generators = DMatrix::from_row_slice(2, 1, &[1.0, 0.0]);
        assert_eq!(zonotope_gauge(&generators, &DVector::from_vec(vec![0.0, 1.0])), None);
    }
}
