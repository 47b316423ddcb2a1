//! The plan: a function of (configuration, what exists) to the tasks that can run now.

mod known;
mod predict;
mod stages;

use serde::{Deserialize, Serialize};

pub use known::KnownArtefacts;

use crate::listing::Listing;
use crate::{ArtefactKey, PipelineError, RunConfig, Stage, Store, Task};

/// What can be done now, and how far the run is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Tasks whose inputs exist and whose artefact does not; earlier stages first.
    pub ready: Vec<Task>,
    /// Progress of every stage, in order.
    pub progress: Vec<StageProgress>,
    /// Whether the run is at its end.
    pub state: PlanState,
}

/// How far a stage is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageProgress {
    /// Which stage.
    pub stage: Stage,
    /// Tasks that are done or set aside.
    pub done: u64,
    /// Tasks in all; `None` while an earlier stage decides how many.
    pub total: Option<u64>,
    /// Of those done, the ones that were set aside.
    pub set_aside: u64,
}

/// Whether the run is at its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum PlanState {
    /// Tasks are ready, or running elsewhere.
    Working,
    /// Everything is done; write the output.
    Finished {
        /// What came out.
        figures: RunFigures,
    },
    /// The run can't go on.
    Failed {
        /// Why, naming the object and the remedy.
        reason: String,
    },
}

/// What came out of a run, in short. The whole is in the output's report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunFigures {
    /// Photographs offered, unreadable ones included.
    pub images: u64,
    /// Photographs with a pose in some component.
    pub registered: u64,
    /// Photographs that could not be read.
    pub rejected: u64,
    /// Clusters.
    pub clusters: u64,
    /// Components of the result.
    pub components: u64,
    /// Points of all components.
    pub points: u64,
    /// Mean reprojection error over all components, in pixels.
    pub mean_reprojection_error_px: f64,
    /// Whether the largest component is in a local east-north-up frame in metres.
    pub georeferenced: bool,
    /// RMS distance of cameras from their satellite positions in the largest component, in metres.
    pub gps_rmse_m: Option<f64>,
    /// Median of these distances, in metres.
    pub gps_median_m: Option<f64>,
    /// Why nothing could be reconstructed, when nothing could.
    pub nothing: Option<String>,
}

/// The tasks of a run that can run now.
///
/// Reads small artefacts (image table, pairs, partition, placement) and, the first time, lists the store; a corrupt one of
/// these is deleted and its task planned again. Every ready task is returned each time, running or not: the caller
/// knows which are running. Deterministic: tasks are in the order of stages, then items.
///
/// # Errors
/// Invalid input when the photographs' folder is absent, empty or without photographs, or options are out of range;
/// storage errors.
pub fn plan(config: &RunConfig, store: &Store, known: &mut KnownArtefacts) -> Result<Plan, PipelineError> {
    let problems = config.validate();
    if !problems.is_empty() {
        return Err(PipelineError::invalid_input(problems.join("; ")));
    }
    known.list(store)?;
    // Each round either succeeds or deletes an artefact; a store that corrupts what it is given ends the loop.
    for _ in 0..16 {
        match stages::Planner::new(config, store, known).plan() {
            Err(error) => match error.broken_artefact() {
                Some(key) => {
                    tracing::warn!(%key, %error, "computing a broken artefact again");
                    known.discard(store, &key)?;
                }
                None => return Err(error),
            },
            done => return done,
        }
    }
    Err(PipelineError::storage(format!("store {} returns other bytes than were written", store.place())))
}

/// The artefacts that the output of a finished run is made of, or `None` when the run is not finished.
pub(crate) fn finished(
    config: &RunConfig,
    store: &Store,
    known: &mut KnownArtefacts,
) -> Result<Option<(ArtefactKey, crate::task::FinishedRun)>, PipelineError> {
    known.list(store)?;
    let mut planner = stages::Planner::new(config, store, known);
    planner.plan_stages()?;
    Ok(planner.finished.take())
}

/// The photographs' files, listed anew until the image table exists.
fn listing(config: &RunConfig, known: &mut KnownArtefacts, again: bool) -> Result<Listing, PipelineError> {
    if let (Some(listing), false) = (&known.listing, again) {
        return Ok(listing.clone());
    }
    let listing = Listing::scan(config)?;
    known.listing = Some(listing.clone());
    Ok(listing)
}

#[cfg(test)]
mod tests;
