//! `golden_abort_safe…`: reference cases of an independent implementation.
//!
//! They speak the paper's language: km, s, kg, kN, Hill frame (our RTN), thrusters counted from 1.
//! Read from `$VBAR_GOLDEN_DIR/abort_safe`, else from the copies in `tests/golden`. A case of a
//! kind that is not known here fails.

use std::{collections::BTreeMap, fs, path::PathBuf};

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};
use serde_json::Value;
use vbar_guidance::{
    Budget,
    dynamics::{PeriodicPlant, RelativeVector, elliptic_step},
    mission::{AvoidanceRegion, AvoidanceSet, ThrustMode, Thrusters},
    orbit::KeplerOrbit,
    program::{
        PolytopeView, RegulatorAnswer, RegulatorProgram, SeparationOutcome, StateCut, Status,
        nearest_point_of_polytope, separate_from_ellipsoids, separate_from_polytopes,
    },
    reach::{
        AbortQuestion, AbortVerdict, EllipsoidUnion, PassiveQuestion, PolytopeQuestion,
        PolytopeUnion, find_abort, passive_safety,
    },
    sets::{CentredEllipsoid, ConvexSet, Polytope},
    units::{Angle, Distance, Force, Mass, Seconds},
};

use crate::two_body_truth::Truth;

/// Metres in a kilometre, newtons in a kilonewton.
const KILO: f64 = 1e3;

fn folder() -> PathBuf {
    let root = std::env::var_os("VBAR_GOLDEN_DIR").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden")),
        PathBuf::from,
    );
    root.join("abort_safe")
}

fn cases() -> Vec<Value> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder())
        .unwrap_or_else(|error| panic!("{}: {error}", folder().display()))
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no case in {}", folder().display());
    files.iter().map(|f| serde_json::from_str(&fs::read_to_string(f).unwrap()).unwrap()).collect()
}

/// The check of a kind.
fn check_of(kind: &str) -> fn(&Case<'_>) {
    match kind {
        "zoh_discretisation" => check_hold,
        "transition_matrix" => check_transition,
        "rs_ellipsoid" => check_ellipsoids,
        "rs_polytope" => check_polytopes,
        "admissible_control_set" => check_admissible,
        "inflation_ellipsoid" => check_inflation,
        "distance_to_ellipsoid_and_tangent" => check_ellipsoid_distance,
        "distance_to_polytope" => check_polytope_distance,
        "separating_hyperplane_socp32" => check_ellipsoid_separation,
        "separating_hyperplane_lp28" => check_polytope_separation,
        "separating_hyperplane_lp28_origin_outside" => check_separation_without_origin,
        "nearest_radial_untimed" => check_nearest_untimed,
        "rsi_membership_and_abort_existence" => check_membership,
        "mode_dominance" => check_dominance,
        "mpc_qp" => check_regulator,
        "passive_safety_verdict" => check_passive,
        "closed_loop" => check_closed_loop,
        "nonlinear_step" => check_nonlinear_step,
        "nonlinear_free_drift_j2" => check_perturbed_drift,
        other => panic!("a case of unknown kind {other}"),
    }
}

#[test]
fn golden_abort_safe_every_case() {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for case in cases() {
        let kind = case["kind"].as_str().unwrap().to_owned();
        check_of(&kind)(&Case::new(&case));
        *counts.entry(kind).or_default() += 1;
    }
    for (kind, count) in &counts {
        println!("golden abort_safe: {count} cases of kind {kind} checked");
    }
    println!("golden abort_safe: {} cases", counts.values().sum::<usize>());
}

#[test]
fn golden_abort_safe_unknown_kind_fails() {
    assert!(std::panic::catch_unwind(|| check_of("rs_cylinder")).is_err());
}

// ---- Reading -------------------------------------------------------------------------------

/// A case with what nearly all of them have.
struct Case<'a> {
    label: &'a str,
    inputs: &'a Value,
    expected: &'a Value,
    tolerances: &'a str,
    mass: Mass,
    step: Seconds,
    thrusters: Thrusters,
}

impl<'a> Case<'a> {
    fn new(case: &'a Value) -> Self {
        let conventions = &case["conventions"];
        let thrust = Force::from_newtons(number(&conventions["um"]) * KILO);
        Self {
            label: case["id"].as_str().unwrap(),
            inputs: &case["inputs"],
            expected: &case["expected"],
            tolerances: case["tolerance"].as_str().unwrap_or_default(),
            mass: Mass::from_kilograms(number(&conventions["mc"])),
            step: Seconds::from_seconds(number(&conventions["dt"])),
            thrusters: Thrusters::cube_corners(thrust).unwrap(),
        }
    }

    fn orbit(&self) -> KeplerOrbit {
        let orbit = &self.inputs["orbit"];
        let axis = Distance::from_metres(number(&orbit["a_km"]) * KILO);
        let anomaly = Angle::from_degrees(number(&orbit["f0_deg"]));
        KeplerOrbit::new(axis, number(&orbit["e"]), anomaly, None).unwrap()
    }

