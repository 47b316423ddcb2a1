//! The engine that reconstructs: `terrane-pipeline` behind the cluster's contracts.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use terrane_pipeline::output::{RunCosts, StageCost};
use terrane_pipeline::{
    ArtefactKey, Cancel, ExecutionContext, KnownArtefacts, PipelineError, Plan, PlanState, RunConfig, Stage,
    Store, Task, TaskError, WorkerHints, execute, output, plan,
};
use terrane_proto::types::{Failure, FailureKind, TaskKey};

use super::{
    CancelFlag, Closing, Engine, EngineFailure, Executor, News, Planned, PlannedStage, PlannedTask, Planner,
    RunTimings, Verdict,
};

/// A run as it travels: what to do, where artefacts are kept, where the result goes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunDescription {
    /// Photographs, options, seed.
    pub config: RunConfig,
    /// The store, as coordinator and workers reach it.
    pub store: String,
    /// The folder of the result, as the coordinator reaches it.
    pub out: PathBuf,
    /// Worker processes that are asked for; goes into the report.
    pub workers: u64,
}

impl RunDescription {
    /// The description as it travels.
    ///
    /// # Errors
    /// When a path is not text.
    pub fn encode(&self) -> Result<Bytes, EngineFailure> {
        let json = serde_json::to_vec(self);
        json.map(Bytes::from).map_err(|error| EngineFailure {
            reason: format!("the run can't be described: {error}"),
            bad_input: true,
        })
    }

    fn decode(bytes: &[u8]) -> Result<Self, EngineFailure> {
        serde_json::from_slice(bytes).map_err(|error| EngineFailure {
            reason: format!("the run's description can't be read: {error}; use the same terrane everywhere"),
            bad_input: true,
        })
    }
}

/// Plans and executes reconstructions.
pub struct PipelineEngine {
    /// Threads and memory of this process's tasks; the coordinator's own are never used.
    pub hints: WorkerHints,
}

fn failure(error: PipelineError) -> EngineFailure {
    EngineFailure { bad_input: error.is_invalid_input(), reason: error.to_string() }
}

impl Engine for PipelineEngine {
    fn planner(&self, description: &[u8]) -> Result<Box<dyn Planner>, EngineFailure> {
        let description = RunDescription::decode(description)?;
        let problems = description.config.validate();
        if !problems.is_empty() {
            return Err(EngineFailure { reason: problems.join("; "), bad_input: true });
        }
        output::check_writable(&description.out).map_err(failure)?;
        let store = Store::open(&description.store).map_err(failure)?;
        let (known, predicted, reused) = (KnownArtefacts::new(), BTreeMap::new(), BTreeMap::new());
        Ok(Box::new(RunPlanner { description, store, known, predicted, reused, reopened: 0 }))
    }

    fn executor(&self, description: &[u8]) -> Result<Arc<dyn Executor>, EngineFailure> {
        let mut description = RunDescription::decode(description)?;
        description.config.workers = self.hints.clone();
        let store = Store::open(&description.store).map_err(failure)?;
        Ok(Arc::new(RunExecutor { config: description.config, store }))
    }
}

/// A store that keeps breaking what the result needs ends the run after so many tries.
const MAX_REOPENED: u32 = 8;

struct RunPlanner {
    description: RunDescription,
    store: Store,
    known: KnownArtefacts,
    /// Largest prediction of memory of each stage in bytes.
    predicted: BTreeMap<Stage, u64>,
    /// Tasks of each stage that the first plan to know them found done.
    reused: BTreeMap<Stage, u64>,
    /// How often the result could not be written for want of an artefact.
    reopened: u32,
}

impl RunPlanner {
    fn take(&mut self, news: News) -> Result<(), PipelineError> {
        for key in news.done.iter().filter_map(artefact) {
            // A worker's word is not enough: the artefact must be there.
            if self.store.head(&key.path())?.is_some() {
                self.known.record(key);
            }
        }
        for (key, reason) in &news.given_up {
            if let Some(key) = artefact(key) {
                self.known.set_aside(key, reason.clone());
            }
        }
        for detail in &news.failures {
            let account: Option<TaskError> = serde_json::from_slice(detail).ok();
            if let Some(key) = account.and_then(|account| account.corrupt_input) {
                tracing::warn!(%key, "computing a broken artefact again");
                self.known.discard(&self.store, &key)?;
            }
        }
        Ok(())
    }

    fn convert(&mut self, plan: Plan) -> Result<Planned, EngineFailure> {
        let mut ready = Vec::with_capacity(plan.ready.len());
        for task in plan.ready {
            let most = self.predicted.entry(task.stage).or_default();
            *most = (*most).max(task.predicted_peak_bytes);
            ready.push(planned_task(&task)?);
        }
        let stages = plan.progress.iter().map(|row| {
            let total = row.total.unwrap_or(row.done);
            PlannedStage { stage: row.stage.name().to_owned(), done: row.done, total }
        });
        let verdict = match plan.state {
            PlanState::Working => None,
            PlanState::Finished { figures } => Some(match figures.nothing {
                None => Verdict::Finished,
                Some(reason) => Verdict::FellShort(reason),
            }),
            PlanState::Failed { reason } => Some(Verdict::FellShort(reason)),
        };
        Ok(Planned { ready, stages: stages.collect(), verdict })
    }

