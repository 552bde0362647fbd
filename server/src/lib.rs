//! The vbar server: one port for gRPC and JSON over HTTP, in front of `vbar_guidance`.
//!
//! ```text
//! transport  →  wire, service
//! service    →  wire, store, compute, guidance
//! wire       →  proto, guidance
//! store      →  bytes and ids only
//! access     →  nobody of these: who asks, and what they may
//! recording  →  nobody of these: what was asked and answered, to be asked again
//! ```
//!
//! A library; the binary is `vbar serve`. [`Node::start`] takes a [`Config`] and answers calls
//! until [`Node::shutdown`].

mod access;
mod compute;
mod config;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
#[cfg(any(test, feature = "fuzzing"))]
#[path = "../tests/server/missions.rs"]
#[allow(dead_code, reason = "the tests over sockets share this file and need more of it")]
mod missions;
mod node;
pub mod offline;
pub mod recording;
#[cfg(test)]
#[path = "../tests/server/seeds.rs"]
mod seeds;
mod service;
mod store;
mod telemetry;
mod transport;
mod wire;

pub use access::{AccessOptions, NewToken};
pub use config::{
    Config, ConfigFault, ListedSetting, NatsLocation, Settings, SettingsError, Sources,
    StoreLocation,
};
pub use node::{Node, StartError};
pub use wire::{BUILD, Build, Limits};
