//! Offline sampling: `vbar/v1/offline_sampling.proto` and
//! `vbar_guidance::control::offline_sampling`.

mod answer;
mod plant;

use nalgebra::{DMatrix, DVector, Vector2};
use vbar_guidance::{
    control::offline_sampling::{
        self as method, CostWeights, GainChoice, Redundancy, SampleChoice, Scheme,
    },
    mission::PlanarCone,
    reach::{GrowthLimits, InvariantLimits},
    sampling::VIOLATION_MAX,
    sets::Polytope,
    units::{Angle, Distance},
};
use vbar_proto::v1::{self, offline_sampling_problem::FirstStep};

use super::{
    Door, Parse, Path,
    types::{
        Size, finite, integer, list, matrix, number, polytope, positive, symmetric_matrix,
        unknown_enum,
    },
};
use plant::{Sizes, required_positive};

/// Most components of state and corrections together: dense programs stay fast below.
const VARIABLES_MAX: usize = 128;
/// Rows that samples may make if the problem does not say.
const ROWS_MAX_DEFAULT: usize = 1_000_000;
/// Most samples of the expected cost.
const COST_SAMPLES_MAX: usize = 1_000_000;
/// The search for a terminal set if the problem does not say, and at most.
const TERMINAL_DEFAULT: InvariantLimits = InvariantLimits { iterations_max: 200, rows_max: 2000 };
const TERMINAL_MOST: InvariantLimits = InvariantLimits { iterations_max: 10_000, rows_max: 20_000 };
/// The growth of a first-step set if the problem does not say, and at most.
const GROWTH_DEFAULT: GrowthLimits = GrowthLimits { rounds: 20, directions: 40, facets_max: 2000 };
const GROWTH_MOST: GrowthLimits =
    GrowthLimits { rounds: 1000, directions: 10_000, facets_max: 100_000 };

impl Parse for method::Problem {
    type Message = v1::OfflineSamplingProblem;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let plant = plant::plant(message, path, door);
        let known = plant.as_ref().map(|(plant, _)| plant);
        let scheme = scheme(message.scheme, path.field("scheme"), door);
        // While sizes are unknown, nothing that depends on them can be judged.
        let sizes = plant::sizes(message, known);
        let vertices = sizes
            .and_then(|sizes| plant::vertices(message, known, sizes, path.field("vertices"), door));
        let place = path.field("disturbance");
        let disturbance = sizes.and_then(|sizes| disturbance(message, sizes, place, door));
        let horizon = horizon(message.horizon, sizes, path.field("horizon"), door);
        let gain = sizes.and_then(|sizes| gain(message, sizes, path.field("gain"), door));
        let weights = sizes.and_then(|sizes| weights(message, sizes, path.field("weights"), door));
        let state_set = sizes.and_then(|sizes| state_set(message, sizes, path, door));
        let input_set = sizes.and_then(|sizes| {
            let place = path.field("input_set");
            let set = door.required(&message.input_set, place)?;
            polytope(set, sizes.inputs, place, door)
        });
        let place = path.field("terminal_limits");
        let terminal_limits = terminal_limits(message.terminal_limits.as_ref(), place, door);
        let sampling = scheme.and_then(|scheme| match scheme {
            Scheme::OfflineSampling => Sampling::parse(message, path, door),
            Scheme::LinearQuadratic | Scheme::TubeRobust => Sampling::refused(message, path, door),
        });
        let (plant, coordinates) = plant?;
        let sampling = sampling?;
        Some(Self {
            scheme: scheme?,
            plant,
            coordinates,
            vertices: vertices?,
            disturbance: disturbance?,
            horizon: horizon?,
            gain: gain?,
            weights: weights?,
            state_set: state_set?,
            input_set: input_set?,
            samples: sampling.samples,
            redundancy: sampling.redundancy,
            terminal_limits: terminal_limits?,
            first_step: sampling.first_step,
            seed: sampling.seed,
        })
    }
}

