//! What the constraints look like from one step: rows, offsets and references of the stages
//! ahead, built only as far as a horizon asks for them.

use nalgebra::{DVector, Vector3};

use super::{
    Scheme, TerminalPoint,
    artifact::{Artifact, Corridor},
};
use crate::{
    matrices::product,
    mission::{CONE_FACES, ConeFaces},
    program::{HorizonProgram, project_onto_polytope},
};

/// Share of an input's effect below which a generator of the fixed terminal set is left out.
const NEGLIGIBLE: f64 = 1e-10;

/// Data of stages 1 .. built ahead of step `step`; the layout is that of [`HorizonProgram`].
#[derive(Debug)]
pub(super) struct Stages<'a> {
    pub(super) artifact: &'a Artifact,
    pub(super) step: usize,
    initial: Vec<f64>,
    rows: usize,
    normals: Vec<f64>,
    offsets: Vec<f64>,
    references: Vec<f64>,
    built: usize,
}

/// Where a nominal trajectory must end.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Terminal {
    /// Centre, n values.
    pub(super) centre: Vec<f64>,
    /// p x n values, one generator after the other.
    pub(super) generators: Vec<f64>,
    /// State constraints hold at the last stage too.
    pub(super) constrain_last: bool,
}

impl Terminal {
    fn is_point(&self) -> bool {
        self.generators.is_empty()
    }
}

impl<'a> Stages<'a> {
    pub(super) fn new(artifact: &'a Artifact, step: usize, initial: &[f64]) -> Self {
        let rows = match &artifact.model.corridor {
            Corridor::Free => 0,
            Corridor::Cone(_) => CONE_FACES,
            Corridor::Polytope(set) => set.offsets().len(),
        };
        Self {
            artifact,
            step,
            initial: initial.to_vec(),
            rows,
            normals: Vec::new(),
            offsets: Vec::new(),
            references: Vec::new(),
            built: 0,
        }
    }

    /// Longest horizon from this step: inputs left by the tube, end of the reference.
    pub(super) fn horizon_limit(&self) -> usize {
        let table = self.artifact.model.reference_end().saturating_sub(self.step);
        self.artifact.horizon_usable.min(table)
    }

    /// Builds stages up to `last`.
    pub(super) fn extend_to(&mut self, last: usize) {
        for stage in self.built + 1..=last {
            if let Some(reference) = self.artifact.model.reference(self.step + stage) {
                self.references.extend(reference.iter());
            }
            self.append_rows(stage);
            self.built = stage;
        }
    }

    fn append_rows(&mut self, stage: usize) {
        let artifact = self.artifact;
        match &artifact.model.corridor {
            Corridor::Free => {}
            Corridor::Cone(faces) => {
                let faces = self.tightened_faces(&faces[self.step + stage], stage);
                for (normal, offset) in faces.normals.iter().zip(faces.offsets) {
                    self.normals.extend(normal.iter());
                    self.normals.extend([0.0; 3]);
                    self.offsets.push(offset);
                }
            }
            Corridor::Polytope(set) => {
                for (normal, offset) in set.normals().row_iter().zip(set.offsets().iter()) {
                    let normal: Vec<f64> = normal.iter().copied().collect();
                    self.offsets.push(offset - self.margin(&normal, stage));
                    self.normals.extend(normal);
                }
            }
        }
    }

    /// rho(h, S(stage)), or 0 for a scheme that does not reckon with disturbances.
    fn margin(&self, normal: &[f64], stage: usize) -> f64 {
        if !self.artifact.is_tightened() {
            return 0.0;
        }
        let terms = stage.min(self.artifact.tube.terms());
        (0..terms).map(|i| self.artifact.tube.state_term(i, normal)).sum()
    }

    /// X(k + j) less S(j): [Quartullo2025a, eq. 20].
    fn tightened_faces(&self, faces: &ConeFaces, stage: usize) -> ConeFaces {
        let mut tightened = *faces;
        if self.artifact.is_tightened() {
            let margins = self.artifact.tube.face_margins(&faces.normals, stage);
            for (offset, margin) in tightened.offsets.iter_mut().zip(margins) {
                *offset -= margin;
            }
        }
        tightened
    }

    /// Where the trajectory of length `horizon` ends in the problem with the terminal point, or,
    /// for the fixed terminal set, its set. `None` if the tightened state set is empty there.
    pub(super) fn terminal(&mut self, horizon: usize) -> Option<Terminal> {
        self.extend_to(horizon);
        let artifact = self.artifact;
        let reference = artifact.model.reference(self.step + horizon)?;
        if artifact.problem.scheme == Scheme::FixedTerminal {
            return self.fixed_terminal(horizon, reference);
        }
        let centre = match artifact.problem.terminal_point {
            TerminalPoint::Reference => reference.as_slice().to_vec(),
            TerminalPoint::Projection => self.project(horizon, reference, horizon)?,
        };
        Some(Terminal { centre, generators: Vec::new(), constrain_last: false })
    }

