//! One step: phase, half-spaces, regulator, verdict.

use nalgebra::{DMatrix, Vector3};

use super::{
    AbortCommand, AbortReason, Arrival, Artifact, Command, Diagnostics, Fallback, Measurement,
    Phase, Problem, SetTiming, State, Step, Trajectory, Verdict,
    artifact::{PhaseSets, PreparedPhase, distance_to_region},
    safety::{abort_now, is_watched, judge_state},
};
use crate::{
    budget::Budget,
    control::{
        Certificate, Claim, ConstraintFamily, ConstraintMargin, Failure, Fault, Infeasibility,
        ProofRow, StepError,
    },
    dynamics::RelativeVector,
    mission::ThrustMode,
    program::{RegulatorAnswer, RegulatorProgram, Softness, StateCut, Status},
    reach::{AbortVerdict, Cut, Flight, cut_off_ellipsoid, cut_off_polytope},
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
    if !state.fits(problem.phases.len(), problem.steps_max, problem.prediction_horizon) {
        return Err(StepError::State("a state of another mission".into()));
    }
    let x = measured(problem, state, measurement)?;
    let (phase_index, distance_m) = phase_at(problem, state.phase, &x);
    let (phase, prepared) = artifact.phase(phase_index);
    let here = Here { problem, phase, prepared, k: state.step, x, phase_index, distance_m, budget };
    let last = phase_index + 1 == problem.phases.len();
    let (range, speed) = (x.fixed_rows::<3>(0).norm(), x.fixed_rows::<3>(3).norm());
    if last && range <= problem.arrival.metres() {
        let arrival = Arrival { completion_steps: state.step, distance_m: range, speed_m_s: speed };
        return Ok(here.without_command(Verdict::Arrived(arrival)));
    }
    let working = measurement.working.unwrap_or(problem.thrusters.nominal());
    let failed = working != problem.thrusters.nominal();
    if failed && (is_watched(&phase.safety) || working == ThrustMode::NONE) {
        return here.leave(working, AbortReason::Failure, None);
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
        faults.push(Fault::new("state", "finite numbers", "not so"));
    }
    let step_s = problem.sample_time.seconds();
    if let Some(elapsed) = measurement.elapsed {
        let expected = state.step as f64 * step_s;
        if !((elapsed.seconds() - expected).abs() <= TIME_TOLERANCE * step_s) {
            let got = format!("{} s", elapsed.seconds());
            faults.push(Fault::new("elapsed", format!("{expected} s"), got));
        }
    }
    if measurement.working.is_some_and(|working| !working.is_within(problem.thrusters.nominal())) {
        faults.push(Fault::new("working", "thrusters of the chaser", "another one"));
    }
    if faults.is_empty() { Ok(x) } else { Err(StepError::Measurement(faults)) }
}

/// The phase at a state, and the distance that decides it. Phases follow each other; one that has
/// begun does not end before the next one's moment. [AguilarMarsillach2022, sec. VI]
fn phase_at(problem: &Problem, from: usize, x: &RelativeVector) -> (usize, f64) {
    let position = x.fixed_rows::<3>(0).into_owned();
    let distance = |phase: &Phase| match phase.safety.watch() {
        Some(watch) => distance_to_region(&watch.avoid, &position),
        None => position.norm(),
    };
    let mut index = from;
    let mut here = distance(&problem.phases[index]);
    while index + 1 < problem.phases.len() && here < problem.phases[index].advance_within.metres() {
        index += 1;
        here = distance(&problem.phases[index]);
    }
    (index, here)
}

/// Where and when a decision is made.
struct Here<'a> {
    problem: &'a Problem,
    phase: &'a Phase,
    prepared: &'a PreparedPhase,
    k: usize,
    x: RelativeVector,
    phase_index: usize,
    distance_m: f64,
    budget: Budget<'a>,
}

/// Half-spaces with the least clearance of the points they were made for.
struct Cuts {
    cuts: Vec<StateCut>,
    least_clearance: f64,
}

