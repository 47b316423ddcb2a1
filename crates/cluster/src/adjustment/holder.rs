//! A process that holds parts of an adjustment and answers for them.

use std::sync::Arc;

use bytes::Bytes;
use terrane_pipeline::adjustment::{FromHolder, FromSolver, PartRequest, PartStore, PartWorker};
use terrane_proto::{Endpoint, LinkReceiver, LinkSender};

use crate::ClusterError;
use crate::error::with_causes;

/// How a holder works.
#[derive(Clone)]
pub struct HolderOptions {
    /// Where the solver is.
    pub endpoint: Endpoint,
    /// A name for the log.
    pub name: String,
    /// Memory that the process may use, in bytes.
    pub memory_bytes: u64,
    /// Where the parts lie.
    pub store: Arc<dyn PartStore>,
}

/// Parts that are answered for together: what they say must fit beside the parts.
const PARTS_AT_ONCE: usize = 64;

/// Holds parts until the solver closes the link. Computes on a thread of its own.
///
/// # Errors
/// When the solver can't be reached or refuses, or a part can't be read or written.
pub async fn hold(options: HolderOptions) -> Result<(), ClusterError> {
    let (sender, mut receiver) = terrane_proto::hold(&options.endpoint).await?.split();
    let joined = encode(&FromHolder::Joined { name: options.name.clone() })?;
    if !sender.send(joined).await {
        return Ok(());
    }
    let (questions, inbox) = std::sync::mpsc::sync_channel(2);
    let computing =
        tokio::task::spawn_blocking(move || Holder { options, sender, worker: None }.work(&inbox));
    forward(&mut receiver, questions).await;
    computing.await.map_err(|_| ClusterError::failed("the holder's thread died"))?
}

async fn forward(receiver: &mut LinkReceiver, questions: std::sync::mpsc::SyncSender<Bytes>) {
    while let Some(message) = receiver.receive().await {
        let questions = questions.clone();
        let sent = tokio::task::spawn_blocking(move || questions.send(message)).await;
        if !matches!(sent, Ok(Ok(()))) {
            return;
        }
    }
}

struct Holder {
    options: HolderOptions,
    sender: LinkSender,
    worker: Option<PartWorker>,
}

impl Holder {
    fn work(mut self, inbox: &std::sync::mpsc::Receiver<Bytes>) -> Result<(), ClusterError> {
        while let Ok(message) = inbox.recv() {
            if let Err(error) = self.handle(&message) {
                if let Ok(said) = encode(&FromHolder::Failed(error.to_string())) {
                    self.sender.blocking_send(said);
                }
                return Err(error);
            }
        }
        Ok(())
    }

    fn handle(&mut self, message: &[u8]) -> Result<(), ClusterError> {
        let failed = |error: &dyn std::error::Error| ClusterError::failed(with_causes(error));
        match FromSolver::decode(message).map_err(|error| failed(&error))? {
            FromSolver::Setup { side, step, cameras } => {
                let parts_bytes =
                    self.options.memory_bytes.saturating_sub(overhead_bytes(side.problem().poses.len()));
                let mut worker = PartWorker::new(side, Some(self.options.store.clone()), parts_bytes);
                worker.resume(step, &cameras).map_err(|error| failed(&error))?;
                self.worker = Some(worker);
            }
            FromSolver::Take(parts) => {
                let worker = self.worker.as_mut().ok_or_else(too_early)?;
                for part in parts {
                    worker.take_stored(part).map_err(|error| failed(&error))?;
                }
                let (held, resident) = worker
                    .held()
                    .fold((0, 0), |(all, kept), (_, resident)| (all + 1, kept + u32::from(resident)));
                tracing::info!("{held} parts are held, {resident} of them in memory");
            }
            FromSolver::Ask { number, only, request } => self.answer(number, only, &request)?,
        }
        Ok(())
    }

    fn answer(
        &mut self,
        number: u64,
        only: Option<Vec<u32>>,
        request: &PartRequest,
    ) -> Result<(), ClusterError> {
        let worker = self.worker.as_mut().ok_or_else(too_early)?;
        worker.begin(request).map_err(|error| ClusterError::failed(with_causes(&error)))?;
        let parts = only.unwrap_or_else(|| worker.held().map(|(part, _)| part).collect());
        for parts in parts.chunks(PARTS_AT_ONCE) {
            let answers = worker
                .answer(request, Some(parts))
                .map_err(|error| ClusterError::failed(with_causes(&error)))?;
            if !self.sender.blocking_send(encode(&FromHolder::Answers { number, answers })?) {
                return Ok(());
            }
        }
        Ok(())
    }
}

/// What a holder takes beside its parts: itself, the cameras as they are accepted and tried, and messages about them.
fn overhead_bytes(num_poses: usize) -> u64 {
    (64 << 20) + 2560 * num_poses as u64
}

fn too_early() -> ClusterError {
    ClusterError::failed("the solver asked before it said what the problem is")
}

fn encode(message: &FromHolder) -> Result<Bytes, ClusterError> {
    message.encode().map_err(|error| ClusterError::failed(error.to_string()))
}
