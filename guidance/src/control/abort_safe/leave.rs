//! Leaving: the first step of an abort, and those after it.

use super::{
    AbortCommand, AbortOrigin, AbortReason, State, Step, Verdict, state::UnderWay, step::Here,
};
use crate::{
    control::{Infeasibility, StepError},
    mission::ThrustMode,
    reach::{Abort, AbortVerdict},
};

impl Here<'_> {
    /// The abort with the thrusters that work, or why there is none.
    pub(super) fn leave(
        &self,
        working: ThrustMode,
        reason: AbortReason,
        otherwise: Option<Infeasibility>,
    ) -> Result<Step, StepError> {
        let Some(watch) = self.phase.safety.watch() else {
            return Ok(self.stranded("nothing is avoided in this phase", otherwise, None));
        };
        let found = self.judge().abort(self.k, &self.x, working, watch.horizon, self.budget)?;
        let (began, origin) = (self.k, AbortOrigin::Searched);
        // Thrusters that have failed stay so; a regulator without an answer may have one again.
        let next = (reason == AbortReason::Failure).then(|| self.drifting(began, working));
        Ok(match found {
            AbortVerdict::Found(abort) => {
                self.leaving(AbortCommand { reason, origin, began, working, abort }, watch.horizon)
            }
            AbortVerdict::NoneProved { .. } => {
                self.stranded("it is proved that no abort exists", otherwise, next)
            }
            AbortVerdict::Undecided { .. } => {
                self.stranded("no abort was found within the limits", otherwise, next)
            }
        })
    }

    /// The next step of an abort that has begun. What is left of its sequence is kept as long as
    /// it keeps out for a whole horizon from the measured state; else a new one is searched; else
    /// the promise that was made at first must do.
    pub(super) fn go_on(
        &self,
        under_way: &UnderWay,
        working: Option<ThrustMode>,
    ) -> Result<Step, StepError> {
        let working = working.unwrap_or(under_way.working);
        let Some(watch) = self.phase.safety.watch() else {
            return Ok(self.stranded("nothing is avoided in this phase", None, None));
        };
        let judge = self.judge();
        let rest = self.rest(under_way, working);
        let left = under_way.until.saturating_sub(self.k);
        let flown = |horizon: usize| {
            let rest = rest.as_ref().filter(|_| horizon > 0)?;
            judge.flown(self.k, &self.x, rest, horizon)
        };
        let searched = |horizon: usize| -> Result<Option<Abort>, StepError> {
            let found = judge.abort(self.k, &self.x, working, horizon, self.budget)?;
            Ok(if let AbortVerdict::Found(abort) = found { Some(abort) } else { None })
        };
        let (reason, began) = (AbortReason::UnderWay, under_way.began);
        let command = |origin, abort| AbortCommand { reason, origin, began, working, abort };
        if let Some(abort) = flown(watch.horizon) {
            return Ok(self.leaving(command(AbortOrigin::Kept, abort), watch.horizon));
        }
        if let Some(abort) = searched(watch.horizon)? {
            return Ok(self.leaving(command(AbortOrigin::Searched, abort), watch.horizon));
        }
        if let Some(abort) = flown(left) {
            return Ok(self.leaving(command(AbortOrigin::Tail, abort), left));
        }
        if left > 0
            && let Some(abort) = searched(left)?
        {
            return Ok(self.leaving(command(AbortOrigin::Searched, abort), left));
        }
        let next = self.drifting(began, working);
        Ok(self.stranded(
            "the abort under way cannot go on and no other was found",
            None,
            Some(next),
        ))
    }

    /// Throttles of all thrusters over what is left of a sequence, if the thrusters that it needs
    /// still work.
    fn rest(&self, under_way: &UnderWay, working: ThrustMode) -> Option<Vec<Vec<f64>>> {
        let count = self.problem.thrusters.list().len();
        let needed = |throttles: &Vec<f64>| {
            let mut used = under_way.working.working().zip(throttles);
            used.all(|(j, &throttle)| throttle == 0.0 || working.working().any(|w| w == j))
        };
        under_way.throttles.iter().all(needed).then(|| {
            let spread = |throttles: &Vec<f64>| {
                let mut all = vec![0.0; count];
                under_way.working.working().zip(throttles).for_each(|(j, &t)| all[j] = t);
                all
            };
            under_way.throttles.iter().map(spread).collect()
        })
    }

    /// The answer that an abort is, and the state that carries it on.
    fn leaving(&self, command: AbortCommand, horizon: usize) -> Step {
        let of = |throttles: &Vec<f64>| command.working.working().map(|j| throttles[j]).collect();
        let under_way = UnderWay {
            began: command.began,
            until: self.k + horizon,
            working: command.working,
            throttles: command.abort.throttles.iter().skip(1).map(of).collect(),
        };
        self.with_abort(Verdict::Abort(command), Some(under_way))
    }

    /// An abort without a sequence: the next step searches again.
    fn drifting(&self, began: usize, working: ThrustMode) -> UnderWay {
        UnderWay { began, until: self.k, working, throttles: Vec::new() }
    }

    fn stranded(
        &self,
        what: &str,
        otherwise: Option<Infeasibility>,
        next: Option<UnderWay>,
    ) -> Step {
        let because = otherwise.as_ref().map_or("thrusters have failed", |o| o.reason.as_str());
        let reason = format!("{because}; {what}");
        let horizon = self.phase.safety.watch().map_or(0, |watch| watch.horizon);
        let infeasibility = match otherwise {
            Some(otherwise) => Infeasibility { reason, horizon, ..otherwise },
            None => Infeasibility {
                reason,
                horizon,
                rows: Vec::new(),
                relaxations: Vec::new(),
                all_horizons_proved: false,
            },
        };
        self.with_abort(Verdict::Infeasible(infeasibility), next)
    }

    fn with_abort(&self, verdict: Verdict, abort: Option<UnderWay>) -> Step {
        let step = self.without_command(verdict);
        Step { next: State { abort, ..step.next }, ..step }
    }
}
