//! Artifacts: looked at, listed, fetched.

use std::sync::Arc;

use vbar_guidance::Budget;

use super::{Call, Code, Error, Service};
use crate::{
    compute::Task,
    store::Shelf,
    wire::{
        ArtifactAnswer, ArtifactCall, ArtifactId, ArtifactsAnswer, ArtifactsCall, DownloadAnswer,
        DownloadCall,
    },
};

/// Which bytes of an artifact.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Range {
    /// From the first, at most so many, or to the end.
    From(usize, Option<usize>),
    /// The last so many.
    Last(usize),
}

impl Range {
    /// First byte and the one after the last, in an artifact of `size` bytes; `None` if the first
    /// lies behind its end.
    fn within(self, size: usize) -> Option<(usize, usize)> {
        match self {
            Self::From(first, length) => {
                let end = length.map_or(size, |length| first.saturating_add(length).min(size));
                (first <= size).then_some((first, end))
            }
            Self::Last(length) => Some((size - length.min(size), size)),
        }
    }
}

impl Service {
    /// `GetArtifact`.
    pub(crate) async fn artifact(
        &self,
        ask: ArtifactCall,
        call: &Call,
    ) -> Result<ArtifactAnswer, Error> {
        self.load(Shelf::Artifacts, ask.id, call).await.map(|stored| self.shelves.answer(stored))
    }

    /// `ListArtifacts`.
    pub(crate) async fn artifacts(
        &self,
        ask: ArtifactsCall,
        call: &Call,
    ) -> Result<ArtifactsAnswer, Error> {
        let (ids, next) = self.page(Shelf::Artifacts, ask.after, ask.page_size, call).await?;
        let mut artifacts = Vec::with_capacity(ids.len());
        for id in ids {
            match self.load(Shelf::Artifacts, id, call).await {
                Ok(stored) => artifacts.push(self.shelves.answer(stored)),
                // It expired since the page was made.
                Err(error) if error.code == Code::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(ArtifactsAnswer { artifacts, next })
    }

    /// `DownloadArtifact`.
    pub(crate) async fn download(
        &self,
        ask: DownloadCall,
        call: &Call,
    ) -> Result<DownloadAnswer, Error> {
        self.download_range(ask.id, Range::From(ask.offset, ask.length), call).await
    }

    /// The same for any range.
    ///
    /// # Errors
    /// `OUT_OF_RANGE` if it begins behind the artifact's end.
    pub(crate) async fn download_range(
        &self,
        id: ArtifactId,
        range: Range,
        call: &Call,
    ) -> Result<DownloadAnswer, Error> {
        let shelves = Arc::clone(&self.shelves);
        let work =
            move |budget: Budget<'_>| shelves.stored_with_bytes(Shelf::Artifacts, id, budget);
        let found = self.compute.run(Task::Download, &call.terms(), work).await?.value?;
        let Some((stored, bytes)) = found else {
            let message = format!("artifact {id} is not known; Precompute makes it");
            return Err(Error::new(Code::NotFound, "ARTIFACT_UNKNOWN", message));
        };
        let size = bytes.len();
        let Some((first, end)) = range.within(size) else {
            return Err(Error::out_of_range(size));
        };
        Ok(DownloadAnswer {
            content: bytes.slice(first..end),
            offset: first,
            size_bytes: size,
            content_sha256: stored.provenance.content_sha256.clone(),
        })
    }
}

impl Error {
    /// No byte of an artifact of `size` bytes was asked for.
    pub(crate) fn out_of_range(size: usize) -> Self {
        let message = format!("the artifact has {size} bytes, and none of them are in the range");
        Self::new(Code::OutOfRange, "RANGE_NOT_SATISFIABLE", message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_lies_within_the_artifact() {
        for (range, size, expected) in [
            (Range::From(0, None), 10, Some((0, 10))),
            (Range::From(3, Some(4)), 10, Some((3, 7))),
            (Range::From(3, Some(usize::MAX)), 10, Some((3, 10))),
            (Range::From(10, None), 10, Some((10, 10))),
            (Range::From(11, None), 10, None),
            (Range::Last(4), 10, Some((6, 10))),
            (Range::Last(99), 10, Some((0, 10))),
        ] {
            assert_eq!(range.within(size), expected, "{range:?}");
        }
    }
}
