//! What is computed before flight, in shards.

use nalgebra::{DMatrix, DVector};

use super::{Artifact, Problem, Redundancy, Summary, problem::GainChoice};
use crate::{
    budget::Budget,
    control::{Failure, Fault, Infeasibility, PrepareError},
    dynamics::{
        ExpectedCost, PlantMatrices, StageWeights, linear_quadratic_regulator, spectral_radius,
        terminal_cost,
    },
    matrices::product,
    reach::{
        EXACT, GrowthError, HalfSpaces, Invariant, NoInterior, PlantVertex, SampledRows, Scenario,
        StageConstraints, StageGroup, grow_control_invariant, irredundant,
        max_robust_positive_invariant, step_back,
    },
    sampling::{ScalarLaw, Stream, failure_of_any},
    sets::Zonotope,
};

/// Stream of the samples of the expected cost, apart from those of the groups.
const COST_STREAM: u64 = u64::MAX;
/// Stream of the samples of the terminal weight.
const TERMINAL_STREAM: u64 = u64::MAX - 1;

/// Part of an artifact.
#[derive(Debug, Clone, PartialEq)]
pub enum Shard {
    /// The rows of one group that are needed beside the context.
    Rows(SampledRows),
    /// The expected cost.
    Cost(ExpectedCost),
}

/// What every shard needs: cheap to make again.
struct Design {
    gain: DMatrix<f64>,
    weights: StageWeights,
    vertices: Vec<PlantMatrices>,
    /// B_w W at each vertex.
    images: Vec<Zonotope>,
    constraints: StageConstraints,
    groups: Vec<StageGroup>,
    sizes: Vec<usize>,
}

impl Design {
    fn new(problem: &Problem, budget: Budget<'_>) -> Result<Self, PrepareError> {
        let faults = problem.faults();
        if !faults.is_empty() {
            return Err(PrepareError::Faults(faults));
        }
        let gain = gain(problem)?;
        let vertices = vertices(problem)?;
        for vertex in &vertices {
            let radius = spectral_radius(&(&vertex.a + product(&vertex.b, &gain)));
            if !(radius < 1.0) {
                let expected = "a gain that stabilises every vertex of the plant";
                let fault = Fault::new("gain", expected, format!("spectral radius {radius}"));
                return Err(PrepareError::Faults(vec![fault]));
            }
        }
        let images = images(problem, &vertices);
        let terminal = terminal_set(problem, &gain, &vertices, &images, budget)?;
        let weights = weights(problem, &gain)?;
        Ok(Self {
            weights,
            images,
            constraints: StageConstraints {
                state: HalfSpaces::from_polytope(&problem.state_set),
                input: HalfSpaces::from_polytope(&problem.input_set),
                terminal,
            },
            groups: problem.groups(),
            sizes: problem.sizes(),
            gain,
            vertices,
        })
    }

    fn scenario<'a>(&'a self, problem: &'a Problem) -> Scenario<'a> {
        Scenario {
            plant: &problem.plant,
            disturbance: &problem.disturbance,
            gain: &self.gain,
            horizon: problem.horizon,
            constraints: &self.constraints,
            groups: &self.groups,
            sizes: &self.sizes,
            seed: problem.seed,
        }
    }

    fn plant_vertices(&self, with_input: bool) -> Vec<PlantVertex<'_>> {
        plant_vertices(&self.gain, &self.vertices, &self.images, with_input)
    }
}

pub(super) fn run_shard(
    problem: &Problem,
    shard: usize,
    budget: Budget<'_>,
) -> Result<Shard, PrepareError> {
    let design = Design::new(problem, budget)?;
    let scenario = design.scenario(problem);
    if shard < design.groups.len() {
        let context = scenario.context(budget).map_err(|reason| no_set(&reason))?;
        let rows = scenario.survivors(shard, &context, budget);
        return rows.map(Shard::Rows).map_err(|reason| no_set(&reason));
    }
    let (n, m) = problem.dimensions();
    let mut cost = ExpectedCost::new(n + problem.horizon * m + 1);
    for sample in 0..problem.weights.samples {
        budget.check()?;
        let prediction = scenario.prediction(COST_STREAM, sample, problem.horizon);
        cost.add(&prediction, &design.weights);
    }
    Ok(Shard::Cost(cost))
}

