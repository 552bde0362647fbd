//! Bearer tokens and roles.

use std::time::Duration;

use serde_json::Value;
use tonic::Code;
use vbar_client::{Client, v1::step_stream_request::Controller};
use vbar_proto::DESCRIPTORS;
use vbar_server::AccessOptions;

use super::{
    authority::{Files, token_entry},
    callers::{Server, until},
};
use crate::nodes::envisat;

const ROLES: [&str; 4] = ["plan", "step", "precompute", "admin"];
const INFO: &str = "/vbar.v1.GuidanceService/GetServerInfo";

/// Which role each RPC needs, written a second time on purpose.
fn role_of(rpc: &str) -> Option<&'static str> {
    match rpc {
        "Step" | "StepStream" | "SafetyReport" => Some("step"),
        "ComputePlan" | "UploadPlan" | "GetPlan" | "ListPlans" | "ExportPlan" => Some("plan"),
        "Precompute" | "GetArtifact" | "ListArtifacts" | "DownloadArtifact" | "GetOperation"
        | "ListOperations" | "WaitOperation" | "CancelOperation" => Some("precompute"),
        "DeleteOperation" => Some("admin"),
        "GetServerInfo" => None,
        other => panic!("nobody has said which role {other} needs"),
    }
}

/// A token for each role, `vbar_<role>`, one without any, `vbar_none`, and one of the past.
fn names() -> String {
    let with_roles = ROLES.map(|role| token_entry(role, &format!("vbar_{role}"), &[role], ""));
    with_roles.concat()
        + &token_entry("none", "vbar_none", &[], "")
        + &token_entry("past", "vbar_past", &["admin"], "expires = 2026-01-01T00:00:00Z")
}

async fn server(files: &Files) -> Server {
    let tokens_file = Some(files.write("tokens.toml", names()));
    let credentials_poll = Duration::from_millis(20);
    Server::start(AccessOptions { tokens_file, credentials_poll, ..AccessOptions::default() }).await
}

