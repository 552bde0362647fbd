//! The OpenAPI document, made from the contract's descriptors and their comments.

use std::collections::{BTreeMap, HashMap};

use http::Method;
use prost_reflect::{
    Cardinality, EnumDescriptor, FieldDescriptor, FileDescriptor, Kind, MessageDescriptor,
};
use serde_json::{Map, Value, json};
use vbar_proto::DESCRIPTORS;

use super::TIMEOUT;
use crate::access::{Right, right};

/// One HTTP binding of an RPC.
struct Route {
    method: &'static str,
    path: &'static str,
    rpc: &'static str,
    /// The request is a JSON body, which may be left out if not required.
    body: Option<Body>,
}

#[derive(Clone, Copy, PartialEq)]
enum Body {
    Required,
    Optional,
}

const ROUTES: [Route; 18] = [
    route("post", "/v1/plans:compute", "vbar.v1.GuidanceService.ComputePlan", Body::Required),
    route("post", "/v1/plans", "vbar.v1.GuidanceService.UploadPlan", Body::Required),
    bare("get", "/v1/plans", "vbar.v1.GuidanceService.ListPlans"),
    bare("get", "/v1/plans/{id}", "vbar.v1.GuidanceService.GetPlan"),
    bare("get", EXPORT, "vbar.v1.GuidanceService.ExportPlan"),
    route("post", "/v1/precompute", "vbar.v1.GuidanceService.Precompute", Body::Required),
    route("post", "/v1/step", "vbar.v1.GuidanceService.Step", Body::Required),
    route("post", "/v1/safety:report", "vbar.v1.GuidanceService.SafetyReport", Body::Required),
    bare("get", "/v1/info", "vbar.v1.GuidanceService.GetServerInfo"),
    bare("get", ARTIFACTS, "vbar.v1.GuidanceService.ListArtifacts"),
    bare("get", "/v1/artifacts/{id}", "vbar.v1.GuidanceService.GetArtifact"),
    bare("get", DOWNLOAD, "vbar.v1.GuidanceService.DownloadArtifact"),
    bare("get", "/v1/operations", "google.longrunning.Operations.ListOperations"),
    bare("get", "/v1/operations/{id}", "google.longrunning.Operations.GetOperation"),
    bare("get", WATCH, "google.longrunning.Operations.GetOperation"),
    bare("delete", "/v1/operations/{id}", "google.longrunning.Operations.DeleteOperation"),
    route(
        "post",
        "/v1/operations/{id}:wait",
        "google.longrunning.Operations.WaitOperation",
        Body::Optional,
    ),
    route(
        "post",
        "/v1/operations/{id}:cancel",
        "google.longrunning.Operations.CancelOperation",
        Body::Optional,
    ),
];

/// Answered by the document itself.
const EXPORT: &str = "/v1/plans/{id}:export";
/// Answered by the bytes themselves.
const DOWNLOAD: &str = "/v1/artifacts/{id}:download";
/// Answered by events.
const WATCH: &str = "/v1/operations/{id}:watch";
const ARTIFACTS: &str = "/v1/artifacts";

const fn route(method: &'static str, path: &'static str, rpc: &'static str, body: Body) -> Route {
    Route { method, path, rpc, body: Some(body) }
}

const fn bare(method: &'static str, path: &'static str, rpc: &'static str) -> Route {
    Route { method, path, rpc, body: None }
}

/// What is served beside the contract: path, name, what it says, in which form.
const BESIDE: [(&str, &str, &str, &str); 5] = [
    ("/healthz", "probe", "Whether the process is alive.", "text/plain"),
    (
        "/readyz",
        "probe",
        "Whether it will answer; 503 while it shuts down or its store is gone.",
        "text/plain",
    ),
    (
        "/readyz/steps",
        "probe",
        "Whether it will answer steps; 503 while it shuts down.",
        "text/plain",
    ),
    ("/metrics", "metrics", "Metrics for Prometheus.", "application/openmetrics-text"),
    ("/openapi.json", "openapi", "This document.", "application/json"),
];

