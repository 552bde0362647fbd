//! Everything that can be known before flight.

use nalgebra::{DMatrix, DVector};

use super::{
    GainChoice, HillPlant, LinearPlant, PhysicalTrajectory, Plant, Problem, Scheme, Trajectory,
    encoding,
};
use crate::{
    budget::{Budget, Interruption},
    bytes::{DecodeError, Reader, Writer},
    control::{Fault, PrepareError, unread},
    dynamics::{
        GainError, HillScaling, clohessy_wiltshire, linear_quadratic_regulator, place_poles,
        spectral_radius,
    },
    matrices::product,
    mission::ConeFaces,
    program::PlantTables,
    reach::{Decrease, ReadError, Tube, TubeError},
    sets::{Polytope, Zonotope, ZonotopeMeasure},
    units::Seconds,
};

/// First bytes of an artifact of this method, with the version of the layout.
const MAGIC: &[u8; 8] = b"vbarVH\x00\x01";

/// Sizes beyond which no problem is prepared, nor read back: everything that is made of a problem,
/// on reading too, then takes a second or two at most. Far above the published missions (horizon
/// 122, 6 states, 12 generators).
const SIZES_MAX: Sizes =
    Sizes { states: 32, inputs: 32, generators: 96, rows: 256, horizon: 2_000, steps: 100_000 };

/// What the work on a problem grows with.
struct Sizes {
    states: usize,
    inputs: usize,
    generators: usize,
    /// Of each polytope.
    rows: usize,
    horizon: usize,
    steps: usize,
}

/// A prepared controller: plant, gain, tube, tightening, reference, cone.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    pub(super) problem: Problem,
    pub(super) model: Model,
    pub(super) gain: DMatrix<f64>,
    pub(super) closed_loop: DMatrix<f64>,
    spectral_radius: f64,
    pub(super) tube: Tube,
    pub(super) decrease: Decrease,
    pub(super) tables: PlantTables,
    /// Tightened bounds, horizon_usable x m.
    pub(super) input_lower: Vec<f64>,
    pub(super) input_upper: Vec<f64>,
    /// Rows on the input, q x m, and tightened right sides, horizon_usable x q.
    pub(super) input_normals: Vec<f64>,
    pub(super) input_offsets: Vec<f64>,
    pub(super) horizon_usable: usize,
    /// W, ready to measure by.
    pub(super) disturbance_measure: ZonotopeMeasure,
}

/// The scaled plant and what moves with it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Model {
    pub(super) a: DMatrix<f64>,
    pub(super) b: DMatrix<f64>,
    pub(super) disturbance: Zonotope,
    pub(super) sample_time: Option<Seconds>,
    pub(super) scaling: Option<HillScaling>,
    /// r(0), r(1), ...; a single one is held for ever.
    pub(super) reference: Vec<DVector<f64>>,
    pub(super) corridor: Corridor,
    input_lower: DVector<f64>,
    input_upper: DVector<f64>,
    input_set: Option<Polytope>,
}

/// State constraints.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Corridor {
    /// None.
    Free,
    /// Cone faces at steps 0, 1, ...; offsets scaled.
    Cone(Vec<ConeFaces>),
    /// The same at every step.
    Polytope(Polytope),
}

/// What a caller may want to know of an artifact; scaled units.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// A, n x n.
    pub a: DMatrix<f64>,
    /// B, n x m.
    pub b: DMatrix<f64>,
    /// K, m x n.
    pub gain: DMatrix<f64>,
    /// Largest modulus of an eigenvalue of A + B K.
    pub spectral_radius: f64,
    /// Guaranteed decrease of the cost a step.
    pub lambda_bar: f64,
    /// `lambda_bar` is exact, not a lower bound.
    pub lambda_bar_exact: bool,
    /// Terms kept of the infinite sums.
    pub series_terms: usize,
    /// The first neglected term is below this.
    pub series_tolerance: f64,
    /// Longest horizon whose tightened input set is not empty, at most `horizon_max`.
    pub horizon_usable: usize,
    /// Generators of W, n x p.
    pub disturbance_generators: DMatrix<f64>,
    /// Metres in one unit of position.
    pub position_unit_m: Option<f64>,
    /// Metres per second in one unit of velocity.
    pub velocity_unit_m_s: Option<f64>,
    /// Length of a step.
    pub sample_time_s: Option<f64>,
}

