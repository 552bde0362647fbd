//! Request ids: the same one names the same job (AIP-155).

use std::{
    collections::{HashMap, HashSet},
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use sha2::{Digest, Sha256};

use crate::{
    service::{Code, Error},
    store::{Ledger, RecordId, Store, StoreError},
    wire::ArtifactId,
};

/// Ids remembered at once; more are refused.
const REQUESTS_MAX: usize = 100_000;

/// Request ids in the store. It alone decides; what is kept here says when which is to be
/// forgotten, and how many there are.
#[derive(Debug, Default)]
pub(super) struct Requests {
    noted: Mutex<HashMap<RecordId, SystemTime>>,
}

impl Requests {
    fn noted(&self) -> MutexGuard<'_, HashMap<RecordId, SystemTime>> {
        self.noted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers that `request_id` asks for `job`, at `now`; whether it did so before. Blocks on the
    /// store.
    ///
    /// # Errors
    /// `ALREADY_EXISTS` if it asked for another one.
    pub(super) fn note(
        &self,
        store: &dyn Store,
        request_id: &str,
        job: ArtifactId,
        now: SystemTime,
    ) -> Result<bool, Error> {
        if self.noted().len() >= REQUESTS_MAX {
            let message = format!("{REQUESTS_MAX} request ids are remembered, no more can be");
            return Err(Error::new(Code::ResourceExhausted, "REQUEST_IDS_FULL", message));
        }
        let id: RecordId = Sha256::digest(request_id).into();
        match store.write(Ledger::Requests, &id, encode(job, now), 0) {
            Ok(_) => {
                self.noted().insert(id, now);
                return Ok(false);
            }
            Err(StoreError::Stale { .. } | StoreError::Damaged { .. }) => {}
            Err(fault) => return Err(fault.into()),
        }
        let entry = match store.read(Ledger::Requests, &id) {
            Err(StoreError::Damaged { .. }) => None,
            read => read?,
        };
        match entry.as_ref().and_then(|entry| decode(&entry.bytes)) {
            Some((before, _)) if before == job => Ok(true),
            Some((before, _)) => {
                let message = format!(
                    "request_id {request_id} came with another problem before, for \
                     operations/{before}"
                );
                Err(Error::new(Code::AlreadyExists, "REQUEST_ID_REUSED", message))
            }
            // It was forgotten just now, or cannot be read: what it asked for is not known.
            None => {
                let message = format!("what request_id {request_id} asked for cannot be read");
                Err(Error::new(Code::DataLoss, "REQUEST_ID_DAMAGED", message))
            }
        }
    }

    /// Forgets those from before `oldest`, as it is `now`. Blocks on the store.
    pub(super) fn sweep(
        &self,
        store: &dyn Store,
        oldest: SystemTime,
        now: SystemTime,
    ) -> Result<(), StoreError> {
        let there: HashSet<_> = store.entries(Ledger::Requests)?.into_iter().collect();
        self.noted().retain(|id, _| there.contains(id));
        for id in there {
            let known = self.noted().get(&id).copied();
            if known.is_some_and(|at| at >= oldest) {
                continue;
            }
            let entry = match store.read(Ledger::Requests, &id) {
                Ok(entry) => entry,
                Err(fault @ StoreError::Damaged { .. }) => {
                    // How long it has been there is not known, so that counts from when it is found.
                    if known.is_none() {
                        tracing::error!(%fault, "a request id's entry cannot be used");
                        self.noted().insert(id, now);
                    } else {
                        store.erase(Ledger::Requests, &id, 0)?;
                        self.noted().remove(&id);
                    }
                    continue;
                }
                Err(fault) => return Err(fault),
            };
            let Some(entry) = entry else { continue };
            match decode(&entry.bytes) {
                Some((_, at)) if at >= oldest => drop(self.noted().insert(id, at)),
                _ => {
                    store.erase(Ledger::Requests, &id, entry.revision)?;
                    self.noted().remove(&id);
                }
            }
        }
        Ok(())
    }
}

/// The job's id, then milliseconds since 1970, little-endian.
pub(super) fn encode(job: ArtifactId, at: SystemTime) -> Bytes {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let unix_ms = u64::try_from(since.as_millis()).unwrap_or(u64::MAX);
    [&job.0[..], &unix_ms.to_le_bytes()].concat().into()
}

pub(super) fn decode(bytes: &[u8]) -> Option<(ArtifactId, SystemTime)> {
    let (job, unix_ms) = bytes.split_first_chunk::<32>()?;
    let unix_ms = u64::from_le_bytes(unix_ms.try_into().ok()?);
    let at = SystemTime::UNIX_EPOCH.checked_add(Duration::from_millis(unix_ms))?;
    Some((ArtifactId(*job), at))
}
