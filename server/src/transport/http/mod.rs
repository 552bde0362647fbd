//! JSON over HTTP: the messages of the contract as canonical proto3 JSON.

mod distinct;
mod download;
mod errors;
mod events;
mod json;
mod openapi;

#[cfg(feature = "fuzzing")]
pub(crate) use json::{decode as decode_json, encode as encode_json};

use std::{sync::Arc, time::Duration};

use axum::{
    Router,
    body::{Body, Bytes},
    extract::{Path, Request, State},
    response::{IntoResponse as _, Response},
    routing::{any, get, post},
};
use http::{HeaderMap, HeaderValue, Method, StatusCode, header, request::Parts};
use http_body_util::{BodyExt as _, LengthLimitError, Limited};
use prost::{Message, Name};
use vbar_proto::{google::longrunning, v1};

use super::{Role, SERVER_TIMING, TransportOptions, deadline_fault, pass, server_timing};
use crate::{
    service::{Call, Code, Error, Service, Timed},
    telemetry::RequestId,
    wire::{ArtifactCall, Document, NamedBy, Parse, Render, parse},
};
use errors::HttpError;

pub(super) use errors::{refused, unknown_path};
pub(super) use openapi::served;

const JSON: HeaderValue = HeaderValue::from_static("application/json");
const TEXT: HeaderValue = HeaderValue::from_static("text/plain; charset=utf-8");
const OPENMETRICS: HeaderValue =
    HeaderValue::from_static("application/openmetrics-text; version=1.0.0; charset=utf-8");
/// A caller's deadline in milliseconds.
const TIMEOUT: &str = "request-timeout-ms";

/// What the handlers share.
#[derive(Debug)]
struct Http {
    service: Arc<Service>,
    options: TransportOptions,
    openapi: Bytes,
}

type Shared = State<Arc<Http>>;

/// Every HTTP route.
pub(super) fn router(service: &Arc<Service>, options: &TransportOptions) -> Router {
    let http = Arc::new(Http {
        service: Arc::clone(service),
        options: options.clone(),
        openapi: openapi::document().to_string().into(),
    });
    let router = match options.role {
        Role::Node => calls(),
        Role::Worker => Router::new(),
    };
    router
        .route("/healthz", get(async || text(StatusCode::OK, "alive\n")))
        .route("/readyz", get(ready))
        .route("/readyz/steps", get(ready_for_steps))
        .route("/metrics", get(metrics))
        .method_not_allowed_fallback(errors::method_not_allowed)
        .with_state(http)
}

/// Routes of calls.
fn calls() -> Router<Arc<Http>> {
    Router::new()
        .route("/v1/plans:compute", post(compute_plan))
        .route("/v1/plans", get(list_plans).post(upload_plan))
        .route("/v1/plans/{id}", get(kept_plan))
        .route("/v1/precompute", post(precompute))
        .route("/v1/operations", get(list_operations))
        .route("/v1/operations/{id}", any(operation))
        .route("/v1/artifacts", get(list_artifacts))
        .route("/v1/artifacts/{id}", get(get_artifact))
        .route("/v1/step", post(step))
        .route("/v1/safety:report", post(safety_report))
        .route("/v1/info", get(info))
        .route("/openapi.json", get(openapi))
}

async fn compute_plan(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (ask, call) = http.message::<_, v1::ComputePlanRequest>(&parts, body).await?;
        Ok(timed(http.service.plan(ask, &call).await?))
    })
    .await
}

async fn upload_plan(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (ask, call) = http.message::<_, v1::UploadPlanRequest>(&parts, body).await?;
        Ok(timed(http.service.upload(ask, &call).await?))
    })
    .await
}

async fn list_plans(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, _)| {
        let Page { page_size, page_token } = page(&parts)?;
        let message = v1::ListPlansRequest { page_size, page_token };
        let (ask, call) = http.parsed(&parts, &message)?;
        Ok(rendered(&http.service.kept_plans(ask, &call).await?))
    })
    .await
}

