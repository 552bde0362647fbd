//! What a node is told about access.

use std::{path::PathBuf, time::Duration};

use super::{
    allowance::{Rate, count_fault},
    certificates, files,
    tokens::Tokens,
};

/// Who may ask, and how much.
#[derive(Debug, Clone, PartialEq)]
pub struct AccessOptions {
    /// PEM file with the node's certificate and those between it and its root. With it the port
    /// speaks TLS and nothing else.
    pub tls_certificate: Option<PathBuf>,
    /// PEM file with the key of that certificate.
    pub tls_key: Option<PathBuf>,
    /// PEM file with the roots of callers' certificates. With it every caller must show one.
    pub tls_client_ca: Option<PathBuf>,
    /// TOML file that names tokens and certificates, and says what their holders may do.
    pub tokens_file: Option<PathBuf>,
    /// How often the files above are read again.
    pub credentials_poll: Duration,
    /// Requests and messages of closed loops that one caller may send in a second, on average.
    pub caller_rate_max_per_s: f64,
    /// How many it may send at once after a silence.
    pub caller_burst_max: u32,
    /// How many of its calls may be under way at once.
    pub caller_calls_max: u32,
    /// How many connections one address may hold open.
    pub caller_connections_max: u32,
    /// File that every call is written down in, one line of JSON each.
    pub audit_file: Option<PathBuf>,
}

impl Default for AccessOptions {
    fn default() -> Self {
        Self {
            tls_certificate: None,
            tls_key: None,
            tls_client_ca: None,
            tokens_file: None,
            credentials_poll: Duration::from_secs(5),
            caller_rate_max_per_s: 5000.0,
            caller_burst_max: 10_000,
            caller_calls_max: 512,
            caller_connections_max: 512,
            audit_file: None,
        }
    }
}

/// One thing that is wrong with them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OptionFault {
    /// Name of the setting.
    pub(crate) setting: &'static str,
    /// What would be right.
    pub(crate) expected: String,
    /// What was found.
    pub(crate) got: String,
}

impl OptionFault {
    pub(super) fn new(
        setting: &'static str,
        expected: impl Into<String>,
        got: impl Into<String>,
    ) -> Self {
        Self { setting, expected: expected.into(), got: got.into() }
    }
}

impl AccessOptions {
    /// The port speaks TLS.
    #[must_use]
    pub fn is_encrypted(&self) -> bool {
        self.tls_certificate.is_some()
    }

    /// Callers must say who they are.
    #[must_use]
    pub fn is_authenticated(&self) -> bool {
        self.tokens_file.is_some() || self.tls_client_ca.is_some()
    }

    /// Everything that is wrong, in the options and in the files they name.
    pub(crate) fn faults(&self) -> Vec<OptionFault> {
        let mut faults = Vec::new();
        let missing = "a file, since the other of tls_certificate and tls_key is given";
        match (&self.tls_certificate, &self.tls_key) {
            (Some(_), None) => faults.push(OptionFault::new("tls_key", missing, "nothing")),
            (None, Some(_)) => faults.push(OptionFault::new("tls_certificate", missing, "nothing")),
            _ => {}
        }
        if self.tls_client_ca.is_some() && !self.is_encrypted() {
            let expected = "a file: tls_client_ca asks callers for certificates over TLS";
            faults.push(OptionFault::new("tls_certificate", expected, "nothing"));
        }
        if faults.is_empty() {
            let read = files::read_tls(self).and_then(|files| match files {
                Some(files) => certificates::server_config(&files).map(|_| ()),
                None => Ok(()),
            });
            faults.extend(read.err().into_iter().flatten());
        }
        if let Some(path) = &self.tokens_file {
            let read = files::read("tokens_file", path)
                .map_err(|fault| vec![fault])
                .and_then(|text| Tokens::read(&text, self.rate(), None));
            faults.extend(read.err().into_iter().flatten());
        }
        faults.extend(self.rate().faults());
        faults.extend(count_fault("caller_connections_max", self.caller_connections_max));
        let polls = Duration::from_millis(10)..=Duration::from_secs(3600);
        if !polls.contains(&self.credentials_poll) {
            let got = format!("{:?}", self.credentials_poll);
            faults.push(OptionFault::new("credentials_poll", "10ms to 3600s", got));
        }
        faults
    }

    /// What a caller may do unless its entry says otherwise.
    pub(super) fn rate(&self) -> Rate {
        Rate {
            per_s: self.caller_rate_max_per_s,
            burst: self.caller_burst_max,
            calls_max: self.caller_calls_max,
        }
    }
}
