//! What can be known before flight: the plants of the phases and their backward reachable sets.

use std::ops::Range;

use super::{Phase, Problem, Safety, Watch, faults::faults};
use crate::{
    budget::{Budget, Interruption},
    bytes::{DecodeError, Reader, Writer},
    control::{Failure, PrepareError},
    dynamics::PeriodicPlant,
    mission::{ThrustMode, dominating_modes},
    reach::{EllipsoidUnion, PolytopeQuestion, PolytopeUnion, ReadError},
    sets::{CentredEllipsoid, Polytope, ZonotopeFacets},
};

/// Starts of one shard.
const STARTS_A_SHARD: usize = 16;
/// Sets of so many modes at most are counted, beside those that stand for all; every set of eight
/// thrusters' failures is within it.
const COUNTED_MODES_MAX: usize = 256;

/// The prepared mission.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    problem: Problem,
    /// Forces of all thrusters.
    nominal: ZonotopeFacets,
    pub(super) phases: Vec<PreparedPhase>,
}

/// A phase with its plant and sets.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PreparedPhase {
    pub(super) plant: PeriodicPlant,
    pub(super) sets: PhaseSets,
}

/// The sets of a phase.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum PhaseSets {
    None,
    /// With the box around the ellipsoid, for aborts that thrust.
    Ellipsoids {
        avoid: CentredEllipsoid,
        around: Polytope,
        union: EllipsoidUnion,
    },
    /// With the modes that stand for all, and how many sets all of them have, if counted.
    Polytopes {
        avoid: Polytope,
        modes: Vec<ThrustMode>,
        union: PolytopeUnion,
        sets_of_all_modes: Option<usize>,
    },
}

/// Sets of some starts of one phase.
#[derive(Debug, Clone, PartialEq)]
pub struct Shard {
    /// Its place among all.
    pub(super) index: usize,
    part: ShardPart,
}

#[derive(Debug, Clone, PartialEq)]
enum ShardPart {
    Nothing,
    Ellipsoids(EllipsoidUnion),
    /// With the number of sets of all modes that were asked for, if counted.
    Polytopes(PolytopeUnion, Option<usize>),
}

impl Shard {
    pub(super) fn write(&self, writer: &mut Writer) {
        match &self.part {
            ShardPart::Nothing => {}
            ShardPart::Ellipsoids(union) => union.write(writer),
            ShardPart::Polytopes(union, sets) => {
                union.write(writer);
                writer.option(*sets, Writer::count);
            }
        }
    }

    pub(super) fn read(
        problem: &Problem,
        index: usize,
        reader: &mut Reader<'_>,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let part = match extent(problem, index) {
            None => ShardPart::Nothing,
            Some((phase, starts)) => {
                match read_sets(&problem.phases[phase], starts, reader, budget)? {
                    PhaseSets::None => ShardPart::Nothing,
                    PhaseSets::Ellipsoids { union, .. } => ShardPart::Ellipsoids(union),
                    PhaseSets::Polytopes { union, sets_of_all_modes, .. } => {
                        ShardPart::Polytopes(union, sets_of_all_modes)
                    }
                }
            }
        };
        Ok(Self { index, part })
    }
}

impl Artifact {
    /// Prepares on one thread.
    ///
    /// # Errors
    /// [`PrepareError::Faults`] with every fault of the problem.
    pub fn prepare(problem: &Problem) -> Result<Self, PrepareError> {
        let shards = (0..shard_count(problem)).map(|i| run_shard(problem, i, Budget::UNLIMITED));
        let shards = shards.collect::<Result<Vec<_>, _>>()?;
        merge(problem, shards, Budget::UNLIMITED)
    }

    /// The problem.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    pub(super) fn nominal_forces(&self) -> &ZonotopeFacets {
        &self.nominal
    }

    pub(super) fn phase(&self, index: usize) -> (&Phase, &PreparedPhase) {
        let index = index.min(self.phases.len() - 1);
        (&self.problem.phases[index], &self.phases[index])
    }

    /// Bytes that [`Artifact::from_bytes`] reads: the problem and the sets. Plants are made again.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        super::encoding::write_problem(&mut writer, &self.problem);
        for phase in &self.phases {
            match &phase.sets {
                PhaseSets::None => {}
                PhaseSets::Ellipsoids { union, .. } => union.write(&mut writer),
                PhaseSets::Polytopes { union, sets_of_all_modes, .. } => {
                    union.write(&mut writer);
                    writer.option(*sets_of_all_modes, Writer::count);
                }
            }
        }
        writer.finish()
    }

    /// Reads what [`Artifact::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        Self::from_bytes_within(bytes, Budget::UNLIMITED).map_err(ReadError::uninterrupted)
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`ReadError`].
    pub fn from_bytes_within(bytes: &[u8], budget: Budget<'_>) -> Result<Self, ReadError> {
        let mut reader = Reader::new(bytes);
        let problem = super::encoding::read_problem(&mut reader)?;
        if let Some(fault) = faults(&problem).first() {
            return Err(reader.fault(format!("{}: {}", fault.field, fault.got)).into());
        }
        let mut sets = Vec::with_capacity(problem.phases.len());
        for phase in &problem.phases {
            sets.push(read_sets(phase, 0..problem.steps_per_period, &mut reader, budget)?);
        }
        reader.end()?;
        let phases = problem.phases.iter().zip(sets);
        let phases = phases
            .map(|(phase, sets)| Ok(PreparedPhase { plant: plant(&problem, phase, budget)?, sets }))
            .collect::<Result<_, Interruption>>()?;
        Ok(Self { nominal: nominal(&problem), problem, phases })
    }
}

