//! Several machines in one process, for tests of how they work together.

use std::{
    collections::{HashMap, HashSet, VecDeque},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant, SystemTime},
};

use bytes::Bytes;

use super::{Change, Follower, Hearer, Lease, Leased, Shared, Task};
use crate::store::{Entry, Ledger, MemoryStore, Put, RecordId, Revision, Shelf, Store, StoreError};

/// One machine's hold on a store in memory with a queue.
#[derive(Debug)]
pub(crate) struct MemoryShared {
    lease_term: Duration,
    store: Arc<MemoryStore>,
    queue: Arc<Queue>,
    listeners: Arc<Mutex<Listeners>>,
    /// Nothing answers this machine while it is set.
    is_down: Arc<AtomicBool>,
}

#[derive(Debug, Default)]
struct Queue {
    tasks: Mutex<Tasks>,
    ready: Condvar,
}

#[derive(Debug, Default)]
struct Tasks {
    waiting: VecDeque<(Task, u64)>,
    /// When each lease runs out.
    leased: HashMap<u64, (Task, u64, Instant)>,
    leases: u64,
    names: HashSet<(RecordId, String)>,
}

#[derive(Default)]
struct Listeners {
    followers: Vec<(Ledger, Follower)>,
    hearers: Vec<Hearer>,
}

impl std::fmt::Debug for Listeners {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} followers, {} hearers", self.followers.len(), self.hearers.len())
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl MemoryShared {
    /// An empty store whose leases last for `lease_term`.
    pub(crate) fn new(lease_term: Duration) -> Self {
        Self {
            lease_term,
            store: Arc::new(MemoryStore::new(1 << 30)),
            queue: Arc::default(),
            listeners: Arc::default(),
            is_down: Arc::default(),
        }
    }

    /// Another machine's hold on the same store.
    pub(crate) fn another(&self) -> Self {
        Self {
            lease_term: self.lease_term,
            store: Arc::clone(&self.store),
            queue: Arc::clone(&self.queue),
            listeners: Arc::clone(&self.listeners),
            is_down: Arc::default(),
        }
    }

    /// From now on nothing answers this machine, or everything does again.
    pub(crate) fn set_down(&self, is_down: bool) {
        self.is_down.store(is_down, Ordering::SeqCst);
        if !is_down {
            let listeners = locked(&self.listeners);
            listeners
                .followers
                .iter()
                .for_each(|(ledger, follower)| self.tell_all(*ledger, follower));
        }
    }

    /// Forgets every task, as a queue that was lost.
    pub(crate) fn lose_tasks(&self) {
        let mut tasks = locked(&self.queue.tasks);
        tasks.waiting.clear();
        tasks.names.clear();
    }

    /// Erases an entry, and nobody is told.
    pub(crate) fn erase_untold(&self, ledger: Ledger, id: &RecordId) {
        let there = self.store.read(ledger, id).unwrap().unwrap();
        self.store.erase(ledger, id, there.revision).unwrap();
    }

    /// Tasks that nobody has leased.
    pub(crate) fn waiting(&self) -> usize {
        locked(&self.queue.tasks).waiting.len()
    }

    fn tell_all(&self, ledger: Ledger, follower: &Follower) {
        let ids = self.store.entries(ledger).unwrap();
        let all =
            ids.into_iter().filter_map(|id| Some((id, self.store.read(ledger, &id).unwrap()?)));
        follower(Change::All(all.collect()));
    }

    fn announce(&self, ledger: Ledger, change: &Change) {
        let listeners = locked(&self.listeners);
        for (_, follower) in listeners.followers.iter().filter(|(followed, _)| *followed == ledger)
        {
            follower(change.clone());
        }
    }
}

fn answers(is_down: &AtomicBool) -> Result<(), StoreError> {
    if is_down.load(Ordering::SeqCst) {
        return Err(StoreError::Unreachable("it is down".to_owned()));
    }
    Ok(())
}

impl Store for MemoryShared {
    fn put_if_absent(&self, shelf: Shelf, id: &RecordId, bytes: Bytes) -> Result<Put, StoreError> {
        self.reach()?;
        self.store.put_if_absent(shelf, id, bytes)
    }

    fn get(&self, shelf: Shelf, id: &RecordId) -> Result<Option<Bytes>, StoreError> {
        self.reach()?;
        self.store.get(shelf, id)
    }

    fn list(
        &self,
        shelf: Shelf,
        after: Option<&RecordId>,
        limit: usize,
    ) -> Result<Vec<RecordId>, StoreError> {
        self.reach()?;
        self.store.list(shelf, after, limit)
    }

    fn remove(&self, shelf: Shelf, id: &RecordId) -> Result<(), StoreError> {
        self.reach()?;
        self.store.remove(shelf, id)
    }

