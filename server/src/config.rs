//! Configuration: flags over environment over file over defaults.
//!
//! Each source is read into [`Settings`], where everything is optional; [`Settings::over`] stacks
//! them and [`Settings::apply`] lays the stack on the defaults. A [`Config`] names all its faults
//! at once, and a node does not start with any.

use std::{fmt, net::SocketAddr, path::PathBuf, thread, time::Duration};

use serde::{Deserialize, Serialize};

pub use listing::{ListedSetting, Sources};

use crate::{
    access::{AccessOptions, OptionFault},
    recording::RecordingOptions,
    store::without_user,
    wire::{Limits, PLAN_INSTANTS_MAX},
};

pub use crate::store::NatsLocation;

/// Everything a node needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Where to listen; port 0 takes any free one.
    pub listen: SocketAddr,
    /// Listen beyond loopback although callers are not asked who they are, or say so in clear.
    pub allow_insecure_listen: bool,
    /// Computations at once: so many steps, and beside them, with less of the machine, one plan
    /// fewer but at least one.
    pub compute_threads: usize,
    /// How long a step may wait for a compute thread before it is told to come back.
    pub compute_wait: Duration,
    /// The same once a call had to be refused, until none was for a tenth of a second; meanwhile no
    /// more than four calls wait for each thread.
    pub compute_overload_wait: Duration,
    /// How long a plan, a report, or anything else that no spacecraft waits for may wait.
    pub compute_patient_wait: Duration,
    /// How many calls may wait at once, of steps, plans and records each.
    pub compute_waiting_max: usize,
    /// Longest computation, whatever the caller's deadline.
    pub computation_time_max: Duration,
    /// Largest request.
    pub request_bytes_max: usize,
    /// Open connections.
    pub connections_max: usize,
    /// Calls at once on one HTTP/2 connection.
    pub streams_max: u32,
    /// How long the head, and then the body, of a request may take to arrive.
    pub receive_time_max: Duration,
    /// How long calls under way may take to finish at shutdown.
    pub shutdown_grace: Duration,
    /// Where artifacts are kept.
    pub store: StoreLocation,
    /// With a directory: a write reaches the disk before it is acknowledged. Without, a power
    /// failure (never a killed process) can take the last half minute.
    pub store_sync: bool,
    /// Decoded artifacts kept in memory, bytes.
    pub cache_bytes_max: usize,
    /// Shards of precomputes at once, on threads beside those for calls; a processor fewer than
    /// there are leaves room for steps.
    pub job_threads: usize,
    /// Precomputes that are not done; more are refused.
    pub jobs_unfinished_max: usize,
    /// Longest run of one precompute.
    pub job_time_max: Duration,
    /// How often a precompute is begun, when the node ends in its midst, before it is given up.
    pub job_attempts_max: u32,
    /// How long `Precompute` waits for the end before it answers that it is under way.
    pub precompute_wait: Duration,
    /// How long a finished operation and a request id are remembered.
    pub operation_lifetime: Duration,
    /// How long an artifact is kept after its last use.
    pub artifact_lifetime: Duration,
    /// Most bytes of artifacts kept; more are refused until some expire.
    pub artifact_bytes_max: u64,
    /// Callers that follow operations as events at once.
    pub watchers_max: usize,
    /// Who may ask, and how much.
    pub access: AccessOptions,
    /// What is recorded of it.
    pub recording: RecordingOptions,
    /// Limits on what a request may ask for.
    pub limits: Limits,
}

/// Where artifacts are kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StoreLocation {
    /// In memory, up to so many bytes; gone when the process ends.
    Memory {
        /// Most bytes.
        bytes_max: usize,
    },
    /// In a directory, which this node has for itself.
    Directory(PathBuf),
    /// On NATS JetStream, where other nodes and workers use it too.
    Nats(NatsLocation),
}

