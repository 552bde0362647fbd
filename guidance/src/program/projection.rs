//! Euclidean projection onto a polytope.

use ::clarabel::{
    algebra::CscMatrix,
    solver::{
        DefaultSettings, DefaultSolver, IPSolver, SolverStatus,
        SupportedConeT::{self, NonnegativeConeT},
    },
};
use nalgebra::{DMatrix, DVector};

/// The point of {x : normals x <= offsets} nearest to `point`; `None` if that set is empty or the
/// solver fails. A point that is inside is returned as it is.
///
/// For a handful of half-spaces on the hot path see `mission::ConeFaces::nearest_point`, which
/// is exact; this is the general case, by Clarabel.
#[must_use]
pub fn project_onto_polytope(
    point: &DVector<f64>,
    normals: &DMatrix<f64>,
    offsets: &DVector<f64>,
) -> Option<DVector<f64>> {
    let margins = offsets - normals * point;
    if margins.iter().all(|&margin| margin >= 0.0) {
        return Some(point.clone());
    }
    let n = point.len();
    let (rows, columns, values) = normals
        .column_iter()
        .enumerate()
        .flat_map(|(c, column)| {
            let entries: Vec<_> = column.iter().copied().enumerate().collect();
            entries.into_iter().map(move |(r, h)| (r, c, h))
        })
        .filter(|entry| entry.2 != 0.0)
        .fold((Vec::new(), Vec::new(), Vec::new()), |mut lists, (r, c, h)| {
            lists.0.push(r);
            lists.1.push(c);
            lists.2.push(h);
            lists
        });
    let q = offsets.len();
    let matrix = CscMatrix::new_from_triplets(q, n, rows, columns, values);
    // Minimise |x - p|^2 / 2 over y = x - p, so that the objective has no large constant part.
    let cones: [SupportedConeT<f64>; 1] = [NonnegativeConeT(q)];
    let settings = DefaultSettings {
        verbose: false,
        tol_gap_abs: 1e-12,
        tol_gap_rel: 1e-12,
        tol_feas: 1e-12,
        ..DefaultSettings::default()
    };
    let identity = CscMatrix::identity(n);
    let mut solver =
        DefaultSolver::new(&identity, &vec![0.0; n], &matrix, margins.as_slice(), &cones, settings)
            .ok()?;
    solver.solve();
    matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved)
        .then(|| point + DVector::from_column_slice(&solver.solution.x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projection_onto_a_box_clips() {
        let normals = DMatrix::from_row_slice(4, 2, &[1.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, -1.0]);
        let ones = DVector::from_element(4, 1.0);
        let nearest =
            project_onto_polytope(&DVector::from_vec(vec![3.0, 0.5]), &normals, &ones).unwrap();
        assert!((nearest - DVector::from_vec(vec![1.0, 0.5])).norm() < 1e-9);
    }

    #[test]
    fn projection_onto_nothing_is_none() {
        let normals = DMatrix::from_row_slice(2, 1, &[1.0, -1.0]);
        let offsets = DVector::from_vec(vec![-1.0, -1.0]);
        assert_eq!(project_onto_polytope(&DVector::zeros(1), &normals, &offsets), None);
    }
}
