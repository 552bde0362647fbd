//! What each store costs, in one run: from order to start of a job, artifacts on their way, steps
//! whose artifact is in memory and steps whose artifact is not.
//!
//! `cargo bench -p vbar-server --bench stores` prints a table, with `-- --json` also JSON. The store
//! on NATS is measured where `VBAR_TEST_NATS` names servers, and said to be skipped elsewhere.

#![allow(clippy::print_stdout, reason = "printing is what it is for")]

#[path = "../tests/server/missions.rs"]
mod missions;

use std::{
    env,
    time::{Duration, Instant},
};

use hdrhistogram::Histogram;
use prost::Message as _;
use serde_json::{Value, json};
use tokio::runtime;
use tokio_stream::StreamExt as _;
use tonic::transport::Channel;
use vbar_proto::{
    google::longrunning::{Operation, WaitOperationRequest, operations_client::OperationsClient},
    v1::{self, guidance_service_client::GuidanceServiceClient},
};
use vbar_server::{Config, NatsLocation, Node, StoreLocation};

const JOBS: u32 = 50;
const DOWNLOADS: usize = 20;
const WARM_STEPS: usize = 2000;
const COLD_STEPS: usize = 200;

/// What was measured of one store.
struct Row {
    name: String,
    /// From the order to its start, milliseconds by the node's own clock.
    start_ms: Histogram<u64>,
    /// From the order to the answer that it is done, nanoseconds.
    made: Histogram<u64>,
    artifact_bytes: usize,
    /// A whole artifact, which the node reads from its store each time; nanoseconds.
    download: Histogram<u64>,
    warm: Histogram<u64>,
    cold: Histogram<u64>,
}

fn main() {
    let folder = tempfile::tempdir().expect("a folder");
    let synced = folder.path().join("synced");
    let unsynced = folder.path().join("unsynced");
    let mut stores = vec![
        ("memory".to_owned(), Config::default()),
        ("directory, synced".to_owned(), directory(synced, true)),
        ("directory, not synced".to_owned(), directory(unsynced, false)),
    ];
    match env::var("VBAR_TEST_NATS").ok().filter(|servers| !servers.is_empty()) {
        Some(servers) => {
            let servers: Vec<_> = servers.split(',').map(str::to_owned).collect();
            let name = format!("NATS, {} servers", servers.len());
            let location = NatsLocation {
                name: format!("bench{}", std::process::id()),
                replicas: servers.len().min(3),
                ..NatsLocation::at(servers)
            };
            stores
                .push((name, Config { store: StoreLocation::Nats(location), ..Config::default() }));
        }
        None => println!("!!! skipped: VBAR_TEST_NATS names no NATS servers"),
    }
    let rows: Vec<_> = stores.into_iter().map(|(name, config)| measure(name, config)).collect();
    println!(
        "{:<24}{:>14}{:>14}{:>14}{:>16}{:>12}{:>12}{:>12}",
        "",
        "start p50 ms",
        "start p99 ms",
        "made p50 ms",
        "artifact MB/s",
        "warm p50 us",
        "cold p50 us",
        "cold p99 us"
    );
    for row in &rows {
        println!(
            "{:<24}{:>14}{:>14}{:>14.2}{:>16.0}{:>12.0}{:>12.0}{:>12.0}",
            row.name,
            row.start_ms.value_at_quantile(0.5),
            row.start_ms.value_at_quantile(0.99),
            at(&row.made, 0.5) * 1e-3,
            row.megabytes_per_s(),
            at(&row.warm, 0.5),
            at(&row.cold, 0.5),
            at(&row.cold, 0.99),
        );
    }
    println!("an artifact of {} bytes; cold: read from the store", rows[0].artifact_bytes);
    if env::args().any(|argument| argument == "--json") {
        println!("{}", Value::Array(rows.iter().map(Row::json).collect()));
    }
}

fn directory(path: std::path::PathBuf, store_sync: bool) -> Config {
    Config { store: StoreLocation::Directory(path), store_sync, ..Config::default() }
}

/// Microseconds.
fn at(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    #[allow(clippy::cast_precision_loss, reason = "nanoseconds of a benchmark")]
    let nanoseconds = histogram.value_at_quantile(quantile) as f64;
    nanoseconds * 1e-3
}

impl Row {
    fn megabytes_per_s(&self) -> f64 {
        #[allow(clippy::cast_precision_loss, reason = "bytes of a benchmark")]
        let bytes = self.artifact_bytes as f64;
        bytes / at(&self.download, 0.5)
    }

    fn json(&self) -> Value {
        let quantiles = |histogram: &Histogram<u64>| json!({ "p50_us": at(histogram, 0.5), "p99_us": at(histogram, 0.99) });
        json!({
            "store": self.name,
            "start_p50_ms": self.start_ms.value_at_quantile(0.5),
            "start_p99_ms": self.start_ms.value_at_quantile(0.99),
            "made": quantiles(&self.made),
            "artifact_bytes": self.artifact_bytes,
            "download": quantiles(&self.download),
            "step_warm": quantiles(&self.warm),
            "step_cold": quantiles(&self.cold),
        })
    }
}

