//! `vbar replay`: what a node recorded, asked again.

mod compare;
mod player;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use clap::Args;
use vbar_client::{Client, Options};
use vbar_server::{
    AccessOptions, BUILD, Config, Node, Settings, StoreLocation,
    recording::{Exchange, Recording, Session, entry::What},
};

use crate::{
    failure::Failure,
    json,
    session::{NodeArguments, Session as Connection},
};
use player::{Judgement, Player};

/// Answers must have the same bytes, but for moments and rates. Without --server the command starts
/// a node of its own with the limits that were in force; what was precomputed is made again. Give
/// the older file first if there are two.
#[derive(Debug, Args)]
pub(crate) struct ReplayArguments {
    /// Files that nodes recorded, in the order of time
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    /// A copy of the directory of that node's store, for what was made before the recording began
    #[arg(long, value_name = "DIRECTORY", conflicts_with = "server")]
    data_dir: Option<PathBuf>,
    /// How many of the answers that differ are shown
    #[arg(long, value_name = "N", default_value_t = 3)]
    differences: usize,
    #[command(flatten)]
    node: NodeArguments,
}

/// What came of it.
#[derive(Debug, Default)]
struct Tally {
    same: u64,
    different: u64,
    skipped: BTreeMap<&'static str, u64>,
    sessions: u64,
    lost: u64,
    shown: Vec<String>,
}

pub(crate) async fn replay(arguments: ReplayArguments) -> Result<(), Failure> {
    let (connection, build) = open(&arguments).await?;
    let mut player = Player::new(connection.client.clone());
    let mut tally = Tally::default();
    let mut outcome = Ok(());
    for log in &arguments.logs {
        outcome = play(log, &mut player, &build, &mut tally, arguments.differences).await;
        if outcome.is_err() {
            break;
        }
    }
    drop(player);
    connection.close().await;
    json::print(&tally.text())?;
    outcome?;
    match tally.different {
        0 => Ok(()),
        count => Err(Failure::different(format!("{count} answers differ"))),
    }
}

/// A node to ask, and the identity of its build.
async fn open(arguments: &ReplayArguments) -> Result<(Connection, String), Failure> {
    if arguments.node.is_elsewhere() {
        let connection = Connection::open(&arguments.node).await?;
        let info = connection.client.server_info().await?;
        return Ok((connection, info.build.unwrap_or_default().sha256));
    }
    let settings = first_session(arguments)?.settings;
    let settings = Settings::from_toml(&settings)
        .map_err(|fault| Failure::data(format!("the recorded settings: {fault}")))?;
    let unlimited = AccessOptions {
        caller_rate_max_per_s: 1e9,
        caller_burst_max: 1_000_000,
        ..AccessOptions::default()
    };
    let mut config = Config { access: unlimited, ..Config::default() };
    if let Some(directory) = &arguments.data_dir {
        config.store = StoreLocation::Directory(directory.clone());
    }
    let config = settings.apply(config).map_err(|fault| Failure::data(fault.to_string()))?;
    let size = config.request_bytes_max.max(Options::default().message_bytes_max);
    let node = Node::start(config)
        .await
        .map_err(|fault| Failure::unavailable(format!("no node of our own: {fault}")))?;
    let url = format!("http://{}", node.local_address());
    let options = Options { message_bytes_max: size, ..Options::default() };
    let client = Client::connect(&url, options).await?;
    Ok((Connection::with(client, node), BUILD.sha256.to_owned()))
}

/// Who wrote the first of the files.
fn first_session(arguments: &ReplayArguments) -> Result<Session, Failure> {
    let Some(path) = arguments.logs.first() else { return Ok(Session::default()) };
    let named = |fault: String| Failure::data(format!("{}: {fault}", path.display()));
    let mut recording = Recording::open(path).map_err(|fault| named(fault.to_string()))?;
    match recording.next() {
        Some(Ok(entry)) => match entry.what {
            Some(What::Session(session)) => Ok(session),
            _ => Err(named("it does not say who wrote it".to_owned())),
        },
        Some(Err(fault)) => Err(named(fault.to_string())),
        None => Ok(Session::default()),
    }
}

/// Asks everything in a file again.
async fn play(
    path: &Path,
    player: &mut Player,
    build: &str,
    tally: &mut Tally,
    differences: usize,
) -> Result<(), Failure> {
    let named = |fault: String| Failure::data(format!("{}: {fault}", path.display()));
    let mut recording = Recording::open(path).map_err(|fault| named(fault.to_string()))?;
    for entry in recording.by_ref() {
        let entry = entry.map_err(|fault| named(fault.to_string()))?;
        match entry.what {
            Some(What::Session(session)) => {
                tally.sessions += u64::from(player.begin(session.id));
                if session.build_sha256 != build {
                    let version = &session.build_version;
                    eprintln!("recorded by another build of vbar ({version}): answers may differ");
                }
            }
            Some(What::Exchange(exchange)) => {
                let judgement = player.ask(&exchange).await?;
                tally.take(&exchange, judgement, differences);
            }
            Some(What::Lost(lost)) => tally.lost += lost.count,
            None => return Err(named("an entry of a kind that is not known".to_owned())),
        }
    }
    if let Some(bytes) = recording.torn() {
        let path = path.display();
        eprintln!("{path}: the last {bytes} bytes are a record that was cut off; left out");
    }
    Ok(())
}

impl Tally {
    fn take(&mut self, exchange: &Exchange, judgement: Judgement, differences: usize) {
        match judgement {
            Judgement::Same => self.same += 1,
            Judgement::Skipped(why) => *self.skipped.entry(why).or_default() += 1,
            Judgement::Different(lines) => {
                self.different += 1;
                if self.shown.len() < differences {
                    let Exchange { call, request_id, closed_loop, index, .. } = exchange;
                    let place = closed_loop.map(|_| format!(", message {index} of its loop"));
                    let place = place.unwrap_or_default();
                    let lines = lines.join("\n    ");
                    self.shown.push(format!("  {call} {request_id}{place}:\n    {lines}"));
                }
            }
        }
    }

    fn text(&self) -> String {
        let Self { same, different, skipped, sessions, lost, shown } = self;
        let total: u64 = skipped.values().sum();
        let mut lines = vec![format!(
            "{sessions} runs of a node: {same} answers are the same, {different} differ, {total} \
             were not compared"
        )];
        lines.extend(skipped.iter().map(|(why, count)| format!("  not compared: {count} {why}")));
        if *lost > 0 {
            lines.push(format!("  {lost} exchanges are missing in the recording"));
        }
        lines.extend(shown.iter().cloned());
        lines.join("\n")
    }
}
