//! What fuzz targets call: bytes in, nothing out. Every function either refuses its bytes or shows
//! that what they mean survives being written and read again; anything else panics.
//!
//! Checksums are put right first where there are any, so that a fuzzer reaches what is behind them.

use std::{collections::BTreeSet, sync::LazyLock};

use prost::{Message, Name};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use vbar_guidance::{Budget, Method};
use vbar_proto::{DESCRIPTORS, find_unknown_field, google::longrunning, v1};

use crate::{
    access::{OptionFault, bearer, tls_faults, token_faults},
    config::{Config, Settings},
    missions,
    offline::verify_plan,
    recording::{Entry, Exchange, Lost, Recording, entry, file_of},
    service::{decode_record, lease_rewritten, stored_jobs},
    store::{Shelf, commit_rewritten, entry_in_file, id_rewritten},
    transport::{decode_json, encode_json, read_frames, read_head},
    wire::{
        Artifact, ArtifactCall, ArtifactId, ArtifactsCall, Candidate, ControllerState,
        DownloadCall, ExportCall, InfoCall, KeptPlanCall, Limits, OperationsCall, Parse, PlanCall,
        PlansCall, PrecomputeCall, Problem, ReportCall, State, StepCall, StreamCall, UploadCall,
        WaitCall, parse, read_ocm_burns,
    },
};

/// Every fault is named, and no more than anybody reads.
fn refused_or_valid<T: Parse>(message: &T::Message) {
    if let Err(violations) = parse::<T>(message, &Limits::default()) {
        assert!((1..=100).contains(&violations.0.len()), "{violations:?}");
    }
}

/// Calls `$do!(message, call)` for the request that `$which` picks.
macro_rules! for_request {
    ($which:expr, $run:ident, $bytes:expr) => {
        match $which % 15 {
            0 => $run::<v1::StepRequest, StepCall>($bytes),
            1 => $run::<v1::StepStreamRequest, StreamCall>($bytes),
            2 => $run::<v1::ComputePlanRequest, PlanCall>($bytes),
            3 => $run::<v1::UploadPlanRequest, UploadCall>($bytes),
            4 => $run::<v1::GetPlanRequest, KeptPlanCall>($bytes),
            5 => $run::<v1::ListPlansRequest, PlansCall>($bytes),
            6 => $run::<v1::ExportPlanRequest, ExportCall>($bytes),
            7 => $run::<v1::GetServerInfoRequest, InfoCall>($bytes),
            8 => $run::<v1::GetArtifactRequest, ArtifactCall>($bytes),
            9 => $run::<v1::ListArtifactsRequest, ArtifactsCall>($bytes),
            10 => $run::<v1::DownloadArtifactRequest, DownloadCall>($bytes),
            11 => $run::<v1::PrecomputeRequest, PrecomputeCall>($bytes),
            12 => $run::<v1::SafetyReportRequest, ReportCall>($bytes),
            13 => $run::<longrunning::WaitOperationRequest, WaitCall>($bytes),
            _ => $run::<longrunning::ListOperationsRequest, OperationsCall>($bytes),
        }
    };
}

/// A request of the wire: the first byte says which.
pub fn request_proto(bytes: &[u8]) {
    fn check<M: Message + Name + Default + PartialEq, C: Parse<Message = M>>(bytes: &[u8]) {
        let descriptor = DESCRIPTORS.get_message_by_name(&M::full_name());
        let unknown = find_unknown_field(&descriptor.expect("it is in the contract"), bytes);
        let Ok(message) = M::decode(bytes) else { return };
        let encoded = message.encode_to_vec();
        // A number that is none is not equal to itself: bytes are compared.
        let again = M::decode(&*encoded).expect("it was just written");
        assert!(again.encode_to_vec() == encoded, "another message came back");
        if unknown.is_none() {
            refused_or_valid::<C>(&message);
        }
    }
    if let Some((which, bytes)) = bytes.split_first() {
        for_request!(which, check, bytes);
    }
}

