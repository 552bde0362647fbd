//! What one step hands to the next.

use crate::bytes::{DecodeError, Reader, Writer};

/// The controller between two steps.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The step this state is for.
    pub(super) step: usize,
    /// Corrections v_0 .. v_{T-1} planned from this step on; empty before the first.
    pub(super) tail: Vec<f64>,
    /// The nominal state that was planned for this step; only in a tube, and not before the first.
    pub(super) nominal: Vec<f64>,
    /// Rows that were active in the last program.
    pub(super) active: Vec<usize>,
}

impl State {
    /// Before the first step.
    pub(super) const START: Self =
        Self { step: 0, tail: Vec::new(), nominal: Vec::new(), active: Vec::new() };

    /// Index of the step this state is for; 0 at the start.
    #[must_use]
    pub fn step_index(&self) -> usize {
        self.step
    }

    /// The payload of the wire's controller state.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.count(self.step);
        writer.numbers(&self.tail);
        writer.numbers(&self.nominal);
        writer.count(self.active.len());
        self.active.iter().for_each(|&row| writer.count(row));
        writer.finish()
    }

    /// Reads what [`State::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let (step, tail, nominal) = (reader.count()?, reader.numbers()?, reader.numbers()?);
        let count = reader.count()?;
        let active = (0..count).map(|_| reader.count()).collect::<Result<_, _>>()?;
        reader.end()?;
        Ok(Self { step, tail, nominal, active })
    }

    /// Does this state fit a controller with so many corrections, nominal components and rows?
    pub(super) fn fits(&self, corrections: usize, nominal: usize, rows: usize) -> bool {
        let (tail, nominal) = if self.step == 0 { (0, 0) } else { (corrections, nominal) };
        let finite = |values: &[f64]| values.iter().all(|value| value.is_finite());
        self.tail.len() == tail
            && self.nominal.len() == nominal
            && finite(&self.tail)
            && finite(&self.nominal)
            && self.active.len() <= corrections + nominal
            && self.active.iter().all(|&row| row < rows)
    }
}