fn scheme(value: i32, path: Path<'_>, door: &mut Door) -> Option<Scheme> {
    use v1::OfflineSamplingScheme as Message;
    const EXPECTED: &str = "OFFLINE_SAMPLING_SCHEME_OFFLINE_SAMPLING, _LINEAR_QUADRATIC or \
                            _TUBE_ROBUST";
    match Message::try_from(value) {
        Ok(Message::OfflineSampling) => Some(Scheme::OfflineSampling),
        Ok(Message::LinearQuadratic) => Some(Scheme::LinearQuadratic),
        Ok(Message::TubeRobust) => Some(Scheme::TubeRobust),
        Ok(unspecified @ Message::Unspecified) => {
            door.refuse(path, EXPECTED, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn disturbance(
    message: &v1::OfflineSamplingProblem,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<vbar_guidance::sampling::ScalarLaw>> {
    let (given, right) = (message.disturbance.len(), sizes.disturbances);
    if given != right {
        return door.refuse(path, format!("{right} laws, one a component of w"), given);
    }
    plant::laws(&message.disturbance, path, door)
}

fn horizon(value: i32, sizes: Option<Sizes>, path: Path<'_>, door: &mut Door) -> Option<usize> {
    let by_size =
        sizes.map_or(usize::MAX, |sizes| VARIABLES_MAX.saturating_sub(sizes.states) / sizes.inputs);
    integer(value, 1..=door.limits.horizon_max.min(by_size), path, door)
}

fn gain(
    message: &v1::OfflineSamplingProblem,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<GainChoice> {
    use v1::sampling_gain::Form;
    let (n, m) = (sizes.states, sizes.inputs);
    match &door.required(&message.gain, path)?.form {
        None => door.refuse(path, "one of explicit, lqr", "nothing"),
        Some(Form::Explicit(k)) => {
            let shape = (Size::Exactly(m), Size::Exactly(n));
            matrix(k, shape, path.field("explicit"), door).map(GainChoice::Explicit)
        }
        Some(Form::Lqr(weights)) => {
            let path = path.field("lqr");
            let state = symmetric_matrix(&weights.state, n, path.field("state"), door);
            let input = symmetric_matrix(&weights.input, m, path.field("input"), door);
            Some(GainChoice::Lqr { state: state?, input: input? })
        }
    }
}

fn weights(
    message: &v1::OfflineSamplingProblem,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<CostWeights> {
    let message = door.required(&message.weights, path)?;
    let state = definite_matrix(&message.state, sizes.states, path.field("state"), door);
    let input = definite_matrix(&message.input, sizes.inputs, path.field("input"), door);
    let samples = integer(message.samples, 1..=COST_SAMPLES_MAX, path.field("samples"), door);
    Some(CostWeights { state: state?, input: input?, samples: samples? })
}

fn definite_matrix(
    message: &Option<v1::Matrix>,
    size: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    let matrix = symmetric_matrix(message, size, path, door)?;
    if matrix.clone().cholesky().is_none() {
        return door.refuse(path, "a positive definite matrix", "another one");
    }
    Some(matrix)
}

/// Rows of both `state_set` and `cone`.
fn state_set(
    message: &v1::OfflineSamplingProblem,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Polytope> {
    let n = sizes.states;
    let given = message.state_set.as_ref();
    let given = given.map(|set| polytope(set, n, path.field("state_set"), door));
    let cone = message.cone.as_ref();
    let cone = cone.map(|cone| planar_cone(cone, n, path.field("cone"), door));
    match (given, cone) {
        (None, None) => {
            let expected = "a value, or a cone in its place";
            door.refuse(path.field("state_set"), expected, "nothing")
        }
        (Some(set), None) | (None, Some(set)) => set,
        (Some(set), Some(cone)) => Some(both(&set?, &cone?)),
    }
}

fn both(first: &Polytope, second: &Polytope) -> Polytope {
    let (rows, more) = (first.offsets().len(), second.offsets().len());
    let mut normals = DMatrix::zeros(rows + more, first.normals().ncols());
    normals.rows_mut(0, rows).copy_from(first.normals());
    normals.rows_mut(rows, more).copy_from(second.normals());
    let offsets = first.offsets().iter().chain(second.offsets().iter()).copied();
    Polytope::new(normals, DVector::from_iterator(rows + more, offsets))
}

fn planar_cone(
    message: &v1::PlanarCone,
    states: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Polytope> {
    let apex = list(&message.apex_m, Size::Exactly(2), path.field("apex_m"), door);
    let place = path.field("axis_deg");
    let axis = door.required(&message.axis_deg, place).and_then(|&a| finite(a, place, door));
    let place = path.field("half_angle_deg");
    let half_angle = door.required(&message.half_angle_deg, place).and_then(|&angle| {
        let expected = "a number between 0 and 90, both excluded";
        number(angle, |angle| angle > 0.0 && angle < 90.0, expected, place, door)
    });
    let range = message.range_max_m;
    let range = range.map(|range| positive(range, path.field("range_max_m"), door));
    if states < 2 {
        return door.refuse(path, "nothing: the state has no plane", "a cone");
    }
    let cone = PlanarCone {
        apex_m: Vector2::from_column_slice(apex?),
        axis: Angle::from_degrees(axis?),
        half_angle: Angle::from_degrees(half_angle?),
        range_max: match range {
            None => None,
            Some(range) => Some(Distance::from_metres(range?)),
        },
    };
    Some(cone.half_spaces(states))
}

fn terminal_limits(
    message: Option<&v1::InvariantSetLimits>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<InvariantLimits> {
    let Some(message) = message else { return Some(TERMINAL_DEFAULT) };
    let (default, most) = (TERMINAL_DEFAULT, TERMINAL_MOST);
    let mut limit = limit_parser(path, door);
    let iterations_max = limit(
        message.iterations_max,
        1,
        default.iterations_max,
        most.iterations_max,
        "iterations_max",
    );
    let rows_max = limit(message.rows_max, 1, default.rows_max, most.rows_max, "rows_max");
    Some(InvariantLimits { iterations_max: iterations_max?, rows_max: rows_max? })
}

/// Reads limits that have a default: value, least, default, most, name.
fn limit_parser<'p>(
    path: Path<'p>,
    door: &'p mut Door,
) -> impl FnMut(Option<i32>, usize, usize, usize, &'static str) -> Option<usize> {
    move |given, least, default, most, name| match given {
        None => Some(default),
        Some(given) => integer(given, least..=most, path.field(name), door),
    }
}

/// What only the sampled controller is asked with.
struct Sampling {
    samples: SampleChoice,
    redundancy: Redundancy,
    first_step: Option<GrowthLimits>,
    seed: u64,
}

impl Sampling {
    fn parse(
        message: &v1::OfflineSamplingProblem,
        path: Path<'_>,
        door: &mut Door,
    ) -> Option<Self> {
        let samples = samples(message, path.field("samples"), door);
        let redundancy = redundancy(message, path.field("redundancy"), door);
        let first_step = first_step(message, path, door);
        let place = path.field("seed");
        let seed = door.required(&message.seed, place).and_then(|&seed| {
            u64::try_from(seed).ok().or_else(|| door.refuse(place, "a number of at least 0", seed))
        });
        Some(Self {
            samples: samples?,
            redundancy: redundancy?,
            first_step: first_step?,
            seed: seed?,
        })
    }

    /// For the baselines, which sample nothing: what they would not read must not be there.
    fn refused(
        message: &v1::OfflineSamplingProblem,
        path: Path<'_>,
        door: &mut Door,
    ) -> Option<Self> {
        let first_step = message.first_step.as_ref().map(|first_step| match first_step {
            FirstStep::FirstStepSet(_) => "first_step_set",
            FirstStep::NoFirstStepSet(_) => "no_first_step_set",
        });
        let given = [
            message.samples.is_some().then_some("samples"),
            message.redundancy.is_some().then_some("redundancy"),
            first_step,
            message.seed.is_some().then_some("seed"),
        ];
        let mut good = true;
        for name in given.into_iter().flatten() {
            let expected = "nothing: this scheme samples no constraints";
            good = false;
            let _: Option<()> = door.refuse(path.field(name), expected, "a value");
        }
        good.then_some(Self {
            samples: SampleChoice {
                violation: 0.0,
                confidence_complement: 0.0,
                variables: None,
                size: None,
                state_at_start: false,
                rows_max: 0,
            },
            redundancy: Redundancy::Exact,
            first_step: None,
            seed: 0,
        })
    }
}

fn samples(
    message: &v1::OfflineSamplingProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<SampleChoice> {
    let message = door.required(&message.samples, path)?;
    let mut probability = |given: Option<f64>, below: f64, name| {
        let place = path.field(name);
        let given = *door.required(&given, place)?;
        let expected = format!("a number between 0 and {below}, both excluded");
        number(given, |p| p > 0.0 && p < below, &expected, place, door)
    };
    let violation = probability(message.violation, VIOLATION_MAX, "violation");
    let confidence_complement =
        probability(message.confidence_complement, 1.0, "confidence_complement");
    let most = door.limits.sampled_rows_max;
    let mut count = |given: Option<i32>, most, name| match given {
        None => Some(None),
        Some(given) => integer(given, 1..=most, path.field(name), door).map(Some),
    };
    let variables = count(message.variables, 1000, "variables");
    let size = count(message.size, most, "size");
    let rows_max = count(message.rows_max, most, "rows_max");
    let rows_max = rows_max.and_then(|given| match given {
        None if ROWS_MAX_DEFAULT > most => {
            let expected = format!("an integer from 1 to {most}, this server's limit");
            door.refuse(path.field("rows_max"), expected, "nothing, which means 1000000")
        }
        given => Some(given.unwrap_or(ROWS_MAX_DEFAULT)),
    });
    Some(SampleChoice {
        violation: violation?,
        confidence_complement: confidence_complement?,
        variables: variables?,
        size: size?,
        state_at_start: message.state_at_start,
        rows_max: rows_max?,
    })
}

fn redundancy(
    message: &v1::OfflineSamplingProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Redundancy> {
    use v1::redundancy::Mode;
    match &door.required(&message.redundancy, path)?.mode {
        None => door.refuse(path, "one of exact, inner_scaled", "nothing"),
        Some(Mode::Exact(v1::ExactReduction {})) => Some(Redundancy::Exact),
        Some(Mode::InnerScaled(inner)) => {
            let scaled = path.field("inner_scaled");
            let place = scaled.field("epsilon");
            let epsilon = required_positive(inner.epsilon, place, door)?;
            if epsilon >= 1.0 {
                return door.refuse(place, "a number between 0 and 1, both excluded", epsilon);
            }
            Some(Redundancy::InnerScaled { epsilon })
        }
    }
}

/// `Some(None)` where the problem asks for none.
#[allow(clippy::option_option, reason = "at fault and not asked for are different things here")]
fn first_step(
    message: &v1::OfflineSamplingProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Option<GrowthLimits>> {
    match &message.first_step {
        None => door.refuse(path, "one of first_step_set, no_first_step_set", "nothing"),
        Some(FirstStep::NoFirstStepSet(v1::NoFirstStepSet {})) => Some(None),
        Some(FirstStep::FirstStepSet(set)) => {
            let (default, most) = (GROWTH_DEFAULT, GROWTH_MOST);
            let mut limit = limit_parser(path.field("first_step_set"), door);
            let rounds = limit(set.rounds, 0, default.rounds, most.rounds, "rounds");
            let directions =
                limit(set.directions, 1, default.directions, most.directions, "directions");
            let facets_max =
                limit(set.facets_max, 1, default.facets_max, most.facets_max, "facets_max");
            Some(Some(GrowthLimits {
                rounds: rounds?,
                directions: directions?,
                facets_max: facets_max?,
            }))
        }
    }
}
