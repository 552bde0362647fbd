//! Sets grown from inside, against the largest one and against chance.

use nalgebra::{DMatrix, DVector};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget,
    program::{DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, Status},
    reach::{
        GrowthLimits, HalfSpaces, Invariant, InvariantLimits, PlantVertex, grow_control_invariant,
        max_robust_control_invariant, max_robust_positive_invariant,
    },
    sets::Zonotope,
};

const LIMITS: InvariantLimits = InvariantLimits { iterations_max: 200, rows_max: 5000 };

fn box_rows(n: usize, sizes: &[f64]) -> HalfSpaces {
    let mut rows = HalfSpaces::new(n);
    for (i, size) in sizes.iter().enumerate() {
        for sign in [1.0, -1.0] {
            let mut normal = vec![0.0; n];
            normal[i] = sign;
            rows.push(&normal, *size);
        }
    }
    rows
}

#[test]
fn growth_of_a_double_integrator_reaches_most_of_the_largest_set() {
    // |x| <= 5, |v| <= 2, |u| <= 1, |w| <= 0.05, u = K x + c.
    let gain = DMatrix::from_row_slice(1, 2, &[-0.4, -1.1]);
    let disturbance = Zonotope::centred(DMatrix::identity(2, 2) * 0.05);
    let b = DMatrix::from_row_slice(2, 1, &[0.5, 1.0]);
    let a = DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0]) + &b * &gain;
    let closed = [PlantVertex { a: a.clone(), b: DMatrix::zeros(2, 0), disturbance: &disturbance }];
    let open = [PlantVertex { a, b, disturbance: &disturbance }];
    // Rows over (x, c); the states alone for the seed.
    let mut rows = box_rows(3, &[5.0, 2.0]);
    let mut states = box_rows(2, &[5.0, 2.0]);
    for sign in [1.0, -1.0] {
        rows.push(&[sign * gain[0], sign * gain[1], sign], 1.0);
        states.push(&[sign * gain[0], sign * gain[1]], 1.0);
    }
    let Invariant::Found { set: seed, .. } =
        max_robust_positive_invariant(&states, &closed, LIMITS, Budget::UNLIMITED)
    else {
        panic!("no seed")
    };
    let all = HalfSpaces::new(2);
    let Invariant::Found { set: largest, .. } =
        max_robust_control_invariant(&rows, &all, &open, LIMITS, Budget::UNLIMITED)
    else {
        panic!("no largest set")
    };
    let limits = GrowthLimits { rounds: 20, directions: 40, facets_max: 500 };
    let grown = grow_control_invariant(&seed, &rows, &open, limits, Budget::UNLIMITED).unwrap();
    assert!(grown.rounds > 1 && !grown.limited, "{grown:?}");
    for corner in &grown.corners {
        assert!(largest.violation(corner.as_slice()) <= 1e-8, "{corner}");
        check_step(&rows, &grown.set, &open, corner);
    }
    // By area, since points are added only where they are worth it: 2 % short at most.
    let mut chance = ChaCha8Rng::seed_from_u64(3);
    let (mut inside, mut total, mut seeded) = (0, 0, 0);
    for _ in 0..20_000 {
        let point = [chance.random_range(-5.0..5.0), chance.random_range(-2.0..2.0)];
        if largest.violation(&point) <= 0.0 {
            total += 1;
            inside += usize::from(grown.set.violation(&point) <= 0.0);
            seeded += usize::from(seed.violation(&point) <= 0.0);
        }
    }
    assert!(inside * 100 >= total * 98, "{inside} of {total}");
    assert!(seeded * 100 <= total * 60, "the seed is no test: {seeded} of {total}");
}

/// From `state` some correction satisfies `rows` and leads into `set` for every vertex.
fn check_step(
    rows: &HalfSpaces,
    set: &HalfSpaces,
    plant: &[PlantVertex<'_>],
    state: &DVector<f64>,
) {
    let n = state.len();
    let corrections = rows.dimension() - n;
    let (mut lines, mut offsets) = (DenseRows::new(corrections), Vec::new());
    for row in 0..rows.len() {
        let (x, v) = rows.normal(row).split_at(n);
        let at: f64 = x.iter().zip(state.iter()).map(|(a, x)| a * x).sum();
        lines.push(v);
        // What a solver's tolerance leaves.
        offsets.push(rows.offset(row) - at + 1e-8);
    }
    for row in 0..set.len() {
        let h = DVector::from_column_slice(set.normal(row));
        for vertex in plant {
            let mut normal: Vec<f64> = (vertex.b.transpose() * &h).iter().copied().collect();
            normal.resize(corrections, 0.0);
            lines.push(&normal);
            let taken = vertex.disturbance.support_function(&h);
            offsets.push(set.offset(row) - taken - h.dot(&(&vertex.a * state)) + 1e-8);
        }
    }
    let cost = QuadraticCost::identity(corrections);
    let gradient = vec![0.0; corrections];
    let program =
        QuadraticProgram { cost: &cost, gradient: &gradient, rows: &lines, offsets: &offsets };
    let solution = DualActiveSet::default().solve(&program, &[], Budget::UNLIMITED).unwrap();
    assert_eq!(solution.status, Status::Optimal, "no step from {state}");
}
