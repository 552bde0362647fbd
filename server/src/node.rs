//! A node: the port, its connections, and their end.

use std::{
    convert::Infallible,
    io,
    net::SocketAddr,
    sync::{Arc, Weak},
    time::Duration,
};

use crate::{
    compute::Compute,
    config::{Config, ConfigFault, StoreLocation},
    service::Service,
    store::{DirectoryStore, MemoryStore, Store, StoreError, Syncing},
    telemetry::Metrics,
    transport::{Front, TransportOptions},
    wire::InfoAnswer,
};
use axum::body::Body;
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::{conn::auto, graceful::GracefulShutdown},
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::{Semaphore, watch},
    task::{JoinHandle, JoinSet},
    time::timeout,
};

/// A running server.
#[derive(Debug)]
pub struct Node {
    local_address: SocketAddr,
    draining: watch::Sender<bool>,
    service: Arc<Service>,
    task: JoinHandle<()>,
}

/// Why a node did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The configuration; every fault.
    #[error("bad configuration: {}", join(.0))]
    Config(Vec<ConfigFault>),
    /// The port cannot be had.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The artifact store cannot be opened.
    #[error("cannot open the artifact store: {0}")]
    Store(String),
    /// The system gives no thread.
    #[error("cannot start the compute threads: {0}")]
    Threads(io::Error),
}

fn join(faults: &[ConfigFault]) -> String {
    faults.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
}

impl Node {
    /// Starts to answer calls.
    ///
    /// # Errors
    /// [`StartError`]; nothing runs then.
    pub async fn start(config: Config) -> Result<Self, StartError> {
        let faults = config.faults();
        if !faults.is_empty() {
            return Err(StartError::Config(faults));
        }
        let address = config.listen;
        let refused = |source| StartError::Listen { address, source };
        let listener = TcpListener::bind(address).await.map_err(refused)?;
        let local_address = listener.local_addr().map_err(refused)?;
        let metrics = Arc::new(Metrics::new());
        let compute = Compute::start(
            config.compute_threads,
            config.compute_wait,
            config.compute_waiting_max,
            Arc::clone(&metrics),
        )
        .map_err(StartError::Threads)?;
        let info = InfoAnswer {
            limits: config.limits,
            request_bytes_max: config.request_bytes_max,
            compute_threads: config.compute_threads,
            computation_time_max: config.computation_time_max,
        };
        let service = {
            let (config, metrics) = (config.clone(), Arc::clone(&metrics));
            let open = move || {
                let store = store(&config).map_err(io::Error::other)?;
                Service::open(compute, store, &config, metrics, info)
            };
            // It reads what the store remembers, and may wait for a process that is just ending.
            let opened = tokio::task::spawn_blocking(open).await.map_err(io::Error::other);
            opened
                .and_then(|opened| opened)
                .map_err(|fault| StartError::Store(fault.to_string()))?
        };
        let service = Arc::new(service);
        let rest = config.artifact_lifetime.min(config.operation_lifetime) / 8;
        tokio::spawn(sweep(Arc::downgrade(&service), rest));
        let (draining, drain) = watch::channel(false);
        let options = TransportOptions {
            request_bytes_max: config.request_bytes_max,
            receive_time_max: config.receive_time_max,
            draining: drain.clone(),
        };
        let front = Front::new(Arc::clone(&service), options).await;
        tracing::info!(%local_address, "listening");
        let port = Port { front, metrics, config };
        let task = tokio::spawn(port.serve(listener, drain));
        Ok(Self { local_address, draining, service, task })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_address(&self) -> SocketAddr {
        self.local_address
    }

    /// Stops: readiness off, no new connections, closed loops told to go elsewhere, precomputes
    /// handed back to the store, calls under way finished within the grace period.
    pub async fn shutdown(self) {
        self.draining.send_replace(true);
        let service = self.service;
        if let Err(fault) = tokio::task::spawn_blocking(move || service.stop()).await {
            tracing::error!(%fault, "jobs were not handed back");
        }
        if let Err(fault) = self.task.await {
            tracing::error!(%fault, "the node did not stop well");
        }
    }
}

fn store(config: &Config) -> Result<Arc<dyn Store>, StoreError> {
    let syncing = if config.store_sync { Syncing::EveryWrite } else { Syncing::LeftToTheSystem };
    Ok(match &config.store {
        StoreLocation::Memory { bytes_max } => Arc::new(MemoryStore::new(*bytes_max)),
        StoreLocation::Directory(root) => Arc::new(DirectoryStore::open(root, syncing)?),
    })
}

/// Sweeps now and then for as long as the service lives, with `rest` in between.
async fn sweep(service: Weak<Service>, rest: Duration) {
    const SHORTEST: Duration = Duration::from_millis(50);
    const LONGEST: Duration = Duration::from_secs(60);
    loop {
        tokio::time::sleep(rest.clamp(SHORTEST, LONGEST)).await;
        let Some(service) = service.upgrade() else { return };
        if let Err(fault) = tokio::task::spawn_blocking(move || service.sweep()).await {
            tracing::error!(%fault, "sweeping");
        }
    }
}

/// Accepts connections.
struct Port {
    front: Front,
    metrics: Arc<Metrics>,
    config: Config,
}

impl Port {
    async fn serve(self, listener: TcpListener, mut draining: watch::Receiver<bool>) {
        let slots = Arc::new(Semaphore::new(self.config.connections_max));
        let graceful = GracefulShutdown::new();
        // Dropped at the end, and with it whatever is still open.
        let mut connections = JoinSet::new();
        loop {
            // If the node is dropped without a shutdown, its port closes all the same.
            let accepted = tokio::select! {
                accepted = listener.accept() => accepted,
                _ = draining.wait_for(|draining| *draining) => break,
            };
            match accepted {
                Ok((stream, _)) => match Arc::clone(&slots).try_acquire_owned() {
                    Ok(slot) => {
                        let connection = self.connection(stream, graceful.watcher());
                        while connections.try_join_next().is_some() {}
                        connections.spawn(async move {
                            connection.await;
                            drop(slot);
                        });
                    }
                    Err(_) => {
                        self.metrics.connections_refused.inc();
                    }
                },
                // Out of file descriptors, or a connection gone before it was accepted: wait a
                // little rather than spin.
                Err(fault) => {
                    tracing::warn!(%fault, "accepting a connection");
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            }
        }
        drop(listener);
        if timeout(self.config.shutdown_grace, graceful.shutdown()).await.is_err() {
            tracing::warn!("calls were still under way when the grace period ended");
        }
    }

    /// One connection, from its first byte to its end.
    fn connection(
        &self,
        stream: TcpStream,
        watcher: hyper_util::server::graceful::Watcher,
    ) -> impl Future<Output = ()> + Send + 'static {
        let builder = self.builder();
        let front = self.front.clone();
        let metrics = Arc::clone(&self.metrics);
        let receive_time_max = self.config.receive_time_max;
        async move {
            metrics.connections.inc();
            let _open = Open(metrics);
            // Small answers must not wait for one another's acknowledgements.
            if let Err(fault) = stream.set_nodelay(true) {
                tracing::debug!(%fault, "TCP_NODELAY");
            }
            let builder = match timeout(receive_time_max, speaks_http2(&stream)).await {
                Ok(Ok(true)) => builder.http2_only(),
                Ok(Ok(false)) => builder.http1_only(),
                // Gone, or silent for too long.
                Ok(Err(_)) | Err(_) => return,
            };
            let answer = hyper::service::service_fn(move |request: hyper::Request<_>| {
                let front = front.clone();
                async move { Ok::<_, Infallible>(front.answer(request.map(Body::new)).await) }
            });
            let connection = builder.serve_connection(TokioIo::new(stream), answer);
            if let Err(fault) = watcher.watch(connection.into_owned()).await {
                tracing::debug!(%fault, "connection");
            }
        }
    }

