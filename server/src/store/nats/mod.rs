//! Records, entries and tasks on NATS JetStream, for any number of machines.
//!
//! ```text
//! KV     <name>_artifacts, _plans, _problems, _shards   id → {sha256, size, object}
//! KV     <name>_jobs, _requests, _leases                id → an entry's bytes
//! OBJ    <name>_content                                 <shelf>.<id>.<sha256>.<nonce> → a record's bytes
//! STREAM <name>_tasks                                   <name>.tasks.<group>, a work queue
//! core   <name>.words                                   what machines tell one another
//! ```
//!
//! An object store has no conditional put. So a record's bytes are put under a name that nobody
//! else uses, and the key, created exactly once, is the commit: whoever loses removes his bytes
//! again. Bytes that a crash left without a key are removed by [`NatsStore::tidy`]. Keys are read
//! from a stream's leader, never from a replica that lags.
//!
//! Every operation may be repeated: writes carry the revision that they follow, and one whose answer
//! was lost is recognised by its bytes. They are repeated for [`NatsLocation::patience`] and then
//! answered with [`StoreError::Unreachable`]; at once where the connection has been gone for a
//! while.

mod location;
mod records;
mod tasks;

use std::{
    fmt::Display,
    io,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use async_nats::{
    Client, ConnectOptions, Event,
    jetstream::{
        Context,
        consumer::{Consumer, pull},
        context::ContextBuilder,
        kv,
        object_store::ObjectStore,
        stream::{self, DiscardPolicy, RetentionPolicy, StorageType},
    },
};
use tokio::{
    runtime::{self, Handle, Runtime},
    sync::watch,
    task::JoinSet,
};

use super::{Ledger, Shelf, StoreError};
pub use location::NatsLocation;
pub(crate) use location::without_user;
#[cfg(feature = "fuzzing")]
pub(super) use records::commit_rewritten;

/// A store on NATS JetStream. Its calls block: they are not for threads of the runtime.
pub(crate) struct NatsStore {
    /// Its own, so that it lives as long as anybody uses the store.
    runtime: Own,
    location: NatsLocation,
    on: Servers,
    /// The one consumer of the work queue, as it was when it was last used.
    workers: Mutex<Option<Consumer<pull::Config>>>,
    words: String,
    /// Loops that follow and hear end with the store.
    listening: Mutex<JoinSet<()>>,
}

/// What a store has on its servers, and the way there.
struct Servers {
    client: Client,
    context: Context,
    shelves: [kv::Store; Shelf::ALL.len()],
    ledgers: [kv::Store; Ledger::ALL.len()],
    content: ObjectStore,
    /// The stream beneath it.
    pieces: stream::Stream,
    tasks: stream::Stream,
    /// Since when there is no connection.
    gone: watch::Receiver<Option<Instant>>,
}

/// A runtime that can be dropped wherever the last user of the store is.
struct Own(Option<Runtime>);

impl Own {
    fn handle(&self) -> &Handle {
        self.0.as_ref().expect("it is there until it is dropped").handle()
    }
}

impl Drop for Own {
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

impl std::fmt::Debug for NatsStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Addresses can hold passwords.
        f.debug_struct("NatsStore").field("name", &self.location.name).finish_non_exhaustive()
    }
}

/// One answer must come within this time before it is asked for again.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);
/// Servers that are started together with a node answer within this time.
const STARTED_WITHIN: Duration = Duration::from_secs(30);
/// A connection that is gone for so long is not waited for.
const GONE_FOR: Duration = Duration::from_millis(500);

impl NatsStore {
    /// Connects, and makes what is not there yet. Blocks.
    ///
    /// # Errors
    /// If no server answers, or what is there was made otherwise.
    pub(crate) fn connect(location: NatsLocation) -> Result<Self, StoreError> {
        let runtime = runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("nats")
            .enable_all()
            .build()
            .map_err(|source| StoreError::Io { doing: "starting a thread".to_owned(), source })?;
        let runtime = Own(Some(runtime));
        let handle = runtime.handle().clone();
        let on = handle.block_on(Self::reach_out(&location))?;
        let words = format!("{}.words", location.name);
        let (workers, listening) = (Mutex::default(), Mutex::default());
        Ok(Self { runtime, location, on, workers, words, listening })
    }

