//! How long the body of a gRPC request may take to arrive.
//!
//! A call with one message must be there in time, all of it; in a closed loop each message that was
//! begun. Between two of those a caller may be silent for as long as it likes. Bodies over HTTP are
//! timed where they are read.

use std::{
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use axum::body::{Body, Bytes};
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};
use tonic::Status;

use super::framing::Framing;

/// The body of a request that is not waited for without end.
#[derive(Debug)]
pub(super) struct Patient {
    body: Body,
    within: Duration,
    is_stream: bool,
    framing: Framing,
    /// Since when something is missing; `None` if nothing is.
    since: Option<Instant>,
    /// Made when there is something to wait for.
    sleep: Option<Pin<Box<Sleep>>>,
    /// What is said of a body that was too slow.
    refusal: fn(Duration) -> Status,
}

impl Patient {
    /// `body`, whose message or messages may each take `within`.
    pub(super) fn new(
        body: Body,
        within: Duration,
        is_stream: bool,
        refusal: fn(Duration) -> Status,
    ) -> Self {
        let since = (!is_stream).then(Instant::now);
        let framing = Framing::new(true);
        Self { body, within, is_stream, framing, since, sleep: None, refusal }
    }

    fn arrived(&mut self, bytes: &[u8]) {
        let mut ended = false;
        self.framing.split(bytes, |part| ended |= part == super::framing::Part::End);
        if !self.is_stream {
            return;
        }
        if ended || !self.framing.is_within() {
            (self.since, self.sleep) = (None, None);
        }
        if self.framing.is_within() {
            self.since.get_or_insert_with(Instant::now);
        }
    }

    /// Ready when a message has taken too long.
    fn poll_late(&mut self, context: &mut Context<'_>) -> Poll<()> {
        let Some(since) = self.since else { return Poll::Pending };
        let late = since + self.within;
        self.sleep.get_or_insert_with(|| Box::pin(sleep_until(late))).as_mut().poll(context)
    }
}

impl HttpBody for Patient {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) else {
            return self.poll_late(context).map(|()| {
                let status = (self.refusal)(self.within);
                Some(Err(axum::Error::new(status)))
            });
        };
        if let Some(data) = frame.as_ref().and_then(|frame| frame.as_ref().ok()?.data_ref()) {
            self.arrived(data);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
