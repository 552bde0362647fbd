//! Which mission, and on which node: what every command that reads a mission file asks.

use std::path::PathBuf;

use clap::Args;
use vbar_simulator::{Mission, MissionFile, SchemeChoice};

use crate::{failure::Failure, session::NodeArguments};

/// A mission file and the node that answers.
#[derive(Debug, Args)]
pub(crate) struct MissionArguments {
    /// Mission file, such as simulator/missions/envisat.json
    #[arg(value_name = "MISSION")]
    pub(crate) mission: PathBuf,
    #[command(flatten)]
    pub(crate) node: NodeArguments,
    /// Controller instead of the mission's own: adaptive-terminal, fixed-terminal,
    /// tube-optimal-control, nominal; to simulate also all that the mission compares
    #[arg(long, value_name = "SCHEME")]
    pub(crate) scheme: Option<SchemeChoice>,
}

impl MissionArguments {
    /// The mission as its file says.
    pub(crate) fn load(&self) -> Result<MissionFile, Failure> {
        MissionFile::load(&self.mission).map_err(|fault| Failure::data(fault.to_string()))
    }

    /// The mission with the one controller that was asked for.
    pub(crate) fn under_one_scheme(&self, mission: Mission) -> Result<Mission, Failure> {
        match self.scheme {
            None => Ok(mission),
            Some(SchemeChoice::All) => Err(Failure::usage("--scheme: name one")),
            Some(SchemeChoice::One(scheme)) => Ok(mission.with_scheme(scheme)),
        }
    }

    /// Names the first option that was given although it means nothing for this mission: `--scheme`
    /// or one of `others`.
    pub(crate) fn refuse(
        &self,
        others: impl IntoIterator<Item = (&'static str, bool)>,
    ) -> Result<(), Failure> {
        let scheme = ("--scheme", self.scheme.is_some());
        match std::iter::once(scheme).chain(others).find(|(_, given)| *given) {
            None => Ok(()),
            Some((name, _)) => Err(Failure::usage(format!("{name} is not for this mission"))),
        }
    }
}
