//! Plans with disturbance feedback: made, kept, brought, exported and flown.

use std::path::Path;

use ::http::Method;
use bytes::Bytes;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::Code;
use vbar_proto::v1::{self, step_response::Verdict};
use vbar_server::{Config, Limits, StoreLocation, offline};

use crate::{
    missions::{self, message, prisma},
    support::{Server, detail, grpc_fields, json_fields, server, server_with},
};

/// Computes the plan for `problem` over HTTP.
async fn computed(server: &Server, problem: &Value) -> Value {
    let answer = server.post("/v1/plans:compute", &json!({ "problem": problem })).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    answer.json()
}

async fn kept(server: &Server, problem: &Value) -> String {
    computed(server, problem).await["planId"].as_str().expect("text").to_owned()
}

async fn document(server: &Server, id: &str) -> Value {
    let answer = server.get(&format!("/v1/plans/{id}")).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    answer.json()["document"].clone()
}

async fn exported(server: &Server, id: &str, format: &str) -> Bytes {
    let answer = server.get(&format!("/v1/plans/{id}:export?format={format}")).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    answer.body
}

/// `json` with the value at `pointer` replaced.
fn with(mut json: Value, pointer: &str, value: Value) -> Value {
    *json.pointer_mut(pointer).unwrap_or_else(|| panic!("{pointer}")) = value;
    json
}

