//! What an answer is worth, recomputed from the program alone.
//!
//! Plain recursions over `nalgebra`-free slices in the order of the definitions, from A and B and
//! not from the tables that the solvers run on; nothing here is shared with a solver.

use super::{HorizonProgram, Multiplier, RowFamily, RowId};

/// How far inputs and terminal coefficients are from satisfying a program. Positive is violated,
/// negative is the margin left.
#[derive(Debug, Clone, PartialEq)]
pub struct Residuals {
    /// The objective of the inputs.
    pub objective: f64,
    /// Worst bound of an input.
    pub input_bound: Option<Residual>,
    /// Worst input row, per unit normal.
    pub input_row: Option<Residual>,
    /// Worst state row, per unit normal.
    pub stage_row: Option<Residual>,
    /// Worst component of z_N - centre - generators xi.
    pub terminal: Residual,
    /// max |xi| - 1; `None` without generators.
    pub terminal_coefficient: Option<f64>,
}

/// The worst of a family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// Stage; inputs count from 0, states from 1.
    pub stage: usize,
    /// Row or component.
    pub index: usize,
    /// Left side minus right side.
    pub value: f64,
}

/// A lower bound on the optimum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DualBound {
    /// The bound; -infinite if the multipliers prove nothing.
    pub value: f64,
    /// Largest amount by which a multiplier had the wrong sign; it was taken as 0 there.
    pub clamped: f64,
}

/// z_0 .. z_N under `inputs`, by z_{j+1} = A z_j + B v_j.
#[must_use]
pub fn simulate(program: &HorizonProgram<'_>, inputs: &[f64]) -> Vec<f64> {
    let (n, m) = (program.states(), program.inputs());
    let (a, b) = program.plant.matrices();
    let mut states = vec![0.0; (program.horizon + 1) * n];
    states[..n].copy_from_slice(program.initial);
    for (j, v) in inputs.chunks_exact(m).enumerate() {
        let (past, future) = states.split_at_mut((j + 1) * n);
        let (z, next) = (&past[j * n..], &mut future[..n]);
        for (column, weight) in a.chunks_exact(n).chain(b.chunks_exact(n)).zip(z.iter().chain(v)) {
            next.iter_mut().zip(column).for_each(|(next, entry)| *next += entry * weight);
        }
    }
    states
}

/// Residuals of `inputs` (N m values) and `terminal_coefficients` (p values), along the states
/// that they lead to.
#[must_use]
pub fn verify(
    program: &HorizonProgram<'_>,
    inputs: &[f64],
    terminal_coefficients: &[f64],
) -> Residuals {
    verify_trajectory(program, &simulate(program, inputs), inputs, terminal_coefficients)
}

/// Residuals of a trajectory whose `states` ((N + 1) n values) are taken as they are given;
/// whether they follow the dynamics is for the caller to check.
#[must_use]
pub fn verify_trajectory(
    program: &HorizonProgram<'_>,
    states: &[f64],
    inputs: &[f64],
    terminal_coefficients: &[f64],
) -> Residuals {
    let (n, m, horizon) = (program.states(), program.inputs(), program.horizon);
    let mut input_bound = None;
    for (i, v) in inputs.iter().enumerate() {
        let value = (v - program.input_upper[i]).max(program.input_lower[i] - v);
        keep_worst(&mut input_bound, Residual { stage: i / m, index: i % m, value });
    }
    let mut input_row = None;
    for stage in 0..horizon {
        let v = &inputs[stage * m..][..m];
        for (index, normal) in program.input_normals.chunks_exact(m).enumerate() {
            let right = program.input_offsets[stage * program.input_rows() + index];
            let value = (sum_product(normal, v) - right) / norm(normal);
            keep_worst(&mut input_row, Residual { stage, index, value });
        }
    }
    let mut stage_row = None;
    for stage in 1..=program.constrained_stages {
        let z = &states[stage * n..][..n];
        for index in 0..program.stage_rows {
            let normal = program.stage_normal(stage, index);
            let left = sum_product(normal, z);
            let value = (left - program.stage_offset(stage, index)) / norm(normal);
            keep_worst(&mut stage_row, Residual { stage, index, value });
        }
    }
    let mut terminal = None;
    for index in 0..n {
        let generators = program.terminal_generators.chunks_exact(n);
        let reached: f64 = generators.zip(terminal_coefficients).map(|(g, xi)| g[index] * xi).sum();
        let miss = states[horizon * n + index] - program.terminal_centre[index] - reached;
        keep_worst(&mut terminal, Residual { stage: horizon, index, value: miss.abs() });
    }
    let largest = terminal_coefficients.iter().map(|xi| xi.abs() - 1.0).reduce(f64::max);
    Residuals {
        objective: objective(program, inputs, states),
        input_bound,
        input_row,
        stage_row,
        terminal: terminal.unwrap_or(Residual { stage: horizon, index: 0, value: 0.0 }),
        terminal_coefficient: largest,
    }
}

