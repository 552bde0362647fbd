//! A node: the port, its connections, and their end.

use std::{
    convert::Infallible,
    io,
    net::{IpAddr, SocketAddr},
    path::Path,
    sync::{Arc, Weak},
    time::Duration,
};

use crate::{
    access::{Gate, OptionFault, Peer},
    compute::{Compute, ComputeLimits},
    config::{Config, ConfigFault, StoreLocation},
    recording::{Recorder, Session},
    service::{OpenStore, Service},
    store::{DirectoryStore, MemoryStore, NatsStore, StoreError, Syncing},
    telemetry::{Metrics, OutcomeLabels},
    transport::{Front, Role, TransportOptions},
    wire::{BUILD, InfoAnswer},
};
use axum::body::Body;
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::{
        conn::auto,
        graceful::{GracefulShutdown, Watcher},
    },
};
use rustls::ServerConfig;
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite},
    net::{TcpListener, TcpStream},
    sync::{Semaphore, watch},
    task::{JoinHandle, JoinSet},
    time::timeout,
};
use tokio_rustls::TlsAcceptor;

/// A running server.
#[derive(Debug)]
pub struct Node {
    local_address: SocketAddr,
    draining: watch::Sender<bool>,
    service: Arc<Service>,
    gate: Arc<Gate>,
    recorder: Option<Arc<Recorder>>,
    shutdown_grace: Duration,
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
        Self::start_as(Role::Node, config).await
    }

    /// Starts to do parts of jobs that nodes with the same store take orders for. On its port it
    /// tells only how it is.
    ///
    /// # Errors
    /// [`StartError`], also if the store is not one that others reach; nothing runs then.
    pub async fn start_worker(config: Config) -> Result<Self, StartError> {
        Self::start_as(Role::Worker, config).await
    }

    async fn start_as(role: Role, config: Config) -> Result<Self, StartError> {
        let mut faults = config.faults();
        if role == Role::Worker {
            faults.extend(config.worker_faults());
        }
        if !faults.is_empty() {
            return Err(StartError::Config(faults));
        }
        let address = config.listen;
        let refused = |source| StartError::Listen { address, source };
        let listener = TcpListener::bind(address).await.map_err(refused)?;
        let local_address = listener.local_addr().map_err(refused)?;
        let metrics = Arc::new(Metrics::new());
        let gate = {
            let (options, metrics) = (config.access.clone(), Arc::clone(&metrics));
            let open = move || Gate::open(options, metrics);
            let opened = tokio::task::spawn_blocking(open).await;
            let failed =
                |fault: tokio::task::JoinError| StartError::Threads(io::Error::other(fault));
            let named = |faults: Vec<OptionFault>| faults.into_iter().map(Into::into).collect();
            Arc::new(opened.map_err(failed)?.map_err(|faults| StartError::Config(named(faults)))?)
        };
        tokio::spawn(reload(Arc::downgrade(&gate), gate.poll()));
        let recorder = {
            let (config, metrics) = (config.clone(), Arc::clone(&metrics));
            let opened = tokio::task::spawn_blocking(move || recorder(&config, metrics)).await;
            opened.map_err(|fault| StartError::Threads(io::Error::other(fault)))??
        };
        let limits = ComputeLimits {
            threads: config.compute_threads,
            wait_max: config.compute_wait,
            overload_wait_max: config.compute_overload_wait,
            patient_wait_max: config.compute_patient_wait,
            waiting_max: config.compute_waiting_max,
        };
        let compute = Compute::start(limits, Arc::clone(&metrics)).map_err(StartError::Threads)?;
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
            role,
        };
        let front =
            Front::new(Arc::clone(&service), Arc::clone(&gate), recorder.clone(), options).await;
        tracing::info!(%local_address, "listening");
        let shutdown_grace = config.shutdown_grace;
        let port = Port { front, gate: Arc::clone(&gate), metrics, config };
        let task = tokio::spawn(port.serve(listener, drain));
        Ok(Self { local_address, draining, service, gate, recorder, shutdown_grace, task })
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
        let (service, grace) = (self.service, self.shutdown_grace);
        let stop = tokio::task::spawn_blocking(move || service.stop(grace));
        let (stopped, ended) = tokio::join!(stop, self.task);
        if let Err(fault) = stopped {
            tracing::error!(%fault, "jobs were not handed back");
        }
        if let Err(fault) = ended {
            tracing::error!(%fault, "the node did not stop well");
        }
        let (gate, recorder) = (self.gate, self.recorder);
        let close = move || {
            gate.audit().close();
            if let Some(recorder) = recorder {
                recorder.close();
            }
        };
        if let Err(fault) = tokio::task::spawn_blocking(close).await {
            tracing::error!(%fault, "closing the audit file and the recording");
        }
    }
}

/// Opens the recording, if there is to be one; blocks.
fn recorder(config: &Config, metrics: Arc<Metrics>) -> Result<Option<Arc<Recorder>>, StartError> {
    let session = Session {
        build_version: BUILD.version.to_owned(),
        build_sha256: BUILD.sha256.to_owned(),
        settings: config.answering().to_toml(),
        ..Session::default()
    };
    let opened = Recorder::open(&config.recording, session, metrics).map_err(|fault| {
        let path = config.recording.file.as_deref().unwrap_or(Path::new("")).display();
        StartError::Config(vec![ConfigFault {
            setting: "record_file",
            expected: "a file that can be written".to_owned(),
            got: format!("{path}: {fault}"),
        }])
    })?;
    Ok(opened.map(Arc::new))
}