/// A request in JSON: the first byte says which.
pub fn request_json(bytes: &[u8]) {
    fn check<M: Message + Name + Default + PartialEq, C: Parse<Message = M>>(bytes: &[u8]) {
        let Ok(message) = decode_json::<M>(bytes) else { return };
        let again = decode_json::<M>(&encode_json(&message)).expect("it was just written");
        assert!(again == message, "another message came back");
        refused_or_valid::<C>(&message);
    }
    if let Some((which, bytes)) = bytes.split_first() {
        for_request!(which, check, bytes);
    }
}

/// A target's orbit in text: the first byte says whether as mean elements of two lines, as an
/// orbit mean-elements message, or a plan's burns in an orbit comprehensive message.
pub fn orbit_text(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let form = match which % 3 {
        0 => v1::target_orbit::Form::Tle(text.to_owned()),
        1 => v1::target_orbit::Form::Omm(text.to_owned()),
        _ => {
            if let Err(faults) = read_ocm_burns(text) {
                assert!(!faults.is_empty(), "refused without a reason");
            }
            return;
        }
    };
    let mut problem: v1::Problem = missions::message(missions::prisma());
    if let Some(v1::problem::Method::DisturbanceFeedback(problem)) = &mut problem.method
        && let Some(orbit) = &mut problem.orbit
    {
        orbit.form = Some(form);
    }
    if let Ok(problem) = parse::<Problem>(&problem, &Limits::default()) {
        assert!(!problem.canonical_bytes().is_empty(), "a problem has bytes");
    }
}

/// Settings: a file, a byte 0, and lines of the environment.
pub fn configuration(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let (file, environment) = text.split_once('\0').unwrap_or((text, ""));
    let pairs = environment.lines().filter_map(|line| line.split_once('='));
    let pairs = pairs.map(|(name, value)| (name.to_owned(), value.to_owned()));
    let file = Settings::from_toml(file);
    let environment = Settings::from_environment(pairs, &["VBAR_LOG"]);
    let (Ok(file), Ok(environment)) = (file, environment) else { return };
    if let Ok(config) = environment.over(file).apply(Config::default()) {
        let faults = config.faults();
        assert!(faults.iter().all(|fault| !fault.to_string().is_empty()), "a fault without words");
    }
}

/// A stored record: the first byte says of which shelf.
pub fn record(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let shelf = if which % 2 == 0 { Shelf::Artifacts } else { Shelf::Plans };
    let id = ArtifactId(Sha256::digest(bytes).into());
    if let Err(why) = decode_record(shelf, id, bytes) {
        assert!(!why.is_empty(), "refused without a reason");
    }
}

/// What is read is written, and read to the same again.
fn artifact(method: Method, bytes: &[u8]) {
    let Ok(artifact) = Artifact::from_bytes(method, bytes) else { return };
    let written = artifact.to_bytes();
    let again = Artifact::from_bytes(method, &written).expect("it was just written");
    assert!(again.to_bytes() == written, "another artifact came back");
    assert!(again.canonical_problem() == artifact.canonical_problem(), "another problem");
}

/// The bytes of an artifact of variable horizon.
pub fn artifact_variable_horizon(bytes: &[u8]) {
    artifact(Method::VariableHorizon, bytes);
}

/// The bytes of an artifact of abort safety.
pub fn artifact_abort_safe(bytes: &[u8]) {
    artifact(Method::AbortSafe, bytes);
}

/// The bytes of an artifact of offline sampling.
pub fn artifact_offline_sampling(bytes: &[u8]) {
    artifact(Method::OfflineSampling, bytes);
}

/// A plan in its compact form, without its checksum.
pub fn plan_binary(bytes: &[u8]) {
    let bytes = sealed(bytes);
    let candidate = Candidate::Binary(bytes.clone().into());
    if let Ok(plan) = candidate.verify() {
        assert!(plan.is_plan() && plan.render_document().is_some(), "a plan has a document");
        artifact(Method::DisturbanceFeedback, &bytes);
    }
}

/// A plan as a document, as somebody brings it who has no node.
pub fn plan_document(bytes: &[u8]) {
    match verify_plan(bytes, &Limits::default()) {
        Ok(plan) => assert!(plan.certificate.relative_gap.is_finite(), "a plan without a proof"),
        Err(refusal) => assert!(!refusal.message.is_empty(), "refused without a reason"),
    }
}

