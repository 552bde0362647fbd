//! A plan made elsewhere: what it claims, against what follows from its mission, burns and gains.

use nalgebra::{DMatrix, Vector3};
use vbar_guidance::{
    Budget,
    control::{
        Claim, Failure, Fault, PrepareError,
        disturbance_feedback::{
            ArrivalSet, BurnBounds, Gain, Origin, Outcome, Plan, PlanCertificate, PlannedState,
            Problem,
        },
    },
    units::{Angle, Seconds},
};
use vbar_proto::v1;

use super::{in_lvlh, plan::burn_epoch};
use crate::wire::{
    Door, Parse, Path, Unverified, Violation, Violations,
    types::{Axes, Size, finite, integer, list, matrix, relative_state, unknown_enum, vector3},
};

/// A mission, burns and gains, and everything that is claimed about them.
#[derive(Debug)]
pub(crate) struct Claimed {
    problem: Problem,
    burns: Vec<Vector3<f64>>,
    gains: Vec<Gain>,
    origin: Origin,
    outcome: Outcome,
    /// Of each burn, as written.
    epochs: Vec<String>,
    /// Where the document stands in the request, with a dot if that is not the root.
    root: String,
}

impl Parse for Claimed {
    type Message = v1::PlanDocument;

    fn parse(message: &v1::PlanDocument, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::problem::Method;
        const EXPECTED: &str = "disturbance_feedback: plans of other methods are not kept";
        let place = path.field("problem");
        let problem = door.required(&message.problem, place).and_then(|p| match &p.method {
            Some(Method::DisturbanceFeedback(problem)) => {
                Problem::parse(problem, place.field("disturbance_feedback"), door)
            }
            Some(Method::VariableHorizon(_)) => door.refuse(place, EXPECTED, "variable_horizon"),
            Some(Method::AbortSafe(_)) => door.refuse(place, EXPECTED, "abort_safe"),
            Some(Method::OfflineSampling(_)) => door.refuse(place, EXPECTED, "offline_sampling"),
            None => door.refuse(place, EXPECTED, "nothing"),
        });
        let place = path.field("plan");
        let claims = door.required(&message.plan, place).and_then(|plan| {
            let place = place.field("disturbance_feedback");
            Claims::parse(door.required(&plan.disturbance_feedback, place)?, place, door)
        });
        let (problem, claims) = (problem?, claims?);
        let root = path.to_string();
        let root = if root.is_empty() { root } else { root + "." };
        let Claims { burns, gains, origin, outcome, epochs } = claims;
        Some(Self { problem, burns, gains, origin, outcome, epochs, root })
    }
}

impl Claimed {
    /// The plan, if everything it claims holds.
    ///
    /// # Errors
    /// Every claim that does not, with what follows from mission, burns and gains instead; the
    /// interruption of the budget.
    pub(crate) fn verify(self, budget: Budget<'_>) -> Result<Plan, Unverified> {
        let Self { problem, burns, gains, origin, outcome, epochs, root } = self;
        let plan = Plan::from_burns_and_gains_within(problem, burns, gains, origin, budget);
        let plan = plan.map_err(|error| match error {
            PrepareError::Failure(Failure::Interrupted(why)) => Unverified::Interrupted(why),
            PrepareError::Faults(faults) => violations(&root, faults).into(),
            other => unreachable!("a plan is right, or has faults: {other:?}"),
        })?;
        let mut faults = plan.disagreements(&outcome);
        faults.extend(shares_that_differ(plan.outcome(), &outcome));
        let start = plan.problem().epoch.as_ref();
        for (i, (claimed, burn)) in epochs.iter().zip(&plan.outcome().burns).enumerate() {
            let expected = burn_epoch(burn, start);
            if *claimed != expected {
                let field = format!("burns[{i}].epoch");
                faults.push(Fault::new(field, format!("{expected:?}"), format!("{claimed:?}")));
            }
        }
        if faults.is_empty() { Ok(plan) } else { Err(violations(&root, faults).into()) }
    }
}

