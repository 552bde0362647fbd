//! Where the mission stands when a measurement comes: which step it is for, what was missed since
//! the last answer, and what acted on the way.

use std::borrow::Cow;

use nalgebra::DVector;

use super::{
    Artifact, MeasuredState, Measurement, RealisedDisturbance, Scheme,
    certify::TOLERANCE,
    state::{Flight, State},
    step::nominal_states,
};
use crate::{
    control::{Fault, StepError},
    matrices::{product, times_vector},
    program::zonotope_gauge,
    sets::{Zonotope, ZonotopeMeasure},
};

/// A measurement must be this near to a step's time, as a share of the sample time.
const EPOCH_TOLERANCE: f64 = 1e-3;
/// A gauge up to here is inside a set: unit conversions round.
pub(super) const GAUGE_TOLERANCE: f64 = 1e-6;

/// The step to be decided.
pub(super) struct Present<'a> {
    pub(super) artifact: &'a Artifact,
    /// The state as it was given; it can be for an earlier step.
    pub(super) given: &'a State,
    pub(super) step: usize,
    /// x(k), scaled.
    pub(super) measured: DVector<f64>,
    /// `None` at the first step.
    pub(super) behind: Option<Behind<'a>>,
}

/// What lies behind a step after the first.
pub(super) struct Behind<'a> {
    /// Steps for which no measurement came since the last answer.
    pub(super) missed: usize,
    /// As the step before the present one would have handed it on.
    pub(super) flight: Cow<'a, Flight>,
    pub(super) disturbance: RealisedDisturbance,
}

impl<'a> Present<'a> {
    /// Checks state and measurement against the artifact, and catches up on missed steps.
    ///
    /// # Errors
    /// [`StepError::State`], [`StepError::Measurement`], [`StepError::PlanExhausted`].
    pub(super) fn new(
        artifact: &'a Artifact,
        given: &'a State,
        measurement: &Measurement,
    ) -> Result<Self, StepError> {
        let problem = &artifact.problem;
        let (n, m) = (artifact.tables.states(), artifact.tables.inputs());
        if !given.fits(n, m, problem.steps_max, problem.horizon_max) {
            return Err(StepError::State("it was not made by this controller".into()));
        }
        let mut faults = Vec::new();
        let missed = missed_steps(artifact, given, measurement, &mut faults);
        let measured = scaled_state(artifact, measurement, &mut faults);
        let (Some(missed), Some(measured)) = (missed, measured) else {
            return Err(StepError::Measurement(faults));
        };
        let step = given.step.saturating_add(missed);
        let beyond = |flight: &Flight| {
            given.step.saturating_add(flight.horizon - 1) > artifact.model.reference_end()
        };
        if given.flight.as_ref().is_some_and(beyond) {
            return Err(StepError::State("its plan goes beyond the mission's end".into()));
        }
        let behind = match &given.flight {
            None => None,
            Some(flight) => Some(Behind::new(artifact, step, flight, missed, &measured)?),
        };
        Ok(Self { artifact, given, step, measured, behind })
    }
}

impl<'a> Behind<'a> {
    fn new(
        artifact: &Artifact,
        step: usize,
        flight: &'a Flight,
        missed: usize,
        measured: &DVector<f64>,
    ) -> Result<Self, StepError> {
        let commands_left = flight.horizon - 1;
        if missed > commands_left {
            return Err(StepError::PlanExhausted { missed, commands_left });
        }
        let flight = match missed {
            0 => Cow::Borrowed(flight),
            _ => Cow::Owned(flown_on(artifact, flight, step - missed, missed)),
        };
        let disturbance = realised_disturbance(artifact, &flight, step, missed, measured);
        Ok(Self { missed, flight, disturbance })
    }

    /// Feasibility and decrease of the cost no longer follow from the last answer.
    pub(super) fn lost_the_tube(&self) -> bool {
        self.missed > 0 && self.disturbance.outside_guaranteed_tube
    }

    /// What an infeasible step has to say for itself.
    pub(super) fn excuse(&self) -> Option<&'static str> {
        let realised = &self.disturbance;
        match self.missed {
            0 if realised.outside_assumed_set => {
                Some("; the last disturbance left the assumed set")
            }
            1.. if realised.outside_guaranteed_tube => {
                Some("; the deviation grew beyond the tube while steps were missed")
            }
            _ => None,
        }
    }
}

