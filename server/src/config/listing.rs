//! A configuration as the settings it came from, and where each was said.

use std::time::Duration;

use serde_json::Value;
use toml::Spanned;

use super::{Config, NatsLocation, Settings, SettingsError, StoreLocation};
use crate::{
    access::AccessOptions, recording::RecordingOptions, store::without_user, wire::Limits,
};

/// Settings of each source, the strongest first, with what to call it.
#[derive(Debug, Default)]
pub struct Sources {
    /// From the command line.
    pub flags: Settings,
    /// From the environment.
    pub environment: Settings,
    /// From a file.
    pub file: Settings,
    /// Its name and its text.
    pub file_text: Option<(String, String)>,
}

/// One setting in force.
#[derive(Debug, Clone, PartialEq)]
pub struct ListedSetting {
    /// Its name, as in a file.
    pub name: &'static str,
    /// Its value, passwords left out; `None` if it has none.
    pub value: Option<Value>,
    /// Where it was said: `flag`, `environment VBAR_…`, `FILE:LINE`, `default`.
    pub source: String,
}

impl Sources {
    /// What all of them say together over `config`.
    ///
    /// # Errors
    /// As [`Settings::apply`].
    pub fn apply(&self, config: Config) -> Result<Config, SettingsError> {
        let Self { flags, environment, file, .. } = self;
        flags.clone().over(environment.clone()).over(file.clone()).apply(config)
    }

    /// Every setting of `config`, which came from these, in the order of the documentation.
    #[must_use]
    pub fn list(&self, config: &Config) -> Vec<ListedSetting> {
        let values = config.settings();
        let mut list = Vec::new();
        macro_rules! list {
            ($($field:ident),*) => {{$(
                let name = stringify!($field);
                let value = values.$field.as_ref().map(|value| {
                    serde_json::to_value(value).unwrap_or(Value::Null)
                });
                let source = if self.flags.$field.is_some() {
                    "flag".to_owned()
                } else if self.environment.$field.is_some() {
                    format!("environment VBAR_{}", name.to_ascii_uppercase())
                } else if self.file.$field.is_some() {
                    self.place(name)
                } else {
                    "default".to_owned()
                };
                list.push(ListedSetting { name, value: value.map(public), source });
            )*}};
        }
        for_each_setting!(list);
        list
    }

    /// File and line of a setting.
    fn place(&self, name: &str) -> String {
        type Table = std::collections::BTreeMap<String, Spanned<toml::Value>>;
        let Some((file, text)) = &self.file_text else { return "file".to_owned() };
        let table = toml::from_str::<Table>(text).unwrap_or_default();
        match table.get(name).and_then(|value| text.get(..value.span().start)) {
            Some(before) => format!("{file}:{}", before.matches('\n').count() + 1),
            None => file.clone(),
        }
    }
}

/// A value without passwords: addresses of servers can hold some.
fn public(value: Value) -> Value {
    match value {
        Value::String(text) if text.contains('@') && text.contains("://") => {
            let servers = text.split(',').map(|server| match without_user(server) {
                public if public == server => public,
                public => public.replacen("://", "://(set)@", 1),
            });
            servers.collect::<Vec<_>>().join(",").into()
        }
        value => value,
    }
}

impl Settings {
    /// The text of a file that says the same.
    #[must_use]
    pub fn to_toml(&self) -> String {
        // Lists, tables and numbers without an end have no place in settings.
        toml::to_string(self).unwrap_or_default()
    }
}

impl Config {
    /// The settings that decide how a request is answered.
    #[must_use]
    pub fn answering(&self) -> Settings {
        let all = self.settings();
        Settings {
            computation_time_max_s: all.computation_time_max_s,
            request_bytes_max: all.request_bytes_max,
            artifact_bytes_max: all.artifact_bytes_max,
            ..self.limit_settings()
        }
    }

    fn limit_settings(&self) -> Settings {
        let Limits {
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
            problem_bytes_max,
        } = self.limits;
        Settings {
            horizon_max: Some(horizon_max),
            generators_max: Some(generators_max),
            states_max: Some(states_max),
            inputs_max: Some(inputs_max),
            steps_max: Some(steps_max),
            polytope_rows_max: Some(polytope_rows_max),
            plan_instants_max: Some(plan_instants_max),
            report_states_max: Some(report_states_max),
            sampled_rows_max: Some(sampled_rows_max),
            plant_vertices_max: Some(plant_vertices_max),
            problem_bytes_max: Some(problem_bytes_max),
            ..Settings::default()
        }
    }

