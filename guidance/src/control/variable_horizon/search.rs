//! Which horizon: a sequence of programs of fixed horizon.

use super::{
    HorizonSearch, Scheme, Trial, TrialOutcome,
    stages::{Stages, Terminal, as_f64},
};
use crate::{
    budget::{Budget, Interruption},
    control::Failure,
    program::{
        Basis, Clarabel, DualSimplex, HorizonProgram, Multiplier, RowFamily, Solution, Solver,
        Status, farkas_margin,
    },
};

/// The best horizon found, and what was tried.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Found {
    pub(super) horizon: usize,
    pub(super) cost: f64,
    pub(super) solution: Solution,
    pub(super) terminal: Terminal,
    /// What the search proved.
    pub(super) proof: Proof,
}

/// What a search proved of its best horizon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Proof {
    /// No horizon at all is better.
    Global,
    /// No horizon up to the longest considered is better.
    ToHorizonMax,
    /// Neither neighbour is better.
    Local,
    /// The horizon was prescribed.
    Fixed,
    /// Stopped early: feasible, no more.
    None,
}

/// A proof that one horizon is infeasible.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct InfeasibleHorizon {
    pub(super) horizon: usize,
    /// Farkas ray; `None` if the tightened state set is empty at the end.
    pub(super) ray: Option<Vec<Multiplier>>,
    pub(super) terminal: Option<Terminal>,
}

impl InfeasibleHorizon {
    /// Last stage of a row in the proof.
    fn last_stage(&self) -> usize {
        self.ray.iter().flatten().map(|multiplier| multiplier.row.stage).max().unwrap_or(0)
    }
}

/// Which terminal constraint a search uses.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Goal {
    /// The scheme's own point or set at each horizon.
    Own,
    /// A fixed centre grown by A_K^i W. [Quartullo2025a, line 13]
    GrownFixed { centre: Vec<f64>, powers: Vec<usize> },
    /// The reference grown by A_K^i W. [Quartullo2025b, eq. 13]
    GrownReference { powers: Vec<usize> },
}

/// Solves programs of one step, horizon by horizon, and remembers what it learned.
pub(super) struct Search<'a, 'b> {
    pub(super) stages: Stages<'a>,
    pub(super) budget: Budget<'b>,
    simplex: DualSimplex,
    basis: Option<Basis>,
    pub(super) trials: Vec<Trial>,
    pub(super) pivots: usize,
    pub(super) general_solver_calls: usize,
    /// The infeasible horizon tried last.
    pub(super) infeasible: Option<InfeasibleHorizon>,
    /// A proof from state rows alone: it holds for every horizon beyond the last of them, and for
    /// every goal.
    barrier: Option<InfeasibleHorizon>,
    /// The best feasible answer so far, kept for when time runs out.
    pub(super) incumbent: Option<Found>,
}

/// What came of one horizon.
enum Tried {
    Solved(Box<Found>),
    Infeasible,
    CutOff,
}

impl<'a, 'b> Search<'a, 'b> {
    pub(super) fn new(stages: Stages<'a>, start: Option<Basis>, budget: Budget<'b>) -> Self {
        Self {
            stages,
            budget,
            simplex: DualSimplex::default(),
            basis: start,
            trials: Vec::new(),
            pivots: 0,
            general_solver_calls: 0,
            infeasible: None,
            barrier: None,
            incumbent: None,
        }
    }

    /// The best horizon in 1 ..= `limit` as the problem's search mode understands it, from
    /// `guess`; `None` if every horizon is proved infeasible.
    pub(super) fn run(
        &mut self,
        goal: &Goal,
        guess: usize,
        limit: usize,
    ) -> Result<Option<Found>, Failure> {
        self.incumbent = None;
        if limit == 0 {
            return Ok(None);
        }
        let guess = guess.clamp(1, limit);
        let Some(first) = self.nearest_feasible(goal, guess, limit)? else { return Ok(None) };
        let best = self.descend(goal, first, limit)?;
        let best = match self.stages.artifact.problem.search {
            HorizonSearch::Local => Found { proof: Proof::Local, ..best },
            HorizonSearch::Enumeration => self.enumerate(goal, best, limit)?,
        };
        Ok(Some(best))
    }