/// `GET /v1/plans/{id}` and `GET /v1/plans/{id}:export`.
///
/// The router takes whole segments only, so the verb is told apart here.
async fn kept_plan(State(http): Shared, Path(segment): Path<String>, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, _)| match segment.strip_suffix(":export") {
        None => {
            no_query(&parts)?;
            let (ask, call) = http.parsed(&parts, &v1::GetPlanRequest { plan_id: segment })?;
            Ok(rendered(&http.service.kept_plan(ask, &call).await?))
        }
        Some(id) => {
            let (ask, call) = http.parsed(&parts, &export_request(id, &parts)?)?;
            Ok(document(http.service.export(ask, &call).await?))
        }
    })
    .await
}

async fn precompute(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (ask, call) = http.message::<_, v1::PrecomputeRequest>(&parts, body).await?;
        Ok(rendered(&http.service.precompute(ask, &call).await?))
    })
    .await
}

async fn step(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (ask, call) = http.message::<_, v1::StepRequest>(&parts, body).await?;
        Ok(timed(http.service.step(ask, &call).await?))
    })
    .await
}

async fn safety_report(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (ask, call) = http.message::<_, v1::SafetyReportRequest>(&parts, body).await?;
        Ok(timed(http.service.safety_report(ask, &call).await?))
    })
    .await
}

/// `GET /v1/artifacts/{id}` and `GET /v1/artifacts/{id}:download`.
async fn get_artifact(
    State(http): Shared,
    Path(segment): Path<String>,
    request: Request,
) -> Response {
    http.call(request, async |http: &Http, (parts, _)| {
        no_query(&parts)?;
        match segment.strip_suffix(":download") {
            None => {
                let message = v1::GetArtifactRequest { artifact_id: segment };
                let (ask, call) = http.parsed(&parts, &message)?;
                Ok(rendered(&http.service.artifact(ask, &call).await?))
            }
            Some(id) => {
                let message = v1::GetArtifactRequest { artifact_id: id.to_owned() };
                let (ArtifactCall { id }, call) = http.parsed(&parts, &message)?;
                download::answer(&http.service, id, &parts.headers, &call).await
            }
        }
    })
    .await
}

async fn list_artifacts(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, _)| {
        let Page { page_size, page_token } = page(&parts)?;
        let message = v1::ListArtifactsRequest { page_size, page_token };
        let (ask, call) = http.parsed(&parts, &message)?;
        Ok(rendered(&http.service.artifacts(ask, &call).await?))
    })
    .await
}

async fn info(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, _)| {
        no_query(&parts)?;
        let (ask, _) = http.parsed(&parts, &v1::GetServerInfoRequest {})?;
        Ok(rendered(&http.service.info(ask)))
    })
    .await
}

async fn list_operations(State(http): Shared, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, _)| {
        let message = list_request(&parts)?;
        let (ask, call) = http.parsed(&parts, &message)?;
        Ok(rendered(&http.service.operations(ask, &call).await?))
    })
    .await
}

/// `GET` and `DELETE /v1/operations/{id}`, `POST /v1/operations/{id}:wait` and `:cancel`,
/// `GET /v1/operations/{id}:watch`.
///
/// The router takes whole segments only, so the verb and what it allows are told apart here.
async fn operation(State(http): Shared, Path(segment): Path<String>, request: Request) -> Response {
    http.call(request, async |http: &Http, (parts, body)| {
        let (id, verb) = match segment.rsplit_once(':') {
            Some((id, verb @ ("wait" | "cancel" | "watch"))) => (id, verb),
            _ => (segment.as_str(), ""),
        };
        let by_name = NamedBy::operation(id);
        match (&parts.method, verb) {
            (&Method::GET | &Method::HEAD, "") => {
                no_query(&parts)?;
                let (ask, call) = http.parsed(&parts, &by_name)?;
                Ok(rendered(&http.service.operation(ask, &call).await?))
            }
            (&Method::DELETE, "") => {
                no_query(&parts)?;
                let (ask, call) = http.parsed(&parts, &by_name)?;
                http.service.delete_operation(ask, &call).await?;
                Ok(empty())
            }
            (&Method::POST, "wait") => {
                no_query(&parts)?;
                let message: Option<longrunning::WaitOperationRequest> =
                    http.optional_message(&parts, body).await?;
                let message = longrunning::WaitOperationRequest {
                    name: format!("operations/{id}"),
                    ..message.unwrap_or_default()
                };
                let (ask, call) = http.parsed(&parts, &message)?;
                Ok(rendered(&http.service.wait_operation(ask, &call).await?))
            }
            (&Method::POST, "cancel") => {
                no_query(&parts)?;
                let _: Option<longrunning::CancelOperationRequest> =
                    http.optional_message(&parts, body).await?;
                let (ask, call) = http.parsed(&parts, &by_name)?;
                http.service.cancel_operation(ask, &call).await?;
                Ok(empty())
            }
            (&Method::GET, "watch") => {
                no_query(&parts)?;
                let (ask, call) = http.parsed(&parts, &by_name)?;
                let watching = http.service.watch_operation(ask, call).await?;
                Ok(events::answer(watching, pass(&parts.extensions)?.clone()))
            }
            (_, "") => Err(HttpError::method_not_allowed("GET,HEAD,DELETE")),
            (_, "watch") => Err(HttpError::method_not_allowed("GET")),
            _ => Err(HttpError::method_not_allowed("POST")),
        }
    })
    .await
}

