//! Parts of a job that several machines do: their names on the shelves and in the queue, and where
//! they stand.

use std::{
    collections::BTreeMap,
    fmt,
    hash::{BuildHasher as _, Hasher as _, RandomState},
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use crate::{
    store::{RecordId, Task},
    wire::ArtifactId,
};

const TICKET_BYTES: usize = 24;

/// Names one order of a job and what lies on the shelves for it: milliseconds since 1970, then what
/// makes it different from every other.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Ticket([u8; TICKET_BYTES]);

impl Ticket {
    /// One that nobody else has.
    pub(super) fn fresh() -> Self {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let unix_ms = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
        // The standard library seeds its hashers from the system's randomness.
        let draw = || RandomState::new().build_hasher().finish();
        let mut ticket = [0; TICKET_BYTES];
        for (word, place) in [unix_ms, draw(), draw()].iter().zip(ticket.chunks_mut(8)) {
            place.copy_from_slice(&word.to_be_bytes());
        }
        Self(ticket)
    }

    /// Of what lies on a shelf under `id`.
    pub(super) fn of(id: &RecordId) -> Self {
        let (ticket, _) = id.split_first_chunk().expect("an id is longer than a ticket");
        Self(*ticket)
    }

    /// When it was drawn.
    pub(super) fn drawn(self) -> SystemTime {
        let (unix_ms, _) = self.0.split_first_chunk().expect("a ticket is longer than a time");
        let since = Duration::from_millis(u64::from_be_bytes(*unix_ms));
        SystemTime::UNIX_EPOCH.checked_add(since).unwrap_or(SystemTime::UNIX_EPOCH)
    }

    fn id(self, last: u64) -> RecordId {
        let mut id = RecordId::default();
        id[..TICKET_BYTES].copy_from_slice(&self.0);
        id[TICKET_BYTES..].copy_from_slice(&last.to_be_bytes());
        id
    }

    /// Where its problem lies; also names its tasks together.
    pub(super) fn problem(self) -> RecordId {
        self.id(u64::MAX)
    }

    /// Where a shard lies.
    pub(super) fn shard(self, shard: usize) -> RecordId {
        self.id(u64::try_from(shard).unwrap_or(u64::MAX - 1))
    }
}

impl fmt::Debug for Ticket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// What a task asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    /// To compute a shard.
    Shard(usize),
    /// To put all shards together.
    Merge,
}

impl Part {
    const MERGE: u32 = u32::MAX;

    fn number(self) -> u32 {
        match self {
            Self::Shard(shard) => u32::try_from(shard).unwrap_or(Self::MERGE - 1),
            Self::Merge => Self::MERGE,
        }
    }

    fn from_number(number: u32) -> Self {
        match number {
            Self::MERGE => Self::Merge,
            shard => Self::Shard(usize::try_from(shard).unwrap_or(usize::MAX)),
        }
    }
}

/// A part of an order of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Errand {
    pub(super) job: ArtifactId,
    pub(super) ticket: Ticket,
    pub(super) part: Part,
}

impl Errand {
    /// As a task; `round` tells it from the same task that was lost.
    pub(super) fn task(&self, round: u64) -> Task {
        Task {
            group: self.ticket.problem(),
            name: format!("{}-{round}", self.part.number()),
            bytes: self.encode(),
        }
    }

    /// The job's id, the ticket, the part's number.
    fn encode(&self) -> Bytes {
        [&self.job.0[..], &self.ticket.0, &self.part.number().to_le_bytes()].concat().into()
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let (job, rest) = bytes.split_first_chunk()?;
        let (ticket, rest) = rest.split_first_chunk()?;
        let part = Part::from_number(u32::from_le_bytes(rest.try_into().ok()?));
        Some(Self { job: ArtifactId(*job), ticket: Ticket(*ticket), part })
    }
}

/// How far somebody is with a part, told to all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Word {
    pub(super) errand: Errand,
    pub(super) millionths: u32,
}

impl Word {
    pub(super) fn encode(&self) -> Bytes {
        [&self.errand.encode()[..], &self.millionths.to_le_bytes()].concat().into()
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let (errand, millionths) = bytes.split_last_chunk()?;
        let errand = Errand::decode(errand)?;
        Some(Self { errand, millionths: u32::from_le_bytes(*millionths) })
    }
}

/// Where the parts of a job stand, in its record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::service::jobs) struct Parts {
    #[serde(with = "hexadecimal")]
    ticket: Vec<u8>,
    /// A bit a shard.
    #[serde(with = "hexadecimal")]
    done: Vec<u8>,
    /// Parts that were handed out more than once, and how often they were begun since.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    begun_again: BTreeMap<u32, u32>,
    /// How often tasks that may have been lost were queued afresh.
    #[serde(default)]
    round: u64,
}

impl Parts {
    pub(super) fn new(ticket: Ticket, shards: usize) -> Self {
        Self {
            ticket: ticket.0.to_vec(),
            done: vec![0; shards.div_ceil(8)],
            begun_again: BTreeMap::new(),
            round: 0,
        }
    }

