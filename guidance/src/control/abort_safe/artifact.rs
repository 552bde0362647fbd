//! What can be known before flight: the plants of the phases and their backward reachable sets.

use std::ops::Range;

use nalgebra::SMatrix;

use super::{Phase, Problem, Safety, Watch};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    control::{Failure, Fault, PrepareError},
    dynamics::PeriodicPlant,
    mission::{AvoidanceSet, ThrustMode, dominating_modes},
    reach::{EllipsoidUnion, PolytopeQuestion, PolytopeUnion},
    sets::{CentredEllipsoid, Polytope},
    units::Seconds,
};

/// Starts of one shard.
const STARTS_A_SHARD: usize = 16;
/// Most numbers that the sets of a phase may need: 512 MB.
const NUMBERS_MAX: usize = 64_000_000;
/// Longest prediction: the dense program's cost grows with its cube.
const PREDICTION_MAX: usize = 120;
/// Most steps of a period, of a safety horizon and parts of a step.
const STEPS_MAX: usize = 10_000;
const FRACTIONS_MAX: usize = 64;
/// Most instants of a safety horizon: artifacts keep their indices in two bytes.
const INSTANTS_MAX: usize = 60_000;
const NEAREST_MAX: usize = 16;
/// Coefficients of a general ellipsoid.
const ELLIPSOID_TERMS: usize = 21;

/// The prepared mission.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    problem: Problem,
    phases: Vec<PreparedPhase>,
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
    Ellipsoids { avoid: CentredEllipsoid, union: EllipsoidUnion },
    Polytopes { avoid: Polytope, modes: Vec<ThrustMode>, union: PolytopeUnion },
}

/// Sets of some starts of one phase.
#[derive(Debug, Clone, PartialEq)]
pub struct Shard {
    part: ShardPart,
}

#[derive(Debug, Clone, PartialEq)]
enum ShardPart {
    Nothing,
    Ellipsoids(usize, EllipsoidUnion),
    Polytopes(usize, PolytopeUnion),
}

/// What an artifact holds, to be shown.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// kp steps minus one revolution.
    pub fold_error: Seconds,
    /// One a phase.
    pub phases: Vec<PhaseSummary>,
}

/// One phase of a [`Summary`].
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseSummary {
    /// Backward reachable sets that are not empty, over all starts.
    pub sets: usize,
    /// Bytes of their numbers.
    pub size_bytes: usize,
    /// Modes whose sets hold those of all modes that were asked for.
    pub dominating_modes: Vec<ThrustMode>,
    /// The bound on speeds, m/s, if a plausible approach is faster: such an approach would pass
    /// through the region unseen.
    pub hides_approaches_above_m_s: Option<f64>,
    /// The region is an ellipsoid, but active modes need a polytope: the box around it is used.
    pub outer_box: bool,
}

impl Artifact {
    /// Prepares on one thread.
    ///
    /// # Errors
    /// [`PrepareError::Faults`] with every fault of the problem.
    pub fn prepare(problem: &Problem) -> Result<Self, PrepareError> {
        let shards = (0..shard_count(problem)).map(|i| run_shard(problem, i));
        let shards = shards.collect::<Result<Vec<_>, _>>()?;
        merge(problem, shards)
    }

    /// The problem.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    /// What it holds.
    #[must_use]
    pub fn summary(&self) -> Summary {
        let phases = self.problem.phases.iter().zip(&self.phases);
        Summary {
            fold_error: self
                .phases
                .first()
                .map_or(Seconds::from_seconds(0.0), |phase| phase.plant.fold_error()),
            phases: phases.map(|(asked, prepared)| self.phase_summary(asked, prepared)).collect(),
        }
    }