impl Artifact {
    /// Prepares a problem.
    ///
    /// # Errors
    /// [`PrepareError::Faults`] for what only the mathematics can see: dimensions that do not
    /// match, a loop that does not contract, poles that cannot be placed.
    pub fn prepare(problem: &Problem) -> Result<Self, PrepareError> {
        Self::prepare_within(problem, Budget::UNLIMITED)
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// As [`Artifact::prepare`]; [`PrepareError::Failure`] when interrupted.
    pub fn prepare_within(problem: &Problem, budget: Budget<'_>) -> Result<Self, PrepareError> {
        let faults = dimension_faults(problem);
        if !faults.is_empty() {
            return Err(PrepareError::Faults(faults));
        }
        let model = Model::new(problem, budget)?;
        let gain = choose_gain(&problem.gain, &model.a, &model.b)
            .map_err(|fault| PrepareError::Faults(vec![fault]))?;
        Self::assemble(problem.clone(), model, gain, budget)
    }

    fn assemble(
        problem: Problem,
        model: Model,
        gain: DMatrix<f64>,
        budget: Budget<'_>,
    ) -> Result<Self, PrepareError> {
        let closed_loop = &model.a + product(&model.b, &gain);
        let radius = spectral_radius(&closed_loop);
        let not_schur = |what: String| {
            let expected = "A + B K with all eigenvalues inside the unit circle";
            PrepareError::Faults(vec![Fault::new("gain", expected, what)])
        };
        if !(radius < 1.0) {
            return Err(not_schur(format!("largest modulus {radius}")));
        }
        let tube = Tube::new(&closed_loop, &gain, &model.disturbance, budget);
        let tube = tube.map_err(|error| match error {
            TubeError::NoContraction => not_schur(error.to_string()),
            TubeError::Interrupted(why) => why.into(),
        })?;
        let decrease = tube.decrease(problem.weights.fuel, problem.weights.tracking, budget)?;
        let disturbance_measure = model.disturbance.measure();
        let tables = PlantTables::within(&model.a, &model.b, problem.horizon_max, budget)?;
        let mut artifact = Self {
            problem,
            model,
            gain,
            closed_loop,
            spectral_radius: radius,
            tube,
            decrease,
            tables,
            input_lower: Vec::new(),
            input_upper: Vec::new(),
            input_normals: Vec::new(),
            input_offsets: Vec::new(),
            horizon_usable: 0,
            disturbance_measure,
        };
        artifact.tighten_inputs(budget)?;
        Ok(artifact)
    }

    /// V(j) = U less K S(j), for every stage until it is empty. [Quartullo2025a, eq. 20]
    fn tighten_inputs(&mut self, budget: Budget<'_>) -> Result<(), Interruption> {
        let m = self.tables.inputs();
        let horizon_max = self.problem.horizon_max;
        let widths = self.tube.input_half_widths(horizon_max, m);
        let tightened = self.is_tightened();
        let rows: Vec<(Vec<f64>, f64)> =
            self.model.input_set.as_ref().map_or_else(Vec::new, |set| {
                let normals = set.normals().row_iter().map(|row| row.iter().copied().collect());
                normals.zip(set.offsets().iter().copied()).collect()
            });
        self.input_normals = rows.iter().flat_map(|(normal, _)| normal.iter().copied()).collect();
        let mut margins = vec![0.0; rows.len()];
        for stage in 0..horizon_max {
            budget.check()?;
            let width = |i: usize| if tightened { widths[(stage, i)] } else { 0.0 };
            let lower: Vec<f64> = (0..m).map(|i| self.model.input_lower[i] + width(i)).collect();
            let upper: Vec<f64> = (0..m).map(|i| self.model.input_upper[i] - width(i)).collect();
            if lower.iter().zip(&upper).any(|(lower, upper)| lower > upper) {
                return Ok(());
            }
            self.input_lower.extend(lower);
            self.input_upper.extend(upper);
            for ((normal, offset), margin) in rows.iter().zip(&mut margins) {
                self.input_offsets.push(offset - *margin);
                if tightened {
                    *margin += self.tube.input_term(stage, normal);
                }
            }
            self.horizon_usable = stage + 1;
        }
        Ok(())
    }

    /// By how much an input lies outside U, if it does by more than rounding.
    pub(super) fn input_excess(&self, input: &DVector<f64>) -> Option<f64> {
        let bounds = self.model.input_lower.iter().zip(self.model.input_upper.iter());
        let beyond = bounds.zip(input.iter()).map(|((lower, upper), u)| (u - upper).max(lower - u));
        let rows = self.model.input_set.as_ref().map(|set| -set.margins(input).min());
        beyond.chain(rows).reduce(f64::max).filter(|&excess| excess > super::certify::TOLERANCE)
    }

    /// Largest magnitude of each input.
    pub(super) fn largest_inputs(&self) -> impl Iterator<Item = f64> {
        let bounds = self.model.input_lower.iter().zip(self.model.input_upper.iter());
        bounds.map(|(lower, upper)| lower.abs().max(upper.abs()))
    }

    /// Does the scheme reckon with disturbances?
    pub(super) fn is_tightened(&self) -> bool {
        self.problem.scheme != Scheme::Nominal
    }

    /// The mission.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    /// What a caller may want to know.
    #[must_use]
    pub fn summary(&self) -> Summary {
        Summary {
            a: self.model.a.clone(),
            b: self.model.b.clone(),
            gain: self.gain.clone(),
            spectral_radius: self.spectral_radius,
            lambda_bar: self.decrease.lambda_bar,
            lambda_bar_exact: self.decrease.exact,
            series_terms: self.tube.terms(),
            series_tolerance: self.tube.tolerance(),
            horizon_usable: self.horizon_usable,
            disturbance_generators: self.model.disturbance.generators().clone(),
            position_unit_m: self.model.scaling.map(|s| s.position_unit_m),
            velocity_unit_m_s: self.model.scaling.map(|s| s.velocity_unit_m_s),
            sample_time_s: self.model.sample_time.map(Seconds::seconds),
        }
    }

    /// SI values of a scaled trajectory; `None` for a general linear plant.
    #[must_use]
    pub fn physical(&self, trajectory: &Trajectory) -> Option<PhysicalTrajectory> {
        let scaling = self.model.scaling?;
        let states: Vec<_> = trajectory
            .states
            .row_iter()
            .map(|row| scaling.physical(&row.iter().copied().collect::<Vec<_>>()))
            .collect();
        Some(PhysicalTrajectory {
            positions_m: states.iter().map(|s| s.position_m.components).collect(),
            velocities_m_s: states.iter().map(|s| s.velocity_m_s.components).collect(),
            accelerations_m_s2: trajectory
                .inputs
                .row_iter()
                .map(|row| row.fixed_columns::<3>(0).transpose() * scaling.acceleration_unit_m_s2)
                .collect(),
        })
    }

    /// The bytes that a store keeps: problem, gain and a check value of what follows from them.
    ///
    /// Everything else is recomputed on reading, in the same fixed order of operations, so that
    /// no table can disagree with the problem it was made from.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.bytes(MAGIC);
        encoding::write_problem(&mut writer, &self.problem);
        self.write_found(&mut writer);
        writer.finish()
    }

