//! Calls over the network become commands to the shell's loop.

use bytes::Bytes;
use terrane_proto::types::*;
use terrane_proto::{ClientCalls, Refusal, WorkerCalls};

use super::{Command, Handle};
use crate::ClusterError;
use crate::state::{Event, RequestId};

fn refusal(error: ClusterError) -> Refusal {
    if error.is_unreachable() { Refusal::Closing } else { Refusal::Invalid(error.to_string()) }
}

impl WorkerCalls for Handle {
    async fn register(&self, registration: Registration) -> Result<Registered, Refusal> {
        let worker = WorkerId(self.fresh_id());
        self.ask(|answer| Command::Register(worker, registration, answer)).await.map_err(refusal)?;
        Ok(Registered { worker, heartbeat_ms: self.0.heartbeat_ms })
    }

    async fn describe_run(&self, run: RunId) -> Result<Bytes, Refusal> {
        let description = self.ask(|answer| Command::Describe(run, answer)).await.map_err(refusal)?;
        description.ok_or_else(|| Refusal::NotFound(format!("run {run} is not known")))
    }

    async fn next_task(&self, worker: WorkerId, held: Vec<LeaseId>) -> Result<NextTask, Refusal> {
        let request = RequestId(self.fresh_id());
        let event = Event::Asked(worker, request, held);
        self.ask(|answer| Command::Ask(event, request, answer)).await.map_err(refusal)
    }

    async fn heartbeat(
        &self,
        worker: WorkerId,
        held: Vec<LeaseId>,
        resident_bytes: u64,
    ) -> Result<HeartbeatAnswer, Refusal> {
        let event = Event::Heartbeat(worker, held, resident_bytes);
        self.ask(|answer| Command::Beat(event, answer)).await.map_err(refusal)
    }

    async fn complete(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        cost: TaskCost,
        _report: Bytes,
    ) -> Result<bool, Refusal> {
        self.ask(|answer| Command::Judge(Event::Completed(worker, lease, cost), answer))
            .await
            .map_err(refusal)
    }

    async fn fail(
        &self,
        worker: WorkerId,
        lease: LeaseId,
        failure: Failure,
        cost: TaskCost,
    ) -> Result<bool, Refusal> {
        self.ask(|answer| Command::Judge(Event::Failed(worker, lease, failure, cost), answer))
            .await
            .map_err(refusal)
    }
}

impl ClientCalls for Handle {
    async fn submit(&self, description: Bytes) -> Result<RunId, Refusal> {
        Handle::submit(self, description).await.map_err(refusal)
    }

    async fn status(&self) -> Result<Status, Refusal> {
        Handle::status(self).await.map_err(refusal)
    }

    async fn cancel(&self, run: RunId) -> Result<bool, Refusal> {
        Handle::cancel(self, run).await.map_err(refusal)
    }

    async fn logs(&self, from: u64) -> Result<LogPage, Refusal> {
        Ok(Handle::logs(self, from))
    }
}
