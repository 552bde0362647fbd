//! The mission as a value: what is asked of an offline-sampling controller.

use nalgebra::DMatrix;

use super::sampled::TERMINAL_PARTS;
use crate::{
    control::Fault,
    dynamics::{Discretisation, PlantMatrices, UncertainPlant},
    reach::{GrowthLimits, InvariantLimits, StageFamily, StageGroup},
    sampling::{ScalarLaw, VIOLATION_MAX, sample_size},
    sets::Polytope,
};

/// A mission; the target is the origin of the state's coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Which controller.
    pub scheme: Scheme,
    /// What is controlled.
    pub plant: UncertainPlant,
    /// What the components of its state and input are.
    pub coordinates: Coordinates,
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
    /// H_x x <= h_x, each row with its probability; the baselines know no probability.
    pub state_set: Polytope,
    /// H_u u <= h_u, always.
    pub input_set: Polytope,
    /// How many samples; read with [`Scheme::OfflineSampling`] only.
    pub samples: SampleChoice,
    /// What becomes of rows that do not matter; read with [`Scheme::OfflineSampling`] only.
    pub redundancy: Redundancy,
    /// How far the terminal set, and the tube of [`Scheme::TubeRobust`], are searched.
    pub terminal_limits: InvariantLimits,
    /// How far the first-step set grows; `None`: no such set, and no promise that every step has
    /// an answer. Read with [`Scheme::OfflineSampling`] only.
    pub first_step: Option<GrowthLimits>,
    /// All chance follows from this.
    pub seed: u64,
}

/// What the components of state and input are. The mathematics is the same; whoever measures and
/// thrusts has to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coordinates {
    /// Anything.
    General,
    /// State [x, y, x', y'] in m and m/s in a plane at rest, input force in N.
    Planar,
    /// State position and velocity in RTN in m and m/s, input force in N.
    Rtn,
}

/// Which controller: the method, or one of the two that [Mammarella2019, table III] compares it
/// with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheme {
    /// Chance constraints, sampled offline.
    OfflineSampling,
    /// The plant at expected parameters and without disturbance, all constraints as they are: not
    /// robust, as a contrast.
    LinearQuadratic,
    /// A nominal trajectory with tightened constraints inside an invariant tube that holds every
    /// plant and disturbance: robust, whatever the law of either.
    TubeRobust,
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
    /// Most rows of all groups together, before any is removed.
    pub rows_max: usize,
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

    /// Components of d: T m corrections, and n more of the place in the tube.
    pub(super) fn decisions(&self) -> usize {
        let (n, m) = self.dimensions();
        let place = if self.scheme == Scheme::TubeRobust { n } else { 0 };
        self.horizon.saturating_mul(m).saturating_add(place)
    }

    /// Seconds between steps, where the plant says so.
    #[must_use]
    pub fn sample_time_s(&self) -> Option<f64> {
        match self.plant.discretisation {
            Discretisation::None => None,
            Discretisation::ZeroOrderHold { sample_time_s }
            | Discretisation::Euler { sample_time_s } => Some(sample_time_s),
        }
    }

    /// The groups of constraints, in their order.
    #[must_use]
    pub fn groups(&self) -> Vec<StageGroup> {
        // A tube bounds what acts on the state by the state set, so the state must start there.
        let at_start = self.scheme == Scheme::TubeRobust || self.samples.state_at_start;
        StageGroup::all(self.horizon, at_start)
    }

    /// d of the sample size of a group: x and the corrections that meet chance before its stage.
    fn variables(&self, group: &StageGroup) -> usize {
        let (n, m) = self.dimensions();
        n + group.stage * m
    }

    /// Samples of each group; the sizes were checked by [`Problem::faults`].
    pub(super) fn sizes(&self) -> Vec<usize> {
        let size = |group: &StageGroup| {
            let variables = self.samples.variables.unwrap_or(self.variables(group));
            let bound =
                sample_size(variables, self.samples.violation, self.samples.confidence_complement);
            self.samples.size.or(bound.ok()).unwrap_or(0)
        };
        self.groups().iter().map(size).collect()
    }

    /// Does every group have the samples that the bound asks for?
    pub(super) fn sampled_by_the_bound(&self) -> bool {
        let most = self.groups().iter().map(|group| self.variables(group)).max().unwrap_or(0);
        self.samples.size.is_none() && self.samples.variables.is_none_or(|given| given >= most)
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

    /// The sampled rows with their state and decisions: those of one part while it is sifted, what is
    /// left of all, and the expected cost. How many terminal rows there are shows only when they are
    /// made: here stands a rule of thumb, and no more than may be drawn at all.
    pub(super) fn memory_bytes(&self) -> usize {
        /// Of the part that is reduced: as sampled, in two orders, with the context, and three times
        /// in coordinates that make the set round.
        const PART_COPIES: usize = 6;
        /// What a row has beside its entries, as numbers.
        const BESIDE: usize = 6;
        let (n, m) = self.dimensions();
        let columns = self.horizon.saturating_mul(m).saturating_add(2 * n + 1);
        let (state, input) = (self.state_set.offsets().len(), self.input_set.offsets().len());
        // How many faces the terminal set has is known once it is found: as a rule up to n times
        // those of the constraints.
        let terminal = (state + input).saturating_mul(n).min(self.terminal_limits.rows_max);
        let (mut all, mut largest) = (0_usize, 0);
        if self.scheme == Scheme::OfflineSampling {
            for (group, size) in self.groups().iter().zip(self.sizes()) {
                let (faces, parts) = match group.family {
                    StageFamily::State => (state, 1),
                    StageFamily::Input => (input, 1),
                    StageFamily::Terminal => (terminal, TERMINAL_PARTS),
                };
                let rows = size.saturating_mul(faces).min(self.samples.rows_max);
                all = all.saturating_add(rows);
                largest = largest.max(rows.div_ceil(parts));
            }
        }
        // All of them stand for what is left of every part and the copies of that.
        let rows = largest.saturating_mul(PART_COPIES).saturating_add(all);
        let numbers = rows.saturating_mul(columns.saturating_add(BESIDE));
        numbers.saturating_add(columns.saturating_mul(columns)).saturating_mul(size_of::<f64>())
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
        if let Some(i) = self.disturbance.iter().position(|law| law.check().is_err()) {
            faults.push(Fault::new(format!("disturbance[{i}]"), "a sound law", "none"));
        }
        if self.scheme == Scheme::OfflineSampling {
            faults.extend(self.chance_faults());
        }
        faults
    }

    fn chance_faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        let SampleChoice { violation, confidence_complement, variables, size, .. } = self.samples;
        // The two are checked apart, so that both are named where both are wrong.
        if let Err(error) = sample_size(1, violation, 0.5) {
            let got = violation.to_string();
            faults.push(Fault::new("samples.violation", error.to_string(), got));
        }
        if let Err(error) = sample_size(1, 0.5 * VIOLATION_MAX, confidence_complement) {
            let got = confidence_complement.to_string();
            faults.push(Fault::new("samples.confidence_complement", error.to_string(), got));
        }
        for (field, count) in [("samples.size", size), ("samples.variables", variables)] {
            if count == Some(0) {
                faults.push(Fault::new(field, "at least 1", "0"));
            }
        }
        if let Redundancy::InnerScaled { epsilon } = self.redundancy
            && !(epsilon > 0.0 && epsilon < 1.0)
        {
            let got = epsilon.to_string();
            faults.push(Fault::new("redundancy.inner_scaled.epsilon", "between 0 and 1", got));
        }
        faults
    }
}
