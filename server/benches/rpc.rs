//! What a step costs over the network, in one run: p50 and p99 of calls made one after another,
//! client and server in one process on runtimes of their own, over loopback.
//!
//! `cargo bench -p vbar-server --bench rpc` prints a table, with `-- --json` also JSON.
//!
//! The yardstick is `grpc.health.v1.Health/Check` on the same port: a few bytes each way through
//! the same connection, router and codec, a map look-up, no compute thread. A bare echo can be no
//! cheaper. "compute" is the time on the compute thread, as `server-timing` reports it.

#![allow(clippy::print_stdout, reason = "printing is what it is for")]

#[path = "../tests/server/missions.rs"]
mod missions;

use std::{
    net::SocketAddr,
    time::{Duration, Instant},
};

use bytes::Bytes;
use hdrhistogram::Histogram;
use http_body_util::{BodyExt as _, Full};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use serde_json::{Value, json};
use tokio::{net::TcpStream, runtime, sync::mpsc};
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::transport::Channel;
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use vbar_proto::v1::{
    self, guidance_service_client::GuidanceServiceClient, step_response::Verdict,
    step_stream_request, step_stream_response,
};
use vbar_server::{Config, Node};

const WARM_UP: usize = 500;
const CALLS: usize = 4000;
/// "Mid-flight" is after so many steps of the 28 or so.
const MID_FLIGHT: usize = 10;

/// One line of the table.
struct Row {
    name: &'static str,
    call: Histogram<u64>,
    compute: Option<Histogram<u64>>,
}

/// A step's question: everything but the controller.
#[derive(Clone)]
struct Question {
    measurement: v1::Measurement,
    controller_state: Bytes,
}

fn main() {
    let server = runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let server = server.expect("a runtime for the server");
    let node = server.block_on(Node::start(Config::default())).expect("a node");
    let client = runtime::Builder::new_current_thread().enable_all().build();
    let rows = client.expect("a runtime for the client").block_on(measure(node.local_address()));
    server.block_on(node.shutdown());
    println!("{}", table(&rows));
    if std::env::args().any(|argument| argument == "--json") {
        println!("{}", report(&rows));
    }
}

async fn measure(address: SocketAddr) -> Vec<Row> {
    let channel = Channel::from_shared(format!("http://{address}")).expect("a URL");
    let channel = channel.tcp_nodelay(true).connect().await.expect("the node listens");
    let mut client = GuidanceServiceClient::new(channel.clone());
    let first = Question {
        measurement: missions::message(missions::envisat_start()),
        controller_state: Bytes::new(),
    };
    let (artifact_id, mid_flight) = fly(&mut client, first.clone()).await;
    let mut rows = vec![echo(channel).await];
    for (name, question) in [("Step, first", &first), ("Step, mid-flight", &mid_flight)] {
        rows.push(unary(name, &mut client, &artifact_id, question, false).await);
    }
    let name = "Step, first, no prediction";
    rows.push(unary(name, &mut client, &artifact_id, &first, true).await);
    for (name, question) in [("StepStream, first", &first), ("StepStream, mid-flight", &mid_flight)]
    {
        rows.push(stream(name, &mut client, &artifact_id, question).await);
    }
    rows.push(over_http("POST /v1/step, first", address, &artifact_id, &first).await);
    rows
}

/// Precomputes EnviSat and flies it without disturbance until [`MID_FLIGHT`].
async fn fly(client: &mut GuidanceServiceClient<Channel>, first: Question) -> (String, Question) {
    let request: v1::PrecomputeRequest =
        missions::message(json!({ "problem": missions::envisat() }));
    let operation = client.precompute(request).await.expect("a precompute").into_inner();
    let id = operation.name.strip_prefix("operations/").expect("its name").to_owned();
    let mut question = first;
    for _ in 0..MID_FLIGHT {
        let answer = client.step(ask(&id, &question, false)).await.expect("a step").into_inner();
        let Some(Verdict::Command(command)) = &answer.verdict else { panic!("no command") };
        let elapsed = command.elapsed_s + command.duration_s.expect("a spacecraft's");
        question = Question {
            measurement: missions::message(missions::predicted(&answer, elapsed)),
            controller_state: answer.controller_state,
        };
    }
    (id, question)
}

fn ask(artifact_id: &str, question: &Question, omit_prediction: bool) -> v1::StepRequest {
    v1::StepRequest {
        controller: Some(v1::step_request::Controller::ArtifactId(artifact_id.to_owned())),
        controller_state: question.controller_state.clone(),
        measurement: Some(question.measurement.clone()),
        omit_prediction,
    }
}

fn histogram() -> Histogram<u64> {
    Histogram::new(3).expect("three digits")
}

fn record(histogram: &mut Histogram<u64>, time: Duration) {
    let nanoseconds = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    histogram.record(nanoseconds).expect("it resizes itself");
}

/// Milliseconds of `compute;dur=…`.
fn compute_time(server_timing: &str) -> Duration {
    let (_, milliseconds) = server_timing.split_once("dur=").expect("compute;dur=…");
    Duration::from_secs_f64(milliseconds.parse::<f64>().expect("a number") * 1e-3)
}

