//! What can go wrong in reading and writing what this crate knows.

/// Why something could not be encoded, decoded, exported or imported.
#[derive(Debug)]
pub struct SceneError(Box<Inner>);

#[derive(Debug, thiserror::Error)]
enum Inner {
    #[error("{0}")]
    Corrupt(String),
    #[error("{0}")]
    Unsupported(String),
    #[error("{0}")]
    Invalid(String),
    #[error("{what}: {source}")]
    Source { what: String, source: Box<dyn std::error::Error + Send + Sync> },
}

impl SceneError {
    /// Bytes that are not what was written.
    pub(crate) fn corrupt(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::Corrupt(message.into())))
    }

    /// Bytes of a version or kind that this program does not read.
    pub(crate) fn unsupported(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::Unsupported(message.into())))
    }

    /// A value that can't be written in the format asked for, or that contradicts itself.
    pub fn invalid(message: impl Into<String>) -> Self {
        Self(Box::new(Inner::Invalid(message.into())))
    }

    /// The place that the bytes come from or go to failed.
    pub(crate) fn source_failed(
        what: &str,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        Self(Box::new(Inner::Source { what: what.to_owned(), source: source.into() }))
    }

    /// The error of a place that shards are read from, for implementations of [`crate::Model`];
    /// [`SceneError::into_source`] gives it back.
    pub fn from_source(source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::source_failed("reading a shard", source)
    }

    /// The bytes are not what was written: compute them again.
    pub fn is_corrupt(&self) -> bool {
        matches!(*self.0, Inner::Corrupt(_))
    }

    /// The bytes are of a kind or version that this program does not read.
    pub fn is_unsupported(&self) -> bool {
        matches!(*self.0, Inner::Unsupported(_))
    }

    /// The error of the place that the bytes come from or go to, when that is what failed.
    pub fn into_source(self) -> Result<Box<dyn std::error::Error + Send + Sync>, Self> {
        match *self.0 {
            Inner::Source { source, .. } => Ok(source),
            _ => Err(self),
        }
    }
}

impl std::fmt::Display for SceneError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for SceneError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&*self.0)
    }
}

impl From<std::io::Error> for SceneError {
    fn from(error: std::io::Error) -> Self {
        Self::source_failed("input or output failed", error)
    }
}
