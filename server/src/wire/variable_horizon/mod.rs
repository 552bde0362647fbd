//! Variable horizon: `vbar/v1/variable_horizon.proto` and
//! `vbar_guidance::control::variable_horizon`.

mod answer;

use nalgebra::{
    DMatrix, DVector, Matrix3, Matrix6, Quaternion, Rotation3, UnitQuaternion, Vector3,
};
use vbar_guidance::{
    control::variable_horizon as method,
    mission::{
        ActuationAndNavigation, BodyMotion, DisturbanceSet, DockingCone, NavigationCovariance,
        RateReference, TargetMotion, TargetSample,
    },
    orbit::{EARTH_MU_M3_S2, EARTH_RADIUS_M},
    sets::Zonotope,
    units::{Acceleration, Angle, Mass, Seconds},
};
use vbar_proto::v1::{self, variable_horizon_problem::Plant as PlantMessage};

use super::{
    Door, Parse, Path,
    types::{
        Axes, Size, integer, list, matrix, not_negative, number, polytope, positive,
        symmetric_matrix, unknown_enum, vector, vector3,
    },
};

/// Steps of a mission that does not say how long it may take.
const STEPS_MAX_DEFAULT: usize = 1000;
/// State components and inputs of the Hill plant.
const HILL: (usize, usize) = (6, 3);
/// Rank of the Hill plant's input matrix: a pole can be placed that often.
const HILL_POLE_MULTIPLICITY_MAX: usize = 3;

impl Parse for method::Problem {
    type Message = v1::VariableHorizonProblem;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let schedule = schedule(message, path, door);
        let plant = match &message.plant {
            None => door.refuse(path, "one of hill, linear", "nothing"),
            Some(PlantMessage::Hill(hill)) => {
                hill_plant(hill, &schedule, path.field("hill"), door).map(method::Plant::Hill)
            }
            Some(PlantMessage::Linear(linear)) => {
                linear_plant(linear, path.field("linear"), door).map(method::Plant::Linear)
            }
        };
        let gain = gain(message, &plant, path.field("gain"), door);
        let scheme = scheme(message.scheme, path.field("scheme"), door);
        let weights = weights(message, path, door);
        let search = search(message.search, path.field("search"), door);
        let terminal = terminal(message, path, door);
        let (terminal_point, fallback) = terminal?;
        Some(Self {
            plant: plant?,
            scheme: scheme?,
            gain: gain?,
            weights: weights?,
            search: search?,
            horizon_max: schedule.horizon_max?,
            horizon_guess: schedule.horizon_guess?,
            terminal_point,
            fallback,
            steps_max: schedule.steps_max?,
            fixed_terminal_terms: schedule.fixed_terminal_terms?,
        })
    }
}

/// The counts of a problem; `None` where one is at fault.
#[allow(clippy::option_option, reason = "absent and wrong are different things here")]
struct Schedule {
    horizon_max: Option<usize>,
    horizon_guess: Option<Option<usize>>,
    steps_max: Option<usize>,
    fixed_terminal_terms: Option<Option<usize>>,
}

fn schedule(message: &v1::VariableHorizonProblem, path: Path<'_>, door: &mut Door) -> Schedule {
    let limits = door.limits;
    let horizon_max =
        integer(message.horizon_max, 1..=limits.horizon_max, path.field("horizon_max"), door);
    let mut optional = |value: Option<i32>, max: usize, name| match value {
        None => Some(None),
        Some(value) => integer(value, 1..=max, path.field(name), door).map(Some),
    };
    let guess_max = horizon_max.unwrap_or(limits.horizon_max);
    Schedule {
        horizon_max,
        horizon_guess: optional(message.horizon_guess, guess_max, "horizon_guess"),
        steps_max: optional(message.steps_max, limits.steps_max, "steps_max")
            .map(|given| given.unwrap_or(STEPS_MAX_DEFAULT.min(limits.steps_max))),
        fixed_terminal_terms: optional(
            message.fixed_terminal_terms,
            limits.steps_max,
            "fixed_terminal_terms",
        ),
    }
}

