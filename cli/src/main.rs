//! The `vbar` command.
//!
//! Results go to standard output, everything else to standard error. Exit codes are those of
//! `sysexits.h` but for 1, a comparison that found a difference: 64 for a wrong command line or configuration, 65 for a file that makes no sense,
//! 69 for a node that does not answer, 70 for a fault of ours.

mod calls;
mod failure;
mod flights;
mod json;
mod log;
mod mission;
mod plans;
mod precompute;
mod replay;
mod safety;
mod serve;
mod session;
mod simulate;
mod token;
mod version;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use failure::{Failure, USAGE};

/// Guidance-as-a-service for spacecraft rendezvous.
///
/// A node answers three kinds of question over gRPC and JSON: plan (think once, fly without asking
/// again), step (decide the next command now), precompute (think long, so that steps are fast).
/// Try it: `vbar simulate simulator/missions/envisat.json`
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    log: log::LogArguments,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a node that answers over the network
    Serve(serve::ServeArguments),
    /// Do parts of the jobs that nodes with the same store take orders for
    Worker(serve::ServeArguments),
    /// Fly a mission many times against a node and report what comes out
    Simulate(simulate::SimulateArguments),
    /// Compute a plan for a mission, print it, and write it as a file for others
    Plan(Box<calls::PlanArguments>),
    /// Check everything a plan claims, without a node; exit code 65 if a claim does not hold
    Verify(plans::VerifyArguments),
    /// Have a node keep a plan, if what it claims holds
    Upload(plans::UploadArguments),
    /// Decide one command: a StepRequest as JSON in, the StepResponse as JSON out
    Step(calls::StepArguments),
    /// Make a mission's artifact on a node, show how far it is, and print its summary as JSON
    Precompute(precompute::PrecomputeArguments),
    /// Say of a trajectory what could be done at each of its states if thrusters failed
    Safety(safety::SafetyArguments),
    /// Ask whether a node will answer; exit code 69 if not
    Health(calls::HealthArguments),
    /// Make tokens for callers of a node that asks who they are
    Token(token::TokenArguments),
    /// Ask again what a node recorded, and compare the answers; exit code 1 if any differs
    Replay(replay::ReplayArguments),
    /// Say what this program, or a node, was built from
    Version(version::VersionArguments),
}

fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(fault) => {
            let code = if fault.use_stderr() { USAGE } else { 0 };
            // Nobody is left to tell when the terminal is gone.
            let _ = fault.print();
            return ExitCode::from(code);
        }
    };
    let filter = if matches!(arguments.command, Command::Serve(_) | Command::Worker(_)) {
        "info"
    } else {
        "warn"
    };
    match log::start(&arguments.log, filter).and_then(|()| run(arguments.command)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("vbar: {failure}");
            ExitCode::from(failure.code)
        }
    }
}

fn run(command: Command) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|fault| Failure::ours(format!("no threads: {fault}")))?;
    runtime.block_on(async {
        match command {
            Command::Serve(arguments) => serve::serve(arguments).await,
            Command::Worker(arguments) => serve::work(arguments).await,
            Command::Simulate(arguments) => simulate::simulate(arguments).await,
            Command::Plan(arguments) => calls::plan(*arguments).await,
            Command::Verify(arguments) => plans::verify(&arguments),
            Command::Upload(arguments) => plans::upload(arguments).await,
            Command::Step(arguments) => calls::step(arguments).await,
            Command::Precompute(arguments) => precompute::precompute(arguments).await,
            Command::Safety(arguments) => safety::safety(arguments).await,
            Command::Health(arguments) => calls::health(arguments).await,
            Command::Token(arguments) => token::token(&arguments),
            Command::Replay(arguments) => replay::replay(arguments).await,
            Command::Version(arguments) => version::version(arguments).await,
        }
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn arguments_are_well_formed() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_argument_has_a_help_text() {
        let command = Arguments::command();
        for subcommand in command.get_subcommands() {
            for argument in subcommand.get_arguments() {
                let name = (subcommand.get_name(), argument.get_id());
                assert!(argument.get_help().is_some(), "{name:?}");
            }
        }
    }
}