    fn plant(&self) -> PeriodicPlant {
        let orbit = self.orbit();
        // A case without kp stays within the first revolution.
        let steps = (orbit.period().seconds() / self.step.seconds()).round() as usize;
        let kp = self.inputs["kp"].as_u64().map_or(steps, |kp| kp as usize);
        PeriodicPlant::new(&orbit, self.mass, self.step, kp, 1)
    }

    fn ellipsoid(&self) -> AvoidanceSet {
        let axes = AvoidanceRegion::SemiAxes(vector3(&self.inputs["semiaxes"]) * KILO);
        AvoidanceSet::new(axes, number(&self.inputs["vm"]) * KILO).unwrap()
    }

    fn cube(&self) -> Polytope {
        let half = Vector3::repeat(number(&self.inputs["pm"]) * KILO);
        let region = AvoidanceRegion::HalfWidths(half);
        let set = AvoidanceSet::new(region, number(&self.inputs["vm"]) * KILO).unwrap();
        assert!(set.is_polytope());
        set.outer_polytope()
    }

    /// The number after some words of the case's own tolerances.
    fn tolerance(&self, words: &str) -> f64 {
        let after = self.tolerances.split_once(words).map(|(_, after)| after);
        let number = after.and_then(|after| after.split([' ', ',', ';']).next());
        number
            .and_then(|number| number.parse().ok())
            .unwrap_or_else(|| panic!("{}: no `{words}` in {}", self.label, self.tolerances))
    }

    /// Index of the state a case speaks of.
    fn index(&self, field: &str) -> usize {
        self.inputs[field].as_u64().unwrap_or_else(|| panic!("{}: {field}", self.label)) as usize
    }

    fn near(&self, what: &str, got: f64, expected: f64, tolerance: f64) {
        let error = (got - expected).abs();
        assert!(error <= tolerance, "{}: {what}: {got} is not {expected}: {error:e}", self.label);
    }

    fn near_all<'v>(
        &self,
        what: &str,
        got: impl IntoIterator<Item = &'v f64>,
        expected: &[f64],
        tolerance: f64,
    ) {
        let got: Vec<f64> = got.into_iter().copied().collect();
        assert_eq!(got.len(), expected.len(), "{}: {what}", self.label);
        for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
            self.near(&format!("{what}[{i}]"), *got, *expected, tolerance);
        }
    }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, not {value}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    list(value).iter().map(number).collect()
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap_or_else(|| panic!("a list, not {value}"))
}

fn vector3(value: &Value) -> Vector3<f64> {
    Vector3::from_column_slice(&numbers(value))
}

/// A state in km and km/s, in SI.
fn state(value: &Value) -> RelativeVector {
    RelativeVector::from_column_slice(&numbers(value)) * KILO
}

fn dynamic(x: &RelativeVector) -> DVector<f64> {
    DVector::from_column_slice(x.as_slice())
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = list(value).iter().map(numbers).collect();
    DMatrix::from_row_slice(rows.len(), rows.first().map_or(0, Vec::len), &rows.concat())
}

/// Row by row.
fn flat(value: &Value) -> Vec<f64> {
    list(value).iter().flat_map(numbers).collect()
}

/// Thrusters are counted from 1 there.
fn mode(value: &Value) -> ThrustMode {
    ThrustMode::of(list(value).iter().map(|j| j.as_u64().unwrap() as usize - 1)).unwrap()
}

/// Like "1.3e4 I3".
fn weight<const N: usize>(value: &Value) -> SMatrix<f64, N, N> {
    let text = value.as_str().unwrap_or_else(|| panic!("a weight, not {value}"));
    let identity = format!("I{N}");
    let factor = text.strip_suffix(&identity).unwrap_or_else(|| panic!("weight {text}")).trim();
    let factor: f64 = if factor.is_empty() { 1.0 } else { factor.parse().unwrap() };
    SMatrix::identity() * factor
}

// ---- Dynamics ------------------------------------------------------------------------------

fn check_hold(case: &Case<'_>) {
    let orbit = case.orbit();
    let start = case.index("k") as f64 * case.step.seconds();
    let step = elliptic_step(&orbit, case.mass, Seconds::from_seconds(start), case.step);
    // Kilometres and kilonewtons cancel; tolerances are the case's own.
    let expected = case.expected;
    case.near_all("A", step.a.transpose().iter(), &flat(&expected["A"]), 1e-10);
    case.near_all("B", step.b.transpose().iter(), &flat(&expected["B"]), 1e-11);
    case.near("period", orbit.period().seconds(), number(&expected["period_s"]), 1e-8);
    // What freezing would have cost is not what we do.
    let frozen = matrix(&expected["A_frozen_for_info"]);
    let apart = (0..36).map(|i| (step.a[(i / 6, i % 6)] - frozen[(i / 6, i % 6)]).abs());
    if number(&case.inputs["orbit"]["e"]) > 0.0 {
        assert!(apart.fold(0.0, f64::max) > 1e-8, "{}: A is frozen", case.label);
    }
}

