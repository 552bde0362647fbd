//! A bounded dual simplex for [`HorizonProgram`]s that never forms the matrix.
//!
//! The program has hundreds of rows and a hundred columns, but at any vertex only a dozen rows
//! hold with equality. So the rows are evaluated by rolling the plant forward, gradients by
//! rolling costates back, both in the anchored form of [`Anchors`](super::anchors::Anchors), where an input only adds; and
//! of the active rows there is nothing but the explicit inverse of their square kernel.
//!
//! The cost |v| and the bounds of an input make one convex piecewise linear function of one
//! column: columns rest at a breakpoint, or are basic strictly between two. Every input is
//! bounded, so any multipliers of the right signs are dual feasible and there is no phase 1; a
//! start from another horizon's vertex only has to drop rows whose multiplier has the wrong sign.
//!
//! A dual step passes breakpoints as long as the dual objective still rises (long-step ratio
//! test). The dual objective bounds the optimum from below all along, so a solve stops as soon as
//! it exceeds a cut-off.
//!
//! What the result claims is checked before it is returned, from the program and the multipliers
//! alone: gap at an optimum, bound at a cut-off, Farkas margin of a ray. If that fails after a
//! refactorisation the status is [`Status::NumericalFailure`].

mod kernel;
mod pivot;
mod ratio;

use kernel::Kernel;

use super::{
    BasicColumn, Basis, HorizonProgram, Multiplier, RowFamily, RowId, Solution, Solver, Status,
    anchors::dot,
    tables::add_scaled,
    verify::{dual_bound, farkas_margin},
};
use crate::budget::{Budget, Interruption};

/// Violation of a scaled row or of a breakpoint that still counts as met. Rows are scaled to
/// unit effect of an input, so this is in units of the input.
const FEASIBILITY: f64 = 1e-10;
/// Rounding of multipliers and gradients that a refactorisation may uncover. What is within it
/// stays where it is, or a degenerate vertex would come apart at every refactorisation. It grows
/// tenfold, up to `DRIFT_MAX`, each time an optimum does come apart; the gap decides in the end.
const DRIFT: f64 = 1e-9;
const DRIFT_MAX: f64 = 1e-6;
/// Relative gap accepted at an optimum.
const GAP: f64 = 1e-8;
/// Rank tolerance for a vertex that came from another program, where rows can be dependent.
const OTHER_VERTEX: f64 = 1e-9;
/// Rank tolerance for a vertex that was reached by pivots here: it has full rank, if not much.
const SAME_VERTEX: f64 = 1e-14;
/// Pivots between refactorisations.
const REFRESH_PERIOD: usize = 60;
/// Pivots between two looks at the budget, some ten microseconds.
const BUDGET_PERIOD: usize = 8;
/// Pivots without progress after which ties are broken by index, which cannot cycle.
const STALL: usize = 30;

/// The solver, with the memory it reuses from one program to the next. No result depends on what
/// was solved before.
#[derive(Debug, Default)]
pub struct DualSimplex {
    // Columns: inputs stage by stage, then terminal coefficients.
    columns: Vec<Column>,
    place: Vec<Place>,
    /// The gradients, falling and rising, at which a column leaves its place.
    limits: Vec<[f64; 2]>,
    values: Vec<f64>,
    /// Gradient of the Lagrangian without the column's own cost: d = A'y.
    gradient: Vec<f64>,
    /// Change of `gradient` along the dual step.
    gradient_step: Vec<f64>,
    // Rows.
    layout: Layout,
    scale: Vec<f64>,
    /// Stage rows as they stand on anchored states, scaled, n values a row.
    stage_rows: Vec<f64>,
    /// Their scaled right sides.
    stage_sides: Vec<f64>,
    /// Position in `active`, or `INACTIVE`.
    position: Vec<u32>,
    /// At which bound an inactive tracking row's multiplier rests.
    at_upper: Vec<bool>,
    /// Anchored states under `values`.
    states: Vec<f64>,
    /// Sum of the terminal generators under `values`.
    reached: Vec<f64>,
    // The vertex.
    active: Vec<ActiveRow>,
    /// The images of each active row, one a block of the anchors.
    images: Vec<f64>,
    basic: Vec<usize>,
    kernel: Kernel,
    // Scratch of one pivot.
    leaving_images: Vec<f64>,
    /// Values of one row on the basic columns, or of one column on the active rows.
    line: Vec<f64>,
    rho: Vec<f64>,
    multiplier_step: Vec<f64>,
    entering: Vec<f64>,
    candidates: Vec<ratio::Candidate>,
    tied: Vec<ratio::Candidate>,
    passed: Vec<ratio::Candidate>,
    /// Resting columns that moved in this pivot, and by how much.
    moved: Vec<(usize, f64)>,
    basic_values: Vec<f64>,
    costates: Vec<f64>,
    costate: Vec<f64>,
    stalled: usize,
    drift: f64,
}

