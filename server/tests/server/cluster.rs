//! Nodes and workers that share a store on NATS. Where `VBAR_TEST_NATS` names servers, as in
//! `.ci/run`; skipped aloud elsewhere.

use std::{
    env,
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

use ::http::Method;
use bytes::Bytes;
use serde_json::{Value, json};
use vbar_server::{Config, NatsLocation, Node, StoreLocation};

use crate::{
    missions,
    offline_sampling::poseidyn,
    operations::{artifact, numbered, precompute},
    support::{Server, patient, server, server_with},
};

/// Servers with a store of this test's own, if there are any.
fn location() -> Option<NatsLocation> {
    static STORES: AtomicU32 = AtomicU32::new(0);
    let Ok(servers) = env::var("VBAR_TEST_NATS") else {
        eprintln!("!!! skipped: VBAR_TEST_NATS names no NATS servers");
        return None;
    };
    let servers: Vec<_> = servers.split(',').map(str::to_owned).collect();
    let number = STORES.fetch_add(1, Ordering::Relaxed);
    Some(NatsLocation {
        name: format!("cluster{}-{number}", std::process::id()),
        replicas: servers.len().min(3),
        lease_term: Duration::from_secs(2),
        ..NatsLocation::at(servers)
    })
}

/// A node that takes orders and does nothing of them.
async fn node(location: &NatsLocation) -> Server {
    let store = StoreLocation::Nats(location.clone());
    server_with(Config { store, job_threads: 0, ..patient() }).await
}

async fn worker(location: &NatsLocation) -> Server {
    let store = StoreLocation::Nats(location.clone());
    let node = Node::start_worker(Config { store, job_threads: 1, ..Config::default() }).await;
    let node = node.expect("the configuration is good");
    Server { address: node.local_address(), node }
}

async fn until(what: &str, mut there: impl AsyncFnMut() -> bool) {
    let patience = Instant::now() + Duration::from_secs(60);
    while !there().await {
        assert!(Instant::now() < patience, "not {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn cluster_makes_the_bytes_that_one_machine_makes() {
    let Some(location) = location() else { return };
    let alone = server().await;
    let (one, other) = (node(&location).await, node(&location).await);
    let _workers = [worker(&location).await, worker(&location).await];
    for problem in [
        missions::envisat(),
        missions::double_integrator(),
        missions::prisma(),
        missions::station(),
        poseidyn(),
    ] {
        let expected = artifact(&precompute(&alone, &problem).await);
        let made = artifact(&precompute(&one, &problem).await);
        assert_eq!(made.provenance, expected.provenance);
        assert_eq!(made.summary, expected.summary);
        // The other node knows all of it, and finds it done.
        let there = artifact(&precompute(&other, &problem).await);
        assert_eq!(there.provenance, expected.provenance);
        let path = format!("/v1/artifacts/{}:download", made.artifact_id);
        let bytes = [&alone, &one, &other].map(async |server| server.get(&path).await.body);
        let [expected, made, there] = bytes;
        let expected = expected.await;
        assert!(made.await == expected && there.await == expected, "{path}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn cluster_nodes_know_what_each_other_was_asked() {
    let Some(location) = location() else { return };
    let (one, other) = (node(&location).await, node(&location).await);
    let ask = |number: u32, request_id: &str| json!({ "problem": numbered(number), "requestId": request_id });
    const FIRST: &str = "0b5d5d0e-5d2c-4c3a-9d7e-1f6f5a3c9b01";
    const SECOND: &str = "0b5d5d0e-5d2c-4c3a-9d7e-1f6f5a3c9b02";
    let impatient = [("content-type", "application/json"), ("request-timeout-ms", "300")];
    let begin = async |server: &Server, body: &Value| {
        server.http(Method::POST, "/v1/precompute", &impatient, body.to_string().into()).await
    };
    let begun = begin(&one, &ask(1, FIRST)).await;
    assert_eq!(begun.status, 200, "{}", begun.text());
    let name = begun.json()["name"].as_str().unwrap().to_owned();
    // At once, and by its own name of the request.
    let got = other.get(&format!("/v1/{name}")).await;
    assert_eq!((got.status.as_u16(), got.json()["done"].clone()), (200, json!(false)));
    assert_eq!(begin(&other, &ask(1, FIRST)).await.json()["name"], name.as_str());
    assert_eq!(begin(&other, &ask(2, FIRST)).await.status, 409);
    assert_eq!(begin(&other, &ask(2, SECOND)).await.status, 200);
    until("listed by both", async || {
        let mut counts = Vec::new();
        for server in [&one, &other] {
            let list = server.get("/v1/operations").await.json();
            counts.push(list["operations"].as_array().map_or(0, Vec::len));
        }
        counts == [2, 2]
    })
    .await;
    // Cancelled by one it is cancelled for all; nobody was at it.
    let path = format!("/v1/{name}:cancel");
    assert_eq!(other.http(Method::POST, &path, &[], Bytes::new()).await.status, 200);
    until("cancelled", async || one.get(&format!("/v1/{name}")).await.json()["error"]["code"] == 1)
        .await;
    assert_eq!(
        one.http(Method::DELETE, &format!("/v1/{name}"), &[], Bytes::new()).await.status,
        200
    );
    until("gone", async || other.get(&format!("/v1/{name}")).await.status == 404).await;
    // What was ordered while nobody worked is done when somebody comes.
    let _worker = worker(&location).await;
    assert!(precompute(&one, &numbered(2)).await.done);
}

#[tokio::test(flavor = "multi_thread")]
async fn cluster_plan_uploaded_to_one_node_is_flown_by_another() {
    let Some(location) = location() else { return };
    let (one, other) = (node(&location).await, node(&location).await);
    let request = json!({ "problem": missions::prisma() });
    let computed = one.post("/v1/plans:compute", &request).await.json();
    let id = computed["planId"].as_str().expect("a plan").to_owned();
    let step = json!({ "planId": id, "measurement": missions::prisma_measurement(0) });
    let (here, there) = (one.post("/v1/step", &step).await, other.post("/v1/step", &step).await);
    assert_eq!(here.status, 200, "{}", here.text());
    assert_eq!(here.body, there.body);
    assert_eq!(other.get("/v1/plans").await.json()["plans"].as_array().unwrap().len(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn cluster_worker_tells_how_it_is_and_answers_no_calls() {
    let Some(location) = location() else { return };
    let worker = worker(&location).await;
    assert_eq!(worker.get("/healthz").await.status, 200);
    until("ready", async || worker.get("/readyz").await.status == 200).await;
    assert!(worker.get("/metrics").await.text().contains("vbar_jobs_unfinished"));
    assert_eq!(worker.get("/v1/info").await.status, 404);
    assert_eq!(worker.post("/v1/step", &json!({})).await.status, 404);
}

/// Without servers there is an answer, not a wait without end.
#[tokio::test(flavor = "multi_thread")]
async fn cluster_worker_with_a_store_of_its_own_is_refused() {
    let refused = Node::start_worker(Config::default()).await.expect_err("nobody has work for it");
    assert!(refused.to_string().contains("store: expected nats://"), "{refused}");
}
