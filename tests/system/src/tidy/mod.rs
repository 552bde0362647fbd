//! The rules of `ARCHITECTURE.md`, checked by reading the source.
//!
//! Every rule is a function from a [`Tree`] to the list of its faults, each with a place and what
//! would be right. A tree is plain text, so the rules themselves are tested on small made-up ones.

mod architecture;
mod citations;
mod methods;
mod paths;
mod purity;
mod safety;
mod tree;
mod words;

pub use architecture::{crate_arrows, guidance_floors, server_arrows, top_level};
pub use citations::citations;
pub use methods::methods;
pub use purity::{fixed_order_sums, purity};
pub use safety::unsafe_forbidden;
pub use tree::Tree;
pub use words::words;

/// A rule: its name and how it is checked.
pub type Rule = (&'static str, fn(&Tree) -> Vec<String>);

/// Every rule.
pub const RULES: [Rule; 10] = [
    ("top-level folders", top_level),
    ("arrows between crates", crate_arrows),
    ("floors of guidance", guidance_floors),
    ("arrows inside the server", server_arrows),
    ("five places of a method", methods),
    ("citations", citations),
    ("purity of guidance", purity),
    ("fixed order of sums", fixed_order_sums),
    ("no unsafe code", unsafe_forbidden),
    ("words", words),
];
