//! Variable-horizon tube MPC.

mod answer;
mod problem;
mod stub;

pub use answer::{
    Arrival, Branch, Command, Diagnostics, MeasuredState, Measurement, PhysicalTrajectory, Plan,
    PlanOutcome, RealisedDisturbance, Step, Trajectory, Trial, TrialOutcome, Tube, Verdict,
};
pub use problem::{
    GainChoice, HillPlant, HorizonSearch, LinearPlant, Plant, Problem, Scheme, TerminalFallback,
    TerminalPoint, Weights,
};
pub use stub::{Artifact, State, Summary, VERSION, VariableHorizon, plan};
