//! vbar client.