/// A recording: the first byte says whether the rest is the file, or what its one record holds.
///
/// What is read is written, and read to the same again.
pub fn recording(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let file = if which % 2 == 0 { bytes.to_vec() } else { file_of([bytes]) };
    let Ok(mut recording) = Recording::read(&*file) else { return };
    let entries: Vec<_> = recording.by_ref().map_while(Result::ok).collect();
    assert!(usize::try_from(recording.place()).is_ok_and(|place| place <= file.len()));
    let written = file_of(entries.iter().map(Message::encode_to_vec));
    let again: Result<Vec<_>, _> = Recording::read(&*written).expect("just begun").collect();
    assert!(again.is_ok_and(|again| again == entries), "something else came back");
}

/// The head of a request: a line with method and target, then a header a line; the credential in
/// it is read too.
pub fn request_head(bytes: &[u8]) {
    let mut lines = bytes.split(|&c| c == b'\n');
    let first = lines.next().unwrap_or_default();
    let place = first.iter().position(|&c| c == b' ').unwrap_or(first.len());
    let (method, target) = first.split_at(place);
    let mut request = http::Request::builder().method(method).uri(target.trim_ascii_start());
    for line in lines.take(64) {
        let place = line.iter().position(|&c| c == b':').unwrap_or(line.len());
        let (name, value) = line.split_at(place);
        let value = value.strip_prefix(b":").unwrap_or_default().trim_ascii();
        if let Some(token) = bearer(value) {
            assert!(!token.is_empty() && token.is_ascii(), "{token:?}");
        }
        request = request.header(name, value);
    }
    // What is no request at all never comes so far.
    if let Ok(request) = request.body(()) {
        read_head(request);
    }
}

/// The body of a gRPC request: the first byte says in pieces of how many bytes it comes.
pub fn request_frames(bytes: &[u8]) {
    let Some((&length, body)) = bytes.split_first() else { return };
    let (count, digest) = read_frames(body, usize::from(length).max(1));
    assert_eq!(read_frames(body, body.len().max(1)), (count, digest), "it matters how it is cut");
    assert!(usize::try_from(count).is_ok_and(|count| count * 5 <= body.len()), "{count} messages");
}

/// What operators write down of who may ask: the first byte says whether the rest is a file of
/// tokens, or certificates, a byte 0, a key, and perhaps a byte 0 and certificates of authorities.
///
/// No fault may hold what looks like a token, wherever in the file it stands.
pub fn credentials(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let faults: Vec<OptionFault> = if which % 2 == 0 {
        token_faults(bytes)
    } else {
        let mut files = bytes.splitn(3, |&c| c == 0);
        let mut next = || files.next().unwrap_or_default();
        let (certificate, key) = (next(), next());
        tls_faults(certificate, key, files.next())
    };
    for fault in faults {
        assert!(!fault.expected.is_empty(), "a fault without words");
        assert!(!format!("{fault:?}").contains(SECRET), "{fault:?}");
    }
}

/// Stands in the seeds wherever somebody may have written a token by mistake.
const SECRET: &str = "vbar_5ec2e7";

/// What a store keeps beside records: the first byte says what. What is read is written, and read
/// to the same again.
pub fn stored(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let rewritten = match which % 8 {
        0 => stored_jobs::job,
        1 => stored_jobs::request,
        2 => stored_jobs::errand,
        3 => stored_jobs::word,
        4 => lease_rewritten,
        5 => commit_rewritten,
        6 => |bytes: &[u8]| {
            let entry = entry_in_file(bytes)?;
            Some([&entry.revision.to_le_bytes()[..], &entry.bytes].concat().into())
        },
        _ => |bytes: &[u8]| id_rewritten(str::from_utf8(bytes).ok()?).map(Into::into),
    };
    if let Some(written) = rewritten(bytes) {
        assert!(rewritten(&written) == Some(written), "something else came back");
    }
}

