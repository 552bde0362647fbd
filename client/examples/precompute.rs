//! Thinks long once: makes an artifact that every later step can name.
//!
//! `cargo run -p vbar-client --example precompute -- http://127.0.0.1:7440`
#![allow(clippy::print_stdout)]

mod envisat;

use vbar_client::{
    Client, Error, Options,
    v1::{StepRequest, artifact::Summary, precompute_response::Outcome, step_request::Controller},
};

#[tokio::main]
async fn main() -> Result<(), Error> {
    let url = std::env::args().nth(1).unwrap_or_else(|| "http://127.0.0.1:7440".into());
    let client = Client::connect(&url, Options::default()).await?;
    let artifact = match client.precompute(envisat::problem()).await?.outcome {
        Some(Outcome::Artifact(artifact)) => artifact,
        Some(Outcome::Infeasible(why)) => {
            println!("no controller exists: {}", why.reason);
            return Ok(());
        }
        None => {
            println!("the node gave no outcome");
            return Ok(());
        }
    };
    println!("artifact {} ({} bytes)", artifact.artifact_id, artifact.size_bytes);
    if let Some(Summary::VariableHorizon(summary)) = &artifact.summary {
        println!("the cost falls by at least {} a step", summary.lambda_bar);
    }
    let request = StepRequest {
        controller: Some(Controller::ArtifactId(artifact.artifact_id)),
        measurement: Some(envisat::start()),
        omit_prediction: true,
        ..StepRequest::default()
    };
    let answer = client.step(request).await?;
    println!("step {} decided from the artifact", answer.step_index);
    Ok(())
}