    /// What was found for the problem: all that is not recomputed from it, and the check value.
    pub(super) fn write_found(&self, writer: &mut Writer) {
        writer.matrix(&self.gain);
        writer.number(self.decrease.lambda_bar);
        writer.count(self.tube.terms());
    }

    /// Reads and checks what [`Artifact::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for bytes that are not an artifact, and for an artifact whose recomputed
    /// guarantee differs from the stored one.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        Self::from_bytes_within(bytes, Budget::UNLIMITED).map_err(ReadError::uninterrupted)
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`ReadError`].
    pub fn from_bytes_within(bytes: &[u8], budget: Budget<'_>) -> Result<Self, ReadError> {
        let mut reader = Reader::new(bytes);
        if reader.bytes()? != MAGIC {
            return Err(reader.fault("not a variable-horizon artifact of this layout").into());
        }
        let problem = encoding::read_problem(&mut reader)?;
        let artifact = Self::read_found(problem, &mut reader, budget)?;
        reader.end()?;
        Ok(artifact)
    }

    /// Reads and checks what [`Artifact::write_found`] wrote.
    pub(super) fn read_found(
        problem: Problem,
        reader: &mut Reader<'_>,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let gain = reader.matrix()?;
        let (lambda_bar, terms) = (reader.number()?, reader.count()?);
        if let Some(fault) = dimension_faults(&problem).first() {
            return Err(reader.fault(format!("{}: {}", fault.field, fault.got)).into());
        }
        let model = Model::new(&problem, budget).map_err(|error| unread(error, reader))?;
        if gain.shape() != (model.b.ncols(), model.a.nrows()) {
            return Err(reader.fault("the gain does not fit the plant").into());
        }
        let artifact =
            Self::assemble(problem, model, gain, budget).map_err(|error| unread(error, reader))?;
        if artifact.decrease.lambda_bar.to_bits() != lambda_bar.to_bits()
            || artifact.tube.terms() != terms
        {
            return Err(reader
                .fault("the recomputed guarantee differs from the stored one")
                .into());
        }
        Ok(artifact)
    }
}

