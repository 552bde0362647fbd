//! `golden_offline_sampling_…`: reference cases of an independent implementation.
//!
//! One kind a file, in the paper's words: x, v, rows `Hx x + Hv v <= h`, cost [x v 1] S [x v 1]'.
//! Read from `$VBAR_GOLDEN_DIR/offline_sampling`, else from the copies in `tests/golden`. A kind
//! that is not known here fails.

use std::{collections::BTreeMap, fs, path::PathBuf};

use nalgebra::{DMatrix, DVector};
use serde_json::Value;
use vbar_guidance::{
    Budget,
    dynamics::{
        ExpectedCost, PlantMatrices, PoseidynVariant, Prediction, StageWeights, Transfer, poseidyn,
        terminal_cost, zero_order_hold,
    },
    program::{
        Clarabel, DenseRows, DualActiveSet, QuadraticCost, QuadraticProgram, QuadraticSolution,
        Status, verify_quadratic,
    },
    reach::{
        EXACT, HalfSpaces, Invariant, InvariantLimits, NoInterior, PlantVertex, StageConstraints,
        StageFamily, StageGroup, irredundant, max_robust_control_invariant,
        max_robust_positive_invariant, project_out_last,
    },
    sampling::{SampleSizeError, ScalarLaw, sample_size, sample_size_bound},
    sets::{ConvexSet, Zonotope},
};

const LIMITS: InvariantLimits = InvariantLimits { iterations_max: 200, rows_max: 20_000 };

fn folder() -> PathBuf {
    let root = std::env::var_os("VBAR_GOLDEN_DIR").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden")),
        PathBuf::from,
    );
    root.join("offline_sampling")
}

#[test]
fn golden_offline_sampling_every_case() {
    let mut files: Vec<PathBuf> = fs::read_dir(folder())
        .unwrap_or_else(|error| panic!("{}: {error}", folder().display()))
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no case in {}", folder().display());
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for path in files {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let case: Value = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
        let kind = case["kind"].as_str().unwrap_or_else(|| panic!("{name}: no kind"));
        *counts.entry(kind.to_owned()).or_default() += check(&name, kind, &case);
    }
    for (kind, count) in &counts {
        assert!(*count > 0, "{kind}: a file without cases");
        println!("golden offline_sampling: {count} cases of kind {kind} checked");
    }
}

#[test]
fn golden_offline_sampling_kinds_are_told_apart() {
    let unknown = serde_json::json!({ "kind": "tube" });
    let result = std::panic::catch_unwind(|| check("file", "tube", &unknown));
    assert!(result.is_err(), "an unknown kind must fail");
}

/// Checks a file; returns how many cases it held.
fn check(name: &str, kind: &str, case: &Value) -> usize {
    match kind {
        "ntilde" => check_sample_size(name, case),
        "discretise" => check_discretise(name, case),
        "truncated_gaussian_quantile" => check_quantile(name, case),
        "transfer" => check_transfer(name, case),
        "stilde" => check_expected_cost(name, case),
        "terminal_P" => check_terminal_cost(name, case),
        "irredundant" => check_irredundant(name, case),
        "max_rci" => check_control_invariant(name, case),
        "max_rpi" => check_positive_invariant(name, case),
        "online_qp" => check_online(name, case),
        "end_to_end" => check_end_to_end(name, case),
        other => panic!("{name}: a case of unknown kind {other:?}"),
    }
}

// ---- Reading -------------------------------------------------------------------------------

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("not a number: {value}"))
}

fn count(value: &Value) -> usize {
    usize::try_from(value.as_u64().unwrap_or_else(|| panic!("not a count: {value}"))).unwrap()
}

fn list(value: &Value) -> &Vec<Value> {
    value.as_array().unwrap_or_else(|| panic!("not a list: {value}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    list(value).iter().map(number).collect()
}

/// Numbers of a list of lists, one after the other.
fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(values) => values.iter().flat_map(flat).collect(),
        other => vec![number(other)],
    }
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows = list(value);
    let columns = list(&rows[0]).len();
    DMatrix::from_row_slice(rows.len(), columns, &flat(value))
}

