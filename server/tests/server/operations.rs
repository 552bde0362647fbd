//! Long-running operations and artifacts.

use ::http::Method;
use bytes::Bytes;
use prost::Message as _;
use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::{
    google::longrunning::{
        CancelOperationRequest, DeleteOperationRequest, GetOperationRequest, ListOperationsRequest,
        Operation, WaitOperationRequest, operation, operations_client::OperationsClient,
    },
    v1,
};
use vbar_server::{Config, StoreLocation};

use crate::{
    missions,
    support::{Server, detail, server, server_with, step_request},
};

async fn precompute(server: &Server, problem: &Value) -> Operation {
    let request: v1::PrecomputeRequest = missions::message(json!({ "problem": problem }));
    server.grpc().await.precompute(request).await.unwrap().into_inner()
}

fn artifact(operation: &Operation) -> v1::Artifact {
    let Some(operation::Result::Response(response)) = &operation.result else {
        panic!("{operation:?}");
    };
    assert_eq!(response.type_url, "type.googleapis.com/vbar.v1.PrecomputeResponse");
    let response = v1::PrecomputeResponse::decode(response.value.as_slice()).unwrap();
    match response.outcome {
        Some(v1::precompute_response::Outcome::Artifact(artifact)) => artifact,
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_of_a_precompute_can_be_asked_for_everywhere() {
    let server = server().await;
    let made = precompute(&server, &missions::double_integrator()).await;
    assert!(made.done);
    let artifact = artifact(&made);
    assert_eq!(made.name, format!("operations/{}", artifact.artifact_id));
    // The same problem is the same operation.
    assert_eq!(precompute(&server, &missions::double_integrator()).await, made);
    let mut client = OperationsClient::new(server.channel().await);
    let name = made.name.clone();
    let got = client.get_operation(GetOperationRequest { name: name.clone() }).await.unwrap();
    assert_eq!(got.into_inner(), made);
    let wait = WaitOperationRequest { name: name.clone(), timeout: None };
    assert_eq!(client.wait_operation(wait).await.unwrap().into_inner(), made);
    let list = client.list_operations(ListOperationsRequest::default()).await.unwrap();
    assert_eq!(list.into_inner().operations, [made]);
    assert!(client.cancel_operation(CancelOperationRequest { name: name.clone() }).await.is_ok());
    let deleted = client.delete_operation(DeleteOperationRequest { name: name.clone() }).await;
    assert_eq!(deleted.unwrap_err().code(), Code::Unimplemented);
    let got = client.get_operation(GetOperationRequest { name }).await;
    assert!(got.is_ok(), "delete must not have deleted");
}

#[tokio::test(flavor = "multi_thread")]
async fn operation_over_http_is_the_same() {
    let server = server().await;
    let request = json!({ "problem": missions::double_integrator() });
    let made = server.post("/v1/precompute", &request).await;
    assert_eq!(made.status, 200, "{}", made.text());
    let made = made.json();
    assert_eq!(made["done"], true);
    let name = made["name"].as_str().unwrap();
    assert_eq!(server.get(&format!("/v1/{name}")).await.json(), made);
    let post = async |path: String| server.http(Method::POST, &path, &[], Bytes::new()).await;
    assert_eq!(post(format!("/v1/{name}:wait")).await.json(), made);
    assert_eq!(post(format!("/v1/{name}:cancel")).await.json(), json!({}));
    let wait = json!({ "timeout": "1.5s" });
    assert_eq!(server.post(&format!("/v1/{name}:wait"), &wait).await.json(), made);
    let list = server.get("/v1/operations").await.json();
    assert_eq!(list["operations"], json!([made]));
    let id = name.strip_prefix("operations/").unwrap();
    let artifact = server.get(&format!("/v1/artifacts/{id}")).await.json();
    assert_eq!(artifact["artifact"], made["response"]["artifact"]);
    assert_eq!(artifact["artifact"]["provenance"]["artifactId"], id);
}

#[tokio::test(flavor = "multi_thread")]
async fn operations_are_paged() {
    let server = server().await;
    let mut ids = Vec::new();
    for weight in [1.0, 2.0, 3.0] {
        let mut problem = missions::double_integrator();
        problem["variableHorizon"]["fuelWeight"] = weight.into();
        ids.push(artifact(&precompute(&server, &problem).await).artifact_id);
    }
    ids.sort();
    let mut seen = Vec::new();
    let mut token = String::new();
    loop {
        let path = format!("/v1/operations?pageSize=1&pageToken={token}");
        let page = server.get(&path).await.json();
        let operations = page["operations"].as_array().unwrap();
        assert!(operations.len() <= 1);
        seen.extend(operations.iter().map(|o| o["metadata"]["artifactId"].clone()));
        token = page["nextPageToken"].as_str().unwrap().to_owned();
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(seen, ids);
}

#[tokio::test(flavor = "multi_thread")]
async fn artifact_unknown_is_not_found_and_malformed_is_refused() {
    let server = server().await;
    let unknown = "ab".repeat(32);
    let answer = server.get(&format!("/v1/artifacts/{unknown}")).await;
    assert_eq!(answer.status, 404);
    assert_eq!(detail(&answer.json(), "ErrorInfo").unwrap()["reason"], "ARTIFACT_UNKNOWN");
    assert_eq!(server.get(&format!("/v1/operations/{unknown}")).await.status, 404);
    for malformed in ["ab", "AB", "zz"] {
        let malformed = malformed.repeat(32)[..63].to_owned();
        assert_eq!(server.get(&format!("/v1/artifacts/{malformed}")).await.status, 400);
    }
    let mut client = server.grpc().await;
    let request = v1::GetArtifactRequest { artifact_id: unknown };
    assert_eq!(client.get_artifact(request).await.unwrap_err().code(), Code::NotFound);
    let step = step_request(
        ("artifactId", "cd".repeat(32).into()),
        json!({ "linear": { "components": [1.0, 0.0] } }),
    );
    assert_eq!(client.step(step).await.unwrap_err().code(), Code::NotFound);
}

#[tokio::test(flavor = "multi_thread")]
async fn precompute_validate_only_keeps_nothing() {
    let server = server().await;
    let request = json!({ "problem": missions::double_integrator(), "validateOnly": true });
    let checked = server.post("/v1/precompute", &request).await;
    assert_eq!(checked.status, 200);
    let id = checked.json()["metadata"]["artifactId"].as_str().unwrap().to_owned();
    assert_eq!(checked.json()["done"], false);
    assert_eq!(server.get(&format!("/v1/artifacts/{id}")).await.status, 404);
    let request = json!({ "problem": missions::double_integrator(), "requestId": "not a uuid" });
    assert_eq!(server.post("/v1/precompute", &request).await.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn artifact_in_a_directory_survives_a_restart_and_damage_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let config =
        Config { store: StoreLocation::Directory(folder.path().to_owned()), ..Config::default() };
    let first = server_with(config.clone()).await;
    let made = artifact(&precompute(&first, &missions::double_integrator()).await);
    first.node.shutdown().await;
    let second = server_with(config.clone()).await;
    let path = format!("/v1/artifacts/{}", made.artifact_id);
    let found = second.get(&path).await.json();
    assert_eq!(found["artifact"]["provenance"]["contentSha256"], {
        made.provenance.as_ref().unwrap().content_sha256.as_str()
    });
    second.node.shutdown().await;
    let file = folder.path().join("v1").join(&made.artifact_id[..2]).join(&made.artifact_id);
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let third = server_with(config).await;
    let damaged = third.get(&path).await;
    assert_eq!(damaged.status, 500);
    let error = damaged.json();
    assert_eq!(error["code"], 15);
    assert_eq!(detail(&error, "ErrorInfo").unwrap()["reason"], "ARTIFACT_DAMAGED");
    assert!(error["message"].as_str().unwrap().contains(&made.artifact_id));
}
