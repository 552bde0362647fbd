//! Plans and steps.

use std::time::{Duration, Instant};

use prost::Message as _;
use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::v1::{self, step_response::Verdict};
use vbar_server::{Config, Limits};

use crate::{
    missions,
    support::{Server, detail, grpc_fields, json_fields, server, server_with, step_request},
};

async fn artifact_id(server: &Server, problem: Value) -> String {
    let answer = server.post("/v1/precompute", &json!({ "problem": problem })).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    answer.json()["metadata"]["artifactId"].as_str().unwrap().to_owned()
}

fn linear(components: [f64; 2]) -> Value {
    json!({ "linear": { "components": components } })
}

async fn step(server: &Server, request: &v1::StepRequest) -> v1::StepResponse {
    server.grpc().await.step(request.clone()).await.expect("a good request").into_inner()
}

#[tokio::test(flavor = "multi_thread")]
async fn step_envisat_gives_a_certified_command() {
    let server = server().await;
    let id = artifact_id(&server, missions::envisat()).await;
    let request = step_request(("artifactId", id.clone().into()), missions::envisat_start());
    let response = server.grpc().await.step(request).await.unwrap();
    let timing = response.metadata().get("server-timing").unwrap().to_str().unwrap().to_owned();
    assert!(timing.starts_with("compute;dur="), "{timing}");
    let answer = response.into_inner();
    let Some(Verdict::Command(command)) = &answer.verdict else { panic!("{answer:?}") };
    assert_eq!(command.frame(), v1::Frame::Rtn);
    assert_eq!(command.acceleration_m_s2.len(), 3);
    assert!(command.acceleration_m_s2.iter().all(|a| a.abs() <= 0.025 * (1.0 + 1e-9)));
    // 360 / 1024 degrees of an orbit of 7140 km.
    let period = std::f64::consts::TAU * (7.14e6_f64.powi(3) / 3.986_004_418e14).sqrt();
    assert!((command.duration_s.unwrap() - period / 1024.0).abs() < 1e-9);
    let certificate = answer.certificate.as_ref().unwrap();
    assert!(certificate.passed);
    // [Quartullo2025a, sec. V.B] with this geometry starts with N = 26.
    let Some(v1::step_response::Diagnostics::VariableHorizon(diagnostics)) = &answer.diagnostics
    else {
        panic!("{answer:?}")
    };
    assert_eq!(diagnostics.horizon, 26);
    assert_eq!(diagnostics.general_solver_calls, 0);
    let prediction = answer.prediction.as_ref().unwrap();
    assert_eq!(prediction.positions_m.as_ref().unwrap().rows, 27);
    assert_eq!(answer.provenance.as_ref().unwrap().artifact_id, id);
    assert!(answer.controller_state.len() < 4096, "{}", answer.controller_state.len());
}

