//! What the store remembers of a job.
//!
//! ```text
//! one line of JSON | "\n" | the problem as it came
//! ```
//!
//! The line can be read by people. The problem is there until the job is done: it is all that is
//! needed to go on with it. Where several machines work together it is not there: it lies on a shelf
//! under the ticket that the line names.

use std::time::{Duration, SystemTime};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::{Ending, fleet::Parts};
use crate::wire::{Failure, NoArtifact, Standing};

const FORMAT_VERSION: u32 = 1;
/// No problem within our limits has as many shards; what is counted for each fits in memory.
const SHARDS_MAX: usize = 1 << 20;

/// A job as it is written down.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct JobRecord {
    line: Line,
    ending: Option<Ending>,
    problem: Bytes,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    format: u32,
    method: String,
    /// How often it was begun.
    attempts: u32,
    shards_done: usize,
    shards_total: usize,
    created_unix_ms: u64,
    started_unix_ms: Option<u64>,
    ended_unix_ms: Option<u64>,
    ending: Option<WrittenEnding>,
    /// Of a job that several machines do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    parts: Option<Parts>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum WrittenEnding {
    Made,
    /// Bytes of the message.
    Infeasible(Vec<u8>),
    Failed(Failure),
    Cancelled,
}

impl JobRecord {
    /// A job that waits.
    pub(super) fn new(method: &str, shards_total: usize, problem: Bytes) -> Self {
        let line = Line {
            format: FORMAT_VERSION,
            method: method.to_owned(),
            attempts: 0,
            shards_done: 0,
            shards_total,
            created_unix_ms: unix_ms(SystemTime::now()),
            started_unix_ms: None,
            ended_unix_ms: None,
            ending: None,
            parts: None,
        };
        Self { line, ending: None, problem }
    }

    /// A job that several machines do waits.
    pub(super) fn in_parts(method: &str, shards_total: usize, parts: Parts) -> Self {
        let mut record = Self::new(method, shards_total, Bytes::new());
        record.line.parts = Some(parts);
        record
    }

    /// Its bytes.
    pub(super) fn encode(&self) -> Vec<u8> {
        let ending = self.ending.as_ref().map(|ending| match ending {
            Ending::Made => WrittenEnding::Made,
            Ending::Infeasible(why) => WrittenEnding::Infeasible(why.to_bytes()),
            Ending::Failed(failure) => WrittenEnding::Failed(failure.clone()),
            Ending::Cancelled => WrittenEnding::Cancelled,
        });
        let line = Line { ending, ..self.line.clone() };
        let mut bytes = serde_json::to_vec(&line).expect("a line of numbers and text");
        bytes.push(b'\n');
        bytes.extend_from_slice(&self.problem);
        bytes
    }

    /// Reads what [`JobRecord::encode`] wrote.
    pub(super) fn decode(bytes: &Bytes) -> Result<Self, String> {
        let end = bytes.iter().position(|&c| c == b'\n').ok_or("it has no first line")?;
        let mut line: Line =
            serde_json::from_slice(&bytes[..end]).map_err(|fault| fault.to_string())?;
        if line.format != FORMAT_VERSION {
            return Err(format!("format {}, this server reads {FORMAT_VERSION}", line.format));
        }
        if line.shards_total > SHARDS_MAX || line.shards_done > line.shards_total {
            let (done, total) = (line.shards_done, line.shards_total);
            return Err(format!("{done} shards of {total} are done, at most {SHARDS_MAX} can be"));
        }
        if line.parts.as_ref().is_some_and(|parts| !parts.fit(line.shards_total)) {
            return Err(format!("its parts are not those of {} shards", line.shards_total));
        }
        let ending = match line.ending.take() {
            None => None,
            Some(WrittenEnding::Made) => Some(Ending::Made),
            Some(WrittenEnding::Infeasible(why)) => {
                let why = NoArtifact::from_bytes(&why).ok_or("its answer cannot be read")?;
                Some(Ending::Infeasible(why))
            }
            Some(WrittenEnding::Failed(failure)) => Some(Ending::Failed(failure)),
            Some(WrittenEnding::Cancelled) => Some(Ending::Cancelled),
        };
        Ok(Self { line, ending, problem: bytes.slice(end + 1..) })
    }

    /// It runs.
    pub(super) fn begin(&mut self) {
        self.line.attempts = self.line.attempts.saturating_add(1);
        self.line.started_unix_ms = Some(unix_ms(SystemTime::now()));
    }

    /// It waits again: whoever was at it has ended.
    pub(super) fn hand_back(&mut self) {
        self.line.started_unix_ms = None;
        self.line.shards_done = 0;
    }

    /// The attempt that [`JobRecord::begin`] counted was not the job's fault.
    pub(super) fn uncount_attempt(&mut self) {
        self.line.attempts = self.line.attempts.saturating_sub(1);
    }

    pub(super) fn set_shards_done(&mut self, done: usize) {
        self.line.shards_done = done;
    }

