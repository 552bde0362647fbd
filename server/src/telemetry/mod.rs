//! What the server says about itself: metrics and request ids.

mod metrics;

use std::{
    hash::{BuildHasher, RandomState},
    sync::{
        Arc, LazyLock,
        atomic::{AtomicU64, Ordering},
    },
};

pub(crate) use metrics::{CallLabels, MethodLabels, Metrics, OutcomeLabels};

/// Names one request in logs, errors and the `x-request-id` header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RequestId(pub(crate) Arc<str>);

impl RequestId {
    /// The caller's own id if it is fit to be logged and echoed, else a new one.
    pub(crate) fn from_caller(given: Option<&http::HeaderValue>) -> Self {
        const LENGTH_MAX: usize = 128;
        let fit = |text: &&str| {
            (1..=LENGTH_MAX).contains(&text.len()) && text.bytes().all(|c| c.is_ascii_graphic())
        };
        match given.and_then(|value| value.to_str().ok()).filter(fit) {
            Some(text) => Self(text.into()),
            None => Self::fresh(),
        }
    }

    /// A new id: a counter behind a name drawn once a process. Unique enough to find a line in a
    /// log; it is no secret.
    pub(crate) fn fresh() -> Self {
        static PROCESS: LazyLock<u64> = LazyLock::new(|| RandomState::new().hash_one("vbar"));
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        Self(format!("{:016x}{count:016x}", *PROCESS).into())
    }
}

impl std::fmt::Display for RequestId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use http::HeaderValue;

    use super::*;

    #[test]
    fn request_id_of_a_caller_is_kept_if_it_is_harmless() {
        let given = HeaderValue::from_static("run-7/step-3");
        assert_eq!(&*RequestId::from_caller(Some(&given)).0, "run-7/step-3");
    }

    #[test]
    fn request_id_too_long_or_not_printable_is_replaced() {
        let long = HeaderValue::from_str(&"x".repeat(129)).unwrap();
        let spaced = HeaderValue::from_static("two words");
        let empty = HeaderValue::from_static("");
        for given in [Some(&long), Some(&spaced), Some(&empty), None] {
            assert_eq!(RequestId::from_caller(given).0.len(), 32);
        }
        assert_ne!(RequestId::fresh(), RequestId::fresh());
    }
}