    fn costs(&self, timings: &RunTimings) -> RunCosts {
        let stages = Stage::ALL.into_iter().map(|stage| {
            let timing = timings.stages.get(stage.name()).cloned().unwrap_or_default();
            let cost = StageCost {
                wall_seconds: timing.wall_ms as f64 * 1e-3,
                cpu_seconds: timing.cpu_ms as f64 * 1e-3,
                tasks_run: timing.tasks,
                tasks_reused: self.reused.get(&stage).map_or(0, |done| done.saturating_sub(timing.tasks)),
                retries: timing.retries,
                peak_bytes: timing.peak_bytes,
                predicted_peak_bytes: self.predicted.get(&stage).copied().unwrap_or(0),
            };
            (stage, cost)
        });
        RunCosts {
            wall_seconds: timings.wall_ms as f64 * 1e-3,
            workers: self.description.workers,
            peak_bytes: timings.peak_bytes.clone(),
            stages: stages.collect(),
        }
    }
}

fn artefact(key: &TaskKey) -> Option<ArtefactKey> {
    key.as_str().parse().ok()
}

fn planned_task(task: &Task) -> Result<PlannedTask, EngineFailure> {
    let bug =
        |what: &str| EngineFailure { reason: format!("{what} (this is a bug of terrane)"), bad_input: false };
    Ok(PlannedTask {
        key: TaskKey::parse(&task.key.to_string()).map_err(|error| bug(&error.to_string()))?,
        stage: task.stage.name().to_owned(),
        item: task.item.clone(),
        spec: serde_json::to_vec(task)
            .map_err(|error| bug(&format!("a task can't be written: {error}")))?
            .into(),
        peak_bytes: task.predicted_peak_bytes,
        expected_ms: (task.predicted_seconds.max(0.0) * 1e3) as u64,
    })
}

impl Planner for RunPlanner {
    fn plan(&mut self, news: News) -> Result<Planned, EngineFailure> {
        self.take(news).map_err(failure)?;
        let plan = plan(&self.description.config, &self.store, &mut self.known).map_err(failure)?;
        for row in &plan.progress {
            self.reused.insert(row.stage, row.done.saturating_sub(row.set_aside));
        }
        self.convert(plan)
    }

    fn close(&mut self, verdict: &Verdict, timings: &RunTimings) -> Result<Closing, EngineFailure> {
        let costs = self.costs(timings);
        let RunDescription { config, out, .. } = &self.description;
        match output::write(config, &self.store, &mut self.known, out, &costs) {
            Ok(_) => Ok(Closing::Written),
            // A run that never got as far as figures has nothing to write; its reason is told all the same.
            Err(error) if matches!(verdict, Verdict::FellShort(_)) && error.is_invalid_input() => {
                Ok(Closing::Written)
            }
            Err(error) => match error.broken_artefact() {
                Some(key) if self.reopened < MAX_REOPENED => {
                    tracing::warn!(%key, %error, "computing a broken artefact again");
                    self.reopened += 1;
                    self.known.discard(&self.store, &key).map_err(failure)?;
                    Ok(Closing::PlanAgain)
                }
                _ => Err(failure(error)),
            },
        }
    }
}

struct RunExecutor {
    config: RunConfig,
    store: Store,
}

impl Executor for RunExecutor {
    fn execute(&self, spec: &[u8], cancel: &CancelFlag) -> Result<Bytes, Failure> {
        let machine = |reason: String| Failure { kind: FailureKind::Machine, reason, detail: Bytes::new() };
        let task: Task = serde_json::from_slice(spec).map_err(|error| {
            machine(format!("the task can't be read: {error}; use the same terrane everywhere"))
        })?;
        let signal = Cancel::default();
        let context = ExecutionContext::new(self.config.clone(), signal.clone())
            .map_err(|error| machine(error.to_string()))?;
        let report = watched(cancel, &signal, || execute(&task, &self.store, &context))
            .map_err(|error| task_failure(&error))?;
        Ok(serde_json::to_vec(&report).unwrap_or_default().into())
    }
}

/// Runs `body`, and passes our request to stop on to the pipeline's signal meanwhile.
fn watched<T>(cancel: &CancelFlag, signal: &Cancel, body: impl FnOnce() -> T) -> T {
    let (over, ended) = std::sync::mpsc::channel::<()>();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let pause = std::time::Duration::from_millis(50);
            while let Err(std::sync::mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(pause) {
                if cancel.is_set() {
                    signal.cancel();
                    return;
                }
            }
        });
        let result = body();
        drop(over);
        result
    })
}

fn task_failure(error: &TaskError) -> Failure {
    let kind = if error.corrupt_input.is_some() {
        FailureKind::LostInput
    } else if error.invalid_input {
        FailureKind::BadRun
    } else if error.storage {
        FailureKind::Storage
    } else if error.retryable || error.cancelled {
        FailureKind::Machine
    } else {
        FailureKind::Input
    };
    let detail = serde_json::to_vec(error).unwrap_or_default().into();
    Failure { kind, reason: error.message.clone(), detail }
}
