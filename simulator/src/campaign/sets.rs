//! Sets the pictures and statistics need: S(N), S(infinity) and their shadows.
//!
//! S(N) is the sum of A_K^i W for i below N, A_K = A + B K [Quartullo2025a, eq. 15]. Gain and
//! generators of W come from the artifact, because the set belongs to the controller.

use nalgebra::{DMatrix, DVector};
use vbar_proto::v1::{self, VariableHorizonArtifact};

use crate::mission::model::matrix;

/// Terms of the infinite sum beyond which it is stopped.
const TERMS_MAX: usize = 10_000;

/// The infinite sum stops when a term's largest entry is below this share of the first's.
const TERM_TOLERANCE: f64 = 1e-15;

/// Generators of the error sets of one controller.
#[derive(Debug, Clone)]
pub(crate) struct ErrorSets {
    closed_loop: DMatrix<f64>,
    disturbance: DMatrix<f64>,
}

impl ErrorSets {
    /// Reads an artifact; the faults say what it lacks.
    pub(crate) fn new(artifact: &VariableHorizonArtifact) -> Result<Self, String> {
        let mut faults = Vec::new();
        let mut read = |place: &str, given: Option<&v1::Matrix>| matrix(place, given, &mut faults);
        let a = read("a", artifact.a.as_ref());
        let b = read("b", artifact.b.as_ref());
        let gain = read("gain", artifact.gain.as_ref());
        let disturbance = match &artifact.disturbance_generators_nd {
            // W = {0} has no columns.
            Some(given) if given.values.is_empty() => DMatrix::zeros(a.nrows(), 0),
            given => read("disturbance_generators_nd", given.as_ref()),
        };
        let n = a.nrows();
        let fits = a.ncols() == n
            && b.nrows() == n
            && gain.shape() == (b.ncols(), n)
            && disturbance.nrows() == n;
        if !faults.is_empty() || !fits {
            return Err(format!("the artifact's matrices do not fit: {}", faults.join("; ")));
        }
        Ok(Self { closed_loop: a + b * gain, disturbance })
    }

    /// Generators of S(terms), one a column.
    pub(crate) fn generators(&self, terms: usize) -> DMatrix<f64> {
        self.sum(terms.min(TERMS_MAX), 0.0)
    }

    /// Generators of S(infinity), its sum stopped where terms vanish.
    pub(crate) fn generators_of_limit(&self) -> DMatrix<f64> {
        self.sum(TERMS_MAX, TERM_TOLERANCE * self.disturbance.amax())
    }

    fn sum(&self, terms: usize, tolerance: f64) -> DMatrix<f64> {
        let mut columns = Vec::new();
        let mut term = self.disturbance.clone();
        for _ in 0..terms {
            if term.ncols() == 0 || term.amax() <= tolerance {
                break;
            }
            columns.extend(term.column_iter().map(|column| column.into_owned()));
            term = &self.closed_loop * term;
        }
        if columns.is_empty() {
            return DMatrix::zeros(self.disturbance.nrows(), 0);
        }
        DMatrix::from_columns(&columns)
    }
}

/// Greatest distance of a point of the projected zonotope from its centre: the radius of the
/// least ball about the centre that holds it. This is the definition that reproduces the radii of
/// [Quartullo2025a, sec. V.A].
///
/// `rows` of the generators are kept. A vertex that is farthest in its own direction is reached
/// by ascent from the axes and diagonals; of those found, the farthest counts.
pub(crate) fn radius(generators: &DMatrix<f64>, rows: usize) -> f64 {
    let shadow = generators.rows(0, rows).into_owned();
    let directions = 3_usize.pow(u32::try_from(rows).unwrap_or(0).min(8));
    let mut farthest = 0.0_f64;
    for code in 0..directions {
        let mut digits = code;
        let mut direction = DVector::from_fn(rows, |_, _| {
            let digit = digits % 3;
            digits /= 3;
            digit as f64 - 1.0
        });
        let mut reached = 0.0;
        while let Some(vertex) = farthest_vertex(&shadow, &direction) {
            if vertex.norm() <= reached {
                break;
            }
            reached = vertex.norm();
            direction = vertex;
        }
        farthest = farthest.max(reached);
    }
    farthest
}

fn farthest_vertex(generators: &DMatrix<f64>, direction: &DVector<f64>) -> Option<DVector<f64>> {
    if direction.norm() == 0.0 {
        return None;
    }
    let signs =
        (generators.transpose() * direction).map(|along| if along < 0.0 { -1.0 } else { 1.0 });
    Some(generators * signs)
}

