//! Whom a client believes, and how it says who it is.

use std::{fmt, net::IpAddr};

use http::Uri;
use tonic::{
    Code, Request, Status,
    metadata::{Ascii, MetadataValue},
    service::Interceptor,
    transport::{Certificate, ClientTlsConfig, Identity},
};

use crate::{Error, Options};

/// Whom to believe, and how to say who asks. Never shown by `Debug`.
#[derive(Clone, Default)]
pub struct Credentials {
    /// Certificates, in PEM, of the authorities that vouch for the node; needed for `https://`.
    pub tls_ca: Option<Vec<u8>>,
    /// A certificate of the caller's own, in PEM, with those between it and its root.
    pub tls_certificate: Option<Vec<u8>>,
    /// The key of that certificate, in PEM.
    pub tls_key: Option<Vec<u8>>,
    /// A token for the header `authorization`.
    pub token: Option<String>,
    /// Send the token in clear to another machine, where something else keeps it from others.
    pub allow_insecure_token: bool,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Credentials")
            .field("tls_ca", &self.tls_ca.is_some())
            .field("tls_certificate", &self.tls_certificate.is_some())
            .field("tls_key", &self.tls_key.is_some())
            .field("token", &self.token.is_some())
            .field("allow_insecure_token", &self.allow_insecure_token)
            .finish()
    }
}

/// How to encrypt calls to `url`; `None` for `http://`.
pub(crate) fn tls(url: &Uri, options: &Options) -> Result<Option<ClientTlsConfig>, Error> {
    let refused = |why: &str| Err(Error::local(Code::InvalidArgument, why));
    let credentials = &options.credentials;
    if url.scheme_str() != Some("https") {
        let has_certificate = credentials.tls_certificate.is_some();
        if has_certificate || credentials.tls_ca.is_some() {
            return refused("certificates are for https://, and the node's URL is http://");
        }
        if credentials.token.is_some() && !credentials.allow_insecure_token && !is_near(url) {
            return refused(
                "the token would go to another machine in clear: use https://, or say that this \
                 is allowed (allow_insecure_token)",
            );
        }
        return Ok(None);
    }
    let Some(ca) = &credentials.tls_ca else {
        return refused("https:// needs the certificates of the authorities to believe (tls_ca)");
    };
    let config = ClientTlsConfig::new()
        .timeout(options.connect_timeout)
        .ca_certificate(Certificate::from_pem(ca));
    match (&credentials.tls_certificate, &credentials.tls_key) {
        (None, None) => Ok(Some(config)),
        (Some(certificate), Some(key)) => {
            Ok(Some(config.identity(Identity::from_pem(certificate, key))))
        }
        _ => refused("a certificate of one's own needs its key, and a key its certificate"),
    }
}

/// On this machine.
fn is_near(url: &Uri) -> bool {
    let host = url.host().unwrap_or_default().trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Puts the token on every call.
#[derive(Debug, Clone)]
pub(crate) struct Bearer(Option<MetadataValue<Ascii>>);

impl Bearer {
    pub(crate) fn new(credentials: &Credentials) -> Result<Self, Error> {
        let Some(token) = &credentials.token else { return Ok(Self(None)) };
        let is_fit = |c: u8| c.is_ascii_alphanumeric() || b"-._~+/=".contains(&c);
        let fault = || Error::local(Code::InvalidArgument, "the token has letters no token has");
        if token.is_empty() || !token.bytes().all(is_fit) {
            return Err(fault());
        }
        let mut value = MetadataValue::try_from(format!("Bearer {token}")).map_err(|_| fault())?;
        value.set_sensitive(true);
        Ok(Self(Some(value)))
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(url: &str, credentials: Credentials) -> Result<bool, String> {
        let options = Options { credentials, ..Options::default() };
        tls(&url.parse().unwrap(), &options).map(|tls| tls.is_some()).map_err(|e| e.message)
    }

    #[test]
    fn credentials_are_refused_where_they_would_be_lost_or_of_no_use() {
        let token = Credentials { token: Some("vbar_x".into()), ..Credentials::default() };
        for near in ["http://127.0.0.1:1", "http://[::1]:1", "http://localhost:1"] {
            assert_eq!(judged(near, token.clone()), Ok(false), "{near}");
        }
        for far in ["http://10.0.0.7:1", "http://node:1", "http://127.0.0.1.example.com:1"] {
            assert!(judged(far, token.clone()).unwrap_err().contains("in clear"), "{far}");
            let allowed = Credentials { allow_insecure_token: true, ..token.clone() };
            assert_eq!(judged(far, allowed), Ok(false), "{far}");
        }
        let nothing = Credentials::default();
        assert!(judged("https://node:1", nothing).unwrap_err().contains("tls_ca"));
        let ca = Credentials { tls_ca: Some(Vec::new()), ..Credentials::default() };
        assert_eq!(judged("https://node:1", ca.clone()), Ok(true));
        assert!(judged("http://node:1", ca.clone()).unwrap_err().contains("https"));
        let half = Credentials { tls_key: Some(Vec::new()), ..ca };
        assert!(judged("https://node:1", half).unwrap_err().contains("certificate"));
        for token in ["", "two words", "x\n", "é"] {
            let credentials = Credentials { token: Some(token.into()), ..Credentials::default() };
            assert!(Bearer::new(&credentials).is_err(), "{token:?}");
        }
    }

    #[test]
    fn credentials_are_never_shown() {
        let secret = || Some(b"secret".to_vec());
        let credentials = Credentials {
            tls_ca: secret(),
            tls_certificate: secret(),
            tls_key: secret(),
            token: Some("secret".into()),
            allow_insecure_token: true,
        };
        let shown = format!("{:?} {:?}", Bearer::new(&credentials).unwrap(), credentials);
        assert!(!shown.contains("secret"), "{shown}");
        // The same as numbers.
        assert!(!shown.contains("115"), "{shown}");
    }
}
