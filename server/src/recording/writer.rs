//! The writing end of the black box.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Write as _},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread::{self, JoinHandle},
    time::SystemTime,
};

use super::{
    RecordingOptions,
    format::{self, Entry, Exchange, Lost, Recording, RecordingFault, Session, entry::What},
};
use crate::telemetry::{Metrics, OutcomeLabels, TOKEN_PREFIX};

/// Hands exchanges to the thread that writes them.
#[derive(Debug)]
pub(crate) struct Recorder {
    /// Gone when no more are taken.
    exchanges: Mutex<Option<SyncSender<Exchange>>>,
    thread: Mutex<Option<JoinHandle<()>>>,
    waiting: Arc<Waiting>,
    loops: AtomicU64,
    metrics: Arc<Metrics>,
}

/// What waits for the disk.
#[derive(Debug, Default)]
struct Waiting {
    bytes: AtomicUsize,
    /// Exchanges that were not taken since this was last written down.
    lost: AtomicU64,
}

impl Recorder {
    /// Exchanges that may wait for the disk, and their bytes.
    const WAITING_MAX: usize = 4096;
    const WAITING_BYTES_MAX: usize = 64 << 20;
    /// Largest message that is kept.
    pub(crate) const MESSAGE_BYTES_MAX: usize = 24 << 20;

    /// Goes on with the file that `options` name; `None` if they name none. Blocks on the file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn open(
        options: &RecordingOptions,
        session: Session,
        metrics: Arc<Metrics>,
    ) -> io::Result<Option<Self>> {
        let Some(path) = &options.file else { return Ok(None) };
        let session = Session { id: unix_ms(), ..session };
        let waiting = Arc::new(Waiting::default());
        let mut target = Target {
            file: Output::open(path)?,
            path: path.clone(),
            session,
            // Two files, one of them full.
            file_bytes_max: options.bytes_max / 2,
            answers: options.answers,
            waiting: Arc::clone(&waiting),
            metrics: Arc::clone(&metrics),
        };
        target.begin()?;
        let (sender, receiver) = sync_channel(Self::WAITING_MAX);
        let thread = thread::Builder::new()
            .name("recording".to_owned())
            .spawn(move || target.write(&receiver))?;
        let exchanges = Mutex::new(Some(sender));
        let thread = Mutex::new(Some(thread));
        Ok(Some(Self { exchanges, thread, waiting, loops: AtomicU64::new(0), metrics }))
    }

    /// A number for a closed loop that begins.
    pub(crate) fn next_loop(&self) -> u64 {
        self.loops.fetch_add(1, Ordering::Relaxed)
    }

    /// Takes an exchange to be written, or counts it as lost: a call never waits for the disk.
    pub(crate) fn take(&self, exchange: Exchange) {
        let size = size(&exchange);
        let fits =
            self.waiting.bytes.fetch_add(size, Ordering::Relaxed) + size <= Self::WAITING_BYTES_MAX;
        let exchanges = self.exchanges.lock().unwrap_or_else(PoisonError::into_inner);
        let is_taken = fits
            && exchanges.as_ref().is_some_and(|exchanges| exchanges.try_send(exchange).is_ok());
        drop(exchanges);
        if !is_taken {
            self.waiting.bytes.fetch_sub(size, Ordering::Relaxed);
            self.lose();
        }
    }

    /// Counts an exchange that cannot be kept.
    pub(crate) fn lose(&self) {
        // Said in the log once for all that are lost until the next is written.
        if self.waiting.lost.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::error!("exchanges are lost to the recording");
        }
        count(&self.metrics, "lost", 1);
    }

    /// Waits until everything is with the system; nothing is taken after this. Blocks.
    pub(crate) fn close(&self) {
        self.exchanges.lock().unwrap_or_else(PoisonError::into_inner).take();
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the recording's thread did not end well");
        }
    }
}

fn count(metrics: &Metrics, outcome: &'static str, count: u64) {
    metrics.recorded_exchanges.get_or_create(&OutcomeLabels { outcome }).inc_by(count);
}

