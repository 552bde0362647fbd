//! Abort-safe approaches: steps, phases, failures.

use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::Code;
use vbar_proto::v1::{self, step_response::Verdict, step_stream_response::Result as Streamed};
use vbar_server::Config;

use crate::{
    missions::{at_rest, envisat, envisat_start, message, predicted, station},
    support::{Server, grpc_fields, json_fields, server, server_with, step_request},
};

async fn precomputed(server: &Server, problem: &Value) -> Value {
    let answer = server.post("/v1/precompute", &json!({ "problem": problem })).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let operation = answer.json();
    assert_eq!(operation["done"], true, "{operation}");
    operation["response"]["artifact"].clone()
}

async fn station_id(server: &Server) -> Value {
    precomputed(server, &station()).await["artifactId"].clone()
}

fn diagnostics(answer: &v1::StepResponse) -> &v1::AbortSafeDiagnostics {
    match &answer.diagnostics {
        Some(v1::step_response::Diagnostics::AbortSafe(diagnostics)) => diagnostics,
        other => panic!("{other:?}"),
    }
}

/// One step over gRPC.
async fn step(server: &Server, id: &Value, measurement: Value, state: &[u8]) -> v1::StepResponse {
    let mut request = step_request(("artifactId", id.clone()), measurement);
    request.controller_state = state.to_vec().into();
    server.grpc().await.step(request).await.unwrap().into_inner()
}

