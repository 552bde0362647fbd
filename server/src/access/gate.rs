//! The gate: everyone passes it, whatever a call comes over.

use std::{
    net::IpAddr,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use http::{HeaderMap, header};
use rustls::ServerConfig;
use tokio::sync::OwnedSemaphorePermit;

use super::{
    AccessOptions, Right, Role, Roles,
    allowance::{Addresses, Allowance, Exceeded},
    audit::Audit,
    caller::Caller,
    certificates,
    files::{self, Digest, digest, hexadecimal},
    options::OptionFault,
    reloaded::Reloaded,
    right,
    tokens::{Shown, Tokens},
};
use crate::telemetry::{Metrics, OutcomeLabels};

const TOKENS: &str = "tokens_file";
/// Longest token that is looked at.
const TOKEN_LENGTH_MAX: usize = 512;

/// The other end of a connection.
#[derive(Debug, Clone)]
pub(crate) struct Peer {
    /// Where it is.
    pub(crate) address: IpAddr,
    /// Digest of the certificate it showed.
    certificate: Option<Digest>,
}

impl Peer {
    /// A peer with the certificate it showed, in DER.
    pub(crate) fn new(address: IpAddr, certificate: Option<&[u8]>) -> Self {
        Self { address, certificate: certificate.map(digest) }
    }
}

/// What a caller shows with one request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Credential {
    Nothing,
    /// In the header, but no bearer token.
    Unreadable,
    Shown(Shown, Digest),
}

/// Why a request is not let in.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Refusal {
    /// Nothing was shown.
    Missing,
    /// What was shown is not known here.
    Unknown,
    /// It was, until a while ago.
    Expired,
    /// The header is not `Bearer` and one token.
    Unreadable,
    /// The caller may ask for other things.
    Role {
        /// Who.
        caller: Arc<str>,
        /// What it asked for.
        call: &'static str,
        /// What that needs.
        needs: Role,
    },
    /// Too many requests.
    Rate {
        /// When to ask again.
        retry_after: Duration,
    },
    /// Too many calls under way.
    Calls {
        /// When to ask again.
        retry_after: Duration,
    },
}

/// A request that was let in.
#[derive(Debug, Clone)]
pub(crate) struct Pass {
    gate: Arc<Gate>,
    peer: Peer,
    credential: Credential,
    call: &'static str,
    caller: Caller,
    /// Held until the answer is gone.
    _place: Option<Arc<OwnedSemaphorePermit>>,
}

impl Pass {
    /// Who asks.
    pub(crate) fn caller(&self) -> &Caller {
        &self.caller
    }

    /// Whether the caller may still have what it was let in for.
    ///
    /// # Errors
    /// As for a call of its own.
    pub(crate) fn holds(&self) -> Result<(), Refusal> {
        let known = self.gate.known(&self.peer, self.credential, self.call);
        known.map(|_| ()).map_err(|(_, refusal)| refusal)
    }

    /// One more message of a call that goes on: it counts, and the caller must still be allowed
    /// what it does.
    ///
    /// # Errors
    /// As for a call of its own.
    pub(crate) fn message(&self) -> Result<(), Refusal> {
        let known = self.gate.known(&self.peer, self.credential, self.call);
        self.gate.count(known).map(|_| ()).map_err(|(_, refusal)| refusal)
    }
}

impl Refusal {
    /// Waiting helps.
    pub(crate) fn is_for_now(&self) -> bool {
        matches!(self, Self::Rate { .. } | Self::Calls { .. })
    }
}

/// Knows who may ask for what, and how much of it each has left.
#[derive(Debug)]
pub(crate) struct Gate {
    options: AccessOptions,
    tls: Option<Reloaded<ServerConfig>>,
    tokens: Option<Reloaded<Tokens>>,
    addresses: Addresses,
    audit: Audit,
    metrics: Arc<Metrics>,
}

/// A caller, and what it has left if it is not counted by its address.
struct Known {
    caller: Caller,
    allowance: Option<Arc<Allowance>>,
}

impl Gate {
    /// A gate with what the files say now. Blocks on them.
    ///
    /// # Errors
    /// Everything that is wrong with the options and the files they name.
    pub(crate) fn open(
        options: AccessOptions,
        metrics: Arc<Metrics>,
    ) -> Result<Self, Vec<OptionFault>> {
        let rate = options.rate();
        let tls = match files::read_tls(&options)? {
            None => None,
            Some(files) => {
                Some(Reloaded::new(files.digest(), certificates::server_config(&files)?))
            }
        };
        let tokens = match &options.tokens_file {
            None => None,
            Some(path) => {
                let content = files::read(TOKENS, path).map_err(|fault| vec![fault])?;
                Some(Reloaded::new(digest(&content), Tokens::read(&content, rate, None)?))
            }
        };
        let audit = Audit::open(options.audit_file.as_deref(), Arc::clone(&metrics));
        let audit = audit.map_err(|fault| vec![fault])?;
        let addresses = Addresses::new(rate, options.caller_connections_max, Instant::now());
        Ok(Self { options, tls, tokens, addresses, audit, metrics })
    }

