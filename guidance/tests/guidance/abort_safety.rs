//! Laws of abort safety: which modes matter, what membership means and what it does not.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use nalgebra::{DMatrix, DVector, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use vbar_guidance::{
    Budget, Interruption,
    budget::Question,
    dynamics::{PeriodicPlant, RelativeVector},
    mission::{AvoidanceRegion, AvoidanceSet, ThrustMode, Thrusters, dominating_modes},
    orbit::KeplerOrbit,
    reach::{
        AbortQuestion, AbortVerdict, PolytopeQuestion, PolytopeUnion, cut_off_polytope, find_abort,
    },
    sets::Polytope,
    units::{Angle, Distance, Force, Mass, Seconds},
};

/// The paper's active case: e = 0.1, f_0 = 140 deg, 4 t, 20 N, 30 s. [AguilarMarsillach2022, VI.B]
fn plant(fractions: usize) -> PeriodicPlant {
    let axis = Distance::from_metres(7_419_320.0);
    let orbit = KeplerOrbit::new(axis, 0.1, Angle::from_degrees(140.0), None).unwrap();
    let (mass, step) = (Mass::from_kilograms(4000.0), Seconds::from_seconds(30.0));
    PeriodicPlant::new(&orbit, mass, step, 212, fractions)
}

/// Its terminal set: 20 m, 6 m/s.
fn cube() -> Polytope {
    let region = AvoidanceRegion::HalfWidths(Vector3::repeat(20.0));
    AvoidanceSet::new(region, 6.0).unwrap().outer_polytope()
}

fn thrusters() -> Thrusters {
    Thrusters::cube_corners(Force::from_newtons(20.0)).unwrap()
}

/// Sets that end at index 0: (steps, mode, offsets).
fn sets_ending_at_0(modes: &[ThrustMode], horizon: usize) -> Vec<(usize, usize, Vec<f64>)> {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let bits: Vec<u32> = modes.iter().map(|mode| mode.bits()).collect();
    let kp = plant.steps_per_period();
    let mut found = Vec::new();
    for j in 0..=horizon {
        let question = PolytopeQuestion {
            plant: &plant,
            avoid: &avoid,
            full_forces_n: &forces,
            modes: &bits,
            horizon: j,
        };
        let start = (kp - j) % kp;
        let union = PolytopeUnion::new(&question, start..start + 1, Budget::UNLIMITED).unwrap();
        let ending = union.sets(start).filter(|set| set.instant == j);
        found.extend(ending.map(|set| (j, set.mode, set.offsets.to_vec())));
    }
    found
}

/// Sets of one end and one number of steps have the same normals: offsets decide containment. Of
/// equal sets the first is kept.
fn not_contained(sets: &[(usize, usize, Vec<f64>)]) -> Vec<usize> {
    let within = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| *a <= b + 1e-12);
    (0..sets.len())
        .filter(|&i| {
            !(0..sets.len()).any(|k| {
                let holds = sets[k].0 == sets[i].0 && within(&sets[i].2, &sets[k].2);
                let equal = within(&sets[k].2, &sets[i].2);
                k != i && holds && (!equal || k < i)
            })
        })
        .collect()
}

#[test]
fn few_modes_stand_for_all_without_total_failure() {
    let all = thrusters().failure_modes();
    let partial = &all[1..];
    let sets = sets_ending_at_0(partial, 47);
    // 254 modes; the independent implementation counted 870 sets too.
    assert_eq!((partial.len(), sets.len()), (254, 870));
    let needed = dominating_modes(partial);
    // Eight single thrusters with six sets each.
    assert_eq!(sets_ending_at_0(&needed, 47).len(), 48);
    let kept = not_contained(&sets);
    // The set that ends at once is the same for every mode: 8 x 5 + 1 differ.
    assert_eq!(kept.len(), 41);
    assert!(kept.iter().all(|&i| sets[i].0 == 0 || needed.contains(&partial[sets[i].1])));
}

#[test]
fn few_modes_hold_the_states_that_all_hold() {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let all = thrusters().failure_modes();
    let union = |modes: &[ThrustMode]| {
        let bits: Vec<u32> = modes.iter().map(|mode| mode.bits()).collect();
        let question = PolytopeQuestion {
            plant: &plant,
            avoid: &avoid,
            full_forces_n: &forces,
            modes: &bits,
            horizon: 47,
        };
        let union = PolytopeUnion::new(&question, 0..1, Budget::UNLIMITED).unwrap();
        let count = PolytopeUnion::count(&question, 0..1, Budget::UNLIMITED).unwrap();
        assert_eq!(union.len(), count);
        union
    };
    let mut rng = ChaCha8Rng::seed_from_u64(20_221_121);
    // Without total failure and with it.
    for modes in [&all[1..], &all[..]] {
        let (whole, few) = (union(modes), union(&dominating_modes(modes)));
        assert!(few.len() * 15 < whole.len(), "{} of {}", few.len(), whole.len());
        let mut inside = 0;
        for case in 0..3000 {
            let x = RelativeVector::from_fn(|i, _| {
                let half = if i < 3 { 40.0 } else { 1.0 };
                rng.random_range(-half..half)
            });
            let held = |union: &PolytopeUnion| union.sets(0).any(|set| set.contains(&x));
            assert_eq!(held(&whole), held(&few), "case {case}: {x}");
            inside += usize::from(held(&few));
        }
        assert!(inside > 100, "{inside} inside: a vain test");
    }
}

