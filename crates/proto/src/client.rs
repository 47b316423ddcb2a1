//! The calling end of a connection.

use std::time::Duration;

use bytes::Bytes;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;
use tonic::{Request, Status as Refused};

use crate::types::*;
use crate::v1::coordinator_client::CoordinatorClient;
use crate::{PROTOCOL_MAX, PROTOCOL_MIN, ProtoError, Token, convert, limits, v1};

/// Where a coordinator is and what lets us in.
#[derive(Clone, Debug)]
pub struct Endpoint {
    /// `http://HOST:PORT`.
    pub url: String,
    /// The coordinator's token, when it wants one.
    pub token: Option<Token>,
    /// Longest time to connect.
    pub connect_timeout: Duration,
    /// Longest time of one call; longer than the coordinator's longest wait before it answers "nothing yet".
    pub call_timeout: Duration,
}

impl Endpoint {
    /// An endpoint with the usual time limits: five seconds to connect, one minute for a call.
    pub fn new(url: impl Into<String>, token: Option<Token>) -> Self {
        Self {
            url: url.into(),
            token,
            connect_timeout: Duration::from_secs(5),
            call_timeout: Duration::from_secs(60),
        }
    }
}

/// Adds the token to every call.
#[derive(Clone)]
pub(crate) struct AddToken(Option<MetadataValue<Ascii>>);

impl tonic::service::Interceptor for AddToken {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Refused> {
        if let Some(value) = &self.0 {
            request.metadata_mut().insert("authorization", value.clone());
        }
        Ok(request)
    }
}

/// A channel to an endpoint, and what lets us in. Without `call_timeout` a call may last for ever.
pub(crate) async fn connect(
    endpoint: &Endpoint,
    call_timeout: Option<Duration>,
) -> Result<(Channel, AddToken), ProtoError> {
    let bad = |error: tonic::transport::Error| {
        ProtoError::invalid(&endpoint.url, format_args!("{error}; give the coordinator as http://HOST:PORT"))
    };
    if !endpoint.url.starts_with("http://") {
        return Err(ProtoError::invalid(&endpoint.url, "give the coordinator as http://HOST:PORT"));
    }
    let mut builder = Channel::from_shared(endpoint.url.clone())
        .map_err(|error| {
            ProtoError::invalid(
                &endpoint.url,
                format_args!("{error}; give the coordinator as http://HOST:PORT"),
            )
        })?
        .user_agent(program())
        .map_err(bad)?
        .connect_timeout(endpoint.connect_timeout)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(10))
        .keep_alive_timeout(Duration::from_secs(20));
    if let Some(timeout) = call_timeout {
        builder = builder.timeout(timeout);
    }
    let channel = builder.connect().await.map_err(|error| {
        ProtoError::unreachable(format!("no coordinator answers at {}: {}", endpoint.url, root(&error)))
    })?;
    let token = match &endpoint.token {
        Some(token) => {
            let mut value = MetadataValue::try_from(format!("Bearer {}", token.secret()))
                .map_err(|_| ProtoError::invalid("token", "holds characters that can't travel"))?;
            value.set_sensitive(true);
            Some(value)
        }
        None => None,
    };
    Ok((channel, AddToken(token)))
}

/// A connection to a coordinator, shared by its clones; reconnects by itself when it was lost.
#[derive(Clone)]
pub struct Client {
    inner: CoordinatorClient<InterceptedService<Channel, AddToken>>,
}

impl Client {
    /// Connects and agrees on a protocol version.
    ///
    /// # Errors
    /// Unreachable when nobody answers, a version mismatch when there is none in common, invalid input for a bad URL.
    pub async fn connect(endpoint: &Endpoint) -> Result<Self, ProtoError> {
        let (channel, token) = connect(endpoint, Some(endpoint.call_timeout)).await?;
        let inner = CoordinatorClient::with_interceptor(channel, token)
            .max_decoding_message_size(limits::MESSAGE_BYTES)
            .max_encoding_message_size(limits::MESSAGE_BYTES);
        let client = Self { inner };
        client.handshake().await?;
        Ok(client)
    }

