//! Tasks, and what machines tell one another.

use std::{
    collections::HashMap,
    error::Error as _,
    sync::PoisonError,
    time::{Duration, SystemTime},
};

use async_nats::{
    Client,
    jetstream::{
        self, AckKind,
        consumer::{AckPolicy, Consumer, pull},
        context::PublishError,
        kv::{self, Operation},
        message::PublishMessage,
    },
};
use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _};
use tokio::runtime::Handle;

use super::{ANSWERED_WITHIN, NatsStore, Refused, records::LISTED_WITHIN, unreachable};
use crate::store::{
    Change, Entry, Follower, Hearer, Lease, Leased, Ledger, RecordId, Shared, Shelf, StoreError,
    Task, hex, unhex,
};

/// The one consumer of the work queue.
const WORKERS: &str = "workers";

impl NatsStore {
    fn subject(&self, group: &RecordId) -> String {
        format!("{}.tasks.{}", self.location.name, hex(group))
    }

    /// The one consumer of the work queue; made if it is not there.
    async fn workers(&self) -> Result<Consumer<pull::Config>, Refused> {
        let known = self.workers.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(known) = known {
            return Ok(known);
        }
        let config = pull::Config {
            durable_name: Some(WORKERS.to_owned()),
            ack_policy: AckPolicy::Explicit,
            ack_wait: self.location.lease_term,
            // How often a task is tried is decided by whoever does it, who keeps the reason.
            max_deliver: -1,
            max_ack_pending: -1,
            num_replicas: self.location.replicas,
            ..pull::Config::default()
        };
        let consumer = self.on.tasks.get_or_create_consumer(WORKERS, config).await;
        let consumer = consumer.map_err(Refused::unanswered)?;
        self.set_workers(Some(consumer.clone()));
        Ok(consumer)
    }

    fn set_workers(&self, workers: Option<Consumer<pull::Config>>) {
        *self.workers.lock().unwrap_or_else(PoisonError::into_inner) = workers;
    }

    fn listen(&self, listening: impl Future<Output = ()> + Send + 'static) {
        let mut tasks = self.listening.lock().unwrap_or_else(PoisonError::into_inner);
        let _runtime = self.runtime.handle().enter();
        tasks.spawn(listening);
    }
}

impl Shared for NatsStore {
    fn queue(&self, task: Task) -> Result<(), StoreError> {
        let subject = self.subject(&task.group);
        let id = format!("{}.{}", hex(&task.group), task.name);
        self.attempt("queueing a task", async || {
            let message = PublishMessage::build().payload(task.bytes.clone()).message_id(&id);
            let sent = self.on.context.send_publish(subject.clone(), message).await;
            match sent.map_err(Refused::unanswered)?.await {
                Ok(_) => Ok(()),
                Err(fault) if is_full(&fault) => {
                    let most = self.location.tasks_max;
                    Err(Refused::For(StoreError::Full(format!("{most} tasks wait already"))))
                }
                Err(fault) => Err(Refused::unanswered(fault)),
            }
        })
    }

    fn lease(&self, patience: Duration) -> Result<Option<Leased>, StoreError> {
        let fetch = async || {
            let consumer = self.workers().await?;
            let fetched = consumer.fetch().max_messages(1).expires(patience).messages().await;
            let mut messages = fetched.map_err(Refused::unanswered)?;
            messages.next().await.transpose().map_err(Refused::unanswered)
        };
        let within = patience + ANSWERED_WITHIN;
        let leased = self.attempt_within("waiting for a task", within, async || {
            let leased = fetch().await;
            if leased.is_err() {
                // Somebody may have removed it: it is looked for again.
                self.set_workers(None);
            }
            leased
        });
        let Some(message) = leased? else { return Ok(None) };
        let deliveries = message.info().map_or(1, |info| info.delivered);
        let bytes = message.payload.clone();
        let handle = self.runtime.handle().clone();
        Ok(Some(Leased {
            bytes,
            deliveries: u64::try_from(deliveries).unwrap_or(1),
            lease: Box::new(NatsLease { handle, message }),
        }))
    }

    fn lease_term(&self) -> Duration {
        self.location.lease_term
    }

    fn withdraw(&self, group: &RecordId) -> Result<(), StoreError> {
        let subject = self.subject(group);
        self.attempt("withdrawing tasks", async || {
            let purged = self.on.tasks.purge().filter(subject.clone()).await;
            purged.map(|_| ()).map_err(Refused::unanswered)
        })
    }

