//! How much one caller may ask for.

use std::{
    collections::hash_map::RandomState,
    hash::BuildHasher as _,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::options::OptionFault;

/// Limits of one caller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rate {
    /// Requests in a second, on average.
    pub(super) per_s: f64,
    /// Requests at once after a silence.
    pub(super) burst: u32,
    /// Calls under way at once.
    pub(super) calls_max: u32,
}

impl Rate {
    /// Everything that is wrong, by the names of the settings.
    pub(super) fn faults(&self) -> Vec<OptionFault> {
        let mut faults = Vec::new();
        if !(1e-3..=1e9).contains(&self.per_s) {
            let got = self.per_s.to_string();
            faults.push(OptionFault::new("caller_rate_max_per_s", "0.001 to 1e9", got));
        }
        faults.extend(count_fault("caller_burst_max", self.burst));
        faults.extend(count_fault("caller_calls_max", self.calls_max));
        faults
    }
}

/// What is wrong with a number of things at once, if anything.
pub(super) fn count_fault(setting: &'static str, value: u32) -> Option<OptionFault> {
    let is_good = (1..=1_000_000).contains(&value);
    (!is_good).then(|| OptionFault::new(setting, "1 to 1000000", value.to_string()))
}

/// What one caller has left: a bucket of requests that fills again with time, and places for calls
/// under way.
#[derive(Debug)]
pub(super) struct Allowance {
    pub(super) rate: Rate,
    bucket: Mutex<Bucket>,
    places: Arc<Semaphore>,
}

#[derive(Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

/// Why a call is not taken, and when to ask again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Exceeded {
    /// Too many requests in too short a time.
    Rate(Duration),
    /// Too many calls under way.
    Calls(Duration),
}

impl Allowance {
    /// Nothing used yet.
    pub(super) fn new(rate: Rate, now: Instant) -> Self {
        Self {
            rate,
            bucket: Mutex::new(Bucket { left: f64::from(rate.burst), at: now }),
            places: places(rate.calls_max),
        }
    }

    /// A place for a call, held until it is dropped.
    pub(super) fn call(&self) -> Result<OwnedSemaphorePermit, Exceeded> {
        /// Nobody knows when the caller's own calls end.
        const RETRY_AFTER: Duration = Duration::from_millis(100);
        let place = Arc::clone(&self.places).try_acquire_owned();
        place.map_err(|_| Exceeded::Calls(RETRY_AFTER))
    }

    /// One request.
    pub(super) fn request(&self, now: Instant) -> Result<(), Exceeded> {
        let mut bucket = self.bucket.lock().unwrap_or_else(PoisonError::into_inner);
        let since = now.saturating_duration_since(bucket.at).as_secs_f64();
        bucket.left = f64::from(self.rate.burst).min(bucket.left + since * self.rate.per_s);
        bucket.at = bucket.at.max(now);
        if bucket.left < 1.0 {
            let delay = (1.0 - bucket.left) / self.rate.per_s;
            return Err(Exceeded::Rate(Duration::from_secs_f64(delay.max(1e-3))));
        }
        bucket.left -= 1.0;
        Ok(())
    }
}

fn places(count: u32) -> Arc<Semaphore> {
    let count = usize::try_from(count).unwrap_or(Semaphore::MAX_PERMITS);
    Arc::new(Semaphore::new(count.min(Semaphore::MAX_PERMITS)))
}

/// What callers are allowed by their address: all connections, and calls of those without a name.
///
/// A fixed number of places, so that no number of addresses takes more memory; whose addresses
/// fall on one place share it, and which do is drawn anew by every process.
#[derive(Debug)]
pub(super) struct Addresses {
    places: Vec<(Allowance, Arc<Semaphore>)>,
    hasher: RandomState,
}

impl Addresses {
    const PLACES: usize = 4096;

    pub(super) fn new(rate: Rate, connections_max: u32, now: Instant) -> Self {
        let place = |_| (Allowance::new(rate, now), places(connections_max));
        let places = (0..Self::PLACES).map(place).collect();
        Self { places, hasher: RandomState::new() }
    }

    /// The allowance of the caller of that name.
    pub(super) fn of(&self, name: &str) -> &Allowance {
        &self.place(name).0
    }

    /// A place for a connection, held until it is dropped; `None` if the caller of that name has
    /// all it may have.
    pub(super) fn connection(&self, name: &str) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.place(name).1).try_acquire_owned().ok()
    }

    fn place(&self, name: &str) -> &(Allowance, Arc<Semaphore>) {
        let place = self.hasher.hash_one(name) % Self::PLACES as u64;
        &self.places[usize::try_from(place).unwrap_or_default()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: Rate = Rate { per_s: 4.0, burst: 3, calls_max: 2 };

    #[test]
    fn allowance_takes_a_burst_then_the_rate_and_says_when_to_ask_again() {
        let start = Instant::now();
        let allowance = Allowance::new(RATE, start);
        for _ in 0..3 {
            assert_eq!(allowance.request(start), Ok(()));
        }
        let quarter = Duration::from_millis(250);
        assert_eq!(allowance.request(start), Err(Exceeded::Rate(quarter)));
        // A refused request costs nothing, and who waits as told is taken.
        assert_eq!(allowance.request(start + quarter), Ok(()));
        let refused = allowance.request(start + quarter + quarter / 2);
        assert_eq!(refused, Err(Exceeded::Rate(quarter / 2)));
        // A long silence gives no more than a burst.
        let later = start + Duration::from_secs(3600);
        let taken = (0..10).filter(|_| allowance.request(later).is_ok()).count();
        assert_eq!(taken, 3);
    }

    #[test]
    fn allowance_is_not_changed_by_a_clock_that_steps_back() {
        let start = Instant::now() + Duration::from_secs(10);
        let allowance = Allowance::new(RATE, start);
        for _ in 0..3 {
            assert_eq!(allowance.request(start - Duration::from_secs(5)), Ok(()));
        }
        assert!(allowance.request(start).is_err());
    }

    #[test]
    fn allowance_frees_a_place_when_a_call_ends() {
        let allowance = Allowance::new(RATE, Instant::now());
        let (first, _second) = (allowance.call().unwrap(), allowance.call().unwrap());
        assert!(matches!(allowance.call(), Err(Exceeded::Calls(_))));
        drop(first);
        assert!(allowance.call().is_ok());
    }

    #[test]
    fn addresses_of_any_number_share_a_fixed_number_of_places() {
        let addresses = Addresses::new(RATE, 1, Instant::now());
        let mut taken = std::collections::HashSet::new();
        for address in 0..100_000_u32 {
            let name = std::net::Ipv4Addr::from(address).to_string();
            let allowance = addresses.of(&name);
            assert!(std::ptr::eq(allowance, addresses.of(&name)));
            taken.insert(std::ptr::from_ref(allowance));
        }
        assert_eq!(taken.len(), Addresses::PLACES);
        let held = addresses.connection("10.0.0.7");
        assert!(held.is_some() && addresses.connection("10.0.0.7").is_none());
        drop(held);
        assert!(addresses.connection("10.0.0.7").is_some());
    }
}
