//! Cases that a seed decides, and how to repeat one that failed.

use std::{env, thread};

/// Runs `case` with each seed in turn: with `VBAR_FAULT_SEED` alone if that is set, else with those
/// from 1 to `VBAR_FAULT_RUNS`, `few` by default. `test` are the words after `cargo test` that name
/// the test.
#[allow(clippy::print_stdout, reason = "whoever looks at a failure needs its seed")]
pub(crate) fn each_seed(test: &str, few: u64, mut case: impl FnMut(u64)) {
    let seeds = match setting("VBAR_FAULT_SEED") {
        Some(seed) => seed..=seed,
        None => 1..=setting("VBAR_FAULT_RUNS").unwrap_or(few),
    };
    println!("{test}: seeds {seeds:?}");
    for seed in seeds {
        let _replay = Replay { test, seed };
        case(seed);
    }
}

fn setting(name: &str) -> Option<u64> {
    let text = env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name}={text:?} is no number")))
}

/// Says how to repeat the case that is under way, if it fails.
struct Replay<'a> {
    test: &'a str,
    seed: u64,
}

impl Drop for Replay<'_> {
    #[allow(clippy::print_stdout, reason = "as above")]
    fn drop(&mut self) {
        if thread::panicking() {
            let Self { test, seed } = self;
            println!("replay: VBAR_FAULT_SEED={seed} cargo test {test} -- --nocapture");
        }
    }
}