/// A controller state: the first byte says of which method, or that the rest is an envelope
/// without its checksum.
pub fn controller_state(bytes: &[u8]) {
    let Some((&which, bytes)) = bytes.split_first() else { return };
    let Some(&method) = Method::ALL.get(usize::from(which % 5)) else {
        let mut envelope = bytes.to_vec();
        let checksum = Sha256::digest(bytes);
        envelope.extend_from_slice(&checksum[..ControllerState::CHECKSUM_LENGTH]);
        if let Ok(state) = ControllerState::decode(&envelope) {
            assert!(state.encode() == envelope, "another envelope came back");
        }
        return;
    };
    if let Ok(state) = State::from_bytes(method, bytes) {
        let written = state.to_bytes();
        let again = State::from_bytes(method, &written).expect("it was just written");
        assert!(again.to_bytes() == written, "another state came back");
        assert_eq!(again.step_index(), state.step_index());
    }
}

/// Missions whose shards are small.
static SHARED: LazyLock<Vec<Problem>> = LazyLock::new(|| {
    let problems =
        [missions::envisat(), missions::prisma(), small_station(), missions::integrator()];
    problems.map(read_problem).into()
});

/// A shard without its checksum: the first byte says of which mission.
pub fn shard(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    let problem = &SHARED[usize::from(*which) % SHARED.len()];
    let bytes = sealed(bytes);
    if let Ok(shard) = problem.shard_from_bytes(&bytes) {
        // A plan has one zero: the sign of another is not kept.
        let written = problem.shard_to_bytes(&shard);
        let again = problem.shard_from_bytes(&written).expect("it was just written");
        assert!(problem.shard_to_bytes(&again) == written, "another shard came back");
    }
}

/// CRC-32 as IEEE 802.3 has it, after the bytes it is of.
fn sealed(body: &[u8]) -> Vec<u8> {
    [body, &crc32fast::hash(body).to_le_bytes()].concat()
}

fn read_problem(json: Value) -> Problem {
    let message = missions::message::<v1::Problem>(json);
    parse(&message, &Limits::default()).expect("a mission of ours")
}

/// The station with safety horizons that a fuzzer has the time for.
fn small_station() -> Value {
    let mut station = missions::station();
    let phases = station["abortSafe"]["phases"].as_array_mut().expect("it has phases");
    for phase in phases {
        for safety in ["passive", "active"] {
            if let Some(safety) = phase.get_mut(safety) {
                safety["watch"]["horizonSteps"] = 6.into();
            }
        }
    }
    station
}

/// Inputs to begin with, of real messages: target, name, bytes.
#[must_use]
pub fn seeds() -> Vec<(&'static str, String, Vec<u8>)> {
    let mut seeds = Vec::new();
    let linear = |components: &[f64]| json!({ "linear": { "components": components } });
    let missions = [
        ("envisat", missions::envisat(), missions::envisat_start()),
        ("double_integrator", missions::double_integrator(), linear(&[20.0, 0.0])),
        ("prisma", missions::prisma(), missions::prisma_measurement(0)),
        ("station", small_station(), missions::at_rest(5000.0)),
        ("integrator", missions::integrator(), linear(&[2.0, 0.0])),
    ];
    for (name, problem, measurement) in missions {
        let step = json!({ "problem": problem, "measurement": measurement });
        let plan = json!({ "problem": problem, "initial": measurement });
        for (which, request) in [(0, &step), (2, &plan), (11, &json!({ "problem": problem }))] {
            let text = request.to_string().into_bytes();
            seeds.push(("request_json", format!("{name}_{which}"), after(which, &text)));
            let message = match which {
                0 => missions::message::<v1::StepRequest>(request.clone()).encode_to_vec(),
                2 => missions::message::<v1::ComputePlanRequest>(request.clone()).encode_to_vec(),
                _ => missions::message::<v1::PrecomputeRequest>(request.clone()).encode_to_vec(),
            };
            seeds.push(("request_proto", format!("{name}_{which}"), after(which, &message)));
        }
        seeds.extend(made(name, &read_problem(problem)));
    }
    seeds.extend(texts());
    seeds.extend(heads());
    seeds.extend(entries());
    seeds
}

fn after(which: u8, bytes: &[u8]) -> Vec<u8> {
    [&[which], bytes].concat()
}