/// Name of the RPC behind a request, or of what is beside the contract; `None` if the path
/// is not served. A method that the path does not take still belongs to the path.
pub(in crate::transport) fn served(method: &Method, path: &str) -> Option<&'static str> {
    if let Some((_, name, ..)) = BESIDE.iter().find(|(beside, ..)| *beside == path) {
        return Some(name);
    }
    let method = if method == Method::HEAD { &Method::GET } else { method };
    let matching = ROUTES.iter().filter(|route| route.takes(path));
    // With a verb after the id two routes match; the longer one says more.
    let best = matching.max_by_key(|route| {
        (route.path.len(), route.method.eq_ignore_ascii_case(method.as_str()))
    })?;
    best.rpc.rsplit('.').next()
}

impl Route {
    fn takes(&self, path: &str) -> bool {
        match self.path.split_once("{id}") {
            None => self.path == path,
            Some((before, after)) => path
                .strip_prefix(before)
                .and_then(|rest| rest.strip_suffix(after))
                .is_some_and(|id| !id.is_empty() && !id.contains('/')),
        }
    }
}

/// The whole document.
pub(super) fn document() -> Value {
    let mut schemas = Schemas::default();
    let mut paths: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for route in &ROUTES {
        let operation = operation(route, &mut schemas);
        paths.entry(route.path.to_owned()).or_default().insert(route.method.to_owned(), operation);
    }
    for (path, _, summary, content) in BESIDE {
        paths.entry(path.to_owned()).or_default().insert("get".to_owned(), probe(summary, content));
    }
    schemas.add_status();
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "vbar",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "Guidance for spacecraft rendezvous. The messages of `vbar.v1` as \
                canonical proto3 JSON: field names in lowerCamelCase (snake_case is accepted), \
                64-bit integers as strings, enum values by name. Unknown fields are refused. The \
                header `X-Request-Id` is echoed.",
            "license": { "name": "Apache-2.0", "identifier": "Apache-2.0" },
        },
        "paths": paths,
        "security": [{}, { "bearer": [] }],
        "components": {
            "securitySchemes": { "bearer": { "type": "http", "scheme": "bearer" } },
            "schemas": schemas.by_name,
            "parameters": {
                "id": {
                    "name": "id",
                    "in": "path",
                    "required": true,
                    "description": "Id of the artifact or plan: 64 lower-case hexadecimal digits.",
                    "schema": { "type": "string", "pattern": "^[0-9a-f]{64}$" },
                },
                "timeout": {
                    "name": TIMEOUT,
                    "in": "header",
                    "required": false,
                    "description": "Deadline in milliseconds; a call that cannot keep it is \
                        answered with 504. Absent: the server's limit.",
                    "schema": { "type": "integer", "minimum": 1, "maximum": 999_999_999 },
                },
            },
        },
    })
}

fn operation(route: &Route, schemas: &mut Schemas) -> Value {
    let (service, rpc) = route.rpc.rsplit_once('.').unwrap_or_default();
    let service = DESCRIPTORS.get_service_by_name(service).expect("it is in the contract");
    let rpc = service.methods().find(|m| m.name() == rpc).expect("it is in the contract");
    let mut parameters = vec![json!({ "$ref": "#/components/parameters/timeout" })];
    if route.path.contains("{id}") {
        parameters.push(json!({ "$ref": "#/components/parameters/id" }));
    }
    let is_list = ["/v1/operations", "/v1/plans", ARTIFACTS].contains(&route.path);
    if is_list && route.method == "get" {
        for (name, schema) in [
            ("pageSize", json!({ "type": "integer", "minimum": 0, "maximum": i32::MAX })),
            ("pageToken", json!({ "type": "string", "pattern": "^([0-9a-f]{64})?$" })),
        ] {
            parameters.push(json!({ "name": name, "in": "query", "schema": schema }));
        }
    }
    if route.path == "/v1/operations" {
        let schema = json!({ "type": "string" });
        parameters.push(json!({ "name": "filter", "in": "query", "schema": schema }));
    }
    if route.path == EXPORT {
        parameters.extend(export_parameters());
    }
    if route.path == DOWNLOAD {
        let schema = json!({ "type": "string", "pattern": "^bytes=[0-9]*-[0-9]*$" });
        parameters.push(json!({ "name": "Range", "in": "header", "schema": schema }));
    }
    let comments = Comments::of(&rpc.parent_file());
    let mut description = comments.at(rpc.path());
    if let Right::Role(role) = right(rpc.name()) {
        description.push_str(&format!("\n\nNeeds the role `{}`.", role.name()));
    }
    let mut operation = json!({
        "operationId": if route.path == WATCH { "WatchOperation" } else { rpc.name() },
        "description": description,
        "parameters": parameters,
        "responses": responses(route, schemas.reference(&rpc.output())),
    });
    if let Some(body) = route.body {
        operation["requestBody"] = json!({
            "required": body == Body::Required,
            "content": { "application/json": { "schema": schemas.reference(&rpc.input()) } },
        });
    }
    operation
}