    async fn handshake(&self) -> Result<(), ProtoError> {
        let request = v1::HandshakeRequest {
            protocol_min: PROTOCOL_MIN,
            protocol_max: PROTOCOL_MAX,
            program: program(),
        };
        let reply = answer(self.inner.clone().handshake(request).await)?;
        if !(PROTOCOL_MIN..=PROTOCOL_MAX).contains(&reply.protocol) {
            return Err(ProtoError::invalid(
                "protocol",
                format_args!("the coordinator chose {}, which was not offered", reply.protocol),
            ));
        }
        Ok(())
    }

    /// Announces a worker.
    pub async fn register(&self, registration: Registration) -> Result<Registered, ProtoError> {
        answer(self.inner.clone().register(v1::RegisterRequest::from(registration)).await)?.try_into()
    }

    /// The description of a run.
    pub async fn describe_run(&self, run: RunId) -> Result<Bytes, ProtoError> {
        let reply = answer(self.inner.clone().describe_run(v1::DescribeRunRequest { run: run.0 }).await)?;
        convert::description(reply.description)
    }

    /// Waits for a task for a while.
    pub async fn next_task(&self, worker: WorkerId, held: &[LeaseId]) -> Result<NextTask, ProtoError> {
        let request =
            v1::NextTaskRequest { worker: worker.0, held: held.iter().map(|lease| lease.0).collect() };
        answer(self.inner.clone().next_task(request).await)?.try_into()
    }

    /// Says that a worker lives, and learns what it should stop.
    pub async fn heartbeat(
        &self,
        worker: WorkerId,
        held: &[LeaseId],
        resident_bytes: u64,
    ) -> Result<HeartbeatAnswer, ProtoError> {
        let held = held.iter().map(|lease| lease.0).collect();
        answer(
            self.inner
                .clone()
                .heartbeat(v1::HeartbeatRequest { worker: worker.0, held, resident_bytes })
                .await,
        )?
        .try_into()
    }

    /// Says that the artefact of a lease is in the store; false when the answer came too late to count.
    pub async fn complete(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        cost: TaskCost,
        report: Bytes,
    ) -> Result<bool, ProtoError> {
        let request =
            v1::CompleteRequest { worker: worker.0, lease: lease.0, cost: Some(cost.into()), report };
        Ok(answer(self.inner.clone().complete(request).await)?.accepted)
    }

    /// Says that a task could not be done; false when the answer came too late to count.
    pub async fn fail(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        failure: Failure,
        cost: TaskCost,
    ) -> Result<bool, ProtoError> {
        let request = v1::FailRequest {
            worker: worker.0,
            lease: lease.0,
            kind: convert::failure_kind(failure.kind),
            reason: convert::clip(failure.reason, limits::TEXT_BYTES),
            cost: Some(cost.into()),
            detail: failure.detail,
        };
        Ok(answer(self.inner.clone().fail(request).await)?.accepted)
    }

    /// Starts a run.
    pub async fn submit(&self, description: Bytes) -> Result<RunId, ProtoError> {
        let description = convert::description(description)?;
        Ok(RunId(answer(self.inner.clone().submit(v1::SubmitRequest { description }).await)?.run))
    }

    /// How everything stands.
    pub async fn status(&self) -> Result<Status, ProtoError> {
        answer(self.inner.clone().status(v1::StatusRequest {}).await)?.try_into()
    }

    /// Ends a run; false when it had ended before.
    pub async fn cancel(&self, run: RunId) -> Result<bool, ProtoError> {
        Ok(answer(self.inner.clone().cancel(v1::CancelRequest { run: run.0 }).await)?.cancelled)
    }

    /// Lines of the coordinator's log from a number on.
    pub async fn logs(&self, from: u64) -> Result<LogPage, ProtoError> {
        answer(self.inner.clone().logs(v1::LogsRequest { from }).await)?.try_into()
    }
}

fn answer<T>(reply: Result<tonic::Response<T>, Refused>) -> Result<T, ProtoError> {
    reply.map(tonic::Response::into_inner).map_err(|status| ProtoError::from_status(&status))
}

/// Name and version of this build, for the other side's log.
pub(crate) fn program() -> String {
    format!("terrane/{}", env!("CARGO_PKG_VERSION"))
}

/// The innermost cause, which says what went wrong; the outer ones only say where.
fn root(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause.to_string()
}
