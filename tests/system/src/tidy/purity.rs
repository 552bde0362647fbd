//! The mathematics touches nothing but its arguments, and adds in one order everywhere.

use toml::{Table, Value};

use super::{Tree, paths};

/// Paths that reach outside, or whose order of iteration is chance.
const OUTSIDE: [&str; 14] = [
    "std::time",
    "std::fs",
    "std::net",
    "std::thread",
    "std::env",
    "std::process",
    "std::io",
    "std::collections::HashMap",
    "std::collections::HashSet",
    "rand::rng",
    "rand::random",
    "serde",
    "serde_json",
    "tokio",
];

/// Functions whose last bit is the machine's business; `libm` has them in one version for all.
const TRANSCENDENTAL: [&str; 18] = [
    "acos", "asin", "atan", "atan2", "cbrt", "cos", "cosh", "exp", "exp2", "hypot", "ln", "log10",
    "log2", "powf", "sin", "sin_cos", "sinh", "tan",
];

/// Everything `guidance` may depend on.
const GUIDANCE_DEPENDENCIES: [&str; 6] =
    ["clarabel", "libm", "nalgebra", "rand", "rand_chacha", "thiserror"];

/// `guidance` has no clock, file, socket, thread, environment, unseeded chance, serde or async,
/// and no function that the machine's own library would answer.
pub fn purity(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    for (path, text) in tree.below("guidance/src", "rs") {
        faults.extend(machine_functions(path, text));
        match paths::used(path, text) {
            Err(fault) => faults.push(fault),
            Ok(used) => {
                for used in used.into_iter().filter(|used| !used.test) {
                    let written = format!("{}::", used.segments.join("::"));
                    if OUTSIDE.iter().any(|outside| written.starts_with(&format!("{outside}::"))) {
                        let what = written.trim_end_matches(':');
                        faults.push(format!("{path}:{}: {what} in pure code", used.line));
                    }
                }
            }
        }
    }
    faults.extend(foreign_dependencies(tree));
    faults
}

fn machine_functions(path: &str, text: &str) -> Vec<String> {
    let mut faults = Vec::new();
    for (line, content) in text.lines().enumerate() {
        let code = content.split("//").next().unwrap_or_default();
        for name in TRANSCENDENTAL {
            if code.contains(&format!(".{name}(")) || code.contains(&format!("f64::{name}")) {
                let line = line + 1;
                faults.push(format!("{path}:{line}: {name} in pure code must be libm::{name}"));
            }
        }
    }
    faults
}

fn foreign_dependencies(tree: &Tree) -> Vec<String> {
    const MANIFEST: &str = "guidance/Cargo.toml";
    let Some(text) = tree.text(MANIFEST) else { return vec![format!("{MANIFEST}: not there")] };
    let manifest: Table = match toml::from_str(text) {
        Ok(manifest) => manifest,
        Err(fault) => return vec![format!("{MANIFEST}: {fault}")],
    };
    let names = manifest.get("dependencies").and_then(Value::as_table);
    let foreign = names
        .into_iter()
        .flat_map(Table::keys)
        .filter(|name| !GUIDANCE_DEPENDENCIES.contains(&name.as_str()));
    foreign.map(|name| format!("{MANIFEST}: {name} is not for the mathematics")).collect()
}

/// `nalgebra` without `std`, in every manifest: with it comes `matrixmultiply`, whose kernels are
/// chosen at run time, and the same request would give other bytes on another machine.
pub fn fixed_order_sums(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    match tree.text("Cargo.lock") {
        None => faults.push("Cargo.lock: not there".into()),
        Some(lock) if lock.contains("name = \"matrixmultiply\"") => {
            faults.push("Cargo.lock: matrixmultiply is in the build; who asks for it?".into());
        }
        Some(_) => {}
    }
    for (path, text) in tree.below("", "toml") {
        let Ok(manifest) = toml::from_str::<Table>(text) else { continue };
        let workspace = manifest.get("workspace").and_then(|w| w.get("dependencies"));
        let own = ["dependencies", "dev-dependencies"].map(|kind| manifest.get(kind));
        for table in own.into_iter().chain([workspace]).flatten() {
            if table.get("nalgebra").is_some_and(brings_std) {
                faults.push(format!("{path}: nalgebra must be without default features and `std`"));
            }
        }
    }
    faults
}

fn brings_std(dependency: &Value) -> bool {
    let from_workspace = dependency.get("workspace").and_then(Value::as_bool) == Some(true);
    let defaults = dependency.get("default-features").and_then(Value::as_bool);
    let features = dependency.get("features").and_then(Value::as_array);
    let asks = features.is_some_and(|list| list.iter().any(|f| f.as_str() == Some("std")));
    asks || (!from_workspace && defaults != Some(false)) || defaults == Some(true)
}
