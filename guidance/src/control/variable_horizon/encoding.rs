//! Canonical bytes of a problem: equal problems, equal bytes; also how artifacts keep them.

use nalgebra::{Matrix6, Quaternion, UnitQuaternion};

use super::{
    GainChoice, HillPlant, HorizonSearch, LinearPlant, Plant, Problem, Scheme, TerminalFallback,
    TerminalPoint, Weights,
};
use crate::{
    bytes::{DecodeError, Reader, Writer},
    mission::{
        ActuationAndNavigation, BodyMotion, DisturbanceSet, DockingCone, NavigationCovariance,
        RateReference, TargetMotion, TargetSample,
    },
    sets::{Polytope, Zonotope},
    units::{Acceleration, Angle, Mass, Seconds},
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
    match &problem.plant {
        Plant::Hill(plant) => {
            writer.tag(1);
            write_hill(writer, plant);
        }
        Plant::Linear(plant) => {
            writer.tag(2);
            write_linear(writer, plant);
        }
    }
    writer.tag(match problem.scheme {
        Scheme::AdaptiveTerminal => 1,
        Scheme::FixedTerminal => 2,
        Scheme::TubeOptimalControl => 3,
        Scheme::Nominal => 4,
    });
    match &problem.gain {
        GainChoice::Explicit(gain) => {
            writer.tag(1);
            writer.matrix(gain);
        }
        GainChoice::Poles(poles) => {
            writer.tag(2);
            writer.numbers(poles);
        }
        GainChoice::Lqr { state, input } => {
            writer.tag(3);
            writer.matrix(state);
            writer.matrix(input);
        }
    }
    writer.number(problem.weights.fuel);
    writer.number(problem.weights.tracking);
    writer.tag(match problem.search {
        HorizonSearch::Local => 1,
        HorizonSearch::Enumeration => 2,
    });
    writer.count(problem.horizon_max);
    writer.option(problem.horizon_guess, Writer::count);
    writer.tag(match problem.terminal_point {
        TerminalPoint::Projection => 1,
        TerminalPoint::Reference => 2,
    });
    writer.tag(match problem.fallback {
        TerminalFallback::PreviousHorizon => 1,
        TerminalFallback::FreeHorizon => 2,
    });
    writer.count(problem.steps_max);
    writer.option(problem.fixed_terminal_terms, Writer::count);
}

pub(super) fn read_problem(reader: &mut Reader<'_>) -> Result<Problem, DecodeError> {
    let plant = match reader.tag()? {
        1 => Plant::Hill(read_hill(reader)?),
        2 => Plant::Linear(read_linear(reader)?),
        other => return Err(reader.unknown("plant", other)),
    };
    let scheme = match reader.tag()? {
        1 => Scheme::AdaptiveTerminal,
        2 => Scheme::FixedTerminal,
        3 => Scheme::TubeOptimalControl,
        4 => Scheme::Nominal,
        other => return Err(reader.unknown("scheme", other)),
    };
    let gain = match reader.tag()? {
        1 => GainChoice::Explicit(reader.matrix()?),
        2 => GainChoice::Poles(reader.numbers()?),
        3 => GainChoice::Lqr { state: reader.matrix()?, input: reader.matrix()? },
        other => return Err(reader.unknown("gain", other)),
    };
    let weights = Weights { fuel: reader.number()?, tracking: reader.number()? };
    let search = match reader.tag()? {
        1 => HorizonSearch::Local,
        2 => HorizonSearch::Enumeration,
        other => return Err(reader.unknown("search", other)),
    };
    let horizon_max = reader.count()?;
    let horizon_guess = reader.option(Reader::count)?;
    let terminal_point = match reader.tag()? {
        1 => TerminalPoint::Projection,
        2 => TerminalPoint::Reference,
        other => return Err(reader.unknown("terminal point", other)),
    };
    let fallback = match reader.tag()? {
        1 => TerminalFallback::PreviousHorizon,
        2 => TerminalFallback::FreeHorizon,
        other => return Err(reader.unknown("fallback", other)),
    };
    Ok(Problem {
        plant,
        scheme,
        gain,
        weights,
        search,
        horizon_max,
        horizon_guess,
        terminal_point,
        fallback,
        steps_max: reader.count()?,
        fixed_terminal_terms: reader.option(Reader::count)?,
    })
}