/// What [`Plan::disagreements`] leaves to us: numbers that only split up others.
fn shares_that_differ(own: &Outcome, claimed: &Outcome) -> Vec<Fault> {
    // As there: a document may have passed through decimals.
    const SAME: f64 = 1e-9;
    let mut faults = Vec::new();
    let mut compare = |field: &str, own: f64, claimed: f64, size: f64| {
        if !((own - claimed).abs() <= SAME * size) {
            faults.push(Fault::new(field, format!("{own:?}"), format!("{claimed:?}")));
        }
    };
    compare("effort_m_s", own.effort_m_s, claimed.effort_m_s, 1.0 + own.effort_m_s.abs());
    let size = own.trace.abs().sqrt();
    if own.trace_shares.len() != claimed.trace_shares.len() {
        let (own, claimed) = (own.trace_shares.len(), claimed.trace_shares.len());
        return vec![Fault::new("trace_shares", own.to_string(), claimed.to_string())];
    }
    for (i, (own, claimed)) in own.trace_shares.iter().zip(&claimed.trace_shares).enumerate() {
        compare(&format!("trace_shares[{i}]"), *own, *claimed, size);
    }
    let mut sets = vec![("arrival", &own.arrival, &claimed.arrival)];
    if let (Some(own), Some(claimed)) = (&own.open_loop_arrival, &claimed.open_loop_arrival) {
        sets.push(("open_loop_arrival", own, claimed));
    }
    for (name, own, claimed) in sets {
        let (own, claimed) = (&own.position_shape, &claimed.position_shape);
        for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
            let size = (own[(i, i)] * own[(j, j)]).sqrt();
            let field = format!("{name}.position_shape[{i}][{j}]");
            compare(&field, own[(i, j)], claimed[(i, j)], size);
        }
    }
    faults
}

/// Fields of the problem keep their prefix; every other one is the plan's.
fn violations(root: &str, faults: Vec<Fault>) -> Violations {
    let place = |field: &str| match field.strip_prefix("problem.") {
        Some(field) => format!("{root}problem.disturbance_feedback.{field}"),
        None if field.is_empty() => format!("{root}plan.disturbance_feedback"),
        None => format!("{root}plan.disturbance_feedback.{field}"),
    };
    let violation = |fault: Fault| Violation {
        path: place(&fault.field),
        expected: fault.expected,
        got: fault.got,
    };
    Violations(faults.into_iter().map(violation).collect())
}

struct Claims {
    burns: Vec<Vector3<f64>>,
    gains: Vec<Gain>,
    origin: Origin,
    outcome: Outcome,
    epochs: Vec<String>,
}

impl Parse for Claims {
    type Message = v1::DisturbanceFeedbackPlan;

