//! The command as its users see it: processes, exit codes, standard streams.

#[path = "command/access.rs"]
mod access;
#[path = "command/crashes.rs"]
mod crashes;
#[cfg(target_os = "linux")]
#[path = "command/flood.rs"]
mod flood;
#[path = "../../server/tests/server/missions.rs"]
#[allow(dead_code, reason = "the tests of the server share this file and need more of it")]
mod missions;
#[path = "command/replay.rs"]
mod replay;

use std::{
    io::{BufRead as _, BufReader, Write as _},
    path::PathBuf,
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use serde_json::{Value, json};
use vbar_client::{
    Client, Code, Options,
    v1::{LinearState, Measurement, measurement, step_stream_request::Controller},
};
use vbar_simulator::Mission;

fn vbar(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_vbar"));
    command.args(arguments).stdin(Stdio::null());
    // What the machine that runs the tests has set must not change them.
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("VBAR_")) {
        command.env_remove(name);
    }
    command
}

fn output(arguments: &[&str]) -> Output {
    vbar(arguments).output().unwrap()
}

fn mission(name: &str) -> String {
    let path: PathBuf =
        [env!("CARGO_MANIFEST_DIR"), "..", "simulator", "missions", name].iter().collect();
    path.to_str().unwrap().to_owned()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// A node in a process of its own; killed when dropped.
struct Process {
    child: Child,
    url: String,
}

impl Process {
    fn start(arguments: &[&str]) -> Self {
        let mut command = vbar(&["serve", "--listen", "127.0.0.1:0", "--log", "warn"]);
        let mut child = command.args(arguments).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
        Self { child, url }
    }

    fn signal(&self, name: &str) {
        let pid = self.child.id().to_string();
        assert!(Command::new("kill").args([name, &pid]).status().unwrap().success());
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already, as some tests want it to.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A first step of the double integrator, as JSON.
fn first_step() -> Value {
    let text = std::fs::read_to_string(mission("double_integrator.json")).unwrap();
    let mission: Value = serde_json::from_str(&text).unwrap();
    json!({
        "problem": mission["problem"],
        "measurement": { "linear": { "components": [20.0, 0.0] } },
    })
}

fn step_with(input: &str, arguments: &[&str]) -> Output {
    let mut command = vbar(&["step"]);
    let mut child = command
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    child.wait_with_output().unwrap()
}

#[test]
fn command_line_that_is_wrong_exits_64() {
    for arguments in [&["serv"][..], &["serve", "--prot", "1"], &["simulate"], &[]] {
        assert_eq!(output(arguments).status.code(), Some(64), "{arguments:?}");
    }
    assert_eq!(output(&["--help"]).status.code(), Some(0));
}

#[test]
fn serve_bad_configuration_exits_64_and_names_every_fault() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vbar.toml");
    std::fs::write(&file, "horizon_max = 0\n").unwrap();
    let file = file.to_str().unwrap();
    let arguments = ["serve", "--listen", "0.0.0.0:0", "--config", file];
    let ended = vbar(&arguments)
        .env("VBAR_COMPUTE_THREADS", "0")
        .env("VBAR_LISTN", "127.0.0.1:1")
        .output()
        .unwrap();
    assert_eq!(ended.status.code(), Some(64));
    let said = text(&ended.stderr);
    for part in ["loopback", "horizon_max", "VBAR_LISTN"] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    let ended = vbar(&arguments).env("VBAR_COMPUTE_THREADS", "0").output().unwrap();
    assert!(text(&ended.stderr).contains("compute_threads"));
}

#[test]
fn serve_check_config_starts_nothing() {
    let good = output(&["serve", "--check-config"]);
    assert_eq!((good.status.code(), text(&good.stderr)), (Some(0), String::new()));
    let bad = output(&["serve", "--check-config", "--config", "/nowhere/vbar.toml"]);
    assert_eq!(bad.status.code(), Some(64));
    assert!(text(&bad.stderr).contains("/nowhere/vbar.toml"));
}

#[test]
fn serve_print_config_says_every_setting_and_where_it_was_said() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vbar.toml");
    let password = "nats://user:secret@127.0.0.1:4222";
    std::fs::write(&file, format!("# ours\nhorizon_max = 77\nstore = '{password}'\n")).unwrap();
    let file = file.to_str().unwrap();
    let print = |arguments: &[&str]| {
        let all = ["serve", "--print-config", "--config", file, "--compute-threads", "3"];
        let printed =
            vbar(&[&all[..], arguments].concat()).env("VBAR_STREAMS_MAX", "44").output().unwrap();
        assert_eq!(printed.status.code(), Some(0), "{}", text(&printed.stderr));
        assert!(!text(&printed.stdout).contains("secret"), "a password is shown");
        text(&printed.stdout)
    };
    let plain = print(&[]);
    for line in [
        "compute_threads = 3  # flag".to_owned(),
        "streams_max = 44  # environment VBAR_STREAMS_MAX".to_owned(),
        format!("horizon_max = 77  # {file}:2"),
        format!("store = \"nats://(set)@127.0.0.1:4222\"  # {file}:3"),
        "listen = \"127.0.0.1:7440\"  # default".to_owned(),
        "# tokens_file is not set".to_owned(),
    ] {
        assert!(plain.lines().any(|printed| printed == line), "{line} is not in\n{plain}");
    }
    let listed: Vec<Value> = serde_json::from_str(&print(&["--format", "json"])).unwrap();
    assert_eq!(listed.len(), plain.lines().count());
    let horizon = listed.iter().find(|setting| setting["name"] == "horizon_max").unwrap();
    assert_eq!((&horizon["value"], &horizon["source"]), (&77.into(), &format!("{file}:2").into()));
    // What is printed is a file of settings that says the same.
    let printed = folder.path().join("printed.toml");
    std::fs::write(&printed, &plain).unwrap();
    let again = output(&["serve", "--print-config", "--config", printed.to_str().unwrap()]);
    let values = |text: &str| -> Vec<String> {
        text.lines().map(|line| line.split("  # ").next().unwrap().to_owned()).collect()
    };
    assert_eq!(values(&text(&again.stdout)), values(&plain), "{}", text(&again.stderr));
}

#[test]
fn version_is_the_same_here_and_on_a_node() {
    let node = Process::start(&[]);
    let here = output(&["version", "--format", "json"]);
    let there = output(&["version", "--format", "json", "--server", &node.url]);
    assert_eq!(text(&here.stdout), text(&there.stdout), "{}", text(&there.stderr));
    let build: Value = serde_json::from_slice(&here.stdout).unwrap();
    assert_eq!(build["sha256"].as_str().unwrap().len(), 64);
    assert!(build["rustc"].as_str().unwrap().starts_with("rustc 1."), "{build}");
    for name in ["version", "target", "profile"] {
        assert!(!build[name].as_str().unwrap().is_empty(), "{name} in {build}");
    }
    let plain = text(&output(&["version"]).stdout);
    assert!(plain.contains(build["sha256"].as_str().unwrap()), "{plain}");
}

#[test]
fn serve_answers_until_it_is_told_to_stop() {
    for signal in ["-TERM", "-INT"] {
        let mut node = Process::start(&[]);
        let healthy = output(&["health", "--server", &node.url]);
        assert_eq!((healthy.status.code(), text(&healthy.stdout)), (Some(0), "serving\n".into()));
        node.signal(signal);
        assert_eq!(node.child.wait().unwrap().code(), Some(0), "{signal}");
    }
}

#[test]
fn serve_port_in_use_is_named() {
    let node = Process::start(&[]);
    let taken = node.url.trim_start_matches("http://");
    let ended = output(&["serve", "--listen", taken]);
    assert_eq!(ended.status.code(), Some(69));
    assert!(text(&ended.stderr).contains(taken), "{}", text(&ended.stderr));
}

#[test]
fn health_of_nobody_exits_69_in_time() {
    let started = Instant::now();
    let ended = output(&["health", "--server", "http://127.0.0.1:1"]);
    assert_eq!(ended.status.code(), Some(69));
    assert!(started.elapsed() < Duration::from_secs(10));
}

#[test]
fn step_reads_json_and_prints_json() {
    let node = Process::start(&[]);
    let input = first_step().to_string();
    let own = step_with(&input, &[]);
    let other = step_with(&input, &["--server", &node.url]);
    assert_eq!(own.status.code(), Some(0), "{}", text(&own.stderr));
    assert_eq!(text(&own.stdout), text(&other.stdout), "two nodes, two answers");
    let answer: Value = serde_json::from_slice(&own.stdout).unwrap();
    assert_eq!(answer["certificate"]["passed"], true);
    assert_eq!(answer["command"]["inputNd"].as_array().unwrap().len(), 1);
}

#[test]
fn step_that_makes_no_sense_exits_65_and_says_why() {
    let mut request = first_step();
    request["problem"]["variableHorizon"]["horizonMax"] = json!(0);
    request["measurement"]["linear"]["components"] = json!([1.0]);
    let refused = step_with(&request.to_string(), &[]);
    assert_eq!(refused.status.code(), Some(65));
    let said = text(&refused.stderr);
    assert!(said.contains("horizon_max"), "{said}");
    let truncated = step_with("{\"problem\": {", &[]);
    assert_eq!(truncated.status.code(), Some(65));
    assert!(text(&truncated.stderr).contains("line 1"));
}

#[test]
fn simulate_prints_the_report_as_json() {
    let arguments =
        ["--runs", "3", "--seed", "1", "--format", "json", "--no-pictures", "--scheme", "all"];
    let flown =
        vbar(&["simulate", &mission("double_integrator.json")]).args(arguments).output().unwrap();
    assert_eq!(flown.status.code(), Some(0), "{}", text(&flown.stderr));
    let report: Value = serde_json::from_slice(&flown.stdout).unwrap();
    assert!(report.is_object(), "{report}");
}

#[test]
fn simulate_without_a_mission_exits_65() {
    let ended = output(&["simulate", "nowhere.json"]);
    assert_eq!(ended.status.code(), Some(65));
    assert!(text(&ended.stderr).contains("nowhere.json"));
}

#[test]
fn plan_starts_at_the_mission_or_where_it_is_told() {
    let planned = output(&["plan", &mission("envisat.json")]);
    assert_eq!(planned.status.code(), Some(0), "{}", text(&planned.stderr));
    let answer: Value = serde_json::from_slice(&planned.stdout).unwrap();
    assert!(answer["plan"]["commands"].as_array().unwrap().len() > 10);

    let folder = tempfile::tempdir().unwrap();
    let initial = folder.path().join("initial.json");
    std::fs::write(&initial, first_step()["measurement"].to_string()).unwrap();
    let initial = initial.to_str().unwrap();
    let arguments = ["plan", &mission("double_integrator.json"), "--initial", initial];
    let planned = output(&arguments);
    assert_eq!(planned.status.code(), Some(0), "{}", text(&planned.stderr));
}

#[test]
fn precompute_prints_the_artifact() {
    let made = output(&["precompute", &mission("double_integrator.json")]);
    assert_eq!(made.status.code(), Some(0), "{}", text(&made.stderr));
    let answer: Value = serde_json::from_slice(&made.stdout).unwrap();
    // 0.2671 is what an independent implementation found for this mission.
    let lambda_bar = answer["artifact"]["variableHorizon"]["lambdaBar"].as_f64().unwrap();
    assert!((lambda_bar - 0.2671).abs() < 5e-5, "{lambda_bar}");
}

#[test]
fn precompute_interrupted_is_cancelled_on_the_node() {
    let node = Process::start(&[]);
    // Its samples take a good while.
    let mut command = vbar(&["precompute", &mission("poseidyn.json"), "--server", &node.url]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // It answers after its own wait; until then there is nothing to cancel.
    std::thread::sleep(Duration::from_secs(3));
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(130), "{}", text(&ended.stderr));
    assert!(text(&ended.stderr).contains("was cancelled on the node"), "{}", text(&ended.stderr));
}

/// What `vbar plan` printed, or its complaint as the test's.
fn planned(arguments: &[&str]) -> String {
    let ended = output(&[&["plan"], arguments].concat());
    assert_eq!(ended.status.code(), Some(0), "{arguments:?}: {}", text(&ended.stderr));
    text(&ended.stdout)
}

#[test]
fn plan_with_feedback_prints_sets_burns_and_proof() {
    let prisma = mission("prisma.json");
    let said = planned(&[&prisma, "--metric", "SCALED_6"]);
    // 105.2 is the open-loop axis of [Deaconu2014, table 3]; ten instants are nine burns.
    for part in ["with feedback", "open loop", "105.2", "certificate passed", "\n  8", "plan "] {
        assert!(said.contains(part), "{part} is missing in\n{said}");
    }
    let said = planned(&[&prisma, "--instants", "6", "--format", "json"]);
    let answer: Value = serde_json::from_str(&said).unwrap();
    let plan = &answer["plan"]["disturbanceFeedback"];
    assert_eq!(plan["burns"].as_array().unwrap().len(), 5);
    assert_eq!(plan["certificate"]["passed"], true);
    assert_eq!(answer["planId"].as_str().unwrap().len(), 64);
}

/// That there is no plan is an answer: exit code 0, and the least bound that has one.
#[test]
fn plan_that_does_not_exist_names_the_least_bound() {
    for arguments in [
        &["--variant", "6000s_as_printed"][..],
        &["--duration", "6000"],
        &["--variant", "6000s", "--delta-v-max", "0.2"],
    ] {
        let said = planned(&[&[mission("prisma.json").as_str()], arguments].concat());
        // 0.27887 m/s is what an independent implementation found.
        assert!(said.contains("no plan exists") && said.contains("0.2788"), "{said}");
    }
}

#[test]
fn plan_exported_can_be_verified_and_uploaded() {
    let folder = tempfile::tempdir().unwrap();
    let node = Process::start(&[]);
    let mission = mission("simbol_x.json");
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    for (format, begins) in
        [("oem", "CCSDS_OEM_VERS"), ("ocm", "CCSDS_OCM_VERS"), ("csv", ""), ("document", "{")]
    {
        let out = file(format);
        planned(&[&mission, "--export", format, "--out", &out]);
        let written = std::fs::read_to_string(&out).unwrap();
        assert!(written.starts_with(begins), "{format}: {written:.60}");
        assert!(written.lines().count() > 9, "{format}: a line an instant at least");
    }
    planned(&[&mission, "--export", "binary", "--out", &file("binary")]);
    let mut ids = Vec::new();
    for name in ["document", "binary"] {
        let verified = output(&["verify", &file(name)]);
        assert_eq!(verified.status.code(), Some(0), "{name}: {}", text(&verified.stderr));
        assert!(text(&verified.stdout).contains("every claim of the plan holds"));
        let uploaded = output(&["upload", &file(name), "--server", &node.url]);
        assert_eq!(uploaded.status.code(), Some(0), "{name}: {}", text(&uploaded.stderr));
        let answer: Value = serde_json::from_slice(&uploaded.stdout).unwrap();
        let id = answer["planId"].as_str().unwrap().to_owned();
        assert!(text(&verified.stdout).contains(&id), "{name}: another id offline");
        ids.push(id);
    }
    assert_eq!(ids[0], ids[1], "two forms of one plan");
}

#[test]
fn verify_refuses_what_does_not_hold_and_says_what() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let mission = mission("simbol_x.json");
    planned(&[&mission, "--export", "document", "--out", &file("good.json")]);
    planned(&[&mission, "--export", "binary", "--out", &file("good.bin")]);

    let good = std::fs::read_to_string(file("good.json")).unwrap();
    let mut claim: Value = serde_json::from_str(&good).unwrap();
    claim["plan"]["disturbanceFeedback"]["trace"] = json!(1e-3);
    std::fs::write(file("claim.json"), claim.to_string()).unwrap();
    let mut burn: Value = serde_json::from_str(&good).unwrap();
    burn["plan"]["disturbanceFeedback"]["burns"][3]["deltaVMS"][0] = json!(0.5);
    std::fs::write(file("burn.json"), burn.to_string()).unwrap();
    let mut flipped = std::fs::read(file("good.bin")).unwrap();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 1;
    std::fs::write(file("flipped.bin"), flipped).unwrap();
    std::fs::write(file("short.json"), &good[..good.len() / 2]).unwrap();

    for (name, part) in
        [("claim.json", "trace"), ("burn.json", ""), ("flipped.bin", ""), ("short.json", "")]
    {
        for command in ["verify", "upload"] {
            let ended = output(&[command, &file(name)]);
            let said = text(&ended.stderr);
            assert_eq!(ended.status.code(), Some(65), "{command} {name}: {said}");
            assert!(said.contains(part), "{command} {name}: {said}");
            assert!(ended.stdout.is_empty());
        }
    }
    let nowhere = output(&["verify", "nowhere.json"]);
    assert_eq!(nowhere.status.code(), Some(65));
    assert!(text(&nowhere.stderr).contains("nowhere.json"));
}

