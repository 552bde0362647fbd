//! Every formula's source can be found.

use std::collections::BTreeSet;

use super::Tree;

/// Where the keys are explained.
const LIST: &str = "guidance/src/lib.rs";

/// Keys used anywhere are listed in `guidance/src/lib.rs`, and listed keys are used.
pub fn citations(tree: &Tree) -> Vec<String> {
    let Some(front) = tree.text(LIST) else { return vec![format!("{LIST}: not there")] };
    let listed: BTreeSet<&str> =
        front.lines().filter(|line| line.contains("- **\\[")).flat_map(keys).collect();
    let mut used = BTreeSet::new();
    let mut faults = Vec::new();
    for ending in ["rs", "proto", "md", "json"] {
        // The tests of these rules make up keys of their own.
        for (path, text) in tree.below("", ending).filter(|(p, _)| !p.starts_with("tests/system/"))
        {
            for (line, content) in text.lines().enumerate() {
                let listing = path == LIST && content.contains("- **\\[");
                // In code such words are names of ours; sources are cited in comments.
                let prose = match content.split_once("//") {
                    Some((_, comment)) if ending == "rs" => comment,
                    None if ending == "rs" => "",
                    _ => content,
                };
                for key in keys(prose).filter(|_| !listing) {
                    used.insert(key);
                    if !listed.contains(key) {
                        let line = line + 1;
                        faults.push(format!("{path}:{line}: {key} is not listed in {LIST}"));
                    }
                }
            }
        }
    }
    let unused = listed.difference(&used);
    faults.extend(unused.map(|key| format!("{LIST}: {key} is listed and cited nowhere")));
    faults
}

/// Words such as `Quartullo2025a`: a capitalised name, a year, perhaps a letter.
fn keys(line: &str) -> impl Iterator<Item = &str> {
    line.split(|c: char| !c.is_alphanumeric()).filter(|word| is_key(word))
}

fn is_key(word: &str) -> bool {
    let name_end = word.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(word.len());
    let (name, rest) = word.split_at(name_end);
    let digits = rest.chars().take_while(char::is_ascii_digit).count();
    let (year, letter) = rest.split_at(digits);
    name.len() >= 4
        && name.starts_with(|c: char| c.is_ascii_uppercase())
        && name.chars().skip(1).any(|c| c.is_ascii_lowercase())
        && year.len() == 4
        && (year.starts_with("19") || year.starts_with("20"))
        && (letter.is_empty()
            || letter.len() == 1 && letter.starts_with(|c: char| c.is_lowercase()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_names_with_a_year() {
        let line = "[Quartullo2025a, eq. 3; Deaconu2014] JGCD 2025, G008874, Utf8, v2025, Rot90";
        assert_eq!(keys(line).collect::<Vec<_>>(), ["Quartullo2025a", "Deaconu2014"]);
    }
}
