//! The figures of a soak, as a table and as JSON.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    time::{Duration, Instant},
};

use hdrhistogram::Histogram;
use serde_json::{Value, json};

use super::processors::Ticks;

/// Length of the stretches of a phase that are told apart by what other machines took in them.
const STRETCH: Duration = Duration::from_secs(2);
/// A stretch is calm if they took less than this share of the processors.
const CALM: f64 = 0.005;

/// A short time of a phase.
#[derive(Debug)]
struct Stretch {
    begun: Instant,
    before: Option<Ticks>,
    steps: Histogram<u64>,
    /// Share of the processors that other machines took, once it is over.
    stolen: Option<f64>,
}

impl Stretch {
    fn begin() -> Self {
        Self { begun: Instant::now(), before: Ticks::now(), steps: histogram(), stolen: None }
    }

    fn end(&mut self) {
        self.stolen = Ticks::now().zip(self.before).map(|(now, before)| now.stolen_since(before));
    }

    fn is_calm(&self) -> bool {
        self.stolen.is_some_and(|stolen| stolen < CALM)
    }
}

/// What one phase saw.
#[derive(Debug)]
pub(super) struct Seen {
    /// Answered steps by method: microseconds from the question to the answer.
    pub(super) steps: BTreeMap<&'static str, Histogram<u64>>,
    /// Everything else that was answered, by what it was.
    pub(super) others: BTreeMap<&'static str, u64>,
    /// Steps answered.
    pub(super) admitted: u64,
    /// Calls told to come back.
    pub(super) refused: u64,
    /// Those of them that were not told when.
    pub(super) refused_without_a_time: u64,
    /// Calls that failed otherwise, by code.
    pub(super) failed: BTreeMap<String, u64>,
    /// What was not as it should be, with the question.
    pub(super) wrong: Vec<String>,
    /// Resident memory of the node, MiB, one figure a tenth of the phase.
    pub(super) memory_mib: Vec<f64>,
    /// Steps that were due, whatever became of them.
    pub(super) offered: u64,
    /// All of it in short stretches; the last one goes on.
    stretches: Vec<Stretch>,
}

impl Seen {
    pub(super) fn nothing() -> Self {
        Self {
            steps: BTreeMap::new(),
            others: BTreeMap::new(),
            admitted: 0,
            refused: 0,
            refused_without_a_time: 0,
            failed: BTreeMap::new(),
            wrong: Vec::new(),
            memory_mib: Vec::new(),
            offered: 0,
            stretches: vec![Stretch::begin()],
        }
    }

    /// The phase is over.
    pub(super) fn end(mut self) -> Self {
        self.stretches.last_mut().into_iter().for_each(Stretch::end);
        self
    }

    /// A step was answered.
    pub(super) fn step(&mut self, method: &'static str, took: Duration) {
        self.admitted += 1;
        let micros = u64::try_from(took.as_micros()).unwrap_or(u64::MAX);
        let histogram = self.steps.entry(method).or_insert_with(histogram);
        histogram.saturating_record(micros);
        if let Some(stretch) = self.stretches.last_mut() {
            stretch.steps.saturating_record(micros);
            if stretch.begun.elapsed() >= STRETCH {
                stretch.end();
                self.stretches.push(Stretch::begin());
            }
        }
    }

    /// Something else was answered as it should.
    pub(super) fn other(&mut self, what: &'static str) {
        *self.others.entry(what).or_default() += 1;
    }

    /// Something was not as it should be; the first hundred are enough to see what.
    pub(super) fn wrong(&mut self, what: String) {
        if self.wrong.len() < 100 {
            self.wrong.push(what);
        }
    }

    /// Steps of the calm stretches, and how many of these there were.
    fn calm(&self) -> (Histogram<u64>, usize) {
        let mut all = histogram();
        let calm = self.stretches.iter().filter(|stretch| stretch.is_calm());
        let count = calm.clone().count();
        calm.for_each(|stretch| all.add(&stretch.steps).expect("the same bounds"));
        (all, count)
    }

    /// Share of the processors that other machines took in the worst stretch.
    fn stolen_most(&self) -> f64 {
        self.stretches.iter().filter_map(|stretch| stretch.stolen).fold(0.0, f64::max)
    }

    /// All steps together.
    fn all(&self) -> Histogram<u64> {
        let mut all = histogram();
        for histogram in self.steps.values() {
            all.add(histogram).expect("the same bounds");
        }
        all
    }
}

fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, 120_000_000, 3).expect("good bounds")
}

fn ms(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    histogram.value_at_quantile(quantile) as f64 / 1e3
}

/// A whole soak.
#[derive(Debug)]
pub(super) struct Report {
    pub(super) seed: u64,
    pub(super) lasts: Duration,
    /// One call after another.
    pub(super) unloaded: Seen,
    /// Steps a second when as many as the node takes are under way.
    pub(super) capacity: f64,
    /// Twice that, and everything else.
    pub(super) overload: Seen,
}

