//! Artifacts and plans: read and checked, kept once, remembered for a while.

use std::sync::Arc;

use bytes::Bytes;
use vbar_guidance::{Budget, Method, control::Failure};

use super::{
    Code, Error,
    cache::{Cache, Outcome},
    leases::Leases,
    record,
};
use crate::{
    store::{Put, Shelf, Store},
    telemetry::{Metrics, OutcomeLabels},
    wire::{Artifact, ArtifactAnswer, ArtifactId, Provenance, StoredArtifact, Unread},
};

/// Two contents for one problem: determinism broke.
const CONFLICT: &str = "ARTIFACT_CONFLICT";

/// What calls and jobs share of a node's memory.
#[derive(Debug)]
pub(super) struct Shelves {
    pub(super) store: Arc<dyn Store>,
    pub(super) cache: Cache,
    pub(super) leases: Leases,
    pub(super) metrics: Arc<Metrics>,
}

impl Shelves {
    /// Reads and checks what stands on a shelf under `id`. Blocks on the store.
    pub(super) fn stored(
        &self,
        shelf: Shelf,
        id: ArtifactId,
        budget: Budget<'_>,
    ) -> Result<Option<StoredArtifact>, Error> {
        Ok(self.stored_with_bytes(shelf, id, budget)?.map(|(stored, _)| stored))
    }

    /// The same with the artifact's own bytes.
    pub(super) fn stored_with_bytes(
        &self,
        shelf: Shelf,
        id: ArtifactId,
        budget: Budget<'_>,
    ) -> Result<Option<(StoredArtifact, Bytes)>, Error> {
        let Some(record) = self.store.get(shelf, &id.0)? else { return Ok(None) };
        match record::decode_within(shelf, id, &record, budget) {
            Ok((artifact, bytes)) => {
                if shelf == Shelf::Artifacts {
                    // Another node may have made it.
                    self.leases.learn(id)?;
                }
                let bytes = record.slice_ref(bytes);
                Ok(Some((loaded(id, artifact, &bytes), bytes)))
            }
            Err(Unread::Interrupted(why)) => Err(Failure::from(why).into()),
            Err(Unread::Damaged(what)) => {
                tracing::error!(%id, what, "unreadable record");
                let (reason, kind) = match shelf {
                    Shelf::Artifacts => ("ARTIFACT_DAMAGED", "artifact"),
                    Shelf::Plans => ("PLAN_DAMAGED", "plan"),
                    Shelf::Problems | Shelf::Shards => ("RECORD_DAMAGED", shelf.name()),
                };
                let message = format!("the record of {kind} {id} cannot be used: {what}");
                Err(Error::new(Code::DataLoss, reason, message))
            }
        }
    }

    /// Stores a new artifact. If another call was faster, both must have made the same bytes.
    /// Blocks on the store.
    pub(super) fn keep(
        &self,
        id: ArtifactId,
        artifact: &Artifact,
        budget: Budget<'_>,
    ) -> Result<StoredArtifact, Error> {
        let loaded = self.put(Shelf::Artifacts, id, artifact, budget)?;
        self.leases.grant(id, loaded.size_bytes)?;
        Ok(loaded)
    }

    /// Stores a plan under the digest of its content; the same plan twice is one plan. Blocks on
    /// the store.
    pub(super) fn keep_plan(
        &self,
        plan: &Artifact,
        budget: Budget<'_>,
    ) -> Result<StoredArtifact, Error> {
        let id = record::content_id(&plan.to_bytes());
        self.put(Shelf::Plans, id, plan, budget)
    }

    fn put(
        &self,
        shelf: Shelf,
        id: ArtifactId,
        artifact: &Artifact,
        budget: Budget<'_>,
    ) -> Result<StoredArtifact, Error> {
        let bytes = artifact.to_bytes();
        if shelf == Shelf::Artifacts && self.leases.expires(id).is_none() {
            self.leases.admit(bytes.len())?;
        }
        let record = Bytes::from(record::encode(artifact.method(), &bytes));
        match self.store.put_if_absent(shelf, &id.0, record.clone())? {
            Put::Created => {}
            Put::Existing(existing) if existing == record => {}
            Put::Existing(_) => {
                self.metrics.artifact_conflicts.inc();
                return Err(Error::internal(CONFLICT, &format!("two contents for {id}")));
            }
        }
        read_back(id, artifact, &bytes, budget)
    }

    /// Keeps what was loaded in memory for a while.
    pub(super) fn remember(&self, shelf: Shelf, loaded: StoredArtifact) -> StoredArtifact {
        self.cache.insert((shelf, loaded.id), Outcome::Made(loaded.clone()));
        loaded
    }

    /// With the end of its lease.
    pub(super) fn answer(&self, stored: StoredArtifact) -> ArtifactAnswer {
        ArtifactAnswer { expires: self.leases.expires(stored.id), stored }
    }

    /// Counts where an artifact came from.
    pub(super) fn looked_up(&self, outcome: &'static str) {
        self.metrics.artifacts.get_or_create(&OutcomeLabels { outcome }).inc();
    }
}

/// What is answered with, and stands on no shelf. Blocks on nothing.
pub(super) fn unkept(
    id: ArtifactId,
    artifact: &Artifact,
    budget: Budget<'_>,
) -> Result<StoredArtifact, Error> {
    read_back(id, artifact, &artifact.to_bytes(), budget)
}

/// What a node finds that reads the bytes from its store. Whoever made them answers with that too:
/// bytes do not tell one zero from the other, and answers would. A deadline does not stop it: the
/// answer is there.
fn read_back(
    id: ArtifactId,
    artifact: &Artifact,
    bytes: &[u8],
    budget: Budget<'_>,
) -> Result<StoredArtifact, Error> {
    let patient = budget.beyond_deadline();
    let again = Artifact::from_bytes_within(artifact.method(), bytes, patient);
    let again = again.map_err(|unread| match unread {
        Unread::Interrupted(why) => Failure::from(why).into(),
        Unread::Damaged(what) => Error::internal("ARTIFACT_UNREADABLE", &format!("{id}: {what}")),
    })?;
    Ok(loaded(id, again, bytes))
}

/// Where something of `method` comes from.
pub(super) fn provenance(method: Method, id: ArtifactId, content_sha256: String) -> Provenance {
    Provenance {
        method: method.name(),
        method_version: method.version(),
        artifact_id: id.to_string(),
        content_sha256,
    }
}

/// `id` is the name under which it was asked for: the problem's for an artifact, the content's for
/// a plan. Controller states are bound to it.
fn loaded(id: ArtifactId, artifact: Artifact, bytes: &[u8]) -> StoredArtifact {
    let method = artifact.method();
    let problem = record::artifact_id(method, &artifact.canonical_problem());
    let provenance = provenance(method, problem, record::content_id(bytes).to_string());
    StoredArtifact { id, artifact, provenance: Arc::new(provenance), size_bytes: bytes.len() }
}
