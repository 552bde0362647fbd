//! Who asked for what: one line a call.
//!
//! Each line goes to the log under the target `vbar::audit`, and as JSON to a file if there is
//! one. Lines hold digests of what was asked and answered, never the text itself, and never what a
//! caller showed to be let in.

use std::{
    fs::{File, OpenOptions},
    io::{self, Write as _},
    net::IpAddr,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant, SystemTime},
};

use serde::Serialize;

use super::options::OptionFault;
use crate::telemetry::Metrics;

/// Name of the target in the log.
pub(crate) const TARGET: &str = "vbar::audit";

/// One call.
#[derive(Debug, Serialize)]
pub(crate) struct AuditLine<'a> {
    /// Who asked: the name of a token or certificate, or an address.
    pub(crate) caller: &'a str,
    /// Where from.
    pub(crate) peer: IpAddr,
    /// The role the call needs; empty if none.
    pub(crate) role: &'static str,
    /// The RPC, whatever it came over.
    pub(crate) call: &'static str,
    /// `grpc` or `http`.
    pub(crate) transport: &'static str,
    /// The id in the path of an HTTP request; empty if there is none.
    pub(crate) resource: &'a str,
    /// Digest of the request's message as it came, without the framing of gRPC; of all messages
    /// in their order if there are several.
    pub(crate) request_sha256: &'a str,
    /// The same of the answer.
    pub(crate) answer_sha256: &'a str,
    /// Messages that came.
    pub(crate) messages_in: u64,
    /// Messages that went.
    pub(crate) messages_out: u64,
    /// Name of the `google.rpc.Code`.
    pub(crate) code: &'a str,
    /// As in errors, logs and the header of the answer.
    pub(crate) request_id: &'a str,
    /// The trace that the request is part of, as in errors and logs.
    pub(crate) trace_id: &'a str,
    /// From the head of the request to the end of the answer.
    pub(crate) elapsed_us: u64,
}

/// A line with its moment.
#[derive(Serialize)]
struct Dated<'a> {
    time: String,
    #[serde(flatten)]
    line: &'a AuditLine<'a>,
}

/// Where calls are written down.
#[derive(Debug)]
pub(crate) struct Audit {
    file: Option<Writer>,
    metrics: Arc<Metrics>,
}

/// A thread that writes, so that no call waits for a disk.
#[derive(Debug)]
struct Writer {
    /// Gone when no more lines are taken.
    lines: Mutex<Option<SyncSender<String>>>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Audit {
    /// Lines that may wait for the disk.
    const WAITING_MAX: usize = 8192;

    /// Writes to `path` too, if there is one.
    pub(super) fn open(path: Option<&Path>, metrics: Arc<Metrics>) -> Result<Self, OptionFault> {
        let Some(path) = path else { return Ok(Self { file: None, metrics }) };
        let fault = |why: io::Error| {
            let got = format!("{}: {why}", path.display());
            OptionFault::new("audit_file", "a file that can be written", got)
        };
        let file = append(path).map_err(fault)?;
        let (sender, receiver) = sync_channel(Self::WAITING_MAX);
        let target = Target {
            path: path.to_owned(),
            file: Some((file, Instant::now())),
            is_torn: false,
            metrics: Arc::clone(&metrics),
        };
        let thread = thread::Builder::new()
            .name("audit".to_owned())
            .spawn(move || target.write(&receiver))
            .map_err(fault)?;
        let writer = Writer { lines: Mutex::new(Some(sender)), thread: Mutex::new(Some(thread)) };
        Ok(Self { file: Some(writer), metrics })
    }

    /// Whether anybody reads the lines.
    pub(crate) fn is_kept(&self) -> bool {
        self.file.is_some() || tracing::enabled!(target: TARGET, tracing::Level::INFO)
    }

    /// Writes a call down.
    pub(crate) fn write(&self, line: &AuditLine<'_>) {
        tracing::info!(
            target: TARGET,
            caller = line.caller,
            peer = %line.peer,
            role = line.role,
            call = line.call,
            transport = line.transport,
            resource = line.resource,
            request_sha256 = line.request_sha256,
            answer_sha256 = line.answer_sha256,
            messages_in = line.messages_in,
            messages_out = line.messages_out,
            code = line.code,
            request_id = line.request_id,
            trace_id = line.trace_id,
            elapsed_us = line.elapsed_us,
            "call"
        );
        let Some(writer) = &self.file else { return };
        let mut text = serde_json::to_string(&Dated { time: now(), line })
            .expect("a line has only text and numbers");
        text.push('\n');
        let lines = writer.lines.lock().unwrap_or_else(PoisonError::into_inner);
        let sent = lines.as_ref().map(|lines| lines.try_send(text));
        if matches!(sent, None | Some(Err(TrySendError::Full(_) | TrySendError::Disconnected(_)))) {
            self.metrics.audit_lines_lost.inc();
            tracing::error!(request_id = line.request_id, "a line of the audit file is lost");
        }
    }

    /// Waits until every line is with the system; none is taken after this. Blocks.
    pub(crate) fn close(&self) {
        let Some(writer) = &self.file else { return };
        writer.lines.lock().unwrap_or_else(PoisonError::into_inner).take();
        let thread = writer.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the audit file's thread did not end well");
        }
    }
}