pub(super) fn merge(problem: &Problem, shards: &[Shard]) -> Result<Artifact, PrepareError> {
    let budget = Budget::UNLIMITED;
    let design = Design::new(problem, budget)?;
    let scenario = design.scenario(problem);
    let context = scenario.context(budget).map_err(|reason| no_set(&reason))?;
    let mut survivors = Vec::new();
    let mut cost = None;
    for shard in shards {
        match shard {
            Shard::Rows(rows) => survivors.push(rows.clone()),
            Shard::Cost(part) => cost = Some(part.mean()),
        }
    }
    let (Some(cost), true) = (cost, survivors.len() == design.groups.len()) else {
        return Err(Failure::Numerical("shards are missing".into()).into());
    };
    let tolerance = match problem.redundancy {
        Redundancy::Exact => EXACT,
        Redundancy::InnerScaled { epsilon } => epsilon,
    };
    let (sampled, reduction) = Scenario::merged(&context, &survivors, tolerance, budget)
        .map_err(|reason| no_set(&reason))?;
    let (first_step, grown) = first_step_rows(problem, &design, &sampled.rows)?;
    let claims = problem.claims(design.constraints.terminal.len());
    let summary = Summary {
        terminal_rows: design.constraints.terminal.len(),
        sampled_rows: scenario.row_count(),
        kept_rows: sampled.rows.len(),
        doubtful_rows: reduction.doubtful,
        outer_excess: reduction.outer_excess,
        first_step_rows: first_step.len(),
        first_step_limited: grown.1,
        samples: design.sizes.iter().sum(),
        joint_confidence: problem
            .samples
            .size
            .is_none()
            .then(|| 1.0 - failure_of_any(claims, problem.samples.confidence_complement)),
        gain: design.gain,
        terminal_weight: design.weights.terminal,
    };
    let origins = sampled.groups.iter().map(|&group| Some(design.groups[group]));
    let origins = origins.chain(std::iter::repeat_n(None, first_step.len())).collect();
    let mut rows = sampled.rows;
    rows.extend(&first_step);
    Artifact::assemble(problem.clone(), summary, cost, rows, origins, grown.0)
        .map_err(|text| Failure::Numerical(text).into())
}

/// D_R: every successor lies in the grown set; without rows that D makes redundant.
/// [Mammarella2019, eq. 15]
fn first_step_rows(
    problem: &Problem,
    design: &Design,
    sampled: &HalfSpaces,
) -> Result<(HalfSpaces, (HalfSpaces, bool)), PrepareError> {
    let budget = Budget::UNLIMITED;
    let vertices = design.plant_vertices(true);
    let growth = grow_control_invariant(
        &design.constraints.terminal,
        sampled,
        &vertices,
        problem.growth,
        budget,
    )
    .map_err(|error| match error {
        GrowthError::Seed(reason) => no_set(&reason),
        GrowthError::Interrupted(why) => why.into(),
        other => Failure::Numerical(format!("the first-step set: {other:?}")).into(),
    })?;
    let mut rows = HalfSpaces::new(sampled.dimension());
    let mut normal = vec![0.0; sampled.dimension()];
    let successors = step_back(&growth.set, &vertices);
    for row in 0..successors.len() {
        let known = successors.normal(row);
        normal[..known.len()].copy_from_slice(known);
        rows.push(&normal, successors.offset(row));
    }
    let kept = irredundant(&rows, sampled, EXACT, budget).map_err(|reason| no_set(&reason))?.kept;
    Ok((rows.select(&kept), (growth.set, growth.limited)))
}

