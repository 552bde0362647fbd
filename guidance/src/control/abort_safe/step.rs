//! One step: phase, half-spaces, regulator, verdict.

use nalgebra::Vector3;

use super::{
    AbortReason, Arrival, Artifact, Command, Diagnostics, Fallback, Measurement, Phase, Problem,
    State, Step, Trajectory, UnsafeState, Verdict, artifact::PreparedPhase, cuts::Cuts,
    regulator::Regulator, safety::Judge,
};
use crate::{
    budget::{Budget, Interruption},
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Failure, Fault, Infeasibility,
        ProofRow, Relaxation, StepError,
    },
    dynamics::RelativeVector,
    mission::ThrustMode,
    program::{
        CondensedRegulator, RegulatorAnswer, RegulatorProgram, RelaxedRows, Softness, Status,
    },
    reach::Flight,
    sets::ZonotopeFacets,
    units::Seconds,
};

/// A measurement belongs to a step if its time is within this part of a step.
const TIME_TOLERANCE: f64 = 1e-3;
/// Largest violation of a facet or a half-space, in their own units of about 1, that a
/// certificate accepts: a thousand times what the dual active set leaves.
const ACCEPTED: f64 = 1e-6;
/// Price of violating a half-space by its whole gauge, in parts of the free response's cost:
/// large enough that none is violated that can be kept.
const SOFT_PRICE: f64 = 1e4;

pub(super) fn step(
    artifact: &Artifact,
    state: &State,
    measurement: &Measurement,
    budget: Budget<'_>,
) -> Result<Step, StepError> {
    let problem = artifact.problem();
    if !state.fits(problem) {
        return Err(StepError::State("a state of another mission".into()));
    }
    let x = measured(problem, state, measurement)?;
    let (phase_index, distance_m) = phase_at(problem, state.phase, !state.is_aborting(), &x);
    let (phase, prepared) = artifact.phase(phase_index);
    let mut here = Here {
        problem,
        phase,
        prepared,
        nominal: artifact.nominal_forces(),
        k: state.step,
        x,
        phase_index,
        distance_m,
        unsafe_state: None,
        budget,
    };
    here.unsafe_state = here.judge().unsafe_state(here.k, &x, budget)?;
    if let Some(under_way) = &state.abort {
        return here.go_on(under_way, measurement.working);
    }
    let last = phase_index + 1 == problem.phases.len();
    let (range, speed) = (x.fixed_rows::<3>(0).norm(), x.fixed_rows::<3>(3).norm());
    if last && range <= problem.arrival.metres() {
        let arrival = Arrival { completion_steps: state.step, distance_m: range, speed_m_s: speed };
        return Ok(here.without_command(Verdict::Arrived(arrival)));
    }
    let working = measurement.working.unwrap_or(problem.thrusters.nominal());
    let failed = working != problem.thrusters.nominal();
    if failed && (phase.safety.watch().is_some() || working == ThrustMode::NONE) {
        return here.leave(working, AbortReason::Failure, None);
    }
    if let (0, Some(unsafe_state)) = (state.step, &here.unsafe_state) {
        let refused = here.unsafe_start(unsafe_state);
        return Ok(here.without_command(Verdict::Infeasible(refused)));
    }
    here.regulate(state, working)
}

fn measured(
    problem: &Problem,
    state: &State,
    measurement: &Measurement,
) -> Result<RelativeVector, StepError> {
    let mut faults = Vec::new();
    let mut x = RelativeVector::zeros();
    x.fixed_rows_mut::<3>(0).copy_from(&measurement.state.position_m.components);
    x.fixed_rows_mut::<3>(3).copy_from(&measurement.state.velocity_m_s.components);
    if !x.iter().all(|c| c.is_finite()) {
        faults.push(Fault::new("relative", "finite numbers", "not so"));
    }
    let step_s = problem.sample_time.seconds();
    if let Some(elapsed) = measurement.elapsed {
        let expected = state.step as f64 * step_s;
        if !((elapsed.seconds() - expected).abs() <= TIME_TOLERANCE * step_s) {
            let got = format!("{} s", elapsed.seconds());
            faults.push(Fault::new("elapsed_s", format!("{expected} s"), got));
        }
    }
    if measurement.working.is_some_and(|working| !working.is_within(problem.thrusters.nominal())) {
        faults.push(Fault::new("working_thrusters", "thrusters of the chaser", "another one"));
    }
    if faults.is_empty() { Ok(x) } else { Err(StepError::Measurement(faults)) }
}