impl Report {
    /// Largest resident memory in the second half over that in the first.
    fn memory_growth(&self) -> Option<f64> {
        let memory = &self.overload.memory_mib;
        let largest = |part: &[f64]| part.iter().copied().reduce(f64::max);
        let (first, second) = memory.split_at(memory.len() / 2);
        Some(largest(second)? / largest(first)?)
    }

    fn p99_ratio(&self) -> f64 {
        ms(&self.overload.all(), 0.99) / ms(&self.unloaded.all(), 0.99)
    }

    /// The same in calm stretches, if there were any.
    fn p99_ratio_calm(&self) -> Option<f64> {
        let ((quiet, _), (loaded, _)) = (self.unloaded.calm(), self.overload.calm());
        let known = !quiet.is_empty() && !loaded.is_empty();
        known.then(|| ms(&loaded, 0.99) / ms(&quiet, 0.99))
    }

    /// For people.
    pub(super) fn table(&self) -> String {
        let mut text = String::new();
        let mut line = |cells: [String; 6]| {
            let [name, rest @ ..] = cells;
            let rest = rest.map(|cell| format!("{cell:>12}")).concat();
            writeln!(text, "{name:<24}{rest}").expect("a String takes everything");
        };
        line(
            ["steps, ms", "p50 quiet", "p99 quiet", "p50 loaded", "p99 loaded", "p99 ratio"]
                .map(str::to_owned),
        );
        let mut row = |name: &str, quiet: &Histogram<u64>, loaded: &Histogram<u64>| {
            let cell = |value: f64| format!("{value:.3}");
            line([
                name.to_owned(),
                cell(ms(quiet, 0.5)),
                cell(ms(quiet, 0.99)),
                cell(ms(loaded, 0.5)),
                cell(ms(loaded, 0.99)),
                format!("{:.2}", ms(loaded, 0.99) / ms(quiet, 0.99)),
            ]);
        };
        let none = histogram();
        for (method, quiet) in &self.unloaded.steps {
            row(method, quiet, self.overload.steps.get(method).unwrap_or(&none));
        }
        row("all", &self.unloaded.all(), &self.overload.all());
        let seen = &self.overload;
        let ((calm_quiet, _), (calm_loaded, calm)) = (self.unloaded.calm(), seen.calm());
        row("all, in calm stretches", &calm_quiet, &calm_loaded);
        writeln!(
            text,
            "calm: {calm} of {} stretches of {} s, in which other machines took less than {:.1} % \
             of the processors; {:.0} % in the worst",
            seen.stretches.len(),
            STRETCH.as_secs(),
            100.0 * CALM,
            100.0 * seen.stolen_most(),
        )
        .expect("a String takes everything");
        let memory: Vec<_> = seen.memory_mib.iter().map(|mib| format!("{mib:.0}")).collect();
        write!(
            text,
            "capacity {:.0} steps/s; {} steps offered in {:.0} s at twice that: {} answered, of \
             all calls {} refused ({} without a time to return), failed {:?}\n\
             others: {:?}\nwrong answers: {}\nmemory of the node, MiB: {}",
            self.capacity,
            seen.offered,
            self.lasts.as_secs_f64(),
            seen.admitted,
            seen.refused,
            seen.refused_without_a_time,
            seen.failed,
            seen.others,
            seen.wrong.len(),
            memory.join(" "),
        )
        .expect("a String takes everything");
        text
    }

    /// For machines.
    pub(super) fn json(&self) -> Value {
        let steps = |seen: &Seen| -> Value {
            let all = [("all", seen.all()), ("calm", seen.calm().0)];
            let each = seen.steps.iter().map(|(method, histogram)| (*method, histogram.clone()));
            let rows = each.chain(all).map(|(name, histogram)| {
                let figures = json!({
                    "count": histogram.len(),
                    "p50_ms": ms(&histogram, 0.5),
                    "p99_ms": ms(&histogram, 0.99),
                    "max_ms": ms(&histogram, 1.0),
                });
                (name.to_owned(), figures)
            });
            Value::Object(rows.collect())
        };
        json!({
            "seed": self.seed,
            "seconds": self.lasts.as_secs_f64(),
            "capacity_steps_per_s": self.capacity,
            "offered_steps": self.overload.offered,
            "unloaded": steps(&self.unloaded),
            "loaded": steps(&self.overload),
            "p99_ratio": self.p99_ratio(),
            "p99_ratio_calm": self.p99_ratio_calm(),
            "stretches": self.overload.stretches.len(),
            "stretches_calm": self.overload.calm().1,
            "stolen_most": self.overload.stolen_most(),
            "refused": self.overload.refused,
            "refused_without_a_time": self.overload.refused_without_a_time,
            "failed": self.overload.failed,
            "others": self.overload.others,
            "wrong": self.overload.wrong,
            "memory_mib": self.overload.memory_mib,
            "memory_growth": self.memory_growth(),
        })
    }
}