fn check_transition(case: &Case<'_>) {
    let plant = case.plant();
    for (j, phi) in list(&case.inputs["j"]).iter().zip(list(&case.expected["Phi"])) {
        let phi = matrix(phi);
        let got = plant.transition(case.index("k"), j.as_u64().unwrap() as usize);
        let got = got.transpose();
        let expected: Vec<f64> = phi.transpose().iter().copied().collect();
        case.near_all(&format!("Phi({j})"), got.iter(), &expected, 1e-8 * phi.amax());
    }
}

fn check_nonlinear_step(case: &Case<'_>) {
    let plant = case.plant();
    let k = case.index("k");
    let force = vector3(&case.inputs["u"]) * KILO;
    let x = state(&case.inputs["x"]);
    let truth = Truth::new(&case.inputs["orbit"], k as f64 * case.step.seconds());
    let next = truth.after(&x, &(force / case.mass.kilograms()), case.step.seconds());
    let expected = numbers(&case.expected["x_next"]);
    // 1e-9 km and km/s.
    case.near_all("x_next", (next / KILO).iter(), &expected, 1e-9);
    let linear = plant.advance(k, &x, &force) / KILO;
    case.near_all("x_next_linear", linear.iter(), &numbers(&case.expected["x_next_linear"]), 1e-9);
}

fn check_perturbed_drift(case: &Case<'_>) {
    let x = state(&case.inputs["x0"]);
    let duration = number(&case.inputs["duration_s"]);
    let truth = Truth::new(&case.inputs["orbit"], 0.0)
        .oblate(number(&case.inputs["J2"]), number(&case.inputs["RE_km"]) * KILO);
    let end = truth.after(&x, &Vector3::zeros(), duration) / KILO;
    case.near_all("x_end", end.iter(), &numbers(&case.expected["x_end"]), 1e-6);
    let zero = Seconds::from_seconds(0.0);
    let linear = elliptic_step(&case.orbit(), case.mass, zero, Seconds::from_seconds(duration));
    let end = linear.a * x / KILO;
    let expected = numbers(&case.expected["x_end_unperturbed_linear"]);
    case.near_all("x_end_unperturbed_linear", end.iter(), &expected, 1e-6);
}

// ---- Sets ----------------------------------------------------------------------------------

fn check_admissible(case: &Case<'_>) {
    let set = case.thrusters.admissible(mode(&case.inputs["mode"]));
    let expected = case.expected;
    for (direction, support) in
        list(&expected["directions"]).iter().zip(numbers(&expected["support_kN"]))
    {
        let got = set.support_function(&DVector::from_vec(numbers(direction))) / KILO;
        case.near("support", got, support, 1e-12);
    }
    let facets = set.facets();
    let dimension = expected["affine_dimension"].as_u64().unwrap() as usize;
    assert_eq!(facets.dimension(), dimension, "{}", case.label);
    let inside = facets.has_inside(&DVector::zeros(3), 1e-9);
    assert_eq!(Some(inside), expected["contains_zero_in_interior"].as_bool(), "{}", case.label);
    if let Some(count) = expected["n_facets"].as_u64() {
        assert_eq!(facets.facets.offsets().len() as u64, count, "{}: facets", case.label);
    }
    if let Some(volume) = expected["volume_kN3"].as_f64() {
        case.near("volume", set.volume() / KILO.powi(3), volume, 1e-12);
    }
    let vertices = set.vertices();
    if let Some(count) = expected["n_vertices"].as_u64() {
        assert_eq!(vertices.len() as u64, count, "{}: vertices", case.label);
    }
    if let Some(listed) = expected["vertices"].as_array() {
        for vertex in listed {
            let vertex = DVector::from_vec(numbers(vertex)) * KILO;
            let nearest = vertices.iter().map(|v| (v - &vertex).norm()).fold(f64::MAX, f64::min);
            case.near("vertex", nearest, 0.0, 1e-9);
        }
    }
}

fn check_ellipsoids(case: &Case<'_>) {
    let plant = case.plant();
    let set = case.ellipsoid().ellipsoid().unwrap();
    for (kj, expected) in list(&case.inputs["kj"]).iter().zip(list(&case.expected["Qinv"])) {
        let kj = numbers(kj);
        let (k, j) = (kj[0] as usize, kj[1] as usize);
        let union = EllipsoidUnion::new(&plant, &set, j, k..k + 1, Budget::UNLIMITED).unwrap();
        compare_precision(case, &union.precision(k, j), &matrix(expected));
    }
}

/// rel 1e-7, entry by entry, beside what the diagonal allows an entry to be.
fn compare_precision(case: &Case<'_>, got: &DMatrix<f64>, expected: &DMatrix<f64>) {
    for i in 0..6 {
        for j in 0..6 {
            let size = (expected[(i, i)] * expected[(j, j)]).sqrt();
            case.near("Qinv", got[(i, j)] * KILO * KILO, expected[(i, j)], 1e-7 * size);
        }
    }
}