/// What a precompute of the problem leaves behind.
fn made(name: &str, problem: &Problem) -> Vec<(&'static str, String, Vec<u8>)> {
    let run = |shard| problem.run_shard(shard, Budget::UNLIMITED).expect("a mission of ours");
    let shards: Vec<_> = (0..problem.shards()).map(run).collect();
    let without_checksum = |bytes: Vec<u8>| bytes[..bytes.len() - size_of::<u32>()].to_vec();
    let mut seeds = Vec::new();
    let place = SHARED.iter().position(|p| p.canonical_bytes() == problem.canonical_bytes());
    if let Some(which) = place.and_then(|place| u8::try_from(place).ok()) {
        // First and last: of offline sampling, rows and the expected cost.
        for index in BTreeSet::from([0, shards.len() - 1]) {
            let body = without_checksum(problem.shard_to_bytes(&shards[index]));
            seeds.push(("shard", format!("{name}_{index}"), after(which, &body)));
        }
    }
    let artifact = problem.merge(shards, Budget::UNLIMITED).expect("a mission of ours");
    let bytes = artifact.to_bytes();
    let (method, state) = (artifact.method(), artifact.start().to_bytes());
    let which = Method::ALL.iter().position(|&other| other == method).unwrap_or_default();
    let which = u8::try_from(which).unwrap_or_default();
    seeds.push(("controller_state", name.to_owned(), after(which, &state)));
    let envelope = ControllerState {
        method,
        artifact_id: ArtifactId([7; 32]),
        step_index: 0,
        payload: &state,
    };
    let envelope = envelope.encode();
    let envelope = &envelope[..envelope.len() - ControllerState::CHECKSUM_LENGTH];
    seeds.push(("controller_state", format!("{name}_envelope"), after(4, envelope)));
    let record = crate::service::encode_record(method, &bytes);
    seeds.push(("record", name.to_owned(), after(0, &record)));
    if let Some(document) = artifact.render_document() {
        seeds.push(("plan_document", name.to_owned(), encode_json(&document)));
    }
    seeds.push(match method {
        Method::VariableHorizon => ("artifact_variable_horizon", name.to_owned(), bytes),
        Method::DisturbanceFeedback => ("plan_binary", name.to_owned(), without_checksum(bytes)),
        Method::AbortSafe => ("artifact_abort_safe", name.to_owned(), bytes),
        Method::OfflineSampling => ("artifact_offline_sampling", name.to_owned(), bytes),
    });
    seeds
}

fn texts() -> Vec<(&'static str, String, Vec<u8>)> {
    const TLE: &str = "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n\
                       2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667";
    const OMM: &str = "CCSDS_OMM_VERS = 2.0\nCREATION_DATE = 2027-03-01T00:00:00\n\
        ORIGINATOR = VBAR\nOBJECT_NAME = VANGUARD 1\nOBJECT_ID = 1958-002B\nCENTER_NAME = EARTH\n\
        REF_FRAME = TEME\nTIME_SYSTEM = UTC\nMEAN_ELEMENT_THEORY = SGP4\n\
        EPOCH = 2027-03-01T11:00:00\nMEAN_MOTION = 14.2\nECCENTRICITY = 0.004\n\
        INCLINATION = 98.2\nRA_OF_ASC_NODE = 30\nARG_OF_PERICENTER = 77\nMEAN_ANOMALY = 10\n\
        EPHEMERIS_TYPE = 0\nBSTAR = 0.0001\nMEAN_MOTION_DOT = 0.000001\nMEAN_MOTION_DDOT = 0\n";
    const OCM: &str = "CCSDS_OCM_VERS = 3.0\nMETA_START\nTIME_SYSTEM = UTC\n\
        EPOCH_TZERO = 2027-03-01T12:00:00\nMETA_STOP\nMAN_START\nCOMMENT two impulses\n\
        MAN_ID = RENDEZVOUS\nMAN_REF_FRAME = LVLH_ROTATING\n\
        MAN_COMPOSITION = TIME_ABSOLUTE,MAN_DURA, DV_X,DV_Y,DV_Z\n\
        2027-03-01T12:00:00.000 0.0 1.5e-4 0 -2e-5\n\
        2027-03-01T13:00:00.000 0.0 0.0 1e-5 0.0\nMAN_STOP\n";
    const FILE: &str = "listen = '127.0.0.1:7878'\ncompute_threads = 2\nhorizon_max = 60\n\
        compute_wait_s = 0.25\n\0VBAR_STEPS_MAX=100\nVBAR_LOG=info\nVBAR_JOB_TIME_MAX_S=60\n";
    vec![
        ("orbit_text", "tle".into(), after(0, TLE.as_bytes())),
        ("orbit_text", "omm".into(), after(1, OMM.as_bytes())),
        ("orbit_text", "ocm".into(), after(2, OCM.as_bytes())),
        ("configuration", "file_and_environment".into(), FILE.into()),
    ]
}