/// Reads the sets of some starts of a phase.
fn read_sets(
    phase: &Phase,
    starts: Range<usize>,
    reader: &mut Reader<'_>,
    budget: Budget<'_>,
) -> Result<PhaseSets, ReadError> {
    let instants = |watch: &Watch| watch.horizon * watch.fractions + 1;
    Ok(match (phase.safety.watch(), form(phase)) {
        (Some(watch), Form::Ellipsoid(avoid, around)) => {
            let union = EllipsoidUnion::read(reader, starts, instants(watch), budget)?;
            PhaseSets::Ellipsoids { avoid, around, union }
        }
        (Some(watch), Form::Polytope(avoid, modes)) => {
            let rows = avoid.offsets().len();
            let instants = instants(watch);
            let union = PolytopeUnion::read(reader, starts, rows, modes.len(), instants, budget)?;
            let sets_of_all_modes = reader.option(Reader::count)?;
            PhaseSets::Polytopes { avoid, modes, union, sets_of_all_modes }
        }
        _ => PhaseSets::None,
    })
}

fn nominal(problem: &Problem) -> ZonotopeFacets {
    problem.thrusters.admissible(problem.thrusters.nominal()).facets()
}

/// How the set of a phase is represented.
enum Form {
    None,
    Ellipsoid(CentredEllipsoid, Polytope),
    Polytope(Polytope, Vec<ThrustMode>),
}

/// Ellipsoids for passive safety of ellipsoids, else polytopes, with the modes that matter.
fn form(phase: &Phase) -> Form {
    let Some(watch) = phase.safety.watch() else { return Form::None };
    let Some(set) = watch.avoid.inflated(watch.inflation) else { return Form::None };
    let passive = matches!(phase.safety, Safety::Passive(_));
    match set.ellipsoid().filter(|_| passive) {
        Some(ellipsoid) => Form::Ellipsoid(ellipsoid, set.outer_polytope()),
        None => Form::Polytope(set.outer_polytope(), dominating_modes(phase.safety.modes())),
    }
}

fn plant(
    problem: &Problem,
    phase: &Phase,
    budget: Budget<'_>,
) -> Result<PeriodicPlant, Interruption> {
    let fractions = phase.safety.watch().map_or(1, |watch| watch.fractions);
    let counts = [problem.steps_per_period, fractions];
    PeriodicPlant::within(&problem.orbit, problem.mass, problem.sample_time, counts, budget)
}

/// The phase and the starts of a shard; `None` beyond the last.
fn extent(problem: &Problem, shard: usize) -> Option<(usize, Range<usize>)> {
    let kp = problem.steps_per_period;
    let watched = (0..problem.phases.len()).filter(|&i| problem.phases[i].safety.watch().is_some());
    let blocks = kp.div_ceil(STARTS_A_SHARD);
    let (phase, block) = (shard / blocks.max(1), shard % blocks.max(1));
    let first = block * STARTS_A_SHARD;
    watched.clone().nth(phase).map(|phase| (phase, first..(first + STARTS_A_SHARD).min(kp)))
}

/// The sets of all starts and instants, as if none were empty, and the condensed regulator.
pub(super) fn memory_bytes(problem: &Problem) -> usize {
    /// A symmetric matrix.
    const ELLIPSOID: usize = 21;
    /// While shards are joined there are two of each.
    const COPIES: usize = 2;
    let sets = problem.phases.iter().filter_map(|phase| {
        let watch = phase.safety.watch()?;
        let instants = watch.horizon.saturating_mul(watch.fractions);
        let numbers = match form(phase) {
            Form::None => 0,
            Form::Ellipsoid(..) => ELLIPSOID,
            Form::Polytope(avoid, modes) => avoid.offsets().len() * (6 + modes.len()),
        };
        Some(problem.steps_per_period.saturating_mul(instants).saturating_mul(numbers))
    });
    let sets = sets.fold(0_usize, usize::saturating_add).saturating_mul(COPIES);
    let inputs = problem.prediction_horizon.saturating_mul(3);
    inputs.saturating_mul(inputs).saturating_add(sets).saturating_mul(size_of::<f64>())
}

