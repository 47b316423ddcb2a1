//! terrane's own types of what travels: checked, with nothing optional that must be there.

use std::fmt;

use bytes::Bytes;

use crate::{ProtoError, limits};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(pub u64);

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}", self.0)
            }
        }
    };
}

id!(
    /// A run at a coordinator.
    RunId
);
id!(
    /// A worker process at a coordinator.
    WorkerId
);
id!(
    /// One handing-out of one task.
    LeaseId
);

/// The key of the artefact that a task makes: letters, digits, `-` and `_`, in parts divided by `/`; never `..`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskKey(String);

impl TaskKey {
    /// A key from its text, refused when it is empty, too long or holds other characters.
    pub fn parse(text: &str) -> Result<Self, ProtoError> {
        let part = |part: &str| {
            !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte))
        };
        if text.len() > limits::KEY_CHARS || !text.split('/').all(part) {
            return Err(ProtoError::invalid(
                "key",
                "must be 1 to 128 letters, digits, '-' or '_', in parts divided by '/'",
            ));
        }
        Ok(Self(text.to_owned()))
    }

    /// The key's text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for TaskKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What a worker process offers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Registration {
    /// Name, unique among the workers that live now.
    pub name: String,
    /// Memory in bytes that the process promises to stay within.
    pub memory_bytes: u64,
    /// Threads that a task may use; at least one.
    pub threads: u32,
    /// Tasks that it runs at once; at least one.
    pub slots: u32,
    /// Process id, for messages to people.
    pub process: u32,
}

/// The answer to a registration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Registered {
    /// Id of the worker.
    pub worker: WorkerId,
    /// Longest time between two heartbeats in milliseconds; at least one.
    pub heartbeat_ms: u32,
}

/// A task given to one worker for a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TaskLease {
    /// Id of the lease.
    pub lease: LeaseId,
    /// Run of the task.
    pub run: RunId,
    /// Key of the artefact that it makes.
    pub key: TaskKey,
    /// Stage, for messages to people.
    pub stage: String,
    /// Item, for messages to people.
    pub item: String,
    /// How often the task was given out, this time included.
    pub attempt: u32,
    /// The task in the engine's own encoding.
    pub spec: Bytes,
}

/// The answer to a request for work.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NextTask {
    /// A task to run.
    Lease(TaskLease),
    /// Nothing to do yet: ask again.
    Nothing,
    /// Work is over: exit.
    Leave,
    /// The worker is not known here: register again.
    Unknown,
}

/// The answer to a heartbeat.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HeartbeatAnswer {
    /// False: register again.
    pub known: bool,
    /// Leases whose results nobody waits for any more.
    pub revoked: Vec<LeaseId>,
}

/// What a task cost its worker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TaskCost {
    /// Milliseconds from start to end.
    pub wall_ms: u64,
    /// Milliseconds of processor time of the process meanwhile, all threads.
    pub cpu_ms: u64,
    /// Highest resident bytes of the process meanwhile.
    pub peak_bytes: u64,
}

/// Whose fault a failure is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailureKind {
    /// The task's input: it would fail anywhere.
    Input,
    /// The machine, the store or the network: it may work elsewhere or later.
    Machine,
    /// An input is corrupt or gone: it must be made again first.
    LostInput,
    /// The run's photographs or options: the run can't go on.
    BadRun,
    /// The store failed for good: the run can't go on.
    Storage,
}

/// A task that could not be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Whose fault it is.
    pub kind: FailureKind,
    /// What happened, in a sentence.
    pub reason: String,
    /// The engine's own account of it.
    pub detail: Bytes,
}

/// How a run stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunStatus {
    /// Id of the run.
    pub run: RunId,
    /// Where it is in its life.
    pub phase: RunPhase,
    /// Its stages in the order of the data.
    pub stages: Vec<StageStatus>,
}

/// Where a run is in its life.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RunPhase {
    /// Tasks are planned and run.
    Working,
    /// All tasks are over; results are being written.
    Closing,
    /// The result is written.
    Done,
    /// It ended without what was asked, for this reason.
    FellShort(String),
    /// Photographs or options are no good, for this reason.
    BadInput(String),
    /// Storage or planning failed, for this reason.
    Failed(String),
    /// Somebody cancelled it.
    Cancelled,
}

impl RunPhase {
    /// Whether nothing will happen to the run any more.
    pub fn is_over(&self) -> bool {
        !matches!(self, Self::Working | Self::Closing)
    }
}

/// How a stage stands, in tasks.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StageStatus {
    /// Name of the stage.
    pub stage: String,
    /// Done, those of earlier runs included.
    pub done: u64,
    /// Known so far.
    pub total: u64,
    /// Running now.
    pub running: u64,
    /// Computed by this coordinator.
    pub computed: u64,
    /// Set aside.
    pub given_up: u64,
}

/// How a worker stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerStatus {
    /// Id of the worker.
    pub worker: WorkerId,
    /// Its name.
    pub name: String,
    /// Memory in bytes that it promises to stay within.
    pub memory_bytes: u64,
    /// Memory in bytes that it holds, as last heard.
    pub resident_bytes: u64,
    /// Milliseconds since it was heard.
    pub silent_ms: u64,
    /// Stage and item of the tasks that it runs.
    pub tasks: Vec<String>,
}

/// How everything stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Runs in the order of their submission.
    pub runs: Vec<RunStatus>,
    /// Workers in the order of their registration.
    pub workers: Vec<WorkerStatus>,
}

/// One line of the coordinator's log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// Its number, from zero.
    pub number: u64,
    /// Milliseconds since the coordinator started.
    pub at_ms: u64,
    /// The text.
    pub text: String,
}

/// Lines of the coordinator's log.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LogPage {
    /// The lines.
    pub lines: Vec<LogLine>,
    /// Number to ask from next time.
    pub next: u64,
}