const INACTIVE: u32 = u32::MAX;

/// One input component: breakpoints in ascending order and the cost's slopes between them.
#[derive(Debug, Clone, Copy)]
struct Column {
    points: [f64; 3],
    slopes: [f64; 2],
    /// Number of breakpoints, 1 to 3.
    count: u8,
}

/// Where a column is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    /// At this breakpoint.
    At(u8),
    /// Basic, between breakpoints `segment` and `segment + 1`.
    Basic { segment: u8 },
}

/// A row that holds with equality.
#[derive(Debug, Clone, Copy)]
struct ActiveRow {
    index: usize,
    id: RowId,
    /// Scaled multiplier.
    multiplier: f64,
}

/// Index ranges of the row families.
#[derive(Debug, Clone, Copy, Default)]
struct Layout {
    tracking: usize,
    input: usize,
    terminal: usize,
    end: usize,
}

/// A violated column or row, and by how much.
#[derive(Debug, Clone, Copy)]
enum Leaving {
    /// Basic column at `position` leaves its segment at the top or bottom.
    Column { position: usize, at_top: bool, excess: f64 },
    /// Inactive row with this signed, scaled residual.
    Row { index: usize, residual: f64 },
}

/// How the main loop ended.
enum End {
    Optimal,
    Infeasible(Leaving),
    CutOff(f64),
    Exhausted,
}

impl Column {
    fn new(lower: f64, upper: f64, cost: f64) -> Self {
        let (points, slopes, count) = if lower == upper {
            ([lower, 0.0, 0.0], [0.0; 2], 1)
        } else if cost > 0.0 && lower < 0.0 && upper > 0.0 {
            ([lower, 0.0, upper], [-cost, cost], 3)
        } else {
            ([lower, upper, 0.0], [if upper <= 0.0 { -cost } else { cost }, 0.0], 2)
        };
        Self { points, slopes, count }
    }

    fn last(&self) -> u8 {
        self.count - 1
    }

    /// The gradients, falling and rising, at which the column leaves breakpoint `point`. A falling
    /// gradient pulls it up.
    fn limits(&self, point: u8) -> [f64; 2] {
        let above = (point < self.last()).then(|| -self.slopes[point as usize]);
        let below = (point > 0).then(|| -self.slopes[point as usize - 1]);
        [above.unwrap_or(f64::NEG_INFINITY), below.unwrap_or(f64::INFINITY)]
    }

    /// The breakpoint that minimises cost + gradient v.
    fn resting_point(&self, gradient: f64) -> u8 {
        (0..self.last()).find(|&k| -gradient <= self.slopes[k as usize]).unwrap_or(self.last())
    }

    /// Does `point` minimise cost + gradient v to within `drift` of a slope?
    fn rests_at(&self, point: u8, gradient: f64, drift: f64) -> bool {
        let pull = -gradient;
        let above_lower = point == 0 || pull >= self.slopes[point as usize - 1] - drift;
        let below_upper = point >= self.last() || pull <= self.slopes[point as usize] + drift;
        point <= self.last() && above_lower && below_upper
    }

    fn cost(&self, value: f64) -> f64 {
        // Integral of the slopes from 0; the breakpoints straddle or exclude 0 by construction.
        match self.count {
            3 => value * if value < 0.0 { self.slopes[0] } else { self.slopes[1] },
            _ => value * self.slopes[0],
        }
    }
}

impl Solver for DualSimplex {
    fn solve(
        &mut self,
        program: &HorizonProgram<'_>,
        start: Option<&Basis>,
        cut_off: Option<f64>,
        budget: Budget<'_>,
    ) -> Result<Solution, Interruption> {
        self.load(program);
        if let Some(basis) = start {
            self.adopt(program, basis);
        }
        self.refresh(program, OTHER_VERTEX);
        let limit = 200 + 20 * self.columns.len();
        let mut pivots = 0;
        let mut doubts = 0;
        loop {
            let end = self.iterate(program, cut_off, limit, &mut pivots, budget)?;
            let (status, multipliers, objective) = match end {
                End::Optimal => {
                    (Status::Optimal, self.multipliers(program), self.objective(program))
                }
                End::Infeasible(leaving) => {
                    (Status::PrimalInfeasible, self.ray(program, leaving), f64::INFINITY)
                }
                End::CutOff(bound) => (Status::CutOff, self.multipliers(program), bound),
                End::Exhausted => (Status::BudgetExhausted, Vec::new(), f64::NAN),
            };
            let believed = match status {
                Status::Optimal => {
                    let bound = dual_bound(program, &multipliers).value;
                    objective - bound <= GAP * (1.0 + objective.abs())
                }
                Status::CutOff => {
                    let bound = dual_bound(program, &multipliers).value;
                    cut_off.is_some_and(|limit| bound >= limit)
                }
                Status::PrimalInfeasible => farkas_margin(program, &multipliers) > 0.0,
                _ => true,
            };
            if believed {
                return Ok(self.solution(program, status, objective, multipliers, pivots));
            }
            doubts += 1;
            if doubts > 3 {
                let failed = Status::NumericalFailure;
                return Ok(self.solution(program, failed, f64::NAN, Vec::new(), pivots));
            }
            self.refresh(program, SAME_VERTEX);
        }
    }
}

