//! The robust baseline: a nominal trajectory inside an invariant tube. Mayne, Seron and Rakovic,
//! "Robust model predictive control of constrained linear systems with bounded disturbances",
//! Automatica 41, 2005.
//!
//! Plants that differ from the expected one push the state by (A(q) - A) x + (B(q) - B) u, which
//! is bounded because the constraints keep x and u in bounded sets. So all of it is lumped into
//! the disturbance, once, over the whole of both sets: robust by construction, and conservative.

use nalgebra::{DMatrix, DVector};

use super::{
    Artifact, Problem, RowOrigin, TubeSummary,
    artifact::Parts,
    design::{
        Design, assembled, checked_gain, disturbance, expected_disturbance, infeasible, no_set,
        vertices,
    },
    nominal::{Nominal, summaries},
    terminal::{fed_back_rows, needed},
};
use crate::{
    budget::Budget,
    control::{Failure, Fault, PrepareError},
    dynamics::PlantMatrices,
    matrices::{product, times_vector},
    reach::{
        EXACT, HalfSpaces, Invariant, PlantVertex, StageGroup, Tube, TubeError, irredundant,
        max_robust_positive_invariant,
    },
    sampling::ScalarLaw,
    sets::{self, Polytope, Zonotope},
};

/// The tube is this much wider than the least invariant one, so that it has few faces.
const MARGIN: f64 = 0.05;
/// Most corners of the state set and of the input set.
const CORNERS_MAX: usize = 20_000;

/// The artifact of [`super::Scheme::TubeRobust`].
pub(super) fn prepare(problem: &Problem, budget: Budget<'_>) -> Result<Artifact, PrepareError> {
    let gain = checked_gain(problem)?;
    let tube = InvariantTube::new(problem, &gain, budget)?;
    let (state, input) = tube.tightened(problem, &gain)?;
    let expected = vec![problem.plant.at_mean()];
    let none = expected_disturbance(problem);
    let design = Design::within(problem, gain, expected, &none, (state, input), budget)?;

    let drift = problem.disturbance.iter().map(ScalarLaw::mean).collect();
    let nominal = Nominal::new(problem, &design.gain, drift);
    let (n, _) = problem.dimensions();
    let (from_nominal, groups) = nominal.rows(&design.constraints, &design.groups);
    let mut rows = HalfSpaces::new(n + problem.decisions());
    for row in 0..from_nominal.len() {
        let (z, v) = from_nominal.normal(row).split_at(n);
        let place = z.iter().map(|a| -a);
        let normal: Vec<f64> = z.iter().chain(v).copied().chain(place).collect();
        rows.push(&normal, from_nominal.offset(row));
    }
    let mut normal = vec![0.0; rows.dimension()];
    let first = normal.len() - n;
    for row in 0..tube.set.len() {
        normal[first..].copy_from_slice(tube.set.normal(row));
        rows.push(&normal, tube.set.offset(row));
    }
    let none = HalfSpaces::new(rows.dimension());
    let reduction = irredundant(&rows, &none, EXACT, budget).map_err(|reason| no_set(&reason))?;
    let origin = |row: &usize| groups.get(*row).map_or(RowOrigin::Tube, |&g| RowOrigin::Stage(g));
    let kept: Vec<StageGroup> =
        reduction.kept.iter().filter_map(|&row| groups.get(row).copied()).collect();
    let mut summary = design.summary(summaries(&design.groups, &groups, &kept));
    summary.doubtful_rows = reduction.doubtful;
    summary.outer_excess = reduction.outer_excess;
    summary.tube = Some(tube.summary);
    let parts = Parts {
        problem: problem.clone(),
        summary,
        cost: with_place(&nominal.cost(&design.weights), n),
        rows: rows.select(&reduction.kept),
        origins: reduction.kept.iter().map(origin).collect(),
        terminal_set: design.constraints.terminal,
        first_step_set: None,
    };
    assembled(parts, budget)
}

/// S over (z_0, v, 1) as a cost over (x, v, e, 1), with z_0 = x - e.
fn with_place(cost: &DMatrix<f64>, n: usize) -> DMatrix<f64> {
    let width = cost.nrows();
    let corrections = width - n - 1;
    let mut map = DMatrix::zeros(width, width + n);
    for i in 0..n {
        map[(i, i)] = 1.0;
        map[(i, n + corrections + i)] = -1.0;
    }
    (0..corrections).for_each(|i| map[(n + i, n + i)] = 1.0);
    map[(width - 1, width + n - 1)] = 1.0;
    product(&map.transpose(), &product(cost, &map))
}