    /// A place for a connection from `address`, held until it is dropped; `None` if there are
    /// enough from there.
    pub(crate) fn connection(&self, address: IpAddr) -> Option<OwnedSemaphorePermit> {
        self.addresses.connection(Caller::at(address, Roles::default()).name())
    }

    /// What a connection is taken with, if the port speaks TLS.
    pub(crate) fn tls(&self) -> Option<Arc<ServerConfig>> {
        self.tls.as_ref().map(Reloaded::get)
    }

    /// How often to [`reload`](Self::reload).
    pub(crate) fn poll(&self) -> Duration {
        self.options.credentials_poll
    }

    /// Where calls are written down.
    pub(crate) fn audit(&self) -> &Audit {
        &self.audit
    }

    /// Reads the files again. What is wrong is said, and what was good before stays. Blocks on
    /// files.
    pub(crate) fn reload(&self) {
        if let Some(tls) = &self.tls {
            let read = files::read_tls(&self.options).and_then(|files| {
                let gone = || vec![OptionFault::new("tls_certificate", "a file", "nothing")];
                files.ok_or_else(gone)
            });
            let renewed =
                tls.renew(read.map(|files| {
                    (files.digest(), move |_: &_| certificates::server_config(&files))
                }));
            self.say("certificates", renewed);
        }
        if let (Some(tokens), Some(path)) = (&self.tokens, &self.options.tokens_file) {
            let rate = self.options.rate();
            let read = files::read(TOKENS, path).map_err(|fault| vec![fault]);
            let renewed = tokens.renew(read.map(|content| {
                let digest = digest(&content);
                (digest, move |before: &_| Tokens::read(&content, rate, Some(before)))
            }));
            self.say("tokens", renewed);
        }
    }