const DAY: Duration = Duration::from_secs(24 * 3600);

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            allow_insecure_listen: false,
            compute_threads: thread::available_parallelism().map_or(1, usize::from),
            compute_wait: Duration::from_millis(20),
            compute_overload_wait: Duration::from_millis(2),
            compute_patient_wait: Duration::from_secs(1),
            compute_waiting_max: 256,
            computation_time_max: Duration::from_secs(60),
            request_bytes_max: 4 << 20,
            connections_max: 1024,
            streams_max: 256,
            receive_time_max: Duration::from_secs(10),
            shutdown_grace: Duration::from_secs(10),
            store: StoreLocation::Memory { bytes_max: 256 << 20 },
            store_sync: true,
            cache_bytes_max: 256 << 20,
            job_threads: thread::available_parallelism().map_or(1, |n| n.get() - 1).max(1),
            jobs_unfinished_max: 64,
            job_time_max: Duration::from_secs(4 * 3600),
            job_attempts_max: 5,
            precompute_wait: Duration::from_secs(1),
            operation_lifetime: 7 * DAY,
            artifact_lifetime: 30 * DAY,
            artifact_bytes_max: 16 << 30,
            watchers_max: 64,
            access: AccessOptions::default(),
            recording: RecordingOptions::default(),
            limits: Limits::default(),
        }
    }
}

/// One thing that is wrong with a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigFault {
    /// Name of the setting.
    pub setting: &'static str,
    /// What would be right.
    pub expected: String,
    /// What was found.
    pub got: String,
}

impl fmt::Display for ConfigFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: expected {}, got {}", self.setting, self.expected, self.got)
    }
}

impl From<OptionFault> for ConfigFault {
    fn from(OptionFault { setting, expected, got }: OptionFault) -> Self {
        Self { setting, expected, got }
    }
}

