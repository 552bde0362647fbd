//! What goes over the wire, on its way into the audit log and the black box.

use std::{
    collections::VecDeque,
    mem,
    pin::Pin,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll, ready},
    time::Instant,
};

use ::http::HeaderMap;
use axum::body::{Body, Bytes};
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use sha2::{Digest as _, Sha256};
use tonic::Status;

use super::{
    GRPC_STATUS, code_of,
    framing::{Framing, Part},
};
use crate::{
    access::{AuditLine, Caller, Gate, Pass, Peer},
    recording::{Exchange, Recorder},
    telemetry::RequestId,
};

/// One call, written down when its last byte has gone or nobody is left to take it.
#[derive(Debug)]
pub(super) struct Record {
    pub(super) gate: Arc<Gate>,
    pub(super) peer: Peer,
    pub(super) caller: Caller,
    pub(super) role: &'static str,
    pub(super) call: &'static str,
    pub(super) transport: &'static str,
    pub(super) resource: String,
    pub(super) id: RequestId,
    pub(super) start: Instant,
    pub(super) asked: Arc<Mutex<Messages>>,
    pub(super) answered: Messages,
    /// What the answer's head or its end says; until then the caller is gone.
    pub(super) code: &'static str,
    /// Somebody reads the audit log.
    pub(super) is_audited: bool,
    /// On its way into the black box.
    pub(super) tape: Option<Tape>,
}

impl Record {
    /// Takes what the head or the end of an answer over gRPC says; `headers` are of either.
    pub(super) fn end(&mut self, headers: &HeaderMap) {
        let Some(status) = headers.get(GRPC_STATUS) else { return };
        self.code = code_of(status);
        if let (Some(tape), Some(status)) = (&mut self.tape, Status::from_header_map(headers)) {
            tape.exchange.code = status.code().into();
            tape.exchange.message = status.message().to_owned();
        }
    }

    /// The same over HTTP, whose head says it all; `number` is of the `google.rpc.Code`.
    pub(super) fn end_http(&mut self, code: &'static str, number: i32) {
        self.code = code;
        if let Some(tape) = &mut self.tape {
            tape.exchange.code = number;
        }
    }

    /// Nothing comes behind the head of the answer.
    pub(super) fn is_all(&mut self) {
        if let Some(tape) = &mut self.tape {
            tape.is_whole = true;
        }
    }
}

/// One call or closed loop, on its way into the black box.
#[derive(Debug)]
pub(super) struct Tape {
    pub(super) recorder: Arc<Recorder>,
    /// What is the same for all its messages.
    pub(super) exchange: Exchange,
    /// The answer has gone to its end.
    is_whole: bool,
}

impl Tape {
    /// Nothing has gone over the wire.
    pub(super) fn new(recorder: Arc<Recorder>, exchange: Exchange) -> Self {
        Self { recorder, exchange, is_whole: false }
    }

    /// A closed loop: each message with its answer, as soon as that is on its way.
    fn pairs(&mut self, asked: &Mutex<Messages>, answered: &mut Messages) {
        while let Some(answer) = answered.next_kept() {
            let request = asked.lock().unwrap_or_else(PoisonError::into_inner).next_kept();
            match (request, answer) {
                (Some(Kept::Whole(request)), Kept::Whole(answer)) => {
                    let answers = vec![answer];
                    self.recorder.take(Exchange { request, answers, ..self.exchange.clone() });
                }
                _ => self.recorder.lose(),
            }
            self.exchange.index += 1;
        }
    }

    /// A call, when all of it has gone over the wire.
    fn call(&mut self, asked: &mut Messages, answered: &mut Messages) {
        // Refused before it was read: nobody could ask that again.
        if !asked.has_ended {
            return;
        }
        let mut request = asked.all_kept().unwrap_or_default();
        let (Some(request), true) = (request.pop(), request.is_empty()) else {
            return self.recorder.lose();
        };
        let Some(answers) = answered.all_kept() else { return self.recorder.lose() };
        let exchange = mem::take(&mut self.exchange);
        self.recorder.take(Exchange { request, answers, ..exchange });
    }
}

impl Drop for Record {
    fn drop(&mut self) {
        let mut asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(tape) = &mut self.tape
            && tape.exchange.closed_loop.is_none()
            && tape.is_whole
        {
            tape.call(&mut asked, &mut self.answered);
        }
        if !self.is_audited {
            return;
        }
        let elapsed_us = u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX);
        self.gate.audit().write(&AuditLine {
            caller: self.caller.name(),
            peer: self.peer.address,
            role: self.role,
            call: self.call,
            transport: self.transport,
            resource: &self.resource,
            request_sha256: &asked.sha256(),
            answer_sha256: &self.answered.sha256(),
            messages_in: asked.count,
            messages_out: self.answered.count,
            code: self.code,
            request_id: &self.id.0,
            trace_id: self.id.trace_id().as_str(),
            elapsed_us,
        });
    }
}