/// The fields of the message that go into the query.
fn export_parameters() -> Vec<Value> {
    let formats = ["CCSDS_OCM", "CCSDS_OEM", "CSV", "BINARY"];
    let text = || json!({ "type": "string", "maxLength": 64 });
    let mut parameters = vec![json!({
        "name": "format", "in": "query", "required": true,
        "schema": { "type": "string", "enum": formats },
    })];
    let names = ["chaserName", "targetName", "chaserDesignator", "originator", "creationDate"];
    for name in names {
        parameters.push(json!({ "name": name, "in": "query", "schema": text() }));
    }
    parameters
}

fn responses(route: &Route, answer: Value) -> Value {
    let mut responses = Map::new();
    let mut add = |code: &str, description: &str, schema: &Value| {
        let content = json!({ "application/json": { "schema": schema } });
        responses
            .insert(code.to_owned(), json!({ "description": description, "content": content }));
    };
    if ![EXPORT, DOWNLOAD, WATCH].contains(&route.path) {
        add("200", "The answer; an infeasible problem is one too.", &answer);
    }
    let status = json!({ "$ref": "#/components/schemas/google.rpc.Status" });
    let mut errors = vec![
        ("400", "The request is at fault; every faulty field is named."),
        ("401", "The node asks who calls: a token or certificate is missing, unknown or expired."),
        ("403", "The caller does not have the role that the call needs."),
        ("405", "The path exists, but not for this method."),
        ("429", "A limit of the server is reached; the details say when to ask again."),
        ("500", "A bug of the server; the request id finds it in the log."),
        ("503", "The artifact store does not answer, or the server is shutting down."),
        ("504", "No certified answer was found before the deadline."),
    ];
    let names_one = ["/v1/step", "/v1/safety:report"].contains(&route.path);
    if route.path.contains("{id}") || names_one {
        errors.push(("404", "There is no such artifact, plan or operation."));
    }
    if route.body.is_some() {
        errors.push(("408", "The body did not arrive in time."));
        errors.push(("413", "The body is too large."));
        errors.push(("415", "The body is not plain JSON."));
    }
    if route.path == "/v1/precompute" {
        errors.push(("409", "The request id came with another problem before."));
    }
    if route.path == DOWNLOAD {
        errors.push(("416", "No byte of the artifact is in the range."));
    }
    for (code, description) in errors {
        add(code, description, &status);
    }
    let mut add_text = |code: &str, description: &str, types: &[&str]| {
        let text = json!({ "schema": { "type": "string" } });
        let content: Map<_, _> = types.iter().map(|t| ((*t).to_owned(), text.clone())).collect();
        let ok = json!({ "description": description, "content": content });
        responses.insert(code.to_owned(), ok);
    };
    match route.path {
        EXPORT => {
            let types = ["text/plain", "text/csv", "application/octet-stream"];
            add_text("200", "The document itself.", &types);
        }
        DOWNLOAD => {
            add_text("200", "The bytes; their sha256 is the ETag.", &["application/octet-stream"]);
            add_text("206", "The bytes in the range.", &["application/octet-stream"]);
        }
        WATCH => {
            let events = "Events `progress`, at most five a second, and `done` at the end, each \
                          with the operation as JSON.";
            add_text("200", events, &["text/event-stream"]);
        }
        _ => {}
    }
    Value::Object(responses)
}