    /// One prescribed horizon.
    pub(super) fn fixed(&mut self, goal: &Goal, horizon: usize) -> Result<Option<Found>, Failure> {
        self.incumbent = None;
        Ok(match self.attempt(goal, horizon, None)? {
            Tried::Solved(found) => Some(Found { proof: Proof::Fixed, ..*found }),
            Tried::Infeasible | Tried::CutOff => None,
        })
    }

    /// First step of [Quartullo2025a, sec. IV.A]: the feasible horizon nearest to the guess; of
    /// two equally near the longer one is tried first, since it is the likelier.
    fn nearest_feasible(
        &mut self,
        goal: &Goal,
        guess: usize,
        limit: usize,
    ) -> Result<Option<Found>, Failure> {
        for distance in 0..limit {
            let longer = Some(guess + distance).filter(|&n| n <= limit);
            let shorter = guess.checked_sub(distance).filter(|&n| n >= 1 && distance > 0);
            for horizon in longer.into_iter().chain(shorter) {
                if let Tried::Solved(found) = self.attempt(goal, horizon, None)? {
                    return Ok(Some(*found));
                }
            }
        }
        Ok(None)
    }

    /// Second step: downhill until the cost no longer decreases, looking past a hump of one
    /// horizon: in the Monte Carlo study one step in a thousand lies behind such a hump.
    fn descend(&mut self, goal: &Goal, start: Found, limit: usize) -> Result<Found, Failure> {
        const HUMP: usize = 1;
        let mut best = start;
        for forward in [false, true] {
            let start = best.horizon;
            let mut worse = 0;
            let mut next = start;
            while worse <= HUMP {
                let ahead = if forward { next.checked_add(1) } else { next.checked_sub(1) };
                let Some(horizon) = ahead.filter(|&n| n >= 1 && n <= limit) else { break };
                next = horizon;
                if self.is_hopeless(next, &best) {
                    break;
                }
                if !self.was_tried(next)
                    && let Tried::Solved(found) = self.attempt(goal, next, Some(best.cost))?
                    && found.cost < best.cost
                {
                    best = *found;
                    worse = 0;
                } else {
                    worse += 1;
                }
            }
            if best.horizon != start {
                break;
            }
        }
        Ok(best)
    }

    /// Every horizon whose J_N >= N leaves a chance, nearest to the best first.
    fn enumerate(&mut self, goal: &Goal, start: Found, limit: usize) -> Result<Found, Failure> {
        let mut best = start;
        let centre = best.horizon;
        for distance in 1..limit {
            let shorter = centre.checked_sub(distance).filter(|&n| n >= 1);
            let longer = Some(centre + distance).filter(|&n| n <= limit);
            for horizon in shorter.into_iter().chain(longer) {
                if self.was_tried(horizon) || self.is_hopeless(horizon, &best) {
                    continue;
                }
                if let Tried::Solved(found) = self.attempt(goal, horizon, Some(best.cost))?
                    && found.cost < best.cost
                {
                    best = *found;
                }
            }
        }
        // Longer horizons than the limit: without inputs, or not worth their own length.
        let exhausted = limit < self.stages.artifact.problem.horizon_max
            && limit == self.stages.artifact.horizon_usable;
        let global = exhausted || self.is_hopeless(limit + 1, &best);
        Ok(Found { proof: if global { Proof::Global } else { Proof::ToHorizonMax }, ..best })
    }

    fn was_tried(&self, horizon: usize) -> bool {
        self.trials.iter().any(|trial| trial.horizon == horizon)
    }

    fn is_hopeless(&self, horizon: usize, best: &Found) -> bool {
        self.stages.least_cost(horizon) >= best.cost
    }

    fn terminal(&mut self, goal: &Goal, horizon: usize) -> Option<Terminal> {
        match goal {
            Goal::Own => self.stages.terminal(horizon),
            Goal::GrownFixed { centre, powers } => {
                self.stages.extend_to(horizon);
                Some(self.stages.grown_terminal(centre.clone(), powers, true))
            }
            Goal::GrownReference { powers } => {
                self.stages.extend_to(horizon);
                let step = self.stages.step + horizon;
                let centre = self.stages.artifact.model.reference(step)?.as_slice().to_vec();
                Some(self.stages.grown_terminal(centre, powers, false))
            }
        }
    }

