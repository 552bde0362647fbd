//! The floating spacecraft of [Mammarella2019] as a scenario program, in shards and as a whole.

use nalgebra::DMatrix;
use vbar_guidance::{
    Budget,
    dynamics::{PoseidynVariant, UncertainPlant, linear_quadratic_regulator, poseidyn},
    reach::{
        EXACT, GroupPart, HalfSpaces, Invariant, InvariantLimits, PlantVertex, Scenario,
        StageConstraints, StageGroup, Survivors, irredundant, max_robust_positive_invariant,
    },
    sampling::ScalarLaw,
    sets::Zonotope,
};

const DISTURBANCE: f64 = 5e-3;
const TARGET_M: [f64; 2] = [0.3, 0.3];
const HORIZON: usize = 10;

/// The cone with vertices (0, 0), (4, 2.25), (2.25, 4) about the target, velocities of 0.1 m/s.
fn state_constraints() -> HalfSpaces {
    let mut rows = HalfSpaces::new(4);
    let far = std::f64::consts::FRAC_1_SQRT_2;
    let length = libm::hypot(4.0, 2.25);
    for (x, y, offset) in [
        (2.25 / length, -4.0 / length, 0.0),
        (-4.0 / length, 2.25 / length, 0.0),
        (far, far, 6.25 * far),
    ] {
        rows.push(&[x, y, 0.0, 0.0], offset - x * TARGET_M[0] - y * TARGET_M[1]);
    }
    for axis in [2, 3] {
        for sign in [1.0, -1.0] {
            let mut normal = [0.0; 4];
            normal[axis] = sign;
            rows.push(&normal, 0.1);
        }
    }
    rows
}

fn input_constraints() -> HalfSpaces {
    let mut rows = HalfSpaces::new(2);
    for normal in [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]] {
        rows.push(&normal, 0.3);
    }
    rows
}

struct Mission {
    plant: UncertainPlant,
    gain: DMatrix<f64>,
    constraints: StageConstraints,
    groups: Vec<StageGroup>,
    disturbance: Vec<ScalarLaw>,
}

impl Mission {
    fn new() -> Self {
        let plant = poseidyn(PoseidynVariant::Printed, 9.882, 5.0);
        let mean = plant.at_mean();
        let diagonal = |entries: &[f64]| DMatrix::from_diagonal(&entries.to_vec().into());
        // The weights under which the independent implementation reproduces the paper.
        let gain = linear_quadratic_regulator(
            &mean.a,
            &mean.b,
            &diagonal(&[1e6, 1e6, 1e8, 1e8]),
            &diagonal(&[1e6, 1e6]),
        )
        .unwrap();
        let terminal = terminal_set(&plant, &gain);
        Self {
            plant,
            gain,
            constraints: StageConstraints {
                state: state_constraints(),
                input: input_constraints(),
                terminal,
            },
            groups: StageGroup::all(HORIZON, false),
            disturbance: vec![
                ScalarLaw::TruncatedGaussian { deviation: 1.0, bound: DISTURBANCE };
                4
            ],
        }
    }

    fn scenario<'a>(&'a self, sizes: &'a [usize]) -> Scenario<'a> {
        Scenario {
            plant: &self.plant,
            disturbance: &self.disturbance,
            gain: &self.gain,
            horizon: HORIZON,
            constraints: &self.constraints,
            groups: &self.groups,
            sizes,
            seed: 2019,
        }
    }
}

/// The largest robust invariant set of u = K x in all constraints.
fn terminal_set(plant: &UncertainPlant, gain: &DMatrix<f64>) -> HalfSpaces {
    let mut rows = state_constraints();
    let inputs = input_constraints();
    for row in 0..inputs.len() {
        let h = DMatrix::from_row_slice(1, 2, inputs.normal(row)) * gain;
        rows.push(h.as_slice(), inputs.offset(row));
    }
    let disturbance = Zonotope::centred(DMatrix::identity(4, 4) * DISTURBANCE);
    let corners = plant.corners().unwrap();
    let vertices: Vec<PlantVertex<'_>> = corners
        .iter()
        .map(|corner| PlantVertex {
            a: &corner.a + &corner.b * gain,
            b: DMatrix::zeros(4, 0),
            disturbance: &disturbance,
        })
        .collect();
    let limits = InvariantLimits { iterations_max: 100, rows_max: 2000 };
    match max_robust_positive_invariant(&rows, &vertices, limits, Budget::UNLIMITED) {
        Invariant::Found { set, .. } => set,
        other => panic!("{other:?}"),
    }
}

#[test]
fn scenario_in_shards_is_the_scenario_as_a_whole() {
    let mission = Mission::new();
    let sizes = vec![60; mission.groups.len()];
    let scenario = mission.scenario(&sizes);
    let mut all = HalfSpaces::new(24);
    for group in 0..sizes.len() {
        let part = GroupPart::whole(group);
        all.extend(&scenario.rows(part, 0..sizes[group], Budget::UNLIMITED).unwrap());
    }
    assert_eq!(all.len(), scenario.row_count());
    let whole = irredundant(&all, &HalfSpaces::new(24), EXACT, Budget::UNLIMITED).unwrap();
    assert_eq!(whole.doubtful, 0);

    let context = scenario.context(Budget::UNLIMITED).unwrap();
    // The last group in three parts.
    let last = sizes.len() - 1;
    let parts = (0..last).map(GroupPart::whole).chain((0..3).map(|first| GroupPart {
        group: last,
        first,
        stride: 3,
    }));
    let survivors: Vec<Survivors> = parts
        .map(|part| scenario.survivors(part, &context, EXACT, Budget::UNLIMITED).unwrap())
        .collect();
    let merged = Scenario::merged(&context, &survivors, EXACT, Budget::UNLIMITED).unwrap();
    assert_eq!(merged.doubtful, 0);
    assert!(merged.outer_excess <= 3.0 * EXACT, "{:e}", merged.outer_excess);
    // What the solver's tolerance at an extreme point leaves.
    assert!(merged.check.excess <= 1e-6, "{:e}", merged.check.excess);
    assert!(merged.check.points > 100, "{} points", merged.check.points);
    let merged = merged.rows;
    let sorted = |rows: &HalfSpaces| {
        let bits = |row: usize| -> Vec<u64> {
            rows.normal(row).iter().chain([&rows.offset(row)]).map(|x| x.to_bits()).collect()
        };
        let mut rows: Vec<Vec<u64>> = (0..rows.len()).map(bits).collect();
        rows.sort_unstable();
        rows
    };
    assert_eq!(sorted(&merged.rows), sorted(&all.select(&whole.kept)));
}