impl Config {
    /// Everything that is wrong, the files with credentials included; empty if a node can start
    /// with it.
    #[must_use]
    pub fn faults(&self) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        let mut check = |good: bool, setting, expected: &str, got: String| {
            if !good {
                faults.push(ConfigFault { setting, expected: expected.to_owned(), got });
            }
        };
        let is_secure = self.access.is_encrypted() && self.access.is_authenticated();
        check(
            self.listen.ip().is_loopback() || is_secure || self.allow_insecure_listen,
            "listen",
            "a loopback address, or TLS (tls_certificate) with tokens_file or tls_client_ca, or \
             allow_insecure_listen",
            self.listen.to_string(),
        );
        let mut count = |setting, value: usize, max: usize| {
            let expected = format!("1 to {max}");
            check((1..=max).contains(&value), setting, &expected, value.to_string());
        };
        count("compute_threads", self.compute_threads, 1024);
        count("request_bytes_max", self.request_bytes_max, 1 << 30);
        count("connections_max", self.connections_max, 1 << 20);
        count("streams_max", usize::try_from(self.streams_max).unwrap_or(usize::MAX), 1 << 16);
        match &self.store {
            // Workers can do all of it.
            StoreLocation::Nats(nats) => {
                count("job_threads", self.job_threads + 1, 1025);
                count("store_replicas", nats.replicas, 5);
                count("tasks_max", nats.tasks_max, 10_000_000);
            }
            _ => count("job_threads", self.job_threads, 1024),
        }
        count("jobs_unfinished_max", self.jobs_unfinished_max, 100_000);
        let attempts = usize::try_from(self.job_attempts_max).unwrap_or(usize::MAX);
        count("job_attempts_max", attempts, 1_000_000);
        count("watchers_max", self.watchers_max, 100_000);
        count("limits.horizon_max", self.limits.horizon_max, 100_000);
        count("limits.generators_max", self.limits.generators_max, 10_000);
        count("limits.states_max", self.limits.states_max, 1000);
        count("limits.inputs_max", self.limits.inputs_max, 1000);
        count("limits.steps_max", self.limits.steps_max, 10_000_000);
        count("limits.polytope_rows_max", self.limits.polytope_rows_max, 100_000);
        count("limits.plan_instants_max", self.limits.plan_instants_max, PLAN_INSTANTS_MAX);
        count("limits.report_states_max", self.limits.report_states_max, 1_000_000);
        count("limits.sampled_rows_max", self.limits.sampled_rows_max, 100_000_000);
        count("limits.plant_vertices_max", self.limits.plant_vertices_max, 4096);
        count("limits.problem_bytes_max", self.limits.problem_bytes_max, 1 << 46);
        let mut time = |setting, value: Duration, (least, most): (Duration, Duration)| {
            let expected = format!("{least:?} to {most:?}");
            check((least..=most).contains(&value), setting, &expected, format!("{value:?}"));
        };
        let (tick, hour) = (Duration::from_millis(1), Duration::from_secs(3600));
        time("compute_wait", self.compute_wait, (Duration::ZERO, hour));
        time("compute_overload_wait", self.compute_overload_wait, (Duration::ZERO, hour));
        time("compute_patient_wait", self.compute_patient_wait, (Duration::ZERO, hour));
        time("computation_time_max", self.computation_time_max, (tick, hour));
        time("receive_time_max", self.receive_time_max, (tick, hour));
        time("shutdown_grace", self.shutdown_grace, (Duration::ZERO, hour));
        time("precompute_wait", self.precompute_wait, (Duration::ZERO, hour));
        time("job_time_max", self.job_time_max, (tick, 30 * DAY));
        time("operation_lifetime", self.operation_lifetime, (tick, 3650 * DAY));
        time("artifact_lifetime", self.artifact_lifetime, (tick, 3650 * DAY));
        match &self.store {
            StoreLocation::Memory { bytes_max } => {
                check(*bytes_max > 0, "store_bytes_max", "at least 1", bytes_max.to_string());
            }
            StoreLocation::Directory(_) => {}
            StoreLocation::Nats(nats) => {
                let second = Duration::from_secs(1);
                let mut time = |setting, value: Duration, least: Duration| {
                    let expected = format!("{least:?} to {hour:?}");
                    check(
                        (least..=hour).contains(&value),
                        setting,
                        &expected,
                        format!("{value:?}"),
                    );
                };
                time("job_lease", nats.lease_term, second);
                time("store_patience", nats.patience, tick);
                for server in &nats.servers {
                    let rest = ["nats://", "tls://"].iter().find_map(|s| server.strip_prefix(s));
                    let expected =
                        "nats://HOST:PORT or tls://HOST:PORT, several with commas between";
                    let good = rest.is_some_and(|rest| !rest.is_empty());
                    check(good, "store", expected, without_user(server));
                }
                let is_word = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
                let good = (1..=32).contains(&nats.name.len()) && nats.name.chars().all(is_word);
                let expected = "up to 32 letters, digits, - and _";
                check(good, "store_name", expected, nats.name.clone());
            }
        }
        let (least, most) = (RecordingOptions::BYTES_MIN, RecordingOptions::BYTES_MAX);
        let bytes_max = self.recording.bytes_max;
        let expected = format!("{least} to {most}");
        check(
            (least..=most).contains(&bytes_max),
            "record_bytes_max",
            &expected,
            bytes_max.to_string(),
        );
        faults.extend(self.access.faults().into_iter().map(ConfigFault::from));
        faults
    }
}

impl Config {
    /// What is wrong with it for a worker only.
    #[must_use]
    pub fn worker_faults(&self) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        if !matches!(self.store, StoreLocation::Nats(_)) {
            let expected = "nats://HOST:PORT: a worker does the jobs of others".to_owned();
            let got = "a store of its own".to_owned();
            faults.push(ConfigFault { setting: "store", expected, got });
        } else if self.job_threads == 0 {
            let expected = "1 to 1024".to_owned();
            faults.push(ConfigFault { setting: "job_threads", expected, got: "0".to_owned() });
        }
        faults
    }
}