/// The phase at a state, and the distance that decides it. Phases follow each other; one that has
/// begun does not end before the next one's moment. [AguilarMarsillach2022, sec. VI]
pub(super) fn phase_at(
    problem: &Problem,
    from: usize,
    advancing: bool,
    x: &RelativeVector,
) -> (usize, f64) {
    let position = x.fixed_rows::<3>(0).into_owned();
    let distance = |phase: &Phase| match phase.safety.watch() {
        Some(watch) => watch.avoid.distance_m(&position),
        None => position.norm(),
    };
    let mut index = from;
    let mut here = distance(&problem.phases[index]);
    while advancing
        && index + 1 < problem.phases.len()
        && here < problem.phases[index].advance_within.metres()
    {
        index += 1;
        here = distance(&problem.phases[index]);
    }
    (index, here)
}

/// Where and when a decision is made.
pub(super) struct Here<'a> {
    pub(super) problem: &'a Problem,
    pub(super) phase: &'a Phase,
    pub(super) prepared: &'a PreparedPhase,
    /// Forces of all thrusters.
    pub(super) nominal: &'a ZonotopeFacets,
    pub(super) k: usize,
    pub(super) x: RelativeVector,
    pub(super) phase_index: usize,
    pub(super) distance_m: f64,
    pub(super) unsafe_state: Option<UnsafeState>,
    pub(super) budget: Budget<'a>,
}

