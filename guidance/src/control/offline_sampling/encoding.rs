//! Canonical bytes of a problem: equal problems, equal bytes; also how artifacts keep them.

use super::{
    Coordinates, CostWeights, GainChoice, GroupSummary, Problem, Redundancy, RowOrigin,
    SampleChoice, Scheme, Summary, TubeSummary, artifact::Parts,
};
use crate::{
    budget::Budget,
    bytes::{DecodeError, Reader, Writer},
    dynamics::{Discretisation, MatrixPolynomial, Monomial, PlantMatrices, UncertainPlant},
    reach::{GrowthLimits, HalfSpaces, InvariantLimits, ReadError, StageFamily, StageGroup},
    sampling::ScalarLaw,
    sets::Polytope,
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
    writer.tag(match problem.scheme {
        Scheme::OfflineSampling => 1,
        Scheme::LinearQuadratic => 2,
        Scheme::TubeRobust => 3,
    });
    write_plant(writer, &problem.plant);
    writer.tag(match problem.coordinates {
        Coordinates::General => 1,
        Coordinates::Planar => 2,
        Coordinates::Rtn => 3,
    });
    writer.option(problem.vertices.as_ref(), |writer, vertices| {
        writer.count(vertices.len());
        for vertex in vertices {
            writer.matrix(&vertex.a);
            writer.matrix(&vertex.b);
            writer.matrix(&vertex.b_w);
        }
    });
    write_laws(writer, &problem.disturbance);
    writer.count(problem.horizon);
    match &problem.gain {
        GainChoice::Explicit(gain) => {
            writer.tag(1);
            writer.matrix(gain);
        }
        GainChoice::Lqr { state, input } => {
            writer.tag(2);
            writer.matrix(state);
            writer.matrix(input);
        }
    }
    writer.matrix(&problem.weights.state);
    writer.matrix(&problem.weights.input);
    writer.count(problem.weights.samples);
    for set in [&problem.state_set, &problem.input_set] {
        writer.matrix(set.normals());
        writer.numbers(set.offsets().as_slice());
    }
    writer.number(problem.samples.violation);
    writer.number(problem.samples.confidence_complement);
    writer.option(problem.samples.variables, Writer::count);
    writer.option(problem.samples.size, Writer::count);
    writer.tag(u8::from(problem.samples.state_at_start));
    writer.count(problem.samples.rows_max);
    match problem.redundancy {
        Redundancy::Exact => writer.tag(1),
        Redundancy::InnerScaled { epsilon } => {
            writer.tag(2);
            writer.number(epsilon);
        }
    }
    writer.count(problem.terminal_limits.iterations_max);
    writer.count(problem.terminal_limits.rows_max);
    writer.option(problem.first_step, |writer, limits| {
        writer.count(limits.rounds);
        writer.count(limits.directions);
        writer.count(limits.facets_max);
    });
    writer.bytes(&problem.seed.to_le_bytes());
}

pub(super) fn read_problem(reader: &mut Reader<'_>) -> Result<Problem, DecodeError> {
    let scheme = match reader.tag()? {
        1 => Scheme::OfflineSampling,
        2 => Scheme::LinearQuadratic,
        3 => Scheme::TubeRobust,
        other => return Err(unknown(reader, "scheme", other)),
    };
    let plant = read_plant(reader)?;
    let coordinates = match reader.tag()? {
        1 => Coordinates::General,
        2 => Coordinates::Planar,
        3 => Coordinates::Rtn,
        other => return Err(unknown(reader, "coordinates", other)),
    };
    let vertices = reader.option(|reader| {
        let count = reader.count()?;
        let vertex = |reader: &mut Reader<'_>| -> Result<PlantMatrices, DecodeError> {
            Ok(PlantMatrices { a: reader.matrix()?, b: reader.matrix()?, b_w: reader.matrix()? })
        };
        (0..count).map(|_| vertex(reader)).collect()
    })?;
    let disturbance = read_laws(reader)?;
    let horizon = reader.count()?;
    let gain = match reader.tag()? {
        1 => GainChoice::Explicit(reader.matrix()?),
        2 => GainChoice::Lqr { state: reader.matrix()?, input: reader.matrix()? },
        other => return Err(unknown(reader, "gain", other)),
    };
    let weights =
        CostWeights { state: reader.matrix()?, input: reader.matrix()?, samples: reader.count()? };
    let polytope = |reader: &mut Reader<'_>| -> Result<Polytope, DecodeError> {
        let (normals, offsets) = (reader.matrix()?, reader.vector()?);
        if normals.nrows() != offsets.len() {
            return Err(reader.fault("rows of a polytope do not match"));
        }
        Ok(Polytope::new(normals, offsets))
    };
    let (state_set, input_set) = (polytope(reader)?, polytope(reader)?);
    let samples = SampleChoice {
        violation: reader.number()?,
        confidence_complement: reader.number()?,
        variables: reader.option(Reader::count)?,
        size: reader.option(Reader::count)?,
        state_at_start: read_flag(reader)?,
        rows_max: reader.count()?,
    };
    let redundancy = match reader.tag()? {
        1 => Redundancy::Exact,
        2 => Redundancy::InnerScaled { epsilon: reader.number()? },
        other => return Err(unknown(reader, "redundancy", other)),
    };
    Ok(Problem {
        scheme,
        plant,
        coordinates,
        vertices,
        disturbance,
        horizon,
        gain,
        weights,
        state_set,
        input_set,
        samples,
        redundancy,
        terminal_limits: InvariantLimits {
            iterations_max: reader.count()?,
            rows_max: reader.count()?,
        },
        first_step: reader.option(|reader| {
            Ok(GrowthLimits {
                rounds: reader.count()?,
                directions: reader.count()?,
                facets_max: reader.count()?,
            })
        })?,
        seed: read_seed(reader)?,
    })
}

