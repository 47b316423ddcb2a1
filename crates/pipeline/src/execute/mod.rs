//! Execution: one task in, one artefact out.

mod appearance;
mod components;
mod graph;
#[cfg(feature = "sqlite")]
mod import;
#[cfg(not(feature = "sqlite"))]
#[path = "no_import.rs"]
mod import;
mod ingest;
mod inputs;
mod matching;
mod pixels;
pub(crate) mod read;
mod report;
mod shards;
mod submaps;

use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use terrane_scene::{ImageTable, SceneError};

pub(crate) use inputs::Inputs;
pub(crate) use report::RunReport;

use crate::{ArtefactKey, PipelineError, Put, RunConfig, Store, Task, TaskError, TaskReport, TaskSpec};

/// Tells tasks to stop. Clones share the signal.
#[derive(Clone, Debug, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Asks every task of this signal to stop at its next safe point.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether it was asked.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    pub(crate) fn check(&self) -> Result<(), PipelineError> {
        if self.is_cancelled() { Err(PipelineError::cancelled()) } else { Ok(()) }
    }
}

/// What a worker has, the same for every task of a run.
pub struct ExecutionContext {
    /// The run.
    pub config: RunConfig,
    /// The signal to stop.
    pub cancel: Cancel,
    pool: rayon::ThreadPool,
    table: Mutex<Option<(ArtefactKey, Arc<ImageTable>, Arc<Inputs>)>>,
}

impl ExecutionContext {
    /// A context with a thread pool of `config.workers.threads` threads.
    ///
    /// # Errors
    /// Invalid input when options are out of range; storage when threads can't be had.
    pub fn new(config: RunConfig, cancel: Cancel) -> Result<Self, PipelineError> {
        let problems = config.validate();
        if !problems.is_empty() {
            return Err(PipelineError::invalid_input(problems.join("; ")));
        }
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(config.workers.threads as usize)
            .thread_name(|at| format!("compute-{at}"))
            .build()
            .map_err(|error| {
                PipelineError::storage(format!("threads for computing can't be had: {error}"))
            })?;
        Ok(Self { config, cancel, pool, table: Mutex::new(None) })
    }

    /// The run's image table, which nearly every task reads: decoded once.
    pub(crate) fn table(&self, store: &Store, key: &ArtefactKey) -> Result<Arc<ImageTable>, PipelineError> {
        Ok(self.ingested(store, key)?.0)
    }

    /// The run's image table, and what is read beside photographs.
    pub(crate) fn ingested(
        &self,
        store: &Store,
        key: &ArtefactKey,
    ) -> Result<(Arc<ImageTable>, Arc<Inputs>), PipelineError> {
        let mut cached = self.table.lock().unwrap_or_else(PoisonError::into_inner);
        match &*cached {
            Some((of, table, inputs)) if of == key => Ok((table.clone(), inputs.clone())),
            _ => {
                let read = read::table(store, key)?;
                let (table, inputs) = (Arc::new(read.table), Arc::new(read.inputs));
                *cached = Some((*key, table.clone(), inputs.clone()));
                Ok((table, inputs))
            }
        }
    }
}

/// What a stage made: the bytes of its artefact, and figures for the report.
pub(crate) struct Made {
    pub bytes: Vec<u8>,
    pub counts: Vec<(&'static str, u64)>,
}

/// A value that can't be written in its own format is a bug of its maker.
pub(crate) fn encode_error(error: SceneError) -> PipelineError {
    PipelineError::bug(format!("an artefact can't be encoded: {error}"))
}

/// Runs a task on the context's threads and leaves its artefact in the store. Blocks until it is done: to be called from
/// a thread that drives no asynchronous runtime.
///
/// # Errors
/// Retryable ones and others, see [`TaskError`]; a task that stops on a broken invariant is an error, never a panic.
pub fn execute(task: &Task, store: &Store, context: &ExecutionContext) -> Result<TaskReport, TaskError> {
    let run = || -> Result<TaskReport, PipelineError> {
        context.cancel.check()?;
        let made = run_stage(task, store, context)?;
        context.cancel.check()?;
        let bytes_written = made.bytes.len() as u64;
        let put = store.put_if_absent(&task.key.path(), made.bytes)?;
        let counts = made.counts.into_iter().map(|(name, count)| (name.to_owned(), count)).collect();
        Ok(TaskReport { bytes_written, existed: put == Put::Existed, counts })
    };
    match std::panic::catch_unwind(AssertUnwindSafe(|| context.pool.install(run))) {
        Ok(done) => done.map_err(TaskError::from),
        Err(panic) => {
            let message = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
            let message = message.or_else(|| panic.downcast_ref::<String>().cloned());
            Err(TaskError::panicked(message.unwrap_or_else(|| "no message".to_owned())))
        }
    }
}

fn run_stage(task: &Task, store: &Store, context: &ExecutionContext) -> Result<Made, PipelineError> {
    match &task.spec {
        TaskSpec::Ingest { listing } => ingest::ingest(context, listing),
        TaskSpec::Features { table, first, count } => pixels::features(store, context, table, *first, *count),
        TaskSpec::Pairs { table, features, lost } => pixels::pairs(store, context, table, features, lost),
        TaskSpec::Match { table, pairs, block, features } => {
            matching::matching(store, context, (table, pairs), *block, features)
        }
        TaskSpec::ViewGraph { num_images, matches } => {
            graph::view_graph(store, context, *num_images, matches)
        }
        TaskSpec::Partition { view_graph } => graph::partition(store, context, view_graph),
        TaskSpec::Submap { .. } => submaps::submap(store, context, &task.spec),
        TaskSpec::Align { a, b } => submaps::align(store, context, a, b),
        TaskSpec::Average { table, submaps, seams } => {
            components::average(store, context, table, submaps, seams)
        }
        TaskSpec::Merge { average, submaps, component } => {
            components::merge(store, context, average, submaps, *component)
        }
        TaskSpec::Adjust { table, average, merge, component } => {
            components::adjust(store, context, table, (average, *component), merge)
        }
        TaskSpec::Georegister { table, adjust, component } => {
            components::georegister(store, context, table, adjust, *component)
        }
        TaskSpec::Export { run } => report::export(store, run),
    }
}
