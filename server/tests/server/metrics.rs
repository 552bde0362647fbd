//! What a node says about itself, after real traffic.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use ::http::Method;
use bytes::Bytes;
use serde_json::{Value, json};
use tonic_types::StatusExt as _;
use vbar_proto::{DESCRIPTORS, v1};

use crate::{
    missions::{double_integrator, envisat, envisat_start, message, prisma},
    support::{Server, detail, server, step_request},
};

/// Some of everything: steps, plans, precomputes, closed loops, faults.
async fn traffic(server: &Server) {
    let step = json!({ "problem": envisat(), "measurement": envisat_start() });
    for path in ["/v1/step", "/v1/step", "/v1/no-such-path"] {
        server.post(path, &step).await;
    }
    server.post("/v1/step", &json!({})).await;
    server.post("/v1/precompute", &json!({ "problem": double_integrator() })).await;
    server.post("/v1/plans:compute", &json!({ "problem": prisma() })).await;
    server.get("/v1/artifacts").await;
    server.get("/healthz").await;
    let mut client = server.grpc().await;
    let request = step_request(("problem", envisat()), envisat_start());
    client.step(request.clone()).await.expect("a step");
    client.step(v1::StepRequest::default()).await.expect_err("nothing was asked");
    let opening: v1::StepStreamRequest =
        message(json!({ "problem": envisat(), "measurement": envisat_start() }));
    let mut answers =
        client.step_stream(tokio_stream::iter([opening])).await.expect("a stream").into_inner();
    while answers.message().await.expect("no fault").is_some() {}
}

/// The text of `/metrics`: kinds by name, and every sample's name with its labels.
struct Scraped {
    kinds: BTreeMap<String, String>,
    samples: BTreeSet<String>,
}

impl Scraped {
    async fn from(server: &Server) -> Self {
        let answer = server.get("/metrics").await;
        assert!(answer.headers["content-type"].starts_with("application/openmetrics-text"));
        assert_eq!(answer.text().lines().last(), Some("# EOF"));
        let kind = |line: &str| {
            let (name, kind) = line.strip_prefix("# TYPE ")?.split_once(' ')?;
            Some((name.to_owned(), kind.to_owned()))
        };
        let samples = answer.text().lines().filter(|line| !line.starts_with('#'));
        Self {
            kinds: answer.text().lines().filter_map(kind).collect(),
            samples: samples
                .map(|line| line.rsplit_once(' ').expect("a value").0.to_owned())
                .collect(),
        }
    }

    fn names(&self) -> BTreeSet<&str> {
        self.samples.iter().map(|sample| sample.split('{').next().unwrap_or_default()).collect()
    }