impl Model {
    /// # Errors
    /// A target that turns too often to follow it to the end of the longest mission.
    fn new(problem: &Problem, budget: Budget<'_>) -> Result<Self, PrepareError> {
        match &problem.plant {
            Plant::Hill(plant) => {
                let samples = problem.steps_max.saturating_add(problem.horizon_max) + 1;
                Self::hill(plant, samples, budget)
            }
            Plant::Linear(plant) => Ok(Self::linear(plant)),
        }
    }

    fn hill(plant: &HillPlant, needed: usize, budget: Budget<'_>) -> Result<Self, PrepareError> {
        let (a, b) = clohessy_wiltshire(plant.sample_angle.radians());
        let scaling = HillScaling::new(plant.mean_motion_rad_s, plant.acceleration_max.m_s2());
        let sample_time_s = plant.sample_angle.radians() / plant.mean_motion_rad_s;
        let motion = &plant.target;
        let samples = motion.samples(plant.mean_motion_rad_s, sample_time_s, needed, budget)?;
        if samples.len() < needed {
            return Err(PrepareError::Faults(vec![Fault::new(
                "hill.rotation.torque_free",
                format!("a motion slow enough to be followed for {needed} samples, or fewer steps"),
                format!("one that can be followed for {}", samples.len()),
            )]));
        }
        let reference = samples
            .iter()
            .map(|sample| {
                let position = sample.capture_point_m / scaling.position_unit_m;
                let velocity = sample.capture_velocity_m_s / scaling.velocity_unit_m_s;
                DVector::from_iterator(6, position.iter().chain(velocity.iter()).copied())
            })
            .collect();
        let corridor = plant.cone.map_or(Corridor::Free, |cone| {
            let port = |s: &crate::mission::TargetSample| s.docking_port_m;
            let faces = samples.iter().map(|s| cone.faces(port(s) / scaling.position_unit_m));
            Corridor::Cone(faces.collect())
        });
        budget.check()?;
        Ok(Self {
            disturbance: plant.disturbance.zonotope(&scaling, &a, &b),
            a,
            b,
            sample_time: Some(Seconds::from_seconds(sample_time_s)),
            scaling: Some(scaling),
            reference,
            corridor,
            input_lower: DVector::from_element(3, -1.0),
            input_upper: DVector::from_element(3, 1.0),
            input_set: None,
        })
    }

