//! Files with credentials, read within bounds.

use std::{
    fs::File,
    io::{self, Read as _},
    path::Path,
};

use sha2::{Digest as _, Sha256};

use super::{AccessOptions, options::OptionFault};

/// Largest file that is read.
const BYTES_MAX: u64 = 1 << 20;

/// SHA-256.
pub(super) type Digest = [u8; 32];

/// The digest of `bytes`.
pub(super) fn digest(bytes: &[u8]) -> Digest {
    Sha256::digest(bytes).into()
}

/// A digest as it is written.
pub(super) fn hexadecimal(digest: &Digest) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Content of the files of a port that speaks TLS.
pub(super) struct TlsFiles {
    pub(super) certificate: Vec<u8>,
    pub(super) key: Vec<u8>,
    pub(super) client_ca: Option<Vec<u8>>,
}

impl TlsFiles {
    /// The digest of all of them.
    pub(super) fn digest(&self) -> Digest {
        let parts = [&self.certificate, &self.key].into_iter().chain(&self.client_ca);
        digest(&parts.flat_map(|part| digest(part)).collect::<Vec<_>>())
    }
}

/// Reads them; `None` if the port does not speak TLS.
pub(super) fn read_tls(options: &AccessOptions) -> Result<Option<TlsFiles>, Vec<OptionFault>> {
    let (Some(certificate), Some(key)) = (&options.tls_certificate, &options.tls_key) else {
        return Ok(None);
    };
    let certificate = read("tls_certificate", certificate);
    let key = read("tls_key", key);
    let client_ca = options.tls_client_ca.as_deref().map(|path| read("tls_client_ca", path));
    match (certificate, key, client_ca.transpose()) {
        (Ok(certificate), Ok(key), Ok(client_ca)) => {
            Ok(Some(TlsFiles { certificate, key, client_ca }))
        }
        (certificate, key, client_ca) => {
            let faults = [certificate.err(), key.err(), client_ca.err()];
            Err(faults.into_iter().flatten().collect())
        }
    }
}

/// Reads the file that `setting` names.
pub(super) fn read(setting: &'static str, path: &Path) -> Result<Vec<u8>, OptionFault> {
    let fault = |got: String| {
        let expected = format!("a file of at most {BYTES_MAX} bytes");
        OptionFault::new(setting, expected, format!("{}: {got}", path.display()))
    };
    let read = || -> io::Result<Vec<u8>> {
        let mut content = Vec::new();
        File::open(path)?.take(BYTES_MAX + 1).read_to_end(&mut content)?;
        Ok(content)
    };
    let content = read().map_err(|why| fault(why.to_string()))?;
    if content.len() as u64 > BYTES_MAX {
        return Err(fault("more".to_owned()));
    }
    Ok(content)
}