fn check_polytopes(case: &Case<'_>) {
    let (plant, avoid) = (case.plant(), case.cube());
    let modes = [mode(&case.inputs["mode"]).bits()];
    let longest = case.index("Nmax");
    let sets = list(&case.expected["sets"]);
    let first_empty = case.expected["first_empty_j"].as_u64();
    for j in 0..=longest {
        let found = set_that_ends(case, &plant, &avoid, &modes, j);
        let expected = sets.iter().find(|set| set["j"].as_u64() == Some(j as u64));
        assert_eq!(
            found.is_some(),
            first_empty.is_none_or(|e| (j as u64) < e),
            "{} {j}",
            case.label
        );
        let (Some((normals, offsets)), Some(expected)) = (found, expected) else { continue };
        let rows = flat(&expected["H"]);
        let size = rows.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        case.near_all(&format!("H_{j}"), normals.iter(), &rows, 1e-9 * size);
        let l: Vec<f64> = offsets.iter().map(|l| l / KILO).collect();
        case.near_all(&format!("l_{j}"), l.iter(), &numbers(&expected["l"]), 1e-10);
        if let Some(origin) = expected["contains_origin"].as_bool() {
            assert_eq!(offsets.iter().all(|&l| l >= 0.0), origin, "{} {j}", case.label);
        }
    }
    // The listed supports follow from H and l, by a program of whoever lists them.
}

/// Normals (row by row) and offsets of the set that ends at k_f after j steps, of the only mode.
fn set_that_ends(
    case: &Case<'_>,
    plant: &PeriodicPlant,
    avoid: &Polytope,
    modes: &[u32],
    j: usize,
) -> Option<(Vec<f64>, Vec<f64>)> {
    let kp = plant.steps_per_period();
    let start = (case.index("kf") + kp * (1 + j / kp) - j) % kp;
    let forces = case.thrusters.full_forces_n();
    let question = PolytopeQuestion { plant, avoid, full_forces_n: &forces, modes, horizon: j };
    let union = PolytopeUnion::new(&question, start..start + 1, Budget::UNLIMITED).unwrap();
    let set = union.sets(start).find(|set| set.instant == j)?;
    Some((set.normals.to_vec(), set.offsets.to_vec()))
}

fn check_dominance(case: &Case<'_>) {
    let (plant, avoid) = (case.plant(), case.cube());
    let longest = case.index("Nmax");
    for row in list(&case.expected["table"]) {
        let modes = [mode(&row["mode"]).bits()];
        let sets: Vec<_> =
            (0..=longest).map_while(|j| set_that_ends(case, &plant, &avoid, &modes, j)).collect();
        assert_eq!(sets.len() as u64, row["n_nonempty"].as_u64().unwrap(), "{row}");
        for ((_, offsets), l) in sets.iter().zip(list(&row["l"])) {
            let got: Vec<f64> = offsets.iter().map(|l| l / KILO).collect();
            case.near_all("l", got.iter(), &numbers(l), 1e-10);
        }
    }
}

fn check_inflation(case: &Case<'_>) {
    let plant = case.plant();
    let (k, j) = (case.index("k"), case.index("j"));
    let x = state(&case.inputs["x"]);
    let union_of = |gamma: f64| {
        let set = case.ellipsoid().inflated(gamma).unwrap().ellipsoid().unwrap();
        EllipsoidUnion::new(&plant, &set, j, k..k + 1, Budget::UNLIMITED).unwrap()
    };
    let q = |union: &EllipsoidUnion| {
        let mut gauges = Vec::new();
        union.gauges_squared(k, &x, &mut gauges);
        gauges[j]
    };
    let expected_q = number(&case.expected["q"]);
    case.near("q", q(&union_of(1.0)), expected_q, 1e-8 * expected_q);
    for result in list(&case.expected["results"]) {
        let union = union_of(number(&result["gamma"]));
        let (h, s) = union.tangent(k, j, &x).unwrap();
        let expected = numbers(&result["h"]);
        let size = expected.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        case.near_all("h", (h * KILO).iter(), &expected, 1e-8 * size);
        case.near("hx", h.dot(&x), number(&result["hx"]), 1e-8);
        case.near("s", s, number(&result["s"]), 1e-8);
    }
}

// ---- Distances and half-spaces -------------------------------------------------------------

/// An ellipsoid given by Qinv in km.
fn ellipsoid_of(value: &Value) -> CentredEllipsoid {
    CentredEllipsoid::from_precision(matrix(value) / (KILO * KILO)).unwrap()
}

/// A polytope given by H and l in km.
fn polytope_of(value: &Value) -> Polytope {
    Polytope::new(matrix(&value["H"]), DVector::from_vec(numbers(&value["l"])) * KILO)
}

fn half_spaces(polytope: &Polytope) -> PolytopeView<'_> {
    PolytopeView { normals: polytope.normals(), offsets: polytope.offsets() }
}