fn objective(program: &HorizonProgram<'_>, inputs: &[f64], states: &[f64]) -> f64 {
    let n = program.states();
    let effort: f64 = inputs.iter().map(|v| v.abs()).sum();
    let mut deviation = 0.0;
    for stage in 1..=program.tracked_stages {
        let z = &states[stage * n..][..n];
        deviation +=
            z.iter().zip(program.reference(stage)).map(|(z, r)| (z - r).abs()).sum::<f64>();
    }
    program.constant + program.input_cost * effort + program.tracking_weight * deviation
}

/// The lower bound that `multipliers` prove: the minimum of the Lagrangian over the input bounds.
/// Any multipliers of the program's rows give a valid bound; wrong signs are taken as 0.
/// Multipliers of rows that the program has not prove nothing.
#[must_use]
pub fn dual_bound(program: &HorizonProgram<'_>, multipliers: &[Multiplier]) -> DualBound {
    if !multipliers.iter().all(|multiplier| has_row(program, multiplier.row)) {
        return DualBound { value: f64::NEG_INFINITY, clamped: 0.0 };
    }
    let mut clamped = 0.0_f64;
    let weight = program.tracking_weight;
    let legal: Vec<Multiplier> = multipliers
        .iter()
        .map(|&Multiplier { row, value }| {
            let right = match row.family {
                RowFamily::Stage | RowFamily::Input => value.max(0.0),
                RowFamily::Tracking => value.clamp(-weight, weight),
                RowFamily::Terminal => value,
            };
            clamped = clamped.max((right - value).abs());
            Multiplier { row, value: right }
        })
        .collect();
    let value = program.constant + minimum_of_lagrangian(program, &legal, program.input_cost).0;
    DualBound { value: if value.is_nan() { f64::NEG_INFINITY } else { value }, clamped }
}

fn has_row(program: &HorizonProgram<'_>, RowId { family, stage, index }: RowId) -> bool {
    let n = program.states();
    match family {
        RowFamily::Stage => {
            (1..=program.constrained_stages).contains(&stage) && index < program.stage_rows
        }
        RowFamily::Tracking => (1..=program.tracked_stages).contains(&stage) && index < n,
        RowFamily::Input => stage < program.horizon && index < program.input_rows(),
        RowFamily::Terminal => stage == program.horizon && index < n,
    }
}

/// How strongly a ray proves that no inputs satisfy the rows: positive is a proof. Relative to
/// the terms that are summed, so that rounding cannot make one.
#[must_use]
pub fn farkas_margin(program: &HorizonProgram<'_>, ray: &[Multiplier]) -> f64 {
    let (value, size) = farkas_contradiction(program, ray);
    if size > 0.0 { value / size - 1e-12 } else { -1.0 }
}