#[test]
fn making_sets_stops_when_told() {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let asked = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&asked);
    let stop: Question = Arc::new(move || {
        let count = counted.fetch_add(1, Ordering::Relaxed);
        (count >= 3).then_some(Interruption::Deadline)
    });
    let modes = [ThrustMode::NONE.bits()];
    let question = PolytopeQuestion {
        plant: &plant,
        avoid: &avoid,
        full_forces_n: &forces,
        modes: &modes,
        horizon: 54,
    };
    let stopped = PolytopeUnion::new(&question, 0..4, Budget::new(&stop));
    assert_eq!(stopped, Err(Interruption::Deadline));
    assert_eq!(asked.load(Ordering::Relaxed), 4);
}

#[test]
fn total_failure_stands_for_all() {
    let all = thrusters().failure_modes();
    let sets = sets_ending_at_0(&all, 47);
    // 870 and the 48 of free drift.
    assert_eq!((all.len(), sets.len()), (255, 918));
    let kept = not_contained(&sets);
    // The avoided set itself and 47 that drift into it.
    assert_eq!(kept.len(), 48);
    assert!(kept.iter().all(|&i| all[sets[i].1] == ThrustMode::NONE));
}

fn question<'a>(
    plant: &'a PeriodicPlant,
    avoid: &'a Polytope,
    forces: &'a [Vector3<f64>],
    working: ThrustMode,
) -> AbortQuestion<'a> {
    AbortQuestion {
        plant,
        avoid,
        clearances: &[1e-3; 12],
        full_forces_n: forces,
        working: working.bits(),
        start: 0,
        horizon: 54,
        programs_max: 5000,
        throughout: false,
    }
}

fn is_member(plant: &PeriodicPlant, mode: ThrustMode, x: &RelativeVector) -> bool {
    let (avoid, forces) = (cube(), thrusters().full_forces_n());
    let modes = [mode.bits()];
    let question = PolytopeQuestion {
        plant,
        avoid: &avoid,
        full_forces_n: &forces,
        modes: &modes,
        horizon: 54,
    };
    PolytopeUnion::new(&question, 0..1, Budget::UNLIMITED)
        .unwrap()
        .sets(0)
        .any(|set| set.contains(x))
}

/// Outside every backward reachable set, and yet no abort: found by the independent
/// implementation with a mixed-integer program.
fn counterexample() -> RelativeVector {
    RelativeVector::from_column_slice(&[-86.16, -100.56, -169.83, 0.6485, 0.8655, 1.3665])
}

#[test]
fn being_outside_every_reachable_set_does_not_mean_that_an_abort_exists() {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let mode = ThrustMode::of([7]).unwrap();
    let x = counterexample();
    assert!(!is_member(&plant, mode, &x));
    let question = question(&plant, &avoid, &forces, mode);
    let verdict = find_abort(&question, &x, Budget::UNLIMITED).unwrap();
    assert!(
        matches!(verdict, AbortVerdict::NoneProved { programs } if programs > 0),
        "{verdict:?}"
    );
    // With one more thruster there is a way out.
    let more = AbortQuestion { working: ThrustMode::of([0, 7]).unwrap().bits(), ..question };
    let verdict = find_abort(&more, &x, Budget::UNLIMITED).unwrap();
    assert!(matches!(verdict, AbortVerdict::Found(_)), "{verdict:?}");
}

#[test]
fn search_that_may_not_search_says_undecided() {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let asked = question(&plant, &avoid, &forces, ThrustMode::of([7]).unwrap());
    let short = AbortQuestion { programs_max: 1, ..asked };
    let verdict = find_abort(&short, &counterexample(), Budget::UNLIMITED).unwrap();
    assert_eq!(verdict, AbortVerdict::Undecided { programs: 0 });
    let stop: Question = Arc::new(|| Some(Interruption::Cancelled));
    let stopped = find_abort(&asked, &counterexample(), Budget::new(&stop));
    assert_eq!(stopped, Err(Interruption::Cancelled));
}