/// Refused over both transports, with exactly these fields at fault; the JSON error comes back.
async fn check_upload(server: &Server, case: &str, document: &Value, fields: &[&str]) -> Value {
    let request = json!({ "document": document });
    let answer = server.post("/v1/plans", &request).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{case}: {error}");
    let named = json_fields(&error);
    for field in fields {
        assert!(named.iter().any(|n| n == field), "{case}: {field} is not in {named:?}");
    }
    let upload: v1::UploadPlanRequest = message(request);
    let status = server.grpc().await.upload_plan(upload).await.expect_err(case);
    assert_eq!(status.code(), Code::InvalidArgument, "{case}");
    assert_eq!(grpc_fields(&status), named, "{case}");
    error
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_is_kept_and_is_the_same_over_both_transports() {
    let server = server().await;
    let over_http = computed(&server, &prisma()).await;
    let request: v1::ComputePlanRequest = message(json!({ "problem": prisma() }));
    let over_grpc = server.grpc().await.compute_plan(request).await.unwrap().into_inner();
    assert_eq!(message::<v1::ComputePlanResponse>(over_http.clone()), over_grpc);
    let plan = &over_http["plan"]["disturbanceFeedback"];
    // Reference case prisma_T18000_N6: trace 3081.306..., fuel 0.83313 m/s (golden data).
    let close = |value: &Value, expected: f64, tolerance: f64| {
        let value = value.as_f64().expect("a number");
        assert!((value / expected - 1.0).abs() < tolerance, "{value} is not {expected}");
    };
    close(&plan["trace"], 3_081.306_460_386, 1e-6);
    close(&plan["fuelMS"], 0.833_126_9, 1e-3);
    assert_eq!(plan["certificate"]["passed"], true);
    assert_eq!(plan["burns"].as_array().unwrap().len(), 5);
    assert_eq!(plan["gains"].as_array().unwrap().len(), 10);
    assert_eq!(plan["burns"][0]["epoch"], "2027-03-01T12:00:00.000");
    assert_eq!(plan["burns"][1]["epoch"], "2027-03-01T13:00:00.000");
    // A plan is named by its content.
    let id = over_http["planId"].as_str().unwrap();
    assert_eq!(over_http["provenance"]["contentSha256"], id);
    let got = server.get(&format!("/v1/plans/{id}")).await.json();
    assert_eq!(got["document"]["plan"], over_http["plan"]);
    assert_eq!(got["provenance"], over_http["provenance"]);
    let request = v1::GetPlanRequest { plan_id: id.to_owned() };
    let over_grpc = server.grpc().await.get_plan(request).await.unwrap().into_inner();
    assert_eq!(message::<v1::GetPlanResponse>(got), over_grpc);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_brought_back_is_the_same_plan() {
    let first = server().await;
    let id = kept(&first, &prisma()).await;
    let document = document(&first, &id).await;
    let binary = exported(&first, &id, "BINARY").await;
    // A node that has never seen it.
    let second = server().await;
    let only_checked = json!({ "document": document, "validateOnly": true });
    let answer = second.post("/v1/plans", &only_checked).await.json();
    assert_eq!(
        (answer["planId"].as_str(), &answer["certificate"]["passed"]),
        (Some(""), &true.into())
    );
    assert_eq!(second.get(&format!("/v1/plans/{id}")).await.status, 404);
    let answer = second.post("/v1/plans", &json!({ "document": document })).await;
    assert_eq!(answer.json()["planId"], id.as_str(), "{}", answer.text());
    let third = server().await;
    let content = Some(v1::upload_plan_request::Content::Binary(binary));
    let request = v1::UploadPlanRequest { content, validate_only: false };
    let answer = third.grpc().await.upload_plan(request).await.unwrap().into_inner();
    assert_eq!(answer.plan_id, id);
    assert!(answer.certificate.unwrap().passed);
    assert_eq!(self::document(&third, &id).await, document);
    // The mission of a kept plan is the mission itself: it gives the same plan.
    assert_eq!(kept(&third, &document["problem"]).await, id);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_with_a_changed_number_is_refused_with_both_numbers() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let good = document(&server, &id).await;
    const PLAN: &str = "/plan/disturbanceFeedback";
    const FIELD: &str = "document.plan.disturbance_feedback";
    let value =
        |pointer: &str| good.pointer(&format!("{PLAN}/{pointer}")).unwrap().as_f64().unwrap();
    for (pointer, change, field) in [
        ("gains/3/gain/values/2", 1e-6, "trace"),
        ("burns/1/deltaVMS/0", 0.01, "certificate.dynamics_residual_nd"),
        ("burns/2/correctionMaxMS/1", 0.01, "burns[2].correction_max_m_s[1]"),
        ("burns/0/saturationMarginMS/0", 0.01, "burns[0].saturation_margin_m_s[0]"),
        ("arrival/inPlaneSemiAxesM/0", 1.0, "arrival.in_plane_semi_axes_m[0]"),
        ("arrival/positionShape/values/4", 1.0, "arrival.position_shape[1][1]"),
        ("states/3/state/positionM/0", 1.0, "states[3].state.position_m[0]"),
        ("fuelMS", -0.1, "fuel_m_s"),
        ("effortMS", 0.1, "effort_m_s"),
        ("traceShares/1", 0.1, "trace_shares[1]"),
        ("trace", -1.0, "trace"),
        ("objective", -1.0, "objective"),
        ("diagnostics/deltaVMaxLeastMS", -0.01, "diagnostics.delta_v_max_least_m_s"),
    ] {
        let changed = value(pointer) + change;
        let bad = with(good.clone(), &format!("{PLAN}/{pointer}"), changed.into());
        let field = format!("{FIELD}.{field}");
        let error = check_upload(&server, pointer, &bad, &[&field]).await;
        let violations = detail(&error, "BadRequest").unwrap()["fieldViolations"].clone();
        let violation = violations
            .as_array()
            .unwrap()
            .iter()
            .find(|violation| violation["field"] == field.as_str())
            .unwrap()["description"]
            .as_str()
            .unwrap()
            .to_owned();
        // A number that is itself a claim is told beside the one that follows instead.
        if !pointer.starts_with("gains") && !pointer.ends_with("deltaVMS/0") {
            assert!(violation.contains(&format!("got {changed:?}")), "{pointer}: {violation}");
            let own = format!("expected {:?}", value(pointer));
            // The recomputed number may differ from the written one in its last digits.
            assert!(violation.contains(&own[..own.len().min(20)]), "{pointer}: {violation}");
        }
    }
    let cases = [
        ("burns/1/epoch", json!("2027-03-01T13:00:01.000"), "burns[1].epoch"),
        ("burns/1/frame", json!("FRAME_RTN"), "burns[1].frame"),
        ("burns/1/frame", json!("FRAME_UNSPECIFIED"), "burns[1].frame"),
        ("gains/0/burnIndex", json!(0), "gains[0]"),
        ("gains/0/gain/rows", json!(2), "gains[0].gain.rows"),
        ("certificate", Value::Null, "certificate"),
        ("certificate/passed", json!(false), "certificate.passed"),
    ];
    for (pointer, value, field) in cases {
        let bad = with(good.clone(), &format!("{PLAN}/{pointer}"), value);
        check_upload(&server, pointer, &bad, &[&format!("{FIELD}.{field}")]).await;
    }
    // The mission changed under the plan: a lower limit breaks margins.
    let limit = "/problem/disturbanceFeedback/deltaVMaxMS";
    let bad = with(good.clone(), limit, 0.01.into());
    let field = format!("{FIELD}.certificate.saturation_margin_m_s");
    check_upload(&server, "a lower limit", &bad, &[&field]).await;
    // Nothing of all this was kept.
    let list = server.get("/v1/plans").await.json();
    assert_eq!(list["plans"].as_array().unwrap().len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_binary_is_refused_whichever_bit_is_flipped() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let good = exported(&server, &id, "BINARY").await;
    assert!(good.len() < 4096, "{} bytes", good.len());
    let limits = Limits::default();
    assert_eq!(offline::verify_plan(&good, &limits).unwrap().plan_id, id);
    for bit in 0..good.len() * 8 {
        let mut bad = good.to_vec();
        bad[bit / 8] ^= 1 << (bit % 8);
        assert!(offline::verify_plan(&bad, &limits).is_err(), "bit {bit}");
    }
    for length in 0..good.len() {
        assert!(offline::verify_plan(&good[..length], &limits).is_err(), "length {length}");
    }
    let mut bad = good.to_vec();
    bad[1000] ^= 4;
    let content = Some(v1::upload_plan_request::Content::Binary(bad.into()));
    let request = v1::UploadPlanRequest { content, validate_only: false };
    let status = server.grpc().await.upload_plan(request).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert_eq!(grpc_fields(&status), ["binary"]);
    assert!(status.message().contains("checksum"), "{status}");
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_in_a_directory_survives_a_restart_and_damage_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let config =
        Config { store: StoreLocation::Directory(folder.path().to_owned()), ..Config::default() };
    let first = server_with(config.clone()).await;
    let id = kept(&first, &prisma()).await;
    let before = document(&first, &id).await;
    first.node.shutdown().await;
    let second = server_with(config.clone()).await;
    assert_eq!(document(&second, &id).await, before);
    let list = second.get("/v1/plans").await.json();
    assert_eq!(list["plans"][0]["planId"], id.as_str());
    second.node.shutdown().await;
    let file = folder.path().join("v1/plans").join(&id[..2]).join(&id);
    flip_a_bit(&file);
    let third = server_with(config).await;
    let damaged = third.get(&format!("/v1/plans/{id}")).await;
    assert_eq!((damaged.status.as_u16(), &damaged.json()["code"]), (500, &json!(15)));
    assert!(damaged.text().contains(&id));
}

fn flip_a_bit(file: &Path) {
    let mut bytes = std::fs::read(file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(file, bytes).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn plans_are_paged_and_summed_up() {
    let server = server().await;
    let mut ids = Vec::new();
    for weight in [1.0, 2.0, 3.0] {
        let problem = with(prisma(), "/disturbanceFeedback/fuelWeight", weight.into());
        ids.push(kept(&server, &problem).await);
    }
    ids.sort();
    let (mut seen, mut token) = (Vec::new(), String::new());
    loop {
        let page = server.get(&format!("/v1/plans?pageSize=2&pageToken={token}")).await.json();
        for plan in page["plans"].as_array().unwrap() {
            assert_eq!(
                (&plan["method"], &plan["burns"]),
                (&json!("disturbance_feedback"), &json!(5))
            );
            assert_eq!(plan["durationS"], 18000.0);
            assert_eq!(plan["epoch"]["calendar"], "2027-03-01T12:00:00.000");
            seen.push(plan["planId"].as_str().unwrap().to_owned());
        }
        token = page["nextPageToken"].as_str().unwrap().to_owned();
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(seen, ids);
    assert_eq!(server.get("/v1/plans?pageSize=-1").await.status, 400);
    assert_eq!(server.get("/v1/plans?pageToken=x").await.status, 400);
    assert_eq!(server.get("/v1/plans?filter=x").await.status, 400);
    let request = v1::ListPlansRequest { page_size: 3, page_token: String::new() };
    let page = server.grpc().await.list_plans(request).await.unwrap().into_inner();
    assert_eq!(page.plans.iter().map(|plan| plan.plan_id.as_str()).collect::<Vec<_>>(), ids);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_unknown_is_not_found() {
    let server = server().await;
    let id = "ab".repeat(32);
    let answer = server.get(&format!("/v1/plans/{id}")).await;
    assert_eq!(answer.status, 404);
    assert_eq!(detail(&answer.json(), "ErrorInfo").unwrap()["reason"], "PLAN_UNKNOWN");
    assert_eq!(server.get(&format!("/v1/plans/{id}:export?format=CSV")).await.status, 404);
    assert_eq!(server.get("/v1/plans/xyz").await.status, 400);
    // An artifact is not a plan because they have the same mission.
    let id = kept(&server, &prisma()).await;
    assert_eq!(server.get(&format!("/v1/artifacts/{id}")).await.status, 404);
    let step = json!({ "planId": "cd".repeat(32), "measurement": missions::prisma_measurement(0) });
    assert_eq!(server.post("/v1/step", &step).await.status, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_not_possible_is_an_answer_with_the_least_limit() {
    let server = server().await;
    let problem = missions::prisma_6000_s(0.26);
    let answer = computed(&server, &problem).await;
    assert_eq!(answer["planId"], "");
    let infeasible = &answer["infeasible"];
    let relaxation = &infeasible["relaxations"][0];
    assert_eq!(relaxation["family"], "CONSTRAINT_FAMILY_INPUT");
    // Reference case prisma_T6000_N10: the least limit is 0.27887347971... m/s.
    let least = relaxation["limitMS"].as_f64().unwrap();
    assert!((least - 0.278_873_479_71).abs() < 1e-9, "{least}");
    let more = relaxation["amountMS"].as_f64().unwrap();
    assert!((more - 0.018_873_479_71).abs() < 1e-9, "{more}");
    assert!(infeasible["reason"].as_str().unwrap().contains("0.27887"), "{infeasible}");
    // A limit above it is enough, and Precompute says the same.
    let enough = computed(&server, &missions::prisma_6000_s(0.35)).await;
    assert_eq!(enough["plan"]["disturbanceFeedback"]["certificate"]["passed"], true);
    let operation = server.post("/v1/precompute", &json!({ "problem": problem })).await.json();
    assert_eq!(operation["response"]["infeasible"], *infeasible);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_by_precompute_is_its_own_artifact() {
    let server = server().await;
    let made = server.post("/v1/precompute", &json!({ "problem": prisma() })).await.json();
    let artifact = &made["response"]["artifact"];
    let id = kept(&server, &prisma()).await;
    assert_eq!(artifact["provenance"]["contentSha256"], id.as_str());
    let plan = document(&server, &id).await["plan"]["disturbanceFeedback"].clone();
    assert_eq!(artifact["disturbanceFeedback"]["plan"], plan);
    let step = json!({
        "artifactId": artifact["artifactId"], "measurement": missions::prisma_measurement(0),
    });
    let answer = server.post("/v1/step", &step).await.json();
    assert_eq!(answer["command"]["deltaVMS"], plan["burns"][0]["deltaVMS"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_is_only_checked_if_so_asked() {
    let server = server().await;
    let request = json!({ "problem": prisma(), "validateOnly": true });
    let answer = server.post("/v1/plans:compute", &request).await.json();
    assert_eq!(answer["planId"], "");
    assert!(answer["plan"].is_null());
    assert_eq!(server.get("/v1/plans").await.json()["plans"], json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_of_another_method_is_not_kept_and_needs_its_initial_state() {
    let server = server().await;
    let request = json!({ "problem": missions::double_integrator() });
    let error = server.post("/v1/plans:compute", &request).await.json();
    assert_eq!(json_fields(&error), ["initial"]);
    let initial = json!({ "linear": { "components": [20.0, 0.0] } });
    let request = json!({ "problem": missions::double_integrator(), "initial": initial });
    let answer = server.post("/v1/plans:compute", &request).await.json();
    assert!(answer["plan"].is_object() && answer["planId"] == "", "{answer}");
    let request = json!({ "problem": prisma(), "initial": missions::prisma_measurement(0) });
    let error = server.post("/v1/plans:compute", &request).await.json();
    assert_eq!(json_fields(&error), ["initial"]);
    let document = json!({
        "problem": missions::double_integrator(), "plan": { "disturbanceFeedback": {} },
    });
    check_upload(&server, "another method", &document, &["document.problem"]).await;
}

/// The state planned at each instant, with what a receiver adds: 1 mm here, 0.1 mm/s there, well
/// inside the assumed errors of 2 cm and 2 mm/s.
fn measurements(plan: &Value) -> Vec<Value> {
    let states = plan["disturbanceFeedback"]["states"].as_array().unwrap();
    let with_error = |state: &Value, sign: f64| {
        let add = |field: &str, error: f64| {
            let mut values: Vec<f64> =
                serde_json::from_value(state["state"][field].clone()).unwrap();
            values[0] += sign * error;
            values[2] -= sign * error;
            values
        };
        json!({
            "relative": {
                "frame": state["state"]["frame"],
                "positionM": add("positionM", 1e-3),
                "velocityMS": add("velocityMS", 1e-4),
            },
            "elapsedS": state["elapsedS"],
        })
    };
    let sign = |k: usize| if k.is_multiple_of(2) { 1.0 } else { -1.0 };
    states.iter().enumerate().map(|(k, state)| with_error(state, sign(k))).collect()
}

async fn flown(server: &Server, id: &str, measured: &[Value]) -> Vec<v1::StepResponse> {
    let mut answers: Vec<v1::StepResponse> = Vec::new();
    for measurement in measured {
        let mut request: v1::StepRequest =
            message(json!({ "planId": id, "measurement": measurement }));
        if let Some(last) = answers.last() {
            request.controller_state = last.controller_state.clone();
        }
        answers.push(server.grpc().await.step(request).await.unwrap().into_inner());
    }
    answers
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_is_flown_by_its_id_in_steps_and_on_a_stream() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let plan = document(&server, &id).await["plan"].clone();
    let measured = measurements(&plan);
    let answers = flown(&server, &id, &measured).await;
    for (k, answer) in answers.iter().enumerate() {
        assert_eq!(answer.step_index, i32::try_from(k).unwrap());
        assert_eq!(answer.provenance.as_ref().unwrap().content_sha256, id);
        let Some(v1::step_response::Diagnostics::DisturbanceFeedback(flight)) = &answer.diagnostics
        else {
            panic!("{answer:?}")
        };
        match &answer.verdict {
            Some(Verdict::Command(command)) if k < 5 => {
                assert_eq!(command.frame(), v1::Frame::LvlhCcsds);
                assert_eq!(command.last, k == 4);
                assert_eq!(command.epoch, plan["disturbanceFeedback"]["burns"][k]["epoch"]);
                let nominal = &flight.nominal_delta_v_m_s;
                let planned = &plan["disturbanceFeedback"]["burns"][k]["deltaVMS"];
                assert_eq!(json!(nominal), *planned);
                for axis in 0..3 {
                    let sum = nominal[axis] + flight.correction_m_s[axis];
                    assert!((command.delta_v_m_s[axis] - sum).abs() < 1e-15);
                }
                assert!(!flight.clipped && flight.arrival_level.is_none());
                assert!(answer.certificate.as_ref().unwrap().passed);
            }
            Some(Verdict::Arrived(arrival)) if k == 5 => {
                assert_eq!(arrival.completion_steps, 5);
                assert!(arrival.inside_guaranteed_set);
                assert!(flight.arrival_level.unwrap() <= 1.0);
            }
            other => panic!("step {k}: {other:?}"),
        }
        if let Some(seen) = &answer.realised_disturbance {
            assert!(!seen.outside_assumed_set && seen.gauge.unwrap() <= 1.0, "{k}: {seen:?}");
        }
    }
    // Corrections were made for the errors seen.
    assert!(answers[2..5].iter().any(|answer| match &answer.diagnostics {
        Some(v1::step_response::Diagnostics::DisturbanceFeedback(flight)) => {
            flight.correction_m_s.iter().any(|c| c.abs() > 1e-9)
        }
        _ => false,
    }));
    assert_eq!(on_a_stream(&server, &id, &measured).await, answers);
}

async fn on_a_stream(server: &Server, id: &str, measured: &[Value]) -> Vec<v1::StepResponse> {
    let (ask, asked) = mpsc::channel(16);
    let mut client = server.grpc().await;
    let mut stream = client.step_stream(ReceiverStream::new(asked)).await.unwrap().into_inner();
    let mut answers = Vec::new();
    for (k, measurement) in measured.iter().enumerate() {
        let mut request = json!({ "measurement": measurement });
        if k == 0 {
            request["planId"] = id.into();
        }
        ask.send(message(request)).await.unwrap();
        match stream.next().await.unwrap().unwrap().result.unwrap() {
            v1::step_stream_response::Result::Response(answer) => answers.push(answer),
            v1::step_stream_response::Result::Status(status) => panic!("{status:?}"),
        }
    }
    answers
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_flown_with_what_does_not_fit_is_refused() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let step = |measurement: Value| json!({ "planId": id, "measurement": measurement });
    let linear = step(json!({ "linear": { "components": [1.0] }, "elapsedS": 0.0 }));
    let error = server.post("/v1/step", &linear).await.json();
    assert_eq!(json_fields(&error), ["measurement"]);
    let late = with(missions::prisma_measurement(0), "/elapsedS", 100.0.into());
    let error = server.post("/v1/step", &step(late)).await.json();
    assert_eq!(json_fields(&error), ["measurement.elapsed_s"]);
    // The state of one plan's flight does not fit another plan, though their mission is one.
    let first = server.post("/v1/step", &step(missions::prisma_measurement(0))).await.json();
    let mut second = step(missions::prisma_measurement(0));
    second["planId"] = kept(&server, &missions::prisma_6000_s(0.35)).await.into();
    second["controllerState"] = first["controllerState"].clone();
    let answer = server.post("/v1/step", &second).await;
    assert_eq!(answer.status, 400);
    let reason = detail(&answer.json(), "ErrorInfo").unwrap()["reason"].clone();
    assert_eq!(reason, "CONTROLLER_STATE_MISMATCH");
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_exported_as_ocm_has_its_burns_and_their_frame() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let path = format!("/v1/plans/{id}:export?format=CCSDS_OCM&chaserName=MAIN%20CRAFT");
    let answer = server.get(&path).await;
    assert_eq!(answer.headers["content-type"], "text/plain; charset=us-ascii");
    let name = format!("attachment; filename=\"plan-{}.ocm\"", &id[..12]);
    assert_eq!(answer.headers["content-disposition"], name);
    let text = answer.text();
    for line in [
        "CCSDS_OCM_VERS = 3.0",
        "OBJECT_NAME = MAIN CRAFT",
        "TIME_SYSTEM = UTC",
        "EPOCH_TZERO = 2027-03-01T12:00:00.000",
        "MAN_REF_FRAME = LVLH_ROTATING",
        "CREATION_DATE = 2027-03-01T12:00:00.000",
    ] {
        assert!(text.lines().any(|found| found == line), "{line}\n{text}");
    }
    let burns = offline::read_ocm(&answer.body).unwrap();
    let plan = document(&server, &id).await["plan"]["disturbanceFeedback"].clone();
    assert_eq!(burns.len(), 5);
    for (k, burn) in burns.iter().enumerate() {
        assert_eq!(burn.epoch, plan["burns"][k]["epoch"]);
        for (axis, value) in burn.delta_v_m_s.iter().enumerate() {
            let own = plan["burns"][k]["deltaVMS"][axis].as_f64().unwrap();
            // 16 digits of a number in km/s.
            assert!((value - own).abs() <= 1e-15 * own.abs(), "{value} {own}");
        }
    }
    let without = text.replace("MAN_REF_FRAME = LVLH_ROTATING\n", "");
    let refusal = offline::read_ocm(without.as_bytes()).unwrap_err();
    assert_eq!(refusal.violations[0].path, "MAN_REF_FRAME");
    // The same without a node.
    let json = document(&server, &id).await.to_string();
    let request = v1::ExportPlanRequest {
        format: v1::PlanFormat::CcsdsOcm.into(),
        chaser_name: "MAIN CRAFT".to_owned(),
        ..v1::ExportPlanRequest::default()
    };
    let offline = offline::export(json.as_bytes(), &request, &Limits::default()).unwrap();
    assert_eq!(offline.content, answer.body);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_exported_as_oem_covers_every_arc_and_state() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let body = exported(&server, &id, "CCSDS_OEM").await;
    let text = std::str::from_utf8(&body).unwrap();
    let count = |line: &str| text.lines().filter(|found| *found == line).count();
    assert_eq!((count("META_START"), count("COVARIANCE_STOP")), (5, 5));
    assert_eq!(count("REF_FRAME = EME2000"), 5);
    let states: Vec<&str> =
        text.lines().filter(|l| l.starts_with("2027-") && l.split(' ').count() == 7).collect();
    let covariances = text.lines().filter(|line| line.starts_with("EPOCH = ")).count();
    assert_eq!(states.len(), covariances);
    // 18,000 s at 1.09e-3 rad/s in steps of at most 0.1 rad.
    assert!(states.len() >= 196, "{}", states.len());
    assert!(text.lines().all(|line| line.len() <= 254 && line.is_ascii()));
    // 7011 km from the Earth's centre, give or take the eccentricity and 10 km.
    for line in [states[0], states[states.len() - 1]] {
        let numbers: Vec<f64> = line.split(' ').skip(1).map(|x| x.parse().unwrap()).collect();
        let radius = numbers[..3].iter().map(|x| x * x).sum::<f64>().sqrt();
        assert!((radius - 7011.0).abs() < 29.0, "{radius}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_exported_as_csv_has_a_line_an_instant() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    let answer = server.get(&format!("/v1/plans/{id}:export?format=PLAN_FORMAT_CSV")).await;
    assert_eq!(answer.headers["content-type"], "text/csv; charset=utf-8");
    let lines: Vec<Vec<&str>> =
        answer.text().lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(lines.len(), 7);
    assert!(lines.iter().all(|line| line.len() == lines[0].len()));
    let plan = document(&server, &id).await["plan"]["disturbanceFeedback"].clone();
    let column = lines[0].iter().position(|name| *name == "delta_v_x_lvlh_ccsds_m_s").unwrap();
    for k in 0..5 {
        let value: f64 = lines[k + 1][column].parse().unwrap();
        assert_eq!(json!(value), plan["burns"][k]["deltaVMS"][0]);
    }
    assert_eq!(lines[6][column], "");
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_export_that_lacks_epoch_or_orientation_names_them() {
    let server = server().await;
    let mut problem = prisma();
    problem["disturbanceFeedback"]["orbit"] = json!({ "elements": {
        "semiMajorAxisM": 7_011_000.0, "eccentricity": 0.004, "trueAnomalyDeg": 0.0,
    } });
    let id = kept(&server, &problem).await;
    const ORBIT: &str = "problem.disturbance_feedback.orbit";
    let epoch = format!("{ORBIT}.epoch");
    let orientation = ["inclination_deg", "raan_deg", "argument_of_perigee_deg", "frame"]
        .map(|name| format!("{ORBIT}.elements.{name}"));
    let all: Vec<String> = std::iter::once(epoch.clone()).chain(orientation).collect();
    for (format, fields) in [("CCSDS_OCM", vec![epoch]), ("CCSDS_OEM", all)] {
        let answer = server.get(&format!("/v1/plans/{id}:export?format={format}")).await;
        assert_eq!(answer.status, 400, "{format}");
        let error = answer.json();
        assert_eq!(error["code"], 9, "{format}");
        assert_eq!(json_fields(&error), fields, "{format}");
        let request: v1::ExportPlanRequest =
            message(json!({ "planId": id, "format": format!("PLAN_FORMAT_{format}") }));
        let status = server.grpc().await.export_plan(request).await.unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert_eq!(grpc_fields(&status), fields);
    }
    for format in ["CSV", "BINARY"] {
        assert!(!exported(&server, &id, format).await.is_empty());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_export_malformed_requests_are_named() {
    let server = server().await;
    let id = kept(&server, &prisma()).await;
    for (query, field) in [
        ("", "format"),
        ("?format=PDF", "format"),
        ("?format=CSV&chaserName=A%0AMAN_REF_FRAME%3DRTN", "chaser_name"),
        ("?format=CSV&creationDate=yesterday", "creation_date"),
        ("?format=CSV&colour=red", "query"),
    ] {
        let answer = server.get(&format!("/v1/plans/{id}:export{query}")).await;
        assert_eq!(answer.status, 400, "{query}");
        assert_eq!(json_fields(&answer.json()), [field], "{query}");
    }
    let path = format!("/v1/plans/{id}:export?format=CSV");
    let answer = server.http(Method::POST, &path, &[], Bytes::new()).await;
    assert_eq!(answer.status, 405);
}