    fn say(&self, what: &'static str, renewed: Option<Result<(), Vec<OptionFault>>>) {
        let outcome = match renewed {
            None => return,
            Some(Ok(())) => {
                tracing::info!(what, "credentials were read again");
                "loaded"
            }
            Some(Err(faults)) => {
                for OptionFault { setting, expected, got } in faults {
                    tracing::error!(
                        what,
                        setting,
                        expected,
                        got,
                        "changed credentials cannot be used; those before stay in force"
                    );
                }
                "refused"
            }
        };
        self.metrics.credential_reloads.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// Lets a request in, or says who is not let in and why.
    ///
    /// # Errors
    /// [`Refusal`].
    pub(crate) fn admit(
        self: &Arc<Self>,
        peer: &Peer,
        headers: &HeaderMap,
        call: &'static str,
    ) -> Result<Pass, (Caller, Refusal)> {
        let pass = |credential, caller, place| Pass {
            gate: Arc::clone(self),
            peer: peer.clone(),
            credential,
            call,
            caller,
            _place: place,
        };
        if right(call) == Right::Open {
            let caller = Caller::at(peer.address, Roles::default());
            return Ok(pass(Credential::Nothing, caller, None));
        }
        let credential = self.credential(peer, headers);
        let known = self.known(peer, credential, call);
        let admitted = self.count(known).and_then(|known| {
            let place = self.allowance(&known).call();
            match place {
                Ok(place) => Ok(pass(credential, known.caller, Some(Arc::new(place)))),
                Err(exceeded) => Err((known.caller, exceeded.into())),
            }
        });
        let outcome = match &admitted {
            Ok(_) => "admitted",
            Err((_, Refusal::Role { .. })) => "role",
            Err((_, Refusal::Rate { .. })) => "rate",
            Err((_, Refusal::Calls { .. })) => "calls",
            Err(_) => "unauthenticated",
        };
        self.metrics.admissions.get_or_create(&OutcomeLabels { outcome }).inc();
        admitted
    }

    /// What a request shows. A token counts more than a certificate: a caller that shows both
    /// asks in the token's name.
    fn credential(&self, peer: &Peer, headers: &HeaderMap) -> Credential {
        let certificate = peer.certificate.map(|digest| (Shown::Certificate, digest));
        let mut given = headers.get_all(header::AUTHORIZATION).iter();
        let (true, Some(value)) = (self.tokens.is_some(), given.next()) else {
            return certificate
                .map_or(Credential::Nothing, |(shown, digest)| Credential::Shown(shown, digest));
        };
        match bearer(value.as_bytes()).filter(|_| given.next().is_none()) {
            Some(token) => Credential::Shown(Shown::Token, digest(token)),
            None => Credential::Unreadable,
        }
    }

    /// Who shows `credential`, and whether it may call `call`; if it is not known, who is to be
    /// counted for it.
    fn known(
        &self,
        peer: &Peer,
        credential: Credential,
        call: &'static str,
    ) -> Result<Known, (Known, Refusal)> {
        let at_address = |roles| Known { caller: Caller::at(peer.address, roles), allowance: None };
        let unknown = |refusal| Err((at_address(Roles::default()), refusal));
        let known = match (credential, &self.tokens) {
            (Credential::Nothing, _) if !self.options.is_authenticated() => at_address(Roles::ALL),
            (Credential::Nothing, _) => return unknown(Refusal::Missing),
            (Credential::Unreadable, _) => return unknown(Refusal::Unreadable),
            // The authority vouches for all it signed alike.
            (Credential::Shown(_, digest), None) => {
                let name = format!("certificate-{}", &hexadecimal(&digest)[..16]);
                Known { caller: Caller::named(name.into(), Roles::ALL), allowance: None }
            }
            (Credential::Shown(shown, digest), Some(tokens)) => {
                let tokens = tokens.get();
                let Some(entry) = tokens.find(shown, &digest) else {
                    return unknown(Refusal::Unknown);
                };
                if entry.has_expired(SystemTime::now()) {
                    return unknown(Refusal::Expired);
                }
                let allowance = Some(Arc::clone(&entry.allowance));
                Known { caller: entry.caller.clone(), allowance }
            }
        };
        match right(call) {
            Right::Role(needs) if !known.caller.roles().allow(needs) => {
                let caller = Arc::clone(known.caller.name());
                Err((known, Refusal::Role { caller, call, needs }))
            }
            _ => Ok(known),
        }
    }

    /// Counts a request, whether it is let in or not.
    fn count(&self, known: Result<Known, (Known, Refusal)>) -> Result<Known, (Caller, Refusal)> {
        let (known, refusal) = match known {
            Ok(known) => (known, None),
            Err((known, refusal)) => (known, Some(refusal)),
        };
        if let Err(exceeded) = self.allowance(&known).request(Instant::now()) {
            return Err((known.caller, exceeded.into()));
        }
        match refusal {
            None => Ok(known),
            Some(refusal) => Err((known.caller, refusal)),
        }
    }

    fn allowance<'a>(&'a self, known: &'a Known) -> &'a Allowance {
        match &known.allowance {
            Some(allowance) => allowance,
            None => self.addresses.of(known.caller.name()),
        }
    }
}

impl From<Exceeded> for Refusal {
    fn from(exceeded: Exceeded) -> Self {
        match exceeded {
            Exceeded::Rate(retry_after) => Self::Rate { retry_after },
            Exceeded::Calls(retry_after) => Self::Calls { retry_after },
        }
    }
}

/// The token in `Bearer TOKEN` (RFC 6750, sec. 2.1).
pub(crate) fn bearer(header: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = header.split_at_checked(7)?;
    let is_fit = |c: &u8| c.is_ascii_alphanumeric() || b"-._~+/=".contains(c);
    (scheme.eq_ignore_ascii_case(b"bearer ")
        && (1..=TOKEN_LENGTH_MAX).contains(&token.len())
        && token.iter().all(is_fit))
    .then_some(token)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bearer_is_one_token_of_the_letters_allowed() {
        assert_eq!(bearer(b"Bearer vbar_0-9._~+/=="), Some(&b"vbar_0-9._~+/=="[..]));
        assert_eq!(bearer(b"bEARER x"), Some(&b"x"[..]));
        let longest = [b"Bearer ", &[b'x'; TOKEN_LENGTH_MAX][..]].concat();
        assert!(bearer(&longest).is_some());
        let longer = [&longest[..], b"x"].concat();
        let malformed: [&[u8]; 9] = [
            b"",
            b"Bearer",
            b"Bearer ",
            b"Bearer  x",
            b"Bearer x y",
            b"Bearer x ",
            b"Basic eDp5",
            b"Bearer \xff",
            &longer,
        ];
        for header in malformed {
            assert_eq!(bearer(header), None, "{header:?}");
        }
    }
}
