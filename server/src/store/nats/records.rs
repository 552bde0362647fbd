//! Records and entries.

use std::time::Duration;

use async_nats::jetstream::{
    context::PublishErrorKind,
    kv::{self, Operation},
    message::PublishMessage,
    object_store::{DeleteErrorKind, InfoErrorKind, ObjectMetadata},
    stream::RawMessageErrorKind,
};
use bytes::{Bytes, BytesMut};
use futures_util::TryStreamExt as _;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{ANSWERED_WITHIN, NatsStore, Refused, unreachable};
use crate::store::{Entry, Ledger, Put, RecordId, Revision, Shelf, Store, StoreError, hex, unhex};

/// Pieces that bytes are sent in: below the largest message that servers take by default, 1 MiB.
const CHUNK_BYTES: usize = 256 << 10;
/// A slow link still moves so many bytes a second.
const BYTES_PER_SECOND_LEAST: usize = 1 << 20;
/// A listing goes through every key.
pub(super) const LISTED_WITHIN: Duration = Duration::from_secs(10);
/// How long it is remembered that a key was erased, for those who follow it.
const MARKER_KEPT: Duration = Duration::from_secs(3600);

/// What a shelf's key holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Commit {
    sha256: String,
    size: usize,
    object: String,
}

/// A commit, read and written again; `None` if it cannot be read.
#[cfg(feature = "fuzzing")]
pub(in crate::store) fn commit_rewritten(bytes: &[u8]) -> Option<Bytes> {
    let commit: Commit = serde_json::from_slice(bytes).ok()?;
    assert!(time_for(commit.size) >= ANSWERED_WITHIN, "time runs backwards");
    Some(serde_json::to_vec(&commit).expect("numbers and text").into())
}

/// Time to move so many bytes.
fn time_for(bytes: usize) -> Duration {
    let seconds = u32::try_from(bytes / BYTES_PER_SECOND_LEAST).unwrap_or(u32::MAX);
    ANSWERED_WITHIN + Duration::from_secs(1).saturating_mul(seconds)
}

fn damaged(id: &RecordId, what: &'static str) -> StoreError {
    StoreError::Damaged { id: hex(id), what }
}

/// What stands under a key now, if anything does.
async fn present(bucket: &kv::Store, key: &str) -> Result<Option<kv::Entry>, Refused> {
    let entry = bucket.entry(key).await.map_err(Refused::unanswered)?;
    Ok(entry.filter(|entry| entry.operation == Operation::Put))
}

/// Every key that has a value, in ascending order.
async fn keys(bucket: &kv::Store) -> Result<Vec<RecordId>, Refused> {
    let keys = bucket.keys().await.map_err(Refused::unanswered)?;
    let keys: Vec<String> = keys.try_collect().await.map_err(Refused::unanswered)?;
    // A key that is not an id is not ours.
    let mut ids: Vec<_> = keys.iter().filter_map(|key| unhex(key)).collect();
    ids.sort_unstable();
    Ok(ids)
}

impl NatsStore {
    /// A word that nobody else uses.
    fn nonce(&self) -> String {
        self.on.client.new_inbox().replace('.', "-")
    }

    fn commit(
        &self,
        shelf: Shelf,
        id: &RecordId,
    ) -> Result<Option<(Commit, Revision)>, StoreError> {
        let key = hex(id);
        let doing = format!("reading {} {key}", shelf.name());
        let entry = self.attempt(&doing, || present(self.shelf(shelf), &key))?;
        entry
            .map(|entry| {
                let commit = serde_json::from_slice(&entry.value);
                let commit = commit.map_err(|_| damaged(id, "its key cannot be read"))?;
                Ok((commit, entry.revision))
            })
            .transpose()
    }

