//! Where a store on NATS is.

use std::{fmt, path::PathBuf, time::Duration};

/// A store on NATS JetStream.
#[derive(Clone, PartialEq, Eq)]
pub struct NatsLocation {
    /// `nats://host:port` or `tls://host:port`, with user and password if need be.
    pub servers: Vec<String>,
    /// A file of credentials.
    pub credentials: Option<PathBuf>,
    /// First word of the name of every stream.
    pub name: String,
    /// Copies of everything: as many servers but one may be lost, rounded down to a minority.
    pub replicas: usize,
    /// How long a part of a job stays with a worker that says nothing.
    pub lease_term: Duration,
    /// How long an operation is tried before the store is said not to answer.
    pub patience: Duration,
    /// Most parts of jobs that wait; more are refused.
    pub tasks_max: usize,
}

impl NatsLocation {
    /// These servers with the settings' defaults.
    #[must_use]
    pub fn at(servers: Vec<String>) -> Self {
        Self {
            servers,
            credentials: None,
            name: "vbar".to_owned(),
            replicas: 1,
            lease_term: Duration::from_secs(30),
            patience: Duration::from_secs(5),
            tasks_max: 100_000,
        }
    }
}

/// Addresses can hold passwords.
impl fmt::Debug for NatsLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let servers = self.servers.iter().map(|server| without_user(server));
        f.debug_struct("NatsLocation")
            .field("servers", &servers.collect::<Vec<_>>())
            .field("name", &self.name)
            .field("replicas", &self.replicas)
            .finish_non_exhaustive()
    }
}

/// An address without user and password, whether it has a scheme or lacks it by mistake.
pub(crate) fn without_user(address: &str) -> String {
    let Some((user, host)) = address.rsplit_once('@') else { return address.to_owned() };
    match user.split_once("://") {
        Some((scheme, _)) => format!("{scheme}://{host}"),
        None => host.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_is_shown_without_user_and_password() {
        for (address, shown) in [
            ("nats://a:1", "nats://a:1"),
            ("tls://user:secret@a:1", "tls://a:1"),
            ("tls://user:sec@ret@a:1", "tls://a:1"),
            ("user:secret@a:1", "a:1"),
        ] {
            assert_eq!(without_user(address), shown);
        }
    }
}