fn probe(summary: &str, content: &str) -> Value {
    let schema = if content == "application/json" {
        json!({ "type": "object" })
    } else {
        json!({ "type": "string" })
    };
    let ok = json!({ "description": "Yes.", "content": { content: { "schema": schema } } });
    let no = json!({
        "description": "Not now.",
        "content": { "text/plain": { "schema": { "type": "string" } } },
    });
    let wrong = json!({
        "description": "Only GET.",
        "content": {
            "application/json": {
                "schema": { "$ref": "#/components/schemas/google.rpc.Status" },
            },
        },
    });
    json!({ "description": summary, "responses": { "200": ok, "405": wrong, "503": no } })
}

/// Schemas of messages and enums, collected as they are referred to.
#[derive(Default)]
struct Schemas {
    by_name: BTreeMap<String, Value>,
}

impl Schemas {
    fn reference(&mut self, message: &MessageDescriptor) -> Value {
        let name = message.full_name();
        match name {
            "google.protobuf.Empty" => return json!({ "type": "object" }),
            "google.protobuf.Duration" => {
                return json!({ "type": "string", "pattern": "^[0-9]{1,9}([.][0-9]{1,9})?s$" });
            }
            "google.protobuf.Timestamp" => {
                return json!({ "type": "string", "format": "date-time" });
            }
            "google.protobuf.Any" => {
                return json!({
                    "type": "object",
                    "properties": { "@type": { "type": "string" } },
                    "required": ["@type"],
                    "additionalProperties": true,
                });
            }
            _ => {}
        }
        if !self.by_name.contains_key(name) {
            // First a place-holder, so that a message may contain itself.
            self.by_name.insert(name.to_owned(), Value::Null);
            let schema = self.message(message);
            self.by_name.insert(name.to_owned(), schema);
        }
        json!({ "$ref": format!("#/components/schemas/{name}") })
    }

    fn message(&mut self, message: &MessageDescriptor) -> Value {
        let comments = Comments::of(&message.parent_file());
        let mut description = comments.at(message.path());
        for oneof in message.oneofs().filter(|oneof| !oneof.is_synthetic()) {
            let names: Vec<_> = oneof.fields().map(|f| f.json_name().to_owned()).collect();
            let comment = comments.at(oneof.path());
            description += &format!(" At most one of {}: {comment}", names.join(", "));
        }
        let mut properties = Map::new();
        for field in message.fields() {
            let mut schema = self.field(&field);
            schema["description"] = comments.at(field.path()).into();
            properties.insert(field.json_name().to_owned(), schema);
        }
        json!({
            "type": "object",
            "description": description.trim(),
            "properties": properties,
            "additionalProperties": false,
        })
    }

    fn field(&mut self, field: &FieldDescriptor) -> Value {
        let kind = self.kind(&field.kind());
        match field.cardinality() {
            Cardinality::Repeated => json!({ "type": "array", "items": kind }),
            Cardinality::Optional | Cardinality::Required => kind,
        }
    }

    fn kind(&mut self, kind: &Kind) -> Value {
        match kind {
            Kind::Double => json!({ "type": "number", "format": "double" }),
            Kind::Float => json!({ "type": "number", "format": "float" }),
            Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => json!({
                "type": "integer", "format": "int32", "minimum": i32::MIN, "maximum": i32::MAX,
            }),
            Kind::Uint32 | Kind::Fixed32 => json!({
                "type": "integer", "minimum": 0, "maximum": u32::MAX,
            }),
            Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => {
                json!({ "type": "string", "format": "int64", "pattern": "^-?[0-9]{1,18}$" })
            }
            Kind::Uint64 | Kind::Fixed64 => {
                json!({ "type": "string", "format": "uint64", "pattern": "^[0-9]{1,18}$" })
            }
            Kind::Bool => json!({ "type": "boolean" }),
            Kind::String => json!({ "type": "string" }),
            Kind::Bytes => json!({ "type": "string", "contentEncoding": "base64" }),
            Kind::Message(message) => self.reference(message),
            Kind::Enum(values) => self.enumeration(values),
        }
    }

