//! The soak: twice what a node can do, of every kind of traffic at once, with every answer held
//! against that of a node that nobody else asked.
//!
//! `VBAR_SOAK_SECONDS` says how long the load lasts, `VBAR_SOAK_SEED` repeats a run, and
//! `VBAR_SOAK_REPORT` names a file for the figures as JSON. The node is a process of its own, so
//! that its memory is its own, and so are its processors where there are two or more: how long the
//! load itself waits for one says nothing about the node.

mod load;
mod nuisance;
mod processors;
pub(crate) mod questions;
mod report;

use std::{
    io::{BufRead as _, BufReader},
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

use tokio::runtime::{self, Runtime};

use load::Load;
use processors::Share;
use questions::Questions;
use report::Report;

/// A node in a process of its own.
struct Process {
    child: Child,
    url: String,
}

impl Process {
    fn start(store: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_soak-node"))
            .arg(store)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let url = lines
            .find_map(|line| Some(line.unwrap().strip_prefix("listening on ")?.to_owned()))
            .expect("the node says where it listens");
        // What else it says is of no interest, but must not fill the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, url }
    }

    fn address(&self) -> std::net::SocketAddr {
        self.url.strip_prefix("http://").unwrap().parse().unwrap()
    }

    /// Resident memory, MiB (Linux; elsewhere nothing is known).
    fn resident_mib(&self) -> Option<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
        Some(line.trim().strip_suffix(" kB")?.parse::<f64>().ok()? / 1024.0)
    }

    /// Ends it; whether it ended well.
    fn end(&mut self) -> bool {
        // It stops when its standard input does.
        drop(self.child.stdin.take());
        self.child.wait().is_ok_and(|status| status.success())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.end();
    }
}

fn setting<T: std::str::FromStr>(name: &str, default: T) -> T {
    match std::env::var(name) {
        Err(_) => default,
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{name}={text:?} is no number")),
    }
}

#[test]
#[allow(clippy::print_stdout, reason = "the figures are what it is for")]
fn soak_answers_are_right_and_refusals_say_when_to_return() {
    let lasts = Duration::from_secs(setting("VBAR_SOAK_SECONDS", 4));
    let seed = setting("VBAR_SOAK_SEED", 20_261_122_u64);
    println!("soak: {} s, VBAR_SOAK_SEED={seed}", lasts.as_secs());
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    // A process has the processors of the thread that starts it.
    println!("{}", processors::keep_to(Share::Node));
    let [quiet, loaded] = folders.each_ref().map(|folder| Process::start(folder.path()));
    println!("{}", processors::keep_to(Share::Load));
    let others = runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .on_thread_start(processors::yield_to_others)
        .enable_all()
        .build()
        .unwrap();
    let runtime = Runtime::new().unwrap();
    runtime.block_on(soak(quiet, loaded, lasts, seed, others.handle().clone()));
}

#[allow(clippy::print_stdout, reason = "the figures are what it is for")]
async fn soak(
    quiet: Process,
    mut loaded: Process,
    lasts: Duration,
    seed: u64,
    others: runtime::Handle,
) {
    let (questions, same) =
        tokio::join!(Questions::answered_by(&quiet.url), Questions::answered_by(&loaded.url));
    // Two processes, the same bytes: what is compared with below is no accident.
    questions.must_equal(&same);
    drop((quiet, same));

    let mut load = Load::new(&loaded, questions, seed, others).await;
    let unloaded = load.one_after_another(lasts / 8).await;
    let capacity = load.capacity(lasts / 8).await;
    let overload = load.overload(2.0 * capacity, lasts).await;
    // Once more, when all is quiet again.
    let afterwards = load.one_after_another(Duration::ZERO).await;
    let metrics = nuisance::get(loaded.address(), "/metrics").await;
    let report = Report { seed, lasts, unloaded, capacity, overload };
    println!("{}", report.table());
    println!("{}", report.json());
    if let Ok(path) = std::env::var("VBAR_SOAK_REPORT") {
        std::fs::write(path, report.json().to_string()).unwrap();
    }

    let Report { overload, .. } = &report;
    assert_eq!(overload.wrong, Vec::<String>::new(), "wrong answers, VBAR_SOAK_SEED={seed}");
    assert_eq!(overload.refused_without_a_time, 0, "VBAR_SOAK_SEED={seed}");
    assert!(overload.admitted > 0 && overload.refused > 0, "it was no overload");
    assert_eq!(afterwards.wrong, Vec::<String>::new());
    for (name, expected) in
        [("vbar_compute_panics_total", 0.0), ("vbar_certificate_failures_total", 0.0)]
    {
        let line = metrics.lines().find_map(|line| line.strip_prefix(name)).expect(name);
        assert_eq!(line.trim().parse::<f64>().unwrap(), expected, "{name}");
    }
    drop(load);
    assert!(loaded.end(), "the node did not end well");
}