fn half_spaces(normals: &Value, offsets: &Value) -> HalfSpaces {
    let columns = list(&normals[0]).len();
    let mut rows = HalfSpaces::new(columns);
    for (normal, offset) in list(normals).iter().zip(list(offsets)) {
        rows.push(&numbers(normal), number(offset));
    }
    rows
}

fn assert_close(label: &str, got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{label}: length");
    let size = expected.iter().fold(1.0_f64, |a, x| a.max(x.abs()));
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        let error = (got - expected).abs();
        assert!(error <= tolerance * size, "{label}[{i}]: {got} expected {expected}");
    }
}

fn assert_matrix(label: &str, got: &DMatrix<f64>, expected: &Value, tolerance: f64) {
    let expected = matrix(expected);
    assert_eq!(got.shape(), expected.shape(), "{label}: shape");
    assert_close(label, got.as_slice(), expected.as_slice(), tolerance);
}

// ---- Numbers and plants --------------------------------------------------------------------

fn check_sample_size(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["rtol"]);
    for entry in list(&case["cases"]) {
        let (d, epsilon, delta) =
            (count(&entry["d"]), number(&entry["eps"]), number(&entry["delta"]));
        let got = sample_size_bound(d, epsilon, delta).unwrap();
        let expected = number(&entry["value"]);
        assert!((got - expected).abs() <= tolerance * expected, "{name}: {entry}: {got}");
        assert_eq!(sample_size(d, epsilon, delta), Ok(count(&entry["ceil"])), "{name}: {entry}");
    }
    let mut invalid = 0;
    for entry in case["invalid"].as_array().into_iter().flatten() {
        let got = sample_size(count(&entry["d"]), number(&entry["eps"]), number(&entry["delta"]));
        let refused = matches!(got, Err(SampleSizeError::Violation | SampleSizeError::Confidence));
        assert!(refused, "{name}: {entry}: {got:?}");
        invalid += 1;
    }
    list(&case["cases"]).len() + invalid
}

fn check_discretise(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["tol"]);
    for (i, entry) in list(&case["cases"]).iter().enumerate() {
        let label = format!("{name} {i}");
        let variant = match entry["variant"].as_str() {
            Some("printed") => PoseidynVariant::Printed,
            Some("cw") => PoseidynVariant::ClohessyWiltshire,
            other => panic!("{label}: variant {other:?}"),
        };
        let time = number(&entry["dt"]);
        let q = numbers(&entry["q"]);
        let mut plant = poseidyn(variant, number(&entry["mass"]), time);
        let exact = plant.at(&q);
        assert_matrix(&format!("{label} A"), &exact.a, &entry["Ad_zoh"], tolerance);
        assert_matrix(&format!("{label} B"), &exact.b, &entry["Bd_zoh"], tolerance);
        let (_, integral) = zero_order_hold(&plant.a.at(&q), &DMatrix::identity(4, 4), time);
        assert_matrix(&format!("{label} integral"), &integral, &entry["G_int"], tolerance);
        plant.discretisation =
            vbar_guidance::dynamics::Discretisation::Euler { sample_time_s: time };
        let euler = plant.at(&q);
        assert_matrix(&format!("{label} Euler A"), &euler.a, &entry["Ad_euler"], tolerance);
        assert_matrix(&format!("{label} Euler B"), &euler.b, &entry["Bd_euler"], tolerance);
    }
    list(&case["cases"]).len()
}

fn check_quantile(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["tol"]);
    for entry in list(&case["cases"]) {
        let (deviation, bound) = (number(&entry["sigma"]), number(&entry["bound"]));
        let law = ScalarLaw::TruncatedGaussian { deviation, bound };
        let got: Vec<f64> = numbers(&entry["u"]).iter().map(|&u| law.quantile(u)).collect();
        for (got, expected) in got.iter().zip(numbers(&entry["x"])) {
            assert!((got - expected).abs() <= tolerance, "{name}: {entry}: {got}");
        }
    }
    list(&case["cases"]).len()
}

