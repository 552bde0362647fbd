//! What every scheme needs before flight: gain, weights, the plant's vertices, the terminal set.

use nalgebra::{DMatrix, DVector};

use super::{
    Artifact, GainChoice, GroupSummary, Problem, Scheme, Summary, artifact::Parts, terminal,
};
use crate::{
    budget::{Budget, Interruption},
    control::{Failure, Fault, Infeasibility, PrepareError},
    dynamics::{
        PlantMatrices, StageWeights, TerminalCostError, linear_quadratic_regulator,
        spectral_radius, terminal_cost,
    },
    matrices::product,
    reach::{HalfSpaces, NoInterior, PlantVertex, StageConstraints, StageGroup},
    sampling::{ScalarLaw, Stream},
    sets::Zonotope,
};

/// Stream of the samples of the terminal weight, apart from those of the groups.
const TERMINAL_STREAM: u64 = u64::MAX - 1;

/// What every part of a precompute needs: cheap to make again.
pub(super) struct Design {
    pub(super) gain: DMatrix<f64>,
    pub(super) weights: StageWeights,
    pub(super) vertices: Vec<PlantMatrices>,
    /// B_w W at each vertex.
    pub(super) images: Vec<Zonotope>,
    pub(super) constraints: StageConstraints,
    pub(super) terminal_iterations: usize,
    pub(super) groups: Vec<StageGroup>,
}

impl Design {
    /// For a scheme without a tube: with all vertices and every disturbance, or with the expected
    /// ones alone.
    ///
    /// # Errors
    /// As [`super::Controller::run_shard`].
    pub(super) fn new(problem: &Problem, budget: Budget<'_>) -> Result<Self, PrepareError> {
        let gain = checked_gain(problem)?;
        let robust = problem.scheme == Scheme::OfflineSampling;
        let vertices = if robust { vertices(problem)? } else { vec![problem.plant.at_mean()] };
        let all = if robust { disturbance(problem) } else { expected_disturbance(problem) };
        let state = HalfSpaces::from_polytope(&problem.state_set);
        let input = HalfSpaces::from_polytope(&problem.input_set);
        Self::within(problem, gain, vertices, &all, (state, input), budget)
    }

    /// For a gain, plants and disturbances of the caller, in his state and input constraints.
    pub(super) fn within(
        problem: &Problem,
        gain: DMatrix<f64>,
        vertices: Vec<PlantMatrices>,
        disturbance: &Zonotope,
        (state, input): (HalfSpaces, HalfSpaces),
        budget: Budget<'_>,
    ) -> Result<Self, PrepareError> {
        check_stable(problem, &vertices, &gain)?;
        let images: Vec<Zonotope> =
            vertices.iter().map(|vertex| disturbance.linear_map(&vertex.b_w)).collect();
        let closed = plant_vertices(&gain, &vertices, &images, false);
        let limits = problem.terminal_limits;
        let found = terminal::terminal_set(&state, &input, &gain, &closed, limits, budget)?;
        Ok(Self {
            weights: weights(problem, &gain, budget)?,
            constraints: StageConstraints { state, input, terminal: found.set },
            terminal_iterations: found.iterations,
            groups: problem.groups(),
            gain,
            vertices,
            images,
        })
    }

    pub(super) fn plant_vertices(&self, with_input: bool) -> Vec<PlantVertex<'_>> {
        plant_vertices(&self.gain, &self.vertices, &self.images, with_input)
    }

    /// A summary without anything sampled or removed.
    pub(super) fn summary(&self, groups: Vec<GroupSummary>) -> Summary {
        Summary {
            gain: self.gain.clone(),
            terminal_weight: self.weights.terminal.clone(),
            terminal_rows: self.constraints.terminal.len(),
            terminal_iterations: self.terminal_iterations,
            groups,
            doubtful_rows: 0,
            outer_excess: 0.0,
            checked_points: 0,
            checked_excess: 0.0,
            first_step_rows: 0,
            first_step_limited: false,
            joint_confidence: None,
            tube: None,
        }
    }
}

/// An artifact, or ours is the fault.
pub(super) fn assembled(parts: Parts, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
    Artifact::assemble(parts, budget)?.map_err(|text| Failure::Numerical(text).into())
}

/// K of a problem without faults.
pub(super) fn checked_gain(problem: &Problem) -> Result<DMatrix<f64>, PrepareError> {
    let faults = problem.faults();
    if !faults.is_empty() {
        return Err(PrepareError::Faults(faults));
    }
    match &problem.gain {
        GainChoice::Explicit(gain) => Ok(gain.clone()),
        GainChoice::Lqr { state, input } => {
            let mean = problem.plant.at_mean();
            linear_quadratic_regulator(&mean.a, &mean.b, state, input).map_err(|error| {
                let expected = "weights of a stabilising regulator";
                PrepareError::Faults(vec![Fault::new("gain.lqr", expected, error.to_string())])
            })
        }
    }
}

