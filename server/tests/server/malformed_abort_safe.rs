//! Malformed abort-safe missions get a named error over both transports.

use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::v1;
use vbar_server::{Config, Limits};

use crate::{
    missions::{message, station},
    support::{Server, detail, grpc_fields, json_fields, server, server_with},
};

const METHOD: &str = "problem.abort_safe";

/// The mission with `value` at `pointer` (removed if null).
fn with(mut problem: Value, pointer: &str, value: Value) -> Value {
    let (parent, name) = pointer.rsplit_once('/').expect("a pointer");
    let place = format!("/abortSafe{parent}");
    match problem.pointer_mut(&place).unwrap_or_else(|| panic!("{pointer}")) {
        Value::Object(map) if value.is_null() => drop(map.remove(name).expect("it was there")),
        Value::Object(map) => drop(map.insert(name.to_owned(), value)),
        Value::Array(list) => list[name.parse::<usize>().expect("an index")] = value,
        other => panic!("{pointer}: {other}"),
    }
    problem
}

/// Refused over both transports with exactly these fields; the JSON error comes back.
async fn refused(server: &Server, case: &str, problem: &Value, fields: &[&str]) -> Value {
    let fields: Vec<String> = fields.iter().map(|field| format!("{METHOD}.{field}")).collect();
    let request = json!({ "problem": problem, "validateOnly": true });
    let answer = server.post("/v1/precompute", &request).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{case}: {error}");
    assert_eq!(json_fields(&error), fields, "{case}: {error}");
    let request: v1::PrecomputeRequest = message(request);
    let status = server.grpc().await.precompute(request).await.expect_err(case);
    assert_eq!(status.code(), Code::InvalidArgument, "{case}: {status}");
    assert_eq!(grpc_fields(&status), fields, "{case}");
    error
}