impl DualSimplex {
    /// Columns, rows and free response of `program`, at the vertex v = argmin cost, y = 0.
    fn load(&mut self, program: &HorizonProgram<'_>) {
        let (n, m, horizon) = (program.states(), program.inputs(), program.horizon);
        let generators = program.terminal_generator_count();
        self.columns.clear();
        let bounds = program.input_lower.iter().zip(program.input_upper).take(horizon * m);
        let cost = program.input_cost;
        self.columns.extend(bounds.map(|(&lower, &upper)| Column::new(lower, upper, cost)));
        self.columns.extend((0..generators).map(|_| Column::new(-1.0, 1.0, 0.0)));
        let count = self.columns.len();
        self.place.clear();
        self.place.resize(count, Place::At(0));
        self.limits.clear();
        self.limits.extend(self.columns.iter().map(|column| column.limits(0)));
        reset(&mut self.values, count);
        reset(&mut self.gradient, count);
        reset(&mut self.gradient_step, count);
        reset(&mut self.reached, n);
        reset(&mut self.states, (horizon + 1) * n);
        // An input row has no images; their space holds its coefficients.
        let space = (program.plant.anchors().blocks(horizon) * n).max(m);
        reset(&mut self.leaving_images, space);
        self.active.clear();
        self.images.clear();
        self.basic.clear();
        self.kernel.clear();
        self.stalled = 0;
        self.drift = DRIFT;
        self.roll_forward(program);
        self.load_rows(program);
    }

    fn load_rows(&mut self, program: &HorizonProgram<'_>) {
        let (n, horizon) = (program.states(), program.horizon);
        let anchors = program.plant.anchors();
        let tracked = if program.tracking_weight > 0.0 { program.tracked_stages } else { 0 };
        let tracking = program.constrained_stages * program.stage_rows;
        let input = tracking + tracked * n;
        let terminal = input + horizon * program.input_rows();
        self.layout = Layout { tracking, input, terminal, end: terminal + n };
        self.scale.clear();
        self.scale.reserve(self.layout.end);
        self.stage_sides.clear();
        self.stage_sides.reserve(tracking);
        reset(&mut self.stage_rows, tracking * n);
        let mut rows = self.stage_rows.chunks_exact_mut(n);
        for stage in 1..=program.constrained_stages {
            let reach = program.plant.reach(stage);
            for (row, out) in (0..program.stage_rows).zip(&mut rows) {
                let normal = program.stage_normal(stage, row);
                let scale = row_scale(normal, reach);
                anchors.row(normal, stage, scale, out);
                self.stage_sides.push(scale * program.stage_offset(stage, row));
                self.scale.push(scale);
            }
        }
        for stage in 1..=tracked {
            self.scale.extend(program.plant.reach(stage).iter().map(|r| inverse_or_one(*r)));
        }
        for _ in 0..horizon {
            for normal in program.input_normals.chunks_exact(program.inputs()) {
                let largest = normal.iter().fold(0.0_f64, |a, h| a.max(h.abs()));
                self.scale.push(inverse_or_one(largest));
            }
        }
        self.scale.extend(program.plant.reach(horizon).iter().map(|r| inverse_or_one(*r)));
        self.position.clear();
        self.position.resize(self.layout.end, INACTIVE);
        // A tracking multiplier rests where the free response's residual puts it.
        self.at_upper.clear();
        for index in tracking..input {
            let above = self.residual(program, index) > 0.0;
            self.at_upper.push(above);
        }
    }

