//! What the cluster asks of the work that it distributes. Everything else about tasks is opaque to it.

mod photographs;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use terrane_proto::types::Failure;

pub use crate::state::{
    Closing, EngineFailure, News, Planned, PlannedStage, PlannedTask, RunTimings, Verdict,
};
pub use photographs::{PipelineEngine, RunDescription};

/// Knows runs by their descriptions. All calls block: they are made on threads that drive no reactor.
pub trait Engine: Send + Sync + 'static {
    /// What plans a run; made once per run, at the coordinator.
    ///
    /// # Errors
    /// When the description is no good or its store can't be opened.
    fn planner(&self, description: &[u8]) -> Result<Box<dyn Planner>, EngineFailure>;

    /// What executes the tasks of a run; made once per run and worker.
    ///
    /// # Errors
    /// As [`Engine::planner`].
    fn executor(&self, description: &[u8]) -> Result<Arc<dyn Executor>, EngineFailure>;
}

/// Plans one run and writes its result.
pub trait Planner: Send {
    /// The tasks that can run now, given what happened since the plan before. An artefact that a worker claims is believed only
    /// when it exists: its task is listed again otherwise.
    ///
    /// # Errors
    /// When the run can't go on: photographs, options or storage.
    fn plan(&mut self, news: News) -> Result<Planned, EngineFailure>;

    /// Writes the result of a run that is at its end.
    ///
    /// # Errors
    /// When it can't be written.
    fn close(&mut self, verdict: &Verdict, timings: &RunTimings) -> Result<Closing, EngineFailure>;
}

/// Executes tasks of one run.
pub trait Executor: Send + Sync {
    /// Does a task: when this returns a report, its artefact exists. Called on a thread of its own.
    ///
    /// # Errors
    /// Why there is no artefact, and whose fault that is.
    fn execute(&self, spec: &[u8], cancel: &CancelFlag) -> Result<Bytes, Failure>;
}

/// Set when nobody waits for a task's result any more. Clones share the flag.
#[derive(Clone, Debug, Default)]
pub struct CancelFlag(Arc<AtomicBool>);

impl CancelFlag {
    /// Asks the task to stop soon.
    pub fn set(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Whether the task should stop.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}
