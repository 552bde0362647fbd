//! Words every method shares: numbers, vectors, matrices, states, certificates, infeasibility.

use std::fmt;

use nalgebra::{DMatrix, DVector, Vector3};
use vbar_guidance::{
    control::{self, Certificate, Claim, ConstraintFamily, Infeasibility},
    frames::{InFrame, LvlhCcsds, RTN_FROM_LVLH_CCSDS, RelativeState, Rtn},
    mission::{THRUSTERS_MAX, ThrustMode},
    sets::Polytope,
    units::Seconds,
};
use vbar_proto::v1;

use super::{Door, Parse, Path, Render, build::BUILD, count};

/// Numbers beyond this are refused everywhere: no mission needs them, and products of a few of
/// them would overflow.
const NUMBER_MAX: f64 = 1e12;

/// sha256 of (method, version, canonical problem): names a problem and what was made for it.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct ArtifactId(pub(crate) [u8; 32]);

impl ArtifactId {
    /// From 64 lower-case hexadecimal digits.
    pub(crate) fn from_hex(text: &str) -> Option<Self> {
        let digit = |c: u8| match c {
            b'0'..=b'9' => Some(c - b'0'),
            b'a'..=b'f' => Some(c - b'a' + 10),
            _ => None,
        };
        let text: &[u8; 64] = text.as_bytes().try_into().ok()?;
        let mut id = [0; 32];
        for (byte, pair) in id.iter_mut().zip(text.chunks_exact(2)) {
            *byte = digit(pair[0])? << 4 | digit(pair[1])?;
        }
        Some(Self(id))
    }
}

impl fmt::Display for ArtifactId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for ArtifactId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl Parse for ArtifactId {
    type Message = String;

    fn parse(message: &String, path: Path<'_>, door: &mut Door) -> Option<Self> {
        Self::from_hex(message).or_else(|| {
            let shown: String = message.chars().take(80).collect();
            door.refuse(path, "64 lower-case hexadecimal digits", format!("{shown:?}"))
        })
    }
}

/// Where an answer comes from.
#[derive(Debug, Clone)]
pub(crate) struct Provenance {
    /// Name of the method.
    pub(crate) method: &'static str,
    /// Version of its mathematics.
    pub(crate) method_version: &'static str,
    /// Names the problem, in hexadecimal.
    pub(crate) artifact_id: String,
    /// sha256 of the artifact's bytes, in hexadecimal; empty if there are none.
    pub(crate) content_sha256: String,
}

impl Render for Provenance {
    type Message = v1::Provenance;

    fn render(&self) -> v1::Provenance {
        v1::Provenance {
            method: self.method.to_owned(),
            method_version: self.method_version.to_owned(),
            artifact_id: self.artifact_id.clone(),
            content_sha256: self.content_sha256.clone(),
            build_version: BUILD.version.to_owned(),
        }
    }
}

/// What was measured, for whichever method.
#[derive(Debug, Clone)]
pub(crate) struct ElapsedAndState {
    /// The state.
    pub(crate) state: MeasuredState,
    /// Time since the mission's start.
    pub(crate) elapsed: Option<Seconds>,
    /// Thrusters that work, if it is said.
    pub(crate) working: Option<ThrustMode>,
}

/// The measured state.
#[derive(Debug, Clone)]
pub(crate) enum MeasuredState {
    /// Of a chaser, in RTN.
    Relative(RelativeState),
    /// Of a general linear plant.
    Linear(DVector<f64>),
}

impl Parse for ElapsedAndState {
    type Message = v1::Measurement;

    fn parse(message: &v1::Measurement, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::measurement::State;
        let state = match &message.state {
            None => door.refuse(path, "one of relative, linear", "nothing"),
            Some(State::Relative(relative)) => {
                relative_state(relative, path.field("relative"), door).map(MeasuredState::Relative)
            }
            Some(State::Linear(linear)) => {
                let path = path.field("linear");
                let size = Size::UpTo(door.limits.states_max);
                vector(&linear.components, size, path.field("components"), door)
                    .map(MeasuredState::Linear)
            }
        };
        let elapsed = match message.elapsed_s {
            None => Some(None),
            Some(seconds) => not_negative(seconds, path.field("elapsed_s"), door).map(Some),
        };
        let working = message.working_thrusters.as_ref().map_or(Some(None), |working| {
            working_thrusters(working, THRUSTERS_MAX, path.field("working_thrusters"), door)
                .map(Some)
        });
        Some(Self {
            state: state?,
            elapsed: elapsed?.map(Seconds::from_seconds),
            working: working?,
        })
    }
}