/// What one source of configuration says; durations in seconds.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "each is the field of the same name in `Config` or `Limits`")]
pub struct Settings {
    pub listen: Option<SocketAddr>,
    pub allow_insecure_listen: Option<bool>,
    pub compute_threads: Option<usize>,
    pub compute_wait_s: Option<f64>,
    pub compute_overload_wait_s: Option<f64>,
    pub compute_patient_wait_s: Option<f64>,
    pub compute_waiting_max: Option<usize>,
    pub computation_time_max_s: Option<f64>,
    pub request_bytes_max: Option<usize>,
    pub connections_max: Option<usize>,
    pub streams_max: Option<u32>,
    pub receive_time_max_s: Option<f64>,
    pub shutdown_grace_s: Option<f64>,
    /// Directory of the artifact store; absent: in memory, or where `store` says.
    pub store_directory: Option<PathBuf>,
    /// `nats://host:port` of one or, with commas between, several servers.
    pub store: Option<String>,
    pub store_credentials: Option<PathBuf>,
    pub store_name: Option<String>,
    pub store_replicas: Option<usize>,
    pub store_patience_s: Option<f64>,
    pub job_lease_s: Option<f64>,
    pub tasks_max: Option<usize>,
    /// Most bytes of a store in memory.
    pub store_bytes_max: Option<usize>,
    pub store_sync: Option<bool>,
    pub cache_bytes_max: Option<usize>,
    pub job_threads: Option<usize>,
    pub jobs_unfinished_max: Option<usize>,
    pub job_time_max_s: Option<f64>,
    pub job_attempts_max: Option<u32>,
    pub precompute_wait_s: Option<f64>,
    pub operation_lifetime_s: Option<f64>,
    pub artifact_lifetime_s: Option<f64>,
    pub artifact_bytes_max: Option<u64>,
    pub watchers_max: Option<usize>,
    pub tls_certificate: Option<PathBuf>,
    pub tls_key: Option<PathBuf>,
    pub tls_client_ca: Option<PathBuf>,
    pub tokens_file: Option<PathBuf>,
    pub credentials_poll_s: Option<f64>,
    pub caller_rate_max_per_s: Option<f64>,
    pub caller_burst_max: Option<u32>,
    pub caller_calls_max: Option<u32>,
    pub caller_connections_max: Option<u32>,
    pub audit_file: Option<PathBuf>,
    pub record_file: Option<PathBuf>,
    pub record_bytes_max: Option<u64>,
    pub record_answers: Option<bool>,
    pub horizon_max: Option<usize>,
    pub generators_max: Option<usize>,
    pub states_max: Option<usize>,
    pub inputs_max: Option<usize>,
    pub steps_max: Option<usize>,
    pub polytope_rows_max: Option<usize>,
    pub plan_instants_max: Option<usize>,
    pub report_states_max: Option<usize>,
    pub sampled_rows_max: Option<usize>,
    pub plant_vertices_max: Option<usize>,
    pub problem_bytes_max: Option<usize>,
}

/// Why a source of configuration could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// The file is not what it should be; the text names line and key.
    #[error("configuration file: {0}")]
    File(String),
    /// Variables are not what they should be.
    #[error("environment: {}", .0.join("; "))]
    Environment(Vec<String>),
    /// Numbers of seconds that are not durations.
    #[error("not a duration: {}", .0.join("; "))]
    Durations(Vec<String>),
}

/// Expands `$body!(field, …)` with every setting.
macro_rules! for_each_setting {
    ($body:ident) => {
        $body!(
            listen,
            allow_insecure_listen,
            compute_threads,
            compute_wait_s,
            compute_overload_wait_s,
            compute_patient_wait_s,
            compute_waiting_max,
            computation_time_max_s,
            request_bytes_max,
            connections_max,
            streams_max,
            receive_time_max_s,
            shutdown_grace_s,
            store_directory,
            store,
            store_credentials,
            store_name,
            store_replicas,
            store_patience_s,
            job_lease_s,
            tasks_max,
            store_bytes_max,
            store_sync,
            cache_bytes_max,
            job_threads,
            jobs_unfinished_max,
            job_time_max_s,
            job_attempts_max,
            precompute_wait_s,
            operation_lifetime_s,
            artifact_lifetime_s,
            artifact_bytes_max,
            watchers_max,
            tls_certificate,
            tls_key,
            tls_client_ca,
            tokens_file,
            credentials_poll_s,
            caller_rate_max_per_s,
            caller_burst_max,
            caller_calls_max,
            caller_connections_max,
            audit_file,
            record_file,
            record_bytes_max,
            record_answers,
            horizon_max,
            generators_max,
            states_max,
            inputs_max,
            steps_max,
            polytope_rows_max,
            plan_instants_max,
            report_states_max,
            sampled_rows_max,
            plant_vertices_max,
            problem_bytes_max
        )
    };
}

