//! The dual step: its direction, and how far it goes.

use super::{Column, DualSimplex, FEASIBILITY, HorizonProgram, Leaving, Place};

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
        self.load_lengths(NOISE * largest);
        self.load_events(program, leaving);
        let mut slope = match leaving {
            Leaving::Column { excess, .. } => excess,
            Leaving::Row { residual, .. } => residual.abs(),
        };
        let (mut travelled, mut gain) = (0.0, 0.0);
        self.passed.clear();
        let chosen = loop {
            let Some(mut candidate) = self.take_nearest() else {
                return Outcome::Unbounded;
            };
            gain += slope * (candidate.length - travelled);
            travelled = candidate.length;
            candidate.gain = gain;
            let Some(drop) = self.slope_drop(leaving, candidate) else { break candidate };
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

    /// Step lengths to the first breakpoint of each resting column; infinite if there is none.
    fn load_lengths(&mut self, noise: f64) {
        self.lengths.clear();
        let columns = self.columns.iter().zip(&self.place);
        let gradients = self.gradient.iter().zip(&self.gradient_step);
        self.lengths.extend(columns.zip(gradients).map(|((column, place), (gradient, step))| {
            match *place {
                Place::At(point) if step.abs() > noise => {
                    let target = column.next_gradient(point, *step);
                    ((target - gradient) / step).max(0.0)
                }
                _ => f64::INFINITY,
            }
        }));
    }

    /// What can end the step besides resting columns.
    fn load_events(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) {
        self.events.clear();
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
                let event = Event::Row { position, at_upper: step > 0.0 };
                self.events.push(Candidate { length, size: step.abs(), gain: 0.0, event });
            }
        }
        match leaving {
            Leaving::Row { index, .. } => {
                let (lower, upper) = self.multiplier_range(program, index);
                if lower.is_finite() && upper.is_finite() {
                    let (length, event) = (upper - lower, Event::Flip);
                    self.events.push(Candidate { length, size: 1.0, gain: 0.0, event });
                }
            }
            Leaving::Column { position, at_top, .. } => {
                let index = self.basic[position];
                let Place::Basic { segment } = self.place[index] else { return };
                let column = &self.columns[index];
                let next = if at_top { segment.checked_add(1) } else { segment.checked_sub(1) };
                if let Some(next) = next.filter(|&s| s < column.last()) {
                    let change = column.slopes[next as usize] - column.slopes[segment as usize];
                    let (length, event) = (change.abs(), Event::NextSegment { segment: next });
                    self.events.push(Candidate { length, size: 1.0, gain: 0.0, event });
                }
            }
        }
    }

    /// After a column has passed one breakpoint it may meet another.
    fn queue_next(&mut self, passed: Candidate) {
        let Event::Column { index, segment, up } = passed.event else { return };
        let step = self.gradient_step[index];
        let point = if up { segment + 1 } else { segment };
        let target = self.columns[index].next_gradient(point, step);
        self.lengths[index] = ((target - self.gradient[index]) / step).max(0.0);
    }

    /// The nearest candidate; among equals the one with the largest pivot.
    fn take_nearest(&mut self) -> Option<Candidate> {
        let mut nearest: Option<usize> = None;
        let (mut length, mut size) = (f64::INFINITY, 0.0);
        let closer = |offered: f64, offered_size: f64, length: f64, size: f64| {
            offered < length * (1.0 - TIE)
                || (offered <= length * (1.0 + TIE) && offered_size > size)
        };
        for (i, &offered) in self.lengths.iter().enumerate() {
            if offered <= length * (1.0 + TIE) && offered < f64::INFINITY {
                let offered_size = self.gradient_step[i].abs();
                if closer(offered, offered_size, length, size) {
                    nearest = Some(i);
                    (length, size) = (offered, offered_size);
                }
            }
        }
        let mut event = None;
        for (i, candidate) in self.events.iter().enumerate() {
            if closer(candidate.length, candidate.size, length, size) {
                event = Some(i);
                (length, size) = (candidate.length, candidate.size);
            }
        }
        if let Some(i) = event {
            return Some(self.events.swap_remove(i));
        }
        let index = nearest?;
        self.lengths[index] = f64::INFINITY;
        let up = self.gradient_step[index] < 0.0;
        let segment = self.segment_ahead(index, up);
        let event = Event::Column { index, segment, up };
        Some(Candidate { length, size, gain: 0.0, event })
    }

    /// The segment that a resting column meets first, counting what it has passed in this step.
    fn segment_ahead(&self, index: usize, up: bool) -> u8 {
        let passed = self.passed.iter().rev().find_map(|candidate| match candidate.event {
            Event::Column { index: other, segment, .. } if other == index => Some(segment),
            _ => None,
        });
        let point = match (passed, self.place[index]) {
            (Some(segment), _) => {
                if up {
                    segment + 1
                } else {
                    segment
                }
            }
            (None, Place::At(point)) => point,
            (None, Place::Basic { segment }) => segment,
        };
        if up { point } else { point.saturating_sub(1) }
    }
}

impl Column {
    /// The gradient at which the column leaves breakpoint `point` when the gradient moves in the
    /// direction of `step`; infinite if it never does.
    fn next_gradient(&self, point: u8, step: f64) -> f64 {
        // A falling gradient pulls the column up.
        if step < 0.0 {
            if point < self.last() { -self.slopes[point as usize] } else { f64::NEG_INFINITY }
        } else if point > 0 {
            -self.slopes[point as usize - 1]
        } else {
            f64::INFINITY
        }
    }
}
