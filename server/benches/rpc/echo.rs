//! The yardstick: bytes in, the same bytes out, over the same stack as the node (axum's router,
//! tonic, hyper, `TCP_NODELAY`) and with nothing of the node's own.

use std::{convert::Infallible, net::SocketAddr, pin::Pin, task};

use bytes::{Buf as _, BufMut as _, Bytes};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::conn::auto,
};
use tokio::net::TcpListener;
use tonic::{
    Request, Response, Status, Streaming,
    body::Body,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    server::{Grpc, NamedService},
    service::Routes,
};
use tower::ServiceExt as _;

pub(crate) const UNARY: &str = "/vbar.bench.Echo/Unary";
pub(crate) const STREAM: &str = "/vbar.bench.Echo/Stream";

/// Starts to answer on a port of its own.
pub(crate) async fn start() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    let router = Routes::new(Echo).into_axum_router();
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.expect("a connection");
            stream.set_nodelay(true).expect("TCP_NODELAY");
            let router = router.clone();
            let service = hyper::service::service_fn(move |request: http::Request<_>| {
                router.clone().oneshot(request.map(axum::body::Body::new))
            });
            tokio::spawn(async move {
                let mut builder = auto::Builder::new(TokioExecutor::new());
                builder.http2().timer(TokioTimer::new());
                let _ = builder.http2_only().serve_connection(TokioIo::new(stream), service).await;
            });
        }
    });
    address
}

#[derive(Clone)]
struct Echo;

impl NamedService for Echo {
    const NAME: &'static str = "vbar.bench.Echo";
}

impl tower::Service<http::Request<Body>> for Echo {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Infallible>> + Send>>;

    fn poll_ready(&mut self, _: &mut task::Context<'_>) -> task::Poll<Result<(), Infallible>> {
        task::Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(async move {
            let mut grpc = Grpc::new(Raw);
            Ok(match request.uri().path() {
                UNARY => {
                    let echo = |request: Request<Bytes>| async {
                        Ok::<_, Status>(Response::new(request.into_inner()))
                    };
                    grpc.unary(tower::service_fn(echo), request).await
                }
                STREAM => {
                    let echo = |request: Request<Streaming<Bytes>>| async {
                        Ok::<_, Status>(Response::new(request.into_inner()))
                    };
                    grpc.streaming(tower::service_fn(echo), request).await
                }
                _ => Status::unimplemented("an echo").into_http(),
            })
        })
    }
}

/// Messages as they are.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, out: &mut EncodeBuf<'_>) -> Result<(), Status> {
        out.put(item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, bytes: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(bytes.copy_to_bytes(bytes.remaining())))
    }
}
