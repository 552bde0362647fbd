//! The whole house: its rules, real nodes, and what the README shows.

mod access;
mod faults;
#[path = "../../../../server/tests/server/missions.rs"]
mod missions;
mod nodes;
mod readme;
#[path = "../../../../server/tests/server/seeds.rs"]
mod seeds;
mod soak;
mod tidy;