    /// Every value of a label.
    fn values(&self, label: &str) -> BTreeSet<&str> {
        let marked = format!("{label}=\"");
        let value = |sample: &'_ String| {
            let from = sample.find(&format!("{{{marked}")).or(sample.find(&format!(",{marked}")))?;
            let from = from + 1 + marked.len();
            Some((from, from + sample[from..].find('"')?))
        };
        self.samples.iter().filter_map(|s| value(s).map(|(from, to)| &s[from..to])).collect()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_tell_rate_errors_and_duration_of_every_method() {
    let server = server().await;
    traffic(&server).await;
    let scraped = Scraped::from(&server).await;
    for (name, kind) in [
        ("vbar_requests", "counter"),
        ("vbar_request_seconds", "histogram"),
        ("vbar_stream_messages", "counter"),
        ("vbar_compute_seconds", "histogram"),
        ("vbar_compute_wait_seconds", "histogram"),
        ("vbar_computations", "gauge"),
        ("vbar_compute_waiting", "gauge"),
        ("vbar_compute_refused", "counter"),
        ("vbar_compute_panics", "counter"),
        ("vbar_verdicts", "counter"),
        ("vbar_commands", "counter"),
        ("vbar_simplex_pivots", "counter"),
        ("vbar_general_solver_calls", "counter"),
        ("vbar_certificate_failures", "counter"),
        ("vbar_artifact_lookups", "counter"),
        ("vbar_jobs", "counter"),
        ("vbar_jobs_unfinished", "gauge"),
        ("vbar_connections", "gauge"),
        ("vbar_runtime_workers", "gauge"),
        ("vbar_runtime_tasks", "gauge"),
        ("vbar_runtime_queue", "gauge"),
    ] {
        assert_eq!(scraped.kinds.get(name).map(String::as_str), Some(kind), "{name}");
    }
    for sample in [
        "vbar_requests_total{method=\"Step\",transport=\"http\",code=\"OK\"}",
        "vbar_requests_total{method=\"Step\",transport=\"http\",code=\"INVALID_ARGUMENT\"}",
        "vbar_requests_total{method=\"Step\",transport=\"grpc\",code=\"INVALID_ARGUMENT\"}",
        "vbar_requests_total{method=\"unknown\",transport=\"http\",code=\"NOT_FOUND\"}",
        "vbar_request_seconds_count{method=\"ComputePlan\"}",
        "vbar_compute_seconds_count{method=\"step\"}",
        "vbar_compute_refused_total{lane=\"steps\",reason=\"backlog\"}",
        "vbar_compute_wait_seconds_count{lane=\"plans\"}",
        "vbar_verdicts_total{outcome=\"command\"}",
        "vbar_commands_total{claim=\"local_in_horizon\"}",
        "vbar_artifact_lookups_total{outcome=\"hit\"}",
    ] {
        assert!(scraped.samples.contains(sample), "{sample} is not in {:#?}", scraped.samples);
    }
    assert!(server.metric("vbar_simplex_pivots_total").await > 0.0);
    assert!(server.metric("vbar_runtime_workers").await > 0.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_have_labels_from_fixed_lists_whatever_strangers_send() {
    let server = server().await;
    traffic(&server).await;
    let before = Scraped::from(&server).await;
    for i in 0..50 {
        server.get(&format!("/v1/{i}?x={i}")).await;
        let id = format!("\"}} {i}");
        let headers = [("x-request-id", id.as_str()), ("content-type", "application/grpc+x")];
        let path = format!("/vbar.v1.Service{i}/Method{i}");
        server.http(Method::POST, &path, &headers, Bytes::new()).await;
        let verb = Method::from_bytes(format!("VERB{i}").as_bytes()).expect("a token");
        server.http(verb, "/v1/step", &[], Bytes::new()).await;
    }
    let after = Scraped::from(&server).await;
    let rpcs: BTreeSet<String> = DESCRIPTORS
        .services()
        .flat_map(|service| service.methods().map(|rpc| rpc.name().to_owned()).collect::<Vec<_>>())
        .collect();
    let new: Vec<_> = after.samples.difference(&before.samples).collect();
    // A code or two that had not been seen, with the buckets of one histogram; not fifty.
    assert!(new.len() < 50, "{new:#?}");
    for method in after.values("method") {
        let is_task = method.bytes().all(|c| c.is_ascii_lowercase() || c == b'_');
        assert!(rpcs.contains(method) || is_task, "{method:?}");
    }
    assert_eq!(after.values("transport"), BTreeSet::from(["grpc", "http"]));
    assert_eq!(after.values("lane"), BTreeSet::from(["plans", "records", "steps"]));
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_have_everything_that_dashboard_and_alerts_name() {
    let server = server().await;
    traffic(&server).await;
    let scraped = Scraped::from(&server).await;
    let known = scraped.names();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docker/observability");
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).expect("it is there");
    let dashboard = read("dashboard.json");
    let panels = serde_json::from_str::<Value>(&dashboard).expect("JSON")["panels"].clone();
    let named = |text: &str| -> BTreeSet<String> {
        let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let words = text.split(|c: char| !word(c)).filter(|word| word.starts_with("vbar_"));
        words.map(str::to_owned).collect()
    };
    for panel in panels.as_array().expect("panels") {
        let targets = panel["targets"].as_array().into_iter().flatten();
        for expression in targets.map(|target| target["expr"].as_str().expect("an expression")) {
            assert!(!named(expression).is_empty(), "{expression} asks for none of our metrics");
        }
    }
    for (file, text) in [("dashboard.json", dashboard), ("alerts.yml", read("alerts.yml"))] {
        let named = named(&text);
        assert!(named.len() >= 8, "{file} names only {named:?}");
        for name in named {
            assert!(known.contains(&*name), "{file}: there is no metric {name}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_name_the_trace_of_their_caller() {
    const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
    let parent = format!("00-{TRACE}-00f067aa0ba902b7-01");
    let server = server().await;
    let headers = [("content-type", "application/json"), ("traceparent", parent.as_str())];
    for (path, body) in [("/v1/step", "{}"), ("/v1/step", "{"), ("/v1/nowhere", "{}")] {
        let answer = server.http(Method::POST, path, &headers, Bytes::from(body)).await;
        let error = answer.json();
        let info = detail(&error, "ErrorInfo").expect("every error has one");
        assert_eq!(info["metadata"]["trace_id"], TRACE, "{path} {body}");
    }
    let mut request = tonic::Request::new(v1::StepRequest::default());
    request.metadata_mut().insert("traceparent", parent.parse().expect("ASCII"));
    let status = server.grpc().await.step(request).await.expect_err("nothing was asked");
    let info = status.get_details_error_info().expect("every error has one");
    assert_eq!(info.metadata["trace_id"], TRACE);
}
