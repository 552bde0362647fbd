//! `vbar serve`.

use std::{
    env, fs,
    net::SocketAddr,
    path::{Path, PathBuf},
};

use clap::Args;
use tokio::signal::unix::{Signal, SignalKind, signal};
use vbar_server::{Config, Node, Settings};

use crate::{failure::Failure, json};

/// Where a node listens unless told otherwise.
const LISTEN_DEFAULT: SocketAddr =
    SocketAddr::V4(std::net::SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 7440));
/// Largest configuration file that is read.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Variables with our prefix that are not settings of a node.
const OTHER_VARIABLES: [&str; 4] = ["VBAR_CONFIG", "VBAR_LOG", "VBAR_LOG_FORMAT", "VBAR_SERVER"];

/// Settings come from flags, then from environment variables (VBAR_LISTEN, VBAR_COMPUTE_THREADS,
/// ...), then from the file, then from defaults.
#[derive(Debug, Args)]
pub(crate) struct ServeArguments {
    /// Where to listen; port 0 takes any free port [default: 127.0.0.1:7440]
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// Listen beyond this machine although nobody is asked who they are
    #[arg(long)]
    allow_insecure_listen: bool,
    /// Where artifacts are kept; without it they are kept in memory and end with the node
    #[arg(long, value_name = "DIRECTORY")]
    data_dir: Option<PathBuf>,
    /// Computations at once [default: one a processor]
    #[arg(long, value_name = "N")]
    compute_threads: Option<usize>,
    /// TOML file of settings, the same names in lower case without VBAR_
    #[arg(long, value_name = "FILE", env = "VBAR_CONFIG")]
    config: Option<PathBuf>,
    /// Check the configuration, name every fault, and end
    #[arg(long)]
    check_config: bool,
}

/// Runs a node until it is told to stop, then lets it finish what it began.
pub(crate) async fn serve(arguments: ServeArguments) -> Result<(), Failure> {
    let config = configuration(&arguments)?;
    if arguments.check_config {
        return json::print("the configuration has no faults");
    }
    let (mut terminate, mut interrupt) =
        (on(SignalKind::terminate())?, on(SignalKind::interrupt())?);
    let node = Node::start(config)
        .await
        .map_err(|fault| Failure::unavailable(format!("the node did not start: {fault}")))?;
    json::print(&format!("listening on http://{}", node.local_address()))?;
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

/// The configuration, or every fault in it.
fn configuration(arguments: &ServeArguments) -> Result<Config, Failure> {
    let flags = Settings {
        listen: arguments.listen,
        allow_insecure_listen: arguments.allow_insecure_listen.then_some(true),
        compute_threads: arguments.compute_threads,
        store_directory: arguments.data_dir.clone(),
        ..Settings::default()
    };
    let mut faults = Vec::new();
    let mut settings = flags;
    match Settings::from_environment(env::vars(), &OTHER_VARIABLES) {
        Ok(environment) => settings = settings.over(environment),
        Err(fault) => faults.push(fault.to_string()),
    }
    match arguments.config.as_deref().map_or(Ok(Settings::default()), from_file) {
        Ok(file) => settings = settings.over(file),
        Err(fault) => faults.push(fault),
    }
    match settings.apply(Config { listen: LISTEN_DEFAULT, ..Config::default() }) {
        Ok(config) => {
            faults.extend(config.faults().iter().map(ToString::to_string));
            if faults.is_empty() {
                return Ok(config);
            }
        }
        Err(fault) => faults.push(fault.to_string()),
    }
    let list = faults.join("\n  ");
    Err(Failure::usage(format!("the configuration cannot be used:\n  {list}")))
}

fn from_file(path: &Path) -> Result<Settings, String> {
    let named = |fault: String| format!("{}: {fault}", path.display());
    let size = fs::metadata(path).map_err(|fault| named(fault.to_string()))?.len();
    if size > FILE_BYTES_MAX {
        return Err(named(format!("{size} bytes; at most {FILE_BYTES_MAX} are read")));
    }
    let text = fs::read_to_string(path).map_err(|fault| named(fault.to_string()))?;
    Settings::from_toml(&text).map_err(|fault| named(fault.to_string()))
}

fn on(kind: SignalKind) -> Result<Signal, Failure> {
    signal(kind).map_err(|fault| Failure::ours(format!("cannot hear signals: {fault}")))
}