    /// Whether they can be the parts of so many shards.
    pub(in crate::service::jobs) fn fit(&self, shards: usize) -> bool {
        let last = self.done.last().copied().unwrap_or_default();
        let beyond = match shards % 8 {
            0 => 0,
            used => last >> used,
        };
        self.ticket().is_some() && self.done.len() == shards.div_ceil(8) && beyond == 0
    }

    pub(super) fn ticket(&self) -> Option<Ticket> {
        self.ticket.as_slice().try_into().ok().map(Ticket)
    }

    pub(super) fn round(&self) -> u64 {
        self.round
    }

    pub(super) fn next_round(&mut self) -> u64 {
        self.round = self.round.saturating_add(1);
        self.round
    }

    pub(super) fn is_done(&self, shard: usize) -> bool {
        self.done.get(shard / 8).is_some_and(|byte| byte >> (shard % 8) & 1 == 1)
    }

    pub(super) fn set_done(&mut self, shard: usize, done: bool) {
        if let Some(byte) = self.done.get_mut(shard / 8) {
            *byte = *byte & !(1 << (shard % 8)) | u8::from(done) << (shard % 8);
        }
        self.begun_again.remove(&Part::Shard(shard).number());
    }

    pub(super) fn count_done(&self) -> usize {
        self.done.iter().map(|byte| byte.count_ones() as usize).sum()
    }

    /// Somebody begins a part that was begun before; how often that was so.
    pub(super) fn begin_again(&mut self, part: Part) -> u32 {
        let begun = self.begun_again.entry(part.number()).or_default();
        *begun = begun.saturating_add(1);
        *begun
    }

    /// Who began a part gives it back: that was not the part's fault.
    pub(super) fn give_back(&mut self, part: Part) {
        if let Some(begun) = self.begun_again.get_mut(&part.number()) {
            *begun = begun.saturating_sub(1);
        }
    }
}

/// A task, read and written again.
#[cfg(feature = "fuzzing")]
pub(in crate::service::jobs) fn errand_rewritten(bytes: &[u8]) -> Option<Bytes> {
    Errand::decode(bytes).map(|errand| errand.encode())
}

/// A word, read and written again.
#[cfg(feature = "fuzzing")]
pub(in crate::service::jobs) fn word_rewritten(bytes: &[u8]) -> Option<Bytes> {
    Word::decode(bytes).map(|word| word.encode())
}

mod hexadecimal {
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

    pub(super) fn serialize<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(&format_args!("{}", Hex(bytes)))
    }

    struct Hex<'a>(&'a [u8]);

    impl std::fmt::Display for Hex<'_> {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
        }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        let text = String::deserialize(from)?;
        let pairs = text.as_bytes().chunks(2);
        let byte = |pair: &[u8]| {
            let digits = std::str::from_utf8(pair).ok().filter(|digits| digits.len() == 2)?;
            u8::from_str_radix(digits, 16).ok()
        };
        let bytes: Option<Vec<u8>> = pairs.map(byte).collect();
        bytes.ok_or_else(|| D::Error::custom("not hexadecimal"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticket_names_its_parts_and_its_time() {
        let before = SystemTime::now() - Duration::from_secs(1);
        let (one, other) = (Ticket::fresh(), Ticket::fresh());
        assert_ne!(one, other);
        assert!(one.drawn() > before && one.drawn() <= SystemTime::now());
        for id in [one.problem(), one.shard(0), one.shard(70_000)] {
            assert_eq!(Ticket::of(&id), one);
        }
        assert_ne!(one.shard(0), one.shard(1));
    }

    #[test]
    fn errand_and_word_come_back_and_nothing_else_is_read() {
        let ticket = Ticket::fresh();
        for part in [Part::Shard(0), Part::Shard(4711), Part::Merge] {
            let errand = Errand { job: ArtifactId([3; 32]), ticket, part };
            assert_eq!(Errand::decode(&errand.encode()), Some(errand));
            let word = Word { errand, millionths: 500_000 };
            assert_eq!(Word::decode(&word.encode()), Some(word));
            assert_eq!(Errand::decode(&word.encode()), None);
            assert_eq!(Word::decode(&errand.encode()), None);
        }
    }

    #[test]
    fn parts_remember_what_is_done() {
        let mut parts = Parts::new(Ticket::fresh(), 11);
        for shard in [0, 7, 8, 10] {
            parts.set_done(shard, true);
        }
        let written = serde_json::to_string(&parts).unwrap();
        let read: Parts = serde_json::from_str(&written).unwrap();
        assert_eq!(read, parts);
        let done: Vec<_> = (0..11).filter(|&shard| read.is_done(shard)).collect();
        assert_eq!((done, read.count_done()), (vec![0, 7, 8, 10], 4));
        parts.set_done(8, false);
        assert_eq!(parts.count_done(), 3);
        assert!(
            serde_json::from_str::<Parts>(&written.replace("\"done\":\"", "\"done\":\"x")).is_err()
        );
    }
}
