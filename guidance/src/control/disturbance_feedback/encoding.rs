//! Canonical bytes of a problem: equal problems, equal bytes; also how plans keep them.

use super::{ArrivalMetric, Instants, Problem};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    control::canonical::{read_epoch, write_epoch},
    frames::{InFrame, LvlhCcsds, RelativeState},
    orbit::KeplerOrbit,
    sets::{Ellipsoid, OuterSum},
    units::Seconds,
};

impl Problem {
    /// Canonical bytes of the parsed values; their digest names the problem.
    #[must_use]
    pub fn canonical_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        write_problem(&mut writer, self);
        writer.finish()
    }

    /// Reads what [`Problem::canonical_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else, and for a problem with faults.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let problem = read_problem(&mut reader)?;
        reader.end()?;
        Ok(problem)
    }
}

pub(super) fn write_problem(writer: &mut Writer, problem: &Problem) {
    problem.orbit.write(writer);
    writer.option(problem.epoch, write_epoch);
    write_state(writer, &problem.initial);
    write_state(writer, &problem.target_state);
    write_instants(writer, &problem.instants);
    writer.number(problem.delta_v_max_m_s);
    writer.count(problem.navigation_errors.len());
    problem.navigation_errors.iter().for_each(|set| writer.matrix(set.shape()));
    writer.tag(match problem.outer_sum {
        OuterSum::MinVolume => 1,
        OuterSum::MinTrace => 2,
    });
    writer.tag(match problem.metric {
        ArrivalMetric::Position => 1,
        ArrivalMetric::Scaled6 => 2,
        ArrivalMetric::Physical6 => 3,
    });
    writer.number(problem.fuel_weight);
    writer.number(problem.effort_weight);
    writer.tag(u8::from(problem.compare_open_loop));
}

pub(super) fn read_problem(reader: &mut Reader<'_>) -> Result<Problem, DecodeError> {
    let orbit = KeplerOrbit::read(reader)?;
    let epoch = reader.option(read_epoch)?;
    let initial = read_state(reader)?;
    let target_state = read_state(reader)?;
    let instants = read_instants(reader)?;
    let delta_v_max_m_s = reader.number()?;
    let sets = reader.count()?;
    let navigation_errors = (0..sets)
        .map(|_| {
            let shape = reader.matrix()?;
            Ellipsoid::from_shape(shape).map_err(|fault| reader.fault(fault.to_string()))
        })
        .collect::<Result<_, _>>()?;
    let outer_sum = match reader.tag()? {
        1 => OuterSum::MinVolume,
        2 => OuterSum::MinTrace,
        other => return Err(reader.unknown("outer sum", other)),
    };
    let metric = match reader.tag()? {
        1 => ArrivalMetric::Position,
        2 => ArrivalMetric::Scaled6,
        3 => ArrivalMetric::Physical6,
        other => return Err(reader.unknown("metric", other)),
    };
    let (fuel_weight, effort_weight) = (reader.number()?, reader.number()?);
    let compare_open_loop = match reader.tag()? {
        0 => false,
        1 => true,
        other => return Err(reader.unknown("comparison", other)),
    };
    let problem = Problem {
        orbit,
        epoch,
        initial,
        target_state,
        instants,
        delta_v_max_m_s,
        navigation_errors,
        outer_sum,
        metric,
        fuel_weight,
        effort_weight,
        compare_open_loop,
    };
    match problem.faults().first() {
        None => Ok(problem),
        Some(fault) => Err(reader.fault(format!("{}: {}", fault.field, fault.got))),
    }
}

fn write_state(writer: &mut Writer, state: &RelativeState<LvlhCcsds>) {
    writer.vector3(&state.position_m.components);
    writer.vector3(&state.velocity_m_s.components);
}

fn read_state(reader: &mut Reader<'_>) -> Result<RelativeState<LvlhCcsds>, DecodeError> {
    let mut vector = || reader.vector3().map(InFrame::<LvlhCcsds>::new);
    Ok(RelativeState { position_m: vector()?, velocity_m_s: vector()? })
}

fn write_instants(writer: &mut Writer, instants: &Instants) {
    match instants {
        Instants::EqualTime { count, duration } => {
            writer.tag(1);
            writer.count(*count);
            writer.number(duration.seconds());
        }
        Instants::EqualTrueAnomaly { count, duration } => {
            writer.tag(2);
            writer.count(*count);
            writer.number(duration.seconds());
        }
        Instants::Given(times) => {
            writer.tag(3);
            let times: Vec<f64> = times.iter().map(|t| t.seconds()).collect();
            writer.numbers(&times);
        }
    }
}

fn read_instants(reader: &mut Reader<'_>) -> Result<Instants, DecodeError> {
    let tag = reader.tag()?;
    let mut equal = || -> Result<(usize, Seconds), DecodeError> {
        Ok((reader.count()?, Seconds::from_seconds(reader.number()?)))
    };
    match tag {
        1 => equal().map(|(count, duration)| Instants::EqualTime { count, duration }),
        2 => equal().map(|(count, duration)| Instants::EqualTrueAnomaly { count, duration }),
        3 => {
            let times = reader.numbers()?;
            Ok(Instants::Given(times.into_iter().map(Seconds::from_seconds).collect()))
        }
        other => Err(reader.unknown("instants", other)),
    }
}