fn check_ellipsoid_distance(case: &Case<'_>) {
    let set = ellipsoid_of(&case.inputs["Qinv"]);
    if case.inputs["semiaxes"].is_array() {
        let (k, j) = (case.index("k"), case.index("j"));
        let plant = case.plant();
        let own = case.ellipsoid().ellipsoid().unwrap();
        let union = EllipsoidUnion::new(&plant, &own, j, k..k + 1, Budget::UNLIMITED).unwrap();
        compare_precision(case, &union.precision(k, j), &matrix(&case.inputs["Qinv"]));
    }
    let x = dynamic(&state(&case.inputs["x"]));
    let expected = case.expected;
    let nearest = set.nearest_point(&x);
    let distance = (&x - &nearest).norm() / KILO;
    // The published 1e-6 is a conic solver's; both sides are active-set answers in truth.
    case.near("distance", distance, number(&expected["euclidean_distance"]), 1e-8);
    case.near_all("projection", (nearest / KILO).iter(), &numbers(&expected["projection"]), 1e-6);
    let q = set.gauge_squared(&x);
    case.near("q", q, number(&expected["q"]), 1e-8 * q);
    let radial = &x / q.sqrt();
    case.near_all(
        "radial",
        (&radial / KILO).iter(),
        &numbers(&expected["radial_projection"]),
        1e-8,
    );
    let distance = (&x - radial).norm() / KILO;
    case.near("radial distance", distance, number(&expected["radial_distance"]), 1e-8);
    let tangent = set.tangent(&x).unwrap();
    let h = numbers(&expected["tangent_h"]);
    let size = h.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
    case.near_all("tangent", (&tangent.normal * KILO).iter(), &h, 1e-8 * size);
    case.near("h x", tangent.normal.dot(&x), number(&expected["tangent_hx"]), 1e-8 * q.sqrt());
    let support = set.support_function(&tangent.normal);
    case.near("support", support, number(&expected["support_of_ellipsoid_in_h"]), 1e-8);
}

fn check_polytope_distance(case: &Case<'_>) {
    let x = dynamic(&state(&case.inputs["x"]));
    let mut distances = Vec::new();
    let results = list(&case.expected["results"]);
    for (set, result) in list(&case.inputs["sets"]).iter().zip(results) {
        let set = polytope_of(set);
        let nearest = nearest_point_of_polytope(half_spaces(&set), &x).unwrap();
        let distance = (&x - &nearest).norm() / KILO;
        case.near("distance", distance, number(&result["distance"]), 1e-9);
        distances.push(distance);
        let projection = numbers(&result["projection"]);
        case.near_all("projection", (nearest / KILO).iter(), &projection, 1e-7);
    }
    let closest = (0..distances.len()).min_by(|&i, &j| distances[i].total_cmp(&distances[j]));
    assert_eq!(closest.map(|i| i as u64), case.expected["closest"].as_u64(), "{}", case.label);
}

fn clearance(outcome: &SeparationOutcome) -> f64 {
    match outcome {
        SeparationOutcome::Found(separation) => separation.clearance,
        other => panic!("{other:?}"),
    }
}

fn check_ellipsoid_separation(case: &Case<'_>) {
    let x = state(&case.inputs["x"]);
    let sets: Vec<CentredEllipsoid> = list(&case.inputs["Qinv"]).iter().map(ellipsoid_of).collect();
    let precisions: Vec<&DMatrix<f64>> = sets.iter().map(CentredEllipsoid::precision).collect();
    let expected = case.expected;
    let common = separate_from_ellipsoids(&precisions, &dynamic(&x));
    let all = ["s_star_all", "s_star_three"].iter().find(|name| expected[**name].is_number());
    if let Some(name) = all {
        case.near(name, clearance(&common), number(&expected[*name]), 1e-6);
    }
    for name in ["feasible_all", "feasible_three"] {
        if let Some(feasible) = expected[name].as_bool() {
            assert_eq!(clearance(&common) >= 0.0, feasible, "{}: {name}", case.label);
        }
    }
    let singles: Vec<f64> = match expected["s_star_single_each"].as_array() {
        Some(each) => each.iter().map(number).collect(),
        None => expected["s_star_single"].as_f64().into_iter().collect(),
    };
    for (set, single) in sets.iter().zip(singles) {
        case.near("tangent", set.tangent(&dynamic(&x)).unwrap().clearance, single, 1e-6);
        let alone = separate_from_ellipsoids(&[set.precision()], &dynamic(&x));
        case.near("cone program", clearance(&alone), single, 1e-6);
    }
    if let (Some(h), SeparationOutcome::Found(found)) = (expected["h"].as_array(), &common) {
        let h: Vec<f64> = h.iter().map(number).collect();
        let size = h.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        // The optimum is flat around h: a clearance to 1e-6 pins it to about its root.
        case.near_all("h", (&found.normal * KILO).iter(), &h, 1e-3 * size);
    }
}

