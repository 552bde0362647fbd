//! Prometheus metrics: rate, errors and duration of every method, and what the solvers did.

use prometheus_client::{
    encoding::{EncodeLabelSet, text::encode},
    metrics::{
        counter::Counter,
        family::Family,
        gauge::Gauge,
        histogram::{Histogram, exponential_buckets},
    },
    registry::{Registry, Unit},
};

/// One finished call.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct CallLabels {
    /// The RPC or route; one of a fixed list.
    pub(crate) method: &'static str,
    /// `grpc` or `http`.
    pub(crate) transport: &'static str,
    /// Name of its `google.rpc.Code`.
    pub(crate) code: &'static str,
}

/// A kind of work.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct MethodLabels {
    /// What is done.
    pub(crate) method: &'static str,
}

/// Computations that share threads.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct LaneLabels {
    /// `steps`, `plans` or `records`.
    pub(crate) lane: &'static str,
}

/// Why no compute thread took something on.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct RefusalLabels {
    /// Whose threads.
    pub(crate) lane: &'static str,
    /// One of a fixed list.
    pub(crate) reason: &'static str,
}

/// What a certificate claims.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct ClaimLabels {
    /// One of a fixed list.
    pub(crate) claim: &'static str,
}

/// What came of something.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(crate) struct OutcomeLabels {
    /// One of a fixed list.
    pub(crate) outcome: &'static str,
}

/// Every metric of a node.
#[derive(Debug)]
pub(crate) struct Metrics {
    registry: Registry,
    /// Calls finished.
    pub(crate) requests: Family<CallLabels, Counter>,
    /// Time from a call's head to its answer's head.
    pub(crate) request_seconds: Family<MethodLabels, Histogram>,
    /// Answers of closed loops.
    pub(crate) stream_messages: Family<OutcomeLabels, Counter>,
    /// Time on a compute thread.
    pub(crate) compute_seconds: Family<MethodLabels, Histogram>,
    /// Time a call waited for a compute thread.
    pub(crate) compute_wait_seconds: Family<LaneLabels, Histogram>,
    /// Computations under way.
    pub(crate) computations: Family<LaneLabels, Gauge>,
    /// Calls waiting for a compute thread.
    pub(crate) compute_waiting: Family<LaneLabels, Gauge>,
    /// Calls that no compute thread took on.
    pub(crate) compute_refused: Family<RefusalLabels, Counter>,
    /// Computations that panicked.
    pub(crate) compute_panics: Counter,
    /// Steps by verdict.
    pub(crate) verdicts: Family<OutcomeLabels, Counter>,
    /// Commands by what they claim: how many are fallbacks.
    pub(crate) commands: Family<ClaimLabels, Counter>,
    /// Simplex pivots.
    pub(crate) simplex_pivots: Counter,
    /// Programs the simplex gave up to the general solver.
    pub(crate) general_solver_calls: Counter,
    /// Answers withheld because their certificate did not pass.
    pub(crate) certificate_failures: Counter,
    /// Artifact look-ups: `hit`, `loaded`, `computed`, `unknown`.
    pub(crate) artifacts: Family<OutcomeLabels, Counter>,
    /// Same problem, different artifact: determinism broke.
    pub(crate) artifact_conflicts: Counter,
    /// Plans: `computed`, `infeasible`, `uploaded`, `refused`, `exported`.
    pub(crate) plans: Family<OutcomeLabels, Counter>,
    /// Jobs: `accepted`, `joined`, `resumed`, `succeeded`, `infeasible`, `failed`, `cancelled`.
    pub(crate) jobs: Family<OutcomeLabels, Counter>,
    /// Jobs that are not done.
    pub(crate) jobs_unfinished: Gauge,
    /// Time on a job thread, a shard.
    pub(crate) job_shard_seconds: Histogram,
    /// Artifacts removed because nobody used them for a whole term.
    pub(crate) artifacts_expired: Counter,
    /// Open connections.
    pub(crate) connections: Gauge,
    /// Connections dropped because too many were open.
    pub(crate) connections_refused: Counter,
    /// TLS handshakes: `completed`, `failed`, `slow`.
    pub(crate) tls_handshakes: Family<OutcomeLabels, Counter>,
    /// Calls at the gate: `admitted`, `unauthenticated`, `role`, `rate`, `calls`.
    pub(crate) admissions: Family<OutcomeLabels, Counter>,
    /// Changed files with credentials: `loaded`, `refused`.
    pub(crate) credential_reloads: Family<OutcomeLabels, Counter>,
    /// Lines that are missing in the audit file.
    pub(crate) audit_lines_lost: Counter,
    /// Exchanges for the black box: `written`, `lost`, `withheld`.
    pub(crate) recorded_exchanges: Family<OutcomeLabels, Counter>,
    /// Threads of the runtime that serves connections.
    runtime_workers: Gauge,
    /// Tasks on it: connections, calls, watchers.
    runtime_tasks: Gauge,
    /// Tasks that wait for one of its threads.
    runtime_queue: Gauge,
}

/// 50 µs to 26 s.
fn durations() -> Histogram {
    Histogram::new(exponential_buckets(50e-6, 2.0, 20))
}