    /// Takes over what another vertex has in common with this program: as many of its rows and
    /// columns as have rank here, and no row whose multiplier would have the wrong sign.
    fn adopt(&mut self, program: &HorizonProgram<'_>, basis: &Basis) {
        let m = program.inputs();
        let columns: Vec<(usize, u8)> = basis
            .columns
            .iter()
            .filter_map(|c| {
                let index = if c.stage < program.horizon && c.index < m {
                    c.stage * m + c.index
                } else if c.stage >= program.horizon && !program.terminal_generators.is_empty() {
                    program.horizon * m + c.index
                } else {
                    return None;
                };
                let segments = self.columns.get(index)?.count.saturating_sub(1);
                let segment = u8::try_from(c.segment).ok()?;
                (segment < segments).then_some((index, segment))
            })
            .collect();
        let mut seen = vec![false; self.columns.len()];
        let columns: Vec<(usize, u8)> =
            columns.into_iter().filter(|c| !std::mem::replace(&mut seen[c.0], true)).collect();
        let mut rows: Vec<usize> =
            basis.rows.iter().filter_map(|row| self.row_index(program, *row)).collect();
        rows.sort_unstable();
        rows.dedup();
        for (index, segment) in columns {
            self.put(index, Place::Basic { segment });
            self.basic.push(index);
        }
        for index in rows {
            self.position[index] = 0;
            let id = self.row_id(program, index);
            self.active.push(ActiveRow { index, id, multiplier: 0.0 });
        }
    }

    /// Everything anew from the names of active rows and basic columns: kernel, multipliers,
    /// gradient, resting places. Rows and columns without rank are dropped, then rows whose
    /// multiplier has the wrong sign.
    fn refresh(&mut self, program: &HorizonProgram<'_>, rank_tolerance: f64) {
        let (rows, columns) = (self.active.len(), self.basic.len());
        let stride = self.leaving_images.len();
        self.images.clear();
        let mut matrix = Vec::with_capacity(rows * columns);
        for i in 0..rows {
            let ActiveRow { index, id, .. } = self.active[i];
            self.load_images(program, index);
            let images = &self.leaving_images;
            let entry = |&column: &usize| self.coefficient(program, id, images, column);
            matrix.extend(self.basic.iter().map(entry));
            self.images.extend_from_slice(&self.leaving_images);
        }
        let kept = self.kernel.factor(&mut matrix, rows, columns, rank_tolerance);
        self.keep(&kept, stride);
        self.settle(program);
    }

    /// Reduces the vertex to the kept (row, column) pairs, in their order.
    fn keep(&mut self, kept: &[(usize, usize)], stride: usize) {
        let (active, basic) = (self.active.clone(), self.basic.clone());
        let images = std::mem::take(&mut self.images);
        for row in &active {
            self.position[row.index] = INACTIVE;
        }
        for (j, &column) in basic.iter().enumerate() {
            if !kept.iter().any(|&(_, c)| c == j) {
                self.put(column, Place::At(0));
            }
        }
        self.active = kept.iter().map(|&(r, _)| active[r]).collect();
        self.basic = kept.iter().map(|&(_, c)| basic[c]).collect();
        for &(r, _) in kept {
            self.images.extend_from_slice(&images[r * stride..][..stride]);
        }
        for (i, row) in self.active.iter().enumerate() {
            self.position[row.index] = u32::try_from(i).unwrap_or(INACTIVE);
        }
    }

    /// Multipliers, gradient and resting places anew from the kernel.
    fn settle(&mut self, program: &HorizonProgram<'_>) {
        self.settle_multipliers(program);
        self.rest_columns();
    }

    /// Multipliers that put every basic column on its slope; drops rows with wrong signs.
    fn settle_multipliers(&mut self, program: &HorizonProgram<'_>) {
        loop {
            for row in &mut self.active {
                row.multiplier = 0.0;
            }
            // From the resting tracking rows alone, then once more for what rounding left over.
            self.load_gradient(program);
            for _ in 0..2 {
                let mut line = std::mem::take(&mut self.line);
                line.clear();
                let missing = |&c: &usize| -self.basic_slope(c) - self.gradient[c];
                line.extend(self.basic.iter().map(missing));
                self.line = line;
                self.kernel.solve_transposed(&self.line, &mut self.rho);
                for (row, change) in self.active.iter_mut().zip(&self.rho) {
                    row.multiplier += change;
                }
                self.load_gradient(program);
            }
            let excess = |(i, row): (usize, &ActiveRow)| {
                let (lower, upper) = self.multiplier_range(program, row.index);
                (i, (lower - row.multiplier).max(row.multiplier - upper))
            };
            let worst = self.active.iter().enumerate().map(excess);
            let Some((i, excess)) = worst.max_by(|a, b| a.1.total_cmp(&b.1)) else { return };
            let ActiveRow { index, multiplier, .. } = self.active[i];
            if excess <= self.drift * (1.0 + multiplier.abs()) {
                return;
            }
            let partner = self.kernel.partner_of_row(i);
            self.put(self.basic[partner], Place::At(0));
            self.drop_pair(partner, i);
            if self.is_tracking(index) {
                self.at_upper[index - self.layout.tracking] = multiplier > 0.0;
            }
        }
    }

