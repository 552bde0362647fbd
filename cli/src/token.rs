//! `vbar token new`.

use clap::{Args, Subcommand};
use vbar_server::NewToken;

use crate::{failure::Failure, json};

#[derive(Debug, Args)]
pub(crate) struct TokenArguments {
    #[command(subcommand)]
    command: TokenCommand,
}

#[derive(Debug, Subcommand)]
enum TokenCommand {
    /// Draw a token: it is shown once, on standard output, and its entry for the node's
    /// tokens_file on standard error
    New(NewArguments),
}

#[derive(Debug, Args)]
struct NewArguments {
    /// Who will ask with it: the name in logs and limits
    #[arg(long)]
    name: String,
    /// What it is good for: plan, step, precompute or admin; may be repeated, and without any it
    /// only reads metrics and the node's limits
    #[arg(long, value_name = "ROLE")]
    role: Vec<String>,
    /// Until when, such as 2027-03-01T00:00:00Z; without it for ever
    #[arg(long, value_name = "TIME")]
    expires: Option<String>,
}

pub(crate) fn token(arguments: &TokenArguments) -> Result<(), Failure> {
    let TokenCommand::New(new) = &arguments.command;
    let token = NewToken::draw(&new.name, &new.role, new.expires.as_deref())
        .map_err(|faults| Failure::usage(faults.join("\n  ")))?;
    json::print(&token.secret)?;
    eprint!("{}", token.entry);
    Ok(())
}
