//! Pages (AIP-158).

use super::{ArtifactId, Door, Path};

/// 0 means the default, more than the most is cut to it.
pub(super) fn page_size(given: i32, most: usize, path: Path<'_>, door: &mut Door) -> Option<usize> {
    match usize::try_from(given) {
        Ok(0) => Some(most),
        Ok(size) => Some(size.min(most)),
        Err(_) => door.refuse(path.field("page_size"), "at least 0", given),
    }
}

/// A token is the id that the page before it ended with.
#[allow(clippy::option_option, reason = "absent and wrong are different things here")]
pub(super) fn page_token(
    token: &str,
    path: Path<'_>,
    door: &mut Door,
) -> Option<Option<ArtifactId>> {
    if token.is_empty() {
        return Some(None);
    }
    ArtifactId::from_hex(token).map(Some).or_else(|| {
        let shown: String = token.chars().take(100).collect();
        let expected = "a token from an earlier page";
        door.refuse(path.field("page_token"), expected, format!("{shown:?}"))
    })
}
