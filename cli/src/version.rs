//! `vbar version`: what a program was built from.

use clap::{Args, ValueEnum};
use vbar_client::{Client, Options, v1::Build};
use vbar_server::BUILD;

use crate::{failure::Failure, json, session::CredentialArguments};

/// Two programs with the same sha256 answer the same request with the same bytes.
#[derive(Debug, Args)]
pub(crate) struct VersionArguments {
    /// URL of a node to ask instead
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    #[command(flatten)]
    credentials: CredentialArguments,
    /// How to print it
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    format: VersionFormat,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum VersionFormat {
    /// For people
    Text,
    /// As in the answer to GetServerInfo
    Json,
}

pub(crate) async fn version(arguments: VersionArguments) -> Result<(), Failure> {
    let build = match &arguments.server {
        None => BUILD.message(),
        Some(url) => {
            let credentials = arguments.credentials.read()?;
            let client =
                Client::connect(url, Options { credentials, ..Options::default() }).await?;
            let info = client.server_info().await?;
            let version = info.build_version;
            // A node from before it could say more.
            info.build.unwrap_or_else(|| Build { version, ..Build::default() })
        }
    };
    match arguments.format {
        VersionFormat::Json => json::print(&json::render(&build)?),
        VersionFormat::Text => json::print(&text(&build)),
    }
}

fn text(build: &Build) -> String {
    let Build { version, commit, rustc, target, profile, features, sha256 } = build;
    let mut lines = vec![format!("vbar {version}")];
    for (name, value) in [
        ("commit", commit),
        ("rustc", rustc),
        ("target", target),
        ("profile", profile),
        ("features", &features.join(",")),
        ("sha256", sha256),
    ] {
        if !value.is_empty() {
            lines.push(format!("{name}: {value}"));
        }
    }
    lines.join("\n")
}
