//! The bytes of an artifact, whole or in part (RFC 9110, sec. 14).

use axum::{body::Body, response::Response};
use http::{HeaderMap, HeaderValue, StatusCode, header};

use super::HttpError;
use crate::{
    service::{Call, Error, Range, Service},
    wire::{ArtifactId, DownloadAnswer},
};

/// Answers with the bytes that the request's headers ask for.
pub(super) async fn answer(
    service: &Service,
    id: ArtifactId,
    headers: &HeaderMap,
    call: &Call,
) -> Result<Response, HttpError> {
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let wanted = text(header::RANGE).and_then(range);
    let everything = Range::From(0, None);
    let mut answer = service
        .download_range(id, wanted.unwrap_or(everything), call)
        .await
        .map_err(HttpError::of_a_range)?;
    let mut is_part = wanted.is_some();
    // The caller has a part of something else: it must have the whole.
    if is_part && text(header::IF_RANGE).is_some_and(|known| known != entity_tag(&answer)) {
        answer = service.download_range(id, everything, call).await?;
        is_part = false;
    }
    if is_part && answer.content.is_empty() {
        return Err(HttpError::of_a_range(Error::out_of_range(answer.size_bytes)));
    }
    response(answer, is_part)
}

fn response(answer: DownloadAnswer, is_part: bool) -> Result<Response, HttpError> {
    let status = if is_part { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
    let mut builder = Response::builder()
        .status(status)
        .header(header::CONTENT_TYPE, "application/octet-stream")
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::ETAG, entity_tag(&answer));
    if is_part {
        let last = answer.offset + answer.content.len() - 1;
        let place = format!("bytes {}-{last}/{}", answer.offset, answer.size_bytes);
        builder = builder.header(header::CONTENT_RANGE, place);
    }
    let response = builder.body(Body::from(answer.content));
    response.map_err(|fault| Error::internal("RESPONSE", &fault.to_string()).into())
}

/// The content's digest: the same for ever.
fn entity_tag(answer: &DownloadAnswer) -> String {
    format!("\"{}\"", answer.content_sha256)
}

/// One range of bytes; anything else in the header means the whole, as the RFC allows.
pub(super) fn range(header: &str) -> Option<Range> {
    let (first, last) = header.strip_prefix("bytes=")?.split_once('-')?;
    let number = |text: &str| {
        let is_number = !text.is_empty() && text.bytes().all(|c| c.is_ascii_digit());
        is_number.then(|| text.parse::<usize>().ok()).flatten()
    };
    match (first, last) {
        ("", last) => number(last).map(Range::Last),
        (first, "") => number(first).map(|first| Range::From(first, None)),
        (first, last) => {
            let (first, last) = (number(first)?, number(last)?);
            (first <= last).then(|| Range::From(first, Some((last - first).saturating_add(1))))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_of_bytes_is_read_and_nothing_else() {
        for (header, expected) in [
            ("bytes=0-0", Some(Range::From(0, Some(1)))),
            ("bytes=5-9", Some(Range::From(5, Some(5)))),
            ("bytes=5-", Some(Range::From(5, None))),
            ("bytes=-7", Some(Range::Last(7))),
            ("bytes=9-5", None),
            ("bytes=-", None),
            ("bytes=+1-2", None),
            ("bytes=0-1,3-4", None),
            ("lines=0-1", None),
            ("bytes=99999999999999999999-", None),
        ] {
            assert_eq!(range(header), expected, "{header}");
        }
    }
}
