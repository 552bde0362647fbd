//! Which mission, and on which node: what every command that reads a mission file asks.

use std::{path::PathBuf, str::FromStr};

use clap::Args;
use vbar_client::v1::Problem;
use vbar_simulator::{Mission, MissionFile, SamplingMission, SamplingSchemeChoice, SchemeChoice};

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
    /// tube-optimal-control, nominal; or offline-sampling, linear-quadratic, tube-robust; to
    /// simulate also all that the mission compares
    #[arg(long, value_name = "SCHEME")]
    scheme: Option<String>,
}

impl MissionArguments {
    /// The mission as its file says.
    pub(crate) fn load(&self) -> Result<MissionFile, Failure> {
        MissionFile::load(&self.mission).map_err(|fault| Failure::data(fault.to_string()))
    }

    /// The controller that was asked for, by the names that the mission's method has.
    pub(crate) fn scheme<T: FromStr<Err = String>>(&self) -> Result<Option<T>, Failure> {
        let parsed = self.scheme.as_deref().map(str::parse).transpose();
        parsed.map_err(|fault| Failure::usage(format!("--scheme: {fault}")))
    }

    /// The mission with the one controller that was asked for.
    pub(crate) fn under_one_scheme(&self, mission: Mission) -> Result<Mission, Failure> {
        match self.scheme()? {
            None => Ok(mission),
            Some(SchemeChoice::All) => Err(one_is_needed()),
            Some(SchemeChoice::One(scheme)) => Ok(mission.with_scheme(scheme)),
        }
    }

    /// The mission's problem for the one controller that was asked for.
    pub(crate) fn sampling_problem(&self, mission: &SamplingMission) -> Result<Problem, Failure> {
        match self.scheme()? {
            None => Ok(mission.problem.clone()),
            Some(SamplingSchemeChoice::All) => Err(one_is_needed()),
            Some(SamplingSchemeChoice::One(scheme)) => {
                mission.problem_under(scheme).map_err(|fault| Failure::data(fault.to_string()))
            }
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

fn one_is_needed() -> Failure {
    Failure::usage("--scheme: name one")
}