    fn access_settings(&self) -> Settings {
        let AccessOptions {
            tls_certificate,
            tls_key,
            tls_client_ca,
            tokens_file,
            credentials_poll,
            caller_rate_max_per_s,
            caller_burst_max,
            caller_calls_max,
            caller_connections_max,
            audit_file,
        } = self.access.clone();
        Settings {
            tls_certificate,
            tls_key,
            tls_client_ca,
            tokens_file,
            credentials_poll_s: seconds(credentials_poll),
            caller_rate_max_per_s: Some(caller_rate_max_per_s),
            caller_burst_max: Some(caller_burst_max),
            caller_calls_max: Some(caller_calls_max),
            caller_connections_max: Some(caller_connections_max),
            audit_file,
            ..self.limit_settings()
        }
    }

    fn store_settings(&self) -> Settings {
        let rest = self.access_settings();
        match self.store.clone() {
            StoreLocation::Memory { bytes_max } => {
                Settings { store_bytes_max: Some(bytes_max), ..rest }
            }
            StoreLocation::Directory(directory) => {
                Settings { store_directory: Some(directory), ..rest }
            }
            StoreLocation::Nats(NatsLocation {
                servers,
                credentials,
                name,
                replicas,
                lease_term,
                patience,
                tasks_max,
            }) => Settings {
                store: Some(servers.join(",")),
                store_credentials: credentials,
                store_name: Some(name),
                store_replicas: Some(replicas),
                job_lease_s: seconds(lease_term),
                store_patience_s: seconds(patience),
                tasks_max: Some(tasks_max),
                ..rest
            },
        }
    }

    /// The settings that say everything this configuration says. Taken apart without a rest, so
    /// that a new field cannot be forgotten here.
    #[must_use]
    pub fn settings(&self) -> Settings {
        let rest = self.store_settings();
        let Self {
            listen,
            allow_insecure_listen,
            compute_threads,
            compute_wait,
            compute_overload_wait,
            compute_patient_wait,
            compute_waiting_max,
            computation_time_max,
            request_bytes_max,
            connections_max,
            streams_max,
            receive_time_max,
            shutdown_grace,
            store: _,
            store_sync,
            cache_bytes_max,
            job_threads,
            jobs_unfinished_max,
            job_time_max,
            job_attempts_max,
            precompute_wait,
            operation_lifetime,
            artifact_lifetime,
            artifact_bytes_max,
            watchers_max,
            access: _,
            recording,
            limits: _,
        } = self.clone();
        let RecordingOptions { file, bytes_max, answers } = recording;
        Settings {
            listen: Some(listen),
            allow_insecure_listen: Some(allow_insecure_listen),
            compute_threads: Some(compute_threads),
            compute_wait_s: seconds(compute_wait),
            compute_overload_wait_s: seconds(compute_overload_wait),
            compute_patient_wait_s: seconds(compute_patient_wait),
            compute_waiting_max: Some(compute_waiting_max),
            computation_time_max_s: seconds(computation_time_max),
            request_bytes_max: Some(request_bytes_max),
            connections_max: Some(connections_max),
            streams_max: Some(streams_max),
            receive_time_max_s: seconds(receive_time_max),
            shutdown_grace_s: seconds(shutdown_grace),
            store_sync: Some(store_sync),
            cache_bytes_max: Some(cache_bytes_max),
            job_threads: Some(job_threads),
            jobs_unfinished_max: Some(jobs_unfinished_max),
            job_time_max_s: seconds(job_time_max),
            job_attempts_max: Some(job_attempts_max),
            precompute_wait_s: seconds(precompute_wait),
            operation_lifetime_s: seconds(operation_lifetime),
            artifact_lifetime_s: seconds(artifact_lifetime),
            artifact_bytes_max: Some(artifact_bytes_max),
            watchers_max: Some(watchers_max),
            record_file: file,
            record_bytes_max: Some(bytes_max),
            record_answers: Some(answers),
            ..rest
        }
    }
}

