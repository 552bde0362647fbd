//! A double integrator of uncertain strength, as an offline-sampling problem small enough to be
//! prepared in every test.

use nalgebra::{DMatrix, DVector};
use vbar_guidance::{
    Budget,
    control::{
        Controller, PrepareError,
        offline_sampling::{
            Artifact, Coordinates, CostWeights, GainChoice, Measurement, OfflineSampling, Problem,
            Redundancy, SampleChoice, Scheme, State, Step,
        },
    },
    dynamics::{Discretisation, MatrixPolynomial, UncertainPlant},
    reach::{GrowthLimits, InvariantLimits},
    sampling::ScalarLaw,
    sets::Polytope,
};

pub(crate) const DISTURBANCE: f64 = 0.02;

/// |x_i| <= sizes_i.
pub(crate) fn symmetric(sizes: &[f64]) -> Polytope {
    let n = sizes.len();
    let normals = DMatrix::from_fn(2 * n, n, |i, j| match i % n == j {
        true if i < n => 1.0,
        true => -1.0,
        false => 0.0,
    });
    Polytope::new(normals, DVector::from_fn(2 * n, |i, _| sizes[i % n]))
}

/// Position within 4, velocity within 1.5, input within 1 and known to 10 %, target at 0.
pub(crate) fn problem() -> Problem {
    let column = DMatrix::from_row_slice(2, 1, &[0.5, 1.0]);
    let plant = UncertainPlant {
        a: MatrixPolynomial::constant(DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0])),
        b: MatrixPolynomial::constant(column.clone()).with_linear(0, column),
        b_w: MatrixPolynomial::constant(DMatrix::identity(2, 2)),
        parameters: vec![ScalarLaw::Uniform { low: -0.1, high: 0.1 }],
        discretisation: Discretisation::None,
    };
    let identity = DMatrix::identity(2, 2);
    let half = DMatrix::from_element(1, 1, 0.5);
    Problem {
        scheme: Scheme::OfflineSampling,
        plant,
        coordinates: Coordinates::General,
        vertices: None,
        disturbance: vec![ScalarLaw::Uniform { low: -DISTURBANCE, high: DISTURBANCE }; 2],
        horizon: 5,
        gain: GainChoice::Lqr { state: identity.clone(), input: half.clone() },
        weights: CostWeights { state: identity, input: half, samples: 200 },
        state_set: symmetric(&[4.0, 1.5]),
        input_set: symmetric(&[1.0]),
        samples: SampleChoice {
            violation: 0.05,
            confidence_complement: 1e-3,
            variables: None,
            size: Some(400),
            state_at_start: false,
            rows_max: 50_000,
        },
        redundancy: Redundancy::Exact,
        terminal_limits: InvariantLimits { iterations_max: 100, rows_max: 500 },
        first_step: Some(GrowthLimits { rounds: 20, directions: 40, facets_max: 300 }),
        seed: 11,
    }
}

pub(crate) fn prepare(problem: &Problem) -> Result<Artifact, PrepareError> {
    let run = |shard| OfflineSampling::run_shard(problem, shard, Budget::UNLIMITED);
    // In reverse, because the order of computing must not matter, only that of merging.
    let count = OfflineSampling::shards(problem);
    let mut shards = (0..count).rev().map(run).collect::<Result<Vec<_>, _>>()?;
    shards.reverse();
    OfflineSampling::merge(problem, shards, Budget::UNLIMITED)
}

pub(crate) fn step(artifact: &Artifact, state: &State, x: &DVector<f64>) -> Step {
    let measurement = Measurement { state: x.clone(), elapsed: None };
    OfflineSampling::step(artifact, state, &measurement, Budget::UNLIMITED).unwrap()
}