fn gain(problem: &Problem) -> Result<DMatrix<f64>, PrepareError> {
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

fn vertices(problem: &Problem) -> Result<Vec<PlantMatrices>, PrepareError> {
    let given = problem.vertices.clone().filter(|vertices| !vertices.is_empty());
    given.or_else(|| problem.plant.corners()).ok_or_else(|| {
        let expected = "given vertices where more than twelve parameters vary";
        PrepareError::Faults(vec![Fault::new("vertices", expected, "none")])
    })
}

/// B_w W at each vertex, W the box of the laws' ranges.
fn images(problem: &Problem, vertices: &[PlantMatrices]) -> Vec<Zonotope> {
    let ranges: Vec<(f64, f64)> = problem.disturbance.iter().map(ScalarLaw::range).collect();
    let centre = DVector::from_iterator(ranges.len(), ranges.iter().map(|r| 0.5 * (r.0 + r.1)));
    let half = DVector::from_iterator(ranges.len(), ranges.iter().map(|r| 0.5 * (r.1 - r.0)));
    let all = Zonotope::new(centre, DMatrix::from_diagonal(&half));
    vertices.iter().map(|vertex| all.linear_map(&vertex.b_w)).collect()
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

/// The largest robust invariant set of u = K x in the state and input constraints.
fn terminal_set(
    problem: &Problem,
    gain: &DMatrix<f64>,
    vertices: &[PlantMatrices],
    images: &[Zonotope],
    budget: Budget<'_>,
) -> Result<HalfSpaces, PrepareError> {
    let mut rows = HalfSpaces::from_polytope(&problem.state_set);
    let fed_back = product(problem.input_set.normals(), gain);
    for (row, offset) in fed_back.row_iter().zip(problem.input_set.offsets().iter()) {
        rows.push(&row.iter().copied().collect::<Vec<_>>(), *offset);
    }
    let vertices = plant_vertices(gain, vertices, images, false);
    match max_robust_positive_invariant(&rows, &vertices, problem.terminal_limits, budget) {
        Invariant::Found { set, .. } => Ok(set),
        Invariant::Interrupted(why) => Err(why.into()),
        Invariant::Empty { iterations, .. } => Err(infeasible(format!(
            "no set around the target stays in the constraints under the gain: nothing is \
                 left after {iterations} steps back"
        ))),
        Invariant::Undecided { iterations, rows } => {
            let got = format!("undecided after {iterations} steps back with {rows} rows");
            let expected = "limits under which the terminal set is found or excluded";
            Err(PrepareError::Faults(vec![Fault::new("terminal_limits", expected, got)]))
        }
    }
}

fn weights(problem: &Problem, gain: &DMatrix<f64>) -> Result<StageWeights, PrepareError> {
    let closed_loop = |sample: usize| {
        let mut stream = Stream::new(problem.seed, TERMINAL_STREAM, sample as u64);
        let step = problem.plant.draw(&mut stream);
        step.a + product(&step.b, gain)
    };
    let loops: Vec<DMatrix<f64>> = (0..problem.weights.samples).map(closed_loop).collect();
    let (state, input) = (problem.weights.state.clone(), problem.weights.input.clone());
    let terminal = terminal_cost(&state, &input, gain, &loops).map_err(|error| {
        let expected = "a gain that is stable in the mean square";
        PrepareError::Faults(vec![Fault::new("gain", expected, error.to_string())])
    })?;
    Ok(StageWeights { state, input, terminal })
}

fn no_set(reason: &NoInterior) -> PrepareError {
    match reason {
        NoInterior::Interrupted(why) => (*why).into(),
        NoInterior::Numerical => {
            Failure::Numerical("no interior point of the sampled set".into()).into()
        }
        NoInterior::Empty { margin, .. } => infeasible(format!(
            "no state and corrections satisfy all samples: they miss by {margin}"
        )),
        NoInterior::Flat { room } => {
            infeasible(format!("the sampled set leaves no room: largest ball {room}"))
        }
    }
}

fn infeasible(reason: String) -> PrepareError {
    PrepareError::Infeasible(Infeasibility {
        reason,
        horizon: 0,
        rows: Vec::new(),
        relaxations: Vec::new(),
        all_horizons_proved: true,
    })
}