impl Metrics {
    /// All of them, at zero.
    pub(crate) fn new() -> Self {
        let mut metrics = Self {
            registry: Registry::with_prefix("vbar"),
            requests: Family::default(),
            request_seconds: Family::new_with_constructor(durations),
            stream_messages: Family::default(),
            compute_seconds: Family::new_with_constructor(durations),
            compute_wait_seconds: Family::new_with_constructor(durations),
            computations: Family::default(),
            compute_waiting: Family::default(),
            compute_refused: Family::default(),
            compute_panics: Counter::default(),
            verdicts: Family::default(),
            commands: Family::default(),
            simplex_pivots: Counter::default(),
            general_solver_calls: Counter::default(),
            certificate_failures: Counter::default(),
            artifacts: Family::default(),
            artifact_conflicts: Counter::default(),
            plans: Family::default(),
            jobs: Family::default(),
            jobs_unfinished: Gauge::default(),
            job_shard_seconds: Histogram::new(exponential_buckets(1e-3, 2.0, 24)),
            artifacts_expired: Counter::default(),
            connections: Gauge::default(),
            connections_refused: Counter::default(),
            tls_handshakes: Family::default(),
            admissions: Family::default(),
            credential_reloads: Family::default(),
            audit_lines_lost: Counter::default(),
            recorded_exchanges: Family::default(),
            runtime_workers: Gauge::default(),
            runtime_tasks: Gauge::default(),
            runtime_queue: Gauge::default(),
        };
        metrics.register();
        // A lane that never refused anything says so.
        for lane in ["steps", "plans", "records"] {
            for reason in ["backlog", "full", "late"] {
                let _ = metrics.compute_refused.get_or_create(&RefusalLabels { lane, reason });
            }
            let _ = metrics.compute_waiting.get_or_create(&LaneLabels { lane });
            let _ = metrics.computations.get_or_create(&LaneLabels { lane });
        }
        metrics
    }

    fn register(&mut self) {
        let r = &mut self.registry;
        r.register("requests", "Calls finished", self.requests.clone());
        let help = "From a call's head to its answer's head";
        r.register_with_unit("request", help, Unit::Seconds, self.request_seconds.clone());
        r.register("stream_messages", "Answers in closed loops", self.stream_messages.clone());
        let help = "Time on a compute thread";
        r.register_with_unit("compute", help, Unit::Seconds, self.compute_seconds.clone());
        let help = "Time spent waiting for a compute thread";
        r.register_with_unit(
            "compute_wait",
            help,
            Unit::Seconds,
            self.compute_wait_seconds.clone(),
        );
        r.register("computations", "Computations under way", self.computations.clone());
        let help = "Calls waiting for a compute thread";
        r.register("compute_waiting", help, self.compute_waiting.clone());
        let help = "Calls that no compute thread took on";
        r.register("compute_refused", help, self.compute_refused.clone());
        r.register("compute_panics", "Computations that panicked", self.compute_panics.clone());
        r.register("verdicts", "Steps by verdict", self.verdicts.clone());
        r.register("commands", "Commands by what they claim", self.commands.clone());
        r.register("simplex_pivots", "Pivots of the simplex", self.simplex_pivots.clone());
        let help = "Programs the simplex gave up to the general solver";
        r.register("general_solver_calls", help, self.general_solver_calls.clone());
        let help = "Answers withheld because their certificate did not pass";
        r.register("certificate_failures", help, self.certificate_failures.clone());
        r.register("artifact_lookups", "Where artifacts came from", self.artifacts.clone());
        let help = "Same problem, different artifact: determinism broke";
        r.register("artifact_conflicts", help, self.artifact_conflicts.clone());
        r.register("plans", "Plans by what became of them", self.plans.clone());
        r.register("jobs", "Precomputes by what became of them", self.jobs.clone());
        let help = "Precomputes that are not done";
        r.register("jobs_unfinished", help, self.jobs_unfinished.clone());
        let help = "Time on a job thread, a shard";
        r.register_with_unit("job_shard", help, Unit::Seconds, self.job_shard_seconds.clone());
        let help = "Artifacts that nobody used for a whole term";
        r.register("artifacts_expired", help, self.artifacts_expired.clone());
        r.register("connections", "Open connections", self.connections.clone());
        let help = "Connections dropped because too many were open";
        r.register("connections_refused", help, self.connections_refused.clone());
        let help = "TLS handshakes by what became of them";
        r.register("tls_handshakes", help, self.tls_handshakes.clone());
        r.register("admissions", "Calls at the gate", self.admissions.clone());
        let help = "Changed files with credentials";
        r.register("credential_reloads", help, self.credential_reloads.clone());
        let help = "Lines missing in the audit file";
        r.register("audit_lines_lost", help, self.audit_lines_lost.clone());
        let help = "Exchanges for the recording by what became of them";
        r.register("recorded_exchanges", help, self.recorded_exchanges.clone());
        let help = "Threads that serve connections";
        r.register("runtime_workers", help, self.runtime_workers.clone());
        let help = "Tasks on the threads that serve connections";
        r.register("runtime_tasks", help, self.runtime_tasks.clone());
        let help = "Tasks that wait for a thread that serves connections";
        r.register("runtime_queue", help, self.runtime_queue.clone());
    }

    /// What the runtime says of itself at this moment; nothing outside of one.
    fn look_at_the_runtime(&self) {
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        let metrics = runtime.metrics();
        for (gauge, count) in [
            (&self.runtime_workers, metrics.num_workers()),
            (&self.runtime_tasks, metrics.num_alive_tasks()),
            (&self.runtime_queue, metrics.global_queue_depth()),
        ] {
            gauge.set(i64::try_from(count).unwrap_or(i64::MAX));
        }
    }

    /// The OpenMetrics text.
    pub(crate) fn text(&self) -> String {
        self.look_at_the_runtime();
        let mut text = String::new();
        encode(&mut text, &self.registry).expect("a String takes everything");
        text
    }
}
