//! Precompute as a long-running operation.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, watch};
use vbar_guidance::{Budget, control::PrepareError};

use super::{
    Call, Code, Error, Service,
    jobs::{Ending, Order, Stopped, View, Work},
    problem_path, record,
    shelves::Shelves,
};
use crate::{
    access::Caller,
    compute::Task,
    store::{Shelf, StoreError},
    wire::{
        self, ArtifactId, Failure, Limits, NoArtifact, OperationAnswer, OperationName,
        OperationOutcome, OperationsAnswer, OperationsCall, PrecomputeCall, Problem, Shard, Unread,
        WaitCall, problem_again,
    },
};

/// A precompute as a job.
#[derive(Debug)]
pub(super) struct Precompute {
    id: ArtifactId,
    problem: Problem,
    shelves: Arc<Shelves>,
}

impl Precompute {
    /// Of a recorded problem. Its method can have another version than when it was recorded, and
    /// then makes another artifact.
    pub(super) fn again(
        id: ArtifactId,
        problem: &[u8],
        limits: &Limits,
        shelves: &Arc<Shelves>,
    ) -> Result<Self, Failure> {
        let problem = problem_again(problem, limits)?;
        let present = record::problem_id(&problem);
        if present != id {
            let message = format!(
                "this server's {} is of another version: the same problem is operations/{present}",
                problem.method().name()
            );
            let error = Error::new(Code::FailedPrecondition, "METHOD_CHANGED", message);
            return Err(error.into());
        }
        Ok(Self { id, problem, shelves: Arc::clone(shelves) })
    }

    fn stopped(&self, fault: PrepareError) -> Stopped {
        match fault {
            PrepareError::Infeasible(why) => {
                Stopped::Infeasible(NoArtifact::new(&self.problem, &why))
            }
            fault => {
                let place = problem_path(self.problem.method());
                Stopped::Failed(Error::prepare(&place, fault).into())
            }
        }
    }
}

impl Work for Precompute {
    type Shard = Shard;

    fn method(&self) -> &'static str {
        self.problem.method().name()
    }

    fn is_made(&self) -> Result<bool, StoreError> {
        self.shelves.leases.is_kept(self.id)
    }

    fn shards(&self) -> usize {
        self.problem.shards()
    }

    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<Shard, Stopped> {
        self.problem.run_shard(shard, budget).map_err(|fault| self.stopped(fault))
    }

    fn shard_to_bytes(&self, shard: &Shard) -> Vec<u8> {
        self.problem.shard_to_bytes(shard)
    }

    fn shard_from_bytes(&self, bytes: &[u8], budget: Budget<'_>) -> Result<Shard, Unread> {
        self.problem.shard_from_bytes_within(bytes, budget)
    }

    fn finish(&self, shards: Vec<Shard>, budget: Budget<'_>) -> Result<(), Stopped> {
        let artifact = self.problem.merge(shards, budget).map_err(|fault| self.stopped(fault))?;
        let kept = self.shelves.keep(self.id, &artifact, budget);
        let kept = kept.map_err(|error| Stopped::Failed(error.into()))?;
        self.shelves.looked_up("computed");
        self.shelves.remember(Shelf::Artifacts, kept);
        Ok(())
    }
}

/// Somebody who is told about an operation as it goes on.
#[derive(Debug)]
pub(crate) struct Watching {
    service: Arc<Service>,
    caller: Caller,
    id: ArtifactId,
    changes: watch::Receiver<()>,
    is_over: bool,
    /// As long as this is held, it counts.
    _place: OwnedSemaphorePermit,
}

