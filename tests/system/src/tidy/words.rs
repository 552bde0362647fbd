//! Names that say nothing, and work left open.

use super::{Tree, paths::modules_of};

/// Modules that collect what has no name.
const EMPTY_MODULES: [&str; 7] = ["common", "helper", "helpers", "misc", "shared", "util", "utils"];

/// Ends of type names that say nothing.
const EMPTY_TYPES: [&str; 3] = ["Manager", "Helper", "Utils"];

/// Marks of open work. Written in two parts, so that this file does not carry them.
const OPEN: [&str; 5] = [
    concat!("FIX", "ME"),
    concat!("TO", "DO"),
    concat!("XX", "X"),
    concat!("to", "do!("),
    concat!("unimple", "mented!("),
];

/// A test that is switched off promises nothing.
const SWITCHED_OFF: &str = concat!("#[ig", "nore");

/// No empty names, no open work, no test switched off.
pub fn words(tree: &Tree) -> Vec<String> {
    let mut faults = Vec::new();
    for (path, text) in tree.below("", "rs") {
        for module in modules_of(path) {
            if EMPTY_MODULES.contains(&module.as_str()) {
                faults.push(format!("{path}: {module} is not a name from the field"));
            }
        }
        for (line, content) in text.lines().enumerate() {
            let line = line + 1;
            if content.contains(SWITCHED_OFF) {
                faults.push(format!("{path}:{line}: a test that is switched off"));
            }
            if let Some(name) = empty_name(content) {
                faults.push(format!("{path}:{line}: {name} says nothing"));
            }
        }
    }
    for ending in ["rs", "proto", "md", "py", "toml", "yml", "yaml"] {
        for (path, text) in tree.below("", ending) {
            for (line, content) in text.lines().enumerate() {
                if OPEN.iter().any(|mark| has_word(content, mark)) {
                    faults.push(format!("{path}:{}: work left open", line + 1));
                }
            }
        }
    }
    faults
}

/// The name in `struct ThingManager` or `mod utils`.
fn empty_name(line: &str) -> Option<&str> {
    let words: Vec<&str> =
        line.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty()).collect();
    let declared = words.windows(2).find_map(|pair| match pair[0] {
        "struct" | "enum" | "trait" | "type" => {
            EMPTY_TYPES.iter().any(|end| pair[1].ends_with(end)).then_some(pair[1])
        }
        "mod" => EMPTY_MODULES.contains(&pair[1]).then_some(pair[1]),
        _ => None,
    });
    declared.filter(|_| !line.trim_start().starts_with("//"))
}

/// `mark` as a word of its own.
fn has_word(line: &str, mark: &str) -> bool {
    line.match_indices(mark).any(|(start, _)| {
        let before = line[..start].chars().next_back();
        let after = line[start + mark.len()..].chars().next();
        let letter = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
        !letter(before) && (mark.ends_with('(') || !letter(after))
    })
}
