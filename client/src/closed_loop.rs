//! A controller in flight.

use prost::bytes::Bytes;
use tokio::{sync::mpsc, time::Instant};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Streaming};
use vbar_proto::v1::{
    Measurement, StepResponse, StepStreamRequest, StepStreamResponse,
    step_stream_request::Controller, step_stream_response,
};

use crate::{Client, Error, retry::Attempts};

/// A closed loop: one measurement in, one decision out, in order.
///
/// The loop itself holds everything needed to go on: when the stream breaks, the next attempt
/// opens another one with the controller and the last controller state. A decision is a pure
/// function of both, so nothing can be decided twice.
#[derive(Debug)]
pub struct ClosedLoop {
    client: Client,
    controller: Controller,
    controller_state: Bytes,
    omit_prediction: bool,
    stream: Option<Stream>,
}

/// One open stream; dropped as soon as its answers could no longer be told apart.
#[derive(Debug)]
struct Stream {
    requests: mpsc::Sender<StepStreamRequest>,
    answers: Streaming<StepStreamResponse>,
    /// The node has taken the controller; before that a refusal may concern it.
    accepted: bool,
}

impl ClosedLoop {
    pub(crate) fn new(client: Client, controller: Controller) -> Self {
        Self {
            client,
            controller,
            controller_state: Bytes::new(),
            omit_prediction: false,
            stream: None,
        }
    }

    /// Goes on from a state that an earlier step returned, on this node or on another.
    #[must_use]
    pub fn from_state(mut self, controller_state: Bytes) -> Self {
        self.controller_state = controller_state;
        self.stream = None;
        self
    }

    /// Leaves the predicted trajectory out of the answers.
    #[must_use]
    pub fn without_prediction(mut self) -> Self {
        self.omit_prediction = true;
        self
    }

    /// What another loop needs to go on from here; empty before the first step.
    #[must_use]
    pub fn controller_state(&self) -> &Bytes {
        &self.controller_state
    }

    /// Decides the next command.
    ///
    /// # Errors
    /// [`Error`], as every call. The loop stays usable: the next step goes on from the last
    /// decision that arrived.
    pub async fn step(&mut self, measurement: Measurement) -> Result<StepResponse, Error> {
        let Client { options, retries, .. } = &self.client;
        let deadline = Instant::now() + options.deadline;
        let mut attempts = Attempts::new(options.attempts_max, deadline, retries);
        loop {
            match attempts.bounded(self.attempt(&measurement)).await {
                Ok(response) => {
                    self.controller_state.clone_from(&response.controller_state);
                    return Ok(response);
                }
                Err(error) => attempts.pause_after(error).await?,
            }
        }
    }

    /// Sends one measurement and takes its answer. The stream is put back only once the answer
    /// is here, so an attempt that was cut off never leaves a late answer behind for the next;
    /// and once the node has taken the controller, since before that it must be sent again.
    async fn attempt(&mut self, measurement: &Measurement) -> Result<StepResponse, Error> {
        let mut stream = match self.stream.take() {
            Some(stream) => {
                let message = self.message(measurement, false);
                stream.requests.send(message).await.map_err(|_| closed())?;
                stream
            }
            None => self.open(self.message(measurement, true)).await?,
        };
        let answer = stream.answers.message().await?.ok_or_else(closed)?;
        let outcome = match answer.result {
            Some(step_stream_response::Result::Response(response)) => Ok(response),
            Some(step_stream_response::Result::Status(status)) => Err(status.into()),
            None => return Err(Error::broken_contract("an answer without a result")),
        };
        stream.accepted |= outcome.is_ok();
        if stream.accepted {
            self.stream = Some(stream);
        }
        outcome
    }

    /// Opens a stream with its first message already in it, because a node may read that
    /// before it answers at all.
    async fn open(&self, first: StepStreamRequest) -> Result<Stream, Error> {
        let (requests, receiver) = mpsc::channel(1);
        requests.send(first).await.map_err(|_| closed())?;
        let mut guidance = self.client.guidance.clone();
        let request = Request::new(ReceiverStream::new(receiver));
        let answers = guidance.step_stream(request).await?.into_inner();
        Ok(Stream { requests, answers, accepted: false })
    }

    fn message(&self, measurement: &Measurement, first: bool) -> StepStreamRequest {
        StepStreamRequest {
            controller: first.then(|| self.controller.clone()),
            controller_state: first.then(|| self.controller_state.clone()),
            measurement: Some(measurement.clone()),
            omit_prediction: self.omit_prediction,
        }
    }
}

fn closed() -> Error {
    Error::local(Code::Unavailable, "the node closed the stream")
}