// Behind the macro, which it uses.
mod listing;

impl Settings {
    /// From the text of a TOML file.
    ///
    /// # Errors
    /// [`SettingsError::File`] with line and key.
    pub fn from_toml(text: &str) -> Result<Self, SettingsError> {
        toml::from_str(text).map_err(|fault| SettingsError::File(fault.to_string()))
    }

    /// From environment variables: `VBAR_LISTEN`, `VBAR_COMPUTE_THREADS`, … Other variables are
    /// left alone, but an unknown name with the prefix is a fault: it is a typing error. Names in
    /// `others` belong to the caller.
    ///
    /// # Errors
    /// [`SettingsError::Environment`] with every fault.
    pub fn from_environment(
        variables: impl IntoIterator<Item = (String, String)>,
        others: &[&str],
    ) -> Result<Self, SettingsError> {
        let mut settings = Self::default();
        let mut faults = Vec::new();
        for (name, text) in variables {
            let Some(setting) = name.strip_prefix("VBAR_") else { continue };
            if others.contains(&name.as_str()) {
                continue;
            }
            if let Err(fault) = settings.set(&setting.to_ascii_lowercase(), &text) {
                faults.push(format!("{name}: {fault}"));
            }
        }
        if faults.is_empty() { Ok(settings) } else { Err(SettingsError::Environment(faults)) }
    }

    fn set(&mut self, setting: &str, text: &str) -> Result<(), String> {
        macro_rules! set {
            ($($field:ident),*) => {
                match setting {
                    $(stringify!($field) => {
                        let value = text.parse();
                        self.$field = Some(value.map_err(|fault| format!("{fault} in {text:?}"))?);
                    })*
                    _ => return Err("there is no such setting".to_owned()),
                }
            };
        }
        for_each_setting!(set);
        Ok(())
    }

    /// These settings where they say something, `lower` elsewhere.
    #[must_use]
    pub fn over(self, lower: Self) -> Self {
        macro_rules! over {
            ($($field:ident),*) => { Self { $($field: self.$field.or(lower.$field)),* } };
        }
        for_each_setting!(over)
    }