fn scheme(value: i32, path: Path<'_>, door: &mut Door) -> Option<method::Scheme> {
    use v1::VariableHorizonScheme as Message;
    const EXPECTED: &str = "VARIABLE_HORIZON_SCHEME_ADAPTIVE_TERMINAL, _FIXED_TERMINAL, \
                            _TUBE_OPTIMAL_CONTROL or _NOMINAL";
    match Message::try_from(value) {
        Ok(Message::AdaptiveTerminal) => Some(method::Scheme::AdaptiveTerminal),
        Ok(Message::FixedTerminal) => Some(method::Scheme::FixedTerminal),
        Ok(Message::TubeOptimalControl) => Some(method::Scheme::TubeOptimalControl),
        Ok(Message::Nominal) => Some(method::Scheme::Nominal),
        Ok(unspecified @ Message::Unspecified) => {
            door.refuse(path, EXPECTED, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn search(value: i32, path: Path<'_>, door: &mut Door) -> Option<method::HorizonSearch> {
    use v1::HorizonSearch as Message;
    const EXPECTED: &str = "HORIZON_SEARCH_LOCAL or HORIZON_SEARCH_ENUMERATION";
    match Message::try_from(value) {
        Ok(Message::Local) => Some(method::HorizonSearch::Local),
        Ok(Message::Enumeration) => Some(method::HorizonSearch::Enumeration),
        Ok(unspecified @ Message::Unspecified) => {
            door.refuse(path, EXPECTED, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(value, EXPECTED, path, door),
    }
}

fn weights(
    message: &v1::VariableHorizonProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<method::Weights> {
    use v1::CostNorm as Norm;
    const EXPECTED: &str = "COST_NORM_ONE (or unspecified, which means it)";
    let place = path.field("fuel_weight");
    let fuel = door
        .required(&message.fuel_weight, place)
        .and_then(|&weight| not_negative(weight, place, door));
    let tracking =
        not_negative(message.tracking_weight.unwrap_or(0.0), path.field("tracking_weight"), door);
    let place = path.field("norm");
    let norm = match Norm::try_from(message.norm) {
        Ok(Norm::Unspecified | Norm::One) => Some(()),
        Ok(other @ (Norm::Two | Norm::Infinity)) => {
            door.refuse(place, EXPECTED, format!("{}, not offered yet", other.as_str_name()))
        }
        Err(_) => unknown_enum(message.norm, EXPECTED, place, door),
    };
    norm?;
    Some(method::Weights { fuel: fuel?, tracking: tracking? })
}

/// Terminal point and fallback, with the defaults of the two papers.
fn terminal(
    message: &v1::VariableHorizonProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(method::TerminalPoint, method::TerminalFallback)> {
    use v1::{TerminalFallback as FallbackMessage, TerminalPoint as PointMessage};
    let place = path.field("terminal_point");
    let expected = "TERMINAL_POINT_PROJECTION, TERMINAL_POINT_REFERENCE or unspecified";
    let point = match PointMessage::try_from(message.terminal_point) {
        Ok(PointMessage::Projection) => Some(method::TerminalPoint::Projection),
        Ok(PointMessage::Reference) => Some(method::TerminalPoint::Reference),
        Ok(PointMessage::Unspecified) => Some(match &message.plant {
            Some(PlantMessage::Linear(_)) => method::TerminalPoint::Reference,
            Some(PlantMessage::Hill(_)) | None => method::TerminalPoint::Projection,
        }),
        Err(_) => unknown_enum(message.terminal_point, expected, place, door),
    };
    let place = path.field("fallback");
    let expected =
        "TERMINAL_FALLBACK_PREVIOUS_HORIZON, TERMINAL_FALLBACK_FREE_HORIZON or unspecified";
    let fallback = match FallbackMessage::try_from(message.fallback) {
        Ok(FallbackMessage::PreviousHorizon) => Some(method::TerminalFallback::PreviousHorizon),
        Ok(FallbackMessage::FreeHorizon) => Some(method::TerminalFallback::FreeHorizon),
        Ok(FallbackMessage::Unspecified) => point.map(|point| match point {
            method::TerminalPoint::Projection => method::TerminalFallback::PreviousHorizon,
            method::TerminalPoint::Reference => method::TerminalFallback::FreeHorizon,
        }),
        Err(_) => unknown_enum(message.fallback, expected, place, door),
    };
    Some((point?, fallback?))
}

fn gain(
    message: &v1::VariableHorizonProblem,
    plant: &Option<method::Plant>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<method::GainChoice> {
    use v1::gain::Form;
    let form = &door.required(&message.gain, path)?.form;
    let Some(form) = form else {
        return door.refuse(path, "one of explicit, poles, lqr", "nothing");
    };
    // A plant at fault still says which kind it is; sizes of a general one are then unknown.
    let (n, m) = match (&message.plant, plant) {
        (Some(PlantMessage::Hill(_)), _) => HILL,
        (_, Some(method::Plant::Linear(linear))) => (linear.b.nrows(), linear.b.ncols()),
        _ => return None,
    };
    match form {
        Form::Explicit(k) => {
            let shape = (Size::Exactly(m), Size::Exactly(n));
            matrix(k, shape, path.field("explicit"), door).map(method::GainChoice::Explicit)
        }
        Form::Poles(poles) => {
            let path = path.field("poles");
            let hill = matches!(message.plant, Some(PlantMessage::Hill(_)));
            let multiplicity_max = if hill { HILL_POLE_MULTIPLICITY_MAX } else { n };
            pole_list(&poles.values, n, multiplicity_max, path.field("values"), door)
                .map(method::GainChoice::Poles)
        }
        Form::Lqr(weights) => {
            let path = path.field("lqr");
            let state = symmetric_matrix(&weights.state, n, path.field("state"), door);
            let input = symmetric_matrix(&weights.input, m, path.field("input"), door);
            Some(method::GainChoice::Lqr { state: state?, input: input? })
        }
    }
}

fn pole_list(
    values: &[f64],
    n: usize,
    multiplicity_max: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<f64>> {
    let values = list(values, Size::Exactly(n), path, door)?;
    let mut good = true;
    for (i, &pole) in values.iter().enumerate() {
        let inside = "a real pole inside the unit circle";
        good &= number(pole, |p| p.abs() < 1.0, inside, path.index(i), door).is_some();
        let times = values.iter().filter(|&&other| other == pole).count();
        // Said once, at the first of the equal ones.
        if times > multiplicity_max && values[..i].iter().all(|&other| other != pole) {
            let expected = format!("no pole more than {multiplicity_max} times (the rank of B)");
            good = false;
            let _: Option<()> = door.refuse(path, expected, format!("{pole} {times} times"));
        }
    }
    good.then(|| values.to_vec())
}

fn hill_plant(
    message: &v1::HillPlant,
    schedule: &Schedule,
    path: Path<'_>,
    door: &mut Door,
) -> Option<method::HillPlant> {
    let axes = Axes::parse(&message.frame, path.field("frame"), door);
    let mean_motion_rad_s = mean_motion(message, path, door);
    let sample_angle = sample_angle(message, mean_motion_rad_s, path, door);
    let place = path.field("acceleration_max_m_s2");
    let acceleration_max = door
        .required(&message.acceleration_max_m_s2, place)
        .and_then(|&value| positive(value, place, door));
    let mass = match message.mass_kg {
        None => Some(None),
        Some(mass) => positive(mass, path.field("mass_kg"), door).map(Some),
    };
    let cone = match &message.cone {
        None => Some(None),
        Some(cone) => docking_cone(cone, path.field("cone"), door).map(Some),
    };
    // Faults of vectors are found whether or not the frame was given.
    let known_axes = axes.unwrap_or(Axes::Rtn);
    let target = target_motion(message, known_axes, schedule, path, door);
    let place = path.field("disturbance");
    let disturbance = door
        .required(&message.disturbance, place)
        .and_then(|set| hill_disturbance(set, known_axes, place, door));
    axes?;
    Some(method::HillPlant {
        mean_motion_rad_s: mean_motion_rad_s?,
        sample_angle: sample_angle?,
        acceleration_max: Acceleration::from_m_s2(acceleration_max?),
        mass: mass?.map(Mass::from_kilograms),
        cone: cone?,
        target: target?,
        disturbance: disturbance?,
    })
}

fn mean_motion(message: &v1::HillPlant, path: Path<'_>, door: &mut Door) -> Option<f64> {
    use v1::hill_plant::Orbit;
    match message.orbit {
        None => door.refuse(path, "one of semi_major_axis_m, mean_motion_deg_s", "nothing"),
        Some(Orbit::SemiMajorAxisM(radius)) => {
            let expected = "a finite radius above the Earth's, 6378137 m";
            let place = path.field("semi_major_axis_m");
            let radius = number(radius, |r| r > EARTH_RADIUS_M, expected, place, door)?;
            Some((EARTH_MU_M3_S2 / (radius * radius * radius)).sqrt())
        }
        Some(Orbit::MeanMotionDegS(rate)) => {
            let rate = positive(rate, path.field("mean_motion_deg_s"), door)?;
            Some(Angle::from_degrees(rate).radians())
        }
    }
}

fn sample_angle(
    message: &v1::HillPlant,
    mean_motion_rad_s: Option<f64>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Angle> {
    use v1::hill_plant::Sampling;
    // At half a revolution the cross-track motion can no longer be steered by held thrust.
    const EXPECTED: &str = "more than 0 and less than half a revolution";
    let fits = |radians: f64| radians > 0.0 && radians < std::f64::consts::PI;
    match message.sampling {
        None => door.refuse(path, "one of sample_time_s, sample_angle_deg", "nothing"),
        Some(Sampling::SampleTimeS(seconds)) => {
            let place = path.field("sample_time_s");
            let eta = mean_motion_rad_s?;
            let seconds = number(seconds, |s| fits(s * eta), EXPECTED, place, door)?;
            Some(Angle::from_radians(seconds * eta))
        }
        Some(Sampling::SampleAngleDeg(degrees)) => {
            let place = path.field("sample_angle_deg");
            let in_radians = |d: f64| Angle::from_degrees(d).radians();
            let degrees = number(degrees, |d| fits(in_radians(d)), EXPECTED, place, door)?;
            Some(Angle::from_degrees(degrees))
        }
    }
}

fn docking_cone(message: &v1::DockingCone, path: Path<'_>, door: &mut Door) -> Option<DockingCone> {
    let place = path.field("half_angle_deg");
    let expected = "a finite number between 0 and 90, both excluded";
    let half_angle = door
        .required(&message.half_angle_deg, place)
        .and_then(|&d| number(d, |d| d > 0.0 && d < 90.0, expected, place, door));
    let roll = message.face_roll_deg.unwrap_or(0.0);
    let expected = "a finite number from -360 to 360";
    let place = path.field("face_roll_deg");
    let face_roll = number(roll, |d| d.abs() <= 360.0, expected, place, door);
    Some(DockingCone {
        half_angle: Angle::from_degrees(half_angle?),
        face_roll: Angle::from_degrees(face_roll?),
    })
}

fn target_motion(
    message: &v1::HillPlant,
    axes: Axes,
    schedule: &Schedule,
    path: Path<'_>,
    door: &mut Door,
) -> Option<TargetMotion> {
    use v1::target_rotation::Motion;
    let place = path.field("rotation");
    let rotation = door.required(&message.rotation, place);
    let body = match rotation.map(|r| &r.motion) {
        None => None,
        Some(None) => door.refuse(place, "one of fixed, spin, torque_free, sampled", "nothing"),
        Some(Some(Motion::Sampled(samples))) => {
            return sampled_motion(message, samples, axes, schedule, path, door);
        }
        Some(Some(Motion::Fixed(v1::FixedAttitude {}))) => Some(BodyMotion::Fixed),
        Some(Some(Motion::Spin(spin))) => {
            let place = place.field("spin");
            let place = place.field("angular_velocity_deg_s");
            vector3(&spin.angular_velocity_deg_s, place, door)
                .map(|rate| BodyMotion::Spin(axes.to_rtn(in_radians(rate))))
        }
        Some(Some(Motion::TorqueFree(free))) => {
            torque_free(free, axes, place.field("torque_free"), door)
        }
    };
    let capture = vector3(&message.capture_point_m, path.field("capture_point_m"), door)
        .map(|point| axes.to_rtn(point));
    let port = docking_port(message, axes, capture, path, door);
    Some(TargetMotion::Rigid { capture_point_m: capture?, docking_port_m: port?, body: body? })
}

/// The port of the cone: its own, or the capture point; never at the centre of mass, from where
/// the cone's axis would have no direction.
fn docking_port(
    message: &v1::HillPlant,
    axes: Axes,
    capture: Option<Vector3<f64>>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vector3<f64>> {
    let Some(cone) = &message.cone else { return capture };
    let cone_path = path.field("cone");
    let (port, place) = if cone.docking_port_m.is_empty() {
        (capture?, path.field("capture_point_m"))
    } else {
        let place = cone_path.field("docking_port_m");
        (axes.to_rtn(vector3(&cone.docking_port_m, place, door)?), place)
    };
    off_centre(port, place, door)
}

fn off_centre(port: Vector3<f64>, path: Path<'_>, door: &mut Door) -> Option<Vector3<f64>> {
    if port.norm() < 1e-9 {
        let expected = "a docking port away from the target's centre of mass";
        return door.refuse(path, expected, "the origin");
    }
    Some(port)
}

fn in_radians(degrees: Vector3<f64>) -> Vector3<f64> {
    degrees.map(|d| Angle::from_degrees(d).radians())
}

fn torque_free(
    message: &v1::TorqueFreeMotion,
    axes: Axes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<BodyMotion> {
    let inertia = inertia(&message.principal_inertia_kg_m2, path, door);
    let place = path.field("frame_from_body_quaternion");
    let attitude = list(&message.frame_from_body_quaternion, Size::Exactly(4), place, door)
        .and_then(|q| unit_quaternion(q, place, door));
    let place = path.field("angular_velocity_body_deg_s");
    let rate = vector3(&message.angular_velocity_body_deg_s, place, door);
    let place = path.field("relative_to");
    let expected = "RATE_REFERENCE_INERTIAL or RATE_REFERENCE_RTN";
    let relative_to = match v1::RateReference::try_from(message.relative_to) {
        Ok(v1::RateReference::Inertial) => Some(RateReference::Inertial),
        Ok(v1::RateReference::Rtn) => Some(RateReference::Rtn),
        Ok(unspecified @ v1::RateReference::Unspecified) => {
            door.refuse(place, expected, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(message.relative_to, expected, place, door),
    };
    Some(BodyMotion::TorqueFree {
        inertia: inertia?,
        rtn_from_body: rtn_from(axes) * attitude?,
        rate_body_rad_s: in_radians(rate?),
        relative_to: relative_to?,
    })
}

/// Positive, and no moment above the sum of the others: no body has such moments.
fn inertia(values: &[f64], path: Path<'_>, door: &mut Door) -> Option<Vector3<f64>> {
    let place = path.field("principal_inertia_kg_m2");
    let moments = vector3(values, place, door)?;
    let mut good = true;
    for i in 0..3 {
        good &= positive(moments[i], place.index(i), door).is_some();
    }
    if good && moments.max() > (moments.sum() - moments.max()) * (1.0 + 1e-9) {
        let expected = "no moment greater than the sum of the other two";
        return door.refuse(place, expected, format!("{values:?}"));
    }
    good.then_some(moments)
}

fn unit_quaternion(q: &[f64], path: Path<'_>, door: &mut Door) -> Option<UnitQuaternion<f64>> {
    let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > 1e-9 {
        return door.refuse(path, "a quaternion of norm 1 within 1e-9", format!("norm {norm}"));
    }
    Some(UnitQuaternion::new_normalize(quaternion))
}

fn rtn_from(axes: Axes) -> UnitQuaternion<f64> {
    let columns = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| axes.to_rtn(axis));
    let matrix = Matrix3::from_columns(&columns);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
}

fn sampled_motion(
    plant: &v1::HillPlant,
    message: &v1::SampledMotion,
    axes: Axes,
    schedule: &Schedule,
    path: Path<'_>,
    door: &mut Door,
) -> Option<TargetMotion> {
    const EXPECTED: &str = "nothing: the samples say it";
    if !plant.capture_point_m.is_empty() {
        let _: Option<()> = door.refuse(path.field("capture_point_m"), EXPECTED, "a vector");
    }
    let cone_path = path.field("cone");
    if plant.cone.as_ref().is_some_and(|cone| !cone.docking_port_m.is_empty()) {
        let place = cone_path.field("docking_port_m");
        let _: Option<()> = door.refuse(place, EXPECTED, "a vector");
    }
    let rotation = path.field("rotation");
    let path = rotation.field("sampled");
    let most = door.limits.steps_max + door.limits.horizon_max + 1;
    let shape = (Size::UpTo(most), Size::Exactly(3));
    let mut table = |message: &Option<v1::Matrix>, name| {
        let path = path.field(name);
        let message = door.required(message, path)?;
        matrix(message, shape, path, door)
    };
    let captures = table(&message.capture_points_m, "capture_points_m");
    let velocities = table(&message.capture_velocities_m_s, "capture_velocities_m_s");
    let ports = match &message.docking_ports_m {
        None => captures.clone(),
        given => table(given, "docking_ports_m"),
    };
    let (captures, velocities, ports) = (captures?, velocities?, ports?);
    let least = schedule.steps_max? + schedule.horizon_max? + 1;
    if captures.nrows() < least {
        let expected = format!("at least steps_max + horizon_max + 1 = {least} samples");
        return door.refuse(path.field("capture_points_m"), expected, captures.nrows());
    }
    for (table, name) in [(&velocities, "capture_velocities_m_s"), (&ports, "docking_ports_m")] {
        if table.nrows() != captures.nrows() {
            let expected = format!("as many samples as capture points, {}", captures.nrows());
            return door.refuse(path.field(name), expected, table.nrows());
        }
    }
    let row = |table: &DMatrix<f64>, i| {
        axes.to_rtn(Vector3::new(table[(i, 0)], table[(i, 1)], table[(i, 2)]))
    };
    let name =
        if message.docking_ports_m.is_some() { "docking_ports_m" } else { "capture_points_m" };
    let place = path.field(name);
    let mut samples = Vec::with_capacity(captures.nrows());
    for i in 0..captures.nrows() {
        let port = row(&ports, i);
        if plant.cone.is_some() {
            off_centre(port, place.index(i), door)?;
        }
        samples.push(TargetSample {
            capture_point_m: row(&captures, i),
            capture_velocity_m_s: row(&velocities, i),
            docking_port_m: port,
        });
    }
    Some(TargetMotion::Sampled(samples))
}

fn hill_disturbance(
    message: &v1::DisturbanceSet,
    axes: Axes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DisturbanceSet> {
    use v1::disturbance_set::Form;
    match &message.form {
        None => door.refuse(
            path,
            "one of none, box, box_si, generators_nd, misalignment, actuation_and_navigation",
            "nothing (write none for W = {0})",
        ),
        Some(Form::None(v1::NoDisturbance {})) => Some(DisturbanceSet::None),
        Some(Form::Box(given)) => {
            let place = path.field("box");
            let half = half_widths(&given.half_width_nd, 6, place.field("half_width_nd"), door)?;
            let turned =
                |i: usize| axes.box_to_rtn(Vector3::new(half[i], half[i + 1], half[i + 2]));
            let (position, velocity) = (turned(0), turned(3));
            Some(DisturbanceSet::Box(position.iter().chain(velocity.iter()).copied().collect()))
        }
        Some(Form::BoxSi(given)) => {
            let place = path.field("box_si");
            let position = half_widths(
                &given.position_half_width_m,
                3,
                place.field("position_half_width_m"),
                door,
            );
            let velocity = half_widths(
                &given.velocity_half_width_m_s,
                3,
                place.field("velocity_half_width_m_s"),
                door,
            );
            Some(DisturbanceSet::BoxSi {
                position_m: axes.box_to_rtn(Vector3::from_column_slice(position?)),
                velocity_m_s: axes.box_to_rtn(Vector3::from_column_slice(velocity?)),
            })
        }
        Some(Form::GeneratorsNd(given)) => {
            let shape = (Size::Exactly(6), Size::UpTo(door.limits.generators_max));
            let mut generators = matrix(given, shape, path.field("generators_nd"), door)?;
            for mut column in generators.column_iter_mut() {
                for i in [0, 3] {
                    let part = Vector3::new(column[i], column[i + 1], column[i + 2]);
                    column.fixed_rows_mut::<3>(i).copy_from(&axes.to_rtn(part));
                }
            }
            Some(DisturbanceSet::Generators(generators))
        }
        Some(Form::Misalignment(given)) => {
            let place = path.field("misalignment");
            let place = place.field("angle_max_deg");
            let &angle = door.required(&given.angle_max_deg, place)?;
            let expected = "a finite number from 0 to less than 90";
            let angle = number(angle, |d| (0.0..90.0).contains(&d), expected, place, door)?;
            Some(DisturbanceSet::Misalignment(Angle::from_degrees(angle)))
        }
        Some(Form::ActuationAndNavigation(given)) => {
            actuation_and_navigation(given, axes, path.field("actuation_and_navigation"), door)
                .map(DisturbanceSet::ActuationAndNavigation)
        }
    }
}

fn actuation_and_navigation(
    message: &v1::ActuationAndNavigation,
    axes: Axes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<ActuationAndNavigation> {
    if *message == v1::ActuationAndNavigation::default() {
        let expected = "at least one of navigation, thrust_magnitude_error_fraction, \
                        pointing_error_max_deg";
        return door.refuse(path, expected, "nothing (write none for W = {0})");
    }
    let navigation = match &message.navigation {
        None => Some(None),
        Some(given) => navigation_covariance(given, axes, path.field("navigation"), door).map(Some),
    };
    let fraction = message.thrust_magnitude_error_fraction.unwrap_or(0.0);
    let place = path.field("thrust_magnitude_error_fraction");
    let expected = "a finite number from 0 to 1";
    let fraction = number(fraction, |f| (0.0..=1.0).contains(&f), expected, place, door);
    let angle = message.pointing_error_max_deg.unwrap_or(0.0);
    let place = path.field("pointing_error_max_deg");
    let expected = "a finite number from 0 to less than 90";
    let angle = number(angle, |d| (0.0..90.0).contains(&d), expected, place, door);
    Some(ActuationAndNavigation {
        navigation: navigation?.map(Box::new),
        thrust_magnitude_error: fraction?,
        pointing_error_max: Angle::from_degrees(angle?),
    })
}

fn navigation_covariance(
    message: &v1::NavigationCovariance,
    axes: Axes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<NavigationCovariance> {
    let place = path.field("covariance");
    let covariance = door.required(&message.covariance, place).and_then(|given| {
        let size = Size::Exactly(HILL.0);
        matrix(given, (size, size), place, door)
    });
    let level_place = path.field("sigma_level");
    let level = door
        .required(&message.sigma_level, level_place)
        .and_then(|&level| positive(level, level_place, door));
    // A covariance at fault is said whether or not the level is right; any level does for that.
    let covariance = turned_covariance(&covariance?, axes);
    match NavigationCovariance::new(covariance, level.unwrap_or(1.0)) {
        Ok(navigation) => level.map(|_| navigation),
        Err(fault) => door.refuse(place, "a symmetric positive semidefinite matrix", fault),
    }
}

/// T P T' for the rotation T of positions and velocities to RTN.
fn turned_covariance(covariance: &DMatrix<f64>, axes: Axes) -> Matrix6<f64> {
    let turned = |matrix: Matrix6<f64>| {
        let mut turned = matrix;
        for mut column in turned.column_iter_mut() {
            for i in [0, 3] {
                let part = Vector3::new(column[i], column[i + 1], column[i + 2]);
                column.fixed_rows_mut::<3>(i).copy_from(&axes.to_rtn(part));
            }
        }
        turned
    };
    let given = Matrix6::from_fn(|i, j| covariance[(i, j)]);
    turned(turned(given).transpose())
}

fn half_widths<'m>(
    values: &'m [f64],
    size: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<&'m [f64]> {
    let values = list(values, Size::Exactly(size), path, door)?;
    let mut good = true;
    for (i, &value) in values.iter().enumerate() {
        good &= not_negative(value, path.index(i), door).is_some();
    }
    good.then_some(values)
}

fn linear_plant(
    message: &v1::LinearPlant,
    path: Path<'_>,
    door: &mut Door,
) -> Option<method::LinearPlant> {
    let place = path.field("a");
    let states_max = Size::UpTo(door.limits.states_max);
    let a = door
        .required(&message.a, place)
        .and_then(|a| matrix(a, (states_max, states_max), place, door))
        .and_then(|a| match a.is_square() {
            true => Some(a),
            false => {
                let got = format!("{} x {}", a.nrows(), a.ncols());
                door.refuse(place, "a square matrix", got)
            }
        });
    // Every other size follows from A.
    let a = a?;
    let n = a.nrows();
    let place = path.field("b");
    let shape = (Size::Exactly(n), Size::UpTo(door.limits.inputs_max));
    let b = door.required(&message.b, place).and_then(|b| matrix(b, shape, place, door));
    let disturbance_path = path.field("disturbance");
    let disturbance = door
        .required(&message.disturbance, disturbance_path)
        .and_then(|set| linear_disturbance(set, n, disturbance_path, door));
    let state_set = match &message.state_set {
        None => Some(None),
        Some(set) => polytope(set, n, path.field("state_set"), door).map(Some),
    };
    let reference = reference(message, n, path.field("reference"), door);
    let sample_time = match message.sample_time_s {
        None => Some(None),
        Some(seconds) => positive(seconds, path.field("sample_time_s"), door).map(Some),
    };
    let b = b?;
    let m = b.ncols();
    let bounds = input_bounds(message, m, path, door);
    let input_set = match &message.input_set {
        None => Some(None),
        Some(set) => polytope(set, m, path.field("input_set"), door).map(Some),
    };
    let (input_lower, input_upper) = bounds?;
    Some(method::LinearPlant {
        a,
        b,
        input_lower,
        input_upper,
        input_set: input_set?,
        state_set: state_set?,
        disturbance: disturbance?,
        reference: reference?,
        sample_time: sample_time?.map(Seconds::from_seconds),
    })
}

fn input_bounds(
    message: &v1::LinearPlant,
    m: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(DVector<f64>, DVector<f64>)> {
    let size = Size::Exactly(m);
    let lower = vector(&message.input_lower, size, path.field("input_lower"), door);
    let upper = vector(&message.input_upper, size, path.field("input_upper"), door);
    let (lower, upper) = (lower?, upper?);
    let place = path.field("input_upper");
    let mut good = true;
    for i in 0..m {
        if lower[i] > upper[i] {
            let expected = format!("at least input_lower[{i}] = {}", lower[i]);
            good = false;
            let _: Option<()> = door.refuse(place.index(i), expected, upper[i]);
        }
    }
    good.then_some((lower, upper))
}

/// Absent: the origin.
fn reference(
    message: &v1::LinearPlant,
    n: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<DVector<f64>>> {
    let Some(given) = &message.reference else { return Some(vec![DVector::zeros(n)]) };
    let most = door.limits.steps_max + door.limits.horizon_max + 1;
    let table = matrix(given, (Size::UpTo(most), Size::Exactly(n)), path, door)?;
    Some(table.row_iter().map(|row| row.transpose()).collect())
}

fn linear_disturbance(
    message: &v1::DisturbanceSet,
    n: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Zonotope> {
    use v1::disturbance_set::Form;
    const EXPECTED: &str = "one of none, box, generators_nd (this plant is not a spacecraft)";
    match &message.form {
        None => door.refuse(path, EXPECTED, "nothing (write none for W = {0})"),
        Some(Form::None(v1::NoDisturbance {})) => Some(Zonotope::centred(DMatrix::zeros(n, 0))),
        Some(Form::Box(given)) => {
            let place = path.field("box");
            let half = half_widths(&given.half_width_nd, n, place.field("half_width_nd"), door)?;
            Some(Zonotope::centred(DMatrix::from_diagonal(&DVector::from_column_slice(half))))
        }
        Some(Form::GeneratorsNd(given)) => {
            let shape = (Size::Exactly(n), Size::UpTo(door.limits.generators_max));
            matrix(given, shape, path.field("generators_nd"), door).map(Zonotope::centred)
        }
        Some(Form::BoxSi(_)) => door.refuse(path, EXPECTED, "box_si"),
        Some(Form::Misalignment(_)) => door.refuse(path, EXPECTED, "misalignment"),
        Some(Form::ActuationAndNavigation(_)) => {
            door.refuse(path, EXPECTED, "actuation_and_navigation")
        }
    }
}