/// What was found for the problem.
pub(super) fn write_found(writer: &mut Writer, parts: &Parts) {
    write_summary(writer, &parts.summary);
    writer.matrix(&parts.cost);
    parts.rows.write(writer);
    for origin in &parts.origins {
        match *origin {
            RowOrigin::FirstStep => writer.tag(4),
            RowOrigin::Tube => writer.tag(5),
            RowOrigin::Stage(group) => write_group(writer, group),
        }
    }
    parts.terminal_set.write(writer);
    writer.option(parts.first_step_set.as_ref(), |writer, set| set.write(writer));
}

pub(super) fn read_found(
    problem: Problem,
    reader: &mut Reader<'_>,
    budget: Budget<'_>,
) -> Result<Parts, ReadError> {
    let summary = read_summary(reader)?;
    let cost = reader.matrix()?;
    let rows = HalfSpaces::read(reader, budget)?;
    let origin = |reader: &mut Reader<'_>| match reader.tag()? {
        4 => Ok(RowOrigin::FirstStep),
        5 => Ok(RowOrigin::Tube),
        family => read_group(reader, family).map(RowOrigin::Stage),
    };
    budget.check()?;
    let origins = (0..rows.len()).map(|_| origin(reader)).collect::<Result<_, _>>()?;
    let terminal_set = HalfSpaces::read(reader, budget)?;
    let first_step_set = match reader.option(|_| Ok(()))? {
        Some(()) => Some(HalfSpaces::read(reader, budget)?),
        None => None,
    };
    Ok(Parts { problem, summary, cost, rows, origins, terminal_set, first_step_set })
}

fn write_summary(writer: &mut Writer, summary: &Summary) {
    writer.matrix(&summary.gain);
    writer.matrix(&summary.terminal_weight);
    writer.count(summary.groups.len());
    for group in &summary.groups {
        write_group(writer, group.group);
        [group.samples, group.rows, group.kept].into_iter().for_each(|count| writer.count(count));
    }
    for count in [
        summary.terminal_rows,
        summary.terminal_iterations,
        summary.doubtful_rows,
        summary.checked_points,
        summary.first_step_rows,
    ] {
        writer.count(count);
    }
    writer.number(summary.outer_excess);
    writer.number(summary.checked_excess);
    writer.tag(u8::from(summary.first_step_limited));
    writer.option(summary.joint_confidence, Writer::number);
    writer.option(summary.tube.as_ref(), |writer, tube| {
        writer.count(tube.rows);
        writer.numbers(tube.state_half_widths.as_slice());
        writer.numbers(tube.input_half_widths.as_slice());
        writer.numbers(tube.disturbance_half_widths.as_slice());
    });
}

fn read_summary(reader: &mut Reader<'_>) -> Result<Summary, DecodeError> {
    let (gain, terminal_weight) = (reader.matrix()?, reader.matrix()?);
    let count = reader.count()?;
    let group = |reader: &mut Reader<'_>| {
        let family = reader.tag()?;
        Ok(GroupSummary {
            group: read_group(reader, family)?,
            samples: reader.count()?,
            rows: reader.count()?,
            kept: reader.count()?,
        })
    };
    Ok(Summary {
        gain,
        terminal_weight,
        groups: (0..count).map(|_| group(reader)).collect::<Result<_, _>>()?,
        terminal_rows: reader.count()?,
        terminal_iterations: reader.count()?,
        doubtful_rows: reader.count()?,
        checked_points: reader.count()?,
        first_step_rows: reader.count()?,
        outer_excess: reader.number()?,
        checked_excess: reader.number()?,
        first_step_limited: read_flag(reader)?,
        joint_confidence: reader.option(Reader::number)?,
        tube: reader.option(|reader| {
            Ok(TubeSummary {
                rows: reader.count()?,
                state_half_widths: reader.vector()?,
                input_half_widths: reader.vector()?,
                disturbance_half_widths: reader.vector()?,
            })
        })?,
    })
}

