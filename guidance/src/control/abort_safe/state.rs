//! What one step hands to the next.

use super::Problem;
use crate::{
    bytes::{DecodeError, Reader, Writer},
    dynamics::RelativeVector,
    mission::ThrustMode,
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
    /// The abort that has begun.
    pub(super) abort: Option<UnderWay>,
}

/// An abort that has begun.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct UnderWay {
    /// The step at which it did.
    pub(super) began: usize,
    /// The time index up to which its sequence was found to keep out.
    pub(super) until: usize,
    /// Thrusters that worked last.
    pub(super) working: ThrustMode,
    /// What is left of its sequence, step by step: throttles of the working thrusters.
    pub(super) throttles: Vec<Vec<f64>>,
}

impl State {
    /// Before the first step.
    pub(super) const START: Self =
        Self { step: 0, phase: 0, prediction: Vec::new(), active: Vec::new(), abort: None };

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

    /// Has an abort begun?
    #[must_use]
    pub fn is_aborting(&self) -> bool {
        self.abort.is_some()
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
        writer.option(self.abort.as_ref(), |writer, abort| abort.write(writer));
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
        let abort = reader.option(UnderWay::read)?;
        reader.end()?;
        Ok(Self { step, phase, prediction, active, abort })
    }

    /// Does this state fit the mission?
    pub(super) fn fits(&self, problem: &Problem) -> bool {
        let phase = problem.phases.get(self.phase);
        let prediction = self.prediction.len();
        phase.is_some()
            && self.step <= problem.steps_max
            && (prediction == 0 || prediction == problem.prediction_horizon + 1)
            && (self.step > 0 || *self == Self::START)
            && self.abort.as_ref().is_none_or(|abort| {
                phase.and_then(|phase| phase.safety.watch()).is_some_and(|watch| {
                    abort.working.is_within(problem.thrusters.nominal())
                        && abort.throttles.len() <= watch.horizon
                        && abort.began < self.step
                        && abort.until <= self.step + watch.horizon
                })
            })
    }
}

impl UnderWay {
    fn write(&self, writer: &mut Writer) {
        writer.count(self.began);
        writer.count(self.until);
        writer.count(self.working.bits() as usize);
        writer.count(self.throttles.len());
        self.throttles.iter().flatten().for_each(|&throttle| writer.number(throttle));
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let (began, until) = (reader.count()?, reader.count()?);
        let bits = u32::try_from(reader.count()?).map_err(|_| reader.fault("no such mode"))?;
        let working = ThrustMode::from_bits(bits);
        let (steps, thrusters) = (reader.count()?, working.working().count());
        if thrusters == 0 && steps > 0 {
            return Err(reader.fault("a sequence without thrusters"));
        }
        let throttle = |reader: &mut Reader<'_>| -> Result<f64, DecodeError> {
            let throttle = reader.number()?;
            let possible = (0.0..=1.0).contains(&throttle);
            if possible { Ok(throttle) } else { Err(reader.fault("a throttle beyond 0 to 1")) }
        };
        let throttles = (0..steps)
            .map(|_| (0..thrusters).map(|_| throttle(reader)).collect())
            .collect::<Result<_, _>>()?;
        Ok(Self { began, until, working, throttles })
    }
}
