//! The error of this crate: storage that fails, or input that contradicts itself. That a seam or a component can't
//! be had is an outcome, not an error.

/// What went wrong while fusing submaps.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct FusionError(Kind);

#[derive(Debug, thiserror::Error)]
enum Kind {
    #[error("shard {shard} could not be {action}: {reason}")]
    Shard { shard: usize, action: &'static str, reason: String },
    #[error("{what} does not fit its input: {reason}")]
    InvalidInput { what: &'static str, reason: String },
    #[error("adjustment failed: {reason}")]
    Adjustment { reason: String },
}

impl FusionError {
    /// A shard that the caller's storage could not read or write; `action` is "read" or "written".
    pub fn shard(shard: usize, action: &'static str, reason: impl ToString) -> Self {
        Self(Kind::Shard { shard, action, reason: reason.to_string() })
    }

    pub(crate) fn invalid(what: &'static str, reason: impl ToString) -> Self {
        Self(Kind::InvalidInput { what, reason: reason.to_string() })
    }

    pub(crate) fn adjustment(reason: impl ToString) -> Self {
        Self(Kind::Adjustment { reason: reason.to_string() })
    }

    /// Whether the caller's storage failed, so that trying again may help.
    pub fn is_storage(&self) -> bool {
        matches!(self.0, Kind::Shard { .. })
    }

    /// Whether the inputs contradict each other, so that trying again won't help.
    pub fn is_invalid_input(&self) -> bool {
        matches!(self.0, Kind::InvalidInput { .. })
    }
}
