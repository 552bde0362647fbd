//! Nodes and callers: gRPC as our client and others speak it, HTTP by hand.

use std::{net::SocketAddr, time::Duration};

use serde_json::Value;
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _},
    net::TcpStream,
    time::timeout,
};
use tonic::{
    Code, Status,
    codegen::{http::uri::PathAndQuery, tokio_stream},
    metadata::AsciiMetadataValue,
    transport::Channel,
};
use tonic_prost::ProstCodec;
use vbar_client::{Client, Credentials, Error, Options};
use vbar_server::{AccessOptions, Config, Node};

/// A node of this process.
pub(crate) struct Server {
    pub(crate) node: Node,
    pub(crate) address: SocketAddr,
    is_encrypted: bool,
}

/// An answer over HTTP/1.1, its header names in lower case.
#[derive(Debug)]
pub(crate) struct Answer {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: String,
}

impl Answer {
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        let lines = self.head.lines().skip(1);
        lines.filter_map(|line| line.split_once(": ")).find(|(n, _)| *n == name).map(|(_, v)| v)
    }

    /// The reason in the error's details.
    pub(crate) fn reason(&self) -> String {
        let error: Value = serde_json::from_str(&self.body).expect(&self.body);
        error["details"][0]["reason"].as_str().expect(&self.body).to_owned()
    }
}

impl Server {
    pub(crate) async fn start(access: AccessOptions) -> Self {
        Self::with(Config { access, ..Config::default() }).await
    }

    pub(crate) async fn with(config: Config) -> Self {
        let is_encrypted = config.access.is_encrypted();
        let node = Node::start(config).await.unwrap();
        Self { address: node.local_address(), node, is_encrypted }
    }

    pub(crate) fn url(&self) -> String {
        let scheme = if self.is_encrypted { "https" } else { "http" };
        format!("{scheme}://{}", self.address)
    }

    pub(crate) async fn client(&self, credentials: Credentials) -> Result<Client, Error> {
        let options = Options { attempts_max: 1, credentials, ..Options::default() };
        Client::connect(&self.url(), options).await
    }

    pub(crate) async fn client_with(&self, token: &str) -> Client {
        let credentials = Credentials { token: Some(token.to_owned()), ..Credentials::default() };
        self.client(credentials).await.unwrap()
    }

    pub(crate) async fn get(&self, path: &str, headers: &[(&str, &str)]) -> Answer {
        self.http("GET", path, headers, "").await
    }

    /// One request over HTTP/1.1 in clear.
    pub(crate) async fn http(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: &str,
    ) -> Answer {
        let stream = TcpStream::connect(self.address).await.unwrap();
        let headers: String =
            headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let length = body.len();
        let request = format!(
            "{method} {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\
             content-type: application/json\r\ncontent-length: {length}\r\n{headers}\r\n{body}"
        );
        exchange(stream, request.as_bytes()).await
    }

    /// One call over gRPC of the method at `path`, with an empty message and the headers given.
    pub(crate) async fn grpc(&self, path: &str, headers: &[(&'static str, &str)]) -> Status {
        let endpoint = Channel::from_shared(self.url()).unwrap();
        let mut grpc = tonic::client::Grpc::new(endpoint.connect().await.unwrap());
        grpc.ready().await.unwrap();
        let mut request = tonic::Request::new(tokio_stream::once(()));
        for (name, value) in headers {
            let value = AsciiMetadataValue::try_from(*value).unwrap();
            request.metadata_mut().append(*name, value);
        }
        let path = PathAndQuery::try_from(path).unwrap();
        match grpc.streaming(request, path, ProstCodec::<(), ()>::default()).await {
            Err(status) => status,
            Ok(answers) => match answers.into_inner().message().await {
                Err(status) => status,
                Ok(_) => Status::new(Code::Ok, ""),
            },
        }
    }

    /// The value of a metric; 0 if it never moved.
    pub(crate) async fn metric(&self, name: &str, headers: &[(&str, &str)]) -> f64 {
        let answer = self.get("/metrics", headers).await;
        assert_eq!(answer.status, 200);
        let line = answer.body.lines().find(|line| line.starts_with(name)).map(str::to_owned);
        line.and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or(0.0)
    }
}

/// Sends a request and reads the answer to the end of the connection.
pub(crate) async fn exchange(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    request: &[u8],
) -> Answer {
    stream.write_all(request).await.unwrap();
    let mut answer = Vec::new();
    let read = stream.read_to_end(&mut answer);
    // The node may close its side first, after an answer to a request it did not read.
    let _ = timeout(Duration::from_secs(30), read).await.expect("the connection ends");
    let text = String::from_utf8(answer).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").expect(&text);
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Answer { status, head: head.to_owned(), body: body.to_owned() }
}

/// Tries until it holds; it must within half a minute.
pub(crate) async fn until<F: Future<Output = bool>>(what: &str, holds: impl Fn() -> F) {
    let start = tokio::time::Instant::now();
    while !holds().await {
        assert!(start.elapsed() < Duration::from_secs(30), "not yet: {what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
