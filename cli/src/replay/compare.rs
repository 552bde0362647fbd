//! Two answers to the same request.

use prost_reflect::{DynamicMessage, MessageDescriptor, SerializeOptions, prost::bytes::Bytes};
use serde_json::{Value, json};
use vbar_client::Code;
use vbar_proto::DESCRIPTORS;
use vbar_server::recording::{Exchange, digest};

use super::player::Judgement;

type Fields = serde_json::Map<String, Value>;

/// Most fields of one answer that are named.
const LINES_MAX: usize = 20;
/// Longest value that is shown.
const VALUE_LENGTH_MAX: usize = 60;

/// What a node said now.
#[derive(Debug)]
pub(super) struct Answer {
    /// `google.rpc.Code`.
    pub(super) code: i32,
    /// What was said with it.
    pub(super) message: String,
    /// Messages, or the body over HTTP.
    pub(super) answers: Vec<Bytes>,
}

impl Answer {
    /// The body of an answer over HTTP: an error says its code.
    pub(super) fn of_http(body: &Bytes) -> Self {
        let (code, message) = error(body).unwrap_or_default();
        Self { code, message, answers: vec![body.clone()] }
    }

    /// An operation that is done or was only checked, or an error.
    pub(super) fn is_final(&self, exchange: &Exchange) -> bool {
        let operation = self.answers.first().and_then(|answer| value(exchange, answer));
        let Some(operation) = operation.filter(|_| self.code == 0) else { return true };
        operation["done"] == true || operation["metadata"]["phase"] == "validated"
    }
}

/// Code and message of an error over HTTP.
fn error(body: &[u8]) -> Option<(i32, String)> {
    let error: Value = serde_json::from_slice(body).ok()?;
    let code = i32::try_from(error.get("code")?.as_i64()?).ok()?;
    let message = error.get("message")?.as_str()?.to_owned();
    error.get("details")?;
    Some((code, message))
}

/// Whether the answer is the one that was recorded.
pub(super) fn judge(exchange: &Exchange, now: &Answer) -> Judgement {
    if exchange.code != now.code {
        let recorded = format!("recorded {}, now {}", exchange.code, now.code);
        let mut lines = vec![format!("code: {recorded} {}", now.message)];
        if now.code == NOT_FOUND {
            lines.push("what it names was made before the recording began (--data-dir)".into());
        }
        return Judgement::Different(lines);
    }
    if exchange.code != 0 {
        return judge_refusals(exchange, now);
    }
    let same = digest(now.answers.iter().map(|answer| &**answer)) == *exchange.answer_sha256;
    if same {
        return Judgement::Same;
    }
    let is_kept = exchange.answers.len() == now.answers.len();
    let recorded: Option<Vec<Value>> =
        exchange.answers.iter().map(|answer| value(exchange, answer)).collect();
    let (true, Some(recorded)) = (is_kept, recorded.filter(|_| !exchange.answers.is_empty()))
    else {
        if exchange.answers.is_empty() && is_dated(exchange, now) {
            return Judgement::Skipped("that name a moment or a call, with only a digest kept");
        }
        let bytes = |answers: &[usize]| answers.iter().sum::<usize>();
        let before: Vec<usize> = exchange.answers.iter().map(Vec::len).collect();
        let after: Vec<usize> = now.answers.iter().map(Bytes::len).collect();
        let (before, after) = (bytes(&before), bytes(&after));
        return Judgement::Different(vec![format!(
            "other bytes: {before} were kept, {after} came now"
        )]);
    };
    // Within a closed loop a refusal is an answer.
    let code = recorded[0]["status"]["code"].as_i64().and_then(|code| i32::try_from(code).ok());
    if let Some(why) = code.and_then(for_want) {
        return Judgement::Skipped(why);
    }
    let answers: Option<Vec<Value>> =
        now.answers.iter().map(|answer| value(exchange, answer)).collect();
    let Some(answers) = answers else {
        return Judgement::Different(vec!["other bytes, and no message of the contract".into()]);
    };
    let mut lines = Vec::new();
    let (mut recorded, mut now) = (Value::from(recorded), Value::from(answers));
    for answers in [&mut recorded, &mut now] {
        without_moments(answers);
    }
    if exchange.call == "Precompute" {
        let is_done = recorded[0]["done"] == true;
        for operation in [&mut recorded[0], &mut now[0]] {
            let whole = operation.take();
            *operation = json!({ "name": whole["name"] });
            if is_done {
                operation["response"] = whole["response"].clone();
                operation["error"] = whole["error"].clone();
            }
        }
    }
    differences("", &recorded, &now, &mut lines);
    if lines.is_empty() { Judgement::Same } else { Judgement::Different(lines) }
}

/// Why answers with this code are not compared, if they are not.
pub(super) fn for_want(code: i32) -> Option<&'static str> {
    match Code::from_i32(code) {
        Code::Cancelled | Code::DeadlineExceeded | Code::ResourceExhausted | Code::Unavailable => {
            Some("that ended for want of time or room")
        }
        _ => None,
    }
}