/// Some of `count` thrusters.
pub(super) fn working_thrusters(
    message: &v1::WorkingThrusters,
    count: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<ThrustMode> {
    let path = path.field("indices");
    let (mut bits, mut least) = (0, 0);
    for (i, &index) in message.indices.iter().enumerate() {
        match usize::try_from(index) {
            Ok(thruster) if (least..count).contains(&thruster) => {
                bits |= 1 << thruster;
                least = thruster + 1;
            }
            _ => {
                let expected = format!("thrusters from 0 to {}, increasing", count - 1);
                return door.refuse(path.index(i), expected, index);
            }
        }
    }
    Some(ThrustMode::from_bits(bits))
}

pub(super) fn relative_state(
    message: &v1::RelativeState,
    path: Path<'_>,
    door: &mut Door,
) -> Option<RelativeState> {
    let axes = Axes::parse(&message.frame, path.field("frame"), door);
    let position = vector3(&message.position_m, path.field("position_m"), door);
    let velocity = vector3(&message.velocity_m_s, path.field("velocity_m_s"), door);
    let (axes, position, velocity) = (axes?, position?, velocity?);
    Some(RelativeState {
        position_m: InFrame::new(axes.to_rtn(position)),
        velocity_m_s: InFrame::new(axes.to_rtn(velocity)),
    })
}

/// Axes a message may be written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Axes {
    Rtn,
    LvlhCcsds,
}

impl Axes {
    /// Components along RTN of a vector given along these axes.
    pub(super) fn to_rtn(self, components: Vector3<f64>) -> Vector3<f64> {
        match self {
            Self::Rtn => components,
            Self::LvlhCcsds => {
                let turned: InFrame<Rtn> =
                    RTN_FROM_LVLH_CCSDS * InFrame::<LvlhCcsds>::new(components);
                turned.components
            }
        }
    }

    /// A quadratic form of one vector, or of position and velocity, along RTN. The axes only change
    /// places and signs, so no digit is lost.
    pub(super) fn form_to_rtn(self, form: &DMatrix<f64>) -> DMatrix<f64> {
        let mut turn = DMatrix::zeros(form.nrows(), form.nrows());
        for first in (0..form.nrows()).step_by(3) {
            for axis in 0..3 {
                let turned = self.to_rtn(Vector3::ith(axis, 1.0));
                (0..3).for_each(|i| turn[(first + i, first + axis)] = turned[i]);
            }
        }
        &turn * form * turn.transpose()
    }

    /// Half widths along RTN of a box given along these axes: the axes only change places.
    pub(super) fn box_to_rtn(self, half_widths: Vector3<f64>) -> Vector3<f64> {
        self.to_rtn(half_widths).abs()
    }
}

impl Parse for Axes {
    type Message = i32;

    fn parse(message: &i32, path: Path<'_>, door: &mut Door) -> Option<Self> {
        match v1::Frame::try_from(*message) {
            Ok(v1::Frame::Rtn) => Some(Self::Rtn),
            Ok(v1::Frame::LvlhCcsds) => Some(Self::LvlhCcsds),
            Ok(v1::Frame::Unspecified) => {
                door.refuse(path, "FRAME_RTN or FRAME_LVLH_CCSDS", "FRAME_UNSPECIFIED")
            }
            Err(_) => unknown_enum(*message, "FRAME_RTN or FRAME_LVLH_CCSDS", path, door),
        }
    }
}

/// An enum value from a newer contract, or from nowhere.
pub(super) fn unknown_enum<T>(
    value: i32,
    expected: &str,
    path: Path<'_>,
    door: &mut Door,
) -> Option<T> {
    door.refuse(path, expected, format!("the unknown enum value {value}"))
}

/// A finite number that `fits`.
pub(super) fn number(
    value: f64,
    fits: impl Fn(f64) -> bool,
    expected: &str,
    path: Path<'_>,
    door: &mut Door,
) -> Option<f64> {
    if value.is_finite() && value.abs() <= NUMBER_MAX && fits(value) {
        Some(value)
    } else {
        door.refuse(path, expected, value)
    }
}

pub(super) fn finite(value: f64, path: Path<'_>, door: &mut Door) -> Option<f64> {
    number(value, |_| true, "a finite number of magnitude up to 1e12", path, door)
}

pub(super) fn positive(value: f64, path: Path<'_>, door: &mut Door) -> Option<f64> {
    number(value, |v| v > 0.0, "a finite number above 0", path, door)
}

pub(super) fn not_negative(value: f64, path: Path<'_>, door: &mut Door) -> Option<f64> {
    number(value, |v| v >= 0.0, "a finite number, at least 0", path, door)
}

