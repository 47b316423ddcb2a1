//! What can go wrong in planning, execution, storage and output.

use serde::{Deserialize, Serialize};
use terrane_scene::SceneError;

use crate::ArtefactKey;

/// Why planning, storage or output failed. "Could not be reconstructed" is an outcome, not one of these.
#[derive(Debug)]
pub struct PipelineError(Box<Inner>);

#[derive(Debug, thiserror::Error)]
enum Inner {
    #[error("{0}")]
    InvalidInput(String),
    #[error("{message}")]
    Storage { message: String, full: bool, denied: bool },
    #[error("artefact {key} is corrupt: {message}")]
    Corrupt { key: ArtefactKey, message: String },
    #[error("artefact {key} is missing: it was deleted while the run needed it")]
    Missing { key: ArtefactKey },
    #[error("cancelled")]
    Cancelled,
    #[error("{0} (this is a bug of terrane)")]
    Bug(String),
}

impl PipelineError {
    /// Wrong options, or photographs that can't be used; names the object and the remedy.
    pub fn invalid_input(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::InvalidInput(message.into())))
    }

    pub(crate) fn bug(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::Bug(message.into())))
    }

    pub(crate) fn cancelled() -> Self {
        Self(Box::new(Inner::Cancelled))
    }

    pub(crate) fn missing(key: ArtefactKey) -> Self {
        Self(Box::new(Inner::Missing { key }))
    }

    pub(crate) fn storage(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::Storage { message: message.into(), full: false, denied: false }))
    }

    /// An error of the operating system about `what`, with the remedy for those that have one.
    pub(crate) fn io(what: &str, error: &std::io::Error) -> Self {
        let full =
            matches!(error.kind(), std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded);
        let denied = matches!(
            error.kind(),
            std::io::ErrorKind::PermissionDenied | std::io::ErrorKind::ReadOnlyFilesystem
        );
        let remedy = match (full, denied) {
            (true, _) => ": free space or choose another folder, then run again to resume",
            (_, true) => ": check the permissions of the folder or choose another one",
            _ => "",
        };
        Self(Box::new(Inner::Storage { message: format!("{what}: {error}{remedy}"), full, denied }))
    }

    /// A codec's error about an artefact: corrupt when its bytes are not what was written.
    pub(crate) fn codec(key: ArtefactKey, error: &SceneError) -> Self {
        Self(Box::new(Inner::Corrupt { key, message: error.to_string() }))
    }

    /// The input or the options are wrong: nothing but a change of them helps.
    pub fn is_invalid_input(&self) -> bool {
        matches!(*self.0, Inner::InvalidInput(_))
    }

    /// The store or the disk failed.
    pub fn is_storage(&self) -> bool {
        matches!(*self.0, Inner::Storage { .. })
    }

    /// The disk is full.
    pub fn is_storage_full(&self) -> bool {
        matches!(*self.0, Inner::Storage { full: true, .. })
    }

    /// The disk may not be written or read by this user.
    pub fn is_permission_denied(&self) -> bool {
        matches!(*self.0, Inner::Storage { denied: true, .. })
    }

    /// An artefact's bytes are not what was written.
    pub fn is_corrupt(&self) -> bool {
        matches!(*self.0, Inner::Corrupt { .. })
    }

    /// The run was told to stop.
    pub fn is_cancelled(&self) -> bool {
        matches!(*self.0, Inner::Cancelled)
    }

    /// Whether trying again, here or elsewhere, may help.
    pub fn is_retryable(&self) -> bool {
        match *self.0 {
            Inner::Storage { denied, full, .. } => !denied && !full,
            Inner::Corrupt { .. } | Inner::Missing { .. } | Inner::Cancelled => true,
            Inner::InvalidInput(_) | Inner::Bug(_) => false,
        }
    }

    /// The artefact that is corrupt or gone: delete it and plan again.
    pub fn broken_artefact(&self) -> Option<ArtefactKey> {
        match *self.0 {
            Inner::Corrupt { key, .. } | Inner::Missing { key } => Some(key),
            _ => None,
        }
    }
}

impl std::fmt::Display for PipelineError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for PipelineError {}

/// Why a task did not leave its artefact. Travels to the coordinator, so it is plain data.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskError {
    /// What happened, naming the object and the remedy.
    pub message: String,
    /// Trying again, here or on another worker, may help.
    pub retryable: bool,
    /// An input that is corrupt or gone: call [`crate::KnownArtefacts::discard`] on it and plan again.
    pub corrupt_input: Option<ArtefactKey>,
    /// The photographs or options are at fault: the run should end with "bad input".
    pub invalid_input: bool,
    /// The store failed for good (full disk, no permission): the run should end with "storage failure".
    pub storage: bool,
    /// The task was told to stop.
    pub cancelled: bool,
}

impl From<PipelineError> for TaskError {
    fn from(error: PipelineError) -> Self {
        Self {
            message: error.to_string(),
            retryable: error.is_retryable(),
            corrupt_input: error.broken_artefact(),
            invalid_input: error.is_invalid_input(),
            storage: error.is_storage() && !error.is_retryable(),
            cancelled: error.is_cancelled(),
        }
    }
}

impl TaskError {
    /// A task that stopped on a broken invariant; another attempt is allowed, so that a flaky machine is not the end.
    pub(crate) fn panicked(message: String) -> Self {
        Self {
            message: format!("the task stopped on a broken invariant: {message} (this is a bug of terrane)"),
            retryable: true,
            corrupt_input: None,
            invalid_input: false,
            storage: false,
            cancelled: false,
        }
    }
}

impl std::fmt::Display for TaskError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for TaskError {}
