//! Canonical bytes of a problem: equal problems, equal bytes; also how artifacts keep them.

use nalgebra::SMatrix;

use super::{Fallback, Phase, Problem, Safety, Separation, SetTiming, Watch, Weights};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    control::canonical::{read_epoch, write_epoch},
    mission::{AvoidanceRegion, AvoidanceSet, ThrustMode, Thruster, Thrusters},
    orbit::KeplerOrbit,
    units::{Distance, Force, Mass, Seconds},
};

impl Problem {
    /// Canonical bytes of the parsed values; their digest names the problem.
    #[must_use]
    pub fn canonical_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        write_problem(&mut writer, self);
        writer.finish()
    }
}

pub(super) fn write_problem(writer: &mut Writer, problem: &Problem) {
    writer.option(problem.epoch, write_epoch);
    problem.orbit.write(writer);
    writer.number(problem.mass.kilograms());
    writer.number(problem.sample_time.seconds());
    writer.count(problem.steps_per_period);
    writer.count(problem.thrusters.list().len());
    for thruster in problem.thrusters.list() {
        writer.vector3(thruster.direction());
        writer.number(thruster.force_max().newtons());
    }
    writer.count(problem.phases.len());
    problem.phases.iter().for_each(|phase| write_phase(writer, phase));
    writer.count(problem.prediction_horizon);
    writer.number(problem.clearance);
    writer.tag(match problem.timing {
        SetTiming::Timed => 1,
        SetTiming::Untimed => 2,
    });
    writer.tag(match problem.separation {
        Separation::Tangent => 1,
        Separation::LinearProgram => 2,
        Separation::SecondOrderCone => 3,
    });
    writer.tag(match problem.fallback {
        Fallback::Soften => 1,
        Fallback::Abort => 2,
    });
    writer.number(problem.arrival.metres());
    writer.number(problem.fastest_approach_m_s);
    writer.count(problem.abort_programs_max);
    writer.number(problem.abort_clearance);
    writer.count(problem.steps_max);
}

pub(super) fn read_problem(reader: &mut Reader<'_>) -> Result<Problem, DecodeError> {
    let epoch = reader.option(read_epoch)?;
    let orbit = KeplerOrbit::read(reader)?;
    let mass = Mass::from_kilograms(reader.number()?);
    let sample_time = Seconds::from_seconds(reader.number()?);
    let steps_per_period = reader.count()?;
    let count = reader.count()?;
    let thruster = |reader: &mut Reader<'_>| -> Result<Thruster, DecodeError> {
        let (direction, force) = (reader.vector3()?, Force::from_newtons(reader.number()?));
        Thruster::exactly(direction, force).ok_or_else(|| reader.fault("no such thruster"))
    };
    let list = (0..count).map(|_| thruster(reader)).collect::<Result<Vec<_>, _>>()?;
    let thrusters = Thrusters::new(list).ok_or_else(|| reader.fault("number of thrusters"))?;
    let count = reader.count()?;
    let phases = (0..count).map(|_| read_phase(reader)).collect::<Result<_, _>>()?;
    let prediction_horizon = reader.count()?;
    let clearance = reader.number()?;
    let timing = match reader.tag()? {
        1 => SetTiming::Timed,
        2 => SetTiming::Untimed,
        other => return Err(reader.unknown("timing", other)),
    };
    let separation = match reader.tag()? {
        1 => Separation::Tangent,
        2 => Separation::LinearProgram,
        3 => Separation::SecondOrderCone,
        other => return Err(reader.unknown("separation", other)),
    };
    let fallback = match reader.tag()? {
        1 => Fallback::Soften,
        2 => Fallback::Abort,
        other => return Err(reader.unknown("fallback", other)),
    };
    Ok(Problem {
        epoch,
        orbit,
        mass,
        sample_time,
        steps_per_period,
        thrusters,
        phases,
        prediction_horizon,
        clearance,
        timing,
        separation,
        fallback,
        arrival: Distance::from_metres(reader.number()?),
        fastest_approach_m_s: reader.number()?,
        abort_programs_max: reader.count()?,
        abort_clearance: reader.number()?,
        steps_max: reader.count()?,
    })
}

