//! `golden_variable_horizon_…`: reference cases of an independent implementation.
//!
//! They speak the papers' language: scaled units, RTN, four-faced cones, lists of cases a file.
//! Read from `$VBAR_GOLDEN_DIR/variable_horizon`, else from the copies in `tests/golden`. A case
//! of a kind that is not known here fails.

use std::{collections::BTreeMap, fs, path::PathBuf, thread};

use nalgebra::{DMatrix, DVector, Vector3};
use serde_json::Value;
use vbar_guidance::{
    Budget,
    control::{
        Controller,
        variable_horizon::{
            Artifact, Branch, GainChoice, HillPlant, HorizonSearch, LinearPlant, MeasuredState,
            Measurement, Plant, Problem, Scheme, State, Step, TerminalFallback, TerminalPoint,
            TrialOutcome, VariableHorizon, Verdict, Weights,
        },
    },
    dynamics::{HillScaling, clohessy_wiltshire, place_poles},
    mission::{BodyMotion, DisturbanceSet, DockingCone, RateReference, TargetMotion, TargetSample},
    program::{Clarabel, DualSimplex},
    sets::{Polytope, Zonotope},
    units::{Acceleration, Angle},
};

/// Relative tolerance on costs, from the cases' own README.
const COST: f64 = 1e-6;
/// On costs beyond this horizon, where the solver that made the cases loses digits.
const COST_AT_LONG_HORIZON: f64 = 1e-5;
const LONG_HORIZON: usize = 34;
/// On tightenings and geometry.
const GEOMETRY: f64 = 1e-9;

fn folder() -> PathBuf {
    let root = std::env::var_os("VBAR_GOLDEN_DIR").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden")),
        PathBuf::from,
    );
    root.join("variable_horizon")
}

/// Every case of every file, with the file's name.
fn cases() -> Vec<(String, Value)> {
    let mut cases = Vec::new();
    let mut files: Vec<PathBuf> = fs::read_dir(folder())
        .unwrap_or_else(|error| panic!("{}: {error}", folder().display()))
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no case in {}", folder().display());
    for file in files {
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        let text = fs::read_to_string(&file).unwrap();
        let list: Value = serde_json::from_str(&text).unwrap();
        let list = list.as_array().unwrap_or_else(|| panic!("{name}: not a list")).clone();
        cases.extend(list.into_iter().map(|case| (name.clone(), case)));
    }
    cases
}

/// The kinds that are known, by the fields that make them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    ProblemWithProjection,
    ProblemWithReference,
    TraceAdaptive2025a,
    TraceAdaptive2025b,
    TraceFixed2025a,
    TraceFixed2025b,
}

fn kind(name: &str, case: &Value) -> Kind {
    let id = &case["id"];
    match (case["terminal"].as_str(), case["law"].as_str(), case.get("steps").is_some()) {
        (Some("proj"), None, false) => Kind::ProblemWithProjection,
        (Some("r"), None, false) => Kind::ProblemWithReference,
        (None, None, true) if case.get("q_f").is_some() => Kind::TraceAdaptive2025a,
        (None, Some("ATC"), true) => Kind::TraceAdaptive2025a,
        (None, Some("ATCS"), true) => Kind::TraceAdaptive2025b,
        (None, Some("FTC"), true) => Kind::TraceFixed2025a,
        (None, Some("FTCS"), true) => Kind::TraceFixed2025b,
        other => panic!("{name} {id}: a case of unknown kind {other:?}"),
    }
}

#[test]
fn golden_variable_horizon_every_case() {
    let cases = cases();
    let mut counts: BTreeMap<Kind, usize> = BTreeMap::new();
    for (name, case) in &cases {
        *counts.entry(kind(name, case)).or_default() += 1;
    }
    // Two halves on two threads; a failed case is named by its panic.
    let (mut programs, mut steps) = (0, 0);
    thread::scope(|scope| {
        let workers: Vec<_> = (0..2)
            .map(|half| {
                let cases = &cases;
                scope.spawn(move || {
                    let mut sums = (0, 0);
                    for (name, case) in cases.iter().skip(half).step_by(2) {
                        let (p, s) = check(name, case);
                        sums = (sums.0 + p, sums.1 + s);
                    }
                    sums
                })
            })
            .collect();
        for worker in workers {
            let (p, s) =
                worker.join().unwrap_or_else(|_| panic!("a golden case failed, see above"));
            programs += p;
            steps += s;
        }
    });
    for (kind, count) in &counts {
        println!("golden variable_horizon: {count} cases of kind {kind:?} checked");
    }
    println!(
        "golden variable_horizon: {} cases, {programs} programs by simplex and Clarabel, \
         {steps} steps",
        cases.len()
    );
}

