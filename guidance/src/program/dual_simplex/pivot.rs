//! Carrying out a dual step.

use super::{
    ActiveRow, BasicColumn, Basis, DualSimplex, HorizonProgram, INACTIVE, Leaving, Multiplier,
    Place, Solution, Status,
    ratio::{Candidate, Event},
};

impl DualSimplex {
    /// Moves along the direction to `step` and exchanges what leaves for what enters.
    pub(super) fn pivot(
        &mut self,
        program: &HorizonProgram<'_>,
        leaving: Leaving,
        step: Candidate,
    ) {
        self.move_dual(step.length);
        self.moved.clear();
        for i in 0..self.passed.len() {
            if let Event::Column { index, segment, up } = self.passed[i].event {
                self.rest(index, if up { segment + 1 } else { segment });
            }
        }
        let own_segment = self.passed.iter().rev().find_map(|passed| match passed.event {
            Event::NextSegment { segment } => Some(segment),
            _ => None,
        });
        match leaving {
            Leaving::Row { index, residual } => self.activate(program, index, residual, step),
            Leaving::Column { position, at_top, .. } => {
                // Beyond its next slope the column rests one point further.
                if let (Some(segment), Place::Basic { .. }) =
                    (own_segment, self.place[self.basic[position]])
                {
                    self.put(self.basic[position], Place::Basic { segment });
                }
                self.release(program, position, at_top, step);
            }
        }
    }

    fn move_dual(&mut self, length: f64) {
        for (row, change) in self.active.iter_mut().zip(&self.multiplier_step) {
            row.multiplier += length * change;
        }
        for (value, change) in self.gradient.iter_mut().zip(&self.gradient_step) {
            *value += length * change;
        }
    }

    /// A violated row becomes active.
    fn activate(
        &mut self,
        program: &HorizonProgram<'_>,
        index: usize,
        residual: f64,
        step: Candidate,
    ) {
        let sign = residual.signum();
        let (lower, upper) = self.multiplier_range(program, index);
        let from = if self.is_tracking(index) {
            if self.at_upper[index - self.layout.tracking] { upper } else { lower }
        } else {
            0.0
        };
        let multiplier = from + sign * step.length;
        match step.event {
            Event::Flip => self.at_upper[index - self.layout.tracking] = residual > 0.0,
            Event::Column { index: column, segment, .. } => {
                self.enter(program, column, segment);
                let pivot = sign * self.gradient_step[column];
                self.kernel.border(&self.entering, &self.rho, pivot);
                self.basic.push(column);
                self.position[index] = u32::try_from(self.active.len()).unwrap_or(INACTIVE);
                self.images.extend_from_slice(&self.leaving_images);
                let id = self.row_id(program, index);
                self.active.push(ActiveRow { index, id, multiplier });
            }
            Event::Row { position, at_upper } => {
                self.kernel.replace_row(position, &self.rho);
                self.rest_row(position, at_upper);
                self.position[index] = u32::try_from(position).unwrap_or(INACTIVE);
                let stride = self.leaving_images.len();
                self.images[position * stride..][..stride].copy_from_slice(&self.leaving_images);
                let id = self.row_id(program, index);
                self.active[position] = ActiveRow { index, id, multiplier };
            }
            Event::NextSegment { .. } => unreachable!("only a leaving column has a next segment"),
        }
    }

    /// A basic column comes to rest at the end of its segment.
    fn release(
        &mut self,
        program: &HorizonProgram<'_>,
        position: usize,
        at_top: bool,
        step: Candidate,
    ) {
        let column = self.basic[position];
        let Place::Basic { segment } = self.place[column] else { return };
        let point = if at_top { segment + 1 } else { segment };
        match step.event {
            Event::NextSegment { segment } => self.put(column, Place::Basic { segment }),
            Event::Column { index, segment, .. } => {
                self.enter(program, index, segment);
                self.kernel.replace_column(position, &self.entering);
                self.basic[position] = index;
                self.rest(column, point);
            }
            Event::Row { position: row, at_upper } => {
                self.rest(column, point);
                self.rest_row(row, at_upper);
                self.drop_pair(position, row);
            }
            Event::Flip => unreachable!("only a leaving row flips"),
        }
    }

