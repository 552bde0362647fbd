//! The simulator's own reading of a problem: what the service is told, in SI and radians.

use nalgebra::{DMatrix, DVector, Matrix3, Quaternion, UnitQuaternion, Vector3, Vector6};
use vbar_proto::v1::{self, disturbance_set::Form, hill_plant, target_rotation::Motion};

use crate::{
    mission::variable_horizon,
    plant::{
        EARTH_MU_M3_S2,
        cone::DockingCone,
        linear::LinearPlant,
        rotation::{BodyMotion, BodyPoints, Target, TorqueFreeBody},
    },
};

/// Steps of a mission when the problem does not say, as the contract promises.
const STEPS_MAX_DEFAULT: i32 = 1000;

/// Most steps of a mission that is flown.
const STEPS_MAX: i32 = 100_000;

/// What is flown and by which rules.
#[derive(Debug, Clone)]
pub(crate) struct Model {
    /// The plant's arm.
    pub kind: Kind,
    /// Set of disturbances, in scaled units.
    pub disturbance: DisturbanceModel,
    /// Most steps of a run.
    pub steps_max: usize,
    /// The state constraints hold at the arrival too. With the reference itself as terminal point
    /// the problem imposes them before the arrival only [Quartullo2025b, eq. 9].
    pub constrained_at_arrival: bool,
}

#[derive(Debug, Clone)]
pub(crate) enum Kind {
    Hill(Box<HillModel>),
    Linear(Box<LinearModel>),
}

/// A chaser near a rotating target.
#[derive(Debug, Clone)]
pub(crate) struct HillModel {
    pub mean_motion_rad_s: f64,
    pub sample_time_s: f64,
    pub acceleration_max_m_s2: f64,
    pub target: Target,
    pub cone: Option<DockingCone>,
}

impl HillModel {
    /// Metres in one unit of scaled position: a_max / eta^2.
    pub(crate) fn position_unit_m(&self) -> f64 {
        self.acceleration_max_m_s2 / self.mean_motion_rad_s.powi(2)
    }

    /// Metres per second in one unit of scaled velocity: a_max / eta.
    pub(crate) fn velocity_unit_m_s(&self) -> f64 {
        self.acceleration_max_m_s2 / self.mean_motion_rad_s
    }

    /// Takes a scaled state to SI.
    pub(crate) fn to_si(&self, scaled: &DVector<f64>) -> Vector6<f64> {
        Vector6::from_fn(|row, _| {
            scaled[row] * if row < 3 { self.position_unit_m() } else { self.velocity_unit_m_s() }
        })
    }
}

/// A general linear plant.
#[derive(Debug, Clone)]
pub(crate) struct LinearModel {
    pub plant: LinearPlant,
    pub input_lower: DVector<f64>,
    pub input_upper: DVector<f64>,
    /// Further half-spaces on the input.
    pub input_set: Option<HalfSpaces>,
    pub state_set: Option<HalfSpaces>,
    /// One row (constant) or one row a sample; none: the origin.
    pub reference: Option<DMatrix<f64>>,
}

impl LinearModel {
    /// The reference at sample `k`; the table's last row holds beyond its end only if it is the
    /// only one.
    pub(crate) fn reference(&self, k: usize) -> Option<DVector<f64>> {
        match &self.reference {
            None => Some(DVector::zeros(self.plant.a.nrows())),
            Some(table) if table.nrows() == 1 => Some(table.row(0).transpose()),
            Some(table) if k < table.nrows() => Some(table.row(k).transpose()),
            Some(_) => None,
        }
    }
}

/// `normals x <= offsets`.
#[derive(Debug, Clone)]
pub(crate) struct HalfSpaces {
    pub normals: DMatrix<f64>,
    pub offsets: DVector<f64>,
}

impl HalfSpaces {
    /// Least right side minus left side.
    pub(crate) fn margin(&self, x: &DVector<f64>) -> f64 {
        (&self.offsets - &self.normals * x).min()
    }
}