fn write_hill(writer: &mut Writer, plant: &HillPlant) {
    writer.number(plant.mean_motion_rad_s);
    writer.number(plant.sample_angle.radians());
    writer.number(plant.acceleration_max.m_s2());
    writer.option(plant.mass, |writer, mass| writer.number(mass.kilograms()));
    writer.option(plant.cone, |writer, cone| {
        writer.number(cone.half_angle.radians());
        writer.number(cone.face_roll.radians());
    });
    match &plant.target {
        TargetMotion::Rigid { capture_point_m, docking_port_m, body } => {
            writer.tag(1);
            writer.vector3(capture_point_m);
            writer.vector3(docking_port_m);
            write_body(writer, body);
        }
        TargetMotion::Sampled(samples) => {
            writer.tag(2);
            writer.count(samples.len());
            for sample in samples {
                writer.vector3(&sample.capture_point_m);
                writer.vector3(&sample.capture_velocity_m_s);
                writer.vector3(&sample.docking_port_m);
            }
        }
    }
    match &plant.disturbance {
        DisturbanceSet::None => writer.tag(1),
        DisturbanceSet::Box(half_widths) => {
            writer.tag(2);
            writer.numbers(half_widths);
        }
        DisturbanceSet::BoxSi { position_m, velocity_m_s } => {
            writer.tag(3);
            writer.vector3(position_m);
            writer.vector3(velocity_m_s);
        }
        DisturbanceSet::Generators(generators) => {
            writer.tag(4);
            writer.matrix(generators);
        }
        DisturbanceSet::Misalignment(angle) => {
            writer.tag(5);
            writer.number(angle.radians());
        }
        DisturbanceSet::ActuationAndNavigation(errors) => {
            writer.tag(6);
            writer.option(errors.navigation.as_deref(), |writer, navigation| {
                navigation.covariance().iter().for_each(|&entry| writer.number(entry));
                writer.number(navigation.sigma_level());
            });
            writer.number(errors.thrust_magnitude_error);
            writer.number(errors.pointing_error_max.radians());
        }
    }
}

fn read_hill(reader: &mut Reader<'_>) -> Result<HillPlant, DecodeError> {
    let mean_motion_rad_s = reader.number()?;
    let sample_angle = Angle::from_radians(reader.number()?);
    let acceleration_max = Acceleration::from_m_s2(reader.number()?);
    let mass = reader.option(|reader| reader.number().map(Mass::from_kilograms))?;
    let cone = reader.option(|reader| {
        Ok(DockingCone {
            half_angle: Angle::from_radians(reader.number()?),
            face_roll: Angle::from_radians(reader.number()?),
        })
    })?;
    let target = match reader.tag()? {
        1 => TargetMotion::Rigid {
            capture_point_m: reader.vector3()?,
            docking_port_m: reader.vector3()?,
            body: read_body(reader)?,
        },
        2 => {
            let count = reader.count()?;
            let sample = |reader: &mut Reader<'_>| -> Result<TargetSample, DecodeError> {
                Ok(TargetSample {
                    capture_point_m: reader.vector3()?,
                    capture_velocity_m_s: reader.vector3()?,
                    docking_port_m: reader.vector3()?,
                })
            };
            TargetMotion::Sampled((0..count).map(|_| sample(reader)).collect::<Result<_, _>>()?)
        }
        other => return Err(reader.unknown("target motion", other)),
    };
    let disturbance = match reader.tag()? {
        1 => DisturbanceSet::None,
        2 => DisturbanceSet::Box(reader.numbers()?),
        3 => {
            DisturbanceSet::BoxSi { position_m: reader.vector3()?, velocity_m_s: reader.vector3()? }
        }
        4 => DisturbanceSet::Generators(reader.matrix()?),
        5 => DisturbanceSet::Misalignment(Angle::from_radians(reader.number()?)),
        6 => DisturbanceSet::ActuationAndNavigation(ActuationAndNavigation {
            navigation: reader.option(read_covariance)?.map(Box::new),
            thrust_magnitude_error: reader.number()?,
            pointing_error_max: Angle::from_radians(reader.number()?),
        }),
        other => return Err(reader.unknown("disturbance set", other)),
    };
    Ok(HillPlant {
        mean_motion_rad_s,
        sample_angle,
        acceleration_max,
        mass,
        cone,
        target,
        disturbance,
    })
}