/// The matrices of every step; B_w is the identity where the case says so.
fn steps(case: &Value, b_w: Option<&Value>) -> Vec<PlantMatrices> {
    let (a, b) = (list(&case["A"]), list(&case["B"]));
    let n = list(&a[0]).len();
    (0..a.len())
        .map(|l| PlantMatrices {
            a: matrix(&a[l]),
            b: matrix(&b[l]),
            b_w: b_w.map_or_else(|| DMatrix::identity(n, n), |b_w| matrix(&b_w[l])),
        })
        .collect()
}

fn check_transfer(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["rtol"]);
    let gain = matrix(&case["K"]);
    let steps = steps(case, Some(&case["Bw"]));
    let transfer = Transfer::new(&steps, &gain);
    for (field, got) in
        [("Phi0", &transfer.state), ("Phiv", &transfer.correction), ("Phiw", &transfer.disturbance)]
    {
        for (l, expected) in list(&case[field]).iter().enumerate() {
            assert_matrix(&format!("{name} {field} {l}"), &got[l], expected, tolerance);
        }
    }
    let inputs = &case["check"];
    let disturbances: Vec<Vec<f64>> = list(&inputs["w"]).iter().map(numbers).collect();
    let prediction = Prediction::new(&steps, &disturbances, &gain, steps.len());
    let z: Vec<f64> = [numbers(&inputs["x0"]), flat(&inputs["v"]), vec![1.0]].concat();
    let z = DVector::from_vec(z);
    let n = gain.ncols();
    for (l, input) in prediction.inputs.iter().enumerate() {
        // Gamma_l: the correction of stage l enters input l and no other.
        let gamma = matrix(&case["Gamma"][l]);
        let without = &gain * &prediction.states[l];
        let got = (input - without).columns(n, gamma.ncols()).into_owned();
        assert_close(&format!("{name} Gamma {l}"), got.as_slice(), gamma.as_slice(), tolerance);
        let got = input * &z;
        assert_close(&format!("{name} u {l}"), got.as_slice(), &flat(&inputs["u"][l]), tolerance);
    }
    for (l, state) in prediction.states.iter().enumerate() {
        let got = state * &z;
        assert_close(&format!("{name} x {l}"), got.as_slice(), &flat(&inputs["x"][l]), tolerance);
    }
    1
}

fn expected_cost(case: &Value, with_b_w: bool) -> DMatrix<f64> {
    let gain = matrix(&case["K"]);
    let weights = StageWeights {
        state: matrix(&case["Q"]),
        input: matrix(&case["R"]),
        terminal: matrix(&case["P"]),
    };
    let horizon = count(&case["T"]);
    let mut cost = ExpectedCost::new(gain.ncols() + horizon * gain.nrows() + 1);
    for prediction in predictions(case, with_b_w) {
        cost.add(&prediction, &weights);
    }
    assert_eq!(cost.samples(), list(&case["samples"]).len());
    cost.mean()
}

fn predictions(case: &Value, with_b_w: bool) -> Vec<Prediction> {
    let gain = matrix(&case["K"]);
    list(&case["samples"])
        .iter()
        .map(|sample| {
            let b_w = with_b_w.then(|| &sample["Bw"]);
            let disturbances: Vec<Vec<f64>> = list(&sample["w"]).iter().map(numbers).collect();
            Prediction::new(&steps(sample, b_w), &disturbances, &gain, count(&case["T"]))
        })
        .collect()
}

fn check_expected_cost(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["rtol"]);
    let s = expected_cost(case, true);
    assert_matrix(&format!("{name} S"), &s, &case["S"], tolerance);
    let inputs = &case["check"];
    let x = numbers(&inputs["x"]);
    let z = DVector::from_vec([x.clone(), flat(&inputs["v"]), vec![1.0]].concat());
    let cost = z.dot(&(&s * &z));
    assert_close(name, &[cost], &[number(&inputs["mean_cost"])], tolerance);
    let none = HalfSpaces::new(s.nrows() - 1);
    let online = Online::new(&s, x.len(), &none);
    let solution = online.solve(&x);
    let expected = flat(&inputs["v_unconstrained"]);
    assert_close(&format!("{name} v"), &solution.point, &expected, tolerance);
    1
}