/// The set W the plan must withstand.
#[derive(Debug, Clone)]
pub(crate) enum DisturbanceModel {
    None,
    /// Half widths, scaled.
    Box(DVector<f64>),
    /// Generators, one a column, scaled.
    Zonotope(DMatrix<f64>),
    /// Made from errors of thrusters and navigation: no law of its own in state space.
    FromErrors,
}

impl Model {
    /// Reads a problem; all faults are returned together.
    pub(crate) fn new(problem: &v1::Problem) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let Some(inner) = variable_horizon(problem) else {
            return Err(vec!["problem.variable_horizon: required".into()]);
        };
        let steps = inner.steps_max.unwrap_or(STEPS_MAX_DEFAULT);
        if !(1..=STEPS_MAX).contains(&steps) {
            faults.push(format!("problem.variable_horizon.steps_max: 1 to {STEPS_MAX}"));
        }
        let kind = match &inner.plant {
            Some(v1::variable_horizon_problem::Plant::Hill(hill)) => {
                let hold = steps.clamp(1, STEPS_MAX) as usize + 1;
                hill_model(hill, hold, &mut faults)
            }
            Some(v1::variable_horizon_problem::Plant::Linear(linear)) => {
                linear_model(linear, &mut faults)
            }
            None => {
                faults.push("problem.variable_horizon.plant: required".into());
                None
            }
        };
        match kind {
            Some((kind, disturbance)) if faults.is_empty() => {
                let projection = match inner.terminal_point() {
                    v1::TerminalPoint::Projection => true,
                    v1::TerminalPoint::Reference => false,
                    v1::TerminalPoint::Unspecified => matches!(kind, Kind::Hill(_)),
                };
                Ok(Self {
                    kind,
                    disturbance,
                    steps_max: steps as usize,
                    constrained_at_arrival: projection,
                })
            }
            _ => Err(faults),
        }
    }

    /// Number of state components.
    pub(crate) fn states(&self) -> usize {
        match &self.kind {
            Kind::Hill(_) => 6,
            Kind::Linear(linear) => linear.plant.a.nrows(),
        }
    }
}

const HILL: &str = "problem.variable_horizon.hill";
const LINEAR: &str = "problem.variable_horizon.linear";

fn hill_model(
    hill: &v1::HillPlant,
    samples: usize,
    faults: &mut Vec<String>,
) -> Option<(Kind, DisturbanceModel)> {
    if hill.frame() != v1::Frame::Rtn {
        faults.push(format!("{HILL}.frame: the simulator reads missions in FRAME_RTN only"));
    }
    let eta = match hill.orbit {
        Some(hill_plant::Orbit::SemiMajorAxisM(a)) => (EARTH_MU_M3_S2 / a.powi(3)).sqrt(),
        Some(hill_plant::Orbit::MeanMotionDegS(n)) => n.to_radians(),
        None => f64::NAN,
    };
    let dt = match hill.sampling {
        Some(hill_plant::Sampling::SampleTimeS(t)) => t,
        Some(hill_plant::Sampling::SampleAngleDeg(angle)) => angle.to_radians() / eta,
        None => f64::NAN,
    };
    let positive = |place: &str, value: f64, faults: &mut Vec<String>| {
        if !(value.is_finite() && value > 0.0) {
            faults.push(format!("{HILL}.{place}: required, greater than 0"));
        }
    };
    positive("orbit", eta, faults);
    positive("sampling", dt, faults);
    let acceleration_max_m_s2 = hill.acceleration_max_m_s2.unwrap_or(f64::NAN);
    positive("acceleration_max_m_s2", acceleration_max_m_s2, faults);
    let sampled =
        matches!(hill.rotation, Some(v1::TargetRotation { motion: Some(Motion::Sampled(_)) }));
    let capture_m = match hill.capture_point_m.is_empty() && sampled {
        true => Vector3::zeros(),
        false => three(&format!("{HILL}.capture_point_m"), &hill.capture_point_m, faults),
    };
    let port_m = match &hill.cone {
        Some(cone) if !cone.docking_port_m.is_empty() => {
            three(&format!("{HILL}.cone.docking_port_m"), &cone.docking_port_m, faults)
        }
        _ => capture_m,
    };
    let cone = hill.cone.as_ref().map(|cone| docking_cone(cone, faults));
    let disturbance = disturbance_model(hill.disturbance.as_ref(), 6, HILL, faults);
    if !faults.is_empty() {
        return None;
    }
    let motion = body_motion(hill.rotation.as_ref(), eta, dt, samples, faults)?;
    let target = Target { motion, capture_m, port_m, sample_time_s: dt };
    let model = HillModel {
        mean_motion_rad_s: eta,
        sample_time_s: dt,
        acceleration_max_m_s2,
        target,
        cone,
    };
    let disturbance = scale_si_box(disturbance?, hill.disturbance.as_ref(), &model);
    Some((Kind::Hill(Box::new(model)), disturbance))
}

