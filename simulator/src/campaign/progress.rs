//! How far a campaign has come, for people.

use std::sync::Mutex;

/// Told about a campaign as it goes.
pub trait Progress: Send + Sync {
    /// A campaign of `total` runs begins.
    fn begin(&self, label: &str, total: u64);
    /// One more run is done.
    fn advance(&self);
    /// The campaign is over.
    fn end(&self);
}

/// Says nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _label: &str, _total: u64) {}
    fn advance(&self) {}
    fn end(&self) {}
}

/// A bar on the terminal's error stream; nothing if that is not a terminal.
#[derive(Debug, Default)]
pub struct ProgressBar {
    bar: Mutex<Option<indicatif::ProgressBar>>,
}

impl ProgressBar {
    fn with(&self, act: impl FnOnce(&mut Option<indicatif::ProgressBar>)) {
        // A poisoned lock only means that another thread panicked while drawing.
        act(&mut self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner));
    }
}

impl ProgressBar {
    /// Shows that `done` of `total` parts are done, of something that is not counted in runs.
    pub fn show(&self, label: &str, done: u64, total: u64) {
        self.with(|current| {
            let bar = current.get_or_insert_with(|| styled(total, "{msg:32} {wide_bar} {elapsed}"));
            bar.set_message(label.to_owned());
            bar.set_position(done);
        });
    }

    /// Takes the bar away.
    pub fn close(&self) {
        self.with(|current| {
            if let Some(bar) = current.take() {
                bar.finish_and_clear();
            }
        });
    }
}

fn styled(total: u64, style: &str) -> indicatif::ProgressBar {
    let bar = indicatif::ProgressBar::new(total);
    if let Ok(style) = indicatif::ProgressStyle::with_template(style) {
        bar.set_style(style);
    }
    bar
}

impl Progress for ProgressBar {
    fn begin(&self, label: &str, total: u64) {
        let bar = styled(total, "{msg:32} {wide_bar} {pos}/{len} {elapsed}");
        bar.set_message(label.to_owned());
        self.with(|current| *current = Some(bar));
    }

    fn advance(&self) {
        self.with(|current| {
            if let Some(bar) = current {
                bar.inc(1);
            }
        });
    }

    fn end(&self) {
        self.close();
    }
}
