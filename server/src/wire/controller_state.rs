//! The envelope of `controller_state`.
//!
//! ```text
//! offset  size  what
//! 0       4     "VBCS"
//! 4       1     format version, 1
//! 5       1     length l of the method's name
//! 6       l     the method's name
//! 6+l     32    artifact id
//! 38+l    4     step index, little-endian
//! 42+l    4     length p of the payload, little-endian
//! 46+l    p     payload: the method's own bytes
//! 46+l+p  8     first 8 bytes of the sha256 of everything before
//! ```
//!
//! The checksum finds accidents, not forgers: the payload is checked again by the method, so that
//! a forged state can at worst ask for a different, certified answer.

use bytes::Bytes;
use sha2::{Digest, Sha256};
use vbar_guidance::Method;

use super::ArtifactId;

const MAGIC: &[u8; 4] = b"VBCS";
const FORMAT_VERSION: u8 = 1;
/// Far above what any method writes (a plan tail and an active set), far below a request's limit.
pub(crate) const LENGTH_MAX: usize = 256 * 1024;

/// A controller state as it travels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ControllerState<'a> {
    /// Whose state it is.
    pub(crate) method: Method,
    /// The artifact it belongs to.
    pub(crate) artifact_id: ArtifactId,
    /// The step it is for.
    pub(crate) step_index: u32,
    /// The method's own bytes.
    pub(crate) payload: &'a [u8],
}

/// Why a controller state cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum StateFault {
    #[error("it has {0} bytes, more than the {LENGTH_MAX} allowed")]
    TooLong(usize),
    #[error("it is not a controller state of this service")]
    NotAState,
    #[error("it has format version {0}; this server reads {FORMAT_VERSION}")]
    Version(u8),
    #[error("it is truncated or has bytes left over")]
    Length,
    #[error("its checksum does not match: it was damaged on the way")]
    Checksum,
    #[error("it belongs to the unknown method {0:?}")]
    Method(String),
    #[error("it belongs to artifact {0}")]
    Artifact(ArtifactId),
    #[error("its payload is not readable: {0}")]
    Payload(String),
    #[error("it claims step {envelope}, its payload is for step {payload}")]
    StepIndex { envelope: u32, payload: usize },
}

impl<'a> ControllerState<'a> {
    /// Bytes of the checksum at the end.
    pub(crate) const CHECKSUM_LENGTH: usize = 8;

    /// Writes the envelope.
    pub(crate) fn encode(&self) -> Bytes {
        let name = self.method.name().as_bytes();
        let length = |bytes: &[u8]| u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes();
        let mut bytes = Vec::with_capacity(64 + name.len() + self.payload.len());
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&[FORMAT_VERSION, length(name)[0]]);
        bytes.extend_from_slice(name);
        bytes.extend_from_slice(&self.artifact_id.0);
        bytes.extend_from_slice(&self.step_index.to_le_bytes());
        bytes.extend_from_slice(&length(self.payload));
        bytes.extend_from_slice(self.payload);
        let checksum = Sha256::digest(&bytes);
        bytes.extend_from_slice(&checksum[..Self::CHECKSUM_LENGTH]);
        bytes.into()
    }

    /// Reads the envelope; everything but the payload is checked.
    pub(crate) fn decode(bytes: &'a [u8]) -> Result<Self, StateFault> {
        if bytes.len() > LENGTH_MAX {
            return Err(StateFault::TooLong(bytes.len()));
        }
        let mut rest = bytes.strip_prefix(MAGIC).ok_or(StateFault::NotAState)?;
        let version = take(&mut rest, 1)?[0];
        if version != FORMAT_VERSION {
            return Err(StateFault::Version(version));
        }
        let split = bytes.len().checked_sub(Self::CHECKSUM_LENGTH).ok_or(StateFault::Length)?;
        let (sealed, checksum) = bytes.split_at(split);
        if Sha256::digest(sealed)[..Self::CHECKSUM_LENGTH] != *checksum {
            return Err(StateFault::Checksum);
        }
        let name_length = usize::from(take(&mut rest, 1)?[0]);
        let name = take(&mut rest, name_length)?;
        let method = Method::ALL.into_iter().find(|method| method.name().as_bytes() == name);
        let method =
            method.ok_or_else(|| StateFault::Method(String::from_utf8_lossy(name).into_owned()))?;
        let artifact_id = ArtifactId(array(take(&mut rest, 32)?)?);
        let step_index = u32::from_le_bytes(array(take(&mut rest, 4)?)?);
        let length = u32::from_le_bytes(array(take(&mut rest, 4)?)?);
        let payload = take(&mut rest, usize::try_from(length).map_err(|_| StateFault::Length)?)?;
        if rest.len() != Self::CHECKSUM_LENGTH {
            return Err(StateFault::Length);
        }
        Ok(Self { method, artifact_id, step_index, payload })
    }
}

fn take<'a>(rest: &mut &'a [u8], length: usize) -> Result<&'a [u8], StateFault> {
    let (taken, left) = rest.split_at_checked(length).ok_or(StateFault::Length)?;
    *rest = left;
    Ok(taken)
}

fn array<const N: usize>(bytes: &[u8]) -> Result<[u8; N], StateFault> {
    bytes.try_into().map_err(|_| StateFault::Length)
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATE: ControllerState<'static> = ControllerState {
        method: Method::VariableHorizon,
        artifact_id: ArtifactId([7; 32]),
        step_index: 41,
        payload: b"anything the method writes",
    };

    #[test]
    fn state_round_trips() {
        assert_eq!(ControllerState::decode(&STATE.encode()), Ok(STATE));
    }

    #[test]
    fn state_every_flipped_bit_is_found() {
        let good = STATE.encode();
        for bit in 0..good.len() * 8 {
            let mut bad = good.to_vec();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(ControllerState::decode(&bad).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn state_every_truncation_is_found() {
        let good = STATE.encode();
        for length in 0..good.len() {
            assert!(ControllerState::decode(&good[..length]).is_err(), "length {length}");
        }
        let mut long = good.to_vec();
        long.push(0);
        assert!(ControllerState::decode(&long).is_err());
        assert_eq!(
            ControllerState::decode(&vec![0; LENGTH_MAX + 1]),
            Err(StateFault::TooLong(LENGTH_MAX + 1))
        );
    }

    #[test]
    fn state_of_another_format_version_is_named() {
        let mut other = STATE.encode().to_vec();
        other[4] = 9;
        assert_eq!(ControllerState::decode(&other), Err(StateFault::Version(9)));
    }
}
