//! Offline sampling: what is precomputed, steps, streams, and what is flown without an answer.

use std::{collections::BTreeMap, fs, path::PathBuf};

use serde_json::{Value, json};
use tonic::Code;
use vbar_proto::v1::{self, artifact::Summary, step_response::Verdict};
use vbar_server::Config;

use crate::{
    missions::{self, diagonal, integrator, matrix, symmetric},
    support::{Server, detail, grpc_fields, json_fields, server, server_with},
};

/// The floating spacecraft with few samples: what the paper does, small.
pub(crate) fn poseidyn() -> Value {
    let weights = [1e6, 1e6, 1e8, 1e8];
    let noise = json!({ "truncatedGaussian": { "deviation": 1.0, "bound": 5e-3 } });
    json!({ "offlineSampling": {
        "poseidyn": {
            "variant": "POSEIDYN_VARIANT_PRINTED", "massKg": 9.882, "sampleTimeS": 5.0,
        },
        "disturbance": [noise, noise, noise, noise],
        "scheme": "OFFLINE_SAMPLING_SCHEME_OFFLINE_SAMPLING",
        "horizon": 4,
        "gain": { "lqr": { "state": diagonal(&weights), "input": diagonal(&[1e6, 1e6]) } },
        "weights": {
            "state": diagonal(&weights), "input": diagonal(&[1e6, 1e6]), "samples": 50,
        },
        "cone": {
            "apexM": [-0.3, -0.3], "axisDeg": 45.0, "halfAngleDeg": 15.642, "rangeMaxM": 4.419,
        },
        "stateSet": symmetric(4, 2, &[0.1, 0.1]),
        "inputSet": symmetric(2, 0, &[0.3, 0.3]),
        "samples": { "violation": 0.05, "confidenceComplement": 1e-3, "size": 40 },
        "redundancy": { "innerScaled": { "epsilon": 0.01 } },
        "noFirstStepSet": {},
        "seed": "1",
    } })
}

/// The nominal baseline for a chaser near a target whose orbit and own mass are uncertain.
pub(crate) fn hill() -> Value {
    let widths = [50.0, 50.0, 50.0, 1.0, 1.0, 1.0];
    json!({ "offlineSampling": {
        "uncertainHill": {
            "meanMotionDegS": { "least": 0.062, "greatest": 0.064 },
            "massKg": { "least": 95.0, "greatest": 100.0 },
            "sampleTimeS": 10.0,
        },
        "disturbance": vec![json!({ "uniform": { "low": -1e-3, "high": 1e-3 } }); 6],
        "scheme": "OFFLINE_SAMPLING_SCHEME_LINEAR_QUADRATIC",
        "horizon": 4,
        "gain": { "lqr": {
            "state": diagonal(&[1.0, 1.0, 1.0, 100.0, 100.0, 100.0]),
            "input": diagonal(&[10.0; 3]),
        } },
        "weights": {
            "state": diagonal(&[1.0, 1.0, 1.0, 100.0, 100.0, 100.0]),
            "input": diagonal(&[10.0; 3]), "samples": 1,
        },
        "stateSet": symmetric(6, 0, &widths),
        "inputSet": symmetric(3, 0, &[5.0; 3]),
    } })
}

/// `problem` as one of the baselines, without what they do not read.
pub(crate) fn baseline(mut problem: Value, scheme: &str) -> Value {
    let asked = problem["offlineSampling"].as_object_mut().expect("a problem");
    asked.insert("scheme".into(), format!("OFFLINE_SAMPLING_SCHEME_{scheme}").into());
    for name in ["samples", "redundancy", "firstStepSet", "noFirstStepSet", "seed"] {
        asked.remove(name);
    }
    problem
}

fn linear(components: &[f64]) -> Value {
    json!({ "linear": { "components": components } })
}

