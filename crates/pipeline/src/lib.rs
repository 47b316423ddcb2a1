//! The stage graph, artefacts on an object store, and the execution of tasks.
//!
//! [`plan`] turns (configuration, what exists) into tasks that can run now; [`execute`] runs one task and leaves one
//! artefact. Nothing else passes between tasks, so any process that shares the [`Store`] can run any of them.
//! This crate knows no network, no processes and no clocks; see `docs/conventions.md` for frames and units.

pub mod adjustment;
pub mod calibrate;
mod config;
mod error;
mod execute;
mod key;
mod listing;
mod masks;
pub mod output;
mod plan;
pub mod resources;
mod stage;
mod store;
mod task;

pub use config::{CameraOverride, RunConfig, WorkerHints};
pub use error::{PipelineError, TaskError};
pub use execute::{Cancel, ExecutionContext, execute};
pub use key::{ArtefactKey, KeyBuilder};
pub use listing::is_photograph;
pub use plan::{KnownArtefacts, Plan, PlanState, RunFigures, StageProgress, plan};
pub use stage::Stage;
pub use store::{Put, Store};
pub use task::{Task, TaskReport, TaskSpec};
pub use terrane_frontend::features::FeatureMethod;
pub use terrane_frontend::matching::Matcher;