fn check_terminal_cost(name: &str, case: &Value) -> usize {
    let (q, r, k) = (matrix(&case["Q"]), matrix(&case["R"]), matrix(&case["K"]));
    for (i, entry) in list(&case["cases"]).iter().enumerate() {
        let loops: Vec<DMatrix<f64>> = list(&entry["Acl"]).iter().map(matrix).collect();
        let p = terminal_cost(&q, &r, &k, &loops, Budget::UNLIMITED).unwrap();
        assert_matrix(&format!("{name} {i}"), &p, &entry["P"], number(&case["rtol"]));
    }
    list(&case["cases"]).len()
}

// ---- Sets ----------------------------------------------------------------------------------

/// Largest d'x over the rows: a linear program by Clarabel, with a quadratic part that moves the
/// answer by less than 1e-9 |x|^2.
fn support(rows: &HalfSpaces, direction: &[f64]) -> f64 {
    let n = rows.dimension();
    let cost = QuadraticCost::new(DMatrix::identity(n, n) * 1e-9).unwrap();
    let gradient: Vec<f64> = direction.iter().map(|d| -d).collect();
    let program = QuadraticProgram {
        cost: &cost,
        gradient: &gradient,
        rows: rows.rows(),
        offsets: rows.offsets(),
    };
    let solution = Clarabel.solve_quadratic(&program, Budget::UNLIMITED).unwrap();
    assert_eq!(solution.status, Status::Optimal, "support in {direction:?}");
    solution.point.iter().zip(direction).map(|(x, d)| x * d).sum()
}

fn check_support(label: &str, rows: &HalfSpaces, expected: &Value, tolerance: f64) {
    let entries = list(expected);
    assert!(!entries.is_empty(), "{label}: no direction to compare");
    for entry in entries {
        let direction = numbers(&entry["dir"]);
        let got = support(rows, &direction);
        let expected = number(&entry["value"]);
        let error = (got - expected).abs();
        assert!(error <= tolerance * (1.0 + expected.abs()), "{label}: {entry}: {got}");
    }
}

fn reduced(rows: &HalfSpaces) -> Result<Vec<usize>, NoInterior> {
    irredundant(rows, &HalfSpaces::new(rows.dimension()), EXACT, Budget::UNLIMITED)
        .map(|reduction| reduction.kept)
}

fn check_irredundant(name: &str, case: &Value) -> usize {
    for entry in list(&case["cases"]) {
        let label = format!("{name} {}", entry["name"]);
        let rows = half_spaces(&entry["A"], &entry["b"]);
        let kept = reduced(&rows);
        if entry["empty"].as_bool().unwrap() {
            assert!(matches!(kept, Err(NoInterior::Empty { .. })), "{label}: {kept:?}");
            continue;
        }
        let kept = kept.unwrap();
        assert_eq!(kept.len(), count(&entry["n_min"]), "{label}: {kept:?}");
        for (row, margin) in numbers(&entry["margin"]).into_iter().enumerate() {
            // Copies of each other have margin 0: exactly one of them stays, which the count says.
            if margin > 1e-9 {
                assert!(kept.contains(&row), "{label}: needed row {row} was removed");
            } else if margin < -1e-9 {
                assert!(!kept.contains(&row), "{label}: redundant row {row} was kept");
            }
        }
    }
    list(&case["cases"]).len()
}

/// The hull of a few points.
struct Hull(Vec<DVector<f64>>);

impl ConvexSet for Hull {
    fn dimension(&self) -> usize {
        self.0[0].len()
    }