    /// It is done, at `now`. What is made is made of all its shards, whoever saw them.
    pub(super) fn end(&mut self, shards_done: usize, ending: Ending, now: SystemTime) {
        let is_made = ending == Ending::Made;
        self.line.shards_done = if is_made { self.line.shards_total } else { shards_done };
        self.line.ended_unix_ms = Some(unix_ms(now));
        self.ending = Some(ending);
        self.problem = Bytes::new();
    }

    /// Where the parts of a job stand that several machines do.
    pub(super) fn parts(&self) -> Option<&Parts> {
        self.line.parts.as_ref()
    }

    /// The same, to be changed.
    pub(super) fn parts_mut(&mut self) -> Option<&mut Parts> {
        self.line.parts.as_mut()
    }

    /// A part of it was begun so often.
    pub(super) fn set_attempts(&mut self, attempts: u32) {
        self.line.attempts = self.line.attempts.max(attempts);
    }

    pub(super) fn method(&self) -> &str {
        &self.line.method
    }

    pub(super) fn problem(&self) -> &[u8] {
        &self.problem
    }

    pub(super) fn ending(&self) -> Option<&Ending> {
        self.ending.as_ref()
    }

    pub(super) fn attempts(&self) -> u32 {
        self.line.attempts
    }

    pub(super) fn shards_done(&self) -> usize {
        self.line.shards_done
    }

    pub(super) fn shards_total(&self) -> usize {
        self.line.shards_total
    }

    pub(super) fn created(&self) -> SystemTime {
        time(self.line.created_unix_ms)
    }

    pub(super) fn started(&self) -> Option<SystemTime> {
        self.line.started_unix_ms.map(time)
    }

    pub(super) fn ended(&self) -> Option<SystemTime> {
        self.line.ended_unix_ms.map(time)
    }

    pub(super) fn standing(&self) -> Standing {
        match &self.ending {
            Some(Ending::Made | Ending::Infeasible(_)) => Standing::Succeeded,
            Some(Ending::Failed(_)) => Standing::Failed,
            Some(Ending::Cancelled) => Standing::Cancelled,
            None if self.line.started_unix_ms.is_some() => Standing::Running,
            None => Standing::Queued,
        }
    }
}

fn unix_ms(time: SystemTime) -> u64 {
    let since = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

fn time(unix_ms: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH.checked_add(Duration::from_millis(unix_ms)).unwrap_or(SystemTime::now())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn job_record_comes_back_as_it_was() {
        let problem = Bytes::from_static(b"line\nand another");
        let mut record = JobRecord::new("variable_horizon", 7, problem.clone());
        assert_eq!(JobRecord::decode(&record.encode().into()), Ok(record.clone()));
        assert_eq!(record.standing(), Standing::Queued);
        record.begin();
        let again = JobRecord::decode(&record.encode().into()).unwrap();
        assert_eq!((again.standing(), again.attempts()), (Standing::Running, 1));
        assert_eq!(again.problem(), problem);
        for (ending, standing, done) in [
            (Ending::Made, Standing::Succeeded, 7),
            (Ending::Cancelled, Standing::Cancelled, 3),
            (Ending::Failed(Failure::cancelled()), Standing::Failed, 3),
        ] {
            let mut ended = record.clone();
            ended.end(3, ending, SystemTime::now());
            let again = JobRecord::decode(&ended.encode().into()).unwrap();
            assert_eq!((again.standing(), again.shards_done()), (standing, done));
            assert_eq!(again, ended);
            assert_eq!(again.problem(), b"", "nobody needs it any more");
        }
    }

    #[test]
    fn job_record_faults_are_named() {
        let fault = |text: &str| JobRecord::decode(&Bytes::copy_from_slice(text.as_bytes()));
        assert!(fault("").unwrap_err().contains("first line"));
        assert!(fault("{}\n").unwrap_err().contains("format"));
        let good = String::from_utf8(JobRecord::new("m", 1, Bytes::new()).encode()).unwrap();
        let other = good.replace("\"format\":1", "\"format\":2");
        assert!(fault(&other).unwrap_err().contains("format 2"));
        // A mirror counts for each shard: so many would take all memory there is.
        let many = good.replace("\"shards_total\":1", &format!("\"shards_total\":{}", usize::MAX));
        assert!(fault(&many).unwrap_err().contains("shards"));
        let beyond = good.replace("\"shards_done\":0", "\"shards_done\":2");
        assert!(fault(&beyond).unwrap_err().contains("2 shards of 1"));
        let parts = |done: &str, ticket: usize| {
            let parts = format!("{{\"ticket\":\"{}\",\"done\":\"{done}\"}}", "00".repeat(ticket));
            fault(&good.replace("\"ending\":null", &format!("\"ending\":null,\"parts\":{parts}")))
        };
        assert!(parts("01", 24).is_ok());
        for (done, ticket) in [("", 24), ("02", 24), ("0100", 24), ("01", 23)] {
            assert!(parts(done, ticket).unwrap_err().contains("parts"), "{done} {ticket}");
        }
        let more = good.replace("\"format\":1", "\"format\":1,\"more\":1");
        assert!(fault(&more).unwrap_err().contains("more"));
    }
}