    /// d = A'y over all rows.
    fn load_gradient(&mut self, program: &HorizonProgram<'_>) {
        let mut gradient = std::mem::take(&mut self.gradient);
        self.start_gradient(program, &mut gradient);
        for i in 0..self.active.len() {
            let ActiveRow { id, multiplier, .. } = self.active[i];
            let images = &self.images[i * self.leaving_images.len()..];
            add_row(program, id, multiplier, images, &mut self.costates, &mut gradient);
        }
        for index in self.layout.tracking..self.layout.input {
            if self.position[index] == INACTIVE {
                let weight = self.resting_multiplier(program, index);
                let RowId { stage, index, .. } = self.row_id(program, index);
                let row = program.plant.anchors().component(stage, index);
                let n = program.states();
                add_scaled(&mut self.costates[stage * n..][..n], row, weight);
            }
        }
        self.finish_gradient(program, &mut gradient);
        self.gradient = gradient;
    }

    fn start_gradient(&mut self, program: &HorizonProgram<'_>, gradient: &mut [f64]) {
        // One stage more than there is holds what terminal rows ask of the generators.
        reset(&mut self.costates, (program.horizon + 2) * program.states());
        gradient.fill(0.0);
    }

    fn finish_gradient(&mut self, program: &HorizonProgram<'_>, gradient: &mut [f64]) {
        let n = program.states();
        let (inputs, coefficients) = gradient.split_at_mut(program.horizon * program.inputs());
        program.plant.anchors().add_gradient(&self.costates, &mut self.costate, inputs);
        let terminal = &self.costates[(program.horizon + 1) * n..];
        let generators = program.terminal_generators.chunks_exact(n);
        for (value, generator) in coefficients.iter_mut().zip(generators) {
            *value = -dot(generator, terminal);
        }
    }

    fn put(&mut self, column: usize, place: Place) {
        self.place[column] = place;
        self.limits[column] = match place {
            Place::At(point) => self.columns[column].limits(point),
            Place::Basic { .. } => [f64::NEG_INFINITY, f64::INFINITY],
        };
    }

    /// Puts every resting column where its gradient wants it.
    fn rest_columns(&mut self) {
        for i in 0..self.columns.len() {
            if let Place::At(present) = self.place[i] {
                let column = &self.columns[i];
                let drift = self.drift * (1.0 + self.gradient[i].abs());
                let point = if column.rests_at(present, self.gradient[i], drift) {
                    present
                } else {
                    column.resting_point(self.gradient[i])
                };
                self.put(i, Place::At(point));
                self.values[i] = self.columns[i].points[point as usize];
            }
        }
    }

    /// Images of row `index` into `leaving_images`.
    fn load_images(&mut self, program: &HorizonProgram<'_>, index: usize) {
        let RowId { family, stage, index: c } = self.row_id(program, index);
        let anchors = program.plant.anchors();
        let n = program.states();
        match family {
            RowFamily::Stage => {
                anchors.images(&self.stage_rows[index * n..][..n], stage, &mut self.leaving_images);
            }
            RowFamily::Tracking | RowFamily::Terminal => {
                reset(&mut self.costate, n);
                add_scaled(&mut self.costate, anchors.component(stage, c), self.scale[index]);
                anchors.images(&self.costate, stage, &mut self.leaving_images);
            }
            RowFamily::Input => {
                let m = program.inputs();
                let normal = &program.input_normals[c * m..][..m];
                self.leaving_images.fill(0.0);
                add_scaled(&mut self.leaving_images, normal, self.scale[index]);
            }
        }
    }

    fn images_of(&self, position: usize) -> &[f64] {
        let stride = self.leaving_images.len();
        &self.images[position * stride..][..stride]
    }

    /// Scaled coefficient of a row, given by its images, on a column.
    fn coefficient(
        &self,
        program: &HorizonProgram<'_>,
        id: RowId,
        images: &[f64],
        column: usize,
    ) -> f64 {
        let (n, m) = (program.states(), program.inputs());
        let (stage, c) = (column / m, column % m);
        match id.family {
            RowFamily::Input => {
                if stage == id.stage {
                    images[c]
                } else {
                    0.0
                }
            }
            _ if stage < id.stage => program.plant.anchors().coefficient(images, stage, c),
            RowFamily::Terminal => {
                let generator = column - program.horizon * m;
                let scale = self.scale[self.layout.terminal + id.index];
                -scale * program.terminal_generators[generator * n + id.index]
            }
            RowFamily::Stage | RowFamily::Tracking => 0.0,
        }
    }

