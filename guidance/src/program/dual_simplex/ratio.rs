//! The dual step: its direction, and how far it goes.

use std::{cmp::Ordering, collections::BinaryHeap};

use super::{ActiveRow, DualSimplex, FEASIBILITY, HorizonProgram, Leaving, Place, add_row};

/// Entries below this share of the step's largest are rounding of zeros: no breakpoints. A ray
/// found without them is checked with them, and so is an optimum.
const NOISE: f64 = 1e-9;
/// A pivot of at least this share of the step's largest entry is taken without a second thought.
const SOUND_PIVOT: f64 = 1e-6;

/// Relative difference of lengths that counts as none.
const TIE: f64 = 1e-12;

/// A point along the dual step where something changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    /// Length of the step to here.
    pub(super) length: f64,
    /// Size of the pivot if the step ends here.
    pub(super) size: f64,
    /// Rise of the dual objective on the way here.
    pub(super) gain: f64,
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
        match leaving {
            Leaving::Column { position, at_top, .. } => {
                // Above its top, a column needs a gradient below minus its slope.
                let sign = if at_top { -1.0 } else { 1.0 };
                self.multiplier_step.clear();
                self.multiplier_step.extend(self.kernel.row(position).iter().map(|x| sign * x));
            }
            Leaving::Row { index, residual } => {
                let sign = residual.signum();
                self.load_images(program, index);
                let id = self.row_id(program, index);
                let mut line = std::mem::take(&mut self.line);
                let images = &self.leaving_images;
                let entry = |&column: &usize| self.coefficient(program, id, images, column);
                line.clear();
                line.extend(self.basic.iter().map(entry));
                self.kernel.solve_transposed(&line, &mut self.rho);
                self.line = line;
                self.multiplier_step.clear();
                self.multiplier_step.extend(self.rho.iter().map(|x| -sign * x));
            }
        }
        self.load_gradient_step(program, leaving);
        // Exact on the basic columns by construction.
        for &column in &self.basic {
            self.gradient_step[column] = 0.0;
        }
        if let Leaving::Column { position, at_top, .. } = leaving {
            self.gradient_step[self.basic[position]] = if at_top { -1.0 } else { 1.0 };
        }
    }

    fn load_gradient_step(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) {
        let mut step = std::mem::take(&mut self.gradient_step);
        self.start_gradient(program, &mut step);
        for i in 0..self.active.len() {
            let ActiveRow { id, .. } = self.active[i];
            let images = &self.images[i * self.leaving_images.len()..];
            let weight = self.multiplier_step[i];
            add_row(program, id, weight, images, &mut self.costates, &mut step);
        }
        if let Leaving::Row { index, residual } = leaving {
            let (id, images) = (self.row_id(program, index), &self.leaving_images);
            add_row(program, id, residual.signum(), images, &mut self.costates, &mut step);
        }
        self.finish_gradient(program, &mut step);
        self.gradient_step = step;
    }

    /// Long-step ratio test: goes on past breakpoints while the dual objective rises.
    pub(super) fn ratio_test(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) -> Outcome {
        let largest = self.gradient_step.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
        self.candidates.clear();
        let end = self.load_events(program, leaving);
        self.load_columns(NOISE * largest, end);
        let mut nearest_first = BinaryHeap::from(std::mem::take(&mut self.candidates));
        let mut slope = match leaving {
            Leaving::Column { excess, .. } => excess,
            Leaving::Row { residual, .. } => residual.abs(),
        };
        let (mut travelled, mut gain) = (0.0, 0.0);
        self.passed.clear();
        let chosen = loop {
            let Some(mut candidate) = take_nearest(&mut nearest_first, &mut self.tied) else {
                break None;
            };
            gain += slope * (candidate.length - travelled);
            travelled = candidate.length;
            candidate.gain = gain;
            let Some(drop) = self.slope_drop(leaving, candidate) else { break Some(candidate) };
            slope -= drop;
            // The slope is the violation that is left: what counts as met needs no further step,
            // least of all at the very edge of what can be reached.
            if slope <= FEASIBILITY {
                break Some(candidate);
            }
            nearest_first.extend(self.next_of(candidate));
            self.passed.push(candidate);
        };
        self.candidates = nearest_first.into_vec();
        let Some(chosen) = chosen else { return Outcome::Unbounded };
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

    /// By how much the slope drops at a candidate; `None` if nothing goes on beyond it.
    fn slope_drop(&self, leaving: Leaving, candidate: Candidate) -> Option<f64> {
        let width = |column: usize, segment: u8| {
            let points = &self.columns[column].points;
            points[segment as usize + 1] - points[segment as usize]
        };
        match (candidate.event, leaving) {
            (Event::Column { index, segment, .. }, _) => {
                Some(candidate.size * width(index, segment))
            }
            (Event::NextSegment { segment }, Leaving::Column { position, .. }) => {
                Some(width(self.basic[position], segment))
            }
            _ => None,
        }
    }

    /// What can end the step besides resting columns; returns where the first of it does.
    fn load_events(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) -> f64 {
        let mut end = f64::INFINITY;
        let row_noise =
            NOISE * self.multiplier_step.iter().fold(0.0_f64, |a, step| a.max(step.abs()));
        for (position, row) in self.active.iter().enumerate() {
            let step = self.multiplier_step[position];
            if step.abs() <= row_noise {
                continue;
            }
            let (lower, upper) = self.multiplier_range(program, row.index);
            let bound = if step > 0.0 { upper } else { lower };
            if bound.is_finite() {
                let length = ((bound - row.multiplier) / step).max(0.0);
                end = end.min(length);
                let event = Event::Row { position, at_upper: step > 0.0 };
                self.candidates.push(Candidate { length, size: step.abs(), gain: 0.0, event });
            }
        }
        match leaving {
            Leaving::Row { index, .. } => {
                let (lower, upper) = self.multiplier_range(program, index);
                if lower.is_finite() && upper.is_finite() {
                    let (length, event) = (upper - lower, Event::Flip);
                    end = end.min(length);
                    self.candidates.push(Candidate { length, size: 1.0, gain: 0.0, event });
                }
            }
            Leaving::Column { position, at_top, .. } => {
                let index = self.basic[position];
                let Place::Basic { segment } = self.place[index] else { return end };
                let column = &self.columns[index];
                let next = if at_top { segment.checked_add(1) } else { segment.checked_sub(1) };
                if let Some(next) = next.filter(|&s| s < column.last()) {
                    let change = column.slopes[next as usize] - column.slopes[segment as usize];
                    let (length, event) = (change.abs(), Event::NextSegment { segment: next });
                    self.candidates.push(Candidate { length, size: 1.0, gain: 0.0, event });
                }
            }
        }
        end
    }

    /// The first breakpoints of the resting columns, up to the `end` of the step.
    fn load_columns(&mut self, noise: f64, end: f64) {
        let end = (end * (1.0 + TIE)).min(f64::MAX);
        let gradients = self.gradient.iter().zip(&self.gradient_step);
        for (index, ((gradient, step), limits)) in gradients.zip(&self.limits).enumerate() {
            if step.abs() > noise {
                let length = (limits[usize::from(*step > 0.0)] - gradient) / step;
                if length <= end
                    && let Place::At(point) = self.place[index]
                {
                    self.candidates.push(Candidate::column(index, point, *step, length));
                }
            }
        }
    }

    /// After a column has passed one breakpoint it may meet another.
    fn next_of(&self, passed: Candidate) -> Option<Candidate> {
        let Event::Column { index, segment, up } = passed.event else { return None };
        let point = if up { segment + 1 } else { segment };
        let (gradient, step) = (self.gradient[index], self.gradient_step[index]);
        let limits = self.columns[index].limits(point);
        let length = (limits[usize::from(step > 0.0)] - gradient) / step;
        (length < f64::INFINITY).then(|| Candidate::column(index, point, step, length))
    }
}

impl Candidate {
    /// A column that rests at `point` leaves it.
    fn column(index: usize, point: u8, step: f64, length: f64) -> Self {
        let up = step < 0.0;
        let segment = if up { point } else { point - 1 };
        let event = Event::Column { index, segment, up };
        Self { length: length.max(0.0), size: step.abs(), gain: 0.0, event }
    }
}

/// The nearest candidate; among equals the one with the largest pivot.
fn take_nearest(
    nearest_first: &mut BinaryHeap<Candidate>,
    tied: &mut Vec<Candidate>,
) -> Option<Candidate> {
    let mut best = nearest_first.pop()?;
    tied.clear();
    while let Some(other) =
        nearest_first.peek().filter(|other| other.length <= best.length * (1.0 + TIE))
    {
        let other = *other;
        nearest_first.pop();
        tied.push(if other.size > best.size { std::mem::replace(&mut best, other) } else { other });
    }
    nearest_first.extend(tied.drain(..));
    Some(best)
}

/// The nearest is the greatest, as a heap wants it; equals in a fixed order.
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        other.length.total_cmp(&self.length).then_with(|| self.size.total_cmp(&other.size))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}
