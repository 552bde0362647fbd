//! TLS by rustls, from PEM files.

use std::sync::Arc;

use rustls::{
    RootCertStore, ServerConfig,
    crypto::{CryptoProvider, ring},
    server::{NoServerSessionStorage, WebPkiClientVerifier, danger::ClientCertVerifier},
};
use rustls_pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject as _};

use super::{files::TlsFiles, options::OptionFault};

/// Protocols that can be agreed on, best first.
const PROTOCOLS: [&[u8]; 2] = [b"h2", b"http/1.1"];

/// What connections are taken with.
///
/// Faults never quote the files: one of them is a key.
pub(super) fn server_config(files: &TlsFiles) -> Result<ServerConfig, Vec<OptionFault>> {
    let provider = Arc::new(ring::default_provider());
    let chain = certificates("tls_certificate", &files.certificate);
    let roots = files.client_ca.as_deref();
    let verifier = roots.map(|roots| verifier(roots, &provider)).transpose();
    let key = PrivateKeyDer::from_pem_slice(&files.key)
        .map_err(|_| OptionFault::new("tls_key", "a private key in PEM", "something else"));
    let (chain, verifier, key) = match (chain, verifier, key) {
        (Ok(chain), Ok(verifier), Ok(key)) => (chain, verifier, key),
        (chain, verifier, key) => {
            let faults = [chain.err(), verifier.err(), key.err()];
            return Err(faults.into_iter().flatten().collect());
        }
    };
    let is_mutual = verifier.is_some();
    let versions = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("ring has the cipher suites of TLS 1.2 and 1.3");
    let clients = match verifier {
        Some(verifier) => versions.with_client_cert_verifier(verifier),
        None => versions.with_no_client_auth(),
    };
    let mut config = clients.with_single_cert(chain, key).map_err(|why| {
        let expected = "the key of the first certificate in tls_certificate";
        vec![OptionFault::new("tls_key", expected, why.to_string())]
    })?;
    config.alpn_protocols = PROTOCOLS.map(<[u8]>::to_vec).to_vec();
    if is_mutual {
        // A resumed session would not look at the caller's certificate again.
        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
    }
    Ok(config)
}

/// Every certificate in a PEM file; at least one.
fn certificates(
    setting: &'static str,
    pem: &[u8],
) -> Result<Vec<CertificateDer<'static>>, OptionFault> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    match read {
        Ok(certificates) if !certificates.is_empty() => Ok(certificates),
        Ok(_) | Err(_) => {
            Err(OptionFault::new(setting, "at least one certificate in PEM", "something else"))
        }
    }
}

fn verifier(
    roots: &[u8],
    provider: &Arc<CryptoProvider>,
) -> Result<Arc<dyn ClientCertVerifier>, OptionFault> {
    const SETTING: &str = "tls_client_ca";
    let fault = |got: String| OptionFault::new(SETTING, "certificates of authorities", got);
    let mut store = RootCertStore::empty();
    for root in certificates(SETTING, roots)? {
        store.add(root).map_err(|why| fault(why.to_string()))?;
    }
    WebPkiClientVerifier::builder_with_provider(Arc::new(store), Arc::clone(provider))
        .build()
        .map_err(|why| fault(why.to_string()))
}
