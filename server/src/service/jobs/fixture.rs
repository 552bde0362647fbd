//! Jobs whose shards wait until they are let go.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::Duration,
};

use vbar_guidance::Budget;

use super::{JobLimits, Stopped, Work};
use crate::{
    service::Error,
    store::StoreError,
    wire::{NoArtifact, Unread},
};

/// Where the work of a test looks what it should do, and notes what it did.
#[derive(Debug, Default)]
pub(super) struct Stage {
    /// Shards that may still be computed.
    let_go: AtomicUsize,
    pub(super) begun: Mutex<Vec<(u8, usize)>>,
    pub(super) made: Mutex<BTreeMap<u8, Vec<usize>>>,
}

impl Stage {
    pub(super) fn let_go(&self, shards: usize) {
        self.let_go.fetch_add(shards, Ordering::SeqCst);
    }

    pub(super) fn begun(&self) -> Vec<(u8, usize)> {
        self.begun.lock().unwrap().clone()
    }

    fn take_one(&self) -> bool {
        let take = |left: usize| left.checked_sub(1);
        self.let_go.fetch_update(Ordering::SeqCst, Ordering::SeqCst, take).is_ok()
    }
}

/// Collects the numbers of its shards.
#[derive(Debug)]
pub(super) struct Counting {
    pub(super) name: u8,
    pub(super) shards: usize,
    pub(super) stage: Arc<Stage>,
}

pub(super) const PANICS: u8 = 200;
pub(super) const CANNOT: u8 = 201;

impl Work for Counting {
    type Shard = usize;

    fn method(&self) -> &'static str {
        "counting"
    }

    fn is_made(&self) -> Result<bool, StoreError> {
        Ok(self.stage.made.lock().unwrap().contains_key(&self.name))
    }

    fn shards(&self) -> usize {
        self.shards
    }

    fn run_shard(&self, shard: usize, budget: Budget<'_>) -> Result<usize, Stopped> {
        budget.tell(1, 2);
        self.stage.begun.lock().unwrap().push((self.name, shard));
        assert_ne!(self.name, PANICS, "a bug");
        while !self.stage.take_one() {
            budget.check().map_err(|interruption| {
                let failure = vbar_guidance::control::Failure::from(interruption);
                Stopped::Failed(Error::from(failure).into())
            })?;
            thread::yield_now();
        }
        Ok(shard)
    }

    fn shard_to_bytes(&self, shard: &usize) -> Vec<u8> {
        vec![u8::try_from(*shard).unwrap()]
    }

    fn shard_from_bytes(&self, bytes: &[u8], _: Budget<'_>) -> Result<usize, Unread> {
        let [shard] = bytes else { return Err(Unread::Damaged("it is no shard".to_owned())) };
        Ok((*shard).into())
    }

    fn finish(&self, shards: Vec<usize>, _: Budget<'_>) -> Result<(), Stopped> {
        if self.name == CANNOT {
            return Err(Stopped::Infeasible(NoArtifact::from_bytes(b"").unwrap()));
        }
        self.stage.made.lock().unwrap().insert(self.name, shards);
        Ok(())
    }
}

pub(super) const LIMITS: JobLimits = JobLimits {
    threads: 2,
    unfinished_max: 4,
    time_max: Duration::from_secs(60),
    attempts_max: 3,
    kept_for: Duration::from_secs(3600),
};
