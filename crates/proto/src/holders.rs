//! The connection between the holders of an adjustment's parts and the process that solves it: whole messages both ways.

use std::future::Future;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures::Stream;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status as Wire, Streaming};

use crate::client::{Endpoint, connect};
use crate::server::admit;
use crate::v1::adjuster_client::AdjusterClient;
use crate::v1::adjuster_server::{Adjuster, AdjusterServer};
use crate::{ProtoError, Token, limits, v1};

/// Messages that wait on either side of a link.
const WAITING: usize = 4;

/// One end of a connection that carries whole messages.
pub struct Link {
    sender: LinkSender,
    receiver: LinkReceiver,
}

/// The sending half of a link.
#[derive(Clone)]
pub struct LinkSender(mpsc::Sender<Bytes>);

/// The receiving half of a link.
pub struct LinkReceiver(mpsc::Receiver<Bytes>);

impl Link {
    /// The two halves.
    pub fn split(self) -> (LinkSender, LinkReceiver) {
        (self.sender, self.receiver)
    }
}

impl LinkSender {
    /// Sends a message; false when the link is closed.
    pub async fn send(&self, message: Bytes) -> bool {
        self.0.send(message).await.is_ok()
    }

    /// The same, on a thread that may block.
    pub fn blocking_send(&self, message: Bytes) -> bool {
        self.0.blocking_send(message).is_ok()
    }
}

impl LinkReceiver {
    /// The next message, or `None` when the link is closed.
    pub async fn receive(&mut self) -> Option<Bytes> {
        self.0.recv().await
    }
}

/// Serves holders on a bound listener until `shutdown` resolves; every one that joins is handed to `joined`.
///
/// # Errors
/// When the listener fails.
pub async fn serve_holders(
    listener: TcpListener,
    token: Option<Token>,
    joined: mpsc::Sender<Link>,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ProtoError> {
    let inner = AdjusterServer::new(Door(joined))
        .max_decoding_message_size(limits::MESSAGE_BYTES)
        .max_encoding_message_size(limits::MESSAGE_BYTES);
    let guarded = tonic::service::interceptor::InterceptedService::new(inner, move |request| {
        admit(token.as_ref(), request)
    });
    tonic::transport::Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .initial_stream_window_size(Some(WINDOW_BYTES))
        .initial_connection_window_size(Some(WINDOW_BYTES))
        .add_service(guarded)
        .serve_with_incoming_shutdown(TcpIncoming::from(listener).with_nodelay(Some(true)), shutdown)
        .await
        .map_err(|error| ProtoError::unreachable(format!("the solver's listener failed: {error}")))
}

/// Bytes in flight before the receiver must say that it keeps up; vectors of cameras are megabytes.
const WINDOW_BYTES: u32 = 8 << 20;

/// Joins as a holder.
///
/// # Errors
/// Unreachable when nobody answers, refused with a wrong token, invalid input for a bad URL.
pub async fn hold(endpoint: &Endpoint) -> Result<Link, ProtoError> {
    let (channel, token) = connect(endpoint, None).await?;
    let mut client = AdjusterClient::with_interceptor(channel, token)
        .max_decoding_message_size(limits::MESSAGE_BYTES)
        .max_encoding_message_size(limits::MESSAGE_BYTES);
    let (sender, outgoing) = mpsc::channel(WAITING);
    let frames = futures::StreamExt::filter_map(frames(outgoing), |frame| std::future::ready(frame.ok()));
    let answer = client.hold(frames).await.map_err(|status| ProtoError::from_status(&status))?;
    let receiver = assemble(answer.into_inner());
    Ok(Link { sender: LinkSender(sender), receiver })
}

struct Door(mpsc::Sender<Link>);

#[tonic::async_trait]
impl Adjuster for Door {
    type HoldStream = std::pin::Pin<Box<dyn Stream<Item = Result<v1::Frame, Wire>> + Send>>;

    async fn hold(&self, request: Request<Streaming<v1::Frame>>) -> Result<Response<Self::HoldStream>, Wire> {
        let receiver = assemble(request.into_inner());
        let (sender, outgoing) = mpsc::channel(WAITING);
        let link = Link { sender: LinkSender(sender), receiver };
        let gone = || Wire::unavailable("the adjustment has ended");
        self.0.send(link).await.map_err(|_| gone())?;
        Ok(Response::new(Box::pin(frames(outgoing))))
    }
}

/// Messages cut into frames.
fn frames(messages: mpsc::Receiver<Bytes>) -> impl Stream<Item = Result<v1::Frame, Wire>> + Send + 'static {
    futures::stream::unfold((messages, Bytes::new(), true), |(mut messages, mut rest, mut last)| async move {
        if last {
            rest = messages.recv().await?;
        }
        let data = rest.split_to(rest.len().min(limits::FRAME_BYTES));
        last = rest.is_empty();
        Some((Ok(v1::Frame { data, last }), (messages, rest, last)))
    })
}

/// Frames put together again, by a task of its own; the channel closes with the stream, or when a message is too large.
fn assemble(mut stream: Streaming<v1::Frame>) -> LinkReceiver {
    let (sender, receiver) = mpsc::channel(WAITING);
    tokio::spawn(async move {
        let mut message = BytesMut::new();
        while let Ok(Some(frame)) = stream.message().await {
            if message.len() + frame.data.len() > limits::HOLDER_MESSAGE_BYTES {
                return;
            }
            if frame.last && message.is_empty() {
                if sender.send(frame.data).await.is_err() {
                    return;
                }
                continue;
            }
            message.extend_from_slice(&frame.data);
            if frame.last && sender.send(message.split().freeze()).await.is_err() {
                return;
            }
        }
    });
    LinkReceiver(receiver)
}
