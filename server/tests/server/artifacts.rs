//! What precomputes made.

use std::time::{Duration, Instant};

use ::http::Method;
use bytes::Bytes;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tonic::Code;
use vbar_proto::v1;
use vbar_server::{Config, StoreLocation};

use crate::{
    missions,
    operations::{artifact, numbered, precompute},
    support::{Server, detail, patient, server, server_with, step_request},
};

#[tokio::test(flavor = "multi_thread")]
async fn artifact_unknown_is_not_found_and_malformed_is_refused() {
    let server = server().await;
    let unknown = "ab".repeat(32);
    for path in [format!("/v1/artifacts/{unknown}"), format!("/v1/artifacts/{unknown}:download")] {
        let answer = server.get(&path).await;
        assert_eq!(answer.status, 404, "{path}");
        assert_eq!(detail(&answer.json(), "ErrorInfo").unwrap()["reason"], "ARTIFACT_UNKNOWN");
    }
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
async fn artifacts_are_listed_by_id() {
    let server = server().await;
    let mut made = Vec::new();
    for number in 0..3 {
        made.push(artifact(&precompute(&server, &numbered(number)).await));
    }
    made.sort_by(|a, b| a.artifact_id.cmp(&b.artifact_id));
    let mut client = server.grpc().await;
    let request = v1::ListArtifactsRequest { page_size: 2, page_token: String::new() };
    let first = client.list_artifacts(request).await.unwrap().into_inner();
    assert_eq!(first.artifacts, made[..2]);
    let request = v1::ListArtifactsRequest { page_size: 2, page_token: first.next_page_token };
    let second = client.list_artifacts(request).await.unwrap().into_inner();
    assert_eq!((second.artifacts.as_slice(), second.next_page_token.as_str()), (&made[2..], ""));
    let all = server.get("/v1/artifacts").await.json();
    let ids: Vec<&str> = all["artifacts"]
        .as_array()
        .unwrap()
        .iter()
        .map(|artifact| artifact["artifactId"].as_str().unwrap())
        .collect();
    assert_eq!(ids, made.iter().map(|a| a.artifact_id.as_str()).collect::<Vec<_>>());
    assert_eq!(server.get("/v1/artifacts?pageSize=x").await.status, 400);
}

/// Everything that gRPC sends for a download.
async fn downloaded(server: &Server, id: &str, offset: i64, length: i64) -> Result<Bytes, Code> {
    let request = v1::DownloadArtifactRequest { artifact_id: id.to_owned(), offset, length };
    let mut client = server.grpc().await;
    let answer = client.download_artifact(request).await.map_err(|status| status.code())?;
    let mut pieces = answer.into_inner();
    let mut content = Vec::new();
    while let Some(piece) = pieces.message().await.map_err(|status| status.code())? {
        assert_eq!(piece.offset, offset + i64::try_from(content.len()).unwrap());
        content.extend_from_slice(&piece.content);
    }
    Ok(content.into())
}

#[tokio::test(flavor = "multi_thread")]
async fn artifact_is_downloaded_whole_and_in_ranges() {
    let server = server().await;
    let made = artifact(&precompute(&server, &missions::envisat()).await);
    let id = made.artifact_id.as_str();
    let whole = downloaded(&server, id, 0, 0).await.unwrap();
    let size = i64::try_from(whole.len()).unwrap();
    assert_eq!(size, made.size_bytes);
    let digest: String = Sha256::digest(&whole).iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(digest, made.provenance.unwrap().content_sha256);
    assert_eq!(downloaded(&server, id, 10, 20).await.unwrap(), whole[10..30]);
    assert_eq!(downloaded(&server, id, size - 5, 99).await.unwrap(), whole[whole.len() - 5..]);
    assert_eq!(downloaded(&server, id, size + 1, 0).await, Err(Code::OutOfRange));
    assert_eq!(downloaded(&server, id, -1, 0).await, Err(Code::InvalidArgument));

    let path = format!("/v1/artifacts/{id}:download");
    let get = async |headers: &[(&str, &str)]| {
        server.http(Method::GET, &path, headers, Bytes::new()).await
    };
    let all = get(&[]).await;
    assert_eq!((all.status.as_u16(), &all.body), (200, &whole));
    assert_eq!(all.headers["etag"], format!("\"{digest}\""));
    assert_eq!(all.headers["accept-ranges"], "bytes");
    for (range, place, expected) in [
        ("bytes=0-9", format!("bytes 0-9/{size}"), &whole[..10]),
        ("bytes=10-", format!("bytes 10-{}/{size}", size - 1), &whole[10..]),
        ("bytes=-7", format!("bytes {}-{}/{size}", size - 7, size - 1), &whole[whole.len() - 7..]),
    ] {
        let part = get(&[("range", range)]).await;
        assert_eq!((part.status.as_u16(), &part.body[..]), (206, expected), "{range}");
        assert_eq!(part.headers["content-range"], place);
    }
    assert_eq!(get(&[("range", &format!("bytes={size}-"))]).await.status, 416);
    // What is no range of bytes, or of something else, means the whole.
    assert_eq!(get(&[("range", "lines=1-2")]).await.status, 200);
    let other = [("range", "bytes=0-9"), ("if-range", "\"another\"")];
    assert_eq!(get(&other).await.body, whole);
    let same = [("range", "bytes=0-9"), ("if-range", all.headers["etag"].as_str())];
    assert_eq!(get(&same).await.status, 206);
    let head = server.http(Method::HEAD, &path, &[], Bytes::new()).await;
    assert_eq!((head.status.as_u16(), head.body.len()), (200, 0));
}

#[tokio::test(flavor = "multi_thread")]
async fn artifact_nobody_uses_expires_and_its_operation_says_so() {
    let artifact_lifetime = Duration::from_secs(2);
    let server = server_with(Config { artifact_lifetime, ..patient() }).await;
    let made = precompute(&server, &missions::double_integrator()).await;
    let path = format!("/v1/artifacts/{}", artifact(&made).artifact_id);
    let patience = Instant::now() + Duration::from_secs(30);
    while server.get(&path).await.status == 200 {
        assert!(Instant::now() < patience, "it does not expire");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let operation = server.get(&format!("/v1/{}", made.name)).await.json();
    let reason = detail(&operation["error"], "ErrorInfo").unwrap()["reason"].clone();
    assert_eq!(reason, "ARTIFACT_EXPIRED");
    assert!(server.metric("vbar_artifacts_expired_total").await >= 1.0);
    // It is made again for whoever asks.
    artifact(&precompute(&server, &missions::double_integrator()).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn artifacts_too_many_are_refused() {
    let server = server_with(Config { artifact_bytes_max: 10, ..patient() }).await;
    let refused = precompute(&server, &missions::double_integrator()).await;
    let operation = server.get(&format!("/v1/{}", refused.name)).await.json();
    assert_eq!(operation["error"]["code"], Code::ResourceExhausted as i32);
    let reason = detail(&operation["error"], "ErrorInfo").unwrap()["reason"].clone();
    assert_eq!(reason, "ARTIFACTS_FULL");
    assert_eq!(server.get("/v1/artifacts").await.json()["artifacts"], json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn artifact_in_a_directory_survives_a_restart_and_damage_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let config = Config { store: StoreLocation::Directory(folder.path().to_owned()), ..patient() };
    let first = server_with(config.clone()).await;
    let operation = precompute(&first, &missions::double_integrator()).await;
    let made = artifact(&operation);
    first.node.shutdown().await;
    let second = server_with(config.clone()).await;
    let path = format!("/v1/artifacts/{}", made.artifact_id);
    let found = second.get(&path).await.json();
    assert_eq!(found["artifact"]["provenance"]["contentSha256"], {
        made.provenance.as_ref().unwrap().content_sha256.as_str()
    });
    let again = second.get(&format!("/v1/{}", operation.name)).await.json();
    assert_eq!(again["response"]["artifact"], found["artifact"]);
    second.node.shutdown().await;
    let file = folder.path().join("v1").join(&made.artifact_id[..2]).join(&made.artifact_id);
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let third = server_with(config).await;
    for path in [path.clone(), format!("{path}:download")] {
        let damaged = third.get(&path).await;
        assert_eq!(damaged.status, 500);
        let error: Value = damaged.json();
        assert_eq!(error["code"], 15);
        assert_eq!(detail(&error, "ErrorInfo").unwrap()["reason"], "ARTIFACT_DAMAGED");
        assert!(error["message"].as_str().unwrap().contains(&made.artifact_id));
    }
}
