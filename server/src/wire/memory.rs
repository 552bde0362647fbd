//! What a problem takes against what was estimated for it: each is precomputed in a process of its
//! own, whose greatest resident size the system tells.
//!
//! `VBAR_MEMORY=all` has the missions that take minutes, too.

use std::{env, path::Path, process::Command};

use serde_json::{Value, json};
use vbar_guidance::Budget;
use vbar_proto::v1;

use super::{Limits, Problem, parse};
use crate::missions;

/// Names the problem to be precomputed in this process.
const ASKED: &str = "VBAR_MEMORY_OF";
/// What a process takes beside the problem, and what nobody has to estimate.
const SLACK_BYTES: usize = 8 << 20;
/// An estimate may be so many times too large where it decides: below this nothing is refused.
const FACTOR_MAX: usize = 4;
const DECIDES_BYTES: usize = 256 << 20;

fn published(name: &str) -> Value {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../simulator/missions");
    let text = std::fs::read_to_string(folder.join(name).with_extension("json")).unwrap();
    let mut mission: Value = serde_json::from_str(&text).unwrap();
    mission["problem"].take()
}

/// A mission, or one made larger: `mission*what`.
fn problem_json(case: &str) -> Value {
    let (mission, larger) = case.split_once('*').unwrap_or((case, ""));
    let mut problem = match mission {
        "integrator" => missions::integrator(),
        "station" => missions::station(),
        other => published(other),
    };
    let grow = |value: &mut Value, by: f64| *value = json!((value.as_f64().unwrap() * by) as u64);
    match larger {
        "" => {}
        "horizon" => {
            let method = problem.as_object_mut().unwrap().values_mut().next().unwrap();
            let key = if method["horizonMax"].is_null() { "horizon" } else { "horizonMax" };
            grow(&mut method[key], 2.0);
        }
        "samples" => {
            let method = &mut problem["offlineSampling"];
            let size = if mission == "integrator" { 3000 } else { 400 };
            method["samples"]["size"] = json!(size);
        }
        "steps" => problem["variableHorizon"]["stepsMax"] = json!(10_000),
        "instants" => {
            let instants = &mut problem["disturbanceFeedback"]["instants"]["equalTime"];
            instants["count"] = json!(60);
        }
        other => panic!("{other}"),
    }
    problem
}

const CASES: [&str; 11] = [
    "envisat",
    "envisat*horizon",
    "envisat*steps",
    "leo_tumbler",
    "prisma",
    "gto",
    "gto*instants",
    "station",
    "integrator",
    "integrator*horizon",
    "integrator*samples",
];

const LONG_CASES: [&str; 10] = [
    "active_abort",
    "double_integrator",
    "hcw_docking",
    "hcw_docking*samples",
    "iss",
    "perturbed_55",
    "poseidyn",
    "simbol_x",
    "tumbling_satellite",
    "vbar_elliptic",
];

/// Bytes of a line of `/proc/self/status`.
fn status_bytes(line: &str) -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let found = status.lines().find_map(|each| each.strip_prefix(line)).unwrap();
    let kib = found.trim_start_matches(':').trim().trim_end_matches(" kB");
    kib.parse::<usize>().unwrap() << 10
}

/// Does its work only in a process that is asked to.
#[test]
#[cfg(target_os = "linux")]
#[allow(clippy::print_stdout, reason = "the other process reads it")]
fn memory_of_one_problem() {
    let Ok(case) = env::var(ASKED) else { return };
    let message: v1::Problem = missions::message(problem_json(&case));
    let limits = Limits { problem_bytes_max: usize::MAX, ..Limits::default() };
    let problem: Problem = parse(&message, &limits).unwrap();
    let before = status_bytes("VmRSS");
    let artifact = problem.prepare(Budget::UNLIMITED).unwrap();
    let bytes = artifact.to_bytes();
    let peak = status_bytes("VmHWM").saturating_sub(before);
    println!("{ASKED} {} {peak} {}", problem.memory_bytes(), bytes.len());
}

#[test]
#[cfg(target_os = "linux")]
#[allow(clippy::print_stdout, reason = "the figures are what it is for")]
fn memory_is_estimated_from_above_and_not_far_off_where_it_decides() {
    let long = env::var("VBAR_MEMORY").is_ok_and(|which| which == "all");
    let cases = CASES.iter().chain(if long { &LONG_CASES[..] } else { &[] });
    println!("{:<22}{:>12}{:>12}{:>12}", "", "estimated", "peak", "made, KiB");
    let mut wrong = Vec::new();
    for case in cases {
        let [estimate, peak, made] = measured(case);
        println!("{case:<22}{:>12}{:>12}{:>12}", estimate >> 10, peak >> 10, made >> 10);
        if peak > estimate + SLACK_BYTES || estimate > FACTOR_MAX * peak.max(DECIDES_BYTES) {
            wrong.push(*case);
        }
    }
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
#[cfg(not(target_os = "linux"))]
#[allow(clippy::print_stdout, reason = "a skip is said aloud")]
fn memory_is_estimated_from_above_and_not_far_off_where_it_decides() {
    println!("SKIPPED: only Linux tells the greatest resident size of a process");
}

/// Estimate, peak and bytes of the artifact, from a process of its own.
#[cfg(target_os = "linux")]
fn measured(case: &str) -> [usize; 3] {
    let output = Command::new(env::current_exe().unwrap())
        .args(["wire::memory::memory_of_one_problem", "--exact", "--nocapture"])
        .env(ASKED, case)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let line = text.lines().find_map(|line| line.split_once(ASKED));
    let (_, numbers) = line.unwrap_or_else(|| panic!("{case}: {output:?}"));
    let numbers: Vec<usize> = numbers.split_whitespace().map(|n| n.parse().unwrap()).collect();
    numbers.try_into().unwrap()
}
