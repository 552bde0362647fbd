//! `golden_disturbance_feedback_…`: reference cases of an independent implementation.
//!
//! They speak the paper's language: LVLH_CCSDS, SI, radians, shape matrices. Read from
//! `$VBAR_GOLDEN_DIR/disturbance_feedback`, else from the copies in `tests/golden`. A case of a
//! kind that is not known here fails. Burns and gains of an optimum are not unique and are not
//! compared.

use std::{collections::BTreeMap, fs, path::PathBuf};

use nalgebra::{DMatrix, DVector, Vector3};
use serde_json::Value;
use vbar_guidance::{
    Budget,
    control::{
        Controller, PrepareError,
        disturbance_feedback::{
            ArrivalMetric, DisturbanceFeedback, EFFORT_WEIGHT_DEFAULT, Gain, Instants, LinearModel,
            Measurement, Origin, Plan, Problem, Verdict, least_delta_v_max_m_s, plan,
        },
    },
    dynamics::{TschaunerHempel, yamanaka_ankersen},
    frames::{InFrame, LvlhCcsds, RelativeState},
    orbit::{EARTH_MU_M3_S2, KeplerOrbit},
    sets::{Ellipsoid, OuterSum},
    units::{Angle, Distance, Seconds},
};

/// On matrices that follow from formulas, of the largest entry.
const FORMULA: f64 = 1e-9;
/// On transition matrices, from the file.
const TRANSITION: f64 = 1e-10;
/// On the least limit: the reference's linear program stops at about 1e-9.
const LIMIT: f64 = 1e-7;
/// On replayed flights, from the files.
const REPLAY: f64 = 1e-7;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Kepler,
    Transition,
    EllipsoidSum,
    Plan,
    Flight,
}

fn folder() -> PathBuf {
    let root = std::env::var_os("VBAR_GOLDEN_DIR").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden")),
        PathBuf::from,
    );
    root.join("disturbance_feedback")
}

/// Every file, by name.
fn files() -> BTreeMap<String, Value> {
    let entries = fs::read_dir(folder()).unwrap_or_else(|e| panic!("{}: {e}", folder().display()));
    let mut files = BTreeMap::new();
    for entry in entries {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "json") {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let text = fs::read_to_string(&path).unwrap();
            files.insert(name, serde_json::from_str(&text).unwrap());
        }
    }
    assert!(!files.is_empty(), "no case in {}", folder().display());
    files
}

/// By the fields that make it, not by the file's name.
fn kind(name: &str, file: &Value) -> Kind {
    let first = &file["cases"][0];
    if file.get("runs").is_some() {
        Kind::Flight
    } else if file.get("problem").is_some() {
        Kind::Plan
    } else if first.get("Phi_scaled").is_some() {
        Kind::Transition
    } else if first.get("S1").is_some() {
        Kind::EllipsoidSum
    } else if first.get("M").is_some() {
        Kind::Kepler
    } else {
        panic!("{name}: a case of unknown kind")
    }
}

#[test]
fn golden_disturbance_feedback_every_case() {
    let files = files();
    let mut counts: BTreeMap<Kind, usize> = BTreeMap::new();
    let (mut feasible, mut fast) = (0, 0);
    for (name, file) in &files {
        let kind = kind(name, file);
        let checked = match kind {
            Kind::Kepler => each(file, |case| check_kepler(name, case)),
            Kind::Transition => each(file, |case| check_transition(name, case)),
            Kind::EllipsoidSum => each(file, |case| check_ellipsoid_sum(name, case)),
            Kind::Plan => {
                if let Some(plan) = check_plan(name, file) {
                    feasible += 1;
                    fast += usize::from(plan.origin().fast_path);
                }
                1
            }
            Kind::Flight => {
                check_flight(name, file, &files);
                1
            }
        };
        *counts.entry(kind).or_default() += checked;
    }
    for (kind, count) in &counts {
        println!("golden disturbance_feedback: {count} cases of kind {kind:?} checked");
    }
    println!("golden disturbance_feedback: {feasible} plans feasible, {fast} by the fast path");
}

fn each(file: &Value, check: impl Fn(&Value)) -> usize {
    let cases = file["cases"].as_array().unwrap();
    cases.iter().for_each(check);
    cases.len()
}

