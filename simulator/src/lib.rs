//! vbar simulator.