fn check_polytope_separation(case: &Case<'_>) {
    let x = dynamic(&state(&case.inputs["x"]));
    let sets: Vec<Polytope> = list(&case.inputs["sets"]).iter().map(polytope_of).collect();
    let all: Vec<PolytopeView<'_>> = sets.iter().map(half_spaces).collect();
    let expected = case.expected;
    let common = clearance(&separate_from_polytopes(&all, &x));
    let star = number(&expected["s_star_all"]);
    case.near("s_star_all", common, star, 1e-6 * star.abs());
    assert_eq!(Some(common >= 0.0), expected["feasible_all"].as_bool(), "{}", case.label);
    for (i, single) in numbers(&expected["s_star_single_each"]).into_iter().enumerate() {
        let alone = clearance(&separate_from_polytopes(&all[i..=i], &x));
        case.near("linear program", alone, single, 1e-6 * single.abs());
        let rows = sets[i].normals() * &x;
        let gauge = rows.iter().zip(sets[i].offsets().iter()).map(|(hx, l)| hx / l);
        let closed = gauge.fold(f64::NEG_INFINITY, f64::max) - 1.0;
        case.near("closed form", closed, single, 1e-9 * single.abs());
        if let Some(feasible) = expected["feasible_each"].as_array() {
            assert_eq!(Some(closed >= 0.0), feasible[i].as_bool(), "{}", case.label);
        }
    }
}

fn check_separation_without_origin(case: &Case<'_>) {
    let x = dynamic(&state(&case.inputs["x"]));
    let set = polytope_of(&case.inputs["set"]);
    let least = set.offsets().min() / KILO;
    case.near("min l", least, number(&case.expected["min_l"]), 1e-12);
    assert_eq!(case.expected["lp28_alone"], "unbounded");
    let alone = separate_from_polytopes(&[half_spaces(&set)], &x);
    assert_eq!(alone, SeparationOutcome::Unbounded, "{}", case.label);
    let sets: Vec<Polytope> = list(&case.inputs["all_sets"]).iter().map(polytope_of).collect();
    let all: Vec<PolytopeView<'_>> = sets.iter().map(half_spaces).collect();
    let star = number(&case.expected["s_star_with_S_included"]);
    let got = clearance(&separate_from_polytopes(&all, &x));
    case.near("with S", got, star, 1e-6 * star.abs());
}

fn check_nearest_untimed(case: &Case<'_>) {
    let plant = case.plant();
    let set = case.ellipsoid().ellipsoid().unwrap();
    let union = EllipsoidUnion::new(
        &plant,
        &set,
        case.index("N"),
        0..plant.steps_per_period(),
        Budget::UNLIMITED,
    )
    .unwrap();
    let expected = case.expected;
    assert_eq!(union.len() as u64, expected["n_sets"].as_u64().unwrap(), "{}", case.label);
    let (k, j) = (numbers(&expected["k"]), numbers(&expected["j"]));
    for (i, x) in list(&case.inputs["states"]).iter().enumerate() {
        let x = state(x);
        let least = number(&list(&expected["min_q"])[i]);
        let near = union.nearest_untimed(&x, 3);
        case.near("min q", near[0].gauge_squared, least, 1e-6 * least);
        // The set may tie with others: its gauge must be the least one too.
        let mut gauges = Vec::new();
        union.gauges_squared(k[i] as usize, &x, &mut gauges);
        case.near("q of the listed set", gauges[j[i] as usize], least, 1e-6 * least);
        let inside = list(&expected["in_orbit_RSi"])[i].as_bool().unwrap();
        assert_eq!(near[0].gauge_squared <= 1.0, inside, "{} {i}", case.label);
    }
}

// ---- Verdicts ------------------------------------------------------------------------------

/// Clearance of the reference's mixed-integer search: 1e-6 km beyond a face, km/s for speeds.
const CLEARANCE_SI: f64 = 1e-3;

fn check_membership(case: &Case<'_>) {
    let (plant, avoid) = (case.plant(), case.cube());
    let forces = case.thrusters.full_forces_n();
    let working = mode(&case.inputs["mode"]).bits();
    let horizon = case.index("N");
    assert_eq!(case.inputs["time_indexed"].as_bool(), Some(true), "{}", case.label);
    let modes = [working];
    for result in list(&case.expected["results"]) {
        let k = result["k"].as_u64().unwrap() as usize;
        let question = PolytopeQuestion {
            plant: &plant,
            avoid: &avoid,
            full_forces_n: &forces,
            modes: &modes,
            horizon,
        };
        let union = PolytopeUnion::new(&question, k..k + 1, Budget::UNLIMITED).unwrap();
        let x = state(&result["x"]);
        let inside: Vec<f64> =
            union.sets(k).filter(|set| set.contains(&x)).map(|set| set.instant as f64).collect();
        assert_eq!(inside, numbers(&result["in_RS_j"]), "{}: {result}", case.label);
        assert_eq!(Some(!inside.is_empty()), result["in_RSi"].as_bool());
        let question = AbortQuestion {
            plant: &plant,
            avoid: &avoid,
            clearances: &[CLEARANCE_SI; 12],
            full_forces_n: &forces,
            working,
            start: k,
            horizon,
            programs_max: 200_000,
            throughout: false,
        };
        let verdict = find_abort(&question, &x, Budget::UNLIMITED).unwrap();
        let (exists, programs) = match &verdict {
            AbortVerdict::Found(abort) => (Some(true), abort.programs),
            AbortVerdict::NoneProved { programs } => (Some(false), *programs),
            AbortVerdict::Undecided { programs } => (None, *programs),
        };
        assert_eq!(exists, result["abort_sequence_exists"].as_bool(), "{}: {result}", case.label);
        println!("golden abort_safe: {}: abort {exists:?} by {programs} programs", case.label);
    }
}