/// The flight after `missed` more steps from `step` on, without measurements: the chaser flies the
/// inputs that the last answer planned, as they are, because nobody knew more.
///
/// Each such step is one of Algorithm 1 that takes the candidate of the feasibility proof: its
/// power joins the terminal set, its lambda_bar leaves the cost. Whether the deviation at the end
/// is one that this candidate covers is for [`realised_disturbance`] to say.
fn flown_on(artifact: &Artifact, flight: &Flight, step: usize, missed: usize) -> Flight {
    let (n, m) = (artifact.tables.states(), artifact.tables.inputs());
    let planned = flight.plan_inputs.chunks_exact(m).skip(step - flight.plan_step);
    let (mut state, mut input) = (flight.previous_state.clone(), flight.previous_input.clone());
    for next in planned.take(missed) {
        state = predicted(artifact, &state, &input);
        input = DVector::from_column_slice(next);
    }
    let mut flown = Flight {
        previous_state: state,
        previous_input: input,
        horizon: flight.horizon - missed,
        basis: (0..missed).fold(flight.basis.clone(), |basis, _| basis.shifted()),
        ..flight.clone()
    };
    // Tube feedback stays with the plan of step 0; the others plan from where they are.
    if artifact.problem.scheme != Scheme::TubeOptimalControl {
        let passed = step + missed - 1 - flight.plan_step;
        let nominal = nominal_states(artifact, &flight.plan_initial, &flight.plan_inputs);
        flown.plan_step += passed;
        flown.plan_initial = nominal[passed * n..][..n].to_vec();
        flown.plan_inputs.drain(..passed * m);
    }
    if artifact.is_adaptive() {
        flown.powers.extend((flown.horizon..flight.horizon).rev());
        flown.cost -= super::stages::as_f64(missed) * artifact.decrease.lambda_bar;
    }
    flown
}

/// A x + B u.
fn predicted(artifact: &Artifact, state: &DVector<f64>, input: &DVector<f64>) -> DVector<f64> {
    times_vector(&artifact.model.a, state) + times_vector(&artifact.model.b, input)
}

/// What acted since the last answer, against what may act.
///
/// Without feedback the disturbances of m + 1 steps add up to an element of
/// W + A W + ... + A^m W; that is what `outside_assumed_set` is about. The guarantee needs more:
/// the candidate of the feasibility proof absorbs an element of S(m + 1) = W + ... + A_K^m W, and
/// tube feedback needs x - z in S(k) around its plan.
fn realised_disturbance(
    artifact: &Artifact,
    flight: &Flight,
    step: usize,
    missed: usize,
    measured: &DVector<f64>,
) -> RealisedDisturbance {
    let components = measured - predicted(artifact, &flight.previous_state, &flight.previous_input);
    let steps = missed + 1;
    if missed == 0 {
        let set = &artifact.model.disturbance;
        let found = Measured::of(set, &artifact.disturbance_measure, &components);
        return found.realised(components, steps, found.outside);
    }
    let open_loop = without_feedback(artifact, steps);
    let found = Measured::of(&open_loop, &open_loop.measure(), &components);
    let (deviation, tube) = match artifact.problem.scheme {
        Scheme::TubeOptimalControl => {
            let since = step - flight.plan_step;
            let nominal = nominal_states(artifact, &flight.plan_initial, &flight.plan_inputs);
            let n = measured.len();
            let z = DVector::from_column_slice(&nominal[since * n..][..n]);
            (measured - z, artifact.tube.sum(0..since))
        }
        _ => (components.clone(), artifact.tube.sum(0..steps)),
    };
    let outside_tube = Measured::of(&tube, &tube.measure(), &deviation).outside;
    found.realised(components, steps, outside_tube || found.outside)
}

/// W + A W + ... + A^(steps - 1) W.
fn without_feedback(artifact: &Artifact, steps: usize) -> Zonotope {
    let mut power = artifact.model.disturbance.generators().clone();
    let mut sum = artifact.model.disturbance.clone();
    for _ in 1..steps {
        power = product(&artifact.model.a, &power);
        sum = sum.minkowski_sum(&Zonotope::centred(power.clone()));
    }
    sum
}