/// A box given in SI is scaled once the units are known.
fn scale_si_box(
    disturbance: DisturbanceModel,
    set: Option<&v1::DisturbanceSet>,
    model: &HillModel,
) -> DisturbanceModel {
    match (disturbance, set.and_then(|set| set.form.as_ref())) {
        (DisturbanceModel::Box(si), Some(Form::BoxSi(_))) => {
            DisturbanceModel::Box(DVector::from_fn(6, |row, _| {
                let (position, velocity) = (model.position_unit_m(), model.velocity_unit_m_s());
                si[row] / if row < 3 { position } else { velocity }
            }))
        }
        (other, _) => other,
    }
}

fn docking_cone(cone: &v1::DockingCone, faults: &mut Vec<String>) -> DockingCone {
    let half_angle_deg = cone.half_angle_deg.unwrap_or(f64::NAN);
    if !(half_angle_deg > 0.0 && half_angle_deg < 90.0) {
        faults.push(format!("{HILL}.cone.half_angle_deg: between 0 and 90, both excluded"));
    }
    let roll_deg = cone.face_roll_deg.unwrap_or(0.0);
    if !roll_deg.is_finite() {
        faults.push(format!("{HILL}.cone.face_roll_deg: must be finite"));
    }
    DockingCone {
        half_angle_rad: half_angle_deg.to_radians(),
        face_roll_rad: roll_deg.to_radians(),
    }
}

fn body_motion(
    rotation: Option<&v1::TargetRotation>,
    eta: f64,
    dt: f64,
    samples: usize,
    faults: &mut Vec<String>,
) -> Option<BodyMotion> {
    let place = format!("{HILL}.rotation");
    let motion = match rotation.and_then(|rotation| rotation.motion.as_ref()) {
        None => {
            faults.push(format!("{place}: required"));
            return None;
        }
        Some(Motion::Fixed(_)) => BodyMotion::Fixed,
        Some(Motion::Spin(spin)) => {
            let rate = three(&place, &spin.angular_velocity_deg_s, faults);
            BodyMotion::Spin(rate.map(f64::to_radians))
        }
        Some(Motion::TorqueFree(free)) => {
            let body = torque_free(free, eta, &place, faults);
            BodyMotion::Tabulated(body.map(|b| b.tabulate(dt, samples)).unwrap_or_default())
        }
        Some(Motion::Sampled(sampled)) => BodyMotion::Points(body_points(sampled, &place, faults)),
    };
    faults.is_empty().then_some(motion)
}