    /// The bytes that a commit names, verified.
    fn content(&self, id: &RecordId, commit: &Commit) -> Result<Bytes, StoreError> {
        let doing = format!("reading {}", commit.object);
        let bytes = self.attempt_within(&doing, time_for(commit.size), async || {
            let gone = || Refused::For(damaged(id, "its bytes are gone"));
            let info = match self.on.content.info(&commit.object).await {
                Ok(info) if info.deleted => return Err(gone()),
                Ok(info) if info.size != commit.size => {
                    let what = "its bytes are not of the length committed";
                    return Err(Refused::For(damaged(id, what)));
                }
                Ok(info) => info,
                Err(fault) if fault.kind() == InfoErrorKind::NotFound => return Err(gone()),
                Err(fault) => return Err(Refused::unanswered(fault)),
            };
            // Piece by piece: the library would make a consumer on the server for each object.
            let subject = format!("$O.{}.C.{}", info.bucket, info.nuid);
            // What the key says of their number is not believed before they are there.
            let (mut bytes, mut next) = (BytesMut::new(), 1);
            while bytes.len() < commit.size {
                let piece = self.on.pieces.raw_message_builder().sequence(next);
                match piece.next_by_subject(subject.clone()).send().await {
                    Ok(piece) => {
                        bytes.extend_from_slice(&piece.payload);
                        next = piece.sequence + 1;
                    }
                    Err(fault) if fault.kind() == RawMessageErrorKind::NoMessageFound => {
                        return Err(gone());
                    }
                    Err(fault) => return Err(Refused::unanswered(fault)),
                }
            }
            Ok(bytes.freeze())
        })?;
        if hex(&Sha256::digest(&bytes)) != commit.sha256 {
            return Err(damaged(id, "its bytes do not have the digest committed"));
        }
        Ok(bytes)
    }

    fn put_content(
        &self,
        shelf: Shelf,
        id: &RecordId,
        bytes: &Bytes,
    ) -> Result<Commit, StoreError> {
        let sha256 = hex(&Sha256::digest(bytes));
        let doing = format!("storing {} {}", shelf.name(), hex(id));
        self.attempt_within(&doing, time_for(bytes.len()), async || {
            let object = format!("{}.{}.{sha256}.{}", shelf.name(), hex(id), self.nonce());
            let metadata = ObjectMetadata {
                name: object.clone(),
                chunk_size: Some(CHUNK_BYTES),
                ..ObjectMetadata::default()
            };
            let put = self.on.content.put(metadata, &mut &bytes[..]).await;
            put.map_err(Refused::unanswered)?;
            Ok(Commit { sha256: sha256.clone(), size: bytes.len(), object })
        })
    }

    /// Removes bytes that no key names. What cannot be removed now is left to [`Self::tidy`].
    pub(super) fn drop_content(&self, object: &str) {
        let dropped = self.attempt(&format!("removing {object}"), async || {
            match self.on.content.delete(object).await {
                Err(fault) if fault.kind() != DeleteErrorKind::NotFound => {
                    Err(Refused::unanswered(fault))
                }
                _ => Ok(()),
            }
        });
        if let Err(fault) = dropped {
            tracing::warn!(%fault, "bytes without a key stay for a while");
        }
    }

    /// Whether a record's bytes are those of `object`.
    pub(super) fn names(
        &self,
        shelf: Shelf,
        id: &RecordId,
        object: &str,
    ) -> Result<bool, StoreError> {
        let commit = self.commit(shelf, id)?;
        Ok(commit.is_some_and(|(commit, _)| commit.object == object))
    }

    /// Gives a key a value if `seen` is its latest revision, 0 if it should have none; the new one,
    /// or `None` if another was faster.
    fn replace(
        &self,
        bucket: &kv::Store,
        key: &str,
        value: Bytes,
        seen: Revision,
    ) -> Result<Option<Revision>, StoreError> {
        let subject = format!("$KV.{}.{key}", bucket.name);
        // By its name the server knows a message again whose acknowledgement was lost.
        let name = self.nonce();
        self.attempt(&format!("writing {key} in {}", bucket.name), async || {
            let publish = async |after: Revision, name: &str| {
                let message = PublishMessage::build()
                    .payload(value.clone())
                    .message_id(name)
                    .expected_last_subject_sequence(after);
                let sent = self.on.context.send_publish(subject.clone(), message).await;
                match sent.map_err(Refused::unanswered)?.await {
                    Ok(acknowledged) => Ok(Some(acknowledged.sequence)),
                    Err(fault) if fault.kind() == PublishErrorKind::WrongLastSequence => Ok(None),
                    Err(fault) => Err(Refused::unanswered(fault)),
                }
            };
            let written = publish(seen, &name).await?;
            if written.is_some() || seen != 0 {
                return Ok(written);
            }
            match bucket.entry(key).await.map_err(Refused::unanswered)? {
                // A value was there and was erased: the marker of that is to be replaced.
                Some(entry) if entry.operation != Operation::Put => {
                    publish(entry.revision, &format!("{name}-{}", entry.revision)).await
                }
                Some(_) => Ok(None),
                None => Err(Refused::Unanswered("its marker was just removed".to_owned())),
            }
        })
    }