async fn echo(channel: Channel) -> Row {
    let mut client = HealthClient::new(channel);
    let mut call = histogram();
    for count in 0..WARM_UP + CALLS {
        let request = HealthCheckRequest { service: String::new() };
        let start = Instant::now();
        client.check(request).await.expect("health");
        if count >= WARM_UP {
            record(&mut call, start.elapsed());
        }
    }
    Row { name: "echo (Health/Check)", call, compute: None }
}

async fn unary(
    name: &'static str,
    client: &mut GuidanceServiceClient<Channel>,
    artifact_id: &str,
    question: &Question,
    omit_prediction: bool,
) -> Row {
    let (mut call, mut compute) = (histogram(), histogram());
    for count in 0..WARM_UP + CALLS {
        let request = ask(artifact_id, question, omit_prediction);
        let start = Instant::now();
        let answer = client.step(request).await.expect("a step");
        let time = start.elapsed();
        let timing = answer.metadata().get("server-timing").expect("it is always there");
        if count >= WARM_UP {
            record(&mut call, time);
            record(&mut compute, compute_time(timing.to_str().expect("ASCII")));
        }
    }
    Row { name, call, compute: Some(compute) }
}

async fn stream(
    name: &'static str,
    client: &mut GuidanceServiceClient<Channel>,
    artifact_id: &str,
    question: &Question,
) -> Row {
    let (sender, messages) = mpsc::channel(1);
    let answers = client.step_stream(ReceiverStream::new(messages)).await.expect("a stream");
    let mut answers = answers.into_inner();
    let mut controller = Some(step_stream_request::Controller::ArtifactId(artifact_id.to_owned()));
    let mut call = histogram();
    for count in 0..WARM_UP + CALLS {
        let message = v1::StepStreamRequest {
            controller: controller.take(),
            // Given each time, so that every message asks the same question.
            controller_state: Some(question.controller_state.clone()),
            measurement: Some(question.measurement.clone()),
            omit_prediction: false,
        };
        let start = Instant::now();
        sender.send(message).await.expect("the stream lives");
        let answer = answers.next().await.expect("an answer").expect("no status");
        let time = start.elapsed();
        assert!(matches!(answer.result, Some(step_stream_response::Result::Response(_))));
        if count >= WARM_UP {
            record(&mut call, time);
        }
    }
    Row { name, call, compute: None }
}

async fn over_http(
    name: &'static str,
    address: SocketAddr,
    artifact_id: &str,
    question: &Question,
) -> Row {
    assert!(question.controller_state.is_empty());
    let body = json!({ "artifactId": artifact_id, "measurement": missions::envisat_start() });
    let body = Bytes::from(body.to_string());
    let stream = TcpStream::connect(address).await.expect("the node listens");
    stream.set_nodelay(true).expect("TCP_NODELAY");
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await.expect("HTTP/1.1");
    let connection = tokio::spawn(connection);
    let (mut call, mut compute) = (histogram(), histogram());
    for count in 0..WARM_UP + CALLS {
        let request = http::Request::post("/v1/step")
            .header("host", "bench")
            .header("content-type", "application/json")
            .body(Full::new(body.clone()))
            .expect("a request");
        let start = Instant::now();
        let answer = sender.send_request(request).await.expect("an answer");
        let timing = answer.headers()["server-timing"].to_str().expect("ASCII").to_owned();
        answer.into_body().collect().await.expect("a body");
        if count >= WARM_UP {
            record(&mut call, start.elapsed());
            record(&mut compute, compute_time(&timing));
        }
    }
    drop(sender);
    connection.await.expect("no panic").expect("a clean end");
    Row { name, call, compute: Some(compute) }
}

fn microseconds(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    #[allow(clippy::cast_precision_loss, reason = "nanoseconds of a benchmark")]
    let nanoseconds = histogram.value_at_quantile(quantile) as f64;
    nanoseconds * 1e-3
}

fn table(rows: &[Row]) -> String {
    let yardstick = microseconds(&rows[0].call, 0.5);
    let mut lines = vec![format!(
        "{:<28}{:>10}{:>10}{:>9}{:>16}",
        "call", "p50 us", "p99 us", "/ echo", "compute p50 us"
    )];
    for row in rows {
        let p50 = microseconds(&row.call, 0.5);
        let compute = row.compute.as_ref().map(|c| format!("{:.0}", microseconds(c, 0.5)));
        lines.push(format!(
            "{:<28}{p50:>10.0}{:>10.0}{:>9.2}{:>16}",
            row.name,
            microseconds(&row.call, 0.99),
            p50 / yardstick,
            compute.unwrap_or_default()
        ));
    }
    lines.join("\n")
}

fn report(rows: &[Row]) -> Value {
    let yardstick = microseconds(&rows[0].call, 0.5);
    let row = |row: &Row| {
        let p50 = microseconds(&row.call, 0.5);
        json!({
            "name": row.name,
            "p50_us": p50,
            "p99_us": microseconds(&row.call, 0.99),
            "ratio_to_echo": p50 / yardstick,
            "compute_p50_us": row.compute.as_ref().map(|c| microseconds(c, 0.5)),
        })
    };
    json!({ "calls": CALLS, "rows": rows.iter().map(row).collect::<Vec<_>>() })
}