fn check_passive(case: &Case<'_>) {
    let (plant, orbit) = (case.plant(), case.orbit());
    let avoid = case.ellipsoid().ellipsoid().unwrap();
    let question =
        PassiveQuestion { plant: &plant, orbit: &orbit, avoid: &avoid, horizon: case.index("N") };
    for result in list(&case.expected["results"]) {
        let k = result["k"].as_u64().unwrap() as usize;
        let verdict = passive_safety(&question, k, &state(&result["x"])).unwrap();
        let linear = &verdict.linear;
        let near = |what: &str, got: f64, tolerance: f64| {
            let expected = number(&result[what]);
            case.near(
                &format!("{what} of {result}"),
                got,
                expected,
                tolerance * expected.max(1e-3),
            );
        };
        near("min_pos_q", linear.least_position_gauge_squared, 1e-7);
        near("min_6d_q", linear.least_state_gauge_squared, 1e-7);
        let instant = |what: &str| result[what].as_u64().unwrap() as usize;
        assert_eq!(linear.position_instant, instant("argmin_j"), "{result}");
        assert_eq!(linear.state_instant, instant("argmin_6d_j"), "{result}");
        assert_eq!(Some(linear.safe_at_instants()), result["passively_safe"].as_bool(), "{result}");
        let outside = !linear.inside_reachable_set();
        assert_eq!(Some(outside), result["outside_RSi_6d"].as_bool(), "{result}");
        // The reference integrates inertial states to a relative 1e-12 or so; squared distances
        // of metres after three revolutions keep six digits.
        if result["min_pos_q_nonlinear"].is_number() {
            near("min_pos_q_nonlinear", verdict.two_body.least_position_gauge_squared, 1e-5);
        }
        assert!(linear.closest_gauge.least <= linear.least_position_gauge_squared);
    }
}

// ---- Control -------------------------------------------------------------------------------

/// (23) with the case's weights and mode.
struct Regulator {
    steps: usize,
    stage: SMatrix<f64, 6, 6>,
    terminal: SMatrix<f64, 6, 6>,
    input: Matrix3<f64>,
    origin: Vector3<f64>,
    basis: DMatrix<f64>,
    facets: Polytope,
}

impl Regulator {
    fn new(case: &Case<'_>, working: ThrustMode) -> Self {
        let square = KILO * KILO;
        let shape = case.thrusters.admissible(working).facets();
        let full = case.thrusters.list()[0].force_max().newtons();
        Self {
            steps: case.index("Np"),
            stage: weight::<6>(&case.inputs["L"]) / square,
            terminal: weight::<6>(&case.inputs["M"]) / square,
            input: weight::<3>(&case.inputs["R"]) / square,
            origin: Vector3::from_column_slice(shape.origin.as_slice()),
            basis: &shape.basis * full,
            facets: Polytope::new(shape.facets.normals().clone(), shape.facets.offsets() / full),
        }
    }

    fn solve(
        &self,
        plant: &PeriodicPlant,
        k: usize,
        x: &RelativeVector,
        cuts: &[StateCut],
        start: &[usize],
    ) -> RegulatorAnswer {
        let steps: Vec<_> =
            (k..k + self.steps).map(|i| (plant.step(i).a, plant.step(i).b)).collect();
        let program = RegulatorProgram {
            steps: &steps,
            initial: x,
            stage_cost: &self.stage,
            terminal_cost: &self.terminal,
            input_cost: &self.input,
            origin: &self.origin,
            basis: &self.basis,
            facets: self.facets.normals(),
            facet_offsets: self.facets.offsets(),
            cuts,
            softness: None,
        };
        let condensed = program.condense().unwrap();
        program.solve(&condensed, start, Budget::UNLIMITED).unwrap()
    }
}

