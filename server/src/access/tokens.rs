//! The file that names tokens and certificates.
//!
//! It holds digests only: who reads it learns no token. What a fault says never quotes the file,
//! because somebody may have written a token where its digest belongs.

use std::{
    net::IpAddr,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use serde::Deserialize;
use subtle::ConstantTimeEq as _;
use toml::value::{Datetime, Offset};

use super::{
    Role, Roles,
    allowance::{Allowance, Rate},
    caller::Caller,
    files::Digest,
    options::OptionFault,
};

/// Most entries of a file: each call looks at all of them.
const ENTRIES_MAX: usize = 1024;
const NAME_LENGTH_MAX: usize = 64;

/// Everyone who may ask.
#[derive(Debug, Default)]
pub(super) struct Tokens {
    entries: Vec<Entry>,
}

/// What a caller shows to be known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shown {
    Token,
    Certificate,
}

/// One who may ask.
#[derive(Debug)]
pub(super) struct Entry {
    shown: Shown,
    sha256: Digest,
    expires: Option<SystemTime>,
    pub(super) caller: Caller,
    /// One for all entries of a name, so that a token can be replaced while the old one still
    /// holds.
    pub(super) allowance: Arc<Allowance>,
}

impl Entry {
    pub(super) fn has_expired(&self, now: SystemTime) -> bool {
        self.expires.is_some_and(|expires| expires <= now)
    }
}

/// The file as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    #[serde(default)]
    token: Vec<WrittenEntry>,
    #[serde(default)]
    certificate: Vec<WrittenEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenEntry {
    name: String,
    sha256: String,
    roles: Vec<String>,
    expires: Option<Datetime>,
    rate_max_per_s: Option<f64>,
    burst_max: Option<u32>,
    calls_max: Option<u32>,
}

impl Tokens {
    /// Reads a file, or lists everything that is wrong with it. Whoever was in `before` with the
    /// same limits goes on with the allowance it has left.
    pub(super) fn read(
        content: &[u8],
        rate: Rate,
        before: Option<&Self>,
    ) -> Result<Self, Vec<OptionFault>> {
        let one = |expected: &str, got: String| vec![fault("", expected, got)];
        let text = str::from_utf8(content).map_err(|_| one("UTF-8", "something else".into()))?;
        let written: Written = toml::from_str(text).map_err(|why| {
            let before = why.span().map_or("", |span| &text[..span.start.min(text.len())]);
            let line = before.matches('\n').count() + 1;
            let said = if is_ours(why.message()) { why.message() } else { "something else" };
            one("tables [[token]] and [[certificate]]", format!("line {line}: {said}"))
        })?;
        let count = written.token.len() + written.certificate.len();
        if count > ENTRIES_MAX {
            return Err(one(&format!("at most {ENTRIES_MAX} entries"), count.to_string()));
        }
        let (mut faults, mut entries) = (Vec::new(), Vec::<Entry>::with_capacity(count));
        for (shown, table, written) in [
            (Shown::Token, "token", written.token),
            (Shown::Certificate, "certificate", written.certificate),
        ] {
            for (index, written) in written.into_iter().enumerate() {
                let place = format!("{table}[{index}]");
                match entry(shown, written, rate, &place) {
                    Ok(mut entry) => {
                        let entries_before = before.into_iter().flat_map(|tokens| &tokens.entries);
                        if let Some(same) = entries.iter().find(|e| e.is_of(&entry)) {
                            if same.allowance.rate != entry.allowance.rate {
                                let expected = "the limits of the other entry of this name";
                                faults.push(fault(&place, expected, "others".into()));
                            }
                            entry.allowance = Arc::clone(&same.allowance);
                        } else if let Some(same) = entries_before
                            .filter(|e| e.is_of(&entry))
                            .find(|e| e.allowance.rate == entry.allowance.rate)
                        {
                            entry.allowance = Arc::clone(&same.allowance);
                        }
                        if entries.iter().any(|e| e.shown == shown && e.sha256 == entry.sha256) {
                            let place = format!("{place}.sha256");
                            let got = "the digest of another entry".into();
                            faults.push(fault(&place, "a digest of its own", got));
                        }
                        entries.push(entry);
                    }
                    Err(found) => faults.extend(found),
                }
            }
        }
        if faults.is_empty() { Ok(Self { entries }) } else { Err(faults) }
    }

    /// Who shows something with that digest.
    ///
    /// Every entry is looked at, and each in the same time whatever it holds, so that the time
    /// tells nothing.
    pub(super) fn find(&self, shown: Shown, sha256: &Digest) -> Option<&Entry> {
        let mut found = None;
        for entry in self.entries.iter().filter(|entry| entry.shown == shown) {
            if bool::from(entry.sha256.ct_eq(sha256)) {
                found = Some(entry);
            }
        }
        found
    }
}