/// Blocks of starts of every phase that watches a set; at least 1.
///
/// Not one shard a mode: the modes of a start share the normals of all their sets.
pub(super) fn shard_count(problem: &Problem) -> usize {
    let watched = problem.phases.iter().filter(|phase| phase.safety.watch().is_some()).count();
    (watched * problem.steps_per_period.div_ceil(STARTS_A_SHARD)).max(1)
}

pub(super) fn run_shard(
    problem: &Problem,
    shard: usize,
    budget: Budget<'_>,
) -> Result<Shard, PrepareError> {
    budget.check()?;
    let found = faults(problem);
    if !found.is_empty() {
        return Err(PrepareError::Faults(found));
    }
    let Some((phase, starts)) = extent(problem, shard) else {
        return Ok(Shard { index: shard, part: ShardPart::Nothing });
    };
    let phase = &problem.phases[phase];
    let plant = plant(problem, phase, budget)?;
    let horizon = phase.safety.watch().map_or(0, |watch| watch.horizon);
    let part = match form(phase) {
        Form::None => ShardPart::Nothing,
        Form::Ellipsoid(avoid, _) => {
            let union = EllipsoidUnion::new(&plant, &avoid, horizon, starts, budget)?;
            ShardPart::Ellipsoids(union)
        }
        Form::Polytope(avoid, modes) => {
            let forces = problem.thrusters.full_forces_n();
            let bits = |modes: &[ThrustMode]| modes.iter().map(|mode| mode.bits()).collect();
            let (needed, all): (Vec<u32>, Vec<u32>) = (bits(&modes), bits(phase.safety.modes()));
            let question = PolytopeQuestion {
                plant: &plant,
                avoid: &avoid,
                full_forces_n: &forces,
                modes: &needed,
                horizon,
            };
            let union = PolytopeUnion::new(&question, starts.clone(), budget)?;
            let count = match all.len() {
                few if few == needed.len() => Some(union.len()),
                0..=COUNTED_MODES_MAX => {
                    let question = PolytopeQuestion { modes: &all, ..question };
                    Some(PolytopeUnion::count(&question, starts, budget)?)
                }
                _ => None,
            };
            ShardPart::Polytopes(union, count)
        }
    };
    Ok(Shard { index: shard, part })
}

pub(super) fn merge(
    problem: &Problem,
    shards: Vec<Shard>,
    budget: Budget<'_>,
) -> Result<Artifact, PrepareError> {
    let found = faults(problem);
    if !found.is_empty() {
        return Err(PrepareError::Faults(found));
    }
    let count = problem.phases.len();
    let missing = || PrepareError::Failure(Failure::Numerical("shards are missing".into()));
    let mut ellipsoids: Vec<Vec<EllipsoidUnion>> = vec![Vec::new(); count];
    let mut polytopes: Vec<Vec<PolytopeUnion>> = vec![Vec::new(); count];
    let mut counts: Vec<Option<usize>> = vec![Some(0); count];
    for shard in shards {
        let Some((phase, _)) = extent(problem, shard.index) else { continue };
        match shard.part {
            ShardPart::Nothing => {}
            ShardPart::Ellipsoids(union) => ellipsoids[phase].push(union),
            ShardPart::Polytopes(union, sets) => {
                polytopes[phase].push(union);
                counts[phase] = counts[phase].zip(sets).map(|(sum, sets)| sum + sets);
            }
        }
    }
    let starts = problem.steps_per_period;
    let parts = ellipsoids.into_iter().zip(polytopes).zip(counts);
    let phases = problem.phases.iter().zip(parts);
    let phases = phases
        .map(|(phase, ((ellipsoids, polytopes), sets_of_all_modes))| {
            let sets = match form(phase) {
                Form::None => PhaseSets::None,
                Form::Ellipsoid(avoid, around) => {
                    let union = EllipsoidUnion::joined(ellipsoids, budget)?
                        .filter(|union| union.starts() == starts)
                        .ok_or_else(missing)?;
                    PhaseSets::Ellipsoids { avoid, around, union }
                }
                Form::Polytope(avoid, modes) => {
                    let union = PolytopeUnion::joined(polytopes)
                        .filter(|union| union.starts() == starts)
                        .ok_or_else(missing)?;
                    PhaseSets::Polytopes { avoid, modes, union, sets_of_all_modes }
                }
            };
            Ok(PreparedPhase { plant: plant(problem, phase, budget)?, sets })
        })
        .collect::<Result<_, PrepareError>>()?;
    Ok(Artifact { nominal: nominal(problem), problem: problem.clone(), phases })
}