    fn read(&self, ledger: Ledger, id: &RecordId) -> Result<Option<Entry>, StoreError> {
        self.reach()?;
        self.store.read(ledger, id)
    }

    fn write(
        &self,
        ledger: Ledger,
        id: &RecordId,
        bytes: Bytes,
        seen: Revision,
    ) -> Result<Revision, StoreError> {
        self.reach()?;
        let revision = self.store.write(ledger, id, bytes.clone(), seen)?;
        self.announce(ledger, &Change::Written(*id, Entry { bytes, revision }));
        Ok(revision)
    }

    fn erase(&self, ledger: Ledger, id: &RecordId, seen: Revision) -> Result<(), StoreError> {
        self.reach()?;
        self.store.erase(ledger, id, seen)?;
        self.announce(ledger, &Change::Erased(*id));
        Ok(())
    }

    fn entries(&self, ledger: Ledger) -> Result<Vec<RecordId>, StoreError> {
        self.reach()?;
        self.store.entries(ledger)
    }

    fn reach(&self) -> Result<(), StoreError> {
        answers(&self.is_down)
    }
}

impl Shared for MemoryShared {
    fn queue(&self, task: Task) -> Result<(), StoreError> {
        self.reach()?;
        let mut tasks = locked(&self.queue.tasks);
        if tasks.names.insert((task.group, task.name.clone())) {
            tasks.waiting.push_back((task, 0));
            self.queue.ready.notify_one();
        }
        Ok(())
    }

    fn lease(&self, patience: Duration) -> Result<Option<Leased>, StoreError> {
        const LOOK_EVERY: Duration = Duration::from_millis(5);
        self.reach()?;
        let until = Instant::now() + patience;
        let mut tasks = locked(&self.queue.tasks);
        loop {
            let now = Instant::now();
            let over: Vec<u64> =
                tasks.leased.iter().filter(|(_, held)| held.2 < now).map(|(key, _)| *key).collect();
            for key in over {
                let (task, deliveries, _) = tasks.leased.remove(&key).unwrap();
                tasks.waiting.push_front((task, deliveries));
            }
            if let Some((task, before)) = tasks.waiting.pop_front() {
                tasks.leases += 1;
                let key = tasks.leases;
                let bytes = task.bytes.clone();
                tasks.leased.insert(key, (task, before + 1, now + self.lease_term));
                let queue = Arc::downgrade(&self.queue);
                let is_down = Arc::clone(&self.is_down);
                let lease = Box::new(MemoryLease { queue, key, term: self.lease_term, is_down });
                return Ok(Some(Leased { bytes, deliveries: before + 1, lease }));
            }
            if now >= until {
                return Ok(None);
            }
            tasks = self
                .queue
                .ready
                .wait_timeout(tasks, LOOK_EVERY)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
    }

    fn lease_term(&self) -> Duration {
        self.lease_term
    }

    fn withdraw(&self, group: &RecordId) -> Result<(), StoreError> {
        self.reach()?;
        locked(&self.queue.tasks).waiting.retain(|(task, _)| task.group != *group);
        Ok(())
    }

    /// A record is put at once or not at all.
    fn tidy(&self, _: SystemTime) -> Result<usize, StoreError> {
        self.reach().map(|()| 0)
    }

    fn follow(&self, ledger: Ledger, follower: Follower) {
        let mut listeners = locked(&self.listeners);
        self.tell_all(ledger, &follower);
        listeners.followers.push((ledger, follower));
    }

    fn tell(&self, word: Bytes) {
        locked(&self.listeners).hearers.iter().for_each(|hearer| hearer(word.clone()));
    }

    fn hear(&self, hearer: Hearer) {
        locked(&self.listeners).hearers.push(hearer);
    }
}

#[derive(Debug)]
struct MemoryLease {
    queue: Weak<Queue>,
    key: u64,
    term: Duration,
    is_down: Arc<AtomicBool>,
}

impl Lease for MemoryLease {
    fn renew(&self) -> Result<(), StoreError> {
        answers(&self.is_down)?;
        if let Some(queue) = self.queue.upgrade()
            && let Some(held) = locked(&queue.tasks).leased.get_mut(&self.key)
        {
            held.2 = Instant::now() + self.term;
        }
        Ok(())
    }

    fn done(&self) -> Result<(), StoreError> {
        answers(&self.is_down)?;
        if let Some(queue) = self.queue.upgrade() {
            locked(&queue.tasks).leased.remove(&self.key);
        }
        Ok(())
    }

    fn hand_back(&self) -> Result<(), StoreError> {
        answers(&self.is_down)?;
        if let Some(queue) = self.queue.upgrade() {
            let mut tasks = locked(&queue.tasks);
            if let Some((task, deliveries, _)) = tasks.leased.remove(&self.key) {
                tasks.waiting.push_front((task, deliveries));
                queue.ready.notify_one();
            }
        }
        Ok(())
    }
}