#[allow(clippy::unnecessary_wraps, reason = "every setting is optional")]
fn seconds(time: Duration) -> Option<f64> {
    Some(time.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every setting, as a file that differs from the defaults in all of them; of the three places
    /// for a store only one counts, so there are three files.
    const FILES: [&str; 3] = [
        "store_directory = '/data'",
        "store_bytes_max = 77",
        "store = 'nats://user:secret@a:1,nats://b:2'\nstore_credentials = '/c'\nstore_name = 'x'\n\
         store_replicas = 3\nstore_patience_s = 1.5\njob_lease_s = 2.5\ntasks_max = 7",
    ];
    const REST: &str = "
listen = '127.0.0.1:17'
allow_insecure_listen = true
compute_threads = 3
compute_wait_s = 0.25
compute_overload_wait_s = 0.5
compute_patient_wait_s = 0.75
compute_waiting_max = 5
computation_time_max_s = 6.5
request_bytes_max = 7
connections_max = 8
streams_max = 9
receive_time_max_s = 10.5
shutdown_grace_s = 11.5
store_sync = false
cache_bytes_max = 12
job_threads = 13
jobs_unfinished_max = 14
job_time_max_s = 15.5
job_attempts_max = 16
precompute_wait_s = 17.5
operation_lifetime_s = 18.5
artifact_lifetime_s = 19.5
artifact_bytes_max = 20
watchers_max = 21
tls_certificate = '/certificate'
tls_key = '/key'
tls_client_ca = '/ca'
tokens_file = '/tokens'
credentials_poll_s = 22.5
caller_rate_max_per_s = 23.5
caller_burst_max = 24
caller_calls_max = 25
caller_connections_max = 26
audit_file = '/audit'
record_file = '/record'
record_bytes_max = 27
record_answers = false
horizon_max = 28
generators_max = 29
states_max = 30
inputs_max = 31
steps_max = 32
polytope_rows_max = 33
plan_instants_max = 34
report_states_max = 35
sampled_rows_max = 36
plant_vertices_max = 37
problem_bytes_max = 38
";

    fn sources(store: &str) -> Sources {
        let text = format!("{store}{REST}");
        let file = Settings::from_toml(&text).unwrap();
        Sources { file, file_text: Some(("node.toml".into(), text)), ..Sources::default() }
    }

    #[test]
    fn listing_has_every_setting_of_a_file_with_its_line() {
        let mut seen = std::collections::BTreeSet::new();
        for store in FILES {
            let sources = sources(store);
            let config = sources.apply(Config::default()).unwrap();
            let (_, text) = sources.file_text.as_ref().unwrap();
            let given: toml::Table = toml::from_str(text).unwrap();
            let list = sources.list(&config);
            for setting in &list {
                let Some(given) = given.get(setting.name) else {
                    assert_eq!((&setting.value, &*setting.source), (&None, "default"));
                    continue;
                };
                seen.insert(setting.name);
                let value = setting.value.as_ref().expect(setting.name);
                if setting.name == "store" {
                    assert_eq!(value, "nats://(set)@a:1,nats://b:2");
                } else {
                    assert_eq!(*value, serde_json::to_value(given).unwrap(), "{}", setting.name);
                }
                let line = text.lines().position(|l| l.starts_with(&format!("{} =", setting.name)));
                let place = format!("node.toml:{}", line.unwrap() + 1);
                assert_eq!(setting.source, place, "{}", setting.name);
            }
            assert!(given.keys().all(|name| list.iter().any(|listed| listed.name == name)));
        }
        let all = Sources::default().list(&Config::default());
        assert_eq!(seen.len(), all.len(), "a setting is missing in this test's files");
    }

    #[test]
    fn settings_of_a_configuration_make_it_again() {
        for store in FILES {
            let config = sources(store).apply(Config::default()).unwrap();
            assert_ne!(config, Config::default());
            let again = Settings::from_toml(&config.settings().to_toml()).unwrap();
            assert_eq!(again.apply(Config::default()).unwrap(), config);
        }
    }

    #[test]
    fn listing_names_the_strongest_source() {
        let flags = Settings { compute_threads: Some(1), ..Settings::default() };
        let variables = ["VBAR_COMPUTE_THREADS", "VBAR_STREAMS_MAX"];
        let variables = variables.map(|name| (name.to_owned(), "2".to_owned()));
        let environment = Settings::from_environment(variables, &[]).unwrap();
        let sources = Sources { flags, environment, ..sources(FILES[0]) };
        let config = sources.apply(Config::default()).unwrap();
        let list = sources.list(&config);
        let of = |name: &str| list.iter().find(|listed| listed.name == name).unwrap();
        for (name, value, source) in [
            ("compute_threads", 1, "flag"),
            ("streams_max", 2, "environment VBAR_STREAMS_MAX"),
            ("connections_max", 8, "node.toml:11"),
        ] {
            assert_eq!(of(name).value, Some(value.into()), "{name}");
            assert_eq!(of(name).source, source, "{name}");
        }
        assert!(Sources::default().list(&config).iter().all(|listed| listed.source == "default"));
    }
}
