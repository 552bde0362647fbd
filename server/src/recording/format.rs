//! The file of a black box.
//!
//! ```text
//! "VBARBOX" | format version 1 | record …
//! record: length l (4) | CRC-32 of the length (4) | CRC-32 of the entry (4) | entry (l)
//! ```
//!
//! Numbers are little-endian; an entry is a message in Protocol Buffers' encoding. A record that
//! ends with the file is one whose writer was killed; the length's own checksum tells it from one
//! that was damaged later.

use std::{
    fs::File,
    io::{self, BufReader, Read},
    path::Path,
};

use prost::Message;
use sha2::{Digest as _, Sha256};

const MAGIC: &[u8; 7] = b"VBARBOX";
const VERSION: u8 = 1;
const HEAD: usize = 12;
/// Largest entry.
pub(super) const ENTRY_BYTES_MAX: usize = 64 << 20;

/// One entry.
#[derive(Clone, PartialEq, Message)]
pub struct Entry {
    /// What it is.
    #[prost(oneof = "entry::What", tags = "1, 2, 3")]
    pub what: Option<entry::What>,
}

/// Kinds of entries.
pub mod entry {
    /// What an entry is.
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub enum What {
        /// A node goes on in this file, or begins.
        #[prost(message, tag = "1")]
        Session(super::Session),
        /// It was asked and answered.
        #[prost(message, tag = "2")]
        Exchange(super::Exchange),
        /// Something is missing here.
        #[prost(message, tag = "3")]
        Lost(super::Lost),
    }
}

/// One run of a node.
#[derive(Clone, PartialEq, Message)]
pub struct Session {
    /// Differs from that of every other run: milliseconds of UTC since 1970 when it began.
    #[prost(uint64, tag = "1")]
    pub id: u64,
    /// Version of the program.
    #[prost(string, tag = "2")]
    pub build_version: String,
    /// Identity of the build: equal for the same sources, compiler and options.
    #[prost(string, tag = "3")]
    pub build_sha256: String,
    /// The settings that decide what is answered, as a file of settings.
    #[prost(string, tag = "4")]
    pub settings: String,
}

/// One call, or one message of a closed loop.
#[derive(Clone, PartialEq, Message)]
pub struct Exchange {
    /// Name of the RPC.
    #[prost(string, tag = "1")]
    pub call: String,
    /// Method of HTTP; empty over gRPC.
    #[prost(string, tag = "2")]
    pub http_method: String,
    /// Path, over HTTP with its query.
    #[prost(string, tag = "3")]
    pub path: String,
    /// The request's message: Protocol Buffers over gRPC, the body over HTTP.
    #[prost(bytes = "vec", tag = "4")]
    pub request: Vec<u8>,
    /// The answer's messages, or its body; none if only their digest was to be kept.
    #[prost(bytes = "vec", repeated, tag = "5")]
    pub answers: Vec<Vec<u8>>,
    /// SHA-256 of all of them in their order.
    #[prost(bytes = "vec", tag = "6")]
    pub answer_sha256: Vec<u8>,
    /// `google.rpc.Code`.
    #[prost(int32, tag = "7")]
    pub code: i32,
    /// What was said with the code over gRPC.
    #[prost(string, tag = "8")]
    pub message: String,
    /// As in logs, errors and the header of the answer.
    #[prost(string, tag = "9")]
    pub request_id: String,
    /// Milliseconds of UTC since 1970 when it was written down.
    #[prost(uint64, tag = "10")]
    pub unix_ms: u64,
    /// Number of the closed loop within its run of the node; absent for a call.
    #[prost(uint64, optional, tag = "11")]
    pub closed_loop: Option<u64>,
    /// Number of the message within its loop, from 0.
    #[prost(uint64, tag = "12")]
    pub index: u64,
}

/// Exchanges that could not be written.
#[derive(Clone, PartialEq, Message)]
pub struct Lost {
    /// How many.
    #[prost(uint64, tag = "1")]
    pub count: u64,
}