fn heads() -> Vec<(&'static str, String, Vec<u8>)> {
    const GRPC: &str = "POST /vbar.v1.GuidanceService/Step\ncontent-type: application/grpc\n\
        grpc-timeout: 250m\nauthorization: Bearer vbar_0123\nx-request-id: run-7\n\
        traceparent: 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01\n";
    const HTTP: &str = "GET /v1/operations?pageSize=5&filter=done%3Dtrue&page_token=a+b\n\
        content-type: application/json; charset=utf-8\nrequest-timeout-ms: 1500\n\
        content-encoding: identity\nrange: bytes=0-99\n";
    const EXPORT: &str = "GET /v1/plans/00ff:export?format=CCSDS_OEM&chaserName=A%20B\n\
        range: bytes=-7\n";
    const FRAMES: [u8; 19] = [0, 0, 0, 0, 3, 1, 2, 3, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1, 9];
    vec![
        ("request_head", "grpc".into(), GRPC.into()),
        ("request_head", "http".into(), HTTP.into()),
        ("request_head", "export".into(), EXPORT.into()),
        ("request_frames", "three".into(), after(4, &FRAMES)),
    ]
}

/// Tokens as an operator writes them, right and wrong, and entries of ledgers.
fn entries() -> Vec<(&'static str, String, Vec<u8>)> {
    let digest = "00".repeat(32);
    let right = format!(
        "[[token]]\nname = 'ground'\nsha256 = '{digest}'\nroles = ['plan', 'step']\n\
         expires = 2027-03-01T00:00:00Z\nrate_max_per_s = 50.0\nburst_max = 9\ncalls_max = 8\n\
         [[certificate]]\nname = 'loop'\nsha256 = '{digest}'\nroles = []\n"
    );
    let misplaced = format!("[[token]]\nname = 'x'\nsha256 = '{SECRET}'\nroles = ['{SECRET}']\n");
    let wrong_type = format!("[[token]]\nname = 'x'\nrate_max_per_s = '{SECRET}'\n");
    let as_key = format!("[[token]]\nname = 'x'\n{SECRET} = 1\n");
    let bare = format!("token = {SECRET}\n");
    let tokens = [
        ("right", right),
        ("misplaced", misplaced),
        ("wrong_type", wrong_type),
        ("as_key", as_key),
        ("bare", bare),
    ];
    let line = |more: &str| {
        format!(
            "{{\"format\":1,\"method\":\"variable_horizon\",\"attempts\":1,\"shards_done\":1,\
             \"shards_total\":3,\"created_unix_ms\":1772366400000,\
             \"started_unix_ms\":1772366400001,\"ended_unix_ms\":null,{more}}}\nproblem"
        )
    };
    let failed = "\"ending\":{\"failed\":{\"code\":13,\"reason\":\"R\",\"message\":\"m\",\
                  \"violations\":[{\"path\":\"p\",\"expected\":\"e\",\"got\":\"g\"}]}}";
    let infeasible = "\"ending\":{\"infeasible\":[]}";
    let parts = format!(
        "\"ending\":null,\"parts\":{{\"ticket\":\"{}\",\"done\":\"01\",\
         \"begun_again\":{{\"2\":1}},\"round\":1}}",
        "0f".repeat(24)
    );
    let commit = format!("{{\"sha256\":\"{digest}\",\"size\":7,\"object\":\"plans.0.0.0\"}}");
    let stored: [(&str, u8, Vec<u8>); 10] = [
        ("job", 0, line("\"ending\":null").into()),
        ("job_failed", 0, line(failed).into()),
        ("job_infeasible", 0, line(infeasible).into()),
        ("job_in_parts", 0, line(&parts).into()),
        ("request", 1, vec![1; 40]),
        ("errand", 2, vec![2; 60]),
        ("word", 3, vec![3; 64]),
        ("lease", 4, vec![1, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0]),
        ("commit", 5, commit.into()),
        ("entry", 6, vec![6; 24]),
    ];
    let exchange = Exchange { call: "Step".into(), request: vec![7; 9], ..Exchange::default() };
    let what = [entry::What::Exchange(exchange), entry::What::Lost(Lost { count: 5 })];
    let [exchange, lost] = what.map(|what| Entry { what: Some(what) }.encode_to_vec());
    let recordings = [
        ("recording", "file".into(), after(0, &file_of([&exchange, &lost]))),
        ("recording", "exchange".into(), after(1, &exchange)),
    ];
    let tokens = tokens.map(|(name, text)| ("credentials", name.into(), after(0, text.as_bytes())));
    let stored = stored.map(|(name, which, bytes)| ("stored", name.into(), after(which, &bytes)));
    tokens.into_iter().chain(stored).chain(recordings).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(target: &str, bytes: &[u8]) {
        match target {
            "request_proto" => request_proto(bytes),
            "request_json" => request_json(bytes),
            "orbit_text" => orbit_text(bytes),
            "configuration" => configuration(bytes),
            "record" => record(bytes),
            "artifact_variable_horizon" => artifact_variable_horizon(bytes),
            "artifact_abort_safe" => artifact_abort_safe(bytes),
            "artifact_offline_sampling" => artifact_offline_sampling(bytes),
            "plan_binary" => plan_binary(bytes),
            "controller_state" => controller_state(bytes),
            "shard" => shard(bytes),
            "plan_document" => plan_document(bytes),
            "request_head" => request_head(bytes),
            "request_frames" => request_frames(bytes),
            "credentials" => credentials(bytes),
            "stored" => stored(bytes),
            "recording" => recording(bytes),
            other => panic!("no target {other}"),
        }
    }

    #[test]
    fn every_seed_reaches_behind_its_parser() {
        for (target, name, bytes) in seeds() {
            run(target, &bytes);
            let body = &bytes[1..];
            let is_taken = match target {
                "artifact_variable_horizon" => {
                    Artifact::from_bytes(Method::VariableHorizon, &bytes).is_ok()
                }
                "artifact_abort_safe" => Artifact::from_bytes(Method::AbortSafe, &bytes).is_ok(),
                "artifact_offline_sampling" => {
                    Artifact::from_bytes(Method::OfflineSampling, &bytes).is_ok()
                }
                "plan_binary" => Candidate::Binary(sealed(&bytes).into()).verify().is_ok(),
                "shard" => SHARED[usize::from(bytes[0])].shard_from_bytes(&sealed(body)).is_ok(),
                "orbit_text" if name == "ocm" => {
                    read_ocm_burns(std::str::from_utf8(body).unwrap()).is_ok()
                }
                "plan_document" => verify_plan(&bytes, &Limits::default()).is_ok(),
                "credentials" => token_faults(body).is_empty() == (name == "right"),
                "stored" => match bytes[0] {
                    0 => stored_jobs::job(body).is_some(),
                    1 => stored_jobs::request(body).is_some(),
                    2 => stored_jobs::errand(body).is_some(),
                    3 => stored_jobs::word(body).is_some(),
                    4 => lease_rewritten(body).is_some(),
                    5 => commit_rewritten(body).is_some(),
                    _ => entry_in_file(body).is_some(),
                },
                "recording" if name == "exchange" => Entry::decode(body).is_ok(),
                "recording" => Recording::read(body).is_ok_and(|mut file| file.next().is_some()),
                _ => true,
            };
            assert!(is_taken, "{target}/{name}");
        }
    }

    #[test]
    fn corpus_holds() {
        let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/fuzz/corpus");
        let mut inputs = 0;
        for target in std::fs::read_dir(corpus).unwrap() {
            let target = target.unwrap();
            for input in std::fs::read_dir(target.path()).unwrap() {
                let bytes = std::fs::read(input.unwrap().path()).unwrap();
                run(target.file_name().to_str().unwrap(), &bytes);
                inputs += 1;
            }
        }
        assert!(inputs >= seeds().len(), "{inputs} inputs");
    }
}
