//! Flies a closed loop: one measurement in, one command out, until arrival.
//!
//! There is no spacecraft here: each next measurement is what the last prediction expected.
//!
//! `cargo run -p vbar-client --example stream -- http://127.0.0.1:7440`
#![allow(clippy::print_stdout)]

mod envisat;

use vbar_client::{
    Client, Error, Options,
    v1::{
        Matrix, Measurement, Prediction, step_response::Verdict, step_stream_request::Controller,
    },
};

/// A mission is over long before this.
const STEPS_MAX: u32 = 200;

#[tokio::main]
async fn main() -> Result<(), Error> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7440".into());
    let client = Client::connect(&url, Options::default()).await?;
    let mut controlled = client.closed_loop(Controller::Problem(envisat::problem())).await?;
    let mut measurement = envisat::start();
    for step in 0..STEPS_MAX {
        let answer = controlled.step(measurement).await?;
        match &answer.verdict {
            Some(Verdict::Command(command)) => {
                println!("step {step:3}: {:?} m/s2", command.acceleration_m_s2);
            }
            Some(Verdict::Arrived(arrival)) => {
                println!("arrived {:.3} m from the port", arrival.distance_m.unwrap_or_default());
                return Ok(());
            }
            Some(Verdict::Infeasible(why)) => {
                println!("no command exists: {}", why.reason);
                return Ok(());
            }
            Some(Verdict::Abort(_)) | None => println!("the node gave no verdict of this method"),
        }
        let Some(expected) = answer.prediction.and_then(|p| expected(&p, step + 1)) else {
            println!("the node gave no prediction");
            return Ok(());
        };
        measurement = expected;
    }
    println!("still flying after {STEPS_MAX} steps");
    Ok(())
}

/// Row 1 of the prediction: the state one step ahead.
fn expected(prediction: &Prediction, step: u32) -> Option<Measurement> {
    let row = |matrix: &Option<Matrix>| Some(matrix.as_ref()?.values.get(3..6)?.to_vec());
    let position = row(&prediction.positions_m)?;
    let velocity = row(&prediction.velocities_m_s)?;
    Some(envisat::measured(position, velocity, step))
}