impl Here<'_> {
    fn regulate(&self, state: &State, working: ThrustMode) -> Result<Step, StepError> {
        let cuts = self.cuts(&self.points(state))?;
        let regulator = Regulator::new(self, working);
        let answer = self.solve(&regulator, &cuts.cuts, None, &state.active)?;
        match answer.status {
            Status::Optimal => self.command(&regulator, &cuts, &answer, false),
            Status::PrimalInfeasible => self.without_trajectory(&regulator, &cuts, &answer),
            other => Err(Failure::Numerical(format!("the regulator ended {other:?}")).into()),
        }
    }

    fn without_trajectory(
        &self,
        regulator: &Regulator,
        cuts: &Cuts,
        answer: &RegulatorAnswer,
    ) -> Result<Step, StepError> {
        let infeasibility = self.infeasibility(regulator, answer);
        match self.problem.fallback {
            Fallback::Abort => {
                let nominal = self.problem.thrusters.nominal();
                self.leave(nominal, AbortReason::NoTrajectory, Some(infeasibility))
            }
            Fallback::Soften => {
                let price = self.price(regulator);
                let softness = Some(Softness { linear: price, quadratic: price });
                let soft = self.solve(regulator, &cuts.cuts, softness, &[])?;
                if soft.status == Status::Optimal {
                    return self.command(regulator, cuts, &soft, true);
                }
                Ok(self.without_command(Verdict::Infeasible(infeasibility)))
            }
        }
    }

    /// The points that half-spaces are made for: the last prediction, one step on, its end
    /// drifting; the state itself everywhere when there is none. [AguilarMarsillach2022, alg. 1]
    fn points(&self, state: &State) -> Vec<RelativeVector> {
        let n = self.problem.prediction_horizon;
        if state.prediction.len() != n + 1 {
            return vec![self.x; n + 1];
        }
        let mut points = state.prediction[1..].to_vec();
        points[0] = self.x;
        let end = state.prediction[n];
        points.push(self.prepared.plant.advance(self.k + n - 1, &end, &Vector3::zeros()));
        points
    }

    fn cuts(&self, points: &[RelativeVector]) -> Result<Cuts, StepError> {
        let mut cuts = Cuts { cuts: Vec::new(), least_clearance: f64::INFINITY };
        let Some(watch) = self.phase.safety.watch() else { return Ok(cuts) };
        for (stage, point) in points.iter().enumerate().skip(1) {
            self.budget.check()?;
            for cut in self.cuts_at(self.k + stage, point, watch.nearest) {
                let Cut { normal, offset, clearance } = cut
                    .ok_or_else(|| Failure::Numerical(format!("no half-space at stage {stage}")))?;
                cuts.least_clearance = cuts.least_clearance.min(clearance);
                let offset = offset + self.problem.clearance;
                cuts.cuts.push(StateCut { stage, normal, offset });
            }
        }
        Ok(cuts)
    }

    /// One half-space for each of the `count` nearest sets at time index k.
    fn cuts_at(&self, k: usize, x: &RelativeVector, count: usize) -> Vec<Option<Cut>> {
        let plant = &self.prepared.plant;
        let all = 0..plant.steps_per_period();
        let timed = self.problem.timing == SetTiming::Timed;
        match &self.prepared.sets {
            PhaseSets::None => Vec::new(),
            PhaseSets::Ellipsoids { union, .. } => {
                let near = if timed {
                    union.nearest(k, x, count)
                } else {
                    union.nearest_untimed(x, count)
                };
                // The origin is the centre of all: no half-space leaves it out, any will do.
                let away = if x.norm() > 0.0 { *x } else { RelativeVector::repeat(1.0) };
                near.iter()
                    .map(|set| cut_off_ellipsoid(union, set.start, set.instant, &away))
                    .collect()
            }
            PhaseSets::Polytopes { union, .. } => {
                let mut near = match timed {
                    true => union.nearest(k, x, count),
                    false => all.flat_map(|start| union.nearest(start, x, count)).collect(),
                };
                near.sort_by(|a, b| a.0.total_cmp(&b.0));
                near.truncate(count);
                near.iter().map(|(_, set)| cut_off_polytope(set, x)).collect()
            }
        }
    }

    fn solve(
        &self,
        regulator: &Regulator,
        cuts: &[StateCut],
        softness: Option<Softness>,
        start: &[usize],
    ) -> Result<RegulatorAnswer, StepError> {
        let program = regulator.program(self, cuts, softness);
        let condensed = program
            .condense()
            .map_err(|error| Failure::Numerical(format!("regulator: {error}")))?;
        Ok(program.solve(&condensed, start, self.budget)?)
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
        softened: bool,
    ) -> Result<Step, StepError> {
        let certificate = self.certify(regulator, cuts, answer, softened);
        if !certificate.passed {
            return Err(Failure::Numerical(format!("certificate: {certificate:?}")).into());
        }
        let safety = match is_watched(&self.phase.safety) {
            false => None,
            true => Some(judge_state(
                self.problem,
                self.phase,
                self.prepared,
                self.k + 1,
                &answer.states[1],
                self.budget,
            )?),
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
                active: if softened { Vec::new() } else { regulator.shifted(answer) },
            },
            trajectory: Some(Trajectory {
                states: answer.states.clone(),
                forces_n: answer.inputs.clone(),
            }),
            certificate: Some(certificate),
            safety,
            diagnostics: Diagnostics {
                cuts: cuts.cuts.len(),
                least_clearance: cuts.least_clearance,
                violation,
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

    /// The abort with the thrusters that work, or why there is none.
    fn leave(
        &self,
        working: ThrustMode,
        reason: AbortReason,
        otherwise: Option<Infeasibility>,
    ) -> Result<Step, StepError> {
        let found = abort_now(
            self.problem,
            self.phase,
            self.prepared,
            self.k,
            &self.x,
            working,
            self.budget,
        )?;
        let what = match found {
            Some(AbortVerdict::Found(abort)) => {
                let abort = AbortCommand { reason, working, abort };
                return Ok(self.without_command(Verdict::Abort(abort)));
            }
            Some(AbortVerdict::NoneProved { .. }) => "it is proved that no abort exists",
            Some(AbortVerdict::Undecided { .. }) => "no abort was found within the limits",
            None => "nothing is avoided in this phase",
        };
        let because = otherwise.as_ref().map_or("thrusters have failed", |o| o.reason.as_str());
        let infeasibility = Infeasibility {
            reason: format!("{because}; {what}"),
            horizon: self.phase.safety.watch().map_or(0, |watch| watch.horizon),
            rows: otherwise.map_or_else(Vec::new, |o| o.rows),
            relaxations: Vec::new(),
            all_horizons_proved: false,
        };
        Ok(self.without_command(Verdict::Infeasible(infeasibility)))
    }

    fn infeasibility(&self, regulator: &Regulator, answer: &RegulatorAnswer) -> Infeasibility {
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
        Infeasibility {
            reason: "no trajectory keeps out of every half-space".into(),
            horizon: self.problem.prediction_horizon,
            rows,
            relaxations: Vec::new(),
            all_horizons_proved: false,
        }
    }

    fn without_command(&self, verdict: Verdict) -> Step {
        Step {
            index: self.k,
            phase: self.phase_index,
            verdict,
            next: State { step: self.k + 1, phase: self.phase_index, ..State::START },
            trajectory: None,
            certificate: None,
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
            closest: None,
            iterations: 0,
            by_general_solver: false,
        }
    }

    fn elapsed(&self) -> Seconds {
        Seconds::from_seconds(self.k as f64 * self.problem.sample_time.seconds())
    }
}

fn tightest(family: ConstraintFamily) -> ConstraintMargin {
    ConstraintMargin { family, stage: 0, row: 0, margin: f64::INFINITY }
}

fn keep_least(least: &mut ConstraintMargin, stage: usize, row: usize, margin: f64) {
    if margin < least.margin {
        *least = ConstraintMargin { stage, row, margin, ..*least };
    }
}

/// The regulator's forces, in units of the strongest thruster.
struct Regulator {
    steps: Vec<(nalgebra::SMatrix<f64, 6, 6>, nalgebra::SMatrix<f64, 6, 3>)>,
    shape: ZonotopeFacets,
    origin: Vector3<f64>,
    basis: DMatrix<f64>,
    facet_offsets: nalgebra::DVector<f64>,
    unit_n: f64,
    nearest: usize,
}

impl Regulator {
    fn new(here: &Here<'_>, working: ThrustMode) -> Self {
        let n = here.problem.prediction_horizon;
        let steps = (here.k..here.k + n).map(|i| here.prepared.plant.step(i));
        let thrusters = &here.problem.thrusters;
        let shape = thrusters.admissible(working).facets();
        let unit_n = thrusters.list().iter().map(|t| t.force_max().newtons()).fold(0.0, f64::max);
        Self {
            steps: steps.map(|step| (step.a, step.b)).collect(),
            origin: Vector3::from_fn(|i, _| shape.origin[i]),
            basis: &shape.basis * unit_n,
            facet_offsets: shape.facets.offsets() / unit_n,
            shape,
            unit_n,
            nearest: here.phase.safety.watch().map_or(0, |watch| watch.nearest),
        }
    }

    fn program<'a>(
        &'a self,
        here: &'a Here<'_>,
        cuts: &'a [StateCut],
        softness: Option<Softness>,
    ) -> RegulatorProgram<'a> {
        RegulatorProgram {
            steps: &self.steps,
            initial: &here.x,
            stage_cost: &here.phase.weights.stage,
            terminal_cost: &here.phase.weights.terminal,
            input_cost: &here.phase.weights.input,
            origin: &self.origin,
            basis: &self.basis,
            facets: self.shape.facets.normals(),
            facet_offsets: &self.facet_offsets,
            cuts,
            softness,
        }
    }

    fn facets(&self) -> usize {
        self.facet_offsets.len()
    }

    /// What a row of the program means: family, stage, row within it.
    fn name(&self, row: usize) -> (ConstraintFamily, usize, usize) {
        let facet_rows = self.steps.len() * self.facets();
        if row < facet_rows {
            return (ConstraintFamily::Input, row / self.facets(), row % self.facets());
        }
        let cut = row - facet_rows;
        let nearest = self.nearest.max(1);
        (ConstraintFamily::State, cut / nearest + 1, cut % nearest)
    }

    /// Active rows as the next step names them: every stage one earlier. A guess, which the
    /// solver does not have to trust.
    fn shifted(&self, answer: &RegulatorAnswer) -> Vec<usize> {
        let facet_rows = self.steps.len() * self.facets();
        let earlier = |row: usize| {
            let (first, a_stage) =
                if row < facet_rows { (0, self.facets()) } else { (facet_rows, self.nearest) };
            (row >= first + a_stage).then(|| row - a_stage)
        };
        answer.active.iter().filter_map(|active| earlier(active.row)).collect()
    }

    /// Distances to the facets in units of the strongest thruster, and to the plane of forces.
    fn margins(&self, force_n: &Vector3<f64>) -> Vec<f64> {
        let from = (force_n - self.origin) / self.unit_n;
        let basis = &self.shape.basis;
        let w = nalgebra::DVector::from_fn(basis.ncols(), |c, _| {
            (0..3).map(|i| basis[(i, c)] * from[i]).sum()
        });
        let inside = basis * &w;
        let off_plane = (from - Vector3::from_fn(|i, _| inside[i])).norm();
        let normals = self.shape.facets.normals();
        let distances = (0..self.facets()).map(|f| {
            self.facet_offsets[f] - (0..w.len()).map(|c| normals[(f, c)] * w[c]).sum::<f64>()
        });
        distances.chain([-off_plane]).collect()
    }
}
