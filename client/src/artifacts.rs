//! What precomputes made: looked at, listed, fetched.

use prost::bytes::{Bytes, BytesMut};
use sha2::{Digest, Sha256};
use tokio::time::Instant;
use tonic::Request;
use vbar_proto::v1::{
    Artifact, DownloadArtifactRequest, GetArtifactRequest, ListArtifactsRequest,
    ListArtifactsResponse,
};

use crate::{Client, Error, retry::Attempts};

impl Client {
    /// Summary of an artifact that a precompute made.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; [`Error`], as every call.
    pub async fn artifact(&self, artifact_id: &str) -> Result<Artifact, Error> {
        let request = GetArtifactRequest { artifact_id: artifact_id.to_owned() };
        let response = self
            .call(self.options.deadline, request, |request| {
                let mut guidance = self.guidance.clone();
                async move { guidance.get_artifact(request).await }
            })
            .await?;
        response.artifact.ok_or_else(|| Error::broken_contract("no artifact in it"))
    }

    /// A page of artifacts.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn artifacts(
        &self,
        request: ListArtifactsRequest,
    ) -> Result<ListArtifactsResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.list_artifacts(request).await }
        })
        .await
    }

    /// The bytes of an artifact, whose digest is checked. What breaks off is gone on with where it
    /// broke off.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; `INTERNAL` if the bytes are not what the node
    /// says they are; [`Error`], as every call.
    pub async fn download_artifact(&self, artifact_id: &str) -> Result<Bytes, Error> {
        let deadline = Instant::now() + self.options.deadline;
        let mut attempts = Attempts::new(self.options.attempts_max, deadline, &self.retries);
        let mut download = Download::default();
        loop {
            match attempts.bounded(self.fetch_rest(artifact_id, &mut download)).await {
                Ok(()) => return download.checked(),
                Err(error) => attempts.pause_after(error).await?,
            }
        }
    }

    async fn fetch_rest(&self, artifact_id: &str, download: &mut Download) -> Result<(), Error> {
        let offset = i64::try_from(download.content.len()).unwrap_or(i64::MAX);
        let request =
            DownloadArtifactRequest { artifact_id: artifact_id.to_owned(), offset, length: 0 };
        let mut guidance = self.guidance.clone();
        let mut pieces = guidance.download_artifact(Request::new(request)).await?.into_inner();
        while let Some(piece) = pieces.message().await? {
            if usize::try_from(piece.offset) != Ok(download.content.len()) {
                return Err(Error::broken_contract("a piece that does not follow the one before"));
            }
            download.content.extend_from_slice(&piece.content);
            download.sha256 = piece.content_sha256;
        }
        Ok(())
    }
}

/// What has arrived so far.
#[derive(Debug, Default)]
struct Download {
    content: BytesMut,
    sha256: String,
}

impl Download {
    fn checked(self) -> Result<Bytes, Error> {
        let digest = Sha256::digest(&self.content);
        let found: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        if found != self.sha256 {
            return Err(Error::broken_contract("bytes of another digest than it says"));
        }
        Ok(self.content.freeze())
    }
}
