//! What one instant hands to the next; small, because it travels with every call.

use nalgebra::{DVector, Vector3};

use super::INSTANTS_MAX;
use crate::bytes::{DecodeError, Reader, Writer};

/// The plan's flight between two instants.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The instant this state is for.
    pub(super) instant: usize,
    /// `None` before the first instant.
    pub(super) flight: Option<Flight>,
}

/// What happened so far.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Flight {
    /// State measured at the previous instant, scaled there; the planned one at instant 0.
    pub(super) previous_state: DVector<f64>,
    /// Impulse given there, m/s.
    pub(super) previous_delta_v_m_s: Vector3<f64>,
    /// w_0, w_1, ... up to the previous instant.
    pub(super) disturbances: Vec<DVector<f64>>,
}

impl State {
    /// Before the first instant.
    pub(super) const START: Self = Self { instant: 0, flight: None };

    /// Index of the instant this state is for; 0 at the start.
    #[must_use]
    pub fn step_index(&self) -> usize {
        self.instant
    }

    /// The payload of the wire's controller state.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.count(self.instant);
        writer.option(self.flight.as_ref(), |writer, flight| {
            writer.numbers(flight.previous_state.as_slice());
            writer.vector3(&flight.previous_delta_v_m_s);
            writer.count(flight.disturbances.len());
            flight.disturbances.iter().for_each(|w| writer.numbers(w.as_slice()));
        });
        writer.finish()
    }

    /// Reads what [`State::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let instant = reader.count()?;
        let flight = reader.option(|reader| {
            let previous_state = reader.vector()?;
            let previous_delta_v_m_s = reader.vector3()?;
            let count = reader.count()?;
            if count >= INSTANTS_MAX {
                return Err(reader.fault(format!("{count} disturbances are too many")));
            }
            let disturbances = (0..count).map(|_| reader.vector()).collect::<Result<_, _>>()?;
            Ok(Flight { previous_state, previous_delta_v_m_s, disturbances })
        })?;
        reader.end()?;
        Ok(Self { instant, flight })
    }

    /// Does this state fit a plan with so many instants?
    pub(super) fn fits(&self, instants: usize) -> bool {
        let Some(flight) = &self.flight else { return self.instant == 0 };
        self.instant >= 1
            && self.instant < instants
            && flight.disturbances.len() + 1 == self.instant
            && flight.previous_state.len() == 6
            && flight.disturbances.iter().all(|w| w.len() == 6)
    }
}
