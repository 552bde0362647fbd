//! The docking of [Mammarella2019, sec. IV] as an offline-sampling problem, target at the origin.

use nalgebra::{DMatrix, DVector};
use vbar_guidance::{
    control::offline_sampling::{
        Coordinates, CostWeights, GainChoice, Problem, Redundancy, SampleChoice, Scheme,
    },
    dynamics::{PoseidynVariant, poseidyn},
    reach::InvariantLimits,
    sampling::ScalarLaw,
    sets::Polytope,
};

/// Where the target is from the cone's apex: no invariant set fits around the apex itself.
pub(crate) const TARGET_M: [f64; 2] = [0.3, 0.3];
/// The paper's bound on the components of w.
pub(crate) const DISTURBANCE: f64 = 5e-3;
/// Starts A, B and C, from the apex.
pub(crate) const STARTS_M: [[f64; 2]; 3] = [[2.5, 2.5], [2.9, 1.75], [2.75, 2.1]];

fn diagonal(entries: &[f64]) -> DMatrix<f64> {
    DMatrix::from_diagonal(&DVector::from_column_slice(entries))
}

fn polytope(rows: &[(Vec<f64>, f64)]) -> Polytope {
    let normals: Vec<f64> = rows.iter().flat_map(|row| row.0.iter().copied()).collect();
    let offsets = DVector::from_iterator(rows.len(), rows.iter().map(|row| row.1));
    Polytope::new(DMatrix::from_row_slice(rows.len(), rows[0].0.len(), &normals), offsets)
}

/// |x_i| <= size for the components from `first` on, of n.
fn within(first: usize, n: usize, size: f64) -> impl Iterator<Item = (Vec<f64>, f64)> {
    (first..n).flat_map(move |i| {
        [1.0, -1.0].map(|sign| {
            let mut normal = vec![0.0; n];
            normal[i] = sign;
            (normal, size)
        })
    })
}

/// The cone with corners (0, 0), (4, 2.25), (2.25, 4) about the target, velocities of 0.1 m/s.
fn state_set() -> Polytope {
    let far = std::f64::consts::FRAC_1_SQRT_2;
    let length = libm::hypot(4.0, 2.25);
    let faces = [
        (2.25 / length, -4.0 / length, 0.0),
        (-4.0 / length, 2.25 / length, 0.0),
        (far, far, 6.25 * far),
    ];
    let faces = faces
        .map(|(x, y, offset)| (vec![x, y, 0.0, 0.0], offset - x * TARGET_M[0] - y * TARGET_M[1]));
    polytope(&faces.into_iter().chain(within(2, 4, 0.1)).collect::<Vec<_>>())
}

/// With `size` samples a group.
pub(crate) fn problem(size: usize) -> Problem {
    // The weights under which the independent implementation reproduces the paper.
    let (state, input) = (diagonal(&[1e6, 1e6, 1e8, 1e8]), diagonal(&[1e6, 1e6]));
    Problem {
        scheme: Scheme::OfflineSampling,
        plant: poseidyn(PoseidynVariant::Printed, 9.882, 5.0),
        coordinates: Coordinates::Planar,
        vertices: None,
        disturbance: vec![ScalarLaw::TruncatedGaussian { deviation: 1.0, bound: DISTURBANCE }; 4],
        horizon: 10,
        gain: GainChoice::Lqr { state: state.clone(), input: input.clone() },
        weights: CostWeights { state, input, samples: 1000 },
        state_set: state_set(),
        input_set: polytope(&within(0, 2, 0.3).collect::<Vec<_>>()),
        samples: SampleChoice {
            violation: 0.05,
            confidence_complement: 1e-3,
            variables: None,
            size: Some(size),
            state_at_start: false,
            rows_max: 2_000_000,
        },
        redundancy: Redundancy::InnerScaled { epsilon: 0.01 },
        terminal_limits: InvariantLimits { iterations_max: 100, rows_max: 2000 },
        first_step: None,
        seed: 2019,
    }
}