    fn support_function(&self, direction: &DVector<f64>) -> f64 {
        self.0.iter().map(|point| point.dot(direction)).fold(f64::NEG_INFINITY, f64::max)
    }
}

fn check_control_invariant(name: &str, case: &Value) -> usize {
    let tolerance = number(&case["tol"]);
    for entry in list(&case["cases"]) {
        let label = format!("{name} {}", entry["name"]);
        let points = list(&entry["W_vertices"]);
        let matrices = list(&entry["vertices"]);
        let images: Vec<Hull> = matrices
            .iter()
            .map(|vertex| {
                let b_w = matrix(&vertex["Bw"]);
                Hull(points.iter().map(|w| &b_w * DVector::from_vec(numbers(w))).collect())
            })
            .collect();
        let vertices: Vec<PlantVertex<'_>> = matrices
            .iter()
            .zip(&images)
            .map(|(vertex, disturbance)| PlantVertex {
                a: matrix(&vertex["A"]),
                b: matrix(&vertex["B"]),
                disturbance,
            })
            .collect();
        let constraints = half_spaces(&entry["HC"], &entry["hC"]);
        let states = HalfSpaces::new(count(&entry["n"]));
        let found = max_robust_control_invariant(
            &constraints,
            &states,
            &vertices,
            LIMITS,
            Budget::UNLIMITED,
        );
        check_invariant(&label, &found, entry, tolerance);
        if let (Some(x), Invariant::Found { set, .. }) =
            (entry["analytic"]["xmax"].as_f64(), &found)
        {
            for side in [-1.0, 1.0] {
                assert!((support(set, &[side]) - x).abs() <= tolerance * x, "{label}: {found:?}");
            }
        }
    }
    list(&case["cases"]).len()
}

fn check_invariant(label: &str, found: &Invariant, entry: &Value, tolerance: f64) {
    match (found, entry["empty"].as_bool().unwrap()) {
        (Invariant::Empty { .. }, true) => {}
        (Invariant::Found { set, .. }, false) => {
            check_support(label, set, &entry["support"], tolerance);
            // Where the case lists the set's own rows, each is a direction with its offset.
            for (normal, offset) in list(&entry["H"]).iter().zip(list(&entry["h"])) {
                let got = support(set, &numbers(normal));
                let expected = number(offset);
                assert!(got <= expected + tolerance * (1.0 + expected.abs()), "{label}: {normal}");
            }
        }
        (other, _) => panic!("{label}: {other:?}"),
    }
}

fn check_positive_invariant(name: &str, case: &Value) -> usize {
    for entry in list(&case["cases"]) {
        let label = format!("{name} {}", entry["name"]);
        let loops: Vec<DMatrix<f64>> = list(&entry["A"]).iter().map(matrix).collect();
        let n = loops[0].nrows();
        let constraints = match entry["x_inf"].as_f64() {
            Some(size) => cube(n, size),
            None => half_spaces(&entry["H0"], &entry["h0"]),
        };
        let disturbance = Zonotope::centred(DMatrix::identity(n, n) * number(&entry["w_inf"]));
        let vertices: Vec<PlantVertex<'_>> = loops
            .into_iter()
            .map(|a| PlantVertex { a, b: DMatrix::zeros(n, 0), disturbance: &disturbance })
            .collect();
        let found =
            max_robust_positive_invariant(&constraints, &vertices, LIMITS, Budget::UNLIMITED);
        check_invariant(&label, &found, entry, number(&case["tol"]));
    }
    list(&case["cases"]).len()
}

fn cube(n: usize, size: f64) -> HalfSpaces {
    let mut rows = HalfSpaces::new(n);
    for i in 0..n {
        for sign in [1.0, -1.0] {
            let mut normal = vec![0.0; n];
            normal[i] = sign;
            rows.push(&normal, size);
        }
    }
    rows
}

// ---- The online program --------------------------------------------------------------------

/// minimise [x v 1] S [x v 1]' over rows (x, v).
struct Online {
    n: usize,
    s: DMatrix<f64>,
    cost: QuadraticCost,
    state: DenseRows,
    correction: DenseRows,
    offsets: Vec<f64>,
}

