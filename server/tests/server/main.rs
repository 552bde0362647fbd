//! Real nodes on port 0, spoken to over real sockets.

mod grpc;
mod http;
mod limits;
mod malformed;
mod missions;
mod operations;
mod steps;
mod streams;
mod support;
