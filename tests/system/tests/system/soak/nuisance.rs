//! Callers that nobody wants: faulty, slow, rude.

use std::{net::SocketAddr, time::Duration};

use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
    time::{sleep, timeout},
};

/// Nothing that a nuisance does may last longer.
const LONGEST: Duration = Duration::from_secs(30);

/// The body that `GET path` is answered with.
pub(super) async fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer.split_once("\r\n\r\n").expect("a head").1.to_owned()
}

/// One nuisance, and what it found wrong.
#[derive(Debug, Clone, Copy)]
pub(super) enum Nuisance {
    /// Text that is no JSON.
    NoJson,
    /// A compressed body, which could be a bomb.
    Compressed,
    /// Half a head, and then nothing.
    HalfAHead,
    /// Half a body, and then the end.
    HalfABody,
    /// A reset in the middle of an answer.
    Reset,
    /// A large answer, read in sips.
    SlowReader,
}

impl Nuisance {
    pub(super) const ALL: [Self; 6] = [
        Self::NoJson,
        Self::Compressed,
        Self::HalfAHead,
        Self::HalfABody,
        Self::Reset,
        Self::SlowReader,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::NoJson => "no JSON",
            Self::Compressed => "compressed body",
            Self::HalfAHead => "half a head",
            Self::HalfABody => "half a body",
            Self::Reset => "reset",
            Self::SlowReader => "slow reader",
        }
    }

    /// Does it; `Err` if the node did something it should not.
    pub(super) async fn act(self, address: SocketAddr) -> Result<(), String> {
        let acted = async {
            // A node may have as many connections as it takes already.
            let Ok(stream) = TcpStream::connect(address).await else { return Ok(()) };
            match self {
                Self::NoJson => answered(stream, "", "{\"controller\": nonsense", "400").await,
                Self::Compressed => {
                    answered(stream, "content-encoding: gzip\r\n", "\u{1f}", "415").await
                }
                Self::HalfAHead => cut_off(stream, "POST /v1/step HTTP/1.1\r\nhost:").await,
                Self::HalfABody => {
                    let head = head("content-length: 10000\r\n");
                    cut_off(stream, &format!("{head}{{\"artifactId\"")).await
                }
                Self::Reset => reset(stream).await,
                Self::SlowReader => sip(stream).await,
            }
        };
        match timeout(LONGEST, acted).await {
            Ok(outcome) => outcome.map_err(|what| format!("{}: {what}", self.name())),
            Err(_) => Err(format!("{}: still open after {LONGEST:?}", self.name())),
        }
    }
}

fn head(headers: &str) -> String {
    format!(
        "POST /v1/step HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\
         content-type: application/json\r\n{headers}\r\n"
    )
}

/// Must be answered with `status`, or dropped.
async fn answered(
    mut stream: TcpStream,
    headers: &str,
    body: &str,
    status: &str,
) -> Result<(), String> {
    let length = format!("{headers}content-length: {}\r\n", body.len());
    let request = format!("{}{body}", head(&length));
    let mut answer = Vec::new();
    let _ = stream.write_all(request.as_bytes()).await;
    let _ = stream.read_to_end(&mut answer).await;
    let answer = String::from_utf8_lossy(&answer);
    let right = answer.is_empty() || answer.starts_with(&format!("HTTP/1.1 {status}"));
    if right { Ok(()) } else { Err(answer.into_owned()) }
}

/// Sends a part and closes: what comes back is nobody's.
async fn cut_off(mut stream: TcpStream, part: &str) -> Result<(), String> {
    let _ = stream.write_all(part.as_bytes()).await;
    sleep(Duration::from_millis(50)).await;
    Ok(())
}

/// Asks and resets the connection before the answer is read.
async fn reset(mut stream: TcpStream) -> Result<(), String> {
    let request = "GET /openapi.json HTTP/1.1\r\nhost: x\r\n\r\n";
    let _ = stream.write_all(request.as_bytes()).await;
    // With what it has received unread, closing is a reset.
    let mut first = [0; 1];
    let _ = stream.read_exact(&mut first).await;
    Ok(())
}

/// Reads a large answer a little at a time; it must still be whole.
async fn sip(mut stream: TcpStream) -> Result<(), String> {
    let request = "GET /openapi.json HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";
    if stream.write_all(request.as_bytes()).await.is_err() {
        return Ok(());
    }
    let (mut answer, mut sip) = (Vec::new(), vec![0; 4096]);
    loop {
        match stream.read(&mut sip).await {
            Ok(0) => break,
            Ok(length) => answer.extend_from_slice(&sip[..length]),
            Err(_) => return Ok(()),
        }
        sleep(Duration::from_millis(10)).await;
    }
    let body = answer.windows(4).position(|end| end == b"\r\n\r\n").map(|end| &answer[end + 4..]);
    match body {
        // Dropped at the door.
        None if answer.is_empty() => Ok(()),
        Some(body) if serde_json::from_slice::<serde_json::Value>(body).is_ok() => Ok(()),
        _ => Err(format!("{} bytes that are no document", answer.len())),
    }
}
