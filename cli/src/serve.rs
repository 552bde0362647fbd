//! `vbar serve` and `vbar worker`.

use std::{
    env, fs,
    net::SocketAddr,
    path::{Path, PathBuf},
};

use clap::{Args, ValueEnum};
use tokio::signal::unix::{Signal, SignalKind, signal};
use vbar_server::{Config, ListedSetting, Node, Settings, Sources};

use crate::{failure::Failure, json, session::CREDENTIAL_VARIABLES};

/// Where a node listens unless told otherwise.
const LISTEN_DEFAULT: SocketAddr =
    SocketAddr::V4(std::net::SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 7440));
/// Largest configuration file that is read.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Variables with our prefix that are not settings of a node.
const OTHER_VARIABLES: [&str; 5] =
    ["VBAR_BUILD_COMMIT", "VBAR_CONFIG", "VBAR_LOG", "VBAR_LOG_FORMAT", "VBAR_SERVER"];

/// Settings come from flags, then from environment variables (VBAR_LISTEN, VBAR_COMPUTE_THREADS,
/// ...), then from the file, then from defaults.
#[derive(Debug, Args)]
pub(crate) struct ServeArguments {
    /// Where to listen; port 0 takes any free port [default: 127.0.0.1:7440]
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// Listen beyond this machine although nobody is asked who they are, or they say so in clear
    #[arg(long)]
    allow_insecure_listen: bool,
    /// Where artifacts are kept; without it they are kept in memory and end with the node
    #[arg(long, value_name = "DIRECTORY")]
    data_dir: Option<PathBuf>,
    /// Keep everything on NATS JetStream, with other nodes and workers [several with commas between]
    #[arg(long, value_name = "nats://HOST:PORT", conflicts_with = "data_dir")]
    store: Option<String>,
    /// Computations at once [default: one a processor]
    #[arg(long, value_name = "N")]
    compute_threads: Option<usize>,
    /// TOML file of settings, the same names in lower case without VBAR_
    #[arg(long, value_name = "FILE", env = "VBAR_CONFIG")]
    config: Option<PathBuf>,
    /// Write down every call and its answer, to be asked again by `vbar replay`; headers and
    /// tokens are not written
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Check the configuration, name every fault, and end
    #[arg(long)]
    check_config: bool,
    /// Print every setting in force and where it was said, and end
    #[arg(long, conflicts_with = "check_config")]
    print_config: bool,
    /// How to print it
    #[arg(long, value_name = "FORMAT", default_value = "text", requires = "print_config")]
    format: ConfigFormat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ConfigFormat {
    /// As a file of settings, with where each was said behind it
    Text,
    /// As a list of objects in JSON
    Json,
}

/// Runs a node until it is told to stop, then lets it finish what it began.
pub(crate) async fn serve(arguments: ServeArguments) -> Result<(), Failure> {
    run(arguments, Role::Node).await
}

/// Does parts of jobs until it is told to stop, then hands back what it is at.
pub(crate) async fn work(arguments: ServeArguments) -> Result<(), Failure> {
    run(arguments, Role::Worker).await
}

/// What to start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Node,
    Worker,
}

async fn run(arguments: ServeArguments, role: Role) -> Result<(), Failure> {
    let (config, sources) = configuration(&arguments, role)?;
    if arguments.check_config {
        return json::print("the configuration has no faults");
    }
    if arguments.print_config {
        let list = sources.list(&config);
        return json::print(&match arguments.format {
            ConfigFormat::Text => list.iter().map(line).collect::<Vec<_>>().join("\n"),
            ConfigFormat::Json => listed(&list)?,
        });
    }
    let (mut terminate, mut interrupt) =
        (on(SignalKind::terminate())?, on(SignalKind::interrupt())?);
    let scheme = if config.access.is_encrypted() { "https" } else { "http" };
    let started = match role {
        Role::Node => Node::start(config).await,
        Role::Worker => Node::start_worker(config).await,
    };
    let node = started
        .map_err(|fault| Failure::unavailable(format!("the node did not start: {fault}")))?;
    json::print(&format!("listening on {scheme}://{}", node.local_address()))?;
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    tracing::info!("stopping; a second signal stops at once");
    tokio::select! {
        () = node.shutdown() => Ok(()),
        _ = terminate.recv() => Err(Failure::ours("stopped before the last call was answered")),
        _ = interrupt.recv() => Err(Failure::ours("stopped before the last call was answered")),
    }
}

/// A setting as a line of a file.
fn line(setting: &ListedSetting) -> String {
    let ListedSetting { name, value, source } = setting;
    match value {
        // Numbers, booleans and plain text are written alike in TOML and JSON.
        Some(value) => format!("{name} = {value}  # {source}"),
        None => format!("# {name} is not set"),
    }
}

fn listed(list: &[ListedSetting]) -> Result<String, Failure> {
    let list: Vec<_> = list
        .iter()
        .map(|setting| {
            let ListedSetting { name, value, source } = setting;
            serde_json::json!({ "name": name, "value": value, "source": source })
        })
        .collect();
    serde_json::to_string_pretty(&list).map_err(|fault| Failure::ours(fault.to_string()))
}

/// The configuration and where it comes from, or every fault in it.
fn configuration(arguments: &ServeArguments, role: Role) -> Result<(Config, Sources), Failure> {
    let flags = Settings {
        listen: arguments.listen,
        allow_insecure_listen: arguments.allow_insecure_listen.then_some(true),
        compute_threads: arguments.compute_threads,
        store_directory: arguments.data_dir.clone(),
        store: arguments.store.clone(),
        record_file: arguments.record.clone(),
        ..Settings::default()
    };
    let mut faults = Vec::new();
    let mut sources = Sources { flags, ..Sources::default() };
    let others = [&OTHER_VARIABLES[..], &CREDENTIAL_VARIABLES].concat();
    match Settings::from_environment(env::vars(), &others) {
        Ok(environment) => sources.environment = environment,
        Err(fault) => faults.push(fault.to_string()),
    }
    if let Some(path) = arguments.config.as_deref() {
        match from_file(path) {
            Ok((file, text)) => {
                sources.file = file;
                sources.file_text = Some((path.display().to_string(), text));
            }
            Err(fault) => faults.push(fault),
        }
    }
    match sources.apply(Config { listen: LISTEN_DEFAULT, ..Config::default() }) {
        Ok(config) => {
            faults.extend(config.faults().iter().map(ToString::to_string));
            if role == Role::Worker {
                faults.extend(config.worker_faults().iter().map(ToString::to_string));
            }
            if faults.is_empty() {
                return Ok((config, sources));
            }
        }
        Err(fault) => faults.push(fault.to_string()),
    }
    let list = faults.join("\n  ");
    Err(Failure::usage(format!("the configuration cannot be used:\n  {list}")))
}

/// What a file says, and its text.
fn from_file(path: &Path) -> Result<(Settings, String), String> {
    let named = |fault: String| format!("{}: {fault}", path.display());
    let size = fs::metadata(path).map_err(|fault| named(fault.to_string()))?.len();
    if size > FILE_BYTES_MAX {
        return Err(named(format!("{size} bytes; at most {FILE_BYTES_MAX} are read")));
    }
    let text = fs::read_to_string(path).map_err(|fault| named(fault.to_string()))?;
    let settings = Settings::from_toml(&text).map_err(|fault| named(fault.to_string()))?;
    Ok((settings, text))
}

fn on(kind: SignalKind) -> Result<Signal, Failure> {
    signal(kind).map_err(|fault| Failure::ours(format!("cannot hear signals: {fault}")))
}