/// Checks one case; returns the programs and steps that it compared.
fn check(name: &str, case: &Value) -> (usize, usize) {
    let label = format!("{name} {}", case["id"].as_str().unwrap_or("?"));
    match kind(name, case) {
        Kind::ProblemWithProjection | Kind::ProblemWithReference => {
            (check_problem(&label, case), 0)
        }
        _ => (0, check_trace(&label, case)),
    }
}

// ---- Reading -------------------------------------------------------------------------------

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn vector(value: &Value) -> DVector<f64> {
    DVector::from_vec(numbers(value))
}

fn vector3(value: &Value) -> Vector3<f64> {
    Vector3::from_column_slice(&numbers(value))
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = value.as_array().unwrap().iter().map(numbers).collect();
    let columns = rows.first().map_or(0, Vec::len);
    DMatrix::from_row_slice(rows.len(), columns, &rows.concat())
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

/// Entries of an object whose keys are steps or horizons.
fn by_index(value: &Value) -> BTreeMap<usize, &Value> {
    value.as_object().unwrap().iter().map(|(key, v)| (key.parse().unwrap(), v)).collect()
}

fn is_spacecraft(case: &Value) -> bool {
    case["physical"].get("eta").is_some()
}

/// The problem of a case. `longest` horizon, `steps` a mission can take.
fn problem(case: &Value, scheme: Scheme, point: TerminalPoint, longest: usize) -> Problem {
    let k = case["k"].as_u64().unwrap_or(0);
    let traced = case["steps"].as_array().map_or(0, Vec::len);
    let steps_max = usize::try_from(k).unwrap() + traced + 1;
    let plant = if is_spacecraft(case) {
        Plant::Hill(spacecraft(case))
    } else {
        Plant::Linear(double_integrator(case))
    };
    let gain = match (case.get("K"), is_spacecraft(case)) {
        (Some(k), _) => GainChoice::Explicit(matrix(k)),
        // The papers' poles; the traces do not repeat K.
        (None, true) => GainChoice::Poles(vec![0.6, 0.6, 0.6, 0.5, 0.5, 0.5]),
        // [Quartullo2025b, sec. 4.1]
        (None, false) => GainChoice::Explicit(DMatrix::from_row_slice(1, 2, &[-0.06, -0.5])),
    };
    Problem {
        plant,
        scheme,
        gain,
        weights: Weights {
            fuel: number(&case["gamma_v"]),
            tracking: case["gamma_z"].as_f64().unwrap_or(0.0),
        },
        search: HorizonSearch::Local,
        horizon_max: longest,
        horizon_guess: None,
        terminal_point: point,
        fallback: match point {
            TerminalPoint::Projection => TerminalFallback::PreviousHorizon,
            TerminalPoint::Reference => TerminalFallback::FreeHorizon,
        },
        steps_max: match case.get("r_table") {
            // The table ends where it ends.
            Some(table) => table.as_array().unwrap().len() - longest - 1,
            None => steps_max,
        },
        fixed_terminal_terms: case["Q_terms"].as_u64().map(|terms| usize::try_from(terms).unwrap()),
    }
}

fn scaling(case: &Value) -> HillScaling {
    let physical = &case["physical"];
    HillScaling::new(number(&physical["eta"]), number(&physical["a_max"]))
}

fn spacecraft(case: &Value) -> HillPlant {
    let physical = &case["physical"];
    let scaling = scaling(case);
    let target = match case.get("r_table") {
        Some(table) => TargetMotion::Sampled(
            table
                .as_array()
                .unwrap()
                .iter()
                .map(|row| {
                    let state = scaling.physical(&numbers(row));
                    TargetSample {
                        capture_point_m: state.position_m.components,
                        capture_velocity_m_s: state.velocity_m_s.components,
                        docking_port_m: state.position_m.components,
                    }
                })
                .collect(),
        ),
        None => TargetMotion::Rigid {
            capture_point_m: vector3(&physical["p_ref0_m"]),
            docking_port_m: vector3(&physical["p_dock0_m"]),
            body: BodyMotion::Spin(vector3(&physical["omega_rad_s"])),
        },
    };
    HillPlant {
        mean_motion_rad_s: number(&physical["eta"]),
        sample_angle: Angle::from_radians(number(&physical["tau_s"])),
        acceleration_max: Acceleration::from_m_s2(number(&physical["a_max"])),
        mass: None,
        cone: Some(DockingCone {
            half_angle: Angle::from_degrees(number(&physical["alpha_deg"])),
            face_roll: Angle::from_radians(0.0),
        }),
        target,
        disturbance: DisturbanceSet::Generators(matrix(&case["W_generators"])),
    }
}

fn double_integrator(case: &Value) -> LinearPlant {
    let u_max = case["u_max"].as_f64().unwrap_or(2.0);
    let or = |field: &str, otherwise: DMatrix<f64>| case.get(field).map_or(otherwise, matrix);
    let normals = [1.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, -1.0];
    LinearPlant {
        a: or("A", DMatrix::from_row_slice(2, 2, &[1.0, 1.0, 0.0, 1.0])),
        b: or("B", DMatrix::from_row_slice(2, 1, &[0.0, 1.0])),
        input_lower: DVector::from_element(1, -u_max),
        input_upper: DVector::from_element(1, u_max),
        input_set: None,
        state_set: Some(Polytope::new(
            DMatrix::from_row_slice(4, 2, &normals),
            DVector::from_vec(vec![25.0, 25.0, 2.0, 2.0]),
        )),
        disturbance: Zonotope::centred(matrix(&case["W_generators"])),
        reference: vec![DVector::zeros(2)],
        sample_time: None,
    }
}

fn prepare(label: &str, problem: &Problem) -> Artifact {
    Artifact::prepare(problem).unwrap_or_else(|error| panic!("{label}: {error:?}"))
}

fn assert_near(label: &str, what: &str, got: f64, expected: f64, tolerance: f64) {
    let error = (got - expected).abs() / (1.0_f64).max(expected.abs());
    assert!(error <= tolerance, "{label}: {what} is {got}, expected {expected}");
}

fn assert_close(label: &str, what: &str, got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{label}: {what}");
    for (got, expected) in got.iter().zip(expected) {
        assert_near(label, what, *got, *expected, tolerance);
    }
}

// ---- Problems ------------------------------------------------------------------------------

fn check_problem(label: &str, case: &Value) -> usize {
    let expected = &case["expected"];
    let point = match case["terminal"].as_str() {
        Some("proj") => TerminalPoint::Projection,
        _ => TerminalPoint::Reference,
    };
    let k = usize::try_from(case["k"].as_u64().unwrap()).unwrap();
    let longest = usize::try_from(case["N_max"].as_u64().unwrap()).unwrap();
    let mission = problem(case, Scheme::AdaptiveTerminal, point, longest);
    let artifact = prepare(label, &mission);
    let summary = artifact.summary();
    assert_close(
        label,
        "A",
        summary.a.transpose().as_slice(),
        matrix(&case["A"]).transpose().as_slice(),
        1e-14,
    );
    assert_close(
        label,
        "B",
        summary.b.transpose().as_slice(),
        matrix(&case["B"]).transpose().as_slice(),
        1e-14,
    );
    let lambda_bar = number(&expected["lambda_bar"]);
    assert_near(label, "lambda_bar", summary.lambda_bar, lambda_bar, 1e-9);
    if is_spacecraft(case) {
        let (a, b) = clohessy_wiltshire(number(&case["physical"]["tau_s"]));
        let k = place_poles(&a, &b, &[0.6, 0.6, 0.6, 0.5, 0.5, 0.5]).unwrap();
        let given = matrix(&case["K"]);
        assert!((&k - &given).amax() < 1e-7 * given.amax(), "{label}: K by pole placement");
    }
    check_geometry(label, &artifact, k, expected);
    let x = vector(&case["x"]);
    let inside = artifact.state_margins(k, &x).iter().all(|&margin| margin >= -1e-12);
    assert_eq!(inside, expected["x_in_X_k"].as_bool().unwrap(), "{label}: x in X(k)");
    check_torque_free(label, case, &artifact);
    let programs = check_costs(label, case, &artifact, k, &x);
    if k == 0 {
        check_search(label, case, &mission, &x, inside);
    }
    programs
}

fn check_geometry(label: &str, artifact: &Artifact, k: usize, expected: &Value) {
    let at = |what: &str, j: usize| format!("{what} at {j}");
    for (j, value) in by_index(&expected["r"]) {
        let got = artifact.reference(k + j).unwrap();
        assert_close(label, &at("r", j), got.as_slice(), &numbers(value), GEOMETRY);
    }
    for (j, value) in by_index(&expected["z_r"]) {
        let got = artifact.terminal_centre(k, j).unwrap();
        assert_close(label, &at("z_r", j), got.as_slice(), &numbers(value), GEOMETRY);
    }
    for (j, value) in by_index(&expected["cone"]) {
        let rows = artifact.state_rows(k, j).unwrap();
        let normals = matrix(&value["H"]);
        assert!((rows.normals - normals).amax() < GEOMETRY, "{label}: {}", at("cone normals", j));
        let offsets = numbers(&value["b"]);
        assert_close(label, &at("cone offsets", j), rows.offsets.as_slice(), &offsets, GEOMETRY);
    }
    for (j, value) in by_index(&expected["state_tightening"]) {
        let rows = artifact.state_rows(k, j).unwrap();
        let what = at("state tightening", j);
        assert_close(label, &what, rows.margins.as_slice(), &numbers(value), GEOMETRY);
    }
    for (j, value) in by_index(&expected["input_tightening"]) {
        let got = artifact.input_margins(j);
        assert_close(label, &at("input tightening", j), got.as_slice(), &numbers(value), GEOMETRY);
    }
}

/// A tumbling case gives both the table and the body: the body must reproduce the table.
fn check_torque_free(label: &str, case: &Value, artifact: &Artifact) {
    let (Some(table), Some(inertia)) = (case.get("r_table"), case["physical"].get("inertia_ratio"))
    else {
        return;
    };
    let physical = &case["physical"];
    let scaling = scaling(case);
    let motion = TargetMotion::Rigid {
        capture_point_m: vector3(&physical["p_ref0_m"]),
        docking_port_m: vector3(&physical["p_dock0_m"]),
        body: BodyMotion::TorqueFree {
            inertia: vector3(inertia),
            rtn_from_body: nalgebra::UnitQuaternion::identity(),
            rate_body_rad_s: vector3(&physical["omega0_body"]),
            relative_to: RateReference::Rtn,
        },
    };
    let rows = table.as_array().unwrap();
    let samples = motion
        .samples(number(&physical["eta"]), number(&physical["dt_s"]), rows.len(), Budget::UNLIMITED)
        .unwrap();
    for (j, (sample, row)) in samples.iter().zip(rows).enumerate() {
        let position = sample.capture_point_m / scaling.position_unit_m;
        let velocity = sample.capture_velocity_m_s / scaling.velocity_unit_m_s;
        let got: Vec<f64> = position.iter().chain(velocity.iter()).copied().collect();
        assert_close(label, &format!("tumbling r at {j}"), &got, &numbers(row), 1e-11);
        assert!(artifact.reference(j).is_some());
    }
}

/// J of every horizon, by both back-ends.
fn check_costs(
    label: &str,
    case: &Value,
    artifact: &Artifact,
    k: usize,
    x: &DVector<f64>,
) -> usize {
    let mut simplex = DualSimplex::default();
    let mut compared = 0;
    for (horizon, value) in by_index(&case["expected"]["J_by_N"]) {
        let label = format!("{label} N = {horizon}");
        let fast = artifact
            .solve_horizon(k, x, horizon, &mut simplex)
            .unwrap_or_else(|error| panic!("{label}: simplex: {error}"));
        let tolerance = if horizon > LONG_HORIZON { COST_AT_LONG_HORIZON } else { COST };
        match (fast.cost, value.as_f64()) {
            (Some(got), Some(expected)) => assert_near(&label, "J", got, expected, tolerance),
            (None, None) => {}
            (got, expected) => panic!("{label}: J is {got:?}, expected {expected:?}"),
        }
        if let Some(residuals) = &fast.residuals {
            let worst = [residuals.input_bound, residuals.stage_row, Some(residuals.terminal)];
            for residual in worst.into_iter().flatten() {
                assert!(residual.value <= 1e-9, "{label}: {residual:?}");
            }
        }
        let general = artifact.solve_horizon(k, x, horizon, &mut Clarabel);
        match (fast.cost, general) {
            (fast, Ok(general)) => match (fast, general.cost) {
                (Some(fast), Some(general)) => {
                    assert_near(&label, "J by Clarabel", general, fast, COST);
                }
                (None, None) => {}
                other => panic!("{label}: the back-ends disagree: {other:?}"),
            },
            // An interior-point method may fail to classify a program without interior; the
            // simplex has proved this one infeasible by a ray that was checked on its own.
            (None, Err(_)) => {}
            (Some(_), Err(error)) => panic!("{label}: Clarabel: {error}"),
        }
        compared += 1;
    }
    compared
}

/// The first step finds the least of all horizons by enumeration, and proves it when it can.
fn check_search(label: &str, case: &Value, mission: &Problem, x: &DVector<f64>, inside: bool) {
    let expected = &case["expected"];
    let enumerated = Problem { search: HorizonSearch::Enumeration, ..mission.clone() };
    let artifact = prepare(label, &enumerated);
    let step = first_step(case, &artifact, x);
    match (&step.verdict, expected["J"].as_f64()) {
        (Verdict::Command(_), Some(cost)) => {
            assert!(inside, "{label}: a start outside the state constraints must be refused");
            assert_near(label, "J*", step.diagnostics.cost, cost, COST);
            let horizon = usize::try_from(expected["N"].as_u64().unwrap()).unwrap();
            assert_eq!(step.diagnostics.horizon, horizon, "{label}: N*");
            let certificate = step.certificate.as_ref().unwrap();
            assert!(certificate.passed, "{label}: {certificate:?}");
            let proved = certificate.claim == vbar_guidance::control::Claim::Global;
            let expected = expected["proved_global_beyond_N_max"].as_bool().unwrap();
            assert_eq!(proved, expected, "{label}: proved beyond N_max: {:?}", certificate.claim);
        }
        (Verdict::Infeasible(reason), expected) => {
            assert!(!inside || expected.is_none(), "{label}: {reason:?}, expected {expected:?}");
            assert!(!reason.rows.is_empty(), "{label}: no row named: {reason:?}");
        }
        other => panic!("{label}: {other:?}"),
    }
    assert_eq!(step.diagnostics.general_solver_calls, 0, "{label}: fell back to Clarabel");
}

fn first_step(case: &Value, artifact: &Artifact, x: &DVector<f64>) -> Step {
    let measurement = measurement(case, x);
    VariableHorizon::step(
        artifact,
        &VariableHorizon::start(artifact),
        &measurement,
        Budget::UNLIMITED,
    )
    .unwrap_or_else(|error| panic!("{}: {error:?}", case["id"]))
}

fn measurement(case: &Value, x: &DVector<f64>) -> Measurement {
    let state = if is_spacecraft(case) {
        MeasuredState::Relative(scaling(case).physical(x.as_slice()))
    } else {
        MeasuredState::Linear(x.clone())
    };
    Measurement { state, elapsed: None }
}

// ---- Traces --------------------------------------------------------------------------------

/// Replays a closed loop at the recorded states.
fn check_trace(label: &str, case: &Value) -> usize {
    let (scheme, point) = match kind(label, case) {
        Kind::TraceAdaptive2025a => (Scheme::AdaptiveTerminal, TerminalPoint::Projection),
        Kind::TraceAdaptive2025b => (Scheme::AdaptiveTerminal, TerminalPoint::Reference),
        Kind::TraceFixed2025a | Kind::TraceFixed2025b => {
            (Scheme::FixedTerminal, TerminalPoint::Projection)
        }
        other => panic!("{label}: {other:?} is not a trace"),
    };
    let longest = case["N_max"].as_u64().map_or(60, |n| usize::try_from(n).unwrap());
    let artifact = prepare(label, &problem(case, scheme, point, longest));
    if let Some(lambda) = case["lambda_"].as_f64() {
        assert_near(label, "lambda_bar", artifact.summary().lambda_bar, lambda, 1e-9);
    }
    let steps = case["steps"].as_array().unwrap();
    let mut state = VariableHorizon::start(&artifact);
    for (k, recorded) in steps.iter().enumerate() {
        let label = format!("{label} k = {k}");
        let measurement = measurement(case, &vector(&recorded["x"]));
        let step = VariableHorizon::step(&artifact, &state, &measurement, Budget::UNLIMITED)
            .unwrap_or_else(|error| panic!("{label}: {error:?}"));
        check_step(&label, recorded, &step);
        let Verdict::Command(command) = &step.verdict else { panic!("{label}: {step:?}") };
        assert_eq!(command.last, k + 1 == steps.len(), "{label}: last command");
        state = step.next;
    }
    check_arrival(label, case, &artifact, &state);
    check_tube_plan(label, case, longest);
    steps.len()
}

fn check_step(label: &str, recorded: &Value, step: &Step) {
    assert_near(label, "J", step.diagnostics.cost, number(&recorded["J"]), COST);
    let horizon = |field: &str| recorded[field].as_u64().map(|n| usize::try_from(n).unwrap());
    assert_eq!(Some(step.diagnostics.horizon), horizon("N"), "{label}: N");
    assert!(step.certificate.as_ref().unwrap().passed, "{label}: {:?}", step.certificate);
    assert_eq!(step.diagnostics.general_solver_calls, 0, "{label}: fell back to Clarabel");
    if let Some(branch) = recorded["branch"].as_str() {
        let expected = match branch {
            "P" | "C1" => Branch::TerminalPoint,
            "F" | "C2" => Branch::TerminalSet,
            other => panic!("{label}: branch {other} is not known"),
        };
        assert_eq!(step.diagnostics.branch, expected, "{label}: branch");
        if let (Some(cost), Some(point)) = (recorded["Jtilde"].as_f64(), step.diagnostics.point) {
            assert_near(label, "J of the terminal point", point.0, cost, COST);
            assert_eq!(Some(point.1), horizon("Ntilde"), "{label}: N of the terminal point");
        }
        let powers: Vec<usize> =
            numbers(&recorded["Zf_powers_of_AK"]).iter().map(|&power| power as usize).collect();
        assert_eq!(step.diagnostics.terminal_set_powers, powers, "{label}: powers of A_K");
    }
    for field in ["center", "r_tilde"] {
        if let Some(centre) = recorded.get(field) {
            let got = step.diagnostics.terminal_centre.as_slice();
            assert_close(label, field, got, &numbers(centre), GEOMETRY);
        }
    }
    for trial in &step.diagnostics.trials {
        if let TrialOutcome::Optimal(cost) = trial.outcome {
            assert!(cost.is_finite(), "{label}: {trial:?}");
        }
    }
}

fn check_arrival(label: &str, case: &Value, artifact: &Artifact, state: &State) {
    let x = vector(&case["x_final"]);
    let step = VariableHorizon::step(artifact, state, &measurement(case, &x), Budget::UNLIMITED)
        .unwrap_or_else(|error| panic!("{label}: {error:?}"));
    let Verdict::Arrived(arrival) = &step.verdict else { panic!("{label}: {step:?}") };
    let completion = case["T_c"].as_u64().or(case["N_ct"].as_u64()).unwrap();
    assert_eq!(arrival.completion_steps, usize::try_from(completion).unwrap(), "{label}: T_c");
    if let (Some(distance), Some(expected)) =
        (arrival.distance_m, case["final_distance_m"].as_f64())
    {
        assert_near(label, "final distance", distance, expected, 1e-6);
    }
    assert!(arrival.inside_guaranteed_set, "{label}: outside the guaranteed set");
    for (field, got) in [
        ("q_f", step.diagnostics.adapted_step),
        ("N_qf", step.diagnostics.adapted_horizon),
        ("Nbar", step.diagnostics.adapted_horizon),
    ] {
        if let Some(expected) = case[field].as_u64() {
            assert_eq!(got, usize::try_from(expected).unwrap(), "{label}: {field}");
        }
    }
}

/// The tube plan recorded beside some traces.
fn check_tube_plan(label: &str, case: &Value, longest: usize) {
    let Some(tube) = case.get("tboc") else { return };
    let mission = problem(case, Scheme::TubeOptimalControl, TerminalPoint::Projection, longest);
    let artifact = prepare(label, &mission);
    let step = first_step(case, &artifact, &vector(&case["steps"][0]["x"]));
    assert_near(label, "J of the tube plan", step.diagnostics.cost, number(&tube["J"]), COST);
    assert_eq!(Some(step.diagnostics.horizon as u64), tube["N"].as_u64(), "{label}: tube plan N");
}

#[test]
fn golden_variable_horizon_kinds_are_told_apart() {
    let unknown = serde_json::json!({ "id": "x", "terminal": "sphere" });
    let result = std::panic::catch_unwind(|| kind("file", &unknown));
    assert!(result.is_err(), "an unknown kind must fail");
}