fn write_phase(writer: &mut Writer, phase: &Phase) {
    match &phase.safety {
        Safety::Passive(watch) => {
            writer.tag(1);
            write_watch(writer, watch);
        }
        Safety::Active { watch, modes } => {
            writer.tag(2);
            write_watch(writer, watch);
            writer.count(modes.len());
            modes.iter().for_each(|mode| writer.count(mode.bits() as usize));
        }
        Safety::None => writer.tag(3),
    }
    phase.weights.stage.iter().for_each(|&x| writer.number(x));
    phase.weights.input.iter().for_each(|&x| writer.number(x));
    phase.weights.terminal.iter().for_each(|&x| writer.number(x));
    writer.number(phase.advance_within.metres());
}

fn read_phase(reader: &mut Reader<'_>) -> Result<Phase, DecodeError> {
    let safety = match reader.tag()? {
        1 => Safety::Passive(read_watch(reader)?),
        2 => {
            let watch = read_watch(reader)?;
            let count = reader.count()?;
            let mode = |reader: &mut Reader<'_>| -> Result<ThrustMode, DecodeError> {
                let bits = u32::try_from(reader.count()?);
                bits.map(ThrustMode::from_bits).map_err(|_| reader.fault("no such mode"))
            };
            let modes = (0..count).map(|_| mode(reader)).collect::<Result<_, _>>()?;
            Safety::Active { watch, modes }
        }
        3 => Safety::None,
        other => return Err(reader.unknown("safety", other)),
    };
    let weights = Weights {
        stage: read_fixed(reader)?,
        input: read_fixed(reader)?,
        terminal: read_fixed(reader)?,
    };
    Ok(Phase { safety, weights, advance_within: Distance::from_metres(reader.number()?) })
}

fn read_fixed<const R: usize, const C: usize>(
    reader: &mut Reader<'_>,
) -> Result<SMatrix<f64, R, C>, DecodeError> {
    let mut matrix = SMatrix::<f64, R, C>::zeros();
    for x in matrix.iter_mut() {
        *x = reader.number()?;
    }
    Ok(matrix)
}

fn write_watch(writer: &mut Writer, watch: &Watch) {
    match watch.avoid.region() {
        AvoidanceRegion::SemiAxes(axes) => {
            writer.tag(1);
            writer.vector3(axes);
        }
        AvoidanceRegion::Radius(radius) => {
            writer.tag(2);
            writer.number(*radius);
        }
        AvoidanceRegion::ShapeMatrix(shape) => {
            writer.tag(3);
            shape.iter().for_each(|&x| writer.number(x));
        }
        AvoidanceRegion::HalfWidths(widths) => {
            writer.tag(4);
            writer.vector3(widths);
        }
        AvoidanceRegion::Faces { normals, offsets } => {
            writer.tag(5);
            writer.matrix(normals);
            writer.numbers(offsets.as_slice());
        }
    }
    writer.number(watch.avoid.speed_max_m_s());
    writer.number(watch.inflation);
    writer.count(watch.horizon);
    writer.count(watch.fractions);
    writer.count(watch.nearest);
}

fn read_watch(reader: &mut Reader<'_>) -> Result<Watch, DecodeError> {
    let region = match reader.tag()? {
        1 => AvoidanceRegion::SemiAxes(reader.vector3()?),
        2 => AvoidanceRegion::Radius(reader.number()?),
        3 => AvoidanceRegion::ShapeMatrix(read_fixed::<3, 3>(reader)?),
        4 => AvoidanceRegion::HalfWidths(reader.vector3()?),
        5 => AvoidanceRegion::Faces { normals: reader.matrix()?, offsets: reader.vector()? },
        other => return Err(reader.unknown("region", other)),
    };
    let avoid = AvoidanceSet::new(region, reader.number()?)
        .ok_or_else(|| reader.fault("a region that is not one"))?;
    Ok(Watch {
        avoid,
        inflation: reader.number()?,
        horizon: reader.count()?,
        fractions: reader.count()?,
        nearest: reader.count()?,
    })
}