/// SHA-256 of an answer's messages in their order.
pub fn digest<'a>(answers: impl IntoIterator<Item = &'a [u8]>) -> Vec<u8> {
    let mut digest = Sha256::new();
    answers.into_iter().for_each(|answer| digest.update(answer));
    digest.finalize().to_vec()
}

/// The begin of a file.
pub(super) fn begin() -> Vec<u8> {
    [&MAGIC[..], &[VERSION]].concat()
}

/// Appends `entry` as a record; `false`, and nothing is appended, if it is too large.
pub(super) fn append(records: &mut Vec<u8>, entry: &Entry) -> bool {
    // What is too large is not encoded at all.
    entry.encoded_len() <= ENTRY_BYTES_MAX && append_content(records, &entry.encode_to_vec())
}

fn append_content(records: &mut Vec<u8>, content: &[u8]) -> bool {
    let Ok(length) = u32::try_from(content.len()) else { return false };
    let length = length.to_le_bytes();
    records.extend_from_slice(&length);
    records.extend_from_slice(&crc32fast::hash(&length).to_le_bytes());
    records.extend_from_slice(&crc32fast::hash(content).to_le_bytes());
    records.extend_from_slice(content);
    true
}

/// A file whose records hold these contents, with checksums that are right.
#[cfg(feature = "fuzzing")]
pub(crate) fn file_of(contents: impl IntoIterator<Item = impl AsRef<[u8]>>) -> Vec<u8> {
    let mut file = begin();
    for content in contents {
        append_content(&mut file, content.as_ref());
    }
    file
}

/// Why a recording cannot be read, or not on.
#[derive(Debug, thiserror::Error)]
pub enum RecordingFault {
    /// The system's reason.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// It does not begin as one.
    #[error("not a recording: expected {expected}, got {got}")]
    Foreign {
        /// What would be right.
        expected: String,
        /// What was found.
        got: String,
    },
    /// A record is not what was written.
    #[error("the record at byte {place} is damaged: {what}")]
    Damaged {
        /// Where it begins.
        place: u64,
        /// What is wrong with it.
        what: String,
    },
}

/// Entries of a recording in their order, up to its end or the first fault.
#[derive(Debug)]
pub struct Recording<R = BufReader<File>> {
    source: R,
    place: u64,
    torn: Option<u64>,
    is_over: bool,
}

impl Recording {
    /// The recording in a file.
    ///
    /// # Errors
    /// If it cannot be read, or is none.
    pub fn open(path: &Path) -> Result<Self, RecordingFault> {
        Self::read(BufReader::new(File::open(path)?))
    }
}

impl<R: Read> Recording<R> {
    /// The recording that `source` holds.
    ///
    /// # Errors
    /// If it cannot be read, or is none.
    pub fn read(mut source: R) -> Result<Self, RecordingFault> {
        let mut head = Vec::new();
        let expected = begin();
        (&mut source).take(expected.len() as u64).read_to_end(&mut head)?;
        if head != expected {
            let got = match head.strip_prefix(&MAGIC[..]) {
                Some([version]) => format!("format version {version}"),
                _ => format!("{} bytes of something else", head.len()),
            };
            let expected = format!("a recording in format version {VERSION}");
            return Err(RecordingFault::Foreign { expected, got });
        }
        Ok(Self { source, place: expected.len() as u64, torn: None, is_over: false })
    }

    /// Where the next record begins; at the end, where the last whole one ended.
    pub fn place(&self) -> u64 {
        self.place
    }

    /// Bytes of a record that ends with the file, if there is one: whoever wrote it was killed.
    pub fn torn(&self) -> Option<u64> {
        self.torn
    }