fn write_group(writer: &mut Writer, group: StageGroup) {
    writer.tag(match group.family {
        StageFamily::State => 1,
        StageFamily::Input => 2,
        StageFamily::Terminal => 3,
    });
    writer.count(group.stage);
}

/// The family's tag was read already.
fn read_group(reader: &mut Reader<'_>, family: u8) -> Result<StageGroup, DecodeError> {
    let family = match family {
        1 => StageFamily::State,
        2 => StageFamily::Input,
        3 => StageFamily::Terminal,
        other => return Err(unknown(reader, "origin", other)),
    };
    Ok(StageGroup { family, stage: reader.count()? })
}

fn unknown(reader: &Reader<'_>, what: &str, tag: u8) -> DecodeError {
    reader.fault(format!("{what} {tag} is not known"))
}

fn read_flag(reader: &mut Reader<'_>) -> Result<bool, DecodeError> {
    match reader.tag()? {
        0 => Ok(false),
        1 => Ok(true),
        other => Err(unknown(reader, "flag", other)),
    }
}

fn read_seed(reader: &mut Reader<'_>) -> Result<u64, DecodeError> {
    let bytes = <[u8; 8]>::try_from(reader.bytes()?);
    bytes.map(u64::from_le_bytes).map_err(|_| reader.fault("a seed has eight bytes"))
}

fn write_plant(writer: &mut Writer, plant: &UncertainPlant) {
    for polynomial in [&plant.a, &plant.b, &plant.b_w] {
        writer.matrix(&polynomial.constant);
        writer.count(polynomial.terms.len());
        for term in &polynomial.terms {
            writer.count(term.powers.len());
            term.powers.iter().for_each(|&power| writer.count(power as usize));
            writer.matrix(&term.matrix);
        }
    }
    write_laws(writer, &plant.parameters);
    match plant.discretisation {
        Discretisation::None => writer.tag(1),
        Discretisation::ZeroOrderHold { sample_time_s } => {
            writer.tag(2);
            writer.number(sample_time_s);
        }
        Discretisation::Euler { sample_time_s } => {
            writer.tag(3);
            writer.number(sample_time_s);
        }
    }
}

fn read_plant(reader: &mut Reader<'_>) -> Result<UncertainPlant, DecodeError> {
    let polynomial = |reader: &mut Reader<'_>| -> Result<MatrixPolynomial, DecodeError> {
        let constant = reader.matrix()?;
        let count = reader.count()?;
        let term = |reader: &mut Reader<'_>| -> Result<Monomial, DecodeError> {
            let count = reader.count()?;
            let power = |reader: &mut Reader<'_>| {
                u32::try_from(reader.count()?).map_err(|_| reader.fault("power too large"))
            };
            let powers = (0..count).map(|_| power(reader)).collect::<Result<_, _>>()?;
            Ok(Monomial { powers, matrix: reader.matrix()? })
        };
        let terms = (0..count).map(|_| term(reader)).collect::<Result<_, _>>()?;
        Ok(MatrixPolynomial { constant, terms })
    };
    let (a, b, b_w) = (polynomial(reader)?, polynomial(reader)?, polynomial(reader)?);
    let parameters = read_laws(reader)?;
    let discretisation = match reader.tag()? {
        1 => Discretisation::None,
        2 => Discretisation::ZeroOrderHold { sample_time_s: reader.number()? },
        3 => Discretisation::Euler { sample_time_s: reader.number()? },
        other => return Err(unknown(reader, "discretisation", other)),
    };
    Ok(UncertainPlant { a, b, b_w, parameters, discretisation })
}

fn write_laws(writer: &mut Writer, laws: &[ScalarLaw]) {
    writer.count(laws.len());
    for law in laws {
        match *law {
            ScalarLaw::Constant(value) => {
                writer.tag(1);
                writer.number(value);
            }
            ScalarLaw::Uniform { low, high } => {
                writer.tag(2);
                writer.number(low);
                writer.number(high);
            }
            ScalarLaw::TruncatedGaussian { deviation, bound } => {
                writer.tag(3);
                writer.number(deviation);
                writer.number(bound);
            }
        }
    }
}

fn read_laws(reader: &mut Reader<'_>) -> Result<Vec<ScalarLaw>, DecodeError> {
    let count = reader.count()?;
    let law = |reader: &mut Reader<'_>| -> Result<ScalarLaw, DecodeError> {
        Ok(match reader.tag()? {
            1 => ScalarLaw::Constant(reader.number()?),
            2 => ScalarLaw::Uniform { low: reader.number()?, high: reader.number()? },
            3 => ScalarLaw::TruncatedGaussian {
                deviation: reader.number()?,
                bound: reader.number()?,
            },
            other => return Err(unknown(reader, "law", other)),
        })
    };
    (0..count).map(|_| law(reader)).collect()
}
