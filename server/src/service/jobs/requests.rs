//! Request ids: the same one names the same job (AIP-155).

use std::{
    collections::HashMap,
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use sha2::{Digest, Sha256};

use crate::{
    service::{Code, Error},
    store::{Ledger, RecordId, Revision, Store, StoreError},
    wire::ArtifactId,
};

/// Ids remembered at once; more are refused.
const REQUESTS_MAX: usize = 100_000;

/// What is remembered of request ids, in memory as in the store.
#[derive(Debug)]
pub(super) struct Requests {
    by_id: HashMap<RecordId, Noted>,
}

#[derive(Debug, Clone, Copy)]
struct Noted {
    job: ArtifactId,
    at: SystemTime,
    revision: Revision,
}

impl Requests {
    /// Reads what the store remembers.
    pub(super) fn open(store: &dyn Store) -> Result<Self, StoreError> {
        let mut by_id = HashMap::new();
        for id in store.entries(Ledger::Requests)? {
            let entry = match store.read(Ledger::Requests, &id) {
                Ok(entry) => entry,
                Err(fault @ StoreError::Damaged { .. }) => {
                    tracing::error!(%fault, "a request id's entry cannot be used");
                    continue;
                }
                Err(fault) => return Err(fault),
            };
            if let Some(entry) = entry
                && let Some((job, at)) = decode(&entry.bytes)
            {
                by_id.insert(id, Noted { job, at, revision: entry.revision });
            }
        }
        Ok(Self { by_id })
    }

    /// Remembers that `request_id` asks for `job`; whether it did so before.
    ///
    /// # Errors
    /// `ALREADY_EXISTS` if it asked for another one.
    pub(super) fn note(
        &mut self,
        store: &dyn Store,
        request_id: &str,
        job: ArtifactId,
    ) -> Result<bool, Error> {
        let id: RecordId = Sha256::digest(request_id).into();
        match self.by_id.get(&id) {
            Some(noted) if noted.job == job => return Ok(true),
            Some(noted) => {
                let message = format!(
                    "request_id {request_id} came with another problem before, for \
                     operations/{}",
                    noted.job
                );
                return Err(Error::new(Code::AlreadyExists, "REQUEST_ID_REUSED", message));
            }
            None if self.by_id.len() >= REQUESTS_MAX => {
                let message = format!("{REQUESTS_MAX} request ids are remembered, no more can be");
                return Err(Error::new(Code::ResourceExhausted, "REQUEST_IDS_FULL", message));
            }
            None => {}
        }
        let at = SystemTime::now();
        let revision = store.write(Ledger::Requests, &id, encode(job, at), 0)?;
        self.by_id.insert(id, Noted { job, at, revision });
        Ok(false)
    }

    /// Forgets those from before `oldest`.
    pub(super) fn sweep(&mut self, store: &dyn Store, oldest: SystemTime) {
        self.by_id.retain(|id, noted| {
            if noted.at >= oldest {
                return true;
            }
            let erased = store.erase(Ledger::Requests, id, noted.revision);
            erased.inspect_err(|fault| tracing::warn!(%fault, "forgetting a request id")).is_err()
        });
    }
}

/// The job's id, then milliseconds since 1970, little-endian.
fn encode(job: ArtifactId, at: SystemTime) -> Bytes {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let unix_ms = u64::try_from(since.as_millis()).unwrap_or(u64::MAX);
    [&job.0[..], &unix_ms.to_le_bytes()].concat().into()
}

fn decode(bytes: &[u8]) -> Option<(ArtifactId, SystemTime)> {
    let (job, unix_ms) = bytes.split_first_chunk::<32>()?;
    let unix_ms = u64::from_le_bytes(unix_ms.try_into().ok()?);
    let at = SystemTime::UNIX_EPOCH.checked_add(Duration::from_millis(unix_ms))?;
    Some((ArtifactId(*job), at))
}
