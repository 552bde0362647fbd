//! Decides the first command of a mission.
//!
//! `cargo run -p vbar-client --example step -- http://127.0.0.1:7440`
#![allow(clippy::print_stdout)]

mod envisat;

use vbar_client::{
    Client, Error, Options,
    v1::{StepRequest, step_request, step_response::Verdict},
};

#[tokio::main]
async fn main() -> Result<(), Error> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7440".into());
    let client = Client::connect(&url, Options::default()).await?;
    let request = StepRequest {
        controller: Some(step_request::Controller::Problem(envisat::problem())),
        measurement: Some(envisat::start()),
        ..StepRequest::default()
    };
    let answer = client.step(request).await?;
    match answer.verdict {
        Some(Verdict::Command(command)) => println!(
            "thrust {:?} m/s2 in RTN for {} s",
            command.acceleration_m_s2,
            command.duration_s.unwrap_or_default()
        ),
        Some(Verdict::Arrived(arrival)) => println!("arrived: {arrival:?}"),
        Some(Verdict::Infeasible(why)) => println!("no command exists: {}", why.reason),
        Some(Verdict::Abort(_)) | None => println!("the node gave no verdict of this method"),
    }
    if let Some(certificate) = answer.certificate {
        println!("certificate passed: {}, cost {}", certificate.passed, certificate.cost);
    }
    Ok(())
}
