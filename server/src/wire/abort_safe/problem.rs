//! Missions of abort safety, read.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector3};
use vbar_guidance::{
    control::abort_safe::{
        FRACTIONS_MAX, Fallback, INSTANTS_MAX, NEAREST_MAX, NUMBERS_MAX, PREDICTION_MAX, Phase,
        Problem, STEPS_MAX, Safety, Separation, SetTiming, Watch, Weights,
    },
    mission::{
        AvoidanceRegion, AvoidanceSet, SPEED_MAX_DEFAULT_M_S, THRUSTERS_MAX, ThrustMode, Thruster,
        Thrusters,
    },
    orbit::KeplerOrbit,
    units::{Distance, Force, Mass, Seconds},
};
use vbar_proto::v1;

use crate::wire::{
    Door, Parse, Path,
    orbits::Target,
    types::{
        Axes, Size, integer, list, matrix, not_negative, number, polytope, positive, unknown_enum,
        vector3, working_thrusters,
    },
};

/// A sample time divides the period if so many samples miss it by at most this part of one.
const FOLD_TOLERANCE: f64 = 1e-3;
/// Most failures of one phase: each is judged at every step.
const MODES_MAX: usize = 4096;
/// Most phases.
const PHASES_MAX: usize = 16;
const CLEARANCE_DEFAULT: f64 = 1e-4;
const ABORT_CLEARANCE_DEFAULT_M: f64 = 1e-3;
const ABORT_PROGRAMS_DEFAULT: usize = 2000;
const ABORT_PROGRAMS_MAX: usize = 1_000_000;
/// Normals are taken as they are, so their offsets are metres only if they have this length.
const UNIT_TOLERANCE: f64 = 1e-9;

impl Parse for Problem {
    type Message = v1::AbortSafeProblem;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let target: Option<Target> = door.message(&message.orbit, path.field("orbit"));
        let orbit = target.map(|target| target.orbit);
        let mass = required_positive(message.mass_kg, path.field("mass_kg"), door);
        let sampling = sampling(message, orbit.as_ref(), path, door);
        let axes = Axes::parse(&message.frame, path.field("frame"), door);
        let thrusters = thrusters(message, axes, path.field("thrusters"), door);
        let given = Given { axes, thrusters: thrusters.as_ref(), samples: sampling.map(|s| s.1) };
        let phases = phases(&message.phases, &given, path.field("phases"), door);
        let longest = PREDICTION_MAX.min(door.limits.horizon_max);
        let place = path.field("prediction_horizon");
        let prediction_horizon = integer(message.prediction_horizon, 1..=longest, place, door);
        let clearance = message.clearance.unwrap_or(CLEARANCE_DEFAULT);
        let clearance = positive(clearance, path.field("clearance"), door);
        let timing = set_timing(message.set_timing, path.field("set_timing"), door);
        let separation = separation(message.separation, path.field("separation"), door);
        let fallback = fallback(message.fallback, path.field("fallback"), door);
        let place = path.field("arrival_distance_m");
        let arrival = required_positive(message.arrival_distance_m, place, door);
        let place = path.field("fastest_approach_m_s");
        let fastest = required_positive(message.fastest_approach_m_s, place, door);
        let search = abort_search(message, path.field("abort_search"), door);
        let longest = door.limits.steps_max;
        let steps_max = integer(message.steps_max, 1..=longest, path.field("steps_max"), door);
        let ((sample_time, steps_per_period), (abort_clearance, abort_programs_max)) =
            (sampling?, search?);
        Some(Self {
            orbit: orbit?,
            epoch: target?.epoch,
            mass: Mass::from_kilograms(mass?),
            sample_time,
            steps_per_period,
            thrusters: thrusters?,
            phases: phases?,
            prediction_horizon: prediction_horizon?,
            clearance: clearance?,
            timing: timing?,
            separation: separation?,
            fallback: fallback?,
            arrival: Distance::from_metres(arrival?),
            fastest_approach_m_s: fastest?,
            abort_programs_max,
            abort_clearance,
            steps_max: steps_max?,
        })
    }
}

fn required_positive(given: Option<f64>, path: Path<'_>, door: &mut Door) -> Option<f64> {
    let value = *door.required(&given, path)?;
    positive(value, path, door)
}

