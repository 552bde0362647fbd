//! What one step hands to the next; small, because it travels with every call.

use nalgebra::DVector;

use crate::{
    bytes::{DecodeError, Reader, Writer},
    program::{BasicColumn, Basis, RowFamily, RowId},
};

/// The controller between two steps.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The step this state is for.
    pub(super) step: usize,
    /// `None` before the first step.
    pub(super) flight: Option<Flight>,
}

/// What the previous step decided, and on which grounds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Flight {
    /// x(k-1), scaled.
    pub(super) previous_state: DVector<f64>,
    /// u(k-1), scaled.
    pub(super) previous_input: DVector<f64>,
    /// J of step k-1.
    pub(super) cost: f64,
    /// N of step k-1.
    pub(super) horizon: usize,
    /// q: step at which the terminal point was last adapted.
    pub(super) adapted_step: usize,
    /// N at step q.
    pub(super) adapted_horizon: usize,
    /// Terminal point of step q, or centre of the terminal set.
    pub(super) centre: Vec<f64>,
    /// Exponents of the A_K^i W in the terminal set of step k-1.
    pub(super) powers: Vec<usize>,
    /// Step at which `plan_inputs` starts.
    pub(super) plan_step: usize,
    /// Nominal state at that step.
    pub(super) plan_initial: Vec<f64>,
    /// Nominal inputs from that step on, N m values.
    pub(super) plan_inputs: Vec<f64>,
    /// Vertex of the last program, as step k-1 saw it.
    pub(super) basis: Basis,
}

impl State {
    /// Before the first step.
    pub(super) const START: Self = Self { step: 0, flight: None };

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
        writer.option(self.flight.as_ref(), |writer, flight| {
            writer.numbers(flight.previous_state.as_slice());
            writer.numbers(flight.previous_input.as_slice());
            writer.number(flight.cost);
            writer.count(flight.horizon);
            writer.count(flight.adapted_step);
            writer.count(flight.adapted_horizon);
            writer.numbers(&flight.centre);
            writer.small_counts(&flight.powers);
            writer.count(flight.plan_step);
            writer.numbers(&flight.plan_initial);
            writer.numbers(&flight.plan_inputs);
            write_basis(writer, &flight.basis);
        });
        writer.finish()
    }

    /// Reads what [`State::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let step = reader.count()?;
        let flight = reader.option(|reader| {
            Ok(Flight {
                previous_state: reader.vector()?,
                previous_input: reader.vector()?,
                cost: reader.number()?,
                horizon: reader.count()?,
                adapted_step: reader.count()?,
                adapted_horizon: reader.count()?,
                centre: reader.numbers()?,
                powers: reader.small_counts()?,
                plan_step: reader.count()?,
                plan_initial: reader.numbers()?,
                plan_inputs: reader.numbers()?,
                basis: read_basis(reader)?,
            })
        })?;
        reader.end()?;
        Ok(Self { step, flight })
    }

    /// Does this state fit a controller with n states, m inputs and these limits?
    pub(super) fn fits(&self, n: usize, m: usize, steps_max: usize, horizon_max: usize) -> bool {
        let Some(flight) = &self.flight else { return self.step == 0 };
        let inputs = flight.plan_inputs.len();
        self.step >= 1
            && self.step <= steps_max.saturating_add(horizon_max)
            && flight.previous_state.len() == n
            && flight.previous_input.len() == m
            && flight.centre.len() == n
            && flight.plan_initial.len() == n
            && inputs % m == 0
            && (1..=horizon_max).contains(&(inputs / m))
            && (1..=horizon_max).contains(&flight.horizon)
            && flight.plan_step < self.step
            && self.step - flight.plan_step <= inputs / m
            && flight.horizon + self.step - 1 == flight.plan_step + inputs / m
            && flight.adapted_step < self.step
            && flight.powers.len() <= horizon_max
    }
}

fn write_basis(writer: &mut Writer, basis: &Basis) {
    writer.count(basis.rows.len());
    for row in &basis.rows {
        writer.tag(match row.family {
            RowFamily::Stage => 0,
            RowFamily::Tracking => 1,
            RowFamily::Input => 2,
            RowFamily::Terminal => 3,
        });
        writer.small_counts(&[row.stage, row.index]);
    }
    writer.count(basis.columns.len());
    for column in &basis.columns {
        writer.small_counts(&[column.stage, column.index, column.segment]);
    }
}

fn read_basis(reader: &mut Reader<'_>) -> Result<Basis, DecodeError> {
    let rows = reader.count()?;
    let row = |reader: &mut Reader<'_>| -> Result<RowId, DecodeError> {
        let family = match reader.tag()? {
            0 => RowFamily::Stage,
            1 => RowFamily::Tracking,
            2 => RowFamily::Input,
            3 => RowFamily::Terminal,
            other => return Err(reader.fault(format!("row family {other} is not known"))),
        };
        match reader.small_counts()?[..] {
            [stage, index] => Ok(RowId { family, stage, index }),
            _ => Err(reader.fault("a row has two indices")),
        }
    };
    let rows = (0..rows).map(|_| row(reader)).collect::<Result<_, _>>()?;
    let columns = reader.count()?;
    let column = |reader: &mut Reader<'_>| -> Result<BasicColumn, DecodeError> {
        match reader.small_counts()?[..] {
            [stage, index, segment] => Ok(BasicColumn { stage, index, segment }),
            _ => Err(reader.fault("a column has three indices")),
        }
    };
    let columns = (0..columns).map(|_| column(reader)).collect::<Result<_, _>>()?;
    Ok(Basis { rows, columns })
}
