//! Golden cases, laws and closed loops of the mathematics, through its public interface.

#![allow(clippy::print_stdout, reason = "golden tests print what they checked")]

mod disturbance_feedback_golden;
mod disturbance_feedback_laws;
mod golden;
mod laws;
mod orbital_motion;
