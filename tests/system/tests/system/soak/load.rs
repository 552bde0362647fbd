//! The load: quiet, at capacity beside every other kind of traffic, and at twice that.

use std::{
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use fastrand::Rng;
use prost::Message;
use tokio::{runtime::Handle, sync::Semaphore, task::JoinSet, time::sleep};
use vbar_client::{
    Client, Code, Error,
    v1::{Problem, StepRequest, precompute_response::Outcome, problem, step_stream_request},
};

use super::{
    Process,
    nuisance::Nuisance,
    questions::{Question, Questions, client},
    report::Seen,
};

/// Connections that steps come over.
const CONNECTIONS: usize = 8;
/// Clients that do everything else, each one of everything at a time.
const OTHERS: usize = 2;
/// Steps on their way at once, at most: far more than the node lets wait.
const UNDER_WAY: usize = 600;

/// What the phases share.
pub(super) struct Load<'a> {
    node: &'a Process,
    clients: Vec<Client>,
    /// Everything but the timed steps, with clients of its own: these must not wait until the load
    /// has read somebody else's plan.
    others: Handle,
    other_clients: Vec<Client>,
    questions: Arc<Questions>,
    rng: Rng,
}

/// What the tasks of one phase share.
#[derive(Clone)]
struct Phase {
    questions: Arc<Questions>,
    seen: Arc<Mutex<Seen>>,
    until: Instant,
}

impl Phase {
    fn goes_on(&self) -> bool {
        Instant::now() < self.until
    }

    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().expect("no task panics with it")
    }

    /// Holds an answer against the known one. What to wait before the next call.
    fn note(&self, what: &'static str, answer: Result<Vec<u8>, Error>, known: &[u8]) -> Duration {
        match answer {
            Ok(bytes) if bytes == known => self.seen().other(what),
            Ok(bytes) => self.seen().wrong(format!("{what}: answered {} bytes", bytes.len())),
            Err(error) => return self.note_error(what, &error),
        }
        Duration::ZERO
    }

    fn note_error(&self, what: &'static str, error: &Error) -> Duration {
        let mut seen = self.seen();
        match (error.code, error.retry_after) {
            (Code::ResourceExhausted, Some(retry_after)) => {
                seen.refused += 1;
                return retry_after.min(self.until.saturating_duration_since(Instant::now()));
            }
            (Code::ResourceExhausted, None) => {
                seen.refused += 1;
                seen.refused_without_a_time += 1;
            }
            // Nobody's fault, and said aloud.
            (Code::DeadlineExceeded | Code::Unavailable, _) => {
                *seen.failed.entry(format!("{what}: {:?}", error.code)).or_default() += 1;
            }
            _ => seen.wrong(format!("{what}: {error}")),
        }
        Duration::from_millis(20)
    }

    /// One step, timed. What to wait before the next.
    async fn step(&self, client: &Client, question: &Question<StepRequest>) -> Duration {
        let asked = Instant::now();
        let answer = client.step(question.request.clone()).await;
        let took = asked.elapsed();
        match answer {
            Ok(answer) if answer.encode_to_vec() == question.answer => {
                self.seen().step(question.name, took);
                Duration::ZERO
            }
            answer => {
                let bytes = answer.map(|answer| answer.encode_to_vec());
                self.note(question.name, bytes, &question.answer)
            }
        }
    }
}

impl<'a> Load<'a> {
    /// `others` runs everything but the timed steps.
    pub(super) async fn new(
        node: &'a Process,
        questions: Questions,
        seed: u64,
        others: Handle,
    ) -> Self {
        let connect = |count| {
            let url = node.url.clone();
            async move {
                let mut clients = Vec::with_capacity(count);
                for _ in 0..count {
                    clients.push(client(&url).await);
                }
                clients
            }
        };
        let clients = connect(CONNECTIONS).await;
        let other_clients = others.spawn(connect(OTHERS)).await.expect("the node listens");
        let questions = Arc::new(questions);
        Self { node, clients, others, other_clients, questions, rng: Rng::with_seed(seed) }
    }

    fn phase(&self, lasts: Duration) -> Phase {
        let seen = Arc::new(Mutex::new(Seen::nothing()));
        Phase { questions: Arc::clone(&self.questions), seen, until: Instant::now() + lasts }
    }

    /// Every step in turn, one call at a time, for so long and at least three times.
    pub(super) async fn one_after_another(&mut self, lasts: Duration) -> Seen {
        let phase = self.phase(lasts);
        let mut rounds = 0;
        while rounds < 3 || phase.goes_on() {
            for question in &phase.questions.steps {
                phase.step(&self.clients[0], question).await;
            }
            rounds += 1;
        }
        ended(phase)
    }