// ---- Reading -------------------------------------------------------------------------------

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}: not a number"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(number).collect()
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = value.as_array().unwrap().iter().map(numbers).collect();
    DMatrix::from_row_slice(rows.len(), rows[0].len(), &rows.concat())
}

fn matrices(value: &Value) -> Vec<DMatrix<f64>> {
    value.as_array().unwrap().iter().map(matrix).collect()
}

fn state(value: &Value) -> RelativeState<LvlhCcsds> {
    let x = numbers(value);
    RelativeState {
        position_m: InFrame::new(Vector3::new(x[0], x[1], x[2])),
        velocity_m_s: InFrame::new(Vector3::new(x[3], x[4], x[5])),
    }
}

fn orbit(case: &Value) -> KeplerOrbit {
    KeplerOrbit::new(
        Distance::from_metres(number(&case["a"])),
        number(&case["e"]),
        Angle::from_radians(number(&case["nu1"])),
        None,
    )
    .unwrap()
}

fn problem(name: &str, case: &Value) -> Problem {
    let count = usize::try_from(case["N"].as_u64().unwrap()).unwrap();
    let duration = Seconds::from_seconds(number(&case["duration"]));
    let noise = &case["noise_shape_physical"];
    let listed = noise[0][0].is_array();
    let shapes = if listed { matrices(noise) } else { vec![matrix(noise)] };
    Problem {
        orbit: orbit(case),
        epoch: None,
        initial: state(&case["X1"]),
        target_state: state(&case["Xf"]),
        instants: match case["spacing"].as_str() {
            Some("time") => Instants::EqualTime { count, duration },
            Some("nu") => Instants::EqualTrueAnomaly { count, duration },
            other => panic!("{name}: spacing {other:?} is not known"),
        },
        delta_v_max_m_s: number(&case["u_max"]),
        navigation_errors: shapes.into_iter().map(|s| Ellipsoid::from_shape(s).unwrap()).collect(),
        outer_sum: match case["minkowski"].as_str() {
            Some("min_volume") => OuterSum::MinVolume,
            Some("min_trace") => OuterSum::MinTrace,
            other => panic!("{name}: sum {other:?} is not known"),
        },
        metric: match case["metric"].as_str() {
            Some("scaled6") => ArrivalMetric::Scaled6,
            Some("phys6") => ArrivalMetric::Physical6,
            Some("pos_m") => ArrivalMetric::Position,
            other => panic!("{name}: metric {other:?} is not known"),
        },
        fuel_weight: number(&case["fuel_weight"]),
        effort_weight: EFFORT_WEIGHT_DEFAULT,
        compare_open_loop: true,
    }
}

// ---- Comparing -----------------------------------------------------------------------------

fn close(label: &str, got: f64, expected: f64, tolerance: f64) {
    assert!(
        (got - expected).abs() <= tolerance,
        "{label}: {got:?}, expected {expected:?}, off by {:e} of {tolerance:e}",
        (got - expected).abs()
    );
}

/// Of the largest entry.
fn close_matrix(label: &str, got: &DMatrix<f64>, expected: &DMatrix<f64>, tolerance: f64) {
    assert_eq!(got.shape(), expected.shape(), "{label}");
    let off = (got - expected).amax() / expected.amax().max(f64::MIN_POSITIVE);
    assert!(off <= tolerance, "{label}: off by {off:e} of the largest entry");
}

fn close_list(label: &str, got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{label}");
    let size = expected.iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        close(&format!("{label}[{i}]"), *got, *expected, tolerance * size);
    }
}

/// Shape matrices are compared entry by entry, in units of the set's own extent.
fn close_shape(label: &str, got: &DMatrix<f64>, expected: &DMatrix<f64>, tolerance: f64) {
    for i in 0..expected.nrows() {
        for j in 0..expected.ncols() {
            let size = (expected[(i, i)] * expected[(j, j)]).sqrt();
            let label = format!("{label}[{i}][{j}]");
            close(&label, got[(i, j)], expected[(i, j)], tolerance * size);
        }
    }
}

// ---- Kinds ---------------------------------------------------------------------------------