    fn enumeration(&mut self, values: &EnumDescriptor) -> Value {
        let name = values.full_name();
        if !self.by_name.contains_key(name) {
            let comments = Comments::of(&values.parent_file());
            let mut description = comments.at(values.path());
            for value in values.values() {
                description += &format!(" `{}`: {}", value.name(), comments.at(value.path()));
            }
            let names: Vec<_> = values.values().map(|value| value.name().to_owned()).collect();
            let schema = json!({
                "type": "string",
                "enum": names,
                "description": description.trim(),
            });
            self.by_name.insert(name.to_owned(), schema);
        }
        json!({ "$ref": format!("#/components/schemas/{name}") })
    }

    /// The shape of every error.
    fn add_status(&mut self) {
        let status = DESCRIPTORS.get_message_by_name("google.rpc.Status");
        self.reference(&status.expect("it is in the contract"));
    }
}

/// The comments of one file, by the path of what they are about.
struct Comments(HashMap<Vec<i32>, String>);

impl Comments {
    fn of(file: &FileDescriptor) -> Self {
        let described = file.file_descriptor_proto();
        let locations = described.source_code_info.iter().flat_map(|info| &info.location);
        let text = |text: &str| {
            let lines = text.lines().map(str::trim).filter(|line| !line.starts_with("buf:"));
            lines.collect::<Vec<_>>().join(" ").trim().to_owned()
        };
        Self(locations.map(|l| (l.path.clone(), text(l.leading_comments()))).collect())
    }

    fn at(&self, path: &[i32]) -> String {
        self.0.get(path).cloned().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every `$ref` of the document.
    fn references(value: &Value, found: &mut Vec<String>) {
        match value {
            Value::Object(map) => {
                for (key, value) in map {
                    match (key.as_str(), value) {
                        ("$ref", Value::String(target)) => found.push(target.clone()),
                        _ => references(value, found),
                    }
                }
            }
            Value::Array(values) => values.iter().for_each(|value| references(value, found)),
            _ => {}
        }
    }

    #[test]
    fn openapi_every_reference_leads_somewhere() {
        let document = document();
        let mut found = Vec::new();
        references(&document, &mut found);
        assert!(found.len() > 100);
        for target in found {
            let pointer = target.strip_prefix('#').expect("a local reference");
            assert!(document.pointer(pointer).is_some_and(Value::is_object), "{target}");
        }
    }

    #[test]
    fn openapi_every_call_declares_its_deadline() {
        let document = document();
        for route in &ROUTES {
            let parameters = document["paths"][route.path][route.method]["parameters"].as_array();
            let declared = parameters.unwrap().iter().any(|parameter| {
                let target = parameter["$ref"].as_str().and_then(|target| target.strip_prefix('#'));
                target.is_some_and(|target| document.pointer(target).unwrap()["name"] == TIMEOUT)
            });
            assert!(declared, "{} {}", route.method, route.path);
        }
    }

    #[test]
    fn openapi_every_schema_and_field_has_the_contract_s_comment() {
        let document = document();
        let schemas = document["components"]["schemas"].as_object().unwrap();
        assert!(schemas.contains_key("vbar.v1.HillPlant"));
        for (name, schema) in schemas {
            assert!(!schema["description"].as_str().unwrap().is_empty(), "{name}");
            for (field, schema) in schema["properties"].as_object().into_iter().flatten() {
                assert!(!schema["description"].as_str().unwrap().is_empty(), "{name}.{field}");
            }
        }
    }
}