    fn parse(message: &Self::Message, path: Path<'_>, door: &mut Door) -> Option<Self> {
        let most = door.limits.plan_instants_max;
        let burns = each(&message.burns, most, path.field("burns"), door, burn);
        let gains = each(&message.gains, most * most / 2, path.field("gains"), door, gain);
        let states = each(&message.states, most, path.field("states"), door, planned);
        let place = path.field("disturbance_shapes_nd");
        let disturbance_shapes =
            each(&message.disturbance_shapes_nd, most, place, door, |m, path, door| {
                matrix(m, SIX_BY_SIX, path, door)
            });
        let place = path.field("arrival");
        let arrival = door.required(&message.arrival, place);
        let arrival = arrival.and_then(|set| arrival_set(set, place, door));
        let open_loop_arrival = match &message.open_loop_arrival {
            None => Some(None),
            Some(set) => arrival_set(set, path.field("open_loop_arrival"), door).map(Some),
        };
        let place = path.field("trace_shares");
        let trace_shares = list(&message.trace_shares, Size::UpTo(most), place, door);
        let mut number = |value: f64, name| finite(value, path.field(name), door);
        let objective = number(message.objective, "objective");
        let trace = number(message.trace, "trace");
        let fuel_m_s = number(message.fuel_m_s, "fuel_m_s");
        let effort_m_s = number(message.effort_m_s, "effort_m_s");
        let certificate = door.message(&message.certificate, path.field("certificate"));
        let diagnostics = diagnostics(message, path.field("diagnostics"), door);
        let (origin, delta_v_max_least_m_s) = diagnostics?;
        let burns: Vec<BurnBounds> = burns?;
        Some(Self {
            burns: burns.iter().map(|burn| burn.delta_v_m_s).collect(),
            gains: gains?,
            origin,
            outcome: Outcome {
                burns,
                states: states?,
                arrival: arrival?,
                open_loop_arrival: open_loop_arrival?,
                disturbance_shapes: disturbance_shapes?,
                objective: objective?,
                trace: trace?,
                trace_shares: trace_shares?.to_vec(),
                fuel_m_s: fuel_m_s?,
                effort_m_s: effort_m_s?,
                delta_v_max_least_m_s,
                certificate: certificate?,
            },
            epochs: message.burns.iter().map(|burn| burn.epoch.clone()).collect(),
        })
    }
}

const SIX_BY_SIX: (Size, Size) = (Size::Exactly(6), Size::Exactly(6));