    fn attempt(
        &mut self,
        goal: &Goal,
        horizon: usize,
        cut_off: Option<f64>,
    ) -> Result<Tried, Failure> {
        self.budget.check()?;
        if self.barrier.as_ref().is_some_and(|proof| proof.last_stage() < horizon) {
            self.record(horizon, TrialOutcome::Infeasible);
            self.infeasible.clone_from(&self.barrier);
            return Ok(Tried::Infeasible);
        }
        let Some(terminal) = self.terminal(goal, horizon) else {
            self.record(horizon, TrialOutcome::Infeasible);
            self.infeasible = Some(InfeasibleHorizon { horizon, ray: None, terminal: None });
            return Ok(Tried::Infeasible);
        };
        let minimum_time = self.stages.artifact.is_minimum_time();
        let program = self.stages.program(horizon, &terminal);
        let cut_off = cut_off.filter(|_| !minimum_time);
        let (solution, calls) =
            solve(&mut self.simplex, &program, self.basis.as_ref(), cut_off, self.budget)?;
        self.pivots += solution.iterations;
        self.general_solver_calls += calls;
        match solution.status {
            Status::Optimal => {
                let cost = if minimum_time { as_f64(horizon) } else { solution.objective };
                self.record(horizon, TrialOutcome::Optimal(cost));
                self.basis = Some(solution.basis.clone());
                let found = Found { horizon, cost, solution, terminal, proof: Proof::None };
                if self.incumbent.as_ref().is_none_or(|best| cost < best.cost) {
                    self.incumbent = Some(found.clone());
                }
                Ok(Tried::Solved(Box::new(found)))
            }
            Status::CutOff => {
                self.record(horizon, TrialOutcome::CutOff(solution.objective));
                Ok(Tried::CutOff)
            }
            Status::PrimalInfeasible => {
                let barrier = barrier(&program, &solution.multipliers);
                self.record(horizon, TrialOutcome::Infeasible);
                let ray = Some(solution.multipliers);
                let proof = InfeasibleHorizon { horizon, ray, terminal: Some(terminal) };
                if barrier.is_some() {
                    self.barrier = Some(InfeasibleHorizon { ray: barrier, ..proof.clone() });
                }
                self.infeasible = Some(proof);
                Ok(Tried::Infeasible)
            }
            status => Err(Failure::Numerical(format!("horizon {horizon}: {status:?}"))),
        }
    }

    fn record(&mut self, horizon: usize, outcome: TrialOutcome) {
        self.trials.push(Trial { horizon, outcome });
    }

    /// Forgets what was tried, for a search with another goal in the same step.
    pub(super) fn restart(&mut self) -> Vec<Trial> {
        std::mem::take(&mut self.trials)
    }
}

/// What is left of a ray without its terminal rows and rounding, if that is a proof by itself.
fn barrier(program: &HorizonProgram<'_>, ray: &[Multiplier]) -> Option<Vec<Multiplier>> {
    const ROUNDING: f64 = 1e-9;
    let of_the_way = |m: &&Multiplier| matches!(m.row.family, RowFamily::Stage | RowFamily::Input);
    let heaviest = ray.iter().filter(of_the_way).fold(0.0, |most, m| f64::max(most, m.value));
    let rows = ray.iter().filter(of_the_way).filter(|m| m.value > ROUNDING * heaviest);
    let rows: Vec<Multiplier> = rows.copied().collect();
    (!rows.is_empty() && farkas_margin(program, &rows) > 0.0).then_some(rows)
}

/// The simplex, and the general solver when the simplex reports trouble.
fn solve(
    simplex: &mut DualSimplex,
    program: &HorizonProgram<'_>,
    start: Option<&Basis>,
    cut_off: Option<f64>,
    budget: Budget<'_>,
) -> Result<(Solution, usize), Interruption> {
    let solution = simplex.solve(program, start, cut_off, budget)?;
    let trusted =
        matches!(solution.status, Status::Optimal | Status::PrimalInfeasible | Status::CutOff);
    if trusted {
        return Ok((solution, 0));
    }
    Ok((Clarabel.solve(program, None, cut_off, budget)?, 1))
}

impl super::Artifact {
    /// Both weights zero: J = N. [Quartullo2025b, sec. 3.1]
    pub(super) fn is_minimum_time(&self) -> bool {
        self.problem.weights.fuel == 0.0 && self.problem.weights.tracking == 0.0
    }

    /// Does the scheme end at a point of its own (and not in a set)?
    pub(super) fn is_adaptive(&self) -> bool {
        self.problem.scheme == Scheme::AdaptiveTerminal
    }
}