/// A set that e+ = A_K e + d never leaves, whatever acts.
struct InvariantTube {
    /// Over e.
    set: HalfSpaces,
    /// Largest h e in it, for the rows of the state set and, with h K e, of the input set: bounds.
    state_taken: Vec<f64>,
    input_taken: Vec<f64>,
    summary: TubeSummary,
}

impl InvariantTube {
    /// The largest invariant set in a polytope around the least one, `MARGIN` away from it on
    /// every side. The polytope's faces are what the constraints will be tightened by, so that no
    /// support has to be computed that could come out too small.
    fn new(
        problem: &Problem,
        gain: &DMatrix<f64>,
        budget: Budget<'_>,
    ) -> Result<Self, PrepareError> {
        let mean = problem.plant.at_mean();
        let lumped = lumped_disturbance(problem, &mean, &vertices(problem)?, budget)?;
        let closed = &mean.a + product(&mean.b, gain);
        let series = Tube::new(&closed, gain, &lumped, budget).map_err(|error| {
            if let TubeError::Interrupted(why) = error {
                return why.into();
            }
            let fault = Fault::new("gain", "a gain that stabilises the plant", error.to_string());
            PrepareError::Faults(vec![fault])
        })?;
        let wider = |sum: f64| (1.0 + MARGIN) * sum;
        let taken = |normal: &[f64]| -> f64 {
            wider((0..series.terms()).map(|i| series.state_term(i, normal)).sum())
        };
        let (n, m) = problem.dimensions();
        let identity = DMatrix::identity(n, n);
        let mut around = HalfSpaces::new(n);
        let mut add = |normals: &DMatrix<f64>| -> Vec<f64> {
            let mut all = Vec::new();
            for row in normals.row_iter() {
                let normal: Vec<f64> = row.iter().copied().collect();
                all.push(taken(&normal));
                around.push(&normal, all[all.len() - 1]);
            }
            all
        };
        let state_half_widths = DVector::from_vec(add(&identity));
        add(&-identity);
        let state_taken = add(problem.state_set.normals());
        let input_taken = add(&product(problem.input_set.normals(), gain));
        if !(state_half_widths.min() > 0.0) {
            let expected = "disturbances that reach every component of the state, for a tube";
            let got = format!("a tube of half widths {:?}", state_half_widths.as_slice());
            return Err(PrepareError::Faults(vec![Fault::new("disturbance", expected, got)]));
        }
        let half_width = |row: usize| {
            let normal: Vec<f64> = gain.row(row).iter().copied().collect();
            taken(&normal)
        };
        let summary = TubeSummary {
            rows: 0,
            input_half_widths: DVector::from_iterator(m, (0..m).map(half_width)),
            disturbance_half_widths: lumped.half_widths(),
            state_half_widths,
        };
        let vertex = PlantVertex { a: closed, b: DMatrix::zeros(n, 0), disturbance: &lumped };
        let limits = problem.terminal_limits;
        match max_robust_positive_invariant(&around, &[vertex], limits, budget) {
            Invariant::Found { set, .. } => Ok(Self {
                summary: TubeSummary { rows: set.len(), ..summary },
                set,
                state_taken,
                input_taken,
            }),
            Invariant::Interrupted(why) => Err(why.into()),
            Invariant::Undecided { iterations, rows } => {
                let expected = "limits under which the tube is found";
                let got = format!("undecided after {iterations} steps back with {rows} rows");
                Err(PrepareError::Faults(vec![Fault::new("terminal_limits", expected, got)]))
            }
            // The least invariant set lies inside, by construction.
            Invariant::Empty { .. } => {
                Err(Failure::Numerical("the tube was lost to rounding".into()).into())
            }
        }
    }