async fn ready(State(http): Shared) -> Response {
    if *http.options.draining.borrow() {
        return shutting_down();
    }
    match http.service.store_fault().await {
        None => text(StatusCode::OK, "ready\n"),
        Some(fault) => text(StatusCode::SERVICE_UNAVAILABLE, format!("{fault}\n")),
    }
}

/// A store that several nodes share is gone for all of them at once. Whoever distributes calls must
/// not take them all out for that: they still answer steps with artifacts that they remember.
async fn ready_for_steps(State(http): Shared) -> Response {
    if *http.options.draining.borrow() {
        return shutting_down();
    }
    text(StatusCode::OK, "ready\n")
}

fn shutting_down() -> Response {
    text(StatusCode::SERVICE_UNAVAILABLE, "shutting down\n")
}

async fn metrics(State(http): Shared) -> Response {
    ([(header::CONTENT_TYPE, OPENMETRICS)], http.service.metrics().text()).into_response()
}

async fn openapi(State(http): Shared) -> Response {
    ([(header::CONTENT_TYPE, JSON)], http.openapi.clone()).into_response()
}

fn text(status: StatusCode, text: impl Into<Body>) -> Response {
    (status, [(header::CONTENT_TYPE, TEXT)], text.into()).into_response()
}

fn empty() -> Response {
    ([(header::CONTENT_TYPE, JSON)], "{}").into_response()
}

fn rendered<A: Render>(answer: &A) -> Response
where
    A::Message: Message + Name,
{
    ([(header::CONTENT_TYPE, JSON)], json::encode(&answer.render())).into_response()
}

fn timed<A: Render>(answer: Timed<A>) -> Response
where
    A::Message: Message + Name,
{
    let mut response = rendered(&answer.value);
    response.headers_mut().insert(SERVER_TIMING, server_timing(answer.compute));
    response
}

impl Http {
    /// Lets `answer` have the request and writes its errors.
    async fn call(
        &self,
        request: Request,
        answer: impl AsyncFnOnce(&Self, (Parts, Body)) -> Result<Response, HttpError>,
    ) -> Response {
        let id = request.extensions().get().cloned().unwrap_or_else(RequestId::fresh);
        match answer(self, request.into_parts()).await {
            Ok(response) => response,
            Err(error) => error.render(&id),
        }
    }

    /// Reads the request's message.
    async fn message<P, M>(&self, parts: &Parts, body: Body) -> Result<(P, Call), HttpError>
    where
        P: Parse<Message = M>,
        M: Message + Name + Default,
    {
        no_query(parts)?;
        is_json(&parts.headers)?;
        let bytes = self.body(&parts.headers, body).await?;
        self.parsed(parts, &json::decode::<M>(&bytes)?)
    }

    /// A message that may be left out; if it is there, it must be one.
    async fn optional_message<M>(&self, parts: &Parts, body: Body) -> Result<Option<M>, HttpError>
    where
        M: Message + Name + Default,
    {
        let bytes = self.body(&parts.headers, body).await?;
        if bytes.is_empty() {
            return Ok(None);
        }
        is_json(&parts.headers)?;
        Ok(Some(json::decode(&bytes)?))
    }