fn torque_free(
    free: &v1::TorqueFreeMotion,
    eta: f64,
    place: &str,
    faults: &mut Vec<String>,
) -> Option<TorqueFreeBody> {
    let inertia = three(place, &free.principal_inertia_kg_m2, faults);
    let rate = three(place, &free.angular_velocity_body_deg_s, faults);
    if inertia.min() <= 0.0 {
        faults.push(format!("{place}.principal_inertia_kg_m2: greater than 0"));
    }
    let rtn_from_body = match free.frame_from_body_quaternion.as_slice() {
        [w, x, y, z] => {
            let quaternion = Quaternion::new(*w, *x, *y, *z);
            if (quaternion.norm() - 1.0).abs() > 1e-6 {
                faults.push(format!("{place}.frame_from_body_quaternion: not of unit length"));
            }
            UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner()
        }
        _ => {
            faults.push(format!("{place}.frame_from_body_quaternion: four components"));
            Matrix3::identity()
        }
    };
    let frame_rate_rad_s = match free.relative_to() {
        v1::RateReference::Inertial => eta,
        v1::RateReference::Rtn => 0.0,
        v1::RateReference::Unspecified => {
            faults.push(format!("{place}.relative_to: required"));
            0.0
        }
    };
    let rate_body = rate.map(f64::to_radians);
    faults.is_empty().then_some(TorqueFreeBody {
        inertia,
        rtn_from_body,
        rate_body,
        frame_rate_rad_s,
    })
}

fn body_points(
    sampled: &v1::SampledMotion,
    place: &str,
    faults: &mut Vec<String>,
) -> Vec<BodyPoints> {
    let table = |field: &str, given: Option<&v1::Matrix>, faults: &mut Vec<String>| {
        let table = matrix(&format!("{place}.sampled.{field}"), given, faults);
        if table.ncols() != 3 {
            faults.push(format!("{place}.sampled.{field}: three columns"));
        }
        table
    };
    let capture = table("capture_points_m", sampled.capture_points_m.as_ref(), faults);
    let velocity = table("capture_velocities_m_s", sampled.capture_velocities_m_s.as_ref(), faults);
    let port = match &sampled.docking_ports_m {
        Some(given) => table("docking_ports_m", Some(given), faults),
        None => capture.clone(),
    };
    if velocity.nrows() != capture.nrows() || port.nrows() != capture.nrows() {
        faults.push(format!("{place}.sampled: all tables have the same number of rows"));
    }
    if !faults.is_empty() {
        return Vec::new();
    }
    let row = |table: &DMatrix<f64>, k: usize| Vector3::from_fn(|i, _| table[(k, i)]);
    (0..capture.nrows())
        .map(|k| BodyPoints {
            capture_m: row(&capture, k),
            capture_velocity_m_s: row(&velocity, k),
            port_m: row(&port, k),
        })
        .collect()
}

fn linear_model(
    linear: &v1::LinearPlant,
    faults: &mut Vec<String>,
) -> Option<(Kind, DisturbanceModel)> {
    let a = matrix(&format!("{LINEAR}.a"), linear.a.as_ref(), faults);
    let b = matrix(&format!("{LINEAR}.b"), linear.b.as_ref(), faults);
    let (n, m) = (a.nrows(), b.ncols());
    if a.ncols() != n || b.nrows() != n {
        faults.push(format!("{LINEAR}: a must be n x n and b n x m"));
    }
    let mut bounds = |field: &str, values: &[f64]| {
        if values.len() != m || values.iter().any(|value| !value.is_finite()) {
            faults.push(format!("{LINEAR}.{field}: {m} finite values"));
        }
        DVector::from_column_slice(values)
    };
    let input_lower = bounds("input_lower", &linear.input_lower);
    let input_upper = bounds("input_upper", &linear.input_upper);
    let input_set = half_spaces("input_set", linear.input_set.as_ref(), m, faults);
    let state_set = half_spaces("state_set", linear.state_set.as_ref(), n, faults);
    let reference =
        linear.reference.as_ref().map(|r| matrix(&format!("{LINEAR}.reference"), Some(r), faults));
    if reference.as_ref().is_some_and(|table| table.ncols() != n || table.nrows() == 0) {
        faults.push(format!("{LINEAR}.reference: {n} columns, at least one row"));
    }
    let disturbance = disturbance_model(linear.disturbance.as_ref(), n, LINEAR, faults);
    if !faults.is_empty() {
        return None;
    }
    let plant = LinearPlant { a, b };
    let model = LinearModel { plant, input_lower, input_upper, input_set, state_set, reference };
    Some((Kind::Linear(Box::new(model)), disturbance?))
}