impl Online {
    fn new(s: &DMatrix<f64>, n: usize, rows: &HalfSpaces) -> Self {
        let width = s.nrows() - n - 1;
        let cost = QuadraticCost::new(s.view((n, n), (width, width)) * 2.0).unwrap();
        let (mut state, mut correction) = (DenseRows::new(n), DenseRows::new(width));
        for row in 0..rows.len() {
            let (x, v) = rows.normal(row).split_at(n);
            state.push(x);
            correction.push(v);
        }
        Self { n, s: s.clone(), cost, state, correction, offsets: rows.offsets().to_vec() }
    }

    fn at(&self, x: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let (n, width) = (self.n, self.s.nrows() - self.n - 1);
        let gradient = (0..width)
            .map(|i| {
                let from_x: f64 = (0..n).map(|k| self.s[(n + i, k)] * x[k]).sum();
                2.0 * (from_x + self.s[(n + i, n + width)])
            })
            .collect();
        let mut moved = Vec::new();
        self.state.products(x, &mut moved);
        let offsets = self.offsets.iter().zip(&moved).map(|(h, hx)| h - hx).collect();
        (gradient, offsets)
    }

    fn solve(&self, x: &[f64]) -> QuadraticSolution {
        let (gradient, offsets) = self.at(x);
        let program = QuadraticProgram {
            cost: &self.cost,
            gradient: &gradient,
            rows: &self.correction,
            offsets: &offsets,
        };
        let solution = DualActiveSet::default().solve(&program, &[], Budget::UNLIMITED).unwrap();
        if solution.status == Status::Optimal {
            let residuals = verify_quadratic(&program, &solution);
            assert!(residuals.gap <= 1e-9, "{residuals:?}");
        }
        solution
    }

    fn cost(&self, x: &[f64], v: &[f64]) -> f64 {
        let z = DVector::from_vec([x, v, &[1.0]].concat());
        z.dot(&(&self.s * &z))
    }

    /// Least t such that every row holds within t, not per unit normal: min t by a program whose
    /// quadratic part moves it by less than 1e-8.
    fn least_violation(&self, x: &[f64]) -> f64 {
        let width = self.s.nrows() - self.n - 1;
        let (_, offsets) = self.at(x);
        let mut lifted = DenseRows::new(width + 1);
        for row in 0..offsets.len() {
            lifted.push(&[self.correction.normal(row), &[-1.0]].concat());
        }
        let cost = QuadraticCost::new(DMatrix::identity(width + 1, width + 1) * 1e-9).unwrap();
        let mut gradient = vec![0.0; width + 1];
        gradient[width] = 1.0;
        let program =
            QuadraticProgram { cost: &cost, gradient: &gradient, rows: &lifted, offsets: &offsets };
        let solution = Clarabel.solve_quadratic(&program, Budget::UNLIMITED).unwrap();
        assert_eq!(solution.status, Status::Optimal);
        solution.point[width]
    }

    /// Compares one state of a case; u = K x + v.
    fn check(&self, label: &str, entry: &Value, gain: &DMatrix<f64>, tolerances: (f64, f64)) {
        let x = numbers(&entry["x"]);
        let solution = self.solve(&x);
        if let Some(expected) = entry["min_max_violation"].as_f64() {
            let got = self.least_violation(&x);
            assert!((got - expected).abs() <= 1e-6 * (1.0 + expected.abs()), "{label}: {got}");
        }
        if !entry["feasible"].as_bool().unwrap() {
            assert_eq!(solution.status, Status::PrimalInfeasible, "{label}");
            return;
        }
        assert_eq!(solution.status, Status::Optimal, "{label}");
        assert_close(&format!("{label} v"), &solution.point, &flat(&entry["v"]), tolerances.0);
        let (cost, expected) = (self.cost(&x, &solution.point), number(&entry["cost"]));
        assert!((cost - expected).abs() <= tolerances.1 * expected.abs(), "{label}: {cost}");
        let m = gain.nrows();
        let u = gain * DVector::from_vec(x) + DVector::from_column_slice(&solution.point[..m]);
        assert_close(&format!("{label} u"), u.as_slice(), &flat(&entry["u0"]), tolerances.0);
        if let Some(active) = entry["active"].as_array() {
            let mut got: Vec<usize> = solution.active.iter().map(|active| active.row).collect();
            got.sort_unstable();
            let expected: Vec<usize> = active.iter().map(count).collect();
            assert_eq!(got, expected, "{label}: active rows");
        }
    }
}

