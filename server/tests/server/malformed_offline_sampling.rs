//! Malformed problems of offline sampling are refused field by field over both transports.

use serde_json::{Value, json};
use vbar_server::{Config, Limits};

use crate::{
    malformed::{check, with},
    missions::integrator,
    offline_sampling::{baseline, finished, hill, poseidyn},
    support::{detail, server, server_with},
};

const METHOD: &str = "problem.offline_sampling";

/// Each case: pointer into the problem, value there (`None`: removed), field that must be named.
async fn check_all(problem: fn() -> Value, cases: &[(&str, Option<Value>, &str)]) {
    let server = server().await;
    for (pointer, value, field) in cases {
        let case = format!("{pointer} = {value:?}");
        let problem = with(problem(), &format!("/offlineSampling/{pointer}"), value.clone());
        let separator = if field.is_empty() { "" } else { "." };
        check(&server, &case, &problem, &[&format!("{METHOD}{separator}{field}")]).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_fields_are_named() {
    let one = json!({ "rows": 1, "columns": 1, "values": [1.0] });
    let law = json!({ "uniform": { "low": 0.1, "high": -0.1 } });
    let gaussian = json!({ "truncatedGaussian": { "deviation": 0.0, "bound": 1.0 } });
    check_all(
        integrator,
        &[
            ("polynomial", None, ""),
            ("scheme", None, "scheme"),
            ("scheme", Some(json!(99)), "scheme"),
            ("horizon", Some(json!(0)), "horizon"),
            // n + T m = 128 at most.
            ("horizon", Some(json!(127)), "horizon"),
            ("disturbance", Some(json!([])), "disturbance"),
            ("disturbance/1", Some(law.clone()), "disturbance[1].uniform.high"),
            ("disturbance/0", Some(gaussian), "disturbance[0].truncated_gaussian.deviation"),
            ("disturbance/0", Some(json!({})), "disturbance[0]"),
            ("gain", None, "gain"),
            ("gain", Some(json!({})), "gain"),
            ("gain", Some(json!({ "explicit": one })), "gain.explicit.columns"),
            ("gain/lqr/input/values/0", Some(json!("NaN")), "gain.lqr.input.values[0]"),
            ("weights", None, "weights"),
            ("weights/state/values/1", Some(json!(0.5)), "weights.state"),
            ("weights/input/values/0", Some(json!(-1.0)), "weights.input"),
            ("weights/samples", Some(json!(0)), "weights.samples"),
            ("stateSet", None, "state_set"),
            ("stateSet/offsets", Some(json!([1.0])), "state_set.offsets"),
            ("stateSet/normals/columns", Some(json!(3)), "state_set.normals.columns"),
            ("inputSet", None, "input_set"),
            ("inputSet/normals/values/0", Some(json!(0.0)), "input_set.normals"),
            ("redundancy", None, "redundancy"),
            ("redundancy", Some(json!({})), "redundancy"),
            (
                "redundancy",
                Some(json!({ "innerScaled": { "epsilon": 1.0 } })),
                "redundancy.inner_scaled.epsilon",
            ),
            ("redundancy", Some(json!({ "innerScaled": {} })), "redundancy.inner_scaled.epsilon"),
            ("firstStepSet", None, ""),
            ("firstStepSet/facetsMax", Some(json!(0)), "first_step_set.facets_max"),
            ("firstStepSet/rounds", Some(json!(-1)), "first_step_set.rounds"),
            ("terminalLimits", Some(json!({ "rowsMax": 0 })), "terminal_limits.rows_max"),
            ("seed", None, "seed"),
            ("seed", Some(json!("-1")), "seed"),
        ],
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_chance_is_named() {
    let cases = [
        ("samples", None, "samples"),
        ("samples/violation", None, "samples.violation"),
        ("samples/violation", Some(json!(0.0)), "samples.violation"),
        ("samples/violation", Some(json!(0.14)), "samples.violation"),
        ("samples/violation", Some(json!(-0.1)), "samples.violation"),
        ("samples/violation", Some(json!("NaN")), "samples.violation"),
        ("samples/confidenceComplement", Some(json!(0.0)), "samples.confidence_complement"),
        ("samples/confidenceComplement", Some(json!(1.0)), "samples.confidence_complement"),
        ("samples/size", Some(json!(0)), "samples.size"),
        ("samples/variables", Some(json!(0)), "samples.variables"),
        ("samples/rowsMax", Some(json!(3_000_000)), "samples.rows_max"),
        // Three states of 4 rows, four inputs of 2 and the terminal set: more than 100 rows.
        ("samples/rowsMax", Some(json!(100)), "samples.rows_max"),
    ];
    check_all(integrator, &cases).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_plants_are_named() {
    let constant = json!({ "rows": 2, "columns": 1, "values": [0.0, 1.0] });
    check_all(
        integrator,
        &[
            ("polynomial/a", None, "polynomial.a"),
            (
                "polynomial/a/constant/values/0",
                Some(json!("Infinity")),
                "polynomial.a.constant.values[0]",
            ),
            ("polynomial/a/constant", Some(constant), "polynomial.a"),
            ("polynomial/b/terms/0/powers", Some(json!([1, 1])), "polynomial.b.terms[0].powers"),
            ("polynomial/b/terms/0/powers/0", Some(json!(9)), "polynomial.b.terms[0].powers[0]"),
            ("polynomial/b/terms/0/matrix", None, "polynomial.b.terms[0].matrix"),
            ("polynomial/discretisation", None, "polynomial.discretisation"),
            (
                "polynomial/discretisation",
                Some(json!("DISCRETISATION_EULER")),
                "polynomial.sample_time_s",
            ),
            ("polynomial/sampleTimeS", Some(json!(1.0)), "polynomial.sample_time_s"),
            ("polynomial/parameters/0", Some(json!({})), "polynomial.parameters[0]"),
        ],
    )
    .await;
    check_all(
        poseidyn,
        &[
            ("poseidyn/variant", None, "poseidyn.variant"),
            ("poseidyn/massKg", Some(json!(0.0)), "poseidyn.mass_kg"),
            ("poseidyn/sampleTimeS", None, "poseidyn.sample_time_s"),
            ("poseidyn/parameters", Some(json!([{ "constant": 1.0 }])), "poseidyn.parameters"),
            ("cone/apexM", Some(json!([0.0])), "cone.apex_m"),
            ("cone/axisDeg", None, "cone.axis_deg"),
            ("cone/halfAngleDeg", Some(json!(90.0)), "cone.half_angle_deg"),
            ("cone/rangeMaxM", Some(json!(0.0)), "cone.range_max_m"),
        ],
    )
    .await;
    check_all(
        hill,
        &[
            (
                "uncertainHill/meanMotionDegS/least",
                Some(json!(0.0)),
                "uncertain_hill.mean_motion_deg_s.least",
            ),
            ("uncertainHill/massKg/greatest", Some(json!(90.0)), "uncertain_hill.mass_kg.greatest"),
            ("uncertainHill/massKg", None, "uncertain_hill.mass_kg"),
            ("uncertainHill/sampleTimeS", Some(json!(-1.0)), "uncertain_hill.sample_time_s"),
        ],
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_unstable_vertex_is_named() {
    let server = server().await;
    let plant = |strength: f64| {
        json!({
            "a": { "rows": 2, "columns": 2, "values": [1.0, 1.0, 0.0, 1.0] },
            "b": { "rows": 2, "columns": 1, "values": [0.5 * strength, strength] },
        })
    };
    let vertices = json!([plant(0.9), plant(-0.5), plant(1.1)]);
    let problem = with(integrator(), "/offlineSampling/vertices", Some(vertices));
    let request = json!({ "problem": problem, "validateOnly": true });
    let error = server.post("/v1/precompute", &request).await.json();
    let fault = &detail(&error, "BadRequest").unwrap()["fieldViolations"][0];
    assert!(fault["field"].as_str().unwrap().starts_with(METHOD), "{error}");
    let text = fault["description"].as_str().unwrap();
    assert!(text.contains("spectral radius"), "{error}");
    assert!(fault.to_string().contains("vertices[1]") || text.contains("vertex 1"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_cone_at_the_target_leaves_no_terminal_set() {
    let server = server().await;
    let apex = Some(json!([0.0, 0.0]));
    let problem = with(poseidyn(), "/offlineSampling/cone/apexM", apex);
    let infeasible = finished(&server, &problem).await["response"]["infeasible"].clone();
    let reason = infeasible["reason"].as_str().unwrap();
    assert!(reason.contains("target"), "{infeasible}");
    // The least offsets of rows through the target that leave a set.
    let relaxations = infeasible["relaxations"].as_array().unwrap();
    assert!(relaxations[0]["amountNd"].as_f64().unwrap() > 0.0, "{infeasible}");
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_sampling_beyond_the_limits_of_a_node_is_named() {
    let limits = Limits { sampled_rows_max: 500, plant_vertices_max: 8, ..Limits::default() };
    let server = server_with(Config { limits, ..Config::default() }).await;
    // What the problem does not say means more rows than this node makes.
    check(&server, "default", &integrator(), &[&format!("{METHOD}.samples.rows_max")]).await;
    let few = with(integrator(), "/offlineSampling/samples/rowsMax", Some(json!(500)));
    check(&server, "rows", &few, &[&format!("{METHOD}.samples.rows_max")]).await;
    // Four uncertain parameters have 16 corners.
    let floating = baseline(poseidyn(), "LINEAR_QUADRATIC");
    check(&server, "corners", &floating, &[&format!("{METHOD}.vertices")]).await;
}