/// Plants whose hull holds every plant.
pub(super) fn vertices(problem: &Problem) -> Result<Vec<PlantMatrices>, PrepareError> {
    let given = problem.vertices.clone().filter(|vertices| !vertices.is_empty());
    given.or_else(|| problem.plant.corners()).ok_or_else(|| {
        let expected = "given vertices where more than twelve parameters vary";
        PrepareError::Faults(vec![Fault::new("vertices", expected, "none")])
    })
}

/// Refuses a gain under which a vertex is not stable, and names every such vertex.
fn check_stable(
    problem: &Problem,
    vertices: &[PlantMatrices],
    gain: &DMatrix<f64>,
) -> Result<(), PrepareError> {
    let unstable = |(index, vertex): (usize, &PlantMatrices)| {
        let radius = spectral_radius(&(&vertex.a + product(&vertex.b, gain)));
        (!(radius < 1.0)).then(|| {
            let given = problem.vertices.as_ref().is_some_and(|given| !given.is_empty());
            let field = if given { format!("vertices[{index}]") } else { "gain".into() };
            let expected = "a gain that stabilises every vertex of the plant";
            let got =
                format!("spectral radius {radius} at vertex {index} of {} from 0", vertices.len());
            Fault::new(field, expected, got)
        })
    };
    let faults: Vec<Fault> = vertices.iter().enumerate().filter_map(unstable).collect();
    if faults.is_empty() { Ok(()) } else { Err(PrepareError::Faults(faults)) }
}

/// W, the box of the laws' ranges about their means.
pub(super) fn disturbance(problem: &Problem) -> Zonotope {
    let laws = &problem.disturbance;
    let half = |law: &ScalarLaw| {
        let ((low, high), mean) = (law.range(), law.mean());
        f64::max(high - mean, mean - low)
    };
    let centre = DVector::from_iterator(laws.len(), laws.iter().map(ScalarLaw::mean));
    let half = DVector::from_iterator(laws.len(), laws.iter().map(half));
    Zonotope::new(centre, DMatrix::from_diagonal(&half))
}

/// {E[w]}.
pub(super) fn expected_disturbance(problem: &Problem) -> Zonotope {
    let centre = disturbance(problem).centre().clone();
    let none = DMatrix::zeros(centre.len(), 0);
    Zonotope::new(centre, none)
}

fn plant_vertices<'a>(
    gain: &DMatrix<f64>,
    vertices: &[PlantMatrices],
    images: &'a [Zonotope],
    with_input: bool,
) -> Vec<PlantVertex<'a>> {
    let vertex = |(vertex, image): (&PlantMatrices, &'a Zonotope)| PlantVertex {
        a: &vertex.a + product(&vertex.b, gain),
        b: if with_input { vertex.b.clone() } else { DMatrix::zeros(vertex.a.nrows(), 0) },
        disturbance: image,
    };
    vertices.iter().zip(images).map(vertex).collect()
}

/// Q, R, and P with equality in [Mammarella2019, eq. 3]: over samples of the plant, or for the
/// expected plant where nothing is sampled.
fn weights(
    problem: &Problem,
    gain: &DMatrix<f64>,
    budget: Budget<'_>,
) -> Result<StageWeights, PrepareError> {
    let closed_loop = |step: PlantMatrices| step.a + product(&step.b, gain);
    let sampled = |sample: usize| {
        let mut stream = Stream::new(problem.seed, TERMINAL_STREAM, sample as u64);
        closed_loop(problem.plant.draw(&mut stream))
    };
    let loops: Vec<DMatrix<f64>> = match problem.scheme {
        Scheme::OfflineSampling => {
            let samples = (0..problem.weights.samples).map(|sample| {
                budget.check()?;
                Ok(sampled(sample))
            });
            samples.collect::<Result<_, Interruption>>()?
        }
        Scheme::LinearQuadratic | Scheme::TubeRobust => vec![closed_loop(problem.plant.at_mean())],
    };
    let (state, input) = (problem.weights.state.clone(), problem.weights.input.clone());
    let terminal = terminal_cost(&state, &input, gain, &loops, budget).map_err(|error| {
        if let TerminalCostError::Interrupted(why) = error {
            return why.into();
        }
        let expected = "a gain that is stable in the mean square";
        PrepareError::Faults(vec![Fault::new("gain", expected, error.to_string())])
    })?;
    Ok(StageWeights { state, input, terminal })
}

pub(super) fn no_set(reason: &NoInterior) -> PrepareError {
    match reason {
        NoInterior::Interrupted(why) => (*why).into(),
        NoInterior::Numerical => {
            Failure::Numerical("no interior point of the constraints' set".into()).into()
        }
        NoInterior::Empty { margin, .. } => infeasible(format!(
            "no state and corrections satisfy all constraints: they miss by {margin}"
        )),
        NoInterior::Flat { room } => {
            infeasible(format!("the constraints leave no room: largest ball {room}"))
        }
    }
}

pub(super) fn infeasible(reason: String) -> PrepareError {
    PrepareError::Infeasible(Infeasibility {
        reason,
        horizon: 0,
        rows: Vec::new(),
        relaxations: Vec::new(),
        all_horizons_proved: true,
    })
}
