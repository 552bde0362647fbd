//! Which request this is: its own id, and the trace of its caller that it belongs to.

use std::{
    hash::{BuildHasher, RandomState},
    sync::{
        Arc, LazyLock,
        atomic::{AtomicU64, Ordering},
    },
};

use http::{HeaderMap, HeaderValue};

use super::TOKEN_PREFIX;

/// Where a caller names its request.
pub(crate) const REQUEST_ID: &str = "x-request-id";
/// Where a caller names its trace (W3C Trace Context, level 1).
pub(crate) const TRACEPARENT: &str = "traceparent";

/// Names one request in logs, errors and the `x-request-id` header; with it goes the id of the
/// trace that the request is part of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RequestId(pub(crate) Arc<str>, TraceId);

/// 32 hex digits, not all 0.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TraceId(Arc<str>);

impl TraceId {
    /// Its digits.
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }

    /// From `00-<trace id>-<parent id>-<flags>`. A later version may append fields; anything else
    /// is no trace context, and the standard says to go on as if it were not there.
    fn from_traceparent(value: &HeaderValue) -> Option<Self> {
        let mut fields = value.to_str().ok()?.split('-');
        let mut hex = |length: usize| {
            let digit = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
            fields.next().filter(|field| field.len() == length && field.bytes().all(digit))
        };
        let some_bit = |field: &&str| field.bytes().any(|c| c != b'0');
        let version = hex(2).filter(|version| *version != "ff")?;
        let trace_id = hex(32).filter(some_bit)?;
        hex(16).filter(some_bit)?;
        hex(2)?;
        (version != "00" || fields.next().is_none()).then(|| Self(trace_id.into()))
    }
}

impl RequestId {
    /// The caller's own id if it is fit to be logged and echoed, else a new one; the caller's
    /// trace if it is part of one, else a new one.
    pub(crate) fn from_caller(headers: &HeaderMap) -> Self {
        const LENGTH_MAX: usize = 128;
        let fit = |text: &&str| {
            (1..=LENGTH_MAX).contains(&text.len())
                && text.bytes().all(|c| c.is_ascii_graphic())
                && !text.contains(TOKEN_PREFIX)
        };
        let Self(mut id, mut trace) = Self::fresh();
        let given = headers.get(REQUEST_ID).and_then(|value| value.to_str().ok());
        if let Some(text) = given.filter(fit) {
            id = text.into();
        }
        if let Some(given) = headers.get(TRACEPARENT).and_then(TraceId::from_traceparent) {
            trace = given;
        }
        Self(id, trace)
    }

    /// A new id, and a new trace of the same name: a counter behind a name drawn once a process.
    /// Unique enough to find a line in a log; it is no secret.
    pub(crate) fn fresh() -> Self {
        // Odd, and so never 0.
        static PROCESS: LazyLock<u64> = LazyLock::new(|| RandomState::new().hash_one("vbar") | 1);
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let id: Arc<str> = format!("{:016x}{count:016x}", *PROCESS).into();
        Self(Arc::clone(&id), TraceId(id))
    }

    /// The trace that the request is part of.
    pub(crate) fn trace_id(&self) -> &TraceId {
        &self.1
    }
}

impl std::fmt::Display for RequestId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";

    fn with(name: &'static str, value: &str) -> RequestId {
        let mut headers = HeaderMap::new();
        headers.insert(name, HeaderValue::from_str(value).unwrap());
        RequestId::from_caller(&headers)
    }

    #[test]
    fn request_id_of_a_caller_is_kept_if_it_is_harmless() {
        assert_eq!(&*with(REQUEST_ID, "run-7/step-3").0, "run-7/step-3");
    }

    #[test]
    fn request_id_too_long_not_printable_or_with_a_token_is_replaced() {
        for given in [&"x".repeat(129), "two words", "", "vbar_00ff"] {
            assert_eq!(with(REQUEST_ID, given).0.len(), 32);
        }
        assert_eq!(RequestId::from_caller(&HeaderMap::new()).0.len(), 32);
        assert_ne!(RequestId::fresh(), RequestId::fresh());
    }

    #[test]
    fn trace_of_a_caller_is_taken_over() {
        for given in [
            &format!("00-{TRACE}-00f067aa0ba902b7-01"),
            &format!("00-{TRACE}-00f067aa0ba902b7-00"),
            &format!("01-{TRACE}-00f067aa0ba902b7-01-what-comes-later"),
        ] {
            assert_eq!(with(TRACEPARENT, given).trace_id().as_str(), TRACE, "{given}");
        }
    }

    #[test]
    fn trace_that_is_none_is_replaced() {
        let zeros = "0".repeat(32);
        for given in [
            String::new(),
            format!("00-{TRACE}-00f067aa0ba902b7"),
            format!("00-{TRACE}-00f067aa0ba902b7-01-more"),
            format!("ff-{TRACE}-00f067aa0ba902b7-01"),
            format!("00-{zeros}-00f067aa0ba902b7-01"),
            format!("00-{TRACE}-0000000000000000-01"),
            format!("00-{}-00f067aa0ba902b7-01", TRACE.to_uppercase()),
            format!("00-{}-00f067aa0ba902b7-01", &TRACE[1..]),
        ] {
            let trace = with(TRACEPARENT, &given).trace_id().clone();
            assert_ne!(trace.as_str(), TRACE, "{given}");
            assert!(trace.as_str().len() == 32 && trace.as_str() != zeros);
        }
    }
}