/// The sample time, and the steps after which the plant repeats.
fn sampling(
    message: &v1::AbortSafeProblem,
    orbit: Option<&KeplerOrbit>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(Seconds, usize)> {
    let place = path.field("sample_time_s");
    let step_s = required_positive(message.sample_time_s, place, door);
    let folding = folding(message.period_folding, path.field("period_folding"), door);
    // An orbit at fault has said so already.
    let (step_s, folding, orbit) = (step_s?, folding?, orbit?);
    let step = Seconds::from_seconds(step_s);
    if orbit.eccentricity() == 0.0 {
        return Some((step, 1));
    }
    let period_s = orbit.period().seconds();
    let ratio = period_s / step_s;
    let samples = ratio.round();
    if !(1.0..=STEPS_MAX as f64).contains(&samples) {
        let expected = format!("1 to {STEPS_MAX} samples in the period of {period_s} s");
        return door.refuse(place, expected, format!("{step_s} s, {ratio:.3} samples"));
    }
    let miss = (samples - ratio).abs();
    if folding == v1::PeriodFolding::Exact && miss > FOLD_TOLERANCE {
        let near = |n: f64| format!("{:.9}", period_s / n);
        let expected = format!(
            "a divisor of the orbit's period of {period_s} s, such as {} or {}; or period_folding \
             PERIOD_FOLDING_RESYNCHRONISE",
            near(ratio.ceil()),
            near(ratio.floor().max(1.0)),
        );
        return door.refuse(place, expected, format!("{step_s}, {miss:.3} samples off"));
    }
    Some((step, samples as usize))
}

fn folding(value: i32, path: Path<'_>, door: &mut Door) -> Option<v1::PeriodFolding> {
    use v1::PeriodFolding as Folding;
    const EXPECTED: &str = "PERIOD_FOLDING_EXACT, PERIOD_FOLDING_RESYNCHRONISE or unspecified";
    match Folding::try_from(value) {
        Ok(Folding::Unspecified | Folding::Exact) => Some(Folding::Exact),
        Ok(Folding::Resynchronise) => Some(Folding::Resynchronise),
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn thrusters(
    message: &v1::AbortSafeProblem,
    axes: Option<Axes>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Thrusters> {
    use v1::thruster_layout::Form;
    let layout = door.required(&message.thrusters, path)?;
    match &layout.form {
        None => door.refuse(path, "one of cube_corners, list", "nothing"),
        Some(Form::CubeCorners(corners)) => {
            let corner = path.field("cube_corners");
            let place = corner.field("force_max_n");
            let force = required_positive(corners.force_max_n, place, door)?;
            let corners = Thrusters::cube_corners(Force::from_newtons(force))?;
            let turned = corners
                .list()
                .iter()
                .map(|corner| Thruster::new(axes?.to_rtn(*corner.direction()), corner.force_max()));
            turned.collect::<Option<_>>().and_then(Thrusters::new)
        }
        Some(Form::List(given)) => {
            let path = path.field("list");
            let path = path.field("thrusters");
            let given = &given.thrusters;
            if !(1..=THRUSTERS_MAX).contains(&given.len()) {
                let expected = format!("1 to {THRUSTERS_MAX} thrusters");
                return door.refuse(path, expected, given.len());
            }
            let list: Vec<Option<Thruster>> = given
                .iter()
                .enumerate()
                .map(|(i, thruster)| one_thruster(thruster, axes, path.index(i), door))
                .collect();
            list.into_iter().collect::<Option<_>>().and_then(Thrusters::new)
        }
    }
}

fn one_thruster(
    message: &v1::Thruster,
    axes: Option<Axes>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Thruster> {
    let place = path.field("direction");
    let direction = vector3(&message.direction, place, door).and_then(|direction| {
        match direction.norm() > 0.0 {
            true => Some(direction),
            false => door.refuse(place, "a direction", "a vector of length 0"),
        }
    });
    let force = required_positive(message.force_max_n, path.field("force_max_n"), door);
    Thruster::new(axes?.to_rtn(direction?), Force::from_newtons(force?))
}

/// What the phases are read with; `None` where it is at fault itself.
struct Given<'a> {
    axes: Option<Axes>,
    thrusters: Option<&'a Thrusters>,
    samples: Option<usize>,
}

fn phases(
    given: &[v1::AbortSafePhase],
    with: &Given<'_>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<Phase>> {
    if !(1..=PHASES_MAX).contains(&given.len()) {
        return door.refuse(path, format!("1 to {PHASES_MAX} phases"), given.len());
    }
    let last = given.len() - 1;
    let phases: Vec<Option<Phase>> = given
        .iter()
        .enumerate()
        .map(|(i, phase)| one_phase(phase, i == last, with, path.index(i), door))
        .collect();
    phases.into_iter().collect()
}

fn one_phase(
    message: &v1::AbortSafePhase,
    last: bool,
    with: &Given<'_>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Phase> {
    use v1::abort_safe_phase::Safety as Message;
    let safety = match &message.safety {
        None => door.refuse(path, "one of passive, active, nothing_avoided", "nothing"),
        Some(Message::Passive(passive)) => {
            let path = path.field("passive");
            watch(&passive.watch, with, path.field("watch"), door).map(Safety::Passive)
        }
        Some(Message::Active(active)) => {
            let path = path.field("active");
            let watch = watch(&active.watch, with, path.field("watch"), door);
            let modes = failure_modes(&active.modes, with, path.field("modes"), door);
            watch.zip(modes).map(|(watch, modes)| Safety::Active { watch, modes })
        }
        Some(Message::NothingAvoided(_)) => Some(Safety::None),
    };
    let place = path.field("weights");
    let weights =
        door.required(&message.weights, place).and_then(|w| weights(w, with.axes, place, door));
    let place = path.field("advance_within_m");
    let within = match (last, message.advance_within_m) {
        (false, given) => {
            door.required(&given, place).and_then(|&within| not_negative(within, place, door))
        }
        (true, None) => Some(0.0),
        (true, Some(within)) => door.refuse(place, "nothing: no phase follows", within),
    };
    Some(Phase {
        safety: safety?,
        weights: weights?,
        advance_within: Distance::from_metres(within?),
    })
}

fn watch(
    message: &Option<v1::SafetyWatch>,
    with: &Given<'_>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Watch> {
    let message = door.required(message, path)?;
    let speed = message.speed_max_m_s.unwrap_or(SPEED_MAX_DEFAULT_M_S);
    let speed = positive(speed, path.field("speed_max_m_s"), door);
    let place = path.field("region");
    let region =
        door.required(&message.region, place).and_then(|r| region(r, with.axes, place, door));
    let avoid = region.zip(speed).and_then(|(region, speed)| {
        AvoidanceSet::new(region, speed).or_else(|| {
            let expected = "lengths and offsets above 0, or a symmetric positive definite matrix";
            door.refuse(place, expected, "another one")
        })
    });
    let inflation = message.inflation.unwrap_or(1.0);
    let place = path.field("inflation");
    let inflation = number(inflation, |gamma| gamma >= 1.0, "a number, at least 1", place, door);
    let horizon = integer(message.horizon_steps, 1..=STEPS_MAX, path.field("horizon_steps"), door);
    let mut or_one = |value: i32, most, name| {
        integer(if value == 0 { 1 } else { value }, 1..=most, path.field(name), door)
    };
    let fractions = or_one(message.fractions, FRACTIONS_MAX, "fractions");
    let nearest = or_one(message.nearest_sets, NEAREST_MAX, "nearest_sets");
    let (horizon, fractions) = (horizon?, fractions?);
    room_for_sets(horizon, fractions, with.samples, path, door)?;
    Some(Watch { avoid: avoid?, inflation: inflation?, horizon, fractions, nearest: nearest? })
}

/// Every start along the orbit has a set an instant, of up to so many numbers.
fn room_for_sets(
    horizon: usize,
    fractions: usize,
    samples: Option<usize>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<()> {
    const ELLIPSOID_TERMS: usize = 21;
    let instants = horizon * fractions;
    if instants > INSTANTS_MAX {
        let expected = format!("at most {INSTANTS_MAX} instants, horizon_steps times fractions");
        return door.refuse(path.field("fractions"), expected, instants);
    }
    let numbers = instants.saturating_mul(samples.unwrap_or(1)).saturating_mul(ELLIPSOID_TERMS);
    if numbers > NUMBERS_MAX {
        let expected = format!("sets of at most {} MB", NUMBERS_MAX * 8 / 1_000_000);
        let got = format!("{} MB", numbers.saturating_mul(8) / 1_000_000);
        return door.refuse(path.field("horizon_steps"), expected, got);
    }
    Some(())
}

fn region(
    message: &v1::AvoidanceRegion,
    axes: Option<Axes>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<AvoidanceRegion> {
    use v1::avoidance_region::Form;
    const FORMS: &str = "one of semi_axes, radius_m, half_widths, shape_m2, faces_m";
    match &message.form {
        None => door.refuse(path, FORMS, "nothing"),
        Some(Form::SemiAxes(given)) => {
            let path = path.field("semi_axes");
            let lengths = lengths(&given.semi_axes_m, path.field("semi_axes_m"), door)?;
            Some(AvoidanceRegion::SemiAxes(axes?.box_to_rtn(lengths)))
        }
        Some(Form::RadiusM(radius)) => {
            positive(*radius, path.field("radius_m"), door).map(AvoidanceRegion::Radius)
        }
        Some(Form::HalfWidths(given)) => {
            let path = path.field("half_widths");
            let lengths = lengths(&given.half_widths_m, path.field("half_widths_m"), door)?;
            Some(AvoidanceRegion::HalfWidths(axes?.box_to_rtn(lengths)))
        }
        Some(Form::ShapeM2(shape)) => {
            let path = path.field("shape_m2");
            let size = (Size::Exactly(3), Size::Exactly(3));
            let shape = definite(matrix(shape, size, path, door)?, path, door)?;
            let shape = axes?.form_to_rtn(&shape);
            Some(AvoidanceRegion::ShapeMatrix(shape.fixed_view::<3, 3>(0, 0).into_owned()))
        }
        Some(Form::FacesM(faces)) => self::faces(faces, axes, path.field("faces_m"), door),
    }
}

fn lengths(given: &[f64], path: Path<'_>, door: &mut Door) -> Option<Vector3<f64>> {
    list(given, Size::Exactly(3), path, door)?;
    let mut good = true;
    for (i, &length) in given.iter().enumerate() {
        good &= positive(length, path.index(i), door).is_some();
    }
    good.then(|| Vector3::from_column_slice(given))
}

fn faces(
    message: &v1::PolytopeSet,
    axes: Option<Axes>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<AvoidanceRegion> {
    let faces = polytope(message, 3, path, door)?;
    let mut good = true;
    for (i, normal) in faces.normals().row_iter().enumerate() {
        let length = normal.norm();
        if !((length - 1.0).abs() <= UNIT_TOLERANCE) {
            good = false;
            let got = format!("row {i} of length {length}");
            let _: Option<()> = door.refuse(path.field("normals"), "rows of length 1", got);
        }
    }
    for (i, &offset) in faces.offsets().iter().enumerate() {
        let expected = "a number above 0: the region holds the target's centre of mass inside";
        let place = path.field("offsets");
        good &= number(offset, |o| o > 0.0, expected, place.index(i), door).is_some();
    }
    if !is_bounded(faces.normals()) {
        let expected = "faces that close the region on all sides";
        return door.refuse(path.field("normals"), expected, "an unbounded region");
    }
    let axes = axes?;
    let rows: Vec<_> = faces
        .normals()
        .row_iter()
        .map(|row| axes.to_rtn(Vector3::new(row[0], row[1], row[2])).transpose())
        .collect();
    let normals = DMatrix::from_fn(rows.len(), 3, |i, j| rows[i][j]);
    good.then(|| AvoidanceRegion::Faces { normals, offsets: faces.offsets().clone() })
}

/// Is {p : normals p <= offsets} bounded, for offsets above 0? Only if no direction d has
/// normals d <= 0: of a cone without a line it is enough to try its edges, where two rows meet.
fn is_bounded(normals: &DMatrix<f64>) -> bool {
    const ROUNDING: f64 = 1e-12;
    let rows: Vec<Vector3<f64>> =
        normals.row_iter().map(|row| Vector3::new(row[0], row[1], row[2])).collect();
    let gram = rows.iter().fold(Matrix3::zeros(), |sum, row| sum + row * row.transpose());
    let flat = gram.symmetric_eigenvalues().min() <= ROUNDING * gram.trace();
    let escapes = |d: &Vector3<f64>| rows.iter().all(|row| row.dot(d) <= ROUNDING);
    let edges = (0..rows.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    let mut directions = edges
        .filter_map(|(i, j)| rows[i].cross(&rows[j]).try_normalize(ROUNDING))
        .flat_map(|d| [d, -d]);
    !flat && !directions.any(|d| escapes(&d))
}

fn failure_modes(
    message: &Option<v1::FailureModes>,
    with: &Given<'_>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<ThrustMode>> {
    use v1::failure_modes::Form;
    let message = door.required(message, path)?;
    match &message.form {
        None => door.refuse(path, "one of preset, list", "nothing"),
        Some(Form::Preset(preset)) => {
            let path = path.field("preset");
            let modes = by_rule(*preset, with.thrusters, path, door)?;
            match (1..=MODES_MAX).contains(&modes.len()) {
                true => Some(modes),
                false => door.refuse(path, format!("1 to {MODES_MAX} modes"), modes.len()),
            }
        }
        Some(Form::List(given)) => {
            let path = path.field("list");
            mode_list(&given.modes, with.thrusters, path.field("modes"), door)
        }
    }
}

fn by_rule(
    preset: i32,
    thrusters: Option<&Thrusters>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<ThrustMode>> {
    use v1::FailureModePreset as Preset;
    const EXPECTED: &str = "FAILURE_MODE_PRESET_SINGLE_THRUSTERS, _SINGLE_FAILURES, _ALL_BUT_TOTAL \
                            or _ALL";
    let preset = match Preset::try_from(preset) {
        Ok(Preset::Unspecified) => {
            return door.refuse(path, EXPECTED, Preset::Unspecified.as_str_name());
        }
        Ok(preset) => preset,
        Err(_) => return unknown_enum(preset, EXPECTED, path, door),
    };
    let thrusters = thrusters?;
    let (count, nominal) = (thrusters.list().len(), thrusters.nominal());
    let single = |j: usize| ThrustMode::from_bits(1 << j);
    let without = |j: usize| ThrustMode::from_bits(nominal.bits() & !(1 << j));
    Some(match preset {
        Preset::SingleThrusters => (0..count).map(single).collect(),
        Preset::SingleFailures => (0..count).map(without).collect(),
        Preset::AllButTotal => thrusters.failure_modes().split_off(1),
        Preset::All | Preset::Unspecified => thrusters.failure_modes(),
    })
}

/// Failures one by one: of a phase, and of a safety report.
pub(super) fn mode_list(
    given: &[v1::WorkingThrusters],
    thrusters: Option<&Thrusters>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<ThrustMode>> {
    if !(1..=MODES_MAX).contains(&given.len()) {
        return door.refuse(path, format!("1 to {MODES_MAX} modes"), given.len());
    }
    let count = thrusters.map_or(THRUSTERS_MAX, |thrusters| thrusters.list().len());
    let mut modes: Vec<ThrustMode> = Vec::with_capacity(given.len());
    let mut good = true;
    for (i, working) in given.iter().enumerate() {
        let place = path.index(i);
        match working_thrusters(working, count, place, door) {
            Some(mode) if modes.contains(&mode) => {
                good = false;
                let _: Option<()> = door.refuse(place, "a mode named once", "one named before");
            }
            Some(mode) => modes.push(mode),
            None => good = false,
        }
    }
    good.then_some(modes)
}

fn weights(
    message: &v1::RegulatorWeights,
    axes: Option<Axes>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Weights> {
    let place = path.field("stage");
    let stage = weight_matrix(&message.stage, 6, place, door)
        .and_then(|weights| semidefinite(weights, place, door));
    let place = path.field("input");
    let input = weight_matrix(&message.input, 3, place, door)
        .and_then(|weights| definite(weights, place, door));
    let place = path.field("terminal");
    let terminal = weight_matrix(&message.terminal, 6, place, door)
        .and_then(|weights| semidefinite(weights, place, door));
    let (axes, stage, input, terminal) = (axes?, stage?, input?, terminal?);
    let six = |matrix: &DMatrix<f64>| -> SMatrix<f64, 6, 6> {
        axes.form_to_rtn(matrix).fixed_view::<6, 6>(0, 0).into_owned()
    };
    Some(Weights {
        stage: six(&stage),
        input: axes.form_to_rtn(&input).fixed_view::<3, 3>(0, 0).into_owned(),
        terminal: six(&terminal),
    })
}

fn weight_matrix(
    message: &Option<v1::WeightMatrix>,
    size: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    use v1::weight_matrix::Form;
    let message = door.required(message, path)?;
    match &message.form {
        None => door.refuse(path, "one of identity_times, diagonal, matrix", "nothing"),
        Some(Form::IdentityTimes(factor)) => {
            not_negative(*factor, path.field("identity_times"), door)
                .map(|factor| DMatrix::identity(size, size) * factor)
        }
        Some(Form::Diagonal(diagonal)) => {
            let path = path.field("diagonal");
            let values = list(&diagonal.values, Size::Exactly(size), path.field("values"), door)?;
            Some(DMatrix::from_diagonal(&DVector::from_column_slice(values)))
        }
        Some(Form::Matrix(given)) => {
            let size = (Size::Exactly(size), Size::Exactly(size));
            matrix(given, size, path.field("matrix"), door)
        }
    }
}

fn is_symmetric(matrix: &DMatrix<f64>) -> bool {
    (matrix - matrix.transpose()).amax() <= 1e-9 * matrix.amax()
}

fn definite(matrix: DMatrix<f64>, path: Path<'_>, door: &mut Door) -> Option<DMatrix<f64>> {
    match is_symmetric(&matrix) && matrix.clone().cholesky().is_some() {
        true => Some(matrix),
        false => door.refuse(path, "a symmetric, positive definite matrix", "another one"),
    }
}

fn semidefinite(matrix: DMatrix<f64>, path: Path<'_>, door: &mut Door) -> Option<DMatrix<f64>> {
    let least = -1e-9 * matrix.amax();
    match is_symmetric(&matrix) && matrix.symmetric_eigenvalues().iter().all(|&x| x >= least) {
        true => Some(matrix),
        false => door.refuse(path, "a symmetric, positive semidefinite matrix", "another one"),
    }
}

fn set_timing(value: i32, path: Path<'_>, door: &mut Door) -> Option<SetTiming> {
    const EXPECTED: &str = "SET_TIMING_TIMED, SET_TIMING_UNTIMED or unspecified";
    match v1::SetTiming::try_from(value) {
        Ok(v1::SetTiming::Unspecified | v1::SetTiming::Timed) => Some(SetTiming::Timed),
        Ok(v1::SetTiming::Untimed) => Some(SetTiming::Untimed),
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn separation(value: i32, path: Path<'_>, door: &mut Door) -> Option<Separation> {
    use v1::Separation as Message;
    const EXPECTED: &str = "SEPARATION_TANGENT, _LINEAR_PROGRAM, _SECOND_ORDER_CONE or unspecified";
    match Message::try_from(value) {
        Ok(Message::Unspecified | Message::Tangent) => Some(Separation::Tangent),
        Ok(Message::LinearProgram) => Some(Separation::LinearProgram),
        Ok(Message::SecondOrderCone) => Some(Separation::SecondOrderCone),
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn fallback(value: i32, path: Path<'_>, door: &mut Door) -> Option<Fallback> {
    use v1::AbortSafeFallback as Message;
    const EXPECTED: &str = "ABORT_SAFE_FALLBACK_SOFTEN or ABORT_SAFE_FALLBACK_ABORT";
    match Message::try_from(value) {
        Ok(Message::Soften) => Some(Fallback::Soften),
        Ok(Message::Abort) => Some(Fallback::Abort),
        Ok(unspecified @ Message::Unspecified) => {
            door.refuse(path, EXPECTED, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

/// Clearance in metres, and most programs.
fn abort_search(
    message: &v1::AbortSafeProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(f64, usize)> {
    let given = message.abort_search.unwrap_or_default();
    let clearance = given.clearance_m.unwrap_or(ABORT_CLEARANCE_DEFAULT_M);
    let clearance = positive(clearance, path.field("clearance_m"), door);
    let programs = match given.programs_max {
        0 => Some(ABORT_PROGRAMS_DEFAULT),
        most => integer(most, 1..=ABORT_PROGRAMS_MAX, path.field("programs_max"), door),
    };
    clearance.zip(programs)
}
