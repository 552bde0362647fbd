//! Golden cases, laws and closed loops of the mathematics, through its public interface.

#![allow(clippy::print_stdout, reason = "golden tests print what they checked")]

mod golden;
mod golden_offline_sampling;
mod growth;
mod laws;
mod offline_sampling;
mod quadratic;
mod redundancy;
mod scenario;
