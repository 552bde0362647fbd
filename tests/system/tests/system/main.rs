//! The whole house: its rules, real nodes, and what the README shows.

mod nodes;
mod readme;
mod tidy;
