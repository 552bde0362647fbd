//! The whole house: its rules, and real nodes.

mod tidy;