#[test]
fn plan_options_that_do_not_fit_exit_64_and_are_named() {
    let (prisma, envisat) = (mission("prisma.json"), mission("envisat.json"));
    for (arguments, part) in [
        (&["plan", &prisma, "--metric", "FANCY"][..], "SCALED_6"),
        (&["plan", &prisma, "--variant", "moon"], "6000s_as_printed"),
        (&["plan", &prisma, "--export", "oem"], "--out"),
        (&["plan", &prisma, "--export", "pdf", "--out", "x"], "binary"),
        (&["plan", &prisma, "--table", "--variant", "9000s"], "--table"),
        (&["plan", &prisma, "--scheme", "nominal"], "--scheme"),
        (&["plan", &envisat, "--table"], "--table"),
        (&["plan", &envisat, "--metric", "POSITION"], "--metric"),
        (&["simulate", &envisat, "--instants", "6"], "--instants"),
        (&["simulate", &prisma, "--compare-search"], "--compare-search"),
        (&["simulate", &prisma, "--variant", "moon"], "6000s_as_printed"),
    ] {
        let ended = output(arguments);
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(64), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
    // What the node refuses comes back with its field.
    let ended = output(&["plan", &prisma, "--duration", "-5"]);
    assert_eq!(ended.status.code(), Some(65));
    assert!(text(&ended.stderr).contains("duration_s"), "{}", text(&ended.stderr));
}

#[test]
fn plan_table_prints_every_column_beside_the_papers() {
    let prisma = mission("prisma.json");
    let said = planned(&[&prisma, "--table"]);
    // The printed figures of [Deaconu2014, table 3].
    for part in ["3.66", "5.77", "8.76", "17.49", "35.03", "56.82", "70.08", "105.2", "no plan"] {
        assert!(said.contains(part), "{part} is missing in\n{said}");
    }
    let said = planned(&[&prisma, "--table", "--metric", "POSITION", "--format", "json"]);
    let rows: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(rows.as_array().unwrap().len(), 5);
    assert_eq!(rows[4]["metric"], "POSITION");
    assert!(rows[4]["in_plane_semi_axes_m"][0].as_f64().unwrap() > 0.0);
}

#[test]
fn simulate_flies_plans_and_writes_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let arguments = ["--runs", "2", "--variant", "8000s_n6", "--format", "json", "--out", out];
    let flown = vbar(&["simulate", &mission("simbol_x.json")]).args(arguments).output().unwrap();
    assert_eq!(flown.status.code(), Some(0), "{}", text(&flown.stderr));
    let report: Value = serde_json::from_slice(&flown.stdout).unwrap();
    assert_eq!((&report["runs"], &report["inside_arrival_set"]), (&json!(2), &json!(2)));
    let written = std::fs::read_to_string(folder.path().join("simbol_x_report.json")).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&written).unwrap(), report);
    for name in
        ["simbol_x_8000s_n6_trajectories.svg", "simbol_x_8000s_n6_runs.csv", "simbol_x_axes.svg"]
    {
        assert!(folder.path().join(name).exists(), "{name}");
        assert!(text(&flown.stderr).contains(name), "{name}");
    }
}

