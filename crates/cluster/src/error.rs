//! The crate's one error.

use terrane_proto::ProtoError;

/// Why a coordinator, worker or launcher could not do its work. Opaque; ask it with the predicates.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct ClusterError {
    message: String,
    bad_input: bool,
    lost: bool,
}

impl ClusterError {
    pub(crate) fn failed(message: impl Into<String>) -> Self {
        Self { message: message.into(), bad_input: false, lost: false }
    }

    pub(crate) fn bad_input(message: impl Into<String>) -> Self {
        Self { message: message.into(), bad_input: true, lost: false }
    }

    pub(crate) fn lost(message: impl Into<String>) -> Self {
        Self { message: message.into(), bad_input: false, lost: true }
    }

    /// What the caller gave is no good; nothing but a change of it helps.
    pub fn is_invalid_input(&self) -> bool {
        self.bad_input
    }

    /// The coordinator can't be reached any more.
    pub fn is_unreachable(&self) -> bool {
        self.lost
    }
}

impl From<ProtoError> for ClusterError {
    fn from(error: ProtoError) -> Self {
        Self {
            bad_input: error.is_invalid_input() || error.is_version_mismatch(),
            lost: error.is_unreachable(),
            message: error.to_string(),
        }
    }
}

/// An error with its causes, for people.
pub fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text.push_str(": ");
        text.push_str(&error.to_string());
        cause = error.source();
    }
    text
}
