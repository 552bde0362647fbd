//! Uncertain plants of offline sampling and the laws of their chance.

use nalgebra::DMatrix;
use vbar_guidance::{
    control::offline_sampling::Coordinates,
    dynamics::{
        Discretisation, MatrixPolynomial, Monomial, PlantMatrices, PoseidynVariant, UncertainPlant,
        poseidyn, uncertain_hill,
    },
    sampling::ScalarLaw,
    units::Angle,
};
use vbar_proto::v1::{self, offline_sampling_problem::Plant as PlantMessage};

use crate::wire::{
    Door, Parse, Path,
    types::{Size, finite, integer, matrix, number, positive, unknown_enum},
};

/// Most parameters and most terms of a polynomial: as many as anyone writes down.
const PARAMETERS_MAX: usize = 64;
/// Highest power of a parameter.
const POWER_MAX: usize = 8;

/// Numbers of components of state, input and disturbance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sizes {
    pub(super) states: usize,
    pub(super) inputs: usize,
    pub(super) disturbances: usize,
}

/// Sizes of the plant; those of the presets are known even while one of their fields is at fault.
pub(super) fn sizes(
    message: &v1::OfflineSamplingProblem,
    plant: Option<&UncertainPlant>,
) -> Option<Sizes> {
    match (&message.plant, plant) {
        (Some(PlantMessage::Poseidyn(_)), _) => {
            Some(Sizes { states: 4, inputs: 2, disturbances: 4 })
        }
        (Some(PlantMessage::UncertainHill(_)), _) => {
            Some(Sizes { states: 6, inputs: 3, disturbances: 6 })
        }
        (_, Some(plant)) => Some(Sizes {
            states: plant.states(),
            inputs: plant.inputs(),
            disturbances: plant.disturbances(),
        }),
        (_, None) => None,
    }
}