/// What each case changes, and the one field that is at fault then.
async fn check(server: &Server, cases: impl IntoIterator<Item = (&str, Value, &str)>) {
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value}");
        refused(server, &case, &with(station(), pointer, value), &[field]).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_numbers_are_named() {
    let server = server().await;
    check(
        &server,
        [
            ("/orbit", Value::Null, "orbit"),
            ("/orbit/elements/eccentricity", json!(1.0), "orbit.elements.eccentricity"),
            ("/orbit/elements/eccentricity", json!(1.7), "orbit.elements.eccentricity"),
            ("/massKg", Value::Null, "mass_kg"),
            ("/massKg", json!(-4000.0), "mass_kg"),
            ("/sampleTimeS", json!(0.0), "sample_time_s"),
            ("/sampleTimeS", json!("NaN"), "sample_time_s"),
            ("/periodFolding", json!(9), "period_folding"),
            ("/frame", Value::Null, "frame"),
            ("/predictionHorizon", json!(0), "prediction_horizon"),
            ("/predictionHorizon", json!(121), "prediction_horizon"),
            ("/clearance", json!(0.0), "clearance"),
            ("/setTiming", json!(9), "set_timing"),
            ("/separation", json!(9), "separation"),
            ("/fallback", Value::Null, "fallback"),
            ("/fallback", json!(9), "fallback"),
            ("/arrivalDistanceM", json!(0.0), "arrival_distance_m"),
            ("/arrivalDistanceM", Value::Null, "arrival_distance_m"),
            ("/fastestApproachMS", Value::Null, "fastest_approach_m_s"),
            ("/fastestApproachMS", json!(-1.0), "fastest_approach_m_s"),
            ("/abortSearch", json!({ "clearanceM": 0.0 }), "abort_search.clearance_m"),
            ("/abortSearch", json!({ "programsMax": -1 }), "abort_search.programs_max"),
            ("/stepsMax", json!(0), "steps_max"),
            ("/stepsMax", json!(10_001), "steps_max"),
        ],
    )
    .await;
    let limits = Limits { horizon_max: 20, steps_max: 50, ..Limits::default() };
    let strict = server_with(Config { limits, ..Config::default() }).await;
    let fields = ["prediction_horizon", "steps_max"];
    refused(&strict, "the node's own limits", &station(), &fields).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_sample_time_comes_with_those_that_fit() {
    let server = server().await;
    let mut problem = station();
    problem["abortSafe"]["orbit"]["elements"] =
        json!({ "semiMajorAxisM": 7_419_320.0, "eccentricity": 0.1, "trueAnomalyDeg": 140.0 });
    let mut phase = problem["abortSafe"]["phases"][1].clone();
    phase["passive"]["watch"]["horizonSteps"] = json!(4);
    phase.as_object_mut().unwrap().remove("advanceWithinM");
    problem["abortSafe"]["phases"] = json!([phase]);
    let with_step = |step_s: f64| with(problem.clone(), "/sampleTimeS", json!(step_s));
    // The period is 212 samples of 30 s within 0.3 ms.
    let accepted = json!({ "problem": with_step(30.0), "validateOnly": true });
    assert_eq!(server.post("/v1/precompute", &accepted).await.status, 200);
    let error = refused(&server, "31 s", &with_step(31.0), &["sample_time_s"]).await;
    let text = error.to_string();
    // 6360.00028 s over 206 and over 205.
    for fit in ["30.873787", "31.024391", "PERIOD_FOLDING_RESYNCHRONISE"] {
        assert!(text.contains(fit), "{fit} is not in {text}");
    }
    refused(&server, "slower than the orbit", &with_step(2e4), &["sample_time_s"]).await;
    refused(&server, "too many samples", &with_step(0.1), &["sample_time_s"]).await;
    let mut folded = with_step(31.0);
    folded["abortSafe"]["periodFolding"] = json!("PERIOD_FOLDING_RESYNCHRONISE");
    let answer = server.post("/v1/precompute", &json!({ "problem": folded })).await.json();
    let summary = &answer["response"]["artifact"]["abortSafe"];
    assert_eq!(summary["stepsPerPeriod"], 205, "{answer}");
    let miss = summary["foldErrorS"].as_f64().unwrap();
    assert!((miss + 5.000_28).abs() < 1e-3, "{miss}");
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_thrusters_are_named() {
    let server = server().await;
    let thruster =
        |direction: [f64; 3], force: f64| json!({ "direction": direction, "forceMaxN": force });
    let list = |thrusters: Vec<Value>| json!({ "list": { "thrusters": thrusters } });
    let up = thruster([1.0, 0.0, 0.0], 20.0);
    check(
        &server,
        [
            ("/thrusters", Value::Null, "thrusters"),
            ("/thrusters", json!({}), "thrusters"),
            ("/thrusters", json!({ "cubeCorners": {} }), "thrusters.cube_corners.force_max_n"),
            ("/thrusters", list(vec![]), "thrusters.list.thrusters"),
            ("/thrusters", list(vec![up.clone(); 17]), "thrusters.list.thrusters"),
            (
                "/thrusters",
                list(vec![up.clone(), thruster([0.0; 3], 1.0)]),
                "thrusters.list.thrusters[1].direction",
            ),
            (
                "/thrusters",
                list(vec![thruster([0.0, 1.0, 0.0], -1.0)]),
                "thrusters.list.thrusters[0].force_max_n",
            ),
        ],
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_phases_are_named() {
    let server = server().await;
    let modes = |modes: Value| json!({ "list": { "modes": modes } });
    const MODES: &str = "/phases/2/active/modes";
    check(
        &server,
        [
            ("/phases", json!([]), "phases"),
            ("/phases/3/advanceWithinM", json!(1.0), "phases[3].advance_within_m"),
            ("/phases/0/advanceWithinM", Value::Null, "phases[0].advance_within_m"),
            ("/phases/0/advanceWithinM", json!(-1.0), "phases[0].advance_within_m"),
            ("/phases/3/nothingAvoided", Value::Null, "phases[3]"),
            ("/phases/0/passive/watch", Value::Null, "phases[0].passive.watch"),
            (MODES, Value::Null, "phases[2].active.modes"),
            (MODES, json!({}), "phases[2].active.modes"),
            (MODES, json!({ "preset": 0 }), "phases[2].active.modes.preset"),
            (MODES, json!({ "preset": 9 }), "phases[2].active.modes.preset"),
            (MODES, modes(json!([])), "phases[2].active.modes.list.modes"),
            (
                MODES,
                modes(json!([{ "indices": [8] }])),
                "phases[2].active.modes.list.modes[0].indices[0]",
            ),
            (
                MODES,
                modes(json!([{ "indices": [1] }, { "indices": [1] }])),
                "phases[2].active.modes.list.modes[1]",
            ),
        ],
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_watches_are_named() {
    let server = server().await;
    const WATCH: &str = "/phases/0/passive/watch";
    let watch = |field: &str| format!("phases[0].passive.watch.{field}");
    let faces = |normals: Vec<f64>, offsets: Vec<f64>| {
        json!({ "facesM": {
            "normals": { "rows": normals.len() / 3, "columns": 3, "values": normals },
            "offsets": offsets,
        } })
    };
    let cube = vec![
        1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, //
        -1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0,
    ];
    let shape =
        |values: [f64; 9]| json!({ "shapeM2": { "rows": 3, "columns": 3, "values": values } });
    let mut long = cube.clone();
    long[0] = 2.0;
    let cases = [
        ("speedMaxMS", json!(0.0), "speed_max_m_s"),
        ("inflation", json!(0.9), "inflation"),
        ("inflation", json!("Infinity"), "inflation"),
        ("horizonSteps", json!(0), "horizon_steps"),
        ("horizonSteps", json!(10_001), "horizon_steps"),
        ("fractions", json!(65), "fractions"),
        ("nearestSets", json!(17), "nearest_sets"),
        ("nearestSets", json!(-1), "nearest_sets"),
        ("region", Value::Null, "region"),
        ("region", json!({}), "region"),
        ("region", json!({ "radiusM": 0.0 }), "region.radius_m"),
        (
            "region",
            json!({ "semiAxes": { "semiAxesM": [1.0, 2.0] } }),
            "region.semi_axes.semi_axes_m",
        ),
        (
            "region",
            json!({ "halfWidths": { "halfWidthsM": [1.0, -2.0, 3.0] } }),
            "region.half_widths.half_widths_m[1]",
        ),
        ("region", shape([1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]), "region.shape_m2"),
        ("region", shape([1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), "region.shape_m2"),
        // The region must hold the target inside, be closed, and have its offsets in metres.
        (
            "region",
            faces(cube.clone(), vec![20.0, 20.0, 20.0, 20.0, -5.0, 20.0]),
            "region.faces_m.offsets[4]",
        ),
        ("region", faces(cube[..15].to_vec(), vec![20.0; 5]), "region.faces_m.normals"),
        ("region", faces(cube[..3].to_vec(), vec![20.0; 1]), "region.faces_m.normals"),
        ("region", faces(long, vec![20.0; 6]), "region.faces_m.normals"),
    ];
    for (name, value, field) in cases {
        let case = format!("{name} = {value}");
        let problem = with(station(), &format!("{WATCH}/{name}"), value);
        refused(&server, &case, &problem, &[&watch(field)]).await;
    }
    let problem = with(station(), &format!("{WATCH}/horizonSteps"), json!(10_000));
    let problem = with(problem, &format!("{WATCH}/fractions"), json!(64));
    refused(&server, "too many instants", &problem, &[&watch("fractions")]).await;
    // The same cube as faces and as half widths is the same region.
    let closed = with(station(), &format!("{WATCH}/region"), faces(cube, vec![20.0; 6]));
    let request = json!({ "problem": closed, "validateOnly": true });
    assert_eq!(server.post("/v1/precompute", &request).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_weights_are_named() {
    let server = server().await;
    const WEIGHTS: &str = "/phases/1/weights";
    let at = |name: &str| format!("{WEIGHTS}/{name}");
    let (stage, input, terminal) = (at("stage"), at("input"), at("terminal"));
    let (stage, input, terminal) = (stage.as_str(), input.as_str(), terminal.as_str());
    let mut lopsided = vec![0.0; 36];
    (0..6).for_each(|i| lopsided[7 * i] = 1.0);
    lopsided[1] = 0.5;
    let matrix = |rows: i32, values: Vec<f64>| {
        let matrix = json!({ "rows": rows, "columns": 6, "values": values });
        json!({ "matrix": matrix })
    };
    let diagonal = |values: Vec<f64>| json!({ "diagonal": { "values": values } });
    check(
        &server,
        [
            (WEIGHTS, Value::Null, "phases[1].weights"),
            (stage, Value::Null, "phases[1].weights.stage"),
            (stage, json!({}), "phases[1].weights.stage"),
            (stage, json!({ "identityTimes": -1.0 }), "phases[1].weights.stage.identity_times"),
            (stage, diagonal(vec![1.0; 3]), "phases[1].weights.stage.diagonal.values"),
            (terminal, diagonal(vec![1.0, 1.0, -1.0, 1.0, 1.0, 1.0]), "phases[1].weights.terminal"),
            (terminal, matrix(6, lopsided), "phases[1].weights.terminal"),
            (terminal, matrix(3, vec![0.0; 18]), "phases[1].weights.terminal.matrix.rows"),
            (input, json!({ "identityTimes": 0.0 }), "phases[1].weights.input"),
            (input, diagonal(vec![1.0, 0.0, 1.0]), "phases[1].weights.input"),
        ],
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_abort_safe_names_every_fault_at_once() {
    let server = server().await;
    let mut problem = station();
    let method = &mut problem["abortSafe"];
    method["orbit"]["elements"]["eccentricity"] = json!(1.2);
    method["massKg"] = json!(0.0);
    method["phases"][0]["passive"]["watch"]["inflation"] = json!(0.5);
    method["phases"][2]["active"]["modes"] = json!({ "list": { "modes": [] } });
    method["fallback"] = json!(0);
    let fields = [
        "orbit.elements.eccentricity",
        "mass_kg",
        "phases[0].passive.watch.inflation",
        "phases[2].active.modes.list.modes",
        "fallback",
    ];
    let error = refused(&server, "five faults", &problem, &fields).await;
    assert!(detail(&error, "BadRequest").is_some());
}

/// The same mission told along other axes is the same mission.
#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_mission_told_in_other_axes_is_the_same_mission() {
    let server = server().await;
    let id = async |problem: &Value| {
        let request = json!({ "problem": problem, "validateOnly": true });
        let answer = server.post("/v1/precompute", &request).await;
        assert_eq!(answer.status, 200, "{}", answer.text());
        answer.json()["metadata"]["artifactId"].clone()
    };
    let corners = |signs: fn(f64, f64, f64) -> [f64; 3]| {
        let sign = |i: i32, bit: i32| if i >> bit & 1 == 0 { 1.0 } else { -1.0 };
        let corner = |i| {
            json!({
                "direction": signs(sign(i, 2), sign(i, 1), sign(i, 0)), "forceMaxN": 20.0,
            })
        };
        json!({ "list": { "thrusters": (0..8).map(corner).collect::<Vec<_>>() } })
    };
    let axes = |lengths: [f64; 3]| json!({ "semiAxes": { "semiAxesM": lengths } });
    const REGION: &str = "/phases/0/passive/watch/region";
    let along_rtn = with(station(), "/thrusters", corners(|r, t, n| [r, t, n]));
    let along_rtn = with(along_rtn, REGION, axes([1.0, 2.0, 3.0]));
    // x = T, y = -N, z = -R.
    let turned = with(along_rtn.clone(), "/frame", json!("FRAME_LVLH_CCSDS"));
    let turned = with(turned, "/thrusters", corners(|r, t, n| [t, -n, -r]));
    let turned = with(turned, REGION, axes([2.0, 3.0, 1.0]));
    assert_eq!(id(&turned).await, id(&along_rtn).await);
}