#[tokio::test(flavor = "multi_thread")]
async fn step_loop_over_both_transports_gives_the_same_answers() {
    let server = server().await;
    let id = artifact_id(&server, missions::envisat()).await;
    let mut measurement = missions::envisat_start();
    let mut state = String::new();
    for index in 0..5 {
        let request = json!({
            "artifactId": id, "controllerState": state, "measurement": measurement,
        });
        let answer = server.post("/v1/step", &request).await;
        assert_eq!(answer.status, 200, "{}", answer.text());
        assert!(answer.headers["server-timing"].starts_with("compute;dur="));
        let over_http: v1::StepResponse = missions::message(answer.json());
        assert_eq!(over_http, step(&server, &missions::message(request)).await);
        assert_eq!(over_http.step_index, index);
        state = answer.json()["controllerState"].as_str().unwrap().to_owned();
        let Some(Verdict::Command(command)) = &over_http.verdict else { panic!("{over_http:?}") };
        let elapsed = command.elapsed_s + command.duration_s.unwrap();
        measurement = missions::predicted(&over_http, elapsed);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn step_after_missed_ones_is_answered_over_both_transports() {
    let server = server().await;
    let id = artifact_id(&server, missions::envisat()).await;
    let first = json!({ "artifactId": id, "measurement": missions::envisat_start() });
    let first = server.post("/v1/step", &first).await.json();
    let state = first["controllerState"].clone();
    let first: v1::StepResponse = missions::message(first);
    let Some(Verdict::Command(command)) = &first.verdict else { panic!("{first:?}") };
    let sample_time_s = command.duration_s.unwrap();
    let request = |step: usize, elapsed_s: f64| {
        let measurement = missions::predicted_after(&first, step, elapsed_s);
        json!({ "artifactId": id, "controllerState": state, "measurement": measurement })
    };
    // The measurements of steps 1 and 2 never came.
    let late = request(3, 3.0 * sample_time_s);
    let answer = server.post("/v1/step", &late).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    assert_eq!(answer.json()["variableHorizon"]["missedSteps"], 2);
    let answer: v1::StepResponse = missions::message(answer.json());
    assert_eq!(answer, step(&server, &missions::message(late)).await);
    assert_eq!(answer.step_index, 3);
    assert!(answer.certificate.as_ref().unwrap().passed);
    let realised = answer.realised_disturbance.as_ref().unwrap();
    assert_eq!(realised.steps, 3);
    assert!(!realised.outside_assumed_set && !realised.outside_guaranteed_tube, "{realised:?}");
    // N = 26 at step 0: after step 26 nobody knows what was flown.
    let beyond = request(26, 27.0 * sample_time_s);
    let message = missions::message::<v1::StepRequest>(beyond.clone());
    let status = server.grpc().await.step(message).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition, "{status}");
    let error = server.post("/v1/step", &beyond).await.json();
    assert_eq!(error["code"], 9, "{error}");
    assert_eq!(detail(&error, "ErrorInfo").unwrap()["reason"], "PLAN_EXHAUSTED");
    // Early, or between two steps: the request is at fault.
    for elapsed_s in [0.0, 2.5 * sample_time_s] {
        let wrong = request(1, elapsed_s);
        let error = server.post("/v1/step", &wrong).await.json();
        assert_eq!(error["code"], 3, "{error}");
        assert_eq!(json_fields(&error), ["measurement.elapsed_s"]);
        let status = server.grpc().await.step(missions::message::<v1::StepRequest>(wrong)).await;
        let status = status.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert_eq!(grpc_fields(&status), ["measurement.elapsed_s"]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn step_inline_problem_is_the_same_controller() {
    let server = server().await;
    let inline = step_request(("problem", missions::double_integrator()), linear([20.0, 0.0]));
    let first = step(&server, &inline).await;
    let id = artifact_id(&server, missions::double_integrator()).await;
    assert_eq!(first.provenance.as_ref().unwrap().artifact_id, id);
    let by_id = step_request(("artifactId", id.into()), linear([20.0, 0.0]));
    assert_eq!(step(&server, &by_id).await, first);
    let hit = r#"vbar_artifact_lookups_total{outcome="hit"}"#;
    let before = server.metric(hit).await;
    step(&server, &inline).await;
    assert_eq!(server.metric(hit).await, before + 1.0);
    assert!(server.metric("vbar_simplex_pivots_total").await > 0.0);
    assert!(server.metric(r#"vbar_verdicts_total{outcome="command"}"#).await >= 3.0);
    assert_eq!(server.metric("vbar_certificate_failures_total").await, 0.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn step_same_request_gives_the_same_bytes_with_1_and_2_threads() {
    let mut answers = Vec::new();
    // Four calls at once wait for one thread, however slow the machine is.
    let compute_wait = Duration::from_secs(20);
    for compute_threads in [1, 2] {
        let config = Config {
            compute_threads,
            compute_wait,
            compute_patient_wait: compute_wait,
            ..Config::default()
        };
        let server = server_with(config).await;
        let problem = ("problem", missions::envisat());
        let request = step_request(problem, missions::envisat_start());
        let calls: Vec<_> = (0..4)
            .map(|_| {
                let request = request.clone();
                let client = server.grpc();
                async move {
                    let mut client = client.await;
                    client.step(request).await.unwrap().into_inner().encode_to_vec()
                }
            })
            .collect();
        answers.extend(futures_util::future::join_all(calls).await);
    }
    assert_eq!(answers.len(), 8);
    assert!(answers.iter().all(|answer| *answer == answers[0]));
}

#[tokio::test(flavor = "multi_thread")]
async fn step_after_malformed_requests_answers_as_before() {
    let server = server().await;
    let problem = ("problem", missions::double_integrator());
    let good = step_request(problem, linear([20.0, 0.0]));
    let before = step(&server, &good).await.encode_to_vec();
    let mut bad = good.clone();
    bad.measurement = None;
    assert!(server.grpc().await.step(bad).await.is_err());
    let mut bad = good.clone();
    bad.controller_state = b"VBCS but not really a state".as_slice().into();
    let status = server.grpc().await.step(bad).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    let nan =
        json!({ "problem": missions::double_integrator(), "measurement": linear([20.0, 0.0]) });
    let nan = nan.to_string().replace("20.0", "\"NaN\"");
    let headers = [("content-type", "application/json")];
    let answer = server.http(::http::Method::POST, "/v1/step", &headers, nan.into()).await;
    assert_eq!(answer.status, 400);
    assert_eq!(json_fields(&answer.json()), ["measurement.linear.components[0]"]);
    // From outside the state constraints: an answer, not an error.
    let problem = ("problem", missions::double_integrator());
    let outside = step(&server, &step_request(problem, linear([200.0, 0.0]))).await;
    assert!(matches!(outside.verdict, Some(Verdict::Infeasible(_))), "{outside:?}");
    assert_eq!(step(&server, &good).await.encode_to_vec(), before);
}

#[tokio::test(flavor = "multi_thread")]
async fn step_measurement_of_the_wrong_kind_is_named() {
    let server = server().await;
    let problem = json!(missions::double_integrator());
    let request = json!({ "problem": problem, "measurement": missions::envisat_start() });
    let answer = server.post("/v1/step", &request).await;
    assert_eq!(answer.status, 400, "{}", answer.text());
    let error = answer.json();
    assert!(json_fields(&error).iter().all(|field| field.starts_with("measurement")), "{error}");
    assert!(!json_fields(&error).is_empty());
    let three = json!({ "linear": { "components": [1.0, 2.0, 3.0] } });
    let request = json!({ "problem": missions::double_integrator(), "measurement": three });
    assert_eq!(server.post("/v1/step", &request).await.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn step_state_of_another_artifact_is_a_failed_precondition() {
    let server = server().await;
    let problem = ("problem", missions::double_integrator());
    let answer = step(&server, &step_request(problem, linear([20.0, 0.0]))).await;
    let mut other = missions::double_integrator();
    other["variableHorizon"]["fuelWeight"] = json!(2.0);
    let mut request = step_request(("problem", other), linear([20.0, 0.0]));
    request.controller_state = answer.controller_state.clone();
    let status = server.grpc().await.step(request.clone()).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    let id = &answer.provenance.as_ref().unwrap().artifact_id;
    assert!(status.message().contains(id), "{status}");
    let mut flipped = answer.controller_state.to_vec();
    flipped[70] ^= 4;
    let problem = ("problem", missions::double_integrator());
    let mut request = step_request(problem, linear([19.0, 0.0]));
    request.controller_state = flipped.into();
    let status = server.grpc().await.step(request).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("checksum"), "{status}");
}

/// A mission whose plan takes long: every horizon up to 500 is looked at, far from the target.
fn long_computation() -> Value {
    let mut problem = missions::envisat();
    let method = &mut problem["variableHorizon"];
    method["search"] = json!("HORIZON_SEARCH_ENUMERATION");
    method["horizonMax"] = json!(500);
    method["fuelWeight"] = json!(100.0);
    method["scheme"] = json!("VARIABLE_HORIZON_SCHEME_NOMINAL");
    json!({ "problem": problem, "measurement": missions::envisat_start() })
}

#[tokio::test(flavor = "multi_thread")]
async fn step_deadline_already_over_is_said() {
    let server = server().await;
    // Over HTTP a deadline of nothing is a fault of the request, named like any other.
    let headers = [("content-type", "application/json"), ("request-timeout-ms", "0")];
    let body = long_computation().to_string();
    let answer = server.http(::http::Method::POST, "/v1/step", &headers, body.into()).await;
    assert_eq!(answer.status, 400, "{}", answer.text());
    let error = answer.json();
    assert_eq!(error["code"], 3);
    let violations = detail(&error, "BadRequest").unwrap();
    assert_eq!(violations["fieldViolations"][0]["field"], "request-timeout-ms");
    let mut request = tonic::Request::new(missions::message::<v1::StepRequest>(long_computation()));
    request.metadata_mut().insert("grpc-timeout", "0n".parse().unwrap());
    let status = server.grpc().await.step(request).await.unwrap_err();
    // The client's own timer can be the faster one; it says CANCELLED.
    assert!(matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled), "{status}");
}

#[tokio::test(flavor = "multi_thread")]
async fn step_cut_short_by_its_deadline_is_labelled() {
    let server = server().await;
    let id = artifact_id(&server, long_computation()["problem"].clone()).await;
    let mut request = long_computation();
    request.as_object_mut().unwrap().remove("problem");
    request["artifactId"] = json!(id);
    let whole = server.post("/v1/step", &request).await.json();
    let proved = "OPTIMALITY_GLOBAL";
    assert!(whole["certificate"]["optimality"].as_str().unwrap().starts_with(proved), "{whole}");
    let mut cut_short = 0;
    for milliseconds in 1..8 {
        let milliseconds = milliseconds.to_string();
        let headers =
            [("content-type", "application/json"), ("request-timeout-ms", milliseconds.as_str())];
        let body = request.to_string().into();
        let answer = server.http(::http::Method::POST, "/v1/step", &headers, body).await;
        let json = answer.json();
        match answer.status.as_u16() {
            504 => cut_short += 1,
            200 if json["certificate"]["optimality"] == "OPTIMALITY_FEASIBLE" => {
                assert_eq!(json["certificate"]["passed"], true);
                cut_short += 1;
            }
            // In time after all: then it is the very same answer.
            200 => assert_eq!(json, whole),
            _ => panic!("{}", answer.text()),
        }
    }
    assert!(cut_short > 0, "the computation takes longer than a millisecond");
}

#[tokio::test(flavor = "multi_thread")]
async fn step_busy_server_refuses_with_a_time_to_come_back() {
    let config = Config {
        compute_threads: 1,
        compute_wait: Duration::ZERO,
        compute_patient_wait: Duration::ZERO,
        compute_waiting_max: 0,
        ..Config::default()
    };
    let server = server_with(config).await;
    let request = || missions::message::<v1::StepRequest>(long_computation());
    let calls: Vec<_> = (0..8)
        .map(|_| {
            let (client, request) = (server.grpc(), request());
            async move { client.await.step(request).await }
        })
        .collect();
    let outcomes = futures_util::future::join_all(calls).await;
    let refused: Vec<_> = outcomes.iter().filter_map(|outcome| outcome.as_ref().err()).collect();
    assert!(!refused.is_empty(), "eight at once on one thread");
    assert!(outcomes.iter().any(Result::is_ok));
    for status in &refused {
        use tonic_types::StatusExt as _;
        assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
        let delay = status.get_details_retry_info().unwrap().retry_delay.unwrap();
        assert!(delay > Duration::ZERO);
    }
    assert!(server.metric("vbar_compute_refused_total").await >= 1.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn step_cancelled_call_stops_computing() {
    let config = Config { compute_threads: 1, ..Config::default() };
    let server = server_with(config).await;
    let mut client = server.grpc().await;
    let request = missions::message::<v1::StepRequest>(long_computation());
    // How long it takes when nobody interrupts it.
    let start = Instant::now();
    let uninterrupted = client.step(request.clone()).await.unwrap();
    let whole = start.elapsed();
    drop(uninterrupted);
    let call = tokio::spawn(async move { client.step(request).await });
    while server.metric("vbar_computations{").await == 0.0 && !call.is_finished() {
        tokio::time::sleep(Duration::from_micros(200)).await;
    }
    call.abort();
    let start = Instant::now();
    while server.metric("vbar_computations{").await > 0.0 {
        tokio::time::sleep(Duration::from_micros(200)).await;
    }
    assert!(start.elapsed() < whole.max(Duration::from_millis(50)));
    // The one thread is free again.
    let problem = ("problem", missions::double_integrator());
    step(&server, &step_request(problem, linear([20.0, 0.0]))).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn step_horizon_limit_is_the_server_s() {
    let limits = Limits { horizon_max: 59, ..Limits::default() };
    let server = server_with(Config { limits, ..Config::default() }).await;
    let request = json!({ "problem": missions::envisat() });
    let error = server.post("/v1/precompute", &request).await.json();
    assert_eq!(json_fields(&error), ["problem.variable_horizon.horizon_max"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_with_tube_feedback_is_complete() {
    let server = server().await;
    let mut problem = missions::envisat();
    problem["variableHorizon"]["scheme"] = json!("VARIABLE_HORIZON_SCHEME_TUBE_OPTIMAL_CONTROL");
    problem["variableHorizon"]["hill"]["massKg"] = json!(2000.0);
    let request = json!({ "problem": problem, "initial": missions::envisat_start() });
    let answer = server.post("/v1/plans:compute", &request).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let plan = &answer.json()["plan"];
    let commands = plan["commands"].as_array().unwrap();
    assert!(!commands.is_empty());
    let of = |name| commands[0][name].as_array().unwrap()[0].as_f64().unwrap();
    assert!((of("forceN") - 2000.0 * of("accelerationMS2")).abs() < 1e-9);
    assert_eq!(plan["tube"]["halfWidthNd"]["rows"], commands.len() + 1);
    assert_eq!(plan["tube"]["positionHalfWidthM"]["columns"], 3);
    assert_eq!(plan["gain"]["rows"], 3);
    assert_eq!(plan["certificate"]["passed"], true);
    let request: v1::ComputePlanRequest = missions::message(request);
    let over_grpc = server.grpc().await.compute_plan(request).await.unwrap().into_inner();
    assert_eq!(over_grpc, missions::message(answer.json()));
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_validate_only_answers_without_a_plan() {
    let server = server().await;
    let request = json!({
        "problem": missions::envisat(), "initial": missions::envisat_start(), "validateOnly": true,
    });
    let answer = server.post("/v1/plans:compute", &request).await.json();
    assert!(answer.get("plan").is_none() && answer.get("infeasible").is_none(), "{answer}");
    assert_eq!(answer["provenance"]["artifactId"].as_str().unwrap().len(), 64);
}

/// The same mission written along CCSDS LVLH axes: radial = -z, along-track = x, normal = -y.
#[tokio::test(flavor = "multi_thread")]
async fn step_in_lvlh_ccsds_is_the_same_mission() {
    fn turned(v: &Value) -> Value {
        let v: Vec<f64> = serde_json::from_value(v.clone()).unwrap();
        json!([v[1], -v[2], -v[0]])
    }
    let server = server().await;
    let mut problem = missions::envisat();
    let hill = &mut problem["variableHorizon"]["hill"];
    hill["frame"] = json!("FRAME_LVLH_CCSDS");
    hill["capturePointM"] = turned(&hill["capturePointM"]);
    let spin = &mut hill["rotation"]["spin"]["angularVelocityDegS"];
    *spin = turned(spin);
    assert_eq!(
        artifact_id(&server, problem.clone()).await,
        artifact_id(&server, missions::envisat()).await
    );
    let mut measurement = missions::envisat_start();
    let relative = &mut measurement["relative"];
    relative["frame"] = json!("FRAME_LVLH_CCSDS");
    relative["positionM"] = turned(&relative["positionM"]);
    relative["velocityMS"] = turned(&relative["velocityMS"]);
    let lvlh = step(&server, &step_request(("problem", problem), measurement)).await;
    let rtn = step_request(("problem", missions::envisat()), missions::envisat_start());
    assert_eq!(lvlh, step(&server, &rtn).await);
}
