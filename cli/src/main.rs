//! The `vbar` command.
fn main() {}
