//! The vbar server: one port for gRPC and JSON over HTTP, in front of `vbar_guidance`.
//!
//! ```text
//! transport  →  wire, service
//! service    →  wire, store, compute, guidance
//! wire       →  proto, guidance
//! store      →  bytes and ids only
//! ```
//!
//! A library; the binary is `vbar serve`. [`Node::start`] takes a [`Config`] and answers calls
//! until [`Node::shutdown`].

mod compute;
mod config;
mod node;
pub mod offline;
mod service;
mod store;
mod telemetry;
mod transport;
mod wire;

pub use config::{Config, ConfigFault, Settings, SettingsError, StoreLocation};
pub use node::{Node, StartError};
pub use wire::Limits;