impl Here<'_> {
    fn regulate(&self, state: &State, working: ThrustMode) -> Result<Step, StepError> {
        let cuts = self.cuts(&self.points(state))?;
        let regulator = Regulator::new(self, working, &cuts.cuts);
        let program = regulator.program(self, &cuts.cuts, None);
        let condensed = condensed(&program)?;
        let start = regulator.received(&state.active);
        let answer = program.solve(&condensed, &start, self.budget)?;
        match answer.status {
            Status::Optimal => self.command(&regulator, &cuts, &answer, None),
            Status::PrimalInfeasible => {
                let why = self.infeasibility(&regulator, &program, &condensed, &answer)?;
                self.without_trajectory(&regulator, &cuts, why)
            }
            other => Err(Failure::Numerical(format!("the regulator ended {other:?}")).into()),
        }
    }

    fn without_trajectory(
        &self,
        regulator: &Regulator,
        cuts: &Cuts,
        infeasibility: Infeasibility,
    ) -> Result<Step, StepError> {
        match self.problem.fallback {
            Fallback::Abort => {
                let nominal = self.problem.thrusters.nominal();
                self.leave(nominal, AbortReason::NoTrajectory, Some(infeasibility))
            }
            Fallback::Soften => {
                let price = self.price(regulator);
                let softness = Some(Softness { linear: price, quadratic: price });
                let program = regulator.program(self, &cuts.cuts, softness);
                let soft = program.solve(&condensed(&program)?, &[], self.budget)?;
                if soft.status == Status::Optimal {
                    return self.command(regulator, cuts, &soft, Some(infeasibility));
                }
                Ok(self.without_command(Verdict::Infeasible(infeasibility)))
            }
        }
    }

    /// What the idle craft would cost: the scale of the price of violations.
    fn price(&self, regulator: &Regulator) -> f64 {
        let program = regulator.program(self, &[], None);
        let idle = vec![Vector3::zeros(); self.problem.prediction_horizon];
        SOFT_PRICE * (1.0 + program.objective(&program.states(&idle), &idle))
    }

    fn command(
        &self,
        regulator: &Regulator,
        cuts: &Cuts,
        answer: &RegulatorAnswer,
        infeasibility: Option<Infeasibility>,
    ) -> Result<Step, StepError> {
        let softened = infeasibility.is_some();
        let certificate = self.certify(regulator, cuts, answer, softened);
        if !certificate.passed {
            return Err(Failure::Numerical(format!("certificate: {certificate:?}")).into());
        }
        let watched = self.phase.safety.watch().is_some();
        let safety = watched.then(|| {
            let modes = self.phase.safety.modes();
            self.judge().verdict(
                self.phase_index,
                self.k + 1,
                &answer.states[1],
                modes,
                self.budget,
            )
        });
        // A command that holds is not withheld because there was no time to say what could be done
        // after it.
        let safety = match safety.transpose() {
            Err(Interruption::Deadline) => None,
            judged => judged?,
        };
        let flight = Flight::under(&self.prepared.plant, self.k, &self.x, &answer.inputs);
        let violation = answer.violations.iter().fold(0.0_f64, |a, &b| a.max(b));
        Ok(Step {
            index: self.k,
            phase: self.phase_index,
            verdict: Verdict::Command(Command {
                elapsed: self.elapsed(),
                duration: self.problem.sample_time,
                force_n: answer.inputs[0],
                softened,
            }),
            next: State {
                step: self.k + 1,
                phase: self.phase_index,
                prediction: answer.states.clone(),
                active: if softened { Vec::new() } else { regulator.handed_on(answer) },
                abort: None,
            },
            trajectory: Some(Trajectory {
                states: answer.states.clone(),
                forces_n: answer.inputs.clone(),
            }),
            certificate: Some(certificate),
            unsafe_state: self.unsafe_state,
            safety,
            diagnostics: Diagnostics {
                cuts: cuts.cuts.len(),
                least_clearance: cuts.least_clearance,
                violation,
                infeasibility,
                closest: Some(flight.closest_to_target()),
                iterations: answer.iterations,
                by_general_solver: answer.by_general_solver,
                ..self.diagnostics()
            },
        })
    }

    /// Propagates the forces once more with the plant and looks at every facet and half-space.
    fn certify(
        &self,
        regulator: &Regulator,
        cuts: &Cuts,
        answer: &RegulatorAnswer,
        softened: bool,
    ) -> Certificate {
        let mut x = self.x;
        let mut residual = 0.0_f64;
        let mut input = tightest(ConstraintFamily::Input);
        let mut state = tightest(ConstraintFamily::State);
        for (j, force) in answer.inputs.iter().enumerate() {
            for (row, margin) in regulator.margins(force).into_iter().enumerate() {
                keep_least(&mut input, j, row, margin);
            }
            x = self.prepared.plant.advance(self.k + j, &x, force);
            residual = residual.max((x - answer.states[j + 1]).amax());
            let here = cuts.cuts.iter().enumerate().filter(|(_, cut)| cut.stage == j + 1);
            for (row, cut) in here {
                keep_least(&mut state, j + 1, row, cut.normal.dot(&x) - cut.offset);
            }
        }
        let clear = softened || state.margin >= -ACCEPTED;
        let margins: Vec<ConstraintMargin> =
            [input, state].into_iter().filter(|m| m.margin.is_finite()).collect();
        let size = 1.0 + self.x.amax();
        Certificate {
            passed: input.margin >= -ACCEPTED && clear && residual <= ACCEPTED * size,
            claim: if softened { Claim::Feasible } else { Claim::FixedHorizon },
            tolerance: ACCEPTED,
            dynamics_residual: residual,
            margins,
            cost: answer.objective,
            lower_bound: None,
        }
    }

    /// The rows that rule out a trajectory, and the least change to half-spaces alone or to forces
    /// alone that would allow one.
    fn infeasibility(
        &self,
        regulator: &Regulator,
        program: &RegulatorProgram<'_>,
        condensed: &CondensedRegulator,
        answer: &RegulatorAnswer,
    ) -> Result<Infeasibility, StepError> {
        let horizon = self.problem.prediction_horizon;
        let total: f64 = answer.active.iter().map(|row| row.multiplier.abs()).sum();
        let mut rows: Vec<ProofRow> = answer
            .active
            .iter()
            .map(|active| {
                let (family, stage, row) = regulator.name(active.row);
                let weight = active.multiplier.abs() / total.max(f64::MIN_POSITIVE);
                ProofRow { family, stage, row, weight }
            })
            .collect();
        rows.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        let mut relaxations = Vec::new();
        let families = [
            (ConstraintFamily::State, RelaxedRows::Cuts),
            (ConstraintFamily::Input, RelaxedRows::Facets),
        ];
        for (family, relaxed) in families {
            let least = program.least_relaxation(condensed, relaxed, self.budget)?;
            relaxations.extend(least.map(|amount| Relaxation { family, horizon, amount }));
        }
        Ok(Infeasibility {
            reason: "no trajectory keeps out of every half-space".into(),
            horizon,
            rows,
            relaxations,
            all_horizons_proved: false,
        })
    }

    /// A mission that starts where nothing could be survived is refused.
    fn unsafe_start(&self, state: &UnsafeState) -> Infeasibility {
        let (family, stage) = (ConstraintFamily::InitialState, 0);
        let horizon = self.phase.safety.watch().map_or(0, |watch| watch.horizon);
        let place = match &state.outside {
            Some(x) => format!(
                "outside, near by, is the position ({:.1}, {:.1}, {:.1}) m with the velocity \
                 ({:.4}, {:.4}, {:.4}) m/s",
                x[0], x[1], x[2], x[3], x[4], x[5]
            ),
            None => "no state near by is known to be outside: start farther out".into(),
        };
        let thrusters: Vec<String> = state.working.working().map(|j| j.to_string()).collect();
        let failure = if thrusters.is_empty() {
            "without thrust".to_owned()
        } else {
            format!("whatever the thrusters [{}] alone do", thrusters.join(", "))
        };
        Infeasibility {
            reason: format!(
                "the start is inside the unsafe set: {failure} the chaser is in the region of phase \
                 {} after {} s; {place}",
                self.phase_index, state.doomed_after_s
            ),
            horizon,
            rows: vec![ProofRow { family, stage, row: state.instant, weight: 1.0 }],
            relaxations: vec![Relaxation { family, horizon, amount: 1.0 - state.gauge }],
            all_horizons_proved: false,
        }
    }

    pub(super) fn without_command(&self, verdict: Verdict) -> Step {
        Step {
            index: self.k,
            phase: self.phase_index,
            verdict,
            next: State { step: self.k + 1, phase: self.phase_index, ..State::START },
            trajectory: None,
            certificate: None,
            unsafe_state: self.unsafe_state,
            safety: None,
            diagnostics: self.diagnostics(),
        }
    }

    fn diagnostics(&self) -> Diagnostics {
        Diagnostics {
            distance_m: self.distance_m,
            cuts: 0,
            least_clearance: f64::INFINITY,
            violation: 0.0,
            infeasibility: None,
            closest: None,
            iterations: 0,
            by_general_solver: false,
        }
    }

    pub(super) fn judge(&self) -> Judge<'_> {
        Judge { problem: self.problem, phase: self.phase, prepared: self.prepared }
    }

    fn elapsed(&self) -> Seconds {
        Seconds::from_seconds(self.k as f64 * self.problem.sample_time.seconds())
    }
}

fn condensed(program: &RegulatorProgram<'_>) -> Result<CondensedRegulator, Failure> {
    program.condense().map_err(|error| Failure::Numerical(format!("regulator: {error}")))
}

fn tightest(family: ConstraintFamily) -> ConstraintMargin {
    ConstraintMargin { family, stage: 0, row: 0, margin: f64::INFINITY }
}

fn keep_least(least: &mut ConstraintMargin, stage: usize, row: usize, margin: f64) {
    if margin < least.margin {
        *least = ConstraintMargin { stage, row, margin, ..*least };
    }
}
