//! Malformed missions of plans with disturbance feedback get a named error over both transports.

use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::v1;
use vbar_server::{Config, Limits};

use crate::{
    missions::{message, prisma},
    support::{Server, grpc_fields, json_fields, server, server_with},
};

const METHOD: &str = "problem.disturbance_feedback";

/// The mission with `value` at `pointer` (removed if null) is refused with exactly this field.
async fn check(server: &Server, pointer: &str, value: Value, field: &str) {
    let case = format!("{pointer} = {value}");
    let mut problem = prisma();
    let (parent, name) = pointer.rsplit_once('/').expect("a pointer");
    let place = format!("/disturbanceFeedback{parent}");
    match problem.pointer_mut(&place).unwrap_or_else(|| panic!("{case}")) {
        Value::Object(map) if value.is_null() => drop(map.remove(name).expect("it was there")),
        Value::Object(map) => drop(map.insert(name.to_owned(), value)),
        Value::Array(list) => list[name.parse::<usize>().expect("an index")] = value,
        other => panic!("{case}: {other}"),
    }
    refused(server, &case, &problem, &[field]).await;
}

async fn refused(server: &Server, case: &str, problem: &Value, fields: &[&str]) {
    let fields: Vec<String> = fields.iter().map(|field| format!("{METHOD}.{field}")).collect();
    let request = json!({ "problem": problem });
    let answer = server.post("/v1/plans:compute", &request).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{case}: {error}");
    assert_eq!(error["code"], 3, "{case}");
    assert_eq!(json_fields(&error), fields, "{case}: {error}");
    let request: v1::ComputePlanRequest = message(request);
    let status = server.grpc().await.compute_plan(request).await.expect_err(case);
    assert_eq!(status.code(), Code::InvalidArgument, "{case}: {status}");
    assert_eq!(grpc_fields(&status), fields, "{case}");
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_orbit_is_named() {
    let server = server().await;
    let elements = "/orbit/elements";
    for (name, value, field) in [
        ("eccentricity", json!(1.0), "eccentricity"),
        ("eccentricity", json!(1.5), "eccentricity"),
        ("eccentricity", json!(-0.1), "eccentricity"),
        ("eccentricity", Value::Null, "eccentricity"),
        ("semiMajorAxisM", json!(6_000_000.0), "semi_major_axis_m"),
        ("semiMajorAxisM", json!("NaN"), "semi_major_axis_m"),
        ("trueAnomalyDeg", Value::Null, "true_anomaly_deg"),
        ("raanDeg", Value::Null, "raan_deg"),
        ("inclinationDeg", json!("Infinity"), "inclination_deg"),
        ("frame", Value::Null, "frame"),
        ("frame", json!(9), "frame"),
    ] {
        check(&server, &format!("{elements}/{name}"), value, &format!("orbit.elements.{field}"))
            .await;
    }
    let epoch =
        |calendar: &str, system: &str| json!({ "calendar": calendar, "timeSystem": system });
    for (value, field) in [
        (epoch("2027-02-30T00:00:00", "TIME_SYSTEM_UTC"), "calendar"),
        (epoch("2027-03-01T12:00:00Z", "TIME_SYSTEM_UTC"), "calendar"),
        (epoch("2027-03-01T12:00:00", "TIME_SYSTEM_UNSPECIFIED"), "time_system"),
    ] {
        check(&server, "/orbit/epoch", value, &format!("orbit.epoch.{field}")).await;
    }
    check(&server, "/orbit", json!({}), "orbit").await;
    let state = |position: [f64; 3], velocity: [f64; 3]| {
        json!({ "state": {
            "frame": "INERTIAL_FRAME_EME2000", "positionM": position, "velocityMS": velocity,
        } })
    };
    // Beyond escape velocity, and a fall to the centre.
    check(&server, "/orbit", state([7e6, 0.0, 0.0], [0.0, 2e4, 0.0]), "orbit.state").await;
    check(&server, "/orbit", state([7e6, 0.0, 0.0], [7e3, 0.0, 0.0]), "orbit.state").await;
}

/// Satellite 00005 of AIAA 2006-6753.
const TLE: &str = "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n\
                   2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667";

fn by_tle(text: &str) -> Value {
    json!({
        "tle": text,
        "epoch": { "calendar": "2000-06-28T00:00:00", "timeSystem": "TIME_SYSTEM_UTC" },
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_mean_elements_are_named() {
    let server = server().await;
    check(&server, "/orbit", by_tle(&TLE.replacen("4753", "4754", 1)), "orbit.tle").await;
    check(&server, "/orbit", by_tle("two lines of\nsomething else"), "orbit.tle").await;
    check(&server, "/orbit", json!({ "tle": TLE }), "orbit.epoch").await;
    let omm = json!({ "omm": "CCSDS_OMM_VERS = 2.0", "epoch": by_tle("")["epoch"] });
    let mut problem = prisma();
    problem["disturbanceFeedback"]["orbit"] = omm;
    let answer = server.post("/v1/plans:compute", &json!({ "problem": problem })).await.json();
    let fields = json_fields(&answer);
    assert!(fields.len() == 13 && fields.iter().all(|f| f == &format!("{METHOD}.orbit.omm")));
    // A good one gives a plan whose orbit is told in TEME.
    problem["disturbanceFeedback"]["orbit"] = by_tle(TLE);
    problem["disturbanceFeedback"]["deltaVMaxMS"] = json!(5.0);
    let answer = server.post("/v1/plans:compute", &json!({ "problem": problem })).await.json();
    let id = answer["planId"].as_str().unwrap();
    let document = server.get(&format!("/v1/plans/{id}")).await.json()["document"].clone();
    let orbit = &document["problem"]["disturbanceFeedback"]["orbit"];
    assert_eq!(orbit["elements"]["frame"], "INERTIAL_FRAME_TEME", "{answer}");
    // Told so, it is the same mission to the last bit.
    let again = json!({ "problem": document["problem"] });
    let again = server.post("/v1/plans:compute", &again).await.json();
    assert_eq!(again["planId"], id);
    let oem = server.get(&format!("/v1/plans/{id}:export?format=CCSDS_OEM")).await;
    assert!(oem.text().contains("REF_FRAME = TEME") && !oem.text().contains("EME2000"));
    // A chaser told in other axes than its target is refused, never mixed.
    let mut mixed = problem.clone();
    mixed["disturbanceFeedback"]["initial"] = json!({ "chaser": {
        "frame": "INERTIAL_FRAME_EME2000", "positionM": [7e6, 0, 0], "velocityMS": [0, 7.5e3, 0],
    } });
    refused(&server, "mixed axes", &mixed, &["initial.chaser.frame"]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_states_and_limits_are_named() {
    let server = server().await;
    for (pointer, value, field) in [
        ("/initial", Value::Null, "initial"),
        ("/initial", json!({}), "initial"),
        ("/initial/relative/frame", json!("FRAME_UNSPECIFIED"), "initial.relative.frame"),
        ("/initial/relative/positionM", json!([1.0, 2.0]), "initial.relative.position_m"),
        ("/targetState/velocityMS/1", json!("NaN"), "target_state.velocity_m_s[1]"),
        ("/targetState", Value::Null, "target_state"),
        ("/deltaVMaxMS", Value::Null, "delta_v_max_m_s"),
        ("/deltaVMaxMS", json!(0.0), "delta_v_max_m_s"),
        ("/fuelWeight", json!(-1.0), "fuel_weight"),
        ("/effortWeight", json!("NaN"), "effort_weight"),
        ("/metric", json!(9), "metric"),
        ("/outerSum", json!(9), "outer_sum"),
    ] {
        check(&server, pointer, value, field).await;
    }
    // "LVLH" alone is no frame of the contract: the first fault of a malformed JSON is named.
    let mut problem = prisma();
    problem["disturbanceFeedback"]["targetState"]["frame"] = json!("FRAME_LVLH");
    let answer = server.post("/v1/plans:compute", &json!({ "problem": problem })).await;
    assert_eq!((answer.status.as_u16(), &answer.json()["code"]), (400, &json!(3)));
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_instants_are_named() {
    let server = server().await;
    let equal = |count: i32, duration: Value| {
        let spacing = json!({ "count": count, "durationS": duration });
        json!({ "equalTime": spacing })
    };
    for (value, field) in [
        (json!({}), "instants"),
        (equal(1, json!(18000.0)), "instants.equal_time.count"),
        (equal(65, json!(18000.0)), "instants.equal_time.count"),
        (equal(6, json!(-1.0)), "instants.equal_time.duration_s"),
        (equal(6, json!(0.0)), "instants.equal_time.duration_s"),
        (equal(6, Value::Null), "instants.equal_time.duration_s"),
        (json!({ "given": { "elapsedS": [0.0] } }), "instants.given.elapsed_s"),
        (json!({ "given": { "elapsedS": [1.0, 2.0] } }), "instants.given.elapsed_s[0]"),
        (json!({ "given": { "elapsedS": [0.0, 2.0, 2.0] } }), "instants.given.elapsed_s[2]"),
        (
            json!({ "equalTrueAnomaly": { "count": 0, "durationS": 5.0 } }),
            "instants.equal_true_anomaly.count",
        ),
    ] {
        check(&server, "/instants", value, field).await;
    }
    let limits = Limits { plan_instants_max: 5, ..Limits::default() };
    let strict = server_with(Config { limits, ..Config::default() }).await;
    check(&strict, "/fuelWeight", json!(1.0), "instants.equal_time.count").await;
    let info = strict.get("/v1/info").await.json();
    assert_eq!(info["limits"]["planInstantsMax"], 5);
}

/// Impulses half a revolution and a whole one before arrival turn the orbital plane about the line
/// of arrival: no size of them moves the chaser out of the plane there.
#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_singular_instants_are_named() {
    let server = server().await;
    let half_period = std::f64::consts::PI * (7.011e6_f64.powi(3) / 3.986_004_418e14).sqrt();
    let mut problem = prisma();
    let method = &mut problem["disturbanceFeedback"];
    method["orbit"]["elements"]["eccentricity"] = json!(0.0);
    method["targetState"]["positionM"] = json!([330.0, 10.0, 30.0]);
    method["instants"] = json!({ "given": { "elapsedS": [0.0, half_period, 2.0 * half_period] } });
    let request = json!({ "problem": problem });
    let answer = server.post("/v1/plans:compute", &request).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{error}");
    assert!(
        json_fields(&error).iter().all(|f| f.starts_with("problem.disturbance_feedback.instants"))
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_navigation_errors_are_named() {
    let server = server().await;
    let diagonal = |values: [f64; 6]| {
        let mut matrix = vec![0.0; 36];
        values.iter().enumerate().for_each(|(i, value)| matrix[7 * i] = *value);
        matrix
    };
    let shape = |values: Vec<f64>| {
        let matrix = json!({ "rows": 6, "columns": 6, "values": values });
        json!([{ "shape": { "frame": "FRAME_RTN", "matrix": matrix } }])
    };
    let good = diagonal([4e-4, 4e-4, 4e-4, 4e-6, 4e-6, 4e-6]);
    let mut lopsided = good.clone();
    lopsided[1] = 1e-5;
    let indefinite = diagonal([4e-4, 4e-4, -4e-4, 4e-6, 4e-6, 4e-6]);
    let flat = diagonal([4e-4, 0.0, 4e-4, 4e-6, 4e-6, 4e-6]);
    for values in [lopsided, indefinite, flat] {
        check(&server, "/navigationErrors", shape(values), "navigation_errors[0].shape.matrix")
            .await;
    }
    let small = json!([{ "shape": {
        "frame": "FRAME_RTN", "matrix": { "rows": 3, "columns": 6, "values": vec![1.0; 18] },
    } }]);
    check(&server, "/navigationErrors", small, "navigation_errors[0].shape.matrix.rows").await;
    let covariance = json!([{ "covariance": {
        "frame": "FRAME_LVLH_CCSDS", "matrix": { "rows": 6, "columns": 6, "values": good },
    } }]);
    let field = "navigation_errors[0].covariance.sigma_level";
    check(&server, "/navigationErrors", covariance, field).await;
    let radii = json!([{ "radii": { "positionRadiusM": 0.0, "velocityRadiusMS": 1e-3 } }]);
    let field = "navigation_errors[0].radii.position_radius_m";
    check(&server, "/navigationErrors", radii, field).await;
    check(&server, "/navigationErrors", json!([]), "navigation_errors").await;
    check(&server, "/navigationErrors", json!([{}, {}]), "navigation_errors").await;
    check(&server, "/navigationErrors", json!([{}]), "navigation_errors[0]").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_plan_names_every_fault_at_once() {
    let server = server().await;
    let mut problem = prisma();
    let method = &mut problem["disturbanceFeedback"];
    method["orbit"]["elements"]["eccentricity"] = json!(1.2);
    method["instants"]["equalTime"]["count"] = json!(1);
    method["deltaVMaxMS"] = json!(-1.0);
    method["navigationErrors"] = json!([]);
    let fields = [
        "orbit.elements.eccentricity",
        "instants.equal_time.count",
        "delta_v_max_m_s",
        "navigation_errors",
    ];
    refused(&server, "four faults", &problem, &fields).await;
}

/// The same mission told in the other axes, and its errors as a covariance: the same plan.
#[tokio::test(flavor = "multi_thread")]
async fn plan_mission_told_in_other_axes_is_the_same_mission() {
    let server = server().await;
    let plan_id = async |problem: &Value| {
        let answer = server.post("/v1/plans:compute", &json!({ "problem": problem })).await.json();
        answer["planId"].as_str().expect("text").to_owned()
    };
    let mut turned = prisma();
    let method = &mut turned["disturbanceFeedback"];
    // x = T, y = -N, z = -R.
    method["initial"]["relative"] = json!({
        "frame": "FRAME_RTN", "positionM": [0.0, 10_000.0, 0.0], "velocityMS": [0.0, 0.0, 0.0],
    });
    method["targetState"] = json!({
        "frame": "FRAME_RTN", "positionM": [-30.0, 330.0, 0.0], "velocityMS": [0.0158, 0.0, 0.0],
    });
    let mut covariance = vec![0.0; 36];
    let radii: [f64; 6] = [0.02, 0.02, 0.02, 2e-3, 2e-3, 2e-3];
    // Two standard deviations: a quarter of the squares, exact in binary.
    radii.iter().enumerate().for_each(|(i, radius)| covariance[7 * i] = radius * radius / 4.0);
    method["navigationErrors"] = json!([{ "covariance": {
        "frame": "FRAME_RTN",
        "matrix": { "rows": 6, "columns": 6, "values": covariance },
        "sigmaLevel": 2.0,
    } }]);
    assert_eq!(plan_id(&turned).await, plan_id(&prisma()).await);
}