    /// State and input constraints of the nominal trajectory.
    fn tightened(
        &self,
        problem: &Problem,
        gain: &DMatrix<f64>,
    ) -> Result<(HalfSpaces, HalfSpaces), PrepareError> {
        let shrunk = |set: &Polytope, taken: &[f64]| {
            let full = HalfSpaces::from_polytope(set);
            let mut rows = HalfSpaces::new(full.dimension());
            (0..full.len()).for_each(|row| {
                rows.push(full.normal(row), full.offset(row) - taken[row]);
            });
            rows
        };
        let state = shrunk(&problem.state_set, &self.state_taken);
        let input = shrunk(&problem.input_set, &self.input_taken);
        let offsets = state.offsets().iter().chain(input.offsets());
        if offsets.copied().fold(f64::INFINITY, f64::min) > 0.0 {
            return Ok((state, input));
        }
        let full = [&problem.state_set, &problem.input_set].map(HalfSpaces::from_polytope);
        let rows = fed_back_rows(&full[0], &full[1], gain);
        let taken = self.state_taken.iter().chain(&self.input_taken);
        let least: Vec<f64> =
            taken.enumerate().map(|(row, taken)| rows.offset(row).max(*taken)).collect();
        let reason = "the tube around the target leaves no room to the nominal trajectory";
        Err(needed(reason, &rows, full[0].len(), &least))
    }
}

/// B_w (w - E[w]), and beside it all that a vertex of the plant adds to a step of the expected one
/// for any x and u of the constraints: a box.
fn lumped_disturbance(
    problem: &Problem,
    mean: &PlantMatrices,
    vertices: &[PlantMatrices],
    budget: Budget<'_>,
) -> Result<Zonotope, PrepareError> {
    let w = disturbance(problem);
    let sets = [("state_set", &problem.state_set), ("input_set", &problem.input_set)];
    let differs = vertices.iter().any(|vertex| vertex.a != mean.a || vertex.b != mean.b);
    let [states, inputs] =
        sets.map(|(field, set)| if differs { corners(field, set, budget) } else { Ok(Vec::new()) });
    let (states, inputs) = (states?, inputs?);
    let (n, _) = problem.dimensions();
    let mut half = DVector::<f64>::zeros(n);
    for vertex in vertices {
        let push = &vertex.b_w - &mean.b_w;
        let spread = w.linear_map(&push);
        let parts = [
            largest(&(&vertex.a - &mean.a), &states),
            largest(&(&vertex.b - &mean.b), &inputs),
            spread.half_widths() + spread.centre().abs(),
        ];
        let sum = parts.iter().sum::<DVector<f64>>();
        half.iter_mut().zip(sum.iter()).for_each(|(most, part)| *most = most.max(*part));
    }
    let own = product(&mean.b_w, w.generators());
    let columns = own.column_iter().map(|column| column.into_owned());
    let sides = (0..n).map(|i| DVector::from_fn(n, |k, _| if k == i { half[i] } else { 0.0 }));
    let generators: Vec<DVector<f64>> =
        columns.chain(sides).filter(|column| column.amax() > 0.0).collect();
    if generators.is_empty() {
        return Ok(Zonotope::centred(DMatrix::zeros(n, 0)));
    }
    Ok(Zonotope::centred(DMatrix::from_columns(&generators)))
}

/// Largest |(M p)_i| over the points, for every i.
fn largest(matrix: &DMatrix<f64>, points: &[DVector<f64>]) -> DVector<f64> {
    let mut most = DVector::<f64>::zeros(matrix.nrows());
    for point in points {
        let image = times_vector(matrix, point);
        most.iter_mut().zip(image.iter()).for_each(|(most, x)| *most = most.max(x.abs()));
    }
    most
}

/// Corners of a constraint set, which must be bounded.
fn corners(
    field: &str,
    set: &Polytope,
    budget: Budget<'_>,
) -> Result<Vec<DVector<f64>>, PrepareError> {
    let inside = HalfSpaces::from_polytope(set).interior_point(budget);
    let inside = inside.map_err(|reason| match reason {
        crate::reach::NoInterior::Interrupted(why) => why.into(),
        _ => infeasible(format!("{field} has no interior")),
    })?;
    let inside = DVector::from_vec(inside.point);
    sets::vertices(set, &inside, CORNERS_MAX, budget).map_err(|error| {
        if let sets::HullError::Interrupted(why) = error {
            return why.into();
        }
        let expected = "a bounded set, which bounds what an uncertain plant does";
        PrepareError::Faults(vec![Fault::new(field, expected, error.to_string())])
    })
}