/// By how much the rows of a ray contradict the input bounds, and the sum of the absolute values
/// of the terms of that: positive is a proof of infeasibility, linear in every right side.
#[must_use]
pub fn farkas_contradiction(program: &HorizonProgram<'_>, ray: &[Multiplier]) -> (f64, f64) {
    let legal: Vec<Multiplier> = ray
        .iter()
        .filter(|multiplier| match multiplier.row.family {
            RowFamily::Stage | RowFamily::Input => multiplier.value > 0.0,
            RowFamily::Tracking => false,
            RowFamily::Terminal => true,
        })
        .copied()
        .collect();
    minimum_of_lagrangian(program, &legal, 0.0)
}

/// min over the input bounds of cost |v|_1 + sum multiplier (left - right), and the sum of the
/// absolute values of what was added.
fn minimum_of_lagrangian(
    program: &HorizonProgram<'_>,
    multipliers: &[Multiplier],
    cost: f64,
) -> (f64, f64) {
    let (n, m, horizon) = (program.states(), program.inputs(), program.horizon);
    let (a, b) = program.plant.matrices();
    let mut costates = vec![0.0; (horizon + 1) * n];
    let mut gradient = vec![0.0; horizon * m];
    let mut terminal = vec![0.0; n];
    let (mut value, mut size) = (0.0, 0.0);
    let mut add = |term: f64| {
        value += term;
        size += term.abs();
    };
    for &Multiplier { row: RowId { family, stage, index }, value: y } in multipliers {
        let costate = &mut costates[stage * n..][..n];
        match family {
            RowFamily::Stage => {
                let normal = program.stage_normal(stage, index);
                costate.iter_mut().zip(normal).for_each(|(l, h)| *l += y * h);
                add(-y * program.stage_offset(stage, index));
            }
            RowFamily::Tracking => {
                costate[index] += y;
                add(-y * program.reference(stage)[index]);
            }
            RowFamily::Input => {
                let normal = &program.input_normals[index * m..][..m];
                let entries = gradient[stage * m..][..m].iter_mut();
                entries.zip(normal).for_each(|(d, h)| *d += y * h);
                add(-y * program.input_offsets[stage * program.input_rows() + index]);
            }
            RowFamily::Terminal => {
                costate[index] += y;
                terminal[index] += y;
                add(-y * program.terminal_centre[index]);
            }
        }
    }
    for generator in program.terminal_generators.chunks_exact(n) {
        add(-sum_product(generator, &terminal).abs());
    }
    let mut carried = vec![0.0; n];
    for stage in (1..=horizon).rev() {
        let costate = &mut costates[stage * n..][..n];
        costate.iter_mut().zip(&carried).for_each(|(l, c)| *l += c);
        // B' costate and A' costate.
        let entries = gradient[(stage - 1) * m..][..m].iter_mut();
        entries.zip(b.chunks_exact(n)).for_each(|(d, column)| *d += sum_product(column, costate));
        let entries = carried.iter_mut().zip(a.chunks_exact(n));
        entries.for_each(|(c, column)| *c = sum_product(column, costate));
    }
    for (l, x) in carried.iter().zip(program.initial) {
        add(l * x);
    }
    for (i, d) in gradient.iter().enumerate() {
        let (lower, upper) = (program.input_lower[i], program.input_upper[i]);
        let nearest_to_zero = 0.0_f64.clamp(lower, upper);
        let at = |v: f64| cost * v.abs() + d * v;
        add(at(lower).min(at(upper)).min(at(nearest_to_zero)));
    }
    (value, size)
}

fn keep_worst(worst: &mut Option<Residual>, candidate: Residual) {
    if worst.is_none_or(|w| candidate.value > w.value) {
        *worst = Some(candidate);
    }
}

fn sum_product(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

fn norm(x: &[f64]) -> f64 {
    sum_product(x, x).sqrt().max(f64::MIN_POSITIVE)
}
