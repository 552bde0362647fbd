//! The mission as a value: what is asked of an offline-sampling controller.

use nalgebra::DMatrix;

use crate::{
    control::Fault,
    dynamics::{PlantMatrices, UncertainPlant},
    reach::{GrowthLimits, InvariantLimits, StageFamily, StageGroup},
    sampling::{ScalarLaw, sample_size},
    sets::Polytope,
};

/// A mission; the target is the origin of the state's coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// What is controlled.
    pub plant: UncertainPlant,
    /// Plants whose hull holds every plant; `None`: the corners of the parameters' box.
    pub vertices: Option<Vec<PlantMatrices>>,
    /// Law of each component of w.
    pub disturbance: Vec<ScalarLaw>,
    /// T >= 1.
    pub horizon: usize,
    /// How K is found.
    pub gain: GainChoice,
    /// Q and R; P follows.
    pub weights: CostWeights,
    /// H_x x <= h_x, each row with its probability.
    pub state_set: Polytope,
    /// H_u u <= h_u, always.
    pub input_set: Polytope,
    /// How many samples.
    pub samples: SampleChoice,
    /// What becomes of rows that do not matter.
    pub redundancy: Redundancy,
    /// How far the terminal set is searched.
    pub terminal_limits: InvariantLimits,
    /// How far the first-step set grows.
    pub growth: GrowthLimits,
    /// All chance follows from this.
    pub seed: u64,
}

/// How K of u = K x + v is found.
#[derive(Debug, Clone, PartialEq)]
pub enum GainChoice {
    /// Given, m x n.
    Explicit(DMatrix<f64>),
    /// The regulator of the plant at expected parameters.
    Lqr {
        /// n x n.
        state: DMatrix<f64>,
        /// m x m.
        input: DMatrix<f64>,
    },
}

/// Weights of the expected cost.
#[derive(Debug, Clone, PartialEq)]
pub struct CostWeights {
    /// Q, n x n, positive definite.
    pub state: DMatrix<f64>,
    /// R, m x m, positive definite.
    pub input: DMatrix<f64>,
    /// Samples of the expectation.
    pub samples: usize,
}

/// How many samples each group gets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampleChoice {
    /// epsilon in (0, 0.14): probability with which a constraint may be violated.
    pub violation: f64,
    /// delta in (0, 1): a group's set is wrong with at most this probability.
    pub confidence_complement: f64,
    /// d of the sample size; `None`: n + l m at stage l, as the proof asks.
    pub variables: Option<usize>,
    /// The number itself, without a guarantee; `None`: from the bound.
    pub size: Option<usize>,
    /// Rows of the state at stage 0 too.
    pub state_at_start: bool,
}

/// What becomes of rows that do not matter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Redundancy {
    /// Only rows that change nothing are removed.
    Exact,
    /// Rows that cut off less than epsilon are removed too, and the rest is moved inwards by as
    /// much: an inner set.
    InnerScaled {
        /// epsilon > 0, relative to the distance from an interior point.
        epsilon: f64,
    },
}

impl Problem {
    /// n and m.
    #[must_use]
    pub fn dimensions(&self) -> (usize, usize) {
        (self.plant.states(), self.plant.inputs())
    }

    /// The sampled groups, in their order.
    #[must_use]
    pub fn groups(&self) -> Vec<StageGroup> {
        StageGroup::all(self.horizon, self.samples.state_at_start)
    }

    /// Samples of each group; the sizes were checked by [`Problem::faults`].
    pub(super) fn sizes(&self) -> Vec<usize> {
        let (n, m) = self.dimensions();
        let size = |group: &StageGroup| {
            let variables = self.samples.variables.unwrap_or(n + group.stage * m);
            let bound =
                sample_size(variables, self.samples.violation, self.samples.confidence_complement);
            self.samples.size.or(bound.ok()).unwrap_or(0)
        };
        self.groups().iter().map(size).collect()
    }

    /// Chance constraints that the sampled sets speak of: one a row and stage, states and terminal.
    pub(super) fn claims(&self, terminal_rows: usize) -> usize {
        let rows = |group: &StageGroup| match group.family {
            StageFamily::State => self.state_set.offsets().len(),
            StageFamily::Input => self.input_set.offsets().len(),
            StageFamily::Terminal => terminal_rows,
        };
        self.groups().iter().map(rows).sum()
    }

    /// Everything that can be seen to be wrong before computing.
    pub(super) fn faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        if let Err(error) = self.plant.check() {
            faults.push(Fault::new("plant", "matrices that fit each other", error.to_string()));
            return faults;
        }
        let (n, m) = self.dimensions();
        let p = self.plant.disturbances();
        let mut expect = |field: &str, expected: String, got: String| {
            if expected != got {
                faults.push(Fault::new(field, expected, got));
            }
        };
        let shape = |matrix: &DMatrix<f64>| format!("{} x {}", matrix.nrows(), matrix.ncols());
        expect("weights.state", format!("{n} x {n}"), shape(&self.weights.state));
        expect("weights.input", format!("{m} x {m}"), shape(&self.weights.input));
        match &self.gain {
            GainChoice::Explicit(gain) => {
                expect("gain.explicit", format!("{m} x {n}"), shape(gain))
            }
            GainChoice::Lqr { state, input } => {
                expect("gain.lqr.state", format!("{n} x {n}"), shape(state));
                expect("gain.lqr.input", format!("{m} x {m}"), shape(input));
            }
        }
        for (field, set, columns) in
            [("state_set", &self.state_set, n), ("input_set", &self.input_set, m)]
        {
            let got = format!("{} columns", set.normals().ncols());
            expect(field, format!("{columns} columns"), got);
        }
        let laws = format!("{} laws", self.disturbance.len());
        expect("disturbance", format!("{p} laws"), laws);
        for vertex in self.vertices.iter().flatten() {
            expect("vertices.a", format!("{n} x {n}"), shape(&vertex.a));
            expect("vertices.b", format!("{n} x {m}"), shape(&vertex.b));
            expect("vertices.b_w", format!("{n} x {p}"), shape(&vertex.b_w));
        }
        let positive = |value: usize| if value > 0 { "at least 1".into() } else { "0".to_owned() };
        expect("horizon", "at least 1".into(), positive(self.horizon));
        expect("weights.samples", "at least 1".into(), positive(self.weights.samples));
        faults.extend(self.chance_faults());
        faults
    }

    fn chance_faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        if let Some(i) = self.disturbance.iter().position(|law| law.check().is_err()) {
            faults.push(Fault::new(format!("disturbance[{i}]"), "a sound law", "none"));
        }
        let SampleChoice { violation, confidence_complement, size, .. } = self.samples;
        if let Err(error) = sample_size(1, violation, confidence_complement) {
            let got = format!("{violation}, {confidence_complement}");
            faults.push(Fault::new("samples", error.to_string(), got));
        }
        if size == Some(0) {
            faults.push(Fault::new("samples.size", "at least 1", "0"));
        }
        if let Redundancy::InnerScaled { epsilon } = self.redundancy
            && !(epsilon > 0.0 && epsilon < 1.0)
        {
            let got = epsilon.to_string();
            faults.push(Fault::new("redundancy.epsilon", "between 0 and 1", got));
        }
        faults
    }
}