/// The operation of a precompute, when it is done.
pub(crate) async fn finished(server: &Server, problem: &Value) -> Value {
    let answer = server.post("/v1/precompute", &json!({ "problem": problem })).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let mut operation = answer.json();
    while operation["done"] != true {
        let name = operation["name"].as_str().expect("a name").to_owned();
        let answer = server.post(&format!("/v1/{name}:wait"), &json!({ "timeout": "30s" })).await;
        assert_eq!(answer.status, 200, "{}", answer.text());
        operation = answer.json();
    }
    operation
}

async fn precompute(server: &Server, problem: &Value) -> v1::Artifact {
    let operation = finished(server, problem).await;
    let artifact = operation["response"]["artifact"].clone();
    assert!(artifact.is_object(), "{operation}");
    let made: v1::Artifact = missions::message(artifact);
    let request = v1::GetArtifactRequest { artifact_id: made.artifact_id.clone() };
    let answer = server.grpc().await.get_artifact(request).await.expect("it was made");
    assert_eq!(answer.into_inner().artifact.expect("an artifact").summary, made.summary);
    made
}

fn summary(artifact: &v1::Artifact) -> &v1::OfflineSamplingArtifact {
    match &artifact.summary {
        Some(Summary::OfflineSampling(summary)) => summary,
        other => panic!("{other:?}"),
    }
}

async fn step(server: &Server, request: &Value) -> v1::StepResponse {
    let answer = server.post("/v1/step", request).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    let over_http: v1::StepResponse = missions::message(answer.json());
    let request: v1::StepRequest = missions::message(request.clone());
    let over_grpc = server.grpc().await.step(request).await.expect("as over HTTP").into_inner();
    assert_eq!(over_http, over_grpc);
    over_grpc
}

fn command(answer: &v1::StepResponse) -> &v1::Command {
    match &answer.verdict {
        Some(Verdict::Command(command)) => command,
        other => panic!("{other:?}"),
    }
}

fn diagnostics(answer: &v1::StepResponse) -> &v1::OfflineSamplingDiagnostics {
    match &answer.diagnostics {
        Some(v1::step_response::Diagnostics::OfflineSampling(diagnostics)) => diagnostics,
        other => panic!("{other:?}"),
    }
}