impl Watching {
    /// The operation as it stands: at once, then after each change or a second, at most one answer
    /// within `pause`; `None` after it is done, or when `until` has come or the node ends.
    pub(crate) async fn next(
        &mut self,
        is_first: bool,
        pause: Duration,
        until: Instant,
    ) -> Option<Result<OperationAnswer, Error>> {
        const LOOK_AGAIN: Duration = Duration::from_secs(1);
        if self.is_over {
            return None;
        }
        if !is_first {
            tokio::select! {
                _ = self.changes.changed() => tokio::time::sleep(pause).await,
                // A shard tells nobody how far it is: it is looked at.
                () = tokio::time::sleep(LOOK_AGAIN) => {}
                () = tokio::time::sleep_until(until.into()) => return None,
                () = self.service.jobs.closed() => return None,
            }
        }
        let deadline = self.service.deadline(None);
        let call = Call { caller: self.caller.clone(), deadline };
        let answer = match self.service.jobs.watch(self.id) {
            Ok((view, changes)) => {
                self.changes = changes;
                self.is_over = view.ending.is_some();
                self.service.operation_answer(view, &call).await
            }
            Err(error) => Err(error),
        };
        self.is_over |= answer.is_err();
        Some(answer)
    }
}

impl Service {
    /// `Precompute`. It waits a moment, so that what is computed fast is answered at once.
    pub(crate) async fn precompute(
        &self,
        ask: PrecomputeCall,
        call: &Call,
    ) -> Result<OperationAnswer, Error> {
        let PrecomputeCall { problem, message, request_id, validate_only } = ask;
        if validate_only {
            let (id, _) = self.validate(problem, call).await?.value;
            return Ok(OperationAnswer::Validated { id });
        }
        let id = record::problem_id(&problem);
        let work = Precompute { id, problem, shelves: Arc::clone(&self.shelves) };
        let (jobs, shelves) = (Arc::clone(&self.jobs), Arc::clone(&self.shelves));
        let submit = move |_: Budget<'_>| {
            let is_made = work.is_made()?;
            if is_made {
                shelves.leases.extend(id);
            } else {
                // Better told now than after hours of work.
                shelves.leases.admit(0)?;
            }
            jobs.submit(Order { id, work, problem: message, request_id, is_made })
        };
        self.compute.run(Task::Submit, &call.terms(), submit).await?.value?;
        let until = call.answer_by().min(Instant::now() + self.precompute_wait);
        let view = self.jobs.wait(id, until).await?;
        if let Some(Ending::Failed(failure)) = &view.ending
            && failure.is_invalid_problem()
        {
            return self.refuse_problem(id, failure.clone(), call).await;
        }
        self.operation_answer(view, call).await
    }

    /// Of a request at fault nothing is kept.
    async fn refuse_problem<T>(
        &self,
        id: ArtifactId,
        failure: Failure,
        call: &Call,
    ) -> Result<T, Error> {
        let jobs = Arc::clone(&self.jobs);
        let forget = move |_: Budget<'_>| jobs.delete(id);
        // Somebody else may have been faster, or have asked once more.
        let _ = self.compute.run(Task::Forget, &call.terms(), forget).await?;
        Err(Error {
            violations: failure.violations,
            ..Error::new(Code::InvalidArgument, "INVALID_REQUEST", failure.message)
        })
    }

    /// `GetOperation`.
    pub(crate) async fn operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<OperationAnswer, Error> {
        self.find(ask.id, call).await?;
        self.operation_answer(self.jobs.view(ask.id)?, call).await
    }

    /// Another node may have taken the order a moment ago.
    async fn find(&self, id: ArtifactId, call: &Call) -> Result<(), Error> {
        if self.jobs.view(id).is_ok() {
            return Ok(());
        }
        let jobs = Arc::clone(&self.jobs);
        let find = move |_: Budget<'_>| jobs.find(id);
        self.compute.run(Task::Load, &call.terms(), find).await?.value
    }

    /// `WaitOperation`: answers when it is done, at its timeout or a little before the call's
    /// deadline.
    pub(crate) async fn wait_operation(
        &self,
        ask: WaitCall,
        call: &Call,
    ) -> Result<OperationAnswer, Error> {
        let until = call.answer_by();
        let until = match ask.timeout {
            None => until,
            Some(timeout) => {
                Instant::now().checked_add(timeout).map_or(until, |end| end.min(until))
            }
        };
        self.find(ask.operation.id, call).await?;
        let view = self.jobs.wait(ask.operation.id, until).await?;
        self.operation_answer(view, call).await
    }

    /// `ListOperations`.
    pub(crate) async fn operations(
        &self,
        ask: OperationsCall,
        call: &Call,
    ) -> Result<OperationsAnswer, Error> {
        let mut views = self.jobs.list(&ask.filter, ask.after, ask.page_size + 1);
        let more = views.len() > ask.page_size;
        views.truncate(ask.page_size);
        let next = views.last().filter(|_| more).map(|view| view.progress.id);
        let mut operations = Vec::with_capacity(views.len());
        for view in views {
            operations.push(self.operation_answer(view, call).await?);
        }
        Ok(OperationsAnswer { operations, next })
    }

    /// `CancelOperation`: it is cancelled when this answers, or was done already.
    pub(crate) async fn cancel_operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<(), Error> {
        let jobs = Arc::clone(&self.jobs);
        let cancel = move |_: Budget<'_>| jobs.cancel(ask.id);
        self.compute.run(Task::Cancel, &call.terms(), cancel).await?.value
    }

    /// `DeleteOperation`: forgets a finished one; its artifact stays until it expires.
    pub(crate) async fn delete_operation(
        &self,
        ask: OperationName,
        call: &Call,
    ) -> Result<(), Error> {
        let jobs = Arc::clone(&self.jobs);
        let delete = move |_: Budget<'_>| jobs.delete(ask.id);
        self.compute.run(Task::Delete, &call.terms(), delete).await?.value
    }

    /// Follows an operation as it goes on.
    ///
    /// # Errors
    /// `NOT_FOUND`; `RESOURCE_EXHAUSTED` if too many are watching.
    pub(crate) async fn watch_operation(
        self: &Arc<Self>,
        ask: OperationName,
        call: Call,
    ) -> Result<Watching, Error> {
        const RETRY_AFTER: Duration = Duration::from_secs(10);
        self.find(ask.id, &call).await?;
        let (_, changes) = self.jobs.watch(ask.id)?;
        let place = Arc::clone(&self.watching).try_acquire_owned().map_err(|_| {
            let message = "too many callers watch operations; WaitOperation is there for all";
            Error {
                retry_after: Some(RETRY_AFTER),
                ..Error::new(Code::ResourceExhausted, "WATCHERS_FULL", message)
            }
        })?;
        let (service, caller) = (Arc::clone(self), call.caller);
        Ok(Watching { service, caller, id: ask.id, changes, is_over: false, _place: place })
    }

    /// A job as callers see it, with the artifact if that is what came of it.
    async fn operation_answer(&self, view: View, call: &Call) -> Result<OperationAnswer, Error> {
        let View { progress, ending } = view;
        let outcome = match ending {
            None => None,
            Some(Ending::Made) => Some(self.made(progress.id, call).await?),
            Some(Ending::Infeasible(why)) => Some(OperationOutcome::Infeasible(why)),
            Some(Ending::Failed(failure)) => Some(OperationOutcome::Failed(failure)),
            Some(Ending::Cancelled) => Some(OperationOutcome::Failed(wire::Failure::cancelled())),
        };
        Ok(OperationAnswer::Precompute { progress: Box::new(progress), outcome })
    }

    async fn made(&self, id: ArtifactId, call: &Call) -> Result<OperationOutcome, Error> {
        match self.load(Shelf::Artifacts, id, call).await {
            Ok(stored) => Ok(OperationOutcome::Made(self.shelves.answer(stored))),
            Err(error) if error.code == Code::NotFound => {
                let message = format!("artifact {id} was made and has expired since");
                let error = Error::new(Code::NotFound, "ARTIFACT_EXPIRED", message);
                Ok(OperationOutcome::Failed(error.into()))
            }
            Err(error) => Err(error),
        }
    }
}