    fn tidy(&self, oldest: SystemTime) -> Result<usize, StoreError> {
        let listed = self.attempt_within("listing content", LISTED_WITHIN, async || {
            let list = self.on.content.list().await.map_err(Refused::unanswered)?;
            list.try_collect::<Vec<_>>().await.map_err(Refused::unanswered)
        })?;
        let mut removed = 0;
        for object in listed {
            let modified = object.modified.map(|time| time.unix_timestamp());
            let before =
                oldest.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs();
            let is_old = modified.is_some_and(|time| u64::try_from(time).is_ok_and(|t| t < before));
            let mut words = object.name.split('.');
            let shelf =
                words.next().and_then(|word| Shelf::ALL.into_iter().find(|s| s.name() == word));
            let id = words.next().and_then(unhex);
            let (true, Some(shelf), Some(id)) = (is_old, shelf, id) else { continue };
            if !self.names(shelf, &id, &object.name)? {
                self.drop_content(&object.name);
                removed += 1;
            }
        }
        Ok(removed)
    }

    fn follow(&self, ledger: Ledger, follower: Follower) {
        let bucket = self.ledger(ledger).clone();
        self.listen(async move {
            loop {
                match follow_once(&bucket, &follower).await {
                    Ok(()) => tracing::debug!(?ledger, "NATS ended a watch"),
                    Err(fault) => tracing::warn!(?ledger, fault, "a watch on NATS is begun anew"),
                }
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        });
    }

    fn tell(&self, word: Bytes) {
        // Where there is no connection nobody hears it; it is not kept for later.
        if !self.is_gone() {
            let told =
                self.runtime.handle().block_on(self.on.client.publish(self.words.clone(), word));
            if let Err(fault) = told {
                tracing::debug!(%fault, "telling others");
            }
        }
    }

    fn hear(&self, hearer: Hearer) {
        let (client, words): (Client, _) = (self.on.client.clone(), self.words.clone());
        self.listen(async move {
            loop {
                match client.subscribe(words.clone()).await {
                    Ok(mut heard) => {
                        while let Some(message) = heard.next().await {
                            hearer(message.payload);
                        }
                    }
                    Err(fault) => tracing::warn!(%fault, "hearing others"),
                }
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        });
    }
}

/// The library has no kind of its own for the server's answer that a stream is full.
fn is_full(fault: &PublishError) -> bool {
    fault.source().is_some_and(|source| source.to_string().contains("maximum messages exceeded"))
}

/// Tells of everything, then of changes, until the watch ends.
async fn follow_once(bucket: &kv::Store, follower: &Follower) -> Result<(), String> {
    /// A watch of an empty bucket says nothing; one that says nothing for so long is asked again.
    const SILENT_FOR: Duration = Duration::from_secs(30);
    let mut watch = bucket.watch_with_history(">").await.map_err(|fault| fault.to_string())?;
    let status = bucket.status().await.map_err(|fault| fault.to_string())?;
    let mut snapshot = Some(HashMap::new());
    if status.values() == 0 {
        follower(Change::All(Vec::new()));
        snapshot = None;
    }
    loop {
        let entry = match tokio::time::timeout(SILENT_FOR, watch.next()).await {
            Ok(Some(entry)) => entry.map_err(|fault| fault.to_string())?,
            Ok(None) => return Ok(()),
            Err(_) if snapshot.is_some() => return Err("it is silent".to_owned()),
            // A watch that was lost without a word would be silent too: it is compared with what
            // is there now and then.
            Err(_) => return Ok(()),
        };
        let is_current = entry.seen_current;
        if let Some(id) = unhex(&entry.key) {
            let there = (entry.operation == Operation::Put)
                .then(|| Entry { bytes: entry.value, revision: entry.revision });
            match (&mut snapshot, there) {
                (Some(all), Some(there)) => drop(all.insert(id, there)),
                (Some(all), None) => drop(all.remove(&id)),
                (None, Some(there)) => follower(Change::Written(id, there)),
                (None, None) => follower(Change::Erased(id)),
            }
        }
        if is_current && let Some(all) = snapshot.take() {
            follower(Change::All(all.into_iter().collect()));
        }
    }
}

/// The hold on a message.
#[derive(Debug)]
struct NatsLease {
    handle: Handle,
    message: jetstream::Message,
}

impl NatsLease {
    fn acknowledge(&self, kind: AckKind) -> Result<(), StoreError> {
        let acknowledged = async {
            tokio::time::timeout(ANSWERED_WITHIN, self.message.double_ack_with(kind)).await
        };
        match self.handle.block_on(acknowledged) {
            Ok(acknowledged) => acknowledged.map_err(unreachable),
            Err(_) => Err(StoreError::Unreachable("an acknowledgement was not heard".to_owned())),
        }
    }
}

impl Lease for NatsLease {
    fn renew(&self) -> Result<(), StoreError> {
        self.acknowledge(AckKind::Progress)
    }

    fn done(&self) -> Result<(), StoreError> {
        self.acknowledge(AckKind::Ack)
    }

    fn hand_back(&self) -> Result<(), StoreError> {
        self.acknowledge(AckKind::Nak(None))
    }
}