    /// Makes a resting column basic; leaves M^-1 m in `entering`, with m its coefficients.
    fn enter(&mut self, program: &HorizonProgram<'_>, column: usize, segment: u8) {
        self.line.clear();
        for i in 0..self.active.len() {
            let id = self.active[i].id;
            let entry = self.coefficient(program, id, self.images_of(i), column);
            self.line.push(entry);
        }
        self.put(column, Place::Basic { segment });
        self.kernel.solve(&self.line, &mut self.entering);
    }

    /// A column comes to rest at `point`.
    fn rest(&mut self, column: usize, point: u8) {
        let value = self.columns[column].points[point as usize];
        self.moved.push((column, value - self.values[column]));
        self.values[column] = value;
        self.put(column, Place::At(point));
    }

    fn rest_row(&mut self, position: usize, at_upper: bool) {
        let index = self.active[position].index;
        self.position[index] = INACTIVE;
        if self.is_tracking(index) {
            self.at_upper[index - self.layout.tracking] = at_upper;
        }
    }

    /// Drops a basic column and an active row from the lists and the kernel.
    pub(super) fn drop_pair(&mut self, column: usize, row: usize) {
        self.kernel.shrink(column, row);
        self.position[self.active[row].index] = INACTIVE;
        self.basic.swap_remove(column);
        self.active.swap_remove(row);
        let stride = self.leaving_images.len();
        let last = self.active.len();
        if row < last {
            self.images.copy_within(last * stride..(last + 1) * stride, row * stride);
            self.position[self.active[row].index] = u32::try_from(row).unwrap_or(INACTIVE);
        }
        self.images.truncate(last * stride);
    }

    /// The direction as a Farkas ray.
    pub(super) fn ray(&self, program: &HorizonProgram<'_>, leaving: Leaving) -> Vec<Multiplier> {
        let active = self.active.iter().zip(&self.multiplier_step).map(|(row, step)| Multiplier {
            row: self.row_id(program, row.index),
            value: step * self.scale[row.index],
        });
        let own = match leaving {
            Leaving::Row { index, residual } => Some(Multiplier {
                row: self.row_id(program, index),
                value: residual.signum() * self.scale[index],
            }),
            Leaving::Column { .. } => None,
        };
        active.chain(own).collect()
    }

    /// Nonzero multipliers of all rows, in the rows' own scale.
    pub(super) fn multipliers(&self, program: &HorizonProgram<'_>) -> Vec<Multiplier> {
        let active = self.active.iter().map(|row| Multiplier {
            row: self.row_id(program, row.index),
            value: row.multiplier * self.scale[row.index],
        });
        let tracking = self.layout.tracking..self.layout.input;
        let resting = tracking.filter(|&index| self.position[index] == INACTIVE).map(|index| {
            let row = self.row_id(program, index);
            Multiplier { row, value: self.resting_multiplier(program, index) }
        });
        active.chain(resting).collect()
    }

    pub(super) fn solution(
        &self,
        program: &HorizonProgram<'_>,
        status: Status,
        objective: f64,
        multipliers: Vec<Multiplier>,
        iterations: usize,
    ) -> Solution {
        let inputs = program.horizon * program.inputs();
        let clamped = |range: std::ops::Range<usize>| -> Vec<f64> {
            let columns = self.columns[range.clone()].iter().zip(&self.values[range]);
            columns.map(|(c, v)| v.clamp(c.points[0], c.points[c.last() as usize])).collect()
        };
        let optimal = status == Status::Optimal;
        Solution {
            status,
            objective,
            inputs: if optimal { clamped(0..inputs) } else { Vec::new() },
            terminal_coefficients: if optimal {
                clamped(inputs..self.columns.len())
            } else {
                Vec::new()
            },
            multipliers,
            basis: self.basis(program),
            iterations,
        }
    }

    fn basis(&self, program: &HorizonProgram<'_>) -> Basis {
        let m = program.inputs();
        let inputs = program.horizon * m;
        let columns = self.basic.iter().filter_map(|&index| {
            let Place::Basic { segment } = self.place[index] else { return None };
            let (stage, index) = if index < inputs {
                (index / m, index % m)
            } else {
                (program.horizon, index - inputs)
            };
            Some(BasicColumn { stage, index, segment: segment.into() })
        });
        Basis {
            rows: self.active.iter().map(|row| self.row_id(program, row.index)).collect(),
            columns: columns.collect(),
        }
    }
}