    fn stale(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> StoreError {
        let found = self.read(ledger, id).ok().flatten().map_or(0, |entry| entry.revision);
        StoreError::Stale { id: hex(id), seen, found }
    }
}

impl Store for NatsStore {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        if let Some(existing) = self.get(shelf, id)? {
            return Ok(Put::Existing(existing));
        }
        let commit = self.put_content(shelf, id, &bytes)?;
        let value = serde_json::to_vec(&commit).expect("text and a number");
        // Where this fails it is not known whether the key was created, so the bytes must stay.
        if self.replace(self.shelf(shelf), &hex(id), value.into(), 0)?.is_some() {
            return Ok(Put::Created);
        }
        match self.commit(shelf, id)? {
            Some((there, _)) => {
                self.drop_content(&commit.object);
                self.content(id, &there).map(Put::Existing)
            }
            None => Err(damaged(id, "it was removed while it was being created")),
        }
    }

    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        let Some((commit, _)) = self.commit(shelf, id)? else { return Ok(None) };
        match self.content(id, &commit) {
            Ok(bytes) => Ok(Some(bytes)),
            // Removed between the two reads?
            Err(fault) => match self.commit(shelf, id)? {
                Some((again, _)) if again == commit => Err(fault),
                Some((again, _)) => self.content(id, &again).map(Some),
                None => Ok(None),
            },
        }
    }

    fn contains(&self, shelf: Shelf, id: &RecordId) -> Result<bool, StoreError> {
        self.commit(shelf, id).map(|commit| commit.is_some())
    }

    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        let doing = format!("listing {}", shelf.name());
        let ids = self.attempt_within(&doing, LISTED_WITHIN, || keys(self.shelf(shelf)))?;
        let from = after.map_or(0, |after| ids.partition_point(|id| id <= after));
        Ok(ids[from..].iter().take(limit).copied().collect())
    }

    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError> {
        let Some((commit, revision)) = self.commit(shelf, id)? else { return Ok(()) };
        self.attempt(&format!("removing {} {}", shelf.name(), hex(id)), async || {
            let bucket = self.shelf(shelf);
            match bucket.purge_expect_revision_with_ttl(hex(id), revision, MARKER_KEPT).await {
                Ok(()) => Ok(()),
                // Already, by another or by us when the answer was lost?
                Err(fault) => match present(bucket, &hex(id)).await? {
                    Some(entry) if entry.revision == revision => Err(Refused::unanswered(fault)),
                    _ => Ok(()),
                },
            }
        })?;
        self.drop_content(&commit.object);
        Ok(())
    }

    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError> {
        let key = hex(id);
        let doing = format!("reading {} {key}", ledger.name());
        let entry = self.attempt(&doing, || present(self.ledger(ledger), &key))?;
        Ok(entry.map(|entry| Entry { bytes: entry.value, revision: entry.revision }))
    }

    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError> {
        let written = self.replace(self.ledger(ledger), &hex(id), bytes, seen)?;
        written.ok_or_else(|| self.stale(ledger, id, seen))
    }

    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError> {
        let (key, bucket) = (hex(id), self.ledger(ledger));
        let erased = self.attempt(&format!("erasing {} {key}", ledger.name()), async || {
            match present(bucket, &key).await? {
                None => Ok(true),
                Some(entry) if entry.revision != seen => Ok(false),
                Some(_) => {
                    let purged = bucket.purge_expect_revision_with_ttl(&key, seen, MARKER_KEPT);
                    purged.await.map(|()| true).map_err(Refused::unanswered)
                }
            }
        })?;
        if erased { Ok(()) } else { Err(self.stale(ledger, id, seen)) }
    }

    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError> {
        let doing = format!("listing {}", ledger.name());
        self.attempt_within(&doing, LISTED_WITHIN, || keys(self.ledger(ledger)))
    }

    fn reach(&self) -> Result<(), StoreError> {
        if self.is_gone() {
            return Err(StoreError::Unreachable("no NATS server is connected".to_owned()));
        }
        let asked = async {
            let asked = self.on.context.query_account();
            tokio::time::timeout(ANSWERED_WITHIN, asked).await
        };
        match self.runtime.handle().block_on(asked) {
            Ok(answered) => answered.map(|_| ()).map_err(unreachable),
            Err(_) => Err(StoreError::Unreachable("JetStream does not answer".to_owned())),
        }
    }
}