#[tokio::test(flavor = "multi_thread")]
async fn token_missing_wrong_expired_or_misplaced_is_refused_alike_over_both_transports() {
    let files = Files::new();
    let server = server(&files).await;
    let long = format!("Bearer {}", "x".repeat(10_000));
    let cases: [(&[(&str, &str)], &str); 9] = [
        (&[], "CREDENTIAL_MISSING"),
        (&[("authorization", "Bearer vbar_wrong")], "CREDENTIAL_UNKNOWN"),
        (&[("authorization", "Bearer vbar_past")], "CREDENTIAL_EXPIRED"),
        (&[("authorization", "Basic dmJhcl9zdGVwOg==")], "CREDENTIAL_UNREADABLE"),
        (&[("authorization", "vbar_step")], "CREDENTIAL_UNREADABLE"),
        (&[("authorization", "Bearer vbar_step vbar_plan")], "CREDENTIAL_UNREADABLE"),
        (&[("authorization", &long)], "CREDENTIAL_UNREADABLE"),
        (
            &[("authorization", "Bearer vbar_step"), ("authorization", "Bearer vbar_plan")],
            "CREDENTIAL_UNREADABLE",
        ),
        (&[("x-token", "vbar_step"), ("cookie", "token=vbar_step")], "CREDENTIAL_MISSING"),
    ];
    for (headers, reason) in cases {
        let answer = server.get("/v1/info", headers).await;
        assert_eq!((answer.status, answer.reason().as_str()), (401, reason), "{headers:?}");
        assert_eq!(answer.header("www-authenticate"), Some("Bearer realm=\"vbar\""));
        let error: Value = serde_json::from_str(&answer.body).unwrap();
        assert_eq!(error["code"], 16);
        assert!(error["details"][1]["requestId"].is_string(), "{error}");

        let status = server.grpc(INFO, headers).await;
        assert_eq!(status.code(), Code::Unauthenticated, "{headers:?} {status}");
        let info = tonic_types::StatusExt::get_details_error_info(&status).unwrap();
        assert_eq!((info.reason.as_str(), info.domain.as_str()), (reason, "vbar"), "{headers:?}");
    }
    for path in ["/v1/info?access_token=vbar_step", "/v1/info?authorization=Bearer%20vbar_step"] {
        assert_eq!(server.get(path, &[]).await.status, 401, "{path}");
    }
    // A header that no text is; and one larger than all headers may be together.
    let not_text = server.get("/v1/info", &[("authorization", "Bearer \u{fc}")]).await;
    assert_eq!(not_text.status, 401);
    let huge = "x".repeat(1_000_000);
    let huge = server.get("/v1/info", &[("authorization", &huge)]).await;
    assert_eq!(huge.status, 431);
    assert_eq!(server.get("/v1/info", &[("Authorization", "bearer vbar_step")]).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn role_decides_over_every_rpc_and_every_path() {
    let files = Files::new();
    let server = server(&files).await;
    let id = "0".repeat(64);
    let paths = [
        ("POST", "/v1/step".to_owned(), "Step"),
        ("POST", "/v1/safety:report".to_owned(), "SafetyReport"),
        ("POST", "/v1/plans:compute".to_owned(), "ComputePlan"),
        ("POST", "/v1/plans".to_owned(), "UploadPlan"),
        ("GET", "/v1/plans".to_owned(), "ListPlans"),
        ("GET", format!("/v1/plans/{id}"), "GetPlan"),
        ("GET", format!("/v1/plans/{id}:export"), "ExportPlan"),
        ("POST", "/v1/precompute".to_owned(), "Precompute"),
        ("GET", "/v1/artifacts".to_owned(), "ListArtifacts"),
        ("GET", format!("/v1/artifacts/{id}"), "GetArtifact"),
        ("GET", format!("/v1/artifacts/{id}:download"), "DownloadArtifact"),
        ("GET", "/v1/operations".to_owned(), "ListOperations"),
        ("GET", format!("/v1/operations/{id}"), "GetOperation"),
        ("GET", format!("/v1/operations/{id}:watch"), "GetOperation"),
        ("POST", format!("/v1/operations/{id}:wait"), "WaitOperation"),
        ("POST", format!("/v1/operations/{id}:cancel"), "CancelOperation"),
        ("DELETE", format!("/v1/operations/{id}"), "DeleteOperation"),
        ("GET", "/v1/info".to_owned(), "GetServerInfo"),
    ];
    let rpcs: Vec<_> = DESCRIPTORS
        .services()
        .flat_map(|service| service.methods().collect::<Vec<_>>())
        .map(|rpc| (format!("/{}/{}", rpc.parent_service().full_name(), rpc.name()), rpc))
        .collect();
    for held in ROLES.into_iter().chain(["none"]) {
        let bearer = format!("Bearer vbar_{held}");
        let headers = [("authorization", bearer.as_str())];
        let may = |rpc: &str| role_of(rpc).is_none_or(|needed| held == needed || held == "admin");
        for (path, rpc) in &rpcs {
            let status = server.grpc(path, &headers).await;
            let denied = status.code() == Code::PermissionDenied;
            assert_eq!(!denied, may(rpc.name()), "{held} asks for {path}: {status}");
            assert_ne!(status.code(), Code::Unauthenticated, "{held} asks for {path}");
            if denied {
                let needed = format!("needs the role {}", role_of(rpc.name()).unwrap());
                assert!(status.message().contains(&needed), "{status}");
            }
        }
        for (method, path, rpc) in &paths {
            let answer = server.http(method, path, &headers, "{}").await;
            assert_eq!(answer.status != 403, may(rpc), "{held} asks for {path}: {answer:?}");
            if answer.status == 403 {
                assert_eq!(answer.reason(), "ROLE_MISSING");
                let needed = format!("needs the role {}", role_of(rpc).unwrap());
                assert!(answer.body.contains(&needed), "{answer:?}");
            }
        }
        // A path that only seems to be one of those is none of them.
        for trick in ["%3Acancel", ":cancel/../x", "/", "%2F"] {
            let path = format!("/v1/operations/{id}{trick}");
            let answer = server.http("POST", &path, &headers, "{}").await;
            assert_eq!(answer.status, 404, "{held} {path}: {answer:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn probes_are_open_and_everything_else_wants_to_know_who_asks() {
    let files = Files::new();
    let server = server(&files).await;
    for path in ["/healthz", "/readyz"] {
        assert_eq!(server.get(path, &[]).await.status, 200, "{path}");
    }
    let health = "/grpc.health.v1.Health/Check";
    assert_eq!(server.grpc(health, &[]).await.code(), Code::Ok);
    let reflection = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
    for method in [reflection, "/vbar.v1.GuidanceService/Nothing", "/none.Such/Call"] {
        assert_eq!(server.grpc(method, &[]).await.code(), Code::Unauthenticated, "{method}");
    }
    let known = [("authorization", "Bearer vbar_none")];
    for (path, status) in [("/metrics", 200), ("/openapi.json", 200), ("/nothing", 404)] {
        assert_eq!(server.get(path, &[]).await.status, 401, "{path}");
        assert_eq!(server.get(path, &known).await.status, status, "{path}");
    }
    let status = server.grpc(reflection, &known).await;
    assert_ne!(status.code(), Code::Unauthenticated, "{status}");
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_carry_nothing_that_lets_another_site_read_them() {
    let files = Files::new();
    let server = server(&files).await;
    let origin = ("origin", "https://elsewhere.example");
    let asks = ("access-control-request-method", "POST");
    let token = ("authorization", "Bearer vbar_step");
    for answer in [
        server.http("OPTIONS", "/v1/step", &[origin, asks], "").await,
        server.http("OPTIONS", "/v1/step", &[origin, asks, token], "").await,
        server.get("/v1/info", &[origin, token]).await,
        server.get("/healthz", &[origin]).await,
    ] {
        assert!(!answer.head.contains("access-control-"), "{}", answer.head);
    }
    let asked = server.http("OPTIONS", "/v1/step", &[origin, asks], "").await;
    assert_eq!(asked.status, 401);
}

/// Opens a closed loop and decides its first step.
async fn in_flight(client: &Client) -> vbar_client::ClosedLoop {
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let mut flight = client.closed_loop(Controller::Problem(mission.problem)).await.unwrap();
    flight.step(start).await.unwrap();
    flight
}

#[tokio::test(flavor = "multi_thread")]
async fn tokens_change_while_calls_run_and_one_taken_away_ends_its_closed_loops() {
    let files = Files::new();
    let server = server(&files).await;
    let kept = server.client_with("vbar_none").await;
    let calls = tokio::spawn({
        let kept = kept.clone();
        async move {
            loop {
                kept.server_info().await.expect("a token that stays goes on");
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        }
    });
    let taken = server.client_with("vbar_step").await;
    let mut flight = in_flight(&taken).await;

    files.write("tokens.toml", names() + &token_entry("new", "vbar_new", &[], ""));
    let new = server.client_with("vbar_new").await;
    until("the new token is known", async || new.server_info().await.is_ok()).await;

    let refused = async || {
        let outcome = "vbar_credential_reloads_total{outcome=\"refused\"}";
        server.metric(outcome, &[("authorization", "Bearer vbar_none")]).await
    };
    files.write("tokens.toml", "[[token]]\nname = 'half");
    until("the bad file is seen", async || refused().await == 1.0).await;
    assert!(new.server_info().await.is_ok(), "what was good before stays");

    let without = names().replace("name = 'step'", "name = 'step'\nexpires = 2026-01-01T00:00:00Z");
    files.write("tokens.toml", without);
    until("the token is taken away", async || taken.server_info().await.is_err()).await;
    let error = taken.server_info().await.unwrap_err();
    assert_eq!(error.code, Code::Unauthenticated, "{error}");
    let error = flight.step(envisat().fixed_start().unwrap()).await.unwrap_err();
    assert_eq!(error.code, Code::Unauthenticated, "{error}");

    assert!(!calls.is_finished(), "a call failed");
    calls.abort();
}
