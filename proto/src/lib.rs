//! The wire contract of vbar: generated messages, clients and servers, and nothing else.
//!
//! Generated from `proto/**/*.proto` at build time. The one addition is [`StrictCodec`], because
//! "unknown fields are refused, never dropped" is part of the contract and `prost` drops them.

mod strict;

use std::sync::LazyLock;

use prost_reflect::DescriptorPool;

pub use strict::{StrictCodec, UnknownField, find_unknown_field};

/// The serialised `FileDescriptorSet` of every file, with comments.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Descriptors of every message, for canonical JSON and for reflection.
pub static DESCRIPTORS: LazyLock<DescriptorPool> = LazyLock::new(|| {
    DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("the build script made these bytes")
});

// Generated paths follow the packages: `vbar.v1` must lie two modules deep.
mod vbar {
    pub mod v1 {
        #![allow(missing_docs, clippy::all, clippy::pedantic, unreachable_pub)]
        tonic::include_proto!("vbar.v1");
    }
}

/// The service's own messages.
pub use vbar::v1;

/// Copies of public contracts that the service speaks.
pub mod google {
    /// The error model (AIP-193).
    pub mod rpc {
        #![allow(missing_docs, clippy::all, clippy::pedantic, unreachable_pub)]
        tonic::include_proto!("google.rpc");
    }
    /// Long-running operations (AIP-151).
    pub mod longrunning {
        #![allow(missing_docs, clippy::all, clippy::pedantic, unreachable_pub)]
        tonic::include_proto!("google.longrunning");
    }
}
