//! Everything is bounded.

use std::time::Duration;

use ::http::Method;
use bytes::Bytes;
use serde_json::json;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpSocket, TcpStream},
    time::timeout,
};
use tonic::Code;
use vbar_proto::v1;
use vbar_server::{AccessOptions, Config, Node, StartError};

use crate::{
    missions::integrator,
    support::{Server, detail, server, server_with},
};

#[tokio::test(flavor = "multi_thread")]
async fn limits_body_of_100_mb_is_refused_unread_over_http() {
    let server = server().await;
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    let head = "POST /v1/step HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n\
                content-length: 104857600\r\n\r\n";
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut answer = vec![0; 4096];
    // Not a byte of the body was sent: the answer must not wait for it.
    let length = timeout(Duration::from_secs(5), stream.read(&mut answer)).await.unwrap().unwrap();
    let answer = String::from_utf8_lossy(&answer[..length]).into_owned();
    assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
    assert!(answer.contains("REQUEST_TOO_LARGE"), "{answer}");
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_body_without_a_length_is_cut_off() {
    let config = Config { request_bytes_max: 1000, ..Config::default() };
    let server = server_with(config).await;
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    let head = "POST /v1/step HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n\
                transfer-encoding: chunked\r\n\r\n";
    stream.write_all(head.as_bytes()).await.unwrap();
    for _ in 0..3 {
        stream.write_all(format!("1f4\r\n{}\r\n", " ".repeat(500)).as_bytes()).await.unwrap();
    }
    let mut answer = vec![0; 4096];
    let length = timeout(Duration::from_secs(5), stream.read(&mut answer)).await.unwrap().unwrap();
    assert!(answer[..length].starts_with(b"HTTP/1.1 413"));
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_body_of_100_mb_is_refused_over_grpc() {
    let server = server().await;
    let huge = v1::StepRequest {
        controller_state: Bytes::from(vec![0; 100 << 20]),
        ..v1::StepRequest::default()
    };
    let mut client = server.grpc().await;
    let status = client.step(huge).await.unwrap_err();
    assert_eq!(status.code(), Code::OutOfRange, "{status}");
    assert!(status.message().contains("4194304"), "{status}");
    // The same connection goes on.
    assert!(client.get_server_info(v1::GetServerInfoRequest {}).await.is_ok());
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_slow_heads_and_bodies_are_dropped() {
    let receive_time_max = Duration::from_millis(200);
    let server = server_with(Config { receive_time_max, ..Config::default() }).await;
    let slow = async |sent: &str| {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(sent.as_bytes()).await.unwrap();
        let mut answer = String::new();
        let read = stream.read_to_string(&mut answer);
        // An answer or a reset; in any case the connection ends by itself.
        let ended = timeout(Duration::from_secs(10), read).await;
        assert!(ended.is_ok(), "after {sent:?} and {answer:?} the connection stays open");
        answer
    };
    assert_eq!(slow("").await, "");
    let half_a_head = slow("GET /healthz HTTP/1.1\r\nhost:").await;
    assert!(!half_a_head.starts_with("HTTP/1.1 200"), "{half_a_head}");
    let half_a_body = slow(
        "POST /v1/step HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\
         content-type: application/json\r\ncontent-length: 10\r\n\r\n{",
    )
    .await;
    assert!(half_a_body.starts_with("HTTP/1.1 408"), "{half_a_body}");
}

/// So many connections, surely accepted: each has sent half a head.
async fn half_a_head_each(server: &Server, count: usize) -> Vec<TcpStream> {
    let mut held = Vec::new();
    for _ in 0..count {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(b"GET /healthz HTTP/1.1\r\n").await.unwrap();
        held.push(stream);
    }
    tokio::time::sleep(Duration::from_millis(100)).await;
    held
}

/// The next connection is closed or reset, without a byte.
async fn ends_without_a_word(server: &Server) {
    let mut refused = TcpStream::connect(server.address).await.unwrap();
    let mut nothing = Vec::new();
    let read = timeout(Duration::from_secs(5), refused.read_to_end(&mut nothing));
    let _ = read.await.expect("the connection ends");
    assert_eq!(nothing, b"");
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_one_address_cannot_hold_every_connection() {
    let access = AccessOptions { caller_connections_max: 2, ..AccessOptions::default() };
    let server = server_with(Config { access, ..Config::default() }).await;
    let _held = half_a_head_each(&server, 2).await;
    ends_without_a_word(&server).await;
    // From another address of this machine there is room.
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let mut other = socket.connect(server.address).await.unwrap();
    let request = b"GET /healthz HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";
    other.write_all(request).await.unwrap();
    let mut answer = String::new();
    other.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_idle_connections_leave_room_when_they_end() {
    let server = server_with(Config { connections_max: 3, ..Config::default() }).await;
    let held = half_a_head_each(&server, 3).await;
    ends_without_a_word(&server).await;
    drop(held);
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(server.get("/healthz").await.status, 200);
    assert_eq!(server.metric("vbar_connections_refused_total").await, 1.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_header_flood_is_refused() {
    let server = server().await;
    let flood: Vec<(String, String)> =
        (0..200).map(|i| (format!("x-{i}"), "y".repeat(10))).collect();
    let flood: Vec<_> = flood.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
    let answer = server.http(Method::GET, "/healthz", &flood, Bytes::new()).await;
    assert_eq!(answer.status, 431);
    assert_eq!(server.get("/healthz").await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_bad_configuration_does_not_start() {
    let listen = "0.0.0.0:0".parse().unwrap();
    let config = Config { listen, compute_threads: 0, ..Config::default() };
    let Err(StartError::Config(faults)) = Node::start(config).await else {
        panic!("it started");
    };
    let named: Vec<_> = faults.iter().map(|fault| fault.setting).collect();
    assert_eq!(named, ["listen", "compute_threads"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_port_in_use_is_said() {
    let server = server().await;
    let config = Config { listen: server.address, ..Config::default() };
    let Err(fault) = Node::start(config).await else { panic!("it started") };
    assert!(fault.to_string().contains(&server.address.to_string()), "{fault}");
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_shutdown_closes_the_port() {
    let server = server().await;
    let mut client = server.grpc().await;
    assert!(client.get_server_info(v1::GetServerInfoRequest {}).await.is_ok());
    let address = server.address;
    timeout(Duration::from_secs(5), server.node.shutdown()).await.expect("nothing is under way");
    assert!(TcpStream::connect(address).await.is_err());
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_problem_that_would_take_too_much_memory_is_refused_before_it_takes_any() {
    let limits = vbar_server::Limits { problem_bytes_max: 1 << 20, ..Default::default() };
    let server = server_with(Config { limits, ..Config::default() }).await;
    // 100,000 rows of 13 numbers and more, twice.
    let mut problem = integrator();
    problem["offlineSampling"]["samples"]["size"] = 20_000.into();
    for (path, request) in [
        ("/v1/precompute", json!({ "problem": problem })),
        ("/v1/precompute", json!({ "problem": problem, "validateOnly": true })),
        ("/v1/plans:compute", json!({ "problem": problem })),
    ] {
        let answer = server.post(path, &request).await;
        assert_eq!(answer.status, 400, "{}", answer.text());
        let error = answer.json();
        let bad = detail(&error, "BadRequest").expect("it names the field");
        let violation = bad["fieldViolations"].as_array().and_then(|all| all.first());
        let violation = violation.expect("a violation");
        assert_eq!(violation["field"], "problem.offline_sampling");
        let description = violation["description"].as_str().expect("a text");
        assert!(description.contains("at most about 1 MiB"), "{description}");
    }
    let small = json!({ "problem": integrator() });
    let mut small_enough = small.clone();
    small_enough["problem"]["offlineSampling"]["samples"]["size"] = 20.into();
    let answer = server.post("/v1/precompute", &small_enough).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
}
