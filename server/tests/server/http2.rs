//! Callers that abuse HTTP/2: frames by hand, since no honest client sends them.

use std::{net::SocketAddr, time::Duration};

use ::http::Method;
use bytes::Bytes;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpSocket, TcpStream},
    time::timeout,
};
use vbar_server::{AccessOptions, Config};

use crate::support::{Server, server, server_with};

/// Frame types and flags (RFC 9113, sec. 6).
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const GOAWAY: u8 = 7;
const WINDOW_UPDATE: u8 = 8;
const CONTINUATION: u8 = 9;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
/// Error codes (sec. 7).
const FLOW_CONTROL_ERROR: u32 = 3;
const CANCEL: u32 = 8;
const ENHANCE_YOUR_CALM: u32 = 11;
/// A setting (sec. 6.5.2).
const INITIAL_WINDOW_SIZE: u16 = 4;

const STEP: &str = "/vbar.v1.GuidanceService/Step";
/// Nothing that is bounded takes longer.
const LONGEST: Duration = Duration::from_secs(30);

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// A header block: literals without indexing or Huffman code (RFC 7541, sec. 6.2.2).
fn block(headers: &[(&str, &str)]) -> Vec<u8> {
    let text = |text: &str| {
        assert!(text.len() < 127, "one byte for the length");
        [&[u8::try_from(text.len()).unwrap()], text.as_bytes()].concat()
    };
    headers.iter().flat_map(|(name, value)| [vec![0], text(name), text(value)].concat()).collect()
}

fn get(path: &str) -> Vec<u8> {
    block(&[(":method", "GET"), (":scheme", "http"), (":authority", "x"), (":path", path)])
}

fn grpc(path: &str) -> Vec<u8> {
    let post = [(":method", "POST"), (":scheme", "http"), (":authority", "x"), (":path", path)];
    block(&[&post[..], &[("content-type", "application/grpc"), ("te", "trailers")]].concat())
}

/// A frame that came.
#[derive(Debug)]
struct Frame {
    kind: u8,
    flags: u8,
    stream: u32,
    payload: Vec<u8>,
}

/// A connection whose frames are written by hand.
struct Connection(TcpStream);

impl Connection {
    async fn open(server: &Server) -> Self {
        Self::with(TcpStream::connect(server.address).await.unwrap(), &[]).await
    }

    async fn with(mut stream: TcpStream, settings: &[(u16, u32)]) -> Self {
        let settings = settings.iter();
        let settings: Vec<u8> = settings
            .flat_map(|(id, value)| [&id.to_be_bytes()[..], &value.to_be_bytes()].concat())
            .collect();
        stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
        stream.write_all(&frame(SETTINGS, 0, 0, &settings)).await.unwrap();
        Self(stream)
    }

    async fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).await.unwrap();
    }

    /// The next frame; `None` at the end, however it ends.
    async fn next(&mut self) -> Option<Frame> {
        let mut head = [0; 9];
        timeout(LONGEST, self.0.read_exact(&mut head)).await.expect("a frame or the end").ok()?;
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
        let stream = u32::from_be_bytes(head[5..].try_into().unwrap());
        let mut payload = vec![0; usize::try_from(length).unwrap()];
        self.0.read_exact(&mut payload).await.ok()?;
        Some(Frame { kind: head[3], flags: head[4], stream, payload })
    }

    /// Skips to the first frame of a stream.
    async fn first_of(&mut self, stream: u32) -> Frame {
        loop {
            let frame = self.next().await.expect("the connection goes on");
            if frame.stream == stream {
                return frame;
            }
        }
    }

    /// Reads until the node ends the connection: the error it gives, if it gives one.
    async fn farewell(&mut self) -> Option<u32> {
        let mut error = None;
        while let Some(frame) = self.next().await {
            if frame.kind == GOAWAY {
                error = Some(u32::from_be_bytes(frame.payload[4..8].try_into().unwrap()));
            }
        }
        error
    }

    /// Sends `flood` over and over, up to `bytes_max`, while what comes back is read; the error
    /// that the node ends the connection with. Panics if the node takes it all.
    async fn flooded(self, flood: &[u8], bytes_max: usize) -> Option<u32> {
        let (mut reader, mut writer) = self.0.into_split();
        let times = bytes_max / flood.len();
        let flood = flood.to_vec();
        let sending = tokio::spawn(async move {
            for _ in 0..times {
                if writer.write_all(&flood).await.is_err() {
                    return false;
                }
            }
            true
        });
        let mut answered = Vec::new();
        // A reset may overtake the farewell: the end is what counts.
        let read = timeout(LONGEST, reader.read_to_end(&mut answered));
        let _ = read.await.expect("the node ends the connection");
        drop(reader);
        assert!(!sending.await.unwrap(), "the node took {bytes_max} bytes of it");
        let mut connection = answered.as_slice();
        let mut error = None;
        while let Some((head, rest)) = connection.split_at_checked(9) {
            let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
            let Some((payload, rest)) = rest.split_at_checked(usize::try_from(length).unwrap())
            else {
                break;
            };
            if head[3] == GOAWAY {
                error = Some(u32::from_be_bytes(payload[4..8].try_into().unwrap()));
            }
            connection = rest;
        }
        error
    }

    /// Sends `flood` over and over without reading until the node takes no more of it. Panics if
    /// it takes `bytes_max`.
    async fn deaf_flood(&mut self, flood: &[u8], bytes_max: usize) {
        let mut sent = 0;
        while sent < bytes_max {
            match timeout(Duration::from_secs(2), self.0.write(flood)).await {
                Ok(Ok(length)) => sent += length,
                Ok(Err(_)) | Err(_) => return,
            }
        }
        panic!("the node took {sent} bytes without anybody reading its answers");
    }
}

