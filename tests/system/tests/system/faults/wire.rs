//! A wire between a client and a node, on which goes wrong what a seed decides.

use std::{
    io,
    net::SocketAddr,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use fastrand::Rng;
use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
    task::{JoinHandle, JoinSet},
    time::sleep,
};

/// A port that leads to a node, while it is held.
#[derive(Debug)]
pub(super) struct Wire {
    pub(super) url: String,
    /// What goes wrong on its first connections; on later ones nothing does.
    pub(super) faults: Vec<Fault>,
    task: JoinHandle<()>,
}

/// What goes wrong on a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// After so many bytes from one side, which is in the middle of a frame, it is reset.
    Reset { after: usize, from: Side },
    /// After as many nothing passes any more, and neither side is told: it is half open.
    Silence { after: usize, from: Side },
    /// Both sides are read a little at a time, and all of it comes late.
    Slow { piece: usize, pause: Duration },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Client,
    Node,
}

impl Fault {
    pub(super) fn drawn(rng: &mut Rng) -> Self {
        let from = if rng.bool() { Side::Client } else { Side::Node };
        // Greetings, heads and small messages; or whole answers.
        let after = if rng.bool() { rng.usize(..400) } else { rng.usize(..20_000) };
        match rng.u8(..5) {
            0 => Self::Silence { after, from },
            1 | 2 => Self::Slow {
                piece: rng.usize(100..2000),
                pause: Duration::from_micros(rng.u64(..2000)),
            },
            _ => Self::Reset { after, from },
        }
    }
}

impl Wire {
    /// A wire to `node`.
    pub(super) async fn start(node: SocketAddr, faults: Vec<Fault>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let mut left = faults.clone().into_iter();
        let task = tokio::spawn(async move {
            // Dropped at the end, and with it whatever is still open.
            let mut connections = JoinSet::new();
            while let Ok((client, _)) = listener.accept().await {
                let fault = left.next();
                connections.spawn(async move {
                    // A node that refuses is told from one that answers by the client itself.
                    if let Ok(node) = TcpStream::connect(node).await {
                        connect(client, node, fault).await;
                    }
                });
            }
        });
        Self { url, faults, task }
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Passes on what both say until both have ended, or the wire ends it.
async fn connect(mut client: TcpStream, mut node: TcpStream, fault: Option<Fault>) {
    let _ = (client.set_nodelay(true), node.set_nodelay(true));
    let is_silent = AtomicBool::new(false);
    let passed = {
        let (from_client, to_client) = client.split();
        let (from_node, to_node) = node.split();
        let there = Passage { side: Side::Client, fault, is_silent: &is_silent, passed: 0 };
        let back = Passage { side: Side::Node, fault, is_silent: &is_silent, passed: 0 };
        tokio::try_join!(there.pass(from_client, to_node), back.pass(from_node, to_client))
    };
    if passed.is_err() {
        let _ = (client.set_zero_linger(), node.set_zero_linger());
    }
}

/// One direction.
struct Passage<'a> {
    side: Side,
    fault: Option<Fault>,
    is_silent: &'a AtomicBool,
    passed: usize,
}

impl Passage<'_> {
    async fn pass(
        mut self,
        mut from: impl AsyncRead + Unpin,
        mut to: impl AsyncWrite + Unpin,
    ) -> io::Result<()> {
        let mut bytes = vec![0; 16 << 10];
        loop {
            let most = match self.fault {
                Some(Fault::Slow { piece, .. }) => piece,
                _ => bytes.len(),
            };
            let length = from.read(&mut bytes[..most]).await?;
            if length == 0 {
                return to.shutdown().await;
            }
            let left = self.left();
            to.write_all(&bytes[..length.min(left)]).await?;
            self.passed += length;
            match self.fault {
                Some(Fault::Reset { .. }) if length >= left => {
                    return Err(io::ErrorKind::ConnectionReset.into());
                }
                Some(Fault::Silence { .. }) if length >= left => {
                    self.is_silent.store(true, Ordering::Relaxed);
                    return std::future::pending().await;
                }
                Some(Fault::Slow { pause, .. }) => sleep(pause).await,
                _ => {}
            }
        }
    }

    /// Bytes that still pass in this direction.
    fn left(&self) -> usize {
        match self.fault {
            _ if self.is_silent.load(Ordering::Relaxed) => 0,
            Some(Fault::Reset { after, from } | Fault::Silence { after, from })
                if from == self.side =>
            {
                after.saturating_sub(self.passed)
            }
            _ => usize::MAX,
        }
    }
}
