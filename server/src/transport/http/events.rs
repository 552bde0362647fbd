//! An operation as events (server-sent events, WHATWG HTML): `progress` while it goes on, `done`
//! at its end, each with the operation as JSON.

use std::{
    convert::Infallible,
    time::{Duration, Instant},
};

use axum::response::{
    IntoResponse as _, Response,
    sse::{Event, KeepAlive, Sse},
};
use futures_util::stream;

use super::{HttpError, json};
use crate::{
    access::Pass,
    service::{Error, Watching},
    telemetry::RequestId,
    wire::{OperationAnswer, Render as _},
};

/// Longest life of one stream; a caller that wants more opens another.
const LIFE: Duration = Duration::from_secs(1800);
/// Between two events.
const PAUSE: Duration = Duration::from_millis(200);
/// A proxy must not take a quiet stream for a dead one.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// Events until the operation is done, the node ends, the caller may no longer see them or the
/// stream has lived its life.
pub(super) fn answer(watching: Watching, pass: Pass) -> Response {
    let until = Instant::now() + LIFE;
    let events = stream::unfold(Some((watching, pass, true)), move |open| async move {
        let (mut watching, pass, is_first) = open?;
        let answer = watching.next(is_first, PAUSE, until).await?;
        let (answer, open) = match pass.holds() {
            Ok(()) => (answer, Some((watching, pass, false))),
            Err(refusal) => (Err(refusal.into()), None),
        };
        Some((Ok::<_, Infallible>(event(answer)), open))
    });
    Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)).into_response()
}

fn event(answer: Result<OperationAnswer, Error>) -> Event {
    let (name, text) = match answer {
        Ok(answer) => {
            let operation = answer.render();
            let name = if operation.done { "done" } else { "progress" };
            (name, String::from_utf8_lossy(&json::encode(&operation)).into_owned())
        }
        Err(error) => ("error", HttpError::from(error).body(&RequestId::fresh())),
    };
    Event::default().event(name).data(text)
}
