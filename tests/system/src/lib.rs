//! What the tests of the whole system share: the [`tidy`] rules.

pub mod tidy;