    /// Most steps a second beside everything else: with few callers the node waits for them, with
    /// many it refuses some, who then stay away for longer than they had to.
    pub(super) async fn capacity(&mut self, lasts: Duration) -> f64 {
        let mut most = 0.0_f64;
        for callers in [1, 2, 4].map(|each| each * CONNECTIONS) {
            most = most.max(self.answered_by(callers, lasts / 3).await);
        }
        most
    }

    /// Steps a second of so many who ask for the next when they have an answer.
    async fn answered_by(&mut self, callers: usize, lasts: Duration) -> f64 {
        let phase = self.phase(lasts.max(Duration::from_millis(300)));
        let begun = Instant::now();
        let (others, mut tasks) = (self.everything_else(&phase), JoinSet::new());
        for client in self.clients.iter().cycle().take(callers) {
            let (phase, client, mut rng) = (phase.clone(), client.clone(), self.rng.fork());
            tasks.spawn(async move {
                while phase.goes_on() {
                    let question = choice(&mut rng, &phase.questions.steps);
                    sleep(phase.step(&client, question).await).await;
                }
            });
        }
        tasks.join_all().await;
        let seconds = begun.elapsed().as_secs_f64();
        others.join_all().await;
        ended(phase).admitted as f64 / seconds
    }

    /// `rate` steps a second, however fast they are answered, and everything else beside them.
    pub(super) async fn overload(&mut self, rate: f64, lasts: Duration) -> Seen {
        let phase = self.phase(lasts);
        let tasks = self.everything_else(&phase);
        let steps = steps(phase.clone(), self.clients.clone(), rate, self.rng.fork());
        tokio::join!(steps, watch_memory(&phase, self.node, lasts), tasks.join_all());
        ended(phase)
    }

    /// All other traffic, for as long as the phase goes on.
    fn everything_else(&mut self, phase: &Phase) -> JoinSet<()> {
        let (mut tasks, others) = (JoinSet::new(), &self.others);
        for client in &self.other_clients {
            let [a, b, c, d, e, f, g, h] = [(); 8].map(|()| self.rng.fork());
            tasks.spawn_on(fly(phase.clone(), client.clone(), a), others);
            tasks.spawn_on(plan(phase.clone(), client.clone(), b), others);
            tasks.spawn_on(report(phase.clone(), client.clone(), c), others);
            tasks.spawn_on(fault(phase.clone(), client.clone(), d), others);
            tasks.spawn_on(give_up(phase.clone(), client.clone(), e), others);
            tasks.spawn_on(precompute(phase.clone(), client.clone(), f), others);
            tasks.spawn_on(be_a_nuisance(phase.clone(), self.node.address(), g), others);
            tasks.spawn_on(be_a_nuisance(phase.clone(), self.node.address(), h), others);
        }
        tasks
    }
}

/// What a phase saw, when all its tasks are over.
fn ended(phase: Phase) -> Seen {
    std::mem::replace(&mut *phase.seen(), Seen::nothing()).end()
}

fn choice<'q, T>(rng: &mut Rng, of: &'q [T]) -> &'q T {
    &of[rng.usize(..of.len())]
}

/// Steps at moments of their own: an open loop, which does not slow down with the node.
async fn steps(phase: Phase, clients: Vec<Client>, rate: f64, mut rng: Rng) {
    let (begun, places) = (Instant::now(), Arc::new(Semaphore::new(UNDER_WAY)));
    let (mut tasks, mut sent) = (JoinSet::new(), 0_u64);
    while phase.goes_on() {
        let due = (begun.elapsed().as_secs_f64() * rate) as u64;
        for _ in sent..due {
            phase.seen().offered += 1;
            let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
                *phase.seen().failed.entry("step: not sent".to_owned()).or_default() += 1;
                continue;
            };
            let chosen = rng.usize(..phase.questions.steps.len());
            let (phase, client) = (phase.clone(), choice(&mut rng, &clients).clone());
            tasks.spawn(async move {
                phase.step(&client, &phase.questions.steps[chosen]).await;
                drop(place);
            });
        }
        sent = due;
        while tasks.try_join_next().is_some() {}
        sleep(Duration::from_millis(1)).await;
    }
    tasks.join_all().await;
}

async fn watch_memory(phase: &Phase, node: &Process, lasts: Duration) {
    while phase.goes_on() {
        sleep(lasts / 10).await;
        if let Some(mib) = node.resident_mib() {
            phase.seen().memory_mib.push(mib);
        }
    }
}