fn check_kepler(name: &str, case: &Value) {
    let (e, mean) = (number(&case["e"]), number(&case["M"]));
    // From perigee, so that the time since the start gives the mean anomaly.
    let a = Distance::from_metres(1e7);
    let orbit = KeplerOrbit::new(a, e, Angle::from_radians(0.0), None).unwrap();
    let elapsed = Seconds::from_seconds(mean / orbit.mean_motion_rad_s());
    let nu = orbit.true_anomaly_after(elapsed);
    let label = format!("{name} e = {e}, M = {mean}");
    close(&label, nu.radians(), number(&case["nu"]), 1e-9 * (1.0 + mean.abs()));
    let back = orbit.elapsed_at(nu).seconds();
    close(
        &format!("{label}, back"),
        back,
        elapsed.seconds(),
        1e-9 * (1.0 + elapsed.seconds().abs()),
    );
}

fn check_transition(name: &str, case: &Value) {
    let orbit = orbit(case);
    let duration = Seconds::from_seconds(number(&case["duration"]));
    let (from, to) = (orbit.true_anomaly(), orbit.true_anomaly_after(duration));
    let label = format!("{name} e = {}, {} s", orbit.eccentricity(), duration.seconds());
    close(&label, to.radians(), number(&case["nu2"]), 1e-12 * (1.0 + to.radians().abs()));
    let phi = yamanaka_ankersen(&orbit, from, to, duration);
    close_matrix(&label, &phi, &matrix(&case["Phi_scaled"]), TRANSITION);
    let physical = TschaunerHempel::new(&orbit, to).physical_from_scaled()
        * &phi
        * TschaunerHempel::new(&orbit, from).scaled_from_physical();
    close_matrix(&label, &physical, &matrix(&case["Phi_physical"]), TRANSITION);
}

fn check_ellipsoid_sum(name: &str, case: &Value) {
    let label = format!("{name} {}", case["name"]);
    let set = |field: &str| Ellipsoid::from_shape(matrix(&case[field])).unwrap();
    let (a, b) = (set("S1"), set("S2"));
    let sum = |kind| a.outer_minkowski_sum(&b, kind).unwrap();
    let trace = sum(OuterSum::MinTrace);
    close_shape(&label, trace.shape(), &matrix(&case["S_trace"]), FORMULA);
    close(&label, trace.shape().trace() / number(&case["trace_min"]), 1.0, FORMULA);
    close_shape(&label, sum(OuterSum::MinVolume).shape(), &matrix(&case["S_volume"]), FORMULA);
}

/// Returns the plan, if the case has one.
fn check_plan(name: &str, file: &Value) -> Option<Plan> {
    assert_eq!(number(&file["mu"]), EARTH_MU_M3_S2, "{name}");
    let problem = problem(name, &file["problem"]);
    let model = LinearModel::of(&problem).unwrap();
    check_derived(name, &file["derived"], &model);
    let bound: f64 = model.lower_bound(Budget::UNLIMITED).unwrap().trace_shares.iter().sum();
    let expected = number(&file["tr_lower_bound_unsaturated"]);
    close(&format!("{name} bound"), bound * bound, expected, 1e-7 * expected);
    let least = least_delta_v_max_m_s(&problem).unwrap();
    match (least, file["nominal_lp"]["u_max_min"].as_f64()) {
        (Some(least), Some(expected)) => {
            close(&format!("{name} least limit"), least, expected, LIMIT * expected);
        }
        (None, None) => {}
        other => panic!("{name}: least limits {other:?}"),
    }
    let answer = &file["answer"];
    let found = plan(&problem, Budget::UNLIMITED);
    if answer["feasible"].as_bool().unwrap() {
        let plan = found.unwrap_or_else(|error| panic!("{name}: {error:?}"));
        check_answer(name, file, &plan);
        return Some(plan);
    }
    match (found, least) {
        (Err(PrepareError::Infeasible(answer)), Some(least)) => {
            let amount = answer.relaxations[0].amount;
            let wanted = problem.delta_v_max_m_s * (1.0 + amount);
            close(&format!("{name} relaxation"), wanted, least, 1e-12);
        }
        (Err(PrepareError::Faults(faults)), None) => {
            assert!(faults.len() == 1 && faults[0].field == "instants", "{name}: {faults:?}");
        }
        other => panic!("{name}: {other:?}"),
    }
    None
}