/// A file in a folder of its own, which must live as long as the file is needed.
fn file(name: &str, content: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, content).unwrap();
    let path = path.to_str().unwrap().to_owned();
    (folder, path)
}

const STATES: &str = "k,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s\n\
                      3,0,300,0,0,0,0\n4,0,300,0.5,0,0,0\n5,0,15,0,0,0,0\n";

#[test]
fn safety_says_what_could_be_done_at_every_state() {
    let (_folder, trajectory) = file("states.csv", STATES);
    let iss = mission("iss.json");
    let ended = output(&["safety", &trajectory, "--mission", &iss, "--phase", "2"]);
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    let said = text(&ended.stdout);
    // 254 failures at three states; the last one is in the box already.
    for part in ["762 verdicts on 3 states", "first state without an abort", "step 5"] {
        assert!(said.contains(part), "{part} is missing in\n{said}");
    }
    let ended = output(&[
        "safety",
        &trajectory,
        "--mission",
        &iss,
        "--phase",
        "2",
        "--first-step",
        "7",
        "--format",
        "json",
    ]);
    let report: Value = serde_json::from_slice(&ended.stdout).unwrap();
    assert_eq!(report["states"][0]["stepIndex"], 7);
    assert_eq!(report["states"][2]["modes"].as_array().unwrap().len(), 254);
    assert!(report["states"][0]["sequences"].is_array(), "JSON has the aborts themselves");
}