    async fn reach_out(location: &NatsLocation) -> Result<Servers, StoreError> {
        let (tell_gone, gone) = watch::channel(None);
        let tell_gone = Arc::new(tell_gone);
        let mut connect = ConnectOptions::new()
            .name("vbar")
            .connection_timeout(ANSWERED_WITHIN)
            .request_timeout(Some(ANSWERED_WITHIN))
            .ping_interval(Duration::from_secs(5))
            .retry_on_initial_connect()
            .reconnect_delay_callback(|attempts| {
                const LONGEST: u64 = 1000;
                let attempts = u64::try_from(attempts).unwrap_or(u64::MAX);
                Duration::from_millis(attempts.saturating_mul(50).min(LONGEST))
            })
            .event_callback(move |event| {
                let tell_gone = Arc::clone(&tell_gone);
                async move {
                    match event {
                        Event::Connected => {
                            tracing::info!("connected to NATS");
                            tell_gone.send_replace(None);
                        }
                        Event::Disconnected => {
                            tracing::warn!("the connection to NATS is gone");
                            let gone = Some(Instant::now());
                            tell_gone.send_if_modified(|since| {
                                since.is_none() && {
                                    *since = gone;
                                    true
                                }
                            });
                        }
                        event => tracing::debug!(%event, "NATS"),
                    }
                }
            });
        if let Some(path) = &location.credentials {
            let unreadable = |source| StoreError::Io {
                doing: format!("reading credentials from {}", path.display()),
                source,
            };
            connect = connect.credentials_file(path).await.map_err(unreadable)?;
        }
        let client = connect.connect(&location.servers).await.map_err(unreachable)?;
        let context = ContextBuilder::new().timeout(ANSWERED_WITHIN).build(client.clone());
        let until = Instant::now() + location.patience.max(STARTED_WITHIN);
        loop {
            match Self::open(&client, &context, location, &gone).await {
                // A cluster that is just starting has no leader yet.
                Err(StoreError::Unreachable(why)) if Instant::now() < until => {
                    tracing::info!(why, "waiting for NATS");
                    tokio::time::sleep(Duration::from_millis(250)).await;
                }
                opened => return opened,
            }
        }
    }

    async fn open(
        client: &Client,
        context: &Context,
        location: &NatsLocation,
        gone: &watch::Receiver<Option<Instant>>,
    ) -> Result<Servers, StoreError> {
        let name = &location.name;
        let bucket = async |kind: &str| -> Result<kv::Store, StoreError> {
            let bucket = format!("{name}_{kind}");
            let subjects = vec![format!("$KV.{bucket}.>")];
            made(context, location, kept(format!("KV_{bucket}"), subjects)).await?;
            context.get_key_value(bucket).await.map_err(unreachable)
        };
        let [artifacts, plans, problems, shards] = Shelf::ALL.map(Shelf::name);
        let [jobs, requests, leases] = Ledger::ALL.map(Ledger::name);
        let shelves = [
            bucket(artifacts).await?,
            bucket(plans).await?,
            bucket(problems).await?,
            bucket(shards).await?,
        ];
        let ledgers = [bucket(jobs).await?, bucket(requests).await?, bucket(leases).await?];
        let content = format!("{name}_content");
        let subjects = vec![format!("$O.{content}.C.>"), format!("$O.{content}.M.>")];
        // Chunks have one subject together: there must be no bound on messages of a subject.
        let chunks = stream::Config {
            max_messages_per_subject: -1,
            deny_delete: false,
            ..kept(format!("OBJ_{content}"), subjects)
        };
        let pieces = made(context, location, chunks).await?;
        let content = context.get_object_store(content).await.map_err(unreachable)?;
        let tasks = made(
            context,
            location,
            stream::Config {
                name: format!("{name}_tasks"),
                subjects: vec![format!("{name}.tasks.*")],
                retention: RetentionPolicy::WorkQueue,
                discard: DiscardPolicy::New,
                max_messages: i64::try_from(location.tasks_max).unwrap_or(i64::MAX),
                duplicate_window: Duration::from_secs(60),
                ..stream::Config::default()
            },
        )
        .await?;
        Ok(Servers {
            client: client.clone(),
            context: context.clone(),
            shelves,
            ledgers,
            content,
            pieces,
            tasks,
            gone: gone.clone(),
        })
    }

