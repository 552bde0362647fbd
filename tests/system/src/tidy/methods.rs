//! A method has five places, no fewer; one that is not served yet is named as such.

use super::Tree;

/// The one list of methods.
const LIST: &str = "guidance/src/control/mod.rs";

/// Every method of the list has its folder, contract, wire module, golden data and a mission.
pub fn methods(tree: &Tree) -> Vec<String> {
    let Some(text) = tree.text(LIST) else { return vec![format!("{LIST}: not there")] };
    let variants = match variants(text) {
        Ok(variants) => variants,
        Err(fault) => return vec![format!("{LIST}: {fault}")],
    };
    let waiting = waiting(text);
    let mut faults = Vec::new();
    for variant in &variants {
        faults.extend(missing_places(tree, text, variant));
    }
    for (path, _) in tree.below("guidance/src/control", "rs") {
        let inside = path.trim_start_matches("guidance/src/control/");
        let Some((folder, _)) = inside.split_once('/') else { continue };
        let listed = variants.iter().any(|v| snake_case(v) == folder);
        match (listed, waiting.iter().any(|name| name == folder)) {
            (true, false) | (false, true) => {}
            (true, true) => faults.push(format!("{path}: served and not yet served at once")),
            (false, false) => faults
                .push(format!("{path}: a folder of control/ that is not in the list of methods")),
        }
    }
    for name in &waiting {
        if !tree.has_folder(&format!("guidance/src/control/{name}")) {
            faults.push(format!("{LIST}: `{name}` is not yet served, and not there either"));
        }
    }
    faults
}

fn variants(text: &str) -> Result<Vec<String>, String> {
    let file = syn::parse_file(text).map_err(|fault| fault.to_string())?;
    let list = file.items.iter().find_map(|item| match item {
        syn::Item::Enum(list) if list.ident == "Method" => Some(list),
        _ => None,
    });
    let list = list.ok_or("no `enum Method`, the one list of methods")?;
    Ok(list.variants.iter().map(|variant| variant.ident.to_string()).collect())
}

/// Names in `NOT_YET_SERVED`: methods whose other places are to come.
fn waiting(text: &str) -> Vec<String> {
    let Ok(file) = syn::parse_file(text) else { return Vec::new() };
    let list = file.items.iter().find_map(|item| match item {
        syn::Item::Const(list) if list.ident == "NOT_YET_SERVED" => Some(&*list.expr),
        _ => None,
    });
    let Some(syn::Expr::Array(array)) = list else { return Vec::new() };
    let names = array.elems.iter().filter_map(|element| match element {
        syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Str(name), .. }) => Some(name.value()),
        _ => None,
    });
    names.collect()
}

fn missing_places(tree: &Tree, list: &str, variant: &str) -> Vec<String> {
    let name = snake_case(variant);
    let contract = format!("proto/vbar/v1/{name}.proto");
    let arm = format!("{variant}Problem {name} =");
    let service = tree.text("proto/vbar/v1/service.proto").unwrap_or_default();
    let wire = [format!("server/src/wire/{name}.rs"), format!("server/src/wire/{name}/mod.rs")];
    let has_file = |path: &String| tree.files.contains_key(path);
    let places = [
        (
            tree.has_folder(&format!("guidance/src/control/{name}")),
            format!("folder guidance/src/control/{name}/"),
        ),
        (list.contains(&format!("Self::{variant} => \"{name}\"")), format!("its name in {LIST}")),
        (has_file(&contract), contract.clone()),
        (service.contains(&arm), format!("oneof arm `{arm}` in proto/vbar/v1/service.proto")),
        (wire.iter().any(has_file), wire[0].clone()),
        (
            tree.has_folder(&format!("tests/golden/{name}")),
            format!("golden data tests/golden/{name}/"),
        ),
        (has_mission(tree, &name), format!("a mission for {name} in simulator/missions/")),
    ];
    let missing = places.into_iter().filter(|(there, _)| !there);
    missing.map(|(_, place)| format!("method {variant} lacks {place}")).collect()
}

fn has_mission(tree: &Tree, name: &str) -> bool {
    tree.below("simulator/missions", "json").any(|(_, text)| {
        let Ok(mission) = serde_json::from_str::<serde_json::Value>(text) else { return false };
        let problem = &mission["problem"];
        problem.get(name).is_some() || problem.get(lower_camel(name)).is_some()
    })
}

fn snake_case(variant: &str) -> String {
    let mut name = String::new();
    for letter in variant.chars() {
        if letter.is_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.extend(letter.to_lowercase());
    }
    name
}

/// As canonical JSON names a field.
fn lower_camel(name: &str) -> String {
    let mut parts = name.split('_');
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |mut camel, part| {
        let mut letters = part.chars();
        camel.extend(letters.next().into_iter().flat_map(char::to_uppercase));
        camel.push_str(letters.as_str());
        camel
    })
}