/// Opens the store; blocks.
fn store(config: &Config) -> Result<OpenStore, StoreError> {
    let syncing = if config.store_sync { Syncing::EveryWrite } else { Syncing::LeftToTheSystem };
    Ok(match &config.store {
        StoreLocation::Memory { bytes_max } => {
            OpenStore::Own(Arc::new(MemoryStore::new(*bytes_max)))
        }
        StoreLocation::Directory(root) => {
            OpenStore::Own(Arc::new(DirectoryStore::open(root, syncing)?))
        }
        StoreLocation::Nats(location) => {
            OpenStore::Shared(Arc::new(NatsStore::connect(location.clone())?))
        }
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

/// Reads the credentials again now and then for as long as the gate stands.
async fn reload(gate: Weak<Gate>, rest: Duration) {
    loop {
        tokio::time::sleep(rest).await;
        let Some(gate) = gate.upgrade() else { return };
        if let Err(fault) = tokio::task::spawn_blocking(move || gate.reload()).await {
            tracing::error!(%fault, "reading the credentials again");
        }
    }
}

/// Accepts connections.
struct Port {
    front: Front,
    gate: Arc<Gate>,
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
                Ok((stream, peer)) => {
                    let address = peer.ip();
                    let place = self.gate.connection(address);
                    let Some(places) = place.zip(Arc::clone(&slots).try_acquire_owned().ok())
                    else {
                        self.metrics.connections_refused.inc();
                        continue;
                    };
                    let connection = self.connection(stream, address, graceful.watcher());
                    while connections.try_join_next().is_some() {}
                    connections.spawn(async move {
                        connection.await;
                        drop(places);
                    });
                }
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
        address: IpAddr,
        watcher: Watcher,
    ) -> impl Future<Output = ()> + Send + 'static {
        let builder = self.builder();
        let front = self.front.clone();
        let metrics = Arc::clone(&self.metrics);
        let receive_time_max = self.config.receive_time_max;
        let tls = self.gate.tls();
        async move {
            metrics.connections.inc();
            let _open = Open(Arc::clone(&metrics));
            // Small answers must not wait for one another's acknowledgements.
            if let Err(fault) = stream.set_nodelay(true) {
                tracing::debug!(%fault, "TCP_NODELAY");
            }
            // Gone, or silent for too long: nobody is left to tell.
            match tls {
                None => {
                    let begin = timeout(receive_time_max, speaks_http2(&stream)).await;
                    let Ok(Ok(is_http2)) = begin else { return };
                    let peer = Peer::new(address, None);
                    serve(builder, is_http2, stream, peer, front, watcher).await;
                }
                Some(tls) => {
                    let begin = timeout(receive_time_max, encrypted(stream, tls)).await;
                    let outcome = match &begin {
                        Ok(Ok(_)) => "completed",
                        Ok(Err(_)) => "failed",
                        Err(_) => "slow",
                    };
                    metrics.tls_handshakes.get_or_create(&OutcomeLabels { outcome }).inc();
                    let (stream, is_http2, certificate) = match begin {
                        Ok(Ok(begun)) => begun,
                        Ok(Err(fault)) => {
                            tracing::debug!(%fault, %address, "TLS");
                            return;
                        }
                        Err(_) => return,
                    };
                    let peer = Peer::new(address, certificate.as_deref());
                    serve(builder, is_http2, stream, peer, front, watcher).await;
                }
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

/// The preface of HTTP/2.
const PREFACE: &[u8; 24] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Whether a connection begins with the preface of HTTP/2 (RFC 9113, sec. 3.4).
///
/// Looked at here and not by the HTTP library, because it would wait for a preface for ever.
async fn speaks_http2(stream: &TcpStream) -> io::Result<bool> {
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

/// A connection that was encrypted, whether it speaks HTTP/2, and the caller's certificate in DER.
///
/// It has already said something: a caller that is silent after the handshake does not get here.
async fn encrypted(
    stream: TcpStream,
    config: Arc<ServerConfig>,
) -> io::Result<(impl AsyncRead + AsyncWrite + Send + Unpin + 'static, bool, Option<Vec<u8>>)> {
    let mut stream = TlsAcceptor::from(config).accept(stream).await?;
    let (_, session) = stream.get_ref();
    let is_http2 = session.alpn_protocol() == Some(b"h2");
    let certificate = session.peer_certificates().and_then(|chain| Some(chain.first()?.to_vec()));
    let mut begin = vec![0; PREFACE.len()];
    // Any first byte will do for HTTP/1, whose head has a time limit of its own; HTTP/2 has none
    // for its preface.
    let least = if is_http2 { begin.len() } else { 1 };
    let mut length = 0;
    while length < least {
        match stream.read(&mut begin[length..]).await? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            more => length += more,
        }
    }
    begin.truncate(length);
    let (reader, writer) = tokio::io::split(stream);
    let whole = tokio::io::join(io::Cursor::new(begin).chain(reader), writer);
    Ok((whole, is_http2, certificate))
}

/// Answers the requests of one connection until it ends.
async fn serve(
    builder: auto::Builder<TokioExecutor>,
    is_http2: bool,
    stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
    peer: Peer,
    front: Front,
    watcher: Watcher,
) {
    let builder = if is_http2 { builder.http2_only() } else { builder.http1_only() };
    let peer = Arc::new(peer);
    let answer = hyper::service::service_fn(move |request: hyper::Request<_>| {
        let (front, peer) = (front.clone(), Arc::clone(&peer));
        async move { Ok::<_, Infallible>(front.answer(request.map(Body::new), &peer).await) }
    });
    let connection = builder.serve_connection(TokioIo::new(stream), answer);
    if let Err(fault) = watcher.watch(connection.into_owned()).await {
        tracing::debug!(%fault, "connection");
    }
}

/// Counts an open connection until it is dropped.
struct Open(Arc<Metrics>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.connections.dec();
    }
}
