//! A bounded dual simplex for [`HorizonProgram`]s that never forms the matrix.
//!
//! The program has hundreds of rows and a hundred columns, but at any vertex only a dozen rows
//! hold with equality. So the rows are evaluated by rolling the plant forward, and only the
//! active ones are kept as coefficients, with the explicit inverse of their square kernel.
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

use kernel::{Kernel, dot};

use super::{
    BasicColumn, Basis, HorizonProgram, Multiplier, RowFamily, RowId, Solution, Solver, Status,
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
    values: Vec<f64>,
    /// Gradient of the Lagrangian without the column's own cost: d = A'y.
    gradient: Vec<f64>,
    /// Change of `gradient` along the dual step.
    gradient_step: Vec<f64>,
    // Rows.
    layout: Layout,
    scale: Vec<f64>,
    /// Position in `active`, or `INACTIVE`.
    position: Vec<u32>,
    /// At which bound an inactive tracking row's multiplier rests.
    at_upper: Vec<bool>,
    /// States under zero input, and under `values`.
    free_states: Vec<f64>,
    states: Vec<f64>,
    // The vertex.
    active: Vec<ActiveRow>,
    /// One row of `columns.len()` coefficients an active row.
    coefficients: Vec<f64>,
    basic: Vec<usize>,
    kernel: Kernel,
    // Scratch of one pivot.
    leaving_coefficients: Vec<f64>,
    rho: Vec<f64>,
    multiplier_step: Vec<f64>,
    entering: Vec<f64>,
    lengths: Vec<f64>,
    events: Vec<ratio::Candidate>,
    passed: Vec<ratio::Candidate>,
    right_sides: Vec<f64>,
    costates: Vec<f64>,
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
    /// Scaled multiplier.
    multiplier: f64,
    /// Right side minus what the resting columns contribute.
    right: f64,
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
    /// Columns, row scales and free response of `program`, at the vertex v = argmin cost, y = 0.
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
        reset(&mut self.values, count);
        reset(&mut self.gradient, count);
        reset(&mut self.gradient_step, count);
        reset(&mut self.leaving_coefficients, count);
        reset(&mut self.free_states, (horizon + 1) * n);
        reset(&mut self.states, (horizon + 1) * n);
        self.free_states[..n].copy_from_slice(program.initial);
        program.plant.roll_forward(&self.values[..horizon * m], &mut self.free_states);
        self.load_rows(program);
        self.active.clear();
        self.coefficients.clear();
        self.basic.clear();
        self.kernel.clear();
        self.stalled = 0;
        self.drift = DRIFT;
    }

    fn load_rows(&mut self, program: &HorizonProgram<'_>) {
        let (n, horizon) = (program.states(), program.horizon);
        let tracked = if program.tracking_weight > 0.0 { program.tracked_stages } else { 0 };
        let tracking = program.constrained_stages * program.stage_rows;
        let input = tracking + tracked * n;
        let terminal = input + horizon * program.input_rows();
        self.layout = Layout { tracking, input, terminal, end: terminal + n };
        self.scale.clear();
        for stage in 1..=program.constrained_stages {
            let reach = program.plant.reach(stage);
            for row in 0..program.stage_rows {
                self.scale.push(row_scale(program.stage_normal(stage, row), reach));
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
        for stage in 1..=tracked {
            let z = &self.free_states[stage * n..][..n];
            self.at_upper.extend(z.iter().zip(program.reference(stage)).map(|(z, r)| z > r));
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
            self.place[index] = Place::Basic { segment };
            self.basic.push(index);
        }
        for index in rows {
            self.position[index] = 0;
            self.active.push(ActiveRow { index, multiplier: 0.0, right: 0.0 });
        }
    }

    /// Everything anew from the names of active rows and basic columns: coefficients, kernel,
    /// multipliers, gradient, resting places, values. Rows and columns without rank are dropped,
    /// then rows whose multiplier has the wrong sign.
    fn refresh(&mut self, program: &HorizonProgram<'_>, rank_tolerance: f64) {
        let (rows, columns) = (self.active.len(), self.basic.len());
        let count = self.columns.len();
        self.coefficients.clear();
        self.coefficients.resize(rows * count, 0.0);
        for i in 0..rows {
            let index = self.active[i].index;
            let mut line = std::mem::take(&mut self.leaving_coefficients);
            self.row_coefficients(program, index, &mut line);
            self.coefficients[i * count..][..count].copy_from_slice(&line);
            self.leaving_coefficients = line;
        }
        let matrix: Vec<f64> = (0..rows)
            .flat_map(|i| self.basic.iter().map(move |&c| (i, c)))
            .map(|(i, c)| self.coefficients[i * count + c])
            .collect();
        let kept = self.kernel.factor(&matrix, rows, columns, rank_tolerance);
        self.keep(&kept);
        self.settle_multipliers(program);
        self.rest_columns();
        self.load_right_sides(program);
    }

    /// Reduces the vertex to the kept (row, column) pairs, in their order.
    fn keep(&mut self, kept: &[(usize, usize)]) {
        let count = self.columns.len();
        let (active, basic) = (self.active.clone(), self.basic.clone());
        let coefficients = std::mem::take(&mut self.coefficients);
        for row in &active {
            self.position[row.index] = INACTIVE;
        }
        for (j, &column) in basic.iter().enumerate() {
            if !kept.iter().any(|&(_, c)| c == j) {
                self.place[column] = Place::At(0);
            }
        }
        self.active = kept.iter().map(|&(r, _)| active[r]).collect();
        self.basic = kept.iter().map(|&(_, c)| basic[c]).collect();
        for &(r, _) in kept {
            self.coefficients.extend_from_slice(&coefficients[r * count..][..count]);
        }
        self.number_rows();
    }

    fn number_rows(&mut self) {
        for (i, row) in self.active.iter().enumerate() {
            self.position[row.index] = u32::try_from(i).unwrap_or(INACTIVE);
        }
    }

    /// Multipliers that put every basic column on its slope; drops rows with wrong signs.
    fn settle_multipliers(&mut self, program: &HorizonProgram<'_>) {
        loop {
            for row in &mut self.active {
                row.multiplier = 0.0;
            }
            // Gradient from the resting tracking rows alone, then what is missing to the slopes.
            self.load_gradient(program);
            let missing: Vec<f64> =
                (self.basic.iter()).map(|&c| -self.basic_slope(c) - self.gradient[c]).collect();
            let mut multipliers = Vec::new();
            self.kernel.solve_transposed(&missing, &mut multipliers);
            let worst = (0..self.active.len())
                .map(|i| {
                    let (lower, upper) = self.multiplier_range(program, self.active[i].index);
                    let y = multipliers[i];
                    (i, (lower - y).max(y - upper), y > upper)
                })
                .max_by(|a, b| a.1.total_cmp(&b.1));
            match worst {
                Some((i, excess, above)) if excess > self.drift * (1.0 + multipliers[i].abs()) => {
                    let index = self.active[i].index;
                    let partner = self.kernel.partner_of_row(i);
                    self.place[self.basic[partner]] = Place::At(0);
                    self.drop_pair(partner, i);
                    if self.is_tracking(index) {
                        self.at_upper[index - self.layout.tracking] = above;
                    }
                }
                _ => {
                    for (row, y) in self.active.iter_mut().zip(&multipliers) {
                        row.multiplier = *y;
                    }
                    break;
                }
            }
        }
        self.load_gradient(program);
    }

    /// d = A'y over all rows, by the costate recursion.
    fn load_gradient(&mut self, program: &HorizonProgram<'_>) {
        let (n, m, horizon) = (program.states(), program.inputs(), program.horizon);
        let mut costates = std::mem::take(&mut self.costates);
        reset(&mut costates, (horizon + 1) * n);
        reset(&mut self.gradient, self.columns.len());
        for i in 0..self.active.len() {
            let ActiveRow { index, multiplier, .. } = self.active[i];
            self.add_row(program, index, multiplier * self.scale[index], &mut costates);
        }
        for index in self.layout.tracking..self.layout.input {
            if self.position[index] == INACTIVE {
                let weight = self.resting_multiplier(program, index);
                self.add_row(program, index, weight, &mut costates);
            }
        }
        let mut carried = vec![0.0; n];
        for stage in (1..=horizon).rev() {
            let costate = &mut costates[stage * n..][..n];
            for (value, from_later) in costate.iter_mut().zip(&carried) {
                *value += from_later;
            }
            let mut slope = [0.0; 16];
            let slope = &mut slope[..m.min(16)];
            if m <= 16 {
                program.plant.input_gradient(costate, slope);
                for (value, s) in self.gradient[(stage - 1) * m..].iter_mut().zip(slope.iter()) {
                    *value += s;
                }
            } else {
                let mut slope = vec![0.0; m];
                program.plant.input_gradient(costate, &mut slope);
                for (value, s) in self.gradient[(stage - 1) * m..].iter_mut().zip(&slope) {
                    *value += s;
                }
            }
            program.plant.costate_back(costate, &mut carried);
        }
        self.costates = costates;
    }

    /// Adds `weight` times a row's left side to the costates, or to the gradient directly.
    fn add_row(
        &mut self,
        program: &HorizonProgram<'_>,
        index: usize,
        weight: f64,
        costates: &mut [f64],
    ) {
        let (n, m) = (program.states(), program.inputs());
        let id = self.row_id(program, index);
        match id.family {
            RowFamily::Stage => {
                let normal = program.stage_normal(id.stage, id.index);
                super::tables::add_scaled(&mut costates[id.stage * n..][..n], normal, weight);
            }
            RowFamily::Tracking => costates[id.stage * n + id.index] += weight,
            RowFamily::Input => {
                let normal = &program.input_normals[id.index * m..][..m];
                let gradient = &mut self.gradient[id.stage * m..][..m];
                super::tables::add_scaled(gradient, normal, weight);
            }
            RowFamily::Terminal => {
                costates[program.horizon * n + id.index] += weight;
                let first = program.horizon * m;
                for (e, generator) in program.terminal_generators.chunks_exact(n).enumerate() {
                    self.gradient[first + e] -= weight * generator[id.index];
                }
            }
        }
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
                self.place[i] = Place::At(point);
                self.values[i] = self.columns[i].points[point as usize];
            }
        }
    }

    fn load_right_sides(&mut self, program: &HorizonProgram<'_>) {
        for i in 0..self.active.len() {
            let index = self.active[i].index;
            let line = &self.coefficients[i * self.columns.len()..][..self.columns.len()];
            let resting = self.resting_contribution(line);
            self.active[i].right = -self.free_residual(program, index) - resting;
        }
    }

    fn resting_contribution(&self, line: &[f64]) -> f64 {
        let terms = line.iter().zip(&self.values).zip(&self.place);
        terms.map(|((a, v), place)| if let Place::At(_) = place { a * v } else { 0.0 }).sum()
    }

    /// Scaled residual of a row under zero input and zero terminal coefficients.
    fn free_residual(&self, program: &HorizonProgram<'_>, index: usize) -> f64 {
        let id = self.row_id(program, index);
        self.scale[index] * residual(program, id, &self.free_states, None)
    }

    /// Scaled coefficients of a row on all columns.
    fn row_coefficients(&self, program: &HorizonProgram<'_>, index: usize, out: &mut [f64]) {
        let (n, m) = (program.states(), program.inputs());
        let id = self.row_id(program, index);
        let scale = self.scale[index];
        out.fill(0.0);
        match id.family {
            RowFamily::Stage => {
                let normal = program.stage_normal(id.stage, id.index);
                program.plant.coefficients(normal, id.stage, scale, out);
            }
            RowFamily::Tracking => unit_coefficients(program, id.stage, id.index, scale, out),
            RowFamily::Input => {
                let normal = &program.input_normals[id.index * m..][..m];
                for (value, h) in out[id.stage * m..].iter_mut().zip(normal) {
                    *value = scale * h;
                }
            }
            RowFamily::Terminal => {
                unit_coefficients(program, program.horizon, id.index, scale, out);
                let generators = program.terminal_generators.chunks_exact(n);
                for (value, generator) in out[program.horizon * m..].iter_mut().zip(generators) {
                    *value = -scale * generator[id.index];
                }
            }
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
        self.load_values(program);
        let mut bound = self.lagrangian(program);
        loop {
            if pivots.is_multiple_of(BUDGET_PERIOD) {
                budget.check()?;
            }
            if cut_off.is_some_and(|limit| bound >= limit) {
                return Ok(End::CutOff(bound));
            }
            let leaving = self.price(program);
            if let Some(leaving) = leaving {
                if *pivots >= limit {
                    return Ok(End::Exhausted);
                }
                self.direction(program, leaving);
                match self.ratio_test(program, leaving) {
                    ratio::Outcome::Step { candidate, sound } => {
                        self.pivot(program, leaving, candidate);
                        let progress = candidate.gain > 1e-12 * (1.0 + bound.abs());
                        self.stalled = if progress { 0 } else { self.stalled + 1 };
                        bound += candidate.gain;
                        since_refresh = if sound { since_refresh + 1 } else { REFRESH_PERIOD };
                    }
                    ratio::Outcome::Unbounded => return Ok(End::Infeasible(leaving)),
                }
                *pivots += 1;
            } else if since_refresh == 0 {
                return Ok(End::Optimal);
            }
            if leaving.is_none() || since_refresh >= REFRESH_PERIOD {
                self.refresh(program, SAME_VERTEX);
                if leaving.is_none() {
                    self.drift = (10.0 * self.drift).min(DRIFT_MAX);
                }
                since_refresh = 0;
                self.load_values(program);
                bound = self.lagrangian(program);
            } else {
                self.load_values(program);
            }
        }
    }

    /// Values of the basic columns and the states they lead to.
    fn load_values(&mut self, program: &HorizonProgram<'_>) {
        self.right_sides.clear();
        self.right_sides.extend(self.active.iter().map(|row| row.right));
        for (i, &column) in self.basic.iter().enumerate() {
            self.values[column] = dot(self.kernel.row(i), &self.right_sides);
        }
        let (n, m) = (program.states(), program.inputs());
        self.states[..n].copy_from_slice(program.initial);
        program.plant.roll_forward(&self.values[..program.horizon * m], &mut self.states);
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
                let id = self.row_id(program, index);
                let weight = self.resting_multiplier(program, index);
                total += weight * residual(program, id, &self.states, None);
            }
        }
        total
    }

    fn objective(&self, program: &HorizonProgram<'_>) -> f64 {
        let costs = self.columns.iter().zip(&self.values).map(|(c, v)| c.cost(*v));
        let mut total = program.constant + costs.sum::<f64>();
        for index in self.layout.tracking..self.layout.input {
            let id = self.row_id(program, index);
            total += program.tracking_weight * residual(program, id, &self.states, None).abs();
        }
        total
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
            let row = self.kernel.row(position);
            let steepness = excess / dot(row, row).sqrt();
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
            let id = RowId {
                family: RowFamily::Terminal,
                stage: program.horizon,
                index: index - self.layout.terminal,
            };
            let coefficients = Some(self.terminal(program));
            let e = self.scale[index] * residual(program, id, &self.states, coefficients);
            offer(index, e, e.abs());
        }
        let rows = program.constrained_stages * program.stage_rows;
        let constrained = self.states[n..].chunks_exact(n).take(program.constrained_stages);
        let states = constrained.flat_map(|z| std::iter::repeat_n(z, program.stage_rows));
        let normals = program.stage_normals.chunks_exact(n);
        let sides = program.stage_offsets.iter().zip(&self.scale[..rows]);
        for (index, ((z, normal), (offset, scale))) in states.zip(normals).zip(sides).enumerate() {
            let left = match (normal.as_array::<6>(), z.as_array::<6>()) {
                (Some(normal), Some(z)) => (0..6).map(|i| normal[i] * z[i]).sum(),
                _ => dot(normal, z),
            };
            let e = scale * (left - offset);
            offer(index, e, e);
        }
        for index in self.layout.tracking..self.layout.terminal {
            let id = self.row_id(program, index);
            let inputs = if id.family == RowFamily::Input { Some(&self.values[..]) } else { None };
            let e = self.scale[index] * residual(program, id, &self.states, inputs);
            let wrong_side = self.is_tracking(index) && self.at_upper[index - self.layout.tracking];
            offer(index, e, if wrong_side { -e } else { e });
        }
        best
    }

    fn terminal(&self, program: &HorizonProgram<'_>) -> &[f64] {
        &self.values[program.horizon * program.inputs()..]
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

/// Scaled coefficients of one state component at `stage`.
fn unit_coefficients(
    program: &HorizonProgram<'_>,
    stage: usize,
    component: usize,
    scale: f64,
    out: &mut [f64],
) {
    let m = program.inputs();
    for (i, chunk) in out[..stage * m].chunks_exact_mut(m).enumerate() {
        let response = program.plant.response_row(stage - 1 - i, component);
        for (value, entry) in chunk.iter_mut().zip(response) {
            *value = scale * entry;
        }
    }
}

/// Left side minus right side of a row. `columns`: the inputs for an input row, the terminal
/// coefficients for a terminal row; `None` stands for zeros.
fn residual(
    program: &HorizonProgram<'_>,
    id: RowId,
    states: &[f64],
    columns: Option<&[f64]>,
) -> f64 {
    let (n, m) = (program.states(), program.inputs());
    match id.family {
        RowFamily::Stage => {
            let z = &states[id.stage * n..][..n];
            dot(program.stage_normal(id.stage, id.index), z)
                - program.stage_offset(id.stage, id.index)
        }
        RowFamily::Tracking => {
            states[id.stage * n + id.index] - program.reference(id.stage)[id.index]
        }
        RowFamily::Input => {
            let normal = &program.input_normals[id.index * m..][..m];
            let left = columns.map_or(0.0, |inputs| dot(normal, &inputs[id.stage * m..][..m]));
            left - program.input_offsets[id.stage * program.input_rows() + id.index]
        }
        RowFamily::Terminal => {
            let offset = columns.map_or(0.0, |coefficients| {
                let generators = program.terminal_generators.chunks_exact(n);
                generators.zip(coefficients).map(|(g, xi)| g[id.index] * xi).sum()
            });
            states[program.horizon * n + id.index] - program.terminal_centre[id.index] - offset
        }
    }
}
