//! What precomputes made: asked for by name, listed, fetched as bytes.

use std::{sync::Arc, time::SystemTime};

use bytes::Bytes;
use vbar_proto::v1;

use super::{
    Artifact, ArtifactId, Door, Parse, Path, Provenance, Render,
    paging::{page_size, page_token},
};

/// `GetArtifact`.
#[derive(Debug)]
pub(crate) struct ArtifactCall {
    pub(crate) id: ArtifactId,
}

impl Parse for ArtifactCall {
    type Message = v1::GetArtifactRequest;

    fn parse(message: &v1::GetArtifactRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        ArtifactId::parse(&message.artifact_id, path.field("artifact_id"), door)
            .map(|id| Self { id })
    }
}

/// An artifact or plan, read and checked, with where it comes from.
#[derive(Debug, Clone)]
pub(crate) struct StoredArtifact {
    pub(crate) id: ArtifactId,
    pub(crate) artifact: Artifact,
    pub(crate) provenance: Arc<Provenance>,
    pub(crate) size_bytes: usize,
}

/// An artifact's summary.
#[derive(Debug, Clone)]
pub(crate) struct ArtifactAnswer {
    pub(crate) stored: StoredArtifact,
    /// Until when it is kept at least.
    pub(crate) expires: Option<SystemTime>,
}

impl ArtifactAnswer {
    pub(super) fn summary(&self) -> v1::Artifact {
        let StoredArtifact { artifact, provenance, size_bytes, .. } = &self.stored;
        v1::Artifact {
            artifact_id: provenance.artifact_id.clone(),
            size_bytes: wire_size(*size_bytes),
            provenance: Some(provenance.render()),
            summary: Some(artifact.render_summary()),
            expire_time: self.expires.map(Into::into),
        }
    }
}

impl Render for ArtifactAnswer {
    type Message = v1::GetArtifactResponse;

    fn render(&self) -> v1::GetArtifactResponse {
        v1::GetArtifactResponse { artifact: Some(self.summary()) }
    }
}

fn wire_size(bytes: usize) -> i64 {
    i64::try_from(bytes).unwrap_or(i64::MAX)
}

/// `ListArtifacts`.
#[derive(Debug)]
pub(crate) struct ArtifactsCall {
    pub(crate) page_size: usize,
    pub(crate) after: Option<ArtifactId>,
}

/// Artifacts on one page unless asked for fewer: each is read and checked again.
const PAGE_SIZE: usize = 50;

impl Parse for ArtifactsCall {
    type Message = v1::ListArtifactsRequest;

    fn parse(message: &v1::ListArtifactsRequest, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let page_size = page_size(message.page_size, PAGE_SIZE, path, door);
        let after = page_token(&message.page_token, path, door);
        Some(Self { page_size: page_size?, after: after? })
    }
}

/// Answer of `ListArtifacts`.
#[derive(Debug)]
pub(crate) struct ArtifactsAnswer {
    pub(crate) artifacts: Vec<ArtifactAnswer>,
    pub(crate) next: Option<ArtifactId>,
}

impl Render for ArtifactsAnswer {
    type Message = v1::ListArtifactsResponse;

    fn render(&self) -> v1::ListArtifactsResponse {
        v1::ListArtifactsResponse {
            artifacts: self.artifacts.iter().map(ArtifactAnswer::summary).collect(),
            next_page_token: self.next.map(|id| id.to_string()).unwrap_or_default(),
        }
    }
}

/// `DownloadArtifact`.
#[derive(Debug)]
pub(crate) struct DownloadCall {
    pub(crate) id: ArtifactId,
    /// First byte.
    pub(crate) offset: usize,
    /// At most so many; `None` to the end.
    pub(crate) length: Option<usize>,
}

impl Parse for DownloadCall {
    type Message = v1::DownloadArtifactRequest;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let id = ArtifactId::parse(&message.artifact_id, path.field("artifact_id"), door);
        let mut bytes = |given: i64, name: &'static str| {
            usize::try_from(given)
                .ok()
                .or_else(|| door.refuse(path.field(name), "a number of bytes, at least 0", given))
        };
        let offset = bytes(message.offset, "offset");
        let length = bytes(message.length, "length");
        Some(Self { id: id?, offset: offset?, length: Some(length?).filter(|&length| length > 0) })
    }
}

/// A part of an artifact's bytes.
#[derive(Debug, Clone)]
pub(crate) struct DownloadAnswer {
    pub(crate) content: Bytes,
    /// Where it begins.
    pub(crate) offset: usize,
    /// Of the whole artifact.
    pub(crate) size_bytes: usize,
    /// Of the whole artifact, in hexadecimal.
    pub(crate) content_sha256: String,
}

impl DownloadAnswer {
    /// Messages of at most `most` bytes of content each; one even if there is no content.
    pub(crate) fn pieces(
        self,
        most: usize,
    ) -> impl Iterator<Item = v1::DownloadArtifactResponse> + Send + use<> {
        let starts = (0..self.content.len().max(1)).step_by(most);
        starts.map(move |start| {
            let end = self.content.len().min(start + most);
            v1::DownloadArtifactResponse {
                content: self.content.slice(start..end),
                offset: wire_size(self.offset + start),
                size_bytes: wire_size(self.size_bytes),
                content_sha256: self.content_sha256.clone(),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn download_pieces_follow_one_another() {
        let content: Vec<u8> = (0..10).collect();
        for most in [1, 3, 5, 10, 99] {
            let answer = DownloadAnswer {
                content: content.clone().into(),
                offset: 100,
                size_bytes: 110,
                content_sha256: String::new(),
            };
            let mut seen = Vec::new();
            for piece in answer.pieces(most) {
                assert_eq!(piece.offset, i64::try_from(100 + seen.len()).unwrap());
                assert!((1..=most).contains(&piece.content.len()));
                seen.extend_from_slice(&piece.content);
            }
            assert_eq!(seen, content);
        }
        let empty = DownloadAnswer {
            content: Bytes::new(),
            offset: 0,
            size_bytes: 0,
            content_sha256: String::new(),
        };
        assert_eq!(empty.pieces(4).count(), 1);
    }
}
