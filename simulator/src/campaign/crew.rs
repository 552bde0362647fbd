//! Many runs at once.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
};

use tokio::{sync::mpsc, task::JoinSet};
use vbar_client::Client;

use super::{Progress, SimulationError};

/// Who flies the runs of a campaign.
pub(crate) struct Crew<'a> {
    /// Runs in flight at once.
    pub concurrency: usize,
    pub client: &'a Client,
    pub progress: &'a dyn Progress,
}

impl Crew<'_> {
    /// Calls `job` for every run below `runs`; results in order of the run.
    pub(crate) async fn each<C, T, F, Job>(
        &self,
        shared: Arc<C>,
        runs: u32,
        label: &str,
        job: Job,
    ) -> Result<Vec<T>, SimulationError>
    where
        C: Send + Sync + 'static,
        T: Send + 'static,
        F: Future<Output = Result<T, SimulationError>> + Send + 'static,
        Job: Fn(Client, Arc<C>, u32) -> F + Clone + Send + Sync + 'static,
    {
        self.progress.begin(label, u64::from(runs));
        let next = Arc::new(AtomicU32::new(0));
        let (sender, mut results) = mpsc::channel(self.concurrency);
        let mut workers = JoinSet::new();
        for _ in 0..self.concurrency {
            let (client, shared, next) = (self.client.clone(), shared.clone(), next.clone());
            let (sender, job) = (sender.clone(), job.clone());
            workers.spawn(async move {
                loop {
                    let run = next.fetch_add(1, Ordering::Relaxed);
                    if run >= runs {
                        return;
                    }
                    let result = job(client.clone(), shared.clone(), run).await;
                    // The receiver is gone only when another run has failed already.
                    if sender.send((run, result)).await.is_err() {
                        return;
                    }
                }
            });
        }
        drop(sender);
        let mut done = BTreeMap::new();
        while let Some((run, result)) = results.recv().await {
            done.insert(run, result?);
            self.progress.advance();
        }
        while let Some(ended) = workers.join_next().await {
            ended?;
        }
        self.progress.end();
        Ok(done.into_values().collect())
    }
}
