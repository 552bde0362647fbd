//! Flights over real sockets: a node on a free port, the client, the simulator.
//!
//! Few runs each, so that the whole stays within seconds; the full campaigns are one command away
//! (`vbar simulate`).

mod aborts;
mod closed_loops;
mod plans;
mod sampling;

use vbar_client::Client;
use vbar_server::{Config, Node};

/// A node of one's own and a client of it.
async fn node() -> (Node, Client) {
    node_with(Config::default()).await
}

/// The same with other settings.
async fn node_with(config: Config) -> (Node, Client) {
    let node = Node::start(config).await.expect("a node");
    let url = format!("http://{}", node.local_address());
    let client = Client::connect(&url, vbar_client::Options::default()).await.expect("a client");
    (node, client)
}

/// The text of a mission file.
fn mission_text(name: &str) -> String {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
    std::fs::read_to_string(folder.join(name)).expect(name)
}