/// Closed loops, which wait for each answer and come back when they are told to.
async fn fly(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        let flight = choice(&mut rng, &phase.questions.flights);
        let controller = step_stream_request::Controller::ArtifactId(flight.artifact_id.clone());
        let Ok(mut closed_loop) = client.closed_loop(controller).await else { continue };
        for (measurement, known) in &flight.steps {
            loop {
                let answer = closed_loop.step(measurement.clone()).await;
                let is_answered = answer.is_ok();
                let bytes = answer.map(|answer| answer.encode_to_vec());
                sleep(phase.note("step of a stream", bytes, known)).await;
                if is_answered || !phase.goes_on() {
                    break;
                }
            }
            if !phase.goes_on() {
                return;
            }
        }
    }
}

async fn plan(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        let question = choice(&mut rng, &phase.questions.plans);
        let answer = client.plan(question.request.clone()).await;
        let answer = answer.map(|answer| answer.encode_to_vec());
        sleep(phase.note(question.name, answer, &question.answer)).await;
        sleep(Duration::from_millis(rng.u64(..40))).await;
    }
}

async fn report(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        let question = choice(&mut rng, &phase.questions.reports);
        let answer = client.safety_report(question.request.clone()).await;
        let answer = answer.map(|answer| answer.encode_to_vec());
        sleep(phase.note(question.name, answer, &question.answer)).await;
        sleep(Duration::from_millis(rng.u64(..40))).await;
    }
}

/// Faulty requests, which must be told what is wrong with them.
async fn fault(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        let (request, path) = choice(&mut rng, &phase.questions.faulty);
        match client.step(request.clone()).await {
            Ok(_) => phase.seen().wrong(format!("a fault in {path} was not seen")),
            Err(error) if error.code == Code::InvalidArgument => {
                if error.violations.iter().any(|violation| violation.field == *path) {
                    phase.seen().other("fault");
                } else {
                    phase.seen().wrong(format!("a fault in {path} was not named: {error}"));
                }
            }
            Err(error) => {
                sleep(phase.note_error("fault", &error)).await;
            }
        }
        sleep(Duration::from_millis(rng.u64(..20))).await;
    }
}

/// Callers who hang up while their plan is computed.
async fn give_up(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        // A mission of its own each time, so that there is something to compute.
        let mut question = choice(&mut rng, &phase.questions.plans).request.clone();
        if let Some(problem) = &mut question.problem {
            vary(problem, &mut rng);
        }
        let patience = Duration::from_millis(rng.u64(..30));
        match tokio::time::timeout(patience, client.plan(question)).await {
            Err(_) => phase.seen().other("hung up"),
            Ok(Ok(_)) => phase.seen().other("plan of its own"),
            Ok(Err(error)) => sleep(phase.note_error("hanging up", &error)).await,
        }
        sleep(Duration::from_millis(rng.u64(..40))).await;
    }
}

/// One of a few missions that resemble `problem`: few, so that what is kept of them has an end.
fn vary(problem: &mut Problem, rng: &mut Rng) {
    let i = rng.u32(1..=8);
    match &mut problem.method {
        Some(problem::Method::VariableHorizon(mission)) => {
            mission.fuel_weight = Some(4.0 + f64::from(i));
        }
        Some(problem::Method::DisturbanceFeedback(mission)) => {
            mission.fuel_weight = Some(1.0 + 0.01 * f64::from(i));
        }
        _ => {}
    }
}

async fn precompute(phase: Phase, client: Client, mut rng: Rng) {
    while phase.goes_on() {
        // Without the abort-safe one, which takes seconds unless it is kept already.
        let mut problem = phase.questions.problems[rng.usize(..2)].clone();
        vary(&mut problem, &mut rng);
        match client.precompute(problem).await {
            Ok(made) if matches!(made.outcome, Some(Outcome::Artifact(_))) => {
                phase.seen().other("precompute");
            }
            Ok(made) => phase.seen().wrong(format!("precompute: {:?}", made.outcome)),
            Err(error) => sleep(phase.note_error("precompute", &error)).await,
        }
        sleep(Duration::from_millis(rng.u64(..100))).await;
    }
}

async fn be_a_nuisance(phase: Phase, address: SocketAddr, mut rng: Rng) {
    while phase.goes_on() {
        let nuisance = *choice(&mut rng, &Nuisance::ALL);
        match nuisance.act(address).await {
            Ok(()) => phase.seen().other(nuisance.name()),
            Err(what) => phase.seen().wrong(what),
        }
        sleep(Duration::from_millis(rng.u64(..20))).await;
    }
}