fn read_covariance(reader: &mut Reader<'_>) -> Result<NavigationCovariance, DecodeError> {
    let mut covariance = Matrix6::zeros();
    for entry in covariance.iter_mut() {
        *entry = reader.number()?;
    }
    let sigma_level = reader.number()?;
    NavigationCovariance::new(covariance, sigma_level)
        .map_err(|fault| reader.fault(fault.to_string()))
}

fn write_body(writer: &mut Writer, body: &BodyMotion) {
    match body {
        BodyMotion::Fixed => writer.tag(1),
        BodyMotion::Spin(rate) => {
            writer.tag(2);
            writer.vector3(rate);
        }
        BodyMotion::TorqueFree { inertia, rtn_from_body, rate_body_rad_s, relative_to } => {
            writer.tag(3);
            writer.vector3(inertia);
            let q = rtn_from_body.quaternion();
            [q.w, q.i, q.j, q.k].iter().for_each(|&x| writer.number(x));
            writer.vector3(rate_body_rad_s);
            writer.tag(match relative_to {
                RateReference::Inertial => 1,
                RateReference::Rtn => 2,
            });
        }
    }
}

fn read_body(reader: &mut Reader<'_>) -> Result<BodyMotion, DecodeError> {
    Ok(match reader.tag()? {
        1 => BodyMotion::Fixed,
        2 => BodyMotion::Spin(reader.vector3()?),
        3 => BodyMotion::TorqueFree {
            inertia: reader.vector3()?,
            // Already of unit length; normalising again would change the last bit.
            rtn_from_body: UnitQuaternion::new_unchecked(Quaternion::new(
                reader.number()?,
                reader.number()?,
                reader.number()?,
                reader.number()?,
            )),
            rate_body_rad_s: reader.vector3()?,
            relative_to: match reader.tag()? {
                1 => RateReference::Inertial,
                2 => RateReference::Rtn,
                other => return Err(reader.unknown("rate reference", other)),
            },
        },
        other => return Err(reader.unknown("body motion", other)),
    })
}

fn write_linear(writer: &mut Writer, plant: &LinearPlant) {
    writer.matrix(&plant.a);
    writer.matrix(&plant.b);
    writer.numbers(plant.input_lower.as_slice());
    writer.numbers(plant.input_upper.as_slice());
    for set in [&plant.input_set, &plant.state_set] {
        writer.option(set.as_ref(), |writer, set| {
            writer.matrix(set.normals());
            writer.numbers(set.offsets().as_slice());
        });
    }
    writer.matrix(plant.disturbance.generators());
    writer.count(plant.reference.len());
    for row in &plant.reference {
        writer.numbers(row.as_slice());
    }
    writer.option(plant.sample_time, |writer, time| writer.number(time.seconds()));
}

fn read_linear(reader: &mut Reader<'_>) -> Result<LinearPlant, DecodeError> {
    let (a, b) = (reader.matrix()?, reader.matrix()?);
    let (input_lower, input_upper) = (reader.vector()?, reader.vector()?);
    let polytope = |reader: &mut Reader<'_>| -> Result<Polytope, DecodeError> {
        let (normals, offsets) = (reader.matrix()?, reader.vector()?);
        if normals.nrows() != offsets.len() {
            return Err(reader.fault("rows of a polytope do not match"));
        }
        Ok(Polytope::new(normals, offsets))
    };
    let input_set = reader.option(polytope)?;
    let state_set = reader.option(polytope)?;
    let disturbance = Zonotope::centred(reader.matrix()?);
    let count = reader.count()?;
    let reference = (0..count).map(|_| reader.vector()).collect::<Result<_, _>>()?;
    let sample_time = reader.option(|reader| reader.number().map(Seconds::from_seconds))?;
    Ok(LinearPlant {
        a,
        b,
        input_lower,
        input_upper,
        input_set,
        state_set,
        disturbance,
        reference,
        sample_time,
    })
}
