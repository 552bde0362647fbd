//! Who may ask: certificates, tokens, roles, limits, over real sockets.

#[path = "access/audit.rs"]
mod audit;
#[path = "access/authority.rs"]
mod authority;
#[path = "access/callers.rs"]
mod callers;
#[path = "access/encryption.rs"]
mod encryption;
#[path = "access/limits.rs"]
mod limits;
#[path = "access/tokens.rs"]
mod tokens;
