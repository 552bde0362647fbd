//! Plans with disturbance feedback: `vbar plan` and `vbar simulate` of their missions,
//! `vbar verify`, `vbar upload`.

use std::{
    fs::{self, File},
    io::Read as _,
    path::{Path, PathBuf},
};

use clap::{Args, ValueEnum};
use vbar_client::{
    Client,
    v1::{
        self, ArrivalMetric, ComputePlanRequest, ExportPlanRequest, PlanDocument, PlanFormat,
        UploadPlanRequest, compute_plan_response::Outcome, upload_plan_request::Content,
    },
};
use vbar_server::{
    Limits,
    offline::{Refusal, verify_plan},
};
use vbar_simulator::{
    PlanAnswer, PlanChanges, PlanMission, PlanRow, compute_table, metric_named, plan_rows_json,
    plan_rows_text, plan_text,
};

use crate::{
    failure::Failure,
    json,
    session::{NodeArguments, Session},
    simulate::{Format, failure},
};

/// Largest plan that is read.
const PLAN_BYTES_MAX: u64 = 64 << 20;

/// What a mission's plan is asked for instead of the file's own numbers.
#[derive(Debug, Args)]
#[command(next_help_heading = "Missions with disturbance-feedback plans (such as prisma.json)")]
pub(crate) struct ChangeArguments {
    /// What shall be small about the arrival set, instead of the mission's own choice: POSITION (in
    /// metres), SCALED_6 (the paper's scaled position and velocity) or PHYSICAL_6 (metres and
    /// metres per second)
    #[arg(long, value_name = "METRIC", value_parser = metric)]
    metric: Option<ArrivalMetric>,
    /// Time from the first to the last instant, instead of the mission's own
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Largest burn along each axis, instead of the mission's own
    #[arg(long, value_name = "M_S", allow_negative_numbers = true)]
    delta_v_max: Option<f64>,
    /// Number of equally spaced instants, with a burn at all but the last
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    instants: Option<i32>,
}

/// Further options of `vbar plan` for these missions.
#[derive(Debug, Args)]
pub(crate) struct PlanOptions {
    #[command(flatten)]
    changes: ChangeArguments,
    /// Plan a named variant of the mission, such as a column of the paper's table
    #[arg(long, value_name = "NAME", conflicts_with = "table")]
    variant: Option<String>,
    /// Plan every variant of the mission's table and print them side by side, with the paper's
    /// figures
    #[arg(long, conflicts_with_all = ["duration", "delta_v_max", "instants", "export"])]
    table: bool,
    /// Also write the plan to a file: as a CCSDS message with its burns (ocm) or with a covariance
    /// at every instant (oem), as a table (csv), in the compact form for uplink (binary), or as
    /// JSON for `vbar verify` and `vbar upload` (document)
    #[arg(long, value_name = "FORMAT", requires = "out")]
    export: Option<Export>,
    /// File for --export
    #[arg(long, value_name = "FILE", requires = "export")]
    out: Option<PathBuf>,
    /// How to print the answer [default: table; json for missions of other methods]
    #[arg(long, value_name = "FORMAT")]
    format: Option<Format>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Export {
    /// CCSDS orbit comprehensive message
    Ocm,
    /// CCSDS orbit ephemeris message
    Oem,
    /// One line an instant
    Csv,
    /// Compact, with a checksum
    Binary,
    /// Mission and plan as JSON
    Document,
}

/// Recomputes everything a plan claims from its mission, its burns and its gains, without a node
/// and without a solver. Exit code 65 if a claim does not hold.
#[derive(Debug, Args)]
pub(crate) struct VerifyArguments {
    /// File with the plan: a PlanDocument as JSON or the compact binary form, as
    /// `vbar plan --export document` and `--export binary` write them
    #[arg(value_name = "PLAN")]
    plan: PathBuf,
    /// How to print the proof
    #[arg(long, value_name = "FORMAT", default_value = "table")]
    format: Format,
}

/// Give a running node with --server: what a node of our own keeps is gone when the command ends.
#[derive(Debug, Args)]
pub(crate) struct UploadArguments {
    /// File with the plan: a PlanDocument as JSON or the compact binary form
    #[arg(value_name = "PLAN")]
    plan: PathBuf,
    #[command(flatten)]
    node: NodeArguments,
    /// Only have it checked
    #[arg(long)]
    validate_only: bool,
}

impl ChangeArguments {
    /// The first option that was given, by its name.
    pub(crate) fn given(&self) -> Option<&'static str> {
        let options = [
            ("--metric", self.metric.is_some()),
            ("--duration", self.duration.is_some()),
            ("--delta-v-max", self.delta_v_max.is_some()),
            ("--instants", self.instants.is_some()),
        ];
        options.into_iter().find_map(|(name, given)| given.then_some(name))
    }

    pub(crate) fn changes(&self) -> PlanChanges {
        PlanChanges {
            duration_s: self.duration,
            instants: self.instants,
            delta_v_max_m_s: self.delta_v_max,
            metric: self.metric,
        }
    }
}

impl PlanOptions {
    /// The first option that only these missions have, by its name.
    pub(crate) fn given(&self) -> Option<&'static str> {
        let options = [
            ("--variant", self.variant.is_some()),
            ("--table", self.table),
            ("--export", self.export.is_some()),
            ("--format table", matches!(self.format, Some(Format::Table))),
        ];
        let own = options.into_iter().find_map(|(name, given)| given.then_some(name));
        own.or(self.changes.given())
    }
}