    fn shelf(&self, shelf: Shelf) -> &kv::Store {
        &self.on.shelves[shelf as usize]
    }

    fn ledger(&self, ledger: Ledger) -> &kv::Store {
        &self.on.ledgers[ledger as usize]
    }

    /// Whether the connection has been gone for too long to wait for it.
    fn is_gone(&self) -> bool {
        self.on.gone.borrow().is_some_and(|since| since.elapsed() > GONE_FOR)
    }

    /// Does something that may be repeated, until it is answered or patience ends. Blocks.
    fn attempt<T, F: Future<Output = Result<T, Refused>>>(
        &self,
        doing: &str,
        operation: impl Fn() -> F,
    ) -> Result<T, StoreError> {
        self.attempt_within(doing, ANSWERED_WITHIN, operation)
    }

    /// The same for what takes longer.
    fn attempt_within<T, F: Future<Output = Result<T, Refused>>>(
        &self,
        doing: &str,
        answered_within: Duration,
        operation: impl Fn() -> F,
    ) -> Result<T, StoreError> {
        const REST: Duration = Duration::from_millis(100);
        let until = Instant::now() + self.location.patience;
        self.runtime.handle().block_on(async {
            loop {
                let why = if self.is_gone() {
                    let gone = "no server is connected".to_owned();
                    return Err(StoreError::Unreachable(format!("{doing}: {gone}")));
                } else {
                    match tokio::time::timeout(answered_within, operation()).await {
                        Ok(Ok(done)) => return Ok(done),
                        Ok(Err(Refused::For(fault))) => return Err(fault),
                        Ok(Err(Refused::Unanswered(why))) => why,
                        Err(_) => "timed out".to_owned(),
                    }
                };
                if Instant::now() >= until {
                    return Err(StoreError::Unreachable(format!("{doing}: {why}")));
                }
                tracing::debug!(doing, why, "asking NATS again");
                tokio::time::sleep(REST).await;
            }
        })
    }
}

/// Why an operation did not come to its end.
enum Refused {
    /// It was answered so.
    For(StoreError),
    /// It was not answered, or not by whoever could.
    Unanswered(String),
}

impl Refused {
    fn unanswered(fault: impl Display) -> Self {
        Self::Unanswered(fault.to_string())
    }
}

fn unreachable(fault: impl Display) -> StoreError {
    StoreError::Unreachable(fault.to_string())
}

/// A stream of which the latest message of each subject is kept.
fn kept(name: String, subjects: Vec<String>) -> stream::Config {
    stream::Config {
        name,
        subjects,
        max_messages_per_subject: 1,
        discard: DiscardPolicy::New,
        allow_rollup: true,
        deny_delete: true,
        allow_message_ttl: true,
        // Replicas lag behind their leader.
        allow_direct: false,
        ..stream::Config::default()
    }
}

async fn made(
    context: &Context,
    location: &NatsLocation,
    config: stream::Config,
) -> Result<stream::Stream, StoreError> {
    let config =
        stream::Config { storage: StorageType::File, num_replicas: location.replicas, ..config };
    let (name, replicas) = (config.name.clone(), config.num_replicas);
    let stream = context
        .get_or_create_stream(config)
        .await
        .map_err(|fault| StoreError::Unreachable(format!("making the stream {name}: {fault}")))?;
    let found = stream.cached_info().config.num_replicas;
    if found != replicas {
        let what = format!("the stream {name} has {found} replicas, {replicas} are configured");
        return Err(StoreError::Io { doing: "opening".to_owned(), source: io::Error::other(what) });
    }
    Ok(stream)
}