#[test]
fn membership_excludes_aborts_and_aborts_fly_clear() {
    let (avoid, forces) = (cube(), thrusters().full_forces_n());
    let plant = plant(2);
    let seed = 20_221_114;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (mut members, mut aborts) = (0, 0);
    for case in 0..120 {
        let mode = ThrustMode::from_bits(rng.random_range(0..255));
        // Towards the target, to be there after 30 to 300 s.
        let arrival_s: f64 = rng.random_range(30.0..300.0);
        let from: [f64; 3] = std::array::from_fn(|_| rng.random_range(-150.0..150.0));
        let aim: [f64; 3] = std::array::from_fn(|_| rng.random_range(-25.0..25.0));
        let x = RelativeVector::from_fn(|i, _| match i {
            0..3 => from[i],
            _ => (aim[i - 3] - from[i - 3]) / arrival_s,
        });
        let asked = question(&plant, &avoid, &forces, mode);
        let verdict = find_abort(&asked, &x, Budget::UNLIMITED).unwrap();
        if is_member(&plant, mode, &x) {
            members += 1;
            let none = matches!(verdict, AbortVerdict::NoneProved { .. });
            assert!(none, "seed {seed} case {case} {mode:?}: {verdict:?}");
        }
        if let AbortVerdict::Found(abort) = verdict {
            aborts += 1;
            flies_clear(&plant, &avoid, mode, &x, &abort.throttles);
        }
    }
    assert!(members > 5 && aborts > 20, "{members} members, {aborts} aborts: a vain test");
}

/// Flies throttles once more, by plain products, and looks at every instant.
fn flies_clear(
    plant: &PeriodicPlant,
    avoid: &Polytope,
    mode: ThrustMode,
    x: &RelativeVector,
    throttles: &[Vec<f64>],
) {
    let outside = |x: &RelativeVector| {
        let margins = avoid.margins(&DVector::from_column_slice(x.as_slice()));
        assert!(margins.min() < -0.99e-3, "inside: {margins}");
    };
    let thrusters = thrusters();
    let mut x = *x;
    outside(&x);
    for (k, throttle) in throttles.iter().enumerate() {
        let mut force = Vector3::zeros();
        for (j, (&share, thruster)) in throttle.iter().zip(thrusters.list()).enumerate() {
            assert!((0.0..=1.0).contains(&share));
            assert!(share == 0.0 || mode.working().any(|w| w == j), "thruster {j} has failed");
            force += thruster.full_force_n() * share;
        }
        let half = plant.fraction(k, 1);
        outside(&(half.a * x + half.b * force));
        x = plant.step(k).a * x + plant.step(k).b * force;
        outside(&x);
    }
}

#[test]
fn general_polytopes_are_propagated_and_emptied_as_boxes_are() {
    // The cube once more, with a thirteenth row that cuts nothing: no closed form any longer.
    let (plant, cube, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let mut normals = DMatrix::zeros(13, 6);
    normals.rows_mut(0, 12).copy_from(cube.normals());
    normals.row_mut(12).copy_from_slice(&[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    let mut offsets = DVector::from_element(13, 1e4);
    offsets.rows_mut(0, 12).copy_from(cube.offsets());
    let general = Polytope::new(normals, offsets);
    let modes: Vec<u32> = thrusters().failure_modes()[1..].iter().map(|m| m.bits()).collect();
    let of = |avoid: &Polytope| {
        let question = PolytopeQuestion {
            plant: &plant,
            avoid,
            full_forces_n: &forces,
            modes: &modes,
            horizon: 7,
        };
        PolytopeUnion::new(&question, 30..31, Budget::UNLIMITED).unwrap()
    };
    let (boxes, generals) = (of(&cube), of(&general));
    let names = |union: &PolytopeUnion| -> Vec<(usize, usize)> {
        union.sets(30).map(|set| (set.instant, set.mode)).collect()
    };
    assert_eq!(names(&boxes), names(&generals));
    for (a, b) in boxes.sets(30).zip(generals.sets(30)) {
        assert_eq!((a.normals, a.offsets), (&b.normals[..72], &b.offsets[..12]));
    }
}

#[test]
fn cuts_hold_their_set_and_leave_the_state_out() {
    let (plant, avoid, forces) = (plant(1), cube(), thrusters().full_forces_n());
    let modes = [ThrustMode::of([7]).unwrap().bits()];
    let question = PolytopeQuestion {
        plant: &plant,
        avoid: &avoid,
        full_forces_n: &forces,
        modes: &modes,
        horizon: 54,
    };
    let union = PolytopeUnion::new(&question, 0..1, Budget::UNLIMITED).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let x = RelativeVector::from_column_slice(&[-75.7, 95.1, -54.7, 1.0, -1.1, 0.7]);
    let mut without_origin = 0;
    for set in union.sets(0) {
        let cut = cut_off_polytope(&set, &x).unwrap();
        assert!((cut.normal.dot(&x) - cut.offset - cut.clearance).abs() < 1e-9);
        assert!(cut.clearance > 0.0 && !set.contains(&x));
        without_origin += usize::from(set.offsets.iter().any(|&l| l <= 0.0));
        // Points of the set, by mapping points of the avoided one back along the drift.
        let back = plant.transition(0, set.instant).try_inverse().unwrap();
        let mut inside = 0;
        for _ in 0..4000 {
            let end = RelativeVector::from_fn(|i, _| {
                let half = if i < 3 { 20.0 } else { 6.0 };
                rng.random_range(-half..half)
            });
            let y = back * end;
            if set.contains(&y) {
                inside += 1;
                assert!(cut.normal.dot(&y) <= cut.offset + 1e-9, "{} steps", set.instant);
            }
        }
        assert!(inside > 0 || set.instant > 3, "no point found after {}", set.instant);
    }
    assert!(without_origin > 0, "no set without the origin");
}