/// The messages in a body: their digest, and their bytes if the black box wants them.
#[derive(Debug)]
pub(super) struct Messages {
    digest: Sha256,
    count: u64,
    framing: Framing,
    kept: Option<VecDeque<Kept>>,
    /// The one that is on its way.
    open: Kept,
    /// There are no more.
    has_ended: bool,
}

/// One message, for the black box.
#[derive(Debug)]
enum Kept {
    Whole(Vec<u8>),
    /// It was too large to be kept.
    TooLarge,
}

impl Kept {
    fn extend(&mut self, bytes: &[u8]) {
        if let Self::Whole(message) = self {
            if message.len() + bytes.len() > Recorder::MESSAGE_BYTES_MAX {
                *self = Self::TooLarge;
            } else {
                message.extend_from_slice(bytes);
            }
        }
    }

    fn take(&mut self) -> Self {
        mem::replace(self, Self::Whole(Vec::new()))
    }
}

impl Messages {
    /// None yet; their bytes are kept if `is_kept`.
    pub(super) fn new(is_grpc: bool, is_kept: bool) -> Self {
        Self {
            digest: Sha256::new(),
            count: 0,
            framing: Framing::new(is_grpc),
            kept: is_kept.then(VecDeque::new),
            open: Kept::Whole(Vec::new()),
            has_ended: false,
        }
    }

    fn take(&mut self, bytes: &[u8]) {
        let Self { digest, count, framing, kept, open, .. } = self;
        if matches!(framing, Framing::Whole) {
            *count |= u64::from(!bytes.is_empty());
        }
        framing.split(bytes, |part| match part {
            Part::Begin => *count += 1,
            Part::Bytes(bytes) => {
                digest.update(bytes);
                if kept.is_some() {
                    open.extend(bytes);
                }
            }
            Part::End => {
                if let Some(kept) = kept {
                    kept.push_back(open.take());
                }
            }
        });
    }

    /// The first message that was kept and has not been asked for.
    fn next_kept(&mut self) -> Option<Kept> {
        self.kept.as_mut()?.pop_front()
    }

    /// Every message; `None` if one was too large. A body that is one message ends here.
    fn all_kept(&mut self) -> Option<Vec<Vec<u8>>> {
        let mut kept = self.kept.take()?;
        if matches!(self.framing, Framing::Whole) {
            kept.push_back(self.open.take());
        }
        let mut size = 0;
        let whole = kept.into_iter().map(|kept| match kept {
            Kept::Whole(message) => {
                size += message.len();
                (size <= Recorder::MESSAGE_BYTES_MAX).then_some(message)
            }
            Kept::TooLarge => None,
        });
        whole.collect()
    }

