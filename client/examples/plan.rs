//! Computes a plan that can be flown without asking again.
//!
//! `cargo run -p vbar-client --example plan -- http://127.0.0.1:7440`
#![allow(clippy::print_stdout)]

mod envisat;

use vbar_client::{
    Client, Error, Options,
    v1::{ComputePlanRequest, compute_plan_response::Outcome},
};

#[tokio::main]
async fn main() -> Result<(), Error> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7440".into());
    let client = Client::connect(&url, Options::default()).await?;
    let request = ComputePlanRequest {
        problem: Some(envisat::problem()),
        initial: Some(envisat::start()),
        validate_only: false,
    };
    match client.plan(request).await?.outcome {
        Some(Outcome::Plan(plan)) => {
            println!("{} commands:", plan.commands.len());
            for command in &plan.commands {
                println!("{:8.1} s  {:?} m/s2", command.elapsed_s, command.acceleration_m_s2);
            }
        }
        Some(Outcome::Infeasible(why)) => println!("no plan exists: {}", why.reason),
        None => println!("the node gave no outcome"),
    }
    Ok(())
}