fn check_online(name: &str, case: &Value) -> usize {
    let mut rows = HalfSpaces::new(list(&case["Hx"][0]).len() + list(&case["Hv"][0]).len());
    let offsets = numbers(&case["h"]);
    for (row, offset) in offsets.iter().enumerate() {
        rows.push(&[numbers(&case["Hx"][row]), numbers(&case["Hv"][row])].concat(), *offset);
    }
    let gain = matrix(&case["K"]);
    let online = Online::new(&matrix(&case["S"]), gain.ncols(), &rows);
    let tolerances = (number(&case["tol_v"]), number(&case["tol_cost_rel"]));
    for entry in list(&case["cases"]) {
        online.check(&format!("{name} {}", entry["name"]), entry, &gain, tolerances);
    }
    list(&case["cases"]).len()
}

// ---- End to end ----------------------------------------------------------------------------

/// The rows of all samples: per sample the stages in order, states before inputs from stage 1 on.
fn sampled_rows(case: &Value) -> HalfSpaces {
    let constraints = StageConstraints {
        state: half_spaces(&case["Hx"], &case["hx"]),
        input: half_spaces(&case["Hu"], &case["hu"]),
        terminal: half_spaces(&case["HT"], &case["hT"]),
    };
    let (n, horizon) = (count(&case["n"]), count(&case["T"]));
    let mut groups = StageGroup::all(horizon, false);
    groups.sort_by_key(|group| (group.stage, group.family != StageFamily::State));
    let mut rows = HalfSpaces::new(n + horizon * count(&case["m"]));
    for prediction in predictions(case, false) {
        for &group in &groups {
            let faces: Vec<usize> = (0..constraints.of(group.family).len()).collect();
            constraints.push_rows(group, &faces, &prediction, &mut rows);
        }
    }
    rows
}

fn check_end_to_end(name: &str, case: &Value) -> usize {
    let (n, m, horizon) = (count(&case["n"]), count(&case["m"]), count(&case["T"]));
    let tolerance = number(&case["tol"]);
    let gain = matrix(&case["K"]);
    let s = expected_cost(case, false);
    assert_matrix(&format!("{name} S"), &s, &case["S"], 1e-9);
    let sampled = sampled_rows(case);
    check_sampled_rows(name, case, &sampled);
    let first = project_out_last(&sampled, (horizon - 1) * m, Budget::UNLIMITED).unwrap();
    check_support(&format!("{name} C_T"), &first, &case["C_T_support"], tolerance);

    let disturbance = Zonotope::centred(DMatrix::identity(n, n) * number(&case["w_inf"]));
    let vertices: Vec<PlantVertex<'_>> = list(&case["vertices"])
        .iter()
        .map(|vertex| {
            let (a, b) = (matrix(&vertex["A"]), matrix(&vertex["B"]));
            PlantVertex { a: a + &b * &gain, b, disturbance: &disturbance }
        })
        .collect();
    let states = half_spaces(&case["Hx"], &case["hx"]);
    let found = max_robust_control_invariant(&first, &states, &vertices, LIMITS, Budget::UNLIMITED);
    let set = match (found, case["empty"].as_bool().unwrap()) {
        (Invariant::Empty { .. }, true) => return 1,
        (Invariant::Found { set, .. }, false) => set,
        (other, _) => panic!("{name}: {other:?}"),
    };
    check_support(&format!("{name} Cinf"), &set, &case["Cinf_support"], tolerance);
    let online = with_first_step(case, &sampled, &set, &vertices, &s);
    for (i, entry) in list(&case["cases"]).iter().enumerate() {
        let label = format!("{name} {i}");
        let x = numbers(&entry["x"]);
        let inside = entry["in_Cinf"].as_bool().unwrap();
        assert_eq!(set.violation(&x) <= 0.0, inside, "{label}: in C_inf");
        online.check(&label, entry, &gain, (tolerance, tolerance));
    }
    check_closed_loop(name, case, &online, &vertices);
    list(&case["cases"]).len()
}