/// About what an exchange takes in memory.
fn size(exchange: &Exchange) -> usize {
    let answers: usize = exchange.answers.iter().map(Vec::len).sum();
    256 + exchange.path.len() + exchange.request.len() + answers
}

fn unix_ms() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// A file with only whole records in it.
#[derive(Debug)]
struct Output {
    file: File,
    /// Bytes of whole records.
    length: u64,
}

impl Output {
    /// Opens the file at `path` behind its last whole record. One that is damaged, or no recording
    /// at all, is put aside under a name that ends in `.damaged`.
    fn open(path: &Path) -> io::Result<Self> {
        let length = match Recording::open(path) {
            Err(RecordingFault::Io(fault)) if fault.kind() == io::ErrorKind::NotFound => 0,
            Err(RecordingFault::Io(fault)) => return Err(fault),
            Err(_) if fs::metadata(path)?.len() == 0 => 0,
            Err(fault) => put_aside(path, &fault)?,
            Ok(mut recording) => match recording.by_ref().find_map(Result::err) {
                Some(RecordingFault::Io(fault)) => return Err(fault),
                Some(fault) => put_aside(path, &fault)?,
                None => recording.place(),
            },
        };
        let mut options = OpenOptions::new();
        options.append(true).create(true);
        // It says where spacecraft are.
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let file = options.open(path)?;
        if file.metadata()?.len() > length {
            tracing::warn!(path = %path.display(), "the recording's last record was torn");
            file.set_len(length)?;
        }
        Ok(Self { file, length })
    }

    fn append(&mut self, records: &[u8]) -> io::Result<()> {
        let written = self.file.write_all(records);
        match written {
            Ok(()) => self.length += records.len() as u64,
            // A part of it may be there: nobody could read past that.
            Err(_) => self.file.set_len(self.length)?,
        }
        written
    }
}

