//! Real nodes on port 0, spoken to over real sockets.

mod abort_safe;
mod aftermath;
mod artifacts;
mod attacks;
mod cluster;
mod grpc;
mod http;
mod http2;
mod limits;
mod malformed;
mod malformed_abort_safe;
mod malformed_offline_sampling;
mod malformed_plans;
mod metrics;
mod missions;
mod offline_sampling;
mod operations;
mod plans;
mod safety_reports;
mod steps;
mod streams;
mod support;