impl Entry {
    fn is_of(&self, other: &Self) -> bool {
        self.caller.name() == other.caller.name()
    }
}

/// Whether a reader's words quote nothing but names of ours: it may also quote what it found.
fn is_ours(message: &str) -> bool {
    const NAMES: [&str; 9] = [
        "token",
        "certificate",
        "name",
        "sha256",
        "roles",
        "expires",
        "rate_max_per_s",
        "burst_max",
        "calls_max",
    ];
    let quoted = message.split('`').skip(1).step_by(2);
    !message.contains(['"', '\'']) && quoted.into_iter().all(|word| NAMES.contains(&word))
}

fn fault(place: &str, expected: &str, got: String) -> OptionFault {
    let separator = if place.is_empty() { "" } else { ": " };
    OptionFault::new("tokens_file", format!("{place}{separator}{expected}"), got)
}

/// One entry, or everything that is wrong with it.
fn entry(
    shown: Shown,
    written: WrittenEntry,
    rate: Rate,
    place: &str,
) -> Result<Entry, Vec<OptionFault>> {
    let mut faults = Vec::new();
    let mut wrong = |field: &str, expected: &str, got: String| {
        faults.push(fault(&format!("{place}.{field}"), expected, got));
    };
    if !is_name(&written.name) {
        let expected = "1 to 64 of a-z, A-Z, 0-9, '.', '_' and '-', and no address";
        wrong("name", expected, format!("{} characters", written.name.chars().count()));
    }
    let sha256 = parse_digest(&written.sha256);
    if sha256.is_none() {
        let got = format!("{} characters", written.sha256.chars().count());
        wrong("sha256", "64 hexadecimal digits", got);
    }
    let known = |name: &String| Role::ALL.into_iter().find(|role| role.name() == name);
    let roles: Option<Roles> = written.roles.iter().map(known).collect();
    if roles.is_none() {
        wrong("roles", "any of plan, step, precompute, admin", "another word".to_owned());
    }
    let expires = match written.expires.map(moment) {
        None => None,
        Some(Some(moment)) => Some(moment),
        Some(None) => {
            let expected = "a date and time with an offset, such as 2027-03-01T00:00:00Z";
            wrong("expires", expected, "something else".to_owned());
            None
        }
    };
    let rate = Rate {
        per_s: written.rate_max_per_s.unwrap_or(rate.per_s),
        burst: written.burst_max.unwrap_or(rate.burst),
        calls_max: written.calls_max.unwrap_or(rate.calls_max),
    };
    for limit in rate.faults() {
        let field = limit.setting.strip_prefix("caller_").unwrap_or(limit.setting);
        wrong(field, &limit.expected, limit.got);
    }
    match (sha256, roles) {
        (Some(sha256), Some(roles)) if faults.is_empty() => Ok(Entry {
            shown,
            sha256,
            expires,
            caller: Caller::named(written.name.into(), roles),
            allowance: Arc::new(Allowance::new(rate, Instant::now())),
        }),
        _ => Err(faults),
    }
}

/// A name that can stand in a log and is nobody's address.
pub(super) fn is_name(text: &str) -> bool {
    let is_fit = |c: u8| c.is_ascii_alphanumeric() || b"._-".contains(&c);
    (1..=NAME_LENGTH_MAX).contains(&text.len())
        && text.bytes().all(is_fit)
        && text.parse::<IpAddr>().is_err()
}

fn parse_digest(text: &str) -> Option<Digest> {
    if text.len() != 64 || !text.bytes().all(|c| c.is_ascii_hexdigit()) {
        return None;
    }
    let mut digest = [0; 32];
    for (byte, at) in digest.iter_mut().zip((0..64).step_by(2)) {
        *byte = u8::from_str_radix(&text[at..at + 2], 16).ok()?;
    }
    Some(digest)
}

