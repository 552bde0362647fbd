//! Nothing of ours is `unsafe`.

use toml::{Table, Value};

use super::Tree;

/// Every manifest forbids `unsafe`, itself or with the lints of the workspace. What is forbidden no
/// line of source can allow again: the compiler refuses it.
pub fn unsafe_forbidden(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    for (path, text) in tree.below("", "toml") {
        if path.rsplit('/').next() != Some("Cargo.toml") {
            continue;
        }
        let Ok(manifest) = toml::from_str::<Table>(text) else {
            faults.push(format!("{path}: it cannot be read"));
            continue;
        };
        let inherits = at(&manifest, &["lints", "workspace"]) == Some(&Value::Boolean(true));
        let of_workspace = ["workspace", "lints", "rust", "unsafe_code"];
        let is_root = manifest.contains_key("workspace") && !manifest.contains_key("package");
        let own = if is_root { &of_workspace[..] } else { &of_workspace[1..] };
        let forbids = at(&manifest, own).and_then(Value::as_str) == Some("forbid");
        if !forbids && (is_root || !inherits) {
            faults.push(format!(
                "{path}: `unsafe` must be forbidden: {} = \"forbid\"",
                own.join(".")
            ));
        }
    }
    faults
}

fn at<'a>(table: &'a Table, path: &[&str]) -> Option<&'a Value> {
    let (first, rest) = path.split_first()?;
    let value = table.get(*first)?;
    if rest.is_empty() { Some(value) } else { at(value.as_table()?, rest) }
}