/// An `int32` within `range`.
pub(super) fn integer(
    value: i32,
    range: std::ops::RangeInclusive<usize>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<usize> {
    match usize::try_from(value) {
        Ok(v) if range.contains(&v) => Some(v),
        _ => {
            let expected = format!("an integer from {} to {}", range.start(), range.end());
            door.refuse(path, expected, value)
        }
    }
}

/// How many elements are right.
#[derive(Debug, Clone, Copy)]
pub(super) enum Size {
    /// This many.
    Exactly(usize),
    /// From 1 to this many.
    UpTo(usize),
}

impl Size {
    fn admits(self, size: usize) -> bool {
        match self {
            Self::Exactly(n) => size == n,
            Self::UpTo(n) => (1..=n).contains(&size),
        }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exactly(n) => write!(f, "{n}"),
            Self::UpTo(n) => write!(f, "1 to {n}"),
        }
    }
}

/// A list of finite numbers.
pub(super) fn list<'m>(
    values: &'m [f64],
    size: Size,
    path: Path<'_>,
    door: &mut Door,
) -> Option<&'m [f64]> {
    if !size.admits(values.len()) {
        let what = if matches!(size, Size::Exactly(1)) { "value" } else { "values" };
        return door.refuse(path, format!("{size} {what}"), values.len());
    }
    let mut good = true;
    for (i, &value) in values.iter().enumerate() {
        good &= finite(value, path.index(i), door).is_some();
    }
    good.then_some(values)
}

