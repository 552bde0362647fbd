//! Access: who asks, what they may, and how much of it.
//!
//! A caller is known by the digest of its token or certificate; the file that names them can
//! change while the node runs, as can the certificates of TLS. Everything passes one [`Gate`],
//! whatever it comes over, and what each call needs stands in one table.

mod allowance;
mod audit;
mod caller;
mod certificates;
mod files;
mod gate;
mod options;
mod reloaded;
mod rights;
mod token;
mod tokens;

pub use options::AccessOptions;
pub use token::NewToken;

pub(crate) use audit::AuditLine;
pub(crate) use caller::{Caller, Role, Roles};
#[cfg(feature = "fuzzing")]
pub(crate) use gate::bearer;
pub(crate) use gate::{Gate, Pass, Peer, Refusal};
pub(crate) use options::OptionFault;
#[cfg(test)]
pub(crate) use rights::named;
pub(crate) use rights::{Right, right};

/// What is wrong with a file of tokens, read for the first time and again.
#[cfg(feature = "fuzzing")]
pub(crate) fn token_faults(content: &[u8]) -> Vec<OptionFault> {
    let rate = AccessOptions::default().rate();
    let read = tokens::Tokens::read(content, rate, None);
    let again = read.and_then(|first| tokens::Tokens::read(content, rate, Some(&first)));
    again.err().unwrap_or_default()
}

/// What is wrong with the files of a port that speaks TLS.
#[cfg(feature = "fuzzing")]
pub(crate) fn tls_faults(
    certificate: &[u8],
    key: &[u8],
    client_ca: Option<&[u8]>,
) -> Vec<OptionFault> {
    let files = files::TlsFiles {
        certificate: certificate.to_vec(),
        key: key.to_vec(),
        client_ca: client_ca.map(<[u8]>::to_vec),
    };
    certificates::server_config(&files).err().unwrap_or_default()
}