    fn linear(plant: &LinearPlant) -> Self {
        Self {
            a: plant.a.clone(),
            b: plant.b.clone(),
            disturbance: plant.disturbance.clone(),
            sample_time: plant.sample_time,
            scaling: None,
            reference: plant.reference.clone(),
            corridor: plant.state_set.clone().map_or(Corridor::Free, Corridor::Polytope),
            input_lower: plant.input_lower.clone(),
            input_upper: plant.input_upper.clone(),
            input_set: plant.input_set.clone(),
        }
    }

    /// r(t); `None` beyond the table.
    pub(super) fn reference(&self, t: usize) -> Option<&DVector<f64>> {
        if self.reference.len() == 1 { self.reference.first() } else { self.reference.get(t) }
    }

    /// Last step with a reference; `usize::MAX` if it is held for ever.
    pub(super) fn reference_end(&self) -> usize {
        if self.reference.len() == 1 { usize::MAX } else { self.reference.len() - 1 }
    }
}

fn choose_gain(
    choice: &GainChoice,
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
) -> Result<DMatrix<f64>, Fault> {
    let fault = |field: &str, error: &GainError| {
        Fault::new(field, "a gain that makes A + B K Schur", error.to_string())
    };
    match choice {
        GainChoice::Explicit(gain) => Ok(gain.clone()),
        GainChoice::Poles(poles) => {
            place_poles(a, b, poles).map_err(|error| fault("gain.poles", &error))
        }
        GainChoice::Lqr { state, input } => linear_quadratic_regulator(a, b, state, input)
            .map_err(|error| fault("gain.lqr", &error)),
    }
}

/// Sizes that must fit each other; the wire checks them too, a direct caller may not have.
fn dimension_faults(problem: &Problem) -> Vec<Fault> {
    let mut faults = size_faults(problem);
    let mut expect = |field: &str, expected: String, got: String| {
        if expected != got {
            faults.push(Fault::new(field, expected, got));
        }
    };
    let shape = |matrix: &DMatrix<f64>| format!("{} x {}", matrix.nrows(), matrix.ncols());
    let (n, m) = match &problem.plant {
        Plant::Hill(_) => (6, 3),
        Plant::Linear(plant) => (plant.a.nrows(), plant.b.ncols()),
    };
    match &problem.plant {
        Plant::Hill(plant) => {
            use crate::mission::DisturbanceSet::{Box, Generators};
            match &plant.disturbance {
                Box(widths) => {
                    let got = format!("{} values", widths.len());
                    expect("hill.disturbance.box.half_width_nd", "6 values".into(), got);
                }
                Generators(generators) => {
                    let got = format!("{} rows", generators.nrows());
                    expect("hill.disturbance.generators_nd", "6 rows".into(), got);
                }
                _ => {}
            }
        }
        Plant::Linear(plant) => {
            expect("linear.a", format!("{n} x {n}"), shape(&plant.a));
            expect("linear.b", format!("{n} x {m}"), shape(&plant.b));
            for (field, vector) in [
                ("linear.input_lower", &plant.input_lower),
                ("linear.input_upper", &plant.input_upper),
            ] {
                expect(field, format!("{m} values"), format!("{} values", vector.len()));
            }
            for (field, set, columns) in [
                ("linear.input_set", &plant.input_set, m),
                ("linear.state_set", &plant.state_set, n),
            ] {
                if let Some(set) = set {
                    let got = format!("{} columns", set.normals().ncols());
                    expect(field, format!("{columns} columns"), got);
                }
            }
            let got = format!("{} rows", plant.disturbance.generators().nrows());
            expect("linear.disturbance", format!("{n} rows"), got);
            for row in &plant.reference {
                expect(
                    "linear.reference",
                    format!("{n} columns"),
                    format!("{} columns", row.len()),
                );
            }
        }
    }
    match &problem.gain {
        GainChoice::Explicit(gain) => expect("gain.explicit", format!("{m} x {n}"), shape(gain)),
        GainChoice::Poles(poles) => {
            expect("gain.poles", format!("{n} values"), format!("{} values", poles.len()));
        }
        GainChoice::Lqr { state, input } => {
            expect("gain.lqr.state", format!("{n} x {n}"), shape(state));
            expect("gain.lqr.input", format!("{m} x {m}"), shape(input));
        }
    }
    faults.extend(table_faults(problem));
    faults
}

