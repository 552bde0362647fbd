//! The rules of the house hold, and the rules themselves find what they should.

use std::path::Path;

use vbar_system_tests::tidy::{
    RULES, Tree, citations, crate_arrows, fixed_order_sums, guidance_floors, methods, purity,
    server_arrows, top_level, unsafe_forbidden, words,
};

#[test]
fn tidy() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let tree = Tree::read(&root).expect("the project can be read");
    assert!(tree.files.len() > 20, "this is not the project: {:?}", tree.files.keys());
    let mut report = String::new();
    for (name, rule) in RULES {
        for fault in rule(&tree) {
            report.push_str(&format!("\n  {name}: {fault}"));
        }
    }
    assert!(report.is_empty(), "{report}");
}

/// `rule` finds exactly one fault in `files`, and its text contains every one of `parts`.
fn finds(rule: fn(&Tree) -> Vec<String>, files: &[(&str, &str)], parts: &[&str]) {
    let faults = rule(&Tree::of(files));
    assert_eq!(faults.len(), 1, "{faults:?}");
    for part in parts {
        assert!(faults[0].contains(part), "{part:?} not in {faults:?}");
    }
}

fn accepts(rule: fn(&Tree) -> Vec<String>, files: &[(&str, &str)]) {
    assert_eq!(rule(&Tree::of(files)), Vec::<String>::new());
}

const FRONT: (&str, &str) = (
    "guidance/src/lib.rs",
    "//! | floor | modules |\n//! | 5 | front |\n//! | 4 | [`control`] |\n\
     //! | 3 | [`mission`], [`reach`] |\n//! | 1 | [`sets`] |\n\
     //! - **\\[Smith1999\\]**\n//! As [Smith1999].\n\
     pub mod control; pub use control::Failure;",
);

#[test]
fn top_level_folder_without_a_room_is_found() {
    accepts(top_level, &[("proto/a.proto", ""), (".ci/run", "")]);
    finds(top_level, &[("scripts/x.sh", "")], &["scripts/"]);
}

#[test]
fn crate_arrow_upwards_is_found() {
    let client = |dependency: &str| format!("[package]\nname='c'\n{dependency}");
    accepts(
        crate_arrows,
        &[("client/Cargo.toml", &client("[dependencies]\nvbar-proto.workspace=true"))],
    );
    for dependency in [
        "[dependencies]\nvbar-server.workspace=true",
        "[dev-dependencies]\nvbar-server.workspace=true",
        "[target.'cfg(unix)'.dependencies]\nvbar-server.workspace=true",
        "[dependencies]\nx = { package = 'vbar-server', path = '../server' }",
    ] {
        let files = [("client/Cargo.toml", &*client(dependency))];
        finds(crate_arrows, &files, &["client/Cargo.toml", "vbar-server"]);
    }
    let simulator = "[dependencies]\nvbar-guidance.workspace=true";
    finds(crate_arrows, &[("simulator/Cargo.toml", simulator)], &["vbar-guidance"]);
    finds(crate_arrows, &[("extra/Cargo.toml", "")], &["without a place"]);
}

#[test]
fn guidance_floor_crossed_upwards_is_found() {
    let from_sets = |text| [FRONT, ("guidance/src/sets/zonotope.rs", text)];
    accepts(guidance_floors, &from_sets("use super::Polytope; use nalgebra::DMatrix;"));
    for text in [
        "use crate::reach::Tube;",
        "use crate::{reach::Tube};",
        "use super::super::reach::Tube;",
        "fn f() { crate::reach::tube(); }",
        "fn f() { assert!(crate::reach::tube()); }",
        "mod tests { use crate::reach::Tube; }",
    ] {
        finds(guidance_floors, &from_sets(text), &["zonotope.rs:1", "sets", "reach"]);
    }
    // A name that the front door hands out belongs to the module it comes from.
    finds(guidance_floors, &from_sets("use crate::Failure;"), &["sets", "control"]);
    finds(guidance_floors, &from_sets("use crate::nowhere::X;"), &["no floor"]);
    finds(guidance_floors, &[FRONT, ("guidance/src/new.rs", "")], &["new", "no floor"]);
}

