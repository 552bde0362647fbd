//! vbar server.
