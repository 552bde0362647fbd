//! Why what was kept is not read back.

use crate::{
    budget::{Budget, Interruption},
    bytes::{DecodeError, Reader},
};

/// Why bytes gave no value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReadError {
    /// They are not those of one.
    #[error(transparent)]
    Bytes(#[from] DecodeError),
    /// Stopped from outside.
    #[error("stopped before it was read: {0:?}")]
    Interrupted(Interruption),
}

impl From<Interruption> for ReadError {
    fn from(interruption: Interruption) -> Self {
        Self::Interrupted(interruption)
    }
}

impl ReadError {
    /// What is wrong with the bytes, where the budget was unlimited.
    pub(crate) fn uninterrupted(self) -> DecodeError {
        match self {
            Self::Bytes(fault) => fault,
            Self::Interrupted(why) => unreachable!("an unlimited budget said {why:?}"),
        }
    }
}

/// Items between two looks at the budget.
const BUDGET_PERIOD: usize = 1024;

/// As many numbers as are announced.
pub(super) fn numbers(reader: &mut Reader<'_>, budget: Budget<'_>) -> Result<Vec<f64>, ReadError> {
    let count = reader.count()?;
    items(count, reader, budget, Reader::number)
}

/// `count` items, one after the other.
pub(super) fn items<'a, T>(
    count: usize,
    reader: &mut Reader<'a>,
    budget: Budget<'_>,
    item: impl Fn(&mut Reader<'a>) -> Result<T, DecodeError>,
) -> Result<Vec<T>, ReadError> {
    // Grown as they come: an announced count is not believed.
    let mut items = Vec::new();
    for i in 0..count {
        if i % BUDGET_PERIOD == 0 {
            budget.check()?;
        }
        items.push(item(reader)?);
    }
    Ok(items)
}