fn check_derived(name: &str, derived: &Value, model: &LinearModel) {
    let times: Vec<f64> = model.elapsed.iter().map(|t| t.seconds()).collect();
    close_list(&format!("{name} t"), &times, &numbers(&derived["t"]), 1e-9);
    let anomalies: Vec<f64> = model.anomalies.iter().map(|nu| nu.radians()).collect();
    close_list(&format!("{name} nu"), &anomalies, &numbers(&derived["nu"]), 1e-11);
    let rho: Vec<f64> = model.scales.iter().map(|s| s.rho).collect();
    close_list(&format!("{name} rho"), &rho, &numbers(&derived["rho"]), FORMULA);
    let scales: Vec<f64> = model.scales.iter().map(|s| s.velocity_scale_s).collect();
    close_list(&format!("{name} dv_scale"), &scales, &numbers(&derived["dv_scale"]), FORMULA);
    for (field, got) in [("Phi_steps", &model.steps), ("final_map_dv", &model.final_maps)] {
        let expected = matrices(&derived[field]);
        assert_eq!(got.len(), expected.len(), "{name} {field}");
        for (k, (got, expected)) in got.iter().zip(&expected).enumerate() {
            close_matrix(&format!("{name} {field}[{k}]"), got, expected, FORMULA);
        }
    }
    let expected = matrices(&derived["W_shape_scaled"]);
    assert_eq!(model.disturbances.len(), expected.len(), "{name} W");
    for (k, (got, expected)) in model.disturbances.iter().zip(&expected).enumerate() {
        close_shape(&format!("{name} W[{k}]"), got.shape(), expected, FORMULA);
    }
    close_matrix(&format!("{name} H"), &model.metric, &matrix(&derived["H"]), FORMULA);
}

fn check_answer(name: &str, file: &Value, plan: &Plan) {
    let (answer, tolerances, outcome) = (&file["answer"], &file["tolerances"], plan.outcome());
    let certificate = &outcome.certificate;
    assert!(certificate.passed, "{name}: {certificate:?}");
    let objective = number(&answer["objective"]);
    let relative = number(&tolerances["objective_rel"]);
    close(&format!("{name} objective"), outcome.objective, objective, relative * objective);
    let trace = number(&answer["tr_Qf"]);
    // Trading fuel against trace within the tolerance on the objective moves the trace as much.
    let relative = number(&tolerances["tr_rel"]);
    close(&format!("{name} trace"), outcome.trace, trace, relative * trace);
    if let Some(tolerance) = tolerances["fuel_abs"].as_f64() {
        close(&format!("{name} fuel"), outcome.fuel_m_s, number(&answer["fuel"]), tolerance);
    }
    assert!(
        certificate.objective_lower_bound <= objective * (1.0 + 1e-9),
        "{name}: the bound {} exceeds the optimum {objective}",
        certificate.objective_lower_bound
    );
    if file["certified_by_bounds"].as_bool() == Some(true) {
        assert!(certificate.relative_gap <= 1e-6, "{name}: {certificate:?}");
    }
    if let Some(axes) = tolerances["axes_rel"].as_f64() {
        check_axes(name, answer, plan, axes);
    }
    let open_loop = outcome.open_loop_arrival.as_ref().unwrap();
    let expected = numbers(&file["open_loop_axes_xz_m"]);
    close_list(&format!("{name} open loop"), &open_loop.in_plane_semi_axes_m, &expected, 1e-8);
}

fn check_axes(name: &str, answer: &Value, plan: &Plan, tolerance: f64) {
    let arrival = &plan.outcome().arrival;
    let pairs = [
        ("axes_xz_m", &arrival.in_plane_semi_axes_m[..]),
        ("axes_xyz_m", &arrival.position_semi_axes_m[..]),
    ];
    for (field, got) in pairs {
        close_list(&format!("{name} {field}"), got, &numbers(&answer[field]), tolerance);
    }
    // A shape is quadratic in the axes.
    let expected = matrix(&answer["Qf_physical"]);
    let got = if expected.nrows() == 3 { &arrival.position_shape } else { &arrival.outer_shape };
    close_shape(&format!("{name} Qf"), got, &expected, 3.0 * tolerance);
    let shares = answer.get("s_i").or_else(|| answer.get("s")).map(numbers).unwrap();
    close_list(&format!("{name} s"), &plan.outcome().trace_shares, &shares, tolerance);
}