/// Renames the file out of the way; the length of what is then there.
fn put_aside(path: &Path, fault: &RecordingFault) -> io::Result<u64> {
    let aside = with_suffix(path, ".damaged");
    let (shown, kept) = (path.display(), aside.display());
    tracing::error!(path = %shown, %fault, %kept, "the recording cannot be continued");
    fs::rename(path, &aside)?;
    Ok(0)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// What the thread has.
#[derive(Debug)]
struct Target {
    path: PathBuf,
    file: Output,
    session: Session,
    file_bytes_max: u64,
    answers: bool,
    waiting: Arc<Waiting>,
    metrics: Arc<Metrics>,
}

impl Target {
    const EXCHANGES_AT_ONCE: usize = 64;
    const BYTES_AT_ONCE: usize = 1 << 20;

    /// Writes who writes.
    fn begin(&mut self) -> io::Result<()> {
        let mut records = if self.file.length == 0 { format::begin() } else { Vec::new() };
        let what = Some(What::Session(self.session.clone()));
        format::append(&mut records, &Entry { what });
        self.file.append(&records)
    }

    fn write(mut self, exchanges: &Receiver<Exchange>) {
        while let Ok(first) = exchanges.recv() {
            let (mut records, mut bytes) = (Vec::new(), 0);
            let mut next = Some(first);
            while let Some(exchange) = next {
                let record = self.encode(exchange);
                bytes += record.as_ref().map_or(0, Vec::len);
                records.extend(record);
                let has_room =
                    records.len() < Self::EXCHANGES_AT_ONCE && bytes < Self::BYTES_AT_ONCE;
                next = has_room.then(|| exchanges.try_recv().ok()).flatten();
            }
            let written = records.len() as u64;
            let lost = self.waiting.lost.swap(0, Ordering::Relaxed);
            if lost > 0 {
                let what = Some(What::Lost(Lost { count: lost }));
                let mut record = Vec::new();
                format::append(&mut record, &Entry { what });
                records.push(record);
                tracing::error!(lost, "exchanges are missing in the recording");
            }
            match self.append(&records) {
                Ok(()) => count(&self.metrics, "written", written),
                // Some may be there: more are said to be missing than are.
                Err(fault) => {
                    self.waiting.lost.fetch_add(lost + written, Ordering::Relaxed);
                    count(&self.metrics, "lost", written);
                    let path = self.path.display();
                    tracing::error!(%path, %fault, written, "exchanges are lost to the recording");
                }
            }
        }
    }

    /// An exchange as a record, unless it must not be kept.
    fn encode(&mut self, mut exchange: Exchange) -> Option<Vec<u8>> {
        self.waiting.bytes.fetch_sub(size(&exchange), Ordering::Relaxed);
        if holds_token(exchange.path.as_bytes()) || holds_token(&exchange.request) {
            count(&self.metrics, "withheld", 1);
            self.waiting.lost.fetch_add(1, Ordering::Relaxed);
            return None;
        }
        exchange.answer_sha256 = format::digest(exchange.answers.iter().map(Vec::as_slice));
        if !self.answers {
            exchange.answers.clear();
        }
        exchange.unix_ms = unix_ms();
        let mut record = Vec::new();
        if !format::append(&mut record, &Entry { what: Some(What::Exchange(exchange)) }) {
            self.waiting.lost.fetch_add(1, Ordering::Relaxed);
            count(&self.metrics, "lost", 1);
            return None;
        }
        Some(record)
    }

    /// Appends records, in a new file from the first on that the old one has no room for.
    fn append(&mut self, records: &[Vec<u8>]) -> io::Result<()> {
        let mut together = Vec::new();
        for record in records {
            let length = self.file.length + (together.len() + record.len()) as u64;
            if length > self.file_bytes_max {
                self.file.append(&together)?;
                together.clear();
                fs::rename(&self.path, with_suffix(&self.path, ".1"))?;
                self.file = Output::open(&self.path)?;
                self.begin()?;
            }
            together.extend_from_slice(record);
        }
        self.file.append(&together)
    }
}

/// Whether `bytes` hold something like a token of ours.
fn holds_token(bytes: &[u8]) -> bool {
    bytes.windows(TOKEN_PREFIX.len()).any(|window| window == TOKEN_PREFIX.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exchange(index: u64, request: &[u8]) -> Exchange {
        Exchange {
            call: "Step".to_owned(),
            path: "/v1/step".to_owned(),
            request: request.to_vec(),
            answers: vec![b"abc".to_vec()],
            index,
            ..Exchange::default()
        }
    }

    fn options(file: &Path) -> RecordingOptions {
        RecordingOptions { file: Some(file.to_owned()), ..RecordingOptions::default() }
    }

    fn open(options: &RecordingOptions, metrics: &Arc<Metrics>) -> Recorder {
        let session = Session::default();
        Recorder::open(options, session, Arc::clone(metrics)).unwrap().expect("there is a file")
    }

    fn entries(path: &Path) -> Vec<What> {
        Recording::open(path).unwrap().map(|entry| entry.unwrap().what.unwrap()).collect()
    }

    fn indices(entries: &[What]) -> Vec<u64> {
        let exchange = |what: &What| match what {
            What::Exchange(exchange) => Some(exchange.index),
            What::Session(_) | What::Lost(_) => None,
        };
        entries.iter().filter_map(exchange).collect()
    }

    #[test]
    fn recording_goes_on_behind_a_torn_record() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box");
        let metrics = Arc::new(Metrics::new());
        for run in 0..3 {
            let recorder = open(&options(&path), &metrics);
            (0..5).for_each(|call| recorder.take(exchange(10 * run + call, b"asked")));
            recorder.close();
            // What a killed writer leaves.
            let whole = fs::read(&path).unwrap();
            fs::write(&path, [&whole[..], &[9, 9, 9]].concat()).unwrap();
        }
        let entries = entries(&path);
        let expected: Vec<u64> =
            (0..3).flat_map(|run| (0..5).map(move |call| 10 * run + call)).collect();
        assert_eq!(indices(&entries), expected);
        assert!(matches!(entries[0], What::Session(_)) && matches!(entries[6], What::Session(_)));
        let What::Exchange(first) = &entries[1] else { panic!("{:?}", entries[1]) };
        // FIPS 180-2, appendix B.1.
        assert_eq!(first.answer_sha256[..4], [0xba, 0x78, 0x16, 0xbf]);
    }

    #[test]
    fn recording_that_is_damaged_is_put_aside() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box");
        let metrics = Arc::new(Metrics::new());
        for before in [&b"something else"[..], &[format::begin(), vec![7; 40]].concat()] {
            fs::write(&path, before).unwrap();
            let recorder = open(&options(&path), &metrics);
            recorder.take(exchange(1, b"asked"));
            recorder.close();
            assert_eq!(indices(&entries(&path)), [1]);
            assert_eq!(fs::read(folder.path().join("box.damaged")).unwrap(), before);
        }
    }

    #[test]
    fn recording_is_bounded_by_two_files_and_each_says_who_wrote_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box");
        let options = RecordingOptions { bytes_max: 40_000, ..options(&path) };
        let recorder = open(&options, &Arc::new(Metrics::new()));
        for index in 0..200 {
            recorder.take(exchange(index, &[1; 1000]));
            // No more at once than may wait.
            while recorder.waiting.bytes.load(Ordering::Relaxed) > 100_000 {
                thread::yield_now();
            }
        }
        recorder.close();
        let (older, newer) = (entries(&folder.path().join("box.1")), entries(&path));
        for entries in [&older, &newer] {
            assert!(matches!(entries[0], What::Session(_)));
        }
        let kept = [indices(&older), indices(&newer)].concat();
        let expected: Vec<u64> = (200 - kept.len() as u64..200).collect();
        assert!(kept == expected && kept.len() > 15, "{kept:?}");
        let bytes: u64 = fs::read_dir(folder.path())
            .unwrap()
            .map(|f| f.unwrap().metadata().unwrap().len())
            .sum();
        assert!(bytes <= 40_000, "{bytes}");
    }

    #[test]
    fn recording_never_holds_a_token_and_says_what_is_missing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box");
        let metrics = Arc::new(Metrics::new());
        let recorder = open(&options(&path), &metrics);
        let secret = format!("{TOKEN_PREFIX}abcdef");
        recorder.take(exchange(0, secret.as_bytes()));
        recorder.take(Exchange { path: format!("/v1/plans/{secret}"), ..exchange(1, b"") });
        recorder.take(exchange(2, b"asked"));
        recorder.close();
        let entries = entries(&path);
        assert_eq!(indices(&entries), [2]);
        let lost = entries.iter().map(|what| match what {
            What::Lost(lost) => lost.count,
            What::Session(_) | What::Exchange(_) => 0,
        });
        assert_eq!(lost.sum::<u64>(), 2);
        assert!(!holds_token(&fs::read(&path).unwrap()));
        // After the end everything is lost, and counted.
        recorder.take(exchange(3, b"late"));
        let text = metrics.text();
        assert!(text.contains("vbar_recorded_exchanges_total{outcome=\"lost\"} 1"), "{text}");
        assert!(text.contains("vbar_recorded_exchanges_total{outcome=\"withheld\"} 2"), "{text}");
    }

    #[test]
    fn recording_to_a_full_disk_is_whole_and_counts_what_is_lost() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("box");
        fs::write(&path, format::begin()).unwrap();
        let metrics = Arc::new(Metrics::new());
        let waiting = Arc::new(Waiting::default());
        let mut target = Target {
            // A file that is not open for writing refuses as a full disk does.
            file: Output { file: File::open(&path).unwrap(), length: 8 },
            path: path.clone(),
            session: Session::default(),
            file_bytes_max: 1 << 20,
            answers: true,
            waiting,
            metrics,
        };
        let records = [target.encode(exchange(0, b"asked")).unwrap()];
        assert!(target.append(&records).is_err());
        target.file = Output::open(&path).unwrap();
        target.append(&records).unwrap();
        assert_eq!(indices(&entries(&path)), [0]);
    }
}
