//! The dual step: its direction, and how far it goes.

use super::{DualSimplex, FEASIBILITY, HorizonProgram, Leaving, Place};

/// Entries below this share of the step's largest are rounding of zeros: no breakpoints. A ray
/// found without them is checked with them, and so is an optimum.
const NOISE: f64 = 1e-9;
/// A pivot of at least this share of the step's largest entry is taken without a second thought.
const SOUND_PIVOT: f64 = 1e-6;

/// A point along the dual step where something changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    /// Length of the step to here.
    pub(super) length: f64,
    /// Size of the pivot if the step ends here.
    pub(super) size: f64,
    /// What changes.
    pub(super) event: Event,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Event {
    /// A column's gradient meets a slope: beyond, it rests `up` or down from `segment`.
    Column { index: usize, segment: u8, up: bool },
    /// An active row's multiplier meets its upper or lower bound.
    Row { position: usize, at_upper: bool },
    /// The leaving row's own multiplier meets its other bound.
    Flip,
    /// The leaving column's gradient meets its next slope.
    NextSegment { segment: u8 },
}

/// How the test ended.
pub(super) enum Outcome {
    /// Step to this candidate; the columns in `passed` change their resting point. Without a
    /// sound pivot the kernel must be refactored afterwards.
    Step { candidate: Candidate, sound: bool },
    /// The dual objective rises without end: the program is infeasible.
    Unbounded,
}

impl DualSimplex {
    /// Change of multipliers and gradient for a unit dual step away from the violation.
    pub(super) fn direction(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) {
        let count = self.columns.len();
        match leaving {
            Leaving::Column { position, at_top, .. } => {
                // Above its top, a column needs a gradient below minus its slope.
                let sign = if at_top { -1.0 } else { 1.0 };
                self.multiplier_step.clear();
                self.multiplier_step.extend(self.kernel.row(position).iter().map(|x| sign * x));
                self.gradient_step.fill(0.0);
            }
            Leaving::Row { index, residual } => {
                let sign = residual.signum();
                let mut line = std::mem::take(&mut self.leaving_coefficients);
                self.row_coefficients(program, index, &mut line);
                let in_basic: Vec<f64> = self.basic.iter().map(|&c| line[c]).collect();
                let mut rho = std::mem::take(&mut self.rho);
                self.kernel.solve_transposed(&in_basic, &mut rho);
                self.multiplier_step.clear();
                self.multiplier_step.extend(rho.iter().map(|x| -sign * x));
                for (step, coefficient) in self.gradient_step.iter_mut().zip(&line) {
                    *step = sign * coefficient;
                }
                self.leaving_coefficients = line;
                self.rho = rho;
            }
        }
        for (line, weight) in self.coefficients.chunks_exact(count).zip(&self.multiplier_step) {
            for (step, coefficient) in self.gradient_step.iter_mut().zip(line) {
                *step += weight * coefficient;
            }
        }
        // Exact on the basic columns by construction.
        for &column in &self.basic {
            self.gradient_step[column] = 0.0;
        }
        if let Leaving::Column { position, at_top, .. } = leaving {
            self.gradient_step[self.basic[position]] = if at_top { -1.0 } else { 1.0 };
        }
    }

    /// Long-step ratio test: goes on past breakpoints while the dual objective rises.
    pub(super) fn ratio_test(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) -> Outcome {
        let largest = self.gradient_step.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
        self.collect_candidates(program, leaving, NOISE * largest);
        let mut slope = match leaving {
            Leaving::Column { excess, .. } => excess,
            Leaving::Row { residual, .. } => residual.abs(),
        };
        self.passed.clear();
        let chosen = loop {
            let Some(candidate) = self.take_nearest() else {
                return Outcome::Unbounded;
            };
            let drop = match candidate.event {
                Event::Column { index, segment, .. } => {
                    let points = &self.columns[index].points;
                    let width = points[segment as usize + 1] - points[segment as usize];
                    candidate.size * width
                }
                Event::NextSegment { segment } => {
                    let Leaving::Column { position, .. } = leaving else { break candidate };
                    let points = &self.columns[self.basic[position]].points;
                    points[segment as usize + 1] - points[segment as usize]
                }
                Event::Row { .. } | Event::Flip => break candidate,
            };
            slope -= drop;
            // The slope is the violation that is left: what counts as met needs no further step,
            // least of all at the very edge of what can be reached.
            if slope <= FEASIBILITY {
                break candidate;
            }
            self.queue_next(candidate);
            self.passed.push(candidate);
        };
        if chosen.size < SOUND_PIVOT * largest {
            // A shorter step with a sound pivot is still a dual ascent.
            let sound = |candidate: &Candidate| candidate.size >= SOUND_PIVOT * largest;
            if let Some(last) = self.passed.iter().rposition(sound) {
                let candidate = self.passed[last];
                self.passed.truncate(last);
                return Outcome::Step { candidate, sound: true };
            }
            return Outcome::Step { candidate: chosen, sound: false };
        }
        Outcome::Step { candidate: chosen, sound: true }
    }

