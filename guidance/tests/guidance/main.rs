//! Golden cases, laws and closed loops of the mathematics, through its public interface.

#![allow(clippy::print_stdout, reason = "golden tests print what they checked")]

mod abort_safe_loop;
mod abort_safety;
mod golden;
mod golden_abort_safe;
mod laws;
mod quadratic;
mod two_body_truth;
