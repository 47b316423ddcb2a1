//! The serving end: our traits behind the generated service, with the token checked before anything is looked at.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::net::TcpListener;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status as Wire};

use crate::client::program;
use crate::types::*;
use crate::v1::coordinator_server::{Coordinator, CoordinatorServer};
use crate::{PROTOCOL_MAX, PROTOCOL_MIN, ProtoError, Token, convert, limits, v1};

/// Why a call was not served.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// What was asked for doesn't exist.
    NotFound(String),
    /// The call's content is no good.
    Invalid(String),
    /// The coordinator is going away.
    Closing,
}

impl From<Refusal> for Wire {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::NotFound(text) => Wire::not_found(text),
            Refusal::Invalid(text) => Wire::invalid_argument(text),
            Refusal::Closing => Wire::unavailable("the coordinator is going away"),
        }
    }
}

/// What workers call.
pub trait WorkerCalls: Send + Sync + 'static {
    /// A worker announces itself.
    fn register(
        &self,
        registration: Registration,
    ) -> impl Future<Output = Result<Registered, Refusal>> + Send;
    /// A worker asks what a run is.
    fn describe_run(&self, run: RunId) -> impl Future<Output = Result<Bytes, Refusal>> + Send;
    /// A worker waits for a task.
    fn next_task(
        &self,
        worker: WorkerId,
        held: Vec<LeaseId>,
    ) -> impl Future<Output = Result<NextTask, Refusal>> + Send;
    /// A worker lives.
    fn heartbeat(
        &self,
        worker: WorkerId,
        held: Vec<LeaseId>,
        resident_bytes: u64,
    ) -> impl Future<Output = Result<HeartbeatAnswer, Refusal>> + Send;
    /// The artefact of a lease is in the store.
    fn complete(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        cost: TaskCost,
        report: Bytes,
    ) -> impl Future<Output = Result<bool, Refusal>> + Send;
    /// The task of a lease could not be done.
    fn fail(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        failure: Failure,
        cost: TaskCost,
    ) -> impl Future<Output = Result<bool, Refusal>> + Send;
}

/// What people's programs call.
pub trait ClientCalls: Send + Sync + 'static {
    /// Starts a run.
    fn submit(&self, description: Bytes) -> impl Future<Output = Result<RunId, Refusal>> + Send;
    /// How everything stands.
    fn status(&self) -> impl Future<Output = Result<Status, Refusal>> + Send;
    /// Ends a run.
    fn cancel(&self, run: RunId) -> impl Future<Output = Result<bool, Refusal>> + Send;
    /// Lines of the log from a number on.
    fn logs(&self, from: u64) -> impl Future<Output = Result<LogPage, Refusal>> + Send;
}

/// How to serve.
#[derive(Clone, Debug, Default)]
pub struct ServeOptions {
    /// The token that every call must carry; `None` lets everybody in.
    pub token: Option<Token>,
}