/// See [`Controller::memory_bytes`](crate::control::Controller::memory_bytes).
pub(super) fn memory_bytes(problem: &Problem) -> usize {
    /// Attitude, reference, faces of the cone and what each is made from.
    const SAMPLE_BYTES: usize = 640;
    /// Of Hill's disturbances but those given one by one.
    const GENERATORS: usize = 16;
    let (n, m, generators, samples) = match &problem.plant {
        Plant::Hill(plant) => {
            use crate::mission::DisturbanceSet::Generators;
            let generators = match &plant.disturbance {
                Generators(generators) => generators.ncols(),
                _ => GENERATORS,
            };
            (6, 3, generators, problem.steps_max.saturating_add(problem.horizon_max))
        }
        Plant::Linear(plant) => {
            let generators = plant.disturbance.generators().ncols();
            (plant.a.nrows(), plant.b.ncols(), generators, plant.reference.len())
        }
    };
    let kernel = problem.horizon_max.saturating_mul(m);
    let numbers = kernel.saturating_mul(kernel);
    let numbers = numbers.saturating_add(problem.horizon_max.saturating_mul(n).saturating_mul(n));
    numbers
        .saturating_mul(size_of::<f64>())
        .saturating_add(Tube::bytes_max(n, m, generators))
        .saturating_add(samples.saturating_mul(SAMPLE_BYTES))
}

/// Sizes that nobody needs and whose work would not end.
fn size_faults(problem: &Problem) -> Vec<Fault> {
    let mut faults = Vec::new();
    let mut limit = |field: &str, most: usize, got: usize| {
        if got > most {
            faults.push(Fault::new(field, format!("at most {most}"), got.to_string()));
        }
    };
    limit("horizon_max", SIZES_MAX.horizon, problem.horizon_max);
    limit("steps_max", SIZES_MAX.steps, problem.steps_max);
    match &problem.plant {
        Plant::Hill(plant) => {
            if let crate::mission::DisturbanceSet::Generators(generators) = &plant.disturbance {
                let field = "hill.disturbance.generators_nd";
                limit(field, SIZES_MAX.generators, generators.ncols());
            }
        }
        Plant::Linear(plant) => {
            limit("linear.a", SIZES_MAX.states, plant.a.nrows().max(plant.a.ncols()));
            limit("linear.b", SIZES_MAX.inputs, plant.b.ncols());
            let generators = plant.disturbance.generators().ncols();
            limit("linear.disturbance", SIZES_MAX.generators, generators);
            for (field, set) in
                [("linear.input_set", &plant.input_set), ("linear.state_set", &plant.state_set)]
            {
                limit(field, SIZES_MAX.rows, set.as_ref().map_or(0, |s| s.offsets().len()));
            }
        }
    }
    faults
}

/// Tables that must reach to the end of the longest mission.
fn table_faults(problem: &Problem) -> Vec<Fault> {
    let mut faults = Vec::new();
    if problem.horizon_max == 0 {
        faults.push(Fault::new("horizon_max", "at least 1", "0"));
    }
    let needed = problem.steps_max.saturating_add(problem.horizon_max).saturating_add(1);
    let (field, given) = match &problem.plant {
        Plant::Linear(plant) if plant.reference.len() != 1 => {
            ("linear.reference", plant.reference.len())
        }
        Plant::Hill(HillPlant { target: crate::mission::TargetMotion::Sampled(s), .. }) => {
            ("hill.rotation.sampled", s.len())
        }
        _ => return faults,
    };
    if given < needed {
        faults.push(Fault::new(
            field,
            format!("steps_max + horizon_max + 1 = {needed} samples, or fewer steps"),
            format!("{given} samples"),
        ));
    }
    faults
}
