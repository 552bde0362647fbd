//! The threads that do jobs. They are their own, so that no number of jobs takes a thread from
//! steps; how many there are decides how much of the machine jobs may have.

use std::{
    io,
    sync::{Arc, atomic::Ordering},
    thread::{self, JoinHandle},
    time::Instant,
};

use vbar_guidance::{Budget, Progress};

use super::{
    Ending, Inner, Work,
    board::{RunKey, Turn},
};
use crate::{
    compute::{until, yield_to_steps},
    service::jobs::caught,
    store::Ledger,
    wire::ArtifactId,
};

/// Starts the threads; they end when the board is closed.
pub(super) fn start<W: Work>(inner: &Arc<Inner<W>>) -> io::Result<Vec<JoinHandle<()>>> {
    let start = |number| {
        let inner = Arc::clone(inner);
        thread::Builder::new().name(format!("job-{number}")).spawn(move || inner.work())
    };
    (0..inner.limits.threads).map(start).collect()
}

impl<W: Work> Inner<W> {
    /// Body of a thread.
    fn work(&self) {
        yield_to_steps();
        while let Some(turn) = self.next_turn() {
            if turn.is_first {
                self.write_down_begin(turn.id, &turn.run);
            }
            if let Some(ending) = self.run(&turn) {
                // A thread's end of a job is always taken in, written down or not.
                let _ = self.end(turn.id, Some(&turn.run), ending);
            }
        }
    }

    /// Waits for a shard; `None` when the node ends.
    fn next_turn(&self) -> Option<Turn<W>> {
        let mut board = self.board();
        loop {
            if board.is_closed() {
                return None;
            }
            if let Some(turn) = board.take(self.limits.time_max) {
                return Some(turn);
            }
            board = self.ready.wait(board).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
    }

    /// Counts the attempt before anything can go wrong in it.
    fn write_down_begin(&self, id: ArtifactId, run: &RunKey) {
        let _journal = self.journal();
        let Some((record, revision)) = self.board().unfinished_record(&id, Some(run)) else {
            return;
        };
        match self.store.write(Ledger::Jobs, &id.0, record.encode().into(), revision) {
            Ok(revision) => self.board().written(&id, revision),
            Err(fault) => tracing::error!(%id, %fault, "the start of a job was not written down"),
        }
    }

    /// Computes a shard, and finishes the job with the last one. How the job ended, if it did.
    fn run(&self, turn: &Turn<W>) -> Option<Ending> {
        let stop = until(turn.deadline, Arc::clone(&turn.run));
        let start = Instant::now();
        let tell = |progress: Progress| turn.told.shard(turn.shard, progress);
        let budget = Budget::new(&stop);
        let shard = caught(|| turn.work.run_shard(turn.shard, budget.telling(&tell)));
        self.metrics.job_shard_seconds.observe(start.elapsed().as_secs_f64());
        // Cancelled or handed back: its end is written by whoever stopped it.
        if turn.run.load(Ordering::Relaxed) {
            return None;
        }
        let ended = match shard {
            Ok(shard) => {
                let shards = self.board().deliver(turn, shard)?;
                let tell = |progress: Progress| turn.told.merge(progress);
                caught(|| turn.work.finish(shards, budget.telling(&tell)))
            }
            Err(stopped) => Err(stopped),
        };
        // Stopped while it was merged: as above.
        let is_stopped = ended.is_err() && turn.run.load(Ordering::Relaxed);
        (!is_stopped).then(|| ended.map_or_else(Ending::from, |()| Ending::Made))
    }
}
