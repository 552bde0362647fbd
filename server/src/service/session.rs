//! A closed loop: the controller once, then one answer a message.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;

use super::{Call, Error, Found, Loaded, Service, load_state};
use crate::{
    compute::Timed,
    wire::{State, StepAnswer, StreamCall},
};

/// The server's side of one `StepStream`: the decoded artifact and the last state stay in memory
/// for as long as the stream lives.
#[derive(Debug)]
pub(crate) struct Session {
    service: Arc<Service>,
    opened: Option<Opened>,
}

#[derive(Debug)]
struct Opened {
    artifact: Loaded,
    state: State,
}

/// Answer to one message.
#[derive(Debug)]
pub(crate) enum SessionAnswer {
    /// A decided step.
    Step(Timed<StepAnswer>),
    /// The message only opened the loop.
    Opened,
}

impl Session {
    /// Not opened yet.
    pub(crate) fn new(service: Arc<Service>) -> Self {
        Self { service, opened: None }
    }

    /// Answers one message. After an error the session is as it was before the message, except
    /// that a controller that was found stays open.
    ///
    /// # Errors
    /// As for a single step; the controller must come with the first message and only there.
    pub(crate) async fn answer(
        &mut self,
        message: StreamCall,
        call: &Call,
    ) -> Result<SessionAnswer, Error> {
        let opening = match (message.controller, &self.opened) {
            (Some(controller), None) => {
                let artifact = match self.service.controller(controller, call).await? {
                    Found::Controller(artifact) => artifact,
                    Found::None(value) => {
                        let compute = Duration::ZERO;
                        return Ok(SessionAnswer::Step(Timed { value, compute }));
                    }
                };
                let state = artifact.artifact.start();
                self.opened = Some(Opened { artifact, state });
                true
            }
            (None, Some(_)) => false,
            (None, None) => {
                let expected = "one of artifact_id, problem, plan_id until the loop is open";
                return Err(Error::field("controller", expected, "nothing"));
            }
            (Some(_), Some(_)) => {
                let expected = "nothing: the loop is already open";
                return Err(Error::field("controller", expected, "a controller"));
            }
        };
        let Some(opened) = &mut self.opened else {
            return Err(Error::internal("SESSION", "a session that was opened is not open"));
        };
        if let Some(given) = &message.controller_state {
            opened.state = load_state(&opened.artifact, given)?;
        }
        let Some(measurement) = message.measurement else {
            if opening {
                return Ok(SessionAnswer::Opened);
            }
            return Err(Error::field("measurement", "a value (the field is required)", "nothing"));
        };
        let artifact = opened.artifact.clone();
        let state = opened.state.clone();
        let answer = self
            .service
            .decide(
                artifact,
                StateSource::Decoded(Box::new(state)),
                measurement,
                message.omit_prediction,
                call,
            )
            .await?;
        opened.state = answer.value.step.next();
        Ok(SessionAnswer::Step(answer.map(StepAnswer::Decided)))
    }
}

/// Where a step's state comes from.
#[derive(Debug)]
pub(super) enum StateSource {
    /// As it travelled; empty at the start.
    Envelope(Bytes),
    /// Kept by a session.
    Decoded(Box<State>),
}
