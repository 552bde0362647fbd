//! What is logged, on standard error.

use std::io::{self, IsTerminal as _};

use clap::{Args, ValueEnum};
use tracing_subscriber::EnvFilter;

use crate::failure::Failure;

/// What to log, and how.
#[derive(Debug, Args)]
pub(crate) struct LogArguments {
    /// What to log: error, warn, info, debug, trace, or per module as in vbar_server=debug; a
    /// node logs info unless told otherwise, any other command warn
    #[arg(long, value_name = "FILTER", env = "VBAR_LOG", global = true)]
    log: Option<String>,
    /// How to log, on standard error
    #[arg(
        long,
        value_name = "FORMAT",
        env = "VBAR_LOG_FORMAT",
        default_value = "text",
        global = true
    )]
    log_format: LogFormat,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LogFormat {
    /// For people
    Text,
    /// One JSON object a line
    Json,
}

/// Starts the log with `filter` unless the arguments name another.
pub(crate) fn start(arguments: &LogArguments, filter: &str) -> Result<(), Failure> {
    let filter = EnvFilter::try_new(arguments.log.as_deref().unwrap_or(filter))
        .map_err(|fault| Failure::usage(format!("--log: {fault}")))?;
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(io::stderr().is_terminal())
        .with_writer(io::stderr);
    match arguments.log_format {
        LogFormat::Text => lines.init(),
        LogFormat::Json => lines.json().init(),
    }
    Ok(())
}
