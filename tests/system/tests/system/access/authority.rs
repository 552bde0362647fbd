//! Certificates for tests, and files with them.

use std::path::{Path, PathBuf};

use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa,
    KeyPair, KeyUsagePurpose, date_time_ymd,
};
use sha2::{Digest as _, Sha256};
use vbar_client::Credentials;
use vbar_server::AccessOptions;

/// Digest as it is written in files.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// An authority that signs what it is asked to.
pub(crate) struct Authority(CertifiedIssuer<'static, KeyPair>);

/// A certificate with its key, in PEM.
pub(crate) struct Certificate {
    pub(crate) pem: String,
    pub(crate) key: String,
    /// Of its DER, as files of tokens name it.
    pub(crate) sha256: String,
}

impl Authority {
    pub(crate) fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        Self(CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap())
    }

    pub(crate) fn pem(&self) -> Vec<u8> {
        self.0.pem().into_bytes()
    }

    /// For a node on this machine.
    pub(crate) fn node(&self) -> Certificate {
        let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
        self.sign(CertificateParams::new(names).unwrap(), ExtendedKeyUsagePurpose::ServerAuth)
    }

    /// For a caller; good until the year given.
    pub(crate) fn caller(&self, name: &str, until: i32) -> Certificate {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.not_after = date_time_ymd(until, 1, 1);
        self.sign(params, ExtendedKeyUsagePurpose::ClientAuth)
    }

    fn sign(&self, mut params: CertificateParams, purpose: ExtendedKeyUsagePurpose) -> Certificate {
        params.extended_key_usages = vec![purpose];
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.0).unwrap();
        let (pem, sha256) = (certificate.pem(), sha256(certificate.der()));
        Certificate { pem, key: key.serialize_pem(), sha256 }
    }
}

/// The files of a node.
pub(crate) struct Files(tempfile::TempDir);

impl Files {
    pub(crate) fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file in one step, as those who replace credentials should.
    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let (new, path) = (self.path("new"), self.path(name));
        std::fs::write(&new, content).unwrap();
        std::fs::rename(&new, &path).unwrap();
        path
    }

    /// Options for a node with `certificate`, which asks callers for one of `callers`.
    pub(crate) fn tls(
        &self,
        certificate: &Certificate,
        callers: Option<&Authority>,
    ) -> AccessOptions {
        AccessOptions {
            tls_certificate: Some(self.write("node.pem", &certificate.pem)),
            tls_key: Some(self.write("node.key", &certificate.key)),
            tls_client_ca: callers.map(|callers| self.write("callers.pem", callers.pem())),
            ..AccessOptions::default()
        }
    }
}

/// What a caller needs to believe a node of `authority` and to show `own`.
pub(crate) fn credentials(authority: &Authority, own: Option<&Certificate>) -> Credentials {
    Credentials {
        tls_ca: Some(authority.pem()),
        tls_certificate: own.map(|own| own.pem.clone().into_bytes()),
        tls_key: own.map(|own| own.key.clone().into_bytes()),
        ..Credentials::default()
    }
}

/// An entry of a file of tokens.
pub(crate) fn entry(table: &str, name: &str, sha256: &str, roles: &[&str], more: &str) -> String {
    format!("[[{table}]]\nname = '{name}'\nsha256 = '{sha256}'\nroles = {roles:?}\n{more}\n")
}

/// One for a token.
pub(crate) fn token_entry(name: &str, token: &str, roles: &[&str], more: &str) -> String {
    entry("token", name, &sha256(token.as_bytes()), roles, more)
}

/// The text of a file.
pub(crate) fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}
