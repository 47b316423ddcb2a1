//! The crate's one public error.

/// Why a photograph, its metadata, a camera or a set of descriptors can't be used.
///
/// The message says what is wrong and what would help. It does not name the file, which this crate never sees: the
/// caller adds the path.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct FrontendError(#[from] Kind);

#[derive(Debug, thiserror::Error)]
enum Kind {
    #[error("{0}")]
    UnsupportedInput(String),
    #[error("{0}")]
    Corrupt(String),
    #[error("{0}")]
    InvalidOption(String),
}

impl FrontendError {
    /// The bytes are of a kind that is not read (HEIC, raw, text, too large); the message names the remedy.
    pub(crate) fn unsupported(message: impl Into<String>) -> Self {
        Self(Kind::UnsupportedInput(message.into()))
    }

    /// The bytes are of a kind that is read, and broken.
    pub(crate) fn corrupt(message: impl Into<String>) -> Self {
        Self(Kind::Corrupt(message.into()))
    }

    /// An option or an argument has a value that makes no sense.
    pub(crate) fn invalid_option(message: impl Into<String>) -> Self {
        Self(Kind::InvalidOption(message.into()))
    }

    /// True when the bytes are of a kind that is read, but damaged: another copy of the file may do.
    pub fn is_corrupt(&self) -> bool {
        matches!(self.0, Kind::Corrupt(_))
    }

    /// True when the file is of a kind or size that is not read: converting it helps.
    pub fn is_unsupported(&self) -> bool {
        matches!(self.0, Kind::UnsupportedInput(_))
    }

    /// True when an option is at fault, not the input.
    pub fn is_invalid_option(&self) -> bool {
        matches!(self.0, Kind::InvalidOption(_))
    }
}
