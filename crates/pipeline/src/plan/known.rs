//! What the planner remembers between calls, so that each call is quick.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::listing::Listing;
use crate::{ArtefactKey, PipelineError, Stage, Store};

/// Which artefacts exist, which tasks are set aside, and small artefacts that planning reads again and again.
///
/// A cache beside the store and nothing more: an empty one gives the same plan, later. One run, one value.
#[derive(Default)]
pub struct KnownArtefacts {
    existing: BTreeSet<ArtefactKey>,
    listed: bool,
    set_aside: BTreeMap<ArtefactKey, String>,
    pub(super) listing: Option<Listing>,
    small: BTreeMap<(ArtefactKey, &'static str), Arc<dyn Any + Send + Sync>>,
}

impl KnownArtefacts {
    /// Knows nothing yet; the first [`crate::plan`] asks the store.
    pub fn new() -> Self {
        Self::default()
    }

    /// Tells that a task has left its artefact.
    pub fn record(&mut self, key: ArtefactKey) {
        self.existing.insert(key);
    }

    /// Tells that a task has failed for good: the plan goes on without its artefact where it can, and ends the run with
    /// this reason where it can't. Not stored: a rerun tries again.
    pub fn set_aside(&mut self, key: ArtefactKey, reason: impl Into<String>) {
        self.set_aside.insert(key, reason.into());
    }

    /// Deletes an artefact that is corrupt and forgets it, so that the next plan has its task again.
    ///
    /// # Errors
    /// When the store can't delete.
    pub fn discard(&mut self, store: &Store, key: &ArtefactKey) -> Result<(), PipelineError> {
        store.delete(&key.path())?;
        self.forget(key);
        Ok(())
    }

    /// Forgets an artefact that is gone.
    pub fn forget(&mut self, key: &ArtefactKey) {
        self.existing.remove(key);
        self.small.retain(|(of, _), _| of != key);
    }

    pub(super) fn exists(&self, key: &ArtefactKey) -> bool {
        self.existing.contains(key)
    }

    pub(super) fn reason_set_aside(&self, key: &ArtefactKey) -> Option<&str> {
        self.set_aside.get(key).map(String::as_str)
    }

    /// Lists the store the first time.
    pub(super) fn list(&mut self, store: &Store) -> Result<(), PipelineError> {
        if !self.listed {
            for stage in Stage::ALL {
                self.existing.extend(store.list_stage(stage)?);
            }
            self.listed = true;
        }
        Ok(())
    }

    /// A value made of an artefact, made once.
    pub(super) fn remember<T: Send + Sync + 'static>(
        &mut self,
        key: ArtefactKey,
        name: &'static str,
        make: impl FnOnce() -> Result<T, PipelineError>,
    ) -> Result<Arc<T>, PipelineError> {
        if let Some(value) =
            self.small.get(&(key, name)).cloned().and_then(|value| value.downcast::<T>().ok())
        {
            return Ok(value);
        }
        let value = Arc::new(make()?);
        self.small.insert((key, name), value.clone());
        Ok(value)
    }
}