    fn phase_summary(&self, asked: &Phase, prepared: &PreparedPhase) -> PhaseSummary {
        let (sets, size_bytes) = match &prepared.sets {
            PhaseSets::None => (0, 0),
            PhaseSets::Ellipsoids { union, .. } => (union.len(), union.size_bytes()),
            PhaseSets::Polytopes { union, .. } => (union.len(), union.size_bytes()),
        };
        let fastest = self.problem.fastest_approach_m_s;
        let watch = asked.safety.watch();
        PhaseSummary {
            sets,
            size_bytes,
            dominating_modes: dominating_modes(asked.safety.modes()),
            hides_approaches_above_m_s: watch
                .and_then(|watch| watch.avoid.hides_approaches_above(fastest)),
            outer_box: matches!(&asked.safety, Safety::Active { watch, .. }
                if !watch.avoid.is_polytope()),
        }
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
                PhaseSets::Polytopes { union, .. } => union.write(&mut writer),
            }
        }
        writer.finish()
    }

    /// Reads what [`Artifact::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for anything else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(bytes);
        let problem = super::encoding::read_problem(&mut reader)?;
        if let Some(fault) = faults(&problem).first() {
            return Err(reader.fault(format!("{}: {}", fault.field, fault.got)));
        }
        let starts = problem.steps_per_period;
        let mut phases = Vec::new();
        for phase in &problem.phases {
            let plant = plant(&problem, phase);
            let instants = |watch: &Watch| watch.horizon * watch.fractions + 1;
            let sets = match (phase.safety.watch(), form(phase)) {
                (Some(watch), Form::Ellipsoid(avoid)) => {
                    let union = EllipsoidUnion::read(&mut reader, starts, instants(watch))?;
                    PhaseSets::Ellipsoids { avoid, union }
                }
                (Some(watch), Form::Polytope(avoid, modes)) => {
                    let count = instants(watch);
                    let union = PolytopeUnion::read(&mut reader, starts, modes.len(), count)?;
                    PhaseSets::Polytopes { avoid, modes, union }
                }
                _ => PhaseSets::None,
            };
            phases.push(PreparedPhase { plant, sets });
        }
        reader.end()?;
        Ok(Self { problem, phases })
    }
}

/// How the set of a phase is represented.
enum Form {
    None,
    Ellipsoid(CentredEllipsoid),
    Polytope(Polytope, Vec<ThrustMode>),
}

/// Ellipsoids for passive safety of ellipsoids, else polytopes, with the modes that matter.
fn form(phase: &Phase) -> Form {
    let Some(watch) = phase.safety.watch() else { return Form::None };
    let Some(set) = watch.avoid.inflated(watch.inflation) else { return Form::None };
    let passive = matches!(phase.safety, Safety::Passive(_));
    match set.ellipsoid().filter(|_| passive) {
        Some(ellipsoid) => Form::Ellipsoid(ellipsoid),
        None => Form::Polytope(set.outer_polytope(), dominating_modes(phase.safety.modes())),
    }
}