fn check_regulator(case: &Case<'_>) {
    let plant = case.plant();
    let (k, x) = (case.index("k"), state(&case.inputs["x0"]));
    let regulator = Regulator::new(case, mode(&case.inputs["mode"]));
    let cuts: Vec<StateCut> = list(&case.inputs["hyperplanes"])
        .iter()
        .map(|cut| StateCut {
            stage: cut["j"].as_u64().unwrap() as usize,
            normal: SVector::from_column_slice(&numbers(&cut["h"])) / KILO,
            offset: number(&cut["rhs"]),
        })
        .collect();
    let answer = regulator.solve(&plant, k, &x, &cuts, &[]);
    let expected = case.expected;
    if expected["status"] != "optimal" {
        assert_eq!(expected["status"], "infeasible", "{}", case.label);
        assert_eq!(answer.status, Status::PrimalInfeasible, "{}", case.label);
        return;
    }
    assert_eq!(answer.status, Status::Optimal, "{}", case.label);
    assert!(!answer.by_general_solver, "{}: fell back to the general solver", case.label);
    let cost = number(&expected["cost"]);
    case.near("cost", answer.objective, cost, case.tolerance("cost rel ") * cost);
    let first = answer.inputs[0] / KILO;
    case.near_all("u0", first.iter(), &numbers(&expected["u0"]), case.tolerance("u0 abs "));
    if let Some(terminal) = expected["x_terminal"].as_array() {
        let terminal: Vec<f64> = terminal.iter().map(number).collect();
        let end = answer.states[regulator.steps] / KILO;
        case.near_all("x_terminal", end.iter(), &terminal, 1e-4);
    }
    if let Some(free) = expected["cost_without_hyperplanes"].as_f64() {
        let answer = regulator.solve(&plant, k, &x, &[], &[]);
        case.near("cost without cuts", answer.objective, free, 1e-6 * free);
    }
    if let Some(active) = expected["active_steps"].as_array() {
        let tight = |cut: &&StateCut| {
            let slack = cut.normal.dot(&answer.states[cut.stage]) - cut.offset;
            slack.abs() < 1e-6
        };
        let got: Vec<u64> = cuts.iter().filter(tight).map(|cut| cut.stage as u64).collect();
        let expected: Vec<u64> = active.iter().map(|j| j.as_u64().unwrap()).collect();
        assert_eq!(got, expected, "{}: active steps", case.label);
    }
}

/// Flies the loop against a two-body truth of the test's own.
fn check_closed_loop(case: &Case<'_>) {
    let plant = case.plant();
    let regulator = Regulator::new(case, case.thrusters.nominal());
    let safety = case.inputs["safety"].as_str().unwrap_or("none");
    let horizon = safety
        .strip_prefix("time-indexed sets k..k+")
        .and_then(|rest| rest.split_once(", l=1,"))
        .map(|(steps, _)| steps.parse::<usize>().unwrap());
    let safe = horizon.is_some();
    assert!(safe || safety.starts_with("none"), "{}: safety {safety}", case.label);
    // Three periods, as everywhere in the paper's passive cases.
    let horizon = horizon.unwrap_or(3 * plant.steps_per_period());
    let set = case.ellipsoid().ellipsoid().unwrap();
    let union =
        EllipsoidUnion::new(&plant, &set, horizon, 0..plant.steps_per_period(), Budget::UNLIMITED)
            .unwrap();
    let rho = number(&case.inputs["rho"]);
    let mut x = state(&case.inputs["x0"]);
    let mut points = vec![x; regulator.steps + 1];
    let (mut effort_1, mut effort_2, mut least) = (0.0, 0.0, f64::INFINITY);
    let mut states = vec![x];
    let drift_gauge = |k: usize, x: &RelativeVector| union.nearest(k, x, 1)[0].gauge_squared;
    for k in 0..case.index("steps") {
        least = least.min(drift_gauge(k, &x));
        let cut = |j: usize| {
            let near = union.nearest(k + j, &points[j], 1)[0];
            let (normal, _) = union.tangent(k + j, near.instant, &points[j]).unwrap();
            StateCut { stage: j, normal, offset: 1.0 + rho }
        };
        let cuts: Vec<StateCut> =
            if safe { (1..=regulator.steps).map(cut).collect() } else { Vec::new() };
        let answer = regulator.solve(&plant, k, &x, &cuts, &[]);
        assert_eq!(answer.status, Status::Optimal, "{} k = {k}", case.label);
        let acceleration = answer.inputs[0] / case.mass.kilograms();
        effort_1 += acceleration.iter().map(|a| a.abs()).sum::<f64>() * case.step.seconds();
        effort_2 += acceleration.norm() * case.step.seconds();
        let truth = Truth::new(&case.inputs["orbit"], k as f64 * case.step.seconds());
        x = truth.after(&x, &acceleration, case.step.seconds());
        states.push(x);
        // Where to linearise next: the state, then the shifted prediction, its end drifting.
        points = answer.states[1..].to_vec();
        points[0] = x;
        points.push(plant.advance(
            k + regulator.steps,
            &answer.states[regulator.steps],
            &Vector3::zeros(),
        ));
    }
    least = least.min(drift_gauge(case.index("steps"), &x));
    let expected = case.expected;
    let near = |what: &str, got: f64| {
        let value = number(&expected[what]);
        case.near(what, got, value, 1e-3 * value);
    };
    near("dv_norm1_km_s", effort_1 / KILO);
    near("dv_norm2_km_s", effort_2 / KILO);
    for (k, at) in expected["states_at"].as_object().unwrap() {
        let k: usize = k.parse().unwrap();
        case.near_all(&format!("state {k}"), (states[k] / KILO).iter(), &numbers(at), 2e-3);
    }
    if expected["min_free_drift_q"].is_number() {
        near("min_free_drift_q", least);
    }
}