fn with_working(mut measurement: Value, indices: &[i32]) -> Value {
    measurement["workingThrusters"] = json!({ "indices": indices });
    measurement
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_step_is_the_same_over_both_transports() {
    let server = server().await;
    let request = json!({ "problem": station(), "measurement": at_rest(5000.0) });
    let answer = server.post("/v1/step", &request).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let over_http: v1::StepResponse = message(answer.json());
    let over_grpc = server.grpc().await.step(message::<v1::StepRequest>(request)).await;
    assert_eq!(over_http, over_grpc.unwrap().into_inner());
    let Some(Verdict::Command(command)) = &over_http.verdict else { panic!("{over_http:?}") };
    assert_eq!((command.frame(), command.duration_s), (v1::Frame::Rtn, Some(30.0)));
    for (force, acceleration) in command.force_n.iter().zip(&command.acceleration_m_s2) {
        assert!((force - 4000.0 * acceleration).abs() <= 1e-12 * force.abs());
    }
    assert!(over_http.certificate.as_ref().unwrap().passed);
    let prediction = over_http.prediction.as_ref().unwrap();
    assert_eq!(prediction.positions_m.as_ref().unwrap().rows, 31);
    assert_eq!(prediction.accelerations_m_s2.as_ref().unwrap().rows, 30);
    let how = diagnostics(&over_http);
    assert_eq!((how.phase_index, how.softened), (0, false));
    // 5000 m along the orbit, 2000 m of them inside the ellipsoid.
    assert!((how.distance_m - 3000.0).abs() < 1e-6, "{}", how.distance_m);
    let next = how.next_state.as_ref().unwrap();
    assert_eq!((next.step_index, next.modes.len(), next.modes_found), (1, 1, 1));
    assert_eq!(next.modes[0].working_thrusters, Some(v1::WorkingThrusters::default()));
    let drift = next.drift.as_ref().unwrap();
    assert!(drift.linear.unwrap().safe_at_instants && drift.two_body.unwrap().safe_throughout);
    assert_eq!(drift.linear.unwrap().time_to_violation_s, None);
    let provenance = over_http.provenance.as_ref().unwrap();
    assert_eq!(provenance.method, "abort_safe");
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_artifact_says_what_was_made_and_warns() {
    let server = server().await;
    let artifact = precomputed(&server, &station()).await;
    let summary = &artifact["abortSafe"];
    assert_eq!(summary["stepsPerPeriod"], 1, "{summary}");
    let too_slow = |summary: &Value| {
        let warnings = summary["warnings"].as_array().unwrap().iter();
        let texts: Vec<&str> = warnings.map(|text| text.as_str().unwrap()).collect();
        texts.iter().any(|text| text.starts_with("phases[2]") && text.contains("than 6 m/s"))
    };
    assert!(!too_slow(summary), "{summary}");
    // 5 m/s for 30 s are more than the 40 m that the box is wide.
    assert_eq!(summary["phases"][2]["crossesUnseenM"], 150.0);
    let phases = summary["phases"].as_array().unwrap();
    assert_eq!((&phases[0]["sets"], &phases[1]["sets"]), (&json!("61"), &json!("61")));
    assert_eq!(phases[2]["modes"], 8);
    assert_eq!(phases[2]["dominatingModes"][7]["indices"], json!([7]));
    // Faster approaches than the 6 m/s that being in the box counts up to.
    let mut faster = station();
    faster["abortSafe"]["fastestApproachMS"] = json!(10.0);
    let summary = precomputed(&server, &faster).await["abortSafe"].clone();
    assert_eq!(summary["phases"][2]["hidesApproachesAboveMS"], 6.0);
    assert!(too_slow(&summary), "{summary}");
    let request = json!({ "problem": faster, "measurement": at_rest(100.0) });
    let answer = server.post("/v1/step", &request).await.json();
    assert_eq!(answer["abortSafe"]["warnings"], summary["warnings"], "{answer}");
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_phases_advance_and_never_go_back() {
    let server = server().await;
    let id = station_id(&server).await;
    let mut state = Vec::new();
    for (k, (along_track_m, phase)) in
        [(2500.0, 0), (2100.0, 1), (240.0, 2), (2100.0, 2), (45.0, 3)].into_iter().enumerate()
    {
        let answer = step(&server, &id, at_rest(along_track_m), &state).await;
        assert_eq!(diagnostics(&answer).phase_index, phase, "at {along_track_m} m");
        assert_eq!(usize::try_from(answer.step_index), Ok(k));
        state = answer.controller_state.to_vec();
    }
    let answer = step(&server, &id, at_rest(4.0), &state).await;
    let Some(Verdict::Arrived(arrival)) = &answer.verdict else { panic!("{answer:?}") };
    assert_eq!((arrival.completion_steps, arrival.distance_m), (5, Some(4.0)));
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_stream_answers_like_step() {
    let server = server().await;
    let (ask, asked) = mpsc::channel(4);
    let mut client = server.grpc().await;
    let mut answers = client.step_stream(ReceiverStream::new(asked)).await.unwrap().into_inner();
    let mut measurement = at_rest(5000.0);
    let (mut state, id) = (Vec::new(), station_id(&server).await);
    for k in 0..3 {
        let mut request = json!({ "measurement": measurement });
        if k == 0 {
            request["problem"] = station();
        }
        ask.send(message(request)).await.unwrap();
        let answer = match answers.next().await.unwrap().unwrap().result {
            Some(Streamed::Response(answer)) => answer,
            other => panic!("{other:?}"),
        };
        assert_eq!(answer, step(&server, &id, measurement.clone(), &state).await);
        state = answer.controller_state.to_vec();
        measurement = predicted(&answer, 30.0 * f64::from(k + 1));
    }
}

/// d/dt of (position, velocity) near a circular orbit with mean motion n under an acceleration:
/// Hill's equations in RTN.
fn hill(n: f64, x: &[f64; 6], acceleration: [f64; 3]) -> [f64; 6] {
    let [a, b, c] = acceleration;
    [
        x[3],
        x[4],
        x[5],
        3.0 * n * n * x[0] + 2.0 * n * x[4] + a,
        -2.0 * n * x[3] + b,
        -n * n * x[2] + c,
    ]
}

/// Runge-Kutta's fourth order over one second.
fn second_later(n: f64, x: &[f64; 6], acceleration: [f64; 3]) -> [f64; 6] {
    let along = |k: &[f64; 6], h: f64| std::array::from_fn(|i| x[i] + h * k[i]);
    let k1 = hill(n, x, acceleration);
    let k2 = hill(n, &along(&k1, 0.5), acceleration);
    let k3 = hill(n, &along(&k2, 0.5), acceleration);
    let k4 = hill(n, &along(&k3, 1.0), acceleration);
    std::array::from_fn(|i| x[i] + (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]) / 6.0)
}

/// States at the samples of an abort, flown by equations that guidance does not know.
fn flown(start: [f64; 6], sequence: &v1::AbortSequence) -> Vec<[f64; 6]> {
    let n = (3.986_004_418e14 / 6_726_270.0_f64.powi(3)).sqrt();
    let forces = &sequence.forces_n.as_ref().unwrap().values;
    let mut x = start;
    let mut states = vec![x];
    for step in 0..usize::try_from(sequence.horizon_steps).unwrap() {
        let force = |axis: usize| forces.get(3 * step + axis).map_or(0.0, |f| f / 4000.0);
        for _ in 0..30 {
            x = second_later(n, &x, [force(0), force(1), force(2)]);
        }
        states.push(x);
    }
    states
}

fn outside_the_box(x: &[f64; 6]) -> bool {
    x[..3].iter().any(|p| p.abs() >= 20.0) || x[3..].iter().any(|v| v.abs() >= 6.0)
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_failure_is_answered_by_an_abort_that_keeps_out() {
    let server = server().await;
    let id = station_id(&server).await;
    let towards = |y: f64, speed: f64| {
        json!({ "relative": {
            "frame": "FRAME_RTN", "positionM": [0.0, y, 0.0], "velocityMS": [0.0, speed, 0.0],
        } })
    };
    // 60 m away and closing with 0.15 m/s, only the thruster along (-1, -1, -1) is left: free drift
    // would be in the box five minutes later.
    let failed = with_working(towards(60.0, -0.15), &[7]);
    let answer = step(&server, &id, failed, &[]).await;
    let Some(Verdict::Abort(abort)) = &answer.verdict else { panic!("{answer:?}") };
    assert_eq!(abort.reason(), v1::AbortReason::Failure);
    assert_eq!(abort.origin(), v1::AbortOrigin::Searched);
    assert_eq!(abort.working_thrusters.as_ref().unwrap().indices, [7]);
    assert_eq!(diagnostics(&answer).phase_index, 2);
    let sequence = abort.sequence.as_ref().unwrap();
    assert_eq!((sequence.horizon_steps, sequence.step_s), (46, 30.0));
    let throttles = sequence.throttles.as_ref().unwrap();
    for row in throttles.values.chunks(8) {
        assert!(row[..7].iter().all(|&throttle| throttle == 0.0) && (0.0..=1.0).contains(&row[7]));
    }
    let start = [0.0, 60.0, 0.0, 0.0, -0.15, 0.0];
    for (k, x) in flown(start, sequence).iter().enumerate() {
        assert!(outside_the_box(x), "sample {k}: {x:?}");
    }
    let idle = v1::AbortSequence { forces_n: Some(v1::Matrix::default()), ..sequence.clone() };
    assert!(flown(start, &idle).iter().any(|x| !outside_the_box(x)), "drift is no abort here");
    // The command of now is the start of the sequence.
    let command = abort.command.as_ref().unwrap();
    assert_eq!(command.force_n, sequence.forces_n.as_ref().unwrap().values[..3]);
    // One step on, the abort goes on.
    let after = flown(start, sequence)[1];
    let measured = json!({ "relative": {
        "frame": "FRAME_RTN", "positionM": after[..3], "velocityMS": after[3..],
    } });
    let state = answer.controller_state.to_vec();
    let answer = step(&server, &id, with_working(measured, &[7]), &state).await;
    let Some(Verdict::Abort(abort)) = &answer.verdict else { panic!("{answer:?}") };
    assert_eq!((abort.reason(), abort.began_step_index), (v1::AbortReason::UnderWay, 0));
    let rest = abort.sequence.as_ref().unwrap();
    assert!(flown(after, rest).iter().all(outside_the_box), "{rest:?}");
    let aborts = server.metric(r#"vbar_verdicts_total{outcome="abort"}"#).await;
    assert_eq!(aborts, 2.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_total_failure_in_a_passive_phase_is_drift() {
    let server = server().await;
    let id = station_id(&server).await;
    let answer = step(&server, &id, with_working(at_rest(5000.0), &[]), &[]).await;
    let Some(Verdict::Abort(abort)) = &answer.verdict else { panic!("{answer:?}") };
    let sequence = abort.sequence.as_ref().unwrap();
    assert_eq!((sequence.throttles.as_ref().unwrap().rows, sequence.horizon_steps), (0, 60));
    assert_eq!(abort.command.as_ref().unwrap().force_n, [0.0; 3]);
    assert!(sequence.margin > 0.0 && sequence.closest_distance_m > 2000.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_start_in_an_unsafe_set_is_named_with_a_way_out() {
    let server = server().await;
    let id = station_id(&server).await;
    // 300 m from the approach ellipsoid at 12 m/s towards it.
    let doomed = json!({ "relative": {
        "frame": "FRAME_RTN", "positionM": [0.0, 2300.0, 0.0], "velocityMS": [0.0, -12.0, 0.0],
    } });
    let answer = step(&server, &id, doomed, &[]).await;
    let Some(Verdict::Infeasible(why)) = &answer.verdict else { panic!("{answer:?}") };
    assert!(!why.reason.is_empty(), "{why:?}");
    let found = diagnostics(&answer).unsafe_state.as_ref().unwrap();
    assert_eq!(found.working_thrusters, Some(v1::WorkingThrusters::default()));
    // 300 m at 12 m/s: inside one sample later.
    assert_eq!(found.time_to_violation_s, 30.0);
    assert!(found.gauge < 1.0, "{found:?}");
    let outside = found.outside.as_ref().expect("a state near it that is safe");
    let measurement = json!({ "relative": {
        "frame": "FRAME_RTN",
        "positionM": outside.position_m,
        "velocityMS": outside.velocity_m_s,
    } });
    let answer = step(&server, &id, measurement, &[]).await;
    assert_eq!(diagnostics(&answer).unsafe_state, None, "{answer:?}");
    assert!(matches!(answer.verdict, Some(Verdict::Command(_))), "{answer:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_bytes_do_not_depend_on_the_threads() {
    let mut bytes = Vec::new();
    for compute_threads in [1, 2] {
        let server = server_with(Config { compute_threads, ..Config::default() }).await;
        let failed = with_working(at_rest(100.0), &[3]);
        let mut decided = Vec::new();
        for measurement in [at_rest(5000.0), at_rest(100.0), failed] {
            let request = step_request(("problem", station()), measurement);
            decided.push(server.grpc().await.step(request).await.unwrap().into_inner());
        }
        // With the digest of the artifact, in the provenance.
        bytes.push(decided);
    }
    assert_eq!(bytes[0], bytes[1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn abort_safe_measurements_that_do_not_fit_are_named() {
    let server = server().await;
    let id = station_id(&server).await;
    let linear = json!({ "linear": { "components": [1.0, 2.0] } });
    let late = json!({ "elapsedS": 31.0, "relative": at_rest(100.0)["relative"] });
    for (measurement, field) in [
        (with_working(at_rest(100.0), &[8]), "measurement.working_thrusters"),
        (with_working(at_rest(100.0), &[16]), "measurement.working_thrusters.indices[0]"),
        (with_working(at_rest(100.0), &[2, 1]), "measurement.working_thrusters.indices[1]"),
        (with_working(at_rest(100.0), &[-1]), "measurement.working_thrusters.indices[0]"),
        (linear, "measurement"),
        (late, "measurement.elapsed_s"),
    ] {
        let request = json!({ "artifactId": id, "measurement": measurement });
        let answer = server.post("/v1/step", &request).await;
        assert_eq!(answer.status, 400, "{field}: {}", answer.text());
        assert_eq!(json_fields(&answer.json()), [field]);
        let status = server.grpc().await.step(message::<v1::StepRequest>(request)).await;
        assert_eq!(grpc_fields(&status.unwrap_err()), [field]);
    }
    // A method that does not know of failures does not ignore one.
    let request = step_request(("problem", envisat()), with_working(envisat_start(), &[0]));
    let status = server.grpc().await.step(request).await.unwrap_err();
    assert_eq!(grpc_fields(&status), ["measurement.working_thrusters"]);
    // And there is no plan of a mission that is decided step by step.
    let request = json!({ "problem": station(), "initial": at_rest(5000.0) });
    let answer = server.post("/v1/plans:compute", &request).await;
    assert_eq!(
        (answer.status.as_u16(), json_fields(&answer.json())),
        (400, vec!["problem".into()])
    );
    let status = server.grpc().await.compute_plan(message::<v1::ComputePlanRequest>(request)).await;
    assert_eq!(status.unwrap_err().code(), Code::InvalidArgument);
}
