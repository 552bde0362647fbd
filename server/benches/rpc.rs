//! What a step costs over the network, in one run: p50 and p99 of calls made one after another,
//! client and server in one process on runtimes of their own, over loopback.
//!
//! `cargo bench -p vbar-server --bench rpc` prints a table, with `-- --json` also JSON.
//!
//! The yardstick of a call is an echo over the same stack, on a port of its own, that returns the
//! bytes of a mid-flight `Step`: unary for unary calls, a stream for a stream. The yardstick of
//! the mathematics, which is measured in the same run, is Clarabel. "compute" is the time on the
//! compute thread, as `server-timing` reports it. The last line says how many programs the
//! simplex gave up to Clarabel.

#![allow(clippy::print_stdout, reason = "printing is what it is for")]

#[path = "rpc/echo.rs"]
mod echo;
#[path = "rpc/mathematics.rs"]
mod mathematics;
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
use prost::Message as _;
use serde_json::{Value, json};
use tokio::{net::TcpStream, runtime, sync::mpsc};
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::transport::Channel;
use vbar_proto::v1::{
    self, guidance_service_client::GuidanceServiceClient, step_response::Diagnostics,
    step_response::Verdict, step_stream_request, step_stream_response,
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
    /// Programs tried, and those of them that fell to the general solver.
    programs: usize,
    fallbacks: usize,
}

impl Row {
    fn new(name: &'static str, compute: bool) -> Self {
        let compute = compute.then(histogram);
        Self { name, call: histogram(), compute, programs: 0, fallbacks: 0 }
    }

    fn count(&mut self, answer: &v1::StepResponse) {
        let Some(Diagnostics::VariableHorizon(diagnostics)) = &answer.diagnostics else {
            panic!("no diagnostics");
        };
        self.programs += diagnostics.trials.len();
        self.fallbacks += usize::try_from(diagnostics.general_solver_calls).expect("a count");
    }
}

/// Rows with the same yardstick, which is the first of them.
struct Table {
    yardstick: &'static str,
    rows: Vec<Row>,
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
    let echo = server.block_on(echo::start());
    let client = runtime::Builder::new_current_thread().enable_all().build();
    let client = client.expect("a runtime for the client");
    let mut tables = client.block_on(measure(node.local_address(), echo));
    server.block_on(node.shutdown());
    tables.push(Table { yardstick: "/ Clarabel", rows: mathematics::measure() });
    for table in &tables {
        println!("{}\n", lines(table));
    }
    let count = |pick: fn(&Row) -> usize| -> usize {
        tables.iter().flat_map(|table| &table.rows).map(pick).sum()
    };
    let (programs, fallbacks) = (count(|row| row.programs), count(|row| row.fallbacks));
    println!("{fallbacks} of {programs} programs fell back to Clarabel");
    if std::env::args().any(|argument| argument == "--json") {
        println!("{}", report(&tables, programs, fallbacks));
    }
}

async fn connect(address: SocketAddr) -> Channel {
    let channel = Channel::from_shared(format!("http://{address}")).expect("a URL");
    channel.tcp_nodelay(true).connect().await.expect("somebody listens")
}