    fn iterate(
        &mut self,
        program: &HorizonProgram<'_>,
        cut_off: Option<f64>,
        limit: usize,
        pivots: &mut usize,
        budget: Budget<'_>,
    ) -> Result<End, Interruption> {
        let mut since_refresh = 0;
        let mut settled = true;
        self.load_values(program);
        let mut bound = self.lagrangian(program);
        loop {
            if pivots.is_multiple_of(BUDGET_PERIOD) {
                budget.check()?;
            }
            if cut_off.is_some_and(|limit| bound >= limit) {
                return Ok(End::CutOff(bound));
            }
            let Some(leaving) = self.price(program) else {
                if settled {
                    return Ok(End::Optimal);
                }
                // Once by the kernel as it is; if the optimum comes apart, by a new one.
                if self.drift == DRIFT {
                    self.settle(program);
                } else {
                    self.refresh(program, SAME_VERTEX);
                    since_refresh = 0;
                }
                self.drift = (10.0 * self.drift).min(DRIFT_MAX);
                settled = true;
                self.load_values(program);
                bound = self.lagrangian(program);
                continue;
            };
            if *pivots >= limit {
                return Ok(End::Exhausted);
            }
            self.direction(program, leaving);
            let ratio::Outcome::Step { candidate, sound } = self.ratio_test(program, leaving)
            else {
                return Ok(End::Infeasible(leaving));
            };
            self.pivot(program, leaving, candidate);
            let progress = candidate.gain > 1e-12 * (1.0 + bound.abs());
            self.stalled = if progress { 0 } else { self.stalled + 1 };
            bound += candidate.gain;
            *pivots += 1;
            settled = false;
            since_refresh += 1;
            if sound && since_refresh < REFRESH_PERIOD {
                self.move_values(program, leaving);
            } else {
                self.refresh(program, SAME_VERTEX);
                (since_refresh, settled) = (0, true);
                self.load_values(program);
                bound = self.lagrangian(program);
            }
        }
    }

    /// Values of the basic columns, such that the active rows hold, and the states of all.
    fn load_values(&mut self, program: &HorizonProgram<'_>) {
        for &column in &self.basic {
            self.values[column] = 0.0;
        }
        self.roll_forward(program);
        if self.basic.is_empty() {
            return;
        }
        self.line.clear();
        for i in 0..self.active.len() {
            let missing = -self.residual(program, self.active[i].index);
            self.line.push(missing);
        }
        self.kernel.solve(&self.line, &mut self.basic_values);
        for (&column, value) in self.basic.iter().zip(&self.basic_values) {
            self.values[column] = *value;
        }
        self.roll_forward(program);
    }

    /// The same after a pivot, from what moved in it; anew where so much moved that it is cheaper.
    fn move_values(&mut self, program: &HorizonProgram<'_>, leaving: Leaving) {
        if self.moved.len() * self.active.len() > self.columns.len() {
            self.load_values(program);
            return;
        }
        let mut line = std::mem::take(&mut self.line);
        line.clear();
        for (i, row) in self.active.iter().enumerate() {
            let images = self.images_of(i);
            let shift = |&(column, change): &(usize, f64)| {
                change * self.coefficient(program, row.id, images, column)
            };
            line.push(-self.moved.iter().map(shift).sum::<f64>());
        }
        if let Leaving::Row { index, residual } = leaving
            && let Some(missing) = line.get_mut(self.position[index] as usize)
        {
            *missing -= residual;
        }
        self.kernel.solve(&line, &mut self.basic_values);
        self.line = line;
        for (&column, change) in self.basic.iter().zip(&self.basic_values) {
            self.values[column] += change;
        }
        self.roll_forward(program);
    }

    /// Anchored states and sum of generators under `values`.
    fn roll_forward(&mut self, program: &HorizonProgram<'_>) {
        let n = program.states();
        self.states[..n].copy_from_slice(program.initial);
        let (inputs, coefficients) = self.values.split_at(program.horizon * program.inputs());
        program.plant.anchors().roll_forward(inputs, &mut self.states);
        self.reached.fill(0.0);
        for (generator, &xi) in program.terminal_generators.chunks_exact(n).zip(coefficients) {
            add_scaled(&mut self.reached, generator, xi);
        }
    }