    fn sha256(&mut self) -> String {
        let digest = self.digest.finalize_reset();
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// How many messages a framed body has, and their digest, if it comes in pieces of `length` bytes.
#[cfg(feature = "fuzzing")]
pub(super) fn read(body: &[u8], length: usize) -> (u64, String) {
    let mut messages = Messages::new(true, false);
    body.chunks(length).for_each(|piece| messages.take(piece));
    (messages.count, messages.sha256())
}

/// The body of a request.
#[derive(Debug)]
pub(super) struct Asked {
    body: Body,
    messages: Arc<Mutex<Messages>>,
}

impl Asked {
    /// `body`, of which `messages` are taken.
    pub(super) fn new(body: Body, messages: Arc<Mutex<Messages>>) -> Self {
        // Nobody will ask an empty body for more.
        let has_ended = body.is_end_stream();
        messages.lock().unwrap_or_else(PoisonError::into_inner).has_ended = has_ended;
        Self { body, messages }
    }
}

/// The body of an answer.
///
/// With it end the caller's place and what is written about the call. It goes in pieces, and the next
/// is not taken before there is room for it: a caller who does not take an answer that is longer
/// keeps its place.
#[derive(Debug)]
pub(super) struct Answered {
    body: Body,
    /// Behind the piece that has gone.
    rest: Bytes,
    record: Option<Record>,
    _pass: Option<Pass>,
}

impl Answered {
    /// As long as the largest frame that every caller takes (RFC 9113, sec. 6.5.2).
    const PIECE: usize = 16 << 10;

    /// `body`, of which `record` tells, for the holder of `pass`.
    pub(super) fn new(body: Body, record: Option<Record>, pass: Option<Pass>) -> Self {
        Self { body, rest: Bytes::new(), record, _pass: pass }
    }

    /// The next piece of what has come of the body.
    fn piece(&mut self) -> Option<Frame<Bytes>> {
        let length = self.rest.len().min(Self::PIECE);
        (length > 0).then(|| Frame::data(self.rest.split_to(length)))
    }

    /// Writes down what has come of the body.
    fn note(&mut self, frame: Option<&Frame<Bytes>>) {
        let has_ended = frame.is_none() || self.body.is_end_stream();
        let Some(record) = &mut self.record else { return };
        if let Some(data) = frame.and_then(Frame::data_ref) {
            record.answered.take(data);
        }
        if let Some(trailers) = frame.and_then(Frame::trailers_ref) {
            record.end(trailers);
            record.is_all();
        }
        if has_ended {
            record.is_all();
        }
        if let Record { tape: Some(tape), asked, answered, .. } = record
            && tape.exchange.closed_loop.is_some()
        {
            tape.pairs(asked, answered);
        }
    }
}

impl HttpBody for Asked {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        let mut messages = self.messages.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(data) = frame.as_ref().and_then(|f| f.as_ref().ok()?.data_ref()) {
            messages.take(data);
        }
        messages.has_ended = frame.is_none() || self.body.is_end_stream();
        drop(messages);
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl HttpBody for Answered {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if let Some(piece) = self.piece() {
            return Poll::Ready(Some(Ok(piece)));
        }
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context)).transpose();
        if let Ok(frame) = &frame {
            self.note(frame.as_ref());
        }
        let frame = match frame.transpose() {
            Some(Ok(frame)) => match frame.into_data() {
                Ok(data) if data.len() > Self::PIECE => {
                    self.rest = data;
                    self.piece().map(Ok)
                }
                Ok(data) => Some(Ok(Frame::data(data))),
                Err(frame) => Some(Ok(frame)),
            },
            other => other,
        };
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let (body, rest) = (self.body.size_hint(), self.rest.len() as u64);
        let mut hint = SizeHint::new();
        hint.set_lower(body.lower() + rest);
        if let Some(upper) = body.upper() {
            hint.set_upper(upper + rest);
        }
        hint
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_have_one_digest_and_are_kept_however_they_are_cut() {
        let whole = [b"abc".as_slice(), b"", &[7; 300]];
        let framed: Vec<u8> = whole
            .iter()
            .flat_map(|message| {
                let length = u32::try_from(message.len()).unwrap().to_be_bytes();
                [&[0], &length[..], *message].concat()
            })
            .collect();
        let expected = {
            let mut one = Messages::new(false, true);
            one.take(b"abc");
            one.take(&[7; 300]);
            assert_eq!(one.all_kept().unwrap(), [whole.concat()]);
            one.sha256()
        };
        for piece in [1, 2, 3, 5, 7, 64, framed.len()] {
            let mut messages = Messages::new(true, true);
            framed.chunks(piece).for_each(|bytes| messages.take(bytes));
            assert_eq!((messages.count, messages.sha256()), (3, expected.clone()), "{piece}");
            assert_eq!(messages.all_kept().unwrap(), whole, "{piece}");
        }
    }

    #[tokio::test]
    async fn answers_go_in_pieces_and_whole() {
        let content: Vec<u8> = (0..100_000_u32).map(|i| i.to_le_bytes()[0]).collect();
        let mut answered = Answered::new(Body::from(content.clone()), None, None);
        let (mut taken, mut count) = (Vec::new(), 0);
        loop {
            let left = content.len() - taken.len();
            assert_eq!(answered.size_hint().exact(), Some(left as u64));
            assert_eq!(answered.is_end_stream(), left == 0);
            let frame = std::future::poll_fn(|context| Pin::new(&mut answered).poll_frame(context));
            let Some(frame) = frame.await else { break };
            let data = frame.unwrap().into_data().unwrap();
            assert!(data.len() <= Answered::PIECE);
            taken.extend_from_slice(&data);
            count += 1;
        }
        assert!(taken == content && count == 7, "{count} pieces, {} bytes", taken.len());
    }

    #[test]
    fn messages_too_large_to_keep_are_not_kept_in_part() {
        let piece = vec![0; Recorder::MESSAGE_BYTES_MAX / 2];
        let mut messages = Messages::new(false, true);
        (0..3).for_each(|_| messages.take(&piece));
        assert_eq!(messages.all_kept(), None);
    }

    #[test]
    fn messages_digest_is_that_of_the_text() {
        let mut messages = Messages::new(false, false);
        messages.take(b"abc");
        // FIPS 180-2, appendix B.1.
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(messages.sha256(), expected);
    }
}
