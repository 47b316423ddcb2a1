//! `report.json` and `run.json`.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::model::write_text;
use crate::execute::RunReport;
use crate::{ArtefactKey, PipelineError, RunConfig, Stage};

/// What a stage cost, as the coordinator measured it: clocks are not this crate's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunCosts {
    /// From the first to the last moment, in seconds.
    pub wall_seconds: f64,
    /// Worker processes.
    pub workers: u64,
    /// Largest resident memory of each process, by name, in bytes.
    pub peak_bytes: BTreeMap<String, u64>,
    /// Costs by stage.
    pub stages: BTreeMap<Stage, StageCost>,
}

#[derive(Serialize)]
struct ReportFile<'a> {
    version: u32,
    terrane: &'static str,
    #[serde(flatten)]
    report: &'a RunReport,
    costs: CostsFile<'a>,
}

#[derive(Serialize)]
struct CostsFile<'a> {
    wall_seconds: f64,
    workers: u64,
    peak_bytes: &'a BTreeMap<String, u64>,
    stages: Vec<StageFile<'a>>,
}

#[derive(Serialize)]
struct StageFile<'a> {
    stage: Stage,
    #[serde(flatten)]
    cost: &'a StageCost,
}

/// Writes `report.json`.
pub(super) fn write_report(report: &RunReport, costs: &RunCosts, folder: &Path) -> Result<(), PipelineError> {
    let stages = costs.stages.iter().map(|(stage, cost)| StageFile { stage: *stage, cost }).collect();
    let file = ReportFile {
        version: 1,
        terrane: env!("CARGO_PKG_VERSION"),
        report,
        costs: CostsFile {
            wall_seconds: costs.wall_seconds,
            workers: costs.workers,
            peak_bytes: &costs.peak_bytes,
            stages,
        },
    };
    write_text(&folder.join("report.json"), &pretty(&file)?)
}

#[derive(Serialize)]
struct RunFile<'a> {
    terrane: &'static str,
    seed: u64,
    stage_versions: BTreeMap<&'static str, u32>,
    /// The artefact that tells where everything else of the run is, for later exports.
    result: ArtefactKey,
    config: &'a RunConfig,
}

/// Writes `run.json`: what the run can be repeated with.
pub(super) fn write_run(config: &RunConfig, result: ArtefactKey, folder: &Path) -> Result<(), PipelineError> {
    let file = RunFile {
        terrane: env!("CARGO_PKG_VERSION"),
        seed: config.seed,
        stage_versions: Stage::ALL.into_iter().map(|stage| (stage.name(), stage.version())).collect(),
        result,
        config,
    };
    write_text(&folder.join("run.json"), &pretty(&file)?)
}

fn pretty<T: Serialize>(value: &T) -> Result<String, PipelineError> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|error| PipelineError::bug(format!("a report can't be written as JSON: {error}")))?;
    text.push('\n');
    Ok(text)
}
