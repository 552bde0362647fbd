//! Who may know whom.

use std::collections::BTreeMap;

use toml::{Table, Value};

use super::{
    Tree,
    paths::{self, Used, modules_of},
};

/// The only folders at the root.
const FOLDERS: [&str; 9] =
    [".ci", "cli", "client", "docker", "guidance", "proto", "server", "simulator", "tests"];

/// Manifest of each crate of ours, and which others it may depend on.
const CRATES: [(&str, &str, &[&str]); 8] = [
    ("proto", "vbar-proto", &[]),
    ("guidance", "vbar-guidance", &[]),
    ("server", "vbar-server", &["vbar-proto", "vbar-guidance"]),
    ("client", "vbar-client", &["vbar-proto"]),
    ("simulator", "vbar-simulator", &["vbar-client", "vbar-proto"]),
    ("cli", "vbar-cli", &["vbar-server", "vbar-simulator", "vbar-client", "vbar-proto"]),
    (
        "tests/system",
        "vbar-system-tests",
        &["vbar-server", "vbar-client", "vbar-simulator", "vbar-proto"],
    ),
    ("tests/fuzz", "vbar-fuzz", &["vbar-server"]),
];

/// What only tests and benchmarks of a crate may depend on besides.
const FOR_TESTS: [(&str, &[&str]); 2] =
    [("vbar-server", &["vbar-client"]), ("vbar-simulator", &["vbar-server"])];

/// Modules of the server, which of each other they may use, and which crates of ours.
const SERVER: [(&str, &[&str], &[&str]); 13] = [
    ("telemetry", &[], &[]),
    ("store", &[], &[]),
    ("access", &["telemetry"], &[]),
    ("recording", &["telemetry"], &[]),
    ("compute", &["access", "telemetry"], &["vbar_guidance"]),
    ("wire", &[], &["vbar_proto", "vbar_guidance"]),
    ("config", &["access", "recording", "store", "wire"], &[]),
    ("offline", &["wire"], &["vbar_proto"]),
    ("service", &["access", "config", "telemetry", "store", "compute", "wire"], &["vbar_guidance"]),
    (
        "transport",
        &["access", "config", "recording", "telemetry", "service", "wire"],
        &["vbar_proto"],
    ),
    (
        "node",
        &[
            "access",
            "config",
            "recording",
            "telemetry",
            "store",
            "compute",
            "wire",
            "service",
            "transport",
        ],
        &[],
    ),
    // Only where targets are fuzzed.
    (
        "fuzzing",
        &[
            "access",
            "config",
            "missions",
            "offline",
            "recording",
            "service",
            "store",
            "transport",
            "wire",
        ],
        &["vbar_proto", "vbar_guidance"],
    ),
    // Only in tests and where targets are fuzzed.
    ("missions", &[], &["vbar_proto"]),
];

/// Modules that the server's own tests share with those over sockets.
const ONLY_IN_TESTS: [&str; 2] = ["missions", "seeds"];

/// Only the named folders stand at the root.
pub fn top_level(tree: &Tree) -> Vec<String> {
    let unknown = tree.folders.iter().filter(|f| !FOLDERS.contains(&f.as_str()));
    unknown.map(|f| format!("{f}/: no such room in ARCHITECTURE.md")).collect()
}

/// Every manifest depends only on crates below it.
pub fn crate_arrows(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    for (path, text) in tree.below("", "toml") {
        let Some(folder) = path.strip_suffix("/Cargo.toml") else { continue };
        let manifest: Table = match toml::from_str(text) {
            Ok(manifest) => manifest,
            Err(fault) => {
                faults.push(format!("{path}: {fault}"));
                continue;
            }
        };
        let Some((_, name, allowed)) = CRATES.iter().find(|(f, _, _)| *f == folder) else {
            faults.push(format!("{path}: a crate without a place in ARCHITECTURE.md"));
            continue;
        };
        let for_tests = FOR_TESTS.iter().find(|(n, _)| n == name).map_or(&[][..], |(_, a)| a);
        for (kind, dependency) in own_dependencies(&manifest) {
            let known = allowed.contains(&dependency.as_str())
                || kind == "dev-dependencies" && for_tests.contains(&dependency.as_str());
            if !known {
                faults.push(format!("{path}: {name} must not know {dependency} ({kind})"));
            }
        }
    }
    faults
}

/// `(kind, crate)` for each of our crates that a manifest depends on.
fn own_dependencies(manifest: &Table) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut tables = vec![manifest];
    let targets = manifest.get("target").and_then(Value::as_table);
    tables.extend(targets.into_iter().flat_map(Table::values).filter_map(Value::as_table));
    for table in tables {
        for kind in ["dependencies", "dev-dependencies", "build-dependencies"] {
            let Some(dependencies) = table.get(kind).and_then(Value::as_table) else { continue };
            for (name, how) in dependencies {
                // A dependency can be renamed; what counts is the crate behind the name.
                let package = how.get("package").and_then(Value::as_str).unwrap_or(name);
                if package.starts_with("vbar") {
                    found.push((kind.to_owned(), package.to_owned()));
                }
            }
        }
    }
    found
}

