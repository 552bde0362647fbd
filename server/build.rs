//! Tells the program what it is built from. Asks nobody: a commit is known if it is given.

use std::{
    env, error, fs,
    path::{Path, PathBuf},
    process::Command,
};

use sha2::{Digest, Sha256};

/// Everything of ours that decides what a node answers, from this folder.
const SOURCES: [&str; 9] = [
    "../Cargo.lock",
    "../Cargo.toml",
    "../guidance/Cargo.toml",
    "../guidance/src",
    "../proto/google",
    "../proto/src",
    "../proto/vbar",
    "Cargo.toml",
    "src",
];
const COMMIT: &str = "VBAR_BUILD_COMMIT";

fn main() -> Result<(), Box<dyn error::Error>> {
    let variable = |name: &str| env::var(name).unwrap_or_default();
    println!("cargo:rerun-if-env-changed={COMMIT}");
    let commit = variable(COMMIT);
    let is_fit = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    if commit.len() > 64 || !commit.chars().all(is_fit) {
        return Err(
            format!("{COMMIT}: expected up to 64 letters and digits, got {commit:?}").into()
        );
    }
    let version = Command::new(variable("RUSTC")).arg("--version").output()?;
    let rustc = String::from_utf8(version.stdout)?.trim().to_owned();
    let features: Vec<String> = env::vars()
        .filter_map(|(name, _)| Some(name.strip_prefix("CARGO_FEATURE_")?.to_ascii_lowercase()))
        .collect();
    let features = features.join(",");
    let mut digest = Sha256::new();
    for part in [
        &rustc,
        &features,
        &variable("TARGET"),
        &variable("PROFILE"),
        &variable("OPT_LEVEL"),
        &variable("CARGO_ENCODED_RUSTFLAGS"),
    ] {
        add(&mut digest, part.as_bytes());
    }
    for source in SOURCES {
        println!("cargo:rerun-if-changed={source}");
        for file in files(Path::new(source))? {
            add(&mut digest, file.to_string_lossy().as_bytes());
            add(&mut digest, &fs::read(&file)?);
        }
    }
    let sha256: String = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    for (name, value) in [
        ("COMMIT", &commit),
        ("RUSTC", &rustc),
        ("TARGET", &variable("TARGET")),
        ("PROFILE", &variable("PROFILE")),
        ("FEATURES", &features),
        ("SHA256", &sha256),
    ] {
        println!("cargo:rustc-env=VBAR_BUILT_{name}={value}");
    }
    Ok(())
}

/// With its length before it, so that no two lists of parts look alike.
fn add(digest: &mut Sha256, part: &[u8]) {
    digest.update((part.len() as u64).to_le_bytes());
    digest.update(part);
}

/// The file, or all files below the folder, in the order of their names.
fn files(path: &Path) -> std::io::Result<Vec<PathBuf>> {
    if path.is_file() {
        return Ok(vec![path.to_owned()]);
    }
    let mut entries = fs::read_dir(path)?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<Result<Vec<_>, _>>()?;
    entries.sort();
    let mut found = Vec::new();
    for entry in entries {
        found.extend(files(&entry)?);
    }
    Ok(found)
}