async fn measure(address: SocketAddr, echo: SocketAddr) -> Vec<Table> {
    let mut client = GuidanceServiceClient::new(connect(address).await);
    let first = Question {
        measurement: missions::message(missions::envisat_start()),
        controller_state: Bytes::new(),
    };
    let (id, mid_flight) = fly(&mut client, first.clone()).await;
    let bytes = Bytes::from(ask(&id, &mid_flight, false).encode_to_vec());
    let mut unary_rows = vec![unary_echo(connect(echo).await, &bytes).await];
    for (name, question) in [("Step, first", &first), ("Step, mid-flight", &mid_flight)] {
        unary_rows.push(unary(name, &mut client, &id, question, false).await);
    }
    let name = "Step, first, no prediction";
    unary_rows.push(unary(name, &mut client, &id, &first, true).await);
    unary_rows.push(over_http("POST /v1/step, first", address, &id, &first).await);
    let mut stream_rows = vec![stream_echo(connect(echo).await, &bytes).await];
    for (name, question) in [("StepStream, first", &first), ("StepStream, mid-flight", &mid_flight)]
    {
        stream_rows.push(stream(name, &mut client, &id, question).await);
    }
    [unary_rows, stream_rows].map(|rows| Table { yardstick: "/ echo", rows }).into()
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

async fn unary_echo(channel: Channel, bytes: &Bytes) -> Row {
    let mut client = tonic::client::Grpc::new(channel);
    let mut row = Row::new("echo, unary", false);
    for count in 0..WARM_UP + CALLS {
        let request = tonic::Request::new(bytes.clone());
        let start = Instant::now();
        client.ready().await.expect("a connection");
        let path = http::uri::PathAndQuery::from_static(echo::UNARY);
        let answer = client.unary(request, path, echo::Raw).await.expect("an echo");
        let time = start.elapsed();
        assert_eq!(answer.get_ref(), bytes);
        if count >= WARM_UP {
            record(&mut row.call, time);
        }
    }
    row
}

async fn stream_echo(channel: Channel, bytes: &Bytes) -> Row {
    let mut client = tonic::client::Grpc::new(channel);
    client.ready().await.expect("a connection");
    let (sender, messages) = mpsc::channel(1);
    let path = http::uri::PathAndQuery::from_static(echo::STREAM);
    let request = tonic::Request::new(ReceiverStream::new(messages));
    let answers = client.streaming(request, path, echo::Raw).await.expect("a stream");
    let mut answers: tonic::Streaming<Bytes> = answers.into_inner();
    let mut row = Row::new("echo, stream", false);
    for count in 0..WARM_UP + CALLS {
        let message = bytes.clone();
        let start = Instant::now();
        sender.send(message).await.expect("the stream lives");
        let answer = answers.next().await.expect("an answer").expect("no status");
        let time = start.elapsed();
        assert_eq!(&answer, bytes);
        if count >= WARM_UP {
            record(&mut row.call, time);
        }
    }
    row
}

async fn unary(
    name: &'static str,
    client: &mut GuidanceServiceClient<Channel>,
    artifact_id: &str,
    question: &Question,
    omit_prediction: bool,
) -> Row {
    let mut row = Row::new(name, true);
    for count in 0..WARM_UP + CALLS {
        let request = ask(artifact_id, question, omit_prediction);
        let start = Instant::now();
        let answer = client.step(request).await.expect("a step");
        let time = start.elapsed();
        let timing = answer.metadata().get("server-timing").expect("it is always there");
        if count >= WARM_UP {
            let compute = row.compute.as_mut().expect("a histogram");
            record(compute, compute_time(timing.to_str().expect("ASCII")));
            record(&mut row.call, time);
        }
        row.count(answer.get_ref());
    }
    row
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
    let mut row = Row::new(name, false);
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
        let Some(step_stream_response::Result::Response(answer)) = &answer.result else {
            panic!("no step: {answer:?}");
        };
        if count >= WARM_UP {
            record(&mut row.call, time);
        }
        row.count(answer);
    }
    row
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
    let mut row = Row::new(name, true);
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
            record(&mut row.call, start.elapsed());
            record(row.compute.as_mut().expect("a histogram"), compute_time(&timing));
        }
    }
    drop(sender);
    connection.await.expect("no panic").expect("a clean end");
    row
}

fn microseconds(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    #[allow(clippy::cast_precision_loss, reason = "nanoseconds of a benchmark")]
    let nanoseconds = histogram.value_at_quantile(quantile) as f64;
    nanoseconds * 1e-3
}

fn lines(table: &Table) -> String {
    let yardstick = microseconds(&table.rows[0].call, 0.5);
    let mut lines = vec![format!(
        "{:<28}{:>10}{:>10}{:>12}{:>16}",
        "", "p50 us", "p99 us", table.yardstick, "compute p50 us"
    )];
    for row in &table.rows {
        let p50 = microseconds(&row.call, 0.5);
        let compute = row.compute.as_ref().map(|c| format!("{:.0}", microseconds(c, 0.5)));
        lines.push(format!(
            "{:<28}{p50:>10.0}{:>10.0}{:>12.3}{:>16}",
            row.name,
            microseconds(&row.call, 0.99),
            p50 / yardstick,
            compute.unwrap_or_default()
        ));
    }
    lines.join("\n")
}

fn report(tables: &[Table], programs: usize, fallbacks: usize) -> Value {
    let rows = tables.iter().flat_map(|table| {
        let yardstick = microseconds(&table.rows[0].call, 0.5);
        table.rows.iter().map(move |row| {
            let p50 = microseconds(&row.call, 0.5);
            json!({
                "name": row.name,
                "p50_us": p50,
                "p99_us": microseconds(&row.call, 0.99),
                "yardstick": table.rows[0].name,
                "ratio_to_yardstick": p50 / yardstick,
                "compute_p50_us": row.compute.as_ref().map(|c| microseconds(c, 0.5)),
            })
        })
    });
    let rows: Vec<Value> = rows.collect();
    json!({ "calls": CALLS, "programs": programs, "fallbacks": fallbacks, "rows": rows })
}