fn half_spaces(
    field: &str,
    set: Option<&v1::PolytopeSet>,
    columns: usize,
    faults: &mut Vec<String>,
) -> Option<HalfSpaces> {
    let set = set?;
    let normals = matrix(&format!("{LINEAR}.{field}.normals"), set.normals.as_ref(), faults);
    if normals.ncols() != columns || normals.nrows() != set.offsets.len() {
        faults.push(format!("{LINEAR}.{field}: {columns} columns, one offset a row"));
    }
    Some(HalfSpaces { normals, offsets: DVector::from_column_slice(&set.offsets) })
}

fn disturbance_model(
    set: Option<&v1::DisturbanceSet>,
    states: usize,
    plant: &str,
    faults: &mut Vec<String>,
) -> Option<DisturbanceModel> {
    let place = format!("{plant}.disturbance");
    let mut half_widths = |values: Vec<f64>| {
        if values.len() != states || values.iter().any(|v| !v.is_finite() || *v < 0.0) {
            faults.push(format!("{place}: {states} half widths, each >= 0"));
        }
        DisturbanceModel::Box(DVector::from_vec(values))
    };
    match set.and_then(|set| set.form.as_ref()) {
        None => {
            faults.push(format!("{place}: required"));
            None
        }
        Some(Form::None(_)) => Some(DisturbanceModel::None),
        Some(Form::Box(given)) => Some(half_widths(given.half_width_nd.clone())),
        Some(Form::BoxSi(given)) => {
            let (position, velocity) =
                (&given.position_half_width_m, &given.velocity_half_width_m_s);
            Some(half_widths([position.as_slice(), velocity.as_slice()].concat()))
        }
        Some(Form::GeneratorsNd(given)) => {
            let generators = matrix(&place, Some(given), faults);
            if generators.nrows() != states {
                faults.push(format!("{place}: generators of {states} rows"));
            }
            Some(DisturbanceModel::Zonotope(generators))
        }
        Some(Form::Misalignment(_) | Form::ActuationAndNavigation(_)) => {
            Some(DisturbanceModel::FromErrors)
        }
    }
}

/// A matrix from the wire; wrong sizes are reported and give an empty matrix.
pub(crate) fn matrix(
    place: &str,
    given: Option<&v1::Matrix>,
    faults: &mut Vec<String>,
) -> DMatrix<f64> {
    let Some(given) = given else {
        faults.push(format!("{place}: required"));
        return DMatrix::zeros(0, 0);
    };
    let (rows, columns) = (given.rows.max(0) as usize, given.columns.max(0) as usize);
    let finite = given.values.iter().all(|value| value.is_finite());
    if rows.checked_mul(columns) != Some(given.values.len()) || rows == 0 || !finite {
        faults.push(format!("{place}: {rows} x {columns} needs that many finite values"));
        return DMatrix::zeros(0, 0);
    }
    DMatrix::from_row_slice(rows, columns, &given.values)
}

pub(crate) fn three(place: &str, values: &[f64], faults: &mut Vec<String>) -> Vector3<f64> {
    match values {
        [x, y, z] if values.iter().all(|value| value.is_finite()) => Vector3::new(*x, *y, *z),
        _ => {
            faults.push(format!("{place}: three finite components"));
            Vector3::zeros()
        }
    }
}