fn plant(problem: &Problem, phase: &Phase) -> PeriodicPlant {
    let fractions = phase.safety.watch().map_or(1, |watch| watch.fractions);
    let steps = problem.steps_per_period;
    PeriodicPlant::new(&problem.orbit, problem.mass, problem.sample_time, steps, fractions)
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

/// Blocks of starts of every phase that watches a set; at least 1.
///
/// Not one shard a mode: the modes of a start share the normals of all their sets.
pub(super) fn shard_count(problem: &Problem) -> usize {
    let watched = problem.phases.iter().filter(|phase| phase.safety.watch().is_some()).count();
    (watched * problem.steps_per_period.div_ceil(STARTS_A_SHARD)).max(1)
}

pub(super) fn run_shard(problem: &Problem, shard: usize) -> Result<Shard, PrepareError> {
    let found = faults(problem);
    if !found.is_empty() {
        return Err(PrepareError::Faults(found));
    }
    let Some((index, starts)) = extent(problem, shard) else {
        return Ok(Shard { part: ShardPart::Nothing });
    };
    let phase = &problem.phases[index];
    let plant = plant(problem, phase);
    let horizon = phase.safety.watch().map_or(0, |watch| watch.horizon);
    let part = match form(phase) {
        Form::None => ShardPart::Nothing,
        Form::Ellipsoid(avoid) => {
            ShardPart::Ellipsoids(index, EllipsoidUnion::new(&plant, &avoid, horizon, starts))
        }
        Form::Polytope(avoid, modes) => {
            let forces = problem.thrusters.full_forces_n();
            let bits: Vec<u32> = modes.iter().map(|mode| mode.bits()).collect();
            let question = PolytopeQuestion {
                plant: &plant,
                avoid: &avoid,
                full_forces_n: &forces,
                modes: &bits,
                horizon,
            };
            ShardPart::Polytopes(index, PolytopeUnion::new(&question, starts))
        }
    };
    Ok(Shard { part })
}

pub(super) fn merge(problem: &Problem, shards: Vec<Shard>) -> Result<Artifact, PrepareError> {
    let found = faults(problem);
    if !found.is_empty() {
        return Err(PrepareError::Faults(found));
    }
    let count = problem.phases.len();
    let missing = || PrepareError::Failure(Failure::Numerical("shards are missing".into()));
    let mut ellipsoids: Vec<Vec<EllipsoidUnion>> = vec![Vec::new(); count];
    let mut polytopes: Vec<Vec<PolytopeUnion>> = vec![Vec::new(); count];
    for shard in shards {
        match shard.part {
            ShardPart::Nothing => {}
            ShardPart::Ellipsoids(phase, union) => {
                ellipsoids.get_mut(phase).ok_or_else(missing)?.push(union);
            }
            ShardPart::Polytopes(phase, union) => {
                polytopes.get_mut(phase).ok_or_else(missing)?.push(union);
            }
        }
    }
    let starts = problem.steps_per_period;
    let parts = problem.phases.iter().zip(ellipsoids.into_iter().zip(polytopes));
    let phases = parts
        .map(|(phase, (ellipsoids, polytopes))| {
            let sets = match form(phase) {
                Form::None => PhaseSets::None,
                Form::Ellipsoid(avoid) => {
                    let union = EllipsoidUnion::joined(ellipsoids)
                        .filter(|union| union.starts() == starts)
                        .ok_or_else(missing)?;
                    PhaseSets::Ellipsoids { avoid, union }
                }
                Form::Polytope(avoid, modes) => {
                    let union = PolytopeUnion::joined(polytopes)
                        .filter(|union| union.starts() == starts)
                        .ok_or_else(missing)?;
                    PhaseSets::Polytopes { avoid, modes, union }
                }
            };
            Ok(PreparedPhase { plant: plant(problem, phase), sets })
        })
        .collect::<Result<_, PrepareError>>()?;
    Ok(Artifact { problem: problem.clone(), phases })
}

/// Everything that is wrong with a problem.
fn faults(problem: &Problem) -> Vec<Fault> {
    let mut faults = Vec::new();
    let mut require = |right: bool, field: String, expected: &str, got: String| {
        if !right {
            faults.push(Fault::new(field, expected, got));
        }
    };
    let between = |x: usize, most: usize| (1..=most).contains(&x);
    let positive = |x: f64| x > 0.0 && x.is_finite();
    let text = |field: &str| field.to_owned();
    let mass = problem.mass.kilograms();
    require(positive(mass), text("mass"), "a positive mass", mass.to_string());
    let step = problem.sample_time.seconds();
    require(positive(step), text("sample_time"), "a positive time", step.to_string());
    let kp = problem.steps_per_period;
    let count = "between 1 and 10000";
    require(between(kp, STEPS_MAX), text("steps_per_period"), count, kp.to_string());
    let invariant = kp == 1 && problem.orbit.eccentricity() == 0.0;
    let miss = kp as f64 * step - problem.orbit.period().seconds();
    let folds = invariant || miss.abs() <= 0.5 * step;
    let whole = "a revolution within half a step";
    require(folds, text("steps_per_period"), whole, format!("{miss} s off"));
    let n = problem.prediction_horizon;
    require(between(n, PREDICTION_MAX), text("prediction_horizon"), "1 to 120", n.to_string());
    let limits = [
        ("clearance", problem.clearance),
        ("arrival", problem.arrival.metres()),
        ("fastest_approach_m_s", problem.fastest_approach_m_s),
        ("abort_clearance", problem.abort_clearance),
    ];
    for (field, value) in limits {
        require(positive(value), text(field), "a positive number", value.to_string());
    }
    require(!problem.phases.is_empty(), text("phases"), "at least one phase", text("none"));
    for (i, phase) in problem.phases.iter().enumerate() {
        phase_faults(problem, i, phase, &mut require);
    }
    faults
}

fn phase_faults(
    problem: &Problem,
    index: usize,
    phase: &Phase,
    require: &mut impl FnMut(bool, String, &str, String),
) {
    let field = |name: &str| format!("phases[{index}].{name}");
    let sound = |matrix: &SMatrix<f64, 6, 6>| {
        (matrix - matrix.transpose()).amax() <= 1e-9 * matrix.amax()
            && matrix.iter().all(|x| x.is_finite())
            && matrix.symmetric_eigenvalues().iter().all(|&x| x >= -1e-9 * matrix.amax())
    };
    let semidefinite = "a symmetric positive semidefinite matrix";
    let weights = &phase.weights;
    require(sound(&weights.stage), field("weights.stage"), semidefinite, "not so".into());
    require(sound(&weights.terminal), field("weights.terminal"), semidefinite, "not so".into());
    let definite = (weights.input - weights.input.transpose()).amax()
        <= 1e-9 * weights.input.amax()
        && weights.input.cholesky().is_some();
    let expected = "a symmetric positive definite matrix";
    require(definite, field("weights.input"), expected, "not so".into());
    let within = phase.advance_within.metres();
    require(
        within >= 0.0 && within.is_finite(),
        field("advance_within"),
        "at least 0 m",
        within.to_string(),
    );
    if let Safety::Active { modes, .. } = &phase.safety {
        require(!modes.is_empty(), field("modes"), "at least one mode", "none".into());
        let known = modes.iter().all(|mode| mode.is_within(problem.thrusters.nominal()));
        require(known, field("modes"), "thrusters of the chaser", "another one".into());
    }
    let Some(watch) = phase.safety.watch() else { return };
    let between = |x: usize, most: usize| (1..=most).contains(&x);
    let gamma = watch.inflation;
    let grows = gamma >= 1.0 && gamma.is_finite();
    require(grows, field("inflation"), "at least 1", gamma.to_string());
    let (horizon, parts, nearest) = (watch.horizon, watch.fractions, watch.nearest);
    require(between(horizon, STEPS_MAX), field("horizon"), "1 to 10000", horizon.to_string());
    require(between(parts, FRACTIONS_MAX), field("fractions"), "1 to 64", parts.to_string());
    require(between(nearest, NEAREST_MAX), field("nearest"), "1 to 16", nearest.to_string());
    let instants = horizon.saturating_mul(parts);
    let few = instants <= INSTANTS_MAX;
    require(few, field("fractions"), "60000 instants at most", instants.to_string());
    let numbers = [problem.steps_per_period, horizon, parts, ELLIPSOID_TERMS]
        .iter()
        .try_fold(1usize, |product, &x| product.checked_mul(x))
        .unwrap_or(usize::MAX);
    let fits = numbers <= NUMBERS_MAX;
    require(fits, field("horizon"), "sets of at most 512 MB", format!("{numbers} numbers"));
}

/// Distance from a position to the region of a set, metres; 0 inside.
pub(super) fn distance_to_region(avoid: &AvoidanceSet, position: &nalgebra::Vector3<f64>) -> f64 {
    let point = nalgebra::DVector::from_column_slice(position.as_slice());
    if let Some(precision) = avoid.position_precision() {
        let precision = nalgebra::DMatrix::from_fn(3, 3, |i, j| precision[(i, j)]);
        return CentredEllipsoid::from_precision(precision)
            .map_or(f64::INFINITY, |region| (region.nearest_point(&point) - point).norm());
    }
    let lifted = avoid.outer_polytope();
    let rows: Vec<usize> = (0..lifted.offsets().len())
        .filter(|&r| (0..3).any(|c| lifted.normals()[(r, c)] != 0.0))
        .collect();
    let normals = lifted.normals().select_rows(&rows).columns(0, 3).into_owned();
    let offsets = lifted.offsets().select_rows(&rows);
    let sides = crate::program::HalfSpaces { normals: &normals, offsets: &offsets };
    crate::program::nearest_point_of_polytope(sides, &point)
        .map_or(f64::INFINITY, |nearest| (nearest - point).norm())
}
