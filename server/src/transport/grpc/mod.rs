//! gRPC: the guidance service, long-running operations, health, reflection.

mod guidance;
mod operations;
mod status;

use std::{sync::Arc, time::Duration};

use axum::Router;
use tokio::sync::watch;
use tonic::{Request, Status, service::Routes};
use vbar_proto::{
    FILE_DESCRIPTOR_SET, google::longrunning::operations_server::OperationsServer,
    v1::guidance_service_server::GuidanceServiceServer,
};

use super::{Role, TransportOptions, deadline_fault, pass};
use crate::{
    service::{Call, Error, Service},
    telemetry::RequestId,
    wire::{Parse, parse},
};

pub(super) use status::{complete, refused, too_slow};

/// Tells those who wait that the node is about to stop.
pub(crate) type Draining = watch::Receiver<bool>;

/// What the gRPC services share.
#[derive(Debug, Clone)]
struct Grpc {
    service: Arc<Service>,
    draining: Draining,
}

/// Every gRPC service.
pub(super) async fn router(service: &Arc<Service>, options: &TransportOptions) -> Router {
    let grpc = Grpc { service: Arc::clone(service), draining: options.draining.clone() };
    let (reporter, health) = tonic_health::server::health_reporter();
    reporter.set_serving::<GuidanceServiceServer<Grpc>>().await;
    let mut draining = options.draining.clone();
    tokio::spawn(async move {
        if draining.wait_for(|draining| *draining).await.is_ok() {
            reporter.set_not_serving::<GuidanceServiceServer<Grpc>>().await;
            reporter.set_service_status("", tonic_health::ServingStatus::NotServing).await;
        }
    });
    let describe = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    if options.role == Role::Worker {
        return Routes::new(health).into_axum_router();
    }
    let largest = options.request_bytes_max;
    Routes::new(GuidanceServiceServer::new(grpc.clone()).max_decoding_message_size(largest))
        .add_service(OperationsServer::new(grpc).max_decoding_message_size(largest))
        .add_service(health)
        .add_service(describe().build_v1().expect("the build script made these descriptors"))
        .add_service(describe().build_v1alpha().expect("the build script made these descriptors"))
        .into_axum_router()
}

impl Grpc {
    /// Reads what every call brings, parses its message, lets `answer` have it, and writes errors.
    async fn call<P: Parse, A>(
        &self,
        request: Request<P::Message>,
        answer: impl AsyncFnOnce(&Service, P, Call) -> Result<A, Error>,
    ) -> Result<A, Status> {
        let id = request_id(&request);
        let answer = async {
            let call = self.head(&request)?;
            let parsed = parse::<P>(request.get_ref(), &self.service.limits())?;
            answer(&self.service, parsed, call).await
        };
        answer.await.map_err(|error| status::render(error, &id))
    }

    /// Who asks, and the call's deadline.
    fn head<T>(&self, request: &Request<T>) -> Result<Call, Error> {
        let wish = match request.metadata().get("grpc-timeout") {
            None => None,
            Some(value) => {
                let timeout = value.to_str().ok().and_then(timeout);
                let expected = "up to 8 digits and one of H, M, S, m, u, n";
                let fault = || {
                    let got = ::http::HeaderValue::from_bytes(value.as_bytes());
                    let empty = ::http::HeaderValue::from_static("");
                    deadline_fault("grpc-timeout", expected, &got.unwrap_or(empty))
                };
                Some(timeout.ok_or_else(fault)?)
            }
        };
        let caller = pass(request.extensions())?.caller().clone();
        Ok(Call { caller, deadline: self.service.deadline(wish) })
    }
}

fn request_id<T>(request: &Request<T>) -> RequestId {
    request.extensions().get().cloned().unwrap_or_else(RequestId::fresh)
}

/// The value of `grpc-timeout`.
pub(super) fn timeout(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|c| c.is_ascii_digit()) {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(count * 3600)),
        "M" => Some(Duration::from_secs(count * 60)),
        "S" => Some(Duration::from_secs(count)),
        "m" => Some(Duration::from_millis(count)),
        "u" => Some(Duration::from_micros(count)),
        "n" => Some(Duration::from_nanos(count)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grpc_timeout_reads_every_unit_and_nothing_else() {
        assert_eq!(timeout("2H"), Some(Duration::from_secs(7200)));
        assert_eq!(timeout("3M"), Some(Duration::from_secs(180)));
        assert_eq!(timeout("99999999S"), Some(Duration::from_secs(99_999_999)));
        assert_eq!(timeout("15m"), Some(Duration::from_millis(15)));
        assert_eq!(timeout("7u"), Some(Duration::from_micros(7)));
        assert_eq!(timeout("0n"), Some(Duration::ZERO));
        for bad in ["", "S", "1", "1 S", "-1S", "1x", "123456789S", "1é"] {
            assert_eq!(timeout(bad), None, "{bad:?}");
        }
    }
}