    /// r~(k + N) + Q(N) with Q(N) = S(inf) less S(N) = A_K^N W + A_K^(N+1) W + ...: the baseline
    /// of [Quartullo2025a, sec. V], after Richards and How (2006).
    fn fixed_terminal(&self, horizon: usize, reference: &DVector<f64>) -> Option<Terminal> {
        let artifact = self.artifact;
        let terms = artifact.tube.terms();
        let (last, in_all) = match artifact.problem.fixed_terminal_terms {
            None => (terms, terms),
            Some(kept) => {
                ((horizon + kept).min(terms), terms.min(kept + artifact.problem.horizon_max))
            }
        };
        let centre = match artifact.problem.terminal_point {
            TerminalPoint::Reference => reference.as_slice().to_vec(),
            TerminalPoint::Projection => self.project(horizon, reference, in_all)?,
        };
        // Generators that no input could tell from nothing only cost time. Without them the set is
        // an inner one, by less than 1e-8 of an input.
        let reach = artifact.tables.reach(horizon);
        let noticeable = |g: &[f64]| g.iter().zip(reach).any(|(g, r)| g.abs() > NEGLIGIBLE * r);
        let all = artifact.tube.sum(horizon..last);
        let kept = all.generators().as_slice().chunks_exact(reach.len()).filter(|g| noticeable(g));
        Some(Terminal {
            centre,
            generators: kept.flatten().copied().collect(),
            constrain_last: artifact.problem.terminal_point == TerminalPoint::Projection,
        })
    }

    /// The point of X(k + N) less S(`tube_terms`) nearest to the reference.
    /// [Quartullo2025a, eq. 21]
    fn project(
        &self,
        horizon: usize,
        reference: &DVector<f64>,
        tube_terms: usize,
    ) -> Option<Vec<f64>> {
        match &self.artifact.model.corridor {
            Corridor::Free => Some(reference.as_slice().to_vec()),
            Corridor::Cone(faces) => {
                let faces = self.tightened_faces(&faces[self.step + horizon], tube_terms);
                let position = Vector3::new(reference[0], reference[1], reference[2]);
                let nearest = faces.nearest_point(position)?;
                Some(nearest.iter().chain(reference.rows(3, 3).iter()).copied().collect())
            }
            Corridor::Polytope(set) => {
                let offsets = set.normals().row_iter().zip(set.offsets().iter()).map(|(row, b)| {
                    b - self.margin(&row.iter().copied().collect::<Vec<_>>(), tube_terms)
                });
                let offsets = DVector::from_iterator(set.offsets().len(), offsets);
                let nearest = project_onto_polytope(reference, set.normals(), &offsets)?;
                Some(nearest.as_slice().to_vec())
            }
        }
    }

    /// `centre` grown by A_K^i W for the given exponents.
    pub(super) fn grown_terminal(
        &self,
        centre: Vec<f64>,
        powers: &[usize],
        constrain_last: bool,
    ) -> Terminal {
        let set = self.artifact.tube.sum(powers.iter().copied());
        Terminal { centre, generators: set.generators().as_slice().to_vec(), constrain_last }
    }

