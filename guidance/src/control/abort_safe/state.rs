//! What one step hands to the next.

use crate::{
    bytes::{DecodeError, Reader, Writer},
    dynamics::RelativeVector,
};

/// The controller between two steps.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The step this state is for.
    pub(super) step: usize,
    /// The phase of the approach; never goes back.
    pub(super) phase: usize,
    /// x_0 .. x_N as the last step predicted them; empty before the first step and after one
    /// that gave no prediction.
    pub(super) prediction: Vec<RelativeVector>,
    /// Rows that were active then, as this step names them.
    pub(super) active: Vec<usize>,
}

impl State {
    /// Before the first step.
    pub(super) const START: Self =
        Self { step: 0, phase: 0, prediction: Vec::new(), active: Vec::new() };

    /// Index of the step this state is for; 0 at the start.
    #[must_use]
    pub fn step_index(&self) -> usize {
        self.step
    }

    /// Index of the phase of the approach.
    #[must_use]
    pub fn phase_index(&self) -> usize {
        self.phase
    }

    /// The payload of the wire's controller state.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.count(self.step);
        writer.count(self.phase);
        writer.count(self.prediction.len());
        self.prediction.iter().flat_map(|x| x.iter()).for_each(|&x| writer.number(x));
        writer.small_counts(&self.active);
        writer.finish()
    }

    /// Reads what [`State::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let (step, phase, count) = (reader.count()?, reader.count()?, reader.count()?);
        let vector = |reader: &mut Reader<'_>| -> Result<RelativeVector, DecodeError> {
            let mut x = RelativeVector::zeros();
            for component in x.iter_mut() {
                *component = reader.number()?;
            }
            Ok(x)
        };
        let prediction = (0..count).map(|_| vector(&mut reader)).collect::<Result<_, _>>()?;
        let active = reader.small_counts()?;
        reader.end()?;
        Ok(Self { step, phase, prediction, active })
    }

    /// Does this state fit a controller with so many phases, steps and stages?
    pub(super) fn fits(&self, phases: usize, steps_max: usize, horizon: usize) -> bool {
        self.phase < phases
            && self.step <= steps_max
            && (self.prediction.is_empty() || self.prediction.len() == horizon + 1)
            && (self.step > 0 || *self == Self::START)
    }
}