    fn builder(&self) -> auto::Builder<TokioExecutor> {
        const HEADERS_MAX: usize = 64;
        const HEADER_BYTES_MAX: u32 = 32 << 10;
        /// A peer that is gone without a word is noticed after about a minute.
        const PING_EVERY: Duration = Duration::from_secs(40);
        const PING_ANSWERED_WITHIN: Duration = Duration::from_secs(20);
        let mut builder = auto::Builder::new(TokioExecutor::new());
        builder
            .http1()
            .timer(TokioTimer::new())
            .header_read_timeout(self.config.receive_time_max)
            .max_headers(HEADERS_MAX)
            .max_buf_size(64 << 10);
        builder
            .http2()
            .timer(TokioTimer::new())
            .max_concurrent_streams(self.config.streams_max)
            .max_header_list_size(HEADER_BYTES_MAX)
            .keep_alive_interval(PING_EVERY)
            .keep_alive_timeout(PING_ANSWERED_WITHIN);
        builder
    }
}

/// Whether a connection begins with the preface of HTTP/2 (RFC 9113, sec. 3.4).
///
/// Looked at here and not by the HTTP library, because it would wait for a preface for ever.
async fn speaks_http2(stream: &TcpStream) -> io::Result<bool> {
    const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    let mut begin = [0; PREFACE.len()];
    loop {
        let length = stream.peek(&mut begin).await?;
        if length == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        if begin[..length] != PREFACE[..length] {
            return Ok(false);
        }
        if length == PREFACE.len() {
            return Ok(true);
        }
        // The rest of a preface that came in pieces; peeking again gives the same bytes at once.
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Counts an open connection until it is dropped.
struct Open(Arc<Metrics>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.connections.dec();
    }
}
