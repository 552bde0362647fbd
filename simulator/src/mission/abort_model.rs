//! The simulator's own reading of an abort-safe problem: SI, radians, RTN.

use std::ops::RangeInclusive;

use hifitime::Epoch;
use nalgebra::Vector3;
use vbar_proto::v1::{
    self, Frame, TimeSystem, abort_safe_phase::Safety, avoidance_region::Form, thruster_layout,
};

use super::plan_model::orbit;
use crate::{
    clearance::Region,
    plant::{EARTH_MU_M3_S2, two_body::Elements},
};

const HERE: &str = "problem.abort_safe";

/// What is flown and by which rules.
#[derive(Debug, Clone)]
pub(crate) struct AbortModel {
    /// Orbit of the target at step 0; zero angles where the problem gives none.
    pub elements: Elements,
    /// The problem gives the orbit's orientation.
    pub oriented: bool,
    /// When the mission starts, if the problem says so.
    pub epoch: Option<Epoch>,
    pub mass_kg: f64,
    pub sample_time_s: f64,
    /// Thrusters by their numbers on the wire.
    pub thrusters: RangeInclusive<i32>,
    pub phases: Vec<PhaseModel>,
    pub steps_max: u32,
}

/// A part of the approach.
#[derive(Debug, Clone)]
pub(crate) struct PhaseModel {
    pub kind: PhaseKind,
    /// What the chaser must not be carried into; `None` where nothing is avoided.
    pub region: Option<Region>,
    /// Steps after a failure for which safety is promised.
    pub horizon_steps: u32,
}

/// What a phase promises.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PhaseKind {
    /// Free drift keeps out of the region.
    Passive,
    /// Thrusters that are left can steer out of it.
    Active,
    /// Nothing.
    Free,
}

impl PhaseKind {
    /// As in reports.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Passive => "passive",
            Self::Active => "active",
            Self::Free => "free",
        }
    }
}

impl AbortModel {
    /// Reads a problem; all faults are returned together.
    pub(crate) fn new(problem: &v1::Problem) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let Some(v1::problem::Method::AbortSafe(inner)) = &problem.method else {
            return Err(vec![format!("{HERE}: required")]);
        };
        let place = format!("{HERE}.orbit");
        let (elements, oriented) = orbit(&place, inner.orbit.as_ref(), &mut faults);
        let mut positive = |value: Option<f64>, field: &str| {
            let value = value.unwrap_or(f64::NAN);
            if !(value.is_finite() && value > 0.0) {
                faults.push(format!("{HERE}.{field}: required, greater than 0"));
            }
            value
        };
        let mass_kg = positive(inner.mass_kg, "mass_kg");
        let sample_time_s = positive(inner.sample_time_s, "sample_time_s");
        if inner.frame() != Frame::Rtn {
            faults.push(format!("{HERE}.frame: the simulator flies in RTN"));
        }
        let thrusters = 0..=thrusters(inner.thrusters.as_ref(), &mut faults) - 1;
        if inner.phases.is_empty() {
            faults.push(format!("{HERE}.phases: at least one"));
        }
        let phases = inner.phases.iter().enumerate();
        let phases = phases.map(|(index, given)| phase(index, given, &mut faults)).collect();
        let steps_max = u32::try_from(inner.steps_max).unwrap_or(0);
        if steps_max == 0 {
            faults.push(format!("{HERE}.steps_max: required, at least 1"));
        }
        let given = inner.orbit.as_ref().and_then(|orbit| orbit.epoch.as_ref());
        let epoch = given.and_then(|given| epoch(given, &mut faults));
        if !faults.is_empty() {
            return Err(faults);
        }
        Ok(Self { elements, oriented, epoch, mass_kg, sample_time_s, thrusters, phases, steps_max })
    }

    /// The region that the first phase avoids, if it avoids any.
    pub(crate) fn first_region(&self) -> Option<&Region> {
        self.phases.first()?.region.as_ref()
    }

    /// Time of a revolution of the target, unperturbed.
    pub(crate) fn period_s(&self) -> f64 {
        let axis = self.elements.semi_major_axis_m;
        std::f64::consts::TAU * (axis.powi(3) / EARTH_MU_M3_S2).sqrt()
    }
}