fn check_sampled_rows(name: &str, case: &Value, sampled: &HalfSpaces) {
    assert_eq!(sampled.len(), count(&case["D_rows"]), "{name}: rows");
    for row in 0..sampled.len() {
        let label = format!("{name} row {row}");
        assert_close(&label, sampled.normal(row), &numbers(&case["D_H"][row]), 1e-10);
        assert_close(&label, &[sampled.offset(row)], &[number(&case["D_h"][row])], 1e-10);
    }
    let kept = reduced(sampled).unwrap();
    assert_eq!(kept.len(), count(&case["D_irredundant"]), "{name}: irredundant rows");
    // Of copies one stays, not always the same one.
    let distinct = |rows: Vec<usize>| {
        let text = |row: usize| format!("{:.9?} {:.9}", sampled.normal(row), sampled.offset(row));
        let mut texts: Vec<String> = rows.into_iter().map(text).collect();
        texts.sort();
        texts
    };
    let expected = list(&case["D_keep"]).iter().enumerate();
    let expected = expected.filter(|(_, kept)| kept.as_bool().unwrap()).map(|(row, _)| row);
    assert_eq!(distinct(kept), distinct(expected.collect()), "{name}: kept rows");
}

/// The online program with the constraint that every successor lies in `set`.
fn with_first_step(
    case: &Value,
    sampled: &HalfSpaces,
    set: &HalfSpaces,
    vertices: &[PlantVertex<'_>],
    s: &DMatrix<f64>,
) -> Online {
    let n = count(&case["n"]);
    let mut rows = sampled.clone();
    for row in 0..set.len() {
        let h = DVector::from_column_slice(set.normal(row));
        for vertex in vertices {
            let mut normal: Vec<f64> = (vertex.a.transpose() * &h).iter().copied().collect();
            normal.extend((vertex.b.transpose() * &h).iter());
            normal.resize(sampled.dimension(), 0.0);
            rows.push(&normal, set.offset(row) - vertex.disturbance.support_function(&h));
        }
    }
    Online::new(s, n, &rows)
}

/// Worst disturbances and every vertex in turn: never infeasible, as the case recorded.
fn check_closed_loop(name: &str, case: &Value, online: &Online, vertices: &[PlantVertex<'_>]) {
    let (n, m, bound) = (count(&case["n"]), count(&case["m"]), number(&case["w_inf"]));
    let recorded = &case["closed_loop_extreme"];
    assert_eq!(count(&recorded["infeasible"]), 0, "{name}: expects infeasible steps");
    let starts: Vec<Vec<f64>> = list(&case["cases"])
        .iter()
        .filter(|entry| entry["feasible"].as_bool().unwrap())
        .map(|entry| numbers(&entry["x"]))
        .collect();
    let each = count(&recorded["steps"]) / starts.len();
    for start in starts {
        let mut x = DVector::from_vec(start);
        for step in 0..each {
            let solution = online.solve(x.as_slice());
            assert_eq!(solution.status, Status::Optimal, "{name}: step {step} at {x}");
            let v = DVector::from_column_slice(&solution.point[..m]);
            let vertex = &vertices[step / 3 % vertices.len()];
            let signs = step / 7;
            let w = DVector::from_fn(n, |i, _| if signs >> i & 1 == 1 { bound } else { -bound });
            x = &vertex.a * x + &vertex.b * v + w;
        }
    }
}
