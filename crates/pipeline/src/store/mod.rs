//! Immutable objects by name, on a local folder or in memory.
//!
//! A synchronous front over `object_store`, so that compute code never sees a future. Not to be called on a thread that
//! drives an asynchronous runtime: it blocks.

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::memory::InMemory;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload};

use crate::{ArtefactKey, PipelineError, Stage};

mod wait;
use wait::block_on;

/// What became of a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Put {
    /// The object is new.
    Written,
    /// An object of that name was there and was left as it is.
    Existed,
}

/// Objects by name. Writing is atomic: nobody ever reads half an object. Clones share the same objects.
#[derive(Clone)]
pub struct Store {
    inner: Arc<dyn ObjectStore>,
    place: Arc<str>,
}

impl std::fmt::Debug for Store {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Store({})", self.place)
    }
}

impl Store {
    /// Opens a store by its location: a folder's path (made if absent), a `file://` address, or `memory://`.
    ///
    /// # Errors
    /// When the folder can't be made or the address names a kind of store that this build does not have.
    pub fn open(location: &str) -> Result<Self, PipelineError> {
        if location == "memory://" {
            return Ok(Self::memory());
        }
        let path = location.strip_prefix("file://").unwrap_or(location);
        if path.contains("://") {
            return Err(PipelineError::invalid_input(format!(
                "store `{location}` is of a kind that this build does not have: use a folder"
            )));
        }
        Self::local(Path::new(path))
    }

    /// A store in a folder, which is made if absent.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn local(folder: &Path) -> Result<Self, PipelineError> {
        std::fs::create_dir_all(folder).map_err(|error| {
            PipelineError::io(&format!("store folder {} can't be made", folder.display()), &error)
        })?;
        let inner = LocalFileSystem::new_with_prefix(folder).map_err(|error| {
            storage(&format!("store folder {} can't be opened", folder.display()), &error)
        })?;
        Ok(Self { inner: Arc::new(inner), place: folder.display().to_string().into() })
    }

    /// A store in this process's memory, for tests.
    pub fn memory() -> Self {
        Self { inner: Arc::new(InMemory::new()), place: "memory://".into() }
    }

    /// Where it is, in words.
    pub fn place(&self) -> &str {
        &self.place
    }

    /// Writes an object unless one of that name exists; the first writer wins.
    ///
    /// # Errors
    /// When the store can't be written: full, read-only, out of reach.
    pub fn put_if_absent(&self, name: &str, bytes: impl Into<Bytes>) -> Result<Put, PipelineError> {
        let options = PutOptions::from(PutMode::Create);
        let payload = PutPayload::from(bytes.into());
        match block_on(self.inner.put_opts(&object_path(name)?, payload, options)) {
            Ok(_) => Ok(Put::Written),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(Put::Existed),
            Err(error) => Err(self.failed("can't write", name, &error)),
        }
    }

    /// Writes an object, replacing any of that name: for manifests, never for artefacts.
    ///
    /// # Errors
    /// As [`Store::put_if_absent`].
    pub fn put(&self, name: &str, bytes: impl Into<Bytes>) -> Result<(), PipelineError> {
        block_on(self.inner.put(&object_path(name)?, PutPayload::from(bytes.into())))
            .map(|_| ())
            .map_err(|error| self.failed("can't write", name, &error))
    }

    /// The whole object, or `None` when there is none.
    ///
    /// # Errors
    /// When the store can't be read.
    pub fn get(&self, name: &str) -> Result<Option<Bytes>, PipelineError> {
        let path = object_path(name)?;
        match block_on(async { self.inner.get(&path).await?.bytes().await }) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed("can't read", name, &error)),
        }
    }

    /// Parts of an object, in the order asked, or `None` when there is no such object. Ranges must lie within it.
    ///
    /// # Errors
    /// When the store can't be read or a range lies outside the object.
    pub fn get_ranges(&self, name: &str, ranges: &[Range<u64>]) -> Result<Option<Vec<Bytes>>, PipelineError> {
        if ranges.iter().all(|range| range.is_empty()) {
            return Ok(Some(vec![Bytes::new(); ranges.len()]));
        }
        let path = object_path(name)?;
        match block_on(self.inner.get_ranges(&path, ranges)) {
            Ok(parts) => Ok(Some(parts)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed("can't read", name, &error)),
        }
    }

    /// The size of an object in bytes, or `None` when there is none.
    ///
    /// # Errors
    /// When the store can't be asked.
    pub fn head(&self, name: &str) -> Result<Option<u64>, PipelineError> {
        match block_on(self.inner.head(&object_path(name)?)) {
            Ok(meta) => Ok(Some(meta.size)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed("can't ask for", name, &error)),
        }
    }

    /// Names and sizes of the objects in a folder and below, by name.
    ///
    /// # Errors
    /// When the store can't be listed.
    pub fn list(&self, folder: &str) -> Result<Vec<(String, u64)>, PipelineError> {
        let path = object_path(folder)?;
        let mut found: Vec<(String, u64)> = block_on(
            self.inner.list(Some(&path)).map_ok(|meta| (meta.location.to_string(), meta.size)).try_collect(),
        )
        .map_err(|error| self.failed("can't list", folder, &error))?;
        found.sort();
        Ok(found)
    }

    /// The artefacts of a stage, ascending.
    ///
    /// # Errors
    /// As [`Store::list`].
    pub fn list_stage(&self, stage: Stage) -> Result<Vec<ArtefactKey>, PipelineError> {
        let found = self.list(&format!("artefacts/{stage}"))?;
        Ok(found.iter().filter_map(|(name, _)| ArtefactKey::from_path(name)).collect())
    }

    /// Deletes an object; one that is not there counts as deleted.
    ///
    /// # Errors
    /// When the store refuses.
    pub fn delete(&self, name: &str) -> Result<(), PipelineError> {
        match block_on(self.inner.delete(&object_path(name)?)) {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.failed("can't delete", name, &error)),
        }
    }

    fn failed(&self, what: &str, name: &str, error: &object_store::Error) -> PipelineError {
        storage(&format!("{what} {name} in store {}", self.place), error)
    }
}

fn object_path(name: &str) -> Result<object_store::path::Path, PipelineError> {
    object_store::path::Path::parse(name)
        .map_err(|error| PipelineError::invalid_input(format!("`{name}` can't name an object: {error}")))
}

/// The library's error with the operating system's cause, which says what the user can do.
fn storage(what: &str, error: &object_store::Error) -> PipelineError {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(current) = cause {
        if let Some(io) = current.downcast_ref::<std::io::Error>() {
            return PipelineError::io(what, io);
        }
        cause = current.source();
    }
    PipelineError::storage(format!("{what}: {error}"))
}

#[cfg(test)]
mod tests;