/// The moment that a calendar means in its scale.
fn epoch(given: &v1::Epoch, faults: &mut Vec<String>) -> Option<Epoch> {
    let scale = match given.time_system() {
        TimeSystem::Utc => Some("UTC"),
        TimeSystem::Tai => Some("TAI"),
        TimeSystem::Tt => Some("TT"),
        TimeSystem::Gps => Some("GPST"),
        TimeSystem::Tdb => Some("TDB"),
        TimeSystem::Unspecified => None,
    };
    let moment = scale.and_then(|scale| format!("{} {scale}", given.calendar).parse().ok());
    if moment.is_none() {
        faults.push(format!(
            "{HERE}.orbit.epoch: a calendar such as 2027-03-01T12:00:00 and its scale"
        ));
    }
    moment
}

/// How many there are.
fn thrusters(layout: Option<&v1::ThrusterLayout>, faults: &mut Vec<String>) -> i32 {
    match layout.and_then(|layout| layout.form.as_ref()) {
        Some(thruster_layout::Form::CubeCorners(_)) => 8,
        Some(thruster_layout::Form::List(list)) => {
            i32::try_from(list.thrusters.len()).unwrap_or(i32::MAX)
        }
        None => {
            faults.push(format!("{HERE}.thrusters: required"));
            0
        }
    }
}

fn phase(index: usize, given: &v1::AbortSafePhase, faults: &mut Vec<String>) -> PhaseModel {
    let place = format!("{HERE}.phases[{index}]");
    let (kind, watch) = match &given.safety {
        Some(Safety::Passive(passive)) => (PhaseKind::Passive, passive.watch.as_ref()),
        Some(Safety::Active(active)) => (PhaseKind::Active, active.watch.as_ref()),
        Some(Safety::NothingAvoided(_)) => (PhaseKind::Free, None),
        None => {
            faults.push(format!("{place}: passive, active or nothing_avoided"));
            (PhaseKind::Free, None)
        }
    };
    if kind == PhaseKind::Free {
        return PhaseModel { kind, region: None, horizon_steps: 0 };
    }
    let horizon_steps = watch.map_or(0, |watch| u32::try_from(watch.horizon_steps).unwrap_or(0));
    if horizon_steps == 0 {
        faults.push(format!("{place}.watch.horizon_steps: required, at least 1"));
    }
    let form = watch.and_then(|watch| watch.region.as_ref()).and_then(|given| given.form.as_ref());
    let region = region(&format!("{place}.watch.region"), form, faults);
    PhaseModel { kind, region, horizon_steps }
}

/// What the problem avoids, as it is: inflation is the controller's own margin.
fn region(place: &str, form: Option<&Form>, faults: &mut Vec<String>) -> Option<Region> {
    let mut three = |lengths: &[f64]| match *lengths {
        [x, y, z] if lengths.iter().all(|length| length.is_finite() && *length > 0.0) => {
            Some(Vector3::new(x, y, z))
        }
        _ => {
            faults.push(format!("{place}: lengths above 0"));
            None
        }
    };
    let ellipsoid = |semi_axes_m| Region::Ellipsoid { semi_axes_m };
    let boxed = |half_widths_m| Region::Box { half_widths_m };
    match form {
        Some(Form::SemiAxes(axes)) => three(&axes.semi_axes_m).map(ellipsoid),
        Some(Form::RadiusM(radius)) => three(&[*radius; 3]).map(ellipsoid),
        Some(Form::HalfWidths(widths)) => three(&widths.half_widths_m).map(boxed),
        Some(Form::ShapeM2(_) | Form::FacesM(_)) | None => {
            let known = "the simulator judges by semi_axes, radius_m or half_widths";
            faults.push(format!("{place}: {known}"));
            None
        }
    }
}
