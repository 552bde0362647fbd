//! Precomputes: started, followed, waited for, stopped.

use std::time::Duration;

use prost::{Message, Name};
use tokio::time::Instant;
use tonic::Code;
use vbar_proto::{
    google::longrunning::{
        CancelOperationRequest, DeleteOperationRequest, GetOperationRequest, ListOperationsRequest,
        ListOperationsResponse, Operation, WaitOperationRequest, operation,
    },
    v1::{PrecomputeMetadata, PrecomputeRequest, PrecomputeResponse, Problem},
};

use crate::{Client, Error, retry::time_left};

/// A node is asked to hold one wait for at most this long; then it is asked again.
const WAIT_MAX: Duration = Duration::from_secs(10);
/// The same while somebody wants to see progress.
const REPORT_EVERY: Duration = Duration::from_millis(250);
/// Shortest and longest pause between two looks at an operation.
const LOOK_PAUSE: (Duration, Duration) = (Duration::from_millis(20), Duration::from_secs(1));

impl Client {
    /// Makes an artifact and waits until it is done, within
    /// [`Options::precompute_deadline`](crate::Options::precompute_deadline).
    ///
    /// # Errors
    /// [`Error`], as every call, and whatever ended the operation.
    pub async fn precompute(&self, problem: Problem) -> Result<PrecomputeResponse, Error> {
        let deadline = Instant::now() + self.options.precompute_deadline;
        let operation = self.start_precompute(problem).await?;
        finished(self.wait(operation, deadline, WAIT_MAX, |_| ()).await?)
    }

    /// The same, telling `report` several times a second how far it is.
    ///
    /// If this future is dropped the node goes on; [`Client::cancel_operation`] stops it.
    ///
    /// # Errors
    /// As [`Client::precompute`].
    pub async fn precompute_reporting(
        &self,
        problem: Problem,
        mut report: impl FnMut(&PrecomputeMetadata),
    ) -> Result<PrecomputeResponse, Error> {
        let deadline = Instant::now() + self.options.precompute_deadline;
        let operation = self.start_precompute(problem).await?;
        let operation = self
            .wait(operation, deadline, REPORT_EVERY, |operation| {
                // A node without this metadata has nothing to report.
                if let Ok(metadata) = progress(operation) {
                    report(&metadata);
                }
            })
            .await?;
        finished(operation)
    }

    /// Starts a precompute; it may be done already when this answers.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn start_precompute(&self, problem: Problem) -> Result<Operation, Error> {
        // No request id: the problem's own digest already makes a repeated call the same job.
        let request = PrecomputeRequest { problem: Some(problem), ..PrecomputeRequest::default() };
        let within = self.options.deadline.min(self.options.precompute_deadline);
        self.call(within, request, |request| {
            let mut guidance = self.guidance.clone();
            async move { guidance.precompute(request).await }
        })
        .await
    }

    /// The present state of an operation, `operations/{id}`.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; [`Error`], as every call.
    pub async fn operation(&self, name: &str) -> Result<Operation, Error> {
        self.look(name, self.options.deadline).await
    }

    /// A page of operations.
    ///
    /// # Errors
    /// [`Error`], as every call.
    pub async fn operations(
        &self,
        request: ListOperationsRequest,
    ) -> Result<ListOperationsResponse, Error> {
        self.call(self.options.deadline, request, |request| {
            let mut operations = self.operations.clone();
            async move { operations.list_operations(request).await }
        })
        .await
    }

    /// Stops an operation that is not done.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; [`Error`], as every call.
    pub async fn cancel_operation(&self, name: &str) -> Result<(), Error> {
        let request = CancelOperationRequest { name: name.to_owned() };
        self.call(self.options.deadline, request, |request| {
            let mut operations = self.operations.clone();
            async move { operations.cancel_operation(request).await }
        })
        .await
    }

    /// Has the node forget a finished operation; its artifact stays until it expires.
    ///
    /// # Errors
    /// `NOT_FOUND` if the node does not have it; `FAILED_PRECONDITION` if it is not done;
    /// [`Error`], as every call.
    pub async fn delete_operation(&self, name: &str) -> Result<(), Error> {
        let request = DeleteOperationRequest { name: name.to_owned() };
        self.call(self.options.deadline, request, |request| {
            let mut operations = self.operations.clone();
            async move { operations.delete_operation(request).await }
        })
        .await
    }

    /// Follows `operation` until it is done; `report` sees every state of it, `every` so often.
    async fn wait(
        &self,
        mut operation: Operation,
        deadline: Instant,
        every: Duration,
        mut report: impl FnMut(&Operation),
    ) -> Result<Operation, Error> {
        let mut can_wait = true;
        let mut pause = LOOK_PAUSE.0;
        loop {
            report(&operation);
            if operation.done {
                return Ok(operation);
            }
            let left = time_left(deadline)?;
            let latest = if can_wait {
                self.wait_once(&operation.name, left, every).await
            } else {
                tokio::time::sleep(pause.min(left)).await;
                pause = (pause * 2).min(LOOK_PAUSE.1);
                self.look(&operation.name, left).await
            };
            match latest {
                Ok(latest) => operation = latest,
                // AIP-151 makes waiting optional for a node; looking is not.
                Err(error) if can_wait && error.code == Code::Unimplemented => can_wait = false,
                // The node has no room for a look just now, which says nothing of the operation.
                Err(Error { code: Code::ResourceExhausted, retry_after: Some(asked), .. }) => {
                    self.retries.add_one();
                    tokio::time::sleep(asked.min(left)).await;
                }
                Err(error) => return Err(error),
            }
        }
    }

    async fn wait_once(
        &self,
        name: &str,
        left: Duration,
        every: Duration,
    ) -> Result<Operation, Error> {
        // A shorter wait than the call's own deadline, so that "not done yet" is an answer.
        let wait = left.min(every).min(self.options.deadline).mul_f64(0.8);
        let timeout = prost_types::Duration::try_from(wait).ok();
        let request = WaitOperationRequest { name: name.to_owned(), timeout };
        self.call(left.min(self.options.deadline), request, |request| {
            let mut operations = self.operations.clone();
            async move { operations.wait_operation(request).await }
        })
        .await
    }

    async fn look(&self, name: &str, left: Duration) -> Result<Operation, Error> {
        let request = GetOperationRequest { name: name.to_owned() };
        self.call(left.min(self.options.deadline), request, |request| {
            let mut operations = self.operations.clone();
            async move { operations.get_operation(request).await }
        })
        .await
    }
}

/// How far a precompute is.
///
/// # Errors
/// `INTERNAL` for an operation that carries something else.
pub fn progress(operation: &Operation) -> Result<PrecomputeMetadata, Error> {
    unpacked(operation.metadata.as_ref())
}

/// Result of a finished precompute.
fn finished(operation: Operation) -> Result<PrecomputeResponse, Error> {
    match operation.result {
        Some(operation::Result::Response(packed)) => unpacked(Some(&packed)),
        Some(operation::Result::Error(status)) => Err(status.into()),
        None => Err(Error::broken_contract("a finished operation without a result")),
    }
}

fn unpacked<M: Message + Name + Default>(packed: Option<&prost_types::Any>) -> Result<M, Error> {
    let broken = |why: String| Error::broken_contract(&format!("in place of a {}: {why}", M::NAME));
    let packed = packed.ok_or_else(|| broken("nothing".to_owned()))?;
    if packed.type_url != M::type_url() {
        return Err(broken(packed.type_url.clone()));
    }
    M::decode(packed.value.as_slice()).map_err(|fault| broken(fault.to_string()))
}