#[test]
fn guidance_neighbours_on_a_floor_are_found() {
    let files = [FRONT, ("guidance/src/mission/cone.rs", "use crate::reach::Tube;")];
    finds(guidance_floors, &files, &["mission", "reach"]);
    let method = "guidance/src/control/first/mod.rs";
    let other = ("guidance/src/control/second/mod.rs", "");
    for text in ["use crate::control::second::X;", "use super::second::X;"] {
        finds(guidance_floors, &[FRONT, other, (method, text)], &["first", "second"]);
    }
    let allowed = "use crate::control::{Failure, verdict::Claim}; use super::Method;";
    accepts(guidance_floors, &[FRONT, other, (method, allowed)]);
}

#[test]
fn server_arrow_upwards_is_found() {
    accepts(server_arrows, &[("server/src/wire/mod.rs", "use vbar_guidance::X; use super::Y;")]);
    finds(
        server_arrows,
        &[("server/src/wire/mod.rs", "use crate::service::X;")],
        &["wire", "service"],
    );
    finds(
        server_arrows,
        &[("server/src/transport/grpc.rs", "use vbar_guidance::X;")],
        &["transport", "vbar_guidance"],
    );
    finds(server_arrows, &[("server/src/store/a.rs", "use vbar_proto::X;")], &["store"]);
    finds(server_arrows, &[("server/src/extra.rs", "")], &["extra", "no place"]);
}