fn state_of(answer: &v1::StepResponse) -> Value {
    missions::json(answer)["controllerState"].clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_loop_gives_certified_commands() {
    let server = server().await;
    let artifact = precompute(&server, &integrator()).await;
    let made = summary(&artifact);
    let gain = &made.gain.as_ref().unwrap().values;
    let (mut x, mut state) = ([2.5, 0.5], json!(""));
    for index in 0..12_u32 {
        let request = json!({
            "artifactId": artifact.artifact_id, "controllerState": state,
            "measurement": linear(&x),
        });
        let answer = step(&server, &request).await;
        assert_eq!(answer.step_index, index as i32);
        let (command, how) = (command(&answer), diagnostics(&answer));
        assert_eq!(how.branch(), v1::SamplingBranch::Optimum);
        let certificate = answer.certificate.as_ref().unwrap();
        assert!(certificate.passed, "{certificate:?}");
        assert_eq!(certificate.optimality(), v1::Optimality::Global);
        let u = command.input_nd[0];
        assert!(u.abs() <= 1.0 + 1e-7, "step {index}: {u}");
        // u = K x + v_0 with what the artifact and the diagnostics say.
        let corrections = &how.corrections.as_ref().unwrap().values;
        assert_eq!(corrections.len(), 4);
        assert!((u - gain[0] * x[0] - gain[1] * x[1] - corrections[0]).abs() < 1e-12);
        // Without disturbance and at expected strength, the prediction comes true.
        let prediction = answer.prediction.as_ref().unwrap();
        let next = &prediction.states_nd.as_ref().unwrap().values[2..4];
        let moved = [x[0] + x[1] + 0.5 * u, x[1] + u];
        assert!((0..2).all(|i| (next[i] - moved[i]).abs() < 1e-12), "{next:?} {moved:?}");
        assert!(answer.controller_state.len() < 4096);
        assert_eq!(answer.provenance.as_ref().unwrap().method, "offline_sampling");
        // The weakest and the strongest plant in turn, with the worst disturbance.
        let (strength, w) = if index % 2 == 0 { (0.9, 0.02) } else { (1.1, -0.02) };
        x = [x[0] + x[1] + 0.5 * strength * u + w, x[1] + strength * u + w];
        state = state_of(&answer);
    }
    assert!(x[0].abs() < 0.2 && x[1].abs() < 0.2, "{x:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_artifact_says_what_was_made() {
    let server = server().await;
    let artifact = precompute(&server, &integrator()).await;
    let made = summary(&artifact);
    assert_eq!(made.scheme(), v1::OfflineSamplingScheme::OfflineSampling);
    // State at stages 1 to 3, input at 0 to 3, terminal at 4.
    let groups: Vec<(v1::ConstraintFamily, i32)> =
        made.groups.iter().map(|group| (group.family(), group.stage)).collect();
    use v1::ConstraintFamily::{Input, State, Terminal};
    let states = (1..4).map(|stage| (State, stage));
    let inputs = (0..4).map(|stage| (Input, stage));
    assert_eq!(groups, states.chain(inputs).chain([(Terminal, 4)]).collect::<Vec<_>>());
    let sum = |pick: fn(&v1::SampledGroup) -> i32| -> i64 {
        made.groups.iter().map(|group| i64::from(pick(group))).sum()
    };
    assert_eq!(made.sampled_rows, sum(|group| group.rows));
    assert_eq!(made.kept_rows, sum(|group| group.kept_rows));
    assert!(made.kept_rows > 0 && made.kept_rows < made.sampled_rows / 10, "{made:?}");
    assert_eq!(made.doubtful_rows, 0);
    assert!(made.first_step_rows > 0 && !made.inner_scaled && made.removed_excess < 1e-6);
    // The size was not taken from the bound: nothing is proved, and said.
    assert_eq!(made.joint_confidence, None);
    assert!(!made.joint_confidence_statement.is_empty());
    assert_eq!(made.expected_cost_sha256.len(), 64);
    let terminal = made.terminal_set.as_ref().unwrap();
    let rows = usize::try_from(terminal.normals.as_ref().unwrap().rows).unwrap();
    assert!(rows >= 4 && terminal.offsets.len() == rows);
    assert!(terminal.offsets.iter().all(|&offset| offset > 0.0), "the target is not inside");
    assert!(made.checked_excess < 1e-6, "{}", made.checked_excess);
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_without_an_answer_names_rows_or_flies_the_tail() {
    let server = server().await;
    let id = precompute(&server, &integrator()).await.artifact_id;
    let far = linear(&[3.9, 1.4]);
    let answer = step(&server, &json!({ "artifactId": id, "measurement": far })).await;
    let Some(Verdict::Infeasible(why)) = &answer.verdict else { panic!("{answer:?}") };
    let weights: f64 = why.rows.iter().map(|row| row.weight).sum();
    assert!((weights - 1.0).abs() < 1e-9 && !why.reason.is_empty(), "{why:?}");
    assert!(answer.certificate.is_none() && answer.prediction.is_none());
    // After a good step there is a plan, and what is flown of it promises nothing.
    let good = json!({ "artifactId": id, "measurement": linear(&[2.0, 0.0]) });
    let state = state_of(&step(&server, &good).await);
    let request = json!({ "artifactId": id, "controllerState": state, "measurement": far });
    let answer = step(&server, &request).await;
    let (command, how) = (command(&answer), diagnostics(&answer));
    assert_eq!(how.branch(), v1::SamplingBranch::PreviousPlanTail);
    assert!(how.clipped && command.input_nd[0].abs() <= 1.0 + 1e-9, "{command:?}");
    assert!(!how.conflict.is_empty());
    let certificate = answer.certificate.as_ref().unwrap();
    assert!(!certificate.passed);
    assert_eq!(certificate.optimality(), v1::Optimality::PreviousPlanTail);
    assert!(certificate.margins.iter().any(|margin| margin.margin_nd < 0.0));
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_first_step_set_is_an_option() {
    let server = server().await;
    // Not grown at all, the first step must lead into the terminal set.
    let mut problem = integrator();
    problem["offlineSampling"]["firstStepSet"]["rounds"] = json!(0);
    let with = precompute(&server, &problem).await;
    let asked = problem["offlineSampling"].as_object_mut().unwrap();
    asked.remove("firstStepSet");
    asked.insert("noFirstStepSet".into(), json!({}));
    let without = precompute(&server, &problem).await;
    assert_eq!(summary(&without).first_step_rows, 0);
    assert_eq!(summary(&without).expected_cost_sha256, summary(&with).expected_cost_sha256);
    // Starts that the samples alone allow, and the set does not.
    let mut families = BTreeMap::new();
    for i in 0..16 {
        let measurement = linear(&[0.25 * f64::from(i), 0.5]);
        let ask = |id: &str| json!({ "artifactId": id, "measurement": measurement });
        let strict = step(&server, &ask(&with.artifact_id)).await;
        let free = step(&server, &ask(&without.artifact_id)).await;
        if let (Some(Verdict::Infeasible(why)), Some(Verdict::Command(_))) =
            (&strict.verdict, &free.verdict)
        {
            for row in &why.rows {
                *families.entry(row.family().as_str_name()).or_insert(0) += 1;
            }
        }
        // The set only takes starts away.
        let allowed = matches!(strict.verdict, Some(Verdict::Command(_)));
        assert!(!allowed || matches!(free.verdict, Some(Verdict::Command(_))), "{i}");
    }
    assert!(families.contains_key("CONSTRAINT_FAMILY_FIRST_STEP"), "{families:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_baselines_are_served() {
    let server = server().await;
    let mut efforts = BTreeMap::new();
    for scheme in ["LINEAR_QUADRATIC", "TUBE_ROBUST"] {
        let artifact = precompute(&server, &baseline(integrator(), scheme)).await;
        let made = summary(&artifact);
        assert_eq!(made.scheme().as_str_name(), format!("OFFLINE_SAMPLING_SCHEME_{scheme}"));
        assert_eq!(made.joint_confidence, None);
        assert_eq!(made.tube.is_some(), scheme == "TUBE_ROBUST");
        let request = json!({
            "artifactId": artifact.artifact_id, "measurement": linear(&[1.0, 0.0]),
        });
        let answer = step(&server, &request).await;
        assert!(answer.certificate.as_ref().unwrap().passed);
        let nominal = &diagnostics(&answer).nominal_state;
        assert_eq!(nominal.len(), if scheme == "TUBE_ROBUST" { 2 } else { 0 });
        efforts.insert(scheme, command(&answer).input_nd[0].abs());
    }
    let tube = precompute(&server, &baseline(integrator(), "TUBE_ROBUST")).await;
    let tube = summary(&tube).tube.clone().unwrap();
    // The tube holds at least one disturbance, and what the plant's uncertainty adds to it.
    assert!(tube.disturbance_half_widths.iter().all(|&width| width > 0.02), "{tube:?}");
    let wider = tube.state_half_widths.iter().zip(&tube.disturbance_half_widths);
    assert!(wider.into_iter().all(|(state, step)| state >= step), "{tube:?}");
    // What a baseline does not read is refused.
    let mut wrong = integrator();
    wrong["offlineSampling"]["scheme"] = json!("OFFLINE_SAMPLING_SCHEME_TUBE_ROBUST");
    let answer = server.post("/v1/precompute", &json!({ "problem": wrong })).await;
    let fields = ["samples", "redundancy", "first_step_set", "seed"];
    let fields = fields.map(|field| format!("problem.offline_sampling.{field}"));
    assert_eq!(json_fields(&answer.json()), fields);
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_floating_spacecraft_is_commanded_in_newtons() {
    let server = server().await;
    let artifact = precompute(&server, &poseidyn()).await;
    let made = summary(&artifact);
    assert!(made.inner_scaled && made.removed_excess > 0.0 && made.removed_excess <= 0.01);
    assert_eq!(made.sample_time_s, Some(5.0));
    let at = |elapsed_s: f64, x: [f64; 4]| json!({ "linear": { "components": x }, "elapsedS": elapsed_s });
    let request = json!({
        "artifactId": artifact.artifact_id, "measurement": at(0.0, [0.5, 0.5, 0.0, 0.0]),
    });
    let first = step(&server, &request).await;
    let flown = command(&first);
    assert_eq!((flown.elapsed_s, flown.duration_s), (0.0, Some(5.0)));
    assert_eq!(flown.force_n, flown.input_nd);
    assert!(flown.force_n.iter().all(|f| f.abs() <= 0.3 && *f < 0.0), "{flown:?}");
    // The measurement of step 1 never came; that of step 2 is answered.
    let expected = &first.prediction.as_ref().unwrap().states_nd.as_ref().unwrap().values[8..12];
    let later = |elapsed_s: f64| {
        let x = [expected[0], expected[1], expected[2], expected[3]];
        json!({
            "artifactId": artifact.artifact_id, "controllerState": state_of(&first),
            "measurement": at(elapsed_s, x),
        })
    };
    let answer = step(&server, &later(10.0)).await;
    assert_eq!((answer.step_index, diagnostics(&answer).missed_steps), (2, 1));
    assert_eq!(command(&answer).elapsed_s, 10.0);
    let wrong = server.post("/v1/step", &later(7.0)).await;
    assert_eq!(json_fields(&wrong.json()), ["measurement.elapsed_s"]);
    let beyond = server.post("/v1/step", &later(100.0)).await.json();
    assert_eq!(detail(&beyond, "ErrorInfo").unwrap()["reason"], "PLAN_EXHAUSTED", "{beyond}");
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_orbital_plant_measures_in_any_frame() {
    let server = server().await;
    let id = precompute(&server, &hill()).await.artifact_id;
    let relative = |frame: &str, position: [f64; 3], velocity: [f64; 3]| {
        json!({
            "artifactId": id,
            "measurement": { "relative": {
                "frame": frame, "positionM": position, "velocityMS": velocity,
            } },
        })
    };
    let rtn = relative("FRAME_RTN", [1.0, -2.0, 3.0], [0.01, 0.02, 0.03]);
    // x along-track, y against the normal, z to the Earth.
    let lvlh = relative("FRAME_LVLH_CCSDS", [-2.0, -3.0, -1.0], [0.02, -0.03, -0.01]);
    let (first, second) = (step(&server, &rtn).await, step(&server, &lvlh).await);
    assert_eq!(first, second);
    let command = command(&first);
    assert_eq!(command.frame(), v1::Frame::Rtn);
    assert_eq!(command.force_n, command.input_nd);
    let positions = first.prediction.as_ref().unwrap().positions_m.as_ref().unwrap();
    assert_eq!((positions.rows, positions.columns), (5, 3));
    assert_eq!(positions.values[..3], [1.0, -2.0, 3.0]);
    let wrong = json!({ "artifactId": id, "measurement": linear(&[0.0; 6]) });
    let wrong = server.post("/v1/step", &wrong).await;
    assert_eq!(json_fields(&wrong.json()), ["measurement"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_stream_answers_in_order() {
    let server = server().await;
    let id = precompute(&server, &integrator()).await.artifact_id;
    let first = json!({ "artifactId": id, "measurement": linear(&[2.0, 0.0]) });
    let more = [[1.5, -0.4], [1.0, -0.5]].map(|x| json!({ "measurement": linear(&x) }));
    let messages: Vec<v1::StepStreamRequest> =
        [first.clone()].into_iter().chain(more.clone()).map(missions::message).collect();
    let answers = server.grpc().await.step_stream(tokio_stream::iter(messages)).await;
    let mut answers = answers.expect("it opens").into_inner();
    let mut state = json!("");
    for request in [first].into_iter().chain(more) {
        let mut request = request;
        request["artifactId"] = id.clone().into();
        request["controllerState"] = state;
        let alone = step(&server, &request).await;
        let message = answers.message().await.expect("no error").expect("an answer");
        let Some(v1::step_stream_response::Result::Response(streamed)) = message.result else {
            panic!("{message:?}")
        };
        assert_eq!(streamed, alone);
        state = state_of(&alone);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_bytes_do_not_depend_on_threads() {
    let mut contents = Vec::new();
    for compute_threads in [1, 2] {
        let server = server_with(Config {
            compute_threads,
            job_threads: compute_threads,
            ..Config::default()
        })
        .await;
        for problem in [integrator(), poseidyn()] {
            let artifact = precompute(&server, &problem).await;
            contents.push(artifact.provenance.unwrap().content_sha256);
        }
    }
    assert_eq!(contents[..2], contents[2..]);
    assert_ne!(contents[0], contents[1]);
    let mut other = integrator();
    other["offlineSampling"]["seed"] = json!("12");
    let server = server().await;
    let other = precompute(&server, &other).await.provenance.unwrap().content_sha256;
    assert!(!contents.contains(&other));
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_step_with_a_long_precompute_points_to_precompute() {
    let computation_time_max = std::time::Duration::from_millis(20);
    let server = server_with(Config { computation_time_max, ..Config::default() }).await;
    let request = json!({ "problem": poseidyn(), "measurement": linear(&[0.5, 0.5, 0.0, 0.0]) });
    let error = server.post("/v1/step", &request).await.json();
    assert_eq!(error["code"], 4, "{error}");
    assert!(error["message"].as_str().unwrap().contains("Precompute"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn sampling_has_no_plan_to_compute() {
    let server = server().await;
    let request = json!({ "problem": integrator() });
    let answer = server.post("/v1/plans:compute", &request).await;
    assert_eq!(json_fields(&answer.json()), ["problem"]);
    let request: v1::ComputePlanRequest = missions::message(request);
    let status = server.grpc().await.compute_plan(request).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert_eq!(grpc_fields(&status), ["problem"]);
}

fn golden(name: &str) -> Value {
    let root = std::env::var_os("VBAR_GOLDEN_DIR").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden")),
        PathBuf::from,
    );
    let path = root.join("offline_sampling").join(name);
    let text = fs::read_to_string(&path).unwrap_or_else(|fault| panic!("{path:?}: {fault}"));
    serde_json::from_str(&text).expect("JSON")
}

/// Sample sizes of an independent implementation, where a precompute with so many is quick.
#[tokio::test(flavor = "multi_thread")]
async fn sampling_sizes_are_the_golden_ones() {
    let server = server().await;
    let golden = golden("g01_ntilde.json");
    let mut checked = 0;
    for case in golden["cases"].as_array().unwrap() {
        let ceil = case["ceil"].as_i64().unwrap();
        if ceil > 3000 || case["d"].as_i64().unwrap() == 0 {
            continue;
        }
        let mut problem = integrator();
        problem["offlineSampling"]["samples"] = json!({
            "violation": case["eps"], "confidenceComplement": case["delta"],
            "variables": case["d"],
        });
        problem["offlineSampling"]["horizon"] = json!(1);
        let artifact = precompute(&server, &problem).await;
        for group in &summary(&artifact).groups {
            assert_eq!(i64::from(group.samples), ceil, "{case}");
        }
        checked += 1;
    }
    assert!(checked >= 2, "only {checked} cases");
}

/// The largest d x over {N x <= h} in a plane: at a corner of two rows.
fn support(set: &v1::PolytopeSet, direction: [f64; 2]) -> f64 {
    let normals = &set.normals.as_ref().expect("rows").values;
    let row = |i: usize| (normals[2 * i], normals[2 * i + 1], set.offsets[i]);
    let mut best = f64::NEG_INFINITY;
    for i in 0..set.offsets.len() {
        for j in 0..i {
            let ((a, b, e), (c, d, f)) = (row(i), row(j));
            let area = a * d - b * c;
            let corner = [(e * d - b * f) / area, (a * f - e * c) / area];
            let inside = (0..set.offsets.len()).all(|k| {
                let (a, b, e) = row(k);
                a * corner[0] + b * corner[1] <= e + 1e-9
            });
            if area.abs() > 1e-12 && inside {
                best = best.max(direction[0] * corner[0] + direction[1] * corner[1]);
            }
        }
    }
    best
}

/// Terminal sets of an independent implementation: plants by their vertices, no input.
#[tokio::test(flavor = "multi_thread")]
async fn sampling_terminal_sets_are_the_golden_ones() {
    let server = server().await;
    let golden = golden("g15_max_rpi.json");
    let mut checked = 0;
    // The corners of a set are counted in a plane; the cases beyond are checked in guidance.
    let planar = |case: &&Value| case["A"][0].as_array().is_some_and(|rows| rows.len() == 2);
    for case in golden["cases"].as_array().unwrap().iter().filter(planar) {
        let response = finished(&server, &invariant(case)).await["response"].clone();
        if case["empty"].as_bool().unwrap() {
            assert!(response["infeasible"]["reason"].is_string(), "{case}: {response}");
            continue;
        }
        let summary = response["artifact"]["offlineSampling"].clone();
        let made: v1::OfflineSamplingArtifact = missions::message(summary);
        for entry in case["support"].as_array().unwrap() {
            let direction: [f64; 2] = serde_json::from_value(entry["dir"].clone()).unwrap();
            let value = support(made.terminal_set.as_ref().unwrap(), direction);
            let expected = entry["value"].as_f64().unwrap();
            let tolerance = golden["tol"].as_f64().unwrap() * (1.0 + expected.abs());
            assert!((value - expected).abs() <= tolerance, "{case}: {value} along {direction:?}");
            checked += 1;
        }
    }
    assert!(checked >= 8, "only {checked} directions");
}

/// A problem whose terminal set is the golden case's: the input does nothing, and its bounds are
/// too far away to matter.
fn invariant(case: &Value) -> Value {
    let plants: Vec<Vec<Vec<f64>>> = serde_json::from_value(case["A"].clone()).unwrap();
    let rows = |a: &[Vec<f64>]| matrix(&a.iter().map(Vec::as_slice).collect::<Vec<_>>());
    let none = matrix(&[&[0.0], &[0.0]]);
    let vertices: Vec<Value> = plants.iter().map(|a| json!({ "a": rows(a), "b": none })).collect();
    let w = case["w_inf"].as_f64().unwrap();
    let law = json!({ "uniform": { "low": -w, "high": w } });
    let width = case["x_inf"].as_f64().unwrap();
    let mut problem = integrator();
    let asked = problem["offlineSampling"].as_object_mut().expect("a problem");
    let weights =
        json!({ "state": diagonal(&[1.0, 1.0]), "input": diagonal(&[1.0]), "samples": 1 });
    for (name, value) in [
        (
            "polynomial",
            json!({
                "a": { "constant": rows(&plants[0]) },
                "b": { "constant": none },
                "discretisation": "DISCRETISATION_NONE",
            }),
        ),
        ("vertices", vertices.into()),
        ("disturbance", vec![law; 2].into()),
        ("gain", json!({ "explicit": matrix(&[&[0.01, 0.01]]) })),
        ("weights", weights),
        ("stateSet", symmetric(2, 0, &[width, width])),
        ("inputSet", symmetric(1, 0, &[100.0])),
        ("horizon", json!(1)),
    ] {
        asked.insert(name.into(), value);
    }
    problem
}
