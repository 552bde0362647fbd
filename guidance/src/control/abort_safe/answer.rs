//! What a step answers.

use nalgebra::Vector3;

use super::State;
use crate::{
    control::{Certificate, Infeasibility},
    dynamics::RelativeVector,
    frames::RelativeState,
    mission::ThrustMode,
    reach::{Abort, AbortVerdict, Closest, PassiveVerdict},
    units::Seconds,
};

/// What was measured, and when.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// The state, RTN.
    pub state: RelativeState,
    /// Time since the mission's start; must equal the step's time.
    pub elapsed: Option<Seconds>,
    /// The thrusters that work; `None`: all.
    pub working: Option<ThrustMode>,
}

/// One decided step.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The step this answers, from 0.
    pub index: usize,
    /// The phase it was decided in.
    pub phase: usize,
    /// The decision.
    pub verdict: Verdict,
    /// To be handed to the next step.
    pub next: State,
    /// The predicted trajectory; `None` without a regulator's command.
    pub trajectory: Option<Trajectory>,
    /// The proof; `None` without a regulator's command.
    pub certificate: Option<Certificate>,
    /// The measured state is in a backward reachable set of its own time index: if thrusters
    /// failed now, nothing would help.
    pub unsafe_state: Option<UnsafeState>,
    /// What could be done if thrusters failed at the next sample; `None` in phases that avoid
    /// nothing, and without a command.
    pub safety: Option<StateVerdict>,
    /// How it came about.
    pub diagnostics: Diagnostics,
}

/// The decision.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "one is made a call and never stored in bulk")]
pub enum Verdict {
    /// Do this.
    Command(Command),
    /// Leave, with this sequence.
    Abort(AbortCommand),
    /// The mission is complete.
    Arrived(Arrival),
    /// No command satisfies the problem.
    Infeasible(Infeasibility),
}

/// What to do until the next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// Start since the mission's start.
    pub elapsed: Seconds,
    /// How long the force is held.
    pub duration: Seconds,
    /// Along RTN, newtons.
    pub force_n: Vector3<f64>,
    /// Predicted states that enter the forbidden side of a half-space, because no trajectory
    /// keeps out of all: the promise of safety does not hold for this step.
    pub softened: bool,
}

/// An abort. Once begun it goes on at every step, to drift when its sequence is over.
#[derive(Debug, Clone, PartialEq)]
pub struct AbortCommand {
    /// Why.
    pub reason: AbortReason,
    /// Where the sequence is from.
    pub origin: AbortOrigin,
    /// Index of the step at which the abort began.
    pub began: usize,
    /// Thrusters that work.
    pub working: ThrustMode,
    /// What to do from this step on.
    pub abort: Abort,
}

/// Why a step answers with an abort.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AbortReason {
    /// Thrusters have failed.
    Failure,
    /// The regulator's problem has no answer. [AguilarMarsillach2022, remark 6]
    NoTrajectory,
    /// An earlier step has begun it.
    UnderWay,
}

/// Where an abort's sequence is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AbortOrigin {
    /// Searched at this step.
    Searched,
    /// What was left of the one under way, then drift: flown once more from the measured state,
    /// it keeps out for a whole horizon from now.
    Kept,
    /// The same, but it keeps out only to the end of the horizon that it was found for, and no
    /// better one exists or was found.
    Tail,
}

/// The mission is complete.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrival {
    /// Number of commands given.
    pub completion_steps: usize,
    /// Distance from the target, metres.
    pub distance_m: f64,
    /// Speed, metres per second.
    pub speed_m_s: f64,
}

/// x_0 .. x_N under u_0 .. u_(N-1), metres, metres per second, newtons, RTN.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// N + 1.
    pub states: Vec<RelativeVector>,
    /// N.
    pub forces_n: Vec<Vector3<f64>>,
}

/// A state that is unsafe already.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnsafeState {
    /// The failure whose set holds it deepest: thrusters that still work after it.
    pub working: ThrustMode,
    /// Seconds until the earliest instant whose set holds it.
    pub doomed_after_s: f64,
    /// The instant of the deepest set, in parts of a step after the state.
    pub instant: usize,
    /// Its gauge at the state, at most 1.
    pub gauge: f64,
    /// A state near it that no set of its time index holds, if one was found: nearest in metres
    /// and in metres per second over the mean motion, among those that the search saw.
    pub outside: Option<RelativeVector>,
}

/// What could be done from a state if thrusters failed there.
#[derive(Debug, Clone, PartialEq)]
pub struct StateVerdict {
    /// Time index k of the state.
    pub index: usize,
    /// The phase whose region is meant.
    pub phase: usize,
    /// The state.
    pub state: RelativeVector,
    /// One a mode that was asked for.
    pub modes: Vec<ModeVerdict>,
    /// What free drift does, for phases that avoid an ellipsoid passively; `None` else, and for a
    /// chaser whose own orbit is no ellipse.
    pub drift: Option<PassiveVerdict>,
}

/// What could be done with the thrusters that are left.
#[derive(Debug, Clone, PartialEq)]
pub struct ModeVerdict {
    /// Thrusters that still work.
    pub working: ThrustMode,
    /// Seconds until the first instant at which the craft is in the avoided set whatever is done:
    /// the earliest of the backward reachable sets that hold the state. `None` outside all.
    pub doomed_after_s: Option<f64>,
    /// Whether an abort exists. Not the opposite of the above: outside every reachable set there
    /// can still be no abort.
    pub abort: AbortVerdict,
}

impl ModeVerdict {
    /// Is the state in a backward reachable set of its own time index?
    #[must_use]
    pub fn inside_reachable_set(&self) -> bool {
        self.doomed_after_s.is_some()
    }
}

impl StateVerdict {
    /// An abort was found for every mode.
    #[must_use]
    pub fn abort_always_exists(&self) -> bool {
        self.modes.iter().all(|mode| matches!(mode.abort, AbortVerdict::Found(_)))
    }
}

/// How a step came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnostics {
    /// Distance to the region of the phase, or to the target where there is none, metres.
    pub distance_m: f64,
    /// Half-spaces that predicted states had to keep out of.
    pub cuts: usize,
    /// Least clearance of the points that the half-spaces were made for; negative if one of them
    /// was inside its set. Infinite without half-spaces.
    pub least_clearance: f64,
    /// Largest violation of a half-space; 0 unless softened.
    pub violation: f64,
    /// Why it was softened, and what would have made that needless.
    pub infeasibility: Option<Infeasibility>,
    /// The closest moment of the predicted trajectory to the target, between samples too; `least`
    /// is in square metres. `None` without a prediction.
    pub closest: Option<Closest>,
    /// Rows that entered or left the active set.
    pub iterations: usize,
    /// The general solver was needed.
    pub by_general_solver: bool,
}
