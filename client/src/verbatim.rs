//! Calls whose messages are sent and taken as they are: what was recorded, asked again.

use http::{Method, uri::PathAndQuery};
use prost::bytes::{Buf as _, BufMut as _, Bytes};
use tokio::{sync::mpsc, time::timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::Service as _;
use tonic::{
    Code, Request, Status, Streaming,
    body::Body,
    client::Grpc,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
};

use crate::{Client, Error, client::Transport};

/// Messages are bytes.
#[derive(Debug, Clone, Copy, Default)]
struct Verbatim;

impl Codec for Verbatim {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        *self
    }

    fn decoder(&mut self) -> Self {
        *self
    }
}

impl Encoder for Verbatim {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, message: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(message);
        Ok(())
    }
}

impl Decoder for Verbatim {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(buffer.copy_to_bytes(buffer.remaining())))
    }
}

/// A closed loop whose messages are bytes.
#[derive(Debug)]
pub struct VerbatimLoop {
    client: Client,
    requests: mpsc::Sender<Bytes>,
    answers: Streaming<Bytes>,
}

impl VerbatimLoop {
    /// Sends one message and takes its answer.
    ///
    /// # Errors
    /// [`Error`]; the loop is over then.
    pub async fn exchange(&mut self, request: Bytes) -> Result<Bytes, Error> {
        let closed = || Error::local(Code::Unavailable, "the node closed the stream");
        self.requests.send(request).await.map_err(|_| closed())?;
        let answer = self.answers.message();
        let answer = timeout(self.client.options.deadline, answer).await.map_err(|_| late())?;
        answer?.ok_or_else(closed)
    }
}

fn late() -> Error {
    Error::local(Code::DeadlineExceeded, "the node did not answer in time")
}

impl Client {
    /// Calls the RPC at `path`, such as `/vbar.v1.GuidanceService/Step`, with one message and
    /// takes all that are answered. Nothing is tried again.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a path that is none; [`Error`], as every call.
    pub async fn verbatim(&self, path: &str, request: Bytes) -> Result<Vec<Bytes>, Error> {
        let mut grpc = self.verbatim_grpc().await?;
        let mut message = Request::new(request);
        message.set_timeout(self.options.deadline);
        let answers = grpc.server_streaming(message, parse(path)?, Verbatim).await?;
        let mut answers = answers.into_inner();
        let mut taken = Vec::new();
        while let Some(answer) = answers.message().await? {
            taken.push(answer);
        }
        Ok(taken)
    }

    /// Opens the closed loop at `path`; its first message goes with it, since a node may read that
    /// before it answers at all.
    ///
    /// # Errors
    /// As [`Self::verbatim`].
    pub async fn verbatim_loop(
        &self,
        path: &str,
        first: Bytes,
    ) -> Result<(VerbatimLoop, Bytes), Error> {
        let mut grpc = self.verbatim_grpc().await?;
        let (requests, receiver) = mpsc::channel(1);
        let request = Request::new(ReceiverStream::new(receiver));
        requests.try_send(first).map_err(|_| Error::broken_contract("no room for a message"))?;
        let answers = grpc.streaming(request, parse(path)?, Verbatim).await?.into_inner();
        let mut opened = VerbatimLoop { client: self.clone(), requests, answers };
        let answer = timeout(self.options.deadline, opened.answers.message()).await;
        let answer = answer.map_err(|_| late())??;
        let closed = || Error::local(Code::Unavailable, "the node closed the stream");
        Ok((opened, answer.ok_or_else(closed)?))
    }

    /// Asks over HTTP with a body of JSON, or none if it is empty; the answer's status and body.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a method or path that is none, `RESOURCE_EXHAUSTED` for an answer
    /// larger than `message_bytes_max`; [`Error`], as every call. An answer that says what is
    /// wrong is an answer.
    pub async fn verbatim_http(
        &self,
        method: &str,
        path: &str,
        request: Bytes,
    ) -> Result<(u16, Bytes), Error> {
        let refused = |what: &str| Error::local(Code::InvalidArgument, what);
        let method: Method = method.parse().map_err(|_| refused("not a method of HTTP"))?;
        let mut builder = http::Request::builder().method(method).uri(parse(path)?.as_str());
        if !request.is_empty() {
            builder = builder.header(http::header::CONTENT_TYPE, "application/json");
        }
        let body = Body::new(http_body_util::Full::new(request));
        let message = builder.body(body).map_err(|fault| refused(&fault.to_string()))?;
        let exchange = async {
            let mut transport = self.ready().await?;
            let answer = transport.call(message).await.map_err(broken)?;
            let status = answer.status().as_u16();
            let most = self.options.message_bytes_max;
            let body = http_body_util::Limited::new(answer.into_body(), most);
            let body = http_body_util::BodyExt::collect(body).await.map_err(|fault| {
                let message = format!("the answer cannot be read whole: {fault}");
                Error::local(Code::ResourceExhausted, message)
            })?;
            Ok((status, body.to_bytes()))
        };
        timeout(self.options.deadline, exchange).await.map_err(|_| late())?
    }

    async fn verbatim_grpc(&self) -> Result<Grpc<Transport>, Error> {
        let size = self.options.message_bytes_max;
        let grpc = Grpc::new(self.transport.clone())
            .max_decoding_message_size(size)
            .max_encoding_message_size(size);
        let mut grpc = grpc;
        grpc.ready().await.map_err(broken)?;
        Ok(grpc)
    }

    async fn ready(&self) -> Result<Transport, Error> {
        let mut transport = self.transport.clone();
        std::future::poll_fn(|context| transport.poll_ready(context)).await.map_err(broken)?;
        Ok(transport)
    }
}

fn broken(fault: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Error {
    Status::from_error(fault.into()).into()
}

fn parse(path: &str) -> Result<PathAndQuery, Error> {
    path.parse().map_err(|_| Error::local(Code::InvalidArgument, format!("{path:?}: not a path")))
}