    /// Up to `length` bytes; fewer only at the end.
    fn bytes(&mut self, length: usize) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        (&mut self.source).take(length as u64).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn entry(&mut self) -> Result<Option<Entry>, RecordingFault> {
        let place = self.place;
        let damaged = |what: &str| RecordingFault::Damaged { place, what: what.to_owned() };
        let head = self.bytes(HEAD)?;
        let number = |at: usize| head.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        let (Some(length), Some(length_check), Some(check)) = (number(0), number(4), number(8))
        else {
            self.torn = (!head.is_empty()).then_some(head.len() as u64);
            return Ok(None);
        };
        if crc32fast::hash(&head[..4]) != length_check {
            return Err(damaged("its length has another checksum"));
        }
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        if length > ENTRY_BYTES_MAX {
            return Err(damaged("it is larger than any"));
        }
        let content = self.bytes(length)?;
        let size = (HEAD + content.len()) as u64;
        if content.len() < length {
            self.torn = Some(size);
            return Ok(None);
        }
        if crc32fast::hash(&content) != check {
            return Err(damaged("its content has another checksum"));
        }
        let entry = Entry::decode(&*content).map_err(|fault| damaged(&fault.to_string()))?;
        self.place += size;
        Ok(Some(entry))
    }
}

impl<R: Read> Iterator for Recording<R> {
    type Item = Result<Entry, RecordingFault>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_over {
            return None;
        }
        let entry = self.entry().transpose();
        self.is_over = !matches!(entry, Some(Ok(_)));
        entry
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries() -> Vec<Entry> {
        let exchange = |index| Exchange {
            call: "Step".to_owned(),
            request: vec![7; 100 * usize::try_from(index).unwrap()],
            index,
            ..Exchange::default()
        };
        let session = Session { id: 1, ..Session::default() };
        let mut all = vec![entry::What::Session(session)];
        all.extend((0..3).map(|index| entry::What::Exchange(exchange(index))));
        all.push(entry::What::Lost(Lost { count: 5 }));
        all.into_iter().map(|what| Entry { what: Some(what) }).collect()
    }

    fn file() -> Vec<u8> {
        let mut file = begin();
        assert!(entries().iter().all(|entry| append(&mut file, entry)));
        file
    }

    #[test]
    fn recording_comes_back_whole() {
        let file = file();
        let mut recording = Recording::read(&*file).unwrap();
        let read: Vec<Entry> = recording.by_ref().map(Result::unwrap).collect();
        assert_eq!(read, entries());
        assert_eq!((recording.place(), recording.torn()), (file.len() as u64, None));
    }

    #[test]
    fn recording_cut_off_anywhere_has_what_was_whole_and_says_what_is_torn() {
        let file = file();
        let mut whole = Vec::new();
        for length in begin().len()..file.len() {
            let mut recording = Recording::read(&file[..length]).unwrap();
            let read = recording.by_ref().map(Result::unwrap).count();
            let rest = length as u64 - recording.place();
            assert_eq!(recording.torn(), (rest > 0).then_some(rest), "{length}");
            whole.push(read);
        }
        assert!(whole.is_sorted() && whole.ends_with(&[4]) && whole[0] == 0, "{whole:?}");
    }

    #[test]
    fn recording_with_any_byte_changed_is_refused_with_the_place() {
        let file = file();
        for place in 0..file.len() {
            let mut damaged = file.clone();
            damaged[place] ^= 0x10;
            let fault = match Recording::read(&*damaged) {
                Err(fault) => fault,
                Ok(recording) => {
                    recording.map(|entry| entry.err()).find_map(|fault| fault).expect("a fault")
                }
            };
            match fault {
                RecordingFault::Foreign { .. } => assert!(place < begin().len()),
                RecordingFault::Damaged { place: named, .. } => {
                    let named = usize::try_from(named).unwrap();
                    assert!(named <= place && place < named + 12 + 1000, "{place}: {named}");
                }
                RecordingFault::Io(fault) => panic!("{fault}"),
            }
        }
    }
}
