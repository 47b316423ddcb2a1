//! What can happen to the coordinator and what it wants done about it. Time and ids come in with the events.

use bytes::Bytes;
use terrane_proto::types::{
    Failure, LeaseId, NextTask, Registration, RunId, RunPhase, TaskCost, TaskKey, WorkerId,
};

use super::item::PlannedTask;
use super::timings::RunTimings;

/// Milliseconds on the coordinator's clock, from its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// This time and some milliseconds.
    pub fn after(self, ms: u64) -> Self {
        Self(self.0.saturating_add(ms))
    }

    /// Milliseconds since an earlier time; zero when it is not earlier.
    pub fn since(self, earlier: Self) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// One waiting call of a worker for a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RequestId(pub u64);

/// How patient the coordinator is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Policy {
    /// Milliseconds of silence after which a worker counts as lost. Default 20,000.
    pub silence_ms: u64,
    /// Milliseconds between heartbeats that workers are asked for. Default 2,000: several fit into the silence.
    pub heartbeat_ms: u32,
    /// Milliseconds after which a waiting worker is told that there is nothing yet. Default 5,000.
    pub wait_ms: u64,
    /// Failures of its input after which a task is set aside. Default 2: the second excludes a passing cause.
    pub max_input_failures: u32,
    /// Failures of machine or store after which a task is set aside. Default 6.
    pub max_machine_failures: u32,
    /// Lost workers after which a task is set aside. Default 5.
    pub max_losses: u32,
    /// Milliseconds before the first retry after a failure; doubled each time, at most 30,000. Default 250.
    pub first_backoff_ms: u64,
    /// Milliseconds to wait for a worker with enough memory before a task is set aside. Default 10,000.
    pub oversize_grace_ms: u64,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            silence_ms: 20_000,
            heartbeat_ms: 2_000,
            wait_ms: 5_000,
            max_input_failures: 2,
            max_machine_failures: 6,
            max_losses: 5,
            first_backoff_ms: 250,
            oversize_grace_ms: 10_000,
        }
    }
}

impl Policy {
    /// Milliseconds before the retry that follows failure number `failures`.
    pub fn backoff_ms(&self, failures: u32) -> u64 {
        let doubled = self.first_backoff_ms.saturating_mul(1 << failures.saturating_sub(1).min(20));
        doubled.min(30_000)
    }
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A run was handed in.
    Submitted(RunId),
    /// A plan is made.
    Planned(RunId, u64, Result<Planned, EngineFailure>),
    /// A worker announced itself.
    Registered(WorkerId, Registration),
    /// A worker waits for a task; it holds these leases and no others.
    Asked(WorkerId, RequestId, Vec<LeaseId>),
    /// A worker lives, holds these leases and this much memory in bytes.
    Heartbeat(WorkerId, Vec<LeaseId>, u64),
    /// A worker says that a task is done.
    Completed(WorkerId, LeaseId, TaskCost),
    /// A worker says that a task can't be done.
    Failed(WorkerId, LeaseId, Failure, TaskCost),
    /// The process of a worker ended.
    Exited(WorkerId),
    /// Somebody ends a run.
    Cancelled(RunId),
    /// The result of a run is written, or can't be.
    Closed(RunId, Result<Closing, EngineFailure>),
    /// The coordinator goes away: nothing more is given out.
    Drain,
    /// Time passes.
    Tick,
}

/// What should be done.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Answer a waiting worker.
    Answer(RequestId, NextTask),
    /// Answer the heartbeat that this is about.
    Heard {
        /// Whether the worker is known.
        known: bool,
        /// Leases that it should drop.
        revoked: Vec<LeaseId>,
    },
    /// Answer the completion or failure that this is about: did it count.
    Judged(bool),
    /// Plan a run, with what happened since the plan before.
    Plan(RunId, u64, News),
    /// Write the result of a run.
    Close(RunId, Verdict, RunTimings),
    /// A run is over.
    Over(RunId, RunPhase),
    /// A line for the log.
    Log(String),
}

/// What a plan must know that happened since the plan before.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct News {
    /// Tasks that workers say are done.
    pub done: Vec<TaskKey>,
    /// Tasks that were set aside, with the reason.
    pub given_up: Vec<(TaskKey, String)>,
    /// The engine's own accounts of failures.
    pub failures: Vec<Bytes>,
}

/// A plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Planned {
    /// Every task whose inputs exist and whose artefact does not, running or not.
    pub ready: Vec<PlannedTask>,
    /// Stages in the order of the data.
    pub stages: Vec<PlannedStage>,
    /// Whether the run is at its end.
    pub verdict: Option<Verdict>,
}

/// How far a stage is, as the store has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedStage {
    /// Its name.
    pub stage: String,
    /// Tasks done or set aside.
    pub done: u64,
    /// Tasks known so far.
    pub total: u64,
}

/// How a run that is at its end came out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// With what was asked for.
    Finished,
    /// With less than was asked for, for this reason.
    FellShort(String),
}

/// What became of writing a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closing {
    /// It is written.
    Written,
    /// An artefact that it needs is corrupt or gone: plan again, so that it is made anew.
    PlanAgain,
}

/// Why the engine could not plan or write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EngineFailure {
    /// What happened, naming the object and the remedy.
    pub reason: String,
    /// Photographs or options are at fault, not storage.
    pub bad_input: bool,
}