    /// The program of `horizon` that ends in `terminal`. Its objective is J = N + tracking +
    /// fuel, except for minimum time, where any positive input cost decides feasibility and the
    /// caller takes N for J.
    pub(super) fn program<'b>(
        &'b self,
        horizon: usize,
        terminal: &'b Terminal,
    ) -> HorizonProgram<'b> {
        let artifact = self.artifact;
        let (n, m) = (artifact.tables.states(), artifact.tables.inputs());
        let weights = artifact.problem.weights;
        let minimum_time = artifact.is_minimum_time();
        let mut constant = as_f64(horizon);
        if weights.tracking > 0.0 {
            if let Some(reference) = artifact.model.reference(self.step) {
                constant += weights.tracking * distance_1(&self.initial, reference.as_slice());
            }
            if terminal.is_point() {
                let last = &self.references[(horizon - 1) * n..][..n];
                constant += weights.tracking * distance_1(&terminal.centre, last);
            }
        }
        let rows_of_inputs = artifact.input_normals.len() / m;
        HorizonProgram {
            plant: &artifact.tables,
            initial: &self.initial,
            horizon,
            input_cost: if minimum_time { 1.0 } else { weights.fuel },
            input_lower: &artifact.input_lower[..horizon * m],
            input_upper: &artifact.input_upper[..horizon * m],
            input_normals: &artifact.input_normals,
            input_offsets: &artifact.input_offsets[..horizon * rows_of_inputs],
            stage_rows: self.rows,
            constrained_stages: if terminal.constrain_last { horizon } else { horizon - 1 },
            stage_normals: &self.normals,
            stage_offsets: &self.offsets,
            tracking_weight: weights.tracking,
            tracked_stages: if weights.tracking == 0.0 {
                0
            } else if terminal.is_point() {
                horizon - 1
            } else {
                horizon
            },
            tracking_reference: &self.references,
            terminal_centre: &terminal.centre,
            terminal_generators: &terminal.generators,
            constant,
        }
    }

    /// What J is at least at `horizon`, before anything is solved.
    pub(super) fn least_cost(&self, horizon: usize) -> f64 {
        let artifact = self.artifact;
        let tracking = artifact.problem.weights.tracking;
        let start = artifact.model.reference(self.step).map_or(0.0, |r| {
            if tracking > 0.0 { tracking * distance_1(&self.initial, r.as_slice()) } else { 0.0 }
        });
        as_f64(horizon) + start
    }

    /// Margins of the measured state in X(k), per unit normal; empty without constraints.
    pub(super) fn present_margins(&self) -> Vec<f64> {
        match &self.artifact.model.corridor {
            Corridor::Free => Vec::new(),
            Corridor::Cone(faces) => {
                let faces = &faces[self.step];
                let p = Vector3::new(self.initial[0], self.initial[1], self.initial[2]);
                (0..CONE_FACES)
                    .map(|i| {
                        (faces.offsets[i] - faces.normals[i].dot(&p)) / faces.normals[i].norm()
                    })
                    .collect()
            }
            Corridor::Polytope(set) => {
                let margins = set.margins(&DVector::from_column_slice(&self.initial));
                let normals = set.normals().row_iter();
                normals.zip(margins.iter()).map(|(h, margin)| margin / h.norm()).collect()
            }
        }
    }

    /// A first guess of the horizon: the best bang-coast-bang of a double integrator over the
    /// longest axis of the distance d to the reference.
    ///
    /// Coasting at speed v takes d / v + v and costs 2 v of input (scaled), so J is least at
    /// v = sqrt(d / (1 + 2 gamma_v)). Without fuel weight this is the minimum time 2 sqrt(d).
    /// [Quartullo2025a, sec. IV.A] takes the guess of a paper that is not at hand.
    pub(super) fn guess(&self) -> usize {
        let artifact = self.artifact;
        let limit = self.horizon_limit().max(1);
        if artifact.model.scaling.is_none() {
            return self.reach_guess(limit);
        }
        let tau = match &artifact.problem.plant {
            super::Plant::Hill(plant) => plant.sample_angle.radians(),
            super::Plant::Linear(_) => 1.0,
        };
        let Some(reference) = artifact.model.reference(self.step) else { return 1 };
        let farthest = (0..3).map(|i| (self.initial[i] - reference[i]).abs()).fold(0.0, f64::max);
        let slowness = libm::sqrt(1.0 + 2.0 * artifact.problem.weights.fuel);
        let time = libm::sqrt(farthest) * (slowness + 1.0 / slowness);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let steps = libm::ceil(time / tau).clamp(1.0, 1e6) as usize;
        steps.clamp(1, limit)
    }

    /// For a general plant: the first horizon at which each component alone could be moved to the
    /// reference by the largest inputs.
    fn reach_guess(&self, limit: usize) -> usize {
        let artifact = self.artifact;
        let n = artifact.tables.states();
        let mut free = DVector::from_column_slice(&self.initial);
        let mut power = artifact.model.b.clone();
        let mut reachable = vec![0.0; n];
        for horizon in 1..=limit {
            free = &artifact.model.a * free;
            for (r, total) in reachable.iter_mut().enumerate() {
                let row = power.row(r);
                let bounds = artifact.largest_inputs();
                *total += row.iter().zip(bounds).map(|(b, u)| b.abs() * u).sum::<f64>();
            }
            power = product(&artifact.model.a, &power);
            let Some(reference) = artifact.model.reference(self.step + horizon) else { break };
            if (0..n).all(|r| (free[r] - reference[r]).abs() <= reachable[r]) {
                return horizon;
            }
        }
        limit
    }
}

fn distance_1(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y).abs()).sum()
}

#[allow(clippy::cast_precision_loss, reason = "horizons are far below 2^53")]
pub(super) fn as_f64(count: usize) -> f64 {
    count as f64
}
