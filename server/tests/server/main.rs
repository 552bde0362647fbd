//! Real nodes on port 0, spoken to over real sockets.

mod artifacts;
mod grpc;
mod http;
mod limits;
mod malformed;
mod malformed_plans;
mod missions;
mod operations;
mod plans;
mod steps;
mod streams;
mod support;
