//! Everything that is wrong with a problem, by the wire's names.

use nalgebra::SMatrix;

use super::{Phase, Problem, Safety, Separation};
use crate::{control::Fault, dynamics::integration_steps};

/// Most numbers that the sets of a phase may need: 512 MB.
pub const NUMBERS_MAX: usize = 64_000_000;
/// Longest prediction: the dense program's cost grows with its cube.
pub const PREDICTION_MAX: usize = 120;
/// Most steps of a period, and of a safety horizon.
pub const STEPS_MAX: usize = 10_000;
/// Most parts of a step.
pub const FRACTIONS_MAX: usize = 64;
/// Most instants of a safety horizon: artifacts keep their indices in two bytes.
pub const INSTANTS_MAX: usize = 60_000;
/// Most steps of the integration of all plants, which takes about a microsecond each. Three phases
/// with 64 parts a step need 12 million on an orbit of eccentricity 0.8, less on rounder ones.
const INTEGRATION_MAX: f64 = 2e7;
/// Most sets that a predicted state is kept out of.
pub const NEAREST_MAX: usize = 16;
/// Coefficients of a general ellipsoid.
const ELLIPSOID_TERMS: usize = 21;

/// Everything that is wrong with a problem.
pub(super) fn faults(problem: &Problem) -> Vec<Fault> {
    let mut faults = Vec::new();
    let mut require = |right: bool, field: String, expected: &str, got: String| {
        if !right {
            faults.push(Fault::new(field, expected, got));
        }
    };
    let between = |x: usize, most: usize| (1..=most).contains(&x);
    let positive = |x: f64| x > 0.0 && x.is_finite();
    let text = |field: &str| field.to_owned();
    let mass = problem.mass.kilograms();
    require(positive(mass), text("mass_kg"), "a positive mass", mass.to_string());
    let step = problem.sample_time.seconds();
    require(positive(step), text("sample_time_s"), "a positive time", step.to_string());
    let kp = problem.steps_per_period;
    let count = "1 to 10000 steps a revolution";
    require(between(kp, STEPS_MAX), text("sample_time_s"), count, format!("{kp} steps"));
    let invariant = kp == 1 && problem.orbit.eccentricity() == 0.0;
    let period = problem.orbit.period().seconds();
    let miss = kp as f64 * step - period;
    let folds = invariant || miss.abs() <= 0.5 * step;
    let fitting = format!("a whole number of steps a revolution, such as {} s", period / kp as f64);
    require(folds, text("sample_time_s"), &fitting, format!("{kp} steps miss it by {miss} s"));
    let kinds = kinds(problem);
    require(
        match problem.separation {
            Separation::Tangent => true,
            Separation::LinearProgram => kinds.contains(&false),
            Separation::SecondOrderCone => kinds.contains(&true),
        },
        text("separation"),
        "a phase that it applies to: polytopes for the linear program, passive ellipsoids for the \
         second-order cone program",
        text("none"),
    );
    let n = problem.prediction_horizon;
    require(between(n, PREDICTION_MAX), text("prediction_horizon"), "1 to 120", n.to_string());
    let limits = [
        ("clearance", problem.clearance),
        ("arrival_distance_m", problem.arrival.metres()),
        ("fastest_approach_m_s", problem.fastest_approach_m_s),
        ("abort_search.clearance_m", problem.abort_clearance),
    ];
    for (field, value) in limits {
        require(positive(value), text(field), "a positive number", value.to_string());
    }
    let parts: usize =
        problem.phases.iter().map(|p| p.safety.watch().map_or(1, |watch| watch.fractions)).sum();
    let work = integration_steps(&problem.orbit, problem.sample_time) * (kp as f64) * parts as f64;
    let expected = "an orbit and a step that are integrated in 20000000 steps, all parts together";
    require(work <= INTEGRATION_MAX, text("sample_time_s"), expected, format!("{work} steps"));
    require(!problem.phases.is_empty(), text("phases"), "at least one phase", text("none"));
    for (i, phase) in problem.phases.iter().enumerate() {
        phase_faults(problem, i, phase, &mut require);
    }
    faults
}

/// Of each phase that avoids something: are its sets ellipsoids?
fn kinds(problem: &Problem) -> Vec<bool> {
    let ellipsoids = |phase: &Phase| match &phase.safety {
        Safety::Passive(watch) => Some(!watch.avoid.is_polytope()),
        Safety::Active { .. } => Some(false),
        Safety::None => None,
    };
    problem.phases.iter().filter_map(ellipsoids).collect()
}

fn phase_faults(
    problem: &Problem,
    index: usize,
    phase: &Phase,
    require: &mut impl FnMut(bool, String, &str, String),
) {
    let field = |name: &str| format!("phases[{index}].{name}");
    let sound = |matrix: &SMatrix<f64, 6, 6>| {
        (matrix - matrix.transpose()).amax() <= 1e-9 * matrix.amax()
            && matrix.iter().all(|x| x.is_finite())
            && matrix.symmetric_eigenvalues().iter().all(|&x| x >= -1e-9 * matrix.amax())
    };
    let semidefinite = "a symmetric positive semidefinite matrix";
    let weights = &phase.weights;
    require(sound(&weights.stage), field("weights.stage"), semidefinite, "not so".into());
    require(sound(&weights.terminal), field("weights.terminal"), semidefinite, "not so".into());
    let definite = (weights.input - weights.input.transpose()).amax()
        <= 1e-9 * weights.input.amax()
        && weights.input.cholesky().is_some();
    let expected = "a symmetric positive definite matrix";
    require(definite, field("weights.input"), expected, "not so".into());
    let within = phase.advance_within.metres();
    require(
        within >= 0.0 && within.is_finite(),
        field("advance_within_m"),
        "at least 0 m",
        within.to_string(),
    );
    if let Safety::Active { modes, .. } = &phase.safety {
        require(!modes.is_empty(), field("active.modes"), "at least one mode", "none".into());
        let known = modes.iter().all(|mode| mode.is_within(problem.thrusters.nominal()));
        require(known, field("active.modes"), "thrusters of the chaser", "another one".into());
    }
    let Some(watch) = phase.safety.watch() else { return };
    let kind = if matches!(phase.safety, Safety::Passive(_)) { "passive" } else { "active" };
    let field = |name: &str| field(&format!("{kind}.watch.{name}"));
    let between = |x: usize, most: usize| (1..=most).contains(&x);
    let gamma = watch.inflation;
    let grows = gamma >= 1.0 && gamma.is_finite();
    require(grows, field("inflation"), "at least 1", gamma.to_string());
    let (horizon, parts, nearest) = (watch.horizon, watch.fractions, watch.nearest);
    require(between(horizon, STEPS_MAX), field("horizon_steps"), "1 to 10000", horizon.to_string());
    require(between(parts, FRACTIONS_MAX), field("fractions"), "1 to 64", parts.to_string());
    require(between(nearest, NEAREST_MAX), field("nearest_sets"), "1 to 16", nearest.to_string());
    let instants = horizon.saturating_mul(parts);
    let few = instants <= INSTANTS_MAX;
    require(few, field("fractions"), "60000 instants at most", instants.to_string());
    let numbers = [problem.steps_per_period, horizon, parts, ELLIPSOID_TERMS]
        .iter()
        .try_fold(1usize, |product, &x| product.checked_mul(x))
        .unwrap_or(usize::MAX);
    let fits = numbers <= NUMBERS_MAX;
    require(fits, field("horizon_steps"), "sets of at most 512 MB", format!("{numbers} numbers"));
}