/// The writing end.
struct Target {
    path: PathBuf,
    /// With the moment it was opened.
    file: Option<(File, Instant)>,
    /// The last line may be cut off.
    is_torn: bool,
    metrics: Arc<Metrics>,
}

impl Target {
    /// A file that was moved away is left after this time.
    const OPEN_MAX: Duration = Duration::from_secs(5);
    const LINES_AT_ONCE: u64 = 256;

    fn write(mut self, lines: &Receiver<String>) {
        while let Ok(mut text) = lines.recv() {
            let mut count = 1;
            while count < Self::LINES_AT_ONCE
                && let Ok(more) = lines.try_recv()
            {
                text.push_str(&more);
                count += 1;
            }
            if let Err(fault) = self.append(&text) {
                self.file = None;
                self.metrics.audit_lines_lost.inc_by(count);
                let path = self.path.display();
                tracing::error!(%path, %fault, count, "lines of the audit file are lost");
            }
        }
    }

    fn append(&mut self, text: &str) -> io::Result<()> {
        let mut file = match self.file.take() {
            Some((file, opened)) if opened.elapsed() < Self::OPEN_MAX => (file, opened),
            _ => (append(&self.path)?, Instant::now()),
        };
        if self.is_torn {
            file.0.write_all(b"\n")?;
        }
        self.is_torn = true;
        file.0.write_all(text.as_bytes())?;
        self.is_torn = false;
        self.file = Some(file);
        Ok(())
    }
}

fn append(path: &Path) -> io::Result<File> {
    OpenOptions::new().append(true).create(true).open(path)
}

/// Now in UTC, as RFC 3339 says it.
fn now() -> String {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    hifitime::Epoch::from_unix_duration(since.into()).to_rfc3339()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(request_id: &str) -> AuditLine<'_> {
        AuditLine {
            caller: "ground",
            peer: [10, 0, 0, 7].into(),
            role: "step",
            call: "Step",
            transport: "grpc",
            resource: "",
            request_sha256: "00",
            answer_sha256: "11",
            messages_in: 1,
            messages_out: 1,
            code: "OK",
            request_id,
            trace_id: "22",
            elapsed_us: 7,
        }
    }

    #[test]
    fn audit_file_has_every_line_whole_and_goes_on_where_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit.jsonl");
        for run in 0..2 {
            let audit = Audit::open(Some(&path), Arc::new(Metrics::new())).unwrap();
            for call in 0..300 {
                audit.write(&line(&format!("{run}-{call}")));
            }
            audit.close();
        }
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<serde_json::Value> =
            text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines.len(), 600);
        assert_eq!(lines[0]["request_id"], "0-0");
        assert_eq!(lines[599]["request_id"], "1-299");
        assert_eq!(lines[0]["peer"], "10.0.0.7");
        assert_eq!(lines[0]["trace_id"], "22");
        let time = lines[0]["time"].as_str().unwrap();
        assert!(time.parse::<toml::value::Datetime>().is_ok(), "{time}");
    }

    #[test]
    fn audit_lines_that_cannot_be_written_are_counted_and_later_ones_are_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit.jsonl");
        let metrics = Arc::new(Metrics::new());
        let mut target = Target {
            path: path.clone(),
            // A file that is not open for writing refuses as a full disk does.
            file: Some((
                File::create(&path).and_then(|_| File::open(&path)).unwrap(),
                Instant::now(),
            )),
            is_torn: true,
            metrics: Arc::clone(&metrics),
        };
        assert!(target.append("lost\n").is_err());
        target.file = None;
        target.append("{}\n").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "\n{}\n");
        let folder_is_gone = Audit::open(Some(&folder.path().join("no/audit")), metrics);
        assert_eq!(folder_is_gone.unwrap_err().setting, "audit_file");
    }
}
