//! More connections than a node takes.

use std::{fs, time::Duration};

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpSocket, TcpStream},
};

use super::Process;

const WANTED: u64 = 10_000;
/// Files that the rest of the tests may have open.
const SPARE: u64 = 500;

/// How many connections this process may hold: as many as are wanted, if it can be had.
fn connections() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let most = limit.maximum.unwrap_or(u64::MAX);
    let current = (WANTED + SPARE).min(most).max(limit.current.unwrap_or(u64::MAX));
    setrlimit(Resource::Nofile, Rlimit { current: Some(current), maximum: limit.maximum }).unwrap();
    let count = WANTED.min(current.saturating_sub(SPARE));
    if count < WANTED {
        eprintln!("!!! only {count} connections, not {WANTED}: files are limited to {most}");
    }
    count
}

/// Memory of a process that is in use, bytes.
fn resident(id: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{id}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
}

/// The answer to `GET path`, asked from another address of this machine.
async fn get_from_elsewhere(node: &Process, path: &str) -> String {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let address = node.url.strip_prefix("http://").unwrap().parse().unwrap();
    let mut stream = socket.connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

fn metric(answer: &str, name: &str) -> u64 {
    let line = answer.lines().find(|line| line.starts_with(&format!("{name} "))).expect(name);
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
#[allow(clippy::print_stdout, reason = "how much memory it took is the result")]
async fn ten_thousand_connections_take_no_memory_and_others_are_served() {
    let count = connections();
    let node = Process::start(&[]);
    let address = node.url.strip_prefix("http://").unwrap();
    assert!(get_from_elsewhere(&node, "/v1/info").await.starts_with("HTTP/1.1 200"));
    let before = resident(node.child.id());
    let mut held = Vec::new();
    for _ in 0..count {
        let mut stream = TcpStream::connect(address).await.unwrap();
        // Half a head; one that is closed unread may say so.
        let _ = stream.write_all(b"GET /healthz HTTP/1.1\r\n").await;
        held.push(stream);
    }
    let answer = get_from_elsewhere(&node, "/metrics").await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    // 512 of one address; their heads may be too late by now.
    assert!(metric(&answer, "vbar_connections") <= 512 + 1);
    let refused = metric(&answer, "vbar_connections_refused_total");
    assert!((1..=count).contains(&refused), "{refused} of {count} were refused");
    let grown = resident(node.child.id()).saturating_sub(before);
    println!("{count} connections, {refused} refused; memory grew by {} KiB", grown >> 10);
    assert!(grown < 64 << 20, "memory grew by {grown} bytes");
    assert!(get_from_elsewhere(&node, "/v1/info").await.starts_with("HTTP/1.1 200"));
    drop(held);
    let mut tries = 0;
    while metric(&get_from_elsewhere(&node, "/metrics").await, "vbar_connections") > 1 {
        tries += 1;
        assert!(tries < 500, "connections that ended are still counted");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
