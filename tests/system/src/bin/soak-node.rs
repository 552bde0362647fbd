//! The node of the soak, in a process of its own: keeps what it makes in the directory that is its
//! argument, says where it listens, and stops when its standard input ends.

use std::io::{Read as _, Write as _};

use vbar_server::{AccessOptions, Config, Node, StoreLocation};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory = std::env::args_os().nth(1).ok_or("the directory of its store is missing")?;
    let store = StoreLocation::Directory(directory.into());
    // All callers of the soak have one address, and are as many as they are.
    let access = AccessOptions {
        caller_rate_max_per_s: 100_000.0,
        caller_burst_max: 100_000,
        caller_calls_max: 100_000,
        caller_connections_max: 100_000,
        ..AccessOptions::default()
    };
    let config = Config { store, store_sync: false, access, ..Config::default() };
    let node = Node::start(config).await?;
    writeln!(std::io::stdout(), "listening on http://{}", node.local_address())?;
    tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new())).await??;
    node.shutdown().await;
    Ok(())
}