const NOT_FOUND: i32 = 5;
const INTERNAL: i32 = 13;

/// Refused both times, for the same reason.
fn judge_refusals(exchange: &Exchange, now: &Answer) -> Judgement {
    let recorded = match exchange.answers.first().and_then(|body| error(body)) {
        Some((_, message)) => message,
        None if exchange.http_method.is_empty() => exchange.message.clone(),
        None => return Judgement::Skipped("refused, of which only a digest was kept"),
    };
    // A fault of ours may name the call that had it.
    if exchange.code == INTERNAL || recorded == now.message {
        return Judgement::Same;
    }
    Judgement::Different(vec![format!("message: recorded {recorded:?}, now {:?}", now.message)])
}

/// Whether an answer tells when something was made or ends, or is a refusal within a closed loop,
/// which names its call.
fn is_dated(exchange: &Exchange, now: &Answer) -> bool {
    let answer = now.answers.first().and_then(|answer| value(exchange, answer));
    let is_refusal = answer.is_some_and(|answer| answer["status"].is_object());
    is_refusal || ["Precompute", "GetArtifact"].contains(&exchange.call.as_str())
}

/// An answer's message as JSON; `None` if it is none.
fn value(exchange: &Exchange, answer: &[u8]) -> Option<Value> {
    if !exchange.http_method.is_empty() {
        return serde_json::from_slice(answer).ok();
    }
    let message = DynamicMessage::decode(answered_with(&exchange.path)?, answer).ok()?;
    let options = SerializeOptions::new().skip_default_fields(false);
    message.serialize_with_options(serde_json::value::Serializer, &options).ok()
}

/// The message that the RPC at `path` answers with.
fn answered_with(path: &str) -> Option<MessageDescriptor> {
    let (service, method) = path.strip_prefix('/')?.split_once('/')?;
    let service = DESCRIPTORS.get_service_by_name(service)?;
    service.methods().find(|rpc| rpc.name() == method).map(|rpc| rpc.output())
}

/// Takes out what tells when and in which call something happened: that is never the same.
fn without_moments(value: &mut Value) {
    match value {
        Value::Object(fields) => {
            for name in ["expireTime", "requestId", "trace_id"] {
                fields.remove(name);
            }
            fields.values_mut().for_each(without_moments);
        }
        Value::Array(values) => values.iter_mut().for_each(without_moments),
        _ => {}
    }
}

/// Every field that differs, with its path.
fn differences(path: &str, recorded: &Value, now: &Value, lines: &mut Vec<String>) {
    if recorded == now || lines.len() >= LINES_MAX {
        return;
    }
    match (recorded, now) {
        (Value::Object(before), Value::Object(after)) => {
            let added = after.keys().filter(|name| !before.contains_key(*name));
            for name in before.keys().chain(added) {
                let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                let of = |fields: &Fields| fields.get(name).cloned().unwrap_or(Value::Null);
                differences(&path, &of(before), &of(after), lines);
            }
        }
        (Value::Array(before), Value::Array(after)) if before.len() == after.len() => {
            // A call has one answer; only a download has several.
            let is_only = path.is_empty() && before.len() == 1;
            for (index, (before, after)) in before.iter().zip(after).enumerate() {
                let path = if is_only { String::new() } else { format!("{path}[{index}]") };
                differences(&path, before, after, lines);
            }
        }
        _ => lines.push(format!("{path}: recorded {}, now {}", shown(recorded), shown(now))),
    }
}

fn shown(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(VALUE_LENGTH_MAX) {
        None => text,
        Some((end, _)) => format!("{}…", &text[..end]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_named_by_field() {
        let recorded = json!([{"a": {"b": [1, 2.5]}, "c": "x", "expireTime": "1", "d": [1]}]);
        let now = json!([{"a": {"b": [1, 2.75]}, "e": true, "expireTime": "2", "d": [1, 2]}]);
        let mut lines = Vec::new();
        let (mut recorded, mut now) = (recorded, now);
        without_moments(&mut recorded);
        without_moments(&mut now);
        differences("", &recorded, &now, &mut lines);
        assert_eq!(
            lines,
            [
                "a.b[1]: recorded 2.5, now 2.75",
                "c: recorded \"x\", now null",
                "d: recorded [1], now [1,2]",
                "e: recorded null, now true",
            ]
        );
        differences("", &recorded, &recorded.clone(), &mut lines);
        assert_eq!(lines.len(), 4);
    }

    #[test]
    fn error_over_http_is_told_from_an_answer() {
        let refusal = json!({ "code": 3, "message": "no", "details": [] }).to_string();
        assert_eq!(error(refusal.as_bytes()), Some((3, "no".to_owned())));
        for body in ["{}", "", "{\"code\": 3}", "t,x\n1,2\n"] {
            assert_eq!(error(body.as_bytes()), None, "{body}");
        }
    }
}