/// Serves `service` on a bound listener until `shutdown` resolves and the calls in flight are answered.
///
/// # Errors
/// When the listener fails.
pub async fn serve<S: WorkerCalls + ClientCalls>(
    listener: TcpListener,
    service: Arc<S>,
    options: ServeOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ProtoError> {
    let inner = CoordinatorServer::new(Adapter(service))
        .max_decoding_message_size(limits::MESSAGE_BYTES)
        .max_encoding_message_size(limits::MESSAGE_BYTES);
    let token = options.token;
    let guarded = tonic::service::interceptor::InterceptedService::new(inner, move |request| {
        admit(token.as_ref(), request)
    });
    // On the listener: the builder's own setting does not reach a listener that was bound elsewhere, and every answer would wait
    // 40 ms for an acknowledgement.
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    tonic::transport::Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .add_service(guarded)
        .serve_with_incoming_shutdown(incoming, shutdown)
        .await
        .map_err(|error| ProtoError::unreachable(format!("the coordinator's listener failed: {error}")))
}

pub(crate) fn admit(token: Option<&Token>, request: Request<()>) -> Result<Request<()>, Wire> {
    let Some(token) = token else { return Ok(request) };
    let given = request.metadata().get("authorization").map(|value| value.as_bytes());
    match given.and_then(|value| value.strip_prefix(b"Bearer ")) {
        Some(secret) if token.admits(secret) => Ok(request),
        Some(_) => Err(Wire::unauthenticated("the coordinator doesn't know this token")),
        None => Err(Wire::unauthenticated("the coordinator wants a token: set TERRANE_TOKEN")),
    }
}

struct Adapter<S>(Arc<S>);

fn invalid(error: ProtoError) -> Wire {
    Wire::invalid_argument(error.to_string())
}

#[tonic::async_trait]
impl<S: WorkerCalls + ClientCalls> Coordinator for Adapter<S> {
    async fn handshake(
        &self,
        request: Request<v1::HandshakeRequest>,
    ) -> Result<Response<v1::HandshakeReply>, Wire> {
        let asked = request.into_inner();
        let protocol = asked.protocol_max.min(PROTOCOL_MAX);
        if protocol < asked.protocol_min.max(PROTOCOL_MIN) {
            return Err(Wire::failed_precondition(format!(
                "protocol versions {} to {} asked for, {PROTOCOL_MIN} to {PROTOCOL_MAX} spoken here: use the same terrane on both sides",
                asked.protocol_min, asked.protocol_max
            )));
        }
        Ok(Response::new(v1::HandshakeReply { protocol, program: program() }))
    }

    async fn register(
        &self,
        request: Request<v1::RegisterRequest>,
    ) -> Result<Response<v1::RegisterReply>, Wire> {
        let registration = request.into_inner().try_into().map_err(invalid)?;
        let registered = self.0.register(registration).await?;
        Ok(Response::new(v1::RegisterReply {
            worker: registered.worker.0,
            heartbeat_ms: registered.heartbeat_ms,
        }))
    }

    async fn describe_run(
        &self,
        request: Request<v1::DescribeRunRequest>,
    ) -> Result<Response<v1::DescribeRunReply>, Wire> {
        let description = self.0.describe_run(RunId(request.into_inner().run)).await?;
        Ok(Response::new(v1::DescribeRunReply { description }))
    }

    async fn next_task(
        &self,
        request: Request<v1::NextTaskRequest>,
    ) -> Result<Response<v1::NextTaskReply>, Wire> {
        let asked = request.into_inner();
        let held = convert::leases("held", asked.held).map_err(invalid)?;
        Ok(Response::new(self.0.next_task(WorkerId(asked.worker), held).await?.into()))
    }

    async fn heartbeat(
        &self,
        request: Request<v1::HeartbeatRequest>,
    ) -> Result<Response<v1::HeartbeatReply>, Wire> {
        let said = request.into_inner();
        let held = convert::leases("held", said.held).map_err(invalid)?;
        let HeartbeatAnswer { known, revoked } =
            self.0.heartbeat(WorkerId(said.worker), held, said.resident_bytes).await?;
        Ok(Response::new(v1::HeartbeatReply {
            known,
            revoked: revoked.iter().map(|lease| lease.0).collect(),
        }))
    }

    async fn complete(
        &self,
        request: Request<v1::CompleteRequest>,
    ) -> Result<Response<v1::CompleteReply>, Wire> {
        let said = request.into_inner();
        let cost = convert::cost(said.cost).map_err(invalid)?;
        let report = convert::report(said.report).map_err(invalid)?;
        let accepted = self.0.complete(WorkerId(said.worker), LeaseId(said.lease), cost, report).await?;
        Ok(Response::new(v1::CompleteReply { accepted }))
    }

    async fn fail(&self, request: Request<v1::FailRequest>) -> Result<Response<v1::FailReply>, Wire> {
        let said = request.into_inner();
        let cost = convert::cost(said.cost).map_err(invalid)?;
        let failure = convert::failure(said.kind, said.reason, said.detail).map_err(invalid)?;
        let accepted = self.0.fail(WorkerId(said.worker), LeaseId(said.lease), failure, cost).await?;
        Ok(Response::new(v1::FailReply { accepted }))
    }

    async fn submit(&self, request: Request<v1::SubmitRequest>) -> Result<Response<v1::SubmitReply>, Wire> {
        let description = convert::description(request.into_inner().description).map_err(invalid)?;
        let run = self.0.submit(description).await?;
        Ok(Response::new(v1::SubmitReply { run: run.0 }))
    }

    async fn status(&self, _: Request<v1::StatusRequest>) -> Result<Response<v1::StatusReply>, Wire> {
        Ok(Response::new(self.0.status().await?.into()))
    }

    async fn cancel(&self, request: Request<v1::CancelRequest>) -> Result<Response<v1::CancelReply>, Wire> {
        let cancelled = self.0.cancel(RunId(request.into_inner().run)).await?;
        Ok(Response::new(v1::CancelReply { cancelled }))
    }

    async fn logs(&self, request: Request<v1::LogsRequest>) -> Result<Response<v1::LogsReply>, Wire> {
        Ok(Response::new(self.0.logs(request.into_inner().from).await?.into()))
    }
}
