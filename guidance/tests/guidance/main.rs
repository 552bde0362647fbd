//! Golden cases, laws and closed loops of the mathematics, through its public interface.

#![allow(clippy::print_stdout, reason = "golden tests print what they checked")]

mod abort_safe_loop;
mod abort_safety;
mod abort_search;
mod chance_constraints;
mod disturbance_feedback_golden;
mod disturbance_feedback_laws;
mod double_integrator;
mod golden;
mod golden_abort_safe;
mod golden_offline_sampling;
mod growth;
mod hill_docking;
mod laws;
mod offline_sampling;
mod offline_sampling_baselines;
mod orbital_motion;
mod quadratic;
mod redundancy;
mod scenario;
mod shards;
mod sizes;
mod two_body_truth;
mod uncertainty;