    /// The dual objective: the Lagrangian at the columns that minimise it.
    fn lagrangian(&self, program: &HorizonProgram<'_>) -> f64 {
        let mut total = program.constant;
        for ((column, place), value) in self.columns.iter().zip(&self.place).zip(&self.values) {
            total += match place {
                Place::At(_) => column.cost(*value),
                Place::Basic { segment } => column.slopes[*segment as usize] * value,
            };
        }
        for index in self.layout.tracking..self.layout.input {
            if self.position[index] == INACTIVE {
                let weight = self.resting_multiplier(program, index);
                total += weight * self.residual(program, index) / self.scale[index];
            }
        }
        total
    }

    fn objective(&self, program: &HorizonProgram<'_>) -> f64 {
        let costs = self.columns.iter().zip(&self.values).map(|(c, v)| c.cost(*v));
        let mut total = program.constant + costs.sum::<f64>();
        for index in self.layout.tracking..self.layout.input {
            let deviation = self.residual(program, index) / self.scale[index];
            total += program.tracking_weight * deviation.abs();
        }
        total
    }

    /// Scaled left side minus right side of a row at `states`, `values` and `reached`.
    fn residual(&self, program: &HorizonProgram<'_>, index: usize) -> f64 {
        let (n, m) = (program.states(), program.inputs());
        let RowId { family, stage, index: c } = self.row_id(program, index);
        let w = &self.states[stage * n..][..n];
        match family {
            RowFamily::Stage => {
                dot(&self.stage_rows[index * n..][..n], w) - self.stage_sides[index]
            }
            RowFamily::Tracking => {
                let z = dot(program.plant.anchors().component(stage, c), w);
                self.scale[index] * (z - program.reference(stage)[c])
            }
            RowFamily::Input => {
                let left =
                    dot(&program.input_normals[c * m..][..m], &self.values[stage * m..][..m]);
                let right = program.input_offsets[stage * program.input_rows() + c];
                self.scale[index] * (left - right)
            }
            RowFamily::Terminal => {
                let z = dot(program.plant.anchors().component(stage, c), w);
                self.scale[index] * (z - program.terminal_centre[c] - self.reached[c])
            }
        }
    }

    /// The violated column or row that leaves, if any: the largest violation per unit dual step, or
    /// the first of all when the dual objective has stalled.
    ///
    /// For a basic column the steepest-edge norm is a row of the kernel, so it is exact and free.
    /// For a row it would cost a row of coefficients each; 1, its least value, does nearly as
    /// well: 34 pivots against 31 with exact norms and 56 without any, at N = 26 on EnviSat.
    fn price(&self, program: &HorizonProgram<'_>) -> Option<Leaving> {
        let first_of_all = self.stalled > STALL;
        let mut best = None;
        let mut largest = FEASIBILITY;
        for (position, &index) in self.basic.iter().enumerate() {
            let Place::Basic { segment } = self.place[index] else { continue };
            let points = &self.columns[index].points;
            let (bottom, top) = (points[segment as usize], points[segment as usize + 1]);
            let value = self.values[index];
            let excess = (bottom - value).max(value - top);
            if excess <= FEASIBILITY {
                continue;
            }
            let steepness = excess / self.kernel.norm(position);
            if steepness > largest {
                best = Some(Leaving::Column { position, at_top: value > top, excess });
                if first_of_all {
                    return best;
                }
                largest = steepness;
            }
        }
        self.price_rows(program, first_of_all, largest).or(best)
    }

    fn price_rows(
        &self,
        program: &HorizonProgram<'_>,
        first_of_all: bool,
        at_least: f64,
    ) -> Option<Leaving> {
        let mut best = None;
        let mut largest = at_least;
        let mut offer = |index: usize, residual: f64, violation: f64| {
            if violation > largest && self.position[index] == INACTIVE {
                best = Some(Leaving::Row { index, residual });
                largest = if first_of_all { f64::INFINITY } else { violation };
            }
        };
        let n = program.states();
        for index in self.layout.terminal..self.layout.end {
            let e = self.residual(program, index);
            offer(index, e, e.abs());
        }
        match (n, program.stage_rows) {
            (_, 0) => {}
            (6, 4) => self.visit_stage_rows(6, 4, &mut offer),
            (n, q) => self.visit_stage_rows(n, q, &mut offer),
        }
        for index in self.layout.tracking..self.layout.terminal {
            let e = self.residual(program, index);
            let wrong_side = self.is_tracking(index) && self.at_upper[index - self.layout.tracking];
            offer(index, e, if wrong_side { -e } else { e });
        }
        best
    }