    /// These settings where they say something, `config` elsewhere.
    ///
    /// # Errors
    /// [`SettingsError::Durations`] with every number of seconds that is not a duration.
    pub fn apply(self, config: Config) -> Result<Config, SettingsError> {
        let mut faults = Vec::new();
        let mut time = |name: &str, given: Option<f64>, default: Duration| match given {
            None => default,
            Some(seconds) => Duration::try_from_secs_f64(seconds).unwrap_or_else(|fault| {
                faults.push(format!("{name} = {seconds}: {fault}"));
                default
            }),
        };
        let store = match (self.store, self.store_directory, self.store_bytes_max) {
            (Some(servers), _, _) => {
                let servers = servers.split(',').map(|server| server.trim().to_owned());
                let default = NatsLocation::at(servers.collect());
                StoreLocation::Nats(NatsLocation {
                    credentials: self.store_credentials.or(default.credentials),
                    name: self.store_name.unwrap_or(default.name),
                    replicas: self.store_replicas.unwrap_or(default.replicas),
                    lease_term: time("job_lease_s", self.job_lease_s, default.lease_term),
                    patience: time("store_patience_s", self.store_patience_s, default.patience),
                    tasks_max: self.tasks_max.unwrap_or(default.tasks_max),
                    servers: default.servers,
                })
            }
            (None, Some(directory), _) => StoreLocation::Directory(directory),
            (None, None, Some(bytes_max)) => StoreLocation::Memory { bytes_max },
            (None, None, None) => config.store,
        };
        let applied = Config {
            listen: self.listen.unwrap_or(config.listen),
            allow_insecure_listen: self
                .allow_insecure_listen
                .unwrap_or(config.allow_insecure_listen),
            compute_threads: self.compute_threads.unwrap_or(config.compute_threads),
            compute_wait: time("compute_wait_s", self.compute_wait_s, config.compute_wait),
            compute_overload_wait: time(
                "compute_overload_wait_s",
                self.compute_overload_wait_s,
                config.compute_overload_wait,
            ),
            compute_patient_wait: time(
                "compute_patient_wait_s",
                self.compute_patient_wait_s,
                config.compute_patient_wait,
            ),
            compute_waiting_max: self.compute_waiting_max.unwrap_or(config.compute_waiting_max),
            computation_time_max: time(
                "computation_time_max_s",
                self.computation_time_max_s,
                config.computation_time_max,
            ),
            request_bytes_max: self.request_bytes_max.unwrap_or(config.request_bytes_max),
            connections_max: self.connections_max.unwrap_or(config.connections_max),
            streams_max: self.streams_max.unwrap_or(config.streams_max),
            receive_time_max: time(
                "receive_time_max_s",
                self.receive_time_max_s,
                config.receive_time_max,
            ),
            shutdown_grace: time("shutdown_grace_s", self.shutdown_grace_s, config.shutdown_grace),
            store,
            store_sync: self.store_sync.unwrap_or(config.store_sync),
            cache_bytes_max: self.cache_bytes_max.unwrap_or(config.cache_bytes_max),
            job_threads: self.job_threads.unwrap_or(config.job_threads),
            jobs_unfinished_max: self.jobs_unfinished_max.unwrap_or(config.jobs_unfinished_max),
            job_time_max: time("job_time_max_s", self.job_time_max_s, config.job_time_max),
            job_attempts_max: self.job_attempts_max.unwrap_or(config.job_attempts_max),
            precompute_wait: time(
                "precompute_wait_s",
                self.precompute_wait_s,
                config.precompute_wait,
            ),
            operation_lifetime: time(
                "operation_lifetime_s",
                self.operation_lifetime_s,
                config.operation_lifetime,
            ),
            artifact_lifetime: time(
                "artifact_lifetime_s",
                self.artifact_lifetime_s,
                config.artifact_lifetime,
            ),
            artifact_bytes_max: self.artifact_bytes_max.unwrap_or(config.artifact_bytes_max),
            watchers_max: self.watchers_max.unwrap_or(config.watchers_max),
            access: AccessOptions {
                tls_certificate: self.tls_certificate.or(config.access.tls_certificate),
                tls_key: self.tls_key.or(config.access.tls_key),
                tls_client_ca: self.tls_client_ca.or(config.access.tls_client_ca),
                tokens_file: self.tokens_file.or(config.access.tokens_file),
                credentials_poll: time(
                    "credentials_poll_s",
                    self.credentials_poll_s,
                    config.access.credentials_poll,
                ),
                caller_rate_max_per_s: self
                    .caller_rate_max_per_s
                    .unwrap_or(config.access.caller_rate_max_per_s),
                caller_burst_max: self.caller_burst_max.unwrap_or(config.access.caller_burst_max),
                caller_calls_max: self.caller_calls_max.unwrap_or(config.access.caller_calls_max),
                caller_connections_max: self
                    .caller_connections_max
                    .unwrap_or(config.access.caller_connections_max),
                audit_file: self.audit_file.or(config.access.audit_file),
            },
            recording: RecordingOptions {
                file: self.record_file.or(config.recording.file),
                bytes_max: self.record_bytes_max.unwrap_or(config.recording.bytes_max),
                answers: self.record_answers.unwrap_or(config.recording.answers),
            },
            limits: Limits {
                horizon_max: self.horizon_max.unwrap_or(config.limits.horizon_max),
                generators_max: self.generators_max.unwrap_or(config.limits.generators_max),
                states_max: self.states_max.unwrap_or(config.limits.states_max),
                inputs_max: self.inputs_max.unwrap_or(config.limits.inputs_max),
                steps_max: self.steps_max.unwrap_or(config.limits.steps_max),
                polytope_rows_max: self
                    .polytope_rows_max
                    .unwrap_or(config.limits.polytope_rows_max),
                plan_instants_max: self
                    .plan_instants_max
                    .unwrap_or(config.limits.plan_instants_max),
                report_states_max: self
                    .report_states_max
                    .unwrap_or(config.limits.report_states_max),
                sampled_rows_max: self.sampled_rows_max.unwrap_or(config.limits.sampled_rows_max),
                plant_vertices_max: self
                    .plant_vertices_max
                    .unwrap_or(config.limits.plant_vertices_max),
                problem_bytes_max: self
                    .problem_bytes_max
                    .unwrap_or(config.limits.problem_bytes_max),
            },
        };
        if faults.is_empty() { Ok(applied) } else { Err(SettingsError::Durations(faults)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(name, value)| ((*name).into(), (*value).into())).collect()
    }

    #[test]
    fn config_default_has_no_fault() {
        assert_eq!(Config::default().faults(), []);
    }

    #[test]
    fn config_every_fault_is_named() {
        let config = Config {
            listen: "0.0.0.0:80".parse().unwrap(),
            compute_threads: 0,
            computation_time_max: Duration::ZERO,
            limits: Limits { horizon_max: 0, ..Limits::default() },
            ..Config::default()
        };
        let named: Vec<_> = config.faults().into_iter().map(|fault| fault.setting).collect();
        let expected = ["listen", "compute_threads", "limits.horizon_max", "computation_time_max"];
        assert_eq!(named, expected);
    }

    #[test]
    fn config_beyond_loopback_only_if_told_so() {
        let listen = "[::]:7878".parse().unwrap();
        let open = Config { listen, ..Config::default() };
        assert_eq!(open.faults().len(), 1);
        let told = Config { allow_insecure_listen: true, ..open };
        assert_eq!(told.faults(), []);
    }

    #[test]
    fn settings_flags_over_environment_over_file_over_defaults() {
        let file = Settings::from_toml(
            "listen = '127.0.0.1:1'\ncompute_threads = 1\nhorizon_max = 7\ncompute_wait_s = 0.25",
        )
        .unwrap();
        let environment = Settings::from_environment(
            variables(&[
                ("VBAR_LISTEN", "127.0.0.1:2"),
                ("VBAR_COMPUTE_THREADS", "2"),
                ("HOME", "x"),
            ]),
            &[],
        )
        .unwrap();
        let flags =
            Settings { listen: Some("127.0.0.1:3".parse().unwrap()), ..Settings::default() };
        let config = flags.over(environment).over(file).apply(Config::default()).unwrap();
        let expected = Config {
            listen: "127.0.0.1:3".parse().unwrap(),
            compute_threads: 2,
            compute_wait: Duration::from_millis(250),
            limits: Limits { horizon_max: 7, ..Limits::default() },
            ..Config::default()
        };
        assert_eq!(config, expected);
    }

    #[test]
    fn settings_faults_are_named() {
        let file = Settings::from_toml("listen = '127.0.0.1:1'\nhorizon = 3").unwrap_err();
        assert!(file.to_string().contains("line 2") && file.to_string().contains("horizon"));
        let environment = Settings::from_environment(
            variables(&[("VBAR_COMPUTE_THREADS", "many"), ("VBAR_LISTN", "x"), ("VBAR_LOG", "x")]),
            &["VBAR_LOG"],
        );
        let text = environment.unwrap_err().to_string();
        assert!(text.contains("VBAR_COMPUTE_THREADS") && text.contains("many"), "{text}");
        assert!(text.contains("VBAR_LISTN") && !text.contains("VBAR_LOG"), "{text}");
        let settings = Settings { compute_wait_s: Some(-1.0), ..Settings::default() };
        let fault = settings.apply(Config::default()).unwrap_err().to_string();
        assert!(fault.contains("compute_wait_s = -1"), "{fault}");
    }
}
