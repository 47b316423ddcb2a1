//! What a run cost, by stage and by process, from the reports of the workers.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use terrane_proto::types::TaskCost;

use super::Timestamp;

/// What a run cost at this coordinator; work of earlier coordinators that was found in the store is not in it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunTimings {
    /// By stage.
    pub stages: BTreeMap<String, StageTiming>,
    /// Highest resident memory of each worker process in bytes, by its name.
    pub peak_bytes: BTreeMap<String, u64>,
    /// Milliseconds from the submission to the end of the last task.
    pub wall_ms: u64,
    /// Workers lost during the run.
    pub workers_lost: u64,
}

/// What a stage cost.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageTiming {
    /// Milliseconds from the start of its first task to the end of its last.
    pub wall_ms: u64,
    /// Milliseconds of processor time over all tasks, those that failed included.
    pub cpu_ms: u64,
    /// Tasks computed.
    pub tasks: u64,
    /// Attempts beyond the first of a task.
    pub retries: u64,
    /// Highest resident memory of a process during one of its tasks, in bytes.
    pub peak_bytes: u64,
}

/// Collects the figures of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Stopwatch {
    started: Timestamp,
    spans: BTreeMap<String, (Timestamp, Timestamp)>,
    timings: RunTimings,
}

impl Stopwatch {
    pub(super) fn new(started: Timestamp) -> Self {
        Self { started, ..Self::default() }
    }

    pub(super) fn begin(&mut self, at: Timestamp, stage: &str, attempt: u32) {
        self.spans.entry(stage.to_owned()).or_insert((at, at));
        let timing = self.timings.stages.entry(stage.to_owned()).or_default();
        timing.retries += u64::from(attempt > 1);
    }

    pub(super) fn end(&mut self, at: Timestamp, stage: &str, worker: &str, cost: TaskCost, done: bool) {
        let span = self.spans.entry(stage.to_owned()).or_insert((at, at));
        span.1 = span.1.max(at);
        let timing = self.timings.stages.entry(stage.to_owned()).or_default();
        timing.wall_ms = span.1.since(span.0);
        timing.cpu_ms = timing.cpu_ms.saturating_add(cost.cpu_ms);
        timing.tasks += u64::from(done);
        timing.peak_bytes = timing.peak_bytes.max(cost.peak_bytes);
        let peak = self.timings.peak_bytes.entry(worker.to_owned()).or_default();
        *peak = (*peak).max(cost.peak_bytes);
        self.timings.wall_ms = at.since(self.started);
    }

    pub(super) fn lose_worker(&mut self) {
        self.timings.workers_lost += 1;
    }

    pub(super) fn timings(&self) -> RunTimings {
        self.timings.clone()
    }
}
