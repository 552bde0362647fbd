//! The compact form for uplink; `proto/UPLINK.md` has it byte by byte.

use bytes::Bytes;
use sha2::{Digest, Sha256};
use vbar_guidance::{Method, control::disturbance_feedback::Plan};

const MAGIC: &[u8; 4] = b"VBUP";
const FORMAT_VERSION: u8 = 1;
const CHECKSUM_LENGTH: usize = 8;
const METHOD: Method = Method::DisturbanceFeedback;

/// Why bytes are not a plan.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum UplinkFault {
    #[error("not a plan for uplink: the first bytes are not VBUP")]
    NotAPlan,
    #[error("format version {0}, this program reads {FORMAT_VERSION}")]
    Version(u8),
    #[error("truncated, or bytes left over")]
    Length,
    #[error("the checksum does not match: the bytes were damaged on the way")]
    Checksum,
    #[error("a plan of method {0:?}, this program reads {name:?}", name = METHOD.name())]
    Method(String),
    #[error("made by version {0:?} of the method, this program has {version:?}", version = METHOD.version())]
    MethodVersion(String),
    #[error("the plan inside is not good: {0}")]
    Plan(String),
}

/// Whether these bytes begin as a plan for uplink does.
pub(crate) fn looks_like_one(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

/// Writes a plan.
pub(crate) fn write(plan: &Plan) -> Bytes {
    let payload = plan.to_bytes();
    let mut bytes = Vec::with_capacity(payload.len() + 64);
    bytes.extend_from_slice(MAGIC);
    bytes.push(FORMAT_VERSION);
    for word in [METHOD.name(), METHOD.version()] {
        bytes.push(u8::try_from(word.len()).expect("methods have short names and versions"));
        bytes.extend_from_slice(word.as_bytes());
    }
    let length = u32::try_from(payload.len()).expect("a plan has at most 64 instants");
    bytes.extend_from_slice(&length.to_le_bytes());
    bytes.extend_from_slice(&payload);
    let checksum = Sha256::digest(&bytes);
    bytes.extend_from_slice(&checksum[..CHECKSUM_LENGTH]);
    bytes.into()
}

/// Reads a plan and checks it again.
///
/// # Errors
/// [`UplinkFault`]; a plan that does not pass its certificate is one.
pub(crate) fn read(bytes: &[u8]) -> Result<Plan, UplinkFault> {
    let mut rest = bytes.strip_prefix(MAGIC).ok_or(UplinkFault::NotAPlan)?;
    let version = take(&mut rest, 1)?[0];
    if version != FORMAT_VERSION {
        return Err(UplinkFault::Version(version));
    }
    let split = bytes.len().checked_sub(CHECKSUM_LENGTH).ok_or(UplinkFault::Length)?;
    let (sealed, checksum) = bytes.split_at(split);
    if Sha256::digest(sealed)[..CHECKSUM_LENGTH] != *checksum {
        return Err(UplinkFault::Checksum);
    }
    let name = word(&mut rest)?;
    if name != METHOD.name() {
        return Err(UplinkFault::Method(name));
    }
    let version = word(&mut rest)?;
    if version != METHOD.version() {
        return Err(UplinkFault::MethodVersion(version));
    }
    let mut length = [0; 4];
    length.copy_from_slice(take(&mut rest, 4)?);
    let length = usize::try_from(u32::from_le_bytes(length)).map_err(|_| UplinkFault::Length)?;
    let payload = take(&mut rest, length)?;
    if rest.len() != CHECKSUM_LENGTH {
        return Err(UplinkFault::Length);
    }
    Plan::from_bytes(payload).map_err(|fault| UplinkFault::Plan(fault.to_string()))
}

fn take<'a>(rest: &mut &'a [u8], length: usize) -> Result<&'a [u8], UplinkFault> {
    let (taken, left) = rest.split_at_checked(length).ok_or(UplinkFault::Length)?;
    *rest = left;
    Ok(taken)
}

fn word(rest: &mut &[u8]) -> Result<String, UplinkFault> {
    let length = usize::from(take(rest, 1)?[0]);
    Ok(String::from_utf8_lossy(take(rest, length)?).into_owned())
}
