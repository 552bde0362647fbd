//! What is made from files, and made again when they change.

use std::sync::{Arc, Mutex, PoisonError, RwLock};

use super::{files::Digest, options::OptionFault};

/// Something made from files that may change while it is used.
#[derive(Debug)]
pub(super) struct Reloaded<T> {
    current: RwLock<Arc<T>>,
    /// What was found last: each change is looked at once, and each fault said once.
    seen: Mutex<Result<Digest, Vec<OptionFault>>>,
}

impl<T> Reloaded<T> {
    /// Made from files of that digest.
    pub(super) fn new(digest: Digest, made: T) -> Self {
        Self { current: RwLock::new(Arc::new(made)), seen: Mutex::new(Ok(digest)) }
    }

    /// As it is now.
    pub(super) fn get(&self) -> Arc<T> {
        Arc::clone(&self.current.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Makes it again if the files have changed since they were looked at last; `None` if not.
    /// After a fault the one before stays.
    pub(super) fn renew(
        &self,
        read: Result<(Digest, impl FnOnce(&T) -> Result<T, Vec<OptionFault>>), Vec<OptionFault>>,
    ) -> Option<Result<(), Vec<OptionFault>>> {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let (found, made) = match read {
            Ok((digest, make)) if *seen != Ok(digest) => (Ok(digest), make(&self.get())),
            Err(faults) if *seen != Err(faults.clone()) => (Err(faults.clone()), Err(faults)),
            Ok(_) | Err(_) => return None,
        };
        *seen = found;
        Some(made.map(|made| {
            *self.current.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(made);
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reloaded_keeps_what_was_good_and_says_each_change_once() {
        type Read = Result<(Digest, fn(&u8) -> Result<u8, Vec<OptionFault>>), Vec<OptionFault>>;
        let fault = || vec![OptionFault::new("tls_key", "a key", "none")];
        let made = Reloaded::new([0; 32], 1);
        let unchanged: Read = Ok(([0; 32], |_| panic!("nothing has changed")));
        assert_eq!(made.renew(unchanged), None);
        let bad: Read = Ok(([1; 32], |_| Err(vec![OptionFault::new("tls_key", "a key", "none")])));
        assert_eq!(made.renew(bad.clone()), Some(Err(fault())));
        assert_eq!(made.renew(bad), None);
        let unreadable: Read = Err(fault());
        assert_eq!(made.renew(unreadable.clone()), Some(Err(fault())));
        assert_eq!(made.renew(unreadable), None);
        assert_eq!(*made.get(), 1);
        let good: Read = Ok(([2; 32], |before| Ok(before + 1)));
        assert_eq!(made.renew(good), Some(Ok(())));
        assert_eq!(*made.get(), 2);
    }
}
