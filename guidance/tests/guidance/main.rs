//! Golden cases, laws and closed loops of the mathematics, through its public interface.

mod golden;
