//! What each call needs.

use super::Role;

/// What a caller needs for a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Right {
    /// Nothing: probes ask before anything is known of anyone.
    Open,
    /// To be known.
    Known,
    /// A role.
    Role(Role),
}

/// Every RPC of the contract and everything else that is served, by name.
const RIGHTS: [(&str, Right); 24] = [
    ("Step", Right::Role(Role::Step)),
    ("StepStream", Right::Role(Role::Step)),
    ("SafetyReport", Right::Role(Role::Step)),
    ("ComputePlan", Right::Role(Role::Plan)),
    ("UploadPlan", Right::Role(Role::Plan)),
    ("GetPlan", Right::Role(Role::Plan)),
    ("ListPlans", Right::Role(Role::Plan)),
    ("ExportPlan", Right::Role(Role::Plan)),
    ("Precompute", Right::Role(Role::Precompute)),
    ("GetArtifact", Right::Role(Role::Precompute)),
    ("ListArtifacts", Right::Role(Role::Precompute)),
    ("DownloadArtifact", Right::Role(Role::Precompute)),
    ("GetOperation", Right::Role(Role::Precompute)),
    ("ListOperations", Right::Role(Role::Precompute)),
    ("WaitOperation", Right::Role(Role::Precompute)),
    // The same problem is the same operation: it may be others' too.
    ("CancelOperation", Right::Role(Role::Precompute)),
    ("DeleteOperation", Right::Role(Role::Admin)),
    ("GetServerInfo", Right::Known),
    ("Reflection", Right::Known),
    ("openapi", Right::Known),
    ("metrics", Right::Known),
    ("unknown", Right::Known),
    ("Health", Right::Open),
    ("probe", Right::Open),
];

/// What the call of that name needs; one that is not in the table is nobody's but the
/// administrator's.
pub(crate) fn right(call: &str) -> Right {
    let known = RIGHTS.iter().find(|(name, _)| *name == call);
    known.map_or(Right::Role(Role::Admin), |(_, right)| *right)
}

/// Names of all calls in the table.
#[cfg(test)]
pub(crate) fn named() -> impl Iterator<Item = &'static str> {
    RIGHTS.iter().map(|(name, _)| *name)
}
