//! What is stored for an artifact or a plan.
//!
//! ```text
//! "VBAR" | format version 1 | l | method's name (l) | v | method's version (v) | artifact's bytes
//! ```
//!
//! An artifact is found by the digest of the problem it answers, so a record is good only if the
//! problem inside it has that digest. A plan is found by the digest of its own bytes.

use sha2::{Digest, Sha256};
use vbar_guidance::{Budget, Method};

use crate::{
    store::Shelf,
    wire::{Artifact, ArtifactId, Problem, Unread},
};

const MAGIC: &[u8; 4] = b"VBAR";
const FORMAT_VERSION: u8 = 1;

/// sha256 of (method, version, canonical problem bytes), the words preceded by their lengths.
pub(super) fn artifact_id(method: Method, canonical_problem: &[u8]) -> ArtifactId {
    let mut digest = Sha256::new();
    for word in [method.name(), method.version()] {
        digest.update([length(word)]);
        digest.update(word);
    }
    digest.update(canonical_problem);
    ArtifactId(digest.finalize().into())
}

/// The id of what answers `problem`.
pub(super) fn problem_id(problem: &Problem) -> ArtifactId {
    artifact_id(problem.method(), &problem.canonical_bytes())
}

fn length(word: &str) -> u8 {
    u8::try_from(word.len()).expect("methods have short names and versions")
}

/// sha256 of an artifact's or plan's own bytes.
pub(super) fn content_id(bytes: &[u8]) -> ArtifactId {
    ArtifactId(Sha256::digest(bytes).into())
}

/// The record of an artifact whose own bytes are `bytes`.
pub(crate) fn encode(method: Method, bytes: &[u8]) -> Vec<u8> {
    let mut record = Vec::with_capacity(bytes.len() + 64);
    record.extend_from_slice(MAGIC);
    record.push(FORMAT_VERSION);
    for word in [method.name(), method.version()] {
        record.push(length(word));
        record.extend_from_slice(word.as_bytes());
    }
    record.extend_from_slice(bytes);
    record
}

/// The artifact in a record, checked again however long that takes, and its own bytes.
#[cfg(any(test, feature = "fuzzing"))]
pub(crate) fn decode(
    shelf: Shelf,
    id: ArtifactId,
    record: &[u8],
) -> Result<(Artifact, &[u8]), String> {
    decode_within(shelf, id, record, Budget::UNLIMITED).map_err(|unread| match unread {
        Unread::Damaged(what) => what,
        Unread::Interrupted(why) => unreachable!("an unlimited budget said {why:?}"),
    })
}

/// The same, if there is time.
pub(crate) fn decode_within<'a>(
    shelf: Shelf,
    id: ArtifactId,
    record: &'a [u8],
    budget: Budget<'_>,
) -> Result<(Artifact, &'a [u8]), Unread> {
    let (method, rest) = of_method(record).map_err(Unread::Damaged)?;
    let artifact = Artifact::from_bytes_within(method, rest, budget)?;
    check_name(shelf, id, &artifact, rest).map_err(Unread::Damaged)?;
    Ok((artifact, rest))
}

/// The method of a record, and the artifact's own bytes.
fn of_method(record: &[u8]) -> Result<(Method, &[u8]), String> {
    let rest = record.strip_prefix(MAGIC).ok_or("it is not an artifact's record")?;
    let (version, mut rest) = rest.split_first().ok_or("it is truncated")?;
    if *version != FORMAT_VERSION {
        return Err(format!("record format {version}, this server reads {FORMAT_VERSION}"));
    }
    let name = word(&mut rest)?;
    let method = Method::ALL.into_iter().find(|method| method.name().as_bytes() == name);
    let method = method.ok_or("it belongs to an unknown method")?;
    let version = word(&mut rest)?;
    if version != method.version().as_bytes() {
        return Err(format!(
            "it was made by version {} of {}, this server has {}",
            String::from_utf8_lossy(version),
            method.name(),
            method.version()
        ));
    }
    Ok((method, rest))
}

/// Refuses an artifact that stands under another's name.
fn check_name(
    shelf: Shelf,
    id: ArtifactId,
    artifact: &Artifact,
    bytes: &[u8],
) -> Result<(), String> {
    match shelf {
        Shelf::Artifacts => {
            let found = artifact_id(artifact.method(), &artifact.canonical_problem());
            if found != id {
                return Err(format!("it answers problem {found}"));
            }
        }
        Shelf::Plans => {
            let found = content_id(bytes);
            if found != id || !artifact.is_plan() {
                return Err(format!("it is not this plan but {found}"));
            }
        }
        Shelf::Problems | Shelf::Shards => {
            return Err(format!("no artifact stands among {}", shelf.name()));
        }
    }
    Ok(())
}

fn word<'a>(rest: &mut &'a [u8]) -> Result<&'a [u8], String> {
    let (&length, after) = rest.split_first().ok_or("it is truncated")?;
    let (word, after) = after.split_at_checked(length.into()).ok_or("it is truncated")?;
    *rest = after;
    Ok(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn record_faults_are_named() {
        let id = ArtifactId([1; 32]);
        let good = encode(Method::VariableHorizon, b"");
        let fault = |record: &[u8]| decode(Shelf::Artifacts, id, record).map(|_| ()).unwrap_err();
        assert_eq!(fault(b"something else"), "it is not an artifact's record");
        let mut other = good.clone();
        other[4] = 2;
        assert_eq!(fault(&other), "record format 2, this server reads 1");
        for length in 4..good.len() {
            assert_eq!(fault(&good[..length]), "it is truncated", "{length}");
        }
        let mut other = good;
        other[6] ^= 1;
        assert_eq!(fault(&other), "it belongs to an unknown method");
    }

    #[test]
    fn record_of_a_plan_that_is_no_plan_is_refused() {
        let record = encode(Method::DisturbanceFeedback, b"no plan");
        let fault = decode(Shelf::Plans, content_id(b"no plan"), &record).map(|_| ());
        assert!(fault.unwrap_err().contains("checksum"));
    }

    #[test]
    fn artifact_id_depends_on_every_part() {
        let one = artifact_id(Method::VariableHorizon, b"problem");
        assert_eq!(one, artifact_id(Method::VariableHorizon, b"problem"));
        assert_ne!(one, artifact_id(Method::VariableHorizon, b"Problem"));
        assert_eq!(ArtifactId::from_hex(&one.to_string()), Some(one));
    }
}