/// The plant, and what its components are.
pub(super) fn plant(
    message: &v1::OfflineSamplingProblem,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(UncertainPlant, Coordinates)> {
    match &message.plant {
        None => door.refuse(path, "one of poseidyn, uncertain_hill, polynomial", "nothing"),
        Some(PlantMessage::Poseidyn(plant)) => {
            floating(plant, path.field("poseidyn"), door).map(|plant| (plant, Coordinates::Planar))
        }
        Some(PlantMessage::UncertainHill(plant)) => {
            hill(plant, path.field("uncertain_hill"), door).map(|plant| (plant, Coordinates::Rtn))
        }
        Some(PlantMessage::Polynomial(plant)) => polynomial(plant, path.field("polynomial"), door)
            .map(|plant| (plant, Coordinates::General)),
    }
}

fn floating(
    message: &v1::PoseidynPlant,
    path: Path<'_>,
    door: &mut Door,
) -> Option<UncertainPlant> {
    const EXPECTED: &str = "POSEIDYN_VARIANT_PRINTED or POSEIDYN_VARIANT_CLOHESSY_WILTSHIRE";
    const PARAMETERS: usize = 4;
    let place = path.field("variant");
    let variant = match v1::PoseidynVariant::try_from(message.variant) {
        Ok(v1::PoseidynVariant::Printed) => Some(PoseidynVariant::Printed),
        Ok(v1::PoseidynVariant::ClohessyWiltshire) => Some(PoseidynVariant::ClohessyWiltshire),
        Ok(unspecified @ v1::PoseidynVariant::Unspecified) => {
            door.refuse(place, EXPECTED, unspecified.as_str_name())
        }
        Err(_) => unknown_enum(message.variant, EXPECTED, place, door),
    };
    let mass = required_positive(message.mass_kg, path.field("mass_kg"), door);
    let time = required_positive(message.sample_time_s, path.field("sample_time_s"), door);
    let place = path.field("parameters");
    let parameters = match message.parameters.len() {
        0 => Some(None),
        PARAMETERS => laws(&message.parameters, place, door).map(Some),
        other => door.refuse(place, "4 laws, or none for those of the paper", other),
    };
    let mut plant = poseidyn(variant?, mass?, time?);
    if let Some(parameters) = parameters? {
        plant.parameters = parameters;
    }
    Some(plant)
}

fn hill(
    message: &v1::UncertainHillPlant,
    path: Path<'_>,
    door: &mut Door,
) -> Option<UncertainPlant> {
    let rate = bounds(&message.mean_motion_deg_s, path.field("mean_motion_deg_s"), door);
    let mass = bounds(&message.mass_kg, path.field("mass_kg"), door);
    let time = required_positive(message.sample_time_s, path.field("sample_time_s"), door);
    let radians = |degrees: f64| Angle::from_degrees(degrees).radians();
    let (least, greatest) = rate?;
    Some(uncertain_hill((radians(least), radians(greatest)), mass?, time?))
}

fn bounds(message: &Option<v1::Bounds>, path: Path<'_>, door: &mut Door) -> Option<(f64, f64)> {
    let message = door.required(message, path)?;
    let least = required_positive(message.least, path.field("least"), door);
    let place = path.field("greatest");
    let greatest = required_positive(message.greatest, place, door);
    let (least, greatest) = (least?, greatest?);
    if greatest < least {
        return door.refuse(place, format!("at least {least}"), greatest);
    }
    Some((least, greatest))
}

pub(super) fn required_positive(
    value: Option<f64>,
    path: Path<'_>,
    door: &mut Door,
) -> Option<f64> {
    let value = *door.required(&value, path)?;
    positive(value, path, door)
}

fn polynomial(
    message: &v1::PolynomialPlant,
    path: Path<'_>,
    door: &mut Door,
) -> Option<UncertainPlant> {
    let place = path.field("parameters");
    let parameters = match message.parameters.len() {
        0..=PARAMETERS_MAX => laws(&message.parameters, place, door),
        other => door.refuse(place, format!("at most {PARAMETERS_MAX} laws"), other),
    };
    let discretisation = discretisation(message, path, door);
    let count = message.parameters.len();
    let states = Size::UpTo(door.limits.states_max);
    let place = path.field("a");
    // Every other size follows from A.
    let a = matrix_polynomial(&message.a, (states, states), count, place, door)?;
    let (n, columns) = a.constant.shape();
    if n != columns {
        return door.refuse(place, "a square matrix", format!("{n} x {columns}"));
    }
    let rows = Size::Exactly(n);
    let inputs = Size::UpTo(door.limits.inputs_max);
    let b = matrix_polynomial(&message.b, (rows, inputs), count, path.field("b"), door);
    let b_w = match &message.b_w {
        None => Some(MatrixPolynomial::constant(DMatrix::identity(n, n))),
        some => matrix_polynomial(some, (rows, states), count, path.field("b_w"), door),
    };
    Some(UncertainPlant {
        a,
        b: b?,
        b_w: b_w?,
        parameters: parameters?,
        discretisation: discretisation?,
    })
}

fn discretisation(
    message: &v1::PolynomialPlant,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Discretisation> {
    use v1::Discretisation as Message;
    const EXPECTED: &str = "DISCRETISATION_NONE, _ZERO_ORDER_HOLD or _EULER";
    let place = path.field("discretisation");
    let asked = match Message::try_from(message.discretisation) {
        Ok(unspecified @ Message::Unspecified) => {
            door.refuse(place, EXPECTED, unspecified.as_str_name())
        }
        Ok(known) => Some(known),
        Err(_) => unknown_enum(message.discretisation, EXPECTED, place, door),
    }?;
    let place = path.field("sample_time_s");
    if asked == Message::None {
        return match message.sample_time_s {
            None => Some(Discretisation::None),
            Some(time) => door.refuse(place, "nothing with DISCRETISATION_NONE", time),
        };
    }
    let sample_time_s = required_positive(message.sample_time_s, place, door)?;
    Some(match asked {
        Message::Euler => Discretisation::Euler { sample_time_s },
        _ => Discretisation::ZeroOrderHold { sample_time_s },
    })
}

fn matrix_polynomial(
    message: &Option<v1::MatrixPolynomial>,
    shape: (Size, Size),
    parameters: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<MatrixPolynomial> {
    let message = door.required(message, path)?;
    let place = path.field("constant");
    let constant =
        door.required(&message.constant, place).and_then(|m| matrix(m, shape, place, door))?;
    let shape = (Size::Exactly(constant.nrows()), Size::Exactly(constant.ncols()));
    let place = path.field("terms");
    if message.terms.len() > PARAMETERS_MAX {
        return door.refuse(place, format!("at most {PARAMETERS_MAX} terms"), message.terms.len());
    }
    let terms: Vec<Option<Monomial>> = message
        .terms
        .iter()
        .enumerate()
        .map(|(i, term)| monomial(term, shape, parameters, place.index(i), door))
        .collect();
    Some(MatrixPolynomial { constant, terms: terms.into_iter().collect::<Option<_>>()? })
}

fn monomial(
    message: &v1::Monomial,
    shape: (Size, Size),
    parameters: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Monomial> {
    let place = path.field("powers");
    let powers: Option<Vec<u32>> = if message.powers.len() > parameters {
        let expected = format!("at most {parameters} powers, one a parameter");
        door.refuse(place, expected, message.powers.len())
    } else {
        let power =
            |(i, &power): (usize, &i32)| integer(power, 0..=POWER_MAX, place.index(i), door);
        let powers: Vec<Option<usize>> = message.powers.iter().enumerate().map(power).collect();
        powers.into_iter().map(|power| u32::try_from(power?).ok()).collect()
    };
    let place = path.field("matrix");
    let matrix = door.required(&message.matrix, place).and_then(|m| matrix(m, shape, place, door));
    Some(Monomial { powers: powers?, matrix: matrix? })
}

/// Laws of independent numbers, every fault of each.
pub(super) fn laws(
    messages: &[v1::ScalarLaw],
    path: Path<'_>,
    door: &mut Door,
) -> Option<Vec<ScalarLaw>> {
    let laws: Vec<Option<ScalarLaw>> = messages
        .iter()
        .enumerate()
        .map(|(i, law)| ScalarLaw::parse(law, path.index(i), door))
        .collect();
    laws.into_iter().collect()
}

impl Parse for ScalarLaw {
    type Message = v1::ScalarLaw;

    fn parse(message: &v1::ScalarLaw, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::scalar_law::Law;
        match &message.law {
            None => door.refuse(path, "one of constant, uniform, truncated_gaussian", "nothing"),
            Some(Law::Constant(value)) => {
                finite(*value, path.field("constant"), door).map(Self::Constant)
            }
            Some(Law::Uniform(law)) => {
                let path = path.field("uniform");
                let place = path.field("low");
                let low =
                    door.required(&law.low, place).and_then(|&low| finite(low, place, door))?;
                let place = path.field("high");
                let expected = format!("a finite number, at least {low}");
                let high = door
                    .required(&law.high, place)
                    .and_then(|&high| number(high, |high| high >= low, &expected, place, door))?;
                Some(Self::Uniform { low, high })
            }
            Some(Law::TruncatedGaussian(law)) => {
                let path = path.field("truncated_gaussian");
                let deviation = required_positive(law.deviation, path.field("deviation"), door);
                let bound = required_positive(law.bound, path.field("bound"), door);
                Some(Self::TruncatedGaussian { deviation: deviation?, bound: bound? })
            }
        }
    }
}

/// Vertices as given; none: the corners of the parameters' box, if there are not too many.
pub(super) fn vertices(
    message: &v1::OfflineSamplingProblem,
    plant: Option<&UncertainPlant>,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Option<Vec<PlantMatrices>>> {
    let most = door.limits.plant_vertices_max;
    if message.vertices.is_empty() {
        let varying = plant.map_or(0, |plant| {
            plant.parameters.iter().filter(|law| law.range().0 < law.range().1).count()
        });
        if 1_usize.checked_shl(varying as u32).is_none_or(|corners| corners > most) {
            let expected = format!("given vertices, at most {most}");
            return door.refuse(
                path,
                expected,
                format!("none, and {varying} uncertain parameters"),
            );
        }
        return Some(None);
    }
    if message.vertices.len() > most {
        return door.refuse(path, format!("at most {most} vertices"), message.vertices.len());
    }
    let vertices: Vec<Option<PlantMatrices>> = message
        .vertices
        .iter()
        .enumerate()
        .map(|(i, vertex)| plant_vertex(vertex, sizes, path.index(i), door))
        .collect();
    vertices.into_iter().collect::<Option<_>>().map(Some)
}

fn plant_vertex(
    message: &v1::PlantVertex,
    sizes: Sizes,
    path: Path<'_>,
    door: &mut Door,
) -> Option<PlantMatrices> {
    let n = sizes.states;
    let mut part = |part: &Option<v1::Matrix>, columns: usize, name| {
        let place = path.field(name);
        let shape = (Size::Exactly(n), Size::Exactly(columns));
        door.required(part, place).and_then(|part| matrix(part, shape, place, door))
    };
    let a = part(&message.a, n, "a");
    let b = part(&message.b, sizes.inputs, "b");
    let b_w = match &message.b_w {
        None if sizes.disturbances == n => Some(DMatrix::identity(n, n)),
        given => part(given, sizes.disturbances, "b_w"),
    };
    Some(PlantMatrices { a: a?, b: b?, b_w: b_w? })
}