// ---- Flights -------------------------------------------------------------------------------

/// The problem that a flight was planned for. One published flight names a plan case that is not
/// published; its problem is that of the named sibling but for the number of instants, which the
/// replayed numbers would contradict if it were not so.
fn flown_problem(name: &str, file: &Value, files: &BTreeMap<String, Value>) -> Problem {
    let case = file["plan_case"].as_str().unwrap();
    if let Some(plan) = files.get(case) {
        return problem(case, &plan["problem"]);
    }
    let sibling = case.rsplit_once("_N").map(|(family, _)| format!("{family}_N4.json"));
    let sibling = sibling.and_then(|sibling| files.get(&sibling));
    let sibling = sibling.unwrap_or_else(|| panic!("{name}: {case} is not there"));
    let mut problem = problem(case, &sibling["problem"]);
    let Instants::EqualTime { count, .. } = &mut problem.instants else { panic!("{name}") };
    *count = file["dv"].as_array().unwrap().len() + 1;
    problem
}

fn check_flight(name: &str, file: &Value, files: &BTreeMap<String, Value>) {
    let problem = flown_problem(name, file, files);
    let burns: Vec<_> = file["dv"]
        .as_array()
        .unwrap()
        .iter()
        .map(|burn| Vector3::from_column_slice(&numbers(burn)))
        .collect();
    let mut gains = Vec::new();
    for burn in 0..burns.len() {
        for disturbance in 0..burn {
            let matrix = matrix(&file["L"][burn][disturbance]);
            gains.push(Gain { burn, disturbance, matrix });
        }
    }
    let plan = Plan::from_burns_and_gains(problem, burns, gains, Origin::ELSEWHERE)
        .unwrap_or_else(|faults| panic!("{name}: {faults:?}"));
    for (r, run) in file["runs"].as_array().unwrap().iter().enumerate() {
        check_run(&format!("{name} run {r}"), run, &plan);
    }
}

fn check_run(label: &str, run: &Value, plan: &Plan) {
    let mut flight = DisturbanceFeedback::start(plan);
    let limit = plan.problem().delta_v_max_m_s;
    let sizes = numbers(&run["X_measured"][0]);
    let size = sizes.iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    for (k, measured) in run["X_measured"].as_array().unwrap().iter().enumerate() {
        let elapsed = plan.instant_time(&flight);
        let measurement = Measurement { state: state(measured), elapsed };
        let step =
            DisturbanceFeedback::step(plan, &flight, &measurement, Budget::UNLIMITED).unwrap();
        assert_eq!(step.index, k, "{label}");
        if k > 0 {
            let disturbance = step.disturbance.as_ref().unwrap();
            let expected = DVector::from_vec(numbers(&run["w_scaled"][k - 1]));
            // The measured states carry 16 digits of the mission's size, so do differences of them.
            let off = (&disturbance.components - &expected).amax();
            assert!(off <= REPLAY * expected.amax() + 1e-12 * size, "{label} w[{k}]: off {off:e}");
            assert!(!disturbance.outside_assumed_set, "{label} w[{k}]: {}", disturbance.gauge);
        }
        match step.verdict {
            Verdict::Burn(burn) => {
                let expected = numbers(&run["u"][k]);
                let label = format!("{label} u[{k}]");
                for axis in 0..3 {
                    close(&label, burn.delta_v_m_s[axis], expected[axis], REPLAY * limit);
                }
                assert!(!step.diagnostics.clipped, "{label}");
            }
            Verdict::Arrived(arrival) => {
                let expected = number(&run["level_in_Qf"]);
                close(
                    &format!("{label} level"),
                    arrival.level,
                    expected,
                    REPLAY * expected.max(1.0),
                );
                assert!(arrival.inside_guaranteed_set, "{label}");
                assert_eq!(k, plan.burns().len(), "{label}");
            }
        }
        flight = step.next;
    }
}