    fn collect_candidates(&mut self, program: &HorizonProgram<'_>, leaving: Leaving, noise: f64) {
        self.candidates.clear();
        for index in 0..self.columns.len() {
            let step = self.gradient_step[index];
            let Place::At(point) = self.place[index] else { continue };
            if step.abs() <= noise {
                continue;
            }
            self.candidates.extend(self.column_candidate(index, point, step));
        }
        let row_noise =
            NOISE * self.multiplier_step.iter().fold(0.0_f64, |a, step| a.max(step.abs()));
        for (position, row) in self.active.iter().enumerate() {
            let step = self.multiplier_step[position];
            let (lower, upper) = self.multiplier_range(program, row.index);
            let bound = if step > 0.0 { upper } else { lower };
            if step.abs() > row_noise && bound.is_finite() {
                self.candidates.push(Candidate {
                    length: ((bound - row.multiplier) / step).max(0.0),
                    size: step.abs(),
                    event: Event::Row { position, at_upper: step > 0.0 },
                });
            }
        }
        match leaving {
            Leaving::Row { index, .. } => {
                let (lower, upper) = self.multiplier_range(program, index);
                if lower.is_finite() && upper.is_finite() {
                    let flip = Candidate { length: upper - lower, size: 1.0, event: Event::Flip };
                    self.candidates.push(flip);
                }
            }
            Leaving::Column { position, at_top, .. } => {
                let index = self.basic[position];
                let Place::Basic { segment } = self.place[index] else { return };
                let column = &self.columns[index];
                let next = if at_top { segment.checked_add(1) } else { segment.checked_sub(1) };
                if let Some(next) = next.filter(|&s| s < column.last()) {
                    let change = column.slopes[next as usize] - column.slopes[segment as usize];
                    let event = Event::NextSegment { segment: next };
                    self.candidates.push(Candidate { length: change.abs(), size: 1.0, event });
                }
            }
        }
    }

    /// The breakpoint that a resting column meets first, if any.
    fn column_candidate(&self, index: usize, point: u8, step: f64) -> Option<Candidate> {
        let column = &self.columns[index];
        // A falling gradient pulls the column up.
        let up = step < 0.0;
        let segment = if up { point } else { point.checked_sub(1)? };
        if segment >= column.last() {
            return None;
        }
        let target = -column.slopes[segment as usize];
        Some(Candidate {
            length: ((target - self.gradient[index]) / step).max(0.0),
            size: step.abs(),
            event: Event::Column { index, segment, up },
        })
    }

    /// After a column has passed one breakpoint it may meet another.
    fn queue_next(&mut self, passed: Candidate) {
        let Event::Column { index, segment, up } = passed.event else { return };
        let point = if up { segment + 1 } else { segment };
        let next = self.column_candidate(index, point, self.gradient_step[index]);
        self.candidates.extend(next);
    }

    /// The nearest candidate; among equals the one with the largest pivot.
    fn take_nearest(&mut self) -> Option<Candidate> {
        let mut best = 0;
        let first = self.candidates.first()?;
        let (mut length, mut size) = (first.length, first.size);
        for (i, candidate) in self.candidates.iter().enumerate().skip(1) {
            let tie = (candidate.length - length).abs() <= 1e-12 * length;
            if if tie { candidate.size > size } else { candidate.length < length } {
                best = i;
                (length, size) = (candidate.length, candidate.size);
            }
        }
        Some(self.candidates.swap_remove(best))
    }
}
