//! Which processors the node has and which the load.

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

fn unshared(share: Share) -> String {
    format!("{share:?} shares all processors: there is no second one")
}
