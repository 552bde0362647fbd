//! How much one caller may ask for.

use std::time::Duration;

use serde_json::Value;
use tonic::Code;
use tonic_types::StatusExt as _;
use vbar_client::{Error, v1::step_stream_request::Controller};
use vbar_server::AccessOptions;

use super::{
    authority::{Files, token_entry},
    callers::{Server, until},
};
use crate::nodes::envisat;

const INFO: &str = "/vbar.v1.GuidanceService/GetServerInfo";
/// A request in 1000 s: nothing comes back while a test runs.
const HARDLY: &str = "rate_max_per_s = 0.001\nburst_max = 3";

async fn server(names: String, access: AccessOptions) -> (Server, Files) {
    let files = Files::new();
    let tokens_file = Some(files.write("tokens.toml", names));
    (Server::start(AccessOptions { tokens_file, ..access }).await, files)
}

#[tokio::test(flavor = "multi_thread")]
async fn rate_of_one_caller_is_refused_at_once_with_a_delay_and_another_goes_on() {
    let names = token_entry("few", "vbar_few", &["step"], HARDLY)
        + &token_entry("many", "vbar_many", &["step"], "");
    let (server, _files) = server(names, AccessOptions::default()).await;
    let few = [("authorization", "Bearer vbar_few")];
    assert_eq!(server.grpc(INFO, &few).await.code(), Code::Ok);
    assert_eq!(server.get("/v1/info", &few).await.status, 200);
    // What is refused for another reason counts too.
    assert_eq!(server.get("/v1/plans", &few).await.status, 403);

    let answer = server.get("/v1/info", &few).await;
    assert_eq!((answer.status, answer.reason().as_str()), (429, "CALLER_RATE"));
    let seconds: f64 = answer.header("retry-after").unwrap().parse().unwrap();
    assert!((900.0..=1000.0).contains(&seconds), "{seconds}");
    let error: Value = serde_json::from_str(&answer.body).unwrap();
    let delay = error["details"][2]["retryDelay"].as_str().unwrap();
    assert!(delay.ends_with('s'), "{error}");
    let status = server.grpc(INFO, &few).await;
    assert_eq!(status.code(), Code::ResourceExhausted);
    let delay = status.get_details_retry_info().unwrap().retry_delay.unwrap();
    assert!(delay > Duration::from_secs(900), "{delay:?}");

    for _ in 0..20 {
        let many = [("authorization", "Bearer vbar_many")];
        assert_eq!(server.grpc(INFO, &many).await.code(), Code::Ok);
    }
    assert_eq!(server.get("/healthz", &few).await.status, 200, "probes are not counted");
}

#[tokio::test(flavor = "multi_thread")]
async fn rate_without_a_name_is_counted_by_address() {
    let access = AccessOptions {
        caller_rate_max_per_s: 0.001,
        caller_burst_max: 4,
        ..AccessOptions::default()
    };
    // Of callers that nobody is asked about.
    let open = Server::start(access.clone()).await;
    for _ in 0..4 {
        assert_eq!(open.grpc(INFO, &[]).await.code(), Code::Ok);
    }
    assert_eq!(open.grpc(INFO, &[]).await.code(), Code::ResourceExhausted);

    // Of those that guess tokens; who knows one does not suffer for them.
    let names = token_entry("known", "vbar_known", &[], "rate_max_per_s = 100.0");
    let (closed, _files) = server(names, access).await;
    for guess in 0..4 {
        let bearer = format!("Bearer vbar_{guess}");
        assert_eq!(closed.get("/v1/info", &[("authorization", &bearer)]).await.status, 401);
    }
    assert_eq!(closed.get("/v1/info", &[]).await.status, 429);
    let known = [("authorization", "Bearer vbar_known")];
    assert_eq!(closed.get("/v1/info", &known).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn calls_at_once_are_bounded_and_a_closed_loop_is_one_until_it_ends() {
    let names = token_entry("one", "vbar_one", &["step"], "calls_max = 1")
        + &token_entry("two", "vbar_two", &["step"], "");
    let (server, _files) = server(names, AccessOptions::default()).await;
    let one = server.client_with("vbar_one").await;
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let mut flight = one.closed_loop(Controller::Problem(mission.problem)).await.unwrap();
    flight.step(start).await.unwrap();

    let refused: Error = one.server_info().await.unwrap_err();
    assert_eq!(refused.code, Code::ResourceExhausted, "{refused}");
    assert!(refused.retry_after.is_some_and(|delay| delay > Duration::ZERO), "{refused:?}");
    let answer = server.get("/v1/info", &[("authorization", "Bearer vbar_one")]).await;
    assert_eq!((answer.status, answer.reason().as_str()), (429, "CALLER_CALLS"));
    assert_eq!(answer.header("retry-after"), Some("1"));
    assert!(server.client_with("vbar_two").await.server_info().await.is_ok());

    drop(flight);
    until("the loop's place is free", async || one.server_info().await.is_ok()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_of_a_closed_loop_count_and_one_refused_does_not_end_it() {
    let names = token_entry("few", "vbar_few", &["step"], "rate_max_per_s = 4.0\nburst_max = 3");
    let (server, _files) = server(names, AccessOptions::default()).await;
    let client = server.client_with("vbar_few").await;
    let mission = envisat();
    let start = mission.fixed_start().unwrap();
    let mut flight = client.closed_loop(Controller::Problem(mission.problem)).await.unwrap();
    flight.step(start.clone()).await.unwrap();
    // The same step again is the same decision, or a refusal of the state: it is not the point.
    let mut refused = None;
    for _ in 0..50 {
        match flight.step(start.clone()).await {
            Err(error) if error.code == Code::ResourceExhausted => {
                refused = Some(error);
                break;
            }
            _ => {}
        }
    }
    let delay = refused.expect("50 messages at once are too many").retry_after.unwrap();
    assert!(delay <= Duration::from_millis(250), "{delay:?}");
    let goes_on = async || {
        let answered = server.get("/v1/info", &[("authorization", "Bearer vbar_few")]).await;
        answered.status == 200
    };
    until("who waits is answered", goes_on).await;
}