/// A module of `guidance` uses lower floors only. The floors are those of the table in
/// `guidance/src/lib.rs`.
pub fn guidance_floors(tree: &Tree) -> Vec<String> {
    const ROOT: &str = "guidance/src/lib.rs";
    let Some(front) = tree.text(ROOT) else { return vec![format!("{ROOT}: not there")] };
    let floors = floors_of(front);
    let mut faults = Vec::new();
    let front_door = match paths::used(ROOT, front) {
        Ok(used) => re_exports(&used),
        Err(fault) => return vec![fault],
    };
    for (path, text) in tree.below("guidance/src", "rs").filter(|(path, _)| *path != ROOT) {
        let modules = modules_of(path);
        if !floors.contains_key(&modules[0]) {
            faults.push(format!("{path}: module {} stands on no floor of {ROOT}", modules[0]));
            continue;
        }
        match paths::used(path, text) {
            Err(fault) => faults.push(fault),
            Ok(used) => {
                for used in used {
                    let target = resolved(&used, &front_door);
                    faults.extend(floor_fault(tree, path, &used, &target, &floors));
                }
            }
        }
    }
    faults
}

/// `| 3 | [`mission`], [`reach`] |` puts two modules on floor 3.
fn floors_of(front: &str) -> BTreeMap<String, u32> {
    let mut floors = BTreeMap::new();
    for line in front.lines().filter_map(|line| line.strip_prefix("//! | ")) {
        let Some((floor, modules)) = line.split_once(" | ") else { continue };
        let Ok(floor) = floor.trim().parse::<u32>() else { continue };
        for module in modules.split('`').skip(1).step_by(2) {
            floors.insert(module.to_owned(), floor);
        }
    }
    floors
}

/// Names that the front door hands out, with the module each comes from.
fn re_exports(front: &[Used]) -> BTreeMap<String, Vec<String>> {
    let named = front.iter().filter(|used| used.segments.len() > 1);
    named
        .map(|used| {
            let start = usize::from(used.segments[0] == "crate");
            let last = used.segments.last().cloned().unwrap_or_default();
            (last, used.segments[start..].to_vec())
        })
        .collect()
}

/// Path without `crate`, seen through the front door; empty for another crate's.
fn resolved(used: &Used, front_door: &BTreeMap<String, Vec<String>>) -> Vec<String> {
    match used.segments.split_first() {
        Some((first, rest)) if first == "crate" => match rest.first() {
            Some(name) => front_door.get(name).cloned().unwrap_or_else(|| rest.to_vec()),
            None => Vec::new(),
        },
        _ => Vec::new(),
    }
}

fn floor_fault(
    tree: &Tree,
    path: &str,
    used: &Used,
    target: &[String],
    floors: &BTreeMap<String, u32>,
) -> Option<String> {
    let (top, line) = (target.first()?, used.line);
    let modules = modules_of(path);
    let own = floors.get(&modules[0])?;
    if *top == modules[0] {
        // Methods never import each other; what two of them need goes one floor down.
        let (from, to) = (modules.get(1)?, target.get(1)?);
        let method = tree.has_folder(&format!("guidance/src/control/{to}"));
        return (top == "control" && from != to && method)
            .then(|| format!("{path}:{line}: {from} must not know its neighbour {to}"));
    }
    match floors.get(top) {
        None => Some(format!("{path}:{line}: crate::{top} stands on no floor")),
        Some(floor) if floor < own => None,
        Some(floor) => Some(format!(
            "{path}:{line}: {} (floor {own}) must not know {top} (floor {floor})",
            modules[0]
        )),
    }
}

/// Modules are written in lower case, types are not.
fn is_module(name: &str) -> bool {
    name.chars().next().is_some_and(char::is_lowercase)
}

/// Modules of the server know each other and our crates only as [`SERVER`] says.
pub fn server_arrows(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    for (path, text) in tree.below("server/src", "rs") {
        let modules = modules_of(path);
        // The front door only hands out.
        let Some(module) = modules.first() else { continue };
        let Some((_, inside, outside)) = SERVER.iter().find(|(name, _, _)| name == module) else {
            faults.push(format!("{path}: module {module} has no place in ARCHITECTURE.md"));
            continue;
        };
        let used = match paths::used(path, text) {
            Ok(used) => used,
            Err(fault) => {
                faults.push(fault);
                continue;
            }
        };
        for Used { segments, line, test } in used.iter().filter(|used| !used.segments.is_empty()) {
            let first = segments[0].as_str();
            let wrong = if first == "crate" {
                segments
                    .get(1)
                    .filter(|to| *to != module && is_module(to) && !inside.contains(&to.as_str()))
                    .filter(|to| !ONLY_IN_TESTS.contains(&to.as_str()))
            } else {
                (first.starts_with("vbar_") && !outside.contains(&first) && !test)
                    .then_some(&segments[0])
            };
            if let Some(wrong) = wrong {
                faults.push(format!("{path}:{line}: {module} must not know {wrong}"));
            }
        }
    }
    faults
}
