//! A node, a gRPC client and a plain HTTP client.

use std::{collections::BTreeMap, net::SocketAddr, sync::Arc, time::Duration};

use ::http::{Method, Request, StatusCode};
use bytes::Bytes;
use http_body_util::{BodyExt as _, Full};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tonic::{
    Status,
    metadata::MetadataValue,
    service::{Interceptor, interceptor::InterceptedService},
    transport::Channel,
};
use tonic_types::StatusExt as _;
use vbar_proto::v1::{self, guidance_service_client::GuidanceServiceClient};
use vbar_server::{Config, Node};

use crate::missions;

/// A node with one or two clients.
pub(crate) struct Server {
    pub(crate) node: Node,
    pub(crate) address: SocketAddr,
}

/// A node as it is by default, but that it waits for what it precomputes, however slow the machine
/// is.
pub(crate) async fn server() -> Server {
    server_with(patient()).await
}

/// Its configuration.
pub(crate) fn patient() -> Config {
    Config { precompute_wait: Duration::from_secs(50), ..Config::default() }
}

/// A node with a configuration.
pub(crate) async fn server_with(config: Config) -> Server {
    let node = Node::start(config).await.expect("the configuration is good");
    let address = node.local_address();
    Server { node, address }
}

/// A client whose calls carry a request id.
pub(crate) type Client = GuidanceServiceClient<InterceptedService<Channel, Identify>>;

/// Puts a request id on every call.
#[derive(Clone)]
pub(crate) struct Identify(Arc<str>);

impl Interceptor for Identify {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, Status> {
        let id = MetadataValue::try_from(&*self.0).expect("an id in ASCII");
        request.metadata_mut().insert("x-request-id", id);
        Ok(request)
    }
}

/// An HTTP answer.
#[derive(Debug)]
pub(crate) struct Answer {
    pub(crate) status: StatusCode,
    pub(crate) headers: BTreeMap<String, String>,
    pub(crate) body: Bytes,
}

impl Answer {
    pub(crate) fn json(&self) -> Value {
        assert_eq!(self.headers["content-type"], "application/json");
        serde_json::from_slice(&self.body).expect("JSON")
    }

    pub(crate) fn text(&self) -> &str {
        std::str::from_utf8(&self.body).expect("text")
    }
}

impl Server {
    pub(crate) async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(format!("http://{}", self.address)).expect("a URL");
        endpoint.tcp_nodelay(true).connect().await.expect("the node listens")
    }

    pub(crate) async fn grpc(&self) -> Client {
        let identify = Identify("test-request".into());
        GuidanceServiceClient::with_interceptor(self.channel().await, identify)
    }

    pub(crate) async fn get(&self, path: &str) -> Answer {
        self.http(Method::GET, path, &[], Bytes::new()).await
    }

    pub(crate) async fn post(&self, path: &str, json: &Value) -> Answer {
        let headers = [("content-type", "application/json")];
        self.http(Method::POST, path, &headers, json.to_string().into()).await
    }

    pub(crate) async fn http(
        &self,
        method: Method,
        path: &str,
        headers: &[(&str, &str)],
        body: Bytes,
    ) -> Answer {
        let stream = TcpStream::connect(self.address).await.expect("the node listens");
        let (mut sender, connection) =
            http1::handshake(TokioIo::new(stream)).await.expect("HTTP/1.1");
        let connection = tokio::spawn(connection);
        let mut request = Request::builder().method(method).uri(path);
        request = request.header("host", self.address.to_string());
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let request = request.body(Full::new(body)).expect("a request");
        let (head, body) = sender.send_request(request).await.expect("an answer").into_parts();
        let body = body.collect().await.expect("a whole body").to_bytes();
        drop(sender);
        // The server may close its side first, after an answer to an oversized request.
        let _ = connection.await.expect("no panic");
        let text = |value: &::http::HeaderValue| value.to_str().expect("text").to_owned();
        let headers =
            head.headers.iter().map(|(name, value)| (name.to_string(), text(value))).collect();
        Answer { status: head.status, headers, body }
    }

    /// The value of a metric, of all its labels together; 0 if it never moved.
    pub(crate) async fn metric(&self, name: &str) -> f64 {
        let answer = self.get("/metrics").await;
        let lines = answer.text().lines().filter(|line| line.starts_with(name));
        let values = lines.filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok());
        // A sum of nothing would be -0.0.
        values.fold(0.0, |sum, value| sum + value)
    }
}

/// Faulty fields in the details of a gRPC status.
pub(crate) fn grpc_fields(status: &Status) -> Vec<String> {
    let bad_request = status.get_details_bad_request();
    let violations = bad_request.into_iter().flat_map(|bad| bad.field_violations);
    violations.map(|violation| violation.field).collect()
}

/// A detail of a JSON error.
pub(crate) fn detail<'a>(error: &'a Value, kind: &str) -> Option<&'a Value> {
    let suffix = format!("google.rpc.{kind}");
    let details = error["details"].as_array()?;
    details.iter().find(|detail| detail["@type"].as_str().is_some_and(|t| t.ends_with(&suffix)))
}

/// Faulty fields in the details of a JSON error.
pub(crate) fn json_fields(error: &Value) -> Vec<String> {
    let violations = detail(error, "BadRequest").and_then(|d| d["fieldViolations"].as_array());
    let field = |violation: &Value| violation["field"].as_str().expect("text").to_owned();
    violations.into_iter().flatten().map(field).collect()
}

/// A step of `controller` (a field of `StepRequest`) from `measurement`.
pub(crate) fn step_request(controller: (&str, Value), measurement: Value) -> v1::StepRequest {
    missions::message(json!({ controller.0: controller.1, "measurement": measurement }))
}
