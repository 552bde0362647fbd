//! Asks what was recorded, in its order.

use std::{collections::HashMap, time::Duration};

use prost_reflect::prost::bytes::Bytes;
use tokio::time::{Instant, sleep};
use vbar_client::{Client, Code, Error, VerbatimLoop};
use vbar_server::recording::Exchange;

use super::compare::{self, Answer};
use crate::failure::Failure;

/// Longest wait for something that is made again.
const MADE_WITHIN: Duration = Duration::from_secs(4 * 3600);

/// What came of one exchange.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Judgement {
    /// The same answer.
    Same,
    /// Where it differs.
    Different(Vec<String>),
    /// Why it was not compared.
    Skipped(&'static str),
}

/// A closed loop that goes on.
#[derive(Debug)]
struct Open {
    /// `None` when it cannot go on.
    verbatim: Option<VerbatimLoop>,
    next: u64,
}

/// Asks a node what another was asked.
#[derive(Debug)]
pub(super) struct Player {
    client: Client,
    session: Option<u64>,
    loops: HashMap<u64, Open>,
}

impl Player {
    pub(super) fn new(client: Client) -> Self {
        Self { client, session: None, loops: HashMap::new() }
    }

    /// A run of the node begins, or goes on in another file; whether it is another.
    pub(super) fn begin(&mut self, session: u64) -> bool {
        let is_other = self.session != Some(session);
        if is_other {
            self.loops.clear();
        }
        self.session = Some(session);
        is_other
    }

    /// Asks once more and compares the answers.
    ///
    /// # Errors
    /// If the node does not answer at all.
    pub(super) async fn ask(&mut self, exchange: &Exchange) -> Result<Judgement, Failure> {
        if let Some(number) = exchange.closed_loop {
            return self.ask_in_loop(number, exchange).await;
        }
        if let Some(why) = incomparable(exchange) {
            return Ok(Judgement::Skipped(why));
        }
        let answer = if exchange.call == "Precompute" {
            self.made(exchange).await?
        } else {
            self.call(exchange).await?
        };
        Ok(compare::judge(exchange, &answer))
    }

    async fn call(&self, exchange: &Exchange) -> Result<Answer, Failure> {
        let request = Bytes::from(exchange.request.clone());
        let (method, path) = (&exchange.http_method, &exchange.path);
        if method.is_empty() {
            return answered(self.client.verbatim(path, request).await);
        }
        let (_, body) = self.client.verbatim_http(method, path, request).await?;
        Ok(Answer::of_http(&body))
    }

    /// A precompute is asked for until it is done: what follows may need what it makes.
    async fn made(&self, exchange: &Exchange) -> Result<Answer, Failure> {
        let start = Instant::now();
        loop {
            let answer = self.call(exchange).await?;
            if answer.is_final(exchange) || start.elapsed() > MADE_WITHIN {
                return Ok(answer);
            }
            sleep(Duration::from_millis(200)).await;
        }
    }

    async fn ask_in_loop(
        &mut self,
        number: u64,
        exchange: &Exchange,
    ) -> Result<Judgement, Failure> {
        let request = Bytes::from(exchange.request.clone());
        if exchange.index == 0 {
            let opened = self.client.verbatim_loop(&exchange.path, request).await;
            let (verbatim, answer) = match opened {
                Ok((verbatim, answer)) => (Some(verbatim), answered(Ok(vec![answer]))?),
                Err(error) => (None, answered(Err(error))?),
            };
            self.loops.insert(number, Open { verbatim, next: 1 });
            return Ok(compare::judge(exchange, &answer));
        }
        let missing = Judgement::Skipped("in a closed loop of which something is missing before");
        let Some(open) = self.loops.get_mut(&number) else { return Ok(missing) };
        let Some(verbatim) = open.verbatim.as_mut().filter(|_| open.next == exchange.index) else {
            open.verbatim = None;
            return Ok(missing);
        };
        open.next += 1;
        let answer = verbatim.exchange(request).await;
        if answer.is_err() {
            open.verbatim = None;
        }
        Ok(compare::judge(exchange, &answered(answer.map(|answer| vec![answer]))?))
    }
}

/// What a node says over gRPC; that there is none, or that it is too busy, is no answer.
fn answered(answer: Result<Vec<Bytes>, Error>) -> Result<Answer, Failure> {
    match answer {
        Ok(answers) => Ok(Answer { code: 0, message: String::new(), answers }),
        Err(error) if error.code == Code::Unavailable => Err(error.into()),
        Err(Error { code, message, .. }) => {
            Ok(Answer { code: code.into(), message, answers: Vec::new() })
        }
    }
}

/// Why an exchange cannot be compared, if it cannot.
fn incomparable(exchange: &Exchange) -> Option<&'static str> {
    match exchange.call.as_str() {
        "GetServerInfo" => return Some("that ask about the node"),
        "ListPlans" | "ListArtifacts" => return Some("that ask what the node keeps"),
        _ => {}
    }
    compare::for_want(exchange.code)
}
