//! Which processors the node has and which the load, and how much of them other machines took.

/// One of the two that are measured together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Share {
    /// All but the last.
    Node,
    /// The last.
    Load,
}

/// Keeps this thread, and what it starts from now on, to its share; says so, or why not.
#[cfg(target_os = "linux")]
pub(super) fn keep_to(share: Share) -> String {
    use std::sync::OnceLock;

    use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

    /// What there was before anybody kept to a share of it.
    static ALL: OnceLock<Vec<usize>> = OnceLock::new();
    let all = ALL.get_or_init(|| match sched_getaffinity(None) {
        Ok(set) => (0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect(),
        Err(_) => Vec::new(),
    });
    let [of_node @ .., of_load] = all.as_slice() else { return unshared(share) };
    if of_node.is_empty() {
        return unshared(share);
    }
    let mine = if share == Share::Node { of_node } else { std::slice::from_ref(of_load) };
    let mut set = CpuSet::new();
    mine.iter().for_each(|cpu| set.set(*cpu));
    match sched_setaffinity(None, &set) {
        Ok(()) => format!("{share:?} has processors {mine:?}"),
        Err(fault) => format!("{share:?} shares all processors: {fault}"),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn keep_to(share: Share) -> String {
    unshared(share)
}

/// Lets this thread have the processor when no other of the load wants it.
pub(super) fn yield_to_others() {
    // Where it cannot, they are equals.
    #[cfg(target_os = "linux")]
    let _ = rustix::process::nice(5);
}

fn unshared(share: Share) -> String {
    format!("{share:?} shares all processors: there is no second one")
}

/// Time that the processors had, and how much of it other machines took: what a virtual machine
/// wanted and did not get. The unit is the system's; only shares mean something.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ticks {
    stolen: u64,
    all: u64,
}

impl Ticks {
    /// Since the machine began (Linux; elsewhere nothing is known).
    pub(super) fn now() -> Option<Self> {
        let text = std::fs::read_to_string("/proc/stat").ok()?;
        // user nice system idle iowait irq softirq steal; what follows is counted in these.
        let fields = text.lines().next()?.strip_prefix("cpu ")?.split_whitespace();
        let fields: Vec<u64> = fields.take(8).map(|f| f.parse().ok()).collect::<Option<_>>()?;
        Some(Self { stolen: *fields.get(7)?, all: fields.iter().sum() })
    }

    /// Share that was taken since `before`.
    pub(super) fn stolen_since(self, before: Self) -> f64 {
        let all = self.all.saturating_sub(before.all).max(1);
        self.stolen.saturating_sub(before.stolen) as f64 / all as f64
    }
}
