//! A node to talk to: a running one, or one of our own for as long as the command runs.

use std::{
    fs::File,
    io::Read as _,
    path::{Path, PathBuf},
};

use clap::Args;
use vbar_client::{Client, Credentials, Options};
use vbar_server::{Config, Node};

use crate::failure::Failure;

/// Which node answers.
#[derive(Debug, Args)]
pub(crate) struct NodeArguments {
    /// URL of a running node, such as http://127.0.0.1:7440. Without it the command starts a node
    /// of its own on a free port and talks to that, over the network all the same
    #[arg(long, value_name = "URL", env = "VBAR_SERVER")]
    server: Option<String>,
    #[command(flatten)]
    credentials: CredentialArguments,
}

/// Whom to believe, and how to say who asks.
#[derive(Debug, Args)]
pub(crate) struct CredentialArguments {
    /// Certificates of the authorities that vouch for the node, in PEM; for https://
    #[arg(long, value_name = "FILE", env = "VBAR_CLIENT_TLS_CA")]
    tls_ca: Option<PathBuf>,
    /// A certificate of one's own, in PEM, for a node that asks for one
    #[arg(long, value_name = "FILE", env = "VBAR_CLIENT_TLS_CERTIFICATE")]
    tls_certificate: Option<PathBuf>,
    /// The key of that certificate, in PEM
    #[arg(long, value_name = "FILE", env = "VBAR_CLIENT_TLS_KEY")]
    tls_key: Option<PathBuf>,
    /// File with a token, for a node that asks for one
    #[arg(long, value_name = "FILE", env = "VBAR_CLIENT_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// Send the token in clear to another machine, where something else keeps it from others
    #[arg(long, env = "VBAR_CLIENT_ALLOW_INSECURE_TOKEN")]
    allow_insecure_token: bool,
}

/// Variables of these arguments: not settings of a node.
pub(crate) const CREDENTIAL_VARIABLES: [&str; 5] = [
    "VBAR_CLIENT_TLS_CA",
    "VBAR_CLIENT_TLS_CERTIFICATE",
    "VBAR_CLIENT_TLS_KEY",
    "VBAR_CLIENT_TOKEN_FILE",
    "VBAR_CLIENT_ALLOW_INSECURE_TOKEN",
];

impl NodeArguments {
    /// The node is one that runs already.
    pub(crate) fn is_elsewhere(&self) -> bool {
        self.server.is_some()
    }
}

impl CredentialArguments {
    /// What the files say.
    pub(crate) fn read(&self) -> Result<Credentials, Failure> {
        let token = match &self.token_file {
            None => None,
            Some(path) => {
                let text = String::from_utf8(file(path)?)
                    .map_err(|_| Failure::usage(format!("{}: not a token", path.display())))?;
                Some(text.trim_end_matches(['\r', '\n']).to_owned())
            }
        };
        Ok(Credentials {
            tls_ca: self.tls_ca.as_deref().map(file).transpose()?,
            tls_certificate: self.tls_certificate.as_deref().map(file).transpose()?,
            tls_key: self.tls_key.as_deref().map(file).transpose()?,
            token,
            allow_insecure_token: self.allow_insecure_token,
        })
    }
}

fn file(path: &Path) -> Result<Vec<u8>, Failure> {
    const BYTES_MAX: u64 = 1 << 20;
    let fault = |why: String| Failure::usage(format!("{}: {why}", path.display()));
    let mut content = Vec::new();
    File::open(path)
        .and_then(|file| file.take(BYTES_MAX + 1).read_to_end(&mut content))
        .map_err(|why| fault(why.to_string()))?;
    if content.len() as u64 > BYTES_MAX {
        return Err(fault(format!("more than {BYTES_MAX} bytes")));
    }
    Ok(content)
}

/// A connection, and the node behind it if it is ours.
pub(crate) struct Session {
    pub(crate) client: Client,
    own: Option<Node>,
}

impl Session {
    pub(crate) async fn open(arguments: &NodeArguments) -> Result<Self, Failure> {
        if let Some(url) = &arguments.server {
            let credentials = arguments.credentials.read()?;
            let client =
                Client::connect(url, Options { credentials, ..Options::default() }).await?;
            return Ok(Self { client, own: None });
        }
        let node = Node::start(Config::default())
            .await
            .map_err(|fault| Failure::unavailable(format!("no node of our own: {fault}")))?;
        let url = format!("http://{}", node.local_address());
        let client = Client::connect(&url, Options::default()).await?;
        Ok(Self { client, own: Some(node) })
    }

    /// A connection to a node of our own.
    pub(crate) fn with(client: Client, own: Node) -> Self {
        Self { client, own: Some(own) }
    }

    /// Ends, and says how often the world interrupted it.
    pub(crate) async fn close(self) {
        let retries = self.client.retries();
        if retries > 0 {
            eprintln!("tried again {retries} times");
        }
        drop(self.client);
        if let Some(node) = self.own {
            node.shutdown().await;
        }
    }
}