/// A point, measured by a set.
struct Measured {
    gauge: Option<f64>,
    residual_norm: f64,
    outside: bool,
}

impl Measured {
    fn of(set: &Zonotope, measure: &ZonotopeMeasure, point: &DVector<f64>) -> Self {
        let found = measure.gauge(point);
        // The upper bound from least-norm coefficients is sharp unless generators are dependent.
        let dependent = set.generators().ncols() > measure.rank();
        let gauge = match found.gauge {
            Some(bound) if bound > 1.0 && dependent => {
                let inside_span = measure.inside_span(point);
                Some(zonotope_gauge(set.generators(), &inside_span).unwrap_or(bound))
            }
            gauge => gauge,
        };
        let residual_max = TOLERANCE.max(GAUGE_TOLERANCE * measure.size());
        let outside = gauge.is_some_and(|gauge| gauge > 1.0 + GAUGE_TOLERANCE)
            || found.residual_norm > residual_max;
        Self { gauge, residual_norm: found.residual_norm, outside }
    }

    fn realised(
        &self,
        components: DVector<f64>,
        steps: usize,
        outside_guaranteed_tube: bool,
    ) -> RealisedDisturbance {
        RealisedDisturbance {
            components,
            gauge: self.gauge,
            residual_norm: self.residual_norm,
            outside_assumed_set: self.outside,
            steps,
            outside_guaranteed_tube,
        }
    }
}

/// By how many whole steps a measurement is later than the step that the state is for.
fn missed_steps(
    artifact: &Artifact,
    given: &State,
    measurement: &Measurement,
    faults: &mut Vec<Fault>,
) -> Option<usize> {
    let (Some(elapsed), Some(sample_time)) = (measurement.elapsed, artifact.model.sample_time)
    else {
        return Some(0);
    };
    /// Far beyond any plan.
    const MISSED_MAX: f64 = 1e9;
    let expected = artifact.elapsed_s(given.step);
    let late = (elapsed.seconds() - expected) / sample_time.seconds();
    let missed = libm::round(late).min(MISSED_MAX);
    let on_time = (late.min(MISSED_MAX) - missed).abs() <= EPOCH_TOLERANCE;
    // Before the first step there is no plan that could have been flown meanwhile.
    if on_time && (missed == 0.0 || (missed > 0.0 && given.flight.is_some())) {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 1e9")]
        return Some(missed as usize);
    }
    let mut right = format!("{expected} s, the time of step {}", given.step);
    if given.flight.is_some() {
        right += &format!(", or whole steps of {} s later", sample_time.seconds());
    }
    faults.push(Fault::new("elapsed_s", right, format!("{} s", elapsed.seconds())));
    None
}

/// The measured state in scaled units.
fn scaled_state(
    artifact: &Artifact,
    measurement: &Measurement,
    faults: &mut Vec<Fault>,
) -> Option<DVector<f64>> {
    let n = artifact.tables.states();
    let state = match (&measurement.state, artifact.model.scaling) {
        (MeasuredState::Relative(state), Some(scaling)) => Some(scaling.scaled(state)),
        (MeasuredState::Linear(state), None) if state.len() == n => Some(state.clone()),
        (MeasuredState::Linear(state), None) => {
            let got = format!("{} values", state.len());
            faults.push(Fault::new("linear.components", format!("{n} values"), got));
            None
        }
        (MeasuredState::Linear(_), Some(_)) => {
            faults.push(Fault::new(
                "linear",
                "a relative state: the plant is a spacecraft",
                "a linear state",
            ));
            None
        }
        (MeasuredState::Relative(_), None) => {
            faults.push(Fault::new(
                "relative",
                "a linear state: the plant is a general one",
                "a relative state",
            ));
            None
        }
    };
    if let Some(state) = &state
        && !state.iter().all(|x| x.is_finite())
    {
        faults.push(Fault::new("", "finite numbers", "a number that is not finite when scaled"));
        return None;
    }
    state
}
