//! `google.longrunning.Operations`.

use tonic::{Request, Response, Status, async_trait};
use vbar_proto::google::longrunning::{
    CancelOperationRequest, DeleteOperationRequest, GetOperationRequest, ListOperationsRequest,
    ListOperationsResponse, Operation, WaitOperationRequest, operations_server::Operations,
};

use super::Grpc;
use crate::{
    service::Service,
    wire::{NamedBy, Render as _},
};

/// The same request, of which only the name matters.
fn named<M>(request: Request<M>) -> Request<NamedBy>
where
    for<'a> NamedBy: From<&'a M>,
{
    request.map(|message| NamedBy::from(&message))
}

#[async_trait]
impl Operations for Grpc {
    async fn list_operations(
        &self,
        request: Request<ListOperationsRequest>,
    ) -> Result<Response<ListOperationsResponse>, Status> {
        self.call(request, async |service: &Service, ask, call| {
            service.operations(ask, &call).await
        })
        .await
        .map(|answer| Response::new(answer.render()))
    }

    async fn get_operation(
        &self,
        request: Request<GetOperationRequest>,
    ) -> Result<Response<Operation>, Status> {
        let request = named(request);
        self.call(request, async |service: &Service, ask, call| service.operation(ask, &call).await)
            .await
            .map(|answer| Response::new(answer.render()))
    }

    async fn delete_operation(
        &self,
        request: Request<DeleteOperationRequest>,
    ) -> Result<Response<()>, Status> {
        self.call(named(request), async |service: &Service, ask, call| {
            service.delete_operation(ask, &call).await
        })
        .await
        .map(Response::new)
    }

    async fn cancel_operation(
        &self,
        request: Request<CancelOperationRequest>,
    ) -> Result<Response<()>, Status> {
        self.call(named(request), async |service: &Service, ask, call| {
            service.cancel_operation(ask, &call).await
        })
        .await
        .map(Response::new)
    }

    async fn wait_operation(
        &self,
        request: Request<WaitOperationRequest>,
    ) -> Result<Response<Operation>, Status> {
        self.call(request, async |service: &Service, ask, call| {
            service.wait_operation(ask, &call).await
        })
        .await
        .map(|answer| Response::new(answer.render()))
    }
}
