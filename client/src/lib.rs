//! The client of vbar: asks a node to plan, to decide the next step, to precompute.
//!
//! Everything a node answers is a function of what it was sent, so a call can be repeated without
//! harm and any node can go on where another stopped. The client uses this: it repeats what the
//! world interrupted (`UNAVAILABLE` and nothing else, AIP-194), within the caller's deadline.
//!
//! ```no_run
//! # async fn fly(problem: vbar_proto::v1::Problem) -> Result<(), vbar_client::Error> {
//! use vbar_client::{Client, Options};
//!
//! let client = Client::connect("http://127.0.0.1:7440", Options::default()).await?;
//! let made = client.precompute(problem).await?;
//! # Ok(())
//! # }
//! ```

mod artifacts;
mod client;
mod closed_loop;
mod credentials;
mod error;
mod operations;
mod retry;
mod verbatim;

pub use client::{Client, Options};
pub use closed_loop::ClosedLoop;
pub use credentials::Credentials;
pub use error::{Error, FieldViolation};
pub use operations::progress;
pub use tonic::Code;
/// The messages this client sends and receives.
pub use vbar_proto::{google::longrunning, v1};
pub use verbatim::VerbatimLoop;