#[test]
fn method_without_one_of_its_places_is_found() {
    const PLACES: [(&str, &str); 6] = [
        (
            "guidance/src/control/mod.rs",
            "enum Method { FarAway } fn f() { match self { Self::FarAway => \"far_away\" } }",
        ),
        ("guidance/src/control/far_away/mod.rs", ""),
        ("proto/vbar/v1/far_away.proto", ""),
        ("proto/vbar/v1/service.proto", "FarAwayProblem far_away = 7;"),
        ("server/src/wire/far_away.rs", ""),
        ("tests/golden/far_away/case.json", ""),
    ];
    const MISSION: (&str, &str) = ("simulator/missions/a.json", r#"{"problem": {"farAway": {}}}"#);
    let all: Vec<_> = PLACES.into_iter().chain([MISSION]).collect();
    accepts(methods, &all);
    for missing in 1..all.len() {
        let mut files = all.clone();
        let (path, _) = files.remove(missing);
        let folder = path.rsplit_once('/').unwrap().0;
        finds(methods, &files, &["FarAway lacks", folder]);
    }
    let mut files = all;
    files.push(("guidance/src/control/unlisted/mod.rs", ""));
    finds(methods, &files, &["unlisted"]);
}

#[test]
fn method_not_yet_served_is_there_and_not_served() {
    const LIST: &str = "guidance/src/control/mod.rs";
    const FOLDER: (&str, &str) = ("guidance/src/control/to_come/mod.rs", "");
    const WAITING: &str = "enum Method {} const NOT_YET_SERVED: [&str; 1] = [\"to_come\"];";
    accepts(methods, &[(LIST, WAITING), FOLDER]);
    finds(methods, &[(LIST, WAITING)], &["to_come", "not there either"]);
    let both = WAITING.replace("{}", "{ ToCome }");
    let faults = methods(&Tree::of(&[(LIST, &both), FOLDER]));
    assert!(faults.iter().any(|fault| fault.contains("at once")), "{faults:?}");
}

#[test]
fn citation_unlisted_or_unused_is_found() {
    accepts(citations, &[FRONT]);
    let cites = ("guidance/src/sets/mod.rs", "/// Outer. [Jones2001b, eq. 3]");
    finds(citations, &[FRONT, cites], &["sets/mod.rs:1", "Jones2001b"]);
    let unused = ("guidance/src/lib.rs", "//! - **\\[Smith1999\\]** Smith, 1999.");
    finds(citations, &[unused], &["Smith1999", "nowhere"]);
}

#[test]
fn impure_mathematics_is_found() {
    let manifest = ("guidance/Cargo.toml", "[dependencies]\nlibm.workspace = true");
    let with = |text| [manifest, ("guidance/src/sets/mod.rs", text)];
    accepts(purity, &with("use std::fmt; #[cfg(test)] mod tests { use std::fs; }"));
    accepts(purity, &with("fn f(x: f64) -> f64 { libm::tan(x).abs().sqrt() } // x.tan()"));
    for text in [
        "use std::time::Instant;",
        "use std::{fmt, fs};",
        "fn f() { std::env::var(\"X\"); }",
        "fn f() { println!(\"{:?}\", std::thread::current()); }",
        "use std::collections::{BTreeMap, HashMap};",
        "use serde::Serialize;",
        "fn f(x: f64) -> f64 { x.tan() }",
        "fn f(x: f64) -> f64 { Some(x).map_or(0.0, f64::exp) }",
    ] {
        finds(purity, &with(text), &["sets/mod.rs:1", "pure"]);
    }
    let manifest = ("guidance/Cargo.toml", "[dependencies]\ntokio.workspace = true");
    finds(purity, &[manifest], &["tokio"]);
}

#[test]
fn nalgebra_with_std_is_found() {
    let lock = ("Cargo.lock", "name = \"nalgebra\"");
    let manifest = |text| [lock, ("simulator/Cargo.toml", text)];
    accepts(fixed_order_sums, &manifest("[dependencies]\nnalgebra.workspace = true"));
    for text in [
        "[dependencies]\nnalgebra = '0.35'",
        "[dev-dependencies]\nnalgebra = { workspace = true, features = ['std'] }",
        "[workspace.dependencies]\nnalgebra = { version = '0.35', default-features = true }",
    ] {
        finds(fixed_order_sums, &manifest(text), &["nalgebra"]);
    }
    finds(fixed_order_sums, &[("Cargo.lock", "name = \"matrixmultiply\"")], &["matrixmultiply"]);
}

#[test]
fn unsafe_code_allowed_is_found() {
    let root = "[workspace]\nmembers=[]\n[workspace.lints.rust]\nunsafe_code = 'forbid'";
    let inherits = "[package]\nname='x'\n[lints]\nworkspace = true";
    let own = "[package]\nname='x'\n[workspace]\n[lints.rust]\nunsafe_code = 'forbid'";
    accepts(
        unsafe_forbidden,
        &[("Cargo.toml", root), ("cli/Cargo.toml", inherits), ("tests/fuzz/Cargo.toml", own)],
    );
    for (path, manifest) in [
        ("Cargo.toml", root.replace("forbid", "deny")),
        ("Cargo.toml", "[workspace]\nmembers=[]\n[lints]\nworkspace = true".to_owned()),
        ("cli/Cargo.toml", inherits.replace("true", "false")),
        ("cli/Cargo.toml", "[package]\nname='x'".to_owned()),
        ("tests/fuzz/Cargo.toml", own.replace("forbid", "warn")),
    ] {
        finds(unsafe_forbidden, &[(path, &*manifest)], &[path, "unsafe"]);
    }
}

#[test]
fn empty_words_and_open_work_are_found() {
    accepts(words, &[("cli/src/serve.rs", "struct Node; // managers may call")]);
    finds(words, &[("cli/src/utils.rs", "")], &["utils"]);
    finds(words, &[("cli/src/a.rs", concat!("mod hel", "pers {}"))], &["helpers says"]);
    finds(words, &[("cli/src/a.rs", concat!("pub struct JobMan", "ager;"))], &["JobManager says"]);
    finds(words, &[("cli/src/a.rs", concat!("// FIX", "ME later"))], &["open"]);
    finds(words, &[("README.md", concat!("TO", "DO"))], &["open"]);
    finds(words, &[("cli/src/a.rs", concat!("#[ig", "nore]"))], &["switched off"]);
}