    /// Checks a message and reads what every call brings.
    fn parsed<P: Parse>(
        &self,
        parts: &Parts,
        message: &P::Message,
    ) -> Result<(P, Call), HttpError> {
        let wish = match parts.headers.get(TIMEOUT) {
            None => None,
            Some(value) => {
                let expected = "a whole number of milliseconds above 0, up to 9 digits";
                let wish = value.to_str().ok().and_then(timeout);
                Some(wish.ok_or_else(|| deadline_fault(TIMEOUT, expected, value))?)
            }
        };
        let call = Call {
            caller: pass(&parts.extensions)?.caller().clone(),
            deadline: self.service.deadline(wish),
        };
        Ok((parse(message, &self.service.limits()).map_err(Error::from)?, call))
    }

    /// The whole body, within the limits of size and time.
    async fn body(&self, headers: &HeaderMap, body: Body) -> Result<Bytes, HttpError> {
        let largest = self.options.request_bytes_max;
        let announced = headers
            .get(header::CONTENT_LENGTH)
            .and_then(|value| value.to_str().ok()?.parse::<u64>().ok());
        if announced.is_some_and(|length| length > u64::try_from(largest).unwrap_or(u64::MAX)) {
            return Err(HttpError::too_large(largest));
        }
        let received = Limited::new(body, largest).collect();
        match tokio::time::timeout(self.options.receive_time_max, received).await {
            Ok(Ok(body)) => Ok(body.to_bytes()),
            Ok(Err(fault)) if fault.is::<LengthLimitError>() => Err(HttpError::too_large(largest)),
            Ok(Err(_)) => {
                let message = "the request's body ended early";
                Err(Error::new(Code::InvalidArgument, "BODY_TRUNCATED", message).into())
            }
            Err(_) => Err(HttpError::too_slow(self.options.receive_time_max)),
        }
    }
}

/// The value of `request-timeout-ms`.
fn timeout(text: &str) -> Option<Duration> {
    let is_number = text.len() <= 9 && text.bytes().all(|c| c.is_ascii_digit());
    let milliseconds = is_number.then(|| text.parse().ok()).flatten();
    milliseconds.filter(|&milliseconds| milliseconds > 0).map(Duration::from_millis)
}

/// Reads what is read by hand of the head of a request over HTTP.
#[cfg(feature = "fuzzing")]
pub(super) fn read_head(parts: &Parts) {
    let text = |name: &str| parts.headers.get(name).and_then(|value| value.to_str().ok());
    if let Some(wish) = text(TIMEOUT).and_then(timeout) {
        assert!(!wish.is_zero() && wish.as_millis() < 1_000_000_000, "a deadline of {wish:?}");
    }
    text(header::RANGE.as_str()).map(download::range);
    let json = is_json(&parts.headers);
    assert!(json.is_err() || parts.headers.contains_key(header::CONTENT_TYPE), "no type is JSON");
    assert!(no_query(parts).is_err() || query(parts).is_empty(), "a query was overlooked");
    let _ = (page(parts), list_request(parts), export_request("", parts));
}

/// Only JSON, and only as it is: a compressed body could be a bomb.
fn is_json(headers: &HeaderMap) -> Result<(), HttpError> {
    let given = headers.get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    let essence = given.split(|&c| c == b';').next().unwrap_or_default().trim_ascii();
    if !essence.eq_ignore_ascii_case(b"application/json") {
        let got = String::from_utf8_lossy(given);
        return Err(HttpError::unsupported("content-type", "application/json", &got));
    }
    match headers.get(header::CONTENT_ENCODING) {
        None => Ok(()),
        Some(value) if value.as_bytes().eq_ignore_ascii_case(b"identity") => Ok(()),
        Some(value) => {
            let got = String::from_utf8_lossy(value.as_bytes());
            Err(HttpError::unsupported("content-encoding", "identity", &got))
        }
    }
}

/// Unknown fields are refused, wherever they stand.
fn no_query(parts: &Parts) -> Result<(), HttpError> {
    match parts.uri.query() {
        None | Some("") => Ok(()),
        Some(query) => Err(Error::field("query", "no query parameters", query).into()),
    }
}

/// Names and values of a query; `%xx` and `+` are decoded in values, names have neither.
fn query(parts: &Parts) -> Vec<(&str, String)> {
    let pairs = parts.uri.query().unwrap_or_default().split('&').filter(|pair| !pair.is_empty());
    pairs
        .map(|pair| {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            (name, decoded(value))
        })
        .collect()
}