pub(super) fn vector(
    values: &[f64],
    size: Size,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DVector<f64>> {
    list(values, size, path, door).map(DVector::from_column_slice)
}

pub(super) fn vector3(values: &[f64], path: Path<'_>, door: &mut Door) -> Option<Vector3<f64>> {
    list(values, Size::Exactly(3), path, door).map(Vector3::from_column_slice)
}

/// A matrix of finite numbers with the right shape.
pub(super) fn matrix(
    message: &v1::Matrix,
    (rows, columns): (Size, Size),
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    let mut side = |given: i32, size: Size, name| match usize::try_from(given) {
        Ok(n) if size.admits(n) => Some(n),
        _ => door.refuse(path.field(name), size.to_string(), given),
    };
    let shape = (side(message.rows, rows, "rows"), side(message.columns, columns, "columns"));
    let (rows, columns) = (shape.0?, shape.1?);
    let size = Size::Exactly(rows.checked_mul(columns)?);
    let values = list(&message.values, size, path.field("values"), door)?;
    Some(DMatrix::from_row_slice(rows, columns, values))
}

/// A symmetric matrix of finite numbers; the field is required.
pub(super) fn symmetric_matrix(
    message: &Option<v1::Matrix>,
    size: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    let message = door.required(message, path)?;
    let matrix = matrix(message, (Size::Exactly(size), Size::Exactly(size)), path, door)?;
    let asymmetry = (&matrix - matrix.transpose()).amax();
    if asymmetry > 1e-12 * matrix.amax() {
        return door.refuse(path, "a symmetric matrix", format!("asymmetry of {asymmetry:e}"));
    }
    Some(matrix)
}

/// A polytope in a space of `dimension`; a row of zeros says nothing and is refused.
pub(super) fn polytope(
    message: &v1::PolytopeSet,
    dimension: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Polytope> {
    let place = path.field("normals");
    let shape = (Size::UpTo(door.limits.polytope_rows_max), Size::Exactly(dimension));
    let normals = door
        .required(&message.normals, place)
        .and_then(|normals| matrix(normals, shape, place, door))?;
    let rows = Size::Exactly(normals.nrows());
    let offsets = vector(&message.offsets, rows, path.field("offsets"), door);
    for (i, normal) in normals.row_iter().enumerate() {
        if normal.norm() < 1e-12 {
            return door.refuse(place, "rows that are not 0", format!("row {i} of zeros"));
        }
    }
    Some(Polytope::new(normals, offsets?))
}

/// Row by row.
pub(super) fn render_matrix(matrix: &DMatrix<f64>) -> v1::Matrix {
    let mut values = Vec::with_capacity(matrix.len());
    for row in 0..matrix.nrows() {
        values.extend((0..matrix.ncols()).map(|column| matrix[(row, column)]));
    }
    v1::Matrix { rows: count(matrix.nrows()), columns: count(matrix.ncols()), values }
}

/// One list a row, all of one length.
pub(super) fn render_rows(rows: impl ExactSizeIterator<Item = Vec<f64>>) -> v1::Matrix {
    let count_of_rows = rows.len();
    let values: Vec<f64> = rows.flatten().collect();
    let columns = values.len().checked_div(count_of_rows).unwrap_or(0);
    v1::Matrix { rows: count(count_of_rows), columns: count(columns), values }
}

/// One vector a row.
pub(super) fn render_vectors(vectors: &[Vector3<f64>]) -> v1::Matrix {
    let values = vectors.iter().flat_map(|v| [v.x, v.y, v.z]).collect();
    v1::Matrix { rows: count(vectors.len()), columns: 3, values }
}

fn render_family(family: ConstraintFamily) -> i32 {
    let family = match family {
        ConstraintFamily::Dynamics => v1::ConstraintFamily::Dynamics,
        ConstraintFamily::State => v1::ConstraintFamily::State,
        ConstraintFamily::Input => v1::ConstraintFamily::Input,
        ConstraintFamily::Terminal => v1::ConstraintFamily::Terminal,
        ConstraintFamily::InitialState => v1::ConstraintFamily::InitialState,
        ConstraintFamily::EmptyInputSet => v1::ConstraintFamily::EmptyInputSet,
        ConstraintFamily::EmptyStateSet => v1::ConstraintFamily::EmptyStateSet,
        ConstraintFamily::FirstStep => v1::ConstraintFamily::FirstStep,
        ConstraintFamily::Tube => v1::ConstraintFamily::Tube,
    };
    family.into()
}

/// What a method's amounts of infeasibility are measured in.
#[derive(Debug, Clone, Copy)]
pub(super) struct Units {
    /// Metres in one unit of a state constraint, for spacecraft plants.
    position_unit_m: Option<f64>,
    /// The limit of an impulse that input constraints are measured in, m/s.
    impulse_limit_m_s: Option<f64>,
}

impl Units {
    /// Inputs are impulses, and amounts are shares of their limit.
    pub(super) fn impulses(limit_m_s: f64) -> Self {
        Self { position_unit_m: None, impulse_limit_m_s: Some(limit_m_s) }
    }

    /// Scaled amounts; `position_unit_m` is metres in one unit of position.
    pub(super) fn scaled(position_unit_m: Option<f64>) -> Self {
        Self { position_unit_m, impulse_limit_m_s: None }
    }
}

/// Only state constraints of a spacecraft plant are half-spaces of position, hence metres.
fn in_metres(family: ConstraintFamily, amount: f64, position_unit_m: Option<f64>) -> Option<f64> {
    match family {
        ConstraintFamily::State
        | ConstraintFamily::InitialState
        | ConstraintFamily::EmptyStateSet => position_unit_m.map(|unit| amount * unit),
        ConstraintFamily::Dynamics
        | ConstraintFamily::Input
        | ConstraintFamily::Terminal
        | ConstraintFamily::EmptyInputSet
        | ConstraintFamily::FirstStep
        | ConstraintFamily::Tube => None,
    }
}

/// `position_unit_m`: metres in one unit of scaled position, for spacecraft plants.
pub(super) fn render_certificate(
    certificate: &Certificate,
    position_unit_m: Option<f64>,
) -> v1::Certificate {
    let optimality = match certificate.claim {
        Claim::Global => v1::Optimality::Global,
        Claim::GlobalToHorizonMax => v1::Optimality::GlobalToHorizonMax,
        Claim::LocalInHorizon => v1::Optimality::LocalInHorizon,
        Claim::FixedHorizon => v1::Optimality::FixedHorizon,
        Claim::Feasible => v1::Optimality::Feasible,
        Claim::PreviousPlanTail => v1::Optimality::PreviousPlanTail,
    };
    let margin = |m: &control::ConstraintMargin| v1::ConstraintMargin {
        family: render_family(m.family),
        stage: count(m.stage),
        row: count(m.row),
        margin_nd: m.margin,
        margin_m: in_metres(m.family, m.margin, position_unit_m),
    };
    v1::Certificate {
        passed: certificate.passed,
        optimality: optimality.into(),
        tolerance_nd: certificate.tolerance,
        dynamics_residual_nd: certificate.dynamics_residual,
        margins: certificate.margins.iter().map(margin).collect(),
        cost: certificate.cost,
        cost_lower_bound: certificate.lower_bound,
        relative_gap: certificate.relative_gap(),
    }
}

/// Writes why there is no answer.
pub(super) fn render_infeasible(infeasibility: &Infeasibility, units: Units) -> v1::Infeasible {
    let row = |r: &control::ProofRow| v1::ConstraintRow {
        family: render_family(r.family),
        stage: count(r.stage),
        row: count(r.row),
        weight: r.weight,
    };
    let relaxation = |r: &control::Relaxation| {
        let limit = units.impulse_limit_m_s.filter(|_| r.family == ConstraintFamily::Input);
        v1::Relaxation {
            family: render_family(r.family),
            horizon: count(r.horizon),
            amount_nd: r.amount,
            amount_m: in_metres(r.family, r.amount, units.position_unit_m),
            amount_m_s: limit.map(|limit| r.amount * limit),
            limit_m_s: limit.map(|limit| (1.0 + r.amount) * limit),
        }
    };
    v1::Infeasible {
        reason: infeasibility.reason.clone(),
        rows: infeasibility.rows.iter().map(row).collect(),
        relaxations: infeasibility.relaxations.iter().map(relaxation).collect(),
        horizon: count(infeasibility.horizon),
        all_horizons_proved: infeasibility.all_horizons_proved,
    }
}