    /// Residuals of the stage rows. Inlined where the sizes are constants, so that loops unroll.
    #[inline(always)]
    fn visit_stage_rows(&self, n: usize, q: usize, offer: &mut impl FnMut(usize, f64, f64)) {
        let rows = self.stage_rows.chunks_exact(n * q).zip(self.stage_sides.chunks_exact(q));
        let states = self.states[n..].chunks_exact(n);
        for (stage, (w, (rows, sides))) in states.zip(rows).enumerate() {
            for (i, (row, side)) in rows.chunks_exact(n).zip(sides).enumerate() {
                let e = dot(row, w) - side;
                offer(stage * q + i, e, e);
            }
        }
    }

    fn basic_slope(&self, column: usize) -> f64 {
        match self.place[column] {
            Place::Basic { segment } => self.columns[column].slopes[segment as usize],
            Place::At(_) => 0.0,
        }
    }

    fn is_tracking(&self, index: usize) -> bool {
        (self.layout.tracking..self.layout.input).contains(&index)
    }

    /// Range of a row's scaled multiplier.
    fn multiplier_range(&self, program: &HorizonProgram<'_>, index: usize) -> (f64, f64) {
        if index >= self.layout.terminal {
            (f64::NEG_INFINITY, f64::INFINITY)
        } else if self.is_tracking(index) {
            let bound = program.tracking_weight / self.scale[index];
            (-bound, bound)
        } else {
            (0.0, f64::INFINITY)
        }
    }

    /// Unscaled multiplier of an inactive row.
    fn resting_multiplier(&self, program: &HorizonProgram<'_>, index: usize) -> f64 {
        if !self.is_tracking(index) {
            0.0
        } else if self.at_upper[index - self.layout.tracking] {
            program.tracking_weight
        } else {
            -program.tracking_weight
        }
    }

    fn row_id(&self, program: &HorizonProgram<'_>, index: usize) -> RowId {
        let (n, q) = (program.states(), program.stage_rows);
        let (family, base, per_stage, first) = if index >= self.layout.terminal {
            let index = index - self.layout.terminal;
            return RowId { family: RowFamily::Terminal, stage: program.horizon, index };
        } else if index >= self.layout.input {
            (RowFamily::Input, self.layout.input, program.input_rows(), 0)
        } else if index >= self.layout.tracking {
            (RowFamily::Tracking, self.layout.tracking, n, 1)
        } else {
            (RowFamily::Stage, 0, q, 1)
        };
        let offset = index - base;
        RowId { family, stage: offset / per_stage + first, index: offset % per_stage }
    }

    fn row_index(&self, program: &HorizonProgram<'_>, id: RowId) -> Option<usize> {
        let (n, q) = (program.states(), program.stage_rows);
        let (base, per_stage, first, end) = match id.family {
            RowFamily::Stage => (0, q, 1, self.layout.tracking),
            RowFamily::Tracking => (self.layout.tracking, n, 1, self.layout.input),
            RowFamily::Input => (self.layout.input, program.input_rows(), 0, self.layout.terminal),
            RowFamily::Terminal => {
                return (id.index < n).then_some(self.layout.terminal + id.index);
            }
        };
        let index = base + id.stage.checked_sub(first)? * per_stage + id.index;
        (id.index < per_stage && index < end).then_some(index)
    }
}

fn reset(buffer: &mut Vec<f64>, length: usize) {
    buffer.clear();
    buffer.resize(length, 0.0);
}

fn inverse_or_one(value: f64) -> f64 {
    if value > 0.0 { 1.0 / value } else { 1.0 }
}

/// One over the largest effect of a unit input on the row, or over the row itself.
fn row_scale(normal: &[f64], reach: &[f64]) -> f64 {
    let effect: f64 = normal.iter().zip(reach).map(|(h, r)| h.abs() * r).sum();
    if effect > 0.0 {
        1.0 / effect
    } else {
        inverse_or_one(normal.iter().fold(0.0, |a, h| a.max(h.abs())))
    }
}

/// Adds `multiplier` times a row to the costates, or to the gradient directly.
fn add_row(
    program: &HorizonProgram<'_>,
    id: RowId,
    multiplier: f64,
    images: &[f64],
    costates: &mut [f64],
    gradient: &mut [f64],
) {
    let (n, m) = (program.states(), program.inputs());
    if id.family == RowFamily::Input {
        add_scaled(&mut gradient[id.stage * m..][..m], &images[..m], multiplier);
        return;
    }
    let own = program.plant.anchors().block_of(id.stage);
    add_scaled(&mut costates[id.stage * n..][..n], &images[own * n..][..n], multiplier);
    if id.family == RowFamily::Terminal {
        let scale = inverse_or_one(program.plant.reach(id.stage)[id.index]);
        costates[(program.horizon + 1) * n + id.index] += scale * multiplier;
    }
}
