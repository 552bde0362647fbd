//! The regulator (23) of one step: its forces, and what its rows mean.

use nalgebra::{DMatrix, Vector3};

use super::step::Here;
use crate::{
    control::ConstraintFamily,
    mission::ThrustMode,
    program::{RegulatorAnswer, RegulatorProgram, Softness, StateCut},
    sets::ZonotopeFacets,
};

/// The regulator's forces, in units of the strongest thruster.
pub(super) struct Regulator {
    steps: Vec<(nalgebra::SMatrix<f64, 6, 6>, nalgebra::SMatrix<f64, 6, 3>)>,
    shape: ZonotopeFacets,
    origin: Vector3<f64>,
    basis: DMatrix<f64>,
    facet_offsets: nalgebra::DVector<f64>,
    unit_n: f64,
    /// Most cuts of a stage.
    nearest: usize,
    /// Stage and place within it, of each cut.
    places: Vec<(usize, usize)>,
}

impl Regulator {
    pub(super) fn new(here: &Here<'_>, working: ThrustMode, cuts: &[StateCut]) -> Self {
        let mut places: Vec<(usize, usize)> = Vec::with_capacity(cuts.len());
        for cut in cuts {
            let place = match places.last() {
                Some(&(stage, place)) if stage == cut.stage => place + 1,
                _ => 0,
            };
            places.push((cut.stage, place));
        }
        let n = here.problem.prediction_horizon;
        let steps = (here.k..here.k + n).map(|i| here.prepared.plant.step(i));
        let thrusters = &here.problem.thrusters;
        let shape = if working == thrusters.nominal() {
            here.nominal.clone()
        } else {
            thrusters.admissible(working).facets()
        };
        let unit_n = thrusters.list().iter().map(|t| t.force_max().newtons()).fold(0.0, f64::max);
        Self {
            steps: steps.map(|step| (step.a, step.b)).collect(),
            origin: Vector3::from_fn(|i, _| shape.origin[i]),
            basis: &shape.basis * unit_n,
            facet_offsets: shape.facets.offsets() / unit_n,
            shape,
            unit_n,
            nearest: here.phase.safety.watch().map_or(0, |watch| watch.nearest),
            places,
        }
    }

    pub(super) fn program<'a>(
        &'a self,
        here: &'a Here<'_>,
        cuts: &'a [StateCut],
        softness: Option<Softness>,
    ) -> RegulatorProgram<'a> {
        RegulatorProgram {
            steps: &self.steps,
            initial: &here.x,
            stage_cost: &here.phase.weights.stage,
            terminal_cost: &here.phase.weights.terminal,
            input_cost: &here.phase.weights.input,
            origin: &self.origin,
            basis: &self.basis,
            facets: self.shape.facets.normals(),
            facet_offsets: &self.facet_offsets,
            cuts,
            softness,
        }
    }

    fn facets(&self) -> usize {
        self.facet_offsets.len()
    }

    /// What a row of the program means: family, stage, row within it.
    pub(super) fn name(&self, row: usize) -> (ConstraintFamily, usize, usize) {
        let facet_rows = self.facet_rows();
        if row < facet_rows {
            return (ConstraintFamily::Input, row / self.facets(), row % self.facets());
        }
        // Beyond the cuts come the signs of their violations.
        let (stage, place) = self.places[(row - facet_rows) % self.places.len()];
        (ConstraintFamily::State, stage, place)
    }

    fn facet_rows(&self) -> usize {
        self.steps.len() * self.facets()
    }

    /// Active rows as the next step names them: every stage one earlier, cuts as if each stage had
    /// as many as it may. A guess, which the solver does not have to trust.
    pub(super) fn handed_on(&self, answer: &RegulatorAnswer) -> Vec<usize> {
        let (facet_rows, facets) = (self.facet_rows(), self.facets());
        let earlier = |row: usize| {
            if row < facet_rows {
                return row.checked_sub(facets);
            }
            let (stage, place) = *self.places.get(row - facet_rows)?;
            (stage > 1).then(|| facet_rows + (stage - 2) * self.nearest + place)
        };
        answer.active.iter().filter_map(|active| earlier(active.row)).collect()
    }

    /// The rows that the last step handed on.
    pub(super) fn received(&self, named: &[usize]) -> Vec<usize> {
        let facet_rows = self.facet_rows();
        let row = |&name: &usize| {
            if name < facet_rows {
                return Some(name);
            }
            let nearest = self.nearest.max(1);
            let place = ((name - facet_rows) / nearest + 1, (name - facet_rows) % nearest);
            self.places.binary_search(&place).ok().map(|cut| facet_rows + cut)
        };
        named.iter().filter_map(row).collect()
    }

    /// Distances to the facets in units of the strongest thruster, and to the plane of forces.
    pub(super) fn margins(&self, force_n: &Vector3<f64>) -> Vec<f64> {
        let from = (force_n - self.origin) / self.unit_n;
        let basis = &self.shape.basis;
        let w = nalgebra::DVector::from_fn(basis.ncols(), |c, _| {
            (0..3).map(|i| basis[(i, c)] * from[i]).sum()
        });
        let inside = basis * &w;
        let off_plane = (from - Vector3::from_fn(|i, _| inside[i])).norm();
        let normals = self.shape.facets.normals();
        let distances = (0..self.facets()).map(|f| {
            self.facet_offsets[f] - (0..w.len()).map(|c| normals[(f, c)] * w[c]).sum::<f64>()
        });
        distances.chain([-off_plane]).collect()
    }
}