/// A moment, if the date says in which offset it is meant.
pub(super) fn moment(written: Datetime) -> Option<SystemTime> {
    let (date, time, offset) = (written.date?, written.time?, written.offset?);
    let epoch = hifitime::Epoch::maybe_from_gregorian_utc(
        date.year.into(),
        date.month,
        date.day,
        time.hour,
        time.minute,
        time.second.unwrap_or(0),
        time.nanosecond.unwrap_or(0),
    )
    .ok()?;
    let minutes = match offset {
        Offset::Z => 0,
        Offset::Custom { minutes } => minutes,
    };
    let seconds = epoch.to_unix_seconds() - f64::from(minutes) * 60.0;
    SystemTime::UNIX_EPOCH.checked_add(Duration::try_from_secs_f64(seconds).ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::files::digest;

    const RATE: Rate = Rate { per_s: 10.0, burst: 20, calls_max: 5 };

    fn read(text: &str) -> Result<Tokens, Vec<OptionFault>> {
        Tokens::read(text.as_bytes(), RATE, None)
    }

    fn hex(token: &str) -> String {
        crate::access::files::hexadecimal(&digest(token.as_bytes()))
    }

    #[test]
    fn tokens_are_found_by_their_digest_and_by_what_is_shown() {
        let (a, b) = (hex("a"), hex("b"));
        let tokens = read(&format!(
            "[[token]]\nname = 'ground'\nsha256 = '{a}'\nroles = ['plan', 'step']\n\
             expires = 2026-03-01T01:00:00+01:00\ncalls_max = 2\n\
             [[certificate]]\nname = 'loop'\nsha256 = '{b}'\nroles = []\n"
        ))
        .unwrap();
        let ground = tokens.find(Shown::Token, &digest(b"a")).unwrap();
        assert_eq!(&**ground.caller.name(), "ground");
        assert!(ground.caller.roles().allow(Role::Step));
        assert!(!ground.caller.roles().allow(Role::Precompute));
        assert_eq!(ground.allowance.rate, Rate { calls_max: 2, ..RATE });
        // 2026-03-01T00:00:00Z
        let end = SystemTime::UNIX_EPOCH + Duration::from_secs(1_772_323_200);
        assert!(ground.has_expired(end));
        assert!(!ground.has_expired(end - Duration::from_secs(1)));
        assert!(tokens.find(Shown::Certificate, &digest(b"a")).is_none());
        let other = tokens.find(Shown::Certificate, &digest(b"b")).unwrap();
        assert!(!other.has_expired(SystemTime::now()));
        assert!(Role::ALL.into_iter().all(|role| !other.caller.roles().allow(role)));
    }

    #[test]
    fn tokens_faults_are_all_named_and_none_quotes_the_file() {
        let secret = "vbar_secret";
        let (a, b) = (hex("a"), hex("b"));
        let faults = read(&format!(
            "[[token]]\nname = '10.0.0.7'\nsha256 = '{secret}'\nroles = ['{secret}']\n\
             expires = 2026-03-01T01:00:00\nrate_max_per_s = 0\n\
             [[token]]\nname = '{secret} '\nsha256 = '{a}'\nroles = []\n\
             [[token]]\nname = 'x'\nsha256 = '{a}'\nroles = []\n\
             [[token]]\nname = 'y'\nsha256 = '{a}'\nroles = []\n\
             [[certificate]]\nname = 'x'\nsha256 = '{b}'\nroles = []\ncalls_max = 3\n"
        ))
        .unwrap_err();
        let named: Vec<_> =
            faults.iter().map(|f| f.expected.split(':').next().unwrap_or_default()).collect();
        let expected = [
            "token[0].name",
            "token[0].sha256",
            "token[0].roles",
            "token[0].expires",
            "token[0].rate_max_per_s",
            "token[1].name",
            "token[3].sha256",
            "certificate[0]",
        ];
        assert_eq!(named, expected);
        assert!(!format!("{faults:?}").contains(secret), "{faults:?}");
        for (text, named) in [
            ("[[token]]\nname = 'x'\ntoken = 'vbar_secret'", "line 3"),
            ("[[tokens]]", "line 1"),
            ("[[token]]\nname = \"vbar_secret", "line 2"),
            ("[[token]]\nname = 'x'\nsha256 = ['vbar_secret']\n", "line 3"),
            // The reader of TOML quotes what has the wrong type, and words that it does not know.
            ("[[token]]\nname = 'x'\nrate_max_per_s = 'vbar_secret'\n", "line 3"),
            ("[[token]]\nname = 'x'\nvbar_secret = 1\n", "line 3"),
            ("token = 'vbar_secret'\n", "line 1"),
            ("[[token]]\nname = 'x'\n", "missing field `sha256`"),
        ] {
            let faults = read(text).unwrap_err();
            let said = format!("{faults:?}");
            assert!(said.contains(named) && !said.contains("secret"), "{said}");
        }
        assert!(Tokens::read(b"\xff", RATE, None).is_err());
    }

    #[test]
    fn tokens_read_again_keep_what_a_caller_has_left_unless_its_limits_change() {
        let text = |sha256: &str, calls: u32| {
            format!("[[token]]\nname = 'x'\nsha256 = '{sha256}'\nroles = []\ncalls_max = {calls}\n")
        };
        let first = read(&text(&hex("a"), 1)).unwrap();
        let place = first.entries[0].allowance.call().unwrap();
        let again = Tokens::read(text(&hex("b"), 1).as_bytes(), RATE, Some(&first)).unwrap();
        assert!(again.entries[0].allowance.call().is_err());
        let more = Tokens::read(text(&hex("b"), 2).as_bytes(), RATE, Some(&again)).unwrap();
        assert!(more.entries[0].allowance.call().is_ok());
        drop(place);
        assert!(again.entries[0].allowance.call().is_ok());
    }
}