/// Somebody else is served as if nothing were going on.
async fn others_are_served(server: &Server) {
    assert_eq!(server.get("/v1/info").await.status, 200);
    let mut client = server.grpc().await;
    assert!(client.get_server_info(vbar_proto::v1::GetServerInfoRequest {}).await.is_ok());
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_rapid_reset_ends_the_connection() {
    let server = server().await;
    let mut flood = Vec::new();
    for stream in (1..200).step_by(2) {
        flood.extend(frame(HEADERS, END_HEADERS | END_STREAM, stream, &get("/v1/info")));
        flood.extend(frame(RST_STREAM, 0, stream, &CANCEL.to_be_bytes()));
    }
    let mut connection = Connection::open(&server).await;
    connection.send(&flood).await;
    assert_eq!(connection.farewell().await, Some(ENHANCE_YOUR_CALM));
    others_are_served(&server).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_resets_that_the_node_is_made_to_send_end_the_connection() {
    let server = server().await;
    let mut connection = Connection::open(&server).await;
    let mut flood = Vec::new();
    for stream in (1..6000).step_by(2) {
        flood.extend(frame(HEADERS, END_HEADERS, stream, &grpc(STEP)));
        // A window beyond its end is an error of the stream (RFC 9113, sec. 6.9.1).
        flood.extend(frame(WINDOW_UPDATE, 0, stream, &0x7fff_ffff_u32.to_be_bytes()));
    }
    // It may be gone before all is sent, and its reset overtake its farewell.
    let _ = connection.0.write_all(&flood).await;
    let error = connection.farewell().await;
    assert!(error.is_none_or(|error| error == ENHANCE_YOUR_CALM), "{error:?}");
    others_are_served(&server).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_continuation_flood_ends_the_connection() {
    let server = server().await;
    // Each piece is one whole header: nothing has to be kept to decode it.
    for piece in [block(&[("x", "y")]), Vec::new(), vec![0, 0x7f, 0xff, 0xff, 0x7f]] {
        let mut connection = Connection::open(&server).await;
        connection.send(&frame(HEADERS, 0, 1, &get("/v1/info"))).await;
        let flood = frame(CONTINUATION, 0, 1, &piece).repeat(100);
        connection.flooded(&flood, 8 << 20).await;
        others_are_served(&server).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_header_flood_is_refused() {
    let server = server().await;
    let header = block(&[("x-flood", &"y".repeat(100))]);
    let mut connection = Connection::open(&server).await;
    // 40 kB where 32 are allowed: the answer is 431, and the connection goes on.
    connection.send(&frame(HEADERS, END_STREAM, 1, &get("/v1/info"))).await;
    for _ in 0..2 {
        connection.send(&frame(CONTINUATION, 0, 1, &header.repeat(135))).await;
    }
    connection.send(&frame(CONTINUATION, END_HEADERS, 1, &header)).await;
    let answer = connection.first_of(1).await;
    assert_eq!(answer.kind, HEADERS);
    let status = String::from_utf8_lossy(&answer.payload).contains("431");
    // The library that encodes it may use Huffman's code: 431 is then 0x68 0x05 0xdf or so, so the
    // length of the value tells.
    assert!(status || answer.payload.len() < 16, "{:?}", answer.payload);
    connection.send(&frame(HEADERS, END_HEADERS | END_STREAM, 3, &get("/healthz"))).await;
    assert_eq!(connection.first_of(3).await.kind, HEADERS);
    others_are_served(&server).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_pings_and_settings_wait_until_their_answers_are_read() {
    let server = server().await;
    for flood in [frame(PING, 0, 0, &[7; 8]), frame(SETTINGS, 0, 0, &[])] {
        let mut connection = Connection::open(&server).await;
        connection.deaf_flood(&flood.repeat(1000), 64 << 20).await;
        others_are_served(&server).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_empty_frames_end_the_connection() {
    let server = server().await;
    let mut connection = Connection::open(&server).await;
    connection.send(&frame(HEADERS, END_HEADERS, 1, &grpc(STEP))).await;
    let error = connection.flooded(&frame(DATA, 0, 1, &[]).repeat(100), 1 << 20).await;
    assert!(error.is_none_or(|error| error == ENHANCE_YOUR_CALM), "{error:?}");
    others_are_served(&server).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_window_beyond_its_end_ends_the_connection() {
    let server = server().await;
    let mut connection = Connection::open(&server).await;
    let most = frame(WINDOW_UPDATE, 0, 0, &0x7fff_ffff_u32.to_be_bytes());
    connection.send(&most).await;
    assert_eq!(connection.farewell().await, Some(FLOW_CONTROL_ERROR));
    others_are_served(&server).await;
}

/// A connection from another address of this machine.
async fn from(address: &str, server: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(address.parse().unwrap()).unwrap();
    socket.connect(server).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_answers_that_nobody_takes_are_calls_under_way() {
    const CALLS_MAX: u32 = 8;
    let access = AccessOptions { caller_calls_max: CALLS_MAX, ..AccessOptions::default() };
    let server = server_with(Config { access, ..Config::default() }).await;
    // A window of nothing, and one of a byte, which takes a piece and then no more. Each is opened
    // by a caller of its own: the last calls of the one before may still hold places.
    for (window, address) in [(0, "127.0.0.2:0"), (1, "127.0.0.3:0")] {
        let refused_before = refused_calls(&server).await;
        let stream = from(address, server.address).await;
        let mut connection = Connection::with(stream, &[(INITIAL_WINDOW_SIZE, window)]).await;
        let streams: Vec<u32> = (1..40).step_by(2).collect();
        for &stream in &streams {
            let request = get("/openapi.json");
            connection.send(&frame(HEADERS, END_HEADERS | END_STREAM, stream, &request)).await;
        }
        let mut heads = Vec::new();
        while heads.len() < streams.len() {
            let frame = connection.next().await.expect("every call is answered");
            if frame.kind == HEADERS {
                heads.push(frame);
            }
        }
        // The document is much longer than what an error says.
        let refused = refused_calls(&server).await - refused_before;
        let expected = streams.len() - usize::try_from(CALLS_MAX).unwrap();
        assert_eq!(refused, expected, "with a window of {window}");
        others_are_served(&server).await;
        drop(connection);
        // Their places are free again.
        let mut tries = 0;
        loop {
            let stream = from(address, server.address).await;
            let mut again = Connection::with(stream, &[]).await;
            again.send(&frame(HEADERS, END_HEADERS | END_STREAM, 1, &get("/openapi.json"))).await;
            again.first_of(1).await;
            let body = again.first_of(1).await;
            if body.flags & END_STREAM == 0 || body.payload.len() > 1000 {
                break;
            }
            tries += 1;
            assert!(tries < 100, "the places stay taken");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

/// Calls refused for want of a place since the node began.
async fn refused_calls(server: &Server) -> usize {
    let count = server.metric(r#"vbar_admissions_total{outcome="calls"}"#).await;
    format!("{count}").parse().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn http2_half_a_message_is_dropped() {
    let receive_time_max = Duration::from_millis(300);
    let server = server_with(Config { receive_time_max, ..Config::default() }).await;
    const STREAM: &str = "/vbar.v1.GuidanceService/StepStream";
    // The head of a message of 100 bytes, and ten of them.
    let half = [&[0, 0, 0, 0, 100][..], &[0; 10]].concat();
    for (path, begin) in
        [(STEP, Some(&half[..])), (STEP, Some(&half[..3])), (STEP, None), (STREAM, Some(&half))]
    {
        let mut connection = Connection::open(&server).await;
        connection.send(&frame(HEADERS, END_HEADERS, 1, &grpc(path))).await;
        if let Some(begin) = begin {
            connection.send(&frame(DATA, 0, 1, begin)).await;
        }
        loop {
            let frame = connection.first_of(1).await;
            if frame.kind == HEADERS && frame.flags & END_STREAM != 0 {
                break;
            }
        }
    }
    let slow = r#"code="DEADLINE_EXCEEDED""#;
    let metrics = server.get("/metrics").await;
    let step = metrics.text().lines().find(|l| l.contains(slow) && l.contains("\"Step\""));
    assert!(step.is_some_and(|line| line.ends_with(" 3")), "{step:?}");
    // A loop that says nothing between two messages goes on for as long as it likes.
    let mut connection = Connection::open(&server).await;
    connection.send(&frame(HEADERS, END_HEADERS, 1, &grpc(STREAM))).await;
    tokio::time::sleep(3 * receive_time_max).await;
    connection.send(&frame(DATA, END_STREAM, 1, &[0, 0, 0, 0, 0])).await;
    assert_eq!(connection.first_of(1).await.kind, HEADERS);
    assert_eq!(connection.first_of(1).await.kind, DATA);
    let answer = server.http(Method::GET, "/healthz", &[], Bytes::new()).await;
    assert_eq!(answer.status, 200);
}