/// Whether `x` lies in the plane zonotope: every edge's normal is tried, |n x| <= sum |n g|.
pub(crate) fn contains_in_plane(generators: &DMatrix<f64>, x: &DVector<f64>) -> bool {
    let normals = generators.column_iter().map(|g| DVector::from_vec(vec![-g[1], g[0]]));
    normals.filter(|normal| normal.norm() > 0.0).all(|normal| {
        let reach: f64 = generators.column_iter().map(|g| normal.dot(&g).abs()).sum();
        normal.dot(x).abs() <= reach
    })
}

/// Corners of a plane zonotope in order, for drawing: generators sorted by direction, walked
/// forth and back.
pub(crate) fn outline(generators: &DMatrix<f64>, rows: [usize; 2]) -> Vec<(f64, f64)> {
    let mut edges: Vec<(f64, f64)> = generators
        .column_iter()
        .map(|g| (g[rows[0]], g[rows[1]]))
        .filter(|(x, y)| x.hypot(*y) > 0.0)
        .map(|(x, y)| if y < 0.0 || (y == 0.0 && x < 0.0) { (-x, -y) } else { (x, y) })
        .collect();
    edges.sort_by(|a, b| a.1.atan2(a.0).total_cmp(&b.1.atan2(b.0)));
    let mut corner = edges.iter().fold((0.0, 0.0), |sum, edge| (sum.0 - edge.0, sum.1 - edge.1));
    let mut corners = vec![corner];
    for sign in [2.0, -2.0] {
        for edge in &edges {
            corner = (corner.0 + sign * edge.0, corner.1 + sign * edge.1);
            corners.push(corner);
        }
    }
    corners
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matrix_message(matrix: &DMatrix<f64>) -> v1::Matrix {
        v1::Matrix {
            rows: matrix.nrows() as i32,
            columns: matrix.ncols() as i32,
            values: matrix.transpose().as_slice().to_vec(),
        }
    }

    fn double_integrator() -> ErrorSets {
        let artifact = VariableHorizonArtifact {
            a: Some(matrix_message(&DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]))),
            b: Some(matrix_message(&DMatrix::from_row_slice(2, 1, &[0.0, 1.0]))),
            gain: Some(matrix_message(&DMatrix::from_row_slice(1, 2, &[-0.06, -0.5]))),
            disturbance_generators_nd: Some(matrix_message(&DMatrix::from_row_slice(
                2,
                2,
                &[0.1, 0.0, 0.0, 0.4],
            ))),
            ..VariableHorizonArtifact::default()
        };
        ErrorSets::new(&artifact).expect("it fits")
    }

    #[test]
    fn sets_limit_is_invariant() {
        let sets = double_integrator();
        let limit = sets.generators_of_limit();
        let corners = outline(&limit, [0, 1]);
        for (x, y) in corners {
            let image = &sets.closed_loop * DVector::from_vec(vec![x, y]);
            for (p, q) in [(0.1, 0.4), (0.1, -0.4), (-0.1, 0.4), (-0.1, -0.4)] {
                let next = (&image + DVector::from_vec(vec![p, q])) * (1.0 - 1e-9);
                assert!(contains_in_plane(&limit, &next), "{next}");
            }
        }
    }

    /// Foreign numbers: half widths of S(j) are the tightenings of a box [reference case di00].
    #[test]
    fn sets_agree_with_reference_tightening() {
        let sets = double_integrator();
        let case = &crate::tests::golden_cases("double_integrator_003.json")[0];
        for (step, expected) in case["expected"]["state_tightening"].as_object().expect("steps") {
            let generators = sets.generators(step.parse().expect("a step"));
            let expected = crate::tests::vector(expected);
            for row in 0..2 {
                let half_width: f64 = generators.row(row).iter().map(|g| g.abs()).sum();
                assert!((half_width - expected[2 * row]).abs() < 1e-12, "S({step}) row {row}");
            }
        }
    }

    #[test]
    fn sets_membership_splits_at_the_outline() {
        let limit = double_integrator().generators_of_limit();
        for (x, y) in outline(&limit, [0, 1]) {
            assert!(contains_in_plane(&limit, &DVector::from_vec(vec![0.999 * x, 0.999 * y])));
            assert!(!contains_in_plane(&limit, &DVector::from_vec(vec![1.001 * x, 1.001 * y])));
        }
    }

    #[test]
    fn sets_radius_of_a_box_is_its_half_diagonal() {
        let generators = DMatrix::from_diagonal(&DVector::from_vec(vec![3.0, 4.0, 12.0, 7.0]));
        assert!((radius(&generators, 3) - 13.0).abs() < 1e-12);
    }
}
