//! gRPC itself: services, reflection, health, unknown fields.

use ::http::uri::PathAndQuery;
use bytes::Bytes;
use prost::Message as _;
use prost_types::FileDescriptorProto;
use tokio_stream::StreamExt as _;
use tonic::{Code, client::Grpc};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use tonic_prost::ProstCodec;
use tonic_reflection::pb;
use tonic_types::StatusExt as _;
use vbar_proto::v1;

use crate::support::{Server, server};

/// The services and one file that a version of the reflection service knows.
macro_rules! reflected {
    ($server:expr, $version:ident) => {{
        use pb::$version::{
            ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
            server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
        };
        let ask = |message_request| ServerReflectionRequest {
            host: String::new(),
            message_request: Some(message_request),
        };
        let questions = tokio_stream::iter([
            ask(MessageRequest::ListServices(String::new())),
            ask(MessageRequest::FileContainingSymbol("vbar.v1.StepRequest".to_owned())),
        ]);
        let mut client = ServerReflectionClient::new($server.channel().await);
        let mut answers = client.server_reflection_info(questions).await.unwrap().into_inner();
        let mut next = async || answers.next().await.unwrap().unwrap().message_response.unwrap();
        let MessageResponse::ListServicesResponse(services) = next().await else { panic!() };
        let MessageResponse::FileDescriptorResponse(files) = next().await else { panic!() };
        let services: Vec<String> = services.service.into_iter().map(|s| s.name).collect();
        (services, files.file_descriptor_proto)
    }};
}

fn check_reflection((mut services, files): (Vec<String>, Vec<Vec<u8>>), version: &str) {
    services.sort();
    for service in
        ["google.longrunning.Operations", "grpc.health.v1.Health", "vbar.v1.GuidanceService"]
    {
        assert!(services.iter().any(|s| s == service), "{version}: {services:?}");
    }
    let file = FileDescriptorProto::decode(files[0].as_slice()).unwrap();
    assert_eq!(file.name(), "vbar/v1/service.proto", "{version}");
}

#[tokio::test(flavor = "multi_thread")]
async fn grpc_reflection_knows_the_services_in_both_versions() {
    let server = server().await;
    check_reflection(reflected!(server, v1), "v1");
    check_reflection(reflected!(server, v1alpha), "v1alpha");
}

#[tokio::test(flavor = "multi_thread")]
async fn grpc_health_serves_until_shutdown() {
    let Server { node, address } = server().await;
    let channel = tonic::transport::Channel::from_shared(format!("http://{address}")).unwrap();
    let mut client = HealthClient::new(channel.connect().await.unwrap());
    let ask = |service: &str| HealthCheckRequest { service: service.to_owned() };
    for service in ["", "vbar.v1.GuidanceService"] {
        let answer = client.check(ask(service)).await.unwrap().into_inner();
        assert_eq!(answer.status(), ServingStatus::Serving, "{service:?}");
    }
    let unknown = client.check(ask("vbar.v1.Nothing")).await.unwrap_err();
    assert_eq!(unknown.code(), Code::NotFound);
    // A watcher is told before the port closes.
    let watched = client.watch(ask("vbar.v1.GuidanceService")).await.unwrap();
    let mut watched = watched.into_inner();
    assert_eq!(watched.next().await.unwrap().unwrap().status(), ServingStatus::Serving);
    let stopping = tokio::spawn(node.shutdown());
    assert_eq!(watched.next().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    drop(watched);
    stopping.await.unwrap();
}

/// Calls `path` with bytes as they are.
pub(crate) async fn raw_call(server: &Server, path: &'static str, body: &[u8]) -> tonic::Status {
    /// Any message: what it decodes does not matter.
    #[derive(Clone, PartialEq, prost::Message)]
    struct Raw {}
    #[derive(Debug)]
    struct Verbatim(Bytes);
    impl prost::Message for Verbatim {
        fn encode_raw(&self, buffer: &mut impl bytes::BufMut) {
            buffer.put_slice(&self.0);
        }
        fn merge_field(
            &mut self,
            _: u32,
            _: prost::encoding::WireType,
            _: &mut impl bytes::Buf,
            _: prost::encoding::DecodeContext,
        ) -> Result<(), prost::DecodeError> {
            Ok(())
        }
        fn encoded_len(&self) -> usize {
            self.0.len()
        }
        fn clear(&mut self) {}
    }
    let mut client = Grpc::new(server.channel().await);
    client.ready().await.unwrap();
    let request = tonic::Request::new(Verbatim(Bytes::copy_from_slice(body)));
    let codec = ProstCodec::<Verbatim, Raw>::default();
    let path = PathAndQuery::from_static(path);
    client.unary(request, path, codec).await.expect_err("it is malformed")
}

#[tokio::test(flavor = "multi_thread")]
async fn grpc_unknown_field_and_garbage_are_refused() {
    let server = server().await;
    const STEP: &str = "/vbar.v1.GuidanceService/Step";
    // Field 77, varint 1.
    let unknown = raw_call(&server, STEP, &[0xe8, 0x04, 0x01]).await;
    assert_eq!(unknown.code(), Code::InvalidArgument);
    assert!(unknown.message().contains("77"), "{unknown}");
    let details = unknown.get_error_details();
    assert_eq!(details.error_info().unwrap().reason, "MALFORMED_MESSAGE");
    assert_eq!(details.request_info().unwrap().request_id.len(), 32);
    let garbage = raw_call(&server, STEP, &[0x0a, 0xff, 0xff]).await;
    assert_eq!(garbage.code(), Code::InvalidArgument, "{garbage}");
    let nowhere = raw_call(&server, "/vbar.v1.GuidanceService/Teleport", &[]).await;
    assert_eq!(nowhere.code(), Code::Unimplemented);
    let nobody = raw_call(&server, "/vbar.v9.Nobody/Step", &[]).await;
    assert_eq!(nobody.code(), Code::Unimplemented);
    for status in [nowhere, nobody] {
        assert_eq!(status.get_error_details().error_info().unwrap().reason, "METHOD_UNKNOWN");
    }
    let metric = r#"vbar_requests_total{method="Step",transport="grpc",code="INVALID_ARGUMENT"}"#;
    assert_eq!(server.metric(metric).await, 2.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn grpc_errors_carry_reason_and_request_id() {
    let server = server().await;
    let status = server.grpc().await.step(v1::StepRequest::default()).await.unwrap_err();
    let details = status.get_error_details();
    assert_eq!(details.error_info().unwrap().reason, "INVALID_REQUEST");
    assert_eq!(details.error_info().unwrap().domain, "vbar");
    assert_eq!(details.request_info().unwrap().request_id, "test-request");
    assert_eq!(status.metadata().get("x-request-id").unwrap(), "test-request");
    let fields: Vec<_> =
        details.bad_request().unwrap().field_violations.iter().map(|v| &v.field).collect();
    assert_eq!(fields, ["controller", "measurement"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn grpc_info_shows_limits_and_methods() {
    let server = server().await;
    let info = server.grpc().await.get_server_info(v1::GetServerInfoRequest {}).await.unwrap();
    let info = info.into_inner();
    assert_eq!(info.methods[0].name, "variable_horizon");
    let limits = info.limits.unwrap();
    assert_eq!(limits.request_bytes_max, 4 << 20);
    assert!(limits.concurrent_computations_max >= 1);
}