fn measure(name: String, config: Config) -> Row {
    let server = runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let server = server.expect("a runtime for the server");
    let client = runtime::Builder::new_current_thread().enable_all().build();
    let client = client.expect("a runtime for the client");
    let node = server.block_on(Node::start(config.clone())).expect("a node");
    let address = node.local_address();
    let mut row = client.block_on(async {
        let mut caller = Caller::new(address).await;
        let (start_ms, made) = caller.jobs().await;
        let mut warm = histogram();
        let id = caller.precompute(&missions::envisat()).await.0;
        caller.steps(&[id], WARM_STEPS, &mut warm).await;
        Row {
            name,
            start_ms,
            made,
            artifact_bytes: 0,
            download: histogram(),
            warm,
            cold: histogram(),
        }
    });
    if matches!(config.store, StoreLocation::Memory { .. }) {
        client.block_on(async { Caller::new(address).await.cold(&mut row).await });
        server.block_on(node.shutdown());
        return row;
    }
    server.block_on(node.shutdown());
    // One that remembers a single artifact: asked for two in turn it reads each from the store.
    let forgetful = Config { cache_bytes_max: 1, ..config };
    let node = server.block_on(Node::start(forgetful)).expect("a node");
    let address = node.local_address();
    client.block_on(async { Caller::new(address).await.cold(&mut row).await });
    server.block_on(node.shutdown());
    row
}

struct Caller {
    guidance: GuidanceServiceClient<Channel>,
    operations: OperationsClient<Channel>,
}

impl Caller {
    async fn new(address: std::net::SocketAddr) -> Self {
        let channel = Channel::from_shared(format!("http://{address}")).expect("a URL");
        let channel = channel.tcp_nodelay(true).connect().await.expect("somebody listens");
        let guidance = GuidanceServiceClient::new(channel.clone());
        Self { guidance, operations: OperationsClient::new(channel) }
    }

    /// Id and metadata of what was made.
    async fn precompute(&mut self, problem: &Value) -> (String, v1::PrecomputeMetadata) {
        let request: v1::PrecomputeRequest = missions::message(json!({ "problem": problem }));
        let begun = self.guidance.precompute(request).await.expect("an operation").into_inner();
        let done = if begun.done {
            begun
        } else {
            let request = WaitOperationRequest { name: begun.name, timeout: None };
            self.operations.wait_operation(request).await.expect("an operation").into_inner()
        };
        assert!(done.done, "{done:?}");
        let metadata = metadata(&done);
        (metadata.artifact_id.clone(), metadata)
    }

    /// Orders problems that differ in nothing that matters.
    async fn jobs(&mut self) -> (Histogram<u64>, Histogram<u64>) {
        let (mut start_ms, mut made) = (histogram(), histogram());
        for number in 0..JOBS {
            let mut problem = missions::envisat();
            problem["variableHorizon"]["fuelWeight"] = json!(5.0 + 1e-6 * f64::from(number + 1));
            let begun = Instant::now();
            let (_, metadata) = self.precompute(&problem).await;
            record(&mut made, begun.elapsed());
            let ms = |time: Option<prost_types::Timestamp>| {
                let time = time.expect("it ran");
                time.seconds * 1000 + i64::from(time.nanos) / 1_000_000
            };
            let wait = ms(metadata.start_time) - ms(metadata.create_time);
            start_ms.record(u64::try_from(wait).unwrap_or(0)).expect("it resizes itself");
        }
        (start_ms, made)
    }

    async fn steps(&mut self, ids: &[String], count: usize, times: &mut Histogram<u64>) {
        let measurement: v1::Measurement = missions::message(missions::envisat_start());
        for id in ids.iter().cycle().take(count) {
            let request = v1::StepRequest {
                controller: Some(v1::step_request::Controller::ArtifactId(id.clone())),
                measurement: Some(measurement.clone()),
                ..v1::StepRequest::default()
            };
            let begun = Instant::now();
            self.guidance.step(request).await.expect("a step");
            record(times, begun.elapsed());
        }
    }

    async fn cold(&mut self, row: &mut Row) {
        let mut other = missions::envisat();
        other["variableHorizon"]["fuelWeight"] = json!(6.0);
        let ids = [self.precompute(&missions::envisat()).await.0, self.precompute(&other).await.0];
        self.steps(&ids, COLD_STEPS, &mut row.cold).await;
        let (large, _) = self.precompute(&missions::station()).await;
        for _ in 0..DOWNLOADS {
            let artifact_id = large.clone();
            let request = v1::DownloadArtifactRequest { artifact_id, offset: 0, length: 0 };
            let begun = Instant::now();
            let pieces = self.guidance.download_artifact(request).await.expect("an artifact");
            let mut pieces = pieces.into_inner();
            let mut bytes = 0;
            while let Some(piece) = pieces.next().await {
                bytes += piece.expect("a piece").content.len();
            }
            record(&mut row.download, begun.elapsed());
            row.artifact_bytes = bytes;
        }
    }
}

fn metadata(operation: &Operation) -> v1::PrecomputeMetadata {
    let packed = operation.metadata.as_ref().expect("there is always metadata");
    v1::PrecomputeMetadata::decode(packed.value.as_slice()).expect("as its type says")
}

fn histogram() -> Histogram<u64> {
    Histogram::new(3).expect("three digits")
}

fn record(histogram: &mut Histogram<u64>, time: Duration) {
    let nanoseconds = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    histogram.record(nanoseconds).expect("it resizes itself");
}
