//! TEMPORARY signatures so that the server can be written against them.
#![allow(missing_docs, unused)]
use nalgebra::DMatrix;
use super::*;
use crate::{Budget, bytes::DecodeError, control::{Controller, PrepareError, StepError}};

pub const VERSION: &str = "1";
/// The method, for `Controller`.
#[derive(Debug, Clone, Copy)]
pub struct VariableHorizon;
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {}
impl Artifact {
    pub fn to_bytes(&self) -> Vec<u8> { unimplemented!() }
    /// Decodes and checks again what was written by this version.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> { unimplemented!() }
    pub fn summary(&self) -> Summary { unimplemented!() }
    /// SI values of a scaled trajectory; None for a general linear plant.
    pub fn physical(&self, trajectory: &Trajectory) -> Option<PhysicalTrajectory> { unimplemented!() }
    pub fn problem(&self) -> &Problem { unimplemented!() }
}
/// What a caller may want to know of an artifact.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    pub a: DMatrix<f64>,
    pub b: DMatrix<f64>,
    pub gain: DMatrix<f64>,
    pub spectral_radius: f64,
    pub lambda_bar: f64,
    pub lambda_bar_exact: bool,
    pub series_terms: usize,
    pub series_tolerance: f64,
    /// Longest horizon whose tightened input set is not empty.
    pub horizon_usable: usize,
    pub disturbance_generators: DMatrix<f64>,
    pub position_unit_m: Option<f64>,
    pub velocity_unit_m_s: Option<f64>,
    pub sample_time_s: Option<f64>,
}
#[derive(Debug, Clone, PartialEq)]
pub struct State {}
impl State {
    /// Step index this state is for (0 at the start).
    pub fn step_index(&self) -> usize { unimplemented!() }
    /// Payload of the wire's controller state; the envelope (version, ids, checksum) is the server's.
    pub fn to_bytes(&self) -> Vec<u8> { unimplemented!() }
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> { unimplemented!() }
}
impl Problem {
    /// Canonical bytes of the parsed values; their digest names the problem.
    pub fn canonical_bytes(&self) -> Vec<u8> { unimplemented!() }
}
impl Controller for VariableHorizon {
    type Problem = Problem;
    type Shard = Artifact;
    type Artifact = Artifact;
    type State = State;
    type Measurement = Measurement;
    type Answer = Step;
    fn shards(problem: &Problem) -> usize { 1 }
    fn run_shard(problem: &Problem, shard: usize, budget: Budget<'_>) -> Result<Artifact, PrepareError> { unimplemented!() }
    fn merge(problem: &Problem, shards: Vec<Artifact>) -> Result<Artifact, PrepareError> { unimplemented!() }
    fn start(artifact: &Artifact) -> State { unimplemented!() }
    fn step(artifact: &Artifact, state: &State, measurement: &Measurement, budget: Budget<'_>) -> Result<Step, StepError> { unimplemented!() }
}
/// The plan of step 0: open-loop, or with tube feedback for `TubeOptimalControl`.
pub fn plan(artifact: &Artifact, initial: &Measurement, budget: Budget<'_>) -> Result<PlanOutcome, StepError> { unimplemented!() }
