//! HTTP itself: paths, methods, types, probes, documents.

use ::http::Method;
use bytes::Bytes;
use serde_json::json;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};

use crate::{
    missions,
    support::{detail, json_fields, server},
};

const JSON: (&str, &str) = ("content-type", "application/json");

#[tokio::test(flavor = "multi_thread")]
async fn http_unknown_path_is_a_status() {
    let server = server().await;
    let answer = server.get("/v1/nothing").await;
    assert_eq!(answer.status, 404);
    let error = answer.json();
    assert_eq!(error["code"], 5);
    assert_eq!(detail(&error, "ErrorInfo").unwrap()["reason"], "PATH_UNKNOWN");
}

#[tokio::test(flavor = "multi_thread")]
async fn http_wrong_method_says_which_are_right() {
    let server = server().await;
    let step = server.get("/v1/step").await;
    assert_eq!((step.status.as_u16(), step.headers["allow"].as_str()), (405, "POST"));
    assert_eq!(step.json()["code"], 12);
    let id = "0".repeat(64);
    for (method, path) in [
        (Method::PUT, format!("/v1/artifacts/{id}")),
        (Method::PATCH, format!("/v1/operations/{id}")),
        (Method::POST, format!("/v1/operations/{id}")),
        (Method::DELETE, "/healthz".to_owned()),
    ] {
        let answer = server.http(method, &path, &[], Bytes::new()).await;
        assert_eq!(answer.status, 405, "{path}");
        assert!(answer.headers["allow"].contains("GET"), "{path}");
        assert_eq!(answer.json()["code"], 12);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn http_only_plain_json_is_taken() {
    let server = server().await;
    let post = async |headers: &[(&str, &str)]| {
        server.http(Method::POST, "/v1/step", headers, "{}".into()).await
    };
    let form = post(&[("content-type", "application/x-www-form-urlencoded")]).await;
    assert_eq!(
        (form.status.as_u16(), json_fields(&form.json())),
        (415, vec!["content-type".into()])
    );
    assert_eq!(post(&[]).await.status, 415);
    let packed = post(&[JSON, ("content-encoding", "gzip")]).await;
    assert_eq!(packed.status, 415);
    assert_eq!(json_fields(&packed.json()), ["content-encoding"]);
    // The type is right, the message is not.
    assert_eq!(post(&[("content-type", "Application/JSON; charset=utf-8")]).await.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_truncated_json_is_named_with_line_and_column() {
    let server = server().await;
    let good = serde_json::to_string_pretty(&json!({ "problem": missions::envisat() })).unwrap();
    for length in [0, 1, 100, good.len() / 2, good.len() - 1] {
        let body = Bytes::copy_from_slice(&good.as_bytes()[..length]);
        let answer = server.http(Method::POST, "/v1/precompute", &[JSON], body).await;
        assert_eq!(answer.status, 400);
        let error = answer.json();
        assert_eq!(error["code"], 3);
        let message = error["message"].as_str().unwrap();
        assert!(message.contains("line") && message.contains("column"), "{message}");
    }
    let unknown = json!({ "problem": missions::envisat(), "keepOutZone": {} });
    let error = server.post("/v1/precompute", &unknown).await.json();
    assert!(error["message"].as_str().unwrap().contains("keepOutZone"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn http_body_cut_off_does_not_hurt() {
    let server = server().await;
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    let head = "POST /v1/step HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n\
                content-length: 1000\r\n\r\n{\"measurement\"";
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.shutdown().await.unwrap();
    let mut answer = String::new();
    // Either a 400 or a closed connection; both end the request.
    let _ = stream.read_to_string(&mut answer).await;
    assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 400"), "{answer}");
    assert_eq!(server.get("/healthz").await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_request_id_is_echoed_and_in_errors() {
    let server = server().await;
    let headers = [JSON, ("x-request-id", "notebook-7")];
    let answer = server.http(Method::POST, "/v1/step", &headers, "{}".into()).await;
    assert_eq!(answer.headers["x-request-id"], "notebook-7");
    assert_eq!(detail(&answer.json(), "RequestInfo").unwrap()["requestId"], "notebook-7");
    let unnamed = server.get("/v1/info").await;
    assert_eq!(unnamed.headers["x-request-id"].len(), 32);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_deadline_header_must_be_a_number() {
    let server = server().await;
    for bad in ["soon", "-1", "1.5", ""] {
        let headers = [("request-timeout-ms", bad)];
        let answer = server.http(Method::GET, "/v1/info", &headers, Bytes::new()).await;
        assert_eq!(answer.status, 400, "{bad:?}");
        assert_eq!(json_fields(&answer.json()), ["request-timeout-ms"]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn http_queries_are_checked() {
    let server = server().await;
    assert_eq!(json_fields(&server.get("/v1/info?x=1").await.json()), ["query"]);
    assert_eq!(json_fields(&server.get("/v1/operations?page=1").await.json()), ["query"]);
    let bad = server.get("/v1/operations?pageSize=-1&page_token=zz&filter=done").await;
    assert_eq!(bad.status, 400);
    assert_eq!(json_fields(&bad.json()), ["filter", "page_token", "page_size"]);
    assert_eq!(server.get("/v1/operations?pageSize=5").await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_probes_answer() {
    let server = server().await;
    assert_eq!(server.get("/healthz").await.text(), "alive\n");
    assert_eq!(server.get("/readyz").await.text(), "ready\n");
    assert_eq!(server.get("/readyz/steps").await.text(), "ready\n");
}

#[tokio::test(flavor = "multi_thread")]
async fn http_info_shows_limits_and_methods() {
    let server = server().await;
    let info = server.get("/v1/info").await.json();
    assert_eq!(info["methods"][0]["name"], "variable_horizon");
    assert_eq!(info["limits"]["requestBytesMax"], (4 << 20).to_string());
    assert_eq!(info["limits"]["horizonMax"], 500);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_metrics_move() {
    let server = server().await;
    let refused = r#"vbar_requests_total{method="Step",transport="http",code="INVALID_ARGUMENT"}"#;
    assert_eq!(server.metric(refused).await, 0.0);
    for count in 1..4 {
        server.post("/v1/step", &json!({})).await;
        assert_eq!(server.metric(refused).await, f64::from(count));
    }
    let text = server.get("/metrics").await;
    assert!(text.headers["content-type"].starts_with("application/openmetrics-text"));
    assert!(text.text().ends_with("# EOF\n"));
}

#[tokio::test(flavor = "multi_thread")]
async fn http_openapi_lists_every_route_and_only_those() {
    let server = server().await;
    let document = server.get("/openapi.json").await.json();
    assert_eq!(document["openapi"], "3.1.0");
    let paths = document["paths"].as_object().unwrap();
    assert_eq!(paths.len(), 21);
    let id = "0".repeat(64);
    for (path, methods) in paths {
        for method in methods.as_object().unwrap().keys() {
            let method = Method::from_bytes(method.to_uppercase().as_bytes()).unwrap();
            let path = path.replace("{id}", &id);
            let answer = server.http(method.clone(), &path, &[JSON], Bytes::new()).await;
            let documented = &methods[method.as_str().to_lowercase()]["responses"];
            let status = answer.status.as_str();
            assert!(documented.get(status).is_some(), "{method} {path} answered {status}");
            // 404 only where an artifact or operation is unknown, never because of the path.
            if answer.status == 404 {
                let error = answer.json();
                let reason = &detail(&error, "ErrorInfo").unwrap()["reason"];
                assert_ne!(reason, "PATH_UNKNOWN", "{method} {path}");
            }
        }
    }
}