/// Reads every element of a list that has at most so many.
fn each<M, T>(
    messages: &[M],
    most: usize,
    path: Path<'_>,
    door: &mut Door,
    mut read: impl FnMut(&M, Path<'_>, &mut Door) -> Option<T>,
) -> Option<Vec<T>> {
    if messages.len() > most {
        return door.refuse(path, format!("at most {most}"), messages.len());
    }
    let all: Vec<Option<T>> =
        messages.iter().enumerate().map(|(i, m)| read(m, path.index(i), door)).collect();
    all.into_iter().collect()
}

fn burn(message: &v1::Burn, path: Path<'_>, door: &mut Door) -> Option<BurnBounds> {
    let axes = Axes::parse(&message.frame, path.field("frame"), door);
    let axes = axes.and_then(|axes| match axes {
        Axes::LvlhCcsds => Some(()),
        Axes::Rtn => door.refuse(path.field("frame"), "FRAME_LVLH_CCSDS", "FRAME_RTN"),
    });
    let elapsed = finite(message.elapsed_s, path.field("elapsed_s"), door);
    let mut vector = |values: &[f64], name| vector3(values, path.field(name), door);
    let delta_v = vector(&message.delta_v_m_s, "delta_v_m_s");
    let correction = vector(&message.correction_max_m_s, "correction_max_m_s");
    let margin = vector(&message.saturation_margin_m_s, "saturation_margin_m_s");
    axes?;
    Some(BurnBounds {
        elapsed: Seconds::from_seconds(elapsed?),
        delta_v_m_s: delta_v?,
        correction_max_m_s: correction?,
        saturation_margin_m_s: margin?,
    })
}

fn gain(message: &v1::FeedbackGain, path: Path<'_>, door: &mut Door) -> Option<Gain> {
    let most = door.limits.plan_instants_max;
    let mut index = |value: i32, name| integer(value, 0..=most, path.field(name), door);
    let burn = index(message.burn_index, "burn_index");
    let disturbance = index(message.disturbance_index, "disturbance_index");
    let place = path.field("gain");
    let size = (Size::Exactly(3), Size::Exactly(6));
    let matrix = door.required(&message.gain, place).and_then(|m| matrix(m, size, place, door));
    Some(Gain { burn: burn?, disturbance: disturbance?, matrix: matrix? })
}

fn planned(message: &v1::PlannedState, path: Path<'_>, door: &mut Door) -> Option<PlannedState> {
    let elapsed = finite(message.elapsed_s, path.field("elapsed_s"), door);
    let anomaly = finite(message.true_anomaly_deg, path.field("true_anomaly_deg"), door);
    let place = path.field("state");
    let state = door.required(&message.state, place);
    let state = state.and_then(|state| relative_state(state, place, door));
    let outer_shape = square(&message.outer_shape, 6, path.field("outer_shape"), door);
    Some(PlannedState {
        elapsed: Seconds::from_seconds(elapsed?),
        true_anomaly: Angle::from_degrees(anomaly?),
        state: in_lvlh(&state?),
        outer_shape: outer_shape?,
    })
}

fn square(
    message: &Option<v1::Matrix>,
    size: usize,
    path: Path<'_>,
    door: &mut Door,
) -> Option<DMatrix<f64>> {
    let size = (Size::Exactly(size), Size::Exactly(size));
    door.required(message, path).and_then(|m| matrix(m, size, path, door))
}

fn arrival_set(message: &v1::ArrivalSet, path: Path<'_>, door: &mut Door) -> Option<ArrivalSet> {
    let outer_shape = square(&message.shape, 6, path.field("shape"), door);
    let position_shape = square(&message.position_shape, 3, path.field("position_shape"), door);
    let place = path.field("in_plane_semi_axes_m");
    let in_plane = list(&message.in_plane_semi_axes_m, Size::Exactly(2), place, door);
    let place = path.field("position_semi_axes_m");
    let position = list(&message.position_semi_axes_m, Size::Exactly(3), place, door);
    Some(ArrivalSet {
        outer_shape: outer_shape?,
        position_shape: position_shape?,
        in_plane_semi_axes_m: in_plane?.try_into().ok()?,
        position_semi_axes_m: position?.try_into().ok()?,
    })
}

fn diagnostics(
    message: &v1::DisturbanceFeedbackPlan,
    path: Path<'_>,
    door: &mut Door,
) -> Option<(Origin, f64)> {
    const ITERATIONS_MAX: usize = 1_000_000;
    let message = door.required(&message.diagnostics, path)?;
    let iterations = message.conic_iterations;
    let iterations = integer(iterations, 0..=ITERATIONS_MAX, path.field("conic_iterations"), door);
    let least = finite(message.delta_v_max_least_m_s, path.field("delta_v_max_least_m_s"), door);
    let origin = Origin { fast_path: message.fast_path, conic_iterations: iterations? };
    Some((origin, least?))
}

impl Parse for PlanCertificate {
    type Message = v1::PlanCertificate;

    fn parse(message: &v1::PlanCertificate, path: Path<'_>, door: &mut Door) -> Option<Self> {
        use v1::Optimality;
        const EXPECTED: &str = "OPTIMALITY_FIXED_HORIZON or OPTIMALITY_FEASIBLE";
        let place = path.field("optimality");
        let claim = match Optimality::try_from(message.optimality) {
            Ok(Optimality::FixedHorizon) => Some(Claim::FixedHorizon),
            Ok(Optimality::Feasible) => Some(Claim::Feasible),
            Ok(other) => door.refuse(place, EXPECTED, other.as_str_name()),
            Err(_) => unknown_enum(message.optimality, EXPECTED, place, door),
        };
        let mut number = |value: f64, name| finite(value, path.field(name), door);
        let trace = number(message.trace, "trace");
        let residual = number(message.dynamics_residual_nd, "dynamics_residual_nd");
        let margin = number(message.saturation_margin_m_s, "saturation_margin_m_s");
        let bound = number(message.objective_lower_bound, "objective_lower_bound");
        let gap = number(message.relative_gap, "relative_gap");
        let inequality = number(message.matrix_inequality_margin, "matrix_inequality_margin");
        Some(Self {
            passed: message.passed,
            trace: trace?,
            dynamics_residual: residual?,
            saturation_margin_m_s: margin?,
            objective_lower_bound: bound?,
            relative_gap: gap?,
            claim: claim?,
            matrix_inequality_margin: inequality?,
        })
    }
}
