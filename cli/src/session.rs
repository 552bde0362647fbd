//! A node to talk to: a running one, or one of our own for as long as the command runs.

use clap::Args;
use vbar_client::{Client, Options};
use vbar_server::{Config, Node};

use crate::failure::Failure;

/// Which node answers.
#[derive(Debug, Args)]
pub(crate) struct NodeArguments {
    /// URL of a running node, such as http://127.0.0.1:7440. Without it the command starts a node
    /// of its own on a free port and talks to that, over the network all the same
    #[arg(long, value_name = "URL", env = "VBAR_SERVER")]
    server: Option<String>,
}

/// A connection, and the node behind it if it is ours.
pub(crate) struct Session {
    pub(crate) client: Client,
    own: Option<Node>,
}

impl Session {
    pub(crate) async fn open(arguments: &NodeArguments) -> Result<Self, Failure> {
        if let Some(url) = &arguments.server {
            let client = Client::connect(url, Options::default()).await?;
            return Ok(Self { client, own: None });
        }
        let node = Node::start(Config::default())
            .await
            .map_err(|fault| Failure::unavailable(format!("no node of our own: {fault}")))?;
        let url = format!("http://{}", node.local_address());
        let client = Client::connect(&url, Options::default()).await?;
        Ok(Self { client, own: Some(node) })
    }

    pub(crate) async fn close(self) {
        drop(self.client);
        if let Some(node) = self.own {
            node.shutdown().await;
        }
    }
}