#[test]
fn safety_refuses_what_makes_no_sense() {
    let (iss, envisat) = (mission("iss.json"), mission("envisat.json"));
    let (_a, csv) = file("states.csv", STATES);
    let (_b, broken) = file("broken.csv", "x_m,y_m\n1,2\n");
    let (_c, request) = file("request.json", "{\"states\": {\"states\": []}, \"speed\": 1}");
    let (_d, empty) = file("empty.json", "{\"states\": []}");
    for (arguments, code, part) in [
        (&["safety", &broken, "--mission", &iss] as &[&str], 65, "z_m"),
        (&["safety", &csv, "--mission", &envisat], 65, "no failures"),
        (&["safety", &request], 65, "speed"),
        (&["safety", &csv], 65, "SafetyReportRequest"),
        (&["safety", &empty, "--mission", &iss], 65, "states"),
        (&["safety", "no/such/file"], 65, "no/such/file"),
        (&["safety", &csv, "--phase", "1"], 64, "--mission"),
        (&["simulate", &iss, "--compare-search"], 64, "--compare-search"),
        (&["simulate", &iss, "--variant", "moon"], 64, "through"),
        (&["plan", &iss], 64, "step by step"),
    ] {
        let ended = output(arguments);
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(code), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
}

/// The nominal next state of the double integrator: the first row after the present one.
fn expected(prediction: &vbar_client::v1::Prediction) -> Measurement {
    measured_at(prediction.states_nd.as_ref().unwrap().values[2..4].to_vec())
}

fn measured_at(components: Vec<f64>) -> Measurement {
    let state = Some(measurement::State::Linear(LinearState { components }));
    Measurement { state, ..Measurement::default() }
}

#[tokio::test]
async fn loop_survives_the_death_of_its_node() {
    let problem = Mission::load(mission("double_integrator.json").as_ref()).unwrap().problem;
    let controller = Controller::Problem(problem);
    let (mut first, second) = (Process::start(&[]), Process::start(&[]));
    let options = || Options { attempts_max: 2, ..Options::default() };
    let mut flight = Client::connect(&first.url, options())
        .await
        .unwrap()
        .closed_loop(controller.clone())
        .await
        .unwrap();
    let mut measured = measured_at(vec![20.0, 0.0]);
    for _ in 0..3 {
        let answer = flight.step(measured).await.unwrap();
        measured = expected(answer.prediction.as_ref().unwrap());
    }
    first.child.kill().unwrap();
    first.child.wait().unwrap();
    let error = flight.step(measured.clone()).await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable, "{error}");

    let state = flight.controller_state().clone();
    let client = Client::connect(&second.url, options()).await.unwrap();
    let mut flight = client.closed_loop(controller).await.unwrap().from_state(state);
    let answer = flight.step(measured).await.unwrap();
    assert_eq!(answer.step_index, 3);
    assert!(answer.certificate.unwrap().passed);
}