/// A value of a query as it was meant; what is no `%xx` stays as it is and is refused later.
fn decoded(value: &str) -> String {
    let mut bytes = Vec::with_capacity(value.len());
    let mut rest = value.as_bytes();
    while let Some((&first, after)) = rest.split_first() {
        let digit = |c: &u8| char::from(*c).to_digit(16).and_then(|d| u8::try_from(d).ok());
        let escaped = match (first, after) {
            (b'%', [high, low, ..]) => digit(high).zip(digit(low)).map(|(h, l)| h << 4 | l),
            _ => None,
        };
        rest = if escaped.is_some() { &after[2..] } else { after };
        bytes.push(escaped.unwrap_or(if first == b'+' { b' ' } else { first }));
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn page_size(value: &str) -> Result<i32, HttpError> {
    value.parse().map_err(|_| Error::field("page_size", "an integer, at least 0", value).into())
}

/// Which page of a list.
struct Page {
    page_size: i32,
    page_token: String,
}

/// `?pageSize=…&pageToken=…`, also in snake case.
fn page(parts: &Parts) -> Result<Page, HttpError> {
    let mut page = Page { page_size: 0, page_token: String::new() };
    for (name, value) in query(parts) {
        match name {
            "pageSize" | "page_size" => page.page_size = page_size(&value)?,
            "pageToken" | "page_token" => page.page_token = value,
            _ => return Err(Error::field("query", "pageSize, pageToken", name).into()),
        }
    }
    Ok(page)
}

/// `?pageSize=…&pageToken=…&filter=…`, also in snake case.
fn list_request(parts: &Parts) -> Result<longrunning::ListOperationsRequest, HttpError> {
    let mut message = longrunning::ListOperationsRequest {
        name: "operations".to_owned(),
        ..longrunning::ListOperationsRequest::default()
    };
    for (name, value) in query(parts) {
        match name {
            "pageSize" | "page_size" => message.page_size = page_size(&value)?,
            "pageToken" | "page_token" => message.page_token = value,
            "filter" => message.filter = value,
            _ => {
                let expected = "pageSize, pageToken, filter";
                return Err(Error::field("query", expected, name).into());
            }
        }
    }
    Ok(message)
}

/// `?format=CCSDS_OEM&chaserName=…`, the fields of the message, also in snake case; the format
/// with or without `PLAN_FORMAT_`.
fn export_request(id: &str, parts: &Parts) -> Result<v1::ExportPlanRequest, HttpError> {
    let mut message =
        v1::ExportPlanRequest { plan_id: id.to_owned(), ..v1::ExportPlanRequest::default() };
    for (name, value) in query(parts) {
        match name {
            "format" => message.format = plan_format(&value)?.into(),
            "chaserName" | "chaser_name" => message.chaser_name = value,
            "targetName" | "target_name" => message.target_name = value,
            "chaserDesignator" | "chaser_designator" => message.chaser_designator = value,
            "originator" => message.originator = value,
            "creationDate" | "creation_date" => message.creation_date = value,
            _ => {
                let expected = "format, chaserName, targetName, chaserDesignator, originator, \
                                creationDate";
                return Err(Error::field("query", expected, name).into());
            }
        }
    }
    Ok(message)
}

fn plan_format(value: &str) -> Result<v1::PlanFormat, HttpError> {
    let full = format!("PLAN_FORMAT_{value}");
    v1::PlanFormat::from_str_name(value)
        .or_else(|| v1::PlanFormat::from_str_name(&full))
        .ok_or_else(|| Error::field("format", "CCSDS_OCM, CCSDS_OEM, CSV or BINARY", value).into())
}

/// The document itself, under its own media type.
fn document(made: Timed<Document>) -> Response {
    let Timed { value, compute } = made;
    let mut response =
        ([(header::CONTENT_TYPE, value.content_type)], value.content).into_response();
    let headers = response.headers_mut();
    let name = format!("attachment; filename=\"{}\"", value.file_name);
    if let Ok(name) = HeaderValue::from_str(&name) {
        headers.insert(header::CONTENT_DISPOSITION, name);
    }
    headers.insert(SERVER_TIMING, server_timing(compute));
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn query_values_are_decoded_once() {
        assert_eq!(decoded("A%20B+C%2fD"), "A B C/D");
        assert_eq!(decoded("%2520"), "%20");
        for malformed in ["%", "%2", "%zz"] {
            assert_eq!(decoded(malformed), malformed);
        }
    }
}