/// Computes a mission's plan, or every plan of its table, and prints it.
pub(crate) async fn plan(
    mission: &PlanMission,
    node: &NodeArguments,
    options: &PlanOptions,
) -> Result<(), Failure> {
    let format = options.format.unwrap_or(Format::Table);
    if options.table {
        let session = Session::open(node).await?;
        let rows = compute_table(&session.client, mission, options.changes.metric).await;
        session.close().await;
        let rows = rows.map_err(failure)?;
        return match format {
            Format::Table => json::print(plan_rows_text(&rows).trim_end()),
            Format::Json => json::print(&format!("{:#}", plan_rows_json(&rows))),
        };
    }
    let mission = match &options.variant {
        None => mission.clone(),
        Some(name) => {
            mission.with_variant(name).map_err(|fault| Failure::usage(fault.to_string()))?
        }
    };
    let mission = mission
        .with(&options.changes.changes())
        .map_err(|fault| Failure::usage(fault.to_string()))?;
    let session = Session::open(node).await?;
    let answered = ask(&session.client, &mission, options.export).await;
    session.close().await;
    let (response, document) = answered?;
    if let (Some(path), Some(document)) = (&options.out, document) {
        write(path, &document)?;
    }
    match format {
        Format::Json => json::print(&json::render(&response)?),
        Format::Table => {
            let answer = PlanAnswer::read(response).map_err(Failure::ours)?;
            json::print(plan_text(&PlanRow { mission, answer }).trim_end())
        }
    }
}

/// The plan, and the document that was asked for if there is a plan.
async fn ask(
    client: &Client,
    mission: &PlanMission,
    export: Option<Export>,
) -> Result<(v1::ComputePlanResponse, Option<Vec<u8>>), Failure> {
    let problem = mission.problem.clone();
    let request =
        ComputePlanRequest { problem: Some(problem.clone()), ..ComputePlanRequest::default() };
    let response = client.plan(request).await?;
    let (Some(export), Some(Outcome::Plan(plan))) = (export, &response.outcome) else {
        return Ok((response, None));
    };
    let format = match export {
        Export::Document => {
            let document = PlanDocument { problem: Some(problem), plan: Some(plan.clone()) };
            let text = json::render(&document)?;
            return Ok((response, Some(text.into_bytes())));
        }
        Export::Ocm => PlanFormat::CcsdsOcm,
        Export::Oem => PlanFormat::CcsdsOem,
        Export::Csv => PlanFormat::Csv,
        Export::Binary => PlanFormat::Binary,
    };
    let request = ExportPlanRequest {
        plan_id: response.plan_id.clone(),
        format: format.into(),
        ..ExportPlanRequest::default()
    };
    let document = client.export_plan(request).await?;
    Ok((response, Some(document.content.to_vec())))
}

/// Checks a plan without a node.
pub(crate) fn verify(arguments: &VerifyArguments) -> Result<(), Failure> {
    let bytes = read(&arguments.plan)?;
    let verified = verify_plan(&bytes, &Limits::default()).map_err(|why| refused(&why))?;
    let proof = &verified.certificate;
    match arguments.format {
        Format::Json => json::print(&json::render(proof)?),
        Format::Table => json::print(&format!(
            "every claim of the plan holds\n  \
             plan {}\n  trace {}, lower bound on every plan's objective {}, relative gap {:.1e}\n  \
             end of the nominal trajectory off by {:.1e} of the mission's size; least margin of a \
             burn {:.5} m/s",
            verified.plan_id,
            proof.trace,
            proof.objective_lower_bound,
            proof.relative_gap,
            proof.dynamics_residual_nd,
            proof.saturation_margin_m_s,
        )),
    }
}

fn refused(why: &Refusal) -> Failure {
    let mut message = why.message.clone();
    for fault in &why.violations {
        let line = format!("\n  {}: expected {}, got {}", fault.path, fault.expected, fault.got);
        message.push_str(&line);
    }
    Failure::data(message)
}

/// Brings a plan to a node.
pub(crate) async fn upload(arguments: UploadArguments) -> Result<(), Failure> {
    let bytes = read(&arguments.plan)?;
    let content = if bytes.trim_ascii_start().starts_with(b"{") {
        let text = String::from_utf8(bytes)
            .map_err(|fault| Failure::data(format!("{}: {fault}", arguments.plan.display())))?;
        Content::Document(json::parse::<PlanDocument>(&text)?)
    } else {
        Content::Binary(bytes.into())
    };
    let request =
        UploadPlanRequest { content: Some(content), validate_only: arguments.validate_only };
    let session = Session::open(&arguments.node).await?;
    let answer = session.client.upload_plan(request).await;
    session.close().await;
    json::print(&json::render(&answer?)?)
}

fn metric(text: &str) -> Result<ArrivalMetric, String> {
    metric_named(text).ok_or_else(|| "a metric is POSITION, SCALED_6 or PHYSICAL_6".to_owned())
}

fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    let named = |fault: std::io::Error| Failure::data(format!("{}: {fault}", path.display()));
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(named)?;
    file.take(PLAN_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(named)?;
    if u64::try_from(bytes.len()).unwrap_or(u64::MAX) > PLAN_BYTES_MAX {
        let limit = format!("{}: longer than {PLAN_BYTES_MAX} bytes", path.display());
        return Err(Failure::data(limit));
    }
    Ok(bytes)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    fs::write(path, bytes)
        .map_err(|fault| Failure::cannot_write(format!("{}: {fault}", path.display())))
}
