//! Malformed input gets a named error over both transports, all faults at once.

use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::v1;

use crate::{
    missions,
    support::{Server, grpc_fields, json_fields, server},
};

/// Has `problem` checked over both transports; both must name exactly `fields`.
pub(crate) async fn check(server: &Server, case: &str, problem: &Value, fields: &[&str]) {
    let request = json!({ "problem": problem, "validateOnly": true });
    let answer = server.post("/v1/precompute", &request).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{case}: {error}");
    assert_eq!(error["code"], 3, "{case}");
    assert_eq!(json_fields(&error), fields, "{case}: {error}");
    let request: v1::PrecomputeRequest = missions::message(request);
    let status = server.grpc().await.precompute(request).await.expect_err(case);
    assert_eq!(status.code(), Code::InvalidArgument, "{case}: {status}");
    assert_eq!(grpc_fields(&status), fields, "{case}");
}

/// `problem` with the value at `pointer` replaced, or removed.
pub(crate) fn with(mut problem: Value, pointer: &str, value: Option<Value>) -> Value {
    let (parent, name) = pointer.rsplit_once('/').expect("a pointer");
    let parent = problem.pointer_mut(parent).expect("a parent");
    match (parent, value) {
        (Value::Object(map), Some(value)) => {
            map.insert(name.to_owned(), value);
        }
        (Value::Object(map), None) => {
            map.remove(name).expect("it was there");
        }
        (Value::Array(list), Some(value)) => list[name.parse::<usize>().expect("an index")] = value,
        (other, _) => panic!("{pointer}: {other}"),
    }
    problem
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_spacecraft_fields_are_named() {
    let server = server().await;
    const HILL: &str = "/variableHorizon/hill";
    let cases = [
        ("capturePointM/1", Some(json!("NaN")), "hill.capture_point_m[1]"),
        ("capturePointM/1", Some(json!("Infinity")), "hill.capture_point_m[1]"),
        ("capturePointM/2", Some(json!(1e300)), "hill.capture_point_m[2]"),
        ("capturePointM", Some(json!([1.0, 2.0])), "hill.capture_point_m"),
        ("capturePointM", Some(json!([0.0, 0.0, 0.0])), "hill.capture_point_m"),
        ("massKg", Some(json!(-1.0)), "hill.mass_kg"),
        ("massKg", Some(json!(0.0)), "hill.mass_kg"),
        ("cone/halfAngleDeg", Some(json!(0.0)), "hill.cone.half_angle_deg"),
        ("cone/halfAngleDeg", Some(json!(90.0)), "hill.cone.half_angle_deg"),
        ("cone/halfAngleDeg", None, "hill.cone.half_angle_deg"),
        ("disturbance", None, "hill.disturbance"),
        ("disturbance", Some(json!({})), "hill.disturbance"),
        (
            "disturbance/misalignment",
            Some(json!({})),
            "hill.disturbance.misalignment.angle_max_deg",
        ),
        ("frame", None, "hill.frame"),
        ("frame", Some(json!(99)), "hill.frame"),
        ("rotation", None, "hill.rotation"),
        ("accelerationMaxMS2", None, "hill.acceleration_max_m_s2"),
        ("accelerationMaxMS2", Some(json!(0.0)), "hill.acceleration_max_m_s2"),
        ("semiMajorAxisM", Some(json!(6_000_000.0)), "hill.semi_major_axis_m"),
        ("sampleAngleDeg", Some(json!(180.0)), "hill.sample_angle_deg"),
    ];
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value:?}");
        let problem = with(missions::envisat(), &format!("{HILL}/{pointer}"), value);
        let field = format!("problem.variable_horizon.{field}");
        check(&server, &case, &problem, &[&field]).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_scheme_and_search_are_named() {
    let server = server().await;
    let cases = [
        ("scheme", None, "scheme"),
        ("scheme", Some(json!(77)), "scheme"),
        ("search", None, "search"),
        ("norm", Some(json!("COST_NORM_TWO")), "norm"),
        ("norm", Some(json!("COST_NORM_INFINITY")), "norm"),
        ("fuelWeight", None, "fuel_weight"),
        ("fuelWeight", Some(json!(-1.0)), "fuel_weight"),
        ("trackingWeight", Some(json!("NaN")), "tracking_weight"),
        ("horizonMax", None, "horizon_max"),
        ("horizonMax", Some(json!(0)), "horizon_max"),
        ("horizonMax", Some(json!(1_000_000)), "horizon_max"),
        ("horizonGuess", Some(json!(61)), "horizon_guess"),
        ("stepsMax", Some(json!(-5)), "steps_max"),
        ("terminalPoint", Some(json!(9)), "terminal_point"),
        ("gain", None, "gain"),
        ("gain", Some(json!({})), "gain"),
        ("gain/poles/values/0", Some(json!(1.0)), "gain.poles.values[0]"),
        ("gain/poles/values/3", Some(json!(0.6)), "gain.poles.values"),
        ("gain/poles/values", Some(json!([0.5])), "gain.poles.values"),
    ];
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value:?}");
        let problem = with(missions::envisat(), &format!("/variableHorizon/{pointer}"), value);
        check(&server, &case, &problem, &[&format!("problem.variable_horizon.{field}")]).await;
    }
    check(&server, "no method", &json!({}), &["problem"]).await;
    let no_plant = with(missions::envisat(), "/variableHorizon/hill", None);
    check(&server, "no plant", &no_plant, &["problem.variable_horizon"]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_linear_plant_is_named() {
    let server = server().await;
    let one_by_one = json!({ "rows": 1, "columns": 1, "values": [1.0] });
    let cases = [
        ("a/rows", Some(json!(3)), "a.values"),
        ("a/rows", Some(json!(-1)), "a.rows"),
        ("a/values/0", Some(json!("-Infinity")), "a.values[0]"),
        ("a", None, "a"),
        ("a", Some(json!({ "rows": 1, "columns": 2, "values": [1, 1] })), "a"),
        ("b", Some(one_by_one.clone()), "b.rows"),
        ("inputUpper", Some(json!([-3.0])), "input_upper[0]"),
        ("inputUpper", Some(json!([])), "input_upper"),
        ("stateSet/offsets", Some(json!([1.0])), "state_set.offsets"),
        ("stateSet/normals/values/0", Some(json!(0.0)), "state_set.normals"),
        ("disturbance", None, "disturbance"),
        ("disturbance", Some(json!({ "misalignment": { "angleMaxDeg": 1 } })), "disturbance"),
        ("disturbance/box/halfWidthNd/1", Some(json!(-0.1)), "disturbance.box.half_width_nd[1]"),
        ("reference", Some(one_by_one), "reference.columns"),
        ("sampleTimeS", Some(json!(0.0)), "sample_time_s"),
    ];
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value:?}");
        let pointer = format!("/variableHorizon/linear/{pointer}");
        let problem = with(missions::double_integrator(), &pointer, value);
        check(&server, &case, &problem, &[&format!("problem.variable_horizon.linear.{field}")])
            .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_request_names_every_fault_at_once() {
    let server = server().await;
    let mut problem = missions::envisat();
    for (pointer, value) in [
        ("horizonMax", json!(0)),
        ("fuelWeight", json!("NaN")),
        ("hill/massKg", json!(-2.0)),
        ("hill/cone/halfAngleDeg", json!(120.0)),
    ] {
        problem = with(problem, &format!("/variableHorizon/{pointer}"), Some(value));
    }
    let fields = [
        "problem.variable_horizon.horizon_max",
        "problem.variable_horizon.hill.mass_kg",
        "problem.variable_horizon.hill.cone.half_angle_deg",
        "problem.variable_horizon.fuel_weight",
    ];
    check(&server, "four faults", &problem, &fields).await;
    let empty = json!({ "measurement": { "relative": { "positionM": [1] } } });
    let error = server.post("/v1/step", &empty).await.json();
    let fields = [
        "controller",
        "measurement.relative.frame",
        "measurement.relative.position_m",
        "measurement.relative.velocity_m_s",
    ];
    assert_eq!(json_fields(&error), fields);
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_motion_of_the_target_is_named() {
    let server = server().await;
    let free = json!({
        "principalInertiaKgM2": [17_023.0, 124_825.0, 129_112.0],
        "frameFromBodyQuaternion": [1.0, 0.0, 0.0, 0.0],
        "angularVelocityBodyDegS": [0.1, 0.2, 1.0],
        "relativeTo": "RATE_REFERENCE_INERTIAL",
    });
    let cases = [
        ("/frameFromBodyQuaternion", json!([1.0, 1e-4, 0.0, 0.0]), "frame_from_body_quaternion"),
        ("/frameFromBodyQuaternion", json!([0, 0, 0, 0]), "frame_from_body_quaternion"),
        ("/principalInertiaKgM2", json!([1.0, 1.0, 3.0]), "principal_inertia_kg_m2"),
        ("/principalInertiaKgM2", json!([0.0, 1.0, 1.0]), "principal_inertia_kg_m2[0]"),
        ("/relativeTo", json!("RATE_REFERENCE_UNSPECIFIED"), "relative_to"),
    ];
    const ROTATION: &str = "/variableHorizon/hill/rotation";
    const PATH: &str = "problem.variable_horizon.hill.rotation";
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value}");
        let rotation = json!({ "torqueFree": with(free.clone(), pointer, Some(value)) });
        let problem = with(missions::envisat(), ROTATION, Some(rotation));
        check(&server, &case, &problem, &[&format!("{PATH}.torque_free.{field}")]).await;
    }
    // Half an hour of integration, if it were tried.
    let fast = with(free, "/angularVelocityBodyDegS", Some(json!([0, 0, 1e7])));
    let problem = with(missions::envisat(), ROTATION, Some(json!({ "torqueFree": fast })));
    let request = json!({ "problem": problem, "measurement": missions::envisat_start() });
    let answer = server.post("/v1/step", &request).await;
    assert_eq!(answer.status, 400, "{}", answer.json());
    assert_eq!(json_fields(&answer.json()), [format!("{PATH}.torque_free")]);
    let table = json!({ "rows": 2, "columns": 3, "values": [1, 0, 0, 1, 0, 0] });
    let sampled = json!({ "sampled": { "capturePointsM": table, "captureVelocitiesMS": table } });
    let problem = with(missions::envisat(), ROTATION, Some(sampled));
    let fields = [
        "problem.variable_horizon.hill.capture_point_m",
        &format!("{PATH}.sampled.capture_points_m"),
    ];
    check(&server, "too few samples, and a capture point beside them", &problem, &fields).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_actuation_and_navigation_is_named() {
    let server = server().await;
    let mut values = vec![0.0; 36];
    (0..6).for_each(|i| values[7 * i] = if i < 3 { 0.01 } else { 1e-6 });
    let covariance = json!({ "rows": 6, "columns": 6, "values": values });
    let good = json!({
        "navigation": { "covariance": covariance, "sigmaLevel": 3.0 },
        "thrustMagnitudeErrorFraction": 0.02,
        "pointingErrorMaxDeg": 1.0,
    });
    const DISTURBANCE: &str = "/variableHorizon/hill/disturbance";
    const PATH: &str = "problem.variable_horizon.hill.disturbance.actuation_and_navigation";
    let whole = |set: Value| {
        let set = json!({ "actuationAndNavigation": set });
        with(missions::envisat(), DISTURBANCE, Some(set))
    };
    // As it is, it is served.
    let answer = server.post("/v1/precompute", &json!({ "problem": whole(good.clone()) })).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let entries = "navigation/covariance/values";
    let cases = [
        // Position and velocity correlated in one triangle only.
        (format!("{entries}/3"), Some(json!(1e-6)), ".navigation.covariance"),
        (format!("{entries}/0"), Some(json!(-0.01)), ".navigation.covariance"),
        (format!("{entries}/0"), Some(json!("NaN")), ".navigation.covariance.values[0]"),
        ("navigation/covariance/rows".into(), Some(json!(5)), ".navigation.covariance.rows"),
        ("navigation/covariance".into(), None, ".navigation.covariance"),
        ("navigation/sigmaLevel".into(), Some(json!(0.0)), ".navigation.sigma_level"),
        ("navigation/sigmaLevel".into(), Some(json!(-3.0)), ".navigation.sigma_level"),
        ("navigation/sigmaLevel".into(), None, ".navigation.sigma_level"),
        (
            "thrustMagnitudeErrorFraction".into(),
            Some(json!(-0.1)),
            ".thrust_magnitude_error_fraction",
        ),
        (
            "thrustMagnitudeErrorFraction".into(),
            Some(json!(1.5)),
            ".thrust_magnitude_error_fraction",
        ),
        ("pointingErrorMaxDeg".into(), Some(json!(90.0)), ".pointing_error_max_deg"),
        ("pointingErrorMaxDeg".into(), Some(json!(-1.0)), ".pointing_error_max_deg"),
    ];
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value:?}");
        let problem = whole(with(good.clone(), &format!("/{pointer}"), value));
        check(&server, &case, &problem, &[&format!("{PATH}{field}")]).await;
    }
    check(&server, "nothing at all", &whole(json!({})), &[PATH]).await;
    // An indefinite matrix: correlation 1.1. Both it and the level are said.
    let mut indefinite = values.clone();
    indefinite[1] = 0.011;
    indefinite[6] = 0.011;
    let covariance = json!({ "rows": 6, "columns": 6, "values": indefinite });
    let both = json!({ "navigation": { "covariance": covariance, "sigmaLevel": 0.0 } });
    let fields =
        [format!("{PATH}.navigation.sigma_level"), format!("{PATH}.navigation.covariance")];
    check(&server, "both wrong", &whole(both), &[&fields[0], &fields[1]]).await;
    let set = json!({ "actuationAndNavigation": { "pointingErrorMaxDeg": 1.0 } });
    let linear = "/variableHorizon/linear/disturbance";
    let problem = with(missions::double_integrator(), linear, Some(set));
    let field = "problem.variable_horizon.linear.disturbance";
    check(&server, "not a spacecraft", &problem, &[field]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_gain_that_does_not_stabilise_is_named() {
    let server = server().await;
    let gain = json!({ "explicit": { "rows": 1, "columns": 2, "values": [1.0, 1.0] } });
    let problem = with(missions::double_integrator(), "/variableHorizon/gain", Some(gain));
    check(&server, "not Schur", &problem, &["problem.variable_horizon.gain"]).await;
}
